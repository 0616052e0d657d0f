"""reconstruct_pair: a moving, bending scene in space from two static cameras that nobody calibrated."""

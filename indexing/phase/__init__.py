"""Actions from single frames: which action a frame is of, and how far the action has come."""

"""The invariants, one per file: what is measured, the tensor of a motion, and the motion of a tensor."""

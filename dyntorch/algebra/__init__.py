"""Linear and multilinear algebra that the invariants stand on: knows tensors only, nothing of cameras or people."""

"""Speed and memory, measured against the goals."""

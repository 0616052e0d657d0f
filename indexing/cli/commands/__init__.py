"""The commands: one module each, whose function of the command's name takes its flags and returns the exit code."""

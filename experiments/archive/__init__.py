"""An archive of movements: what it finds, how it grows, and how fast it answers."""

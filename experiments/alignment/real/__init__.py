"""Alignment of real recordings: traffic seen by a drone, rooms seen by depth cameras, boards in space."""

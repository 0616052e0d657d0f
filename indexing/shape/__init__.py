"""Space-time shapes of actions: what is compared between two windows, and how."""

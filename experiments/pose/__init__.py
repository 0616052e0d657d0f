"""Keypoints from videos: who is found, what it takes, and what can be done with the joints."""

"""Cameras calibrated from the people in view: virtual rigs with known truth, and real recordings."""

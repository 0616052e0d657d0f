"""Reconstruction from tracks of moving points."""

"""Segmentation of two views, and planes that translate."""

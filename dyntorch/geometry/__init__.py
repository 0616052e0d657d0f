"""Geometry of homogeneous coordinates, with no invariant in it: points, lines, cameras, epipolar geometry, triangulation.

Functions of tensors that return tensors or small frozen records.  Stands on ``numerics`` alone.
"""

"""COLMAP without masks: which matches of its database stand still.

``database`` reads it and writes the copy, ``pair_segmentation`` divides each pair of images into bodies and lets COLMAP verify,
``voting`` decides over all pairs which bodies are static, ``static`` holds :func:`find_static` and its stages in order, and draws
masks around what moves.
"""

from __future__ import annotations

from indexing.colmap.database import MatchDatabase as MatchDatabase
from indexing.colmap.database import check_target as check_target
from indexing.colmap.database import read_database as read_database
from indexing.colmap.pair_segmentation import StaticOptions as StaticOptions
from indexing.colmap.static import StaticPoints as StaticPoints
from indexing.colmap.static import find_static as find_static

__all__ = ["MatchDatabase", "StaticOptions", "StaticPoints", "check_target", "find_static", "read_database"]

"""Video without tracks: motion read from image gradients alone (thesis, chapter 7; after Irani)."""

from __future__ import annotations

from indexing.brightness.synchronization import brightness_shift as brightness_shift

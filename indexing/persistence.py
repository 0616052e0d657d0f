"""Model files: safetensors with JSON metadata.  Nothing in them can run."""

from __future__ import annotations

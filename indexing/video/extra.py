"""The two packages of the extra ``video``, imported when they are needed and not before."""

from __future__ import annotations

from importlib import import_module
from typing import Any


def av() -> Any:
    """PyAV: reads and writes video files.

    Raises:
        ValueError: it is not installed.
    """
    return _load("av", "PyAV")


def cv2() -> Any:
    """OpenCV: finds points, follows them, warps pictures.

    Raises:
        ValueError: it is not installed.
    """
    return _load("cv2", "OpenCV")


def _load(module: str, name: str) -> Any:
    try:
        return import_module(module)
    except ImportError as error:
        raise ValueError(f"video: {name} ({module}) cannot be imported ({error}); install 'dyntorch[video]'") from error

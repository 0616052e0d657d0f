"""Shapes of points seen by uncalibrated cameras, every view by another one: standing still (``static``), or moving in time.

``basis`` says how a point may move, ``moving`` finds the shapes, ``times`` when a new view was taken; ``projective`` does both for
perspective views, ``lifted`` is of shapes of P^k; ``deformable`` finds shapes that deform in unknown ways, before two cameras.
"""

from __future__ import annotations

from typing import Any

from dyntorch import _lazily

_HOME = {
    "deformable_shapes": "dyntorch.shapes.deformable",
    "DeformableShapes": "dyntorch.shapes.deformable",
    "fit_shapes": "dyntorch.shapes.moving",
    "MovingShapes": "dyntorch.shapes.moving",
    "fit_perspective_shapes": "dyntorch.shapes.projective",
    "recover_perspective_times": "dyntorch.shapes.projective",
    "recover_times": "dyntorch.shapes.times",
    "Recovery": "dyntorch.shapes.times",
}
__all__ = sorted(_HOME)


def __getattr__(name: str) -> Any:
    return _lazily(__name__, _HOME, name)


def __dir__() -> list[str]:
    return __all__

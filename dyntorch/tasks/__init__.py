"""The tasks a person comes with: a room for each verb, which returns a frozen result; what results share is in ``outcome``."""

from __future__ import annotations

from typing import Any

from dyntorch import _lazily

_HOME = {
    "breaks": "dyntorch.tasks.synchronize.breaks",
    "camera_breaks": "dyntorch.tasks.synchronize.breaks",
    "affine_segmentation": "dyntorch.tasks.segment.affine",
    "MOTION_MODELS": "dyntorch.tasks.reconstruct.motion_models",
    "MotionName": "dyntorch.tasks.reconstruct.motion_models",
    "projective_factorization": "dyntorch.tasks.reconstruct.factorization",
    "velocity_factorization": "dyntorch.tasks.reconstruct.factorization",
    "LineStatus": "dyntorch.tasks.trajectories.trajectories",
    "points_on_lines": "dyntorch.tasks.trajectories.trajectories",
    "BodyModel": "dyntorch.tasks.segment.result",
}
__all__ = sorted(_HOME)


def __getattr__(name: str) -> Any:
    return _lazily(__name__, _HOME, name)


def __dir__() -> list[str]:
    return __all__

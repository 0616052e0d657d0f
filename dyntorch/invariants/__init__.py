"""The invariants, one per file: what is measured, the tensor of a motion, and the motion of a tensor."""

from __future__ import annotations

from typing import Any

from dyntorch import _lazily

_HOME = {
    "multibody_matrix": "dyntorch.invariants.multibody",
}
__all__ = sorted(_HOME)


def __getattr__(name: str) -> Any:
    return _lazily(__name__, _HOME, name)


def __dir__() -> list[str]:
    return __all__

"""Geometry of scenes in which everything moves, batched in PyTorch.

The public names are imported lazily, so that ``import dyntorch`` costs nothing before one of them is used.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any

__version__ = "0.1.0"

_HOME = {
    "canonical_correlation": "dyntorch.algebra.subspaces",
    "orthonormal_basis": "dyntorch.algebra.subspaces",
    "affine_factorization": "dyntorch.algebra.factorization",
    "metric_upgrade": "dyntorch.algebra.factorization",
}
__all__ = sorted(_HOME)


def __getattr__(name: str) -> Any:
    if name in _HOME:
        return getattr(import_module(_HOME[name]), name)
    raise AttributeError(f"module 'dyntorch' has no attribute {name!r}")


def __dir__() -> list[str]:
    return [*__all__, "__version__"]

"""What is measured in one view, and the vectors that it puts into the estimation matrix; the contract is in ``base``."""

from dyntorch.primitives.base import Primitive, triangle
from dyntorch.primitives.equations import Equations
from dyntorch.primitives.monomials import Monomials
from dyntorch.primitives.plane import Hyperplane, HyperplanesThrough, Point
from dyntorch.primitives.space import Line, Projected, direction

__all__ = [
    "Equations", "Hyperplane", "HyperplanesThrough", "Line", "Monomials", "Point", "Primitive", "Projected", "direction",
    "triangle",
]  # fmt: skip

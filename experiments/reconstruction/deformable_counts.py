"""Which information determines a deformable shape basis: dimensions that stay open, by exact ranks over prime fields.

``python -m experiments.reconstruction.deformable_counts`` prints, for every kind of camera and number B of basis shapes, what the
images leave open beyond what they cannot tell (the frame of the scene, a change of the basis, the scale of a frame), and the least
number of frames and points from which that is 0.

The images :math:`x_{ti} = M_t \\sum_b c_{tb} B_{bi}` (about a known origin) are polynomials of all unknowns; their Jacobian
at a random point modulo 2^31 - 1 has the rank that it has at almost every real point. Rotations are those of quaternions, of
any length.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dyntorch.counting.exact import Echelon, Field
from experiments.common.runner import BaseConfig, Tables, Words, experiment

PRIME = 2**31 - 1
Array = NDArray[np.int64]


@dataclass(frozen=True)
class Dual:
    """Numbers modulo the prime and their derivatives by all unknowns, ``(*shape)`` and ``(*shape, unknowns)``."""

    value: Array
    slope: Array

    def __add__(self, other: Dual) -> Dual:
        return Dual((self.value + other.value) % PRIME, (self.slope + other.slope) % PRIME)

    def __sub__(self, other: Dual) -> Dual:
        return Dual((self.value - other.value) % PRIME, (self.slope - other.slope) % PRIME)

    def __mul__(self, other: Dual) -> Dual:
        slope = (self.value[..., None] * other.slope % PRIME + other.value[..., None] * self.slope % PRIME) % PRIME
        return Dual(self.value * other.value % PRIME, slope)

    def __getitem__(self, at: Any) -> Dual:
        return Dual(self.value[at], self.slope[at])


def stacked(parts: Sequence[Dual], axis: int) -> Dual:
    """Along a new axis, counted from the front."""
    return Dual(np.stack([part.value for part in parts], axis), np.stack([part.slope for part in parts], axis))


def product(first: Dual, second: Dual) -> Dual:
    """Matrices ``(..., i, k)`` times ``(..., k, j)``."""

    def term(k: int) -> Dual:
        left = Dual(first.value[..., :, k, None], first.slope[..., :, k, None, :])
        return left * Dual(second.value[..., None, k, :], second.slope[..., None, k, :, :])

    total = term(0)
    for k in range(1, first.value.shape[-1]):
        total = total + term(k)
    return total


class Unknowns:
    """Random numbers that are all unknown, handed out block by block."""

    def __init__(self, count: int, seed: int) -> None:
        self.values = np.random.default_rng(seed).integers(1, PRIME, count)
        self.used = 0

    def __call__(self, *shape: int) -> Dual:
        size = int(np.prod(shape))
        place = np.arange(self.used, self.used + size)
        self.used += size
        slope = np.zeros((size, len(self.values)), dtype=np.int64)
        slope[np.arange(size), place] = 1
        return Dual(self.values[place].reshape(shape), slope.reshape(*shape, -1))


def rotated(q: Dual) -> Dual:
    """Rotations times the squared length of quaternions ``(T, 4)``: ``(T, 3, 3)``."""
    w, x, y, z = (q[:, k] for k in range(4))
    two = Dual(np.full_like(w.value, 2), np.zeros_like(w.slope))
    rows = [
        [w * w + x * x - y * y - z * z, two * (x * y - w * z), two * (x * z + w * y)],
        [two * (x * y + w * z), w * w - x * x + y * y - z * z, two * (y * z - w * x)],
        [two * (x * z - w * y), two * (y * z + w * x), w * w - x * x - y * y + z * z],
    ]
    return stacked([stacked(row, 1) for row in rows], 1)


def _any(take: Unknowns, T: int) -> Dual:
    return take(T, 2, 3)


def _fixed(take: Unknowns, T: int) -> Dual:
    one = take(1, 2, 3)
    return stacked([one[0] for _ in range(T)], 0)


def _orthographic(take: Unknowns, T: int) -> Dual:
    return rotated(take(T, 4))[:, :2]


def _turntable(take: Unknowns, T: int) -> Dual:
    """Rows (a, 0, b) and (0, e, 0): a camera that turns about the vertical of the image."""
    free = take(T, 3)
    nothing = Dual(np.zeros_like(free.value[:, 0]), np.zeros_like(free.slope[:, 0]))
    rows = [[free[:, 0], nothing, free[:, 1]], [nothing, free[:, 2], nothing]]
    return stacked([stacked(row, 1) for row in rows], 1)


def _pair(take: Unknowns, T: int) -> Dual:
    one = take(1, 4, 3)
    return stacked([one[0] for _ in range(T)], 0)


def _moving_pair(take: Unknowns, T: int) -> Dual:
    rig = take(1, 4, 3)
    return product(stacked([rig[0] for _ in range(T)], 0), rotated(take(T, 4)))


@dataclass(frozen=True)
class Kind:
    """One kind of information: its cameras, unknowns of them (of T frames), and the frames of the scene that no image tells."""

    name: str
    cameras: Callable[[Unknowns, int], Dual]
    unknowns: Callable[[int], int]
    frame: int
    """Dimensions of the changes of the scene's frame that the cameras allow, but for one scale."""
    scales: Callable[[int], int]
    """Dimensions of the scales that cancel in the product of cameras, coefficients and shapes."""
    symmetric: bool = False


KINDS = (
    Kind("one affine camera, another in every frame", _any, lambda T: 6 * T, 8, lambda T: T + 1),
    Kind("one affine camera, fixed", _fixed, lambda T: 6, 8, lambda T: 2),
    Kind("one scaled orthographic camera, turning freely", _orthographic, lambda T: 4 * T, 3, lambda T: T + 1),
    Kind("one affine camera, turning about the vertical", _turntable, lambda T: 3 * T, 4, lambda T: T + 1),
    Kind("symmetric shapes, one affine camera, another in every frame", _any, lambda T: 6 * T, 4, lambda T: T + 1, True),
    Kind("symmetric shapes, one affine camera, fixed", _fixed, lambda T: 6, 4, lambda T: 2, True),
    Kind("two affine cameras, fixed", _pair, lambda T: 12, 8, lambda T: 2),
    Kind("two affine cameras, fixed to each other, moving", _moving_pair, lambda T: 12 + 4 * T, 6, lambda T: T + 2),
)


def excess(kind: Kind, B: int, T: int, n: int, seed: int = 0) -> int:
    """Dimensions that T frames of n points leave open beyond the frame, the basis and the scales."""
    free = n // 2 if kind.symmetric else n
    count = kind.unknowns(T) + T * B + 3 * free * B
    take = Unknowns(count, seed)
    cameras, coefficients, shapes = kind.cameras(take, T), take(T, B), take(B, 3, free)
    if kind.symmetric:  # mirrored in the plane X = 0
        other = Dual(shapes.value.copy(), shapes.slope.copy())
        other.value[:, 0], other.slope[:, 0] = -other.value[:, 0] % PRIME, -other.slope[:, 0] % PRIME
        shapes = Dual(np.concatenate([shapes.value, other.value], -1), np.concatenate([shapes.slope, other.slope], -2))
    flat = Dual(shapes.value.reshape(B, -1), shapes.slope.reshape(B, -1, count))
    deformed = product(coefficients, flat)
    points = Dual(deformed.value.reshape(T, 3, -1), deformed.slope.reshape(T, 3, -1, count))
    images = product(cameras, points)
    rank = Echelon(Field(PRIME, [seed]), count)
    rank.add(images.slope.reshape(-1, count))
    return count - rank.rank - (kind.frame + B * B - 1 + kind.scales(T))


@dataclass(frozen=True)
class Config(BaseConfig):
    """Counts of shapes that deform."""

    shapes: int = 3
    """Basis shapes up to which is counted."""


def least(kind: Kind, B: int, most: int = 16) -> tuple[str, str, str]:
    """What stays open of many frames and points, the least frames (of many points) and the least points (of many frames)."""
    T, n = most, 14
    open_ = excess(kind, B, T, n)
    if open_:
        more = excess(kind, B, T, n + 2) - open_
        longer = excess(kind, B, T + 1, n) - open_
        return f"{open_} ({more / 2:+g} per point, {longer:+d} per frame)", "-", "-"
    frames = next(t for t in range(1, T + 1) if excess(kind, B, t, n) == 0)
    points = next(m for m in range(2, n + 1) if not (kind.symmetric and m % 2) and excess(kind, B, T, m) == 0)
    return "0", str(frames), str(points)


@experiment(Config(), quick={"shapes": 2})
def tables(config: Config) -> Tables:
    """Every kind of cameras, by the number of basis shapes."""
    head = ("cameras", "B", "open dimensions, 16 frames of 14 points", "least frames (14 points)", "least points (16 frames)")
    lines = [(kind.name, str(B), *least(kind, B)) for kind in KINDS for B in range(2, config.shapes + 1)]
    yield "dimensions that stay open", Words(head, lines)

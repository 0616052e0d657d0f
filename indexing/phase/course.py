r"""How the shape of the joints goes through an action, learned from single frames: :math:`X(\phi) = \sum_b c_b(\phi) X_b`.

Maximum likelihood (:func:`dyntorch.fit_shapes`) has the least residual on the frames learned from, but not on other takes: 15 to
30 views are few, and people differ.  A ridge and a coordinate of style per clip take its phase error from 13.8 to 11.1 degrees
(CMU walking, four views per take, other takes), 18 functions by maximum likelihood to 50.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from dyntorch import Fourier, Polynomial
from indexing.phase.frames import shape_distance, standardized
from indexing.shape.bank import Windows, stack

RIDGE = 1e-4  # of the mean diagonal of the normal matrix; 1e-5 is as good, 1e-3 costs .5 and 1e-2 4 degrees
ROUNDS, AGAIN = 30, 8  # alternations from the mean shape, and after every change of styles
STYLES = (-0.7, 0.0, 0.7)  # five from -1 to 1 give the same
CHANGES = 5  # of styles
SWING = 0.3  # styles start as more and less motion
STYLED = 4  # clips: fewer do not tell styles apart
GRID = 96  # phases: 3.75 degrees apart; 192 changes the median error by less than .1 degree


@dataclass(frozen=True)
class Course:
    """The shapes of an action.

    shapes: ``(styles, B, n, 3)`` float64; periodic: whether phase 1 is phase 0 again; seen: ``(n,)`` joints that are known.
    """

    shapes: Tensor
    periodic: bool
    seen: Tensor

    def bank(self, grid: int = GRID) -> Windows:
        """The shapes of all styles at all phases of the grid, style by style."""
        rows = basis_of(self.periodic, self.shapes.shape[1]).rows(_argument(phases(grid, self.periodic), self.periodic))
        values = torch.cat([_at(rows.to(self.shapes), shapes) for shapes in self.shapes])
        return Windows(values[:, None], self.seen.expand(len(values), -1))

    def curve(self, query: Windows, grid: int = GRID) -> Tensor:
        """``(Q, grid)`` what is left of every frame at every phase, in the style that leaves least."""
        return curves(query, [self], grid)[0]


def curves(query: Windows, courses: Sequence[Course], grid: int = GRID) -> list[Tensor]:
    """:meth:`Course.curve` of several courses in one pass."""
    left = shape_distance(query, stack([course.bank(grid) for course in courses]))
    parts = left.split([grid * len(course.shapes) for course in courses], 1)
    return [part.unflatten(1, (-1, grid)).amin(1) for part in parts]


def basis_of(periodic: bool, size: int) -> Fourier | Polynomial:
    """The basis with so many functions."""
    return Fourier((size - 1) // 2, 1.0) if periodic else Polynomial(size - 1)


def phases(grid: int, periodic: bool) -> Tensor:
    """``(grid,)`` in [0, 1) of a cycle, in [0, 1] of a course."""
    return torch.arange(grid, dtype=torch.float64) / grid if periodic else torch.linspace(0, 1, grid, dtype=torch.float64)


def _argument(phase: Tensor, periodic: bool) -> Tensor:
    return phase if periodic else 2 * phase - 1


def learn_course(x: Tensor, seen: Tensor, phase: Tensor, clip: Tensor, *, harmonics: int, periodic: bool) -> Course:
    r"""Alternate between cameras and shapes, each a linear problem; then give every clip a style a and repeat.

    .. math:: \min \sum_f w_f \Big\|x_f - \sum_b c_b(\phi_f)\,(X_b + a_{k(f)} X'_b)\,A_f - 1 b_f^T\Big\|^2
        + \lambda(\|X\|^2 + \|X'\|^2)

    Args:
        x: ``(F, n, 2)`` frames; seen: ``(F, n)``; phase: ``(F,)`` in [0, 1]; clip: ``(F,)`` whose frame it is (every clip counts
            the same).
        harmonics: of a cycle; the degree of a course is twice as high.
    """
    rows = basis_of(periodic, 2 * harmonics + 1).rows(_argument(phase, periodic))
    _, owner, counts = clip.unique(return_inverse=True, return_counts=True)
    weight = seen.to(x) * (len(x) / (len(counts) * counts[owner].to(x)))[:, None]
    x = standardized(x, seen)
    # the first guess stands still
    flat = x.permute(1, 0, 2).flatten(1)
    start = x.new_zeros(rows.shape[1], x.shape[1], 3)
    start[0] = torch.linalg.eigh(flat @ flat.mT)[1][:, -3:].flip(1)
    start[1:] = 0.1 * torch.randn(start[1:].shape, generator=torch.Generator().manual_seed(0), dtype=x.dtype) / rows.shape[1]
    shapes = _alternated(x, weight, rows, start, ROUNDS)
    known = seen.any(0)
    if len(counts) < STYLED:
        return Course(shapes[None], periodic, known)
    swing = SWING * shapes
    swing[0] = 0
    both = torch.cat([shapes, swing])
    levels = torch.tensor(STYLES, dtype=x.dtype)
    for _ in range(CHANGES):
        left = torch.stack([_left(x, weight, rows, _styled(both, level)) for level in levels])
        style = levels[x.new_zeros(len(levels), len(counts)).index_add_(1, owner, left).argmin(0)]
        style = style - style.mean()
        style = max(STYLES) * style / style.std(correction=0).clamp(min=1e-9)
        both = _alternated(x, weight, torch.cat([rows, style[owner, None] * rows], 1), both, AGAIN)
    return Course(torch.stack([_styled(both, level) for level in levels]), periodic, known)


def _styled(both: Tensor, level: Tensor) -> Tensor:
    plain, change = both.chunk(2)
    return plain + level * change


def _cameras(x: Tensor, weight: Tensor, at: Tensor) -> Tensor:
    """Affine cameras ``(F, 4, 2)``, the last row the translation."""
    wide = torch.cat([at, torch.ones_like(at[..., :1])], -1)
    heavy = (wide * weight[..., None]).mT
    gram = heavy @ wide
    ridge = 1e-9 * gram.diagonal(dim1=1, dim2=2).sum(-1).clamp(min=1e-12)[:, None, None] * torch.eye(4, dtype=x.dtype)
    return torch.linalg.solve(gram + ridge, heavy @ x)


def _left(x: Tensor, weight: Tensor, rows: Tensor, shapes: Tensor) -> Tensor:
    """``(F,)`` weighted squared residual of every frame."""
    at = _at(rows, shapes)
    cameras = _cameras(x, weight, at)
    return ((x - at @ cameras[:, :3] - cameras[:, 3:]).square() * weight[..., None]).sum((1, 2))


def _alternated(x: Tensor, weight: Tensor, rows: Tensor, shapes: Tensor, rounds: int) -> Tensor:
    frames, n = weight.shape
    eye = torch.eye(3 * rows.shape[1], dtype=x.dtype)
    for _ in range(rounds):
        cameras = _cameras(x, weight, _at(rows, shapes))
        design = (rows[:, None, :, None] * cameras[:, :3].mT[:, :, None]).flatten(2)  # (F, 2, 3 B)
        gram = (weight.mT @ (design.mT @ design).flatten(1)).unflatten(1, eye.shape)
        right = ((x - cameras[:, 3:]) * weight[..., None]).permute(1, 0, 2).flatten(1) @ design.flatten(0, 1)
        gram = gram + RIDGE * gram.diagonal(dim1=1, dim2=2).mean(-1).clamp(min=1e-12)[:, None, None] * eye
        shapes = torch.linalg.solve(gram, right).reshape(n, -1, 3).transpose(0, 1)
        # the affine frame is free: unit covariance keeps the ridge meaningful
        at = _at(rows, shapes)
        at = (at - at.mean(1, keepdim=True)).flatten(0, 1)
        spread = at.mT @ at / frames
        factor = torch.linalg.cholesky_ex(spread + 1e-9 * spread.trace() * torch.eye(3, dtype=x.dtype))[0]
        shapes = torch.linalg.solve_triangular(factor, shapes.mT, upper=False).mT
    return shapes


def _at(rows: Tensor, shapes: Tensor) -> Tensor:
    """``(F, n, 3)`` the shape of every frame."""
    return (rows @ shapes.flatten(1)).unflatten(1, shapes.shape[1:])

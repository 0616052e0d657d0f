"""Many weightings of the same matches: tensors, distances and annealed reweighting for a whole bundle of starts at once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from dyntorch.eigenspace import orthonormal
from dyntorch.invariant import Invariant
from dyntorch.matrix import unpack
from dyntorch.nullspace import gram_null_space
from dyntorch.primitives import HyperplanesThrough, Point, Primitive
from dyntorch.residual import SINGULAR, whiten

STEPS = 2
"""Inverse iterations per reweighting: the weights change more than what is left of the null vector's error."""
SHIFT = 1e-14  # of the trace: keeps the factor of an exactly singular Gram finite
FAR = 1e30  # squared distance in place of one that is no number


@dataclass(frozen=True)
class Bundle:
    """Matches of a block of problems in normalized coordinates, with everything that does not depend on their weights.

    Axes: problems b, copies c (1 where the invariant has none), starts K, tensors of one null space a, matches n.
    """

    invariant: Invariant
    primitives: tuple[Primitive, ...]
    views: tuple[Tensor, ...]
    """``(b, 1, n, ...)``."""
    scales: tuple[Tensor, ...]
    """``(b,)`` size, in these coordinates, of one unit of the measurements."""
    weights: Tensor
    """``(b, n)``."""
    moments: Tensor
    """``(b, c, n, m)`` packed outer squares of the rows of each match."""
    vectors: tuple[Tensor, ...]
    """``(b, c, width, n)`` per view."""

    def first(self, weights: Tensor) -> Tensor:
        """Null spaces ``(b, c, K, a, D)`` of the weightings ``(b, K, n)`` of rows of unit length."""
        norms = torch.ones((), dtype=weights.dtype, device=weights.device)
        for primitive, u in zip(self.primitives, self.vectors, strict=True):
            norms = norms * u.square().sum(-2) if primitive.rows == 1 else norms
        gram = self._gram(weights[:, None] / norms[:, :, None].clamp(min=1e-300))
        return gram_null_space(gram, self.invariant.nullity).basis

    def next(self, weights: Tensor, basis: Tensor) -> Tensor:
        """The same for weightings ``(b, c, K, n)`` of unscaled rows, by inverse iteration from the null spaces before."""
        gram = self._gram(weights)
        diagonal = gram.diagonal(dim1=-2, dim2=-1)
        diagonal += diagonal.sum(-1, keepdim=True) * SHIFT + 1e-300
        factor, _ = torch.linalg.cholesky_ex(gram)
        columns = basis.mT
        for _ in range(STEPS):
            columns = orthonormal(torch.cholesky_solve(columns, factor))
        found = columns.mT
        return torch.where(found.isfinite().all(-1, keepdim=True).all(-2, keepdim=True), found, basis)

    def _gram(self, weights: Tensor) -> Tensor:
        # all starts in one product: the matches are read once, however many weightings there are
        return unpack(weights @ self.moments, tuple(p.width for p in self.primitives))

    def distances(self, basis: Tensor) -> tuple[Tensor, Tensor]:
        r"""Squared Sampson distances ``(b, K, n)`` in the unit of the measurements, and row weights ``(b, c, K, n)``.

        Of several tensors, or copies, :math:`d^2 = k \sum h^2 / \sum \|\nabla h\|^2` with k conditions per match: right in the
        mean, without the motion behind the tensors.
        """
        slot = transfer_slot(self.primitives)
        square, rows = self._form(basis) if slot is None else self._transfer(basis, slot)
        return square.nan_to_num(nan=FAR, posinf=FAR).clamp(max=FAR), rows.nan_to_num(nan=0.0, posinf=0.0)

    def _form(self, basis: Tensor) -> tuple[Tensor, Tensor]:
        """One row per match: the value of the multilinear form over the length of its gradient."""
        widths = [p.width for p in self.primitives]
        cube = basis.unflatten(-1, widths)
        square = torch.zeros((), dtype=basis.dtype, device=basis.device)
        value = torch.zeros((), dtype=basis.dtype, device=basis.device)
        for v, scale in enumerate(self.scales):
            others = _products([u for w, u in enumerate(self.vectors) if w != v])
            gradient = (cube.movedim(4 + v, 4).flatten(2, 4).flatten(3) @ others).unflatten(2, (*basis.shape[2:4], widths[v]))
            if v == 0:
                value = (gradient * self.vectors[v][:, :, None, None]).sum(-2)
            square = square + scale.square()[:, None, None, None] * self._pullback(v, gradient).square().sum((3, -2))
        ratio = value.square().sum(-2) / (square + SINGULAR)
        return ratio.mean(1) * self.invariant.codim, 1 / (square + SINGULAR)

    def _transfer(self, basis: Tensor, slot: int) -> tuple[Tensor, Tensor]:
        """Rows that say where the point of one view lies: how far it is from where the others predict it."""
        widths = [p.width for p in self.primitives]
        d = widths[slot] - 1
        cube = basis[:, :, :, 0].unflatten(-1, widths).movedim(3 + slot, 3)
        rest = [v for v in range(len(widths)) if v != slot]
        lead = cube.shape[:2]
        image = cube.reshape(*lead, cube.shape[2] * (d + 1), -1) @ _products([self.vectors[v] for v in rest])
        image = image.unflatten(2, (-1, d + 1))
        depth, floor = image[..., d, :], 1e-12 * image.abs().amax(-2)
        depth = torch.where(depth.abs() > floor, depth, floor.clamp(min=1e-300))
        place = image[..., :d, :] / depth[..., None, :]
        eye = torch.eye(d, dtype=basis.dtype, device=basis.device)
        covariance = self.scales[slot].square()[:, None, None, None, None, None] * eye
        for i, v in enumerate(rest):
            others = _products([self.vectors[w] for w in rest if w != v] or [torch.ones_like(self.vectors[v][..., :1, :])])
            rows = cube.movedim(4 + i, 4).reshape(*lead, cube.shape[2] * (d + 1) * widths[v], -1)
            moved = self._pullback(v, (rows @ others).unflatten(2, (-1, d + 1, widths[v])))
            jacobian = (moved[:, :, :, :d] - place[..., None, :] * moved[:, :, :, d:]) / depth[..., None, None, :]
            jacobian = (self.scales[v][:, None, None, None, None, None] * jacobian).movedim(-1, 3)
            covariance = covariance + (jacobian[..., :, None, :] * jacobian[..., None, :, :]).sum(-1)
        error = place.mT - self.views[slot][:, :, None]
        size = covariance.diagonal(dim1=-2, dim2=-1).sum(-1) / d * depth.square()
        return whiten(error, covariance).square().sum(-1)[:, 0], 1 / (size + SINGULAR)

    def _pullback(self, view: int, gradient: Tensor) -> Tensor:
        """Derivatives by the measured coordinates ``(b, c, .., d, n)`` from those by the vectors ``(b, c, .., width, n)``."""
        primitive = self.primitives[view]
        if isinstance(primitive, Point):
            return gradient[..., :-1, :]
        x = self.views[view]
        columns = gradient.mT
        item = x.shape[3:]
        # one long axis of matches, because the primitive knows only one
        spread = x[(slice(None), slice(None), *[None] * (gradient.ndim - 4))].expand(*x.shape[:2], *columns.shape[2:-1], *item)
        flat = primitive.pullback(spread.reshape(*x.shape[:2], -1, *item), columns.flatten(2, -2))
        return flat.unflatten(2, columns.shape[2:-1]).mT


def bundle(
    invariant: Invariant, primitives: tuple[Primitive, ...], views: tuple[Tensor, ...], scales: tuple[Tensor, ...], weights: Tensor
) -> Bundle:
    """Prepare matches ``(b, 1, n, ...)`` in normalized coordinates, with weights ``(b, n)``."""
    packed, vectors = [], []
    for primitive, x in zip(primitives, views, strict=True):
        rows, columns = torch.triu_indices(primitive.width, primitive.width, device=x.device)
        if primitive.rows > 1:
            packed.append(primitive.packed(x).mT)
            vectors.append(x.new_zeros(0))
        else:
            vectors.append(primitive.components(x))
            packed.append((vectors[-1][..., rows, :] * vectors[-1][..., columns, :]).mT)
    moments = packed[0]
    for factor in packed[1:]:
        moments = (moments[..., :, None] * factor[..., None, :]).flatten(-2)
    return Bundle(invariant, primitives, views, scales, weights, moments, tuple(vectors))


def transfer_slot(primitives: Sequence[Primitive]) -> int | None:
    """The view measured through all hyperplanes of its points, which the other views predict."""
    slots = [v for v, p in enumerate(primitives) if isinstance(p, HyperplanesThrough)]
    return slots[0] if slots else None


def anneal(data: Bundle, basis: Tensor, end: Tensor, iterations: int) -> Tensor:
    r"""Graduated non-convexity: weights :math:`(a / (a + d^2))^2` (Geman-McClure) with a scale a that shrinks to ``end``.

    The scale starts at four times the median squared distance of each start (a mean would be that of the outliers).

    Args:
        data: matches.
        basis: ``(b, c, K, a, D)``.
        end: ``(b,)`` squared scale at the end.
        iterations: reweightings; the last 30 % are at the final scale.

    Returns:
        The tensors, same shape.

    Source: Black and Rangarajan 1996; Yang, Antonante, Tzoumas and Carlone 2020.
    """
    stop = end[:, None, None, None]
    start: Tensor | None = None
    for i in range(iterations):
        square, rows = data.distances(basis)
        if start is None:
            start = torch.maximum(4 * median(square, data.weights)[:, None, :, None], stop)
        scale = start * (stop / start) ** min(1.0, i / (0.7 * iterations))
        weights = (scale / (scale + square[:, None])).square() * data.weights[:, None, None] * rows
        basis = data.next(weights, basis)
    return basis


def concentrate(data: Bundle, basis: Tensor, cut: Tensor | None, iterations: int) -> Tensor:
    """Refit to the matches with a squared distance up to ``cut (b,)``, or (None) to the nearer half of them."""
    for _ in range(iterations):
        square, rows = data.distances(basis)
        limit = median(square, data.weights)[:, :, None] if cut is None else cut[:, None, None]
        basis = data.next((square <= limit)[:, None] * data.weights[:, None, None] * rows, basis)
    return basis


def msac(square: Tensor, weights: Tensor, cut: Tensor) -> Tensor:
    """Truncated squares in units of the cut, ``(b, K)``: the matches' weight lost, less is better."""
    return ((square / cut[:, None, None]).clamp(max=1.0) * weights[:, None]).sum(-1)


def median(square: Tensor, weights: Tensor) -> Tensor:
    """Median ``(b, K)`` over the matches with weight."""
    order = square.masked_fill(weights[:, None] <= 0, torch.inf).sort(-1).values
    middle = ((weights > 0).sum(-1) // 2).clamp(max=order.shape[-1] - 1)
    return order.gather(-1, middle[:, None, None].expand(*order.shape[:2], 1))[..., 0].clamp(max=FAR)


def _products(vectors: list[Tensor]) -> Tensor:
    """Kronecker products of vectors, match by match: ``(b, c, w1 w2 ..., n)``."""
    total = vectors[0]
    for u in vectors[1:]:
        total = (total[..., :, None, :] * u[..., None, :, :]).flatten(-3, -2)
    return total

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
from dyntorch.primitives import HyperplanesThrough, Point, Primitive, triangle
from dyntorch.residual import SINGULAR, whiten

STEPS = 2
"""Inverse iterations per reweighting: the weights change more than what is left of the null vector's error."""
SHIFT = 1e-14  # of the trace: keeps the factor of an exactly singular Gram finite
FAR = 1e30  # squared distance in place of one that is no number
HOLD = 0.7  # share of the reweightings during which the scale shrinks


@dataclass(frozen=True)
class Bundle:
    """Matches of a block of problems in normalized coordinates, with everything that does not depend on their weights.

    Axes: problems b, copies c (1 where the invariant has none), starts K, tensors of one null space a, matches n.
    """

    invariant: Invariant
    """In these coordinates, for tensors ``(b, K, ..)``."""
    primitives: tuple[Primitive, ...]
    views: tuple[Tensor, ...]
    """``(b, 1, n, ...)``."""
    scales: tuple[Tensor, ...]
    """``(b,)`` size, in these coordinates, of one unit of the search."""
    weights: Tensor
    """``(b, n)``."""
    moments: Tensor
    """``(b, c, n, m)`` packed outer squares of the rows of each match."""
    vectors: tuple[Tensor, ...]
    """``(b, c, width, rows, n)`` per view, of the length that the derivatives of the primitives suppose."""

    def first(self, weights: Tensor) -> Tensor:
        """Null spaces ``(b, c, K, a, D)`` of the weightings ``(b, K, n)`` of rows of unit length."""
        gram = self._gram(weights[:, None] / self.lengths()[:, :, None])
        return gram_null_space(gram, self.invariant.nullity).basis

    def lengths(self) -> Tensor:
        """Squared lengths ``(b, c, n)`` of the rows."""
        norms = torch.ones_like(self.weights[:, None])
        for primitive, u in zip(self.primitives, self.vectors, strict=True):
            norms = norms * u[..., 0, :].square().sum(-2) if primitive.rows == 1 else norms
        return norms.clamp(min=1e-300)

    def constrained(self, basis: Tensor) -> Tensor:
        """The tensors of the motions that tensors ``(b, c, K, a, D)`` decompose into; where no motion guides, the tensors."""
        if not self.invariant.guides:
            return basis
        inv, own = self.invariant, basis.transpose(1, 2)
        motion = inv.decompose(inv.tensor_of(own if inv.copies else own[:, :, 0]))
        made = inv.compose(*motion) if isinstance(motion, tuple) else inv.compose(motion)
        made = inv.basis_of(made).reshape(own.shape).transpose(1, 2)
        sound = made.isfinite().all(-1, keepdim=True) & (made.abs().amax(-1, keepdim=True) > 0)
        return torch.where(sound.all(-2, keepdim=True).all(1, keepdim=True), made, basis)

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

        Of several tensors, rows or copies, :math:`d^2 = k \sum h^2 / \sum \|\nabla h\|^2` with k conditions per match: right in
        the mean, without the motion behind the tensors.
        """
        slot = transfer_slot(self.primitives)
        square, rows = self._form(basis) if slot is None else self._transfer(basis, slot)
        return square.nan_to_num(nan=FAR, posinf=FAR).clamp(max=FAR), rows.nan_to_num(nan=0.0, posinf=0.0)

    def _form(self, basis: Tensor) -> tuple[Tensor, Tensor]:
        """Values of the multilinear form on all rows of a match over the length of their gradients."""
        widths = [p.width for p in self.primitives]
        cube = basis.unflatten(-1, widths)
        square = torch.zeros((), dtype=basis.dtype, device=basis.device)
        value = torch.zeros((), dtype=basis.dtype, device=basis.device)
        for v, scale in enumerate(self.scales):
            others = _products([u for w, u in enumerate(self.vectors) if w != v])
            flat = cube.movedim(4 + v, 4).flatten(2, 4).flatten(3) @ others.flatten(3)
            gradient = flat.unflatten(2, (*basis.shape[2:4], widths[v])).unflatten(-1, others.shape[3:]).movedim(-2, 4)
            if v == 0:
                for u in self.vectors[v][:, :, None, None, None].unbind(-2):
                    value = value + (gradient * u).sum(-2).square().sum((3, 4))
            square = square + scale.square()[:, None, None, None] * self._slopes(v, gradient).square().sum((3, 4, 5))
        return (value / (square + SINGULAR)).mean(1) * self.invariant.codim, 1 / (square + SINGULAR)

    def _transfer(self, basis: Tensor, slot: int) -> tuple[Tensor, Tensor]:
        """Rows that say where the point of one view lies: how far it is from where the others predict it."""
        widths = [p.width for p in self.primitives]
        d = widths[slot] - 1
        cube = basis[:, :, :, 0].unflatten(-1, widths).movedim(3 + slot, 3)
        rest = [v for v in range(len(widths)) if v != slot]
        lead = cube.shape[:2]
        image = cube.reshape(*lead, cube.shape[2] * (d + 1), -1) @ _products([self.vectors[v] for v in rest])[..., 0, :]
        image = image.unflatten(2, (-1, d + 1))
        depth, floor = image[..., d, :], 1e-12 * image.abs().amax(-2)
        depth = torch.where(depth.abs() > floor, depth, floor.clamp(min=1e-300))
        place = image[..., :d, :] / depth[..., None, :]
        eye = torch.eye(d, dtype=basis.dtype, device=basis.device)
        covariance = self.scales[slot].square()[:, None, None, None, None, None] * eye
        for i, v in enumerate(rest):
            others = _products([self.vectors[w] for w in rest if w != v] or [torch.ones_like(self.vectors[v][:, :, :1])])[..., 0, :]
            rows = cube.movedim(4 + i, 4).reshape(*lead, cube.shape[2] * (d + 1) * widths[v], -1)
            moved = self._slopes(v, (rows @ others).unflatten(2, (-1, d + 1, widths[v])))
            jacobian = (moved[:, :, :, :d] - place[..., None, :] * moved[:, :, :, d:]) / depth[..., None, None, :]
            jacobian = (self.scales[v][:, None, None, None, None, None] * jacobian).movedim(-1, 3)
            covariance = covariance + (jacobian[..., :, None, :] * jacobian[..., None, :, :]).sum(-1)
        error = place.mT - self.views[slot][:, :, None]
        size = covariance.diagonal(dim1=-2, dim2=-1).sum(-1) / d * depth.square()
        return whiten(error, covariance).square().sum(-1)[:, 0], 1 / (size + SINGULAR)

    def _slopes(self, view: int, gradient: Tensor) -> Tensor:
        """Derivatives by the measured coordinates ``(b, c, .., d, n)`` from those by the vectors ``(b, c, .., width, n)``.

        Of several hyperplanes [I | -x] each moves with some coordinates only: these are all of their derivatives.
        """
        primitive = self.primitives[view]
        if isinstance(primitive, HyperplanesThrough):
            return primitive.slopes(gradient)
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
        rows, columns = triangle(primitive.width, x.device)
        if primitive.rows > 1:
            vectors.append(primitive.vectors(x).permute(0, 1, 4, 3, 2).contiguous())
            packed.append(primitive.packed(x).mT)
        else:
            # not the components of the estimation matrix, which may be scaled: distances need the length that is measured
            vectors.append(primitive.raw(x).mT.contiguous()[..., None, :])
            packed.append((vectors[-1][..., rows, 0, :] * vectors[-1][..., columns, 0, :]).mT)
    moments = packed[0]
    for factor in packed[1:]:
        moments = (moments[..., :, None] * factor[..., None, :]).flatten(-2)
    return Bundle(invariant, primitives, views, scales, weights, moments, tuple(vectors))


def transfer_slot(primitives: Sequence[Primitive]) -> int | None:
    """The only view measured through all hyperplanes of its points, which the other views then predict."""
    slots = [v for v, p in enumerate(primitives) if isinstance(p, HyperplanesThrough) and p.order == 1]
    return slots[0] if len(slots) == 1 and all(p.rows == 1 for v, p in enumerate(primitives) if v not in slots) else None


def anneal(data: Bundle, basis: Tensor, end: Tensor | None, iterations: int, *, guided: bool = False) -> Tensor:
    r"""Graduated non-convexity: weights :math:`(a / (a + d^2))^2` (Geman-McClure) with a scale a that shrinks to ``end``.

    The scale starts at four times the median squared distance of each start (a mean would be that of the outliers).

    Args:
        data: matches.
        basis: ``(b, c, K, a, D)``.
        end: ``(b,)`` squared scale at the end; None: the scale is the median squared distance itself, all the time.
        iterations: reweightings; the last 30 % are at the final scale.
        guided: measure the distances, until the scale is final, to the tensor of a motion, which has fewer degrees of freedom,
            so that fewer outliers can bend it; costs a decomposition per reweighting.

    Returns:
        The tensors, same shape.

    Source: Black and Rangarajan 1996; Yang, Antonante, Tzoumas and Carlone 2020.
    """
    start: Tensor | None = None
    for i in range(iterations):
        square, rows = data.distances(data.constrained(basis) if guided and i < HOLD * iterations else basis)
        if guided and 2 * i < iterations:
            # the gradients of a wrong tensor mislead: half their say doubles the successes of lines (175, 30 % outliers)
            rows = (rows / data.lengths()[:, :, None]).sqrt()
        if end is None:
            scale = median(square, data.weights)[:, None, :, None].clamp(min=torch.finfo(square.dtype).tiny)
        else:
            stop = end[:, None, None, None]
            start = torch.maximum(4 * median(square, data.weights)[:, None, :, None], stop) if start is None else start
            scale = start * (stop / start) ** min(1.0, i / (HOLD * iterations))
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
    """Kronecker products of the vectors of each match, and of their rows: ``(b, c, w1 w2 .., r1 r2 .., n)``."""
    total = vectors[0]
    for u in vectors[1:]:
        total = (total[..., :, None, :, None, :] * u[..., None, :, None, :, :]).flatten(-5, -4).flatten(-3, -2)
    return total

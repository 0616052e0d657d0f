"""Any number of bodies in two views of exact matches: the multibody fundamental matrix, and the bodies in it."""

from __future__ import annotations

from dataclasses import dataclass
from math import comb

import torch
from torch import Tensor

from dyntorch.core.normalize import hartley
from dyntorch.core.primitives import Monomials
from dyntorch.core.residual import sampson
from dyntorch.geometry.epipolar import check_matches, describe_labels
from dyntorch.geometry.homogeneous import homogeneous, monomial_derivatives, monomials, unit, unit_vectors
from dyntorch.geometry.pairs import order_of_bodies
from dyntorch.invariants.fundamental_matrix import FundamentalMatrix
from dyntorch.numerics.arguments import FARTHEST
from dyntorch.numerics.blocks import one_thread
from dyntorch.numerics.nullspace import null_space

ROUNDS = 4
"""Turns of labels and fundamental matrices after the first labels; exact matches are right after one or two."""
DEGENERATE = 1e-12
"""Second smallest singular value over the norm of the matrix below which the multibody matrix is not the only one."""
LEAST = 8  # matches of a body


@dataclass(frozen=True, repr=False)
class Multibody:
    """Bodies of exact matches; nothing carries gradients but ``matrix``."""

    matrix: Tensor
    """``(*batch, M, M)`` norm 1: :math:`\\nu(p_2)^T M\\, \\nu(p_1) = 0`, monomials in the order 00, 01, 02, 11, 12, 22."""
    fundamentals: Tensor
    """``(*batch, bodies, 3, 3)`` of norm 1 and rank two, the body with more matches first."""
    labels: Tensor
    """``(*batch, n)`` int64, 1 to ``bodies``; 0 where the weight is 0 or a coordinate is not finite."""
    degenerate: Tensor
    """``(*batch,)`` bool: another matrix vanishes on all matches as well (a planar body, too few matches), or a body was left
    with fewer than 8.  Labels and matrices then mean nothing."""

    def __repr__(self) -> str:
        return describe_labels(self, self.labels, self.degenerate, self.fundamentals.shape[-3])


@one_thread
def multibody_matrix(x1: Tensor, x2: Tensor, bodies: int, weights: Tensor | None = None) -> Multibody:
    r"""The multibody fundamental matrix of exact matches: :math:`\nu(p_2)^T M\, \nu(p_1) = \prod_k p_2^T F_k\, p_1 = 0`.

    :math:`\nu` has the :math:`M_K = \binom{K+2}{2}` monomials of degree K, so :math:`M_K^2` coefficients take
    :math:`M_K^2 - 1` matches: 8, 35, 99, 224 for 1 to 4 bodies.  The derivative of the product at a match is the derivative of
    the factor of its body: its epipolar lines (:func:`multibody_lines`).  The lines of all bodies in one view fulfil
    :math:`\prod_k e_k \cdot l = 0`, whose derivative at a line is the epipole of its body.  Matches with the same pair of
    epipoles are a body, and eight of them give its fundamental matrix.

    Three bodies or more need exact matches: the 7 K true parameters are estimated as :math:`M_K^2`, and noise closes the gap
    between the smallest singular values.  Median of :math:`s_{min-1} / s_{min}`, and labels right, of 20 scenes with bodies from
    :func:`dyntorch.scenes.two_view` (one label for all would be 50, 33 and 25 %):

    ======  =======  =========  ===========  ===========  ===========
    bodies  matches  exact      .01 px       .1 px        .5 px
    ======  =======  =========  ===========  ===========  ===========
    2       300      3e13 100%  210   99.9%  21    95.0%  4.8   95.6%
    3       219      2e12 100%  53    98.4%  6.0   82.4%  1.8   63.0%
    4       384      9e10 100%  8     74.3%  1.8   57.8%  1.6   52.4%
    ======  =======  =========  ===========  ===========  ===========

    Two bodies under noise: :class:`dyntorch.SegmentationMatrix`; any number: :func:`dyntorch.segment`.

    Args:
        x1: ``(*batch, n, 2)`` points of view 1; a match with a coordinate that is not finite weighs 0.
        x2: ``(*batch, n, 2)`` points of view 2.
        bodies: how many, K.
        weights: ``(*batch, n)``, not negative, 0 = ignore.

    Returns:
        matrix, fundamentals, labels and degenerate.  The epipoles of any two bodies must differ in both views.

    Raises:
        ValueError: fewer matches than :math:`M_K^2 - 1`, ``bodies`` no whole number from 1, shapes that do not agree.

    Source: thesis section 6 (two bodies); Vidal, Ma, Soatto and Sastry 2006 (multibody epipolar constraint).

    Example:
        >>> import torch
        >>> from dyntorch.scenes import two_view
        >>> scene = two_view(24, batch=2, generator=torch.Generator().manual_seed(0))
        >>> x1, x2 = (x.flatten(0, 1)[:40] for x in scene.views)
        >>> multibody_matrix(x1, x2, 2).labels.tolist() == [1] * 24 + [2] * 16
        True
    """
    weights = _check(x1, x2, bodies, weights)
    raw = [torch.where((weights > 0)[..., None], x, 0.0).double() for x in (x1, x2)]
    frames = [hartley(x[..., None, :], weights) for x in raw]
    first, second = (homogeneous(x) @ frame.mT for x, frame in zip(raw, frames, strict=True))
    matrix, single = _fit(first, second, bodies, weights)
    with torch.no_grad():
        labels, fundamentals, enough = _bodies(matrix, first, second, bodies, weights)
    lifts = [Monomials(bodies).action(frame) for frame in frames]
    matrix = unit(lifts[1].mT @ matrix @ lifts[0])
    fundamentals = unit(frames[1][..., None, :, :].mT @ fundamentals @ frames[0][..., None, :, :])
    dtype = x1.dtype
    return Multibody(matrix.to(dtype), fundamentals.to(dtype), labels, ~(single & enough))


def multibody_lines(matrix: Tensor, p1: Tensor, p2: Tensor, bodies: int) -> tuple[Tensor, Tensor]:
    r"""The epipolar lines of every match, each of its own body: the derivatives of :math:`\nu(p_2)^T M\, \nu(p_1)`. matrix
    ``(*batch, M, M)``, p1 ``(*batch, n, 3)``, p2 ``(*batch, n, 3)`` -> ``(*batch, n, 3)``."""
    l1 = _gradient(monomials(p2.mT, bodies).mT @ matrix, p1, bodies)
    l2 = _gradient(monomials(p1.mT, bodies).mT @ matrix.mT, p2, bodies)
    return l1, l2


def _check(x1: Tensor, x2: Tensor, bodies: int, weights: Tensor | None) -> Tensor:
    """Weights in float64, 0 for what is not finite."""
    check_matches(x1, x2, weights)
    if not isinstance(bodies, int) or isinstance(bodies, bool) or bodies < 1:
        raise ValueError(f"bodies must be a whole number, 1 or more, got {bodies!r}")
    min_matches, n = comb(bodies + 2, 2) ** 2 - 1, x1.shape[-2]
    if n < min_matches:
        raise ValueError(f"the multibody matrix of {bodies} bodies takes {min_matches} matches, got {n}: add {min_matches - n}")
    finite = ((x1.abs() <= FARTHEST) & (x2.abs() <= FARTHEST)).all(-1)
    given = finite.double() if weights is None else weights.double()
    if given.shape != finite.shape or not bool((given >= 0).all()):
        raise ValueError(f"weights must be {tuple(finite.shape)} and not negative or NaN, got {tuple(given.shape)}")
    return torch.where(finite & given.isfinite(), given, 0.0)


def _fit(first: Tensor, second: Tensor, bodies: int, weights: Tensor) -> tuple[Tensor, Tensor]:
    """The multibody matrix of normalized matches, and whether it is the only one."""
    rows = monomials(second.mT, bodies).mT[..., :, None] * monomials(first.mT, bodies).mT[..., None, :]
    size = rows.shape[-1]
    # every row of the same length: far points have monomials a hundred times larger
    rows = unit_vectors(rows.flatten(-2)) * weights.sqrt()[..., None]
    null = null_space(rows)[..., 0, :]
    # an orthonormal pair of vectors: one of them is as long as the second smallest singular value, but for a factor of sqrt(2)
    second_smallest = (rows.detach() @ null_space(rows.detach(), 2).mT).norm(dim=-2).amax(-1)
    return null.unflatten(-1, (size, size)), second_smallest > DEGENERATE * rows.detach().norm(dim=(-2, -1))


def _bodies(matrix: Tensor, first: Tensor, second: Tensor, bodies: int, weights: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Labels, fundamental matrices ``(*batch, bodies, 3, 3)``, and whether every body has enough matches."""
    lines = multibody_lines(matrix, first, second, bodies)
    trust = torch.stack([line.norm(dim=-1) for line in lines]).prod(0) * (weights > 0)
    trust = trust / trust.amax(-1, keepdim=True).clamp(min=torch.finfo(trust.dtype).tiny)
    e1, e2 = (_epipoles(line, trust, bodies) for line in lines)
    label = _group_directions((e2[..., :, None] * e1[..., None, :]).flatten(-2), trust, bodies)
    row = unit_vectors((second[..., :, None] * first[..., None, :]).flatten(-2))
    share = trust  # at first, matches where bodies cross count little
    for _ in range(ROUNDS):
        member = label[..., None, :] == torch.arange(bodies, device=label.device)[:, None]
        matrices = null_space(row[..., None, :, :] * (member * share[..., None, :])[..., None])[..., 0, :].unflatten(-1, (3, 3))
        fundamentals = FundamentalMatrix().constrain(matrices)
        distances = [sampson(FundamentalMatrix, f, first[..., :2], second[..., :2]) for f in fundamentals.unbind(-3)]
        label = torch.stack(distances).argmin(dim=0)
        share = (weights > 0).to(trust.dtype)
    member = (label[..., None, :] == torch.arange(bodies, device=label.device)[:, None]) & (weights > 0)[..., None, :]
    order = order_of_bodies(member)
    labels = torch.where(weights > 0, 1 + order.argsort(dim=-1).gather(-1, label), 0)
    return labels, fundamentals.take_along_dim(order[..., None, None], dim=-3), member.sum(-1).amin(-1) >= LEAST


def _gradient(form: Tensor, p: Tensor, degree: int) -> Tensor:
    """Of forms ``(..., n, M)`` in the monomials of vectors, at vectors ``(..., n, 3)``."""
    return (form[..., None, :] @ monomial_derivatives(p, degree, 3))[..., 0, :]


def _epipoles(lines: Tensor, trust: Tensor, bodies: int) -> Tensor:
    """The epipole ``(*batch, n, 3)`` of the body of every line: the gradient of the form of all epipoles."""
    lines = unit_vectors(lines)
    form = null_space(monomials(lines.mT, bodies).mT * trust[..., None])[..., 0, :]
    return unit_vectors(_gradient(form[..., None, :], lines, bodies))


def _group_directions(vectors: Tensor, trust: Tensor, groups: int) -> Tensor:
    """Unit vectors ``(*batch, n, d)`` up to sign in groups ``(*batch, n)``: seeds far from each other, then the nearest seed."""
    far, seeds = trust, []
    for _ in range(groups):
        seeds.append(vectors.take_along_dim(far.argmax(dim=-1)[..., None, None], dim=-2))
        sine = 1 - (vectors @ torch.cat(seeds, dim=-2).mT).square().amax(-1)
        far = trust * sine
    return (vectors @ torch.cat(seeds, dim=-2).mT).abs().argmax(dim=-1)

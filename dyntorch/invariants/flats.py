"""Points that stay within a flat: how far their views are from one, and the forms that vanish on all such points."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations, combinations_with_replacement, permutations
from math import comb
from typing import NamedTuple

import torch
from torch import Tensor

from dyntorch.core.residual import whiten
from dyntorch.geometry.extensors import levi_civita
from dyntorch.geometry.homogeneous import homogeneous
from dyntorch.invariants.agreement import skew_partner
from dyntorch.numerics.blocks import constant
from dyntorch.numerics.eigenspaces import jacobi, on_host
from dyntorch.numerics.implicit import follow_minimum
from dyntorch.numerics.nullspace import eigh, gram_null_space

# ----------------------------------------------------------------------------------------------------------------------
# The forms on m vectors that vanish wherever the vectors span no more than k dimensions.


SMALL = 1e-9
"""Singular value of integer generators (the others are above .1) that is zero."""


@constant
def vanishing_forms(size: int, views: int, step: int, device: torch.device) -> Tensor:
    r"""Orthonormal basis of all forms on ``views`` vectors that vanish where these span no more than ``step`` dimensions."""
    if size == views == step + 1:
        epsilon = levi_civita(size, device=device)
        return (epsilon / epsilon.norm())[None]
    known: dict[tuple[int, ...], tuple[list[tuple[int, ...]], Tensor]] = {}
    rows: list[Tensor] = []
    place = torch.tensor([size ** (views - 1 - v) for v in range(views)])
    for indices in combinations_with_replacement(range(size), views):
        names = sorted(set(indices), key=lambda i: (-indices.count(i), i))
        pattern = tuple(indices.count(i) for i in names)
        if pattern not in known:
            known[pattern] = _block(pattern, step)
        words, basis = known[pattern]
        where = torch.tensor([[names[letter] for letter in word] for word in words]) @ place
        block = torch.zeros(len(basis), size**views, dtype=torch.float64)
        block[:, where] = basis
        rows.append(block)
    return torch.cat(rows).unflatten(-1, (size,) * views).to(device)


def _block(pattern: tuple[int, ...], step: int) -> tuple[list[tuple[int, ...]], Tensor]:
    """All words with so many of each letter, and an orthonormal basis of the vanishing forms on them."""
    letters = [letter for letter, count in enumerate(pattern) for _ in range(count)]
    words = sorted(set(permutations(letters)))
    number = {word: i for i, word in enumerate(words)}
    made = set()
    for word in words:
        for slots in combinations(range(len(letters)), step + 1):
            # one generator for each set of words that differ by the order of these letters
            chosen = [word[s] for s in slots]
            if len(set(chosen)) == len(chosen) and chosen == sorted(chosen):
                made.add((word, slots))
    generators = torch.zeros(len(made), len(words), dtype=torch.float64)
    for row, (word, slots) in enumerate(sorted(made)):
        for order in permutations(range(len(slots))):
            other = list(word)
            for s, i in zip(slots, order, strict=True):
                other[s] = word[slots[i]]
            generators[row, number[tuple(other)]] = _sign(order)
    if not made:
        return words, generators
    _, values, basis = torch.linalg.svd(generators, full_matrices=False)
    return words, basis[: int((values > SMALL * values[0]).sum())]


def _sign(order: Sequence[int]) -> int:
    return (-1) ** sum(a > b for a, b in combinations(order, 2))


# ----------------------------------------------------------------------------------------------------------------------
# The distance of the views of a moving point from a flat that contains all of its positions.


STEPS = 6
"""Gauss-Newton steps to the nearest flat at most: from one through the carried points, exact to rounding after 2 or 3, more where
the points hardly move."""
SPREAD = 1e-12
"""Of the trace: what keeps the inverse of a flat's information finite where the points do not determine it."""
TINY = 1e-150


class Flats(NamedTuple):
    """The nearest flat of each match, and how far its views are from it."""

    residual: Tensor
    """``(b, n, m, c)`` whitened distance of every view from the flat, along c normals."""
    hyperplanes: Tensor
    """``(b, n, c, N)`` that contain the flat, in the coordinates of view 1."""
    root: Tensor
    """``(b, n, m, c, c)`` what whitens the incidences with these hyperplanes."""
    feet: Tensor
    """``(b, n, m, N)`` nearest points of the flat, in the coordinates of each view."""
    slope: Tensor
    """``(b, n, m c, c k)`` of the residual, by the displacements of the flat."""
    inverse: Tensor
    """``(b, n, c k, c k)`` inverse of the information on these."""


def nearest_flats(maps: Tensor, points: Tensor, scales: Tensor, step: int) -> Flats:
    r"""The flats of ``step`` - 1 dimensions of least distance from all views of a match. maps ``(b, m, N, N)``, points
    ``(b, n, m, N - 1)``, scales ``(b, m)``."""
    p, s = homogeneous(points), scales[:, None, :, None, None]
    carried = torch.nn.functional.normalize((maps[:, None] @ p[..., None])[..., 0], dim=-1)
    carried = torch.nan_to_num(carried)
    square = carried.mT @ carried
    # an accelerator waits for eigh, and these are tiny
    vectors = eigh(square)[1] if on_host(square) else jacobi(square.flatten(0, 1))[1].unflatten(0, square.shape[:2])
    size = vectors.shape[-1]
    count = size - step
    base, across = vectors[..., :count].mT, vectors[..., count:].mT
    at, cost = _at(base, across, maps, p, s), torch.full(p.shape[:2], torch.inf, dtype=p.dtype, device=p.device)
    for _ in range(STEPS):
        cost = at.residual.square().sum((-2, -1))
        pulled = at.slope.mT @ at.residual.flatten(-2)[..., None]
        move = -(at.inverse @ pulled)[..., 0].unflatten(-1, (count, step)) @ across
        tried = _at(at.hyperplanes + move, across, maps, p, s)
        new = tried.residual.square().sum((-2, -1))
        # where the points hardly move the flat may turn far: only what helps counts
        better = new < cost
        at = Flats(*(torch.where(better[(..., *[None] * (a.ndim - 2))], a, b) for a, b in zip(tried, at, strict=True)))
        # an accelerator would wait for the answer longer than for the steps
        if on_host(cost) and not bool((better & (cost - new > 1e-12 * cost)).any()):
            break
    return at


def _at(hyperplanes: Tensor, across: Tensor, maps: Tensor, p: Tensor, s: Tensor) -> Flats:
    """What belongs to given flats; ``across (b, n, k, N)`` is what displacements of the hyperplanes are made of."""
    residual, root, h = whitened_incidence(hyperplanes, maps, p, s)
    force = (root.mT @ residual[..., None])[..., 0]
    foot = torch.nn.functional.pad(((h * s).mT @ force[..., None])[..., 0][..., :-1] * s[..., 0], (0, 1))
    feet = p - foot
    along = (across[:, :, None] @ (maps[:, None] @ feet[..., None]))[..., 0]  # (b, n, m, k)
    slope = (root[..., :, :, None] * along[..., None, None, :]).flatten(-2).flatten(-3, -2)
    information = slope.mT @ slope
    trace = information.diagonal(dim1=-2, dim2=-1).sum(-1)[..., None, None].clamp(min=TINY)
    eye = torch.eye(information.shape[-1], dtype=p.dtype, device=p.device)
    inverse = torch.linalg.inv_ex(information + SPREAD * trace * eye)[0]
    return Flats(residual, hyperplanes, root, feet, slope, torch.nan_to_num(inverse, posinf=0.0, neginf=0.0))


def whitened_incidence(hyperplanes: Tensor, maps: Tensor, p: Tensor, s: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Whitened incidences ``(b, n, m, c)``, what whitened them ``(.., c, c)``, and the hyperplanes ``(.., c, N)`` of each view."""
    h = hyperplanes[:, :, None] @ maps[:, None]
    normals = h[..., :-1] * s
    spread = normals @ normals.mT
    eye = torch.eye(spread.shape[-1], dtype=p.dtype, device=p.device)
    size = spread.diagonal(dim1=-2, dim2=-1).amax(-1)[..., None, None].detach().clamp(min=TINY)
    # the columns of the inverse root; a flat at infinity has no normals: the floor of whiten() keeps it finite
    root = whiten(eye, (spread / size)[..., None, :, :]).mT / size.sqrt()
    return (root @ (h @ p[..., None]))[..., 0], root, h


def flat_residual(maps: Tensor, views: Sequence[Tensor], scales: Sequence[Tensor], step: int) -> Tensor:
    r"""Whitened distances of matches from the flats they stay in, ``(b, n, m c)``, whose square sum is the least possible."""
    points, noise = torch.stack(list(views), dim=-2), torch.stack(list(scales), dim=-1)
    with torch.no_grad():
        hyperplanes = nearest_flats(maps, points, noise, step).hyperplanes
    if torch.is_grad_enabled() and any(x.requires_grad for x in (maps, points, noise)):
        hyperplanes = _differentiable_flats(hyperplanes, maps, points, noise, step)
    s = noise[:, None, :, None, None]
    return whitened_incidence(hyperplanes, maps, homogeneous(points), s)[0].flatten(-2)


def _differentiable_flats(hyperplanes: Tensor, maps: Tensor, points: Tensor, noise: Tensor, step: int) -> Tensor:
    """The nearest flats ``(b, n, c, N)`` as functions of what they are nearest to, every match by itself."""
    problems, count, c, size = hyperplanes.shape
    across = eigh(hyperplanes.mT @ hyperplanes)[1][..., : size - c].mT[..., :step, :]

    def moved(by: Tensor, hyperplanes: Tensor, across: Tensor) -> Tensor:
        return hyperplanes + by.unflatten(-1, (c, across.shape[-2])) @ across

    def cost(by: Tensor, hyperplanes: Tensor, across: Tensor, points: Tensor, maps: Tensor, noise: Tensor) -> Tensor:
        at = moved(by, hyperplanes, across)[:, None]
        found = whitened_incidence(at, maps, homogeneous(points)[:, None], noise[:, None, :, None, None])
        return found[0].square().sum((-3, -2, -1))

    held = hyperplanes.flatten(0, 1), across.flatten(0, 1)
    still = held[0].new_zeros(problems * count, c * across.shape[-2])
    several = [x[:, None].expand(-1, count, *x.shape[1:]).flatten(0, 1) for x in (maps, noise)]
    by = follow_minimum(cost, still, still.new_zeros(*still.shape, 0), *held, points.flatten(0, 1), *several)
    return moved(by, *held).unflatten(0, (problems, count))


def flat_residual_derivative(maps: Tensor, views: Sequence[Tensor], scales: Sequence[Tensor], step: int) -> tuple[Tensor, Tensor]:
    r""":func:`flat_residual`, flat ``(b, n m c)``, and its derivative ``(b, p, n m c)`` by the entries of all maps but the
    first."""
    at = nearest_flats(maps, torch.stack(list(views), dim=-2), torch.stack(list(scales), dim=-1), step)
    b, n, m, c = at.residual.shape
    size = maps.shape[-1]
    rows = at.root @ at.hyperplanes[:, :, None]  # (b, n, m, c, N)
    own = (rows[..., :, None] * at.feet[..., None, None, :]).flatten(-2)  # (b, n, m, c, N N)
    moved = own.new_zeros(b, n, m, c, m - 1, size * size)
    for v in range(1, m):
        moved[:, :, v, :, v - 1] = own[:, :, v]
    moved = moved.flatten(4).flatten(2, 3)  # (b, n, m c, p)
    derivative = moved - at.slope @ (at.inverse @ (at.slope.mT @ moved))
    return at.residual.flatten(1), derivative.movedim(-1, 1).flatten(2)


# ----------------------------------------------------------------------------------------------------------------------
# The collineations behind the vanishing forms of moved points.


def forms_of_views(basis: Tensor, views: int, slots: Sequence[int], step: int) -> Tensor:
    r"""The forms on ``step`` + 1 of the views alone, from an orthonormal basis of those on all views. basis
    ``(*batch, nullity, N, ..., N)`` -> ``(*batch, forms, N, ..., N)``."""
    if views == len(slots):
        return basis
    size, lead = basis.shape[-1], basis.ndim - views
    others = [v for v in range(views) if v not in slots]
    parted = basis.permute(*range(lead), *(lead + v for v in (*slots, *others))).flatten(lead + len(slots))
    parted = parted.flatten(lead, lead + len(slots) - 1)  # (*batch, nullity, N^(k+1), N^(m-k-1))
    trace = (parted @ parted.mT).sum(-3)
    eye = torch.eye(trace.shape[-1], dtype=basis.dtype, device=basis.device)
    found = gram_null_space(parted.shape[-1] * eye - trace, comb(size, step + 1)).basis
    return found.unflatten(-1, (size,) * len(slots))


def collineations(basis: Tensor, views: int, step: int) -> tuple[Tensor, ...]:
    r"""The collineations from every view but the first to the first, linearly and uniquely, from the vanishing forms. basis
    ``(*batch, nullity, N, ..., N)`` -> ``(*batch, N, N)``."""
    lead = basis.ndim - views
    slices: list[list[Tensor]] = [[] for _ in range(views)]
    for slots in combinations(range(1, views), step):
        forms = forms_of_views(basis, views, (0, *slots), step)
        for i, v in enumerate(slots, start=1):
            pair = forms.permute(*range(lead), *(lead + s for s in range(step + 1) if s not in (0, i)), lead, lead + i)
            slices[v].append(pair.flatten(lead - 1, -3))
    return tuple(skew_partner(torch.cat(found, dim=-3)) for found in slices[1:])

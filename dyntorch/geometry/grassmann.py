"""Grassmann tensors: the determinants of rows chosen from several projections P^k -> P^l."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from math import comb, prod

import torch
from torch import Tensor
from torch.nn.functional import one_hot

from dyntorch.geometry.extensors import compound, dual, meet, wedge
from dyntorch.geometry.homogeneous import cofactors, null_vectors, unit, unit_vectors
from dyntorch.numerics.blocks import constant, one_thread


def grassmann_tensor(projections: Sequence[Tensor], profile: Sequence[int]) -> Tensor:
    r"""The Grassmann tensor of projections: :math:`A_{I_1 \dots I_n} = \det(\text{rows } I_1 \text{ of } M_1, \dots, I_n
    \text{ of } M_n)`, with :math:`|I_i| = \alpha_i` and :math:`\sum \alpha_i = k + 1`.

    With hyperplanes :math:`S_i\ (\alpha_i \times m_i)` through the images of one point,
    :math:`\langle A, \bigotimes_i C_{\alpha_i}(S_i) \rangle = \det(S_1 M_1; \dots; S_n M_n) = 0`.

    Args:
        projections: :math:`M_i`, ``(*batch, m_i, k + 1)``; batch dimensions broadcast.
        profile: :math:`\alpha_i`, from 1 to :math:`m_i`.

    Returns:
        ``(*batch, binomial(m_1, alpha_1), ..., binomial(m_n, alpha_n))``, subsets in lexicographic order, not scaled.
        Joins of the compound matrices: a polynomial, with exact derivatives also where minors are singular.

    Raises:
        ValueError: another number of projections than the profile has entries, of different widths, or a profile whose sum
            is not their width.

    Source: Hartley and Schaffalitzky 2004; thesis chapter 3.

    Example:
        >>> import torch
        >>> P = torch.rand(2, 3, 4, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
        >>> F = grassmann_tensor(P, (2, 2))  # the fundamental matrix, lines of both views by their two rows
        >>> F.shape, bool(torch.isclose(F[0, 2], torch.linalg.det(torch.cat([P[0, [0, 1]], P[1, [1, 2]]]))))
        (torch.Size([3, 3]), True)
    """
    size = _check(projections, profile)
    parts = [compound(m, a) for m, a in zip(projections, profile, strict=True)]
    # two halves of about the same step, whose last product is one matrix product
    cut = 1 + next(i for i in range(len(profile)) if 2 * sum(profile[: i + 1]) >= size)
    cut = min(cut, len(profile) - 1)
    left, step = _join_rows(parts[:cut], profile[:cut], size)
    right, _ = _join_rows(parts[cut:], profile[cut:], size)
    sign = -1 if step * (size - step) % 2 else 1  # of (I, I^c) against (I^c, I)
    tensor = left @ (sign * dual(right, size, size - step)).mT
    return tensor.flatten(-2).unflatten(-1, [int(p.shape[-2]) for p in parts])


def _join_rows(parts: Sequence[Tensor], steps: Sequence[int], size: int) -> tuple[Tensor, int]:
    """The joins of one row of each part, ``(*batch, rows, binomial(size, total step))``, and the step."""
    total, step = parts[0], steps[0]
    for part, more in zip(parts[1:], steps[1:], strict=True):
        total = wedge(total[..., :, None, :], part[..., None, :, :], size, (step, more)).flatten(-3, -2)
        step += more
    return total, step


def grassmann_derivative(projections: Sequence[Tensor], profile: Sequence[int]) -> tuple[Tensor, Tensor]:
    r"""The Grassmann tensor and its derivative by the entries of all projections, several times cheaper than forward mode.
    projections ``(*batch, m_i, k + 1)`` -> ``(*batch, D)``."""
    size = _check(projections, profile)
    parts = [compound(m, a) for m, a in zip(projections, profile, strict=True)]
    derivatives, lengths = [], [int(p.shape[-2]) for p in parts]
    value: Tensor | None = None
    for i, (matrix, order) in enumerate(zip(projections, profile, strict=True)):
        others, step = _join_rows([*parts[:i], *parts[i + 1 :]], [*profile[:i], *profile[i + 1 :]], size)
        # the rows of this view stand before those of the later ones
        sign = -1 if order * sum(profile[i + 1 :]) % 2 else 1
        weight = sign * dual(others, size, step)
        if value is None:
            value = (parts[0] @ weight.mT).flatten(-2)
        slope = _minor_slopes(matrix, order, weight).unflatten(-1, lengths[:i] + lengths[i + 1 :])
        # (.., r c, I_i, other views) to the order of the views
        derivatives.append(slope.movedim(-len(lengths), i - len(lengths)).flatten(-len(lengths)))
    assert value is not None
    return value, torch.cat(derivatives, dim=-2)


def _check(projections: Sequence[Tensor], profile: Sequence[int]) -> int:
    size = sum(profile)
    if len(projections) != len(profile) or len(profile) < 2 or {int(m.shape[-1]) for m in projections} != {size}:
        shapes = [tuple(m.shape[-2:]) for m in projections]
        raise ValueError(f"a profile {tuple(profile)} takes {max(2, len(profile))} projections of {size} columns, got {shapes}")
    return size


def _minor_slopes(matrix: Tensor, order: int, weight: Tensor) -> Tensor:
    r"""Derivative ``(*batch, rows * K, sets I, rest)`` of :math:`C_a(M) W^T` by the entries of M, for W
    ``(*batch, rest, sets S)``."""
    rows, columns = matrix.shape[-2:]
    place, sign = _removals(columns, order, matrix.device)
    taken = (weight[..., place] * sign.to(matrix.dtype)).movedim(-3, -1)  # (.., c, T, rest)
    smaller = compound(matrix, order - 1) if order > 1 else torch.ones_like(matrix[..., :1, :1])
    inner = smaller[..., None, :, :] @ taken  # (.., c, U, rest)
    place, sign = _insertions(rows, order, matrix.device)
    # (.., c, r, I, rest): the sets without a row that they have; sign 0 where they do not
    slope = inner[..., place, :] * sign.to(matrix.dtype)[..., None]
    return slope.movedim(-4, -3).flatten(-4, -3)


@constant
def _removals(size: int, order: int, device: torch.device) -> tuple[Tensor, Tensor]:
    """For every element c and set T of ``order - 1`` others: the place of c with T among the sets, and the sign; 0 if c is in T."""
    place = {s: i for i, s in enumerate(combinations(range(size), order))}
    smaller = list(combinations(range(size), order - 1))
    found = [[place.get(tuple(sorted((c, *t))), 0) for t in smaller] for c in range(size)]
    signs = [[0 if c in t else (-1) ** sum(i < c for i in t) for t in smaller] for c in range(size)]
    return torch.tensor(found, device=device), torch.tensor(signs, device=device)


@constant
def _insertions(size: int, order: int, device: torch.device) -> tuple[Tensor, Tensor]:
    """For every element r and set I: the place of I without r among the smaller sets, and the sign; 0 if r is not in I."""
    place = {s: i for i, s in enumerate(combinations(range(size), order - 1))}
    sets = list(combinations(range(size), order))
    found = [[place.get(tuple(i for i in s if i != r), 0) for s in sets] for r in range(size)]
    signs = [[(-1) ** s.index(r) if r in s else 0 for s in sets] for r in range(size)]
    return torch.tensor(found, device=device), torch.tensor(signs, device=device)


# ----------------------------------------------------------------------------------------------------------------------
# Projections from a Grassmann tensor of any profile, in closed form: a few candidates that noise-free tensors fulfil exactly.


POWER_STEPS = 3
"""Power iterations for a rank-1 split: exact without noise, and the error of a noisy one falls by (s_2 / s_1)^2 in each."""


def candidates(tensor: Tensor, profile: Sequence[int], sizes: Sequence[int], tries: int = 5) -> tuple[Tensor, ...]:
    r"""Projections :math:`M_i` with the given Grassmann tensor, :math:`A(M_1, \dots, M_n) \sim T`, one set per random rotation."""
    check(tensor, profile, sizes)
    if tries < 1:
        raise ValueError(f"tries must be at least 1, got {tries}")
    batch = tensor.shape[: tensor.ndim - len(sizes)]
    with torch.no_grad():
        scaled, sound = normalize_tensors(tensor.reshape(prod(batch), *tensor.shape[len(batch) :]))
        found = _recover(scaled, tables(tuple(profile), tuple(sizes), tries, tensor.device))
        parts = balance_projections([torch.where(sound[:, None, None], part, torch.zeros_like(part)) for part in found])
    return tuple(part.reshape(tries, *batch, *part.shape[-2:]).to(tensor.dtype) for part in parts)


def check(tensor: Tensor, profile: Sequence[int], sizes: Sequence[int]) -> None:
    """Raise a ``ValueError`` where profile, sizes and tensor do not fit."""
    if len(profile) != len(sizes) or len(profile) < 2 or not all(1 <= a <= m for a, m in zip(profile, sizes, strict=True)):
        raise ValueError(f"profile must have 1 to m_i rows of at least two views, got {tuple(profile)} for sizes {tuple(sizes)}")
    shape = tuple(comb(m, a) for m, a in zip(sizes, profile, strict=True))
    if tuple(tensor.shape[-len(shape) :]) != shape or not tensor.is_floating_point():
        raise ValueError(
            f"the tensor of profile {tuple(profile)} is floating point (*batch, {str(shape)[1:-1]}), "
            f"got {tuple(tensor.shape)} {tensor.dtype}"
        )


def normalize_tensors(tensor: Tensor) -> tuple[Tensor, Tensor]:
    """Tensors ``(b, ...)`` as float64 of norm 1, and which were sound ``(b,)``; the others become constant."""
    flat = tensor.flatten(1).double()
    largest = flat.detach().abs().amax(-1, keepdim=True)
    sound = largest.isfinite() & (largest > 0)  # NaN is the largest
    flat = torch.where(sound, flat, torch.ones_like(flat)) / torch.where(sound, largest, torch.ones_like(largest))
    return (flat / flat.norm(dim=-1, keepdim=True)).view(tensor.shape), sound[:, 0]


def balance_projections(parts: Sequence[Tensor]) -> list[Tensor]:
    """The same projections up to a collineation: all of norm 1, the columns of the stack orthogonal but for that.  Zeros stay."""
    parts = _normalize(parts)
    stack = torch.cat(parts, dim=-2)
    stack = torch.linalg.qr(stack).Q * (stack != 0).any(-1, keepdim=True)
    return _normalize(stack.split([int(part.shape[-2]) for part in parts], dim=-2))


def rotate_tensors(tensor: Tensor, compounds: Sequence[Tensor]) -> Tensor:
    """Tensors ``(b, N_1, ..., N_n)`` in images moved by rotations with ``compounds`` ``(tries, N_i, N_i)``: ``(tries, b, ...)``."""
    tries, count = compounds[0].shape[0], len(compounds)
    result = tensor.expand(tries, *tensor.shape)
    for matrix in reversed(compounds):  # the last axis is moved to the front n times, and all are in order again
        product = result.flatten(1, -2) @ matrix.mT
        result = product.view(result.shape).movedim(-1, -count)
    return result


@dataclass(frozen=True)
class Tables:
    """What does not depend on the tensor.  A subset I of the rows of a view is counted lexicographically."""

    profile: tuple[int, ...]
    sizes: tuple[int, ...]
    rotations: tuple[Tensor, ...]
    """Of every view ``(tries, m_i, m_i)``."""
    compounds: tuple[Tensor, ...]
    """How they act on its axis of the tensor ``(tries, N_i, N_i)``."""
    places: tuple[Tensor, ...]
    """``(N_i, 1 + (m_i - alpha_i) alpha_i)``: where I stands, and where I with its row j replaced by the extra row r does, in the
    order of (r, j)."""
    signs: tuple[Tensor, ...]
    """Of the order in which the rows then stand."""
    orders: tuple[Tensor, ...]
    """``(N_i, m_i)``: the rows of I, then the extra rows."""


@constant
def tables(profile: tuple[int, ...], sizes: tuple[int, ...], tries: int, device: torch.device) -> Tables:
    """The tables of a profile; the rotations are always the same."""
    generator = torch.Generator().manual_seed(0)
    rotations, compounds, rest = [], [], []
    for alpha, size in zip(profile, sizes, strict=True):
        rotation = torch.linalg.qr(torch.randn(tries, size, size, generator=generator, dtype=torch.float64)).Q
        rotations.append(rotation.to(device))
        compounds.append(compound(rotation, alpha).to(device))
        rest.append(tuple(table.to(device) for table in _replacements(size, alpha)))
    places, signs, orders = zip(*rest, strict=True)
    return Tables(profile, sizes, tuple(rotations), tuple(compounds), places, signs, orders)


def _replacements(size: int, alpha: int) -> tuple[Tensor, Tensor, Tensor]:
    subsets = list(combinations(range(size), alpha))
    number = {subset: i for i, subset in enumerate(subsets)}
    places, signs, orders = [], [], []
    for subset in subsets:
        extra = [row for row in range(size) if row not in subset]
        sets = [subset, *((*subset[:j], row, *subset[j + 1 :]) for row in extra for j in range(alpha))]
        places.append([number[tuple(sorted(rows))] for rows in sets])
        signs.append([(-1.0) ** sum(a > b for a, b in combinations(rows, 2)) for rows in sets])
        orders.append([*subset, *extra])
    return torch.tensor(places), torch.tensor(signs, dtype=torch.float64), torch.tensor(orders)


def _recover(tensor: Tensor, table: Tables) -> list[Tensor]:
    """All candidates ``(tries, b, m_i, K)`` for tensors ``(b, ...)`` of norm 1."""
    values = rotate_tensors(tensor, table.compounds)
    tries, count = values.shape[:2]
    flat = values.flatten(0, 1).flatten(1)
    # the rows of the largest minor become the unit vectors; the minors count relative to it
    pivot = _places(flat.abs().argmax(-1), tensor.shape[1:])
    place = torch.zeros(len(flat), 1, dtype=torch.long, device=flat.device)
    sign = torch.ones(len(flat), 1, dtype=flat.dtype, device=flat.device)
    for i, chosen in enumerate(pivot):
        place = (place[..., None] * tensor.shape[1 + i] + table.places[i][chosen][:, None]).flatten(1)
        sign = (sign[..., None] * table.signs[i][chosen][:, None]).flatten(1)
    minors = flat.gather(-1, place) * sign
    minors = (minors / minors[:, :1]).unflatten(-1, [int(p.shape[1]) for p in table.places])
    found = []
    which = torch.arange(tries, device=flat.device).repeat_interleave(count)
    for i, rows in enumerate(_rows(minors, table)):
        order = table.orders[i][pivot[i]][:, None].expand(-1, table.sizes[i], -1)
        back = table.rotations[i].mT[which].gather(-1, order)
        found.append((back @ rows).unflatten(0, (tries, count)))
    return found


def _rows(minors: Tensor, table: Tables) -> list[Tensor]:
    """Projections ``(b, m_i, K)`` whose first rows are unit vectors, from relative signed minors ``(b, 1 + e_1 alpha_1, ...)``."""
    views = range(len(table.profile))
    extra = [m - a for m, a in zip(table.sizes, table.profile, strict=True)]
    block = {(i, i): _minors(minors, i).unflatten(-1, (extra[i], table.profile[i])) for i in views}
    for i, q in combinations(views, 2):
        split = extra[i], table.profile[i], extra[q], table.profile[q]
        known = block[i, i][:, :, :, None, None] * block[q, q][:, None, None]
        product = known - _minors(minors, i, q).view(len(minors), *split)  # (r, j, s, t): b_t c_j
        left, right = _rank_one(product.permute(0, 1, 4, 3, 2).reshape(len(minors), split[0] * split[3], split[2] * split[1]))
        block[i, q], block[q, i] = left.unflatten(-1, (split[0], split[3])), right.unflatten(-1, (split[2], split[1]))
    for q in views[2:]:
        for i, scale in enumerate(_scales(minors, block, q), 1):
            block[i, q], block[q, i] = block[i, q] * scale[:, None, None], block[q, i] / scale[:, None, None]
    result = []
    for i in views:
        below = torch.cat([block[i, q] for q in views], dim=-1)
        start = sum(table.profile[:i])
        above = torch.eye(below.shape[-1], dtype=below.dtype, device=below.device)[start : start + table.profile[i]]
        result.append(torch.cat([above.expand(len(below), -1, -1), below], dim=-2))
    return result


def _minors(minors: Tensor, *views: int) -> Tensor:
    """Those with one row replaced in each of the views, ``(b, e_i alpha_i, ...)``."""
    return minors[(slice(None), *(slice(1, None) if i in views else 0 for i in range(minors.ndim - 1)))]


def _rank_one(matrix: Tensor) -> tuple[Tensor, Tensor]:
    """Vectors of the same length whose product is nearest to the matrices ``(b, r, c)``; zeros for a matrix without entries."""
    if 0 in matrix.shape[1:]:
        return matrix.new_zeros(matrix.shape[:2]), matrix.new_zeros(len(matrix), matrix.shape[2])
    longest = matrix.square().sum(-1).argmax(-1)[:, None, None].expand(-1, 1, matrix.shape[2])
    right = unit_vectors(matrix.gather(1, longest)[:, 0])
    for _ in range(POWER_STEPS):
        left = (matrix * right[:, None]).sum(-1)
        right = unit_vectors((matrix * left[..., None]).sum(1))
    left = (matrix * right[:, None]).sum(-1)
    root = left.norm(dim=-1, keepdim=True).sqrt()
    return unit_vectors(left) * root, right * root


def _scales(minors: Tensor, block: dict[tuple[int, int], Tensor], q: int) -> list[Tensor]:
    """Factors of the blocks (i, q), 0 < i < q, relative to those of view 0, ``(b,)`` each."""
    roots, errors = zip(*[_roots(_minors(minors, 0, i, q), block, i, q) for i in range(1, q)], strict=True)
    if q < 3 or any(size > 2 for size in minors.shape[1 : q + 2]):
        return [_pick(*pair) for pair in zip(roots, errors, strict=True)]
    # in images of one dimension the triple with view 0 has two exact roots: the triples with view 1 choose
    first, second = roots[0][:, :, None], roots[1][:, None]
    joint = errors[0][:, :, None] + errors[1][:, None] + _triple_error(minors, block, (2, q), first, second)
    result = [_pick(part.expand(-1, 4, 4).flatten(1), joint.flatten(1)) for part in (first, second)]
    for i in range(3, q):
        again = _triple_error(minors, block, (i, q), result[0][:, None], roots[i - 1])
        result.append(_pick(roots[i - 1], errors[i - 1] + again))
    return result


def _pick(roots: Tensor, errors: Tensor) -> Tensor:
    """The root of the least error, ``(b,)``."""
    return roots.gather(-1, errors.argmin(-1, keepdim=True))[:, 0]


def _triple_error(
    minors: Tensor, block: dict[tuple[int, int], Tensor], views: tuple[int, int], first: Tensor, second: Tensor
) -> Tensor:
    """Squared error of the minor of views 1, i, q of dimension one, for factors ``(b, ...)`` of the blocks (1, q), (i, q)."""
    shape = (-1, *[1] * (first.ndim - 1))
    names = (1, *views)
    (d, ab, ac), (ba, e, bc), (ca, cb, f) = ([block[row, column].view(shape) for column in names] for row in names)
    fixed = d * e * f - d * bc * cb - e * ac * ca - f * ab * ba
    determinant = fixed + ab * (bc * second) * (ca / first) + (ac * first) * ba * (cb / second)
    return (determinant - _minors(minors, *names).view(shape)).square()


def _roots(minors: Tensor, block: dict[tuple[int, int], Tensor], i: int, q: int) -> tuple[Tensor, Tensor]:
    r"""Candidates of the factor of block (i, q) relative to those of view 0, and their squared errors, ``(b, 4)`` each."""
    # all with the dimensions (batch, b, j, c, g, d, t)
    (bj, bg, bt), (cj, cg, ct), (dj, dg, dt) = (
        [_axes(block[u, v], a, b) for b, v in enumerate((0, i, q))] for a, u in enumerate((0, i, q))
    )
    known = bj * cg * dt - bj * ct * dg - bg * cj * dt - bt * cg * dj
    x, y = (bg * ct * dj).flatten(1), (bt * cj * dg).flatten(1)
    z = minors.flatten(1) - known.flatten(1)
    xx, yy, xz, yz = ((a * b).sum(-1) for a, b in ((x, x), (y, y), (x, z), (y, z)))
    # lambda = s mu, s^4 = yy / xx, makes the quartic mu^4 - p mu^3 + r mu - 1
    unit = torch.where((xx > 0) & (yy > 0), (yy / xx) ** 0.25, 1.0)
    size = torch.where((xx > 0) & (yy > 0), (xx * yy).sqrt(), 1.0)
    p, r = xz * unit / size, yz / unit / size
    companion = torch.diag_embed(torch.ones_like(p)[:, None].expand(-1, 3), offset=-1)
    companion[:, 0, 0], companion[:, 0, 2], companion[:, 0, 3] = p, -r, 1.0
    # the real part of a complex root is one more candidate, and never the best
    roots = torch.linalg.eigvals(companion.nan_to_num(0.0, 1e100, -1e100)).real * unit[:, None]
    roots = torch.where(roots == 0, unit[:, None], roots)[..., None]
    return roots[..., 0], (roots * x[:, None] + y[:, None] / roots - z[:, None]).square().sum(-1)


def _axes(block: Tensor, row: int, column: int) -> Tensor:
    """Blocks ``(b, e, a)`` with the rows in dimension 1 + 2 row of seven, and the columns in dimension 2 + 2 column."""
    shape = [1] * 6
    shape[2 * row], shape[2 * column + 1] = block.shape[1:]
    return (block if row <= column else block.mT).reshape(len(block), *shape)


def _normalize(parts: Sequence[Tensor]) -> list[Tensor]:
    """Matrices of Frobenius norm 1; zero stays, and so does what is not finite."""
    return [unit_vectors(part.nan_to_num(0.0, 0.0, 0.0).flatten(-2)).view(part.shape) for part in parts]


def _places(flat: Tensor, shape: torch.Size) -> tuple[Tensor, ...]:
    """Indices by axis of flat ones; ``torch.unravel_index`` imports sympy (0.5 s)."""
    places = []
    for size in reversed(shape):
        places.append(flat % size)
        flat = flat // size
    return tuple(reversed(places))


# ----------------------------------------------------------------------------------------------------------------------
# Epipoles of projections P^k -> P^l, and joint epipoles, the images of the line that meets three centres.


FLAT = 1e-12
"""Sine of the angle between two lines below which their intersection is rounding."""


@dataclass(frozen=True)
class JointEpipoles:
    """Joint epipoles of three views and how well they are defined."""

    epipoles: Tensor
    """``(*batch, 3, 3)``: view, homogeneous image coordinates; unit vectors, zero where undefined."""
    lines: Tensor
    """``(*batch, 3, 2, 3)``: in every view the images of the other two centres, in order of views; unit vectors."""
    definedness: Tensor
    """``(*batch,)`` the least sine over the views of the angle between both lines; near 0 there is no joint epipole."""


def epipoles(projections: Sequence[Tensor]) -> Tensor:
    r"""Images of centres that are points: :math:`e_{ij} = M_i c_j,\ M_j c_j = 0`. projections ``(*batch, m, m + 1)`` ->
    ``(*batch, v, v, m)``."""
    shapes = {tuple(m.shape[-2:]) for m in projections}
    if len(shapes) != 1 or next(iter(shapes))[0] + 1 != next(iter(shapes))[1]:
        raise ValueError(f"projections must all be (*batch, m, m + 1), whose centre is a point; got {sorted(shapes)}")
    views = torch.stack(torch.broadcast_tensors(*projections), dim=-3)
    maps = torch.where(views.isfinite().flatten(-2).all(-1)[..., None, None], views.double(), 0.0)
    centres = meet(*maps.unbind(-2))
    images = torch.einsum("...imk,...jk->...ijm", maps, centres)
    own = torch.eye(len(projections), dtype=torch.bool, device=views.device)[..., None]
    return _orient(images.masked_fill(own, 0.0)).to(views.dtype)


@one_thread
def joint_epipoles(projections: Sequence[Tensor]) -> JointEpipoles:
    r"""Where the images of the other two centres meet: :math:`e_i \sim M_i L_j \times M_i L_k`.

    The centre of :math:`M : P^4 \to P^2` is a line L, the meet of its rows.  Three lines of :math:`P^4` have one transversal,
    the meet of the hyperplanes :math:`L_1 \vee L_2,\ L_1 \vee L_3,\ L_2 \vee L_3`; it passes through the centre of every view,
    which therefore sees it as a point, the joint epipole.  For points of space that move in one direction it is the vanishing
    point of that direction.  For points of the plane with constant velocities the three centres lie in one hyperplane: both
    lines are the image of the line at infinity, and there is no joint epipole.

    Args:
        projections: three of ``(*batch, 3, 5)``, of any scale.

    Returns:
        epipoles, lines and definedness; the angles are those after a change of image coordinates that makes the rows of every
        projection orthonormal, so that they do not depend on the unit of the images.

    Raises:
        ValueError: not three projections P^4 -> P^2.

    Source: thesis chapter 3 and section 10.1.

    Example:
        >>> import torch
        >>> rand = torch.Generator().manual_seed(0)
        >>> P = torch.randn(3, 3, 4, generator=rand, dtype=torch.float64)
        >>> direction = torch.tensor([1.0, 2.0, 2.0, 0.0], dtype=torch.float64)
        >>> M = [torch.cat([p, t * (p @ direction)[:, None]], -1) for t, p in enumerate(P)]
        >>> e = joint_epipoles(M).epipoles
        >>> bool(torch.linalg.cross(e, P @ direction).abs().max() < 1e-12)
        True
    """
    if len(projections) != 3 or any(m.shape[-2:] != (3, 5) for m in projections):
        raise ValueError(f"joint epipoles take three projections (*batch, 3, 5), got {[tuple(m.shape) for m in projections]}")
    views = torch.stack(torch.broadcast_tensors(*projections), dim=-3)
    lower, rows = _orthonormal_rows(views.double())
    centres = meet(*rows.unbind(-2))
    maps = compound(rows, 2)
    others = [(maps[..., i, :, :] @ centres[..., _other_views(i), :].mT).mT for i in range(3)]
    return _meeting(dual(torch.stack(others, dim=-3), 3, 2), lower, views.dtype)


def joint_epipoles_of_tensor(tensor: Tensor) -> JointEpipoles:
    r"""The joint epipoles of a Grassmann tensor of profile (2, 2, 1), without its projections. tensor ``(*batch, 3, 3, 3)``."""
    if tensor.shape[-3:] != (3, 3, 3):
        raise ValueError(f"tensor must be (*batch, 3, 3, 3), of profile (2, 2, 1), got {tuple(tensor.shape)}")
    # pairs of rows -> points, in both views
    finite = tensor.isfinite().flatten(-3).all(-1)[..., None, None, None]
    slices = torch.where(finite, tensor.double(), 0.0).movedim(-1, -3)
    slices = dual(dual(slices, 3, 2).mT, 3, 2).mT  # (*batch, k, i, j)
    size = torch.linalg.vector_norm(slices.detach(), dim=(-3, -2, -1), keepdim=True)
    slices = slices / torch.where(size > 0, size, 1.0)
    left, right = null_vectors(slices)
    of_first, of_second = null_vectors(left)[1], null_vectors(right)[1]
    first = _third_line(slices.movedim(-3, -1), of_first)
    second = _third_line(slices.mT.movedim(-3, -1), of_second)
    lines = torch.stack(
        [
            torch.stack([of_first, first], -2),
            torch.stack([of_second, second], -2),
            torch.stack([_image_in_third(slices, of_first, of_second), _image_in_third(slices.mT, of_second, of_first)], -2),
        ],
        dim=-3,
    )
    eye = torch.eye(3, dtype=lines.dtype, device=lines.device)
    return _meeting(lines, eye.expand(*lines.shape[:-2], 3, 3), tensor.dtype)


def _other_views(view: int) -> list[int]:
    return [j for j in range(3) if j != view]


def _orthonormal_rows(views: Tensor) -> tuple[Tensor, Tensor]:
    """M = L O with orthonormal rows of O; the identity and zero for what is not finite."""
    finite = views.isfinite().flatten(-2).all(-1)[..., None, None]
    q, r = torch.linalg.qr(torch.where(finite, views, torch.eye(3, 5, dtype=views.dtype, device=views.device)).mT)
    return r.mT, torch.where(finite, q.mT, 0.0)


def _third_line(slices: Tensor, line: Tensor) -> Tensor:
    """The line chi of det A(p, .) = (phi . p)^2 (chi . p), from slices ``(*batch, i, j, k)``."""
    # three points with phi . p = 1: phi, and one more along either direction across it
    across = _across(line)
    points = torch.cat([line[..., None, :], line[..., None, :] + across], dim=-2)
    at_line, *others = torch.linalg.det(torch.einsum("...ai,...ijk->...ajk", points, slices)).unbind(-1)
    along = torch.stack([other - at_line for other in others], dim=-1)
    return at_line[..., None] * line + (along[..., None] * across).sum(-2)


def _across(line: Tensor) -> Tensor:
    """Two unit vectors orthogonal to a unit vector and to each other."""
    least = one_hot(line.abs().argmin(dim=-1), 3).to(line)
    first = unit_vectors(torch.linalg.cross(line, least))
    return torch.stack([first, torch.linalg.cross(line, first)], dim=-2)


def _image_in_third(slices: Tensor, first: Tensor, second: Tensor) -> Tensor:
    """M_3 L_1: the image under A(p, .) of the line psi of view 2, for p off the line phi of view 1; slices (*batch, k, i, j)."""
    homography = torch.einsum("...kij,...i->...kj", slices, first)
    return (cofactors(homography) @ second[..., None])[..., 0]


def _meeting(lines: Tensor, coordinates: Tensor, dtype: torch.dtype) -> JointEpipoles:
    """Intersections of both lines ``(*batch, 3, 2, 3)`` of every view, in image coordinates that ``coordinates`` leads back to."""
    lines = unit_vectors(lines)
    crossing = torch.linalg.cross(lines[..., 0, :], lines[..., 1, :])
    sine = torch.linalg.vector_norm(crossing, dim=-1)
    points = torch.where((sine > FLAT)[..., None], (coordinates @ crossing[..., None])[..., 0], 0.0)
    seen = lines @ cofactors(coordinates).mT
    return JointEpipoles(_orient(points).to(dtype), _orient(seen).to(dtype), sine.amin(-1).to(dtype))


def _orient(vectors: Tensor) -> Tensor:
    """Unit vectors whose largest entry is positive."""
    return unit(vectors[..., None])[..., 0]

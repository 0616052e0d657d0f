"""Maximum-likelihood fundamental matrices of many weightings of the same matches: Levenberg-Marquardt on the Sampson distance."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product
from math import pi

import torch
from torch import Tensor

from dyntorch.geometry.epipolar import PairMonomials, affine_fundamental, bilinear, eight_point_of, polar
from dyntorch.geometry.homogeneous import cofactors
from dyntorch.numerics.blocks import constant, map_blocks, uniform
from dyntorch.numerics.least_squares import Iterate, LeastSquares, LeastSquaresOptions, Minimum, Tensors, damped_step, minimize

CAP = 2.25
"""Squared distances count up to this multiple of the squared scale."""
BLOCK = 1 << 17
"""Matches times fits per block: the weights stay in the cache."""
FEW = 4  # fits of a pair of views up to which their Jacobians take less time than products that all fits share
RIDGE = 1e-10  # of the largest diagonal entry: few matches, or those of a plane, leave directions open
DESCENT = LeastSquaresOptions(increase=10.0, least_damping=1e-8, tolerance=None)
LEAST = 1e-100  # scale, whose square still has an inverse


@dataclass(frozen=True)
class Frames:
    r"""Matrices of rank two and norm 1, :math:`F = U\,\mathrm{diag}(B, 0)\,V^T`, in a chart without singularities."""

    turns: Tensor  # (b, 2, 3, 3): U and V
    core: Tensor  # (b, 4): B, of norm 1

    @staticmethod
    def of(F: Tensor) -> Frames:
        """The nearest such matrices to ``(b, 3, 3)``."""
        # microseconds per matrix in batches of 1, 30, 1000: 9, 2.3, 2; by null_vectors 190, 7.5, 0.8, and the frames to complete
        u, s, vt = torch.linalg.svd(torch.nan_to_num(F))
        core = torch.zeros(len(F), 4, dtype=F.dtype, device=F.device)
        # the zero matrix is no fundamental matrix: some other one stands in for it
        core[:, 0], core[:, 3] = torch.where(s[:, 0] > 0, s[:, 0], 1.0), s[:, 1]
        return Frames(torch.stack([u, vt.mT], dim=1), core / core.norm(dim=-1, keepdim=True))

    def matrix(self) -> Tensor:
        """F ``(b, 9)``."""
        u, v = self.turns[..., :2].unbind(1)
        return (u @ self.core.unflatten(-1, (2, 2)) @ v.mT).flatten(1)

    def tangents(self) -> Tensor:
        """Derivative ``(b, 7, 9)`` of F by the parameters of :meth:`retract`, at 0."""
        local = (self.core @ _tables(self.core.dtype, self.core.device)[0]).unflatten(-1, (7, 9))
        u, v = self.turns.unbind(1)
        turn = (u.mT[:, :, None, :, None] * v.mT[:, None, :, None, :]).reshape(-1, 9, 9)
        return local @ turn

    def retract(self, step: Tensor) -> Frames:
        """After a step ``(b, 7)``: U turned about its first two axes, V about its own, B along its tangents."""
        _, quaternions, rotation, multiplied, still = _tables(step.dtype, step.device)
        q = torch.addmm(still, step, quaternions).unflatten(-1, (3, 4))
        q = q / torch.linalg.vector_norm(q, dim=-1, keepdim=True)
        pairs = (torch.cat([q[:, :2], self.core[:, None]], dim=1)[..., None] * q[..., None, :]).flatten(-2)
        turns = self.turns @ (pairs[:, :2] @ rotation).unflatten(-1, (3, 3))
        return Frames(turns, pairs[:, 2] @ multiplied)


@constant
def _tables(dtype: torch.dtype, device: torch.device) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """What is linear in the parts of frames."""
    # B = (b0, b1, b2, b3) times 1, i, j, k: an orthonormal basis, as (unit, new entry, old entry)
    units = torch.zeros(4, 4, 4, dtype=dtype)
    for unit, code in enumerate(("+0+1+2+3", "-1+0-3+2", "-2+3+0-1", "-3-2+1+0")):
        for entry in range(4):
            units[unit, entry, int(code[2 * entry + 1])] = float(code[2 * entry] + "1")
    generators = torch.zeros(4, 7, 3, 3, dtype=dtype)
    for row, column in product(range(2), repeat=2):
        # turned by the axes 0 and 1 from the left, B reaches the last row, and from the right, transposed, the last column
        generators[2 * row + column, 1 - row, 2, column] = 2.0 * row - 1
        generators[2 * row + column, 3 - column, row, 2] = 2.0 * column - 1
    generators[:, 4:, :2, :2] = units[1:].permute(2, 0, 1).reshape(4, 3, 2, 2)
    quaternions = torch.zeros(7, 3, 4, dtype=dtype)
    for parameter, (which, part) in enumerate(((0, 1), (0, 2), (1, 1), (1, 2), (2, 1), (2, 2), (2, 3))):
        quaternions[parameter, which, part] = 0.5 if which < 2 else 1.0
    rotation = torch.zeros(4, 4, 3, 3, dtype=dtype)
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        rotation[0, 0, i, i] = rotation[i + 1, i + 1, i, i] = 1.0
        rotation[j + 1, j + 1, i, i] = rotation[k + 1, k + 1, i, i] = -1.0
        rotation[i + 1, j + 1, i, j] = rotation[i + 1, j + 1, j, i] = 2.0
        rotation[0, i + 1, k, j], rotation[0, i + 1, j, k] = 2.0, -2.0
    multiplied = units.permute(2, 0, 1).reshape(16, 4)
    found = (
        generators.reshape(4, 63),
        quaternions.reshape(7, 12),
        rotation.reshape(16, 9),
        multiplied,
        torch.eye(4, dtype=dtype)[0].repeat(3),
    )
    return tuple(table.to(device) for table in found)  # type: ignore[return-value]


def descend(F: Tensor, x1: Tensor, x2: Tensor, weights: Tensor, scale: float | Tensor, steps: int = 3) -> Tensor:
    r"""Levenberg-Marquardt steps towards the least truncated Sampson distance: F ``(B, 3, 3)``, x1, x2 ``(n, 2)``, weights
    ``(B, n)`` -> ``(B, 3, 3)``; of several pairs of views ``(p, ...)`` each, at scales ``(p,)``."""
    return _descend(PairMonomials(x1, x2), F, weights, (scale,), steps)[0]


def _descend(
    data: PairMonomials, F: Tensor, weights: Tensor, scales: Sequence[float | Tensor], steps: int
) -> tuple[Tensor, Tensor]:
    """F and its cost at the last scale."""
    tables, lead = Products(data), weights.shape[:-1]
    # several pairs of views come in blocks already
    size = max(1, BLOCK // max(1, weights.shape[-1])) if len(lead) == 1 else max(1, lead.numel())

    def block(F: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
        options, frames, found = replace(DESCENT, iterations=steps), Frames.of(F), None
        for scale in scales:
            problem = EpipolarProblem(tables, weights, (*lead[:-1], -1), _inverse_square(scale, lead))
            start = problem.evaluate((frames.turns, frames.core)) if found is None else problem.evaluate_at_scale(found)
            found = minimize(problem, start, options)
        assert found is not None
        return found.terms[0].unflatten(-1, (3, 3)), found.cost

    found, cost = map_blocks(block, F.reshape(-1, 3, 3), weights.reshape(-1, weights.shape[-1]), size=size)
    return found.view(*lead, 3, 3), cost.view(lead)


def _inverse_square(scale: float | Tensor, lead: torch.Size) -> float | Tensor:
    """Of one scale, or of those of several pairs ``(p,)``, once for every fit ``(p b, 1)``."""
    if not isinstance(scale, Tensor):
        return 1 / max(scale, LEAST) ** 2
    return scale.clamp(min=LEAST).square().reciprocal()[:, None].expand(lead).reshape(-1, 1)


@dataclass(frozen=True)
class EpipolarProblem(LeastSquares):
    """Truncated Sampson distances of one list of matches with weights ``(b, n)``, in the parts of :class:`Frames`."""

    tables: Products
    weights: Tensor
    lead: tuple[int, ...]
    """What the problems are in the tables: ``(-1,)``, or ``(p, -1)`` of several pairs of views."""
    inverse: float | Tensor
    """Of the squared scale, of all or ``(b, 1)``."""

    def evaluate(self, theta: Tensors) -> Iterate:
        """With F, its values at the matches and the squared gradients."""
        f = Frames(*theta).matrix()
        value, square = (x.view_as(self.weights) for x in self.tables.data.flat_terms(f.view(*self.lead, 9)))
        return Iterate(theta, _msac(value, square, self.weights, self.inverse), (f, value, square))

    def evaluate_at_scale(self, at: Minimum) -> Iterate:
        """The same place at another scale."""
        _, value, square = at.terms
        return Iterate(at.theta, _msac(value, square, self.weights, self.inverse), at.terms)

    def step(self, at: Iterate, damping: Tensor) -> Tensors:
        """Of the seven parameters."""
        f, value, square = at.terms
        frames = Frames(*at.theta)
        normal, gradient = _normal_equations(self.tables, frames, f, value, square, self.weights, self.inverse, self.lead)
        return (damped_step(gradient, normal, damping, ridge=RIDGE),)

    def retract(self, theta: Tensors, step: Tensors) -> Tensors:
        """The frames turned."""
        fresh = Frames(*theta).retract(-step[0])
        return fresh.turns, fresh.core


def _msac(value: Tensor, square: Tensor, weights: Tensor, inverse: float | Tensor) -> Tensor:
    ratio = (value.square() / square).mul_(inverse).clamp_(max=CAP)
    return torch.linalg.vecdot(ratio, weights)


class Products:
    """Products of the monomials, whose weighted sums over the matches give the normal equations."""

    def __init__(self, data: PairMonomials) -> None:
        """Of the matches of ``data``."""
        self.data = data
        self.polar = polar(data.bilinear.dtype, data.bilinear.device).flatten(1)

    @cached_property
    def tables(self) -> list[Tensor]:
        """Bilinear, mixed and quadratic ones, ``(n, k)`` each."""
        # the derivative of the constraint counts positive, that of its gradient negative
        all_ = torch.cat([self.data.bilinear, -self.data.quadratic], dim=-2)
        return [(all_[..., i, :] * all_[..., j, :]).mT for i, j in _pairs(all_.device)[:3]]

    def gram(self, a: Tensor, b: Tensor, c: Tensor) -> Tensor:
        """Moments ``(*batch, 21, 21)`` of the monomials: bilinear with weights a, quadratic with c, b for one of each."""
        sums = torch.cat([weight @ table for weight, table in zip((a, b, c), self.tables, strict=True)], dim=-1)
        return sums[..., _pairs(sums.device)[3]].unflatten(-1, (21, 21))


@constant
def _pairs(device: torch.device) -> tuple[tuple[Tensor, Tensor], tuple[Tensor, Tensor], tuple[Tensor, Tensor], Tensor]:
    """Pairs of factors of all different products, bilinear, mixed and quadratic, and which one each entry of the Gram is."""
    second, first = ((1, 0), (0, 1), (0, 0)), ((2, 0), (1, 1), (0, 2), (1, 0), (0, 1), (0, 0))
    powers = [(*j, *i) for i in second for j in second] + [(*p, 0, 0) for p in first] + [(0, 0, *p) for p in first]
    found: list[dict[tuple[int, ...], tuple[int, int]]] = [{}, {}, {}]
    names = {}
    for i, j in product(range(21), repeat=2):
        kind, total = (i >= 9) + (j >= 9), tuple(p + q for p, q in zip(powers[i], powers[j], strict=True))
        found[kind].setdefault(total, (i, j))
        names[i, j] = kind, list(found[kind]).index(total)
    offsets = (0, len(found[0]), len(found[0]) + len(found[1]))
    place = torch.tensor([offsets[kind] + index for kind, index in names.values()], device=device)
    pairs = [torch.tensor(list(kind.values()), device=device).unbind(-1) for kind in found]
    one, two, three = ((pair[0], pair[1]) for pair in pairs)
    return one, two, three, place


def _normal_equations(
    tables: Products,
    frames: Frames,
    f: Tensor,
    value: Tensor,
    square: Tensor,
    weights: Tensor,
    inverse: float | Tensor,
    lead: tuple[int, ...] = (-1,),
) -> tuple[Tensor, Tensor]:
    r"""Gauss-Newton matrix ``(b, 7, 7)`` and gradient ``(b, 7)`` of the weighted distances :math:`r = e / g`."""
    ratio = value / square
    a = (weights * (1 - (value * ratio).mul_(inverse / CAP)).clamp_(min=0)).div_(square)
    tangents = frames.tangents()
    gradients = tangents @ (f @ tables.polar).unflatten(-1, (9, 12))
    if weights.numel() <= FEW * tables.data.bilinear[..., 0, :].numel():
        slope, bend = (_by_pair(part, monomials, lead) for part, monomials in
                       ((tangents, tables.data.bilinear), (gradients, tables.data.quadratic)))  # fmt: skip
        J = slope - bend * ratio[:, None]  # (b, 7, n)
        weighted = J * a[:, None]
        return weighted @ J.mT, (weighted @ value[..., None])[..., 0]
    b = a * ratio
    outer = torch.cat([tangents, gradients], dim=-1)  # (b, 7, 21)
    product = outer @ tables.gram(*(x.view(*lead, x.shape[-1]) for x in (a, b, b * ratio))).view(-1, 21, 21)
    return product @ outer.mT, (product[..., :9] @ f[..., None])[..., 0]


def _by_pair(rows: Tensor, monomials: Tensor, lead: tuple[int, ...]) -> Tensor:
    """Products of ``(b, 7, k)`` with the monomials ``(k, n)`` of the pair of views of each."""
    shaped = rows.view(*lead, *rows.shape[-2:])
    return (shaped.flatten(-3, -2) @ monomials).view(*rows.shape[:2], monomials.shape[-1])


def fit_fundamental(
    x1: Tensor, x2: Tensor, weights: Tensor, scales: Sequence[float], starts: Tensor | None = None, steps: int = 3
) -> tuple[Tensor, Tensor]:
    r"""The best of several descents: from the linear fit, from the affine one, and from given matrices. x1, x2 ``(n, 2)``,
    weights ``(B, n)``, starts ``(B, S, 3, 3)`` -> ``(B, 3, 3)``; of several pairs of views ``(p, ...)`` each."""
    if not scales or min(scales) <= 0:
        raise ValueError(
            f"scales must be positive thresholds in the unit of the matches, got {tuple(scales)}: pass e.g. (0.02, 0.01)"
        )
    data = PairMonomials(x1, x2)
    several = torch.stack([eight_point_of(data, weights, 0), affine_fundamental(x1, x2, weights)], dim=-3)
    several = several if starts is None else torch.cat([several, starts], dim=-3)

    def descend_from(several: Tensor, scales: Sequence[float], steps: int) -> tuple[Tensor, Tensor]:
        count = several.shape[-3]
        spread = weights[..., None, :].expand(*weights.shape[:-1], count, -1).flatten(-3, -2)
        F, cost = _descend(data, several.flatten(-4, -3), spread, scales, steps)
        return F.unflatten(-3, (-1, count)), cost.unflatten(-1, (-1, count))

    F, cost = descend_from(several, scales, steps)
    if starts is not None:
        F0, cost0 = descend_from(starts, scales[-1:], 0)
        F, cost = torch.cat([F, F0], dim=-3), torch.cat([cost, cost0], dim=-1)
    best = cost.argmin(-1, keepdim=True)
    picked = F.gather(-3, best[..., None, None].expand(*best.shape, 3, 3))
    return picked[..., 0, :, :], cost.gather(-1, best)[..., 0]


# ----------------------------------------------------------------------------------------------------------------------
# Fundamental matrices of samples of seven matches, tens of thousands at a time.


SAMPLES_BLOCK = 4096
"""Samples per block, which stay in the cache."""


def seven_point(x1: Tensor, x2: Tensor) -> tuple[Tensor, Tensor]:
    r"""Fundamental matrices of seven matches each: :math:`x_2^T F x_1 = 0,\ \det F = 0`, one or three of them. x1, x2
    ``(*batch, 7, 2)`` -> ``(*batch, 3, 3, 3)``."""
    if x1.shape[-2:] != (7, 2) or x2.shape != x1.shape:
        raise ValueError(f"x1 and x2 must be (*batch, 7, 2), got {tuple(x1.shape)} and {tuple(x2.shape)}")
    design = torch.nan_to_num(bilinear(x1, x2)).mT
    # microseconds per sample in batches of 1, 30, 1000: 12, 1.6, 1.1; by null_space 335, 12, 2.1
    basis = torch.linalg.qr(design.mT, mode="complete").Q[..., 7:]
    one, two = basis.mT.unflatten(-1, (3, 3)).unbind(-3)
    direction, valid = _roots(*_pencil(one, two))
    found = direction[..., :1, None] * one[..., None, :, :] + direction[..., 1:, None] * two[..., None, :, :]
    return torch.where(valid[..., None, None], found, 0.0), valid


def sample_fundamentals(
    x1: Tensor, x2: Tensor, weights: Tensor, samples: int, generator: torch.Generator | None = None
) -> tuple[Tensor, Tensor]:
    """Fundamental matrices of samples of seven matches, drawn without replacement, with probabilities by weight. x1, x2
    ``(n, 2)``, weights ``(B, n)`` -> ``(B, 3 samples, 3, 3)``."""
    chosen = draw(weights, 7, samples, generator)

    def block(chosen: Tensor) -> tuple[Tensor, Tensor]:
        return seven_point(x1[chosen], x2[chosen])

    F, valid = (part.unflatten(0, (-1, samples)) for part in map_blocks(block, chosen.flatten(0, 1), size=SAMPLES_BLOCK))
    valid = valid & ((weights > 0).sum(-1) >= 7)[:, None, None]
    return torch.where(valid[..., None, None], F, 0.0).flatten(1, 2), valid.flatten(1, 2)


def draw(weights: Tensor, size: int, samples: int, generator: torch.Generator | None = None) -> Tensor:
    """Indices ``(B, samples, size)`` drawn without replacement, one after the other, with probabilities by weight."""
    ends = weights.double().cumsum(-1)
    numbers = uniform(len(weights), samples, size, generator=generator, device=weights.device)
    left = ends[:, -1:].clone().expand(-1, samples)
    starts = ends.new_empty(len(ends), samples, 0)
    widths = starts
    chosen: list[Tensor] = []
    for k in range(size):
        position = numbers[..., k] * left
        starts, order = starts.sort(dim=-1)
        widths = widths.gather(-1, order)
        for start, width in zip(starts.unbind(-1), widths.unbind(-1), strict=True):
            position = position + torch.where(position >= start, width, 0.0)
        index = torch.searchsorted(ends, position, right=True).clamp(max=ends.shape[-1] - 1)
        width = weights.double().gather(-1, index)
        chosen.append(index)
        starts = torch.cat([starts, (ends.gather(-1, index) - width)[..., None]], dim=-1)
        widths = torch.cat([widths, width[..., None]], dim=-1)
        left = left - width
    return torch.stack(chosen, dim=-1)


def _pencil(one: Tensor, two: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Coefficients of det(a F_1 + b F_2) by falling powers of a."""
    first, second = cofactors(one), cofactors(two)
    return (
        (first[..., 0, :] * one[..., 0, :]).sum(-1),
        (first * two).sum((-2, -1)),
        (second * one).sum((-2, -1)),
        (second[..., 0, :] * two[..., 0, :]).sum(-1),
    )


def _roots(c3: Tensor, c2: Tensor, c1: Tensor, c0: Tensor) -> tuple[Tensor, Tensor]:
    """Unit vectors ``(*batch, 3, 2)`` at which a binary cubic is 0, and which of them are real ``(*batch, 3)``."""
    plus, minus = c3 + c1, c2 + c0
    size = torch.stack([c3, 0.5**1.5 * (plus + minus), c0, 0.5**1.5 * (plus - minus)], dim=-1).abs()
    turn = (pi / 4) * size.argmax(-1).to(c3.dtype)
    c, s = turn.cos(), turn.sin()
    cc, cs, ss = c * c, c * s, s * s
    # the same form in u, v with a = c u - s v, b = s u + c v
    lead = (c3 * c + c2 * s) * cc + (c1 * c + c0 * s) * ss
    lead = torch.where(lead == 0, 1.0, lead)
    a2 = (c * (c2 * cc - 3 * c3 * cs + 2 * c1 * cs + 3 * c0 * ss) - s * (2 * c2 * cs + c1 * ss)) / lead
    a1 = (c * (c1 * cc - 2 * c2 * cs + 3 * c3 * ss + 3 * c0 * cs) + s * (c2 * ss - 2 * c1 * cs)) / lead
    a0 = (c * (c0 * cc - c1 * cs + c2 * ss) - s * c3 * ss) / lead
    root, valid = _cubic(a2, a1, a0)
    c, s = c[..., None], s[..., None]
    vector = torch.stack([c * root - s, s * root + c], dim=-1)
    return vector / vector.norm(dim=-1, keepdim=True), valid


def _cubic(a2: Tensor, a1: Tensor, a0: Tensor) -> tuple[Tensor, Tensor]:
    """Roots ``(*batch, 3)`` of a monic cubic by Viete and Cardano, polished, and which are real: the first one always is."""
    p, q = a1 - a2 * a2 / 3, (2 * a2 * a2 / 27 - a1 / 3) * a2 + a0
    discriminant = (q / 2).square() + (p / 3) ** 3
    three = discriminant < 0
    radius = (-p / 3).clamp(min=0).sqrt()
    angle = (-q / (2 * radius**3)).nan_to_num(0.0, 1.0, -1.0).clamp(-1, 1).acos() / 3
    offsets = torch.tensor([0.0, 2 * pi / 3, -2 * pi / 3], dtype=q.dtype, device=q.device)
    cosines = 2 * radius[..., None] * (angle[..., None] + offsets).cos()
    cube = -q / 2 - torch.copysign(discriminant.clamp(min=0).sqrt(), q)
    u = torch.copysign(cube.abs() ** (1 / 3), cube)
    single = u - p / torch.where(u == 0, torch.inf, 3 * u)
    t = torch.where(three[..., None], cosines, single[..., None])
    p, q = p[..., None], q[..., None]
    for _ in range(2):
        slope = 3 * t * t + p
        step = ((t * t + p) * t + q) / slope
        t = torch.where(slope.abs() > 1e-8 * (t * t + p.abs()), t - step, t)
    valid = three[..., None] | (offsets == 0)
    return t - (a2 / 3)[..., None], valid & t.isfinite()

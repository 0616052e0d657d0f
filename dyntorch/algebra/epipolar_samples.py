"""Fundamental matrices of samples of seven matches, tens of thousands at a time."""

from __future__ import annotations

from math import pi

import torch
from torch import Tensor

from dyntorch.algebra.epipolar import bilinear
from dyntorch.algebra.rank_two import cofactors
from dyntorch.blocks import map_blocks
from dyntorch.sampling import uniform

BLOCK = 4096
"""Samples per block, which stay in the cache."""


def seven_point(x1: Tensor, x2: Tensor) -> tuple[Tensor, Tensor]:
    r"""Fundamental matrices of seven matches each: :math:`x_2^T F x_1 = 0,\ \det F = 0`, one or three of them.

    Args:
        x1, x2: ``(*batch, 7, 2)``.

    Returns:
        F ``(*batch, 3, 3, 3)`` of norm 1, zero where there is none, and which exist ``(*batch, 3)``.

    Raises:
        ValueError: not seven matches.

    Source: Hartley and Zisserman, Multiple View Geometry, section 11.1.2.

    Example:
        >>> import torch
        >>> x1 = torch.rand(7, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
        >>> F, valid = seven_point(x1, x1 + torch.tensor([0.1, 0.0]) * x1.square())
        >>> F.shape, int(valid.sum()) in (1, 3)
        (torch.Size([3, 3, 3]), True)
    """
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
    """Fundamental matrices of samples of seven matches, drawn without replacement, with probabilities by weight.

    Args:
        x1, x2: ``(n, 2)``.
        weights: ``(B, n)``, not negative: the pools.
        samples: per pool.
        generator: source of all randomness.

    Returns:
        F ``(B, 3 samples, 3, 3)`` of norm 1, zero where there is none, and which exist ``(B, 3 samples)``: none in a pool of
        fewer than seven matches.

    Example:
        >>> import torch
        >>> x = torch.rand(2, 20, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
        >>> F, valid = sample_fundamentals(x[0], x[1], torch.ones(4, 20, dtype=torch.float64), 5, torch.Generator().manual_seed(0))
        >>> F.shape, valid.shape
        (torch.Size([4, 15, 3, 3]), torch.Size([4, 15]))
    """
    chosen = draw(weights, 7, samples, generator)

    def block(chosen: Tensor) -> tuple[Tensor, Tensor]:
        return seven_point(x1[chosen], x2[chosen])

    F, valid = (part.unflatten(0, (-1, samples)) for part in map_blocks(block, chosen.flatten(0, 1), size=BLOCK))
    valid = valid & ((weights > 0).sum(-1) >= 7)[:, None, None]
    return torch.where(valid[..., None, None], F, 0.0).flatten(1, 2), valid.flatten(1, 2)


def draw(weights: Tensor, size: int, samples: int, generator: torch.Generator | None = None) -> Tensor:
    """Indices ``(B, samples, size)`` drawn without replacement, one after the other, with probabilities by weight.

    Each draw is a position on the line of cumulated weights from which the stretches drawn before are cut out.  The random keys
    of ``torch.multinomial`` cost n numbers per sample.  Repeats occur only where fewer weights than ``size`` are positive.
    """
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
    """Unit vectors ``(*batch, 3, 2)`` at which a binary cubic is 0, and which of them are real ``(*batch, 3)``.

    The form is turned by 0, 45, 90 or 135 degrees to a large leading coefficient, so that no root is near infinity.
    """
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

"""What speaks against a lag between different points: motion that repeats itself, and a peak that depends on single moments."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from dyntorch.tasks.sync_subspace import FEWEST, SubspaceCurve, bodies_curve, information
from dyntorch.tasks.sync_subspace_body import Body, halves

BLOCKS = 8
"""Parts of the overlap that are left out in turn."""


def resemblance(curve: SubspaceCurve, best: int, apart: float) -> float:
    r"""How much the motion resembles itself at another time that fits as well: 0 not at all, 1 as much as at the same time.

    .. math:: \max_\delta \frac{r_a(\delta) + r_b(\delta)}{r_a(0) + r_b(0)}

    r is the evidence per frame between two halves of one camera's points, over the lags by which the best lag can be wrong.
    Exactly periodic motion reaches .7 and more; of the answers that are right on motion capture 98 percent stay below .63.

    Args:
        curve: with its bodies.
        best: entry of the best lag.
        apart: frames below which lags are one.
    """
    if curve.bodies is None:
        return 0.0
    judged = curve.scores.isfinite()
    rivals = judged.nonzero()[:, 0] - best
    frames, step = min(len(body.rows) for body in curve.bodies), curve.bodies[0].step
    reach = min(int(rivals.abs().max()), frames - math.ceil(FEWEST / step))
    if reach <= apart:
        return 0.0
    both = sum((_alike(body, reach) for body in curve.bodies), curve.scores.new_zeros(2 * reach + 1))
    both = both + both.flip(0)
    padded = torch.nn.functional.pad(both, (1, 1), value=math.inf)
    peak = (both >= padded[:-2]) & (both >= padded[2:])
    rivals = rivals[(rivals.abs() <= reach) & (rivals.abs() > apart)] + reach
    found = both[rivals[peak[rivals]]]
    if not len(found):
        return 0.0
    own, other = float(both[reach]), float(found.max())
    return other / own if own > 0 else math.inf


def _alike(body: Body, reach: int) -> Tensor:
    """Evidence per frame ``(2 reach + 1,)`` between halves of the points."""
    first, second = halves(body)
    return bodies_curve(first.blurred, second.blurred, (-reach, reach), body.step).rates.nan_to_num(-math.inf)


def wobble(curve: SubspaceCurve, lag: int) -> float:
    r"""Standard deviation of the best lag in frames, by the jackknife over parts of the overlap.

    .. math:: \sigma^2 = \frac{B - 1}{B} \sum_k (\hat s_{-k} - \bar s)^2, \qquad
              \hat s_{-k} \approx -\frac{S'_{-k}}{\overline{S''}}

    Noise of detectors keeps for some frames, which the curvature of the score does not know of.

    Args:
        curve: with its bodies.
        lag: the best, frames.
    """
    if curve.bodies is None:
        return 0.0
    a, b = curve.bodies
    start, end = max(0, 1 - lag), min(len(a.rows), len(b.rows) - lag - 1)
    if end - start < BLOCKS:
        return math.inf
    edges = torch.linspace(start, end, BLOCKS + 1).round().long().tolist()
    sizes = torch.tensor(edges).diff().tolist()
    shapes: list[Tensor] = []
    motions: list[Tensor] = []
    for at in range(lag - 1, lag + 2):
        w = a.weights[start:end] * b.weights[start + at : end + at]
        for kept, x, y in ((shapes, a.rows, b.rows), (motions, a.motion, b.motion)):
            both = torch.cat([x[start:end], y[start + at : end + at], torch.ones_like(w)[:, None]], dim=1) * w[:, None]
            kept.append(torch.stack([part.mT @ part for part in both.split(sizes)]))
    shape, motion = (_without(torch.stack(kept)) for kept in (shapes, motions))
    before, here, after = information(shape, a.rows.shape[1], motion).unflatten(0, (3, BLOCKS))
    bend = float((before - 2 * here + after).mean())
    return math.sqrt((BLOCKS - 1) * float(((after - before) / 2).var(correction=0))) / -bend if bend < 0 else math.inf


def _without(moments: Tensor) -> Tensor:
    """Covariances ``(L B, d, d)`` of all parts but one, of moments ``(L, B, d + 1, d + 1)``."""
    rest = (moments.sum(1, keepdim=True) - moments).flatten(0, 1)
    count = rest[:, -1:, -1:].clamp(min=1.0)
    mean = rest[:, :-1, -1:] / count
    return rest[:, :-1, :-1] / count - mean @ mean.mT

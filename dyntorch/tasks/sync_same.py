"""Synchronization by points that both cameras see: plain first, then what may be wrong with the input, one thing at a time."""

from __future__ import annotations

import dataclasses
import math

import torch
from torch import Generator, Tensor

from dyntorch.tasks.sync_attempt import APART, Attempt
from dyntorch.tasks.sync_consensus import consistent_points
from dyntorch.tasks.sync_lens import fit_distortion
from dyntorch.tasks.sync_scaled import frame_scaled
from dyntorch.tasks.sync_search import DRIFTING, Search, attempt
from dyntorch.tasks.sync_tracks import RATES, Tracks, smoothed, without

LONGEST = 4_000
"""Steps of a take at most; longer takes are searched in coarser steps."""
COARSE = 2_000
"""Steps of a take for a search over rates, of a tenth of a second at least."""
SUSPECT = 3.0
"""Times the usual residual, beyond which a point is wrong."""
FAR = 6.0
"""Robust standard deviations from the fit at which a position counts as an outlier."""
LOST = 0.3
"""Share of the positions of a point, or of a stretch of the take, that may be outliers."""
STRETCHES = 8
RARE = 0.01
"""Share of the positions that makes no difference to a fit that is sure."""
ROUGH = 1.25
"""Residual over what the noise explains, from which lenses are looked at."""


@dataclasses.dataclass(frozen=True, eq=False)
class Result:
    """The best attempt and what it took.

    Attributes:
        seen: ``(n,)`` bool, points that both cameras show at all.
    """

    found: Attempt
    notes: tuple[str, ...]
    seen: Tensor


def same_points(
    a: Tracks,
    b: Tracks,
    *,
    max_shift: float | None,
    rate: float | None,
    camera: str,
    lenses: bool,
    generator: Generator | None,
) -> Result:
    """The shift of cameras that see the same points.

    Args:
        rate: of b's clock, where it is known.
        camera: ``"perspective"``, ``"affine"`` or ``"auto"``.
        lenses: whether nobody calibrated the cameras, and distortion may be looked for.
    """
    span = min(float(t.times[-1] - t.times[0]) for t in (a, b))
    search = Search(step=span / LONGEST, max_shift=max_shift, rates=(rate or 1.0,), free_rate=rate is None)
    seen = (a.weights > 0).any(0) & (b.weights > 0).any(0)
    if a.still or b.still:
        return Result(dataclasses.replace(attempt(a, b, search), fit=None), (), seen)
    if camera == "affine":
        return Result(_affine(a, b, search, generator), (), seen)
    found = _sorted_out(a, b, search, generator)
    if not found.decided and rate is None:
        found = _better(found, _over_rates(a, b, search, span, generator))
    notes: tuple[str, ...] = ()
    if lenses and found.fit is not None and found.roughness > ROUGH:
        found, notes = _straightened(found, a, b, search, generator)
    if camera == "auto" and not found.decided:
        scaled = _affine(a, b, search, generator)
        # without the place in the picture a gait repeats itself, so that affine cameras alone may be sure of a wrong period
        if scaled.decided and _agree(scaled, found):
            note = "affine cameras: the points do not hold enough depth, or are too noisy, for perspective ones"
            return Result(scaled, (note,), seen)
    return Result(found, notes if found.decided else (), seen)


def _sorted_out(a: Tracks, b: Tracks, search: Search, generator: Generator | None) -> Attempt:
    """An attempt with all points, and one without those that do not fit, where that may be why it fails."""
    found = attempt(a, b, search)
    pruned = _pruned(found)
    if pruned is not None:
        a, b = pruned
        found = _better(found, dataclasses.replace(attempt(a, b, search), pruned=True))
    if found.decided and not bool(_suspects(found).any()):
        return found
    points = consistent_points(a, b, found, generator)
    if points is None or bool(points.all()):
        return found
    return _better(found, dataclasses.replace(attempt(a, b, search, points), pruned=pruned is not None))


def _pruned(found: Attempt) -> tuple[Tracks, Tracks] | None:
    """Tracks without the positions far from the fit, in both cameras: whose is wrong is not known; None where all is well."""
    fit = found.fit
    if fit is None or len(fit.times) != len(found.a.times):
        return None
    far = fit.distances.abs() > FAR
    seen = fit.distances.isfinite()
    # a point that is mostly elsewhere is another point, and is found as such
    far = far & (far.sum(0) <= LOST * seen.sum(0))
    parts = [(float(one.sum()), float(all_.sum())) for one, all_ in zip(far.chunk(STRETCHES), seen.chunk(STRETCHES), strict=True)]
    if found.decided and float(far.double().mean()) < RARE:
        return None  # the weights of the fit are enough
    # a stretch that does not fit is no outlier: it contradicts
    if not bool(far.any()) or any(lost > LOST * whole for lost, whole in parts):
        return None
    frames, joints = far.nonzero().unbind(1)
    there = fit.times[frames] * fit.rate + fit.offset
    nearest = (there[:, None] - found.b.times).abs().argmin(1)
    other = torch.zeros_like(found.b.weights, dtype=torch.bool)
    other[nearest, joints] = True
    return without(found.a, far), without(found.b, other)


def _over_rates(a: Tracks, b: Tracks, search: Search, span: float, generator: Generator | None) -> Attempt | None:
    """A search over clock rates too, where a wrong one would have smeared the motion."""
    step = max(span / COARSE, 0.1)
    change = 2 * step / span  # moves the ends of the overlap by a step
    count = math.ceil(RATES / change)
    if span < DRIFTING:
        return None
    rates = tuple(1 + k * change for k in range(-count, count + 1))
    coarse = attempt(a, b, dataclasses.replace(search, step=step, rates=rates))
    if coarse.fit is None:
        return None
    return _sorted_out(a, b, dataclasses.replace(search, rates=(coarse.fit.rate,)), generator)


def _affine(a: Tracks, b: Tracks, search: Search, generator: Generator | None) -> Attempt:
    return _sorted_out(frame_scaled(a), frame_scaled(b), dataclasses.replace(search, method="affine"), generator)


def _better(one: Attempt, other: Attempt | None) -> Attempt:
    """The decided one; where both are, the other, which had the more careful input; where none is, the one more likely right."""
    if other is None or other.fit is None:
        return one
    if one.fit is None or other.decided:
        return other
    return one if one.decided or one.confidence >= other.confidence else other


def _agree(one: Attempt, other: Attempt) -> bool:
    """Whether the best shifts are the same."""
    return one.fit is not None and other.fit is not None and abs(one.fit.shift - other.fit.shift) <= APART * one.frame


def _suspects(found: Attempt) -> Tensor:
    """``(n,)`` of the points that took part: whether their residual is out of all proportion."""
    assert found.fit is not None
    own = found.fit.distances.abs().nanmedian(0).values * 1.4826
    return own.nan_to_num(0.0) > SUSPECT


def _straightened(
    found: Attempt, a: Tracks, b: Tracks, search: Search, generator: Generator | None
) -> tuple[Attempt, tuple[str, ...]]:
    """Once more with lenses fitted at the shift found, where they are significant."""
    assert found.fit is not None
    fit = found.fit
    x1, _, w1 = smoothed(found.a, fit.times, found.frame)
    x2, _, w2 = smoothed(found.b, fit.times * fit.rate + fit.offset, found.frame)
    lens = fit_distortion(x1.flatten(0, 1), x2.flatten(0, 1), (w1 * w2).flatten())
    if not lens.significant:
        return found, ()
    straight = []
    for tracks, one in zip((a, b), lens.lenses, strict=True):
        x = one.undistort(tracks.x)
        seen = x.isfinite().all(-1)
        straight.append(dataclasses.replace(tracks, x=torch.where(seen[..., None], x, 0.0), weights=tracks.weights * seen))
    again = attempt(straight[0], straight[1], search, found.points)
    better = again.fit is not None and again.fit.residual < fit.residual and _better(found, again) is again
    return (again, (lens.note,)) if better else (found, ())

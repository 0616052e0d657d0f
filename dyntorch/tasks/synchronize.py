"""Synchronize two cameras that nobody synchronized."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from numbers import Real
from typing import Any

import torch
from torch import Generator, Tensor

from dyntorch.algebra.lens import undistorted
from dyntorch.blocks import one_thread
from dyntorch.devices import on_cpu
from dyntorch.tasks.shift import Shift
from dyntorch.tasks.sync_attempt import APART, WANDER, Attempt
from dyntorch.tasks.sync_cleaning import cleaned
from dyntorch.tasks.sync_different import different_points
from dyntorch.tasks.sync_same import Result, same_points
from dyntorch.tasks.sync_tracks import Tracks, read_tracks

SHORTEST = 12
"""Frames of a take at least."""
BLIND = 10.0
"""Frames of sigma from which no shift stands out at all."""
CAMERAS = ("auto", "perspective", "affine")


@one_thread
@on_cpu
def synchronize(
    a: Tensor,
    b: Tensor,
    correspondence: bool = True,
    *,
    fps: float | tuple[float, float] | None = None,
    times: tuple[Tensor, Tensor] | None = None,
    max_shift: float | None = None,
    calibration: tuple[Any, Any] | None = None,
    weights: tuple[Tensor | None, Tensor | None] | None = None,
    rate: float | None = None,
    camera: str = "auto",
    generator: Generator | None = None,
) -> Shift:
    r"""How b's clock runs against a's, from what two static cameras saw move: :math:`t_b = \text{rate}\; t_a + \text{offset}`.

    With corresponding points, the shift at which one fundamental matrix explains all frames:

    .. math:: \min_{s, F} \frac{\sum_{ij} (x_{b,j}(t_i + s)^T F\, x_{a,j}(t_i))^2}{\sum_{ij} |\nabla|^2},

    at all shifts by FFT, then by least squares of the Sampson distance in offset, rate and F together.  With different points, the
    shift at which the two cameras' coordinates share most information.  The result is refused (``ok`` false, with a reason)
    where the motion repeats itself, is too small, or where parts of the take disagree.

    A search: it computes on the CPU wherever its tensors are, and the result returns to their device.

    Args:
        a: ``(frames_a, n, 2)`` px, y down; NaN = missing.  Point k of a is point k of b.
        b: ``(frames_b, n, 2)``; without correspondence ``(frames_b, m, 2)``.
        correspondence: whether points correspond.
        fps: frames per second of both, or of each; frame 0 is at 0 s.
        times: instead, ``(frames,)`` seconds of each frame, increasing, for variable frame rates and dropped frames.
        max_shift: how far to search, seconds; None for all shifts with enough overlap.
        calibration: per camera None or ``(K, dist)`` (OpenCV's order), whose distortion is removed.  Without, distortion is
            looked for where the points do not fit, and removed by one parameter per camera, with a note.
        weights: per camera ``(frames, n)``, such as a detector's confidences; 0 = ignore.
        rate: of b's clock, where known; by default 1 unless the takes say otherwise (up to 2 %).
        camera: ``"perspective"``, ``"affine"`` (points about their middle in each frame), or ``"auto"``: perspective unless that
            cannot decide and affine can.  Of corresponding points only.
        generator: of the subsets that look for wrong points; a fixed one by default.

    Returns:
        offset, sigma, rate, confidence, all peaks, and whether it is ok.

    Raises:
        ValueError: input of the wrong shape, fewer than 12 frames, a take that is nearly all gap, or settings that make no sense.

    Source: thesis, chapter 7 (Wolf and Zomet 2002); theory of moments at all lags by FFT.

    Example:
        >>> import torch
        >>> g = torch.Generator().manual_seed(0)
        >>> t = torch.arange(150, dtype=torch.float64)[:, None, None] / 30
        >>> wave = lambda: torch.randn(12, 3, generator=g, dtype=torch.float64)
        >>> speeds, phases, sizes, base = 4 * wave().abs(), 6 * wave(), wave(), 3 * wave()
        >>> def film(t, turn):  # twelve points that wobble, from five metres away
        ...     p = base / 3 + 0.2 * sizes * torch.sin(speeds * t + phases)
        ...     c, d = math.cos(turn), math.sin(turn)
        ...     x, z = c * p[..., 0] + d * p[..., 2], c * p[..., 2] - d * p[..., 0]
        ...     return 800 * torch.stack([x, p[..., 1]], -1) / (z + 5)[..., None]
        >>> shift = synchronize(film(t, 0.0), film(t - 0.42, 1.0), fps=30.0)
        >>> round(shift.offset, 3), shift.ok
        (0.42, True)
    """
    _check(correspondence, fps, times, weights, max_shift, rate, camera)
    pair: tuple[float | None, float | None] = (None, None)
    if fps is not None:
        pair = (float(fps[0]), float(fps[1])) if isinstance(fps, Sequence) else (float(fps), float(fps))
    given = (None, None) if weights is None else weights
    tracks = [
        read_tracks(name, x, one, None if times is None else times[i], given[i])
        for i, (name, x, one) in enumerate(zip("ab", (a, b), pair, strict=True))
    ]
    for name, one in zip("ab", tracks, strict=True):
        if len(one.times) < SHORTEST:
            raise ValueError(f"{name} has {len(one.times)} frames, {SHORTEST} are needed at least")
    if calibration is not None:
        tracks = [_straight(name, one, lens) for name, one, lens in zip("ab", tracks, _pairwise(calibration), strict=True)]
    # both clocks count from a's first frame: timestamps may be of any era, and products of rates with them lose digits
    origin = float(tracks[0].times[0])
    first, second = (cleaned(dataclasses.replace(one, times=one.times - origin)) for one in tracks)
    if not correspondence:
        return different_points(first, second, max_shift=max_shift, rate=rate).since(origin)
    if a.shape[1] != b.shape[1]:
        raise ValueError(
            f"a has {a.shape[1]} points and b {b.shape[1]}: corresponding points are as many; "
            "give the same ones in the same order, or correspondence=False"
        )
    result = same_points(
        first, second, max_shift=max_shift, rate=rate, camera=camera, lenses=calibration is None, generator=generator
    )
    return _shift(result).since(origin)


def _check(
    correspondence: bool,
    fps: float | tuple[float, float] | None,
    times: tuple[Tensor, Tensor] | None,
    weights: tuple[Tensor | None, Tensor | None] | None,
    max_shift: float | None,
    rate: float | None,
    camera: str,
) -> None:
    if (fps is None) == (times is None):
        raise ValueError(f"give either fps or times, got {'neither' if fps is None else 'both'}")
    for name, value in (("fps", fps), ("times", times), ("weights", weights)):
        paired = isinstance(value, Sequence) and len(value) == 2
        if value is not None and not isinstance(value, Real) and not paired:
            got = f"{len(value)} values" if isinstance(value, Sequence) else type(value).__name__
            raise ValueError(f"{name} must be a pair, one of a and one of b, got {got}")
    if max_shift is not None and not 0 < max_shift < math.inf:
        raise ValueError(f"max_shift must be a positive number of seconds or None, got {max_shift}")
    if rate is not None and not 0.1 < rate < 10:
        raise ValueError(f"rate must be about 1 (seconds of b's clock per second of a's), got {rate}; give fps for frame rates")
    if camera not in CAMERAS:
        raise ValueError(f"camera must be one of {', '.join(CAMERAS)}, got {camera!r}")
    if camera != "auto" and not correspondence:
        raise ValueError(f"camera={camera!r} is for corresponding points; leave it out with correspondence=False")


def _pairwise(calibration: Any) -> Sequence[Any]:
    if not isinstance(calibration, Sequence) or len(calibration) != 2:
        raise ValueError("calibration must be a pair, of a and of b: each None or (K, dist)")
    return calibration


def _straight(name: str, tracks: Tracks, lens: Any) -> Tracks:
    try:
        x = undistorted(tracks.x, lens)
    except ValueError as problem:
        raise ValueError(f"calibration of {name}: {problem}") from problem
    seen = (tracks.weights > 0) & x.isfinite().all(-1)
    return dataclasses.replace(tracks, x=torch.where(seen[..., None], x, 0.0), weights=torch.where(seen, tracks.weights, 0.0))


def _shift(result: Result) -> Shift:
    """The result of an attempt."""
    found, notes = result.found, result.notes
    fps = 1 / found.a.step, 1 / found.b.step
    fit = found.fit
    points = found.points & result.seen
    if fit is None:
        none = torch.zeros(0, dtype=torch.float64)
        reason = _nothing(found)
        return Shift(
            0.0, math.inf, 1.0, 0.0, 0.0, none.reshape(0, 2), False, reason, found.method, fps, 0.0, none, none, result.seen
        )
    wrong = (result.seen & ~found.points).nonzero()[:, 0].tolist()
    if wrong:
        which = ", ".join(str(point) for point in wrong)
        notes = (*notes, f"{len(wrong)} of {len(points)} points never agree with the others and were left out: {which}")
    if found.decided and found.wander > WANDER:
        notes = (*notes, "each half of the take fits much better by itself: a camera may have moved")
    lags = found.curve.rate * (found.curve.lags + fit.center) - fit.center
    return Shift(
        offset=fit.offset,
        sigma=found.sigma,
        rate=fit.rate,
        rate_sigma=fit.rate_sigma,
        confidence=found.confidence,
        peaks=torch.tensor(found.peaks, dtype=torch.float64),
        ok=found.decided,
        reason="" if found.decided else _reason(found),
        method=found.method,
        fps=fps,
        center=fit.center,
        lags=lags,
        scores=found.curve.scores,
        points=points,
        fundamental=fit.fundamental if found.method == "epipolar" else None,
        notes=notes,
    )


def _nothing(found: Attempt) -> str:
    """Why no shift stands out."""
    for name, tracks in (("a", found.a), ("b", found.b)):
        if not bool((tracks.weights > 0).any()):
            return f"no point is seen in {name}; check the detections"
        if tracks.still:
            return f"nothing moves in {name}; film some movement"
    return "no shift stands out, or both cameras never show enough points at once; film longer, or raise max_shift"


def _reason(found: Attempt) -> str:
    fit = found.fit
    assert fit is not None
    if fit.sigma > BLIND * found.frame:
        return _nothing(found)
    if found.edge:
        return f"the best shift, about {fit.shift:+.3g} s, lies at the end of the search or beyond; raise max_shift"
    if not found.sharp:
        return (
            f"the motion is too small for its noise: the best shift, {fit.shift:+.3g} s, is uncertain by {fit.sigma:.2g} s "
            "or more; film larger or faster movements"
        )
    if found.margin < found.needed and len(found.peaks) > 1:
        least = found.misfits[0] - found.needed
        near = [shift for (shift, _), misfit in zip(found.peaks, found.misfits, strict=True) if misfit > least]
        rivals = ", ".join(f"{shift:+.3g} s" for shift in near[1:4])
        return (
            f"the motion repeats itself or is too small: {found.peaks[0][0]:+.3g} s fits hardly better than {rivals}; "
            "film something that happens once, or narrow max_shift"
        )
    first, second = found.halves
    shifts = (f"{fit.shift + away * found.frame:+.3g} s" for away in (first, second))
    said = " and ".join("nothing" if "nan" in shift else shift for shift in shifts)
    return (
        f"the halves of the take say {said}, more than {APART:g} frames from {fit.shift:+.3g} s: "
        "the cameras may show different events, overlap too little, or one of them moved"
    )

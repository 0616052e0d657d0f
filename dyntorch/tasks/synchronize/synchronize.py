"""Synchronize two cameras that nobody synchronized."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from numbers import Real
from typing import Any

import torch
from torch import Generator, Tensor

from dyntorch.core.outcome import Notice, select_problem, solve_one_by_one, trim_padding
from dyntorch.geometry.lens import undistort_points
from dyntorch.numerics.arguments import check_options, check_together, on_cpu
from dyntorch.numerics.blocks import one_thread
from dyntorch.numerics.messages import Message
from dyntorch.tasks.synchronize.different_points import different_points
from dyntorch.tasks.synchronize.epipolar import EPIPOLAR
from dyntorch.tasks.synchronize.motion_capture import CAMERA
from dyntorch.tasks.synchronize.projective import projective_points
from dyntorch.tasks.synchronize.result import Shift, ShiftNotice, SynchronizeOptions
from dyntorch.tasks.synchronize.same_points import search_same_points, shift_of
from dyntorch.tasks.synchronize.tracks import Tracks, read_tracks, reject_outliers

CAMERAS = ("auto", "perspective", "affine", "projective")


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
    options: SynchronizeOptions | None = None,
) -> Shift:
    r"""How b's clock runs against a's, from what two static cameras saw move: :math:`t_b = \text{rate}\; t_a + \text{offset}`.

    With corresponding points, the shift at which one fundamental matrix explains all frames:

    .. math:: \min_{s, F} \frac{\sum_{ij} (x_{b,j}(t_i + s)^T F\, x_{a,j}(t_i))^2}{\sum_{ij} |\nabla|^2},

    at all shifts by FFT, then by least squares of the Sampson distance in offset, rate and F together.  With different points, the
    shift at which the two cameras' coordinates share most information.  The result is refused (``ok`` false, with a reason)
    where the motion repeats itself, is too small, or where parts of the take disagree.

    One of both may be motion capture, points in space in any unit, with any axis up: then one camera explains what the other sees,

    .. math:: \min_{s, P} \sum_{ij} |x_{a,j}(t_i) - P X_{b,j}(t_i + s)|^2,

    in the same two steps (:mod:`dyntorch.tasks.synchronize.motion_capture`); different points are combinations of those in space.

    A search: it computes on the CPU wherever its tensors are, and the result returns to their device.

    Args:
        a: ``(frames_a, n, 2)`` px, y down; NaN = missing; of motion capture ``(frames_a, n, 3)``.  Point k of a is point k of b.
        b: ``(frames_b, n, 2)``; without correspondence ``(frames_b, m, 2)``; of motion capture, where a is a camera, with 3
            coordinates.  Both may have batch dimensions in front, ``times``
            and ``weights`` too: takes of different lengths end in frames of NaN; each problem is searched by itself.
        correspondence: whether points correspond.
        fps: frames per second of both, or of each; frame 0 is at 0 s.
        times: instead, ``(frames,)`` seconds of each frame, increasing, for variable frame rates and dropped frames.
        max_shift: how far to search, seconds; None for all shifts with enough overlap.
        calibration: per camera None or ``(K, dist)`` (OpenCV's order), whose distortion is removed.  Without, distortion is
            looked for where the points do not fit, and removed by one parameter per camera, with a note.
        weights: per camera ``(frames, n)``, such as a detector's confidences; 0 = ignore.
        rate: of b's clock, where known; by default 1 unless the takes say otherwise (up to 2 %).
        camera: ``"perspective"``, ``"affine"`` (points about their middle in each frame), or ``"auto"``: perspective unless that
            cannot decide and affine can; these are of corresponding points.  Of different points ``"projective"``: uncalibrated
            perspective cameras, six points or more each of one rigid body that turns (see
            :func:`dyntorch.tasks.synchronize.projective.projective_points`).
        generator: of the subsets that look for wrong points; a fixed one by default.
        options: what is known of the data, and what is paid.

    Returns:
        offset, sigma, rate, confidence, all peaks, and whether it is ok; of a batch tensors ``(*batch, ...)``, and a problem that
            cannot be used is refused alone.

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
    if isinstance(a, Tensor) and isinstance(b, Tensor) and max(a.ndim, b.ndim) > 3:
        return synchronize_batch(
            synchronize, a, b, times=times, weights=weights, correspondence=correspondence, fps=fps, max_shift=max_shift,
            calibration=calibration, rate=rate, camera=camera, generator=generator, options=options,
        )  # fmt: skip
    options = SynchronizeOptions() if options is None else options
    check_options(options, SynchronizeOptions)
    _check(correspondence, fps, times, weights, max_shift, rate, camera)
    first, second, origin = prepare_tracks(a, b, fps=fps, times=times, weights=weights, calibration=calibration, options=options)
    spatial = _spatial((first, second), camera)
    if camera == "projective":
        return projective_points(first, second, max_shift=max_shift, rate=rate, options=options).since(origin)
    if not correspondence:
        return different_points(first, second, max_shift=max_shift, rate=rate, options=options).since(origin)
    if a.shape[1] != b.shape[1]:
        text = (
            "{camera:a} has {a} points and {camera:b} {b}: corresponding points are as many; "
            "give the same ones in the same order, or {arg:correspondence=False}"
        )
        raise ValueError(Message(text, a=a.shape[1], b=b.shape[1]))
    result = search_same_points(
        first,
        second,
        max_shift=max_shift,
        rate=rate,
        camera=camera,
        lenses=calibration is None and not spatial,
        generator=generator,
        options=options,
        model=CAMERA if spatial else EPIPOLAR,
    )
    return shift_of(result).since(origin)


def prepare_tracks(
    a: Tensor,
    b: Tensor,
    *,
    fps: float | tuple[float, float] | None,
    times: tuple[Tensor, Tensor] | None,
    weights: tuple[Tensor | None, Tensor | None] | None,
    calibration: tuple[Any, Any] | None,
    options: SynchronizeOptions,
) -> tuple[Tracks, Tracks, float]:
    """Tracks of checked input, without outliers, and the time that both clocks are counted from: a's first frame."""
    pair: tuple[float | None, float | None] = (None, None)
    if fps is not None:
        pair = (float(fps[0]), float(fps[1])) if isinstance(fps, Sequence) else (float(fps), float(fps))
    given = (None, None) if weights is None else weights
    tracks = [
        read_tracks(name, x, one, None if times is None else times[i], given[i])
        for i, (name, x, one) in enumerate(zip("ab", (a, b), pair, strict=True))
    ]
    for name, one in zip("ab", tracks, strict=True):
        if len(one.times) < options.min_frames:
            text = "{camera:{which}} has {frames} frames, {needed} are needed at least"
            raise ValueError(Message(text, which=name, frames=len(one.times), needed=options.min_frames))
    if calibration is not None:
        tracks = [_undistort(name, one, lens) for name, one, lens in zip("ab", tracks, _pairwise(calibration), strict=True)]
    # both clocks count from a's first frame: timestamps may be of any era, and products of rates with them lose digits
    origin = float(tracks[0].times[0])
    first, second = (reject_outliers(dataclasses.replace(one, times=one.times - origin)) for one in tracks)
    return first, second, origin


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
        raise ValueError(Message("{arg:max_shift} must be a positive number of seconds or None, got {given}", given=max_shift))
    if rate is not None and not 0.1 < rate < 10:
        raise ValueError(f"rate must be about 1 (seconds of b's clock per second of a's), got {rate}; give fps for frame rates")
    if camera not in CAMERAS:
        raise ValueError(f"camera must be one of {', '.join(CAMERAS)}, got {camera!r}")
    if camera in ("perspective", "affine") and not correspondence:
        raise ValueError(f"camera={camera!r} is for corresponding points; leave it out with correspondence=False")
    if camera == "projective" and correspondence:
        raise ValueError("camera='projective' is for different points: give correspondence=False, or camera='perspective'")


def _pairwise(calibration: Any) -> Sequence[Any]:
    if not isinstance(calibration, Sequence) or len(calibration) != 2:
        raise ValueError("calibration must be a pair, of a and of b: each None or (K, dist)")
    return calibration


def _spatial(tracks: Sequence[Tracks], camera: str) -> bool:
    """Whether one of both is of points in space."""
    count = sum(one.x.shape[-1] == 3 for one in tracks)
    if count == 2:
        text = "{camera:a} and {camera:b} both hold points in space (frames, points, 3): one must be a camera (frames, points, 2)"
        raise ValueError(Message(text))
    if count and camera in ("affine", "projective"):
        raise ValueError(f"camera={camera!r} is for two cameras, and one of both holds points in space; leave it out")
    return count == 1


def _undistort(name: str, tracks: Tracks, lens: Any) -> Tracks:
    if tracks.x.shape[-1] == 3:
        if lens is None:
            return tracks
        raise ValueError(Message("calibration of {camera:{which}}: it holds points in space; give None for it", which=name))
    try:
        x = undistort_points(tracks.x, lens)
    except ValueError as problem:
        raise ValueError(Message("calibration of {camera:{which}}: {said}", which=name, said=str(problem))) from problem
    seen = (tracks.weights > 0) & x.isfinite().all(-1)
    return dataclasses.replace(tracks, x=torch.where(seen[..., None], x, 0.0), weights=torch.where(seen, tracks.weights, 0.0))


def synchronize_batch(
    verb: Callable[..., Shift], a: Tensor, b: Tensor, *, times: tuple[Any, Any] | None, weights: tuple[Any, Any] | None, **more: Any
) -> Shift:
    """The shifts of all problems, one after the other: a search shares nothing between takes. a ``(*batch, frames_a, n, 2)``,
    b ``(*batch, frames_b, m, 2)``, times ``(frames,)``, weights ``(*batch, frames, n)``."""
    batch = check_together(a=(a, 3), b=(b, 3))

    def solve(place: int) -> Shift:
        takes = [trim_padding(select_problem(x, place, batch, 3)) for x in (a, b)]
        clocks = None if times is None else _of_problem(times, takes, place, batch, 1)
        trust = None if weights is None else _of_problem(weights, takes, place, batch, 2)
        return verb(*takes, times=clocks, weights=trust, **more)

    def spare(said: str) -> Shift:
        return Shift.unknown("none", (math.nan, math.nan), [Notice(ShiftNotice.UNUSABLE, 0.0, {"said": said})])

    return solve_one_by_one(batch, solve, spare)


def _of_problem(values: tuple[Any, Any], takes: list[Tensor], place: int, batch: Any, own: int) -> tuple[Any, Any]:
    """What belongs to a problem, of the frames that its takes have."""
    parts = [select_problem(value, place, batch, own) for value in values]
    return tuple(None if x is None else x[: len(take)] for x, take in zip(parts, takes, strict=True))  # type: ignore[return-value]

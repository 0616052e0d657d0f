"""Two videos of one event, no tracks: which moment of one is which of the other, from brightness alone."""

from __future__ import annotations

import math
from typing import Any

import torch

from dyntorch import Shift, on_cpu, one_thread
from indexing.brightness.box import Region, boxes, motion
from indexing.brightness.decision import APART, LEAST, Verdict, judge
from indexing.brightness.sampling import Sampled, common_rate, sampled
from indexing.brightness.takes import FEWEST, Take, take

PEAKS = 10  # reported at most
LIVELIEST = 10  # frames in which something moves, at least
FLOOR = 0.35
"""Frames of the grid: standard deviation of an accepted offset.  Measured .24 to .32 RMS on shifts by quarters of a frame and
four pairs of rates: the parabola is hardly better than whole frames (.29)."""


@on_cpu
@one_thread
def brightness_shift(
    a: Any,
    b: Any,
    *,
    fps: tuple[float, float] | None = None,
    times: tuple[Any, Any] | None = None,
    max_shift: float | None = None,
    region: str | Region | None = "motion",
) -> Shift:
    r"""How camera b's clock runs against camera a's, from brightness alone, or why that cannot be told.

    Of the box in which something moves, every frame gives a profile: how much moves up, down and sideways in six bands of rows,

    .. math:: z = W\Bigl(\sqrt{\langle v^- \rangle}, \sqrt{\langle v^+ \rangle}, \sqrt{\langle |u| \rangle}\Bigr),\quad
        (u, v) = -I_t\,\nabla I / (\|\nabla I\| + \epsilon),

    whitened (W) and of norm 1.  A shift scores the mean cosine of the profiles that it pairs.  The best one is believed only if
    both halves of the overlap choose it, the thesis's window kernel chooses it, no other peak comes near, short windows ask for it
    one by one, and it leads b played backwards clearly: takes of similar motion fail there.  Cameras should stand upright and
    still; the more their views differ (90 degrees is worst), the longer a take is needed.

    A search: it computes on the CPU wherever its tensors are, and the result returns to their device.

    Args:
        a: grey video ``(frames, h, w)``, uint8 or float (0..1 or 0..255), array or tensor (colour: ``(frames, h, w, 3)``); or an
            iterable of such chunks, or of pairs (chunk, seconds of its frames) as :func:`indexing.video.read_video` gives them.
            A stream is read once, and its frames are not kept in memory.
        b: the other camera's; sizes and lengths may differ.
        fps: frames per second of a and b, where frames have no times.
        times: seconds of each frame of a and of b.
        max_shift: seconds; offsets beyond are not considered.
        region: ``"motion"``: the box about what moves, found by itself, following a person who crosses the image;
            ``(x0, y0, x1, y1)`` in pixels: about what moves in there, in both videos; None: whole images.

    Returns:
        :class:`dyntorch.Shift` with ``method="brightness"`` and rate 1 (clock rates are not fitted).  Where ``ok`` is false,
        ``reason`` says why; the best candidate and all peaks are there all the same.

    Raises:
        ValueError: fewer than 20 frames, NaN, wrong shapes, no times, or a ``max_shift`` that leaves no overlap.

    Source: thesis, chapter 7; Irani 1999 for the patch equations.

    Example:
        >>> from indexing.actors import Person, stream
        >>> from indexing.actors.textured import film
        >>> clip, _ = stream(["squat", "wave", "bow", "punch"], Person(), rng=1)
        >>> first, second = (film(clip, azimuth=angle, image=(80, 60), rng=int(angle)) for angle in (10.0, 40.0))
        >>> shift = brightness_shift(first[20:], second[:-10], fps=(30.0, 30.0))
        >>> shift.ok, round(shift.frames)
        (True, 20)
    """
    first, second = _takes(a, b, fps, times)
    if max_shift is not None and not (math.isfinite(max_shift) and max_shift >= 0):
        raise ValueError(f"max_shift must be seconds, 0 or more, got {max_shift!r}")
    rate = common_rate(first, second)
    (one, why_a, notes_a), (two, why_b, notes_b) = (_prepared(each, region, rate) for each in (first, second))
    base = two.start - one.start
    span = (1 - len(one.profile), len(two.profile) - 1)
    if max_shift is not None:
        span = (
            max(span[0], math.ceil((-max_shift - base) * rate - 1e-6)),
            min(span[1], math.floor((max_shift - base) * rate + 1e-6)),
        )
    least = max(float(FEWEST), LEAST * min(len(one.profile), len(two.profile)))
    longest = min(len(one.profile), len(two.profile) - span[0]) - max(0, -span[1])
    if span[0] > span[1] or longest < least:
        raise ValueError(
            f"max_shift {max_shift!r}: within it the videos overlap by less than {least:.0f} frames at {rate:.3g} per second; "
            "allow larger shifts or give longer videos"
        )
    verdict = judge(one, two, span, least)
    return _shift((first, second), (one, two), verdict, "; ".join(filter(None, (why_a, why_b))), notes_a + notes_b)


def _takes(a: Any, b: Any, fps: tuple[float, float] | None, times: tuple[Any, Any] | None) -> tuple[Take, Take]:
    for name, pair in (("fps", fps), ("times", times)):
        if pair is not None and not (isinstance(pair, (tuple, list)) and len(pair) == 2):
            raise ValueError(f"{name} must be a pair, one for each video, got {pair!r}")
    rates, stamps = fps or (None, None), times or (None, None)
    return take(a, "a", rates[0], stamps[0]), take(b, "b", rates[1], stamps[1])


def _prepared(source: Take, region: str | Region | None, rate: float) -> tuple[Sampled, str, tuple[str, ...]]:
    """A take on the grid, why it decides nothing (else empty), and what else to know of it."""
    height, width = source.frames.shape[1:]
    found = motion(source.frames, None if region is None else _inside(region, source))
    box, moving = boxes(found, source.fps)
    if region is None:
        whole = torch.tensor([[width / 2, height / 2, max(width, height)]], dtype=torch.float64)
        box, moving = whole.expand(len(source.frames), 3), False
    on_grid, name = sampled(source, box, rate), source.name
    if found.drift.hopeless:
        return on_grid, f"all of {name} changes: its camera moves fast, or the light flickers; stabilize the video first", ()
    if int(found.lively.sum()) < LIVELIEST:
        return on_grid, f"nothing moves in {name}; choose a take with motion", ()
    if found.drift.moves:
        step = float(found.drift.step.norm(dim=1).mean()) / source.scale
        return on_grid, "", (f"{name}: the camera moves ({step:.1f} px per frame); its motion was taken out approximately",)
    return on_grid, "", (f"{name}: motion crosses the image; a moving box follows it",) if moving else ()


def _inside(region: str | Region, source: Take) -> Region | None:
    if isinstance(region, str):
        if region != "motion":
            raise ValueError(f"region must be 'motion', None or (x0, y0, x1, y1) in pixels, got {region!r}")
        return None
    height, width = source.frames.shape[1:]
    values = [float(v) for v in region] if len(region) == 4 else []
    if not values or not (values[0] < values[2] and values[1] < values[3]) or not all(map(math.isfinite, values)):
        raise ValueError(f"region must be (x0, y0, x1, y1) in pixels with x0 < x1 and y0 < y1, got {region!r}")
    x0, y0, x1, y1 = (v * source.scale for v in values)
    if x0 >= width or y0 >= height or x1 <= 0 or y1 <= 0:
        raise ValueError(f"region {region!r} lies outside the image of {source.name}")
    return x0, y0, x1, y1


def _shift(takes: tuple[Take, Take], grids: tuple[Sampled, Sampled], verdict: Verdict, why: str, notes: tuple[str, ...]) -> Shift:
    (one, two), curve, best = grids, verdict.curve, verdict.best
    rate, base = one.rate, two.start - one.start
    found = curve.peaks(APART // 2)[:PEAKS]
    places = torch.tensor([int(curve.lags[k]) + curve.offset(int(curve.lags[k])) for k in found], dtype=torch.float64)
    reason = why or verdict.reason(rate)
    low, high = max(0, -best), min(len(one.profile), len(two.profile) - best)
    spread = max(abs(half - best) for half in verdict.halves) / 2
    return Shift(
        offset=base + (best + curve.offset(best)) / rate,
        sigma=math.hypot(FLOOR, spread) / rate,
        rate=1.0,
        rate_sigma=0.0,
        confidence=0.0 if why else verdict.confidence,
        peaks=torch.stack([base + places / rate, curve.scores[found]], dim=1),
        ok=not reason,
        reason=reason,
        method="brightness",
        fps=(takes[0].fps, takes[1].fps),
        center=one.start + (low + high - 1) / 2 / rate,
        lags=base + curve.lags.double() / rate,
        scores=curve.scores.masked_fill(~curve.scores.isfinite(), torch.nan),
        notes=notes,
    )

"""What synchronize() takes beside its arguments, and what it returns: how one camera's clock runs against another's."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, Self

import torch
from torch import Tensor

from dyntorch.core.outcome import Notice, NoticeCode, Outcome, Status, status_from


@dataclass(frozen=True)
class SynchronizeOptions:
    """What is known of the data, and what is paid, in :func:`dyntorch.synchronize`, :func:`dyntorch.synchronize_cameras` and
    :func:`dyntorch.tasks.breaks`."""

    min_frames: int = 12
    """Frames of each recording at least."""
    min_margin: float = 0.2
    """Risk of a wrong period, for corresponding points: nats by which the best peak must lead, 2.5 times as many for affine
    cameras.  Of exactly periodic gaits 95 of 100 lead by less than .17, right peaks by more than .31 (30 mm of noise)."""
    reject_points: bool = True
    """Whether some points may be others than those of the same number in the other camera, and are looked for and left out."""
    camera_model: Literal["auto", "affine", "affine_moving", "perspective"] = "auto"
    """Kind of both cameras, for different points; ``"auto"`` selects the one whose best lag stands out most."""
    measure: Literal["auto", "rank", "log_determinant", "principal_angles"] = "auto"
    """What two row spaces share, for different points: one measure of the thesis, or ``"auto"``: the log-determinant, beside the
    mutual information of shape and motion.  ``"principal_angles"`` is for motion in a plane: of 24 scenes in space its best lag is
    more than a frame off in 13, the log-determinant's in none."""
    body_measure: Literal["attitude", "rank"] = "attitude"
    """What ranks the lags of ``camera="projective"``: the disagreement about the body's attitude, or the rank of both cameras'
    scaled measurements, which is exact for whole frames and long recordings alone."""
    focal_lengths: tuple[float, ...] = (4.0, 9.0, 25.0)
    """Starting focal lengths of ``camera="projective"``, over the RMS coordinate of the tracks."""
    num_views: int = 20
    """Frames that ``camera="projective"`` starts with, spread over the recording: more take longer."""
    max_jump: float = 2.0
    """Seconds that a clock may jump by where frames were lost or doubled (``breaks``): more take longer."""


# ----------------------------------------------------------------------------------------------------------------------
# What synchronize() returns: how one camera's clock runs against another's, how sure that is, and what else it might be.


class ShiftNotice(NoticeCode):
    """Why two cameras' clocks are not decided, or what to know besides, and how it is said."""

    NO_POINT = "no_point", "no point is seen in {camera:{which}}; check the detections", Status.TOO_FEW
    """A camera shows nothing."""
    STILL = "still", "nothing moves in {camera:{which}}; film some movement", Status.DEGENERATE
    """Nothing moves."""
    NOTHING = (
        "nothing",
        "no shift stands out, or both cameras never show enough points at once; film longer, or raise {arg:max_shift}",
        Status.DEGENERATE,
    )
    """No shift is better than others."""
    EDGE = (
        "edge",
        "the best shift, about {best:+.3g} s, lies at the end of the search or beyond; raise {arg:max_shift}",
        Status.AMBIGUOUS,
    )
    """The best shift lies at the end of the search."""
    BLUNT = (
        "blunt",
        {
            "small": "the motion is too small for its noise: the best shift, {best:+.3g} s, is uncertain by {value:.2g} s or "
            "more; film larger or faster movements",
            "known": "the best shift is only known to {value:.3f} s: film longer, or a larger motion",
            "rough": "the best shift is only known roughly: film longer, or a larger motion",
            "frame": "the best shift is uncertain by {value:.2g} s, frames are {frame:.2g} s apart: film longer, or larger motion",
        },
        Status.AMBIGUOUS,
    )
    """The shift is uncertain by more than a frame."""
    REPEATED = (
        "repeated",
        {
            "rivals": "the motion repeats itself or is too small: {best:+.3g} s fits hardly better than {rivals}; film something "
            "that happens once, or narrow {arg:max_shift}",
            "itself": "the motion repeats itself, and another shift fits as well: film something that does not",
            "others": "other shifts fit about as well (seconds: {rivals}), as where the motion repeats itself: film something "
            "that does not",
            "unclear": "the best shift is not clear of others (seconds: {rivals}): film longer, or a larger motion",
        },
        Status.AMBIGUOUS,
    )
    """Other shifts fit as well."""
    BACKWARDS = (
        "backwards",
        "{camera:b} played backwards fits as well or better ({value:+.2g} nats for forwards): check that no film runs backwards, "
        "and film something that happens once",
        Status.NO_CONSENSUS,
    )
    """One of the films may run backwards."""
    HALVES = (
        "halves",
        "the halves of the take say {halves}, more than {apart:g} frames from {best:+.3g} s: the cameras may show different "
        "events, overlap too little, or one of them moved",
        Status.NO_CONSENSUS,
    )
    """The two halves of the take contradict the whole."""
    SHORT_OVERLAP = (
        "short_overlap",
        "the cameras overlap too little to judge any shift: film longer, or give a larger {arg:max_shift}",
        Status.TOO_FEW,
    )
    """Two cameras have too few frames in common."""
    NOISY = (
        "noisy",
        "the motion is too small against the noise, or the cameras do not show the same event: film a larger motion",
        Status.NO_CONSENSUS,
    )
    """The motion is below the noise."""
    STRAIGHT = (
        "straight",
        "all points move on straight lines at constant velocity, as at any other shift: film a motion that turns or stops",
        Status.DEGENERATE,
    )
    """Motion that looks the same at every shift."""
    FEW_ON_BODY = (
        "few_on_body",
        "{camera:{which}} shows {value:# point|# points} in half of the frames, projective cameras need {needed} on one body; "
        "track more, or longer",
        Status.TOO_FEW,
    )
    """Too few points for projective depths."""
    NO_BODY = (
        "no_body",
        "the points of {camera:{which}} do not move as one rigid body before a fixed perspective camera ({value:.2g} px beside a "
        "noise of {noise:.2g}): leave out those of other bodies, or use {arg:camera='auto'}",
        Status.NO_CONSENSUS,
    )
    """No rigid body explains what a camera sees."""
    FLAT_BODY = (
        "flat_body",
        "the points of {camera:{which}} lie in one plane ({value:.2g} px beside a noise of {noise:.2g}): add points off it",
        Status.DEGENERATE,
    )
    """A plane has no projective depths of its own."""
    NO_TURN = (
        "no_turn",
        "the body turns by {value:.2g} radians before {camera:{which}}, too little to tell its shape: film a larger turn",
        Status.DEGENERATE,
    )
    """A body that does not turn."""
    NO_COMMON_MOTION = (
        "no_common_motion",
        "at no shift do both cameras see one motion (they differ by {value:.2g} times what is known of it): check that both show "
        "points of the same rigid body, raise {arg:max_shift}",
        Status.NO_CONSENSUS,
    )
    """Two bodies that move in different ways."""
    UNUSABLE = "unusable", "{said}", Status.TOO_FEW
    """A problem of a batch that would be refused as misuse by itself."""
    AFFINE = "affine", "affine cameras: the points do not hold enough depth, or are too noisy, for perspective ones"
    """What was fitted are affine cameras."""
    LENS = (
        "lens",
        "lens distortion fitted, lambda = {a:+.3f} and {b:+.3f}: an approximation; give {arg:calibration=((K, dist), (K, dist))}",
    )
    """What was fitted are lenses, too."""
    LEFT_OUT = "left_out", "{value:g} of {points} points never agree with the others and were left out: {which}"
    """Points that are never consistent with the others."""
    FOREIGN = ("foreign", "{value:g} of {points} tracks of {camera:{which}} have no part in the motion and were left out: {tracks}")
    """Tracks that go their own way."""
    MOVED = "moved", "each half of the take fits much better by itself: a camera may have moved"
    """A camera that moved."""


class ClockOutcome(Outcome):
    """What results about clocks share: the data decide, or some notices say why they do not."""

    @property
    def ok(self) -> bool:
        """Whether the data decide; of a batch a bool tensor ``(*batch,)``."""
        decided: Any = self.status == Status.OK
        return decided if self.status.ndim else bool(decided)

    @property
    def notes(self) -> tuple[str, ...]:
        """What a user should know besides the reason."""
        return note_texts(self.notices)

    def check(self) -> Self:
        """Raise where the data do not decide."""
        if self.status.ndim:
            return super().check()
        if not self.ok:
            raise ValueError(f"{self.task}: {self.reason}")
        return self

    def _telling(self, status: Status) -> Sequence[Notice]:
        """The notices that refuse."""
        return refusals(self.notices)


@dataclass(frozen=True, eq=False, repr=False)
class Shift(ClockOutcome):
    """One camera's clock against another's.

    A moment that camera a shows at time :math:`t_a` is shown by camera b at

    .. math:: t_b = \\text{rate}\\; t_a + \\text{offset}.

    Of a batch every attribute has the batch in front, numbers are tensors ``(*batch,)``, filled up with NaN where problems have
    fewer frames, lags or peaks; :meth:`problem` is the result of one.

    Attributes:
        offset: seconds; always the best candidate, whether or not ``ok``.
        sigma: standard deviation of the shift at ``center``, in seconds.
        rate: seconds of b's clock per second of a's clock; 1 where nothing speaks against it.
        rate_sigma: its standard deviation; 0 where the rate was given or not searched.
        confidence: probability in [0, 1] that the offset is right to within a frame, as far as the data can tell.
        peaks: ``(k, 2)`` float64, offset in seconds and score of every local maximum of the curve worth a look, best first.
            Offsets are those at ``center``: :math:`t_b - t_a` there.
        status: OK where the data decide, as ``ok`` says; ``reason`` says why not, in one sentence with what to do.
        notices: that reason, and what a user should know besides (``notes``).
        method: ``"epipolar"``, ``"affine"`` (both: same points), ``"camera"`` (a camera, and the same points in space),
            ``"subspace"``, ``"projective"`` (both: different points), ``"brightness"``.
        fps: frames per second of a and of b, of the timestamps' median where these were given.
        center: a's time in the middle of the overlap: where offset and rate are least correlated.
        lags: ``(L,)`` seconds, at ``center``: the abscissa of ``scores``.
        scores: ``(L,)``, higher is better; NaN where cameras overlap too little to say.
        points: ``(n,)`` bool, which corresponding points take part; false = never consistent with the others (wrong joint).  None
            where points do not correspond.
        fundamental: ``(3, 3)`` of norm 1, :math:`x_b^T F x_a = 0` in the coordinates given (after removal of lens distortion, where
            that was asked for); None where there is none.
        projection: ``(3, 4)`` of norm 1, the camera that shows the points in space, :math:`x \\sim P X`, where one of the takes is
            of motion capture; None where there is none.
    """

    offset: float
    sigma: float
    rate: float
    rate_sigma: float
    confidence: float
    peaks: Tensor
    method: str
    fps: tuple[float, float]
    center: float
    lags: Tensor
    scores: Tensor
    points: Tensor | None = None
    fundamental: Tensor | None = None
    projection: Tensor | None = None

    TASK = "synchronize"

    @staticmethod
    def unknown(method: str, fps: tuple[float, float], notices: Sequence[Notice], points: Tensor | None = None) -> Shift:
        """No shift, and the reasons."""
        none = torch.zeros(0, dtype=torch.float64)
        return Shift(
            0.0, math.inf, 1.0, 0.0, 0.0, none.reshape(0, 2), method, fps, 0.0, none, none, points,
            status=status_from(notices), notices=tuple(notices),
        )  # fmt: skip

    @property
    def frames(self) -> float:
        """The offset in frames of b."""
        return self.offset * self.fps[1]

    def at(self, times: Tensor | float) -> Tensor:
        """Times of b's clock, of the moments at ``times`` of a's clock; of a batch ``(*batch, ...)``."""
        t = torch.as_tensor(times, dtype=torch.float64)
        if self.status.ndim:
            wide = (..., *([None] * t.ndim))
            return t * torch.as_tensor(self.rate)[wide] + torch.as_tensor(self.offset)[wide]
        return t * self.rate + self.offset

    def problem(self, *place: int) -> Shift:
        """The clocks of one problem of a batch, with what was filled up."""
        flat: dict[str, Any] = {one.name: getattr(self, one.name) for one in dataclasses.fields(self)}
        parts: dict[str, Any] = {name: value[place] if isinstance(value, Tensor) else value for name, value in flat.items()}
        numbers = ("offset", "sigma", "rate", "rate_sigma", "confidence", "center")
        parts |= {name: float(parts[name]) for name in numbers}
        parts["fps"] = tuple(float(one[place]) if isinstance(one, Tensor) else one for one in flat["fps"])
        if isinstance(flat["method"], tuple):
            parts["method"] = flat["method"][int(torch.arange(self.status.numel()).reshape(self.status.shape)[place])]
        parts["notices"] = tuple(dataclasses.replace(one, problem=()) for one in self.notices if one.problem == tuple(place))
        return Shift(**parts)

    def inverse(self, times: Tensor | float) -> Tensor:
        """Times of a's clock, of the moments at ``times`` of b's clock; of a batch ``(*batch, ...)``."""
        t = torch.as_tensor(times, dtype=torch.float64)
        if self.status.ndim:
            wide = (..., *([None] * t.ndim))
            return (t - torch.as_tensor(self.offset)[wide]) / torch.as_tensor(self.rate)[wide]
        return (t - self.offset) / self.rate

    def since(self, origin: float) -> Shift:
        """The same clocks, counted from another moment: both said ``origin`` at what was 0."""
        return dataclasses.replace(self, offset=self.offset + (1 - self.rate) * origin, center=self.center + origin)

    def __repr__(self) -> str:
        if self.status.ndim:
            return "\n".join([self.head(), *self.warning_lines()])
        drift = f", rate {1e6 * (self.rate - 1):+.0f} ± {1e6 * self.rate_sigma:.0f} ppm" if self.rate != 1 else ""
        state = "ok" if self.ok else f"refused: {self.reason}"
        lines = [f"Shift({self.offset:+.4f} ± {self.sigma:.4f} s = {self.frames:+.2f} frames{drift}, {self.method}, {state})"]
        lines += [f"  peak {offset:+.3f} s, score {score:.3f}" for offset, score in self.peaks[:3].tolist()]
        lines += [f"  note: {note}" for note in self.notes]
        return "\n".join(lines)


def note_texts(found: Sequence[Notice]) -> tuple[str, ...]:
    """The sentences of the notices that refuse nothing."""
    return tuple(notice.text for notice in found if notice.code.refuses is None)


def refusals(found: Sequence[Notice]) -> tuple[Notice, ...]:
    """The notices that refuse."""
    return tuple(notice for notice in found if notice.code.refuses is not None)


# ----------------------------------------------------------------------------------------------------------------------
# What synchronize_cameras() returns: every camera's clock against the reference camera's, and which pairs say so.


@dataclass(frozen=True)
class Pair:
    """What one pair of cameras contributes."""

    cameras: tuple[int, int]
    """(i, j): the shift is that of j's clock against i's."""
    shift: float
    """Seconds at the middle of the pair's overlap, of the peak that is used, else of the best one."""
    sigma: float
    """Seconds."""
    residual: float
    """Seconds: ``shift`` minus what all clocks together say; NaN where a camera has no clock."""
    peak: int
    """Which of the pair's peaks is used, 0 = its own best; -1 = none."""
    ok: bool
    """Whether the pair decides on its own."""

    @property
    def is_used(self) -> bool:
        """Whether the pair takes part in the result."""
        return self.peak >= 0

    @property
    def outlier(self) -> bool:
        """Whether the pair, sure of itself, is contradicted by the others."""
        return self.ok and self.peak != 0


class ClocksNotice(NoticeCode):
    """Why the clocks of several cameras are not decided, or what to know besides, and how it is said."""

    LOST = (
        "lost",
        "no pair leads from the reference to {lost:cameras}: compare further pairs, or leave these cameras out",
        Status.TOO_FEW,
    )
    """Cameras that no pair ties to the reference."""
    REFUSED = (
        "refused",
        {"pairs": "{cameras:cameras}: too few sure pairs, {refused:pairs} refused ({first})", "pair": "{first}"},
        Status.AMBIGUOUS,
    )
    """Too few pairs decide by themselves."""
    CONTRADICTION = (
        "contradiction",
        "{cameras:cameras}: the pairs {torn:pairs} contradict each other and nothing tells which is wrong; film longer, or add "
        "a camera",
        Status.NO_CONSENSUS,
    )
    """Sure pairs contradict each other."""
    TWO = "two", "two cameras: nothing checks the pair; a third one would"
    """Nothing checks a single pair."""
    ALONE = "alone", "{cameras:cameras}: tied by one pair alone, which nothing checks"
    """Nothing checks the only pair of a camera."""
    OUTLIER = (
        "outlier",
        {
            "unused": "pair {pair:pairs} is sure of itself but contradicts the others by {value:+.3f} s",
            "used": "pair {pair:pairs} is sure of itself but contradicts the others: the others confirm its {peak} at "
            "{value:+.3f} s",
        },
    )
    """A pair that is sure and wrong."""
    CONFIRMED = "confirmed", "pair {pair:pairs} refused on its own; the others confirm its {peak} at {value:+.3f} s"
    """A pair that does not decide, but has a peak that the others confirm."""
    OF_PAIR = "of_pair", "pair {pair:pairs}: {note}"
    """What the comparison of a pair says."""


@dataclass(frozen=True, eq=False, repr=False)
class Clocks(ClockOutcome):
    """All cameras' clocks against the reference camera's.

    The moment that the reference camera shows at time :math:`t` is shown by camera i at

    .. math:: t_i = \\text{rate}_i\\; t + \\text{offset}_i.

    Attributes:
        offsets: ``(cameras,)`` seconds; the best candidates, whether or not ``ok``; NaN where no pair leads to a camera.
        rates: ``(cameras,)`` seconds per second of the reference clock.
        sigmas: ``(cameras,)`` standard deviation of the clocks at ``center``, seconds, as if the pairs' errors were independent;
            infinite where there is no clock.
        rate_sigmas: ``(cameras,)``; 0 where no pair searched the rate.
        confidence: probability in [0, 1] of these offsets against all other readings of the pairs' peaks.
        pairs: one row per pair.
        cycle_error: RMS over triangles of cameras, in seconds, of going round them by the pairs used; NaN without triangles.
        worst_cycle: the cameras of the triangle that closes worst, and by how many seconds; None without triangles.
        outliers: pairs (i, j) that are sure of themselves and wrong.
        status: OK where the data decide, as ``ok`` says; ``reason`` says why not, in one sentence with what to do.
        notices: that reason, and what a user should know besides (``notes``).
        reference: the camera whose clock is t.
        center: time of the reference camera in the middle of the overlaps.
        shifts: what the pairs said.
        breaks: what was mended, where that was asked for; the clocks are those of ``breaks.times``.
    """

    offsets: Tensor
    rates: Tensor
    sigmas: Tensor
    rate_sigmas: Tensor
    confidence: float
    pairs: tuple[Pair, ...]
    cycle_error: float
    worst_cycle: tuple[tuple[int, int, int], float] | None
    outliers: list[tuple[int, int]]
    reference: int
    center: float
    shifts: Mapping[tuple[int, int], Shift]
    breaks: Breaks | None = None

    TASK = "synchronize_cameras"

    def at(self, times: Tensor | float) -> Tensor:
        """Times of all clocks, ``(cameras, ...)``, of the moments at ``times`` of the reference clock."""
        t = torch.as_tensor(times, dtype=torch.float64, device=self.rates.device)
        wide = (slice(None), *([None] * t.ndim))
        return self.rates[wide] * t + self.offsets[wide]

    def inverse(self, camera: int, times: Tensor | float) -> Tensor:
        """Times of the reference clock, of the moments at ``times`` of a camera's clock."""
        t = torch.as_tensor(times, dtype=torch.float64, device=self.rates.device)
        return (t - self.offsets[camera]) / self.rates[camera]

    def __repr__(self) -> str:
        cycle = "" if self.worst_cycle is None else f", cycle error {self.cycle_error:.4f} s"
        lines = [f"Clocks({len(self.offsets)} cameras{cycle}, {'ok' if self.ok else f'refused: {self.reason}'})"]
        for camera, (offset, rate, sigma, rate_sigma) in enumerate(
            zip(self.offsets.tolist(), self.rates.tolist(), self.sigmas.tolist(), self.rate_sigmas.tolist(), strict=True)
        ):
            drift = f", rate {1e6 * (rate - 1):+.0f} ± {1e6 * rate_sigma:.0f} ppm" if abs(rate - 1) > 5e-7 else ""
            own = ", the reference" if camera == self.reference else ""
            lines.append(f"  camera {camera}: {offset:+.4f} ± {sigma:.4f} s{drift}{own}")
        lines += [f"  pair {row}" for row in map(_row, self.pairs)]
        lines += [] if self.breaks is None else [f"  break: {note}" for note in self.breaks.notes]
        return "\n".join([*lines, *(f"  note: {note}" for note in self.notes)])


def _row(pair: Pair) -> str:
    state = "contradicts the others" if pair.outlier else "refused" if not pair.ok else "ok"
    use = "" if pair.peak == 0 else ", not used" if pair.peak < 0 else f", used with its peak {pair.peak + 1}"
    i, j = pair.cameras
    return f"{i}-{j}: {pair.shift:+.4f} ± {pair.sigma:.4f} s, residual {pair.residual:+.4f} s, {state}{use}"


# ----------------------------------------------------------------------------------------------------------------------
# What breaks() and camera_breaks() return: moments at which a camera lost frames, or wrote some twice, without saying so.


class BreakNotice(NoticeCode):
    """What happened to a clock, and how it is said."""

    LOST = (
        "lost_frames",
        {
            "frames": "{lost:# frame|# frames} lost by {camera:{which}} at {at:.2f} s of its clock, or there twice in "
            "{camera:{other}} at {there:.2f} s of its own: of two cameras nothing tells; a third one would",
            "seconds": "{lost:g} s lost by {camera:{which}} at {at:.2f} s of its clock, or there twice in {camera:{other}} at "
            "{there:.2f} s of its own: of two cameras nothing tells; a third one would",
            "frames of one": "{camera:{which}} lost {lost:# frame|# frames} at {at:.2f} s of its clock",
            "seconds of one": "{camera:{which}} lost {lost:g} s at {at:.2f} s of its clock",
        },
    )
    """Frames are missing."""
    TWICE = (
        "frames_twice",
        {
            "frames of one": "{camera:{which}} shows {lost:# frame|# frames} twice at {at:.2f} s of its clock",
            "seconds of one": "{camera:{which}} shows {lost:g} s twice at {at:.2f} s of its clock",
        },
    )
    """Frames are there twice."""
    UNDECIDED = ("undecided", "whether a clock breaks is not decided, as no single shift is sure: {said}", Status.AMBIGUOUS)
    """Not even pieces of the take can be synchronized."""


@dataclass(frozen=True)
class ClockBreak:
    """A moment at which a camera lost frames, or wrote some twice, while the frame numbers of its file went on."""

    candidates: tuple[int, ...]
    """The camera; of two that nothing tells apart, first the one that would have lost frames, then the one that would have them
    twice.  0 and 1 are a and b."""
    moments: tuple[float, ...]
    """Seconds of each candidate's own clock, as its file counts: behind the last frame before the break."""
    sigma: float
    """Standard deviation of the moment, seconds."""
    jump: float
    """Seconds by which the clock of the camera jumps against the others', negative where it lost frames; of two candidates that of
    camera 1's clock against camera 0's (of the later one's against the earlier one's)."""
    jump_sigma: float
    """Its standard deviation."""
    frames: int | None
    """Frames of the first candidate that were lost, or are there twice; None where no whole number fits."""
    evidence: float
    """Nats by which one offset on both sides explains the residuals worse."""
    residuals: tuple[float, float]
    """Robust standard deviation of the distance from epipolar lines, px of the first camera of the pair: with one offset on both
    sides, and with the break."""

    @property
    def camera(self) -> int | None:
        """The camera that broke; None where two may be it."""
        return self.candidates[0] if len(self.candidates) == 1 else None

    @property
    def time(self) -> float:
        """Seconds of the first candidate's own clock."""
        return self.moments[0]

    @property
    def is_doubled(self) -> bool:
        """Whether frames are there twice, as far as is known."""
        return self.camera is not None and self.jump > 0

    def seconds(self, step: float) -> float:
        """How much of the first candidate's time is lost or there twice; whole frames, ``step`` seconds apart, where those fit."""
        return abs(self.jump) if self.frames is None else self.frames * step


@dataclass(frozen=True, eq=False, repr=False)
class Breaks(ClockOutcome):
    """Clocks that broke, and times as if they had not."""

    breaks: tuple[ClockBreak, ...]  # in the order of time; empty where nothing broke
    times: tuple[Tensor, ...]  # ``(frames,)`` seconds per camera: what to give as ``times`` from here on
    clocks: Shift | Clocks  # of two cameras the :class:`Shift` with these times; of several the :class:`Clocks` that were given

    TASK = "breaks"

    def __repr__(self) -> str:
        state = "ok" if self.ok else f"refused: {self.reason}"
        lines = [f"Breaks({len(self.breaks)} in {len(self.times)} cameras, {state})"]
        for one, note in zip(self.breaks, self.notes, strict=False):
            sure = f"{one.evidence:.0f} nats, residual {one.residuals[0]:.2f} -> {one.residuals[1]:.2f} px"
            lines.append(f"  {note} ± {one.sigma:.2f} s ({1e3 * one.jump:+.0f} ± {1e3 * one.jump_sigma:.0f} ms, {sure})")
        return "\n".join(lines)

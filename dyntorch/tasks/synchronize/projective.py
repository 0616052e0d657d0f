"""Synchronization by different points of one rigid body before perspective cameras: the motion that both of them have seen."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from dyntorch.core.outcome import Notice, status_from
from dyntorch.geometry.homogeneous import skew
from dyntorch.geometry.rigid import rotation_exponential
from dyntorch.numerics.blocks import constant
from dyntorch.numerics.lags import lag_covariances, lag_products
from dyntorch.numerics.least_squares import Iterate, LeastSquares, LeastSquaresOptions, Tensors, damped_step, minimize
from dyntorch.tasks.pair.tracks import interpolate
from dyntorch.tasks.synchronize.result import Shift, ShiftNotice, SynchronizeOptions
from dyntorch.tasks.synchronize.rigid_body import MAX_ITERATIONS, MIN_FRAMES, MIN_RELATIVE_NOISE, BodyMotion, body_motion
from dyntorch.tasks.synchronize.subspace import (
    MAX_SIGMA_FRAMES,
    MIN_OVERLAP_SECONDS,
    MIN_OVERLAP_SHARE,
    MIN_PEAK_SEPARATION_SECONDS,
    local_maxima,
)
from dyntorch.tasks.synchronize.tracks import MAX_RATE_DEVIATION, MIN_SECONDS_FOR_RATE, RATE_SIGNIFICANCE_SIGMAS, Tracks, lag_range

# ----------------------------------------------------------------------------------------------------------------------
# One body's attitude in time before two cameras, q_b = x q_a y in quaternions: at all lags by FFT.


@constant
def _products(device: torch.device) -> Tensor:
    """``(4, 4, 4, 4)`` entries :math:`e_k \\cdot (e_i\\, e_l\\, e_j)` of products of quaternions, by i, j, k, l."""
    one = torch.zeros(4, 4, 4, dtype=torch.float64, device=device)  # e_i e_j = one[i, j]
    for i in range(4):
        one[0, i, i] = one[i, 0, i] = 1.0
    for i in range(1, 4):
        one[i, i, 0] = -1.0
        j, k = i % 3 + 1, (i + 1) % 3 + 1
        one[i, j, k], one[j, i, k] = 1.0, -1.0
    return torch.einsum("ilm,mjk->ijkl", one, one)


def quaternions(rotations: Tensor) -> Tensor:
    """Unit quaternions ``(frames, 4)``, the real part first, of ``(frames, 3, 3)``; signs so that neighbours are near."""
    m = rotations
    trace = m.diagonal(dim1=-2, dim2=-1).sum(-1)
    odd = torch.stack([m[:, 2, 1] - m[:, 1, 2], m[:, 0, 2] - m[:, 2, 0], m[:, 1, 0] - m[:, 0, 1]], -1)
    full = torch.zeros(len(m), 4, 4, dtype=m.dtype, device=m.device)
    full[:, 0, 0] = trace
    full[:, 0, 1:] = full[:, 1:, 0] = odd
    full[:, 1:, 1:] = m + m.mT - trace[:, None, None] * torch.eye(3, dtype=m.dtype, device=m.device)
    q = torch.linalg.eigh(full)[1][..., -1]
    turn = torch.where((q[1:] * q[:-1]).sum(-1) < 0, -1.0, 1.0).to(q)
    return q * torch.cat([q.new_ones(1), turn.cumprod(0)])[:, None]


def rotations_of(q: Tensor) -> Tensor:
    """``(..., 3, 3)`` of quaternions ``(..., 4)`` of any length."""
    q = torch.nn.functional.normalize(q, dim=-1)
    turn = 2 * q[..., :1, None] * skew(q[..., 1:]) + 2 * (q[..., 1:, None] * q[..., None, 1:])
    return turn + (q[..., 0].square() - q[..., 1:].square().sum(-1))[..., None, None] * torch.eye(3, dtype=q.dtype, device=q.device)


def attitude_curve(a: Tensor, b: Tensor, wa: Tensor, wb: Tensor, lags: tuple[int, int]) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    r"""How far two cameras disagree about the attitude of a body, at all lags. a ``(Ta, 4)``, b ``(Tb, 4)``, wa ``(Ta,)``, wb
    ``(Tb,)`` -> ``(L,)``."""
    moments = lag_products(a * wa[:, None], b * wb[:, None], lags)  # (L, l, k)
    counts = lag_products(wa[:, None], wb[:, None], lags)[:, 0, 0].round()
    u, s, vt = torch.linalg.svd(torch.einsum("ijkl,slk->sij", _products(a.device), moments))
    return (8 * (1 - s[:, 0] / counts.clamp(min=1))).clamp(min=0), counts, u[..., 0], vt[:, 0]


# ----------------------------------------------------------------------------------------------------------------------
# The shift between frames: the motion before b as that before a, with what is unknown between the cameras and on the body.


@dataclass(frozen=True, eq=False)
class Poses:
    """Poses of a body before one camera in time, and how well they are known."""

    times: Tensor  # ``(frames,)`` seconds
    values: Tensor  # ``(frames, 7)`` quaternion and place, NaN where not known
    covariance: Tensor  # ``(frames, 6, 6)`` of turns about the origin and moves, 0 where not known

    @staticmethod
    def of(motion: BodyMotion, times: Tensor) -> Poses:
        """Of what one camera has seen."""
        noise = max(motion.residual, MIN_RELATIVE_NOISE * motion.scale)
        poses = motion.body.motions[0]
        eye = torch.eye(6, dtype=poses.dtype, device=poses.device)
        known = motion.seen[:, None, None]
        information = torch.where(known, motion.information, eye)
        covariance = torch.where(known, noise**2 * torch.linalg.pinv(information, hermitian=True), 0.0)
        values = torch.full((len(poses), 7), math.nan, dtype=poses.dtype, device=poses.device)
        values[motion.seen] = torch.cat([quaternions(poses[motion.seen, :, :3]), poses[motion.seen, :, 3]], -1)
        return Poses(times, values, covariance)

    def at(self, moments: Tensor) -> tuple[Tensor, Tensor]:
        """Rotations ``(..., 3, 3)`` and places ``(..., 3)`` at any moments ``(...)``, NaN where not known."""
        padded = torch.nn.functional.pad(self.values, (0, 1)).unflatten(-1, (4, 2))
        found = interpolate(padded, self.times, moments.flatten()).flatten(1).unflatten(0, moments.shape)
        return rotations_of(found[..., :4]), found[..., 4:7]

    def spread(self, moments: Tensor) -> Tensor:
        """Covariances ``(..., 6, 6)`` of the nearest frame."""
        after = torch.searchsorted(self.times, moments.contiguous()).clamp(1, len(self.times) - 1)
        nearer = (moments - self.times[after - 1]).abs() < (self.times[after] - moments).abs()
        return self.covariance[torch.where(nearer, after - 1, after)]


@dataclass(frozen=True)
class SharedMotion(LeastSquares):
    r"""Minimize what is left of :math:`R_b(\rho t + o) = X R_a(t) Y` and :math:`T_b(\rho t + o) = \sigma X T_a(t) + c + R_b d`."""

    a: Poses
    b: Poses
    start: Tensor
    """``(b, 2)`` offset and rate: the frames that count are those that overlap there, and the offset stays near."""
    reach: float
    """Seconds."""
    free: Tensor
    """``(15,)`` 0 for what stays as it is."""

    def subset(self, keep: Tensor) -> SharedMotion:
        """Some of the starts."""
        return replace(self, start=self.start[keep])

    def evaluate(self, theta: Tensors) -> Iterate:
        """Twice the negative logarithm of the likelihood per frame; infinite far from the start."""
        error, counted = self.errors(theta)
        cost = error.square().sum((-2, -1)) / counted.sum(-1).clamp(min=1)
        middle = self.a.times.mean()
        away = (theta[0] - self.start)[:, 0] + (theta[0] - self.start)[:, 1] * middle
        sound = (away.abs() <= self.reach) & (counted.sum(-1) > 0) & cost.isfinite()
        return Iterate(theta, torch.where(sound, cost, torch.inf), ())

    def errors(self, theta: Tensors) -> tuple[Tensor, Tensor]:
        """Whitened ``(b, frames, 6)`` and which frames count ``(b, frames)``."""
        error, whiten, counted, *_ = self._raw(theta)
        return (whiten @ error[..., None])[..., 0], counted

    def _raw(self, theta: Tensors) -> tuple[Tensor, ...]:
        (clock, x, y, rest), times = theta, self.a.times
        moments = clock[:, :1] + clock[:, 1:] * times
        turn, place = self.b.at(moments)
        own_turn, own_place = self.a.at(times)
        scale, shift, body = rest[:, :1], rest[:, None, 1:4], rest[:, 4:]
        moved = scale[:, None] * (x[:, None] @ own_place[None, ..., None])[..., 0]
        rotation = x[:, None] @ own_turn @ y[:, None]
        arm = (rotation @ body[:, None, :, None])[..., 0]
        error = torch.cat([_log(turn @ rotation.mT), place - moved - shift - arm], -1)
        begun = self.start[:, :1] + self.start[:, 1:] * times
        inside = (begun - self.reach >= self.b.times[0]) & (begun + self.reach <= self.b.times[-1])
        counted = error.isfinite().all(-1) & inside
        error = torch.where(counted[..., None], error, 0.0)
        upper = torch.cat([x, torch.zeros_like(x)], -1)[:, None].expand(-1, len(times), -1, -1)
        lower = torch.cat(
            [-skew(arm) @ x[:, None], (scale[..., None] * x)[:, None].expand_as(arm[..., None].expand(*arm.shape, 3))], -1
        )
        carry = torch.where(counted[..., None, None], torch.cat([upper, lower], -2), 0.0)
        eye = torch.eye(6, dtype=x.dtype, device=x.device)
        total = self.b.spread(moments) + carry @ self.a.spread(times) @ carry.mT
        total = torch.where(counted[..., None, None], total, eye)
        held = total + 1e-12 * total.diagonal(dim1=-2, dim2=-1).mean(-1)[..., None, None] * eye
        whiten = torch.linalg.solve_triangular(torch.linalg.cholesky_ex(held)[0], eye.expand_as(held), upper=False)
        whiten = torch.where(counted[..., None, None], whiten, 0.0)
        return error, whiten, counted, moments, rotation, moved, arm, own_turn, own_place

    def linear(self, theta: Tensors) -> tuple[Tensor, Tensor]:
        """Whitened errors ``(b, frames, 6)`` and their derivatives ``(b, frames, 6, 15)``."""
        error, whiten, counted, moments, rotation, moved, arm, own_turn, own_place = self._raw(theta)
        x, eye = theta[1][:, None], torch.eye(3, dtype=error.dtype, device=error.device).expand(*arm.shape, 3)
        near = 1e-3 * (self.b.times[1] - self.b.times[0])
        (after, there), (before, here) = self.b.at(moments + near), self.b.at(moments - near)
        speed = torch.cat([_log(after @ before.mT), there - here], -1) / (2 * near)
        body = (x @ own_turn).nan_to_num()
        zero = torch.zeros_like(eye)
        columns = [
            speed[..., None],
            (speed * self.a.times[:, None])[..., None],
            torch.cat([-eye, skew(moved + arm)], -2),
            torch.cat([-body, skew(arm) @ body], -2),
            torch.cat([torch.zeros_like(arm), -(x @ own_place[None, ..., None])[..., 0]], -1)[..., None],
            torch.cat([zero, -eye], -2),
            torch.cat([zero, -rotation], -2),
        ]
        slope = torch.where(counted[..., None, None], torch.cat(columns, -1).nan_to_num(), 0.0)
        return (whiten @ error[..., None])[..., 0], whiten @ slope

    def step(self, at: Iterate, damping: Tensor) -> Tensors:
        """Of the fifteen parameters."""
        error, slope = self.linear(at.theta)
        tall = slope.flatten(1, 2)
        gradient = (tall.mT @ error.flatten(1)[..., None])[..., 0]
        return (damped_step(gradient, tall.mT @ tall, damping, self.free, ridge=1e-15),)

    def retract(self, theta: Tensors, step: Tensors) -> Tensors:
        """Clocks moved, turns turned."""
        clock, x, y, rest = theta
        move = -step[0]
        return (
            clock + move[:, :2],
            rotation_exponential(move[:, 2:5]) @ x,
            rotation_exponential(move[:, 5:8]) @ y,
            rest + move[:, 8:],
        )


def _log(rotation: Tensor) -> Tensor:
    """Axis times angle ``(..., 3)`` of rotations."""
    odd = torch.stack(
        [
            rotation[..., 2, 1] - rotation[..., 1, 2],
            rotation[..., 0, 2] - rotation[..., 2, 0],
            rotation[..., 1, 0] - rotation[..., 0, 1],
        ],
        -1,
    )
    sine = odd.norm(dim=-1) / 2
    angle = torch.atan2(sine, (rotation.diagonal(dim1=-2, dim2=-1).sum(-1) - 1) / 2)
    return odd / 2 * torch.where(sine > 1e-12, angle / sine.clamp(min=1e-300), 1.0)[..., None]


def linear_start(problem: SharedMotion, x: Tensor, y: Tensor) -> Tensors:
    """The parameters of least squares for given turns ``(b, 3, 3)``: scale and places are linear, all frames alike."""
    clock, times = problem.start, problem.a.times
    turn, place = problem.b.at(clock[:, :1] + clock[:, 1:] * times)
    own_turn, own_place = problem.a.at(times)
    del own_turn
    eye = torch.eye(3, dtype=place.dtype, device=place.device).expand(*place.shape, 3)
    rows = torch.cat([(x[:, None] @ own_place[None, ..., None]), eye, turn], -1)
    known = rows.isfinite().all(-1).all(-1) & place.isfinite().all(-1)
    rows = torch.where(known[..., None, None], rows, 0.0).flatten(1, 2)
    seen = torch.where(known[..., None], place, 0.0).flatten(1)[..., None]
    rest = torch.linalg.lstsq(rows, seen, driver="gelsd").solution[..., 0]
    return clock, x, y, rest


def common_motion(first: Poses, second: Poses) -> tuple[tuple[Tensor, Tensor, Tensor], float]:
    """What turns a's motion to b's at the same moments: X, Y ``(3, 3)``, scale and places ``(7,)``; and what is left in sigmas."""
    attitudes = [torch.where(poses.values.isfinite(), poses.values, 0.0)[:, :4] for poses in (first, second)]
    known = [poses.values.isfinite().all(-1).double() for poses in (first, second)]
    _, _, x, y = attitude_curve(attitudes[0], attitudes[1], known[0], known[1], (0, 0))
    start = x.new_tensor([[0.0, 1.0]])
    free = x.new_ones(15)
    free[:2] = 0.0
    problem = SharedMotion(first, second, start, 0.0, free)
    theta = linear_start(problem, rotations_of(x), rotations_of(y))
    found = minimize(problem, problem.evaluate(theta), LeastSquaresOptions(iterations=MAX_ITERATIONS, tolerance=1e-9))
    return (found.theta[1][0], found.theta[2][0], found.theta[3][0]), float((found.cost[0] / 6).sqrt())


# ----------------------------------------------------------------------------------------------------------------------
# The rank test of chapter 7 on scaled measurements: all rows of both cameras lie in the span of the motion.


def rank_curve(a: Tensor, b: Tensor, wa: Tensor, wb: Tensor, lags: tuple[int, int]) -> tuple[Tensor, Tensor]:
    r"""What of the motions before two cameras is beyond one space of 13 dimensions, at all lags. a ``(Ta, 3, 4)``, b
    ``(Tb, 3, 4)``, wa ``(Ta,)``, wb ``(Tb,)`` -> ``(L,)``."""
    rows = []
    for poses, w in ((a, wa), (b, wb)):
        known = w[:, None] > 0
        x = torch.where(known, poses.flatten(1), 0.0)
        x = torch.where(known, x - x.sum(0) / w.sum().clamp(min=1), 0.0)
        rows.append(x / x.square().sum(0).clamp(min=1e-300).sqrt())
    aa, bb, ab, counts = lag_covariances(rows[0], rows[1], lags, (wa, wb))
    # each camera by its own spread in the overlap: what is large in one frame of coordinates is no evidence
    aa, ab = _normalize_rows(aa, ab)
    bb, ba = _normalize_rows(bb, ab.mT)
    both = torch.cat([torch.cat([aa, ba.mT], -1), torch.cat([ba, bb], -1)], -2)
    values = torch.linalg.eigvalsh(both).clamp(min=0)
    return values[:, : values.shape[1] - 12].sum(-1) / values.sum(-1).clamp(min=1e-300), counts


def _normalize_rows(own: Tensor, cross: Tensor) -> tuple[Tensor, Tensor]:
    size = own.diagonal(dim1=-2, dim2=-1).clamp(min=1e-300).rsqrt()
    return size[..., None] * own * size[..., None, :], size[..., None] * cross


# ----------------------------------------------------------------------------------------------------------------------
# The whole: two bodies, all lags, a descent from the best of them, and whether to believe it.


MEASURES = ("attitude", "rank")


def projective_points(a: Tracks, b: Tracks, *, max_shift: float | None, rate: float | None, options: SynchronizeOptions) -> Shift:
    """The shift of uncalibrated perspective cameras that see different points of one rigid body."""
    if options.body_measure not in MEASURES:
        raise ValueError(f"options.body_measure must be {' or '.join(MEASURES)}, got {options.body_measure!r}")
    motions = [body_motion(name, tracks, options) for name, tracks in (("a", a), ("b", b))]
    wrong = [motion for motion in motions if isinstance(motion, Notice)]
    if wrong:
        return Shift.unknown("projective", (1 / a.step, 1 / b.step), wrong)
    poses = [
        Poses.of(motion, tracks.times) for motion, tracks in zip(motions, (a, b), strict=True) if isinstance(motion, BodyMotion)
    ]
    return match_motions(poses[0], poses[1], a, b, max_shift=max_shift, rate=rate, options=options)


def match_motions(
    first: Poses, second: Poses, a: Tracks, b: Tracks, *, max_shift: float | None, rate: float | None, options: SynchronizeOptions
) -> Shift:
    """The shift at which two motions are those of one body."""
    curve = _curve(first, second, a, b, rate or 1.0, max_shift, options)
    top = curve.maxima()
    if not top:
        return Shift.unknown("projective", (1 / a.step, 1 / b.step), [Notice(ShiftNotice.SHORT_OVERLAP)])
    problem, theta = _starts(first, second, curve, top)
    found = minimize(problem, problem.evaluate(theta), LeastSquaresOptions(iterations=MAX_ITERATIONS, tolerance=1e-9))
    misfits = (found.cost / 6).sqrt()
    if not bool(misfits.isfinite().any()):
        return Shift.unknown("projective", (1 / a.step, 1 / b.step), [Notice(ShiftNotice.SHORT_OVERLAP)])
    best = misfits.argmin()
    alone = replace(problem.subset(best[None]), start=found.theta[0][best][None])
    theta = tuple(part[best][None] for part in found.theta)
    if rate is None and a.times[-1] - a.times[0] > MIN_SECONDS_FOR_RATE:
        theta, alone = _with_rate(alone, theta)
    return _summarize(alone, theta, problem.start, found.theta[0], misfits, curve, a, b)


NUM_PEAKS = 5  # Lags from which a descent starts.


@dataclass(frozen=True, eq=False)
class _Curve:
    """Misfits of both motions ``(L,)`` at ``lags (L,)`` seconds of b's clock at time 0 of a's, and the turns there."""

    offsets: Tensor
    squares: Tensor
    counts: Tensor
    judged: Tensor
    turns: tuple[Tensor, Tensor]
    rate: float
    step: float

    @property
    def scores(self) -> Tensor:
        """Negative logarithms of the misfit, NaN where the overlap is too short."""
        return torch.where(self.judged, -0.5 * self.squares.clamp(min=1e-16).log(), torch.nan)

    def maxima(self) -> list[int]:
        """Local maxima, the best first, none near a better one."""
        return local_maxima(self.scores.nan_to_num(nan=-math.inf), MIN_PEAK_SEPARATION_SECONDS / self.step)[:NUM_PEAKS]


def _curve(
    first: Poses, second: Poses, a: Tracks, b: Tracks, rate: float, max_shift: float | None, options: SynchronizeOptions
) -> _Curve:
    step = max(a.step, b.step)
    rows, weights = [], []
    for poses, tracks, own in ((first, a, step), (second, b, step * rate)):
        turn, place = poses.at(tracks.every(own))
        known = turn.isfinite().all(-1).all(-1) & place.isfinite().all(-1)
        held = torch.cat([turn, place[..., None]], -1)
        # a frame that is not known repeats the last one: its weight is 0, and neighbours stay near
        index = torch.where(known, torch.arange(len(known), device=known.device), -1).cummax(0).values
        rows.append(held[torch.where(index < 0, known.int().argmax(), index)])
        weights.append(known.double())
    start = float(b.times[0]) / rate - float(a.times[0])
    lags = lag_range((len(rows[0]), len(rows[1])), start, step, rate, max_shift, at_least_one=True)
    spins = [quaternions(part[..., :3].nan_to_num()) for part in rows]
    squares, counts, x, y = attitude_curve(spins[0], spins[1], weights[0], weights[1], lags)
    if options.body_measure == "rank":
        squares, counts = rank_curve(rows[0], rows[1], weights[0], weights[1], lags)
    least = max(MIN_OVERLAP_SHARE * min(float(w.sum()) for w in weights), MIN_OVERLAP_SECONDS / step)
    offsets = (start + step * torch.arange(lags[0], lags[1] + 1, dtype=torch.float64, device=counts.device)) * rate
    return _Curve(offsets, squares, counts, counts >= max(least, MIN_FRAMES), (x, y), rate, step)


def _starts(first: Poses, second: Poses, curve: _Curve, top: list[int]) -> tuple[SharedMotion, Tensors]:
    """A descent from each of these lags."""
    offsets = curve.offsets[top]
    start = torch.stack([offsets, torch.full_like(offsets, curve.rate)], -1)
    free = torch.ones(15, dtype=offsets.dtype, device=offsets.device)
    free[1] = 0.0
    problem = SharedMotion(first, second, start, 2 * curve.step, free)
    return problem, linear_start(problem, *(rotations_of(turn[top]) for turn in curve.turns))


def _with_rate(problem: SharedMotion, theta: Tensors) -> tuple[Tensors, SharedMotion]:
    """With a rate of its own where that is significant."""
    free = replace(problem, free=torch.ones_like(problem.free), reach=problem.reach)
    found = minimize(free, free.evaluate(theta), LeastSquaresOptions(iterations=MAX_ITERATIONS, tolerance=1e-9))
    sigma = float(_covariance(free, found.theta)[1, 1].sqrt())
    away = abs(float(found.theta[0][0, 1]) - 1)
    return (found.theta, free) if MAX_RATE_DEVIATION > away > RATE_SIGNIFICANCE_SIGMAS * sigma else (theta, problem)


def _covariance(problem: SharedMotion, theta: Tensors) -> Tensor:
    """``(15, 15)`` of the parameters of one problem, 0 for those that stay."""
    error, slope = problem.linear(theta)
    tall, free = slope[0].flatten(0, 1), problem.free
    misfit = float(error.square().sum() / (error[0].abs().sum(-1) > 0).sum().clamp(min=1) / 6)
    matrix = tall.mT @ tall * free * free[:, None]
    return max(misfit, 1.0) * torch.linalg.pinv(matrix, hermitian=True)


MAX_MISFIT = 1.8  # Difference of two motions, sigmas, beyond which they are not one: .9 to 1.2 at the right shift.
EVEN_MARGIN = 0.1  # That logarithm at which right and wrong are as likely; set by hand.
MARGIN_SCALE = 0.03  # The same per unit of the log odds.
MIN_SIGMA_SECONDS = 1e-6  # Error of a shift at least: poses between frames are interpolated.


def _summarize(
    problem: SharedMotion, theta: Tensors, starts: Tensor, clocks: Tensor, misfits: Tensor, curve: _Curve, a: Tracks, b: Tracks
) -> Shift:
    offset, rate = theta[0][0].tolist()
    first = max(float(a.times[0]), (float(b.times[0]) - offset) / rate)
    last = min(float(a.times[-1]), (float(b.times[-1]) - offset) / rate)
    center = (first + last) / 2
    at = torch.tensor([1.0, center], dtype=torch.float64, device=starts.device)
    clock = _covariance(problem, theta)[:2, :2]
    sigma = max(float(at @ clock @ at) ** 0.5, MIN_SIGMA_SECONDS)
    order = misfits.argsort(stable=True)
    order = order[misfits[order].isfinite()]
    shifts = clocks[order] @ at - center
    best = float(misfits[order[0]])
    # rounding is no evidence: exact motions agree to the last digits
    margin = math.log(max(float(misfits[order[1]]), 1.0) / max(best, 1.0)) if len(order) > 1 else math.inf
    refused = _refusal(best, margin, sigma, shifts, curve, max(a.step, b.step))
    limits = () if refused is None else (refused,)
    likely = 1 / (1 + math.exp(-min((margin - EVEN_MARGIN) / MARGIN_SCALE, 700.0)))
    return Shift(
        offset=offset,
        sigma=sigma,
        rate=rate,
        rate_sigma=float(clock[1, 1].clamp(min=0).sqrt()) if rate != curve.rate else 0.0,
        confidence=likely * min(1.0, (MAX_MISFIT / max(best, 1e-9)) ** 2),
        peaks=torch.stack([shifts, -misfits[order].clamp(min=1e-16).log()], -1),
        method="projective",
        fps=(1 / a.step, 1 / b.step),
        center=center,
        lags=curve.offsets + (curve.rate - 1) * center,
        scores=curve.scores,
        status=status_from(limits),
        notices=limits,
    )


MIN_MARGIN = 0.2  # Logarithm of the misfit at the next lag over the best one, for a decision.


def _refusal(best: float, margin: float, sigma: float, shifts: Tensor, curve: _Curve, frame: float) -> Notice | None:
    """Why the data do not decide; None where they do."""
    if best > MAX_MISFIT:
        return Notice(ShiftNotice.NO_COMMON_MOTION, best)
    if margin < MIN_MARGIN:
        rivals = ", ".join(f"{shift:+.3g} s" for shift in shifts[1:4].tolist())
        return Notice(ShiftNotice.REPEATED, margin, {"case": "rivals", "best": float(shifts[0]), "rivals": rivals})
    if sigma > MAX_SIGMA_FRAMES * frame:
        return Notice(ShiftNotice.BLUNT, sigma, {"case": "frame", "frame": frame})
    inner = curve.offsets[curve.judged]
    if not float(inner[0]) - 1e-9 <= float(shifts[0]) <= float(inner[-1]) + 1e-9:
        return Notice(ShiftNotice.EDGE, float(shifts[0]), {"best": float(shifts[0])})
    return None

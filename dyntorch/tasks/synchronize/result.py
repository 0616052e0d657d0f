"""What synchronize() returns: how one camera's clock runs against another's, how sure that is, and what else it might be."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field

import torch
from torch import Tensor


@dataclass(frozen=True, eq=False, repr=False)
class Shift:
    """One camera's clock against another's.

    A moment that camera a shows at time :math:`t_a` is shown by camera b at

    .. math:: t_b = \\text{rate}\\; t_a + \\text{offset}.

    Attributes:
        offset: seconds; always the best candidate, whether or not ``ok``.
        sigma: standard deviation of the shift at ``center``, in seconds.
        rate: seconds of b's clock per second of a's clock; 1 where nothing speaks against it.
        rate_sigma: its standard deviation; 0 where the rate was given or not searched.
        confidence: probability in [0, 1] that the offset is right to within a frame, as far as the data can tell.
        peaks: ``(k, 2)`` float64, offset in seconds and score of every local maximum of the curve worth a look, best first.
            Offsets are those at ``center``: :math:`t_b - t_a` there.
        ok: whether the data decide.
        reason: why not, in one sentence with what to do; empty where ``ok``.
        method: ``"epipolar"``, ``"affine"`` (both: same points), ``"subspace"`` (different points), ``"brightness"``.
        fps: frames per second of a and of b, of the timestamps' median where these were given.
        center: a's time in the middle of the overlap: where offset and rate are least correlated.
        lags: ``(L,)`` seconds, at ``center``: the abscissa of ``scores``.
        scores: ``(L,)``, higher is better; NaN where cameras overlap too little to say.
        points: ``(n,)`` bool, which corresponding points take part; false = never consistent with the others (wrong joint).  None
            where points do not correspond.
        fundamental: ``(3, 3)`` of norm 1, :math:`x_b^T F x_a = 0` in the coordinates given (after removal of lens distortion, where
            that was asked for); None where there is none.
        notes: what a user should know besides.
    """

    offset: float
    sigma: float
    rate: float
    rate_sigma: float
    confidence: float
    peaks: Tensor
    ok: bool
    reason: str
    method: str
    fps: tuple[float, float]
    center: float
    lags: Tensor
    scores: Tensor
    points: Tensor | None = None
    fundamental: Tensor | None = None
    notes: tuple[str, ...] = field(default=())

    @property
    def frames(self) -> float:
        """The offset in frames of b."""
        return self.offset * self.fps[1]

    def at(self, times: Tensor | float) -> Tensor:
        """Times of b's clock, of the moments at ``times`` of a's clock."""
        return torch.as_tensor(times, dtype=torch.float64) * self.rate + self.offset

    def inverse(self, times: Tensor | float) -> Tensor:
        """Times of a's clock, of the moments at ``times`` of b's clock."""
        return (torch.as_tensor(times, dtype=torch.float64) - self.offset) / self.rate

    def since(self, origin: float) -> Shift:
        """The same clocks, counted from another moment: both said ``origin`` at what was 0."""
        return dataclasses.replace(self, offset=self.offset + (1 - self.rate) * origin, center=self.center + origin)

    def check(self) -> Shift:
        """Raise where the data do not decide.

        Raises:
            ValueError: the reason.
        """
        if not self.ok:
            raise ValueError(f"synchronize: {self.reason}")
        return self

    def __repr__(self) -> str:
        drift = f", rate {1e6 * (self.rate - 1):+.0f} ± {1e6 * self.rate_sigma:.0f} ppm" if self.rate != 1 else ""
        state = "ok" if self.ok else f"refused: {self.reason}"
        lines = [f"Shift({self.offset:+.4f} ± {self.sigma:.4f} s = {self.frames:+.2f} frames{drift}, {self.method}, {state})"]
        lines += [f"  peak {offset:+.3f} s, score {score:.3f}" for offset, score in self.peaks[:3].tolist()]
        lines += [f"  note: {note}" for note in self.notes]
        return "\n".join(lines)


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
    def used(self) -> bool:
        """Whether the pair takes part in the result."""
        return self.peak >= 0

    @property
    def outlier(self) -> bool:
        """Whether the pair, sure of itself, is contradicted by the others."""
        return self.ok and self.peak != 0


@dataclass(frozen=True, eq=False, repr=False)
class Clocks:
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
        ok: whether the data decide.
        reason: why not, in one sentence with what to do; empty where ``ok``.
        reference: the camera whose clock is t.
        center: time of the reference camera in the middle of the overlaps.
        shifts: what the pairs said.
        notes: what a user should know besides.
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
    ok: bool
    reason: str
    reference: int
    center: float
    shifts: Mapping[tuple[int, int], Shift]
    notes: tuple[str, ...] = field(default=())

    def at(self, times: Tensor | float) -> Tensor:
        """Times of all clocks, ``(cameras, ...)``, of the moments at ``times`` of the reference clock."""
        t = torch.as_tensor(times, dtype=torch.float64)
        wide = (slice(None), *([None] * t.ndim))
        return self.rates[wide] * t + self.offsets[wide]

    def inverse(self, camera: int, times: Tensor | float) -> Tensor:
        """Times of the reference clock, of the moments at ``times`` of a camera's clock."""
        return (torch.as_tensor(times, dtype=torch.float64) - self.offsets[camera]) / self.rates[camera]

    def check(self) -> Clocks:
        """Raise where the data do not decide.

        Raises:
            ValueError: the reason.
        """
        if not self.ok:
            raise ValueError(f"synchronize_cameras: {self.reason}")
        return self

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
        return "\n".join([*lines, *(f"  note: {note}" for note in self.notes)])


def _row(pair: Pair) -> str:
    state = "contradicts the others" if pair.outlier else "refused" if not pair.ok else "ok"
    use = "" if pair.peak == 0 else ", not used" if pair.peak < 0 else f", used with its peak {pair.peak + 1}"
    i, j = pair.cameras
    return f"{i}-{j}: {pair.shift:+.4f} ± {pair.sigma:.4f} s, residual {pair.residual:+.4f} s, {state}{use}"

"""What synchronize_cameras() returns: every camera's clock against the reference camera's, and which pairs say so."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import torch
from torch import Tensor

from dyntorch.tasks.shift import Shift


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

"""What synchronize() returns: how one camera's clock runs against another's, how sure that is, and what else it might be."""

from __future__ import annotations

import dataclasses
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

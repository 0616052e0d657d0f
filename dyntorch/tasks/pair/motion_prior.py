r"""What tracks of one camera say of themselves: how much of every frequency and every combination of points is motion, not noise.

The coordinates of n points over T frames, about their means, are taken as Gaussian with the covariance :math:`S_f\,B + \sigma^2 I`
at each frequency f of the discrete cosine transform: one spectrum S for all points, one covariance B of the points for all
frequencies.  Nothing is assumed on the frequencies but what the tracks show.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor


def cosines(x: Tensor) -> Tensor:
    """Orthonormal discrete cosine transform (type II) over the first dimension, without its constant."""
    frames = len(x)
    spectrum = torch.fft.rfft(torch.cat([x, x.flip(0)]), dim=0)[1:frames]
    turn = torch.exp(-0.5j * torch.pi / frames * torch.arange(1, frames, dtype=x.dtype, device=x.device))
    return (spectrum * turn[(..., *([None] * (x.ndim - 1)))]).real / (2 * frames) ** 0.5


def inverse_cosines(z: Tensor) -> Tensor:
    """The inverse of :func:`cosines`: ``(T - 1, ...)`` to ``(T, ...)`` of mean 0."""
    frames = len(z) + 1
    turn = torch.exp(0.5j * torch.pi / frames * torch.arange(1, frames, dtype=z.dtype, device=z.device))
    half = z * turn[(..., *([None] * (z.ndim - 1)))] * (2 * frames) ** 0.5
    zero = torch.zeros_like(half[:1])
    return torch.fft.irfft(torch.cat([zero, half, zero]), n=2 * frames, dim=0)[:frames]


MIN_POWER_RATIO = 1e-6  # of the motion of any frequency over the noise, and of the noise in gaps over the motion


def motion_spectrum(z: Tensor, variance: float) -> Tensor:
    """Power of the motion at each frequency, mean over points and coordinates, smoothed over an eighth of an octave,
    ``(T - 1,)``."""
    power = z.square().mean((1, 2))
    total = torch.cat([power.new_zeros(1), power.cumsum(0)])
    place = torch.arange(len(power), device=z.device)
    low, high = (place - 1 - place // 8).clamp(min=0), (place + 2 + place // 8).clamp(max=len(power))
    smooth = (total[high] - total[low]) / (high - low)
    return (smooth - variance).clamp(min=MIN_POWER_RATIO * variance + 1e-300)


EM_ITERATIONS = 20  # for the covariance of the points


@dataclass(frozen=True)
class Prior:
    """The motion of the points of one camera."""

    spectrum: Tensor  # ``(T - 1,)`` S
    energies: Tensor  # ``(n,)`` eigenvalues of B
    modes: Tensor  # ``(n, n)`` its eigenvectors, as columns
    variance: float  # of the noise

    @staticmethod
    def of(z: Tensor, variance: float) -> Prior:
        """Of ``(T - 1, n, 2)`` of :func:`cosines`, by expectation-maximization."""
        spectrum = motion_spectrum(z, variance)
        n = z.shape[1]
        found = Prior(spectrum, z.new_ones(n), torch.eye(n, dtype=z.dtype, device=z.device), variance)
        root = spectrum.sqrt()[:, None, None]
        for _ in range(EM_ITERATIONS):
            hidden = (found.denoised(z) / root).mT.flatten(0, 1)
            left = (found.energies * (1 - found.shares())).sum(0) * 2
            moment = (hidden.mT @ hidden + found.modes @ torch.diag(left) @ found.modes.mT) / (2 * len(z))
            energies, modes = torch.linalg.eigh(moment)
            found = Prior(spectrum, energies.clamp(min=1e-12), modes, variance)
        return found

    def shares(self) -> Tensor:
        """``(T - 1, n)``: how much of each frequency of each mode is motion."""
        power = self.spectrum[:, None] * self.energies
        return power / (power + self.variance)

    def denoised(self, z: Tensor) -> Tensor:
        """The expected motion given ``(T - 1, n, 2)`` (Wiener)."""
        shares = self.shares()[..., None]
        return self.modes @ ((self.modes.mT @ z) * shares)


FILL_ITERATIONS = 30  # each leaves about the share of the missing positions of the error


def fill_gaps(x: Tensor, variance: float) -> Tensor:
    r"""Tracks ``(T, n, 2)`` whose gaps (NaN) hold what the other points expect, and what these miss around the gap."""
    seen = x.isfinite().all(-1)
    if bool(seen.all()):
        return x
    found = torch.where(seen[..., None], x, _interpolate_linearly(x, seen))
    weights = seen.to(x)
    mean = found.mean(0)
    spread = (found - mean).mT.flatten(0, 1)
    B = spread.mT @ spread / len(spread)
    level = max(variance, MIN_POWER_RATIO * float(B.diagonal().mean()))
    for _ in range(FILL_ITERATIONS):
        shared = weights[:, :, None] * B * weights[:, None]
        # points that are missing have an equation of their own
        precision = torch.linalg.inv_ex(shared + torch.diag_embed(torch.where(seen, level, 1.0)))[0] * weights[:, None]
        offset = weights[..., None] * (found - mean)
        gain = B @ (weights[:, :, None] * precision)
        expected = gain @ offset
        found = torch.where(seen[..., None], x, expected + mean)
        left = torch.where(seen[..., None], offset, expected).mT.flatten(0, 1)
        unsure = (B - gain @ (weights[:, :, None] * B)) * (1 - weights)[:, :, None] * (1 - weights)[:, None]
        B, mean = (left.mT @ left + 2 * unsure.sum(0)) / len(left), found.mean(0)
    # what the others would have missed, had they to say where the point is
    beside = (precision @ offset) / torch.where(seen, precision.diagonal(dim1=-2, dim2=-1), 1.0)[..., None]
    return torch.where(seen[..., None], x, found + _interpolate_linearly(torch.where(seen[..., None], beside, torch.nan), seen))


def _interpolate_linearly(x: Tensor, seen: Tensor) -> Tensor:
    """Gaps bridged by straight lines, the ends by the nearest position; 0 for points never seen."""
    frames = len(x)
    place = torch.arange(frames, device=x.device)[:, None].expand_as(seen)
    before = torch.where(seen, place, -1).cummax(0).values
    after = torch.where(seen, place, frames).flip(0).cummin(0).values.flip(0)
    low, high = torch.where(before < 0, after, before), torch.where(after >= frames, before, after)
    known = x.nan_to_num()

    def at(index: Tensor) -> Tensor:
        return known.gather(0, index.clamp(0, frames - 1)[..., None].expand_as(x))

    share = ((place - low) / (high - low).clamp(min=1)).clamp(0, 1)[..., None]
    return at(low) * (1 - share) + at(high) * share

"""How tall a person is, and how far apart the highest and the lowest joint of a standing one are: what gives a rig its metres."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray

from dyntorch.numerics import Message
from indexing.calibrate.options import Share, StatureOptions
from indexing.joints import canonical
from indexing.opening import listed

if TYPE_CHECKING:
    from dyntorch import Calibration

FloatArray = NDArray[np.float64]
UNITS = (("millimetres", 1000.0), ("centimetres", 100.0), ("inches", 39.37), ("feet", 3.2808))


@dataclass(frozen=True)
class Stature:
    """The extent of the joints of somebody who stands upright."""

    extent: float  # metres from the lowest joint to the highest
    sigma: float  # metres, one standard deviation: people's proportions differ, and so do detectors
    tops: tuple[str, ...]  # the names of those joints, left and right
    bottoms: tuple[str, ...]
    height: float  # metres, of the person
    measured: str = ""  # how the extent was found in a rig, in a few words

    @property
    def note(self) -> str:
        """What the scale rests on, in a sentence."""
        share = 100 * self.extent / self.height
        return (
            f"scale from a standing height of {self.height:g} m: {self.bottoms[0]} to {self.tops[0]} is {share:.1f} % of it "
            f"(Drillis and Contini), ± {100 * self.sigma / self.extent:.1f} % from person to person"
            + (f"; {self.measured}" if self.measured else "")
        )


def check_height(height: float, options: StatureOptions = StatureOptions()) -> float:
    """A standing height in metres."""
    value = float(height)
    if math.isfinite(value) and options.smallest <= value <= options.tallest:
        return value
    means = Message(
        "{arg:height} must be that of a standing person in metres, {low:g} to {high:g}, got {value:g}",
        low=options.smallest, high=options.tallest, value=value,
    )  # fmt: skip
    for unit, per_metre in UNITS:
        metres = value / per_metre
        usual = 1.0 <= metres <= options.tallest
        if usual:
            text = "{means}; in {unit}? give {metres:.3g}"
            raise ValueError(Message(text, means=means, unit=unit, metres=metres))
    raise ValueError(means)


def standing(names: Sequence[str], height: float, options: StatureOptions = StatureOptions()) -> Stature:
    r"""The extent of a body's joints when it stands upright, from its height :math:`H`."""
    height = check_height(height, options)
    known: list[tuple[Share, str]] = [(share, name) for name in names if (share := _share(name, options)) is not None]
    levels = sorted(known, key=lambda one: (one[0].height, one[1]))
    if len(levels) < 2 or levels[-1][0].height - levels[0][0].height < options.least:
        text = (
            "{arg:height}: the joints ({names}) do not reach from the head or the shoulders to the feet, so the height says "
            "nothing of them; give {arg:length} between two of them instead"
        )
        raise ValueError(Message(text, names=listed(names)))
    low, high = levels[0][0], levels[-1][0]
    tops, bottoms = (tuple(name for share, name in levels if share.height == edge.height) for edge in (high, low))
    return Stature((high.height - low.height) * height, height * math.hypot(low.spread, high.spread), tops, bottoms, height)


def _share(name: str, options: StatureOptions) -> Share | None:
    plain = re.sub(r"^(left|right)", "", canonical(name))
    return options.shares.get(plain)


# ----------------------------------------------------------------------------------------------------------------------
# From the extent of a standing body to metres of a rig.


def in_metres(
    found: Calibration, stature: Stature, names: Sequence[str], options: StatureOptions = StatureOptions()
) -> tuple[Calibration, Stature | None]:
    r"""A rig in metres, by the tallest of its people."""
    points = np.asarray(found.points.numpy(), dtype=np.float64)
    people = points.reshape(len(points), -1, len(names), 3)
    sizes = [size for who in range(people.shape[1]) if (size := _size(people[:, who], stature, names, options)) is not None]
    if not sizes:
        return found, None
    factor, sigma, how = min(sizes)
    return scaled(found, factor), replace(stature, sigma=sigma, measured=how)


def _size(body: FloatArray, stature: Stature, names: Sequence[str], options: StatureOptions) -> tuple[float, float, str] | None:
    """Metres per unit of a body ``(frames, n, 3)``, the standard deviation of the extent, and how that was found."""
    tops, bottoms = ([i for i, name in enumerate(names) if name in wanted] for wanted in (stature.tops, stature.bottoms))
    head, feet = body[:, tops, 2], body[:, bottoms, 2]
    both = np.isfinite(head).any(axis=1) & np.isfinite(feet).all(axis=1)
    extent = np.full(len(body), np.nan)
    extent[both] = np.nanmean(head[both], axis=1) - feet[both].min(axis=1)
    chain = _chain(body, names)
    if chain is None:
        known = extent[both]
        usable = len(known) >= options.frames and float(np.quantile(known, options.extent)) > 0
        how = "measured where head and feet are farthest apart"
        return (stature.extent / float(np.quantile(known, options.extent)), stature.sigma, how) if usable else None
    length, above = chain
    straight = both & (np.nan_to_num(above) >= options.straight * length)
    if straight.sum() >= options.frames:
        how = f"measured in {straight.sum()} frames in which the body is straight"
        return stature.extent / float(np.median(extent[straight])), stature.sigma, how
    share = options.shares["shoulder"].height - options.shares["ankle"].height
    how = "by trunk and legs, as nobody stands straight"
    return share * stature.height / length, options.chain_sigma * stature.extent, how


def _chain(body: FloatArray, names: Sequence[str]) -> tuple[float, FloatArray] | None:
    """The length of trunk and leg, and ``(frames,)`` how far the shoulders are above an ankle; None where these are not known."""
    index = {canonical(name): i for i, name in enumerate(names)}
    wanted = [f"{side}{part}" for part in ("shoulder", "hip", "knee", "ankle") for side in ("left", "right")]
    if not all(name in index for name in wanted):
        return None
    shoulders, hips, knees, ankles = (
        np.stack([body[:, index[f"{side}{part}"]] for side in ("left", "right")], axis=1)
        for part in ("shoulder", "hip", "knee", "ankle")
    )

    def usual(a: FloatArray, b: FloatArray) -> float:
        far = np.linalg.norm(a - b, axis=-1)
        return float(np.nanmedian(far)) if np.isfinite(far).any() else math.nan

    length = usual(shoulders.mean(axis=1), hips.mean(axis=1)) + usual(hips, knees) + usual(knees, ankles)
    known = np.isfinite(ankles[..., 2]).any(axis=1)
    above = np.full(len(body), np.nan)
    above[known] = shoulders[known].mean(axis=1)[:, 2] - np.nanmin(ankles[known, :, 2], axis=1)
    return (length, above) if math.isfinite(length) and length > 0 else None


def scaled(found: Calibration, factor: float) -> Calibration:
    """A calibration of another unit, which is metres from now on."""
    change = torch.eye(found.covariance.shape[-1], dtype=torch.float64)
    change[3:6, 3:6] *= factor
    notices = tuple(notice for notice in found.notices if notice.code.value != "unknown_scale")
    return replace(
        found, t=factor * found.t, points=factor * found.points, sigmas=factor * found.sigmas, metric=True,
        covariance=change @ found.covariance @ change.mT, notices=notices,
    )  # fmt: skip

"""How tall a person is, and how far apart the highest and the lowest joint of a standing one are: what gives a rig its metres."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray

from dyntorch.numerics import Message
from indexing.joints import canonical
from indexing.opening import listing

if TYPE_CHECKING:
    from dyntorch import Calibration

FloatArray = NDArray[np.float64]
UNITS = (("millimetres", 1000.0), ("centimetres", 100.0), ("inches", 39.37), ("feet", 3.2808))

MIN_HEIGHT_METRES = 0.4  # nobody who is filmed standing is smaller
MAX_HEIGHT_METRES = 2.6  # nobody was ever taller than 2.72
MIN_EXTENT = 0.6  # body heights between the highest and the lowest joint
MIN_STRAIGHTNESS = 0.97  # shoulders above the ankle over trunk and leg: 14 degrees off the vertical
MIN_STANDING_FRAMES = 10  # in which somebody stands straight, or is seen from head to foot
CHAIN_SIGMA = 0.03  # of the height by trunk and legs alone: 2.7 % off for Pose2Sim's balancing person
EXTENT_QUANTILE = 0.75  # of the distance from feet to head, where trunk and legs are unknown


@dataclass(frozen=True)
class Share:
    """How high a joint of somebody who stands upright is, in body heights."""

    height: float
    spread: float


SHARES: Mapping[str, Share] = {
    "headtop": Share(1.0, 0.008),
    "eye": Share(0.936, 0.008),
    "eyeinner": Share(0.936, 0.008),
    "eyeouter": Share(0.936, 0.008),
    "ear": Share(0.930, 0.010),
    "headcenter": Share(0.930, 0.015),
    "nose": Share(0.915, 0.010),
    "mouth": Share(0.890, 0.010),
    "upperneck": Share(0.870, 0.015),
    "neck": Share(0.818, 0.012),
    "neckbase": Share(0.830, 0.015),
    "thorax": Share(0.818, 0.015),
    "shouldercenter": Share(0.818, 0.015),
    "spineshoulder": Share(0.818, 0.015),
    "shoulder": Share(0.818, 0.012),
    "ankle": Share(0.039, 0.006),
    "foot": Share(0.020, 0.010),
    "heel": Share(0.015, 0.008),
    "bigtoe": Share(0.010, 0.006),
    "smalltoe": Share(0.010, 0.006),
    "footindex": Share(0.010, 0.008),
}
"""Levels of eye, chin, shoulder, ankle and top of the head: Drillis and Contini (1966), as in D. A. Winter, Biomechanics and Motor
Control of Human Movement, figure 4.1.  Ear, nose, mouth, heel and toes lie between these by the proportions of the face and
the foot; the spread of a level between adults is about 0.6 % of the height, the rest is what detectors are off."""


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


def check_height(height: float) -> float:
    """A standing height in metres."""
    value = float(height)
    if math.isfinite(value) and MIN_HEIGHT_METRES <= value <= MAX_HEIGHT_METRES:
        return value
    means = Message(
        "{arg:height} must be that of a standing person in metres, {low:g} to {high:g}, got {value:g}",
        low=MIN_HEIGHT_METRES, high=MAX_HEIGHT_METRES, value=value,
    )  # fmt: skip
    for unit, per_metre in UNITS:
        metres = value / per_metre
        usual = 1.0 <= metres <= MAX_HEIGHT_METRES
        if usual:
            text = "{means}; in {unit}? give {metres:.3g}"
            raise ValueError(Message(text, means=means, unit=unit, metres=metres))
    raise ValueError(means)


def standing_extent(names: Sequence[str], height: float) -> Stature:
    r"""The extent of a body's joints when it stands upright, from its height :math:`H`."""
    height = check_height(height)
    known: list[tuple[Share, str]] = [(share, name) for name in names if (share := _height_share(name)) is not None]
    levels = sorted(known, key=lambda one: (one[0].height, one[1]))
    if len(levels) < 2 or levels[-1][0].height - levels[0][0].height < MIN_EXTENT:
        text = (
            "{arg:height}: the joints ({names}) do not reach from the head or the shoulders to the feet, so the height says "
            "nothing of them; give {arg:length} between two of them instead"
        )
        raise ValueError(Message(text, names=listing(names)))
    low, high = levels[0][0], levels[-1][0]
    tops, bottoms = (tuple(name for share, name in levels if share.height == edge.height) for edge in (high, low))
    return Stature((high.height - low.height) * height, height * math.hypot(low.spread, high.spread), tops, bottoms, height)


def _height_share(name: str) -> Share | None:
    plain = re.sub(r"^(left|right)", "", canonical(name))
    return SHARES.get(plain)


# ----------------------------------------------------------------------------------------------------------------------
# From the extent of a standing body to metres of a rig.


def scale_to_metres(calibration: Calibration, stature: Stature, names: Sequence[str]) -> tuple[Calibration, Stature | None]:
    r"""A rig in metres, by the tallest of its people."""
    points = np.asarray(calibration.points.numpy(), dtype=np.float64)
    people = points.reshape(len(points), -1, len(names), 3)
    sizes = [size for who in range(people.shape[1]) if (size := _metres_per_unit(people[:, who], stature, names)) is not None]
    if not sizes:
        return calibration, None
    factor, sigma, how = min(sizes)
    return scale_calibration(calibration, factor), replace(stature, sigma=sigma, measured=how)


def _metres_per_unit(body: FloatArray, stature: Stature, names: Sequence[str]) -> tuple[float, float, str] | None:
    """Metres per unit of a body ``(frames, n, 3)``, the standard deviation of the extent, and how that was found."""
    tops, bottoms = ([i for i, name in enumerate(names) if name in wanted] for wanted in (stature.tops, stature.bottoms))
    head, feet = body[:, tops, 2], body[:, bottoms, 2]
    both = np.isfinite(head).any(axis=1) & np.isfinite(feet).all(axis=1)
    extent = np.full(len(body), np.nan)
    extent[both] = np.nanmean(head[both], axis=1) - feet[both].min(axis=1)
    chain = _trunk_and_leg(body, names)
    if chain is None:
        known = extent[both]
        usable = len(known) >= MIN_STANDING_FRAMES and float(np.quantile(known, EXTENT_QUANTILE)) > 0
        how = "measured where head and feet are farthest apart"
        return (stature.extent / float(np.quantile(known, EXTENT_QUANTILE)), stature.sigma, how) if usable else None
    length, above = chain
    straight = both & (np.nan_to_num(above) >= MIN_STRAIGHTNESS * length)
    if straight.sum() >= MIN_STANDING_FRAMES:
        how = f"measured in {straight.sum()} frames in which the body is straight"
        return stature.extent / float(np.median(extent[straight])), stature.sigma, how
    share = SHARES["shoulder"].height - SHARES["ankle"].height
    how = "by trunk and legs, as nobody stands straight"
    return share * stature.height / length, CHAIN_SIGMA * stature.extent, how


def _trunk_and_leg(body: FloatArray, names: Sequence[str]) -> tuple[float, FloatArray] | None:
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


def scale_calibration(calibration: Calibration, factor: float) -> Calibration:
    """A calibration of another unit, which is metres from now on."""
    change = torch.eye(calibration.covariance.shape[-1], dtype=torch.float64)
    change[3:6, 3:6] *= factor
    notices = tuple(notice for notice in calibration.notices if notice.code.value != "unknown_scale")
    return replace(
        calibration, t=factor * calibration.t, points=factor * calibration.points, sigmas=factor * calibration.sigmas, metric=True,
        covariance=change @ calibration.covariance @ change.mT, notices=notices,
    )  # fmt: skip

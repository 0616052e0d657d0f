"""What is known beforehand: lenses (focal lengths, a calibration file, what a phone wrote), clocks, and how tall a person is."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from dyntorch import Clocks
from dyntorch.numerics import Message
from indexing.calibrate.camera_views import Size
from indexing.joints import canonical
from indexing.opening import error, listing, parse_json, read_text
from indexing.sync.calibration import Lens, named_lenses
from indexing.sync.recordings import Take
from indexing.video.reading import av

if TYPE_CHECKING:
    from dyntorch import Calibration

DIAGONAL = math.hypot(36.0, 24.0)
PHOTOS = (".jpg", ".jpeg", ".tif", ".tiff")
FOCAL_35 = 41989  # the EXIF tag FocalLengthIn35mmFilm


@dataclass(frozen=True, eq=False)
class KnownLenses:
    """What is held of the lenses."""

    focals: tuple[float, ...] | None = None  # pixels, of each camera; None = they are found
    one_lens: bool = False  # all cameras have the same focal length
    lenses: tuple[Lens, ...] | None = None  # matrix and distortions of each camera, which are held; None = not given
    source: str = "found from the movement"  # in a few words, where the focal lengths come from
    notes: tuple[str, ...] = ()  # what to say about it

    @property
    def calibration(self) -> list[tuple[Tensor, Tensor | None]] | None:
        """Matrix and distortion of each camera, as :func:`dyntorch.calibrate` takes them; None where they are not known."""
        if self.lenses is None:
            return None
        return [(lens.matrix.double(), lens.distortions.double() if len(lens.distortions) else None) for lens in self.lenses]


def known_lenses(
    takes: Sequence[Take],
    sizes: Sequence[Size],
    *,
    focal: float | Sequence[float] | None = None,
    one_lens: bool = False,
    calibration: Any = None,
    exif: bool = False,
) -> KnownLenses:
    """What is known of the lenses of some cameras."""
    there = {"focal": focal is not None, "one_lens": one_lens, "calibration": calibration is not None, "exif": exif}
    given = [name for name, said in there.items() if said]
    if len(given) > 1:
        text = f"{{arg:{given[0]}}} and {{arg:{given[1]}}} both say what the focal lengths are; give one of them"
        raise ValueError(Message(text))
    if focal is not None:
        focals = _focals(focal, len(takes))
        return KnownLenses(focals, source="given, and held", notes=_focal_notes(takes, focals, sizes))
    if calibration is not None:
        return _from_file(takes, sizes, calibration)
    if exif:
        return _from_exif(takes, sizes)
    return KnownLenses(one_lens=one_lens, source="found from the movement, one for all" if one_lens else KnownLenses.source)


def _focals(focal: float | Sequence[float], cameras: int) -> tuple[float, ...]:
    values = [float(focal)] if isinstance(focal, (int, float)) else [float(one) for one in focal]
    bad = [value for value in values if not (math.isfinite(value) and value > 0)]
    if bad or not values:
        raise ValueError(Message("{arg:focal} must be positive, in pixels, got {value:g}", value=bad[0] if bad else math.nan))
    if len(values) not in (1, cameras):
        text = "{arg:focal} gives {many} focal lengths for {cameras} cameras; give one, or one per camera"
        raise ValueError(Message(text, many=len(values), cameras=cameras))
    return tuple(values * (cameras if len(values) == 1 else 1))


def _focal_notes(takes: Sequence[Take], focals: Sequence[float], sizes: Sequence[Size]) -> tuple[str, ...]:
    """On focal lengths that no camera has: millimetres, or those of another size of the picture."""
    odd = [
        f"{take.name} ({f:g} px for pictures of {size[0]}x{size[1]}: a view of {_field_of_view(f, size):.0f} degrees)"
        for take, f, size in zip(takes, focals, sizes, strict=True)
        if not 8 <= _field_of_view(f, size) <= 130
    ]
    return (f"focal lengths are unusual, are they in pixels of these pictures? {', '.join(odd)}",) if odd else ()


def _field_of_view(focal: float, size: Size) -> float:
    """Degrees from corner to corner."""
    return math.degrees(2 * math.atan2(math.hypot(*size) / 2, focal))


def _from_file(takes: Sequence[Take], sizes: Sequence[Size], calibration: Any) -> KnownLenses:
    if not isinstance(calibration, (str, Path)):
        text = "{arg:calibration} must be the path of a calibration file, got {kind}"
        raise ValueError(Message(text, kind=type(calibration).__name__))
    lenses, notes = named_lenses(calibration, [take.name for take in takes])
    fish = [lens.name for lens in lenses if lens.fisheye]
    if fish:
        raise error(calibration, f"[{fish[0]}] has a fisheye lens, which is not modelled", "undistort the keypoints first")
    other = [
        f"{lens.name} ({lens.size[0]:g}x{lens.size[1]:g}, its pictures {size[0]}x{size[1]})"
        for lens, size in zip(lenses, sizes, strict=True)
        if lens.size is not None and max(abs(a - b) for a, b in zip(lens.size, size, strict=True)) > 0.01 * max(size)
    ]
    if other:
        remedy = "calibrate in the mode in which you film, or give the right size"
        raise error(calibration, f"was made with other pictures: {', '.join(other)}", remedy)
    focals = tuple(float((lens.matrix[0, 0] * lens.matrix[1, 1]).sqrt()) for lens in lenses)
    return KnownLenses(focals, lenses=tuple(lenses), source=f"given by {Path(calibration).name}, and held", notes=notes)


# ----------------------------------------------------------------------------------------------------------------------
# What phones write into their videos and photos.


def _from_exif(takes: Sequence[Take], sizes: Sequence[Size]) -> KnownLenses:
    focals_35 = [focal_35(take) for take in takes]
    lacking = [take.name for take, one in zip(takes, focals_35, strict=True) if one is None]
    if lacking:
        text = (
            "{names}: no 35 mm equivalent is written in its video, nor in a photo beside its keypoints; "
            "leave {arg:exif} out, or give {arg:focal}"
        )
        raise ValueError(Message(text, names=listing(lacking)))
    known = [one for one in focals_35 if one is not None]
    focals = tuple(mm * math.hypot(*size) / DIAGONAL for (mm, _), size in zip(known, sizes, strict=True))
    written = "; ".join(
        f"{take.name} {mm:g} mm ({where}): {f:.0f} px" for take, (mm, where), f in zip(takes, known, focals, strict=True)
    )
    note = f"35 mm equivalents as written, and held: {written}; stabilized videos show up to a tenth less than photos"
    return KnownLenses(focals, source="35 mm equivalent, and held", notes=(note,))


def focal_35(take: Take) -> tuple[float, str] | None:
    """Millimetres of the 35 mm equivalent that a camera wrote, and where; None where it did not."""
    if take.path is None:
        return None
    if take.video is not None:
        return _video_focal_35(take.path)
    beside = take.path if take.path.is_dir() else take.path.parent
    photos = [file for file in sorted(beside.iterdir()) if file.suffix.lower() in PHOTOS and file.is_file()]
    own = photos if take.path.is_dir() else [file for file in photos if file.stem == take.path.stem]
    return next((found for photo in own if (found := _photo_focal_35(photo)) is not None), None)


def _video_focal_35(path: Path) -> tuple[float, str] | None:
    with av().open(str(path)) as container:
        tags: dict[str, str] = dict(container.metadata)
        for stream in container.streams.video:
            tags |= dict(stream.metadata)
    for name, value in tags.items():
        number = re.match(r"\s*(\d+(\.\d+)?)", str(value))
        if number and re.search(r"35 ?mm", name.lower()) and float(number[1]) > 0:
            return float(number[1]), f"{name} of {path.name}"
    return None


def _photo_focal_35(path: Path) -> tuple[float, str] | None:
    from PIL import Image

    try:
        with Image.open(path) as photo:
            value = photo.getexif().get_ifd(0x8769).get(FOCAL_35)
    except (OSError, ValueError):
        return None
    return (float(value), path.name) if isinstance(value, (int, float)) and value > 0 else None


KNOWN = "known"
REMEDY = "give the sync.json of dyntorch sync, or the word known for recordings that are synchronized"


def given_clocks(value: Any, names: Sequence[str]) -> Tensor | None:
    """``(cameras, 2)`` offset in seconds and rate of each camera's clock against the first one's; None where nothing is given."""
    if value is None:
        return None
    if isinstance(value, str) and value == KNOWN:
        return torch.tensor([[0.0, 1.0]], dtype=torch.float64).repeat(len(names), 1)
    if isinstance(value, (str, Path)):
        return _clocks_from_sync(Path(value).expanduser(), names)
    if isinstance(value, Clocks):
        return _relative_to_first(torch.stack([value.offsets, value.rates], dim=1).double(), len(names))
    numbers = torch.as_tensor(value, dtype=torch.float64)
    if numbers.ndim == 1:
        numbers = torch.stack([numbers, torch.ones_like(numbers)], dim=1)
    return _relative_to_first(numbers, len(names))


def _relative_to_first(clocks: Tensor, cameras: int) -> Tensor:
    """Clocks against that of the first camera: :math:`t_i = r_i (t_0 - o_0) / r_0 + o_i`."""
    if clocks.shape != (cameras, 2) or not bool(torch.isfinite(clocks).all()) or not bool((clocks[:, 1] > 0).all()):
        text = "{arg:clocks} must be offset and rate of {cameras} cameras, finite and rates positive, got shape {shape}"
        raise ValueError(Message(text, cameras=cameras, shape=tuple(clocks.shape)))
    rates = clocks[:, 1] / clocks[0, 1]
    return torch.stack([clocks[:, 0] - rates * clocks[0, 0], rates], dim=1)


def _clocks_from_sync(path: Path, names: Sequence[str]) -> Tensor:
    """What ``dyntorch sync`` wrote."""
    content = parse_json(path, read_text(path, REMEDY), REMEDY)
    cameras = content.get("cameras") if isinstance(content, dict) else None
    if not isinstance(cameras, list) or not all(isinstance(one, dict) and isinstance(one.get("name"), str) for one in cameras):
        raise error(path, "has no list of cameras with names", REMEDY)
    if not content.get("ok"):
        raise error(path, "the recordings did not decide on these clocks", "leave it out, or synchronize them in another way")
    known = {one["name"]: one for one in cameras}
    lacking = [name for name in names if name not in known]
    if lacking:
        raise error(path, f"has no clock of {listing(lacking)} (it has {listing(known)})", "synchronize the same recordings")
    rows = []
    for name in names:
        offset, rate = known[name].get("offset"), known[name].get("rate")
        numbers = all(isinstance(x, (int, float)) and math.isfinite(x) for x in (offset, rate))
        if not numbers or rate <= 0:
            raise error(path, f"{name}: offset and rate are no numbers", REMEDY)
        rows.append([float(offset), float(rate)])
    return _relative_to_first(torch.tensor(rows, dtype=torch.float64), len(names))


# ----------------------------------------------------------------------------------------------------------------------
# How tall a person is: what gives a rig its metres.


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
        if 1.0 <= metres <= MAX_HEIGHT_METRES:
            text = "{means}; in {unit}? give {metres:.3g}"
            raise ValueError(Message(text, means=means, unit=unit, metres=metres))
    raise ValueError(means)


def standing_extent(names: Sequence[str], height: float) -> Stature:
    r"""The extent of a body's joints when it stands upright, from its height :math:`H`."""
    height = check_height(height)
    shares = [(SHARES.get(re.sub(r"^(left|right)", "", canonical(name))), name) for name in names]
    levels = sorted(((share, name) for share, name in shares if share is not None), key=lambda level: (level[0].height, level[1]))
    if len(levels) < 2 or levels[-1][0].height - levels[0][0].height < MIN_EXTENT:
        text = (
            "{arg:height}: the joints ({names}) do not reach from the head or the shoulders to the feet, so the height says "
            "nothing of them; give {arg:length} between two of them instead"
        )
        raise ValueError(Message(text, names=listing(names)))
    low, high = levels[0][0], levels[-1][0]
    tops, bottoms = (tuple(name for share, name in levels if share.height == edge.height) for edge in (high, low))
    return Stature((high.height - low.height) * height, height * math.hypot(low.spread, high.spread), tops, bottoms, height)


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

    def median_distance(a: FloatArray, b: FloatArray) -> float:
        far = np.linalg.norm(a - b, axis=-1)
        return float(np.nanmedian(far)) if np.isfinite(far).any() else math.nan

    trunk = median_distance(shoulders.mean(axis=1), hips.mean(axis=1))
    length = trunk + median_distance(hips, knees) + median_distance(knees, ankles)
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

"""What is known of the cameras beforehand: lenses (focal lengths, a calibration file, what a phone wrote) and clocks."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from dyntorch import Clocks
from dyntorch.numerics import Message
from indexing.calibrate.camera_views import Size
from indexing.opening import error, listing, parse_json, read_text
from indexing.sync.calibration import Lens, named_lenses
from indexing.sync.recordings import Take

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
    def given(self) -> list[tuple[Tensor, Tensor | None]] | None:
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
    given = [
        name
        for name, there in (
            ("focal", focal is not None),
            ("one_lens", one_lens),
            ("calibration", calibration is not None),
            ("exif", exif),
        )
        if there
    ]
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
    names = [take.name for take in takes]
    path = calibration if isinstance(calibration, (str, Path)) else None
    if path is None:
        raise ValueError(
            Message("{arg:calibration} must be the path of a calibration file, got {kind}", kind=type(calibration).__name__)
        )
    lenses, notes = named_lenses(path, names)
    fish = [lens.name for lens in lenses if lens.fisheye]
    if fish:
        raise error(path, f"[{fish[0]}] has a fisheye lens, which is not modelled", "undistort the keypoints first")
    other = [
        f"{lens.name} ({lens.size[0]:g}x{lens.size[1]:g}, its pictures {size[0]}x{size[1]})"
        for lens, size in zip(lenses, sizes, strict=True)
        if lens.size is not None and max(abs(a - b) for a, b in zip(lens.size, size, strict=True)) > 0.01 * max(size)
    ]
    if other:
        raise error(
            path,
            f"was made with other pictures: {', '.join(other)}",
            "calibrate in the mode in which you film, or give the right size",
        )
    focals = tuple(float((lens.matrix[0, 0] * lens.matrix[1, 1]).sqrt()) for lens in lenses)
    return KnownLenses(focals, lenses=tuple(lenses), source=f"given by {Path(path).name}, and held", notes=notes)


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
    from indexing.video.reading import av

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

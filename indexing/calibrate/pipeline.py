"""The verb: from whatever there is of the cameras' recordings to a rig, step by step."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

import dyntorch
from dyntorch import CalibrateOptions, Calibration, Clocks
from dyntorch.numerics import Message, as_python
from indexing.calibrate.camera_views import (
    Joints,
    Size,
    View,
    check_cameras,
    check_overlap,
    make_view,
    select_common_joints,
    to_pixels,
)
from indexing.calibrate.left_right import SideExchange, correct_sides
from indexing.calibrate.people import Association, associate
from indexing.calibrate.priors import KnownLenses, given_clocks, known_lenses, scale_to_metres, standing_extent
from indexing.calibrate.rig import CameraRig
from indexing.clip import Clip
from indexing.joints import canonical
from indexing.opening import listing
from indexing.sync.recordings import Take, find_cameras, take_of

Progress = Callable[[str], None]
NO_STATURE = Message("{arg:height} says nothing: nobody is seen from head to foot, so the scale stays unknown; give {arg:length}")
ONE_PERSON = Message("who is who is not decided; {arg:person='largest'} uses the largest person of each frame instead")
ASSUMED_RATE = "30 frames per second assumed for {names}; {arg:fps=} says otherwise"

MAX_LENGTH_METRES = 100.0  # between two joints: nothing filmed whole is larger, and millimetres are


@dataclass(frozen=True)
class RigPriors:
    """What somebody knows of a rig besides the recordings; see :func:`calibrate`."""

    focal: float | Sequence[float] | None = None
    one_lens: bool = False
    calibration: str | Path | None = None
    exif: bool = False
    clocks: Any = None
    rate: bool = True
    max_shift: float | None = None
    height: float | None = None
    lengths: Mapping[tuple[str, str], float] | None = None

    @property
    def named_lengths(self) -> dict[tuple[str, str], float]:
        """The lengths, if there are any."""
        return dict(self.lengths or {})


def calibrate(
    cameras: Sequence[Any] | str | Path,
    *,
    fps: float | Sequence[float] | None = None,
    sizes: Size | Sequence[Size] | None = None,
    focal: float | Sequence[float] | None = None,
    one_lens: bool = False,
    calibration: str | Path | None = None,
    exif: bool = False,
    height: float | None = None,
    lengths: Mapping[tuple[str, str], float] | None = None,
    clocks: Any = None,
    rate: bool = True,
    max_shift: float | None = None,
    person: str = "everyone",
    people: int = 4,
    options: CalibrateOptions | None = None,
    **reading: Any,
) -> CameraRig:
    r"""Cameras from the people in view: where each stands, its focal length, its clock, and the movement in space.

    Joint k of a person, at :math:`X_k(t)` in space, has in camera i, whose clock says :math:`t_i = r_i t + o_i`, the image

    .. math:: x_{ik}(t_i) \sim K_i\,\mathrm{distort}(R_i X_k(t) + t_i),

    and all of this is found from the keypoints alone: pairs of cameras give clocks and epipolar geometry, these the focal
    lengths and rotations, and one adjustment of cameras, lenses, clocks and points has the last word (:func:`dyntorch.calibrate`).

    Args:
        cameras: of two to eight cameras what each recorded: a keypoint file or a folder with one file per frame in any format of
            :mod:`indexing.readers`, a video, a :class:`~indexing.Clip` or a list of its people, or keypoints
            ``(frames, joints, 2)``; or one folder that holds those of all.
        fps: frames per second where files do not say, of all or of each.
        sizes: width and height of the pictures in pixels, of all or of each; by default as the files or videos say.
        focal: pixels, of all cameras or of each: held.
        one_lens: all have the same focal length, which is found.
        calibration: path of a calibration file: matrix and distortions of each camera, held.
        exif: focal lengths by the 35 mm equivalent that phones write into their files.
        height: metres, of the person standing (of several, the tallest): fixes the scale, by the joints' share of it
            (:mod:`~indexing.calibrate.priors`).
        lengths: ``{("left_hip", "left_knee"): 0.43}``, metres, of the first person: fix the scale as well.
        clocks: ``"known"`` where frames of equal times were taken at once; the path of a ``sync.json``, whose clocks are held;
            or what :func:`dyntorch.calibrate` takes.
        rate: clocks may run at different rates.
        max_shift: seconds, the largest offset of two clocks that is searched.
        person: ``"everyone"``, or who is followed where several people are in view: ``"largest"``, ``"confident"``,
            ``"tracked"``.
        people: of ``"everyone"``, how many at most.
        options: of :func:`dyntorch.calibrate`.
        reading: for the reader: ``format=``, ``layout=``, ``min_confidence=``.

    Returns:
        the rig, whether the data decide or not: ``.ok`` and ``.reason`` say so, ``.check()`` raises.

    Raises:
        ValueError: input that cannot be read or cannot be that of one rig; one line that says what to do.

    Example:
        >>> from indexing.actors import Person, stream
        >>> from indexing import cameras
        >>> scene, _ = stream(["squat", "wave"], Person(), rng=1)
        >>> views = [cameras.virtual(scene, azimuth) for azimuth in (0.0, 60.0, 120.0)]
        >>> calibrate(views[:1], sizes=(1920, 1080))
        Traceback (most recent call last):
        ...
        ValueError: 1 camera: two to 8 are calibrated together; add a camera
    """
    recordings = _name_cameras(cameras)
    rates = _per_camera("fps", fps, len(recordings))
    how = {"person": "auto" if person == "everyone" else person, **reading}
    takes = [
        take_of(value, name=name, fps=one, by="keypoints", **how) for (name, value), one in zip(recordings, rates, strict=True)
    ]
    known = RigPriors(focal, one_lens, calibration, exif, clocks, rate, max_shift, height, lengths)
    return calibrate_recordings(takes, known, sizes=sizes, people=people if person == "everyone" else 1, options=options)


def _name_cameras(cameras: Sequence[Any] | str | Path) -> list[tuple[str, Any]]:
    """Name and recording of each camera."""
    values = [cameras] if isinstance(cameras, (str, Path)) else list(cameras)
    if values and all(isinstance(value, (str, Path)) for value in values):
        return list(find_cameras([Path(value).expanduser() for value in values]).items())
    names = [f"cam{i}" if not isinstance(value, Take) else value.name for i, value in enumerate(values, start=1)]
    return list(zip(names, values, strict=True))


def _per_camera(name: str, value: Any, cameras: int) -> list[Any]:
    """One value for each camera."""
    values = [value] if value is None or isinstance(value, (int, float)) else list(value)
    if len(values) not in (1, cameras):
        text = f"{{arg:{name}=}} gives {{many}} values for {{cameras}} cameras; give one, or one per camera"
        raise ValueError(Message(text, many=len(values), cameras=cameras))
    return values * (cameras if len(values) == 1 else 1)


# ----------------------------------------------------------------------------------------------------------------------
# From recordings that were read to a rig.


def calibrate_recordings(
    takes: Sequence[Take],
    known: RigPriors = RigPriors(),
    *,
    sizes: Size | Sequence[Size | None] | None = None,
    people: int = 4,
    words: Callable[[str, str | None], str] = as_python,
    options: CalibrateOptions | None = None,
) -> CameraRig:
    """:func:`calibrate` for recordings that were read.

    Args:
        takes: of each camera.
        known: what is known besides.
        sizes: of the pictures, of all or of each.
        people: how many at most.
        words: what whoever reads the result calls arguments.

    Raises:
        ValueError: as :func:`calibrate`.
    """
    # 1. what was recorded, in pixels
    check_cameras(takes)
    in_pixels = [to_pixels(take, size) for take, size in zip(takes, sizes_of(sizes, len(takes)), strict=True)]
    takes, shapes = [take for take, _ in in_pixels], [size for _, size in in_pixels]
    lenses = known_lenses(takes, shapes, focal=known.focal, one_lens=known.one_lens, calibration=known.calibration, exif=known.exif)
    # 2. which joint is which, and what is known of the person
    if known.height is not None and known.lengths:
        raise ValueError(Message("{arg:height} and {arg:length} both fix the scale; give one of them"))
    joints = select_common_joints([take.people[0] for take in takes], [take.name for take in takes])
    names = () if joints.skeleton is None else joints.skeleton.joints
    stature = None if known.height is None else standing_extent(names, known.height)
    lengths = _lengths(names, known.named_lengths)
    clocks = given_clocks(known.clocks, [take.name for take in takes])
    # 3. who is who
    clips, identities = _identify_people(takes, clocks, people)
    remarks: list[str] = [*_recording_notes(takes), *([joints.note] if joints.note else [])]
    if clips is None:
        views = [make_view(take, take.people[:1], size) for take, size in zip(takes, shapes, strict=True)]
        unknown = _unknown_calibration(views, joints, identities)
        return CameraRig(unknown, views, joints, lenses, None, known.named_lengths, identities, (), (*remarks, ONE_PERSON), words)
    views = [make_view(take, own, size) for take, own, size in zip(takes, clips, shapes, strict=True)]
    if clocks is not None:
        check_overlap(views, clocks)
    # 4. the cameras
    arguments = (joints, lenses, known, clocks, lengths, options)
    calibration = _calibrate_cameras(views, *arguments)
    # 5. left and right, which the cameras tell each other
    views, exchanges = _correct_sides(views, calibration, joints)
    if exchanges:
        calibration = _calibrate_cameras(views, *arguments)
        remarks += _side_notes(views, exchanges)
    # 6. the scale
    if stature is not None and len(calibration.points):
        calibration, stature = scale_to_metres(calibration, stature, names)
        remarks += [NO_STATURE] if stature is None else []
    remarks += [str(note) for note in getattr(identities, "notes", ())]
    return CameraRig(calibration, views, joints, lenses, stature, known.named_lengths, identities, exchanges, tuple(remarks), words)


def _recording_notes(takes: Sequence[Take]) -> list[str]:
    """What to know of the recordings."""
    rated = [take.name for take in takes if take.fps_assumed]
    return [*([Message(ASSUMED_RATE, names=listing(rated))] if rated else []), *(note for take in takes for note in take.notes)]


def sizes_of(sizes: Any, cameras: int) -> list[Size | None]:
    """The pictures' sizes of all cameras, where they were given."""
    if sizes is None:
        return [None] * cameras
    alone = len(sizes) == 2 and not any(isinstance(part, Sequence) for part in sizes)
    pairs: list[Any] = [sizes] if alone else list(sizes)
    if len(pairs) not in (1, cameras):
        text = "{arg:size=} gives {many} sizes for {cameras} cameras; give one, or one per camera"
        raise ValueError(Message(text, many=len(pairs), cameras=cameras))
    out: list[Size | None] = []
    for pair in pairs:
        good = pair is None or (len(pair) == 2 and all(math.isfinite(x) and x >= 1 for x in pair))
        if not good:
            raise ValueError(Message("{arg:size=} must be width and height of the picture in pixels, got {pair!r}", pair=pair))
        out.append(None if pair is None else (round(float(pair[0])), round(float(pair[1]))))
    return out * (cameras if len(out) == 1 else 1)


def _lengths(names: Sequence[str], lengths: Mapping[tuple[str, str], float]) -> dict[tuple[int, int], float]:
    """Known lengths by the numbers of their joints."""
    index = {canonical(name): i for i, name in enumerate(names)}
    out = {}
    for ends, length in lengths.items():
        lacking = [end for end in ends if canonical(end) not in index]
        if lacking:
            text = "{arg:length} {joint!r}: there is no such joint; the joints are {names}"
            raise ValueError(Message(text, joint=lacking[0], names=", ".join(names) or "not named"))
        i, j = (index[canonical(end)] for end in ends)
        if i == j or not (math.isfinite(length) and 0 < length < MAX_LENGTH_METRES):
            text = "{arg:length} {a} {b}: expected two joints and the metres between them, got {length:g}"
            raise ValueError(Message(text, a=ends[0], b=ends[1], length=length))
        out[i, j] = float(length)
    return out


def _identify_people(
    takes: Sequence[Take], clocks: torch.Tensor | None, people: int
) -> tuple[list[list[Clip | None]] | None, Association | None]:
    """The clips of each camera, person by person (None: nobody knows who is who), and what says so."""
    if people < 2 or all(len(take.everyone) < 2 for take in takes):
        return [[take.people[0]] for take in takes], None
    association = associate(takes, None if clocks is None else clocks.numpy())
    if not association.ok:
        return None, association
    seen = np.stack([(tracks >= 0).sum(axis=0) for tracks in association.tracks])
    # who is seen by two cameras at least, the longest first
    order = sorted((k for k in range(association.people) if (seen[:, k] > 0).sum() > 1), key=lambda k: -int(seen[:, k].sum()))[
        :people
    ]
    every = [association.clips(i) for i in range(len(takes))]
    return [[own[k] if seen[i, k] else None for k in order] for i, own in enumerate(every)], association


def _unknown_calibration(views: Sequence[View], joints: Joints, found: Any) -> Calibration:
    """What is known of the cameras where nobody knows who is who: nothing."""
    nowhere = torch.full((len(views),), math.nan, dtype=torch.float64)
    clocks = Clocks(
        status=found.status, notices=(), offsets=nowhere, rates=nowhere, sigmas=nowhere, rate_sigmas=nowhere, confidence=0.0,
        pairs=(), cycle_error=math.nan, worst_cycle=None, outliers=[], reference=0, center=0.0, shifts={},
    )  # fmt: skip
    sizes = torch.tensor([view.size for view in views], dtype=torch.float64)
    return Calibration.unknown(sizes, joints.count, clocks, tuple(view.take.fps for view in views), found.notices)


def _correct_sides(views: list[View], found: Calibration, joints: Joints) -> tuple[list[View], tuple[SideExchange, ...]]:
    """The views with left and right as most cameras see them, and where they were exchanged."""
    if joints.skeleton is None or len(views) < 3 or not bool(found.K.isfinite().all()):
        return views, ()
    tables = [view.table(places) for view, places in zip(views, joints.places, strict=True)]
    corrected = correct_sides(
        [tracks.numpy() for tracks, _ in tables],
        found,
        joints.skeleton.joints,
        times=[view.times for view in views],
        weights=[trust.numpy() for _, trust in tables],
    )
    if not corrected.exchanges:
        return views, ()
    parts = zip(views, corrected.tracks, corrected.weights, joints.places, strict=True)
    return [view.with_joints(tracks, trust, places) for view, tracks, trust, places in parts], corrected.exchanges


def _side_notes(views: Sequence[View], exchanges: Sequence[SideExchange]) -> list[str]:
    """Where left and right were exchanged, a sentence for each camera."""
    notes = []
    for i, view in enumerate(views):
        own = [one for one in exchanges if one.camera == i]
        if own:
            lasts = sum(one.end - one.start + 1 / view.take.fps for one in own)
            limbs = listing(dict.fromkeys(one.limb for one in own))
            notes.append(
                f"{view.name}: left and right exchanged {len(own)} times ({limbs}; {lasts:.2f} s in all), mended by the others"
            )
    return notes


def _calibrate_cameras(
    views: Sequence[View],
    joints: Joints,
    lenses: KnownLenses,
    known: RigPriors,
    clocks: torch.Tensor | None,
    lengths: Mapping[tuple[int, int], float],
    options: CalibrateOptions | None,
) -> Calibration:
    """The library's calibration, on the seconds of the files."""
    seen = [view.table(places) for view, places in zip(views, joints.places, strict=True)]
    try:
        return dyntorch.calibrate(
            [tracks for tracks, _ in seen],
            fps=tuple(view.take.fps for view in views),
            times=[torch.from_numpy(view.times) for view in views],
            sizes=[view.size for view in views],
            focal=None if lenses.focals is None or lenses.lenses is not None else list(lenses.focals),
            calibration=lenses.calibration,
            clocks=clocks,
            lengths=dict(lengths) or None,
            weights=[trust for _, trust in seen],
            one_lens=lenses.one_lens,
            max_shift=known.max_shift,
            rate=None if known.rate else 1.0,
            options=options or CalibrateOptions(),
        )
    except ValueError as problem:  # which speaks of cameras by number
        numbers = ", ".join(f"{i} is {view.name}" for i, view in enumerate(views))
        raise ValueError(Message("{said} (camera {numbers})", said=problem.args[0], numbers=numbers)) from problem

"""What one camera recorded, ready to be compared with what another one did: people over time, a video, or gray frames.

Motion capture is such a recording, too: people, or markers, in space.
"""

from __future__ import annotations

import dataclasses
import math
import tempfile
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray

from dyntorch import Shift, Status, SynchronizeOptions
from dyntorch.core import Notice, NoticeCode, Outcome, status_from
from dyntorch.numerics import Message
from indexing.clip import Clip, check_fps, stretches
from indexing.movement import clips_of, is_dataset
from indexing.readers.files import VIDEOS
from indexing.remarks import FOLLOWED, describe_issues

Measure = Literal["profile", "window"]
"""What of the brightness is compared: the row-band profile, which the window kernel must confirm, or the window kernel alone."""
MEASURES = ("profile", "window")


@dataclass(frozen=True)
class SyncOptions:
    """What is known of the recordings, and what is paid, in :func:`indexing.synchronize`."""

    min_frames: int = 12
    """Frames of keypoints at least."""
    min_margin: float = 0.2
    """Risk of a wrong period: nats by which the best offset of corresponding keypoints must lead (see
    :class:`dyntorch.SynchronizeOptions`)."""
    num_candidates: int = 3
    """People of a camera that are tried, besides the largest one of each frame: all pairings are compared."""

    @property
    def of_points(self) -> SynchronizeOptions:
        """Those of :func:`dyntorch.synchronize`, for keypoints and tracks."""
        return SynchronizeOptions(min_frames=self.min_frames, min_margin=self.min_margin)


_METHODS = "tracks say {tracks}, brightness says {brightness}"


class SyncNotice(NoticeCode):
    """What to know of recordings, of the people in them, and of two methods that must agree."""

    NOTE = "note", "{text}"
    """What a reader says; ``camera`` is the recording that it speaks of."""
    ASSUMED = "assumed_rate", "30 frames per second assumed for {names}; {arg:fps=} says otherwise"
    """Files that do not say how many frames a second has."""
    SAME = "same_recording", "{names} are the same recording"
    """One recording given twice."""
    METHODS = "methods", _METHODS
    """What each method says."""
    PEOPLE = "people", "several people in view: compared {first} with {second}, the best of {value:g} pairings"
    """Who was compared."""
    BY_PIXELS = "by_pixels", "the keypoints do not decide ({keypoints}); this is what the videos' pixels say"
    """Keypoints of videos that do not decide, and pixels that do."""
    NEITHER = "neither", "the pixels do not decide, either: {pixels}"
    """Neither keypoints nor pixels of two videos decide."""
    DISAGREE = (
        "disagree",
        f"{_METHODS}; record keypoints of the people, or a longer take with more motion",
        Status.NO_CONSENSUS,
    )
    """Two methods that say different things."""
    UNDECIDED = "undecided", "neither tracks nor brightness decide: {tracks}; {brightness}", Status.AMBIGUOUS
    """Neither of two methods decides."""
    FEW_TRACKS = (
        "few_tracks",
        "fewer than {needed} moving points could be followed in {names}; use keypoints",
        Status.TOO_FEW,
    )
    """Nothing to follow."""
    UNUSABLE = "unusable", "{text}", Status.TOO_FEW
    """A method that cannot be tried."""
    PAIRINGS = (
        "pairings",
        "one pairing of people says {value:+.3f} s, but pairings of other people say {rivals}; name one person per camera "
        "({arg:person=}), or record one who moves otherwise",
        Status.NO_CONSENSUS,
    )
    """Pairings of other people that are as sure."""


def reader_notices(texts: Iterable[str], camera: str = "") -> list[Notice]:
    """Notes of a reader as notices, of one recording or of all."""
    return [Notice(SyncNotice.NOTE, 0.0, {"text": text, "camera": camera}) for text in texts]


def accepted_notices(shift: Outcome) -> list[Notice]:
    """The notices that refuse nothing."""
    return [notice for notice in shift.notices if notice.code.refuses is None]


FloatArray = NDArray[np.float64]


Kind = Literal["keypoints", "video", "frames"]


By = Literal["auto", "keypoints", "pixels"]


CHOICES = ("auto", *FOLLOWED)


ASSUMED = 30.0  # frames per second where nobody says


@dataclass(frozen=True, eq=False)
class Take:
    """One camera's recording. frames ``(frames, height, width)``, times ``(frames,)``."""

    name: str
    kind: Kind
    path: Path | None = None
    people: tuple[Clip, ...] = ()
    everyone: tuple[Clip, ...] = ()
    frames: NDArray[Any] | None = None
    fps: float = ASSUMED
    fps_assumed: bool = False
    times: FloatArray = dataclasses.field(default_factory=lambda: np.zeros(0))
    count: int = 0
    notes: tuple[str, ...] = ()
    video: Take | None = None
    film: Path | None = None

    @property
    def spatial(self) -> bool:
        """Whether it is of motion capture: points in space rather than what a camera sees."""
        return bool(self.people) and self.people[0].dims == 3

    @property
    def footage(self) -> Path | None:
        """The video of this camera, where there is one."""
        if self.video is not None:
            return self.video.path
        return self.path if self.kind == "video" else self.film


def take_of(
    value: Any,
    *,
    name: str = "",
    fps: float | None = None,
    person: str = "auto",
    min_confidence: float = 0.0,
    format: str | None = None,  # noqa: A002  (the word of the readers)
    size: tuple[float, float] | None = None,
    layout: str | None = None,
    by: By = "auto",
    keypoints: Path | ValueError | None = None,
    options: SyncOptions | None = None,
) -> Take:
    """A recording from whatever a user has of it: see :func:`indexing.sync.synchronize.synchronize`."""
    if isinstance(value, Take):
        return value
    options = options or SyncOptions()
    if fps is not None:
        check_fps(fps)
    how = {"min_confidence": min_confidence, "format": format, "size": size, "layout": layout}
    take = _read(value, name, fps, person, how, options)
    if take.kind == "video" and by != "pixels":
        take = _read_people(take, by, keypoints, person, how, options)
    return _cut_pauses(take)


def _read(value: Any, name: str, fps: float | None, person: str, how: dict[str, Any], options: SyncOptions) -> Take:
    if person not in CHOICES:
        raise ValueError(f"person must be one of {', '.join(CHOICES)}, got {person!r}")
    if isinstance(value, Clip):
        return _of_clips(name or value.name, None, [value])
    if is_dataset(value):
        return _of_clips(name, None, list(clips_of(value, fps=fps, name=name)))
    if isinstance(value, Sequence) and value and all(isinstance(item, Clip) for item in value):
        return _of_clips(name or value[0].name, None, list(value))
    if isinstance(value, (str, Path)):
        path = Path(value).expanduser()
        name = name or camera_name(path)
        if path.suffix.lower() in VIDEOS and not path.is_dir():
            return _of_video(name, path, fps)
        return _of_file(name, path, fps, person, how, options)
    return _of_array(name, value, fps)


MAX_SPAN_PER_FRAME = 20  # A clock may run over so many times its frames, for its frames to be compared.
MAX_SPAN_FRAMES = 20_000  # Frames that it may run over in any case.
CUT_PAUSES_SECONDS = (60.0, 10.0, 1.0)  # Pauses at which a recording that is nearly all gap is cut: as few as will do.


def _cut_pauses(take: Take) -> Take:
    """The take with its people cut to the longest stretch of frames, where it is nearly all gap."""
    if take.kind != "keypoints" or take.count < 2:
        return take
    most = max(MAX_SPAN_PER_FRAME * take.count, MAX_SPAN_FRAMES) / take.fps
    first, end = 0, take.count
    for pause in CUT_PAUSES_SECONDS:
        if take.times[end - 1] - take.times[first] <= most:
            break
        cuts = stretches(take.times, pause)
        first, end = cuts[(cuts[:, 1] - cuts[:, 0]).argmax()].tolist()
    if end - first == take.count:
        return take
    begin, last = float(take.times[first]), float(take.times[end - 1])
    people = [clip.between(begin, last) for clip in take.people if ((clip.times >= begin) & (clip.times <= last)).any()]
    said = f"{take.name}: nearly all gap: only its {end - first} frames from {begin:.6g} to {last:.6g} s are compared"
    return dataclasses.replace(take, people=tuple(people), notes=(*take.notes, said))


def camera_name(path: Path) -> str:
    """A camera's name from its file or folder, as Pose2Sim names folders."""
    path = path if path.name not in ("", "..") else path.resolve()
    return (path.name if path.is_dir() else path.stem).removesuffix("_json") or path.name


def _of_clips(name: str, path: Path | None, people: list[Clip]) -> Take:
    first = people[0]
    if any(clip.dims != first.dims for clip in people):
        raise ValueError(f"{path or name or 'clip'}: holds 2D and 3D joints; give the people of one camera, or of motion capture")
    times = np.unique(np.concatenate([clip.times for clip in people]))
    seen, rate = tuple(people), frame_rate(times, float(first.fps or ASSUMED))
    known = [clip.replace(name=name) for clip in people[:1]] if name else people[:1]  # a camera goes by its own name
    return Take(
        name, "keypoints", path, seen, seen, fps=rate, fps_assumed=first.fps_assumed, times=times, count=len(times),
        notes=tuple(describe_issues(known)),
    )  # fmt: skip


FPS_TOLERANCE = 1e-9  # Relative difference by which a frame rate is still the one that was given.


def frame_rate(times: FloatArray, about: float) -> float:
    """Frames per second over all of a take: by the median step of rounded times, frame numbers would drift from their frames."""
    steps = np.rint(np.diff(times) * about).sum()
    exact = float(steps / (times[-1] - times[0])) if steps > 0 else about
    return exact if abs(exact / about - 1) > FPS_TOLERANCE else about


def _of_file(name: str, path: Path, fps: float | None, person: str, how: dict[str, Any], options: SyncOptions) -> Take:
    from indexing.readers import read

    if person != "auto":
        clips = read(path, fps=fps, person=person, **how)
        return _with_notes(_of_clips(name, path, [_single(path, list(clips))]), FOLLOWED[person])
    everyone = list(read(path, fps=fps, person="everyone", **how))
    if any(clip.label is not None for clip in everyone) or "person" not in everyone[0].meta:  # a set of clips, not a recording
        return _with_notes(_of_clips(name, path, [_single(path, everyone)]), "")
    largest = read(path, fps=fps, person="largest", **how)[0]  # this one has the frames without people, too
    tried = candidates(largest, everyone, options=options) if len(everyone) > 1 else []
    found = dataclasses.replace(_of_clips(name, path, [largest, *tried]), everyone=tuple(everyone))
    return _with_notes(found, "" if tried else FOLLOWED["largest"])


MAX_GRID_ERROR_FRAMES = 0.1  # Distance of times from an even grid, frames, up to which missing frames are counted.
MAX_EMPTY_SHARE = 0.1  # Share of frames without a person above which it is said.


def _with_notes(take: Take, followed: str) -> Take:
    """The recording with notes on frames that are missing, on those that show nobody, and on others in view than who is
    followed."""
    notes: list[str] = []
    people = take.people[0].meta.get("people")
    if people is not None and followed:
        text = "{name}: {people} people in view; compared is {followed}; {arg:person=} says otherwise"
        notes.append(Message(text, name=take.name, people=people, followed=followed))
    steps = np.diff(take.times) * take.fps
    lost = (
        int(np.rint(steps - 1).clip(0).sum())
        if len(steps) and not (np.abs(steps - np.rint(steps)) > MAX_GRID_ERROR_FRAMES).any()
        else 0
    )
    if lost:
        notes.append(f"{take.name}: {lost} of {lost + take.count} frames are missing; the others keep their times")
    nobody = 1 - float(take.people[0].seen.any(axis=1).sum()) / max(1, take.count)
    if nobody > MAX_EMPTY_SHARE:
        notes.append(f"{take.name}: {100 * nobody:.0f} % of the frames show nobody")
    return dataclasses.replace(take, notes=(*take.notes, *notes))


def _single(path: Path, clips: list[Clip]) -> Clip:
    if len(clips) != 1:
        raise ValueError(f"{path}: holds {len(clips)} clips where one recording is expected; save the one of this camera by itself")
    return clips[0]


MIN_PRESENCE_SHARE = 0.2  # Share of the longest person's frames in which a person must be visible to be tried.
DUPLICATE_SHARE = 0.9  # Share of the frames in which the largest person is this one from which both are one.


def candidates(largest: Clip, everyone: Sequence[Clip], options: SyncOptions | None = None) -> list[Clip]:
    """The people worth a try besides the largest one of each frame: seen for long, and large."""
    longest = max(int(clip.seen.any(axis=1).sum()) for clip in everyone)
    found = []
    for clip in everyone:
        there = clip.seen.any(axis=1)
        if there.sum() < MIN_PRESENCE_SHARE * longest:
            continue
        rows = np.searchsorted(largest.times, clip.times[there])
        equal = (np.nan_to_num(largest.joints[rows]) == np.nan_to_num(clip.joints[there])).all(axis=(1, 2))
        if equal.sum() >= DUPLICATE_SHARE * largest.seen.any(axis=1).sum():  # the largest one of each frame is this person
            continue
        extent = np.nanmax(clip.joints[there], axis=1) - np.nanmin(clip.joints[there], axis=1)
        found.append((float(extent.prod(axis=1).sum()), clip))
    return [clip for _, clip in sorted(found, key=lambda entry: -entry[0])[: (options or SyncOptions()).num_candidates]]


def _of_video(name: str, path: Path, fps: float | None) -> Take:
    from indexing.video import probe

    info = probe(path, fps=fps)
    notes = tuple(f"{path.name}: {note}" for note in info.notes)
    return Take(name, "video", path, fps=info.fps, times=np.array([0.0, info.duration]), count=info.frames, notes=notes)


MAX_PEOPLE_IN_VIDEO = 4  # People that a pose model looks for in a video: pairings of more are not tried.


def _read_people(
    video: Take, by: By, keypoints: Path | ValueError | None, person: str, how: dict[str, Any], options: SyncOptions
) -> Take:
    """The people in a video, as a pose model sees them; the video itself where there is no model, or nobody is seen."""
    from indexing.pose import available, keypoint_file
    from indexing.readers.recording import NobodySeen

    assert video.path is not None
    if by == "auto" and keypoints is None and available() is None:
        return video
    try:
        if isinstance(keypoints, ValueError):
            raise keypoints
        with tempfile.TemporaryDirectory(prefix="dyntorch-pose-") as passing:
            file = keypoints or keypoint_file(video.path, passing, MAX_PEOPLE_IN_VIDEO).path
            take = _of_file(video.name, file, None, person, how, options)
    except NobodySeen:
        if by == "keypoints":
            raise
        said = f"{video.path.name}: nobody is seen in it, so it is compared by its pixels"
        return dataclasses.replace(video, notes=(*video.notes, said))
    said = f"{video.path.name}: compared by the people that BlazePose {take.people[0].meta['model']} finds in it"
    return dataclasses.replace(take, path=video.path, video=video, notes=(*video.notes, *take.notes, said))


def _of_array(name: str, value: Any, fps: float | None) -> Take:
    try:
        array = np.asarray(value.detach().cpu().numpy() if hasattr(value, "detach") else value)
        if array.dtype.kind not in "fiub":
            raise TypeError(f"dtype {array.dtype}")
    except (TypeError, ValueError) as error:
        raise ValueError(
            f"{name or 'recording'}: expected a clip, a path or an array, got {type(value).__name__} ({error})"
        ) from None
    rate = float(fps or ASSUMED)
    if array.ndim != 3 or not len(array):
        raise ValueError(
            f"{name or 'recording'}: expected keypoints (frames, joints, 2), motion capture (frames, markers, 3) or gray frames "
            f"(frames, height, width), got shape {array.shape}; give one camera at a time"
        )
    if array.shape[2] > 3:
        times = np.arange(len(array)) / rate
        return Take(name, "frames", frames=array, fps=rate, fps_assumed=fps is None, times=times, count=len(times))
    return _of_clips(name, None, [Clip(array, fps=fps, name=name)])


def find_cameras(paths: Sequence[Path]) -> dict[str, Path]:
    """Name and path of every camera; one folder may hold those of all (Pose2Sim's ``pose/cam01_json``, or a folder of videos)."""
    found = list(paths)
    if len(found) == 1:
        found = _inside(found[0])
    if len(found) < 2:
        raise ValueError(_too_few(paths, len(found)))
    twice = [path for i, path in enumerate(found) if path.resolve() in [other.resolve() for other in found[:i]]]
    if twice:
        raise ValueError(f"{twice[0]}: given twice; name every camera once")
    names = [camera_name(path) for path in found]
    for depth in range(2):  # cam1/pose.json and cam2/pose.json are cam1 and cam2
        if len(set(names)) < len(names):
            names = [camera_name(path.resolve().parents[depth]) for path in found]
    if len(set(names)) < len(names):
        names = [f"{name}-{i}" for i, name in enumerate((camera_name(path) for path in found), start=1)]
    return dict(zip(names, found, strict=True))


def _too_few(paths: Sequence[Path], found: int) -> str:
    remedy = "two are needed; give a file or folder for each, or the folder that holds a folder for each"
    if not paths:
        return f"no cameras given, {remedy}"
    if not paths[0].exists():
        return f"{paths[0]}: no such file or folder; check the path"
    alone = paths[0].is_file() or any(_is_frame(file) for file in paths[0].iterdir())
    return f"{paths[0]}: {'is one camera' if alone else f'holds {found} cameras'}, {remedy}"


def _inside(folder: Path) -> list[Path]:
    """The cameras in a folder: subfolders with keypoints, or else videos."""
    if not folder.is_dir():
        return [folder]
    for where in (folder, folder / "pose", folder / "videos"):
        if where.is_dir():
            entries = sorted(entry for entry in where.iterdir() if not entry.name.startswith("."))
            folders = [entry for entry in entries if entry.is_dir() and any(_is_frame(file) for file in entry.iterdir())]
            videos = [entry for entry in entries if entry.suffix.lower() in VIDEOS and entry.is_file()]
            if len(folders or videos) > 1:
                return folders or videos
    return []


def _is_frame(file: Path) -> bool:
    return file.suffix.lower() in (".json", ".txt") and not file.name.startswith(".")


def undecided_shift(fps: tuple[float, float], method: str, *limits: Notice) -> Shift:
    """What is said where there is nothing to compare."""
    none = torch.zeros(0, dtype=torch.float64)
    return Shift(
        offset=0.0, sigma=math.inf, rate=1.0, rate_sigma=0.0, confidence=0.0, peaks=none.reshape(0, 2), method=method, fps=fps,
        center=0.0, lags=none, scores=none, status=status_from(limits), notices=limits,
    )  # fmt: skip


def joint_weights(clip: Clip) -> FloatArray:
    """``(frames, joints)`` how much the detector trusts each joint; 1 and 0 where it does not say."""
    if clip.confidence is None:
        return np.where(clip.seen, 1.0, 0.0)
    return np.asarray(np.nan_to_num(np.clip(clip.confidence, 0.0, None)), dtype=np.float64)


def videos_named(folder: Path, name: str) -> list[Path]:
    """The video files of a folder that have a name, whatever their ending."""
    files = sorted(folder.iterdir()) if folder.is_dir() else []
    return [file for file in files if file.suffix.lower() in VIDEOS and file.stem == name and file.is_file()]

"""What an archive takes in: files, folders, clips and sets of them; how each is told from the others; and reading one of them.

Reading happens in workers, which know nothing of the archive: :func:`read_source` is handed a :class:`ArchiveSource` and gives back
movement as it is stored, or the reason why there is none.
"""

from __future__ import annotations

import hashlib
import inspect
import json
import os
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from indexing.archive.catalogue import CATALOGUE, storable
from indexing.archive.tracks import StorageFormat, Track, total_windows, tracks_of
from indexing.clip import Clip, LabelledSet
from indexing.files import sha256_of
from indexing.movement import clips_of, is_dataset
from indexing.opening import parse_json, read_text, size_of
from indexing.pose import available, keypoint_file
from indexing.readers.files import VIDEOS, WatchOptions, frame_number
from indexing.remarks import describe_issues
from indexing.skeleton import Skeleton

MAX_FRAME_BYTES = 2**22  # of a JSON file that may be one frame of many
POSES = "poses"  # the folder of an archive in which the keypoints of videos are kept
KEYPOINT_FILES = (".json", ".npz", ".csv")  # suffixes that are looked into where a folder is given
READING = {"person": "everyone"}  # how files are read where nothing else is said

SourceInput = Clip | LabelledSet[Clip] | str | os.PathLike[str]


@dataclass(frozen=True, eq=False)
class ArchiveSource:
    """One thing to add."""

    key: str
    name: str
    path: Path | None = None
    clip: Clip | None = None
    poses: Path | None = None


@dataclass(frozen=True)
class Stamp:
    """What a source was like when it was read: bytes, time of its last change (ns), hash of its content."""

    size: int
    modified: int
    sha256: str = ""


@dataclass(frozen=True, eq=False)
class ReadRecording:
    """One person of a recording, as it is stored."""

    name: str
    person: str
    joints: int
    skeleton: Skeleton | None
    tracks: tuple[Track, ...]
    begins: float
    ends: float
    seconds: float
    windows: int


@dataclass(frozen=True, eq=False)
class ReadSource:
    """What reading gave: recordings, and what a reader should know; or, in ``failure``, why there are none."""

    stamp: Stamp
    recordings: tuple[ReadRecording, ...] = ()
    note: str = ""
    failure: str = ""

    @property
    def windows(self) -> int:
        """Of all recordings."""
        return sum(one.windows for one in self.recordings)

    @property
    def seconds(self) -> float:
        """Stored, of all people."""
        return sum(one.seconds for one in self.recordings)


# ---- what there is to add ------------------------------------------------------------------------------------------------


def gather(given: SourceInput | Iterable[SourceInput]) -> list[ArchiveSource]:
    """All sources, folders walked, each once."""
    single = isinstance(given, (Clip, str, os.PathLike)) or is_dataset(given)
    listed: list[Any] = [given] if single else list(given)  # type: ignore[arg-type]
    found: list[ArchiveSource] = []
    for one in listed:
        if isinstance(one, Clip):
            found.append(_of_clip(one))
        elif isinstance(one, (str, os.PathLike)):
            found += _of_path(Path(one))
        elif is_dataset(one):
            found += [_of_clip(clip) for clip in clips_of(one)]
        elif isinstance(one, LabelledSet) and all(isinstance(clip, Clip) for clip in one):
            found += [_of_clip(clip) for clip in one]
        else:
            raise ValueError(f"sources: got {type(one).__name__}; give paths of files or folders, Clips, ClipSets or datasets")
    if not found:
        raise ValueError("sources: nothing to add; give keypoint files, folders that hold some, Clips or ClipSets")
    return _once(found)


def _of_clip(clip: Clip) -> ArchiveSource:
    name = storable(clip.name or f"clip {_hash_of(clip)[:12]}")
    return ArchiveSource(f"clip:{name}", name, clip=clip)


def _of_path(path: Path) -> list[ArchiveSource]:
    path = path.expanduser()
    return _walk(path, set()) if os.path.isdir(path) and not is_recording(path) else [_of_file(path)]


def _of_file(path: Path) -> ArchiveSource:
    """A file, or a folder that is one recording; whatever is wrong with it is found when it is read."""
    return ArchiveSource(storable(f"file:{_resolve(path)}"), storable(str(path)), path)


def _walk(folder: Path, walked: set[Path]) -> list[ArchiveSource]:
    """All that is in a folder, by name; links that lead to where the walk has been are not followed."""
    real = Path(_resolve(folder))
    if real in walked:
        return []
    walked.add(real)
    try:
        inside = sorted(folder.iterdir())
    except OSError:
        return [_of_file(folder)]
    found: list[ArchiveSource] = []
    videos: list[Path] = []
    for one in inside:
        if one.name.startswith("."):
            continue
        if os.path.isdir(one):
            if is_recording(one):
                found.append(_of_file(one))
            elif not os.path.exists(one / CATALOGUE):
                found += _walk(one, walked)
        elif one.suffix.lower() in KEYPOINT_FILES:
            found.append(_of_file(one))
        elif one.suffix.lower() in VIDEOS:
            videos.append(one)
    if videos and available() is not None:
        keypoints = [one.name for one in inside if one.is_dir() or one.suffix.lower() in KEYPOINT_FILES]
        found += [_of_file(one) for one in videos if not any(_begins(name, one.stem) for name in keypoints)]
    return found


def _begins(name: str, stem: str) -> bool:
    """Whether a file of keypoints is called as those of a video are: its name, and then nothing that could belong to the name."""
    rest = name[len(stem) :]
    return name.startswith(stem) and (not rest[:1].isalnum() or rest.startswith("DLC"))


def assign_pose_folders(sources: Sequence[ArchiveSource], archive: Path) -> list[ArchiveSource]:
    """The sources, of which videos know where the archive keeps their keypoints."""
    return [replace(one, poses=poses_of(archive, one.key)) if _is_video(one.path) else one for one in sources]


def poses_of(archive: Path, key: str) -> Path:
    """The folder in which an archive keeps the keypoints of a video: found again when it is added under the same path."""
    return archive / POSES / hashlib.sha256(key.encode("utf-8", "surrogateescape")).hexdigest()[:16]


def _is_video(path: Path | None) -> bool:
    return path is not None and path.suffix.lower() in VIDEOS and not os.path.isdir(path)


def _resolve(path: Path) -> str:
    try:
        return os.path.realpath(path)
    except (OSError, ValueError):  # no file can have this name
        return str(path)


def is_recording(folder: Path) -> bool:
    """Whether a folder is one recording, with a file for each frame, and not a collection of recordings."""
    try:
        files = sorted(one for one in folder.iterdir() if not one.name.startswith("."))
    except OSError:
        return False
    for suffix in (".json", ".txt"):
        frames: list[Path] = []
        others: list[Path] = []
        for one in files:
            (frames if one.suffix.lower() == suffix and one.name != "classes.txt" else others).append(one)
        if not frames or any(one.is_dir() or one.suffix.lower() in (*KEYPOINT_FILES, *VIDEOS) for one in others):
            continue
        if any(frame_number(one.name) is None for one in frames):
            continue
        return suffix == ".txt" or (len(frames) > 1 and _is_frame(frames[0]))
    return False


def _is_frame(path: Path) -> bool:
    """Whether a JSON file is one frame as OpenPose writes it."""
    try:
        if path.stat().st_size > MAX_FRAME_BYTES:
            return False
        data = parse_json(path, read_text(path), "")
    except (ValueError, OSError):
        return False
    return isinstance(data, dict) and ("people" in data or "bodies" in data)


def _once(found: Sequence[ArchiveSource]) -> list[ArchiveSource]:
    """A file that was named twice is one; clips of one name are told apart by their number, in the order given."""
    out: dict[str, ArchiveSource] = {}
    for one in found:
        if one.clip is None:
            out.setdefault(one.key, one)
            continue
        key, name, number = one.key, one.name, 1
        while key in out and out[key].clip is not one.clip:
            number += 1
            key, name = f"{one.key} ({number})", f"{one.name} ({number})"
        out[key] = ArchiveSource(key, name, clip=one.clip)
    return list(out.values())


# ---- what a source is like -----------------------------------------------------------------------------------------------


def stamp(source: ArchiveSource) -> Stamp:
    """Size and last change, without reading a file; of a clip, the hash of what it holds."""
    if source.clip is not None:
        return Stamp(source.clip.joints.nbytes, 0, _hash_of(source.clip))
    assert source.path is not None
    facts = [os.stat(one) for one in _files(source.path)]
    return Stamp(sum(one.st_size for one in facts), max((one.st_mtime_ns for one in facts), default=0))


def content(source: ArchiveSource) -> str:
    """The hash of what a source holds."""
    if source.clip is not None:
        return _hash_of(source.clip)
    assert source.path is not None
    if not source.path.is_dir():
        return sha256_of(source.path)
    each = (f"{os.path.basename(one)}\0{sha256_of(one)}\0" for one in _files(source.path))
    return hashlib.sha256("".join(each).encode("utf-8", "surrogateescape")).hexdigest()


def reading_key(reading: Mapping[str, Any]) -> str:
    """How files are read, as text that is the same for the same: what is said as it is anyway counts as not said."""
    from indexing.readers import read

    usual = {name: one.default for name, one in inspect.signature(read).parameters.items() if one.kind is one.KEYWORD_ONLY}
    unknown = sorted(set(reading) - set(usual))
    if unknown:
        raise ValueError(f"reading: nothing is known of {unknown[0]!r}; give some of {', '.join(usual)}")
    told = {name: value for name, value in reading.items() if value != {**usual, **READING}[name]}
    return json.dumps(told, sort_keys=True, default=str)


def _files(path: Path) -> list[str]:
    """A file, or those in a folder: names, as a detector that writes one for each frame makes a hundred thousand an hour."""
    if os.path.isdir(path):
        with os.scandir(path) as inside:
            return sorted(one.path for one in inside if one.is_file())
    size_of(path)  # says what is wrong with it, if anything
    return [str(path)]


def _hash_of(clip: Clip) -> str:
    skeleton = None if clip.skeleton is None else [clip.skeleton.name, clip.skeleton.joints, clip.skeleton.bones]
    digest = hashlib.sha256(json.dumps([clip.up, clip.joints.shape, str(clip.joints.dtype), skeleton], default=int).encode())
    for one in (clip.joints, clip.times) if clip.confidence is None else (clip.joints, clip.times, clip.confidence):
        digest.update(np.ascontiguousarray(one).tobytes())
    return digest.hexdigest()


# ---- reading one, in a worker --------------------------------------------------------------------------------------------


def read_source(source: ArchiveSource, reading: Mapping[str, Any], storage: StorageFormat) -> ReadSource:
    """Movement of one source as it is stored; whatever is wrong with it becomes a reason, never an exception."""
    try:
        before = stamp(source)
        people, note = _people(source, reading)
        held = before.sha256 or content(source)
        if source.clip is None and stamp(source) != before:  # what was read may be half of it, under the hash of another half
            raise ValueError(f"{source.name}: was written to while it was read; add it again when it is finished")
        found = [_recording(clip, name, person, storage) for name, person, clip in people]
        kept = tuple(one for one in found if one.windows)
        if not kept:
            note = f"nobody is in view for {storage.min_duration:g} s" if people else note
        return ReadSource(Stamp(before.size, before.modified, held), kept, note)
    except Exception as problem:  # one file among thousands must not end an addition, whatever a reader does with it
        remedy = "; check the path and its permissions" * isinstance(problem, OSError)
        return ReadSource(Stamp(0, 0), failure=failure_text(source, problem) + remedy)


def failure_text(source: ArchiveSource, problem: Exception) -> str:
    """What is wrong with a source, as one line that names it; a reader's own words name it already."""
    if isinstance(problem, ValueError):
        return " ".join(str(problem).split())
    if isinstance(problem, OSError):
        return f"{source.name}: {problem.strerror or problem}"
    return f"{source.name}: {type(problem).__name__}: {' '.join(str(problem).split())}"


def _people(source: ArchiveSource, reading: Mapping[str, Any]) -> tuple[list[tuple[str, str, Clip]], str]:
    """``(name, person, clip)`` of everybody, and what a reader should know."""
    from indexing.readers import read
    from indexing.readers.recording import NobodySeen
    from indexing.recordings.people import of_recording, tracked_people

    if source.clip is not None:
        return [(source.name, "", source.clip)], ""
    assert source.path is not None
    try:
        clips = read(_keypoints(source, reading), **{**READING, **reading})
    except NobodySeen:
        return [], "nobody is in view in any frame"
    notes = ["30 frames per second assumed"] if any(clip.fps_assumed for clip in clips) else []
    note = "; ".join([*notes, *(str(one).removeprefix(f"{source.path.name}: ") for one in describe_issues(clips))])
    if of_recording(clips):
        crowd = tracked_people(clips, source.name)
        return [(source.name, who.name, who.clip) for who in crowd.people], note
    if len(clips) == 1:
        return [(source.name, "", clips[0])], note
    seen = Counter[str]()
    named: list[tuple[str, str, Clip]] = []
    for clip in clips:
        seen[clip.name] += 1
        number = f" ({seen[clip.name]})" if seen[clip.name] > 1 else ""
        named.append((f"{source.name}: {clip.name}{number}", "", clip))
    return named, note


def _keypoints(source: ArchiveSource, reading: Mapping[str, Any]) -> Path:
    """The file to read: of a video, that of its keypoints, which are found now if they were not before."""
    assert source.path is not None
    if source.poses is None or available() is None:
        return source.path  # whoever reads it says what is missing
    how = reading.get("watching") or WatchOptions()
    made = keypoint_file(source.path, source.poses, how.people, model=how.model, every=how.every, fps=reading.get("fps"), own=True)
    return made.path


def _recording(clip: Clip, name: str, person: str, storage: StorageFormat) -> ReadRecording:
    tracks = tuple(tracks_of(clip, storage))
    first = [track for track in tracks if track.view == 0] or list(tracks)
    seconds = sum((len(track) - 1) / storage.rate for track in first)
    begins = min((track.start for track in tracks), default=0.0)
    ends = max((track.start + (len(track) - 1) / storage.rate for track in tracks), default=0.0)
    return ReadRecording(
        storable(name),
        storable(person),
        clip.joints.shape[1],
        clip.skeleton,
        tracks,
        begins,
        ends,
        seconds,
        total_windows(tracks, storage),
    )

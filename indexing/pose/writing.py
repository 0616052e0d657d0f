"""Keypoint files of videos: a clip set for every command of this package, and a folder of JSON as OpenPose and Pose2Sim have it."""

from __future__ import annotations

import os
import re
import shutil
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from json import dumps
from pathlib import Path

import numpy as np

from indexing.clip import Clip, ClipSet
from indexing.files import prepare, recover_folder, replacing_folder
from indexing.opening import entries, error, is_regular, parse_json, read_text
from indexing.pose.blazepose import Floats
from indexing.pose.chunks import content_of, nearest, plan
from indexing.pose.detection import Detected, FrameProgress, ModelName, NobodyInVideo, Progress, VideoTask, as_frames, check, run
from indexing.pose.models import ModelSet, load_models
from indexing.pose.tracking import Indices, PoseOptions
from indexing.readers.formats.clipset import read_clip_set
from indexing.readers.npz import NumpyArchive

MADE_FROM, CONTENT = "made_from", "content"  # the fields by which a file of ours is known
MARK = ".dyntorch"  # the file by which a folder is; not .json, of which Pose2Sim reads hidden ones, too
FRAME = r"_\d{12,}_keypoints\.json"  # how the names of its files end
MOVE = "move it away, or write to another folder"


@dataclass(frozen=True, eq=False)
class KeypointFile:
    """The keypoint file of a video.

    Attributes:
        path: of the clip set.
        folder: of the JSON, None where there is none.
        clips: one per person.
        reused: whether it was there before.
        found: how it was made; None where it was there before.
    """

    path: Path
    folder: Path | None
    clips: ClipSet
    reused: bool
    found: Detected | None = None


def keypoint_file(
    video: str | Path,
    folder: str | Path,
    people: int = 1,
    *,
    model: ModelName | None = None,
    models: str | Path | None = None,
    every: int = 1,
    fps: float | None = None,
    workers: int = 1,
    progress: Progress | None = None,
    json: bool = False,
    own: bool = False,
    options: PoseOptions | None = None,
) -> KeypointFile:
    """The keypoints of a video from a folder, made where they are not there yet.

    A file counts as there if it was made from the same content (size, and what stands at both ends of the file), by the same model
    and the same arguments; made by others, it is replaced.  What was worked before an interruption or an error is kept in a hidden
    folder and used.  What is not ours, or of another video of this name, is never replaced.

    Args:
        video: a path.
        folder: where ``NAME.npz`` is looked for and written, and with ``json`` the folder ``NAME_json``.
        people, model, models, every, fps, workers, progress, options: as of :func:`indexing.pose.detect`.
        json: whether to write the folder of JSON as well.  One that was written before is kept up with the clip set in any case.
        own: whether the folder belongs to this video alone, so that what is there of its older content is replaced.

    Raises:
        ValueError: as :func:`indexing.pose.detect`, or a file or folder of that name holds something else.
    """
    check(people, every, workers, fps)
    chosen = load_models(model, models)
    task = VideoTask(Path(video).expanduser(), people, every, fps, chosen.name, options or PoseOptions())
    ((_, made),) = keypoint_files([task], Path(folder).expanduser(), chosen, workers, as_frames(progress), json, own)
    if isinstance(made, ValueError):
        raise made
    return made


def kept_file(video: Path, folder: Path) -> Path | None:
    """The clip set of a video in a folder, made from this very video, however it was made; None where there is none."""
    target = folder / f"{video.stem}.npz"
    if not (is_regular(target) and is_regular(video)):
        return None
    try:
        content = NumpyArchive(target).get(CONTENT, np.zeros(0))
    except ValueError:
        return None
    return target if content.size and str(content.flat[0]) == content_of(video) else None


def keypoint_files(
    tasks: Sequence[VideoTask],
    folder: Path,
    models: ModelSet,
    workers: int = 1,
    progress: FrameProgress | None = None,
    json: bool = True,
    own: bool = False,
) -> Iterator[tuple[VideoTask, KeypointFile | ValueError]]:
    """The keypoint files of many videos, in their order, each as soon as it is written, or what is wrong with it."""
    targets = targets_of([task.path for task in tasks], folder)
    there: dict[int, KeypointFile | ValueError] = {}
    for number, (task, target) in enumerate(zip(tasks, targets, strict=True)):
        try:
            kept = _reusable(task, target, json, own)
        except ValueError as problem:
            there[number] = problem
            continue
        if kept is not None:
            there[number] = kept
    left = [replace(task, parts=_parts(target)) for number, (task, target) in enumerate(zip(tasks, targets, strict=True))
            if number not in there]  # fmt: skip
    fresh = not folder.exists()
    if left:
        prepare(folder)
    working = run(left, models, workers, progress)
    for number, (task, target) in enumerate(zip(tasks, targets, strict=True)):
        if number in there:
            yield task, there[number]
            continue
        same, found = next(working)
        if isinstance(found, NobodyInVideo):
            shutil.rmtree(_parts(target), ignore_errors=True)
        made = found if isinstance(found, ValueError) else _write(same, found, target, json)
        with suppress(OSError):  # pieces that are kept for the next run stay
            _parts(target).rmdir()
        yield task, made
    if fresh and left and not any(folder.iterdir()):
        folder.rmdir()


def targets_of(videos: Sequence[Path], folder: Path) -> list[Path]:
    """The clip set of each video."""
    owners: dict[str, Path] = {}
    for video in videos:
        other = owners.setdefault(video.stem.lower(), video)
        if other is not video:
            said = f"would be written to {folder / video.stem}.npz, as {other}"
            raise error(video, said, "rename one of them, or give two folders")
    return [folder / f"{video.stem}.npz" for video in videos]


def _parts(target: Path) -> Path:
    return target.with_name(f".{target.stem}.parts")


def _json(target: Path) -> Path:
    return target.with_name(f"{target.stem}_json")


def _reusable(task: VideoTask, target: Path, json: bool, own: bool) -> KeypointFile | None:
    """The file that was written before, if it is what would be written now."""
    folder = _json(target)
    recover_folder(folder)
    kept, beside = _of_file(target), _of_folder(folder)
    if json and beside is None:
        _refuse(folder)
    if kept is None and beside is None:
        return None
    now = plan(task.path, task.people, task.every, task.fps, task.model, task.options)
    for path, origin in ((target, kept), (folder, beside if json else None)):
        if origin is not None and origin.content != now.content and not own:
            raise error(path, "holds the keypoints of another video of this name", MOVE)
    with_json = json or _of_video(beside, now.content)
    if kept is None or kept.made_from != now.made_from:
        if with_json:
            _refuse(folder)
        return None
    clips = read_clip_set(target)
    if with_json and (beside is None or beside.made_from != now.made_from):
        wanted = np.concatenate([piece.frames for piece in now.pieces])
        if task.people == 1:  # this clip has every frame that could be decoded
            wanted = np.array([nearest(now.times, time) for time in clips[0].times])
        write_json_folder(clips, wanted, now.times[wanted], folder)
    return KeypointFile(target, folder if with_json else None, clips, True)


def _write(task: VideoTask, found: Detected, target: Path, json: bool) -> KeypointFile | ValueError:
    """Write what was found; the clip set last, so that it says that all is there."""
    folder = _json(target)
    with_json = json or _of_video(_of_folder(folder), str(found.clips[0].meta[CONTENT]))
    try:
        _of_file(target)  # again: somebody may have put one there meanwhile
        if with_json:
            write_json_folder(found.clips, found.frames, found.times, folder)
        found.clips.save(target)
    except ValueError as problem:
        return problem
    if task.parts is not None:
        shutil.rmtree(task.parts, ignore_errors=True)
    return KeypointFile(target, folder if with_json else None, found.clips, False, found)


# ----------------------------------------------------------------------------------------------------------------------
# What is ours, and of which video; nothing else is ever replaced.


@dataclass(frozen=True)
class _Origin:
    """What a file or folder of ours was made from; see :class:`indexing.pose.chunks.VideoPlan`."""

    made_from: str
    content: str


def _of_file(target: Path) -> _Origin | None:
    """Of a clip set; None where there is none."""
    if not target.exists():
        return None
    try:
        fields = NumpyArchive(target)
        made_from, content = fields.get(MADE_FROM, np.zeros(0)), fields.get(CONTENT, np.zeros(0))
    except ValueError:
        made_from = content = np.zeros(0)
    if not (made_from.size and content.size):
        raise error(target, "is there, and no keypoint file of 'dyntorch pose'", MOVE)
    return _Origin(str(made_from.flat[0]), str(content.flat[0]))


def _of_folder(folder: Path) -> _Origin | None:
    """Of a folder of JSON; None where there is none, or one that is not ours."""
    try:
        told = parse_json(folder / MARK, read_text(folder / MARK), "")
        return _Origin(str(told[MADE_FROM]), str(told[CONTENT]))
    except (ValueError, KeyError, TypeError):
        return None


def _of_video(origin: _Origin | None, content: str) -> bool:
    return origin is not None and origin.content == content


def _refuse(folder: Path) -> None:
    """Raise where something would be lost if the folder were replaced: it is not ours, or somebody keeps files in it."""
    if not os.path.lexists(folder):
        return
    if _of_folder(folder) is None:
        raise error(folder, "is there, and no folder of 'dyntorch pose'", MOVE)
    frame = re.compile(re.escape(_name(folder)) + FRAME)
    other = next((entry for entry in entries(folder) if not frame.fullmatch(entry.name)), None)
    if other is not None:
        raise error(other, "is no file of 'dyntorch pose', and its folder is to be written again", MOVE)


def write_json_folder(clips: Sequence[Clip], numbers: Indices, times: Floats, folder: Path) -> Path:
    """Write a file per frame, as OpenPose does and Pose2Sim reads: ``NAME_000000000000_keypoints.json``. numbers
    ``(frames,)``."""
    _refuse(folder)
    rows: list[dict[int, int]] = [{nearest(times, time): row for row, time in enumerate(clip.times)} for clip in clips]
    ids = [clip.meta["person"] if clip.meta["followed"] == "ids" else -1 for clip in clips]
    mark = {key: str(clips[0].meta[key]) for key in (MADE_FROM, CONTENT)}
    with replacing_folder(folder) as building:
        for k, number in enumerate(numbers.tolist()):
            people = [
                {"person_id": [who], "pose_keypoints_2d": _flat(clip, row[k])}
                for clip, row, who in zip(clips, rows, ids, strict=True)
                if k in row and clip.seen[row[k]].any()
            ]
            frame = {"version": 1.3, "time": round(float(times[k]), 9), "people": people}
            (building / f"{_name(folder)}_{number:012d}_keypoints.json").write_text(dumps(frame), encoding="utf-8")
        (building / MARK).write_text(dumps(mark), encoding="utf-8")
    return folder


def _name(folder: Path) -> str:
    return folder.name.removesuffix("_json")


def _flat(clip: Clip, row: int) -> list[float]:
    """x, y, confidence of every joint, one after the other."""
    assert clip.confidence is not None
    table = np.concatenate([clip.joints[row], clip.confidence[row][:, None]], axis=1).astype(np.float64)
    table[np.isnan(table).any(axis=1)] = 0.0
    return np.round(table, 4).ravel().tolist()

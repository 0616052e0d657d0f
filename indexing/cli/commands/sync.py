"""``dyntorch sync``: cameras that nobody synchronized, put on one clock."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import math
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import dyntorch
from dyntorch.numerics import Message, with_words
from indexing.cli.console import check_report, count, flag_words, names, present, progress, say
from indexing.cli.flags.geometry import Sync
from indexing.cli.flags.shared import Watched
from indexing.cli.inputs import camera_numbers, refuse_range
from indexing.cli.videos import find_keypoints, wants_keypoints
from indexing.clip import Clip
from indexing.files import manifest, prepare
from indexing.report.sync import FILES, SyncReport
from indexing.sync.calibration import named_lenses
from indexing.sync.files import (
    MOCAP_FOLDER,
    Plan,
    check_mocap,
    check_target,
    drop_mocap,
    drop_poses,
    folder_of,
    plan,
    retime_mocap,
    write_mocap,
    write_poses,
)
from indexing.sync.people import Pairing
from indexing.sync.pose2sim import Trial, numbers, shortest, trial_of, trials_in
from indexing.sync.recordings import By, Take, find_cameras, take_of
from indexing.sync.synchronize import BY, Method, find_breaks, recording_notices
from indexing.sync.synchronize import pair as compare_pair
from indexing.sync.trimming import CameraVideo, check_videos, drop_videos, frame_clock, trim, trim_as_json, video_of, write_videos
from indexing.video import write_check_video
from indexing.video.reading import av, cv2

WORDS = flag_words(
    "fps", "person", "method", "measure", "max_shift", "min_confidence", "format", "size", "layout", "rate", "sound",
    calibration="--calibration FILE.toml",
)  # fmt: skip


def run(flags: Sync) -> int:
    """Read, synchronize, write, and say what was found."""
    _check(flags)
    for path in flags.cameras:
        refuse_range(path)

    paths = [path.expanduser() for path in flags.cameras]
    home = paths[0] if len(paths) == 1 and paths[0].is_dir() else None
    trial = None if home is None else trial_of(home)
    if trial is None and home is not None and (inner := trials_in(home)):
        return _session(flags, home, inner)
    return _sync_scene(flags, find_cameras(paths) if trial is None else trial.cameras, trial)


def _session(flags: Sync, home: Path, trials: list[Path]) -> int:
    """All trials of a session, one after the other; the worst exit code."""
    codes = []
    for number, path in enumerate(trials):
        say(f"{'' if not number else '--- '}trial {path.relative_to(home)}:")
        out = None if flags.out is None else flags.out / path.relative_to(home)
        codes.append(run(dataclasses.replace(flags, cameras=(path,), out=out)))
    return max(codes)


def _sync_scene(flags: Sync, found: dict[str, Path], trial: Trial | None) -> int:
    """The cameras of one scene."""
    inputs = [*found.values(), *([flags.calibration.expanduser()] if flags.calibration else [])]
    out = trial.folder if trial is not None and flags.out is None else flags.out
    folder = check_report(out, inputs, [*FILES, *check_names(list(found))])
    if folder is not None:
        check_target(folder, inputs)
    if folder is not None and flags.videos:
        check_videos(folder, [*inputs, *(trial.films.values() if trial is not None else ())])
    started = time.perf_counter()
    by = _by(flags)
    watched = Watched({})
    if by != "pixels" and wants_keypoints(flags.footage):
        watched = find_keypoints(flags.footage, found.values(), folder, _rates(flags, len(found))[0])
    with progress("reading", steps=False):
        takes = _read(flags, found, by, watched, trial)
        _check_spatial(takes, folder, inputs)
        films = _camera_videos(flags, takes)
    read = time.perf_counter()
    pairs = len(takes) * (len(takes) - 1) // 2
    with progress(f"comparing {count(pairs, 'pair')} of cameras") as done:
        report = _repair_clocks(flags, _solve(flags, takes, done, trial), done, trial)
    timings = {"read": read - started, "synchronize": time.perf_counter() - read}
    if folder is not None:
        made = manifest({"command": "sync", **dataclasses.asdict(flags)}, inputs, None, timings)
        report = _write(flags, folder, dataclasses.replace(report, manifest=made, folder=folder), films, trial is not None)
    return present(report, folder)


def _check(flags: Sync) -> None:
    """Raise on flags that make no sense by themselves, before any file is read."""
    if flags.max_shift is not None and not 0 < flags.max_shift < math.inf:
        raise ValueError(f"--max-shift must be a positive number of seconds, got {flags.max_shift:g}")
    trial = len(flags.cameras) == 1 and (flags.cameras[0].expanduser() / "Config.toml").is_file()
    for flag, asked in (("check", flags.check), ("videos", flags.videos)):
        if asked and flags.out is None and not trial:
            raise ValueError(f"--{flag} writes {'a video' if flag == 'check' else 'videos'}; say where with --out")
    if flags.videos_fps is not None and not 0 < flags.videos_fps < math.inf:
        raise ValueError(f"--videos-fps must be a positive number of frames per second, got {flags.videos_fps:g}")
    if flags.videos_fps is not None and not flags.videos:
        raise ValueError("--videos-fps is of the videos that --videos writes; add --videos, or leave it out")
    if flags.check or flags.videos:
        av(), cv2()  # said now rather than when all is done
    _rates(flags, None)


def _rates(flags: Sync, cameras: int | None) -> list[float | None]:
    """Frames per second of each camera."""
    return camera_numbers("fps", flags.fps, cameras)


def _by(flags: Sync) -> By:
    """What of videos is compared."""
    of_method, by = BY[flags.method], flags.footage.by
    said = "sound" if flags.method == "sound" else of_method
    if "auto" not in (by, said) and by != said:
        raise ValueError(f"--by {by}: --method {flags.method} compares the {said} of videos; leave --by out")
    if by == "sound":
        return "pixels"
    return of_method if by == "auto" else by


def _method(flags: Sync) -> Method:
    return "sound" if flags.footage.by == "sound" else flags.method


def _camera_videos(flags: Sync, takes: list[Take]) -> list[CameraVideo] | None:
    """The videos to cut, looked for before the work."""
    return [video_of(take) for take in takes if not take.spatial] if flags.videos else None


def _read(flags: Sync, found: dict[str, Path], by: By, watched: Watched, trial: Trial | None = None) -> list[Take]:

    rates = _rates(flags, len(found)) if trial is None or flags.fps is not None else trial.rates()
    options: dict[str, Any] = {"person": flags.person, "min_confidence": flags.min_confidence, "by": by}
    options |= {"format": flags.format, "size": flags.size, "layout": flags.layout}
    try:
        takes = []
        for (name, path), rate in zip(found.items(), rates, strict=True):
            # a C3D file says all of it itself, and one --fps is of the files that do not
            own = path.suffix.lower() == ".c3d"
            how = {**options, "format": None, "size": None, "layout": None} if own else options
            rate = None if own and "," not in (flags.fps or "") else rate
            takes.append(take_of(path, name=name, fps=rate, keypoints=watched.files.get(path), **how))
        return takes if trial is None else trial.with_videos(takes)
    except ValueError as problem:
        raise ValueError(with_words(problem, WORDS)) from problem


def _repair_clocks(flags: Sync, report: SyncReport, done: Any, trial: Trial | None = None) -> SyncReport:
    """The report, where clocks broke with what is found when they are mended."""
    if not flags.breaks or _method(flags) not in ("auto", "keypoints"):
        return report
    lenses, _ = _lenses(flags, report.takes, trial)
    found = find_breaks(report.takes, report.compared, report.together, calibration=lenses, max_shift=flags.max_shift)
    if found is None:
        return report
    if found.is_attributed:
        again = _solve(flags, list(found.takes), done, trial)
        if again.ok >= report.ok and again.num_decided >= report.num_decided:
            return dataclasses.replace(again, takes=report.takes, remarks=report.remarks, mended=found)
    why = "fewer pairs decide when it is mended" if found.is_attributed else "other pairs of these cameras see nothing of it"
    doubts = [f"doubtful, and not mended, as {why}: {notice.text}" for notice in found.found.notices]
    return dataclasses.replace(report, remarks=[*report.remarks, *doubts])


def _lenses(flags: Sync, takes: Sequence[Take], trial: Trial | None) -> tuple[Any, tuple[str, ...]]:
    """The lenses of the cameras, and what to say about them."""
    called = [take.name for take in takes if not take.spatial]
    if flags.calibration is not None:
        return named_lenses(flags.calibration, called)
    return (None, ()) if trial is None else trial.lenses(called)


def _solve(flags: Sync, takes: list[Take], done: Any, trial: Trial | None = None) -> SyncReport:
    """All pairs, and what they say together."""
    lenses, told = _lenses(flags, takes, trial)
    options: dict[str, Any] = {"max_shift": flags.max_shift, "calibration": lenses, "rate": None if flags.rate else 1.0}
    options |= {"measure": flags.measure, "sound": flags.sound}
    total = len(takes) * (len(takes) - 1) // 2
    compared: dict[tuple[int, int], Pairing] = {}

    def compare(a: Take, b: Take, *_: Any, **__: Any) -> Any:
        try:
            found = compare_pair(a, b, _method(flags), **options)
        except ValueError as problem:
            said = problem.args[0] if problem.args else str(problem)
            known = said.startswith(tuple(str(word) for take in (a, b) for word in (take.name, take.path or take.name)))
            both = Message("{a} and {b}: {said}", a=a.name, b=b.name, said=said)
            raise ValueError(said if known else both) from problem
        compared[takes.index(a), takes.index(b)] = found
        done(len(compared) / total)
        return found.shift

    try:
        clocks = dyntorch.synchronize_cameras(takes, pair=compare) if len(takes) > 2 else None
        if clocks is None:
            compare(takes[0], takes[1])
    except ValueError as problem:
        # that of a pair says which cameras it is about by name, and so not by number
        of_pair = problem.__cause__ if len(takes) > 2 and problem.__cause__ is not None else problem
        raise ValueError(with_words(of_pair, WORDS)) from problem
    known: dict[str, Any] = {"remarks": [*(one.text for one in recording_notices(takes)), *told], "heading": flags.title or ""}
    return SyncReport(takes=takes, compared=compared, together=clocks, words=WORDS, **known)


def _write(
    flags: Sync, folder: Path, report: SyncReport, films: list[CameraVideo] | None = None, trial: bool = False
) -> SyncReport:
    """Write the shifted files and the cut videos where the data decide, and the check video where asked for."""
    prepare(folder)
    report, notes = _write_videos(flags, folder, report, films)  # first: what cannot be written is mostly this
    with progress("writing", steps=False):
        report, more = _write_poses(folder, report, trial)
        notes = more + notes
        report, more = _write_mocap(folder, report)
        notes += more
        videos: list[str] = []
        if flags.check and any(len(pair.shift.peaks) for pair in report.pairs):  # of the best candidate, sure or not
            videos, failed = write_checks(folder, report)
            notes += failed
        drop_checks(folder, videos)
    return dataclasses.replace(report, afterwards=notes, checks=videos)


def _write_videos(flags: Sync, folder: Path, report: SyncReport, films: list[CameraVideo] | None) -> tuple[SyncReport, list[str]]:
    """``synchronized_videos/``, if they are asked for and the data decide."""
    if films is None or not report.ok:
        removed = drop_videos(folder)
        why = "this one does not decide" if films is not None else "this one writes none"
        return report, [f"the videos of an earlier run in synchronized_videos were removed, because {why}"] if removed else []
    clocks = [clock for clock in report.clocks if not clock.take.spatial]
    if report.mended is not None:
        new = {take.name: take.times for take in report.mended.takes}
        films = [
            dataclasses.replace(film, times=frame_clock(clock.take, film.path, film.stamps, new[film.name]))
            for film, clock in zip(films, clocks, strict=True)
        ]
    chosen = trim(films, [clock.against(clocks[0]) for clock in clocks], flags.videos_fps)
    with progress(f"writing {count(len(films), 'video')} of {count(chosen.frames, 'frame')}") as done:
        write_videos(folder, chosen, done)
    return dataclasses.replace(report, videos=trim_as_json(chosen)), []


def _check_spatial(takes: list[Take], folder: Path | None, inputs: list[Path]) -> None:
    """Raise where there is more than one motion capture, or what is written of it would replace something."""
    spatial = [take for take in takes if take.spatial]
    if len(spatial) > 1:
        said = names([take.name for take in spatial])
        raise ValueError(f"{spatial[1].path or spatial[1].name}: {said} are both motion capture; give one, and cameras")
    if spatial and folder is not None:
        check_mocap(folder, inputs)


def _write_mocap(folder: Path, report: SyncReport) -> tuple[SyncReport, list[str]]:
    """``mocap-sync/``, if the data decide and its clock is not the reference itself, and what to say about it."""
    spatial = [i for i, clock in enumerate(report.clocks) if clock.take.spatial]
    removed = drop_mocap(folder)
    if not report.ok or spatial in ([], [0]):
        why = "this one writes none" if report.ok else "this one does not decide"
        return report, [f"{MOCAP_FOLDER} of an earlier run was removed, because {why}"] if removed else []
    clock = report.clocks[spatial[0]]
    one = retime_mocap(clock.take, clock.offset, clock.rate)
    if one is None:
        return report, [f"{clock.name} ended before number 0 of {report.reference.name}, so nothing is written of it"]
    notes = write_mocap(folder, one)
    told = {"folder": f"{MOCAP_FOLDER}/{one.name}", "files": 1, "shift": one.first, "rest": one.rest, "repeated": 0}
    told["left_out"] = one.first
    return dataclasses.replace(report, shifted={**report.shifted, spatial[0]: told}), notes


def _write_poses(folder: Path, report: SyncReport, trial: bool) -> tuple[SyncReport, list[str]]:
    """``pose-sync/``, if the data decide, and what to say about it."""
    poses = {i: clock for i, clock in enumerate(report.clocks) if clock.take.kind == "keypoints" and not clock.take.spatial}
    if not (report.ok and poses):
        removed = drop_poses(folder)
        return report, ["pose-sync of an earlier run was removed, because this one does not decide"] if removed else []
    first = report.clocks[shortest(report.takes)] if trial else report.reference
    # on the clock of motion capture frames are numbered as often as a camera takes them
    fps = next(iter(poses.values())).take.fps if first.take.spatial else first.take.fps
    plans = {}
    for i, clock in poses.items():
        told, times = clock.against(first), None if report.mended is None else report.mended.takes[i].times
        plans[i] = plan(clock.take, told.offset, told.rate, fps, times)
    write_poses(folder, list(plans.values()), numbers(list(plans.values())) if trial else None)
    notes = early(list(plans.values()), first.name)
    if trial and first is not report.reference:
        notes.append(f"frame numbers in pose-sync are those of {first.name}, the shortest recording, as in Pose2Sim")
    return dataclasses.replace(report, shifted={i: _frame_shift(one) for i, one in plans.items()}), notes


def early(plans: list[Plan], reference: str) -> list[str]:
    """Notes on frames that have no number, because they were taken before the reference's first."""
    said = [f"{count(one.before, 'frame')} of {one.take.name}" for one in plans if one.before]
    return [f"{names(said)} left out of pose-sync: taken before number 0 of {reference}"] if said else []


def _frame_shift(one: Plan) -> dict[str, Any]:
    return {
        "folder": f"pose-sync/{folder_of(one.take)}", "files": len(one.numbers), "shift": one.shift, "rest": one.rest,
        "repeated": one.num_repeated, "left_out": one.before,
    }  # fmt: skip


# ----------------------------------------------------------------------------------------------------------------------
# Videos to check by: the reference camera beside each of the others, at the same moments.


def check_names(cameras: Sequence[str]) -> list[str]:
    """The files' names: ``check.mp4`` for two cameras, one for each but the reference for more."""
    return ["check.mp4"] if len(cameras) == 2 else [f"check-{name}.mp4" for name in cameras[1:]]


def write_checks(folder: Path, report: SyncReport) -> tuple[list[str], list[str]]:
    """Write the videos: the names of those written, and notes on those that could not be."""
    written, notes, takes, found = [], [], report.takes, report.compared
    for i, name in enumerate(check_names([take.name for take in takes]), start=1):
        people = found[0, i].people if (0, i) in found else (0, 0)
        first, other = (_recording_of(take, person) for take, person in zip((takes[0], takes[i]), people, strict=True))
        try:
            write_check_video(folder / name, first, other, report.clocks[i], names=(takes[0].name, takes[i].name))
            written.append(name)
        except ValueError as problem:
            notes.append(f"{name} was not written: {problem}")
    return written, notes


def drop_checks(folder: Path, written: Sequence[str]) -> None:
    """Remove the check videos of an earlier run that this one did not write again: they show cameras of other files."""
    try:
        known = json.loads((folder / "sync.json").read_text(encoding="utf-8"))
        asked = known["manifest"]["arguments"]
        ours = asked["command"] == "sync" and asked["check"]
        names = check_names([str(camera["name"]) for camera in known["cameras"]]) if ours else []
    except (OSError, ValueError, KeyError, TypeError):
        return
    for name in set(names) - set(written):
        if Path(name).name == name:
            with contextlib.suppress(OSError):
                (folder / name).unlink()


def _recording_of(take: Take, person: int) -> Path | Clip:
    if take.kind == "keypoints" and take.video is None:
        return take.people[person]
    assert take.path is not None  # the command line has no frames without a file
    return take.path

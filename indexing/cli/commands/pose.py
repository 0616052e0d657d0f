"""``dyntorch pose``: videos to keypoints."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np

from indexing.cli.commands.archive import INTERRUPTED, PROBLEMS, check_workers
from indexing.cli.console import check_folder, complain, count, of_total, progress, say, table
from indexing.cli.flags.geometry import Pose
from indexing.clip import check_fps
from indexing.pose import models as files
from indexing.pose import writing
from indexing.pose.detection import VideoTask, workers_here
from indexing.pose.models import cache_folder
from indexing.pose.writing import KeypointFile


def run(flags: Pose) -> int:
    """Fetch, or look at every video, and say what became of it."""
    if flags.get_models:
        return _fetch(flags)
    if not flags.videos:
        raise ValueError("no videos; give video files, or --get-models")
    if flags.out is None:
        raise ValueError("-o is missing: say in which folder to write the keypoint files, as in -o pose/")
    for name, value in (("people", flags.people), ("every", flags.every)):
        if value < 1:
            raise ValueError(f"--{name} {value}: expected 1 or more")
    if flags.fps is not None:
        check_fps(flags.fps, "--")
    check_workers(flags.workers, None)
    folder = check_folder(flags.out)
    return _work(flags, folder)


def _fetch(flags: Pose) -> int:
    if flags.videos:
        raise ValueError("--get-models: fetches the model files and looks at no video; leave the videos out")
    with progress("fetching the model files", steps=False):
        done = files.get_models(flags.models)
    table(["file", ""], [[one.file, one.state] for one in done])
    for one in done:
        if one.state == "missing":
            say(f"note: {one.file} is not there: {one.why}")
    where = cache_folder() if flags.models is None else flags.models
    say(f"{where}: {count(sum(one.state != 'missing' for one in done), 'model file')}")
    return 0


def _work(flags: Pose, folder: Path) -> int:
    with progress("loading the networks", steps=False):
        models = files.load_models(flags.model, flags.models)
    tasks = [VideoTask(path.expanduser(), flags.people, flags.every, flags.fps, models.name) for path in flags.videos]
    workers = flags.workers or workers_here()
    begun, rows, notes, failed, done = time.perf_counter(), [], [], [], 0
    try:
        with progress("looking at " + count(len(tasks), "video")) as tell:
            for task, made in writing.keypoint_files(tasks, folder, models, workers, of_total(tell), flags.json):
                if isinstance(made, ValueError):
                    failed.append(made)
                    continue
                rows.append(_row(task, made))
                notes += _notes(task, made, flags.people)
                done += 0 if made.found is None else len(made.found.frames)
    except KeyboardInterrupt:
        complain(f"interrupted; what is finished is kept in {folder}, and the same command goes on from there")
        return INTERRUPTED
    seconds = time.perf_counter() - begun
    if rows:
        table(["video", "frames ", "seconds ", "people ", "with somebody ", "written"], rows)
    for note in notes:
        say(f"note: {note}")
    if rows:
        rate = f"; took {seconds:.1f} s, {done / seconds:.3g} frames a second" if done else ""
        say(f"model {models.name}, 33 joints (blazepose33), raw: not smoothed{rate}")
    for problem in failed:
        complain(str(problem))
    return PROBLEMS if failed else 0


def _row(task: VideoTask, made: KeypointFile) -> list[str]:
    """What there is of one video."""
    clips = made.clips
    times = np.unique(np.concatenate([clip.times for clip in clips])) if made.found is None else made.found.times
    seen = np.unique(np.concatenate([clip.times[clip.seen.any(axis=1)] for clip in clips]))
    files = str(made.path) if made.folder is None else f"{made.path}, {made.folder.name}/"
    length = f"{times[-1] - times[0]:.2f}"
    state = "there already: " if made.reused else ""
    return [task.path.name, f"{len(times):,}", length, str(len(clips)), f"{100 * len(seen) / len(times):.1f} %", state + files]


def _notes(task: VideoTask, made: KeypointFile, people: int) -> list[str]:
    """What a user should know of one video."""
    notes = [] if made.found is None else list(made.found.notes)
    several = made.clips[0].meta.get("people")
    if people == 1 and several is not None:
        notes.append(f"{several} people in view at once; the largest is followed, --people {several} follows more")
    return [f"{task.path}: {note}" for note in notes]

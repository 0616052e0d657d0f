"""Videos to check a synchronization by: the reference camera beside each of the others, at the same moments."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Sequence
from pathlib import Path

from indexing.clip import Clip
from indexing.report.sync import SyncReport
from indexing.sync.recordings import Take
from indexing.video import write_check_video


def names_of(cameras: Sequence[str]) -> list[str]:
    """The files' names: ``check.mp4`` for two cameras, one for each but the reference for more."""
    return ["check.mp4"] if len(cameras) == 2 else [f"check-{name}.mp4" for name in cameras[1:]]


def write_checks(folder: Path, report: SyncReport) -> tuple[list[str], list[str]]:
    """Write the videos: the names of those written, and notes on those that could not be."""
    written, notes, takes, found = [], [], report.takes, report.compared
    for i, name in enumerate(names_of([take.name for take in takes]), start=1):
        people = found[0, i].people if (0, i) in found else (0, 0)
        first, other = (_shown_recording(take, person) for take, person in zip((takes[0], takes[i]), people, strict=True))
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
        names = names_of([str(camera["name"]) for camera in known["cameras"]]) if ours else []
    except (OSError, ValueError, KeyError, TypeError):
        return
    for name in set(names) - set(written):
        if Path(name).name == name:
            with contextlib.suppress(OSError):
                (folder / name).unlink()


def _shown_recording(take: Take, person: int) -> Path | Clip:
    if take.kind == "keypoints" and take.video is None:
        return take.people[person]
    assert take.path is not None  # the command line has no frames without a file
    return take.path

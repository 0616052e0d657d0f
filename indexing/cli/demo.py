"""``dyntorch demo``: the whole way on built-in synthetic people."""

from __future__ import annotations

import dataclasses
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from indexing.cli.console import check_folder, check_report, count, progress, say, table

if TYPE_CHECKING:
    from indexing.demo import Demonstration


@dataclass(frozen=True)
class Demo:
    """Learn actions from ONE 2D clip each, recognize other people from other viewpoints, and write a report.

    Everything is made on the spot from synthetic people; nothing is downloaded.
    """

    out: Annotated[Path, tyro.conf.arg(metavar="FOLDER")] = Path("demo-report")
    """where to write the report"""
    seed: int = 0
    """of the people, their movements and the detector's errors"""
    people: Annotated[int, tyro.conf.arg(metavar="N")] = 12
    """how many other people are recognized"""

    examples: Annotated[Path | None, tyro.conf.arg(metavar="FOLDER", help_behavior_hint="")] = None
    """instead, write files to try all other commands on, and print these commands"""

    def run(self) -> int:
        """Perform, learn, recognize, search, report."""
        if self.examples is not None:
            return _examples(self.examples)
        started = time.perf_counter()
        folder = check_report(self.out, [])
        assert folder is not None
        with progress("starting", steps=False):
            from indexing.demo import demonstrate, report
            from indexing.files import manifest
            from indexing.report import write_recognition
        with progress("performing, learning, recognizing") as bar:
            shown = demonstrate(people=self.people, seed=self.seed, progress=bar)
        with progress("drawing the report", steps=False):
            made = manifest({"command": "demo", **dataclasses.asdict(self)}, seed=self.seed, timings=shown.timings)
            page = write_recognition(folder, report(shown, made))
        _show(shown)
        say(f"Report: {page}")
        say(f"Everything took {time.perf_counter() - started:.1f} s. Next: dyntorch index fit --help")
        return 0


def _examples(folder: Path) -> int:
    """Write the example files and print the commands that use them."""
    folder = check_folder(folder)
    with progress("making the examples", steps=False):
        from indexing.examples import write_examples

        commands = write_examples(folder)
    say(f"Examples: {folder}. Try there (commands.txt has these lines, too):")
    for command in commands:
        say(f"  {command}")
    return 0


def _show(shown: Demonstration) -> None:
    from indexing.report.results import frame_accuracy, missed

    say(f"Learned {count(len(shown.classes), 'action')} from ONE 2D clip each: one person, one camera, noisy keypoints.")
    others = "one other person" if shown.people == 1 else f"{shown.people} other people"
    say(f"Asked about {others}, seen by that camera and by others turned about the person:")
    rows = [[name, f"{ours:.0%}", f"{plain:.0%}"] for name, (ours, plain) in shown.accuracy().items()]
    table(["camera", "dyntorch ", "2D nearest neighbour "], rows)
    say(f"2D nearest neighbour: {shown.BASELINE}.")
    stream = shown.recording
    known = stream.truth or ()
    say(
        f"Searched {stream.duration:.0f} s of another person, camera turned by {shown.stream_azimuth:g} degrees: "
        f"{len(known) - len(missed(stream))} of {count(len(known), 'known action')} found, {len(stream.events)} reported; "
        f"{frame_accuracy(stream):.0%} of the frames in known actions are right."
    )
    times = shown.timings
    say(
        f"Learning took {times['learn']:.1f} s, recognizing {shown.queries:,} clips {times['recognize']:.1f} s, "
        f"searching {times['search']:.1f} s."
    )

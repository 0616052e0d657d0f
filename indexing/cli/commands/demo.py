"""``dyntorch demo``: the whole way on built-in synthetic people."""

from __future__ import annotations

import dataclasses
import time
from pathlib import Path

from indexing.cli.console import check_folder, check_report, count, progress, say, table
from indexing.cli.flags.cameras import Demo
from indexing.demo import Demonstration, demonstrate, report
from indexing.examples import write_examples
from indexing.files import manifest
from indexing.report import write_recognition
from indexing.report.results import frame_accuracy, missed_actions


def run(flags: Demo) -> int:
    """Perform, learn, recognize, search, report."""
    if flags.examples is not None:
        return _examples(flags.examples)
    started = time.perf_counter()
    folder = check_report(flags.out, [])
    assert folder is not None
    with progress("performing, learning, recognizing") as bar:
        shown = demonstrate(people=flags.people, seed=flags.seed, progress=bar)
    with progress("drawing the report", steps=False):
        made = manifest({"command": "demo", **dataclasses.asdict(flags)}, seed=flags.seed, timings=shown.timings)
        page = write_recognition(folder, report(shown, made))
    _show(shown)
    say(f"Report: {page}")
    say(f"Everything took {time.perf_counter() - started:.1f} s. Next: dyntorch index fit --help")
    return 0


def _examples(folder: Path) -> int:
    """Write the example files and print the commands that use them."""
    folder = check_folder(folder)
    with progress("making the examples", steps=False):
        commands = write_examples(folder)
    say(f"Examples: {folder}. Try there (commands.txt has these lines, too):")
    for command in commands:
        say(f"  {command}")
    return 0


def _show(shown: Demonstration) -> None:

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
        f"{len(known) - len(missed_actions(stream))} of {count(len(known), 'known action')} found, {len(stream.events)} reported; "
        f"{frame_accuracy(stream):.0%} of the frames in known actions are right."
    )
    times = shown.timings
    say(
        f"Learning took {times['learn']:.1f} s, recognizing {shown.queries:,} clips {times['recognize']:.1f} s, "
        f"searching {times['search']:.1f} s."
    )

"""``dyntorch index fit``: learn actions from example clips."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from indexing.action.indexer import ActionIndexer
from indexing.cli.console import check_file, check_report, count, names, present, progress, say, table
from indexing.cli.flags.recognition import Fit
from indexing.cli.flags.shared import Example, Reading
from indexing.cli.inputs import on_overlaps, on_range, parse_example, read_clips, read_examples, watch_videos
from indexing.cli.labels import check_labelling, film_examples, labelled_examples
from indexing.cli.videos import (
    NO_MODEL,
    are_sets,
    count_as_keypoints,
    frame_rate,
    is_video,
    pixel_indexer,
    read_video_examples,
    refuse_film_flags,
    refuse_keypoint_flags,
)
from indexing.clip import Clip
from indexing.files import manifest, prepare
from indexing.report.training import FILES, TrainingReport


def run(flags: Fit) -> int:
    """Read, learn, write, and say what was learned."""
    if not flags.examples:
        raise ValueError("no examples; give an action or more, such as squat=a.json lunge=b.json, or a clip set SET.npz")
    examples = [parse_example(text) for text in flags.examples]
    check_labelling(flags.labelling, examples, flags.unlabelled_is_background)
    paths = [example.path for example in examples] + list(flags.background) + list(flags.labelling.labels)
    output, folder = check_file(flags.output, paths), check_report(flags.report, paths, FILES)
    if not count_as_keypoints(flags.reading.footage, [example.path for example in examples]):
        return _from_pixels(flags, examples, output)
    refuse_film_flags(flags.pixels)
    reading = watch_videos(flags.reading, [*(example.path for example in examples), *flags.background], output.parent)
    with progress("reading", steps=False):
        clips, background, notes = _read(flags, examples, reading)
    notes = [*reading.watched.notes, *notes]
    started = time.perf_counter()
    with progress(f"learning from {count(len(clips), 'clip')}", steps=False):
        indexer = ActionIndexer(
            view=flags.view, weights=flags.weights, reject=flags.reject, mirror="auto" if flags.mirror else False,
            random_state=flags.seed,
        )  # fmt: skip
        indexer.fit(clips, [str(clip.label) for clip in clips], background=background or None)
    seconds = time.perf_counter() - started
    if flags.weights == "learned" and (indexer.groups_ is None or len(set(indexer.groups_)) < 2):
        notes.append("--weights learned: nobody could be left out (no field 'subject', or one person), so the usual weights stand")
    prepare(output.parent)
    indexer.save(output)
    about: dict[str, Any] = {}
    if folder is not None:
        about = manifest({"command": "index fit", **dataclasses.asdict(flags)}, [path.expanduser() for path in paths], flags.seed)
    return present(TrainingReport(indexer, clips, notes, [_written_text(output, seconds)], about), folder)


def _read(flags: Fit, examples: list[Example], reading: Reading) -> tuple[list[Clip], list[Clip], list[str]]:
    """Labelled clips, other movement, and what a person should know of them."""
    background = [clip for path in flags.background for clip in read_clips(reading, path)]
    if not flags.labelling.labels:
        clips, notes = read_examples(examples, reading, flags.select)
        return clips, background, notes
    given = [example for example in examples if example.label is not None]
    clips, notes = read_examples(given, reading, flags.select) if given else ([], [])
    paths = [example.path for example in examples if example.label is None]
    marked = labelled_examples(flags.labelling, paths, reading, flags.unlabelled_is_background, clips)
    return [*clips, *marked.clips], [*background, *marked.background], notes + marked.notes


def _from_pixels(flags: Fit, examples: list[Example], output: Path) -> int:
    """The same for videos."""
    refuse_keypoint_flags(flags, "view", "weights", "mirror", "seed", "report", "background", "unlabelled_is_background")
    with progress("reading", steps=False):
        notes = [] if flags.reading.footage.by == "pixels" or are_sets(examples) else [NO_MODEL]
        notes += on_overlaps(examples)
        if flags.labelling.labels:
            examples, said = film_examples(examples, flags.labelling, flags.reading)
            notes += said
        sources, labels, lengths = read_video_examples(examples, flags.reading, flags.select)
        if all(is_video(example.path) for example in examples):
            for example, seconds in zip(examples, lengths, strict=True):
                notes += on_range(example, 0.0, (example.start or 0.0) + seconds)
    _check_two(labels, examples)
    started = time.perf_counter()
    with progress(f"learning from {count(len(sources), 'video')}", steps=False):
        indexer = pixel_indexer(flags.pixels, frame_rate(sources), reject=flags.reject).fit(sources, labels)
    prepare(output.parent)
    indexer.save(output)
    lines = []
    for label in sorted(set(labels)):
        mine = [seconds for name, seconds in zip(labels, lengths, strict=True) if name == label]
        lines.append([label, len(mine), f"{sum(mine):.1f}"])
    table(["action", "examples ", "seconds "], lines)
    for note in [*notes, f"learned from pixels, at {indexer.fps:.3g} frames per second"]:
        say(f"note: {note}")
    say(_written_text(output, time.perf_counter() - started))
    return 0


def _check_two(labels: Sequence[str], examples: Sequence[Example]) -> None:
    if len(set(labels)) < 2:
        files = names([str(example.path) for example in examples])
        raise ValueError(f"{files}: only one action ({labels[0]}); give examples of two or more, such as ordinary movement")


def _written_text(output: Path, seconds: float) -> str:
    return f"learned in {seconds:.1f} s; model written to {output} ({max(1, round(output.stat().st_size / 1000)):,} kB)"

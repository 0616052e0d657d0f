"""``dyntorch index fit``: learn actions from example clips."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from indexing.cli.console import count, names, progress, say, table
from indexing.cli.films import Pixels, are_films, refuse_film_flags
from indexing.cli.inputs import Example, Reading, parse_example, read_examples
from indexing.cli.outputs import check_file, check_report

if TYPE_CHECKING:
    from indexing.clip import Clip
    from indexing.indexer import ActionIndexer


@dataclass(frozen=True)
class Fit:
    """Learn actions from example clips and write a model file.

    dyntorch index fit squat=a.json "lunge left"=b.json@1.5-4 -o moves.safetensors

    dyntorch index fit clips.npz --select view=1,2 -o moves.safetensors

    dyntorch index fit raise=a.mp4 wave=b.mp4@3-5 -o moves.safetensors      (videos: from pixels alone, no pose estimator)
    """

    examples: Annotated[tyro.conf.Positional[tuple[str, ...]], tyro.conf.arg(metavar="LABEL=FILE ...", help_behavior_hint="")]
    """keypoint files or OpenPose folders, or videos, one or more per label; label=file@1.5-4 uses these seconds; a labelled set:
    SET.npz"""
    output: Annotated[Path, tyro.conf.arg(aliases=("-o",), metavar="FILE")]
    """the model to write, usually *.safetensors"""
    select: Annotated[tyro.conf.UseAppendAction[tuple[str, ...]], tyro.conf.arg(metavar="FIELD=VALUES")] = ()
    """of clip sets, learn only from clips with these values, e.g. view=1,2"""
    view: Literal["any", "same"] = "any"
    """from where recordings will be seen: from anywhere, or from about where the examples were"""
    reject: Annotated[float | None, tyro.conf.arg(metavar="R", help_behavior_hint="")] = None
    """share of clips of unknown actions that may be taken for a known one, 0 to 1; any other number is the least score"""
    weights: Literal["equal", "learned"] = "equal"
    """of the kinds of evidence; learned: by what serves people best who are left out (clip sets with a field 'subject')"""
    report: Annotated[Path | None, tyro.conf.arg(metavar="FOLDER", help_behavior_hint="")] = None
    """where to write report.html and body_parts.png: which body parts tell the actions apart, and how the evidence is weighed"""
    mirror: bool = True
    """let examples count mirrored, too, where left and right are not different actions"""
    seed: int = 0
    """of the virtual views"""
    reading: Reading = field(default_factory=Reading)
    pixels: Pixels = field(default_factory=Pixels)

    def run(self) -> int:
        """Read, learn, write, and say what was learned."""
        if not self.examples:
            raise ValueError("no examples; give at least two actions, such as squat=a.json lunge=b.json, or a clip set SET.npz")
        examples = [parse_example(text) for text in self.examples]
        paths = [example.path for example in examples]
        output, folder = check_file(self.output, paths), check_report(self.report, paths)
        if are_films(paths):
            return self._from_pixels(examples, output)
        refuse_film_flags(self.pixels)
        with progress("reading", steps=False):
            clips, notes = read_examples(examples, self.reading, self.select)
        _check_two([str(clip.label) for clip in clips], examples)
        started = time.perf_counter()
        with progress(f"learning from {count(len(clips), 'clip')}", steps=False):
            from indexing.files import prepare
            from indexing.indexer import ActionIndexer

            indexer = ActionIndexer(
                view=self.view, weights=self.weights, reject=self.reject, mirror="auto" if self.mirror else False,
                random_state=self.seed,
            )  # fmt: skip
            indexer.fit(clips, [str(clip.label) for clip in clips])
        seconds = time.perf_counter() - started
        if self.weights == "learned" and (indexer.groups_ is None or len(set(indexer.groups_)) < 2):
            notes.append(
                "--weights learned: nobody could be left out (no field 'subject', or one person), so the usual weights stand"
            )
        prepare(output.parent)
        indexer.save(output)
        page = None if folder is None else self._write(folder, indexer, clips, notes, paths)
        _show(clips)
        for note in notes:
            say(f"note: {note}")
        code = _written(output, seconds)
        if page is not None:
            say(f"report: {page}")
        return code

    def _write(self, folder: Path, indexer: ActionIndexer, clips: list[Clip], notes: list[str], paths: list[Path]) -> Path:
        from indexing.files import manifest
        from indexing.report.learned import write_learned

        about = manifest({"command": "index fit", **dataclasses.asdict(self)}, [path.expanduser() for path in paths], self.seed)
        with progress("drawing the report", steps=False):
            return write_learned(folder, indexer, clips, notes, about)

    def _from_pixels(self, examples: list[Example], output: Path) -> int:
        """The same for videos."""
        from indexing.cli import films
        from indexing.files import prepare

        films.refuse_keypoint_flags(self, "view", "weights", "mirror", "seed", "report")
        with progress("reading", steps=False):
            sources, labels, lengths = films.read_examples(examples, self.reading, self.select)
        _check_two(labels, examples)
        started = time.perf_counter()
        with progress(f"learning from {count(len(sources), 'video')}", steps=False):
            indexer = self.pixels.indexer(films.frame_rate(sources), reject=self.reject).fit(sources, labels)
        prepare(output.parent)
        indexer.save(output)
        lines = []
        for label in sorted(set(labels)):
            mine = [seconds for name, seconds in zip(labels, lengths, strict=True) if name == label]
            lines.append([label, len(mine), f"{sum(mine):.1f}"])
        table(["action", "examples ", "seconds "], lines)
        say(f"note: learned from pixels, at {indexer.fps:.3g} frames per second")
        return _written(output, time.perf_counter() - started)


def _check_two(labels: Sequence[str], examples: Sequence[Example]) -> None:
    if len(set(labels)) < 2:
        files = names([str(example.path) for example in examples])
        raise ValueError(f"{files}: only one action ({labels[0]}); give examples of two or more, such as ordinary movement")


def _written(output: Path, seconds: float) -> int:
    say(f"learned in {seconds:.1f} s; model written to {output} ({max(1, round(output.stat().st_size / 1000)):,} kB)")
    return 0


def _show(clips: list[Clip]) -> None:
    groups: dict[str, list[Clip]] = {}
    for clip in clips:
        groups.setdefault(str(clip.label), []).append(clip)
    rows = []
    for label, mine in sorted(groups.items()):
        kinds = sorted({f"{clip.joints.shape[1]} in {clip.dims}D" for clip in mine})
        rows.append([label, len(mine), f"{sum(clip.duration for clip in mine):.1f}", ", ".join(kinds)])
    table(["action", "examples ", "seconds ", "joints "], rows)

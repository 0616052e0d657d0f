"""``dyntorch index fit``: learn actions from example clips."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from indexing.cli.console import count, names, progress, say, table
from indexing.cli.inputs import Reading, parse_example, read_examples
from indexing.cli.outputs import check_file

if TYPE_CHECKING:
    from indexing.clip import Clip


@dataclass(frozen=True)
class Fit:
    """Learn actions from example clips and write a model file.

    dyntorch index fit squat=a.json "lunge left"=b.json@1.5-4 -o moves.safetensors

    dyntorch index fit clips.npz --select view=1,2 -o moves.safetensors
    """

    examples: Annotated[tyro.conf.Positional[tuple[str, ...]], tyro.conf.arg(metavar="LABEL=FILE ...", help_behavior_hint="")]
    """keypoint files or OpenPose folders, one or more per label; label=file@1.5-4 uses these seconds; a labelled set: SET.npz"""
    output: Annotated[Path, tyro.conf.arg(aliases=("-o",), metavar="FILE")]
    """the model to write, usually *.safetensors"""
    select: Annotated[tyro.conf.UseAppendAction[tuple[str, ...]], tyro.conf.arg(metavar="FIELD=VALUES")] = ()
    """of clip sets, learn only from clips with these values, e.g. view=1,2"""
    view: Literal["any", "same"] = "any"
    """from where recordings will be seen: from anywhere, or from about where the examples were"""
    reject: Annotated[float | None, tyro.conf.arg(metavar="R", help_behavior_hint="")] = None
    """share of clips of unknown actions that may be taken for a known one, 0 to 1; any other number is the least score"""
    weights: Literal["equal", "learned"] = "equal"
    """of the channels that are compared"""
    mirror: bool = True
    """let examples count mirrored, too, where left and right are not different actions"""
    seed: int = 0
    """of the virtual views"""
    reading: Reading = field(default_factory=Reading)

    def run(self) -> int:
        """Read, learn, write, and say what was learned."""
        if not self.examples:
            raise ValueError("no examples; give at least two actions, such as squat=a.json lunge=b.json, or a clip set SET.npz")
        examples = [parse_example(text) for text in self.examples]
        output = check_file(self.output, [example.path for example in examples])
        with progress("reading", steps=False):
            clips, notes = read_examples(examples, self.reading, self.select)
        if len({str(clip.label) for clip in clips}) < 2:
            files = names([str(example.path) for example in examples])
            raise ValueError(
                f"{files}: only one action ({clips[0].label}); give examples of two or more, such as ordinary movement"
            )
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
        prepare(output.parent)
        indexer.save(output)
        _show(clips)
        for note in notes:
            say(f"note: {note}")
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

"""``dyntorch index suggest``: which parts of recordings to label next."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from indexing.cli.console import count, progress, say, table
from indexing.cli.inputs import Following, Lane, read_recordings
from indexing.cli.labels import UNCONFIRMED, Labelling, check_labelling, check_write, read_marked, write_to

if TYPE_CHECKING:
    from indexing.action.indexer import ActionIndexer
    from indexing.labels import Label
    from indexing.recordings.suggesting import Suggestion

TIER = "to label"


@dataclass(frozen=True)
class Suggest:
    """Say which parts of recordings to label next: what is unlike all that is known, and what might be either of two actions.

    Unlike: how far a part is from the nearest example, 0 to 1.  Margin: how much likelier the guess is than the next one.

    dyntorch index suggest session.json -m moves.safetensors --write todo.eaf

    dyntorch index suggest session.json -m moves.safetensors --labels session.boris --write todo.boris      (not what is labelled)
    """

    recordings: Annotated[tyro.conf.Positional[tuple[Path, ...]], tyro.conf.arg(metavar="FILE ...", help_behavior_hint="")]
    """keypoint files (a folder in OpenPose form is one recording)"""
    model: Annotated[Path, tyro.conf.arg(aliases=("-m",), metavar="FILE")]
    """what 'dyntorch index fit' wrote"""
    write: Annotated[Path | None, tyro.conf.arg(metavar="FILE", help_behavior_hint="")] = None
    """write the parts for the program in which you label: .eaf (ELAN), .boris, .csv, .tsv, or .json (ActivityNet); a guess is
    written as '? squat', and is learned only once you have corrected it"""
    number: Annotated[int, tyro.conf.arg(metavar="N")] = 10
    """how many parts"""
    labelling: Labelling = field(default_factory=Labelling)
    reading: Following = field(default_factory=Following)

    def run(self) -> int:
        """Read, compare, choose, print the parts and write them."""
        if not self.recordings:
            raise ValueError("no recordings; give at least one keypoint file or folder")
        if self.number < 1:
            raise ValueError(f"--number {self.number}: suggests nothing; give 1 or more")
        target = check_write(self.write, [*self.recordings, self.model], self.recordings, self.labelling.media, TIER)
        with progress("loading", steps=False):
            indexer, lanes, notes = self._read()
            done: list[list[Label] | None] = [None] * len(lanes)
            if self.labelling.labels:
                done, said = read_marked(self.labelling, lanes, self.reading)
                notes += said
            else:
                check_labelling(self.labelling, [], False)
        shown = [(lane, labels) for lane, labels in zip(lanes, done, strict=True) if lane.clip is not None]
        with progress("comparing") as bar:
            from indexing.recordings.suggesting import suggest

            spans = [[(one.start, one.end) for one in labels or ()] for _, labels in shown]
            found = suggest(indexer, [lane.clip for lane, _ in shown if lane.clip is not None], self.number, spans, progress=bar)
        if target is not None:
            notes += self._write(target, found, [lane for lane, _ in shown])
        _show(found, [lane for lane, _ in shown])
        for note in notes:
            say(f"note: {note}")
        if found:
            seconds = sum(one.end - one.start for one in found)
            say(f"{count(len(found), 'part')} to label ({seconds:.1f} s of recordings)")
        else:
            say("nothing to label: nobody moves in what is left")
        if target is not None:
            say(f"written: {target}")
        return 0

    def _read(self) -> tuple[ActionIndexer, list[Lane], list[str]]:
        """The model and the recordings, person by person."""
        from indexing.modelfile import model_kind

        if model_kind(self.model) == "dyntorch.brightness-indexer":
            raise ValueError(f"{self.model}: was learned from the pixels of videos; give a model that was learned from keypoints")
        from indexing.action.indexer import ActionIndexer

        indexer = ActionIndexer.load(self.model.expanduser())
        reading = self.reading.watching(self.recordings, None if self.write is None else self.write.parent)
        lanes, notes = read_recordings(self.recordings, reading, indexer.n_joints_, self.model, indexer.skeleton_)
        return indexer, lanes, [*reading.watched.notes, *notes]

    def _write(self, target: Path, found: Sequence[Suggestion], lanes: Sequence[Lane]) -> list[str]:
        """The parts as labels in a tier of their own; what the format does not keep."""
        from indexing.labels import Label

        alone = len(self.recordings) == 1
        labels = [
            Label(
                one.start, one.end, f"{UNCONFIRMED} {'' if one.guess is None else one.guess}".strip(), lanes[one.recording].person,
                media="" if alone else lanes[one.recording].name, comment=_why(one),
            )
            for one in sorted(found, key=lambda one: (one.recording, one.start))
        ]  # fmt: skip
        return write_to(target, labels, self.recordings, _duration(lanes), self.labelling, TIER)


def _duration(lanes: Sequence[Lane]) -> float | None:
    """Where the last frame is, where all lanes are of one recording."""
    return max(float(lane.times[-1]) for lane in lanes) if len({lane.name for lane in lanes}) == 1 else None


def _why(one: Suggestion) -> str:
    """Why a part was chosen, in words."""
    if one.reason == "either of two":
        return f"may be {one.guess} or {one.other}"
    return one.reason


def _show(found: Sequence[Suggestion], lanes: Sequence[Lane]) -> None:
    """The parts in the order in which they were chosen, with recording and person where there are several."""
    named = {"recording": len({lane.name for lane in lanes}) > 1, "person": any(lane.person for lane in lanes)}
    columns = [name for name, wanted in named.items() if wanted]
    rows: list[list[Any]] = []
    for one in found:
        lane = lanes[one.recording]
        whose = [lane.name] * named["recording"] + [lane.person] * named["person"]
        guess = "none of them" if one.guess is None else str(one.guess)
        rows.append([*whose, f"{one.start:.2f}", f"{one.end:.2f}", guess, f"{one.margin:.2f}", f"{one.unlike:.3f}", _why(one)])
    if rows:
        table([*columns, "start (s) ", "end (s) ", "guess", "margin ", "unlike ", "why"], rows)

"""``dyntorch index suggest``: which parts of recordings to label next."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from indexing.action.indexer import ActionIndexer
from indexing.cli.console import count, progress, say, table
from indexing.cli.flags.recognition import Suggest
from indexing.cli.inputs import Lane, read_recordings, watch_videos
from indexing.cli.labels import UNCONFIRMED, check_labelling, check_write, read_marked, write_to
from indexing.labels import Label
from indexing.modelfile import model_kind
from indexing.recordings.suggesting import Suggestion, suggest

TIER = "to label"


def run(flags: Suggest) -> int:
    """Read, compare, choose, print the parts and write them."""
    if not flags.recordings:
        raise ValueError("no recordings; give at least one keypoint file or folder")
    if flags.number < 1:
        raise ValueError(f"--number {flags.number}: suggests nothing; give 1 or more")
    target = check_write(flags.write, [*flags.recordings, flags.model], flags.recordings, flags.labelling.media, TIER)
    with progress("loading", steps=False):
        indexer, lanes, notes = _read(flags)
        done: list[list[Label] | None] = [None] * len(lanes)
        if flags.labelling.labels:
            done, said = read_marked(flags.labelling, lanes, flags.reading)
            notes += said
        else:
            check_labelling(flags.labelling, [], False)
    shown = [(lane, labels) for lane, labels in zip(lanes, done, strict=True) if lane.clip is not None]
    with progress("comparing") as bar:
        spans = [[(one.start, one.end) for one in labels or ()] for _, labels in shown]
        found = suggest(indexer, [lane.clip for lane, _ in shown if lane.clip is not None], flags.number, spans, progress=bar)
    if target is not None:
        notes += _write(flags, target, found, [lane for lane, _ in shown])
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


def _read(flags: Suggest) -> tuple[ActionIndexer, list[Lane], list[str]]:
    """The model and the recordings, person by person."""
    if model_kind(flags.model) == "dyntorch.brightness-indexer":
        raise ValueError(f"{flags.model}: was learned from the pixels of videos; give a model that was learned from keypoints")

    indexer = ActionIndexer.load(flags.model.expanduser())
    reading = watch_videos(flags.reading, flags.recordings, None if flags.write is None else flags.write.parent)
    lanes, notes = read_recordings(flags.recordings, reading, indexer.n_joints_, flags.model, indexer.skeleton_)
    return indexer, lanes, [*reading.watched.notes, *notes]


def _write(flags: Suggest, target: Path, found: Sequence[Suggestion], lanes: Sequence[Lane]) -> list[str]:
    """The parts as labels in a tier of their own; what the format does not keep."""
    alone = len(flags.recordings) == 1
    labels = [
        Label(
            one.start, one.end, f"{UNCONFIRMED} {'' if one.guess is None else one.guess}".strip(), lanes[one.recording].person,
            media="" if alone else lanes[one.recording].name, comment=_why(one),
        )
        for one in sorted(found, key=lambda one: (one.recording, one.start))
    ]  # fmt: skip
    return write_to(target, labels, flags.recordings, _duration(lanes), flags.labelling, TIER)


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

"""One action learned alone, from one clip: is it found among others, and does the rate that was asked for hold?

    DYNTORCH_DATA=../shared/data python -m experiments.recognition.one_action

Each action is learned from one clip of one person, with nothing else but what the indexer makes itself (synthetic people where
joints have names, and the clip played otherwise), and looked for in recordings of other people who do all actions, seen from
azimuth 0 and 90.  *Actors*: streams of synthetic actions with rests between them; the background that is made knows the same
actions, done by other people.  *Unnamed*: the same with joints that have no names, so that no synthetic people are in the
background.  *UTKinect, Florence3D*: all clips of one other person, one after the other; synthetic people are in the background of
real ones.  *With a recording*: one more person, who does all actions but this one, is given as ``background=``.

Found: share of the performances that one event covers, at an intersection over union of half.  False: of the performances of other
actions, how many share half of their time with an event; this is what ``reject`` asks for (.1 where nothing is said).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import tyro

from experiments.common.book import Book
from experiments.common.tables import command, note
from experiments.common.timing import threads
from experiments.recognition import protocol
from experiments.recognition.detection_metrics import overlap
from experiments.recognition.novelty import named
from indexing import ActionIndexer, Clip, ClipSet
from indexing.actors import ACTIONS, Person, dataset, detect, stream
from indexing.scoring import Event

TURNS = (0, 90)
PAUSE = 0.1  # seconds between joined clips
Source = Literal["actors", "unnamed", "utkinect", "florence3d"]


@dataclass(frozen=True)
class Config:
    """One action learned from one clip, looked for in recordings of others."""

    sets: tuple[Source, ...] = ("actors", "unnamed", "utkinect", "florence3d")
    """Which recordings; the last two are in the folder DYNTORCH_DATA."""
    rates: tuple[float, ...] = (0.1, 0.3)
    """False-alarm rates that are asked for."""
    recordings: int = 2
    """Recordings of other people, by set."""
    background: tuple[bool, ...] = (False, True)
    """Without and with a recording of other movement."""
    out: Annotated[Path, tyro.conf.arg(metavar="FOLDER")] = Path("results/one_action")
    """Where the tables are written (JSON)."""


@dataclass(frozen=True)
class Joined:
    """A recording in one view, and what happens in it."""

    clip: Clip
    truth: list[Event]


@dataclass(frozen=True)
class Search:
    """What is learned, one clip per action; where it is looked for, by azimuth; and a recording of somebody else."""

    examples: dict[str, Clip]
    asked: dict[int, list[Joined]]
    other: list[Clip]


@dataclass
class Tally:
    """Of all actions and recordings: performances and how many were found, others and how many were taken for them."""

    known: int = 0
    found: int = 0
    others: int = 0
    taken: int = 0
    wrong: int = 0
    seconds: float = 0.0

    def add(self, label: str, events: Sequence[Event], recording: Joined) -> None:
        """One action in one recording."""
        mine = [one for one in recording.truth if one.label == label]
        rest = [one for one in recording.truth if one.label != label]
        shares = overlap(events, mine)
        hit = shares.max(axis=0) >= 0.5 if len(events) and mine else np.zeros(len(mine), dtype=bool)
        right = shares.max(axis=1) >= 0.5 if len(events) and mine else np.zeros(len(events), dtype=bool)
        covered = [sum(max(0.0, min(e.end, r.end) - max(e.start, r.start)) for e in events) / (r.end - r.start) for r in rest]
        self.known, self.found = self.known + len(mine), self.found + int(hit.sum())
        self.others, self.taken = self.others + len(rest), self.taken + sum(share > 0.5 for share in covered)
        self.wrong, self.seconds = self.wrong + int((~right).sum()), self.seconds + recording.clip.duration

    @property
    def row(self) -> list[float]:
        """Found, false, precision, false alarms per minute."""
        right = max(1, self.found + self.wrong)
        return [
            self.found / max(1, self.known),
            self.taken / max(1, self.others),
            self.found / right,
            60 * self.wrong / self.seconds,
        ]


def actors(recordings: int, named: bool) -> Search:
    """Synthetic people."""

    def plain(clip: Clip) -> Clip:
        return clip if named else clip.replace(skeleton=None)

    rng = np.random.default_rng(21)
    learned = dataset([Person.random(rng)], ACTIONS, rng=rng)
    asked: dict[int, list[Joined]] = {turn: [] for turn in TURNS}
    for _ in range(recordings):
        clip, truth = stream(list(rng.permutation(ACTIONS)), Person.random(rng), rng=rng)
        events = [Event(label, start, end, 0.0, 0.0) for label, start, end in truth]
        for turn in TURNS:
            asked[turn].append(Joined(plain(detect(clip, azimuth=turn, rng=rng)), events))
    other = dataset([Person.random(rng)], ACTIONS, azimuth=30.0, rng=rng)
    return Search({str(clip.label): plain(clip) for clip in learned}, asked, [plain(clip) for clip in other])


def people(name: str, recordings: int) -> Search:
    """Clips of a set: learned from its first subject, looked for in all clips of others, joined; another one is given."""
    rendered = protocol.render(ClipSet([named(clip, name) for clip in protocol.load_set(name)]), 0, turns=TURNS)
    subjects = np.unique(rendered.subjects)
    first = np.flatnonzero(rendered.subjects == subjects[0])
    examples = {str(rendered.labels[i]): rendered.exemplars[i] for i in first[::-1]}
    asked: dict[int, list[Joined]] = {turn: [] for turn in TURNS}
    for subject in subjects[2 : 2 + recordings]:
        theirs = np.random.default_rng(0).permutation(np.flatnonzero(rendered.subjects == subject))
        for turn in TURNS:
            asked[turn].append(joined([rendered.queries[turn][i] for i in theirs], rendered.labels[theirs]))
    second = np.flatnonzero(rendered.subjects == subjects[1])
    other = [rendered.queries[0][i].replace(label=str(rendered.labels[i])) for i in second]
    return Search(examples, asked, other)


def joined(clips: Sequence[Clip], labels: protocol.Array) -> Joined:
    """Clips one after the other, each where the last one stood."""
    times, parts, truth, at = [], [], [], 0.0
    for clip, label in zip(clips, labels, strict=True):
        middle = np.nanmedian(clip.joints, axis=(0, 1), keepdims=True)
        own = clip.times - clip.times[0]
        truth.append(Event(str(label), at, at + float(own[-1]), 0.0, 0.0))
        times.append(at + own)
        parts.append(clip.joints - middle)
        at += float(own[-1]) + PAUSE
    return Joined(clips[0].replace(joints=np.concatenate(parts), times=np.concatenate(times), confidence=None, label=None), truth)


def search(name: Source, config: Config) -> Search:
    """The recordings of one set."""
    return actors(config.recordings, name == "actors") if name in ("actors", "unnamed") else people(name, config.recordings)


def measure(task: Search, given: bool, config: Config) -> tuple[dict[tuple[int, float], Tally], list[str]]:
    """By azimuth and rate; and the actions that could not be learned."""
    tallies = {(turn, rate): Tally() for turn in TURNS for rate in config.rates}
    refused = []
    for label, clip in task.examples.items():
        other = [one.replace(label=None) for one in task.other if str(one.label) != label] if given else None
        try:
            indexer = ActionIndexer().fit([clip], [label], background=other)
        except ValueError:
            refused.append(label)
            continue
        for rate in config.rates:
            indexer.set_params(reject=rate)._calibrate()
            for turn, recordings in task.asked.items():
                for recording in recordings:
                    tallies[turn, rate].add(label, indexer.find(recording.clip), recording)
    return tallies, refused


def tables(name: Source, config: Config, book: Book) -> None:
    """Measure one set."""
    task = search(name, config)
    lines: dict[str, list[float]] = {}
    for given in config.background:
        words = "with a recording" if given else "alone"
        note(f"... {name}, {words}")
        tallies, refused = measure(task, given, config)
        if refused:
            note(f"{name}, {words}: not learned, nothing to tell it from: {', '.join(refused)}")
        lines |= {f"{words}, {turn}°, asked {rate:g}": tally.row for (turn, rate), tally in tallies.items()}
    book.grid(f"{name}, one clip of one action", ["found", "false", "precision", "false a minute"], lines)


def run(config: Config) -> None:
    """Print the tables and write the file.

    Raises:
        ValueError: no set, a rate that is none, or no data folder.
    """
    if not config.sets or not config.background or config.recordings < 1:
        raise ValueError("sets and background must name at least one each, and recordings be at least 1")
    if not config.rates or not all(0 < rate < 1 for rate in config.rates):
        raise ValueError(f"rates must be between 0 and 1, at least one, got {config.rates}")
    book = Book(config.out)
    real = [name for name in config.sets if name not in ("actors", "unnamed")]
    inputs = [protocol.data_folder() / f"{name}.npz" for name in real]
    with threads(1):
        for name in config.sets:
            tables(name, config, book)
    book.close(vars(config), inputs)


if __name__ == "__main__":
    command(lambda: run(tyro.cli(Config, prog="python -m experiments.recognition.one_action")))

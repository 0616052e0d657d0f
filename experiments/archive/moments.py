"""The same moment asked from another camera: which place in an archive of 300,000 windows comes first.

    DYNTORCH_DATA=../shared/data python -m experiments.archive.moments

The archive holds thirty captured takes (CMU) and *distractors* (:mod:`experiments.archive.scenes`: people put together of the
lower body of one take and the upper body of another, at other tempi, mirrored, with other limbs), each filmed once, from anywhere.
A query is a moment of a take, filmed by another camera with another clock and other noise.  It is found where a hit lies on the
same moment of the same take: their middles a quarter of the duration apart, or .15 s.  Recall@k: share of the queries whose first k
hits hold one.

*Archive* is :meth:`indexing.Archive.search` as it is; *exhaustive* compares every window on a grid of .1 s exactly, by the same
residual (also with the durations that the archive tries, as somebody searches who does not know that the tempo is the same); both
merge neighbours alike.  *Sketches* ranks by the archive's sketches alone, without the exact comparison.  *2D cosine*: plain poses
about the window's middle; *heights*: their heights about each frame's middle.  The other tables ask in other ways: by cameras that
are rolled, that look from the ceiling, or do not see every joint; with fewer or more candidates, and without parts of the search.
"""

from __future__ import annotations

import contextlib
import dataclasses
import tempfile
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np

from experiments.archive.exhaustive import cosine, exact, hits, metric_of, rankings
from experiments.archive.scenes import (
    CEILING,
    ROLLED,
    Cameras,
    Question,
    Takes,
    captured,
    distractors,
    every_take,
    questions,
)
from experiments.common.runner import BaseConfig, Grid, Tables, experiment
from experiments.common.tables import Row, note
from experiments.recognition.corruptions import missing_bursts
from indexing import Archive, Clip, ClipSet
from indexing.archive import search
from indexing.archive.search import Hit, candidates, check_example, merge_candidates, queries_of, suppress_overlaps

AT = (1, 10)
STEP = 0.1  # seconds between the windows that are counted, and compared exhaustively
NEAR, LEAST = 0.25, 0.15  # of the duration, and seconds, between the middles of a hit and of the moment asked for
GOAL_FIRST, GOAL_TEN, GOAL_SHARE = 0.78, 0.93, 0.95
LOST = 0.2  # share of joints
ARCHIVE, SKETCHES, EXHAUSTIVE, PLAIN = "archive", "sketches", "exhaustive", "2D cosine"
WIDE, HEIGHTS = "exhaustive, other tempi, too", "heights"
WAYS = ARCHIVE, EXHAUSTIVE, WIDE, SKETCHES, PLAIN, HEIGHTS


@dataclass(frozen=True)
class Config(BaseConfig):
    """Recall of an archive's search on captured moments among distractors, of the folder DYNTORCH_DATA."""

    windows: int = 300_000
    """Windows of the archive, on a grid of .1 s."""
    queries: int = 200
    """Of each duration and of each way to ask."""
    durations: tuple[float, ...] = (1.0, 2.0, 0.6, 4.0)
    """Seconds of a query."""
    candidates: tuple[int, ...] = (100, 300, 1000, 3000)
    """How many windows are compared exactly, in the last table."""
    asked: float = 1.0
    """Seconds of a query in the tables after the first."""


# ---- what is right -----------------------------------------------------------------------------------------------------
def place(found: Iterable[Hit], question: Question) -> float:
    """Of the first hit that lies on the moment asked for, from 0; infinite where there is none."""
    middle, duration = (question.start + question.end) / 2, question.end - question.start
    for number, hit in enumerate(found):
        away = abs((hit.start + hit.end) / 2 - middle)
        if hit.source == question.source and away <= max(NEAR * duration, LEAST):
            return number
    return np.inf


def recall(places: Sequence[float]) -> list[float]:
    """Share of the places below each of AT."""
    return [float(np.mean(np.array(places) < k)) for k in AT]


# ---- ways to ask -------------------------------------------------------------------------------------------------------
def searched(archive: Archive, asked: Sequence[Question], mirror: bool = False) -> list[float]:
    """Places of the right hits, as somebody sees them who asks for ten."""
    return [place(archive.search(one.clip, k=10, mirror=mirror), one) for one in asked]


def sketched(archive: Archive, asked: Sequence[Question]) -> list[float]:
    """Places by the archive's sketches: the stages of a search before the exact comparison, neighbours merged."""
    snapshot = archive._open_snapshot()
    places = []
    for one in asked:
        queries = queries_of(check_example(one.clip, snapshot.contents.storage.min_duration), snapshot.contents)
        found = candidates(snapshot.tasks(queries, search.MAX_SCANNED_WINDOWS), None, None)
        pool = suppress_overlaps(snapshot, merge_candidates(snapshot, queries, found, archive.options.num_candidates))
        places.append(place(archive._hits(snapshot, pool), one))
    return places


def compared(archive: Archive, clips: Sequence[Clip], asked: Sequence[Question], ways: Sequence[str]) -> dict[str, list[float]]:
    """Places where everything is compared with everything; all queries are of one duration."""
    duration = asked[0].clip.duration
    residual = exact(metric_of(archive))
    measures = {EXHAUSTIVE: residual, PLAIN: cosine(heights=False), HEIGHTS: cosine(heights=True)}
    queries = [one.clip for one in asked]
    found = rankings(queries, clips, duration, {name: measures[name] for name in ways if name in measures}, (1.0,), STEP)
    if WIDE in ways:
        found |= rankings(queries, clips, duration, {WIDE: residual}, step=STEP)
    return {
        name: [place(hits(one, clips, max(AT)), question) for one, question in zip(each, asked, strict=True)]
        for name, each in found.items()
    }


def bounded(archive: Archive, count: int) -> Archive:
    """The same archive, of which so many candidates are compared exactly."""
    return Archive(archive.path, dataclasses.replace(archive.options, num_candidates=count))


# ---- tables ------------------------------------------------------------------------------------------------------------
def by_duration(archive: Archive, clips: Sequence[Clip], people: Takes, config: Config) -> Grid:
    """Every way to compare, at every duration."""
    lines: dict[str, list[float]] = {name: [] for name in WAYS}
    rows: list[Row] = []
    for duration in config.durations:
        note(f"... {duration:g} s")
        asked = questions(people, duration, config.queries, np.random.default_rng([config.seed, 1]))
        found = compared(archive, clips, asked, WAYS)
        found |= {ARCHIVE: searched(archive, asked), SKETCHES: sketched(archive, asked)}
        for name in WAYS:
            lines[name] += [*recall(found[name])]
        first, ten = recall(found[ARCHIVE])[:2]
        if duration == 1.0:
            rows += [Row("moment of 1 s", "recall@1", first, GOAL_FIRST), Row("moment of 1 s", "recall@10", ten, GOAL_TEN)]
        goal = GOAL_SHARE * recall(found[EXHAUSTIVE])[1]
        rows.append(Row(f"moment of {duration:g} s", "recall@10, .95 of exhaustive", ten, goal))
    columns = [f"{duration:g} s @{k}" for duration in config.durations for k in AT]
    return Grid(columns, lines, rows)


def by_difficulty(archive: Archive, clips: Sequence[Clip], people: Takes, config: Config) -> Tables:
    """Moments of one duration, asked in other ways."""

    def drawn(cameras: Cameras) -> list[Question]:
        return questions(people, config.asked, config.queries, np.random.default_rng([config.seed, 2]), cameras)

    usual, rng = drawn(Cameras()), np.random.default_rng([config.seed, 3])
    ways = {
        "as they are": usual,
        "rolled by 30 degrees": drawn(ROLLED),
        "from the ceiling, 60 degrees": drawn(CEILING),
        "a fifth of the joints never seen": [blinded(one, rng) for one in usual],
        "a fifth of the joints missing, in bursts": [
            dataclasses.replace(one, clip=missing_bursts(one.clip, LOST, rng)) for one in usual
        ],
    }
    lines: dict[str, list[float]] = {}
    for title, asked in ways.items():
        note(f"... {title}")
        wide = compared(archive, clips, asked, [EXHAUSTIVE, HEIGHTS])
        found = [searched(archive, asked), sketched(archive, asked), wide[EXHAUSTIVE], wide[HEIGHTS]]
        lines[title] = [share for places in found for share in recall(places)]
    columns = [f"{name} @{k}" for name in (ARCHIVE, SKETCHES, EXHAUSTIVE, HEIGHTS) for k in AT]
    yield f"moments of {config.asked:g} s, asked in other ways", Grid(columns, lines)
    changed: dict[str, tuple[Archive, dict[str, Any]]] = {
        f"{count} candidates": (bounded(archive, count), {}) for count in config.candidates
    }
    changed |= {"nothing refined": (archive, {"SHIFTS": (0.0,)})}
    changed |= {"the query's tempo only": (archive, {"TEMPOS": (1.0,)})}
    options = {}
    for title, (other, constants) in changed.items():
        note(f"... {title}")
        clock = time.perf_counter()
        with contextlib.ExitStack() as stack:
            for constant, value in constants.items():
                stack.enter_context(mock.patch.object(search, constant, value))
            places = searched(other, usual)
        options[title] = [*recall(places), (time.perf_counter() - clock) / len(usual)]
    places = searched(archive, usual, mirror=True)
    options["mirror images, too"] = [*recall(places), np.nan]
    yield f"moments of {config.asked:g} s, searched in other ways", Grid([*(f"@{k}" for k in AT), "s a query"], options)


def blinded(question: Question, rng: np.random.Generator) -> Question:
    """A fifth of the joints, drawn at random, is not seen in any frame."""
    joints = question.clip.joints.copy()
    joints[:, rng.permutation(joints.shape[1])[: round(LOST * joints.shape[1])]] = np.nan
    return dataclasses.replace(question, clip=question.clip.replace(joints=joints))


def recorded(config: Config, people: Takes) -> list[Clip]:
    """The archive's recordings: all takes, and distractors until there are enough windows.

    Raises:
        ValueError: the takes alone are more windows than are asked for.
    """
    rng = np.random.default_rng([config.seed, 0])
    clips = every_take(people, rng)
    left = config.windows * STEP - sum(clip.duration for clip in clips)
    if left < 0:
        raise ValueError(f"windows: the takes alone are {sum(len(c) for c in clips) // 3}, got {config.windows}; give more")
    return [*clips, *distractors(people, left, rng)]


@experiment(Config(), quick={"queries": 2, "durations": (1.0,)}, one_thread=False)
def tables(config: Config) -> Tables:
    """Recall of an archive's search on captured moments among distractors.

    Raises:
        ValueError: no data folder, or fewer windows than the takes have.
    """
    people = captured()
    clips = recorded(config, people)
    with tempfile.TemporaryDirectory() as folder:
        archive = Archive(Path(folder) / "moments.archive")
        note(f"... adding {len(clips)} recordings")
        archive.add(ClipSet(clips))
        title = f"the same moment by another camera, {config.windows:,} windows, {config.queries} queries each"
        yield title, by_duration(archive, clips, people, config)
        yield from by_difficulty(archive, clips, people, config)

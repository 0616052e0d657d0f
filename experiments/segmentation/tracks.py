"""Segmentation of the tracks of whole videos into bodies: KT3DMoSeg, Hopkins155, MTPV62, and streets made for it.

    DYNTORCH_DATA=../shared/data python -m experiments.segmentation.tracks
    DYNTORCH_DATA=../shared/data python -m experiments.segmentation.tracks --only kt3d --quick

Errors are misclassifications in percent: the share of all tracks, short ones included, whose label is not the true one under the
best assignment of the bodies found (:func:`dyntorch.metrics.misclassification`); a track that is called an outlier and is none
counts as an error.  :func:`dyntorch.segment_tracks` runs with its default parameters, the same for all sets, on one thread, with
the number of bodies given ("K known") and without ("K unknown").  The recordings are the shared halves of their sets: published
figures are of whole sets.

- **kt3d**: 12 street sequences of KT3DMoSeg, 10 to 20 frames.  **kt3d_two_views**: their first and last frame only, by
  :func:`dyntorch.segment`, then by :func:`dyntorch.segment_tracks`: the tracks and bodies that both show.
- **hopkins**: 86 sequences of Hopkins155.  **mtpv**: 6 of MTPV62; its label 0 is an outlier; "bodies' tracks" leaves these out.
- **streets**: made by :func:`dyntorch.scenes.streets`, 2 to 4 bodies, 20 frames, 500 tracks, with .5 px of noise; **quiet_streets**
  with .1.  **other_streets**: of other kinds (``OTHERS``), which nothing was tuned to.  **streets_two_views**: two frames of the
  streets, 6 apart, by :func:`dyntorch.segment`.
- **time**: of one call.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from statistics import fmean, median

import torch

import dyntorch as dyn
from dyntorch.metrics import misclassification
from dyntorch.scenes import StreetOptions, streets
from experiments.common.runner import SceneConfig, Tables, experiment
from experiments.common.tables import Row, note
from experiments.common.timing import threads
from experiments.segmentation.data import Pair, Tracks, hopkins_tracks, kt3d_tracks, mtpv_tracks

WORST = 5
APART = 6
"""Frames between the two of a street, of 20: most tracks are in 5 to 12 frames."""
LIKE_KITTI = StreetOptions()
OTHERS: dict[str, tuple[int, StreetOptions]] = {
    "night": (200, StreetOptions(texture=0.15, road=0.1, loss=0.08, members=12)),
    "sharp turns": (500, StreetOptions(turn=(0.025, 0.05), junction=(3.0, 12.0))),
    "standing camera": (500, StreetOptions(speed=(0.0, 0.0), steering=0.0, turn=(0.0, 0.0), pitch=0.0005)),
    "buses": (500, StreetOptions(buses=0.7)),
    "stopping cars": (500, StreetOptions(traffic=("stopping", "stopping", "oncoming", "crossing"))),
    "fast road": (400, StreetOptions(speed=(1.8, 3.0), traffic=("slower", "faster", "equal", "oncoming"), steering=0.003)),
}
"""Tracks and kind of street."""


PUBLISHED = """
Published figures, nothing of theirs was run here. What could be read of them:
  KT3DMoSeg: 22 clips of KITTI, 10 to 20 frames; tracks under 5 frames were removed, the labelled, sparse ones are evaluated;
  results of Xu, Cheong and Li (CVPR 2018) vary with random hypotheses (Readme of their code, alex-xun-xu/MultiViewMoSeg);
  Hopkins155, all sequences: 3 % wrong, the best of the time 1.2 % (abstract of Flores-Mangas' thesis, Toronto), 4.8 % (abstract of
  Goh and Vidal, CVPR 2007).
Not verified, from memory only, their tables could not be read here: KT3DMoSeg 7.9 to 8.5 %, MTPV62 1 to 5 %, Hopkins155 .3 to 2 %
  (Xu, Cheong and Li 2018 and followers); KT3DMoSeg from two frames, Prog-X about 15 %."""


@dataclass(frozen=True)
class Config(SceneConfig):
    """Segmentation of tracks into bodies, on the recordings in the folder DYNTORCH_DATA and on streets made for it."""

    only: tuple[str, ...] = ()
    """Names of tables; all where none is named."""
    first: int = 1000
    """Seed of the first street."""


@dataclass(frozen=True)
class Outcome:
    """One run: percent misclassified of all tracks and of those of bodies, bodies found and true ones, seconds."""

    name: str
    error: float
    inlier_error: float
    bodies: int
    truth: int
    seconds: float


@dataclass(frozen=True)
class Goals:
    """Percent: mean and median misclassification at most, share of right numbers of bodies at least."""

    mean: float | None = None
    median: float | None = None
    right: float | None = None


NO_GOALS = Goals()


def segmented(video: Tracks, bodies: int | None, seed: int = 0) -> Outcome:
    """Segment a video and compare with the truth."""
    clock = time.perf_counter()
    found = dyn.segment_tracks(video.tracks, bodies, generator=torch.Generator().manual_seed(seed))
    return _outcome(video, found.labels, int(found.bodies), time.perf_counter() - clock, "unknown" if bodies is None else "known")


def paired(pair: Pair, bodies: int | None, seed: int = 0) -> Outcome:
    """Segment two frames and compare with the truth."""
    clock = time.perf_counter()
    found = dyn.segment(pair.x1, pair.x2, bodies, generator=torch.Generator().manual_seed(seed))
    return _outcome(pair, found.labels, int(found.bodies), time.perf_counter() - clock, "two views")


def _outcome(truth: Tracks | Pair, labels: torch.Tensor, bodies: int, seconds: float, what: str) -> Outcome:
    body = truth.labels > 0
    error, inlier_error = (100 * float(misclassification(a, b)) for a, b in _cases(labels, truth.labels, body))
    note(f"    {truth.name}, {what}: {error:.2f} %, {bodies} of {truth.bodies} bodies, {seconds:.2f} s")
    return Outcome(truth.name, error, inlier_error, bodies, truth.bodies, seconds)


def _cases(labels: torch.Tensor, truth: torch.Tensor, body: torch.Tensor) -> list[tuple[torch.Tensor, torch.Tensor]]:
    return [(labels, truth), (labels[body], truth[body])]


def rows(title: str, found: Sequence[Outcome], goals: Goals = NO_GOALS, known: bool = True, worst: int = WORST) -> list[Row]:
    """Mean and median error, the share of right numbers where the number was not given, seconds, and the worst."""
    errors, seconds = [run.error for run in found], [run.seconds for run in found]
    setting = f"{len(found)} {'sequence' if len(found) == 1 else 'sequences'}"
    table = [
        Row(f"{title}, mean error", setting, fmean(errors), goals.mean, at_most=True, unit=" %"),
        Row(f"{title}, median error", setting, median(errors), goals.median, at_most=True, unit=" %"),
    ]
    if any(run.inlier_error != run.error for run in found):
        table.append(Row(f"{title}, mean error", "bodies' tracks", fmean(run.inlier_error for run in found), unit=" %"))
    if not known:
        right = 100 * fmean(run.bodies == run.truth for run in found)
        table.append(Row(f"{title}, K right", setting, right, goals.right, unit=" %"))
    table.append(Row(f"{title}, time", f"median; worst {max(seconds):.2f} s", median(seconds), unit=" s"))
    for run in sorted((run for run in found if run.error > 0), key=lambda run: -run.error)[:worst]:
        number = f"{run.truth} bodies" if known else f"{run.bodies} of {run.truth} bodies"
        table.append(Row(f"{title}, worst", f"{run.name}; {number}", run.error, unit=" %"))
    return table


def _both(videos: Sequence[Tracks], config: Config, known: Goals, unknown: Goals, title: str = "", worst: int = WORST) -> list[Row]:
    given = [segmented(video, video.bodies, config.seed) for video in videos]
    found = [segmented(video, None, config.seed) for video in videos]
    return [
        *rows(f"{title}K known", given, known, worst=worst),
        *rows(f"{title}K unknown", found, unknown, known=False, worst=worst),
    ]


def kt3d(config: Config) -> list[Row]:
    """KT3DMoSeg, whole sequences."""
    return _both(kt3d_tracks()[:: 4 if config.quick else 1], config, Goals(3.0), Goals(6.0))


def kt3d_two_views(config: Config) -> list[Row]:
    """KT3DMoSeg, first and last frame."""
    pairs = [video.pair() for video in kt3d_tracks()[:: 4 if config.quick else 1]]
    videos = [Tracks(pair.name, torch.stack([pair.x1, pair.x2]), pair.labels) for pair in pairs]
    return [
        *rows("K known", [paired(pair, pair.bodies, config.seed) for pair in pairs], Goals(6.0)),
        *rows("segment_tracks of both, K known", [segmented(video, video.bodies, config.seed) for video in videos], Goals(6.0)),
    ]


def hopkins(config: Config) -> list[Row]:
    """Hopkins155, whole sequences."""
    return _both(hopkins_tracks()[:: 8 if config.quick else 1], config, Goals(0.3), Goals(0.8, right=95.0))


def mtpv(config: Config) -> list[Row]:
    """MTPV62, whole sequences."""
    return _both(mtpv_tracks()[:: 4 if config.quick else 1], config, Goals(1.0), Goals(3.0))


def made_streets(
    config: Config, options: StreetOptions = LIKE_KITTI, tracks: int = 500, later: int = 0, sigma: float = 0.5
) -> list[Tracks]:
    """Streets of 2, 3, 4, 2, ... bodies with noise ``sigma`` px; their seeds begin ``later`` than the configuration says."""
    found = []
    for number in range(config.scenes):
        seed = config.first + later + number
        draw = torch.Generator().manual_seed(seed)
        street = streets(2 + number % 3, tracks=tracks, sigma=sigma, options=options, generator=draw)
        found.append(Tracks(f"street {seed}: {', '.join(street.kinds)}", street.tracks, street.labels))
    return found


def street_table(config: Config) -> list[Row]:
    """Streets like KT3DMoSeg's."""
    return _both(made_streets(config), config, Goals(4.0, 1.0), NO_GOALS)


def quiet_streets(config: Config) -> list[Row]:
    """The same with a noise that is about that of KT3DMoSeg's tracks."""
    return _both(made_streets(config, sigma=QUIET), config, Goals(4.0, 1.0), NO_GOALS)


def other_streets(config: Config) -> list[Row]:
    """Streets of other kinds."""
    table = []
    for name, (tracks, options) in OTHERS.items():
        few = replace(config, scenes=max(1, config.scenes // 3))
        table += _both(made_streets(few, options, tracks, 5000), config, NO_GOALS, NO_GOALS, f"{name}, ", worst=1)
    return table


def streets_two_views(config: Config) -> list[Row]:
    """Two frames of the streets, their bodies that both show."""
    first = (20 - APART) // 2
    pairs = [video.pair(first, first + APART) for video in made_streets(config)]
    return rows("K known", [paired(pair, pair.bodies, config.seed) for pair in pairs])


def durations(config: Config) -> list[Row]:
    """Seconds of a call, the number of bodies known and not."""
    table = []
    for count, frames, goal, cores in ((500, 20, 2.0, 1), (5000, 100, 30.0, 2)):
        if config.quick and frames > 20:
            continue
        street = streets(3, frames, count, generator=torch.Generator().manual_seed(config.first))
        video = Tracks(f"{count} tracks x {frames} frames", street.tracks, street.labels)
        with threads(cores):
            runs = {known: segmented(video, 3 if known else None, config.seed) for known in (True, False)}
        for known, run in runs.items():
            setting = f"{video.name}, {cores} {'core' if cores == 1 else 'cores'}; error {run.error:.1f} %"
            table.append(Row(f"K {'known' if known else 'unknown'}", setting, run.seconds, goal, at_most=True, unit=" s"))
    return table


QUIET = 0.1
"""px: that of the tracks of KT3DMoSeg at 15 px of motion."""
TABLES: dict[str, tuple[str, Callable[[Config], list[Row]]]] = {
    "kt3d": ("KT3DMoSeg, whole sequences", kt3d),
    "kt3d_two_views": ("KT3DMoSeg, first and last frame", kt3d_two_views),
    "hopkins": ("Hopkins155, whole sequences", hopkins),
    "mtpv": ("MTPV62, whole sequences", mtpv),
    "streets": ("Streets of 2 to 4 bodies, 20 frames, 500 tracks, noise .5 px", street_table),
    "quiet_streets": ("The same streets, noise .1 px", quiet_streets),
    "streets_two_views": (f"The same streets, two frames {APART} apart", streets_two_views),
    "other_streets": ("Streets of other kinds, 2 to 4 bodies, 20 frames", other_streets),
    "time": ("Seconds of a call", durations),
}


@experiment(Config(scenes=18), quick={"scenes": 6})
def tables(config: Config) -> Tables:
    """Recordings of the folder DYNTORCH_DATA, and streets made for it; quick: every fourth or eighth recording.

    Raises:
        ValueError: no data folder, or an unknown table.
    """
    unknown = [name for name in config.only if name not in TABLES]
    if unknown:
        raise ValueError(f"only must name tables of {', '.join(TABLES)}, got {', '.join(unknown)}")
    for name in config.only or tuple(TABLES):
        title, table = TABLES[name]
        yield title, table(config)
    yield "", PUBLISHED

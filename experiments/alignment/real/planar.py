"""The homography tensor on real planes: cars on roads seen by moving cameras, and a board moved by hand.

    DYNTORCH_DATA=../shared/data python -m experiments.alignment.real.planar

**Traffic** (Hopkins155): three frames of all tracked points, background and cars alike, go into ``align_planar`` with its
default threshold for every sequence (an estimated one, tried on the same sequences, called more of the cars outliers).
True label: background = static, cars = moving; an outlier label counts as wrong
everywhere.  No scene is entirely planar: the background holds buildings and trees.  That it is one homography to a fraction
of a pixel is due to cameras that mostly turn; the same goes for the cars, whose points are off the road but on straight image
paths after stabilization as long as the camera turns and the car drives straight.  Where a car turns, it is an outlier by
the model and counts as a mistake here.  In cars10 three groups of similar size are seen by a camera that really translates:
there is no dominant plane, and the result is wrong.  The share experiment takes
background points away, down to none; the error is measured on all of them.  Beside it, RANSAC homographies (kornia), for
which cars are outliers.  Neither method survives 10 %: a car is a rigid body with a homography of its own, and the largest
of those that stand still among themselves is taken for the background.  The tensor needs no static points, but points that
move in different ways, and two cars do not.  Three views cannot tell a car that stands still from a road that does: where
the rest drives straight before it, the status is ``AMBIGUOUS``, whichever of the two is chosen (notice ``other_background``).

**Board** (caliscope): a board with 12 corners of known identity, moved by hand; at three instants it is a plane in three
unknown poses.  Corners that keep their identity stand still on it.  A point that *moves* on it is made of true sightings:
corner a at the first instant, b at the second, c at the third, for a, b, c on one line of the board (a row, a column, a
diagonal).  All pixels and camera motions are measured; only the itinerary is chosen.  A third of the corners is held out: no
match uses them, and the error is how far the motion carries them from view 2 and 3 to where they are in view 1.  Two
configurations: one camera at three instants, and three cameras at one instant each.  Columns: all points moving (no match is
static, and none is labelled); half of them with a fifth of wrong identities; and homographies of the same corners with their
identities given, which is the best that these corners allow.  Sightings are shared by many itineraries, so that their noise
is not independent.  Medians are over the triples whose status is OK; where these are few they are not comparable between rows.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from itertools import product

import kornia
import torch
from torch import Tensor

import dyntorch as dyn
from dyntorch.geometry.homogeneous import apply
from dyntorch.tasks.align.result import MOVING, OUTLIER, STATIC, Alignment
from experiments.alignment.real.solvers import listed, median
from experiments.common.real_data import Board, Traffic, board, traffic
from experiments.common.runner import BaseConfig, Tables, experiment
from experiments.common.tables import Row

SHARES = (1.0, 0.5, 0.25, 0.1, 0.0)
HELD_OUT = 4
WAYS = ("all move", "moving, static and a fifth wrong", "identities given")
WRONG = 5.0
LOOSE = 2.0
"""Pixels per step: an instant in which the board hardly moves says nothing."""


@dataclass(frozen=True)
class Config(BaseConfig):
    """The homography tensor on the recordings in the folder DYNTORCH_DATA."""

    threshold: float = 1.5
    """Pixels, the same everywhere: the library's default."""


@dataclass(frozen=True)
class Scored:
    """One sequence, three frames of it."""

    name: str
    views: tuple[Tensor, Tensor, Tensor]
    background: Tensor
    result: Alignment

    @property
    def error(self) -> float:
        """Median distance of background points carried from view 3 to where they are in view 1, pixels."""
        return transfer(self.result.B, self.views, self.background)

    @property
    def accuracy(self) -> float:
        """Share of points labelled right."""
        return float((self.result.labels == torch.where(self.background, STATIC, MOVING)).double().mean())

    def share(self, label: int, of: Tensor) -> float:
        """Share of the points ``of`` that have this label."""
        return float((self.result.labels[of] == label).double().mean())


def transfer(B: Tensor | None, views: tuple[Tensor, ...], of: Tensor) -> float:
    """Median distance in view 1 of points carried from view 3."""
    assert B is not None
    return float((apply(B, views[2][of]) - views[0][of]).norm(dim=-1).nan_to_num(nan=torch.inf).median())


def triples(count: int) -> list[tuple[int, int, int]]:
    """Frames of a sequence: the whole of it, its first half and its last."""
    last = count - 1
    return [(0, last // 2, last), (0, last // 4, last // 2), (last // 2, last // 2 + (last - last // 2) // 2, last)]


def scored(sequence: Traffic, frames: tuple[int, int, int], config: Config, keep: Tensor | None = None) -> Scored:
    """Align three frames; ``keep`` leaves the other points out."""
    views = sequence.triple(frames)
    used = torch.ones_like(sequence.background) if keep is None else keep
    generator = torch.Generator().manual_seed(config.seed)
    found = dyn.align_planar(*views, threshold=config.threshold, weights=used.to(views[0]), generator=generator)
    return Scored(sequence.name, views, sequence.background, found)


def traffic_rows(sequences: list[Traffic], config: Config) -> list[Row]:
    """Labels and motion of every sequence, means over the triples."""
    rows = []
    for sequence in sequences:
        found = [scored(sequence, frames, config) for frames in triples(len(sequence.tracks))]
        back, cars = sequence.background, ~sequence.background
        states = Counter(dyn.Status(int(one.result.status)).name for one in found)
        codes = Counter(notice.code.value for one in found for notice in one.result.warnings)
        points = f"{int(back.sum())} + {int(cars.sum())} points"

        def mean(values: list[float]) -> float:
            return sum(values) / len(values)

        accuracy = mean([one.accuracy for one in found])
        kinds = f"background static {mean([one.share(STATIC, back) for one in found]):.3f}, "
        kinds += f"cars moving {mean([one.share(MOVING, cars) for one in found]):.3f}, "
        kinds += f"cars outlier {mean([one.share(OUTLIER, cars) for one in found]):.3f}"
        sigma, error = mean([float(one.result.sigma) for one in found]), mean([one.error for one in found])
        figures = f"sigma {sigma:.2f} px, error of the background {error:.2f} px"
        rows.append(Row(sequence.name, f"{points}; {kinds}; {figures}; {listed(states)}; {listed(codes)}; labels right", accuracy))
    return rows


def ransac(views: tuple[Tensor, ...], threshold: float) -> Tensor:
    """Homography of view 3 to view 1 by RANSAC (kornia), for which whatever moves is an outlier."""
    found = kornia.geometry.ransac.RANSAC("homography", inl_th=threshold, max_iter=20)
    matrix, _ = found(views[2].float(), views[0].float())
    return torch.as_tensor(matrix).double()


def share_rows(sequences: list[Traffic], config: Config) -> list[Row]:
    """Errors as background points are taken away: ours and homographies by RANSAC, medians over sequences."""
    rows = []
    shares = SHARES[::2] if config.quick else SHARES
    for share in shares:
        ours, theirs, states = [], [], Counter[str]()
        for sequence in sequences:
            draw = torch.Generator().manual_seed(config.seed)
            keep = ~sequence.background | (torch.rand(len(sequence.background), generator=draw) < share)
            frames = triples(len(sequence.tracks))[1]
            one = scored(sequence, frames, config, keep)
            ours.append(one.error)
            states[dyn.Status(int(one.result.status)).name] += 1
            torch.manual_seed(config.seed)
            theirs.append(transfer(ransac(tuple(x[keep] for x in one.views), config.threshold), one.views, one.background))
        for name, values in (("align_planar", ours), ("homography, RANSAC", theirs)):
            setting = f"{share:.0%} of the background, median of {len(values)} sequences"
            rows.append(Row(name, setting + (f"; {listed(states)}" if name == "align_planar" else ""), median(values), unit=" px"))
    return rows


# ---- the board ---------------------------------------------------------------------------------------------------------
def itineraries(place: Tensor, allowed: list[int]) -> list[tuple[int, int, int]]:
    """Corners a, b, c on one line of the board, not all the same."""
    found = []
    for a, b, c in product(allowed, repeat=3):
        if len({a, b, c}) > 1:
            u, v = place[b] - place[a], place[c] - place[a]
            if abs(float(u[0] * v[1] - u[1] * v[0])) < 1e-9:
                found.append((a, b, c))
    return found


def instants(seen: Board, cameras: tuple[int, int, int], gap: int) -> list[tuple[Tensor, Tensor, Tensor]]:
    """Sightings of the board at t, t + gap, t + 2 gap, one camera each, wherever all corners are seen."""
    found = []
    for first in sorted(seen.seen[cameras[0]]):
        views = [seen.seen[camera].get(first + i * gap) for i, camera in enumerate(cameras)]
        one, two, three = views
        if one is None or two is None or three is None or not all(bool(x.isfinite().all()) for x in (one, two, three)):
            continue
        same = cameras[0] == cameras[1]
        if not same or min(float((two - one).norm(dim=-1).median()), float((three - two).norm(dim=-1).median())) > LOOSE:
            found.append((one, two, three))
    return found


def board_errors(seen: Board, views: tuple[Tensor, Tensor, Tensor], config: Config, draw: torch.Generator) -> dict[str, float]:
    """Errors of the held-out corners by three ways, pixels, for one triple of sightings."""
    order = torch.randperm(len(seen.place), generator=draw)
    held, known = order[:HELD_OUT], sorted(order[HELD_OUT:].tolist())
    hops = itineraries(seen.place, known)

    def align(matches: list[tuple[int, int, int]]) -> Alignment:
        index = torch.tensor(matches)
        picked = [x[index[:, i]] for i, x in enumerate(views)]
        return dyn.align_planar(*picked, threshold=config.threshold, generator=torch.Generator().manual_seed(config.seed))

    def carried(A: Tensor, B: Tensor | None) -> float:
        assert B is not None
        parts = [(apply(m, x[held]) - views[0][held]).norm(dim=-1) for m, x in ((A, views[1]), (B, views[2]))]
        return float(torch.cat(parts).median())

    wrong = [tuple(known[int(i)] for i in torch.randint(len(known), (3,), generator=draw)) for _ in range(len(hops) // 8)]
    some = [hops[int(i)] for i in torch.randperm(len(hops), generator=draw)[: len(hops) // 2]]
    still = [(k, k, k) for k in known]
    moving, mixed = align(hops), align([*some, *still, *wrong])
    truth = [dyn.fit(dyn.Collineation(2), views[0][known], x[known]).tensor for x in views[1:]]
    errors = {"identities given": carried(truth[0], truth[1])}
    for way, one in (("all move", moving), ("moving, static and a fifth wrong", mixed)):
        # NaN: the status says that there is no motion
        errors[way] = carried(one.A, one.B) if one.status == dyn.Status.OK else float("nan")
    return errors


def board_rows(seen: Board, config: Config) -> list[Row]:
    """Errors of the held-out corners, medians over instants."""
    draw = torch.Generator().manual_seed(config.seed)
    kinds = {
        "one camera, three instants": [((c, c, c), gap) for c in (1, 2) for gap in (2, 4)],
        "three cameras, one instant each": [((1, 2, 3), 1), ((3, 2, 1), 2), ((2, 1, 3), 1)],
    }
    rows = []
    for kind, settings in kinds.items():
        found = [views for cameras, gap in settings for views in instants(seen, cameras, gap)]
        errors = [board_errors(seen, views, config, draw) for views in (found[::8] if config.quick else found)]
        if not errors:
            continue
        for way in WAYS:
            values = torch.tensor([one[way] for one in errors])
            ok = values[values.isfinite()]
            setting = (
                f"{way}; {len(ok)} of {len(values)} triples OK, {int((ok > WRONG).sum())} of them off by more than {WRONG:g} px"
            )
            rows.append(Row(kind, setting + "; median where OK", float(ok.median()) if len(ok) else float("inf"), unit=" px"))
    return rows


@experiment(Config())
def tables(config: Config) -> Tables:
    """Traffic, traffic with less background, and the board."""
    sequences = [one for one in traffic() if not config.quick or one.name in ("cars1", "cars2B", "cars3")]
    yield "Traffic: labels and motion (means of 3 triples)", traffic_rows(sequences, config)
    yield "Traffic with less background", share_rows(sequences, config)
    yield "Board moved by hand: held-out corners", board_rows(board(), config)

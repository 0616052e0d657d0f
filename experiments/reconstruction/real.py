"""Reconstruction of moving points on real motion: cars filmed from moving cameras, people, and traffic seen by virtual drones.

    DYNTORCH_DATA=../shared/data python -m experiments.reconstruction.real

**Traffic** (Hopkins155, real images): six frames of a sequence at equal steps.  All points of five of them, cars and the rest
alike and without labels, go into ``reconstruct``; the sixth, within or after them, is predicted: its camera is resected from a
random half of the background, and the table gives the median distance of the cars, and of the other half, from where they
are.  Whatever stays put (one homography from the nearest frame) and two ways that know which points are background stand
beside it.  *Two bodies*: labels of all points of the 66 two-group sequences, six frames each.  The groups are bodies that
translate against each other only in some of them (T without R in the name, cars); a board or car that turns is no such body.
``auto`` is asked which motion the traffic has.

**People and drives** (CMU, Argoverse 2): true motion, virtual cameras.  0.5 px of noise.  Nobody moves straight: the table
``people`` takes 0, 3, 10, 30 and 100 % of the joints' true way off their straight lines, and tells for each how large that way
is, the error of positions and velocities (relative to the scene and to the rms displacement, after the best alignment within
the gauge), and how often the minimum is the one that bundle adjustment finds from the truth (rms within 2 %).  Held out:
another instant, its camera resected from half of the points, median distance of the others, beside a static scene.
Boxes move on a ground that is nearly a plane, half of them not at all, the others mostly along one road: that is as degenerate
as traffic is, and the statuses should say so.  *Sensors*: the boxes as the moving sensor measured them, no virtual camera,
by a model that is not in the list: planar velocities before 3D sensors.

**Factorizations**: the same people seen from near and from far (20 radii), where cameras are nearly affine.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

import dyntorch as dyn
from dyntorch import metrics
from dyntorch.geometry.homogeneous import apply, homogeneous, inhomogeneous
from dyntorch.tasks.reconstruct.factorization import projective_factorization, velocity_factorization
from dyntorch.tasks.reconstruct.motions import MOTIONS, polynomial
from dyntorch.tasks.reconstruct.result import Reconstruction
from experiments.alignment.real.solvers import listed, median
from experiments.common.real_data import Take, Traffic, takes, traffic
from experiments.common.runner import BaseConfig, Tables, experiment
from experiments.common.tables import Row
from experiments.reconstruction.data import (
    Boxes,
    World,
    boxes,
    crowd,
    declared,
    drone,
    minimum,
    pairs,
    predicted,
    scene_error,
    seen,
)

PLANAR = ("constant_direction_2d", "constant_velocity_2d")
WRONG = 5.0
"""Pixels, for the background of the held-out frame."""


@dataclass(frozen=True)
class Asked:
    """A held-out frame of a sequence."""

    sequence: Traffic
    frames: list[int]
    held: int
    known: Tensor
    """``(n,)`` bool: the half of the background that resects its camera."""

    def error(self, where: Tensor, cars: bool) -> float:
        """Median distance of the cars, or of the other half of the background."""
        of = ~self.sequence.background if cars else self.sequence.background & ~self.known
        return float((where - self.sequence.tracks[self.held])[of].norm(dim=-1).nan_to_num(nan=math.inf).median())

    def stabilized(self, to: int) -> Tensor:
        """``(3, 3)`` homography of the frame ``to`` to the held-out one, by the known background."""
        known, tracks = self.known, self.sequence.tracks
        return dyn.fit(dyn.Collineation(2), tracks[self.held][known], tracks[to][known]).tensor


def asked(sequence: Traffic, step: int, within: bool, draw: torch.Generator) -> Asked | None:
    """Six frames from the first on, of which the fourth or the last is held out; None where the sequence is too short."""
    frames = list(range(0, len(sequence.tracks), step))[:6]
    if len(frames) < 6:
        return None
    held = frames.pop(3 if within else 5)
    known = sequence.background & (torch.rand(len(sequence.background), generator=draw) < 0.5)
    return Asked(sequence, frames, held, known)


def put(one: Asked) -> tuple[Tensor, str]:
    """Nothing moves: the nearest frame, by a homography."""
    near = min(one.frames, key=lambda f: abs(f - one.held))
    return apply(one.stabilized(near), one.sequence.tracks[near]), "no test"


def straight(one: Asked) -> tuple[Tensor, str]:
    """Straight lines at constant velocity in the stabilized *image*, which a plane seen obliquely does not have."""
    known, tracks = one.sequence.background, one.sequence.tracks
    maps = [dyn.fit(dyn.Collineation(2), tracks[one.held][known], tracks[f][known]).tensor for f in one.frames]
    moved = torch.stack([apply(m, tracks[f]) for m, f in zip(maps, one.frames, strict=True)])
    since = torch.tensor(one.frames).double() - one.held
    rows = torch.stack([torch.ones_like(since), since], dim=-1)
    return (torch.linalg.pinv(rows) @ moved.flatten(1))[0].reshape(-1, 2), "knows the background of all frames"


def affine(one: Asked) -> tuple[Tensor, str]:
    """Tracks interpolated linearly between (beyond) the two nearest frames, then an affine map by the known background."""
    a, b = sorted(sorted(one.frames, key=lambda f: abs(f - one.held))[:2])
    tracks, share = one.sequence.tracks, (one.held - a) / (b - a)
    there = homogeneous((1 - share) * tracks[a] + share * tracks[b])
    fitted = torch.linalg.lstsq(there[one.known], tracks[one.held][one.known]).solution
    return there @ fitted, "no test"


Way = Callable[[Asked], tuple[Tensor, str]]
"""Where the points are in the held-out frame, and a status."""


def model(name: str, threshold: float | None = math.inf) -> Way:
    """By a reconstruction of all points of the other frames."""

    def solve(one: Asked) -> tuple[Tensor, str]:
        times = torch.tensor(one.frames, dtype=torch.float64)
        found = declared(one.sequence.tracks[one.frames], name, times, threshold)
        return predicted(found, float(one.held), one.sequence.tracks[one.held], one.known), dyn.Status(int(found.status)).name

    return solve


WAYS: dict[str, Way] = {
    "all still: homography": put,
    "affine interpolation": affine,
    "straight in the stabilized image": straight,
    **{name: model(name) for name in PLANAR},
}


def traffic_rows(sequences: list[Traffic], steps: Sequence[int], seed: int) -> list[Row]:
    """Distances in held-out frames, medians over the sequences."""
    rows: list[Row] = []
    for within in (True, False):
        for step in steps:
            draw = torch.Generator().manual_seed(seed)
            cases = [case for one in sequences if (case := asked(one, step, within, draw))]
            for name, solve in WAYS.items():
                found = [solve(case) for case in cases]
                cars, others = ([case.error(x, cars) for case, (x, _) in zip(cases, found, strict=True)] for cars in (True, False))
                place = "between" if within else "after"
                setting = f"held out {place} frames {step} apart, {len(cases)} sequences; background {median(others):.2f} px, "
                setting += f"off by more than {WRONG:g} px in {sum(x > WRONG for x in others)}; worst cars {max(cars):.3g} px; "
                rows.append(Row(name, setting + f"{listed(Counter(s for _, s in found))}; cars", median(cars), unit=" px"))
    return rows


def threshold_rows(sequences: list[Traffic], seed: int) -> list[Row]:
    """The same with a threshold, above which observations are outliers."""
    rows = []
    for threshold in (math.inf, 3.0, 1.5, None):
        draw = torch.Generator().manual_seed(seed)
        cases = [case for one in sequences if (case := asked(one, 2, True, draw))]
        found = [model("constant_velocity_2d", threshold)(case) for case in cases]
        cars = [case.error(x, cars=True) for case, (x, _) in zip(cases, found, strict=True)]
        setting = "estimated" if threshold is None else f"{threshold:g} px"
        setting += f", {len(cases)} sequences; worst cars {max(cars):.3g} px; {listed(Counter(s for _, s in found))}; cars"
        rows.append(Row("constant_velocity_2d, threshold", setting, median(cars), unit=" px"))
    return rows


def bodies_rows(sequences: list[Traffic]) -> list[Row]:
    """Share of labels that are right, by the kind of the sequence."""
    rows = []
    kinds: dict[str, Callable[[str], bool]] = {
        "cars": lambda name: name.startswith("cars"),
        "boards": lambda name: not name.startswith("cars"),
    }
    for name in ("two_bodies_2d", "two_bodies_3d"):
        for kind, belongs in kinds.items():
            right, base, sigmas, states = [], [], [], Counter[str]()
            for one in filter(lambda one: belongs(one.name), sequences):
                frames = torch.linspace(0, len(one.tracks) - 1, 6).round().long()
                found = declared(one.tracks[frames], name, frames.double(), math.inf)
                right.append(max(float((found.labels == labels).double().mean()) for labels in (one.bodies, 3 - one.bodies)))
                base.append(float(one.background.double().mean()))
                sigmas.append(float(found.sigma))
                states[dyn.Status(int(found.status)).name] += 1
            setting = (
                f"{len(right)} {kind}: all right in {sum(x == 1 for x in right)}, above 0.95 in {sum(x > 0.95 for x in right)}, "
            )
            setting += (
                f"worst {min(right):.2f}; sigma {median(sigmas):.2f} px; {listed(states)}; larger body {median(base):.2f}; median"
            )
            rows.append(Row(name, setting, median(right)))
    return rows


def auto_rows(sequences: list[Traffic]) -> list[Row]:
    """Which motion is chosen for the traffic, without any label."""
    chosen = Counter[str]()
    for one in sequences:
        case = asked(one, 2, True, torch.Generator().manual_seed(0))
        if case:
            found = declared(one.tracks[case.frames], "auto", torch.tensor(case.frames).double(), None)
            chosen[found.motion.name] += 1
    moving = sum(count for name, count in chosen.items() if not name.startswith("static"))
    return [Row("auto", f"{listed(chosen)}; share that moves", moving / max(1, chosen.total()))]


SPATIAL = ("constant_direction_3d", "constant_velocity_planes_3d", "constant_velocity_3d")
SHARES = (0.0, 0.03, 0.1, 0.3, 1.0)
LOST = 1.02
"""Rms reprojection distance over that of the minimum next to the truth above which it was missed."""


@dataclass(frozen=True)
class Config(BaseConfig):
    """Reconstruction on the recordings in the folder DYNTORCH_DATA."""

    crowds: int = 3
    """Random crowds per line."""


# ---- people and drives -------------------------------------------------------------------------------------------------
@dataclass(frozen=True)
class Judged:
    """One reconstruction of a world before virtual cameras."""

    world: World
    found: Reconstruction
    error: metrics.LiftedError
    best: metrics.LiftedError
    missed: bool
    held: float
    """Median distance in the held-out view, px."""

    @property
    def state(self) -> str:
        return dyn.Status(int(self.found.status)).name


def judged(world: World, name: str, draw: torch.Generator, reference: bool = True) -> Judged:
    """Hold out one view in the middle, reconstruct from the others; also from the truth, as a reference."""
    world = world.turned()
    cameras = drone(world, draw)
    tracks = seen(world, cameras, draw)
    half = torch.rand(tracks.shape[1], generator=draw) < 0.5
    held = len(tracks) // 2
    kept = [i for i in range(len(tracks)) if i != held]
    some = world.only(kept)
    found = declared(tracks[kept], name, some.times, math.inf)
    there = predicted(found, float(world.times[held]), tracks[held], half)
    error = scene_error(found.structure, some, name)
    floor, best = minimum(tracks[kept], some, cameras[kept], name) if reference else (math.inf, error)
    apart = (there - tracks[held])[~half].norm(dim=-1).nan_to_num(nan=math.inf)
    missed = not float(found.residual) <= LOST * floor
    return Judged(some, found, error, best, missed, float(apart.median()))


def judged_row(label: str, prefix: str, some: Sequence[Judged]) -> Row:
    """Medians over several worlds."""
    wander = 1000 * torch.cat([one.world.deviation.flatten() for one in some]).square().mean().sqrt()
    go = 1000 * torch.cat([(one.world.places[-1] - one.world.places[0]).norm(dim=-1) for one in some]).square().mean().sqrt()
    setting = f"{prefix}points go {go:.0f} mm, off their lines by {wander:.1f} mm; residual "
    setting += (
        f"{median([float(one.found.residual) for one in some]):.2f} px, held out {median([one.held for one in some]):.2f} px; "
    )
    setting += f"minimum missed {sum(one.missed for one in some)} of {len(some)}; {listed(Counter(one.state for one in some))}; "
    best = f"position {median([float(one.best.position) for one in some]):.3f}"
    if not some[0].found.motion.static:
        setting += f"velocity {median([float(one.error.velocity) for one in some]):.2f} "
        best += f", velocity {median([float(one.best.velocity) for one in some]):.2f}"
    setting += f"(adjusted from the truth: {best}); position"
    return Row(label, setting, median([float(one.error.position) for one in some]))


def people_rows(pool: list[Take], config: Config) -> list[Row]:
    """Errors against the share of the true way off straight lines, and of true motion in shorter times."""
    rows: list[Row] = []
    cases = [(4, share) for share in SHARES[:: 2 if config.quick else 1]] + [(2, 1.0), (1, 1.0)]
    for spacing, share in cases:
        draw = torch.Generator().manual_seed(config.seed)
        worlds = [crowd(pool, spacing, 7, draw).bent(share) for _ in range(config.crowds)]
        for name in ("constant_velocity_3d",) if share < 1 else ("constant_velocity_3d", "constant_direction_3d", "static_3d"):
            some = [judged(world, name, torch.Generator().manual_seed(config.seed + i)) for i, world in enumerate(worlds)]
            rows.append(judged_row(name, f"{spacing * 100 / 6:.0f} ms, {share:.0%} of the way off: ", some))
    return rows


def drives_rows(logs: list[Boxes], config: Config) -> list[Row]:
    """Corners of boxes before virtual drones, as they were and with straight motion."""
    rows = []
    for share in (0.0, 1.0):
        for step in (4,) if config.quick else (2, 4):
            for name in ("static_3d", *SPATIAL):
                some = []
                for log in logs:
                    for start in (0,) if config.quick else (0, 60, 110):
                        world = log.window(start, step, 7)[0].bent(share)
                        some.append(judged(world, name, torch.Generator().manual_seed(config.seed + start)))
                moving = median([float(one.world.moving.double().mean()) for one in some])
                rows.append(judged_row(name, f"{share:.0%}, {0.1 * step:.1f} s, {moving:.0%} move: ", some))
    return rows


def sensor_rows(logs: list[Boxes], config: Config) -> list[Row]:
    """Corners as the moving sensor measured them, by a declared model and by one of our own."""
    own = dyn.Motion(polynomial(3, 2), "planar velocities before 3D sensors", sensor=3)
    rows = []
    for step in (5,) if config.quick else (2, 5, 10):
        for motion in (own, MOTIONS["constant_velocity_3d_sensors"]):
            positions, speeds, residuals, states = [], [], [], Counter[str]()
            for log in logs:
                for start in (0, 60) if config.quick else (0, 30, 60, 90):
                    world, measured = log.window(start, step, 6)
                    found = declared(measured, motion, world.times, math.inf)
                    truth = "constant_velocity_planes_3d" if motion is own else "constant_velocity_3d"
                    error = scene_error(found.structure, world, truth)
                    positions.append(float(error.position))
                    speeds.append(float(error.velocity))
                    residuals.append(float(found.residual))
                    states[dyn.Status(int(found.status)).name] += 1
            setting = (
                f"{0.1 * step:.1f} s: residual {median(residuals):.3f} m; {listed(states)}; velocity {median(speeds):.2f}; position"
            )
            rows.append(Row(motion.name, setting, median(positions)))
    return rows


def factorization_rows(pool: list[Take], config: Config) -> list[Row]:
    """The same crowds by three ways, from near and from far."""
    rows = []
    name = "constant_velocity_3d"
    for share in (0.0, 0.1, 1.0):
        for distance in (4.0, 20.0):
            figures: dict[str, list[tuple[float, float, float]]] = {"reconstruct": [], "Han-Kanade": [], "rank 7": []}
            for k in range(2 if config.quick else 3):
                draw = torch.Generator().manual_seed(config.seed + k)
                world = crowd(pool, 4, 8, draw).bent(share)
                tracks = seen(world, drone(world, draw, distance), draw)
                one = declared(tracks, name, world.times, math.inf)
                other = velocity_factorization(tracks, world.times)
                rank = projective_factorization(tracks, 7)
                apart = inhomogeneous(rank.structure @ rank.projections.mT) - tracks
                flat = torch.cat([homogeneous(other.points), other.velocities], dim=-1)
                for way, lifted, residual in (("reconstruct", one.structure, one.residual), ("Han-Kanade", flat, other.residual)):
                    error = scene_error(lifted, world, name)
                    figures[way].append((float(error.position), float(error.velocity), float(residual)))
                figures["rank 7"].append((math.nan, math.nan, float(apart.square().sum(-1).mean().sqrt())))
            for way, values in figures.items():
                position, speed, away = (median([value[i] for value in values]) for i in range(3))
                setting = f"{share:.0%} of the way off, {distance:g} radii away: "
                setting += "" if math.isnan(position) else f"position {position:.3f}, velocity {speed:.2f}; "
                rows.append(Row(way, setting + "residual", away, unit=" px"))
    return rows


@experiment(Config(), quick={"crowds": 2})
def tables(config: Config) -> Tables:
    """Traffic, pairs of bodies, people and boxes; quick: few sequences, crowds and windows."""
    sequences = [one for one in traffic() if not config.quick or one.name in ("cars2B", "cars5", "cars9")]
    some = sequences[:1] if config.quick else sequences[1::3]
    pool, logs = takes()[1::2], boxes()
    yield "Traffic: a held-out frame", traffic_rows(sequences, (2,) if config.quick else (2, 4), config.seed)
    yield "Traffic: thresholds", threshold_rows(some, config.seed)
    yield "Two bodies: labels", bodies_rows(pairs()[:: 6 if config.quick else 1])
    yield "Traffic: which motion?", auto_rows(some)
    yield "People before virtual cameras", people_rows(pool, config)
    yield "Boxes of traffic before virtual cameras", drives_rows(logs, config)
    yield "Boxes of traffic as the sensor measured them", sensor_rows(logs, config)
    yield "Factorizations of people", factorization_rows(pool, config)

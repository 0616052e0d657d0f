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
from collections.abc import Sequence
from dataclasses import dataclass

import torch

import dyntorch as dyn
from dyntorch import metrics
from dyntorch.geometry.homogeneous import homogeneous, inhomogeneous
from dyntorch.tasks.reconstruct.factorization import projective_factorization, velocity_factorization
from dyntorch.tasks.reconstruct.motions import MOTIONS, polynomial
from dyntorch.tasks.reconstruct.result import Reconstruction
from experiments.alignment.real.solvers import listed, median
from experiments.common.real_data import Take, takes, traffic
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
from experiments.reconstruction.traffic import auto_rows, bodies_rows, threshold_rows, traffic_rows

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

"""Reconstruction of moving points on real motion: cars filmed from moving cameras, people, and traffic seen by virtual drones.

    DYNTORCH_DATA=../shared/data python -m experiments.real_lifted

**Traffic** (Hopkins155, real images): six frames of a sequence at equal steps.  All points of five of them, cars and the rest
alike and without labels, go into ``reconstruct``; the sixth, within or after them, is predicted: its camera is resected from a
random half of the background, and the table gives the median distance of the cars, and of the other half, from where they
are.  Whatever stays put (one homography from the nearest frame) and two ways that know which points are background stand
beside it.  *Two bodies*: labels of all points of the 57 two-group sequences, six frames each.  The groups are bodies that
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
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import torch
import tyro
from torch import Tensor

import dyntorch as dyn
from dyntorch import metrics
from dyntorch.algebra.homogeneous import apply, homogeneous, inhomogeneous
from dyntorch.algebra.projective_factorization import projective_factorization
from dyntorch.algebra.velocity_factorization import velocity_factorization
from dyntorch.motions import MOTIONS, polynomial
from dyntorch.tasks.reconstruction import Reconstruction
from experiments.lifted_data import Boxes, World, boxes, crowd, declared, drone, minimum, pairs, predicted, scene_error, seen
from experiments.lifted_pictures import drive_picture, people_picture, traffic_picture
from experiments.protocol import data_folder
from experiments.real_data import Take, Traffic, takes, traffic
from experiments.real_solvers import listed, median
from experiments.tables import Row, command, markdown, note
from indexing.files import manifest, plain, prepare, write_json

PLANAR = ("constant_direction_2d", "constant_velocity_2d")
SPATIAL = ("constant_direction_3d", "constant_velocity_planes_3d", "constant_velocity_3d")
SHARES = (0.0, 0.03, 0.1, 0.3, 1.0)
WRONG = 5.0
"""Pixels, for the background of the held-out frame."""
LOST = 1.02
"""Rms reprojection distance over that of the minimum next to the truth above which it was missed."""


@dataclass(frozen=True)
class Config:
    """Reconstruction on the recordings in the folder DYNTORCH_DATA."""

    quick: bool = False
    """Few sequences, crowds and windows."""
    crowds: int = 5
    """Random crowds per line."""
    seed: int = 0
    """Of all random choices."""
    out: Annotated[Path, tyro.conf.arg(metavar="FOLDER")] = Path("results/real_lifted")
    """Where the figures (figures.json) and the pictures are written."""


# ---- traffic -----------------------------------------------------------------------------------------------------------
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


def put(one: Asked, _: Config) -> tuple[Tensor, str]:
    """Nothing moves: the nearest frame, by a homography."""
    near = min(one.frames, key=lambda f: abs(f - one.held))
    return apply(one.stabilized(near), one.sequence.tracks[near]), "no test"


def straight(one: Asked, _: Config) -> tuple[Tensor, str]:
    """Straight lines at constant velocity in the stabilized *image*, which a plane seen obliquely does not have."""
    known, tracks = one.sequence.background, one.sequence.tracks
    maps = [dyn.fit(dyn.Collineation(2), tracks[one.held][known], tracks[f][known]).tensor for f in one.frames]
    moved = torch.stack([apply(m, tracks[f]) for m, f in zip(maps, one.frames, strict=True)])
    since = torch.tensor(one.frames).double() - one.held
    rows = torch.stack([torch.ones_like(since), since], dim=-1)
    return (torch.linalg.pinv(rows) @ moved.flatten(1))[0].reshape(-1, 2), "knows the background of all frames"


def affine(one: Asked, _: Config) -> tuple[Tensor, str]:
    """Tracks interpolated linearly between (beyond) the two nearest frames, then an affine map by the known background."""
    a, b = sorted(sorted(one.frames, key=lambda f: abs(f - one.held))[:2])
    tracks, share = one.sequence.tracks, (one.held - a) / (b - a)
    there = homogeneous((1 - share) * tracks[a] + share * tracks[b])
    fitted = torch.linalg.lstsq(there[one.known], tracks[one.held][one.known]).solution
    return there @ fitted, "no test"


def model(name: str) -> Callable[[Asked, Config], tuple[Tensor, str]]:
    """By a reconstruction of all points of the other frames."""

    def solve(one: Asked, config: Config) -> tuple[Tensor, str]:
        times = torch.tensor(one.frames, dtype=torch.float64)
        found = declared(one.sequence.tracks[one.frames], name, times, None)
        return predicted(found, float(one.held), one.sequence.tracks[one.held], one.known), dyn.Status(int(found.status)).name

    return solve


WAYS: dict[str, Callable[[Asked, Config], tuple[Tensor, str]]] = {
    "all still: homography": put,
    "affine interpolation": affine,
    "straight in the stabilized image": straight,
    **{name: model(name) for name in PLANAR},
}


def traffic_rows(sequences: list[Traffic], config: Config) -> tuple[list[Row], dict[str, list[float]]]:
    """Distances in held-out frames, medians over the sequences."""
    rows: list[Row] = []
    curves: dict[str, list[float]] = {}
    for within in (True, False):
        for step in (2,) if config.quick else (1, 2, 4):
            draw = torch.Generator().manual_seed(config.seed)
            cases = [case for one in sequences if (case := asked(one, step, within, draw))]
            for name, solve in WAYS.items():
                found = [solve(case, config) for case in cases]
                cars, others = ([case.error(x, cars) for case, (x, _) in zip(cases, found, strict=True)] for cars in (True, False))
                place = "between" if within else "after"
                curves.setdefault(f"{name}, {place}", []).append(median(cars))
                setting = f"held out {place} frames {step} apart, {len(cases)} sequences; background {median(others):.2f} px, "
                setting += f"off by more than {WRONG:g} px in {sum(x > WRONG for x in others)}; worst cars {max(cars):.3g} px; "
                rows.append(Row(name, setting + f"{listed(Counter(s for _, s in found))}; cars", median(cars), unit=" px"))
    return rows, curves


def bodies_rows(config: Config) -> list[Row]:
    """Share of labels that are right, by the kind of the sequence."""
    rows = []
    sequences = pairs()[::6] if config.quick else pairs()
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
            setting = f"{len(right)} {kind}: all right in {sum(x == 1 for x in right)}, above 0.95 in {sum(x > 0.95 for x in right)}, "
            setting += f"worst {min(right):.2f}; sigma {median(sigmas):.2f} px; {listed(states)}; larger body {median(base):.2f}; median"
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


def judged(world: World, name: str, draw: torch.Generator, distance: float = 4.0) -> Judged:
    """Hold out one view in the middle, reconstruct from the others."""
    cameras = drone(world, draw, distance)
    tracks = seen(world, cameras, draw)
    half = torch.rand(tracks.shape[1], generator=draw) < 0.5
    held = len(tracks) // 2
    kept = [i for i in range(len(tracks)) if i != held]
    some = world.only(kept)
    found = declared(tracks[kept], name, some.times, math.inf)
    there = predicted(found, float(world.times[held]), tracks[held], half)
    floor, best = minimum(tracks[kept], some, cameras[kept], name)
    apart = (there - tracks[held])[~half].norm(dim=-1).nan_to_num(nan=math.inf)
    missed = not float(found.residual) <= LOST * floor
    return Judged(some, found, scene_error(found.structure, some, name), best, missed, float(apart.median()))


def judged_row(label: str, prefix: str, some: Sequence[Judged]) -> Row:
    """Medians over several worlds."""
    wander = 1000 * torch.cat([one.world.deviation.flatten() for one in some]).square().mean().sqrt()
    go = 1000 * torch.cat([(one.world.places[-1] - one.world.places[0]).norm(dim=-1) for one in some]).square().mean().sqrt()
    setting = f"{prefix}points go {go:.0f} mm, off their lines by {wander:.1f} mm; residual "
    setting += f"{median([float(one.found.residual) for one in some]):.2f} px, held out {median([one.held for one in some]):.2f} px; "
    setting += f"minimum missed {sum(one.missed for one in some)} of {len(some)}; {listed(Counter(one.state for one in some))}; "
    setting += f"velocity {median([float(one.error.velocity) for one in some]):.2f} "
    setting += f"(adjusted from the truth: position {median([float(one.best.position) for one in some]):.3f}, "
    setting += f"velocity {median([float(one.best.velocity) for one in some]):.2f}); position"
    return Row(label, setting, median([float(one.error.position) for one in some]))


def people_rows(pool: list[Take], config: Config) -> tuple[list[Row], dict[str, list[float]]]:
    """Errors against the share of the true way off straight lines; and what other models make of it."""
    rows: list[Row] = []
    curves: dict[str, list[float]] = {"position": [], "velocity": [], "position, adjusted from the truth": []}
    crowds = 2 if config.quick else config.crowds
    for share in SHARES[::2] if config.quick else SHARES:
        for name in ("constant_velocity_3d", "static_3d") if share in (0.1, 1.0) else ("constant_velocity_3d",):
            draw = torch.Generator().manual_seed(config.seed)
            worlds = [crowd(pool, 4, 7, draw).bent(share) for _ in range(crowds)]
            some = [judged(world, name, torch.Generator().manual_seed(config.seed + i)) for i, world in enumerate(worlds)]
            rows.append(judged_row(name, f"{share:.0%} of the way off: ", some))
            if name != "static_3d":
                curves["position"].append(median([float(one.error.position) for one in some]))
                curves["velocity"].append(median([float(one.error.velocity) for one in some]))
                curves["position, adjusted from the truth"].append(median([float(one.best.position) for one in some]))
    return rows, curves


def drives_rows(logs: list[Boxes], config: Config) -> list[Row]:
    """Corners of boxes before virtual drones, as they were and with straight motion."""
    rows = []
    for share in (0.0, 1.0):
        for step in (4,) if config.quick else (2, 4, 6):
            for name in ("static_3d", *SPATIAL):
                some = []
                for log in logs:
                    for start in (0,) if config.quick else (0, 40, 80, 110):
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
            setting = f"{0.1 * step:.1f} s: residual {median(residuals):.3f} m; {listed(states)}; velocity {median(speeds):.2f}; position"
            rows.append(Row(motion.name, setting, median(positions)))
    return rows


def factorization_rows(pool: list[Take], config: Config) -> list[Row]:
    """The same crowds by three ways, from near and from far."""
    rows = []
    name = "constant_velocity_3d"
    for share in (0.0, 0.1, 1.0):
        for distance in (4.0, 20.0):
            figures: dict[str, list[tuple[float, float, float]]] = {"reconstruct": [], "Han-Kanade": [], "rank 7": []}
            for k in range(2 if config.quick else config.crowds):
                draw = torch.Generator().manual_seed(config.seed + k)
                world = crowd(pool, 4, 8, draw).bent(share)
                tracks = seen(world, drone(world, draw, distance), draw)
                one = declared(tracks, name, world.times, math.inf)
                other = velocity_factorization(tracks, world.times)
                rank = projective_factorization(tracks, 7)
                apart = inhomogeneous(rank.structure @ rank.projections.mT) - tracks
                flat = torch.cat([homogeneous(other.points), other.velocities], dim=-1)
                figures["reconstruct"].append((*map(float, scene_error(one.structure, world, name)), float(one.residual)))
                figures["Han-Kanade"].append((*map(float, scene_error(flat, world, name)), float(other.residual)))
                figures["rank 7"].append((math.nan, math.nan, float(apart.square().sum(-1).mean().sqrt())))
            for way, values in figures.items():
                position, speed, residual = (median([value[i] for value in values]) for i in range(3))
                setting = f"{share:.0%} of the way off, {distance:g} radii away: "
                setting += "" if math.isnan(position) else f"position {position:.3f}, velocity {speed:.2f}; "
                rows.append(Row(way, setting + "residual", residual, unit=" px"))
    return rows


def run(config: Config) -> None:
    """Print every table, then write the figures and the pictures."""
    folder, begin = data_folder(), time.perf_counter()
    prepare(config.out)
    sequences, pool, logs = traffic(), takes()[1::2], boxes()
    sequences = [one for one in sequences if one.name in ("cars2B", "cars5", "cars9")] if config.quick else sequences
    tables: dict[str, list[Row]] = {}

    def table(title: str, rows: list[Row]) -> None:
        tables[title] = rows
        print(markdown(rows, title), flush=True)
        note(f"... {time.perf_counter() - begin:.0f} s")

    rows, waits = traffic_rows(sequences, config)
    table("Traffic: a held-out frame", rows)
    table("Two bodies: labels", bodies_rows(config))
    table("Traffic: which motion?", auto_rows(sequences))
    rows, curves = people_rows(pool, config)
    table("People before virtual cameras", rows)
    table("Boxes of traffic before virtual cameras", drives_rows(logs, config))
    table("Boxes of traffic as the sensor measured them", sensor_rows(logs, config))
    table("Factorizations of people", factorization_rows(pool, config))
    shown = next(one for one in sequences if one.name == "cars5")
    case = asked(shown, 4, True, torch.Generator().manual_seed(config.seed))
    assert case is not None
    found = declared(shown.tracks[case.frames], "constant_velocity_2d", torch.tensor(case.frames).double(), None)
    traffic_picture(shown.tracks, case.frames, found, shown.background, waits, config.out / "traffic.png")
    world = crowd(pool, 4, 7, torch.Generator().manual_seed(config.seed)).bent(0.1)
    one = judged(world, "constant_velocity_3d", torch.Generator().manual_seed(config.seed))
    people_picture(one.world, one.found, curves, SHARES[::2] if config.quick else SHARES, config.out / "people.png")
    drive = judged(logs[0].window(0, 4, 7)[0], "constant_velocity_planes_3d", torch.Generator().manual_seed(config.seed))
    drive_picture(drive.world, drive.found, config.out / "drive.png")
    inputs = [folder / name for name in ("hopkins155.npz", "argoverse2", "cmu_mocap_60fps.npz")]
    about = manifest(vars(config), inputs, seed=config.seed, timings={"all": time.perf_counter() - begin})
    write_json(config.out / "figures.json", {"manifest": about, "tables": plain(tables)})
    note(f"written: {config.out}, {time.perf_counter() - begin:.0f} s")


if __name__ == "__main__":
    command(lambda: run(tyro.cli(Config, prog="python -m experiments.real_lifted")))

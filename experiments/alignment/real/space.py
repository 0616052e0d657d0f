"""The tensors of space and rigid alignment on real 3D motion: boxes of traffic seen from a car, and moving bodies.

    DYNTORCH_DATA=../shared/data python -m experiments.alignment.real.space

**Drives** (Argoverse 2): centres of annotated boxes at sweeps t, t + k, t + 2k in the frame of the moving sensor, whose true
pose is known.  (a) The projective tensors are degenerate there - velocities lie in the ground plane, many boxes are parked,
second differences are millimetres: the table counts what status each one reports, and how wrong its motion is where it
says OK (more than 0.1 m, the median over the boxes, up to what the invariant leaves open).  (b) ``align_points(model="rigid")``
against RANSAC of 3 boxes with refit, for which movers are outliers, as the share of movers grows: parked boxes are taken away
(at low shares movers are).  Both use the threshold 0.1 m, three standard deviations of the wander of parked boxes.  It and the
0.3 s were settled while looking at these two logs (0.3 m, an estimated threshold, and other steps were tried as well).  A
velocity common to all boxes cannot be told from a motion of the sensor, and traffic nearly has one; the last column takes
the best such velocity out of both translations.

**Bodies** (CMU): joints of people at three instants k frames apart, each on a place of its own in a room of 4 m, seen by
virtual sensors (rigid, or projective).  Joints do not move exactly on straight lines; the table tells how far from it.  The
spacing k is chosen on half of the takes, per model, and the figures are those of the other half.  Errors of A and B: median
distance between where they and the true motion carry the joints, the worse of the two.  The constant velocity tensor is
compared up to its gauge.  Reference: one collineation (or rigid motion) per pair of views of all joints, as if all stood still.
At so short steps joints nearly keep their velocity, and the velocity common to all is then known from the few static joints.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import torch
from torch import Tensor

import dyntorch as dyn
from dyntorch import metrics
from dyntorch.geometry.homogeneous import apply
from dyntorch.geometry.rigid import rigid_alignment
from dyntorch.scenes.scene import Draw
from experiments.alignment.real.solvers import Matrices, Solver, aligned, gap, listed, median, rigid_ransac, tensor
from experiments.common.real_data import Drive, Take, drives, takes
from experiments.common.runner import BaseConfig, Tables, experiment
from experiments.common.tables import Row, note

SPACINGS = (1, 2, 4)
"""Frames between the views, at 60 per second."""
PEOPLE = 12


@dataclass(frozen=True)
class Crowd:
    """People at three instants: ``world (3, n, 3)`` metres, three views of it, and the true A, B."""

    world: Tensor
    views: list[Tensor]
    sensors: Tensor
    motion: Matrices

    @property
    def deviation(self) -> Tensor:
        """``(n,)`` standard deviation of a joint across the line that fits its three positions best, metres."""
        centred = (self.world - self.world.mean(0)).movedim(1, 0)
        return (torch.linalg.svdvals(centred)[:, 1].square() / 2).sqrt()


def crowd(pool: list[Take], spacing: int, kind: str, draw: torch.Generator) -> Crowd:
    """Random people at random instants, each turned about the vertical and put somewhere in a room of 4 m."""
    people = []
    for _ in range(PEOPLE):
        joints = pool[int(torch.randint(len(pool), (1,), generator=draw))].joints
        start = int(torch.randint(len(joints) - 2 * spacing, (1,), generator=draw))
        three = joints[[start, start + spacing, start + 2 * spacing]]
        angle, place = (torch.rand(1, generator=draw) * 2 * torch.pi).double(), torch.rand(2, generator=draw).double() * 4 - 2
        cos, sin = angle.cos(), angle.sin()
        x, y, z = (three - three[1].mean(0) * torch.tensor([1.0, 0.0, 1.0], dtype=three.dtype)).unbind(-1)
        people.append(torch.stack([cos * x + sin * z + place[0], y - 1.0, cos * z - sin * x + place[1]], dim=-1))
    world = torch.cat(people, dim=1)
    sensors = Draw(world.shape[1], (), 0.0, 0.0, 0.0, draw, torch.float64).sensors(3, kind)
    # the first sensor is rigid in either case, so that errors in its frame are metres
    sensors[0] = Draw(1, (), 0.0, 0.0, 0.0, draw, torch.float64).sensors(1, "rigid")[0]
    motion = tuple(sensors[0] @ torch.linalg.inv(m) for m in sensors[1:])
    return Crowd(world, [apply(m, x) for m, x in zip(sensors, world, strict=True)], sensors, (motion[0], motion[1]))


def _still(views: list[Tensor], _: Matrices) -> tuple[Matrices, str]:
    a, b = (dyn.fit(dyn.Collineation(3), views[0], x).tensor for x in views[1:])
    return (a, b), "no test"


def _kabsch(views: list[Tensor], _: Matrices) -> tuple[Matrices, str]:
    return (rigid_alignment(views[0], views[1]), rigid_alignment(views[0], views[2])), "no test"


METHODS: dict[str, tuple[str, Solver]] = {
    "all still: collineations": ("projective", _still),
    "JoinTensor, linear": ("projective", tensor(dyn.JoinTensor)),
    "MinimalJoinTensor, linear": ("projective", tensor(dyn.MinimalJoinTensor)),
    "ConstantVelocityTensor, linear": ("projective", tensor(dyn.ConstantVelocityTensor)),
    'align_points("join")': ("projective", aligned("join")),
    'align_points("minimal_join")': ("projective", aligned("minimal_join")),
    'align_points("constant_velocity")': ("projective", aligned("constant_velocity")),
    "all still: rigid motions": ("rigid", _kabsch),
    'align_points("rigid")': ("rigid", aligned("rigid")),
}


def bodies_rows(pool: list[Take], crowds: int, seed: int) -> list[Row]:
    """Errors on the test takes with the spacing chosen on the training takes."""
    training, test = pool[::2], pool[1::2]
    rows: list[Row] = []
    for name, (kind, solve) in METHODS.items():
        note(f"... bodies, {name}")
        training_errors: list[float] = []
        for spacing in SPACINGS:
            draw = torch.Generator().manual_seed(seed)
            some = [crowd(training, spacing, kind, draw) for _ in range(max(1, crowds // 2))]
            training_errors.append(median([gap(solve(c.views, c.motion)[0], c.motion, c.views) for c in some]))
        best = SPACINGS[min(range(len(SPACINGS)), key=training_errors.__getitem__)]
        draw = torch.Generator().manual_seed(seed + 1)
        asked = [crowd(test, best, kind, draw) for _ in range(crowds)]
        found = [solve(c.views, c.motion) for c in asked]
        errors = [gap(motion, c.motion, c.views) for (motion, _), c in zip(found, asked, strict=True)]
        bent = 1000 * torch.cat([c.deviation for c in asked])
        gone = 1000 * torch.cat([(c.world[2] - c.world[0]).norm(dim=-1) for c in asked])
        setting = f"{kind}, {best} frames apart, joints go {gone.median():.0f} mm, off their lines by {bent.median():.2f} mm "
        setting += f"(rms {bent.square().mean().sqrt():.1f}); {listed(Counter(state for _, state in found))}; worst "
        setting += f"{1000 * max(errors):.3g} mm, median"
        rows.append(Row(name, setting, 1000 * median(errors), unit=" mm"))
    return rows


STEPS = (1, 3, 5)  # sweeps, 0.1 s each
THRESHOLD = 0.1
SHARES = (0.0, 0.25, 0.5, 0.75, 0.9, 1.0)
WRONG = 0.1
"""Metres."""


@dataclass(frozen=True)
class Config(BaseConfig):
    """The tensors of space on the recordings in the folder DYNTORCH_DATA."""

    crowds: int = 6
    """Random crowds of the test takes (half as many of the training takes per spacing)."""


# ---- drives ------------------------------------------------------------------------------------------------------------
def starts(drive: Drive, step: int, config: Config, every: int = 10) -> range:
    """First sweeps of the triples."""
    return range(0, len(drive.seconds) - 2 * step, 40 if config.quick else every)


def tensor_rows(logs: list[Drive], config: Config) -> list[Row]:
    """Status of the projective models, and how often it is OK, without a warning, but wrong."""
    rows = []
    for step in STEPS:
        for name, least, solve in PROJECTIVE:
            states, errors, wrong = Counter[str](), [], 0
            for drive in logs:
                for start in starts(drive, step, config, every=30):
                    views, _, A, B = drive.triple(start, step)
                    if len(views[0]) < least:
                        states["refused (too few boxes)"] += 1
                        continue
                    pair, state = solve(views, (A, B))
                    states[state] += 1
                    if state.startswith("OK"):
                        errors.append(gap(pair, (A, B), views))
                        wrong += state == "OK" and errors[-1] > WRONG
            setting = f"{0.1 * step:.1f} s: {listed(states)}"
            setting += f"; median error where OK {median(errors):.2g} m" if errors else ""
            rows.append(Row(name, setting + "; OK but wrong", wrong / sum(states.values())))
    return rows


PROJECTIVE: tuple[tuple[str, int, Solver], ...] = (
    ("JoinTensor", dyn.JoinTensor.minimal(), tensor(dyn.JoinTensor)),
    ("MinimalJoinTensor", dyn.MinimalJoinTensor.minimal(), tensor(dyn.MinimalJoinTensor)),
    ("ConstantVelocityTensor", dyn.ConstantVelocityTensor.minimal(), tensor(dyn.ConstantVelocityTensor)),
    ('align_points("join")', 47, aligned("join")),
    ('align_points("constant_velocity")', 21, aligned("constant_velocity")),
)


def mixed(moving: Tensor, share: float, draw: torch.Generator) -> Tensor:
    """``(n,)`` bool: as many boxes as can be kept so that this share of them moves."""
    rank = torch.rand(len(moving), generator=draw)
    movers, parked = int(moving.sum()), int((~moving).sum())
    if share in (0.0, 1.0):
        return moving == bool(share)
    keep_movers = min(movers, round(parked * share / (1 - share)))
    keep_parked = min(parked, round(keep_movers * (1 - share) / share))
    order = torch.where(moving, rank, 2 + rank).argsort()
    kept = torch.zeros_like(moving)
    kept[order[:keep_movers]] = True
    kept[order[movers : movers + keep_parked]] = True
    return kept


def pose_errors(found: Matrices, true: Matrices) -> list[float]:
    """Degrees, metres, and metres up to a velocity common to all points, of view 3."""
    rotation = max(float(metrics.rotation_error(a, b)) for a, b in zip(found, true, strict=True))
    shift = [a[:3, 3] / a[3, 3] - b[:3, 3] for a, b in zip(found, true, strict=True)]
    common = (shift[0] + 2 * shift[1]) / 5  # least squares of shift_t = t u
    rest = max(float((shift[0] - common).norm()), float((shift[1] - 2 * common).norm()))
    return [x if x == x else float("inf") for x in (rotation, max(float(s.norm()) for s in shift), rest)]


def movers_rows(logs: list[Drive], config: Config, step: int = 3) -> list[Row]:
    """Pose errors against the share of movers, medians over the triples of both logs."""
    methods = ("rigid RANSAC", "align_points, straight", "align_points, constant velocity")
    rows: list[Row] = []
    for share in SHARES:
        errors: dict[str, list[list[float]]] = {name: [] for name in methods}
        states: dict[str, Counter[str]] = {name: Counter() for name in methods}
        for drive in logs:
            for start in starts(drive, step, config):
                views, moving, A, B = drive.triple(start, step)
                draw = torch.Generator().manual_seed(config.seed + start)
                kept = mixed(moving, share, draw)
                some = [x[kept] for x in views]
                theirs = rigid_ransac(some[0], some[1], THRESHOLD, draw), rigid_ransac(some[0], some[2], THRESHOLD, draw)
                errors[methods[0]].append(pose_errors(theirs, (A, B)))
                for name, motion in zip(methods[1:], ("straight", "constant_velocity"), strict=True):
                    one = dyn.align_points(*some, model="rigid", threshold=THRESHOLD, motion=motion, generator=draw)
                    assert one.B is not None
                    errors[name].append(pose_errors((one.A, one.B), (A, B)))
                    states[name][dyn.Status(int(one.status)).name] += 1
                    states[name].update(notice.code.value for notice in one.warnings)
        for name in methods:
            middle = torch.tensor(errors[name]).median(0).values.tolist()
            shift = f"translation {middle[1]:.2g} m, up to a common velocity {middle[2]:.2g} m"
            setting = f"{share:.0%} movers: {shift}; {listed(states[name])}".rstrip("; ")
            rows.append(Row(name, setting + "; rotation", middle[0], unit=" degrees"))
    return rows


@experiment(Config(), quick={"crowds": 2})
def tables(config: Config) -> Tables:
    """Drives and bodies."""
    logs = drives()
    yield "Drives: status of the projective tensors", tensor_rows(logs, config)
    title = f"Drives: rigid motion against the share of movers, 0.3 s between sweeps, threshold {THRESHOLD} m"
    yield title, movers_rows(logs, config)
    yield "Bodies: error of A and B", bodies_rows(takes(), config.crowds, config.seed)

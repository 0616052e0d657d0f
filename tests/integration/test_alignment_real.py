"""Alignment on real recordings; skipped where DYNTORCH_DATA names no folder."""

from __future__ import annotations

import os

import numpy as np
import pytest
import torch

import dyntorch as dyn
from dyntorch import metrics
from dyntorch.tasks.align.result import MOVING, OUTLIER, STATIC
from experiments.alignment.real import planar as real_planar
from experiments.alignment.real.solvers import aligned, gap, rigid_ransac
from experiments.alignment.real.space import crowd
from experiments.common import real_data

pytestmark = pytest.mark.skipif(not os.environ.get("DYNTORCH_DATA"), reason="DYNTORCH_DATA is not set: no real data")


def scored(name: str, triple: int) -> tuple:
    """A recording of traffic, and how three of its frames are aligned."""
    sequence = next(one for one in real_data.traffic() if one.name == name)
    return sequence, real_planar.scored(sequence, real_planar.triples(len(sequence.tracks))[triple], real_planar.Config())


@pytest.mark.parametrize("name", ["cars2B", "cars3", "cars7"])
def test_cars_move_and_roads_do_not(name: str) -> None:
    sequence, one = scored(name, 1)
    # cars that drive alike are as good a background as the road: which of both stands still, nothing tells
    assert one.result.status == (dyn.Status.AMBIGUOUS if name == "cars3" else dyn.Status.OK)
    assert one.accuracy > 0.95
    assert one.share(STATIC, ~sequence.background) == 0
    assert one.share(MOVING, ~sequence.background) > 0.9
    assert one.error < 0.5
    assert 0.05 < float(one.result.sigma) < 0.5


def test_a_car_that_turns_is_not_on_a_straight_path() -> None:
    sequence, one = scored("cars4", 0)
    assert one.share(OUTLIER, ~sequence.background) > 0.9
    assert one.share(STATIC, sequence.background) > 0.9
    assert one.error < 2


@pytest.mark.slow
def test_points_that_all_move_on_a_board_give_its_homographies() -> None:
    seen = real_data.board()
    views = max(real_planar.instants(seen, (1, 1, 1), 2), key=lambda v: float((v[2] - v[0]).norm(dim=-1).median()))
    held = [1, 4, 7, 10]
    known = [k for k in range(len(seen.place)) if k not in held]
    index = torch.tensor([hop for hop in real_planar.itineraries(seen.place, known) if len(set(hop)) > 1])
    one = dyn.align_planar(*(x[index[:, i]] for i, x in enumerate(views)), generator=torch.Generator().manual_seed(0))
    assert one.status == dyn.Status.OK
    assert float((one.labels == STATIC).double().mean()) < 0.02
    everyone = torch.zeros(len(seen.place), dtype=torch.bool)
    everyone[held] = True
    assert real_planar.transfer(one.B, views, everyone) < 2
    # the hops are in a plane that really moved: without its motion they are far off
    assert real_planar.transfer(torch.eye(3).double(), views, everyone) > 5


@pytest.mark.slow
@pytest.mark.parametrize("motion", ["straight", "constant_velocity"])
def test_pose_of_a_car_from_boxes_in_traffic(motion: str) -> None:
    errors = []
    for drive in real_data.drives():
        for start in (10, 60, 110):
            views, moving, _, B = drive.triple(start, 3)
            # at the true pose parked boxes are where they were, and moving ones are not
            off = (views[0] - views[2] @ B[:3, :3].T - B[:3, 3]).norm(dim=-1)
            assert float(off[~moving].max()) < 0.4 and float(off[moving].min()) > 0.25
            draw = torch.Generator().manual_seed(0)
            one = dyn.align_points(*views, model="rigid", threshold=0.1, motion=motion, generator=draw)
            assert one.status == dyn.Status.OK and one.B is not None
            errors.append([float(metrics.rotation_error(one.B, B)), float(metrics.translation_error(one.B, B))])
            assert float(metrics.rotation_error(rigid_ransac(views[0], views[2], 0.1, draw), B)) < 0.2
    assert np.median([e[0] for e in errors]) < 0.05
    assert np.median([e[1] for e in errors]) < 0.05


def test_projective_tensors_say_that_traffic_is_degenerate() -> None:
    for drive in real_data.drives():
        views, _, _, _ = drive.triple(60, 3)
        for invariant in (dyn.JoinTensor, dyn.MinimalJoinTensor):
            assert dyn.fit(invariant, *views).status in (dyn.Status.DEGENERATE, dyn.Status.AMBIGUOUS)


@pytest.mark.slow
def test_rigid_sensors_among_bodies_that_all_move() -> None:
    pool = real_data.takes()[1::2]
    draw = torch.Generator().manual_seed(0)
    turns, ours, none = [], [], []
    for _ in range(5):
        people = crowd(pool, 4, "rigid", draw)
        assert float(people.deviation.median()) < 5e-3
        (A, B), state = aligned("rigid")(people.views, people.motion)
        assert state.startswith("OK")
        turns.append(float(metrics.rotation_error(B, people.motion[1])))
        ours.append(gap((A, B), people.motion, people.views))
        eye = torch.eye(4, dtype=torch.float64)
        none.append(gap((eye, eye), people.motion, people.views))
    # joints nearly keep their velocity, so that static ones alone tell the velocity common to all
    assert np.median(turns) < 2
    assert np.median(ours) < 0.05 < 0.2 < np.median(none)

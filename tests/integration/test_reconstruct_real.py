"""Reconstruction of real motion; skipped where DYNTORCH_DATA names no folder."""

from __future__ import annotations

import math
import os

import numpy as np
import pytest
import torch

import dyntorch as dyn
from experiments.common import real_data
from experiments.reconstruction import data as lifted_data
from experiments.reconstruction import real as real_lifted
from experiments.reconstruction.data import declared, predicted

pytestmark = pytest.mark.skipif(not os.environ.get("DYNTORCH_DATA"), reason="DYNTORCH_DATA is not set: no real data")


@pytest.mark.slow
def test_cars_are_where_constant_velocity_puts_them_in_a_frame_that_was_not_used() -> None:
    sequences = {one.name: one for one in real_data.traffic()}
    ours, still, background = [], [], []
    for name in ("cars2_07", "cars5", "cars7", "cars9"):
        case = real_lifted.asked(sequences[name], 2, True, torch.Generator().manual_seed(0))
        assert case is not None
        there, _ = real_lifted.model("constant_velocity_2d")(case)
        ours.append(case.error(there, cars=True))
        background.append(case.error(there, cars=False))
        still.append(case.error(real_lifted.put(case)[0], cars=True))
    assert np.median(ours) < 0.5 * np.median(still)
    assert np.median(background) < 1


@pytest.mark.slow
def test_cars_and_roads_are_two_bodies() -> None:
    right = []
    for one in lifted_data.pairs():
        if one.name in ("cars2_07_g13", "cars3_g13", "cars6", "cars7"):
            frames = torch.linspace(0, len(one.tracks) - 1, 6).round().long()
            found = declared(one.tracks[frames], "two_bodies_2d", frames.double(), math.inf)
            right.append(max(float((found.labels == labels).double().mean()) for labels in (one.bodies, 3 - one.bodies)))
    assert len(right) == 4 and np.median(right) > 0.95


@pytest.mark.slow
def test_people_who_move_almost_straight_before_a_virtual_drone() -> None:
    pool = real_data.takes()[1::2]
    errors, held, still = [], [], []
    for seed in range(2):
        draw = torch.Generator().manual_seed(seed)
        world = lifted_data.crowd(pool, 4, 7, draw).bent(0.1)
        one = real_lifted.judged(world, "constant_velocity_3d", torch.Generator().manual_seed(seed), reference=False)
        errors.append(float(one.error.position))
        held.append(one.held)
        still.append(real_lifted.judged(world, "static_3d", torch.Generator().manual_seed(seed), reference=False).held)
    assert np.median(errors) < 0.1
    assert np.median(held) < 0.5 * np.median(still)


@pytest.mark.slow
def test_boxes_of_traffic_are_predicted_better_than_if_they_stood_still() -> None:
    held: dict[str, list[float]] = {"constant_velocity_planes_3d": [], "static_3d": []}
    for log in lifted_data.boxes():
        world, measured = log.window(0, 4, 7)
        # the sensor frame and the city frame show the same rigid boxes
        sides = [(x[:, 0::8] - x[:, 7::8]).norm(dim=-1) for x in (world.places, measured)]
        assert torch.allclose(*sides)
        fewer = lifted_data.World(world.places[:, ::3], world.times, world.moving[::3])
        for name, values in held.items():
            values.append(real_lifted.judged(fewer, name, torch.Generator().manual_seed(0), reference=False).held)
    assert np.median(held["constant_velocity_planes_3d"]) < np.median(held["static_3d"])


def test_prediction_of_a_view_is_exact_without_noise() -> None:
    world = lifted_data.crowd(real_data.takes(), 2, 6, torch.Generator().manual_seed(0)).bent(0.0)
    draw = torch.Generator().manual_seed(1)
    tracks = lifted_data.seen(world, lifted_data.drone(world, draw), draw, sigma=0.0)
    kept, half = [0, 1, 3, 4, 5], torch.arange(tracks.shape[1]) % 2 == 0
    found = declared(tracks[kept], "constant_velocity_3d", world.times[kept], math.inf)
    assert found.status in (dyn.Status.OK, dyn.Status.AMBIGUOUS)
    assert float((predicted(found, float(world.times[2]), tracks[2], half) - tracks[2]).abs().max()) < 1e-3
    error = lifted_data.scene_error(found.structure, world.only(kept), "constant_velocity_3d")
    assert float(error.position) < 1e-6

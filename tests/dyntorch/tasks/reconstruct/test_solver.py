"""motion="auto": the model of a scene is found, and the runners-up are listed."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import pytest
import torch

import dyntorch as dyn
from dyntorch import scenes
from dyntorch.core.outcome import Status
from dyntorch.tasks.reconstruct import solver as lifted_choice
from dyntorch.tasks.reconstruct.motions import MOTIONS, Motion
from dyntorch.tasks.reconstruct.reconstruct import normalize_tracks
from dyntorch.tasks.reconstruct.result import Reconstruction
from dyntorch.tasks.reconstruct.scene import ViewTracks
from dyntorch.tasks.reconstruct.solver import LABEL_COST, OUTLIER_COST, LiftedFit, _missing_input, penalized_cost
from tests.draws import seeded


@pytest.mark.slow
@pytest.mark.parametrize("name", ["static_3d", "constant_velocity_2d", "constant_direction_3d", "two_bodies_3d"])
def test_the_model_of_the_scene(name: str) -> None:
    scene = scenes.lifted_points(name, 80, views=4, sigma=0.5, generator=seeded(7))
    found = dyn.reconstruct(scene.tracks, "auto", threshold=math.inf)
    assert found.motion.name == name and found.status == Status.OK
    scores = [one.score for one in found.candidates]
    assert scores == sorted(scores) and len(scores) >= 8
    assert f"then {found.candidates[1].motion}" in repr(found)


def test_formula() -> None:
    scene = scenes.lifted_points("constant_velocity_2d", 10, views=3, generator=seeded())
    weights = torch.ones(1, 3, 10, dtype=torch.float64)
    tracks = normalize_tracks(scene.tracks[None], weights, scene.times)
    apart = torch.full((1, 3, 10), 0.5, dtype=torch.float64)
    apart[0, :, 0] = 100.0
    motion = MOTIONS["constant_velocity_2d"]
    found = penalized_cost(
        tracks, LiftedFit(motion, apart, torch.tensor([False]), torch.ones(1)), torch.full((1,), 0.5, dtype=torch.float64)
    )
    # 3 cameras of 8, less the ambiguity of 8; every good point leaves 3 sigma^2, but no more than that of 6 - 4 coordinates
    expected = 10 * min(3.0, OUTLIER_COST * 2) - 3.0 + OUTLIER_COST * 2 + 10 * 4 * math.log(6) + (24 - 8) * math.log(60)
    assert abs(float(found) - expected) < 1e-9
    assert math.log(2) > LABEL_COST


@pytest.mark.slow
def test_models_that_were_not_tried_say_why() -> None:
    scene = scenes.lifted_points("constant_direction_2d", 30, views=4, sigma=0.5, generator=seeded(7))
    found = dyn.reconstruct(scene.tracks, "auto", threshold=math.inf)
    reasons = {one.motion: one.reason for one in found.candidates if one.reason}
    assert reasons.items() >= {"constant_acceleration_2d": "needs 40 tracks", "constant_velocity_3d": "needs 40 tracks"}.items()
    assert "not tried: " in repr(found) and "constant_velocity_3d (needs 40 tracks)" in repr(found)
    assert all(one.score == math.inf for one in found.candidates if one.reason)
    times = torch.tensor([0.0, 0.0, 1.0, 1.0], dtype=torch.float64)
    assert _missing_input(MOTIONS["constant_velocity_2d"], times, 4, 30) == "needs views at 3 different times"
    assert _missing_input(MOTIONS["constant_velocity_3d"], times[:2], 2, 30) == "needs 4 views"
    assert _missing_input(MOTIONS["static_3d"], times, 4, 30) == ""
    assert MOTIONS["two_bodies_3d"].min_views_and_tracks(torch.arange(5.0)) == (3, 14)


@pytest.mark.slow
@pytest.mark.parametrize(("wrong", "all_tried"), [(0, False), (1, False), (3, True)])
def test_models_are_all_fitted_robustly_only_where_outliers_mislead_least_squares(
    monkeypatch: pytest.MonkeyPatch, wrong: int, all_tried: bool
) -> None:
    tried: list[Reconstruction] = []
    solve = lifted_choice.solve

    def noted(tracks: ViewTracks, motion: Motion, *rest: Any) -> Reconstruction:
        # the others need not be solved: only whether they are asked for matters
        tried.append(replace(tried[0], motion=motion) if tried else solve(tracks, motion, *rest))
        return tried[-1]

    monkeypatch.setattr(lifted_choice, "solve", noted)
    scene = scenes.lifted_points("constant_velocity_2d", 80, views=4, sigma=0.5, generator=seeded(7))
    tracks, draw = scene.tracks.clone(), seeded(1)
    # 2.5 px is no gross error
    off = 2.5 * torch.ones(1, 2) if wrong == 1 else 100 * torch.randn(wrong, 2, generator=draw)
    tracks[2, :wrong] += off.double()
    found = dyn.reconstruct(tracks, "auto", generator=draw)
    assert (len(tried) > 5) is all_tried
    assert all_tried or (found.status == Status.OK and found.motion.name == "constant_velocity_2d")

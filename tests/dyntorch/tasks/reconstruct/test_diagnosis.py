"""Which condition of a model failed: statuses and notices on sound and on degenerate scenes, with and without noise."""

from __future__ import annotations

import math

import pytest
import torch

import dyntorch as dyn
from dyntorch import scenes
from dyntorch.core.outcome import Status
from dyntorch.scenes.lifts import KINDS
from dyntorch.tasks.reconstruct.result import Reconstruction, ReconstructNotice
from tests.draws import seeded


def solved(name: str, sigma: float = 0.5, **options: object) -> Reconstruction:
    views = max(5, KINDS[name].views)
    generator = seeded(1)
    scene = scenes.lifted_points(name, 80, views=views, batch=3, sigma=sigma, generator=generator, **options)
    return dyn.reconstruct(scene.tracks, name, scene.times, threshold=math.inf)


def codes(found: Reconstruction, problem: int) -> set[ReconstructNotice]:
    return {w.code for w in found.warnings if w.problem == (problem,)}


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in KINDS if "sensors" not in name])
def test_sound_scenes_raise_no_doubt(name: str) -> None:
    found = solved(name)
    assert (found.status == Status.OK).all()
    assert {w.code for w in found.warnings} <= {ReconstructNotice.UNCERTAIN}


STILL = ["constant_direction_2d", "constant_velocity_2d", "constant_direction_3d", "constant_velocity_3d"]


@pytest.mark.slow
@pytest.mark.parametrize("sigma", [0.0, 0.5])
@pytest.mark.parametrize("name", STILL)
def test_static_scenes(name: str, sigma: float) -> None:
    found = solved(name, sigma, static=1.0)
    assert (found.status == (Status.AMBIGUOUS if sigma else Status.DEGENERATE)).all()
    causes = {ReconstructNotice.STATIC_SCENE, ReconstructNotice.TURNING_CAMERA}
    assert all(codes(found, i) & causes for i in range(3))
    with pytest.raises(ValueError, match="a smaller model leaves a residual"):
        found.check()


CAMERAS = {
    "static_3d": (0.0, ReconstructNotice.TURNING_CAMERA),
    "constant_direction_3d": (0.0, ReconstructNotice.TURNING_CAMERA),
    "constant_velocity_planes_3d": (1.0, ReconstructNotice.UNIFORM_CAMERA),
    "constant_velocity_3d": (1.0, ReconstructNotice.UNIFORM_CAMERA),
}


@pytest.mark.slow
@pytest.mark.parametrize("sigma", [0.0, 0.5])
@pytest.mark.parametrize("name", CAMERAS)
def test_cameras_that_stand_still_or_move_uniformly(name: str, sigma: float) -> None:
    drift, code = CAMERAS[name]
    found = solved(name, sigma, jitter=0.0, drift=drift)
    assert not (found.status == Status.OK).any()
    assert sum(code in codes(found, i) for i in range(3)) >= 2


@pytest.mark.slow
@pytest.mark.parametrize("name", ["two_bodies_2d", "two_bodies_3d"])
def test_one_body(name: str) -> None:
    found = solved(name, static=1.0)
    assert (found.status == Status.AMBIGUOUS).all()
    assert all(ReconstructNotice.ONE_BODY in codes(found, i) for i in range(3))


@pytest.mark.slow
def test_collinear_images() -> None:
    scene = scenes.lifted_points("constant_velocity_2d", 40, views=4, generator=seeded())
    tracks = scene.tracks.clone()
    tracks[..., 1] = 2 * tracks[..., 0]
    found = dyn.reconstruct(tracks, "constant_velocity_2d")
    assert found.status == Status.DEGENERATE
    assert ReconstructNotice.COLLINEAR in {w.code for w in found.warnings}


def test_tracks_of_one_observation_have_no_position() -> None:
    scene = scenes.lifted_points("constant_velocity_2d", 60, views=4, sigma=0.3, generator=seeded())
    tracks = scene.tracks.clone()
    tracks[1:, :4] = torch.nan
    found = dyn.reconstruct(tracks, "constant_velocity_2d")
    assert found.status == Status.OK
    (notice,) = [w for w in found.warnings if w.code == ReconstructNotice.FEW_OBSERVED]
    assert notice.value == 4 and bool(found.points[:4].isnan().all()) and bool(found.points[4:].isfinite().all())

"""Thesis 1.2: an affine reconstruction, "from which a Euclidean one is readily given", for every motion of chapter 3 and more.

The scenes are written here from the definitions: points that move, cameras K [R | t] at every view, images by division.
"""

from __future__ import annotations

import math
from functools import partial

import pytest
import torch
from torch import Tensor

import dyntorch as dyn
from dyntorch.core.outcome import Status
from dyntorch.geometry.rigid import rotation_exponential
from dyntorch.scenes.lifts import KINDS
from dyntorch.tasks.reconstruct.motions import MOTIONS
from dyntorch.tasks.reconstruct.result import Reconstruction

K = torch.tensor([[1300.0, 0.0, 500.0], [0.0, 1280.0, 480.0], [0.0, 0.0, 1.0]], dtype=torch.float64)


def filmed(name: str, views: int, n: int, seed: int, turning: bool = False) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Images ``(views, n, l)``, points ``(views, n, d)``, R and t of a motion, by its definition."""
    normal = partial(torch.randn, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    kind = KINDS[name]
    dim, moving = kind.dim, kind.axes
    t = torch.arange(float(views), dtype=torch.float64)[:, None, None]
    X = torch.zeros(views, n, 3, dtype=torch.float64)
    X[..., :dim] = normal(n, dim)
    X[..., :moving] += 0.12 * t * normal(n, moving)
    if kind.degree > 1:
        X[..., :moving] += 0.03 * t**2 * normal(n, moving)
    if kind.bodies > 1:
        X[:, n // 2 :, :dim] += 0.5 * normal(views, 1, dim)
    R = rotation_exponential(0.35 * normal(views, 3) + torch.tensor([0.5, 0.2, 0.0], dtype=torch.float64))
    centre = torch.tensor([0.3, -0.2, -6.0], dtype=torch.float64) + (0.0 if turning else 0.6) * normal(views, 3)
    shift = -(R @ centre[..., None])[..., 0] if turning else centre * torch.tensor([1.0, 1.0, -1.0])
    seen = X @ R.mT + shift[:, None]
    if not kind.sensors:
        seen = seen @ K.mT
        seen = seen[..., :2] / seen[..., 2:]
    return seen, X[..., :dim], R, shift


def apart(found: Tensor, true: Tensor, scale: bool = True) -> float:
    """Rms distance, over the size of the scene, after one similarity for all views and a shift of each (a common motion)."""
    a, b = (x - x.mean(-2, keepdim=True) for x in (found, true))
    u, s, vh = torch.linalg.svd((b.mT @ a).sum(0))
    size = s.sum() / a.square().sum() if scale else 1.0
    return float((size * a @ (u @ vh).mT - b).norm() / b.norm())


def tracked(found: Reconstruction, views: int) -> Tensor:
    return torch.stack([found.at(float(t)) for t in range(views)])


@pytest.mark.parametrize("name", [name for name in MOTIONS if KINDS[name].bodies == 1])
def test_scene_is_metric_up_to_a_similarity_and_what_all_points_share(name: str) -> None:
    """Known K makes every motion metric; exact data leave rounding.  Static planes take a third view."""
    views, tracks = MOTIONS[name].min_views_and_tracks(torch.arange(6.0))
    views += name == "static_2d"
    sensors = KINDS[name].sensors
    x, X, _, _ = filmed(name, views, max(45, math.ceil(1.25 * tracks)), 3)
    given = torch.eye(4, dtype=torch.float64) if sensors else K
    found = dyn.reconstruct(x, name, threshold=float("inf"), calibration=given)
    assert found.check().metric is not None and bool(found.metric) and "similarity" in found.ambiguity + "rigid similarity"
    assert apart(tracked(found, views), X, scale=not sensors) < 1e-8
    # the cameras are K [R | t], and show the points where they were seen
    assert found.rotations is not None and found.translations is not None
    assert float((found.rotations @ found.rotations.mT - torch.eye(3)).abs().max()) < 1e-9
    assert float((torch.linalg.det(found.rotations) - 1).abs().max()) < 1e-9
    world = tracked(found, views)
    turned = world @ found.rotations[..., : world.shape[-1]].mT + found.translations[:, None]
    if sensors:
        assert float((turned - x).abs().max()) < 1e-8
        return
    assert float(turned[..., 2].min()) > 0
    seen = turned @ K.mT
    assert float((seen[..., :2] / seen[..., 2:] - x).abs().max()) < 1e-6


@pytest.mark.parametrize("name", ["two_bodies_2d", "two_bodies_3d"])
def test_both_bodies_are_metric_and_turn_together(name: str) -> None:
    """The rotations of the cameras against both bodies are one; each body is right up to its own similarity."""
    x, X, R, _ = filmed(name, 4, 40, 5)
    found = dyn.reconstruct(x, name, threshold=float("inf"), calibration=K.expand(4, 3, 3)).check()
    assert found.rotations is not None and found.translations is not None and found.translations.shape == (2, 4, 3)
    for half in (slice(0, 20), slice(20, 40)):
        assert apart(found.points[None, half], X[:1, half]) < 1e-8
    if name == "two_bodies_3d":
        assert float((found.rotations @ found.rotations[:1].mT - R @ R[:1].mT).abs().max()) < 1e-8


@pytest.mark.slow
def test_directions_between_points_that_no_affine_frame_tells() -> None:
    """Without K constant velocity leaves angles open; with it they are right, and at half a pixel nearly so."""
    x, X, _, _ = filmed("constant_velocity_3d", 6, 60, 1)
    free = dyn.reconstruct(x, "constant_velocity_3d", threshold=float("inf"))
    assert free.metric is None and apart(tracked(free, 6), X) > 0.05
    noisy = x + 0.5 * torch.randn(x.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    found = dyn.reconstruct(noisy, "constant_velocity_3d", threshold=float("inf"), calibration=K).check()
    assert apart(tracked(found, 6), X) < 0.02 and float(found.sigma) < 0.6


def test_batch_with_a_calibration_of_each_view_is_its_loop() -> None:
    """Cameras of different focal lengths, in a batch, with missing observations; the loop gives the same."""
    scenes = [filmed("constant_velocity_2d", 4, 30, seed) for seed in (0, 1)]
    zoom = torch.diag_embed(torch.tensor([[1.0, 1.0, 1.0], [1.2, 1.2, 1.0], [0.8, 0.8, 1.0], [1.1, 1.1, 1.0]]).double())
    x = torch.stack([s[0] @ zoom[:, :2, :2] for s in scenes])
    x[0, 1, 3] = torch.nan
    both = dyn.reconstruct(x, "constant_velocity_2d", threshold=float("inf"), calibration=zoom @ K)
    assert both.metric is not None and both.metric.tolist() == [True, True]
    for i, scene in enumerate(scenes):
        one = dyn.reconstruct(x[i], "constant_velocity_2d", threshold=float("inf"), calibration=zoom @ K)
        place = torch.stack([both.at(float(t))[i] for t in range(4)])
        assert apart(tracked(one, 4), scene[1]) < 1e-8 and apart(place, scene[1]) < 1e-8


@pytest.mark.slow
def test_two_views_of_a_plane_leave_two_slants_and_a_third_decides() -> None:
    """The two decompositions of a calibrated homography (Faugeras and Lustman): one is given, and the other is said to exist."""
    kinds = set()
    for seed in range(6):
        x, X, _, _ = filmed("static_2d", 3, 20, seed)
        two = dyn.reconstruct(x[:2], "static_2d", threshold=float("inf"), calibration=K)
        open_ = [n for n in two.notices if n.code == "metric_several"]
        assert (int(two.status) == Status.AMBIGUOUS) == bool(open_) and (open_ or apart(tracked(two, 1), X[:1]) < 1e-8)
        kinds.add(bool(open_))
        three = dyn.reconstruct(x, "static_2d", threshold=float("inf"), calibration=K).check()
        assert apart(tracked(three, 1), X[:1]) < 1e-8
    assert kinds == {True, False}  # where half of the points would be behind a camera the other is none


@pytest.mark.slow
def test_what_has_no_metric_frame_says_why_and_stays_as_it_is() -> None:
    """A camera that only turns tells no slant of a plane; a wrong K is refused, each with its notice."""
    x, _, _, _ = filmed("static_2d", 4, 20, 2, turning=True)
    found = dyn.reconstruct(x, "static_2d", threshold=float("inf"), calibration=K)
    assert found.metric is not None and not bool(found.metric) and found.notices[-1].code == "metric_family"
    assert "turns" in found.notices[-1].text and float(found.rotations.abs().max()) == 0  # type: ignore[union-attr]
    plain = dyn.reconstruct(x, "static_2d", threshold=float("inf"))
    assert torch.equal(found.cameras, plain.cameras) and "collineation" in found.ambiguity
    # a plane whose points move at constant velocity is metric before the same camera: its vanishing line is known
    x, X, _, _ = filmed("constant_velocity_2d", 4, 30, 2, turning=True)
    assert apart(tracked(dyn.reconstruct(x, "constant_velocity_2d", threshold=float("inf"), calibration=K), 4), X) < 1e-8
    x, _, _, _ = filmed("constant_velocity_3d", 5, 45, 3)
    wrong = torch.diag(torch.tensor([2.0, 0.7, 1.0], dtype=torch.float64)) @ K
    found = dyn.reconstruct(x, "constant_velocity_3d", threshold=float("inf"), calibration=wrong)
    assert not bool(found.metric) and "calibration" in [n.code for n in found.notices]

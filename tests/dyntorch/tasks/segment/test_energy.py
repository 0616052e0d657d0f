"""The cost of a segmentation: against loops over the matches, and the parallax against finite differences of points of space."""

from __future__ import annotations

import math

import pytest
import torch

from dyntorch import scenes
from dyntorch.geometry.homogeneous import apply, homogeneous, skew, unit
from dyntorch.tasks.segment.coherence import (
    CUT_COST,
    ENERGY_MAX_SQUARED_DISTANCE,
    MIN_PARALLAX_PIXELS,
    PARALLAX_FREEDOM,
    PARALLAX_WEIGHT,
    SAMPSON_NOISE_PIXELS,
    View,
    coherence,
    energy,
    parallax,
)

F64 = torch.float64
PIXEL = 1 / 200


def draw(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def view_of(x1, x2) -> View:
    return View(x1, x2, PIXEL, coherence(x1, x2, 3 * PIXEL).links)


def scene_view(seed: int = 0, **options) -> tuple[View, torch.Tensor, torch.Tensor]:
    """Two bodies around 0 at unit size, their matrices and labels from 0."""
    scene = scenes.bodies(60, 2, generator=draw(seed), **options)
    x1, x2 = (x * PIXEL - torch.tensor([1.6, 1.2], dtype=F64) for x in scene.views)
    T = torch.tensor([[PIXEL, 0, -1.6], [0, PIXEL, -1.2], [0, 0, 1]], dtype=F64)
    inverse = torch.linalg.inv(T)
    return view_of(x1, x2), unit(inverse.mT @ torch.stack(scene.motion) @ inverse), scene.labels - 1


def one_hot(labels):
    return (labels == torch.arange(2)[:, None]).to(F64)


def plane_and_points(count: int = 40):
    """F and H of a plane, points x1, and x2(x1, rho) = H x1 + rho e, for points off the plane."""
    epipole = torch.tensor([0.9, -0.3, 0.2], dtype=F64)
    H = torch.eye(3, dtype=F64) + 0.1 * torch.randn(3, 3, generator=draw(3), dtype=F64)
    x1 = 2 * torch.rand(count, 2, generator=draw(4), dtype=F64) - 1

    def second(rho):
        moved = homogeneous(x1) @ H.mT + torch.as_tensor(rho, dtype=F64)[..., None] * epipole
        return moved[..., :2] / moved[..., 2:]

    return unit(skew(epipole) @ H), H, x1, second


def test_energy_is_the_sum_over_matches_and_pairs():
    view, F, labels = scene_view(sigma=1.0)
    labels = torch.stack([labels, labels.roll(3)])
    member = torch.stack([one_hot(row) for row in labels])
    found = energy(view, F.expand(2, 2, 3, 3), member)
    relief, scale = parallax(view, F.expand(2, 2, 3, 3), member)
    full = view.links.pull(torch.eye(60, dtype=F64))
    for b, row in enumerate(labels.tolist()):
        expected = 0.0
        for i, k in enumerate(row):
            one, two = homogeneous(view.x1[i]), homogeneous(view.x2[i])
            line, other = F[k] @ one, F[k].mT @ two
            square = float((two @ line) ** 2 / (line[:2] @ line[:2] + other[:2] @ other[:2]))
            expected += min(square / (SAMPSON_NOISE_PIXELS * PIXEL) ** 2, ENERGY_MAX_SQUARED_DISTANCE)
            expected += sum(CUT_COST * float(full[i, j]) for j in range(i) if row[j] != k)
            p, t = float(relief[b, k, i]), float(scale[b, k])
            nu = PARALLAX_FREEDOM
            expected += PARALLAX_WEIGHT * ((nu + 1) * math.log(1 + p * p / (nu * t)) + math.log(t))
        assert float(found[b]) == pytest.approx(expected, rel=1e-9)
    assert found[0] < found[1]


def test_empty_bodies_cost_nothing():
    view, F, labels = scene_view(sigma=0.5)
    member = one_hot(labels)
    found = energy(view, F[None], member[None])
    more = energy(
        view,
        torch.cat([F, torch.zeros(1, 3, 3, dtype=F64)])[None],
        torch.cat([member, torch.zeros(1, 60, dtype=F64)])[None],
    )
    torch.testing.assert_close(more, found)


def test_points_of_a_plane_have_no_parallax():
    F, _, x1, second = plane_and_points()
    view = view_of(x1, second(torch.zeros(40)))
    value, scale = parallax(view, F[None, None], torch.ones(1, 1, 40, dtype=F64))
    assert float(value.abs().max()) < 1e-5
    torch.testing.assert_close(scale, torch.full((1, 1), MIN_PARALLAX_PIXELS**2, dtype=F64))


def test_parallax_is_the_way_along_the_epipolar_line_in_pixels():
    F, H, x1, second = plane_and_points()
    step = torch.zeros(40, dtype=F64)
    step[:12] = 1e-4 * torch.linspace(-1, 1, 12, dtype=F64)
    member = (step == 0).to(F64)[None, None]  # the plane is that of the others
    value, _ = parallax(view_of(x1, second(step)), F[None, None], member)
    way = (second(step) - apply(H, x1)).norm(dim=-1) / PIXEL
    torch.testing.assert_close(value[0, 0, :12].abs(), way[:12], rtol=1e-3, atol=1e-7)
    # to both sides of the plane
    assert bool((value[0, 0, :6] * value[0, 0, 6:12].flip(0) < 0).all())
    for factor in (-1.0, 7.0, 1e-3):
        scaled, _ = parallax(view_of(x1, second(step)), factor * F[None, None], member)
        torch.testing.assert_close(scaled.abs(), value.abs(), rtol=1e-6, atol=1e-6)


def test_a_few_points_off_the_plane_do_not_bend_it():
    F, _, x1, second = plane_and_points()
    step = torch.zeros(40, dtype=F64)
    step[:6] = 0.3
    value, scale = parallax(view_of(x1, second(step)), F[None, None], torch.ones(1, 1, 40, dtype=F64))
    assert float(value[0, 0, 6:].abs().max()) < 1.0 and float(value[0, 0, :6].abs().min()) > 20
    assert float(scale) < 8 * MIN_PARALLAX_PIXELS**2


def test_scale_is_that_of_students_distribution():
    F, _, x1, second = plane_and_points(400)
    normal = torch.randn(3, 400, generator=draw(5), dtype=F64)
    student = normal[0] / ((normal[1] ** 2 + normal[2] ** 2) / 2).sqrt()
    slope = (second(torch.full((400,), 1e-5)) - second(torch.zeros(400))).norm(dim=-1) / 1e-5
    _, scale = parallax(view_of(x1, second(student * 6 * PIXEL / slope)), F[None, None], torch.ones(1, 1, 400, dtype=F64))
    assert 5 < math.sqrt(float(scale)) < 7.2


def test_batches_are_loops_and_subsets_are_views_of_their_own():
    view, F, labels = scene_view(1, sigma=0.5)
    turned = torch.stack([F, F.flip(0), F])
    member = torch.stack([one_hot(labels), one_hot(labels), one_hot(labels.roll(7))])
    value, scale = parallax(view, turned, member)
    total = energy(view, turned, member)
    for b in range(3):
        one, two = parallax(view, turned[b : b + 1], member[b : b + 1])
        torch.testing.assert_close(value[b], one[0])
        torch.testing.assert_close(scale[b], two[0])
        torch.testing.assert_close(total[b], energy(view, turned[b : b + 1], member[b : b + 1])[0])
    keep = torch.randperm(60, generator=draw())[:30]
    part = view.subset(keep)
    assert part.pixel == PIXEL and torch.equal(part.x1, view.x1[keep]) and torch.equal(part.x2, view.x2[keep])
    assert len(part.links.index) == 30


def test_absent_bodies_and_matches_at_the_epipole_stay_finite():
    view, F, labels = scene_view(2)
    nothing = torch.zeros(1, 2, 60, dtype=F64)
    for matrices in (F[None], torch.zeros(1, 2, 3, 3, dtype=F64)):
        value, scale = parallax(view, matrices, nothing)
        assert bool(value.isfinite().all()) and bool(scale.isfinite().all())
        assert bool(energy(view, matrices, one_hot(labels)[None]).isfinite().all())
    # zoom: the epipole is a point of the image
    F, zoom = skew(torch.tensor([0.0, 0.0, 1.0], dtype=F64)), view.x1.clone()
    zoom[0] = 0.0
    value, _ = parallax(View(zoom, 1.2 * zoom, PIXEL, view.links), F[None, None], torch.ones(1, 1, 60, dtype=F64))
    assert bool(value.isfinite().all())

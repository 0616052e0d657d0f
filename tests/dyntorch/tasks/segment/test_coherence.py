"""coherence: the graph of matches that move alike, against loops over the formula, and what it must not depend on."""

from __future__ import annotations

import math

import pytest
import torch

from dyntorch import scenes
from dyntorch.geometry.epipolar import sampson_squared
from dyntorch.geometry.homogeneous import apply, homogeneous, skew, unit
from dyntorch.tasks.segment import coherence as module
from dyntorch.tasks.segment.coherence import (
    CUT_COST,
    DEVIATION_TOLERANCE,
    EDGE_TOLERANCE,
    ENERGY_MAX_SQUARED_DISTANCE,
    MIN_NEIGHBOUR_COHERENCE,
    MIN_PARALLAX_PIXELS,
    NUM_EDGES,
    NUM_NEIGHBOURS,
    NUM_PASSES,
    PARALLAX_FREEDOM,
    PARALLAX_WEIGHT,
    RIDGE,
    SAMPSON_NOISE_PIXELS,
    Links,
    View,
    coherence,
    conformity,
    energy,
    parallax,
)
from dyntorch.tasks.segment.search import one_hot
from dyntorch.tasks.segment.track_energy import no_links
from tests.dyntorch.tasks.segment.videos import F64, draw, true_view

SCALE = 0.01


def points(n: int, seed: int = 0) -> torch.Tensor:
    return torch.rand(n, 2, generator=draw(seed), dtype=F64)


def affine(x: torch.Tensor, noise: float = 0.0) -> torch.Tensor:
    matrix = torch.tensor([[1.1, 0.15], [-0.1, 0.9]], dtype=F64)
    return x @ matrix.mT + 0.3 + noise * torch.randn(x.shape, generator=draw(9), dtype=F64)


def mixed(n: int = 40) -> tuple[torch.Tensor, torch.Tensor]:
    """An affine field with noise, one match in four wrong, two repeated."""
    x1 = points(n)
    x2 = affine(x1, 0.01)
    x2[::4] = points(len(x2[::4]), 5)
    x1[1], x2[1] = x1[2], x2[2]
    return x1, x2


def similarity(zoom: float, angle: float) -> torch.Tensor:
    c, s = zoom * math.cos(angle), zoom * math.sin(angle)
    return torch.tensor([[c, -s], [s, c]], dtype=F64)


def deviations(a, b, i, neighbours):
    """The formula for one match, where the common motion is the identity."""
    size = [float((a[j] - a[i]).norm()) + SCALE for j in neighbours]
    moment, target = torch.zeros(2, 2, dtype=F64), torch.zeros(2, 2, dtype=F64)
    errors = [(b[j] - b[i]) - (a[j] - a[i]) for j in neighbours]
    for j, s, error in zip(neighbours, size, errors, strict=True):
        weight = math.exp(-((float(error.norm()) / s / DEVIATION_TOLERANCE) ** 2))
        moment += weight * torch.outer(a[j] - a[i], a[j] - a[i])
        target += weight * torch.outer(a[j] - a[i], error)
    moment += (RIDGE * moment.trace() + 4 * SCALE**2) * torch.eye(2, dtype=F64)
    local = torch.linalg.solve(moment, target)
    return [float((e - (a[j] - a[i]) @ local).norm()) / s for j, s, e in zip(neighbours, size, errors, strict=True)]


def brute_force(x1, x2):
    """Values and the dense matrix of links, one match at a time."""
    n = len(x1)
    joint = torch.cat([x1, x2], dim=-1)
    values = [1.0] * n

    def apart(i: int, j: int) -> bool:
        return bool((joint[i] - joint[j]).norm() >= SCALE / 6)

    for _ in range(NUM_PASSES):
        trusted, values, links = values, [0.0] * n, torch.zeros(n, n, dtype=F64)
        for a, b in ((x1, x2), (x2, x1)):
            for i in range(n):
                others = [
                    j
                    for j in range(n)
                    if apart(i, j) and trusted[j] > MIN_NEIGHBOUR_COHERENCE and all(apart(j, k) for k in range(j))
                ]
                others = sorted(others, key=lambda j: float((a[i] - a[j]).norm()))[:NUM_NEIGHBOURS]
                deviation = deviations(a, b, i, others)
                values[i] += sum(math.exp(-((d / DEVIATION_TOLERANCE) ** 2)) for d in deviation) / len(others) / 2
                for j, d in list(zip(others, deviation, strict=True))[:NUM_EDGES]:
                    weight = math.exp(-((d / EDGE_TOLERANCE) ** 2)) / 4
                    links[i, j] += weight
                    links[j, i] += weight
    return torch.tensor(values, dtype=F64), links


def dense(links: Links) -> torch.Tensor:
    return links.pull(torch.eye(len(links.index), dtype=F64)).mT


@pytest.mark.slow
def test_formula_one_match_at_a_time():
    x1, x2 = mixed(26)
    found = coherence(x1, x2, SCALE)
    values, links = brute_force(x1, x2)
    torch.testing.assert_close(found[0], values)
    torch.testing.assert_close(dense(found[1]), links)
    assert bool((found[1].weight >= 0).all()) and bool((found[1].weight <= 1).all())


def test_links_are_symmetric_gathered_cut_and_taken_in_part(monkeypatch):
    links = coherence(*mixed(), SCALE)[1]
    full = torch.zeros(40, 40, dtype=F64)
    for i in range(40):
        for j, weight in zip(links.index[i].tolist(), links.weight[i].tolist(), strict=True):
            full[i, j] += weight
    torch.testing.assert_close(full, full.mT)
    assert bool((full.diagonal() == 0).all())
    values = torch.randn(2, 3, 40, generator=draw(1), dtype=F64)
    torch.testing.assert_close(links.pull(values), values @ full)
    labels = torch.randint(0, 3, (2, 40), generator=draw(2))
    expected = [full[row[:, None] != row].sum() / 2 for row in labels]
    torch.testing.assert_close(links.cut_weight(one_hot(labels, 3)), torch.stack(expected))
    keep = torch.randperm(40, generator=draw(3))[:23]
    torch.testing.assert_close(dense(links.subset(keep)), full[keep][:, keep])
    monkeypatch.setattr(module, "DENSE", 10)
    torch.testing.assert_close(Links(links.index, links.weight).pull(values), values @ full)


def test_components_of_a_chain_and_without_links():
    n, everything = 50, torch.ones(50, dtype=torch.bool)
    index = torch.stack([(torch.arange(n) - 1).clamp(min=0), (torch.arange(n) + 1).clamp(max=n - 1)], dim=-1)
    chain = Links(index, torch.ones(n, 2, dtype=F64))
    assert bool((chain.components(0.5, everything) == 0).all())
    assert chain.components(0.5, torch.arange(n) != 20).bincount().tolist() == [20, 1, n - 21]
    none = no_links(n, index.device)
    assert torch.equal(none.components(0.5, everything), torch.arange(n))
    assert bool((none.pull(torch.ones(2, n, dtype=F64)) == 0).all())
    assert none.subset(torch.arange(7)).index.shape == (7, 0)


def test_place_turn_scale_views_and_order_of_the_matches_do_not_matter():
    x1, x2 = mixed()
    found = coherence(x1, x2, SCALE)
    shift = torch.tensor([30.0, -7.0], dtype=F64)
    for angle in (0.0, 0.7):
        turn = similarity(1.0, angle)
        moved = coherence(x1 @ turn.mT + shift, x2 @ turn.mT - shift, SCALE)
        torch.testing.assert_close(moved[0], found[0], rtol=0, atol=1e-9)
    for other in (coherence(250 * x1, 250 * x2, 250 * SCALE), coherence(x2, x1, SCALE)):
        torch.testing.assert_close(other[0], found[0], rtol=0, atol=1e-9)
        torch.testing.assert_close(dense(other[1]), dense(found[1]), rtol=0, atol=1e-9)
    order = torch.randperm(40, generator=draw(6))
    # not the two repeated ones, of which one or the other may be a neighbour
    torch.testing.assert_close(coherence(x1[order], x2[order], SCALE)[0], found[0][order], rtol=0, atol=1e-9)


def test_affine_fields_are_coherent_and_random_matches_are_not():
    x1 = points(150)
    assert float(coherence(x1, affine(x1, 0.002), SCALE)[0].min()) > 0.7
    found = coherence(x1, points(150, 1), SCALE)
    assert float(found[0].mean()) < 0.1
    assert int(found[1].components(0.3, found[0] > 0.2).unique(return_counts=True)[1].max()) < 7
    x2 = affine(x1, 0.002)
    x2[:75] = points(75, 2)
    assert right_from_wrong(coherence(x1, x2, SCALE)[0], 75)
    for n in (1, 2, 3, 9):
        found = coherence(points(n), affine(points(n)), SCALE)
        assert found[0].shape == (n,) and bool(found[0].isfinite().all()) and found[1].index.shape[0] == n


def test_repeated_matches_confirm_nothing():
    # not the copies of random matches each other, nor those of a neighbour the local motion towards it
    for x1, x2 in ((points(60), points(60, 1)), mixed(60)):
        alone = coherence(x1, x2, SCALE)
        found = coherence(x1.repeat(6, 1), x2.repeat(6, 1), SCALE)
        torch.testing.assert_close(found[0], alone[0].repeat(6), rtol=0, atol=1e-9)
    same = coherence(x1[:1].expand(30, 2), x2[:1].expand(30, 2), SCALE)
    assert bool((same[0] == 0).all()) and bool((same[1].weight == 0).all())


def right_from_wrong(values, wrong: int) -> bool:
    """The first matches are wrong."""
    right, random = (values[wrong:] > 0.35).double().mean(), (values[:wrong] < 0.2).double().mean()
    return float(right) > 0.97 and float(random) > 0.9


def test_common_zoom_and_rotation_are_recognized_and_parts_that_turn_far():
    x1 = points(200)
    noise = 0.002 * torch.randn(200, 2, generator=draw(7), dtype=F64)
    for zoom, angle in ((2.0, 0.0), (0.5, 0.0), (1.0, math.pi / 2), (1.5, -2.0)):
        x2 = x1 @ similarity(zoom, angle).mT + 0.5 + noise
        x2[:60] = zoom * points(60, 8)
        assert right_from_wrong(coherence(x1, x2, SCALE)[0], 60), (zoom, angle)
    right = x1[:, 0] > 0.7
    for angle in (math.pi / 2, 2.0, math.pi):
        x2 = torch.where(right[:, None], x1 @ similarity(1.0, angle).mT, x1 + 0.1) + noise
        values, links = coherence(x1, x2, SCALE)
        assert float(values[right].median()) > 0.7 and float(values[~right].median()) > 0.7
        assert float(links.cut_weight(torch.stack([right, ~right]).double())) < 0.1 * float(links.weight.sum()) / 2


def test_conformity_asks_the_members_of_each_body_alone():
    x1 = points(120)
    right = x1[:, 0] > 0.5
    x2 = torch.where(right[:, None], x1 @ similarity(1.0, 0.3).mT, x1 + torch.tensor([0.2, -0.1], dtype=F64))
    found = conformity(x1, x2, torch.stack([~right, right]), SCALE)
    assert found.shape == (2, 120)
    assert float(found[0, ~right].min()) > 0.7 and float(found[1, right].min()) > 0.7
    assert float(found[0, right].mean()) < 0.4
    # all matches as one body: the coherence of one pass
    whole = conformity(x1, x2, torch.ones(1, 120, dtype=torch.bool), SCALE)[0]
    assert float((whole - coherence(x1, x2, SCALE)[0]).abs().max()) < 0.1
    assert bool((conformity(x1, x2, torch.zeros(1, 120, dtype=torch.bool), SCALE) == 0).all())


PIXEL = 1 / 200
NONE = no_links(0, torch.device("cpu"))


def scene_view(seed: int = 0, **options) -> tuple[View, torch.Tensor, torch.Tensor]:
    """Two bodies around 0 at unit size, their matrices and labels from 0."""
    scene = scenes.bodies(60, 2, generator=draw(seed), **options)
    view, F = true_view(scene, PIXEL)
    return view, F, scene.labels - 1


def plane_and_points(count: int = 40):
    """F and H of a plane, points x1, and x2(x1, rho) = H x1 + rho e, for points off the plane."""
    epipole = torch.tensor([0.9, -0.3, 0.2], dtype=F64)
    H = torch.eye(3, dtype=F64) + 0.1 * torch.randn(3, 3, generator=draw(3), dtype=F64)
    x1 = 2 * torch.rand(count, 2, generator=draw(4), dtype=F64) - 1

    def second(rho):
        moved = homogeneous(x1) @ H.mT + torch.as_tensor(rho, dtype=F64)[..., None] * epipole
        return moved[..., :2] / moved[..., 2:]

    return unit(skew(epipole) @ H), H, x1, second


def test_energy_is_the_sum_over_matches_and_pairs_and_empty_bodies_cost_nothing():
    view, F, labels = scene_view(sigma=1.0)
    labels = torch.stack([labels, labels.roll(3)])
    fundamentals, member = F.expand(2, 2, 3, 3), one_hot(labels, 2)
    found = energy(view, fundamentals, member)
    relief, scale = parallax(view, fundamentals, member)
    full = dense(view.links)
    square = sampson_squared(F, view.x1, view.x2) / (SAMPSON_NOISE_PIXELS * PIXEL) ** 2
    nu = PARALLAX_FREEDOM
    for b, row in enumerate(labels.tolist()):
        expected = 0.0
        for i, k in enumerate(row):
            expected += min(float(square[k, i]), ENERGY_MAX_SQUARED_DISTANCE)
            expected += sum(CUT_COST * float(full[i, j]) for j in range(i) if row[j] != k)
            p, t = float(relief[b, k, i]), float(scale[b, k])
            expected += PARALLAX_WEIGHT * ((nu + 1) * math.log(1 + p * p / (nu * t)) + math.log(t))
        assert float(found[b]) == pytest.approx(expected, rel=1e-9)
    assert found[0] < found[1]
    none = torch.zeros(2, 1, 3, 3, dtype=F64)
    torch.testing.assert_close(energy(view, torch.cat([fundamentals, none], 1), one_hot(labels, 3)), found)


def test_parallax_is_the_way_along_the_epipolar_line_in_pixels():
    F, H, x1, second = plane_and_points()
    value, scale = parallax(View(x1, second(torch.zeros(40)), PIXEL, NONE), F[None, None], torch.ones(1, 1, 40, dtype=F64))
    assert float(value.abs().max()) < 1e-5  # none of points of the plane
    torch.testing.assert_close(scale, torch.full((1, 1), MIN_PARALLAX_PIXELS**2, dtype=F64))
    step = torch.zeros(40, dtype=F64)
    step[:12] = 1e-4 * torch.linspace(-1, 1, 12, dtype=F64)
    member, view = (step == 0).to(F64)[None, None], View(x1, second(step), PIXEL, NONE)  # the plane is that of the others
    value, _ = parallax(view, F[None, None], member)
    way = (second(step) - apply(H, x1)).norm(dim=-1) / PIXEL
    torch.testing.assert_close(value[0, 0, :12].abs(), way[:12], rtol=1e-3, atol=1e-7)
    # to both sides of the plane
    assert bool((value[0, 0, :6] * value[0, 0, 6:12].flip(0) < 0).all())
    for factor in (-1.0, 7.0, 1e-3):
        torch.testing.assert_close(parallax(view, factor * F[None, None], member)[0].abs(), value.abs(), rtol=1e-6, atol=1e-6)
    F, _, x1, second = plane_and_points()
    step = torch.zeros(40, dtype=F64)
    step[:6] = 0.3
    value, scale = parallax(View(x1, second(step), PIXEL, NONE), F[None, None], torch.ones(1, 1, 40, dtype=F64))
    assert float(value[0, 0, 6:].abs().max()) < 1.0 and float(value[0, 0, :6].abs().min()) > 20
    assert float(scale) < 8 * MIN_PARALLAX_PIXELS**2
    F, _, x1, second = plane_and_points(400)
    normal = torch.randn(3, 400, generator=draw(5), dtype=F64)
    student = normal[0] / ((normal[1] ** 2 + normal[2] ** 2) / 2).sqrt()
    slope = (second(torch.full((400,), 1e-5)) - second(torch.zeros(400))).norm(dim=-1) / 1e-5
    _, scale = parallax(View(x1, second(student * 6 * PIXEL / slope), PIXEL, NONE), F[None, None], torch.ones(1, 1, 400, dtype=F64))
    assert 5 < math.sqrt(float(scale)) < 7.2


def test_batches_are_loops_and_subsets_are_views_of_their_own():
    view, F, labels = scene_view(1, sigma=0.5)
    turned = torch.stack([F, F.flip(0), F])
    member = one_hot(torch.stack([labels, labels, labels.roll(7)]), 2)
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
        assert bool(energy(view, matrices, one_hot(labels, 2)[None]).isfinite().all())
    # zoom: the epipole is a point of the image
    F, zoom = skew(torch.tensor([0.0, 0.0, 1.0], dtype=F64)), view.x1.clone()
    zoom[0] = 0.0
    value, _ = parallax(View(zoom, 1.2 * zoom, PIXEL, view.links), F[None, None], torch.ones(1, 1, 60, dtype=F64))
    assert bool(value.isfinite().all())

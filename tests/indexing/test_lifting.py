"""Lifting: what it finds of new actors' depth, what it must not depend on, and closed forms against brute force."""

import numpy as np
import pytest
import torch
from sklearn.kernel_ridge import KernelRidge

from indexing.actors.layouts import LAYOUTS, layout_map
from indexing.actors.random_poses import random_views
from indexing.cameras import rotation, virtual
from indexing.clip import Clip
from indexing.shape.bank import EPSILON, Windows, fused_residual
from indexing.shape.channels import CHANNELS, JointMetric
from indexing.shape.lifting import RIDGE, SLACK, WIDTH, Lifter, layout_of, lift_views, solid, standardized
from indexing.shape.views import mirror, turn
from indexing.skeleton import COCO17, Skeleton

LENGTH = 6


def turned_distance(a, b):
    """``(Q, E)`` of bodies ``(N, joints, 2 | 3)`` that stand still, by the residual's term for turned bodies."""
    joints = a.shape[1]
    plain = JointMetric(torch.eye(joints).double().expand(len(CHANNELS), joints, joints), 0.0)
    query, bank = (Windows(x[:, None], torch.ones(len(x), joints, dtype=torch.bool)) for x in (a, b))
    return fused_residual(query, [bank], plain, ("clip",), terms=("turned",)).exp() - EPSILON


@pytest.fixture(scope="module")
def lifter():
    return Lifter.fit(COCO17.joints, LENGTH, actors=600)


@pytest.fixture(scope="module")
def views():
    return random_views(200, LENGTH, layout_map(COCO17.joints), 99)


@pytest.fixture(scope="module")
def windows(views):
    return torch.from_numpy(views.image).float()


def explained(truth, found):
    pose, mine = (z - z.mean(dim=2, keepdim=True) for z in (truth, found))
    return float(1 - (pose - mine).square().sum() / pose.square().sum())


def test_it_finds_a_third_of_the_depth_of_new_actors(lifter, views, windows):
    truth = torch.from_numpy(views.depth).float()
    averaged, plain = (explained(truth, lifter.depth(windows, average=average)) for average in (True, False))
    assert averaged > 0.35
    assert averaged > plain > 0.3


def test_it_is_the_kernel_ridge_of_scikit_learn(lifter, windows):
    views = random_views(600, LENGTH, layout_map(COCO17.joints), 0)
    x, scale = standardized(torch.from_numpy(views.image))
    rows = x.flatten(1).numpy()
    ridge = KernelRidge(alpha=RIDGE, kernel="rbf", gamma=WIDTH / rows.shape[1])
    ridge.fit(rows, (torch.from_numpy(views.depth) / scale[..., 0]).flatten(1).numpy())
    query, size = standardized(windows[:5].double())
    expected = ridge.predict(query.flatten(1).numpy()).reshape(5, LENGTH, 17) * size[..., 0].numpy()
    expected -= expected.mean(axis=(1, 2), keepdims=True)
    assert np.abs(lifter.depth(windows[:5], average=False).numpy() - expected).max() < 1e-3


def test_mirror_image_reversed_time_place_and_size_change_what_they_should(lifter, windows):
    depth, swap = lifter.depth(windows), lifter.symmetry
    assert torch.allclose(lifter.depth(mirror(windows, swap)), depth[:, :, swap], atol=1e-4)
    assert torch.allclose(lifter.depth(windows.flip(1)), depth.flip(1), atol=1e-4)
    assert torch.allclose(lifter.depth(200 * windows + 7), 200 * depth, atol=5e-2)
    assert torch.allclose(lifter.depth(windows[3:4]), depth[3:4], atol=1e-4)
    assert lifter.depth(windows[:0]).shape == (0, LENGTH, 17)


def test_a_photograph_is_the_mirror_image_and_the_wrong_way_round_is_the_other_side(lifter, views, windows):
    photographed = Lifter(lifter.images, lifter.coefficients, lifter.symmetry, photograph=True)
    flipped = windows * torch.tensor([-1.0, 1.0])
    assert torch.allclose(photographed.depth(flipped), lifter.depth(windows))
    truth = torch.from_numpy(views.depth).float()
    wrong = photographed.depth(windows)
    assert explained(truth, wrong) < 0 < explained(truth, -wrong)


def test_joints_not_seen_are_placed_and_their_values_do_not_matter(lifter, views, windows):
    seen = torch.ones(200, 17, dtype=torch.bool)
    seen[:100, 9] = False  # a wrist
    seen[100:150, 13:] = False  # all below the hips
    hidden = torch.where(seen[:, None, :, None], windows, 0.0)
    placed = lifter.completed(Windows(hidden, seen))
    assert torch.equal(placed[150:], windows[150:])
    assert torch.equal(placed[seen[:, None].expand(-1, LENGTH, -1)], windows[seen[:, None].expand(-1, LENGTH, -1)])
    error = (placed - windows)[:100, :, 9].square().sum()
    assert error < 0.6 * (windows[:100, :, 7] - windows[:100, :, 9]).square().sum()  # better than at the elbow
    depth = lifter.depth(hidden, seen)
    assert torch.allclose(depth, lifter.depth(torch.where(seen[:, None, :, None], windows, 5.0), seen), atol=1e-4)
    assert explained(torch.from_numpy(views.depth).float(), depth) > 0.3
    assert lifter.depth(0 * windows[:2], torch.zeros(2, 17, dtype=torch.bool)).isfinite().all()


def test_joints_not_seen_are_where_a_linear_fit_to_the_actors_puts_them(lifter, windows):
    seen = torch.ones(17, dtype=torch.bool)
    seen[[0, 8, 15]] = False
    actors = lifter.images.double()
    actors = actors - actors[:, :, seen].mean(dim=(1, 2), keepdim=True)
    known, wanted = (actors[:, :, part].flatten(2).flatten(0, 1) for part in (seen, ~seen))
    slack = (SLACK * known.square().sum(dim=0).mean()).sqrt() * torch.eye(28)
    fit = torch.linalg.lstsq(torch.cat([known, slack]), torch.cat([wanted, torch.zeros(28, 6)])).solution
    middle = windows[:2, :, seen].mean(dim=(1, 2), keepdim=True)
    expected = ((windows[:2, :, seen] - middle).flatten(2).double() @ fit).unflatten(2, (3, 2)) + middle
    placed = lifter.completed(Windows(windows[:2], seen.expand(2, 17)))
    assert torch.allclose(placed[:, :, ~seen].double(), expected, atol=1e-4)


def test_views_of_the_lifted_body_are_those_of_a_far_camera():
    rng = np.random.default_rng(0)
    body = rng.normal(size=(LENGTH, 17, 3))
    clip = Clip(body)
    scale = np.median(np.ptp(body[..., 1], axis=1)) / 1.5
    angles = np.array([0.3, 2.0, -1.0]), np.array([0.1, -0.2, 0.0])
    cards = torch.from_numpy(body[None, ..., :2]).repeat(3, 1, 1, 1)
    found = lift_views(cards, torch.from_numpy(body[None, ..., 2]).repeat(3, 1, 1), *angles)
    for azimuth, pitch, mine in zip(*angles, found.numpy(), strict=True):
        seen = virtual(clip, float(np.rad2deg(azimuth)), float(pitch), distance=1e7).joints * scale
        assert np.abs(seen - mine).max() < 1e-4
    assert torch.allclose(lift_views(cards, torch.zeros(3, LENGTH, 17), *angles), turn(cards, *angles))


def test_the_best_turn_is_found_in_closed_form():
    rng = torch.Generator().manual_seed(0)
    a, b = (torch.randn(count, 30, 3, generator=rng).double() for count in (4, 5))
    a, b = (x - x.mean(dim=1, keepdim=True) for x in (a, b))
    unit = [x / x.square().sum(dim=(1, 2), keepdim=True).sqrt() for x in (a, b)]
    turns = torch.from_numpy(np.stack([rotation(angle, 0.0) for angle in np.linspace(0, 2 * np.pi, 721)]))
    alike = torch.einsum("qpi,kij,epj->qek", unit[0], turns, unit[1])
    assert torch.allclose(turned_distance(a, b), 1 - alike.amax(dim=2), atol=1e-4)
    assert torch.allclose(turned_distance(a @ turns[100].mT, b @ turns[555].mT), turned_distance(a, b))
    flat = [torch.cat([x[..., :2], 0 * x[..., :1]], dim=2) for x in (a, b)]
    assert torch.allclose(turned_distance(*flat), turned_distance(a[..., :2], b[..., :2]))
    assert turned_distance(a[..., :2], a[..., :2] * torch.tensor([-3.0, 3.0])).diagonal().max() < 1e-12


def test_lifted_bodies_of_one_actor_are_more_alike_than_of_others(lifter, windows):
    quarter = lift_views(windows, lifter.depth(windows), np.full(200, 1.0), np.zeros(200))
    first, second = (
        solid(Windows(x, torch.ones(200, 17, dtype=torch.bool)), lifter).values.flatten(1, 2) for x in (windows, quarter)
    )
    nearest = turned_distance(first, second).argmin(dim=1)
    assert (nearest == torch.arange(200)).float().mean() > 0.9


def test_layout_from_names_from_numbers_and_from_nothing(windows):
    assert layout_of(COCO17, windows) == LAYOUTS["COCO-17"]
    assert layout_of(None, windows) == LAYOUTS["COCO-17"]
    assert layout_of(Skeleton("numbers", tuple(str(i) for i in range(17))), windows) == LAYOUTS["COCO-17"]
    assert layout_of(None, windows[:, :, :12]) is None
    few = Skeleton("some", COCO17.joints[5:])
    assert layout_of(few, windows[:, :, 5:]) == COCO17.joints[5:]
    for name in ("Kinect-20", "MSRAction3D-20", "NITE-15", "BODY_25"):
        image = torch.from_numpy(random_views(60, LENGTH, layout_map(LAYOUTS[name]), 1).image)
        assert layout_of(None, image) == LAYOUTS[name]


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda lifter: Lifter.fit(("left_hip", "right_hip", "tail")), r"joints: no body has joints called tail; use names"),
        (lambda lifter: Lifter.fit(("neck", "nose")), r"none of neck, nose... has a left and a right"),
        (lambda lifter: lifter.depth(torch.zeros(2, 12, 17, 2)), r"windows: \(12, 17, 2\) per window, .* fitted for \(6, 17, 2\)"),
    ],
)
def test_misuse_says_what_to_do(lifter, call, message):
    with pytest.raises(ValueError, match=message):
        call(lifter)

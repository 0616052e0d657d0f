"""Exact matches of several bodies: labels, fundamental matrices, ranks, coordinates, degenerate data, misuse; and the noise."""

from itertools import permutations

import pytest
import torch

from dyntorch.core.primitives import Monomials
from dyntorch.geometry.homogeneous import homogeneous, unit
from dyntorch.geometry.pairs import product_matrix
from dyntorch.invariants.multibody import multibody_lines, multibody_matrix
from dyntorch.metrics import relative_error
from dyntorch.scenes import two_view
from tests.draws import random, seeded
from tests.grid import assert_refused


def scene(*batch, counts, sigma=0.0, seed=0):
    """Matches of bodies with their own motions, true labels from 1, true fundamental matrices."""
    made = [two_view(n, batch=batch, sigma=sigma, generator=seeded(seed + 17 * k)) for k, n in enumerate(counts)]
    x1, x2 = (torch.cat([s.views[v] for s in made], dim=-2) for v in range(2))
    labels = torch.repeat_interleave(torch.arange(1, 1 + len(counts)), torch.tensor(counts)).expand(*batch, -1)
    return x1, x2, labels, torch.stack([s.motion[0] for s in made], dim=-3)


def right(found, true, bodies):
    """Share of right labels under the best naming of the bodies."""
    names = torch.tensor([[0, *p] for p in permutations(range(1, bodies + 1))])
    return (names[:, true] == found).double().mean(-1).amax(0)


@pytest.mark.parametrize("counts", [(8,), (20, 15), (27, 8), (40, 25), (33, 33, 33), (50, 60, 40), (60, 55, 57, 60)])
def test_exact_bodies_at_minimal_counts_too(counts):
    bodies = len(counts)
    x1, x2, labels, F = scene(3 if bodies == 4 else 20, counts=counts)
    found = multibody_matrix(x1, x2, bodies)
    assert right(found.labels, labels, bodies).min() == 1
    assert not found.degenerate.any()
    assert (torch.stack([(found.labels == 1 + k).sum(-1) for k in range(bodies)], -1).diff(dim=-1) <= 0).all()
    assert relative_error(found.matrix, unit(product_matrix(*F.unbind(-3)))).max() < 1e-3 ** (4 - min(bodies, 3))
    own = found.fundamentals.take_along_dim((found.labels - 1)[..., None, None], dim=1)
    true = F.take_along_dim((labels - 1)[..., None, None], dim=1)
    assert relative_error(own, true).max() < 1e-6


def test_lines_are_those_of_the_own_body():
    x1, x2, labels, F = scene(counts=(40, 40))
    p1, p2 = homogeneous(x1), homogeneous(x2)
    own = F[labels - 1]
    for line, truth in zip(
        multibody_lines(multibody_matrix(x1, x2, 2).matrix, p1, p2, 2),
        ((own.mT @ p2[..., None])[..., 0], (own @ p1[..., None])[..., 0]),
        strict=True,
    ):
        assert relative_error(line[:, None], truth[:, None]).median() < 1e-8


def test_a_single_body_or_a_planar_one_is_degenerate_and_alone():
    x1, x2, labels, _ = scene(3, counts=(40, 40))
    plane = x1[1] @ random(2, 2, seed=3) + 5  # an affinity
    x1[0], x2[0] = two_view(80, generator=seeded()).views
    x2[1] = torch.where((labels[1] == 2)[:, None], plane, x2[1])
    found = multibody_matrix(x1, x2, 2)
    assert found.degenerate.tolist() == [True, True, False]
    assert found.fundamentals.isfinite().all()


def test_coordinates_change_nothing():
    x1, x2, _, _ = scene(4, counts=(30, 30))
    turn = torch.tensor([[0.0, -2.0], [2.0, 0.0]]).double()
    first, second = multibody_matrix(x1, x2, 2), multibody_matrix(x1 @ turn + 700, x2 / 50 - 3, 2)
    assert right(first.labels[0], second.labels[0], 2) == 1
    T1, T2 = torch.eye(3).double(), torch.eye(3).double()
    T1[:2, :2], T1[:2, 2], T2[:2, :2], T2[:2, 2] = turn.mT, 700, torch.eye(2) / 50, -3
    moved = Monomials(2).action(T2).mT @ second.matrix @ Monomials(2).action(T1)
    assert relative_error(moved, first.matrix).max() < 1e-7


def test_missing_matches_weigh_nothing_and_batch_equals_loop():
    x1, x2, labels, _ = scene(2, 2, counts=(25, 25))
    x1[1, 1, 4] = torch.nan
    x1[0, 0] = torch.nan
    weights = torch.ones(2, 2, 50).double()
    x2[1, 0, 30], weights[1, 0, 30] = 1e3, 0
    found = multibody_matrix(x1, x2, 2, weights)
    assert found.degenerate.tolist() == [[True, False], [False, False]]
    assert found.labels[1, 1, 4] == found.labels[1, 0, 30] == 0
    assert repr(found).startswith("Multibody(matches=50, bodies=2, batch=(2, 2)")
    for i, j in ((0, 1), (1, 0), (1, 1)):
        one = multibody_matrix(x1[i, j], x2[i, j], 2, weights[i, j])
        assert torch.equal(one.labels, found.labels[i, j])
        torch.testing.assert_close(one.fundamentals, found.fundamentals[i, j], rtol=1e-6, atol=1e-8)
        valid = one.labels > 0
        assert right(one.labels[valid], labels[i, j][valid], 2) == 1
    assert found.matrix.isfinite().all()


def test_matrix_carries_gradients():
    x1, x2, _, _ = scene(counts=(24, 24))
    x1 = x1.requires_grad_()
    direction = random(*x1.shape, seed=5)
    probe = random(6, 6, seed=6)

    def value(x):
        return (multibody_matrix((x - 300) / 300, (x2 - 300) / 300, 2).matrix * probe).sum()

    (gradient,) = torch.autograd.grad(value(x1), x1)
    with torch.no_grad():
        numeric = (value(x1 + 1e-5 * direction) - value(x1 - 1e-5 * direction)) / 2e-5
    torch.testing.assert_close((gradient * direction).sum(), numeric, rtol=1e-3, atol=1e-8)


def test_misuse():
    x1, x2, _, _ = scene(counts=(20, 14))
    for bodies, said in ((0, "0"), ("3", "'3'"), (2.0, "2.0"), (True, "True")):
        words = f"bodies must be a whole number, 1 or more, got {said}"
        assert_refused((lambda bodies=bodies: multibody_matrix(x1, x2, bodies), words))
    assert_refused(
        (lambda: multibody_matrix(x1, x2, 2), "2 bodies takes 35 matches, got 34: add 1"),
        (lambda: multibody_matrix(x1.numpy(), x2.numpy(), 1), r"got ndarray; use torch.as_tensor"),
        (lambda: multibody_matrix(x1, x2[1:], 1), "of one shape"),
        (lambda: multibody_matrix(x1, x2, 1, -torch.ones(34)), "not negative"),
    )

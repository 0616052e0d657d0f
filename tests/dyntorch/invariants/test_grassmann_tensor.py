"""Grassmann tensors as an invariant: counts by ranks, the classical tensors that they contain, lines on which points move."""

import pytest
import torch

import dyntorch as dyn
from dyntorch import scenes
from dyntorch.geometry.homogeneous import apply, homogeneous, inhomogeneous
from dyntorch.numerics.least_squares import jacobian
from tests.battery.projections import tensor_error
from tests.battery.references import rank, subdeterminants
from tests.draws import random, seeded
from tests.grid import assert_refused

TRIFOCAL = dyn.GrassmannTensor(3, (2, 1, 1))
# k, profile, dimensions of the views
FAMILIES = [
    (2, (1, 1, 1), 1),
    (2, (2, 1), 2),
    (3, (2, 2), 2),
    (3, (1, 1, 1, 1), 1),
    (3, (2, 1, 1), 2),
    (3, (1, 1, 1, 1), 2),
    (4, (2, 2, 1), 2),
    (4, (1, 2, 2), (1, 2, 3)),
    (4, (2, 1, 1, 1), 2),
    (4, (3, 1, 1), (3, 1, 2)),
    (5, (2, 2, 2), 2),
    (5, (2, 2, 1, 1), 2),
    (6, (2, 2, 2, 1), 2),
    (6, (3, 3, 1), 3),
    (6, (3, 3, 1), (3, 3, 2)),
]


def projections(invariant, *batch, seed=0, last=0.2):
    """Random projections of norm 1 that see random points at finite places."""
    found = []
    for i, m in enumerate(invariant.sizes):
        matrix = random(*batch, m, invariant.k + 1, seed=100 * seed + i)
        matrix[..., -1, :] *= last
        matrix[..., -1, -1] = 1.0
        found.append(matrix / matrix.norm(dim=(-2, -1), keepdim=True))
    return tuple(found)


def images(motion, n=0, seed=50, structure=None):
    """What the projections see of points near the origin."""
    world = homogeneous(random(*motion[0].shape[:-2], n, motion[0].shape[-1] - 1, seed=seed)) if structure is None else structure
    return tuple(inhomogeneous(world @ m.mT) for m in motion)


def rows(profile, match):
    """Products of the minors of the hyperplanes through the images, one match."""
    total = torch.ones(1, 1, dtype=torch.float64)
    for order, x in zip(profile, match, strict=True):
        planes = torch.cat([torch.eye(len(x), dtype=torch.float64), -x[:, None]], dim=1)
        total = torch.stack([torch.kron(a, b) for a in total for b in subdeterminants(planes, order)])
    return total


def sight(order):
    """The map from homogeneous points of P^order to the meets of all of their hyperplanes, by interpolation."""
    points = random(order + 3, order, seed=11)
    meets = torch.stack([rows((order,), (x,))[0] for x in points])
    found = torch.linalg.lstsq(homogeneous(points), meets).solution.T
    torch.testing.assert_close(homogeneous(points) @ found.T, meets)
    return found


@pytest.mark.parametrize(("k", "profile", "dims"), FAMILIES)
def test_minimal_counts_are_those_of_ranks(k, profile, dims):
    invariant = dyn.GrassmannTensor(k, profile, dims)
    views = images(projections(invariant), invariant.minimal() + 1)
    matches = [rows(profile, [x[i] for x in views]) for i in range(invariant.minimal() + 1)]
    assert matches[0].shape == (invariant.rows(), invariant.width())
    ranks = [rank(torch.cat(matches[:n])) for n in (1, invariant.minimal() - 1, invariant.minimal(), invariant.minimal() + 1)]
    full = invariant.width() - 1
    assert ranks[0] == invariant.rows() and ranks[1] < full and ranks[2:] == [full, full]


@pytest.mark.parametrize(("k", "profile", "dims"), FAMILIES)
def test_degrees_of_freedom_and_conditions_are_ranks(k, profile, dims):
    invariant = dyn.GrassmannTensor(k, profile, dims)
    motion = projections(invariant, 1)
    value, slope = invariant.compose_derivative(motion)
    assert rank(slope[0]) == invariant.dof
    # and the derivative is the one of compose
    sizes = [m.numel() for m in motion]

    def tensor(theta):
        parts = (part.reshape(*theta.shape[:-1], *m.shape[1:]) for part, m in zip(theta.split(sizes, -1), motion, strict=True))
        return invariant.compose(*parts).flatten(theta.ndim - 1)

    expected = jacobian(tensor, torch.cat([m.flatten(1) for m in motion], dim=-1))
    torch.testing.assert_close((value, slope), tuple(expected), rtol=1e-8, atol=1e-9)
    assert slope.shape == (1, sum(sizes), invariant.width())
    # what remains of all coordinates when one of k dimensions is seen
    point = homogeneous(random(k, seed=3))
    seen = torch.func.jacrev(lambda y: torch.cat([inhomogeneous(m[0] @ y) for m in motion]))(point)
    assert seen.shape[0] - rank(seen) == invariant.codim


@pytest.mark.parametrize(("k", "profile", "dims"), FAMILIES)
def test_exact_matches_give_the_projections(k, profile, dims):
    invariant = dyn.GrassmannTensor(k, profile, dims)
    true = projections(invariant, 2)
    solution = dyn.fit(invariant, *images(true, invariant.minimal() + 6)).check()
    assert [m.shape for m in solution.motion] == [m.shape for m in true]
    assert tensor_error(profile, solution.motion, true).max() < 1e-7
    if dims == 1:
        return  # views that are all lines: two motions have the tensor
    # one collineation H of the space takes all of them to the true ones, up to scale: M_i H = s_i N_i, linear in H and s_i
    for b in range(2):
        sides = [torch.kron(m[b], torch.eye(k + 1, dtype=torch.float64)) for m in solution.motion]
        others = torch.block_diag(*(m[b].flatten()[:, None] for m in true))
        s = torch.linalg.svdvals(torch.cat([torch.cat(sides), -others], dim=1))
        assert s[-1] < 1e-7 * s[0] and s[-2] > 1e-4 * s[0]


# ------------------------------------------------------------------ classical tensors


def test_two_views_of_space_are_the_fundamental_matrix():
    scene = scenes.two_view(n=40, sigma=0.5, batch=(3,), generator=seeded())
    S = sight(2)
    invariant = dyn.GrassmannTensor(3, (2, 2))
    for views, tolerance in ((scene.exact, 1e-9), (scene.views, 1e-5)):
        # least distances, which are the same; without noise the linear solutions are, too
        both = [dyn.fit(i, *views) for i in (invariant, dyn.FundamentalMatrix)]
        if tolerance > 1e-8:
            both = [dyn.refine(s, *views, iterations=100) for s in both]
            torch.testing.assert_close(both[0].sigma, both[1].sigma, rtol=1e-6, atol=0)
        # S x_1 and S x_2 in the slots of the first
        F = S.T @ both[0].tensor.mT @ S
        F = F / F.norm(dim=(-2, -1), keepdim=True)
        off = torch.minimum(*((F - s * both[1].tensor).norm(dim=(-2, -1)) for s in (1, -1)))
        assert off.max() < tolerance


def test_static_trifocal_tensor_is_the_classical_one():
    r"""T_i = a_i b_4^T - a_4 b_i^T, for cameras [I | 0], [A | a_4], [B | b_4]: a point in the first slot, lines in the others."""
    cameras = projections(TRIFOCAL)
    first = torch.cat([cameras[0], torch.linalg.svd(cameras[0]).Vh[3:]])
    a, b = (m @ torch.linalg.inv(first) for m in cameras[1:])
    classical = torch.stack([torch.outer(a[:, i], b[:, 3]) - torch.outer(a[:, 3], b[:, i]) for i in range(3)])
    tensors = TRIFOCAL.compose(*cameras), dyn.fit(TRIFOCAL, *images(cameras, 12)).check().tensor
    for tensor in tensors:
        found = torch.einsum("ajk,ai->ijk", tensor, sight(2))
        found = found / found.norm() * classical.norm()
        assert min((found - classical).norm(), (found + classical).norm()) < 1e-9 * classical.norm()


def test_sensors_of_space_have_the_constant_velocity_tensor():
    scene = scenes.constant_velocity(60, sigma=0.01, batch=(2,), generator=seeded(1))
    S = sight(3)
    for views in (scene.exact, scene.views):
        mine = dyn.fit(dyn.GrassmannTensor(6, (3, 3, 1), 3), *views)
        other = dyn.fit(dyn.ConstantVelocityTensor, *views)
        found = torch.einsum("...abk,ai,bj->...ijk", mine.tensor, S, S).flatten(-3)
        found = found / found.norm(dim=-1, keepdim=True)
        # the same rows in the same normalization: equal with noise, too
        assert (1 - (found * other.tensor.flatten(-3)).sum(-1).abs()).max() < 1e-10
        assert torch.equal(mine.status, other.status)


# ------------------------------------------------------------------ lines on which points move


def test_dual_views_of_lines():
    """A point that moves on a line of space is in every view on the image of the line: one hyperplane of P^5 each."""
    invariant = dyn.GrassmannTensor(5, (1,) * 6, dual=True)
    assert (invariant.minimal(), invariant.width(), invariant.rows(), invariant.codim, invariant.dof) == (728, 729, 1, 1, 67)
    small = dyn.GrassmannTensor(3, (1,) * 4, dual=True)
    assert (small.minimal(), small.codim) == (80, 1)
    true = projections(small, 2)
    n = 200
    lines = random(2, n, 4, seed=3)
    # a point of every image line, at a place of its own, in coordinates far from normal
    views, frames = [], []
    for i, m in enumerate(true):
        image = lines @ m.mT
        x, y = random(2, n, 1, seed=20 + i), None
        y = -(image[..., :1] * x + image[..., 2:]) / image[..., 1:2]
        far = y.abs() > 3
        x = torch.where(far, -(image[..., 1:2] * x + image[..., 2:]) / image[..., :1], x)
        y = torch.where(far, -(image[..., :1] * x + image[..., 2:]) / image[..., 1:2], y)
        frame = torch.tensor([[300.0, 20.0, 500.0], [-30.0, 280.0, 400.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
        views.append(apply(frame, torch.cat([x, y], dim=-1)))
        frames.append(torch.linalg.inv(frame).mT)
    near = torch.stack([v.abs().amax(-1) for v in views]).amax(0) < 1e4
    solution = dyn.fit(small, *views, weights=near.double()).check()
    moved = tuple(f @ m for f, m in zip(frames, true, strict=True))
    assert tensor_error(small.profile, solution.motion, moved).max() < 1e-6
    assert dyn.sampson(small, solution.tensor, *views)[near].max() < 1e-4
    refined = dyn.refine(solution, *views, weights=near.double())
    assert tensor_error(small.profile, refined.motion, moved).max() < 1e-6


def test_decompose_of_what_is_no_tensor():
    tensor = random(4, 3, 3, 3)
    tensor[1], tensor[2, 0] = 0.0, torch.nan
    alone = TRIFOCAL.decompose(tensor[[0, 3]])
    motion = TRIFOCAL.decompose(tensor)
    for part, one in zip(motion, alone, strict=True):
        assert part.isfinite().all() and part[1:3].abs().max() == 0
        torch.testing.assert_close(part[[0, 3]], one)
    blind = tuple(m * (torch.arange(4) > 0) for m in projections(TRIFOCAL, 1))
    assert TRIFOCAL.compose(*blind).abs().max() < 1e-15 and TRIFOCAL.compose(*blind).isfinite().all()
    starts = TRIFOCAL.starts(tensor)
    assert all(s.shape[1:] == (4, 3, 4) and s.isfinite().all() for s in starts)


def test_it_is_a_value_with_parameters_that_fit():
    G = dyn.GrassmannTensor
    assert G(3, [2, 2]) == G(3, (2, 2)) != TRIFOCAL and hash(G(3, [2, 2])) == hash(G(3, (2, 2)))
    assert repr(G(6, (3, 3, 1), 3)) == "GrassmannTensor(6, (3, 3, 1), l=3)"
    assert repr(G(3, (1,) * 4, dual=True)) == "GrassmannTensor(3, (1, 1, 1, 1), dual=True)"
    views = images(projections(TRIFOCAL), 9)
    assert_refused(
        (lambda: dyn.fit(G, *views), "is a family: give its parameters"),
        (lambda: G(4, (2, 2)), r"sum k \+ 1 = 5, got \(2, 2\)"),
        (lambda: G(2, (3,)), r"two entries or more"),
        (lambda: G(3, (3, 1)), r"1 to the dimension of their view \(2, 2\), got \(3, 1\)"),
        (lambda: G(3, (4, 0), 4), r"got \(4, 0\)"),
        (lambda: G(3, (2, 2), (2, 2, 2)), r"one dimension or one per view, 2, got \(2, 2, 2\)"),
        (lambda: G(3, (2, 2), 2, True), r"one hyperplane each, got the profile \(2, 2\); use all ones"),
    )

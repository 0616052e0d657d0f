"""Shape tensors of any projections P^k -> P^l beyond the properties of all: counts, what they equal."""

from itertools import combinations

import pytest
import torch

import dyntorch as dyn
from dyntorch.counting import count
from dyntorch.shapes import lifted
from tests.battery.shape_cases import SHAPE_CASES
from tests.draws import seeded
from tests.grid import assert_refused


def views(k, d, n, count, seed=0):
    """Images ``(views, n, d)`` of random points of P^k, and the points."""
    g = seeded(seed)
    points = torch.randn(n, k + 1, generator=g, dtype=torch.float64)
    seen = points @ torch.randn(count, k + 1, d + 1, generator=g, dtype=torch.float64)
    return seen[..., :d] / seen[..., d:], points


@pytest.mark.parametrize(
    ("k", "d", "n"), [(2, 1, 6), (3, 1, 8), (3, 2, 6), (3, 2, 7), (3, 2, 8), (4, 2, 8), (4, 2, 9), (4, 3, 8), (5, 2, 9), (5, 3, 9)]
)
def test_counts_are_exact(k, d, n):
    invariant = dyn.LiftedShapeTensor(k, d, points=n)
    counted = count("lifted_shape", space=k, image=d, points=n, synthetic=True, images=invariant.minimal())
    assert (counted.nullity, counted.minimal, counted.width) == (1, invariant.minimal(), *invariant.shape())
    synthetic = count("lifted_shape", space=k, image=d, points=n, synthetic=True, images=0).rank
    assert synthetic == invariant.shape()[0] - invariant.width()


@pytest.mark.parametrize(("space", "points", "profile", "minimal"), [(6, 11, (2, 2, 2, 1), 105), (5, 10, (2, 2, 1, 1), 25)])
def test_moving_points_as_static_ones_of_a_higher_space(space, points, profile, minimal):
    invariant = dyn.LiftedShapeTensor(space, points=points)
    assert (invariant.profile, invariant.minimal()) == (profile, minimal)
    x, truth = views(space, 2, points, minimal + 5)
    solution = dyn.fit(invariant, *x[:minimal].unbind(1)).check()
    assert dyn.sampson(invariant, solution.tensor, *x[minimal:].unbind(1)).max() < 1e-6
    # the points up to a collineation: that of k + 2 of them takes all others along
    found = solution.motion[0]
    frames = [torch.linalg.solve(p[: space + 1].T, p[space + 1]) for p in (found, truth)]
    both = [torch.linalg.solve((f[:, None] * p[: space + 1]).T, p.T).T for f, p in zip(frames, (found, truth), strict=True)]
    both = [b / b.norm(dim=-1, keepdim=True) for b in both]
    assert (1 - (both[0] * both[1]).sum(-1).abs()).max() < 1e-9


def test_views_of_lines_of_one_dimension_have_one_solution():
    for seed in range(4):
        x, _ = views(3, 1, 8, 18, seed)
        solution = dyn.fit(dyn.LiftedShapeTensor(3, 1), *x[:13].unbind(1)).check()
        assert dyn.sampson(solution.invariant, solution.tensor, *x[13:].unbind(1)).max() < 1e-6


@pytest.mark.parametrize("n", [6, 7, 8])
def test_equals_the_shape_tensor_general(n):
    case = SHAPE_CASES[n - 6]
    points, _ = case.scene(6, batch=(2,), seed=1)
    lifted_, plain = dyn.LiftedShapeTensor(3, points=n), dyn.ShapeTensor("general", n)
    assert (lifted_.width(), lifted_.rows(), lifted_.minimal(), lifted_.dof, lifted_.codim) == (
        plain.width(), plain.rows(), plain.minimal(), plain.dof, plain.codim
    )  # fmt: skip
    found, other = dyn.fit(lifted_, *points), dyn.fit(plain, *points)
    for solution in (found, other):
        solution.check()
    # the form for the images e1, e2, e3, (1, 1, 1) of the basis is the tensor; of two lines it has minors, and their meet has signs
    basis = torch.cat([torch.eye(3), torch.ones(1, 3)]).double()
    form = lifted_.multilinear(found.tensor, basis)
    for axis, a in enumerate(lifted_.profile):
        if a == 2:
            form = form.movedim(axis + 1, -1)[..., [2, 1, 0]] * torch.tensor([1.0, -1.0, 1.0]).double()
            form = form.movedim(-1, axis + 1)
    left, right = (t.flatten(1) / t.flatten(1).norm(dim=-1, keepdim=True) for t in (form, other.tensor))
    torch.testing.assert_close((left * right).sum(-1).abs(), torch.ones(2).double(), atol=1e-9, rtol=0)
    torch.testing.assert_close(found.motion[0].abs(), other.motion[0].abs(), atol=1e-7, rtol=0)
    noisy, _ = case.scene(6, batch=(2,), seed=2, sigma=0.5)
    distance = [dyn.sampson(family, s.tensor, *noisy) for family, s in ((lifted_, found), (plain, other))]
    torch.testing.assert_close(*distance, rtol=1e-6, atol=1e-7)
    refined = [dyn.refine(dyn.fit(family, *noisy), *noisy) for family in (lifted_, plain)]
    cost = [dyn.sampson(s.invariant, s.tensor, *noisy).square().sum() for s in refined]
    assert abs(float(cost[0] / cost[1]) - 1) < 1e-3 or cost[0] < cost[1]


@pytest.mark.parametrize(("index", "frame"), [(5, "plane"), (8, "affine")])
def test_equals_the_shape_tensor_beside_a_plane_and_of_affine_views(index, frame):
    case = SHAPE_CASES[index]
    points, _ = case.scene(6, batch=(2,), seed=3)
    found, other = dyn.fit(dyn.LiftedShapeTensor(3, 2, frame), *points).check(), dyn.fit(dyn.ShapeTensor(frame), *points).check()
    if frame == "affine":
        torch.testing.assert_close(found.tensor.mT @ found.tensor, other.tensor.mT @ other.tensor)
    else:
        torch.testing.assert_close(found.motion[0].abs(), other.motion[0].abs(), atol=1e-9, rtol=0)
    noisy, _ = case.scene(6, batch=(2,), seed=4, sigma=0.5)
    distance = [dyn.sampson(s.invariant, s.tensor, *noisy) for s in (found, other)]
    torch.testing.assert_close(*distance, rtol=1e-6, atol=1e-7)


def test_rows_are_determinants_of_the_stacked_incidences():
    """det (S_j B diag X_j) by torch, for every choice of hyperplanes, is the row times the tensor, up to one factor a view."""
    x, truth = views(4, 2, 9, 3, seed=5)
    invariant = dyn.LiftedShapeTensor(4, points=9)
    frame = truth[:5]
    others = truth[5:] @ torch.linalg.inv(frame)
    tensor = lifted.compose_entries(torch.cat([torch.eye(5).double(), others]), invariant.profile)
    p = torch.nn.functional.pad(x[0] + torch.linspace(0, 1, 9).double()[:, None], (0, 1), value=1.0)  # a view of another shape
    through = torch.stack([torch.linalg.svd(q[None], full_matrices=True).Vh[1:] for q in p[5:]])
    rows = lifted.products(p[:5], through, invariant.profile)
    chosen = [list(combinations(range(2), a)) for a in invariant.profile]
    values = []
    for a in chosen[0]:
        for b in chosen[1]:
            for c in chosen[2]:
                for d in chosen[3]:
                    picks = (a, b, c, d)
                    stack = [through[j, list(pick)] @ (p[:5].T * others[j]) for j, pick in enumerate(picks)]
                    values.append(torch.linalg.det(torch.cat(stack)))
    torch.testing.assert_close(rows @ tensor, torch.stack(values))


def test_missing_points_are_left_out_of_distances_and_views_of_fits():
    x, _ = views(4, 2, 9, 9, seed=6)
    x[7, 2] = x[8, 3:] = torch.nan
    solution = dyn.fit(dyn.LiftedShapeTensor(4), *x.unbind(1)).check()
    assert solution.matches.weights[0].tolist() == [1.0] * 7 + [0.0] * 2
    distance = dyn.sampson(solution.invariant, solution.tensor, *x.unbind(1))
    assert distance[:8].max() < 1e-6 and distance[8].isinf()
    assert solution.invariant.score(solution.tensor, *x.unbind(1))[:7].max() < 1e-9


def test_misuse_is_a_value_error_with_its_remedy():
    x, truth = views(4, 2, 8, 12)
    L = dyn.LiftedShapeTensor
    unknown = r"does not know its number of points; give it, LiftedShapeTensor\(4, points=...\)"
    assert_refused(
        (lambda: dyn.fit(L, *x.unbind(1)), "is a family: give its parameters"),
        (lambda: dyn.fit(L(4), *x.unbind(1)[:7]), r"LiftedShapeTensor\(4\) needs at least 8 points, got 7"),
        (lambda: dyn.fit(L(4, 3), *x.unbind(1)), r"point 1 .*expected \(\*batch, n, 3\)"),
        (lambda: dyn.fit(L(3), *x.unbind(1), x[:, 0]), "takes up to 8 points, got 9; take as many of them"),
        (lambda: L(2, 2), "l must be 1 to k - 1, got k = 2, l = 2"),
        (lambda: L(4, 2, "plane"), "takes k = l \\+ 1, .* got k = 4, l = 2"),
        (lambda: L(4, 2, "metric"), "one of general, plane, affine, got 'metric'"),
        (lambda: L(4).minimal(), unknown),
        (lambda: L(4).compose(truth[:, :3]), r"points must be \(\*batch, n, 4\) or homogeneous"),
        (lambda: count("lifted_shape", space=4, points=7), "points must be 8 to 10 for P\\^4 -> P\\^2, got 7"),
        (lambda: count("lifted_shape", space=2), "image must be 1 to space - 1, got space = 2, image = 2"),
        (lambda: count("lifted_shape", space=6, points=14), "5,040 unknowns are too many"),
        (lambda: count("dynamic_shape", degree=5), "degree must be 1 to 4, got 5"),
    )

"""Grassmann tensors against determinants one by one, finite differences at singular minors, and Cauchy-Binet."""

from itertools import combinations, product
from math import comb

import pytest
import torch

from dyntorch.geometry.extensors import compound
from dyntorch.geometry.grassmann import grassmann_derivative, grassmann_tensor
from dyntorch.geometry.homogeneous import hyperplanes_through, inhomogeneous

# profile, rows of each view
PROFILES = [
    ((2, 2), (3, 3)),
    ((2, 1, 1), (3, 3, 3)),
    ((1, 1, 1, 1), (3, 3, 3, 3)),
    ((2, 2, 1), (3, 3, 3)),
    ((2, 1, 1, 1), (3, 3, 3, 3)),
    ((2, 2, 2), (3, 3, 3)),
    ((2, 2, 1, 1), (3, 3, 3, 3)),
    ((2, 2, 2, 1), (3, 3, 3, 3)),
    ((1, 1, 1), (2, 2, 2)),
    ((3, 3, 1), (4, 4, 4)),
    ((3, 3, 1), (4, 4, 3)),
    ((1, 2, 3), (2, 3, 5)),
    ((3, 1), (4, 2)),
    ((3, 2), (3, 3)),
]


def random(*shape, seed=0):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def projections(profile, rows, *batch, seed=0):
    return [random(*batch, m, sum(profile), seed=10 * seed + i) for i, m in enumerate(rows)]


def brute(views, profile):
    """Reference: every entry by its own determinant."""
    subsets = [list(combinations(range(m.shape[-2]), a)) for m, a in zip(views, profile, strict=True)]
    entries = [
        torch.linalg.det(torch.cat([m[..., list(rows), :] for m, rows in zip(views, chosen, strict=True)], -2))
        for chosen in product(*subsets)
    ]
    return torch.stack(entries, -1).unflatten(-1, [len(s) for s in subsets])


def contract(tensor, vectors):
    """One vector per axis of a tensor without batch."""
    for v in vectors:
        tensor = torch.tensordot(v, tensor, dims=([-1], [0]))
    return tensor


@pytest.mark.parametrize(("profile", "rows"), PROFILES)
def test_every_entry_is_a_determinant(profile, rows):
    views = projections(profile, rows, 2)
    tensor = grassmann_tensor(views, profile)
    assert tensor.shape == (2, *(comb(m, a) for m, a in zip(rows, profile, strict=True)))
    torch.testing.assert_close(tensor, brute(views, profile), rtol=1e-9, atol=1e-10)


def test_six_line_cameras():
    views = projections((1,) * 6, (3,) * 6)
    torch.testing.assert_close(grassmann_tensor(views, (1,) * 6), brute(views, (1,) * 6), rtol=1e-9, atol=1e-10)


def test_batches_broadcast():
    first, second = random(4, 1, 3, 4), random(5, 3, 4, seed=1)
    tensor = grassmann_tensor([first, second], (2, 2))
    assert tensor.shape == (4, 5, 3, 3)
    torch.testing.assert_close(tensor[3, 2], grassmann_tensor([first[3, 0], second[2]], (2, 2)))


@pytest.mark.parametrize(("profile", "rows"), PROFILES)
def test_contraction_with_hyperplanes(profile, rows):
    """<A, x C_a(S_i)> = det(stack S_i M_i), of any hyperplanes."""
    views = projections(profile, rows)
    planes = [random(a, m, seed=99 + i) for i, (a, m) in enumerate(zip(profile, rows, strict=True))]
    value = contract(grassmann_tensor(views, profile), [compound(s, a)[0] for s, a in zip(planes, profile, strict=True)])
    stack = torch.cat([s @ m for s, m in zip(planes, views, strict=True)])
    torch.testing.assert_close(value, torch.linalg.det(stack), rtol=1e-9, atol=1e-10)


@pytest.mark.parametrize(("profile", "rows"), [p for p in PROFILES if all(a < m for a, m in zip(*p, strict=True))])
def test_images_of_one_point_fulfil_it(profile, rows):
    views, world = projections(profile, rows), random(sum(profile), seed=7)
    tensor = grassmann_tensor(views, profile)
    hyperplanes = [hyperplanes_through(inhomogeneous(m @ world)[None])[0] for m in views]
    value = contract(tensor, [compound(h[:a], a)[0] for h, a in zip(hyperplanes, profile, strict=True)])
    assert value.abs() < 1e-10 * tensor.norm()


@pytest.mark.parametrize(("profile", "rows"), [((2, 2, 1), (3, 3, 3)), ((3, 3, 1), (4, 4, 3)), ((1, 1, 1, 1), (3, 3, 3, 3))])
def test_collineations_of_the_images_and_of_the_world_act_on_it(profile, rows):
    views = projections(profile, rows)
    moves = [random(m, m, seed=50 + i) for i, m in enumerate(rows)]
    world = random(sum(profile), sum(profile), seed=70)
    moved = grassmann_tensor([r @ m @ world for r, m in zip(moves, views, strict=True)], profile)
    expected = grassmann_tensor(views, profile) * torch.linalg.det(world)
    for axis, (r, a) in enumerate(zip(moves, profile, strict=True)):
        expected = torch.tensordot(compound(r, a), expected, dims=([1], [axis])).movedim(0, axis)
    torch.testing.assert_close(moved, expected, rtol=1e-9, atol=1e-9)


def singular_views():
    """Two views with one row in common and a third of rank one: minors of corank 1, 2 and more."""
    first, second, third = projections((2, 2, 1), (3, 3, 3))
    second[0] = first[0]
    second[1] = 2 * first[1]
    third[1:] = third[:1] * torch.tensor([[2.0], [-1.0]])
    return [first, second, third]


def test_gradients_are_exact_where_minors_are_singular():
    views = singular_views()
    assert (grassmann_tensor(views, (2, 2, 1)).abs() < 1e-12).any()
    inputs = tuple(v.clone().requires_grad_() for v in views)
    assert torch.autograd.gradcheck(
        lambda *m: grassmann_tensor(m, (2, 2, 1)), inputs, check_forward_ad=True, check_batched_grad=True
    )


@pytest.mark.parametrize(("profile", "rows"), [PROFILES[3], PROFILES[5], PROFILES[7], PROFILES[10], PROFILES[11]])
def test_closed_form_derivative_is_that_of_autograd(profile, rows):
    views = projections(profile, rows, 2)
    value, derivative = grassmann_derivative(views, profile)
    torch.testing.assert_close(value, grassmann_tensor(views, profile).flatten(1), rtol=1e-9, atol=1e-10)

    def flat(*m):
        return grassmann_tensor(m, profile).flatten()

    for b in range(2):
        jacobians = torch.func.jacrev(flat, argnums=tuple(range(len(rows))))(*(m[b] for m in views))
        expected = torch.cat([j.flatten(1) for j in jacobians], 1).mT
        torch.testing.assert_close(derivative[b], expected, rtol=1e-9, atol=1e-10)


def test_forward_mode_is_the_finite_difference_at_singular_minors():
    views = singular_views()
    tangents = [random(3, 5, seed=30 + i) for i in range(3)]
    _, derivative = torch.func.jvp(lambda *m: grassmann_tensor(m, (2, 2, 1)), tuple(views), tuple(tangents))
    h = 1e-5
    ahead, behind = (brute([m + s * t for m, t in zip(views, tangents, strict=True)], (2, 2, 1)) for s in (h, -h))
    torch.testing.assert_close(derivative, (ahead - behind) / (2 * h), rtol=1e-7, atol=1e-8)


def test_gradients_vanish_at_corank_two_and_second_derivatives_do_not():
    views = [torch.zeros(3, 4, dtype=torch.float64), random(3, 4)]
    zero = views[0].clone().requires_grad_()
    assert torch.autograd.gradgradcheck(lambda m: grassmann_tensor([m, views[1]], (2, 2)), zero)
    (gradient,) = torch.autograd.grad(grassmann_tensor([zero, views[1]], (2, 2)).sum(), zero)
    assert not gradient.any()


@pytest.mark.parametrize(
    ("shapes", "profile"),
    [([(3, 4)], (2, 2)), ([(5, 3)], (3,)), ([(3, 4), (3, 5)], (2, 2)), ([(3, 4), (3, 4)], (2, 1)), ([(3, 4), (3, 4)], (3, 2))],
)
def test_projections_that_do_not_fit_are_refused(shapes, profile):
    with pytest.raises(ValueError, match="takes 2 projections"):
        grassmann_tensor([random(*s) for s in shapes], profile)


def test_more_rows_than_a_view_has_are_refused():
    with pytest.raises(ValueError, match="order must be 1 to"):
        grassmann_tensor([random(3, 5), random(3, 5)], (4, 1))

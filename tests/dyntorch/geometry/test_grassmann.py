"""Grassmann tensors against determinants one by one, finite differences at singular minors, and Cauchy-Binet."""

from math import comb

import pytest
import torch
from torch.nn.functional import normalize

from dyntorch.geometry.extensors import compound, dual, meet, wedge
from dyntorch.geometry.grassmann import (
    candidates,
    epipoles,
    grassmann_derivative,
    grassmann_tensor,
    joint_epipoles,
    joint_epipoles_of_tensor,
)
from dyntorch.metrics import relative_error
from tests.battery.projections import minors
from tests.draws import random, seeded
from tests.grid import assert_refused

# profile, rows of each view
THREE = [(2, 2), (2, 1, 1), (1, 1, 1, 1), (2, 2, 1), (2, 1, 1, 1), (2, 2, 2), (2, 2, 1, 1), (2, 2, 2, 1), (1, 1, 1, 1, 1, 1)]
OTHERS = [
    ((1, 1, 1), (2, 2, 2)),
    ((3, 3, 1), (4, 4, 4)),
    ((3, 3, 1), (4, 4, 3)),
    ((1, 2, 3), (2, 3, 5)),
    ((3, 1), (4, 2)),
    ((3, 2), (3, 3)),
]
PROFILES = [*((profile, (3,) * len(profile)) for profile in THREE), *OTHERS]
CASES = [
    *((p, (3,) * len(p)) for p in (*THREE, (2, 1), (1, 1), (1, 2, 2), (2, 2, 1, 1, 1))),
    ((2, 2), (4, 4)),
    ((2, 2, 2), (4, 4, 4)),
    *OTHERS[1:3],
]


def projections(profile, rows, *batch, seed=0):
    return [random(*batch, m, sum(profile), seed=10 * seed + i) for i, m in enumerate(rows)]


@pytest.mark.parametrize(("profile", "rows"), PROFILES)
def test_every_entry_is_a_determinant(profile, rows):
    views = projections(profile, rows, 2)
    tensor = grassmann_tensor(views, profile)
    assert tensor.shape == (2, *(comb(m, a) for m, a in zip(rows, profile, strict=True)))
    torch.testing.assert_close(tensor.flatten(1), minors(profile, views), rtol=1e-9, atol=1e-10)


def test_batches_broadcast():
    first, second = random(4, 1, 3, 4), random(5, 3, 4, seed=1)
    tensor = grassmann_tensor([first, second], (2, 2))
    assert tensor.shape == (4, 5, 3, 3)
    torch.testing.assert_close(tensor[3, 2], grassmann_tensor([first[3, 0], second[2]], (2, 2)))


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


def test_gradients_are_exact_where_minors_are_singular():
    """Two views with one row in common and a third of rank one: minors of corank 1, 2 and more."""
    views = first, second, third = projections((2, 2, 1), (3, 3, 3))
    second[0], second[1] = first[0], 2 * first[1]
    third[1:] = third[:1] * torch.tensor([[2.0], [-1.0]])
    assert (grassmann_tensor(views, (2, 2, 1)).abs() < 1e-12).any()
    inputs = tuple(v.clone().requires_grad_() for v in views)
    assert torch.autograd.gradcheck(
        lambda *m: grassmann_tensor(m, (2, 2, 1)), inputs, check_forward_ad=True, check_batched_grad=True
    )
    # of corank two they vanish, and second derivatives do not
    zero, other = torch.zeros(3, 4, dtype=torch.float64, requires_grad=True), random(3, 4)
    assert torch.autograd.gradgradcheck(lambda m: grassmann_tensor([m, other], (2, 2)), zero)
    (gradient,) = torch.autograd.grad(grassmann_tensor([zero, other], (2, 2)).sum(), zero)
    assert not gradient.any()


@pytest.mark.parametrize(("profile", "rows"), [PROFILES[3], PROFILES[5], PROFILES[7], *OTHERS[2:4]])
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


# Candidate projections against the true ones: every profile, any order and scale, zeros; the balance; the known ambiguity.


def scene(profile, sizes, *batch, seed=0):
    return [random(*batch, m, sum(profile), seed=seed + i) for i, m in enumerate(sizes)]


def distance(projections, tensor, profile):
    return relative_error(grassmann_tensor(projections, profile), tensor, dims=len(profile))


def relative(result, views):
    """Reference: the smallest of the singular values of R_i H = s_i M_i in H and all s_i, relative to the next, per problem."""
    size, count = views[0].shape[-1], len(views)
    ratios = []
    for b in range(len(views[0])):
        blocks = []
        for i, (r, m) in enumerate(zip(result, views, strict=True)):
            scale = torch.zeros(m[b].numel(), count, dtype=m.dtype)
            scale[:, i] = -(m[b] / m[b].norm()).flatten()
            blocks.append(torch.cat([torch.kron(r[b].contiguous(), torch.eye(size, dtype=m.dtype)), scale], dim=-1))
        s = torch.linalg.svdvals(torch.cat(blocks))
        ratios.append(float(s[-1] / s[-2]))
    return torch.tensor(ratios)


@pytest.mark.parametrize(("profile", "sizes"), CASES)
def test_candidates_are_the_true_projections(profile, sizes):
    views = scene(profile, sizes, 6)
    tensor = grassmann_tensor(views, profile)
    found = candidates(tensor, profile, sizes)
    assert [tuple(part.shape) for part in found] == [(5, 6, m, sum(profile)) for m in sizes]
    assert distance(found, tensor.expand(5, *tensor.shape), profile).max() < 1e-11
    # which of the tries is best depends on the scene; the median one is good
    ratio = torch.stack([relative([part[t] for part in found], views) for t in range(5)])
    assert ratio.median(dim=0).values.max() < 1e-9


@pytest.mark.parametrize(("profile", "sizes"), [((3, 1), (3, 3)), ((1, 2), (3, 2)), ((2, 2, 2), (3, 2, 3)), ((2, 1), (2, 3))])
def test_all_rows_of_a_view(profile, sizes):
    tensor = grassmann_tensor(scene(profile, sizes, 4), profile)
    assert distance(candidates(tensor, profile, sizes, tries=3), tensor.expand(3, *tensor.shape), profile).max() < 1e-12


def test_three_views_of_a_line_have_two_solutions():
    views = scene((1, 1, 1), (2, 2, 2), 8)
    tensor = grassmann_tensor(views, (1, 1, 1))
    found = candidates(tensor, (1, 1, 1), (2, 2, 2), tries=20)
    assert distance(found, tensor.expand(20, *tensor.shape), (1, 1, 1)).max() < 1e-11
    right = torch.stack([relative([part[t] for part in found], views) for t in range(20)]) < 1e-9
    assert right.any(0).all()
    assert (~right).any(0).all()
    # a second solution, the same for every rotation of a scene
    for b in range(8):
        wrong = (~right[:, b]).nonzero()[:, 0]
        first = [part[wrong[:1].expand(len(wrong)), b] for part in found]
        assert relative([part[wrong, b] for part in found], first).max() < 1e-9


def test_cameras_for_which_many_minors_vanish():
    eye = torch.eye(3, dtype=torch.float64).expand(4, 3, 3)
    views = [torch.cat([eye, i * random(4, 3, 1, seed=i)], dim=-1) for i in range(3)]  # [I | 0] and translations
    tensor = grassmann_tensor(views, (2, 1, 1))
    assert (tensor == 0).sum() > 20
    found = candidates(tensor, (2, 1, 1), (3, 3, 3))
    assert distance(found, tensor.expand(5, *tensor.shape), (2, 1, 1)).max() < 1e-11
    assert relative([part[0] for part in found], views).max() < 1e-9


def test_scale_sign_and_batch_do_not_matter():
    tensor = grassmann_tensor(scene((2, 2, 1), (3, 3, 3), 2, 3), (2, 2, 1))
    tensor = tensor + 1e-3 * random(*tensor.shape, seed=9)
    found = candidates(tensor, (2, 2, 1), (3, 3, 3))
    for factor in (-1.0, 2.0**-200, -(2.0**100)):
        for part, same in zip(candidates(factor * tensor, (2, 2, 1), (3, 3, 3)), found, strict=True):
            torch.testing.assert_close(part, same)
    for a in range(2):
        for b in range(3):
            for part, same in zip(candidates(tensor[a, b], (2, 2, 1), (3, 3, 3)), found, strict=True):
                torch.testing.assert_close(part, same[:, a, b], rtol=0, atol=1e-10)
    single = candidates(tensor.float(), (2, 2, 1), (3, 3, 3))
    assert single[0].dtype == torch.float32
    assert candidates(tensor[:0], (2, 2, 1), (3, 3, 3))[0].shape == (5, 0, 3, 3, 5)
    assert not candidates(tensor.requires_grad_(), (2, 2, 1), (3, 3, 3))[0].requires_grad


def test_zero_and_not_finite_tensors_give_zeros_and_disturb_nobody():
    tensor = grassmann_tensor(scene((2, 2, 2, 1), (3, 3, 3, 3), 5), (2, 2, 2, 1))
    alone = candidates(tensor[2:3], (2, 2, 2, 1), (3, 3, 3, 3))
    tensor[0], tensor[1, 0, 0, 0, 0], tensor[3, 1], tensor[4] = 0.0, torch.nan, torch.inf, torch.nan
    for part, same in zip(candidates(tensor, (2, 2, 2, 1), (3, 3, 3, 3)), alone, strict=True):
        assert (part[:, [0, 1, 3, 4]] == 0).all()
        torch.testing.assert_close(part[:, 2], same[:, 0], rtol=0, atol=1e-10)


def test_noise_that_no_projection_explains_stays_finite():
    for seed, shape, profile in ((0, (50, 3, 3, 3), (2, 2, 1)), (1, (50, 2, 2, 2), (1, 1, 1))):
        found = candidates(random(*shape, seed=seed), profile, [shape[-1]] * 3)
        assert all(part.isfinite().all() for part in found)
        assert all(torch.allclose(part.flatten(-2).norm(dim=-1), torch.ones(()).double()) for part in found)
    one = torch.zeros(3, 3, 3)
    one[0, 1, 2] = 1.0  # a single minor: the other rows of the projections are zero
    assert all(part.isfinite().all() for part in candidates(one, (2, 2, 1), (3, 3, 3)))


# Epipoles and joint epipoles: against vanishing points, null vectors, the transversal of the centres, and the tensor alone.


PIXELS = torch.tensor([[900.0, 3.0, 500.0], [0.0, 880.0, 400.0], [0.0, 0.0, 1.0]]).double()


def common_direction(*batch, seed=0):
    """Projections P^4 -> P^2 of points of space that move in one direction, and the images of that direction."""
    cameras = random(*batch, 3, 3, 4, seed=seed)
    direction = torch.cat([random(*batch, 3, seed=seed + 1), torch.zeros(*batch, 1).double()], -1)
    vanishing = (cameras @ direction[..., None, :, None])[..., 0]
    times = torch.tensor([0.0, 1.0, 2.5]).double()
    return torch.cat([cameras, times[:, None, None] * vanishing[..., None]], -1), vanishing


def constant_velocity(*batch, seed=0):
    """Projections P^4 -> P^2 of points of the plane with constant velocities, and the images of the line at infinity."""
    cameras = random(*batch, 3, 3, 3, seed=seed)
    times = torch.tensor([0.0, 1.0, 2.5]).double()[:, None, None]
    return torch.cat([cameras, times * cameras[..., :2]], -1), torch.linalg.cross(cameras[..., 0], cameras[..., 1])


def test_joint_epipoles_are_the_vanishing_points_of_the_common_direction():
    views, vanishing = common_direction(40)
    found = joint_epipoles(views.unbind(-3))
    assert relative_error(found.epipoles, vanishing, dims=1).max() < 1e-10
    assert found.definedness.min() > 1e-4
    # in any projective frame and in pixels
    moved = joint_epipoles((PIXELS @ views @ random(40, 1, 5, 5, seed=5) * random(40, 3, 1, 1, seed=6)).unbind(-3))
    assert relative_error(moved.epipoles @ torch.linalg.inv(PIXELS).mT, vanishing, dims=1).max() < 1e-8
    torch.testing.assert_close(joint_epipoles((PIXELS @ views).unbind(-3)).definedness, found.definedness)


def test_epipoles_lie_on_the_transversal_of_the_centres():
    views = random(10, 3, 3, 5, seed=1)
    found = joint_epipoles(views.unbind(-3))
    centres = meet(*views.unbind(-2)).unbind(-2)
    hyperplanes = [dual(wedge(a, b, 5, (2, 2)), 5, 4) for a, b in ((centres[0], centres[1]), (centres[0], centres[2]), centres[1:])]
    transversal = meet(*hyperplanes)
    for view in range(3):
        assert wedge(transversal, centres[view], 5, (2, 2)).abs().max() < 1e-9 * transversal.norm(dim=-1).max()
        # a line that meets the centre has a point for image
        image = compound(views[:, view], 2) @ transversal[..., None]
        assert image.abs().max() < 1e-9 * transversal.norm(dim=-1).max()
        # two of its points: skew form of the line, u -> u meet line
        points = torch.stack([dual(wedge(dual(transversal, 5, 2), h, 5, (3, 1)), 5, 4) for h in random(2, 10, 5, seed=8)], -1)
        for point in (views[:, view] @ points).unbind(-1):
            assert relative_error(point, found.epipoles[:, view], dims=1).max() < 1e-8


def test_lines_are_the_images_of_the_centres():
    views = random(6, 3, 3, 5, seed=2)
    found = joint_epipoles(views.unbind(-3))
    for i in range(3):
        for place, j in enumerate(j for j in range(3) if j != i):
            kernel = torch.linalg.svd(views[:, j]).Vh[:, 3:].mT
            assert (found.lines[:, i, place, None] @ (views[:, i] @ kernel)).abs().max() < 1e-12


def test_constant_velocities_in_the_plane_have_none():
    views, infinity = constant_velocity(20)
    found = joint_epipoles(views.unbind(-3))
    assert found.definedness.max() < 1e-10
    assert relative_error(found.lines, infinity[..., None, :].expand_as(found.lines), dims=1).max() < 1e-9
    from_tensor = joint_epipoles_of_tensor(grassmann_tensor(views.unbind(-3), (2, 2, 1)))
    assert from_tensor.definedness.max() < 1e-5
    assert (from_tensor.epipoles.isfinite() & found.epipoles.isfinite()).all()


@pytest.mark.parametrize("scene", ["random", "common direction"])
def test_the_tensor_alone_knows_them(scene):
    views = random(30, 3, 3, 5, seed=4) if scene == "random" else common_direction(30, seed=9)[0]
    tensor = grassmann_tensor(views.unbind(-3), (2, 2, 1))
    found, expected = joint_epipoles_of_tensor(-7 * tensor), joint_epipoles(views.unbind(-3))
    assert relative_error(found.epipoles, expected.epipoles, dims=1).median() < 1e-12
    assert relative_error(found.epipoles, expected.epipoles, dims=1).max() < 1e-7
    assert relative_error(found.lines, expected.lines, dims=1).max() < 1e-7


def test_slices_of_the_tensor_are_homographies_that_share_an_eigenspace():
    views = random(3, 3, 5, seed=11)
    tensor = grassmann_tensor(views.unbind(0), (2, 2, 1))
    points = dual(dual(tensor.movedim(-1, 0), 3, 2).mT, 3, 2).mT.movedim(0, -1)  # pairs of rows -> points
    y = random(5, seed=12)
    p, q, r = (views @ y).unbind(0)
    assert torch.einsum("i,j,ijk->k", p, q, points).cross(r, dim=0).norm() < 1e-12
    # two points of P^4 with the same first image: the slice maps their second images to their third ones
    homography = torch.einsum("i,ijk->kj", p, points)
    same_plane = y + torch.linalg.svd(views[0]).Vh[3:].mT @ random(2, seed=13)
    assert relative_error(homography @ (views[1] @ same_plane), views[2] @ same_plane, dims=1) < 1e-12
    # another slice is proportional to it on the image of the first centre
    other = torch.einsum("i,ijk->kj", random(3, seed=14), points)
    line = views[1] @ torch.linalg.svd(views[0]).Vh[3:].mT
    ratio = (torch.linalg.inv(other) @ homography @ line) / line
    assert (ratio - ratio[0, 0]).abs().max() < 1e-9 * ratio.abs().max()


def test_epipoles_of_points_that_move_in_one_direction_of_the_plane():
    cameras = random(8, 3, 3, 3)
    times = torch.tensor([0.0, 1.0, 2.0]).double()[:, None]
    views = torch.cat([cameras, (times * cameras[..., 0])[..., None]], -1)
    found = epipoles(views.unbind(-3))
    assert found.shape == (8, 3, 3, 3)
    for i in range(3):
        assert (found[:, i, i] == 0).all()
        for j in range(3):
            if i != j:  # the vanishing point of the direction
                assert relative_error(found[:, i, j], cameras[:, i, :, 0], dims=1).max() < 1e-9


def test_batch_is_loop_and_nan_stays_alone():
    views = random(4, 3, 3, 5)
    views[2, 1, 0, 0] = torch.nan
    tensor = grassmann_tensor(views.unbind(-3), (2, 2, 1))
    for verb, argument in ((lambda v: joint_epipoles(v.unbind(-3)), views), (joint_epipoles_of_tensor, tensor)):
        batch = verb(argument)
        for part in ("epipoles", "lines", "definedness"):
            assert getattr(batch, part).isfinite().all()
            for k in (0, 1, 3):
                torch.testing.assert_close(getattr(batch, part)[k], getattr(verb(argument[k]), part), atol=1e-9, rtol=1e-9)
        assert batch.definedness[2] == 0
    assert epipoles(views[..., :4].unbind(-3)).isfinite().all()
    views = views[0].float()
    assert joint_epipoles(views.unbind(0)).epipoles.dtype == epipoles(views[..., :4].unbind(0)).dtype == torch.float32


@pytest.mark.slow
def test_gradients():
    views = random(2, 3, 3, 5, seed=15).requires_grad_()
    assert torch.autograd.gradcheck(lambda v: joint_epipoles(v.unbind(-3)).epipoles, views, atol=1e-4)

    def of_tensor(v):
        return joint_epipoles_of_tensor(grassmann_tensor(v.unbind(-3), (2, 2, 1))).epipoles

    assert torch.autograd.gradcheck(of_tensor, views, atol=1e-4)


@pytest.mark.parametrize("k", [3, 4, 5])
def test_candidates_of_images_of_one_dimension_have_the_tensor_that_they_come_from(k):
    """Each triple of views alone leaves two roots; only together do the triples say which."""
    generator = seeded(k)
    views = [torch.randn(40, 2, k + 1, generator=generator, dtype=torch.float64) for _ in range(k + 1)]
    tensor = normalize(grassmann_tensor(views, (1,) * (k + 1)).flatten(1), dim=-1)
    flat = grassmann_tensor(candidates(tensor.view(-1, *(2,) * (k + 1)), (1,) * (k + 1), (2,) * (k + 1)), (1,) * (k + 1)).flatten(2)
    assert (1 - (normalize(flat, dim=-1) * tensor).sum(-1).abs()).max() < 1e-7


def test_misuse():
    tensor, views = random(3, 3, 3), random(3, 3, 5)
    two = [([(3, 4)], (2, 2)), ([(5, 3)], (3,)), ([(3, 4), (3, 5)], (2, 2)), ([(3, 4), (3, 4)], (2, 1)), ([(3, 4), (3, 4)], (3, 2))]
    assert_refused(
        *((lambda s=s, p=p: grassmann_tensor([random(*shape) for shape in s], p), "takes 2 projections") for s, p in two),
        (lambda: grassmann_tensor([random(3, 5), random(3, 5)], (4, 1)), "order must be 1 to"),
        (lambda: candidates(tensor, (2, 2, 4), (3, 3, 3)), "profile must have 1 to m_i rows"),
        (lambda: candidates(tensor, (2, 2), (3, 3, 3)), "profile must have 1 to m_i rows"),
        (lambda: candidates(tensor, (2, 2, 2, 1), (3, 3, 3, 3)), "is floating point"),
        (lambda: candidates(tensor.long(), (2, 2, 1), (3, 3, 3)), "is floating point"),
        (lambda: candidates(tensor, (2, 2, 1), (3, 3, 3), tries=0), "tries"),
        (lambda: joint_epipoles(views[:2].unbind(0)), "three projections"),
        (lambda: joint_epipoles(views[..., :4].unbind(0)), "three projections"),
        (lambda: epipoles(views.unbind(0)), "centre is a point"),
        (lambda: epipoles([]), "centre is a point"),
        (lambda: joint_epipoles_of_tensor(random(3, 3, 6)), "profile"),
    )

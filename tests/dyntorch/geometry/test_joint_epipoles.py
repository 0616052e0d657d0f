"""Epipoles and joint epipoles: against vanishing points, null vectors, the transversal of the centres, and the tensor alone."""

import pytest
import torch
from torch.nn.functional import normalize

from dyntorch.geometry.extensors import compound, dual, meet, wedge
from dyntorch.geometry.grassmann import epipoles, grassmann_tensor, joint_epipoles, joint_epipoles_of_tensor

PIXELS = torch.tensor([[900.0, 3.0, 500.0], [0.0, 880.0, 400.0], [0.0, 0.0, 1.0]]).double()


def random(*shape, seed=0):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def angle(a, b):
    return torch.linalg.cross(normalize(a, dim=-1), normalize(b, dim=-1)).norm(dim=-1)


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
    assert angle(found.epipoles, vanishing).max() < 1e-10
    assert found.definedness.min() > 1e-4


def test_any_projective_frame_and_pixels():
    views, vanishing = common_direction(20, seed=3)
    plain = joint_epipoles(views.unbind(-3))
    moved = PIXELS @ views @ random(20, 1, 5, 5, seed=5)
    found = joint_epipoles((moved * random(20, 3, 1, 1, seed=6)).unbind(-3))
    assert angle(found.epipoles @ torch.linalg.inv(PIXELS).mT, vanishing).max() < 1e-8
    pixels_alone = joint_epipoles((PIXELS @ views).unbind(-3))
    torch.testing.assert_close(pixels_alone.definedness, plain.definedness)


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
            assert angle(point, found.epipoles[:, view]).max() < 1e-8


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
    assert angle(found.lines, infinity[..., None, :].expand_as(found.lines)).max() < 1e-9
    from_tensor = joint_epipoles_of_tensor(grassmann_tensor(views.unbind(-3), (2, 2, 1)))
    assert from_tensor.definedness.max() < 1e-5
    assert (from_tensor.epipoles.isfinite() & found.epipoles.isfinite()).all()


@pytest.mark.parametrize("scene", ["random", "common direction"])
def test_the_tensor_alone_knows_them(scene):
    views = random(30, 3, 3, 5, seed=4) if scene == "random" else common_direction(30, seed=9)[0]
    tensor = grassmann_tensor(views.unbind(-3), (2, 2, 1))
    found, expected = joint_epipoles_of_tensor(-7 * tensor), joint_epipoles(views.unbind(-3))
    assert angle(found.epipoles, expected.epipoles).median() < 1e-12
    assert angle(found.epipoles, expected.epipoles).max() < 1e-7
    assert angle(found.lines, expected.lines).max() < 1e-7


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
    assert angle(homography @ (views[1] @ same_plane), views[2] @ same_plane) < 1e-12
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
                assert angle(found[:, i, j], cameras[:, i, :, 0]).max() < 1e-9


def test_epipoles_are_null_vectors_of_the_fundamental_matrix():
    first, second = random(2, 5, 3, 4)
    found = epipoles([first, second])
    tensor = grassmann_tensor([first, second], (2, 2))
    bilinear = dual(dual(tensor, 3, 2).mT, 3, 2).mT
    assert (bilinear @ found[:, 1, 0, :, None]).abs().max() < 1e-12
    assert (found[:, 0, 1, None] @ bilinear).abs().max() < 1e-12


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


@pytest.mark.slow
def test_gradients():
    views = random(2, 3, 3, 5, seed=15).requires_grad_()
    assert torch.autograd.gradcheck(lambda v: joint_epipoles(v.unbind(-3)).epipoles, views, atol=1e-4)

    def of_tensor(v):
        return joint_epipoles_of_tensor(grassmann_tensor(v.unbind(-3), (2, 2, 1))).epipoles

    assert torch.autograd.gradcheck(of_tensor, views, atol=1e-4)


def test_float32_in_float32_out():
    views = random(3, 3, 5).float()
    assert joint_epipoles(views.unbind(0)).epipoles.dtype == torch.float32
    assert epipoles(views[..., :4].unbind(0)).dtype == torch.float32


def test_refusals():
    views = random(3, 3, 5)
    with pytest.raises(ValueError, match="three projections"):
        joint_epipoles(views[:2].unbind(0))
    with pytest.raises(ValueError, match="three projections"):
        joint_epipoles(views[..., :4].unbind(0))
    with pytest.raises(ValueError, match="centre is a point"):
        epipoles(views.unbind(0))
    with pytest.raises(ValueError, match="centre is a point"):
        epipoles([])
    with pytest.raises(ValueError, match="profile"):
        joint_epipoles_of_tensor(random(3, 3, 6))

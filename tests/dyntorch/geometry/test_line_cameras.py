"""Line cameras against images of points, the way back to cameras, and the Klein quadric against the definition of a line."""

import pytest
import torch

from dyntorch.geometry.extensors import (
    camera_of_lines,
    cameras_of_lines,
    join,
    klein_frame,
    line_camera,
    lines_of_pencil,
    nearest_line,
    plucker_form,
)

J = plucker_form()


def random(*shape, seed=0):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def parallel(a, b, axes=2):
    """Largest 1 - |cos| of tensors up to scale."""
    a, b = a.flatten(-axes), b.flatten(-axes)
    return float((1 - ((a * b).sum(-1) / (a.norm(dim=-1) * b.norm(dim=-1))).abs()).max())


def misfit(cameras, found):
    """Reference: residual of the best T with found_i ~ cameras_i T, all of norm 1, and the gap to the next best."""
    views = len(cameras)
    unit = [c / c.norm() for c in cameras], [f / f.norm() for f in found]
    rows = torch.zeros(views, 12, 16 + views, dtype=torch.float64)
    for i in range(views):
        rows[i, :, :16] = torch.kron(unit[0][i].contiguous(), torch.eye(4, dtype=torch.float64))
        rows[i, :, 16 + i] = -unit[1][i].flatten()
    values = torch.linalg.svdvals(rows.flatten(0, 1))
    return float(values[-1]), float(values[-2])


def test_a_line_camera_maps_joins_to_cross_products():
    P, A, B = random(5, 3, 4), random(5, 4, seed=1), random(5, 4, seed=2)
    image = torch.linalg.cross((P @ A[..., None])[..., 0], (P @ B[..., None])[..., 0])
    torch.testing.assert_close((line_camera(P) @ join(A, B)[..., None])[..., 0], image)


def test_rows_of_a_line_camera_are_isotropic_and_its_null_lines_pass_through_the_centre():
    P = random(3, 4)
    M = line_camera(P)
    assert (M @ J @ M.T).abs().max() < 1e-12
    centre = torch.linalg.svd(P).Vh[-1]
    assert (M @ join(centre.expand(5, 4), random(5, 4, seed=3)).T).abs().max() < 1e-12


@pytest.mark.parametrize("scale", [1.0, -3.0])
def test_camera_of_lines_is_the_inverse(scale):
    P = random(7, 2, 3, 4)
    found = camera_of_lines(scale * line_camera(P))
    assert parallel(P, found) < 1e-14
    torch.testing.assert_close(found.flatten(-2).norm(dim=-1), torch.ones(7, 2, dtype=torch.float64))
    # what is no camera is data
    bad = torch.stack([line_camera(P[0, 0]), torch.full((3, 6), torch.nan).double(), torch.zeros(3, 6).double()])
    assert camera_of_lines(bad)[0].abs().max() > 0
    assert not camera_of_lines(bad)[1:].any()


@pytest.mark.parametrize("views", [5, 6, 9])
def test_cameras_come_back_from_a_collineation_of_p5(views):
    cameras, H, scale = random(8, views, 3, 4), random(8, 6, 6, seed=1), random(8, views, 1, 1, seed=2)
    seen = line_camera(cameras) @ H[:, None] * scale
    found = cameras_of_lines(seen)
    for one, other, several in zip(cameras, found, seen, strict=True):
        residual, gap = misfit(one, other)
        assert residual < 1e-10 < 1e-2 < gap
        torch.testing.assert_close(cameras_of_lines(several), other, rtol=1e-6, atol=1e-8)


def test_correlations_are_recognised():
    cameras = random(6, 3, 4)
    # J makes lines through a point lines in a plane
    assert misfit(cameras, cameras_of_lines(line_camera(cameras) @ J))[0] < 1e-12
    assert misfit(cameras, cameras_of_lines(line_camera(cameras)))[0] < 1e-12


def test_four_views_leave_a_family_of_quadrics_and_five_do_not():
    i, j = torch.triu_indices(6, 6)
    for views, rank in ((3, 15), (4, 18), (5, 20), (6, 20)):
        M = line_camera(random(views, 3, 4)) @ random(6, 6, seed=1)
        rows = [((a[i] * b[j] + a[j] * b[i]) / (1 + (i == j).double())) for m in M for a in m for b in m]
        assert int(torch.linalg.matrix_rank(torch.stack(rows), rtol=1e-9)) == rank


def test_frames_of_bad_projections_are_zero_and_harm_no_other():
    good = line_camera(random(6, 3, 4))
    flat = good.clone()
    flat[..., 0] = 0
    found = klein_frame(torch.stack([good, good * torch.nan, flat, torch.zeros_like(good)]))
    torch.testing.assert_close(found[0], klein_frame(good))
    assert not found[1:].any()


def test_nearest_line_is_on_the_quadric_and_nearest():
    v = random(50, 6)
    line = nearest_line(v)
    assert ((line @ J) * line).sum(-1).abs().max() < 1e-14
    torch.testing.assert_close(line.norm(dim=-1), torch.ones(50, dtype=torch.float64))
    # reference: the best of many lines, and the line itself where it is one
    others = torch.nn.functional.normalize(join(random(20000, 4, seed=1), random(20000, 4, seed=2)), dim=-1)
    unit = torch.nn.functional.normalize(v, dim=-1)
    assert ((unit @ others.T).abs().amax(-1) <= (unit * line).sum(-1) + 1e-12).all()
    torch.testing.assert_close(nearest_line(3 * others[:9]), others[:9])
    assert not nearest_line(J[0] + torch.eye(6)[0].double()).any()


def test_a_pencil_of_complexes_has_two_lines_or_none():
    first, second = (torch.nn.functional.normalize(join(random(4, seed=s), random(4, seed=s + 9)), dim=-1) for s in (1, 2))
    basis = torch.linalg.qr(torch.stack([first, second], dim=-1)).Q.T
    lines, real = lines_of_pencil(*basis)
    assert bool(real)
    assert min(parallel(lines, torch.stack(pair), 1) for pair in ((first, second), (second, first))) < 1e-14
    plus = torch.eye(6, dtype=torch.float64)[:2] @ (torch.eye(6) + J) / 2**0.5
    lines, real = lines_of_pencil(*plus)  # positive for the form: no line in it
    assert not bool(real)
    assert bool(lines.isfinite().all())


def test_gradients():
    P = random(3, 4).requires_grad_()
    assert torch.autograd.gradcheck(line_camera, P)
    assert torch.autograd.gradcheck(lambda p: camera_of_lines(line_camera(p)), P)
    assert torch.autograd.gradcheck(nearest_line, random(3, 6).requires_grad_())


def test_bad_shapes():
    with pytest.raises(ValueError, match="camera must be"):
        line_camera(torch.zeros(4, 3))
    with pytest.raises(ValueError, match="matrix must be"):
        camera_of_lines(torch.zeros(3, 4))
    for shape in ((4, 3, 6), (6, 3, 4), (3, 6)):
        with pytest.raises(ValueError, match="5 or more views"):
            klein_frame(torch.zeros(shape))

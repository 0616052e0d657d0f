"""Minimal join tensors: what one camera leaves open, what two determine; transfer against A and B; accuracy with noise."""

import pytest
import torch

from dyntorch.core.invariant import as_invariant
from dyntorch.geometry.extensors import levi_civita
from dyntorch.geometry.homogeneous import apply, homogeneous, similarity, unit
from dyntorch.invariants.join_tensor import JoinTensor
from dyntorch.invariants.minimal_join_tensor import MinimalJoinTensor
from dyntorch.metrics import point_error, relative_error
from dyntorch.scenes import moving_points


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


def random(*shape, seed=0):
    return torch.randn(*shape, generator=generator(seed), dtype=torch.float64)


def rows(*points):
    result = points[0]
    for p in points[1:]:
        result = (result[..., :, None] * p[..., None, :]).flatten(-2)
    return torch.nn.functional.normalize(result, dim=-1)


def rank(matrix):
    values = torch.linalg.svdvals(matrix)
    return int((values > 1e-9 * values[0]).sum())


def skew_system(slices):
    """The equations X^T S + S^T X = 0 by applying them to the 16 unit matrices, ``(c, 4, 4)`` slices."""
    basis = torch.eye(16, dtype=slices.dtype).reshape(16, 1, 4, 4)
    product = basis.mT @ slices
    return (product + product.mT).reshape(16, -1).T


def normalized(views):
    frames = []
    for x in views:
        centre = x.mean(-2)
        frames.append(similarity((3 / (x - centre[..., None, :]).square().sum(-1).mean(-1)).sqrt(), centre))
    return [apply(t, x) for t, x in zip(frames, views, strict=True)], frames


def fitted(invariant, views):
    """Motion by plain singular vectors, one per camera, in normalized coordinates."""
    points, frames = normalized(views)
    inner = invariant.normalize(tuple(t[..., None, :, :] for t in frames))
    image = homogeneous(points[2])[..., None, :, :] @ inner.primitives[2].cameras.mT
    first, second = (homogeneous(x)[..., None, :, :].expand(*image.shape[:-1], 4) for x in points[:2])
    matrix = rows(first, second, image)
    factor = torch.linalg.qr(matrix, mode="r").R if matrix.shape[-2] > 48 else matrix
    tensor = torch.linalg.svd(factor).Vh[..., -1, :].unflatten(-1, (4, 4, 3))
    return [torch.linalg.inv(frames[0]) @ m @ t for m, t in zip(inner.decompose(tensor), frames[1:], strict=True)]


def error(motion, scene):
    """RMS error at the points of the scene, the worse of A and B."""
    pairs = zip(motion, scene.motion, scene.exact[1:], strict=True)
    return torch.stack([point_error(got, true, x) for got, true, x in pairs]).amax(0)


def test_declaration():
    invariant = as_invariant(MinimalJoinTensor)
    assert (MinimalJoinTensor.minimal(), MinimalJoinTensor.width(), MinimalJoinTensor.shape()) == (47, 48, (4, 4, 3))
    assert (invariant.nullity, invariant.copies, invariant.dof, invariant.codim) == (1, 4, 30, 2)
    assert invariant.labels_static
    assert repr(invariant) == "MinimalJoinTensor"
    assert MinimalJoinTensor(random(2, 3, 4)).copies == 2
    assert repr(MinimalJoinTensor(random(2, 3, 4))) == "MinimalJoinTensor(2 cameras)"


@pytest.mark.parametrize(("n", "expected"), [(46, 46), (47, 47), (90, 47)])
@pytest.mark.parametrize("seed", [1, 2])
def test_rank_of_moving_matches(n, expected, seed):
    scene = moving_points(n, generator=generator(seed))
    one, two, three = (homogeneous(x) for x in scene.exact)
    for camera in (random(3, 4, seed=seed), torch.eye(4, dtype=torch.float64)[1:]):
        assert rank(rows(one, two, three @ camera.mT)) == expected


def test_tensor_is_the_null_vector_of_exact_matches():
    scene = moving_points(60, generator=generator(3))
    invariant = MinimalJoinTensor(random(3, 3, 4, seed=4))
    tensor = invariant.compose(*scene.motion)
    assert tensor.shape == (3, 4, 4, 3)
    one, two, three = (homogeneous(x) for x in scene.exact)
    for camera, got in zip(invariant.cameras, tensor, strict=True):
        null = torch.linalg.svd(rows(one, two, three @ camera.mT)).Vh[-1]
        assert relative_error(got.flatten(), null, dims=1) < 1e-8


def test_tensor_is_that_of_the_projected_definition():
    """N_ijk = eps_lmk W_li (W A)_mj with W = M B^-1."""
    a, b = random(5, 1, 4, 4, seed=5), random(5, 1, 4, 4, seed=6)
    invariant = MinimalJoinTensor(random(3, 3, 4, seed=7))
    w = invariant.cameras @ torch.linalg.inv(b)
    expected = torch.einsum("lmk,zcli,zcmj->zcijk", levi_civita(3), w, w @ a)
    tensor = invariant.compose(a[:, 0], b[:, 0])
    assert relative_error(tensor, expected, dims=3).max() < 1e-11
    torch.testing.assert_close(tensor.flatten(-3).norm(dim=-1), torch.ones(5, 3, dtype=torch.float64))


@pytest.mark.parametrize(("cameras", "expected"), [(1, 11), (2, 15), (4, 15)])
def test_one_camera_leaves_nullity_five_and_two_leave_one(cameras, expected):
    a, b = random(4, 4, seed=10), random(4, 4, seed=11)
    tensor = MinimalJoinTensor(random(cameras, 3, 4, seed=12)).compose(a, b)
    slices = tensor.permute(0, 3, 1, 2).reshape(-1, 4, 4)
    assert rank(skew_system(slices)) == expected


def test_one_camera_does_not_see_part_of_the_motion():
    """N stays the same for A -> (t I + B C v^T) A, where C is the centre of the camera."""
    a, b, camera = random(4, 4, seed=13), random(4, 4, seed=14), random(1, 3, 4, seed=15)
    invariant = MinimalJoinTensor(camera)
    centre = torch.linalg.svd(camera[0]).Vh[-1]
    other = (0.7 * torch.eye(4, dtype=torch.float64) + torch.outer(b @ centre, random(4, seed=16))) @ a
    assert relative_error(other, a) > 0.1
    assert relative_error(invariant.compose(other, b), invariant.compose(a, b), dims=3).max() < 1e-11
    with pytest.raises(ValueError, match="at least two cameras with different centres"):
        invariant.decompose(invariant.compose(a, b))
    x = torch.zeros(1, 3, dtype=torch.float64)
    with pytest.raises(ValueError, match="one camera"):
        invariant.transfer(invariant.compose(a, b), x, 2, 1)
    # the plane of a trajectory needs no more than one
    assert invariant.trajectory_planes(invariant.compose(a, b), x, x + 1).shape == (1, 1, 4)


@pytest.mark.parametrize(("cameras", "expected"), [(1, 23), (2, 32), (4, 34)])
def test_dimension_of_the_cone(cameras, expected):
    """Tangent rank at scale-free parts times their free scales: 22 + 1 for one camera, 30 + c for more."""
    invariant = MinimalJoinTensor(random(cameras, 3, 4, seed=17))

    def scaled(parameters):
        motion = parameters[:32].unflatten(-1, (2, 4, 4))
        return parameters[32:, None] * invariant.compose(motion[0], motion[1]).flatten(-3)

    start = torch.cat([random(32, seed=18), torch.ones(cameras, dtype=torch.float64)])
    jacobian = torch.autograd.functional.jacobian(scaled, start, vectorize=True)
    assert rank(jacobian.flatten(0, 1)) == expected


@pytest.mark.parametrize("batch", [(), (5,), (2, 3)])
@pytest.mark.parametrize("count", [2, 3, None])
def test_round_trip(batch, count):
    a, b = random(*batch, 4, 4, seed=19), random(*batch, 4, 4, seed=20)
    invariant = MinimalJoinTensor() if count is None else MinimalJoinTensor(random(count, 3, 4, seed=21))
    tensor = invariant.compose(a, b)
    signs = random(*batch, invariant.copies, 1, 1, 1, seed=22).sign()
    for got, true in zip(invariant.decompose(signs * tensor), (a, b), strict=True):
        torch.testing.assert_close(got, unit(true), atol=1e-9, rtol=0)


def test_scale_of_the_cameras_does_not_matter():
    cameras, scales = random(3, 3, 4, seed=23), torch.tensor([2.0, -5.0, 1e3], dtype=torch.float64)[:, None, None]
    a, b = random(4, 4, seed=24), random(4, 4, seed=25)
    noisy = MinimalJoinTensor(cameras).compose(a, b) + 0.01 * random(3, 4, 4, 3, seed=26)
    expected = MinimalJoinTensor(cameras).decompose(noisy)
    for got, true in zip(MinimalJoinTensor(scales * cameras).decompose(noisy), expected, strict=True):
        torch.testing.assert_close(got, true, atol=1e-10, rtol=0)
    pixels = MinimalJoinTensor(torch.diag(torch.tensor([700.0, 700.0, 1.0], dtype=torch.float64)) @ cameras)
    for got, true in zip(pixels.decompose(pixels.compose(a, b)), (a, b), strict=True):
        assert relative_error(got, true) < 1e-9


def test_batch_equals_loop_with_cameras_of_each_problem():
    """After normalization every problem has cameras of its own."""
    frames = tuple(similarity(random(6, seed=s).abs() + 0.3, random(6, 3, seed=s + 1))[:, None] for s in (27, 29, 31))
    invariant = MinimalJoinTensor().normalize(frames)
    a, b = random(6, 4, 4, seed=33), random(6, 4, 4, seed=34)
    tensor = invariant.compose(a, b)
    assert tensor.shape == (6, 4, 4, 4, 3)
    x = random(6, 5, 3, seed=35)
    transferred, parts = invariant.transfer(tensor, x, 3, 1), invariant.decompose(tensor)
    for i in range(6):
        alone = MinimalJoinTensor().normalize(tuple(t[i] for t in frames))
        torch.testing.assert_close(alone.compose(a[i], b[i]), tensor[i], atol=1e-12, rtol=0)
        torch.testing.assert_close(alone.transfer(tensor[i], x[i], 3, 1), transferred[i], atol=1e-9, rtol=1e-9)
        for got, part in zip(alone.decompose(tensor[i]), parts, strict=True):
            torch.testing.assert_close(got, part[i], atol=1e-10, rtol=0)


def test_change_of_coordinates_commutes_with_compose():
    """The tensor of normalized matches, carried back by the actions of the primitives, is the tensor of the matches."""
    frames = tuple(similarity(random(2, seed=s).abs() + 0.3, random(2, 3, seed=s + 1)) for s in (36, 38, 40))
    with_cameras = tuple(t[:, None] for t in frames)
    outer = MinimalJoinTensor(random(3, 3, 4, seed=42))
    inner = outer.normalize(with_cameras)
    q = inner.primitives[2].cameras
    torch.testing.assert_close(q @ q.mT, torch.eye(3, dtype=torch.float64).expand(2, 3, 3, 3), atol=1e-12, rtol=0)
    a, b = random(2, 4, 4, seed=43), random(2, 4, 4, seed=44)
    hatted = inner.compose(frames[0] @ a @ torch.linalg.inv(frames[1]), frames[0] @ b @ torch.linalg.inv(frames[2]))
    actions = [p.action(t) for p, t in zip(outer.primitives, with_cameras, strict=True)]
    back = torch.einsum("zcabd,zcai,zcbj,zcdk->zcijk", hatted, *(m.expand(2, 3, -1, -1) for m in actions))
    assert relative_error(back, outer.compose(a, b), dims=3).max() < 1e-11


@pytest.mark.parametrize(("source", "target"), [(1, 2), (1, 3), (2, 1), (2, 3), (3, 1), (3, 2)])
@pytest.mark.parametrize("count", [2, None])
def test_transfer_between_all_views(source, target, count):
    scene = moving_points(15, batch=2, static=1.0, generator=generator(45))
    invariant = MinimalJoinTensor() if count is None else MinimalJoinTensor(random(count, 3, 4, seed=46))
    tensor = invariant.compose(*scene.motion)
    got = invariant.transfer(tensor, scene.exact[source - 1], source, target)
    torch.testing.assert_close(got, scene.exact[target - 1], atol=1e-9, rtol=0)


@pytest.mark.parametrize("view", [1, 2, 3])
def test_trajectories_are_those_of_the_join_tensor(view):
    scene = moving_points(15, batch=2, generator=generator(47))
    given = [x for v, x in enumerate(scene.exact, start=1) if v != view]
    line = MinimalJoinTensor.trajectory(MinimalJoinTensor.compose(*scene.motion), *given, view)
    expected = JoinTensor.trajectory(JoinTensor.compose(*scene.motion), *given, view)
    assert relative_error(line, expected, dims=1).max() < 1e-9


def test_residuals_are_those_of_the_join_tensor():
    scene = moving_points(30, batch=2, sigma=0.01, static=0.5, generator=generator(48))
    scales = tuple(torch.full((2,), s, dtype=torch.float64) for s in (0.01, 0.02, 0.03))
    one, other = as_invariant(MinimalJoinTensor), as_invariant(JoinTensor)
    for name in ("whitened_residual", "whitened_static_residual"):
        assert torch.equal(*(getattr(i, name)(scene.motion, scene.views, scales) for i in (one, other)))
    distance = one.static_distance(one.compose(*scene.motion), *scene.views)
    torch.testing.assert_close(distance, other.static_distance(other.compose(*scene.motion), *scene.views))


REACH = {(60, 0.002, 4): 0.013, (100, 0.002, 4): 0.007, (100, 0.01, 4): 0.035, (500, 0.002, 4): 0.0026, (500, 0.01, 4): 0.013}


@pytest.mark.parametrize(("n", "sigma", "cameras"), [*REACH, (100, 0.002, 2)])
def test_linear_accuracy_with_noise(n, sigma, cameras):
    """Medians of 16 scenes, measured .0080, .0050, .025, .0021, .0105 and .0058 with two cameras."""
    scene = moving_points(n, batch=16, sigma=sigma, generator=generator(n))
    invariant = MinimalJoinTensor(MinimalJoinTensor().primitives[2].cameras[:cameras])
    assert error(fitted(invariant, scene.views), scene).median() < REACH.get((n, sigma, cameras), 0.01)


def test_forty_seven_exact_matches_give_the_motion():
    scene = moving_points(47, batch=4, generator=generator(49))
    assert error(fitted(MinimalJoinTensor(), scene.views), scene).max() < 1e-6


@pytest.mark.slow
def test_compose_and_decompose_are_differentiable():
    a, b = random(4, 4, seed=50).requires_grad_(), random(4, 4, seed=51).requires_grad_()
    options = {"check_forward_ad": True, "check_batched_forward_grad": True}
    assert torch.autograd.gradcheck(MinimalJoinTensor.compose, (a, b), **options)
    invariant = MinimalJoinTensor(random(2, 3, 4, seed=52))
    noisy = (invariant.compose(a, b).detach() + 0.03 * random(2, 4, 4, 3, seed=53)).requires_grad_()
    assert torch.autograd.gradcheck(lambda t: torch.stack(invariant.decompose(t)), (noisy,))


def test_degenerate_input_stays_finite():
    zero = torch.zeros(4, 4, dtype=torch.float64)
    a = torch.stack([zero, random(4, 4, seed=58)]).requires_grad_()
    b = torch.stack([zero, random(4, 4, seed=59)]).requires_grad_()
    tensor = MinimalJoinTensor.compose(a, b)
    assert (tensor[0] == 0).all()
    parts = MinimalJoinTensor.decompose(tensor)
    assert all(part.isfinite().all() for part in parts)
    torch.testing.assert_close(parts[1][1], unit(b[1]), atol=1e-10, rtol=0)
    (tensor * random(4, 4, 4, 3, seed=60)).sum().backward()
    assert a.grad.isfinite().all() and b.grad.isfinite().all()
    # no inverse of B is taken: a singular one is no exception
    singular = torch.diag(torch.tensor([1.0, 1.0, 1.0, 0.0], dtype=torch.float64))
    assert MinimalJoinTensor.compose(b.detach()[1], singular).isfinite().all()


@pytest.mark.parametrize(
    ("cameras", "message"),
    [
        (torch.zeros(3, 4), r"\(c, 3, 4\)"),
        (torch.zeros(0, 3, 4), r"\(c, 3, 4\)"),
        (torch.zeros(2, 4, 4), r"\(c, 3, 4\)"),
        (torch.ones(1, 3, 4), "camera 0 is not"),
        (torch.zeros(2, 3, 4), "camera 0 is not"),
        (torch.full((2, 3, 4), torch.nan), "camera 0 is not"),
        (torch.eye(4)[:3].repeat(2, 1, 1) * torch.tensor([[[1.0]], [[-2.0]]]), "different centres"),
    ],
)
def test_cameras_that_cannot_serve_are_refused(cameras, message):
    with pytest.raises(ValueError, match=message):
        MinimalJoinTensor(cameras)


def test_misuse_is_refused():
    with pytest.raises(ValueError, match="A and B must be"):
        MinimalJoinTensor.compose(torch.eye(3), torch.eye(4))
    with pytest.raises(ValueError, match=r"\(\*batch, 4, 4, 4, 3\)"):
        MinimalJoinTensor.decompose(torch.zeros(2, 4, 4, 3))
    tensor = MinimalJoinTensor.compose(torch.eye(4), torch.eye(4))
    with pytest.raises(ValueError, match="two different views"):
        MinimalJoinTensor.transfer(tensor, torch.zeros(1, 3), 3, 3)

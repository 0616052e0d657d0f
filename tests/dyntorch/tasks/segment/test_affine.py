"""Two bodies under affine cameras: minimal counts, ranks, noise, degenerate bodies, batches, gradients, misuse."""

import pytest
import torch

from dyntorch.geometry.epipolar import sampson_squared
from dyntorch.geometry.homogeneous import homogeneous
from dyntorch.metrics import relative_error
from dyntorch.tasks.segment.affine import affine_segmentation


def bodies(*batch, counts=(20, 20), sigma=0.0, planar=False, seed=0):
    """Two bodies of about 100 px seen by scaled orthographic cameras, their true labels and affine fundamental matrices."""
    rand = torch.Generator().manual_seed(seed)

    def normal(*shape):
        return torch.randn(*batch, *shape, generator=rand, dtype=torch.float64)

    n = sum(counts)
    labels = torch.where(torch.arange(n) < counts[0], 1, 2)
    points = 100 * normal(n, 3)
    if planar:
        points[..., 2] = torch.where(labels == 2, 0.3 * points[..., 0], points[..., 2])
    rotations = torch.linalg.qr(0.3 * normal(2, 3, 3) + torch.eye(3).double()).Q  # of either body, to view 2
    places = 300 + 60 * normal(2, 2, 1, 2)
    first = points[..., :2] + places[..., 0, labels - 1, 0, :]
    both = points[..., None, :, :] @ rotations[..., :2] + places[..., 1, :, :, :]
    second = torch.where((labels == 1)[:, None], both[..., 0, :, :], both[..., 1, :, :])
    # the columns a, b, c of a camera's rotation: x2 = a x + b y + c z; what is across c does not depend on z
    across = torch.stack([rotations[..., 2, 1], -rotations[..., 2, 0]], -1)
    back = -(across[..., None, :] @ rotations[..., :2, :2].mT)[..., 0, :]
    offset = -(across * places[..., 1, :, 0, :]).sum(-1) - (back * places[..., 0, :, 0, :]).sum(-1)
    matrices = points.new_zeros(*batch, 2, 3, 3)
    matrices[..., :2, 2], matrices[..., 2, :2], matrices[..., 2, 2] = across, back, offset
    noise = [sigma * normal(n, 2) for _ in range(2)]
    return first + noise[0], second + noise[1], labels.expand(*batch, n), matrices


def wrong(found, true):
    error = (found != true).double().mean(-1)
    return torch.minimum(error, 1 - error)


@pytest.mark.slow
@pytest.mark.parametrize("counts", [(7, 7), (10, 4), (9, 5), (4, 10), (60, 20)])
def test_exact_bodies_at_minimal_counts_too(counts):
    x1, x2, labels, matrices = bodies(100, counts=counts)
    found = affine_segmentation(x1, x2)
    assert wrong(found.labels, labels).max() == 0
    assert found.residuals.max() < 1e-9
    assert found.degenerate.double().mean() < 0.02  # unlucky points
    order = (found.labels[:, :1] - 1) ^ torch.tensor([[0, 1]])
    swapped = found.fundamentals.take_along_dim(order[..., None, None], dim=1)
    assert relative_error(swapped, matrices).median() < 1e-10
    value = torch.einsum("bni,bkij,bnj->bkn", homogeneous(x2), found.fundamentals, homogeneous(x1))
    assert value.abs().amin(1).max() < 1e-8
    assert (found.fundamentals[..., :2, :2] == 0).all()
    torch.testing.assert_close(torch.linalg.matrix_norm(found.fundamentals), torch.ones(100, 2).double())


@pytest.mark.parametrize(("counts", "rank"), [((7, 7), 14), ((10, 4), 14), ((9, 5), 14), ((4, 10), 14), ((12, 2), 12)])
def test_ranks_of_the_quadric(counts, rank):
    x1, x2, _, _ = bodies(counts=counts)
    match = torch.cat([(x - x.mean(0)) / x.std(0) for x in (x2, x1)], -1)
    z = homogeneous(match)
    row, column = torch.triu_indices(5, 5)
    values = torch.linalg.svdvals(z[:, row] * z[:, column])
    assert int((values > 1e-10 * values[0]).sum()) == rank
    assert bool(affine_segmentation(x1, x2).degenerate) == (rank < 14)


@pytest.mark.slow
@pytest.mark.parametrize(("n", "most"), [(14, 0.05), (60, 0.01)])
def test_noise(n, most):
    x1, x2, labels, _ = bodies(100, counts=(n // 2, n // 2), sigma=0.5)
    found = affine_segmentation(x1, x2)
    assert wrong(found.labels, labels).mean() < most
    if n == 60:  # of four noisy coordinates, one is across the hyperplane
        assert 0.4 < found.residuals.square().mean().sqrt() < 0.55


def test_missing_matches_weigh_nothing():
    x1, x2, labels, _ = bodies(counts=(15, 15))
    broken = x1.clone()
    broken[3, 0] = torch.nan
    weights = torch.ones(30).double()
    weights[20] = 0
    kept = [i for i in range(30) if i not in (3, 20)]
    found = affine_segmentation(broken, x2, weights)
    fewer = affine_segmentation(x1[kept], x2[kept])
    assert found.labels[[3, 20]].tolist() == [0, 0]
    assert found.residuals[[3, 20]].tolist() == [0, 0]
    assert wrong(found.labels[kept], labels[kept]) == 0
    torch.testing.assert_close(found.fundamentals, fewer.fundamentals)
    # a planar body is degenerate and alone, as nothing is
    flat1, flat2, _, _ = bodies(counts=(15, 15), planar=True)
    found = affine_segmentation(torch.stack([x1, flat1, x1 * torch.nan]), torch.stack([x2, flat2, x2]))
    assert found.degenerate.tolist() == [False, True, True]
    assert found.fundamentals.isfinite().all()


def test_batch_equals_loop_and_dtype_is_kept():
    x1, x2, _, _ = bodies(2, 3, sigma=0.3)
    found = affine_segmentation(x1, x2)
    for i in range(2):
        for j in range(3):
            one = affine_segmentation(x1[i, j], x2[i, j])
            torch.testing.assert_close(found.fundamentals[i, j], one.fundamentals)
            assert torch.equal(found.labels[i, j], one.labels)
            # residuals are the distances in the image pair
            distance = sampson_squared(one.fundamentals, x1[i, j], x2[i, j]).sqrt()
            torch.testing.assert_close(found.residuals[i, j], distance.gather(0, one.labels[None] - 1)[0])
    small = affine_segmentation(x1.float(), x2.float())
    assert small.fundamentals.dtype == small.residuals.dtype == torch.float32
    assert wrong(small.labels, found.labels).max() < 0.05


def test_gradients():
    x1, x2, _, _ = bodies(counts=(12, 12), sigma=0.5)
    x1, x2 = x1 / 100 - 3, x2 / 100 - 3
    points = (x1.requires_grad_(), x2.requires_grad_())
    assert torch.autograd.gradcheck(lambda *x: affine_segmentation(*x).residuals, points, fast_mode=True)


def test_misuse():
    x1, x2, _, _ = bodies(counts=(7, 6))
    for given, words in (
        ((x1, x2), "take 14 matches, got 13: add 1"),
        ((x1, x2[:-1]), "of one shape"),
        ((x1.numpy(), x2.numpy()), r"x1 must be a torch.Tensor, got ndarray; use torch.as_tensor"),
        ((x1, x2, [1.0] * 13), r"weights must be a torch.Tensor, got list"),
    ):
        with pytest.raises(ValueError, match=words):
            affine_segmentation(*given)

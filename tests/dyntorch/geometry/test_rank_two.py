"""3 x 3 cofactors and null vectors: against inverses and singular vectors; pixels, noise, rank below two, gradients."""

import pytest
import torch
from torch.nn.functional import normalize

from dyntorch.geometry.homogeneous import cofactors, null_vectors


def random(*shape, seed=0, dtype=torch.float64):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=dtype)


def rank_two(*batch, seed=0):
    return random(*batch, 3, 2, seed=seed) @ random(*batch, 2, 3, seed=seed + 1)


def angle(a, b):
    return torch.linalg.cross(normalize(a, dim=-1), normalize(b, dim=-1)).norm(dim=-1)


def test_cofactors_are_the_scaled_inverse_transpose():
    m = random(50, 3, 3)
    torch.testing.assert_close(cofactors(m), torch.linalg.det(m)[:, None, None] * torch.linalg.inv(m).mT)
    torch.testing.assert_close(cofactors(m[0] @ m[1]), cofactors(m[0]) @ cofactors(m[1]))


def test_null_vectors_of_rank_two():
    m = rank_two(200)
    left, right = null_vectors(m)
    assert (left[:, None] @ m).abs().max() < 1e-12
    assert (m @ right[..., None]).abs().max() < 1e-12
    torch.testing.assert_close(left.norm(dim=-1), torch.ones(200).double())
    torch.testing.assert_close(right.norm(dim=-1), torch.ones(200).double())


@pytest.mark.parametrize("noise", [1e-6, 1e-2, 0.1])
def test_noisy_matrices_give_the_smallest_singular_vectors(noise):
    m = rank_two(500) + noise * random(500, 3, 3, seed=9)
    u, s, vt = torch.linalg.svd(m)
    clear = s[:, 2] < 0.6 * s[:, 1]
    assert clear.sum() > 300
    left, right = null_vectors(m[clear])
    assert angle(left, u[clear][..., 2]).max() < 1e-9
    assert angle(right, vt[clear][:, 2]).max() < 1e-9


def test_units_of_the_coordinates_do_not_matter():
    # pixels beside the constant 1, exaggerated; the last singular value of such a matrix is known to 1e-4 of the middle one
    rows, columns = torch.tensor([1e-6, 1e-6, 1.0]).double(), torch.tensor([1.0, 1e6, 1e6]).double()
    m = rank_two(100)
    left, right = null_vectors(m)
    scaled_left, scaled_right = null_vectors(rows[:, None] * m * columns)
    for plain, scaled, unit in ((left, scaled_left, rows), (right, scaled_right, columns)):
        assert angle(plain, scaled * unit).max() < 1e-10


def test_rank_below_two_is_zero_and_does_not_touch_the_others():
    m = torch.stack([torch.zeros(3, 3), torch.ones(3, 3), rank_two(), torch.full((3, 3), torch.nan)]).double().requires_grad_()
    left, right = null_vectors(m)
    assert torch.equal(left[:2], torch.zeros(2, 3).double())
    assert torch.equal(right[:2], torch.zeros(2, 3).double())
    (left[:3].square().sum() + right[:3].sum()).backward()
    assert m.grad[:3].isfinite().all()
    torch.testing.assert_close(torch.stack([left[2], right[2]]), torch.stack(null_vectors(m[2])), rtol=0, atol=0)


def test_gradients():
    m = rank_two(3).requires_grad_()

    def projectors(m):
        return tuple(v[..., :, None] * v[..., None, :] for v in null_vectors(m))

    assert torch.autograd.gradcheck(projectors, m)
    assert torch.autograd.gradcheck(cofactors, m)


def test_wrong_shapes_are_refused():
    for function in (cofactors, null_vectors):
        with pytest.raises(ValueError, match=r"\(2, 4\)"):
            function(torch.zeros(2, 4))

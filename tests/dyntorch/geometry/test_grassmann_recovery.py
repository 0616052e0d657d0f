"""Candidate projections against the true ones: every profile, any order and scale, zeros; the balance; the known ambiguity."""

import pytest
import torch

from dyntorch.geometry.extensors import compound
from dyntorch.geometry.grassmann import balance_projections, candidates, grassmann_tensor, rotate_tensors, tables

CASES = [
    ((2, 1), (3, 3)),
    ((2, 2), (3, 3)),
    ((1, 1), (3, 3)),
    ((2, 2), (4, 4)),
    ((2, 1, 1), (3, 3, 3)),
    ((1, 1, 1, 1), (3, 3, 3, 3)),
    ((2, 2, 1), (3, 3, 3)),
    ((1, 2, 2), (3, 3, 3)),
    ((2, 1, 1, 1), (3, 3, 3, 3)),
    ((2, 2, 2), (3, 3, 3)),
    ((2, 2, 2), (4, 4, 4)),
    ((2, 2, 1, 1), (3, 3, 3, 3)),
    ((2, 2, 2, 1), (3, 3, 3, 3)),
    ((2, 2, 1, 1, 1), (3, 3, 3, 3, 3)),
    ((3, 3, 1), (4, 4, 4)),
    ((3, 3, 1), (4, 4, 3)),
    ((1, 1, 1, 1, 1, 1), (3, 3, 3, 3, 3, 3)),
]


def random(*shape, seed=0, dtype=torch.float64):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=dtype)


def scene(profile, sizes, *batch, seed=0):
    return [random(*batch, m, sum(profile), seed=seed + i) for i, m in enumerate(sizes)]


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


def distance(projections, tensor, profile):
    views = len(profile)
    found, target = grassmann_tensor(projections, profile).flatten(-views), tensor.flatten(-views)
    found, target = (x / x.norm(dim=-1, keepdim=True) for x in (found, target))
    cosine = (found * target).sum(-1, keepdim=True)
    return (found - cosine.sign() * target).norm(dim=-1)


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


def test_balanced_is_a_collineation_away():
    views = scene((2, 2, 1), (3, 3, 3), 4)
    parts = balance_projections([1e6 * views[0], views[1], 1e-3 * views[2]])
    assert relative(parts, views).max() < 1e-12
    for part in parts:
        torch.testing.assert_close(part.flatten(1).norm(dim=-1), torch.ones(4).double())
    zero = balance_projections([torch.zeros(1, 3, 5, dtype=torch.float64)] * 3)
    assert all((part == 0).all() for part in zero)


def test_rotated_is_the_tensor_of_rotated_images():
    profile, sizes = (3, 2, 1), (4, 3, 3)
    views, table = scene(profile, sizes, 5), tables(profile, sizes, 2, torch.device("cpu"))
    turned = grassmann_tensor([r[:, None] @ m for r, m in zip(table.rotations, views, strict=True)], profile)
    torch.testing.assert_close(rotate_tensors(grassmann_tensor(views, profile), table.compounds), turned)
    torch.testing.assert_close(table.compounds[0], compound(table.rotations[0], 3))
    assert tables(profile, sizes, 2, torch.device("cpu")) is table


def test_misuse():
    tensor = random(3, 3, 3)
    with pytest.raises(ValueError, match="profile must have 1 to m_i rows"):
        candidates(tensor, (2, 2, 4), (3, 3, 3))
    with pytest.raises(ValueError, match="profile must have 1 to m_i rows"):
        candidates(tensor, (2, 2), (3, 3, 3))
    with pytest.raises(ValueError, match="is floating point"):
        candidates(tensor, (2, 2, 2, 1), (3, 3, 3, 3))
    with pytest.raises(ValueError, match="is floating point"):
        candidates(tensor.long(), (2, 2, 1), (3, 3, 3))
    with pytest.raises(ValueError, match="tries"):
        candidates(tensor, (2, 2, 1), (3, 3, 3), tries=0)

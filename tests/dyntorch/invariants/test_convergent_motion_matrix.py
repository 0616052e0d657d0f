"""Static points and points on coplanar lines through a vertex: the form, its freedom, plane and vertex, which is which."""

import pytest
import torch

import dyntorch as dyn
from dyntorch.geometry.homogeneous import apply, homogeneous, skew
from dyntorch.invariants.convergent_motion_matrix import ConvergentMotionMatrix, plane_of
from dyntorch.invariants.fundamental_matrix import FundamentalMatrix
from dyntorch.invariants.segmentation_matrix import SegmentationMatrix
from dyntorch.metrics import relative_error
from dyntorch.scenes import convergent_motions
from tests.draws import random, seeded


def motion(*batch, seed=0):
    """A homography of order 1, an epipole and a vertex."""
    eye = torch.eye(3, dtype=torch.float64)
    return eye + 0.3 * random(*batch, 3, 3, seed=seed), random(*batch, 3, seed=seed + 1), random(*batch, 3, seed=seed + 2)


def value(matrix, x1, x2):
    return torch.einsum("...ni,...ij,...nj->...n", homogeneous(x2), matrix, homogeneous(x1))


@pytest.mark.parametrize("parallel", [False, True])
def test_scene_is_what_it_says(parallel):
    scene = convergent_motions(40, batch=5, parallel=parallel, generator=seeded())
    F, G = scene.motion
    H, e2 = (scene.extras[name] for name in ("homography", "epipole"))
    own = torch.where(scene.labels == 1, value(F, *scene.views), value(G, *scene.views))
    other = torch.where(scene.labels == 1, value(G, *scene.views), value(F, *scene.views))
    assert own.abs().max() < 1e-9 < other.abs().median()
    # what moves is not where the plane would take it
    assert (apply(H, scene.views[0]) - scene.views[1]).norm(dim=-1)[scene.labels == 2].min() > 0.1
    # the baseline is seen at the epipole: H and F are of one camera pair
    assert relative_error(skew(e2) @ H, F).max() < 1e-12


def test_product_is_that_of_both_forms():
    H, e2, v2 = motion(4)
    F, G = ConvergentMotionMatrix.factors(H, e2, v2)
    S = ConvergentMotionMatrix.compose(H, e2, v2)
    x1, x2 = random(4, 9, 2, seed=7), random(4, 9, 2, seed=8)
    row, column = torch.triu_indices(3, 3)
    nu1, nu2 = (homogeneous(x)[..., row] * homogeneous(x)[..., column] for x in (x1, x2))
    ratio = torch.einsum("bni,bij,bnj->bn", nu2, S, nu1) / (value(F, x1, x2) * value(G, x1, x2))
    torch.testing.assert_close(ratio, ratio[:, :1].expand_as(ratio))
    torch.testing.assert_close(torch.linalg.matrix_norm(S), torch.ones(4).double())
    # rank two, and the two ties
    v1, v = ConvergentMotionMatrix.vertices(H, v2)
    e1 = ConvergentMotionMatrix.vertices(H, e2)[0]
    assert torch.linalg.svdvals(G)[:, 2].max() < 1e-15
    assert max((G @ v1[..., None]).abs().max(), (G.mT @ v[..., None]).abs().max()) < 1e-14
    for point2, matrix, point1 in ((v2, F, v1), (e2, G, e1)):
        assert torch.einsum("bi,bij,bj->b", point2, matrix, point1).abs().max() < 1e-14
    # nothing in the product says which is which
    torch.testing.assert_close(S, ConvergentMotionMatrix.compose(H, v2, e2))


def test_two_matrices_with_both_ties_share_a_homography():
    # not composed of one: F of rank two, then a vertex pair on its epipolar lines, then G within three conditions
    u, s, vt = torch.linalg.svd(random(10, 3, 3))
    F = u[..., :2] * s[:, None, :2] @ vt[:, :2]
    e2, e1 = u[..., 2], vt[:, 2]
    v1 = random(10, 3, seed=1)
    v2 = torch.linalg.cross((F @ v1[..., None])[..., 0], random(10, 3, seed=2))
    left, right = (torch.linalg.svd(v[:, None]).Vh[:, 1:] for v in (v2, v1))
    tie = ((left @ e2[..., None]) * (right @ e1[..., None]).mT).flatten(1)
    within = torch.linalg.svd(tie[:, None]).Vh[:, 1:]
    G = left.mT @ (random(10, 1, 3, seed=3) @ within).reshape(10, 2, 2) @ right
    H = plane_of(F, G)
    assert relative_error(skew(e2) @ H, F).max() < 1e-10
    assert relative_error(skew(v2) @ H, G).max() < 1e-10
    assert torch.linalg.det(H).abs().min() > 1e-6


def test_decompose_returns_the_motion_in_either_order():
    H, e2, v2 = motion(50)
    found = ConvergentMotionMatrix.decompose(ConvergentMotionMatrix.compose(H, e2, v2))
    assert relative_error(found[0], H).max() < 1e-7
    straight = torch.maximum(relative_error(found[1], e2, dims=1), relative_error(found[2], v2, dims=1))
    swapped = torch.maximum(relative_error(found[1], v2, dims=1), relative_error(found[2], e2, dims=1))
    assert torch.minimum(straight, swapped).max() < 1e-8
    failed = ConvergentMotionMatrix.decompose(torch.zeros(2, 6, 6))
    assert all((part == 0).all() and part.dtype == torch.float32 for part in failed)


@pytest.mark.parametrize(("parallel", "n"), [(False, 35), (False, 60), (True, 60)])
def test_exact_matches_give_plane_vertex_and_epipole(parallel, n):
    scene = convergent_motions(n, batch=20, parallel=parallel, generator=seeded(1))
    solution = dyn.fit(ConvergentMotionMatrix, *scene.views)
    assert solution.status.eq(dyn.Status.OK).double().mean() >= 0.95
    K = scene.extras["calibration"]
    H, e2, v2, gap = ConvergentMotionMatrix.static_first(*solution.motion, K, K)
    good = solution.status == dyn.Status.OK
    for found, name in ((H, "homography"), (e2[..., None], "epipole"), (v2[..., None], "vertex")):
        true = scene.extras[name] if found.shape[-1] == 3 else scene.extras[name][..., None]
        assert relative_error(found, true)[good].median() < 1e-10
        assert relative_error(found, true)[good].max() < 1e-5
    assert (gap[good] > 1e-3).all()
    v1 = ConvergentMotionMatrix.vertices(H, v2)[0]
    assert relative_error(v1, torch.linalg.solve(scene.extras["homography"], scene.extras["vertex"]), dims=1)[good].max() < 1e-5
    F, G = ConvergentMotionMatrix.factors(H, e2, v2)
    if n > 35:
        assert torch.equal(SegmentationMatrix.labels(F, G, *scene.views), scene.labels)


def test_true_parameters_are_better_than_the_linear_ones_under_noise():
    scene = convergent_motions(200, batch=8, sigma=0.3, generator=seeded(1))
    solution = dyn.fit(ConvergentMotionMatrix, *scene.views)
    for _ in range(4):
        weights = SegmentationMatrix.reweight(solution.tensor, *scene.views)
        solution = dyn.fit(ConvergentMotionMatrix, *scene.views, weights=weights)
    refined = dyn.refine(solution, *scene.views, weights=torch.ones(8, 200).double())
    before, after = (relative_error(s.motion[0], scene.extras["homography"]).median() for s in (solution, refined))
    assert after < 0.8 * before
    K = scene.extras["calibration"]
    F, G = ConvergentMotionMatrix.factors(*ConvergentMotionMatrix.static_first(*refined.motion, K, K)[:3])
    assert (SegmentationMatrix.labels(F, G, *scene.views) != scene.labels).double().mean() < 0.03


def test_a_camera_that_travels_along_the_lines_is_degenerate():
    H, e2, _ = motion()
    x1 = random(80, 2, seed=3)
    x2 = apply(H, x1)
    p = homogeneous(x2) + random(80, 1, seed=4) * e2 / e2[2]  # static and moving alike: on lines through the epipole
    good = p[:, 2].abs() > 0.2
    solution = dyn.fit(ConvergentMotionMatrix, x1[good], (p[:, :2] / p[:, 2:])[good])
    assert solution.status == dyn.Status.DEGENERATE
    plane = plane_of(*[FundamentalMatrix.compose(H, e2)] * 2)
    assert plane.isfinite().all()


def test_batch_equals_loop_and_gradients():
    H, e2, v2 = motion(2, 3)
    S = ConvergentMotionMatrix.compose(H, e2, v2)
    found = ConvergentMotionMatrix.decompose(S)
    for i in range(2):
        for j in range(3):
            for part, one in zip(found, ConvergentMotionMatrix.decompose(S[i, j]), strict=True):
                torch.testing.assert_close(part[i, j], one)
    F, G = (m.clone().requires_grad_() for m in ConvergentMotionMatrix.factors(*motion(2, seed=5)))
    assert torch.autograd.gradcheck(plane_of, (F, G))

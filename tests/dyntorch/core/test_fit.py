"""fit(): statuses, spectrum and uncertainty, hard conditioning, blocks; what holds for every invariant is in the battery."""

from __future__ import annotations

from copy import copy
from dataclasses import replace

import pytest
import torch

import dyntorch as dyn
from dyntorch import metrics, scenes
from dyntorch.core import fit as fitting
from dyntorch.core.outcome import Status
from dyntorch.core.solution import Solution
from dyntorch.geometry.rigid import rotation_exponential
from tests.battery.cases import CASES, moved_views
from tests.battery.references import apart, matrices, noisy, spans
from tests.battery.steps import equal_steps
from tests.draws import seeded


@pytest.mark.parametrize("case", CASES, ids=repr)
def test_singular_values_are_those_of_the_normalized_rows(case):
    """Down to the rounding of the largest one, also of fewer rows than columns."""
    n = case.minimal + 3
    views = noisy(case, case.scene(n).exact, 1e-3)
    solution = dyn.fit(case.invariant, *views)
    frames = tuple(t[0, 0] if case.invariant.copies else t[0] for t in solution.normalization.transforms)
    found = solution.singular_values if case.invariant.copies else solution.singular_values[None]
    assert found.shape[-1] == case.invariant.width() and (found.diff(dim=-1) <= 0).all()
    if case.invariant.copies:
        return  # the cameras of normalized points have been given orthonormal rows
    moved = moved_views(case.invariant, views, frames)
    invariant = copy(case.invariant)
    # what is least squares is said by the primitives of normalized coordinates
    vars(invariant)["primitives"] = tuple(p.normalize(t) for p, t in zip(invariant.primitives, frames, strict=True))
    matrix = matrices(replace(case, invariant=invariant), moved)[0]
    values = torch.linalg.svdvals(matrix)
    values = torch.nn.functional.pad(values, (0, case.invariant.width() - len(values)))
    torch.testing.assert_close(found[0], values, rtol=1e-9, atol=1e-13 * float(values[0]))


H, J, CV, L = dyn.HomographyTensor, dyn.JoinTensor, dyn.ConstantVelocityTensor, dyn.TranslatingLinesMatrix
LOWER_RANK = (
    (H, scenes.planar, {"n": 60, "static": 0.9}, ()),
    (J, scenes.moving_points, {"n": 100, "static": 0.8}, ()),
    *((CV, scenes.constant_velocity, {"n": 60, "velocities": kind}, (1e-4, 2e-3, 1e-2)) for kind in ("planar", "linear", "equal")),
    *((L, scenes.translating_lines, {"n": 90, "motion": kind}, (2e-3,)) for kind in ("translation", "objects")),
)


@pytest.mark.parametrize(("kind", "make", "options", "sigmas"), LOWER_RANK)
def test_scenes_of_lower_rank_are_degenerate_and_with_noise_ambiguous(kind, make, options, sigmas):
    exact = dyn.fit(kind, *make(**options, batch=4, generator=seeded()).views)
    assert (exact.status == Status.DEGENERATE).all() and exact.tensor.abs().max() == 0
    for sigma in sigmas:
        noisy_views = make(**options, batch=4, sigma=sigma, generator=seeded()).views
        assert (dyn.fit(kind, *noisy_views).status == Status.AMBIGUOUS).sum() >= 3


@pytest.mark.parametrize("still", [0.0, 0.4, 1.0])
def test_points_with_noise_determine_the_homographies_however_many_stand_still(still):
    """Static points are singular points of the true tensor: the spurious ones have residuals of first order (thesis 2; theory)."""
    scene = scenes.planar(100, static=still, sigma=0.5, batch=20, generator=seeded())
    solution = dyn.fit(dyn.HomographyTensor, *scene.views)
    assert (solution.status == Status.OK).all()
    error = metrics.grid_transfer_error(solution.motion[0], scene.motion[0], 640, 480)
    assert error.median() < 1.5


@pytest.mark.parametrize("case", CASES, ids=repr)
def test_uncertainty_is_the_size_of_the_error(case):
    """Of the normalized tensor, over many scenes, within a factor of two."""
    scene = case.scene(2 * case.minimal + 20, batch=(40,))
    solution = dyn.fit(case.invariant, *noisy(case, scene.exact, case.noise))
    exact = dyn.fit(case.invariant, *scene.exact)
    # the exact tensor in the normalized coordinates of the noisy matches
    frames = solution.normalization.transforms
    moved = moved_views(case.invariant, scene.exact, tuple(t[:, 0] for t in frames) if case.invariant.copies else frames)
    if case.invariant.copies:
        third = solution.normalization.primitives[2]
        rows = [dyn.fit(type(case.invariant)(third.cameras[b]), *(x[b] for x in moved), normalize=False).tensor for b in range(40)]
        true = torch.stack(rows)
    else:
        true = dyn.fit(case.invariant, *moved, normalize=False).tensor
    a, b = spans(case, solution.normalized), spans(case, true)
    a = torch.linalg.qr(a.mT)[0].mT
    error = torch.linalg.matrix_norm(a - (a @ b.mT) @ b).reshape(40, -1).square().mean(-1).sqrt()
    ratio = (error / case.nullity**0.5 / solution.uncertainty).median()
    assert 0.4 < ratio < 2.0
    assert (exact.uncertainty < 1e-5).all()


@pytest.mark.parametrize("step", [1.0, 0.01])
def test_small_motions_keep_their_digits(step):
    """The second smallest singular value falls with the motion: a Gram alone would lose twice as many digits."""
    scene = scenes.planar(60, step=(step, 3 * step), batch=8, generator=seeded())
    solution = dyn.fit(dyn.HomographyTensor, *scene.exact)
    assert (solution.status == Status.OK).all()
    gap = solution.singular_values[:, 25] / solution.singular_values[:, 0]
    assert gap.max() < 1e-2 * step
    bound = 1e4 * torch.finfo(torch.float64).eps / gap
    assert (metrics.relative_error(solution.motion[0], scene.motion[0]) < bound).all()


def test_far_away_coordinates_cost_only_their_rounding():
    scene = scenes.moving_points(100, batch=4, generator=seeded())
    far = [x + 1e4 for x in scene.exact]
    shift = torch.eye(4).double()
    shift[:3, 3] = 1e4
    solution = dyn.fit(dyn.JoinTensor, *far)
    back = torch.linalg.inv(shift) @ solution.motion[0] @ shift
    assert metrics.relative_error(back, scene.motion[0]).max() < 1e-7


@pytest.mark.parametrize("case", CASES, ids=repr)
def test_blocks_are_one_batch(case, monkeypatch):
    views = noisy(case, case.scene(case.minimal + 5, batch=(9,)).exact, 1e-3)
    whole = dyn.fit(case.invariant, *views)
    monkeypatch.setattr(fitting, "BLOCK", 1)
    single = dyn.fit(case.invariant, *views)
    assert apart(case, whole.tensor, single.tensor) < 1e-9
    torch.testing.assert_close(whole.uncertainty, single.uncertainty, rtol=1e-6, atol=1e-12)


def test_solution_reads_well_and_complains_clearly():
    x1, x2 = scenes.collineation(2, 6, batch=(2, 6), generator=seeded()).views
    good = dyn.fit(dyn.Collineation(2), x1, x2)
    assert good.check() is good and isinstance(good, Solution)
    assert repr(good) == "Solution(Collineation(n=2), matches=6, batch=(2, 6): 12 OK)"
    x1[0] = torch.nan
    x1[1, :4] = torch.nan
    bad = dyn.fit(dyn.Collineation(2), x1, x2)
    assert repr(bad) == "Solution(Collineation(n=2), matches=6, batch=(2, 6): 2 OK, 10 TOO_FEW)"
    with pytest.raises(ValueError, match=r"Collineation\(n=2\): problem 0, 1, 2, 3, 4, 5, 6, 7, \.\.\. of 12: TOO_FEW; give more"):
        bad.check()
    with pytest.raises(ValueError, match="the problem: TOO_FEW"):
        dyn.fit(dyn.Collineation(2), x1[0, 0], x2[0, 0]).check()
    assert repr(dyn.fit(dyn.Collineation(2), x1[:, :0], x2[:, :0])).endswith("batch=(2, 0): empty)")


# A tensor that only noise singles out is not called certain, and one that the matches decide is.


RIGID = (("objects", {"objects": 1}, Status.AMBIGUOUS), ("in_plane", {}, Status.OK))


@pytest.mark.parametrize(("motion", "options", "status"), RIGID)
def test_one_rigid_body_is_ambiguous_however_clear_the_gap_and_general_motion_is_certain(motion, options, status):
    # rank 20 of 36: the noise lifts 15 null directions by its first order and one by its second, and that one is not the truth
    scene = scenes.translating_lines(80, batch=6, sigma=0.005, motion=motion, generator=seeded(), **options)
    solution = dyn.fit(dyn.TranslatingLinesMatrix, *scene.views)
    values, error = solution.singular_values, metrics.relative_error(solution.motion[0], scene.motion[0])
    assert (solution.status == status).all() and ((error < 0.1) == (status == Status.OK)).all()
    assert status == Status.OK or (values[..., -1] < 0.1 * values[..., -2]).all()  # the ratio looks healthy


def test_very_many_matches_are_judged_by_a_part_of_them():
    scene = scenes.constant_velocity(5000, sigma=1e-3, velocities="planar", generator=seeded(2))
    assert dyn.fit(dyn.ConstantVelocityTensor, *scene.views).status == Status.AMBIGUOUS


@pytest.mark.parametrize("still", [0.0, 0.1])
def test_equal_steps_leave_a_family_of_cameras(still):
    # at constant velocity all is as straight from a camera that moves along at any velocity: four tensors, not one
    views = equal_steps(80, still=still, generator=seeded(3))
    assert dyn.fit(dyn.HomographyTensor, *views).status == Status.AMBIGUOUS
    draw = seeded(4)
    assert dyn.robust_fit(dyn.HomographyTensor, *views, threshold=1.5, generator=draw).status == Status.AMBIGUOUS


@pytest.mark.parametrize(("depth", "shift"), [(0.01, 0.5), (1.0, 1e-3)])
def test_nearly_degenerate_views_are_certain_without_noise_and_not_with_it(depth, shift):
    # exact numbers decide: nearly a plane, or hardly a translation, is not a plane or a rotation
    draw = seeded(6)
    points = torch.randn(40, 3, generator=draw, dtype=torch.float64) * torch.tensor([1.0, 1.0, depth], dtype=torch.float64)
    points = points + torch.tensor([0.0, 0.0, 5.0], dtype=torch.float64)
    turn = rotation_exponential(torch.tensor([0.0, 0.1, 0.0], dtype=torch.float64))
    moved = points @ turn.mT + shift * torch.tensor([1.0, 0.3, 0.2], dtype=torch.float64)
    x1, x2 = (800 * x[:, :2] / x[:, 2:] for x in (points, moved))
    exact = dyn.fit(dyn.FundamentalMatrix, x1, x2)
    assert exact.status == Status.OK and dyn.sampson(dyn.FundamentalMatrix, exact.tensor, x1, x2).abs().max() < 1e-6
    noise = 0.5 * torch.randn(2, 40, 2, generator=draw, dtype=torch.float64)
    assert dyn.fit(dyn.FundamentalMatrix, x1 + noise[0], x2 + noise[1]).status == Status.AMBIGUOUS

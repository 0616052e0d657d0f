"""Robust estimation: wrong matches are found, chance is not believed, and the problems of a batch do not disturb each other."""

from __future__ import annotations

import math
from functools import partial
from math import comb, log
from typing import Any

import pytest
import torch
from torch import Tensor

import dyntorch as dyn
from dyntorch import Status, scenes
from dyntorch.core import consensus
from dyntorch.core.consensus import Search, anneal, evidence_and_doubt, msac
from dyntorch.core.invariant import Invariant
from dyntorch.core.matches import matches
from dyntorch.core.matrix import estimation_matrix
from dyntorch.core.normalize import denormalize
from dyntorch.core.residual import multilinear
from dyntorch.scenes.scene import OUTLIER
from tests.battery.cases import CASES as KNOWN
from tests.battery.cases import Case
from tests.draws import seeded
from tests.grid import assert_refused


def planar(batch: int | tuple[int, ...] = (), outliers: float = 0.4, n: int = 120, **more: Any) -> scenes.Scene:
    return scenes.planar(n, batch=batch, sigma=0.5, outliers=outliers, generator=seeded(1), **more)


def judge_fit(scene: scenes.Scene, solution: dyn.Solution) -> tuple[Tensor, Tensor]:
    """RMS distance of the exact true matches, and the share of the true matches kept, per problem."""
    right = scene.labels != OUTLIER
    clean = dyn.sampson(solution.invariant, solution.tensor, *scene.exact)
    assert solution.inliers is not None
    count = right.sum(-1)
    return ((clean.square() * right).sum(-1) / count).sqrt(), (solution.inliers & right).sum(-1) / count


def test_inliers_are_the_matches_within_the_threshold_and_polish_improves() -> None:
    scene, errors = planar(batch=8, outliers=0.3), []
    for polish in (True, False):
        solution = dyn.robust_fit(dyn.HomographyTensor, *scene.views, threshold=1.5, polish=polish)
        assert solution.inliers is not None
        assert torch.equal(solution.inliers, dyn.sampson(dyn.HomographyTensor, solution.tensor, *scene.views) <= 1.5)
        errors.append(float(judge_fit(scene, solution)[0].mean()))
    assert errors[0] < errors[1]


def test_one_threshold_per_problem() -> None:
    scene = planar(batch=2)
    views = tuple(x * torch.tensor([1.0, 0.01], dtype=x.dtype)[:, None, None] for x in scene.views)
    solution = dyn.robust_fit(dyn.HomographyTensor, *views, threshold=torch.tensor([1.5, 0.015], dtype=torch.float64))
    assert solution.inliers is not None
    assert solution.sigma is not None
    both = dyn.robust_fit(dyn.HomographyTensor, *(x[:1].expand(2, -1, -1) for x in scene.views), threshold=1.5)
    assert both.inliers is not None
    assert torch.equal(solution.inliers[0], both.inliers[0])
    assert bool(((solution.sigma / torch.tensor([0.5, 0.005])) - 1).abs().max() < 0.25)


@pytest.mark.slow
@pytest.mark.parametrize("case", KNOWN, ids=repr)
def test_estimated_threshold_for_every_invariant(case: Case) -> None:
    scale = case.units[0] if case.units else 1.0
    share = min(0.2, case.outliers)
    made = case.scene(max(120, 5 * case.minimal), batch=2, seed=41, outliers=share, sigma=case.noise / scale)
    solution = dyn.robust_fit(case.invariant, *made.views, generator=seeded())
    right = made.labels != OUTLIER
    assert solution.inliers is not None
    assert solution.sigma is not None
    assert solution.status.tolist() == [Status.OK, Status.OK]
    assert bool(((solution.inliers & right).sum(-1) >= 0.9 * right.sum(-1)).all())
    assert bool(((solution.sigma / shown_noise(case, made) - 1).abs() < 0.25).all())


def shown_noise(case: Case, made: scenes.Scene) -> Tensor:
    """The noise of one coordinate that the true matches show under the true motion."""
    tensor = case.invariant.compose(*made.motion)
    square = dyn.sampson(case.invariant, tensor, *made.views).square() / case.invariant.codim
    right = made.labels != OUTLIER
    return ((square * right).sum(-1) / right.sum(-1)).sqrt()


def test_several_slots_of_hyperplanes_have_distances_right_in_the_mean() -> None:
    """Against the pseudo-inverse of the whole covariance of the eight rows, which the motion makes of rank four."""
    made = scenes.planar(400, sigma=0.3, static=1.0, generator=seeded(8))
    invariant = dyn.DualHomographyTensor("points")
    search = Search(invariant, matches(invariant, made.views), seeded())
    work = search._bundle(search.searched)
    basis = work.first(search.weights[:, None])
    square = work.distances(basis)[0][0, 0] / search.unit**2
    assert float(square.mean()) == pytest.approx(4 * 0.3**2, rel=0.1)
    exact = dyn.sampson(invariant, invariant.compose(*made.motion), *made.views).square()
    assert float(torch.corrcoef(torch.stack([square, exact]))[0, 1]) > 0.8


@pytest.mark.slow
def test_random_matches_have_no_consensus() -> None:
    for invariant in (dyn.HomographyTensor(), dyn.FundamentalMatrix(), dyn.Collineation(2)):
        views = [500 * torch.rand(3, 80, 2, generator=seeded(v), dtype=torch.float64) for v in range(len(invariant.primitives))]
        solution = dyn.robust_fit(invariant, *views, threshold=1.5, starts=(1, 4), generator=seeded())
        assert solution.status.tolist() == [Status.NO_CONSENSUS] * 3
        assert float(solution.tensor.flatten(1).norm(dim=-1).min()) > 0.99


def test_evidence_is_the_expected_number_of_chance_finds() -> None:
    scene = planar(batch=1, outliers=0.2, n=60)
    data = matches(dyn.HomographyTensor(), scene.views)
    search = Search(dyn.HomographyTensor(), data, None)
    work = search._bundle(search.searched)
    limit = (1.5 * search.unit).square()
    basis = anneal(work, work.first(search.weights[:, None]), limit, 30)
    square = work.distances(basis)[0][:, 0]
    evidence, _ = evidence_and_doubt(work, basis, square, limit)
    n, m, k = 60, 26, int((square <= limit).sum())
    tensor = basis[0, 0, 0].unflatten(-1, (3, 3, 3))
    hits, trials = 0, 0
    for j in range(4):
        shift = (2 * j + 1) * n // 24
        mixed = search.norm.apply(work.invariant, [x.roll(v * shift, -2) for v, x in enumerate(scene.views)])
        hits, trials = hits + int((multilinear(work.invariant, tensor, mixed, work.scales).square() <= limit).sum()), trials + n
    expected = log(n - m) + log(comb(n, k)) + log(comb(k, m)) + (k - m) * log((hits + 1) / (trials + 1))
    assert float(evidence) == pytest.approx(expected, rel=1e-9)
    square, weights = torch.tensor([[[0.0, 2.0, 100.0]]]), torch.tensor([[1.0, 0.5, 2.0]])
    assert msac(square, weights, torch.tensor([4.0])).tolist() == [[0.25 + 2.0]]  # the weight lost


@pytest.mark.parametrize(
    ("invariant", "scene"),
    [
        (dyn.HomographyTensor(), planar(batch=2)),
        (dyn.FundamentalMatrix(), scenes.two_view(60, batch=2, sigma=0.5, generator=seeded())),
        (dyn.Collineation(3), scenes.collineation(3, 60, batch=2, sigma=0.01, generator=seeded())),
    ],
    ids=lambda v: repr(v)[:20],
)
def test_starts_are_linear_fits_and_distances_are_sampson(invariant: Invariant, scene: scenes.Scene) -> None:
    data = matches(invariant, scene.views)
    search = Search(invariant, data, seeded())
    work = search._bundle(search.searched)
    chosen = search._samples(torch.arange(2), 3)[:, :3]
    basis = work.first(chosen)
    square, _ = work.distances(basis)
    widths = tuple(p.width for p in invariant.primitives)
    for k in range(3):
        tensor = basis[:, 0, k, 0].unflatten(-1, widths).permute(0, *(1 + v for v in invariant.axes()))
        there = dyn.sampson(invariant, denormalize(invariant, tensor, search.norm.actions), *scene.views)
        assert torch.allclose(square[:, k].sqrt() / search.unit[:, None], there, rtol=1e-6, atol=1e-8)
        points = [x[:, 0] for x, p in zip(search.searched.views, invariant.primitives, strict=True) if p.rows == 1]
        unit = math.prod((1 + x.square().sum(-1) for x in points), start=torch.ones(()))
        rows = estimation_matrix(search.norm.primitives, [x[:, 0] for x in search.searched.views], chosen[:, k] / unit)
        null = torch.linalg.svd(rows.double()).Vh[:, -1]
        assert torch.allclose((null * basis[:, 0, k, 0]).sum(-1).abs(), torch.ones(2, dtype=null.dtype), atol=1e-7)


def test_statuses_of_what_the_data_lack() -> None:
    views = [torch.stack(pair) for pair in zip(planar().views, planar(outliers=0.0, static=1.0).exact, strict=True)]
    few = torch.ones(3, 120, dtype=torch.float64)
    few[2, 20:] = 0
    views = [torch.cat([x, x[:1]]) for x in views]
    solution = dyn.robust_fit(dyn.HomographyTensor, *views, threshold=1.5, weights=few)
    assert solution.status.tolist() == [Status.OK, Status.DEGENERATE, Status.TOO_FEW]
    assert float(solution.tensor[1:].abs().max()) == 0
    assert solution.inliers is not None
    assert not bool(solution.inliers[1:].any())


def test_missing_matches_and_gross_outliers() -> None:
    scene = planar(outliers=0.2)
    views = [x.clone() for x in scene.views]
    views[0][:5] = torch.nan
    views[2][5:8] = 1e9
    solution = dyn.robust_fit(dyn.HomographyTensor, *views, threshold=1.5)
    assert int(solution.status) == Status.OK
    assert solution.inliers is not None
    assert not bool(solution.inliers[:8].any())
    right = scene.labels[8:] != OUTLIER
    assert float(solution.inliers[8:][right].double().mean()) > 0.95


def test_results_repeat_and_follow_the_generator() -> None:
    scene = scenes.two_view(100, batch=2, sigma=0.5, outliers=0.5, generator=seeded(4))
    one, two = (dyn.robust_fit(dyn.FundamentalMatrix, *scene.views, threshold=1.5, generator=seeded(7)) for _ in range(2))
    assert torch.equal(one.tensor, two.tensor)
    state = torch.random.get_rng_state()
    dyn.robust_fit(dyn.FundamentalMatrix, *scene.views, threshold=1.5, generator=seeded(7))
    assert torch.equal(state, torch.random.get_rng_state())


def test_more_matches_than_are_searched() -> None:
    scene = scenes.collineation(2, 1500, sigma=0.002, outliers=0.4, generator=seeded(5))
    solution = dyn.robust_fit(dyn.Collineation(2), *scene.views, threshold=0.007, generator=seeded())
    rms, kept = judge_fit(scene, solution)
    assert float(rms) < 0.001
    assert float(kept) > 0.97


def test_shapes_and_precision() -> None:
    scene = planar(batch=(2, 1), outliers=0.2).to(torch.float32)
    solution = dyn.robust_fit(dyn.HomographyTensor, *(x.requires_grad_() for x in scene.views), threshold=1.5)
    assert solution.tensor.dtype == torch.float32
    assert not solution.tensor.requires_grad
    assert solution.inliers is not None
    assert (solution.tensor.shape, solution.status.shape, solution.inliers.shape) == ((2, 1, 3, 3, 3), (2, 1), (2, 1, 120))
    empty = dyn.robust_fit(dyn.HomographyTensor, *(x[:0] for x in scene.views), threshold=1.5)
    assert empty.tensor.shape == (0, 1, 3, 3, 3)


def test_misuse_is_named() -> None:
    fit, views = partial(dyn.robust_fit, dyn.HomographyTensor), planar().views
    assert_refused(
        *((lambda t=t: fit(*views, threshold=t), f"threshold must be a distance > 0 .*, got {t}") for t in (-1.0, math.inf)),
        (lambda: fit(*views, threshold=torch.ones(3)), r"threshold must be a number or \(\*batch,\)"),
        (lambda: fit(*views, threshold=1.5, starts=()), "starts must be numbers"),
        (lambda: fit(*(x[:20] for x in views), threshold=1.5), "needs at least 26 matches, got 20"),
    )


@pytest.mark.parametrize("case", KNOWN, ids=repr)
@pytest.mark.parametrize("threshold", [None, 1.0])
def test_no_problems_give_an_empty_solution(case: Case, threshold: float | None) -> None:
    views = [x[:0] for x in case.scene(case.minimal, batch=(2,)).views]
    solution = dyn.robust_fit(case.invariant, *views, threshold=threshold)
    assert solution.check() is solution and solution.tensor.shape[0] == 0
    assert solution.inliers is not None and solution.inliers.shape == (0, case.minimal)
    assert solution.sigma is not None and solution.sigma.shape == (0,)


@pytest.mark.parametrize("threshold", [None, 0.1])
def test_covariance_of_what_fails_is_never_nan(threshold: float | None) -> None:
    exact = scenes.two_view(30, generator=seeded(1)).views
    equal = [x[:1].expand_as(x) for x in exact]
    line = [x[:1] + torch.linspace(0, 9, 30)[:, None].to(x) * (x[1:2] - x[:1]) for x in exact]
    views = [torch.stack(pair) for pair in zip(equal, line, strict=True)]
    solution = dyn.robust_fit(dyn.FundamentalMatrix, *views, threshold=threshold, generator=seeded(0))
    assert (solution.status != Status.OK).all()
    assert solution.covariance is not None and not solution.covariance.isnan().any()
    failed = (solution.status == Status.DEGENERATE) | (solution.status == Status.TOO_FEW)
    assert (solution.covariance[failed] == 0).all()


@pytest.fixture
def counts(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """How many starts each round of a search has."""
    found: list[int] = []
    solve = Search._solve
    monkeypatch.setattr(Search, "_solve", lambda self, where, cut, count: found.append(count) or solve(self, where, cut, count))
    return found


def test_too_few_matches_with_weight_are_not_searched(counts: list[int]) -> None:
    views = scenes.planar(60, generator=seeded()).views
    solution = dyn.robust_fit(dyn.HomographyTensor, *views, threshold=1.0, weights=torch.zeros(60).double())
    assert int(solution.status) == Status.TOO_FEW and counts == [1]


@pytest.mark.slow
def test_more_starts_are_not_tried_where_a_quarter_of_them_agree(counts: list[int], monkeypatch: pytest.MonkeyPatch) -> None:
    """A tight bound leaves doubt whatever is found; what most of 16 starts find, 256 would find again."""
    monkeypatch.setattr(consensus, "MAX_NEAR_MISSES", -1.0)
    scene = scenes.planar(n=100, sigma=0.5, static=0.3, outliers=0.1, generator=seeded(1))
    views = tuple(x[None] for x in scene.views)
    data = matches(dyn.HomographyTensor(), views, None)
    search = Search(dyn.HomographyTensor(), data, seeded(0))
    with torch.no_grad():
        found = search.run(torch.tensor([1.5], dtype=torch.float64), (1, 4, 16, 64, 256))
    assert bool(found.doubt) and counts == [1, 4, 16]

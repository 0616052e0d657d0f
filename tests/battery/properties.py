"""The properties that every invariant has, each a function of a :class:`~tests.battery.cases.Case`; ``CHECKS`` lists them.

References are brute force (:mod:`tests.battery.references`), known motions of exact scenes, and the same computation done another
way.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from unittest.mock import patch

import pytest
import torch
from torch import Tensor

import dyntorch as dyn
from dyntorch.core.normalize import denormalization_derivative, denormalize_motion
from dyntorch.core.primitives import HyperplanesThrough, Point
from dyntorch.core.solution import Solution
from dyntorch.invariants.segmentation_matrix import RelationPair
from dyntorch.native import library
from dyntorch.numerics.least_squares import flatten_parts, jacobian, parts_of
from tests.battery.cases import Case, carried, moved_views
from tests.battery.references import apart, matrices, noisy, pulled_back, rank, spans

Check = Callable[[Case], None]
CHECKS: list[tuple[Check, Callable[[Case], bool]]] = []


def prop(applies: Callable[[Case], bool] = lambda case: True) -> Callable[[Check], Check]:
    """Put a property on the list, for the cases it applies to."""

    def add(check: Check) -> Check:
        CHECKS.append((check, applies))
        return check

    return add


def many(case: Case) -> int:
    return 2 * case.minimal + 6


def example(
    case: Case, n: int = 0, *, batch: tuple[int, ...] = (2,), seed: int = 0, sigma: float | None = None
) -> tuple[Tensor, ...]:
    """Noisy matches of order 1."""
    exact = case.scene(n or many(case), batch=batch, seed=seed).exact
    return noisy(case, exact, case.noise if sigma is None else sigma, seed + 1)


def ok(solution: Solution) -> Solution:
    assert (solution.status == dyn.Status.OK).all(), repr(solution)
    return solution


def finite(solution: Solution) -> None:
    """Nothing that a user can reach is NaN."""
    for x in (solution.tensor, solution.uncertainty, solution.singular_values, *solution.motion):
        assert x.isfinite().all()


def worst(error: Tensor) -> float:
    return float(error.max()) if error.numel() else 0.0


def similarities(case: Case, seed: int = 5) -> tuple[Tensor, ...]:
    """A rotation, a scale and a shift for every view."""
    g = torch.Generator().manual_seed(seed)
    frames = []
    for v, primitive in enumerate(case.invariant.primitives):
        frame = torch.eye(primitive.dim + 1, dtype=torch.float64)
        turn = torch.linalg.qr(torch.randn(primitive.dim, primitive.dim, generator=g, dtype=torch.float64)).Q
        frame[:-1, :-1] = (0.1, 3.0, 40.0, 0.7)[v] * turn
        frame[:-1, -1] = 20.0 * torch.randn(primitive.dim, generator=g, dtype=torch.float64)
        frames.append(frame)
    return tuple(frames)


def collineations(case: Case, seed: int = 6) -> tuple[Tensor, ...]:
    """A general change of coordinates of every view that keeps the scene before the hyperplane at infinity."""
    g = torch.Generator().manual_seed(seed)
    frames = []
    for primitive in case.invariant.primitives:
        d = primitive.dim
        frame = torch.eye(d + 1, dtype=torch.float64) + 0.25 * torch.randn(d + 1, d + 1, generator=g, dtype=torch.float64)
        frame[-1] = torch.cat([0.05 * torch.randn(d, generator=g, dtype=torch.float64), torch.ones(1, dtype=torch.float64)])
        frames.append(frame)
    return tuple(frames)


# ------------------------------------------------------------------ what is declared


@prop()
def nullity_is_the_rank_defect(case: Case) -> None:
    invariant = case.invariant
    for n in (case.minimal, many(case)):
        scene = case.scene(n)
        for matrix in matrices(case, scene.exact):
            assert matrix.shape == (n * invariant.rows(), invariant.width())
            assert invariant.width() - rank(matrix) == case.nullity == invariant.nullity
    assert min(rank(m) for m in matrices(case, case.scene(case.minimal - 1).exact)) < invariant.width() - case.nullity
    assert invariant.minimal() == case.minimal


@prop()
def dof_and_codim_are_ranks_of_derivatives(case: Case) -> None:
    scene = case.scene(3, seed=2)
    sizes = [m.shape for m in scene.motion]

    def projector(theta: Tensor) -> Tensor:
        parts = theta.split([size.numel() for size in sizes])
        rows = spans(case, case.invariant.compose(*(p.reshape(size) for p, size in zip(parts, sizes, strict=True))))
        return (rows.mT @ rows).flatten()

    theta = torch.cat([m.flatten() for m in scene.motion])
    assert rank(torch.func.jacfwd(projector)(theta)) == case.invariant.dof
    for i in range(3):
        match = tuple(x[i] for x in scene.exact)
        slopes = torch.func.jacrev(lambda *z: case.conditions(scene.motion, *z), argnums=tuple(range(len(match))))(*match)
        assert rank(torch.cat([slope.flatten(1) for slope in slopes], dim=1).T) == case.invariant.codim


@prop()
def tensor_is_the_null_space_of_the_brute_force_matrix(case: Case) -> None:
    views = example(case, batch=())
    raw = dyn.fit(case.invariant, *views, normalize=False)
    exact = case.scene(many(case))
    for given, solution, tolerance in ((exact.exact, ok(dyn.fit(case.invariant, *exact.exact)), 1e-10), (views, raw, None)):
        tensors = spans(case, _in_order_of_views(case, solution.tensor))
        for matrix, tensor in zip(matrices(case, given), tensors, strict=True):
            left = torch.linalg.matrix_norm(matrix @ tensor.mT)
            least = torch.linalg.svdvals(matrix)[-case.nullity :].norm()
            if tolerance is not None:
                assert left < tolerance
            elif not isinstance(case.invariant, dyn.FundamentalMatrix | RelationPair):
                # of all tensors the least residual; rank two, or a norm that rotations of the views preserve, costs a little
                torch.testing.assert_close(left, least, rtol=1e-8, atol=1e-12)


def _in_order_of_views(case: Case, tensor: Tensor) -> Tensor:
    axes = case.invariant.axes()
    lead = tensor.ndim - len(axes)
    return tensor.permute(*range(lead), *(lead + axes.index(v) for v in range(len(axes))))


# ------------------------------------------------------------------ exact matches


@prop()
def exact_matches_give_the_true_motion(case: Case) -> None:
    for make in (case.scene, case.raw):
        scene = make(many(case), batch=(6,))
        solution = ok(dyn.fit(case.invariant, *scene.exact))
        assert worst(case.error(solution.motion, scene.motion)) < 1e-8
        assert solution.uncertainty.max() < 1e-5


@prop()
def minimal_matches_suffice(case: Case) -> None:
    scene = case.scene(case.minimal, batch=(6,), seed=3)
    assert worst(case.error(ok(dyn.fit(case.invariant, *scene.exact)).motion, scene.motion)) < 1e-6


@prop()
def one_match_fewer_is_refused(case: Case) -> None:
    views = case.scene(case.minimal - 1, batch=(2,)).exact
    with pytest.raises(ValueError, match=rf"at least {case.minimal} matches, got {case.minimal - 1}; add matches"):
        dyn.fit(case.invariant, *views)


@prop()
def motion_of_composed_tensor_is_the_motion(case: Case) -> None:
    for make in (case.scene, case.raw):
        true = make(1, batch=(3, 4)).motion
        tensor = case.invariant.compose(*true)
        found = case.invariant.decompose(-0.3 * tensor)
        found = found if isinstance(found, tuple) else (found,)
        assert [p.shape for p in found] == [p.shape for p in true]
        assert worst(case.error(found, true)) < 1e-8
        assert apart(case, case.invariant.compose(*found), tensor) < 1e-8
        rows = spans(case, tensor)
        torch.testing.assert_close(rows @ rows.mT, torch.eye(case.nullity).double().expand(len(rows), -1, -1))


@prop()
def change_of_coordinates_commutes_with_exact_fit(case: Case) -> None:
    scene = case.scene(many(case), batch=(3,), seed=4)
    for frames in (similarities(case), collineations(case)):
        invariant = case.follows(case.invariant, frames)
        solution = ok(dyn.fit(invariant, *moved_views(case.invariant, scene.exact, frames)))
        assert worst(case.error(solution.motion, carried(case.invariant, scene.motion, frames))) < 1e-7
        # and the tensor is the one of the moved matches: it composes from that motion
        assert apart(case, solution.tensor, invariant.compose(*solution.motion)) < 1e-6


@prop()
def similarity_commutes_with_noisy_fit(case: Case) -> None:
    views = example(case, seed=5)
    frames = similarities(case)
    before = dyn.fit(case.invariant, *views)
    after = dyn.fit(case.follows(case.invariant, frames), *moved_views(case.invariant, views, frames))
    # several tensors that are orthonormal in one system of coordinates are near to dependent in another one
    rounding = 1e-15 * float(torch.stack([torch.linalg.cond(frame) for frame in frames]).prod()) if case.nullity > 1 else 0.0
    assert apart(case, pulled_back(case, after.tensor, frames), before.tensor) < max(1e-8, rounding)
    assert torch.equal(before.status, after.status)
    torch.testing.assert_close(before.uncertainty, after.uncertainty, rtol=1e-4, atol=1e-9)
    # decompositions that balance the axes of a tensor that is not quite one change by far less than the noise
    back = carried(case.invariant, after.motion, tuple(torch.linalg.inv(g) for g in frames))
    truth = case.scene(many(case), batch=(2,), seed=5).motion
    assert (case.error(back, before.motion) <= 0.05 * case.error(before.motion, truth)).all()


# ------------------------------------------------------------------ batches, weights, order, missing


@prop()
def batch_is_loop(case: Case) -> None:
    views = example(case, batch=(2, 3))
    whole = dyn.fit(case.invariant, *views)
    assert whole.status.shape == (2, 3) and whole.tensor.shape[:2] == (2, 3)
    refined = dyn.refine(whole, *views)
    for i in range(2):
        for j in range(3):
            alone = dyn.fit(case.invariant, *(x[i, j] for x in views))
            assert alone.status.shape == () and alone.tensor.shape == whole.tensor.shape[2:]
            assert apart(case, whole.tensor[i, j], alone.tensor) < 1e-9
            assert worst(case.error(tuple(m[i, j] for m in whole.motion), alone.motion)) < 1e-7
            torch.testing.assert_close(whole.singular_values[i, j], alone.singular_values)
            torch.testing.assert_close(whole.uncertainty[i, j], alone.uncertainty, rtol=1e-6, atol=1e-12)
            if i == j == 1:
                one = dyn.refine(alone, *(x[i, j] for x in views))
                assert worst(case.error(tuple(m[i, j] for m in refined.motion), one.motion)) < 1e-5
                torch.testing.assert_close(refined.sigma[i, j], one.sigma, rtol=1e-6, atol=0)


@prop()
def kernel_and_torch_agree(case: Case) -> None:
    """Statuses of good, exact, degenerate, scarce and broken problems are the same, and so are tensors, to rounding of a Gram."""
    noisy, exact = example(case, batch=(9,)), example(case, batch=(9,), sigma=0.0)
    views = tuple(torch.cat([a, b]) for a, b in zip(noisy, exact, strict=True))
    for x in views:
        x[3] = x[3, :1]  # all matches are one
        x[5, 2:] = math.nan
        x[7] = 0.0
        x[12] *= 1e140
    first = dyn.fit(case.invariant, *views)
    with patch.object(library, "load", lambda: ({}, "torch")):
        second = dyn.fit(case.invariant, *views)
    assert first.status.tolist() == second.status.tolist()
    sound = first.status == dyn.Status.OK
    assert apart(case, first.tensor[sound], second.tensor[sound]) < 1e-6
    torch.testing.assert_close(
        first.uncertainty[sound], second.uncertainty[sound], rtol=1e-3, atol=1e-5
    )  # of exact matches it is rounding


@prop(
    lambda case: case.invariant.nullity == 1 and all(isinstance(p, (Point, HyperplanesThrough)) for p in case.invariant.primitives)
)
def robust_fit_is_the_same_with_and_without_the_kernel(case: Case) -> None:
    """Not in the draws of samples, but in what is found: the statuses, and a refined tensor to the noise's own share."""
    views = tuple(x.clone() for x in example(case, 2 * many(case), batch=(2,)))
    views[0][:, :3] = views[0][:, :3].flip(1) + 0.3  # a few matches that are wrong
    cut = 4 * case.noise * case.invariant.codim**0.5
    found = []
    for load in (library.load, lambda: ({}, "torch")):
        with patch.object(library, "load", load):
            found.append(dyn.robust_fit(case.invariant, *views, threshold=cut, generator=torch.Generator().manual_seed(0)))
    assert found[0].status.tolist() == found[1].status.tolist()
    sound = found[0].status == dyn.Status.OK
    assert apart(case, found[0].tensor[sound], found[1].tensor[sound]) < 1e-4


@prop()
def changes_of_coordinates_of_motions_have_their_derivative(case: Case) -> None:
    """By hand, against automatic differentiation."""
    solution = ok(dyn.fit(case.invariant, *example(case)))
    frames, motion = solution.frames(), solution.normalized_motion()
    shapes = [part.shape[1:] for part in motion]

    def back(theta: Tensor) -> Tensor:
        parts = denormalize_motion(case.invariant, parts_of(theta, shapes), frames)
        return torch.cat([part.flatten(theta.ndim - 1) for part in parts], dim=-1)

    expected = jacobian(back, flatten_parts(motion))[1]
    torch.testing.assert_close(denormalization_derivative(case.invariant, motion, frames), expected, rtol=1e-9, atol=1e-9)


@prop()
def order_of_matches_changes_nothing(case: Case) -> None:
    views = example(case)
    order = torch.randperm(many(case), generator=torch.Generator().manual_seed(0))
    first, second = dyn.fit(case.invariant, *views), dyn.fit(case.invariant, *(x[:, order] for x in views))
    assert apart(case, first.tensor, second.tensor) < 1e-9
    torch.testing.assert_close(first.singular_values, second.singular_values)


@prop()
def weight_zero_and_missing_are_absent(case: Case) -> None:
    views = example(case)
    n = many(case)
    gone = torch.tensor([1, 4, n - 1])
    kept = torch.tensor([i for i in range(n) if i not in gone])
    expected = dyn.fit(case.invariant, *(x[:, kept] for x in views))
    weights = torch.ones(2, n, dtype=torch.float64)
    weights[:, gone] = 0
    wild = tuple(x.clone() for x in views)
    wild[0][:, gone] = 1e3
    missing = tuple(x.clone() for x in views)
    for k, i in enumerate(gone.tolist()):
        missing[k % len(views)][:, i] = (torch.nan, torch.inf, -torch.inf)[k]
    lost = weights.masked_fill(weights == 0, torch.nan)
    for given, weight in ((views, weights), (wild, weights), (wild, weights[0]), (missing, None), (wild, lost), (missing, weights)):
        found = dyn.fit(case.invariant, *given, weights=weight)
        assert apart(case, found.tensor, expected.tensor) < 1e-10
        assert torch.equal(found.status, expected.status)
        torch.testing.assert_close(found.singular_values, expected.singular_values)
        torch.testing.assert_close(found.uncertainty, expected.uncertainty)
    refined = dyn.refine(expected, *(x[:, kept] for x in views))
    assert worst(case.error(dyn.refine(found, *missing, weights=weights).motion, refined.motion)) < 1e-5


@prop()
def weight_two_is_a_match_twice(case: Case) -> None:
    views = example(case)
    weights = torch.ones(2, many(case), dtype=torch.float64)
    weights[:, :5] = 2
    twice = dyn.fit(case.invariant, *(torch.cat([x, x[:, :5]], dim=1) for x in views))
    once = dyn.fit(case.invariant, *views, weights=weights)
    assert apart(case, once.tensor, twice.tensor) < 1e-9
    shares = [s.singular_values / s.singular_values[..., :1] for s in (once, twice)]
    torch.testing.assert_close(*shares)
    # only their ratios count
    assert apart(case, once.tensor, dyn.fit(case.invariant, *views, weights=1e6 * weights).tensor) < 1e-9


@prop()
def empty_batch_works(case: Case) -> None:
    for batch in ((0,), (2, 0)):
        views = tuple(x.new_zeros(*batch, *x.shape[1:]) for x in case.scene(many(case), batch=(1,)).exact)
        solution = dyn.fit(case.invariant, *views).check()
        assert solution.status.shape == batch and solution.tensor.shape[: len(batch)] == batch
        assert all(m.shape[: len(batch)] == batch for m in solution.motion)
        assert dyn.refine(solution, *views).sigma.shape == batch
        copies = [] if case.invariant.copies is None else [case.invariant.copies]
        assert solution.singular_values.shape == (*batch, *copies, case.invariant.width())

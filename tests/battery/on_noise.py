"""Properties in the presence of noise: gradients, distances, refinement and its covariance, robust estimation."""

from __future__ import annotations

import torch
from torch import Tensor

import dyntorch as dyn
from tests.battery.cases import Case, Motion, carried, moved_views
from tests.battery.properties import example, many, ok, prop, worst
from tests.battery.references import apart, first_order, geometric, noisy, spans


def projector(case: Case, tensor: Tensor) -> Tensor:
    """What does not depend on signs or a basis: the projection of a fixed vector onto the span of the tensors."""
    rows = spans(case, tensor)
    fixed = torch.linspace(-1, 1, rows.shape[-1], dtype=rows.dtype) + 0.3
    return (rows @ fixed)[:, None, :] @ rows


# ------------------------------------------------------------------ derivatives


def _gradients(case: Case, n: int, *, exact: bool = False) -> None:
    views = example(case, n, batch=(), sigma=0.0 if exact else None)
    weights = torch.linspace(0.5, 1.5, n, dtype=torch.float64)

    def function(weights: Tensor, *views: Tensor) -> Tensor:
        return projector(case, dyn.fit(case.invariant, *views, weights=weights).tensor)

    inputs = [x.clone().requires_grad_() for x in (weights, *views)]
    assert torch.autograd.gradcheck(function, inputs, fast_mode=True, eps=1e-7, atol=1e-5, rtol=1e-3)
    # fast mode looks along one direction: the gradient must be there, too
    grads = torch.autograd.grad(function(*inputs)[0, 0, 0], inputs[1:])
    assert all(g.isfinite().all() and g.abs().max() > 1e-6 for g in grads)


@prop()
def gradient_is_right(case: Case) -> None:
    _gradients(case, many(case))


@prop()
def gradient_is_right_at_the_minimal_count(case: Case) -> None:
    _gradients(case, case.minimal)


@prop()
def gradient_of_exact_matches_is_right(case: Case) -> None:
    """Exactly singular: where the backward pass of an SVD divides by zero."""
    _gradients(case, many(case), exact=True)


@prop()
def gradient_of_motion_is_right(case: Case) -> None:
    """Of the tensor composed again from the motion, which does not depend on what the motion leaves open."""
    views = example(case, batch=())

    def function(*views: Tensor) -> Tensor:
        return projector(case, case.invariant.compose(*dyn.fit(case.invariant, *views).motion))

    inputs = [x.clone().requires_grad_() for x in views]
    assert torch.autograd.gradcheck(function, inputs, fast_mode=True, eps=1e-7, atol=1e-5, rtol=1e-3)


@prop()
def second_derivatives_are_right(case: Case) -> None:
    """Along a direction of the data, from values of the gradient: through normalization, null space and constraint."""
    for n in (case.minimal, many(case)):
        views = example(case, n, batch=())
        g = torch.Generator().manual_seed(3)
        along = [torch.randn(x.shape, generator=g, dtype=x.dtype) for x in views]

        def slope(s: float, create: bool, views: tuple[Tensor, ...] = views, along: list[Tensor] = along) -> tuple[Tensor, Tensor]:
            q = torch.tensor(s, dtype=torch.float64, requires_grad=True)
            tensor = dyn.fit(case.invariant, *(x + q * e for x, e in zip(views, along, strict=True))).tensor
            value = projector(case, tensor)[0, 0, :3].sum()
            return torch.autograd.grad(value, q, create_graph=create)[0], q

        first, q = slope(0.0, True)
        (second,) = torch.autograd.grad(first, q)
        h = 1e-6
        expected = (slope(h, False)[0] - slope(-h, False)[0]).detach() / (2 * h)
        torch.testing.assert_close(second, expected, rtol=1e-3, atol=1e-4 * float(first.detach().abs()) + 1e-3)


@prop(lambda case: case.invariant.width() < 36)
def torch_func_agrees_with_autograd(case: Case) -> None:
    """A derivative of each problem, mapped over the problems: of the tensor, its motion and the distances, in one go."""
    views = example(case, batch=(2,))

    def function(*views: Tensor) -> Tensor:
        solution = dyn.fit(case.invariant, *views)
        composed = case.invariant.compose(*solution.motion)
        far = dyn.sampson(case.invariant, solution.tensor, *views).square().sum()
        return projector(case, solution.tensor).sum() + projector(case, composed).sin().sum() + far

    leaves = [x.clone().requires_grad_() for x in views]
    expected = torch.autograd.grad(sum(function(*(x[b] for x in leaves)) for b in range(2)), leaves)
    found = torch.func.vmap(torch.func.grad(function, argnums=tuple(range(len(views)))))(*views)
    for one, other in zip(found, expected, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-4, atol=1e-5 * float(other.abs().max()))


@prop()
def failed_problems_leave_gradients_of_the_others_alone(case: Case) -> None:
    views = example(case, batch=(3,))
    alone = [x[:1].clone().requires_grad_() for x in views]
    broken = [x.clone() for x in views]
    for x in broken:
        x[1] = x[1, :1]
    broken[0][2] = torch.nan
    inputs = [x.requires_grad_() for x in broken]
    for given in (alone, inputs):
        solution = dyn.fit(case.invariant, *given)
        total = projector(case, solution.tensor).sum() + sum(m.square().sum(-1).sin().sum() for m in solution.motion)
        total.backward()
    for one, whole in zip(alone, inputs, strict=True):
        assert whole.grad is not None and one.grad is not None and whole.grad.isfinite().all()
        torch.testing.assert_close(whole.grad[:1], one.grad, rtol=1e-6, atol=1e-9)


# ------------------------------------------------------------------ distances


@prop()
def sampson_is_the_first_order_of_the_geometric_distance(case: Case) -> None:
    scene = case.scene(60)
    ones = (1.0,) * len(scene.views)
    tensor = case.invariant.compose(*scene.motion)
    for sigma, tolerance in ((1e-4, 0.02), (1e-6, 2e-4)):
        views = noisy(case, scene.exact, sigma)
        found = dyn.sampson(case.invariant, -2.5 * tensor, *views) / sigma
        assert found.shape == (60,) and found.min() >= 0
        assert (found - geometric(case, scene.motion, views, ones) / sigma).abs().max() < tolerance
        assert 0.6 < found.square().mean() / case.invariant.codim < 1.5


@prop(lambda case: "Join" not in repr(case) and repr(case) != "Collineation(1)" and not case.projected)
def sampson_is_the_one_by_autograd(case: Case) -> None:
    """Exactly, also far from the motion, where the conditions are the ones that the library takes, up to a constant."""
    scene = case.scene(40)
    views = noisy(case, scene.exact, 0.05)
    found = dyn.sampson(case.invariant, case.invariant.compose(*scene.motion), *views)
    expected = first_order(case, scene.motion, views, (1.0,) * len(views))
    torch.testing.assert_close(found, expected, rtol=1e-6, atol=1e-8)


@prop(lambda case: case.invariant.rows() == 1 and case.invariant.copies is None and case.nullity == 1)
def algebraic_is_the_form_on_the_vectors(case: Case) -> None:
    scene = case.scene(10)
    views = noisy(case, scene.exact, 0.05)
    g = torch.Generator().manual_seed(0)
    for _ in range(2):
        tensor = torch.randn(case.invariant.shape(), generator=g, dtype=torch.float64)
        found = dyn.core.algebraic(case.invariant, tensor, *views)
        moved = dyn.core.algebraic(case.invariant, 2 * tensor, *views)
        torch.testing.assert_close(moved, 2 * found)
    exact = dyn.core.algebraic(case.invariant, case.invariant.compose(*scene.motion), *scene.exact)
    assert exact.abs().max() < 1e-13


# ------------------------------------------------------------------ refinement


def cost(case: Case, solution: dyn.Solution, motion: Motion, views: tuple[Tensor, ...]) -> Tensor:
    """Sum of squares of brute-force distances in the coordinates in which the solution is normalized."""
    frames = solution.normalization.transforms
    frames = tuple(t[:, 0] for t in frames) if case.invariant.copies else frames
    moved = moved_views(case.invariant, views, frames)
    parts = carried(case.invariant, motion, frames)
    total = []
    for b in range(len(views[0])):
        scales = tuple(float(t[b, 0, 0]) for t in frames)
        one = tuple(p[b] for p in parts)
        distances = geometric if case.projected else first_order
        total.append(distances(case, one, tuple(x[b] for x in moved), scales).square().sum())
    return torch.stack(total)


@prop()
def refinement_never_raises_the_distances(case: Case) -> None:
    for sigma in (case.noise, 5 * case.noise):
        views = example(case, batch=(2,), seed=8, sigma=sigma)
        solution = dyn.fit(case.invariant, *views)
        before = cost(case, solution, solution.motion, views)
        last = before
        for iterations in (1, 30):
            refined = dyn.refine(solution, *views, iterations=iterations)
            after = cost(case, solution, refined.motion, views)
            assert (after <= last * (1 + 1e-6)).all()
            last = after
        assert (last < before).all()
        # the tensor is that of the motion, and fulfils every internal constraint
        assert apart(case, refined.tensor, case.invariant.compose(*refined.motion)) < 1e-7


@prop()
def refinement_finds_a_stationary_point(case: Case) -> None:
    views = example(case, batch=(1,), seed=9)
    solution = dyn.fit(case.invariant, *views)
    refined = dyn.refine(solution, *views)
    least = cost(case, solution, refined.motion, views)
    assert (least <= cost(case, solution, case.scene(many(case), batch=(1,), seed=9).motion, views)).all()
    g = torch.Generator().manual_seed(2)
    for _ in range(4):
        other = tuple(m + 1e-5 * torch.randn(m.shape, generator=g, dtype=m.dtype) for m in refined.motion)
        assert (cost(case, solution, other, views) >= least * (1 - 1e-7)).all()
    again = dyn.refine(refined, *views)
    assert worst(case.error(again.motion, refined.motion)) < 1e-5


@prop()
def refinement_keeps_exact_solutions(case: Case) -> None:
    for n in (case.minimal, many(case)):
        scene = case.scene(n, batch=(3,), seed=2)
        solution = ok(dyn.fit(case.invariant, *scene.exact))
        refined = ok(dyn.refine(solution, *scene.exact))
        assert worst(case.error(refined.motion, scene.motion)) < 1e-6
        if n > case.minimal:
            assert refined.sigma is not None and refined.sigma.max() < 1e-7


@prop(lambda case: case.invariant.width() < 36)
def gradient_of_refinement_is_right(case: Case) -> None:
    """Along a direction of the data, from refinements beside it: of the tensor and of the noise that is left."""
    views = example(case, batch=())
    g = torch.Generator().manual_seed(3)
    along = [case.noise * torch.randn(x.shape, generator=g, dtype=x.dtype) for x in views]

    def answer(s: Tensor) -> Tensor:
        moved = [x + s * e for x, e in zip(views, along, strict=True)]
        found = dyn.refine(dyn.fit(case.invariant, *moved), *moved)
        assert found.sigma is not None and not found.notices
        return torch.cat([projector(case, found.tensor)[0, 0], found.sigma[None] / case.noise])

    at = torch.zeros((), dtype=torch.float64, requires_grad=True)
    fixed = torch.randn(len(answer(at)), generator=g, dtype=torch.float64)
    (slope,) = torch.autograd.grad((answer(at) * fixed).sum(), at)
    h = 2e-2
    steps = [(answer(torch.tensor(s * h, dtype=torch.float64)) * fixed).sum() for s in (-2.0, -1.0, 1.0, 2.0)]
    expected = (8 * (steps[2] - steps[1]) - (steps[3] - steps[0])) / (12 * h)
    torch.testing.assert_close(slope, expected, rtol=1e-3, atol=1e-6)


def features(case: Case, motion: Motion) -> Tensor:
    """A function of the motion ``(b, f)`` that is blind to what the invariant leaves open."""
    if case.nullity > 1:
        return torch.cat([m.flatten(1) for m in motion], dim=-1)
    return case.invariant.compose(*motion).flatten(1)


@prop()
def covariance_is_calibrated(case: Case) -> None:
    """Over many draws of the noise the squared error of the motion, in units of the covariance, has the mean dof."""
    n, batch, dof = 2 * case.minimal + 30, 40, case.invariant.dof
    scene = case.scene(n, batch=(batch,), seed=21)
    views = noisy(case, scene.exact, 0.25 * case.noise, seed=22)
    refined = dyn.refine(dyn.fit(case.invariant, *views), *views)
    assert refined.covariance is not None and refined.sigma is not None
    torch.testing.assert_close(refined.sigma.mean() / (0.25 * case.noise), torch.tensor(1.0).double(), rtol=0.05, atol=0)
    sizes = [m[0].numel() for m in refined.motion]
    assert refined.covariance.shape == (batch, sum(sizes), sum(sizes))
    theta = torch.cat([m.flatten(1) for m in refined.motion], dim=-1)

    def of(t: Tensor) -> Tensor:
        parts = [p.reshape(1, *m.shape[1:]) for p, m in zip(t.split(sizes), refined.motion, strict=True)]
        return features(case, tuple(parts))[0]

    jacobian = torch.func.vmap(torch.func.jacfwd(of))(theta)
    difference = features(case, refined.motion)
    truth = features(case, scene.motion)
    difference = difference - truth * (difference * truth).sum(-1, keepdim=True).sign()
    covariance = jacobian @ refined.covariance @ jacobian.mT
    values, vectors = torch.linalg.eigh(covariance)
    assert (values[:, -dof] > 1e3 * values[:, :-dof].abs().amax(-1) if values.shape[-1] > dof else values[:, -dof] > 0).all()
    square = ((vectors.mT @ difference[..., None])[..., 0].square()[:, -dof:] / values[:, -dof:]).sum(-1)
    assert abs(float(square.mean()) / dof - 1) < 0.25
    # and not one number only: its spread is that of chi-square
    assert float((square / dof).std()) < 2.5 * (2 / dof) ** 0.5


# ------------------------------------------------------------------ outliers


@prop()
def robust_fit_survives_outliers(case: Case) -> None:
    n, sigma = min(200, max(60, 5 * case.minimal)), 0.5 * case.noise
    scene = case.scene(n, batch=(2,), seed=31, outliers=case.outliers)
    views = noisy(case, scene.views, sigma, seed=32)
    good = scene.labels != 0
    oracle = dyn.fit(case.invariant, *views, weights=good.double())
    oracle = dyn.refine(oracle, *views, weights=good.double())
    found = dyn.robust_fit(case.invariant, *views, threshold=3 * sigma, generator=torch.Generator().manual_seed(case.draw))
    ok(found)
    assert found.inliers is not None and found.inliers.shape == good.shape and found.inliers.dtype == torch.bool
    bound = 5 * case.error(oracle.motion, scene.motion).max() + 1e-6
    assert (case.error(found.motion, scene.motion) < bound).all()
    assert (found.inliers & good).sum() >= 0.8 * good.sum()

"""Properties of what comes in: labelled static matches, degenerate data, bad problems, misuse, precision, devices."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

import dyntorch as dyn
from dyntorch.core.outcome import is_failure
from dyntorch.core.primitives import Hyperplane
from dyntorch.core.refine import constrain
from tests.battery.cases import Case
from tests.battery.pretend_device import accelerators, moved
from tests.battery.properties import example, finite, many, ok, prop, worst
from tests.battery.references import apart, matrices, rank

Views = tuple[Tensor, ...]

# ------------------------------------------------------------------ labelled static matches


@prop(lambda case: case.invariant.labels_static)
def labelled_static_matches_put_in_all_their_rows(case: Case) -> None:
    n = many(case)
    scene = case.scene(n, static=0.2)
    static = scene.labels == 1
    views = tuple(x + 0.01 * torch.randn(x.shape, generator=torch.Generator().manual_seed(0), dtype=x.dtype) for x in scene.exact)
    solution = dyn.fit(case.invariant, *views, static=static, normalize=False)
    found = solution.singular_values if case.invariant.copies else solution.singular_values[None]
    for values, matrix in zip(found, matrices(case, views, static.tolist()), strict=True):
        torch.testing.assert_close(
            values / values[0], torch.linalg.svdvals(matrix)[: case.invariant.width()] / torch.linalg.svdvals(matrix)[0]
        )
    exact = ok(dyn.fit(case.invariant, *scene.exact, static=static))
    assert worst(case.error(exact.motion, scene.motion)) < 1e-8
    # and no label is no change
    none = dyn.fit(case.invariant, *views, static=torch.zeros_like(static))
    assert apart(case, dyn.fit(case.invariant, *views).tensor, none.tensor) < 1e-9


@prop(lambda case: bool(case.labelled))
def labelled_static_matches_have_the_ranks_of_the_theory(case: Case) -> None:
    """So many static ones need so many moving ones beside them, and not one fewer."""
    full = case.invariant.width() - case.nullity
    for still, moving in case.labelled.items():
        scene = case.scene(still + moving, static=still / (still + moving), seed=still)
        static = scene.labels == 1
        assert int(static.sum()) == still
        alone = tuple(x[static] for x in scene.exact)
        if still:
            assert rank(matrices(case, alone, [True] * still)[0]) == full - moving
        solution = ok(dyn.fit(case.invariant, *scene.exact, static=static))
        assert worst(case.error(solution.motion, scene.motion)) < 1e-6
        gone = int((~static if moving else static).nonzero()[0])
        rest = [i for i in range(still + moving) if i != gone]
        assert rank(matrices(case, tuple(x[rest] for x in scene.exact), static[rest].tolist())[0]) < full
        # one that weighs nothing stands in for the missing one, which could be refused at once
        weights = (torch.arange(still + moving) != gone).double()
        fewer = dyn.fit(case.invariant, *scene.exact, static=static, weights=weights)
        assert bool(is_failure(fewer.status)) and fewer.tensor.abs().max() == 0


# ------------------------------------------------------------------ degenerate and bad problems


def degenerate(case: Case, kind: str) -> Views:
    """One problem that determines nothing."""
    exact = case.scene(many(case)).exact
    if kind == "equal":
        return tuple(x[:1].expand_as(x).clone() for x in exact)
    if kind == "repeated":
        few = torch.arange(many(case)) % (case.minimal - 1)
        return tuple(x[few] for x in exact)
    if kind == "collinear":
        t = torch.linspace(0, 1, many(case), dtype=torch.float64)
        return tuple(x[0] + t.reshape(-1, *([1] * (x.ndim - 1))) * (x[1] - x[0]) for x in exact)
    if kind == "static":
        return case.scene(many(case), static=1.0).exact
    if kind == "zero":
        return tuple(torch.zeros_like(x) for x in exact)
    return tuple(torch.full_like(x, {"nan": torch.nan, "infinite": torch.inf}[kind]) for x in exact)


def kinds(case: Case) -> list[str]:
    found = ["equal", "repeated", "zero", "nan", "infinite"]
    if min(p.dim for p in case.invariant.primitives) > 1:
        found.append("collinear")
    return [*found, "static"] if case.moves else found


@prop()
def degenerate_problems_have_a_status_and_no_tensor(case: Case) -> None:
    good = case.scene(many(case), seed=12)
    names = ["good", *kinds(case), "good"]
    problems = [good.exact if kind == "good" else degenerate(case, kind) for kind in names]
    views = tuple(torch.stack(xs) for xs in zip(*problems, strict=True))
    solution = dyn.fit(case.invariant, *views)
    # the others are as they are without the bad ones
    fine = [0, len(names) - 1]
    clean = dyn.fit(case.invariant, *(x[fine].expand(len(names) // 2, *[-1] * x.ndim).flatten(0, 1) for x in views))
    assert apart(case, solution.tensor[fine], clean.tensor[:2]) < 1e-9 and torch.equal(solution.status[fine], clean.status[:2])
    refined = dyn.refine(solution, *views)
    assert refined.covariance is not None and refined.covariance.isfinite().all()
    for s in (solution, refined):
        finite(s)
        for i, kind in enumerate(names):
            assert bool(is_failure(s.status[i])) == (kind != "good"), f"{kind}: {s!r}"
            assert (s.tensor[i].abs().max() == 0) == (kind != "good")
        assert worst(case.error(tuple(m[fine] for m in s.motion), tuple(m[None] for m in good.motion))) < 1e-6
        with pytest.raises(ValueError, match=r"problem \d.* of \d+: (DEGENERATE|TOO_FEW); (add|give more) matches"):
            s.check()
    for kind, bad in zip(names[1:-1], problems[1:-1], strict=True):
        alone = dyn.fit(case.invariant, *bad)
        assert int(alone.status) == int(solution.status[names.index(kind)]) and alone.tensor.abs().max() == 0
        finite(alone)


@prop()
def weights_all_zero_are_too_few(case: Case) -> None:
    views = example(case, batch=(3,))
    weights = torch.ones(3, many(case), dtype=torch.float64)
    weights[1] = 0
    weights[2, case.minimal - 1 :] = 0
    solution = dyn.fit(case.invariant, *views, weights=weights)
    assert solution.status.tolist() == [dyn.Status.OK, dyn.Status.TOO_FEW, dyn.Status.TOO_FEW]
    assert solution.tensor[1:].abs().max() == 0
    finite(solution)
    finite(dyn.refine(solution, *views, weights=weights, iterations=2))
    with pytest.raises(ValueError, match="problem 1, 2 of 3: TOO_FEW; give more matches, or weigh fewer of them 0"):
        solution.check()


@prop()
def hostile_scales_stay_finite(case: Case) -> None:
    """The unit of the coordinates does not matter, and what is beyond the range of float64 is a status, without a NaN."""
    views = example(case, batch=())
    scales = [1.0, 1e300, 1e160, 1e50, 1e-50, 1e-160, 1e-300, 1.7e308, 1e-310]
    problems = [tuple(x * scale for x in views) for scale in scales]
    hostile = tuple(x.clone() for x in views)
    hostile[0][0] *= 1e300
    problems.append(hostile)
    stacked = tuple(torch.stack(xs) for xs in zip(*problems, strict=True))
    found = dyn.fit(case.invariant, *stacked)
    sound = [i for i, scale in enumerate(scales) if scale in (1.0, 1e50, 1e-50)] + [len(scales)]
    # homogeneous coordinates of hyperplanes have no unit
    measured = not any(isinstance(p, Hyperplane) for p in case.invariant.primitives)
    for solution in (found, dyn.refine(found, *stacked, iterations=2)):
        finite(solution)
        assert not measured or [int(s) for s in is_failure(solution.status).logical_not().nonzero()] == sound
        assert torch.equal(solution.tensor.flatten(1).abs().amax(-1) > 0, ~is_failure(solution.status))
    assert not measured or found.status[sound].eq(found.status[0]).all()
    assert not measured or worst((found.singular_values[[3, 4]] / found.singular_values[0] - 1)[..., 0].abs()) < 1e-9
    few = tuple(x[[0, 1, 3]] for x in stacked)
    if not case.invariant.intrinsic:
        tried = dyn.robust_fit(case.invariant, *few, starts=(1,), generator=torch.Generator().manual_seed(0))
        assert tried.tensor.isfinite().all() and tried.sigma is not None and tried.sigma.isfinite().all()
        assert tried.covariance is not None and not tried.covariance.isnan().any()
        assert not measured or tried.status[0] == tried.status[2]


@prop()
def neighbours_do_not_matter(case: Case) -> None:
    """Robust estimation and constrained fits of a problem are the same whatever stands beside it."""
    views = example(case, max(40, many(case)), batch=(3,))
    alone = case.nullity == 1 and case.invariant.copies is None

    def run(views: Views) -> tuple[dyn.Solution, dyn.Solution | None]:
        draw = torch.Generator().manual_seed(0)
        robust = dyn.robust_fit(case.invariant, *views, starts=(1, 2), generator=draw)
        return robust, constrain(dyn.fit(case.invariant, *views)) if alone else None

    expected = run(views)
    other = tuple(x.clone() for x in views)
    for x in other:
        x[1] = torch.nan
    found = run(other)
    rest = [0, 2]
    # descents end where the cost falls by less than 1e-9 of it
    for one, two in zip(found, expected, strict=True):
        if one is not None and two is not None:
            assert torch.equal(one.status[rest], two.status[rest])
            assert apart(case, one.tensor[rest], two.tensor[rest]) < 1e-6
    assert found[0].inliers is not None and expected[0].inliers is not None
    assert torch.equal(found[0].inliers[rest], expected[0].inliers[rest])


# ------------------------------------------------------------------ misuse


@prop()
def misuse_is_named_with_its_remedy(case: Case) -> None:
    invariant, views, n = case.invariant, example(case), many(case)
    last = views[-1]
    ints = tuple(x.long() for x in views)
    mixed = (*views[:-1], last.float())
    ones = torch.ones(2, n, dtype=torch.float64)
    wrong = (
        ((*views, last), {}, rf"takes matches in {len(views)} views, got {len(views) + 1}"),
        (views[:-1], {}, rf"takes matches in {len(views)} views, got {len(views) - 1}"),
        ((*views[:-1], last[..., :-1]), {}, rf"view {len(views)} of .*expected \(\*batch, n, .*got \(2, {n}"),
        ((*views[:-1], last[:, :-1]), {}, r"same \(\*batch, n\).*expand the smaller ones"),
        ((*views[:-1], last[:1]), {}, r"same \(\*batch, n\).*expand the smaller ones"),
        (mixed, {}, r"one dtype, got .*torch.float32.*; use .to\(dtype\)"),
        (ints, {}, r"view 1 must be of floating point, got torch.int64; use .double\(\)"),
        ((views[0].numpy(), *views[1:]), {}, r"view 1 must be a torch.Tensor, got ndarray; use torch.as_tensor"),
        (views, {"weights": -ones}, r"weights must not be negative, got -1; use 0"),
        (views, {"weights": ones[:, :-1]}, rf"weights must be \(\*batch, n\) = \(2, {n}\), got \(2, {n - 1}\)"),
        (views, {"weights": [1.0] * n}, r"weights must be a torch.Tensor, got list"),
        ((*views[:-1], last.to("meta")), {}, r"one device, got .*; use .to\(device\)"),
    )
    for given, options, message in wrong:
        with pytest.raises(ValueError, match=message):
            dyn.fit(invariant, *given, **options)
    told = r"static must be \(\*batch, n\)" if invariant.labels_static else "no rows for labelled static matches; leave out static="
    with pytest.raises(ValueError, match=told):
        dyn.fit(invariant, *views, static=torch.zeros(2, n + 1, dtype=torch.bool))
    solution = dyn.fit(invariant, *views)
    with pytest.raises(ValueError, match="give the same ones"):
        dyn.refine(solution, *(x[:, :-1] for x in views))
    with pytest.raises(ValueError, match=rf"takes .*{len(views)} views, got {len(views) + 1}"):
        dyn.sampson(invariant, solution.tensor, *views, last)


# ------------------------------------------------------------------ precision and devices


@prop()
def single_precision_is_solved_in_double(case: Case) -> None:
    views = example(case)
    single = tuple(x.float() for x in views)
    found = dyn.fit(case.invariant, *single)
    refined = dyn.refine(found, *single)
    assert {x.dtype for x in (found.tensor, *found.motion, found.singular_values, found.uncertainty)} == {torch.float32}
    assert {x.dtype for x in (refined.tensor, *refined.motion, refined.sigma, refined.covariance)} == {torch.float32}
    assert found.status.dtype == dyn.fit(case.invariant, *views).status.dtype
    # the same numbers in double give the same tensor to the rounding of the result
    double = dyn.fit(case.invariant, *(x.double() for x in single))
    assert apart(case, found.tensor, double.tensor) < 1e-6
    # exact matches, rounded to single precision: the error is that of the input, no more
    scene = case.scene(many(case), batch=(6,))
    rounded = dyn.fit(case.invariant, *(x.float() for x in scene.exact))
    assert worst(case.error(tuple(m.double() for m in rounded.motion), scene.motion)) < 2e-4


@prop()
def an_accelerator_agrees(case: Case) -> None:
    views = tuple(x[:1] for x in example(case))
    here = dyn.fit(case.invariant, *views)
    motion = dyn.refine(here, *views).motion
    nothing = tuple(map(torch.stack, zip(*(degenerate(case, kind) for kind in kinds(case)), strict=True)))
    for device in accelerators():
        assert dyn.fit(case.invariant, *moved(nothing, device)).status.tolist() == dyn.fit(case.invariant, *nothing).status.tolist()
        away = moved(views, device)
        there = dyn.fit(case.invariant, *away)
        assert {x.device.type for x in (there.tensor, there.status, *there.motion)} == {device}
        assert apart(case, there.tensor.cpu(), here.tensor) < 1e-8
        assert torch.equal(there.status.cpu(), here.status)
        assert worst(case.error(moved(dyn.refine(there, *away).motion, "cpu"), motion)) < 1e-5

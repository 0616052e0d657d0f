"""Shape tensors: properties of views of points, and the algebra against determinants, closed forms and exact counts."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

import dyntorch as dyn
from dyntorch import counting
from dyntorch.invariants.shape_tensor import ShapeTensor
from dyntorch.shapes import static as shape_rows
from dyntorch.shapes.static import dual_cameras, reference_cameras
from tests.battery.references import rank
from tests.battery.shape_cases import LIFTED_CASES, SHAPE_CASES
from tests.draws import random, seeded
from tests.grid import assert_refused

EVERY = [*SHAPE_CASES, *LIFTED_CASES]
STATIC = [case for case in SHAPE_CASES if not case.timed]
every = pytest.mark.parametrize("case", EVERY, ids=repr)
most = pytest.mark.parametrize("case", [EVERY[i] for i in (1, 2, 5, 6, 8, 9, 10, 11, 13, 15, 18, 19)], ids=repr)
forms = pytest.mark.parametrize("case", [*STATIC, *LIFTED_CASES], ids=repr)
some = pytest.mark.parametrize("case", [*(STATIC[i] for i in (2, 6, 8)), *(LIFTED_CASES[i] for i in (1, 2, 6))], ids=repr)
MANY = 8


def ok(solution):
    assert (solution.status == dyn.Status.OK).all(), repr(solution)
    return solution


@every
def test_counts_are_ranks(case):
    inv = case.invariant
    assert (inv.minimal(), inv.width(), inv.dof, inv.codim) == (case.minimal, case.width, case.dof, case.conditions)
    points, shape = case.scene(case.many, seed=1)
    for views in (case.minimal, case.many):
        matrix = case.rows(tuple(p[-views:] for p in points))
        assert rank(matrix.flatten(0, -2)) == case.width - inv.nullity
        if views == case.minimal:
            assert rank(matrix[:-1].flatten(0, -2)) < case.width - inv.nullity
            assert rank(matrix[0]) == inv.rows()

    # the freedom of the shape, by central differences of the span of its tensor
    steps = 1e-4 * torch.eye(shape.numel(), dtype=torch.float64).reshape(-1, *shape.shape)
    spans = [t.reshape(-1, inv.nullity, case.size) for t in (inv.compose(shape + steps), inv.compose(shape - steps))]
    values = torch.linalg.svdvals(((spans[0].mT @ spans[0] - spans[1].mT @ spans[1]) / 2e-4).flatten(1))
    assert int((values > 1e-5 * values[0]).sum()) == case.dof


@every
def test_minimal_views_suffice_and_one_fewer_is_refused(case):
    for views in (case.minimal, case.many):
        points, shape = case.scene(views, batch=(4,), seed=2)
        solution = ok(case.fit(points))
        assert solution.tensor.shape[1:] == ((case.invariant.nullity,) * (case.invariant.nullity > 1) + case.invariant.shape())
        assert solution.singular_values.shape == (4, case.width)
        assert case.apart(solution.tensor, case.invariant.compose(shape)) < 10 * case.exact
    points, _ = case.scene(case.minimal - 1, batch=(2,))
    with pytest.raises(ValueError, match=rf"at least {case.minimal} matches, got {case.minimal - 1}; add matches"):
        case.fit(points)


@every
def test_coordinates_of_the_views_change_nothing(case):
    points, shape = case.scene(case.many, batch=(3,), seed=3)
    assert case.apart(ok(case.fit(case.changed(points))).tensor, case.invariant.compose(shape)) < 10 * case.exact
    noisy, _ = case.scene(case.many, batch=(3,), seed=3, sigma=0.5)
    before, after = (case.fit(x) for x in (noisy, case.changed(noisy, similar=True)))
    assert case.apart(before.tensor, after.tensor) < 10 * case.exact
    assert torch.equal(before.status, after.status)
    torch.testing.assert_close(before.singular_values, after.singular_values)


@forms
def test_structure_of_a_composed_tensor_gives_it_back(case):
    shape = case.scene(1, batch=(2, 3), seed=4)[1]
    tensor = case.invariant.compose(shape)
    points = case.invariant.decompose(-0.3 * tensor)
    size = case.dims[0] + 1
    assert points.shape == (2, 3, case.n, size)
    assert case.apart(case.invariant.compose(points), tensor) < 1e-8
    homogeneous = torch.nn.functional.pad(shape, (0, 1), value=1.0)
    scaled = homogeneous * torch.linspace(0.5, 2, case.n).double()[:, None].mul(torch.tensor(-1.0)) ** 3
    assert case.apart(case.invariant.compose(scaled), tensor) < 1e-10
    # a collineation of space (affinity) is what is left open
    moved = homogeneous @ (torch.eye(size) + 0.1 * random(size, size))
    moved = moved if case.frame != "affine" else torch.cat([moved[..., :-1], homogeneous[..., -1:]], -1)
    assert case.apart(case.invariant.compose(moved), tensor) < 1e-10
    assert case.invariant.decompose(torch.zeros_like(tensor)).abs().max() == 0


@most
def test_batch_is_loop_and_order_and_weights_of_views_are_what_they_should_be(case):
    points, _ = case.scene(case.many, batch=(2, 2), seed=5, sigma=0.5)
    whole = case.fit(points)
    alone = case.fit(tuple(p[1, 0] for p in points))
    assert case.apart(whole.tensor[1, 0], alone.tensor) < case.exact and whole.status.shape == (2, 2)
    torch.testing.assert_close(whole.singular_values[1, 0], alone.singular_values)
    order = torch.randperm(case.many, generator=seeded())
    assert case.apart(case.fit(tuple(p[..., order, :] for p in points)).tensor, whole.tensor) < case.exact
    kept = case.fit(tuple(p[..., 2:, :] for p in points))
    weights = torch.ones(case.many, dtype=torch.float64)
    weights[:2] = 0
    wild = tuple(torch.cat([1e3 * p[..., :2, :].flip(-1), p[..., 2:, :]], -2) for p in points)
    missing = tuple(torch.cat([torch.full_like(p[..., :2, :], torch.nan), p[..., 2:, :]], -2) for p in points)
    for given, weight in ((wild, weights), (missing, None), (wild, weights.masked_fill(weights == 0, torch.nan))):
        found = case.fit(given, weights=weight)
        assert case.apart(found.tensor, kept.tensor) < case.exact
        assert torch.equal(found.status, kept.status)
    twice = case.fit(tuple(torch.cat([p, p[..., :3, :]], -2) for p in points))
    weights = torch.tensor([2.0] * 3 + [1.0] * (case.many - 3)).double()
    assert case.apart(case.fit(points, weights=weights).tensor, twice.tensor) < case.exact
    rounded = tuple(p.float() for p in points)
    single = case.fit(rounded)
    dtypes = (single.tensor, *single.motion, case.sampson(single.tensor, rounded), case.invariant.compose(single.motion[0]))
    assert {part.dtype for part in dtypes} == {torch.float32} and case.apart(single.tensor.double(), whole.tensor) < 1e-3
    empty = case.fit(tuple(p[:0] for p in points)).check()
    assert empty.tensor.shape[:2] == (0, 2) and empty.motion[0].shape[:2] == (0, 2)


@most
def test_one_bad_problem_leaves_the_others_alone(case):
    points, _ = case.scene(case.many, batch=(3,), seed=6, sigma=0.2)
    good = case.fit(points)
    bad = tuple(p.clone() for p in points)
    for p in bad:
        p[0] = torch.nan
        p[2] = p[2, :1]  # one view, again and again
    found = case.fit(bad)
    assert found.status.tolist() == [dyn.Status.TOO_FEW, dyn.Status.OK, dyn.Status.DEGENERATE]
    assert case.apart(found.tensor[1], good.tensor[1]) < case.exact
    for x in (found.tensor, found.singular_values, *found.motion, case.refine(found, bad).tensor):
        assert x.isfinite().all()
    assert not found.uncertainty.isnan().any() and found.uncertainty[1].isfinite()
    with pytest.raises(ValueError, match="problem 0 of 3: TOO_FEW"):
        found.check()


@pytest.mark.parametrize("case", [SHAPE_CASES[i] for i in (0, 5, 7, 9, 10)], ids=repr)
def test_gradients(case):
    for views in (case.minimal, case.minimal + 2):
        points, _ = case.scene(views, seed=8, sigma=0.2)
        times = points[case.n :]
        x = ((torch.stack(points[: case.n], -2) - 300) / 100).requires_grad_()
        weight = random(case.size)

        def gauge_free(x, case=case, times=times, weight=weight):
            tensor = case.fit((*x.unbind(-2), *times)).tensor.reshape(-1, case.size)
            return (tensor @ weight).square().sum()

        # the basis of a moving shape is found by a descent, to nine digits here: differences over 1e-4 leave it five
        rtol = 1e-3 if "basis" in repr(case) else 1e-6
        assert torch.autograd.gradcheck(gauge_free, x, eps=1e-4, atol=1e-7, rtol=rtol, fast_mode=True)


@forms
def test_sampson_is_the_distance_to_the_nearest_image(case):
    points, shape = case.scene(4, batch=(2,), seed=9, sigma=0.3)
    tensor = case.invariant.compose(shape)
    found = dyn.sampson(replace(case.invariant, points=None), tensor, *points)
    exact, _ = case.scene(4, batch=(2,), seed=9)
    assert dyn.sampson(case.invariant, tensor, *exact).max() < 1e-6
    assert case.invariant.score(tensor, *exact).max() < 1e-9
    assert (case.invariant.score(tensor, *points) > 1e-6).all()
    # brute force: Gauss-Newton over all entries of the camera
    x, world = torch.stack(points, -2)[1, 2], torch.nn.functional.pad(shape[1], (0, 1), value=1.0)
    k, d = case.dims
    rows = d if case.frame == "affine" else d + 1
    truth = torch.stack(exact, -2)[1, 2]

    def error(camera):
        image = world @ camera.reshape(rows, k + 1).T
        return ((image if rows == d else image[:, :d] / image[:, d:]) - x).flatten()

    lifted = torch.nn.functional.pad(truth, (0, 1), value=1.0)
    across = [torch.linalg.svd(p[None], full_matrices=True).Vh[1:] for p in lifted]
    blocks = torch.cat([torch.kron(a.contiguous(), q[None]) for a, q in zip(across, world, strict=True)])
    camera = torch.linalg.svd(blocks).Vh[-1]
    camera = (camera.reshape(d + 1, k + 1) / camera[-1])[:rows].flatten()
    for _ in range(6):
        camera = camera - torch.linalg.pinv(torch.func.jacrev(error)(camera), rtol=1e-10) @ error(camera)
    torch.testing.assert_close(found[1, 2], error(camera).norm(), rtol=2e-2, atol=0)


@some
def test_refinement_lowers_the_distances(case):
    points, _ = case.scene(MANY, batch=(6,), seed=10, sigma=0.5)
    linear = dyn.fit(case.invariant, *points)
    refined = dyn.refine(linear, *points)
    cost = [dyn.sampson(case.invariant, s.tensor, *points).square().sum(-1) for s in (linear, refined)]
    assert (cost[1] <= cost[0] * (1 + 1e-9)).all()
    assert ((refined.sigma > 0.25) & (refined.sigma < 1)).all()
    fresh, _ = case.scene(MANY, batch=(6,), seed=10)
    assert dyn.sampson(case.invariant, refined.tensor, *fresh).median() < 1.5
    residual, slope = case.invariant.linearize(
        (refined.motion[0],),
        (torch.stack([torch.nn.functional.pad(p, (0, 1), value=1.0) for p in points], -2),),
        (torch.ones(6).double(),),
    )
    torch.testing.assert_close(
        residual.unflatten(-1, (MANY, -1)).norm(dim=-1), dyn.sampson(case.invariant, refined.tensor, *points), rtol=1e-4, atol=1e-6
    )
    # at the minimum of the cost it does not change to first order
    assert ((slope @ residual[..., None])[..., 0].norm(dim=-1) < 1e-3 * slope.flatten(1).norm(dim=-1)).all()


@pytest.mark.parametrize("case", [SHAPE_CASES[i] for i in (5, 6, 8)], ids=repr)
def test_missing_points_lose_their_own_rows_only(case):
    points, shape = case.scene(12, batch=(4,), seed=11)
    x = torch.stack(points, -2)
    gone = torch.rand(x.shape[:-1], generator=seeded(1)) < 0.15
    if case.frame == "plane":
        gone[..., :4] = False
    assert (gone.any(-1).sum(-1) > 2).all()
    seen = x.masked_fill(gone[..., None], torch.nan)
    solution = ok(dyn.fit(case.invariant, *seen.unbind(-2)))
    assert case.apart(solution.tensor, case.invariant.compose(shape)) < 1e-7
    assert solution.singular_values.isfinite().all()
    distance = dyn.sampson(case.invariant, solution.tensor, *seen.unbind(-2))
    told = 2 * (~gone).sum(-1) > (8 if case.frame == "affine" else 11)
    assert torch.equal(distance.isfinite(), told) and distance[told].max() < 1e-5
    assert dyn.refine(solution, *seen.unbind(-2)).tensor.isfinite().all()


@pytest.mark.parametrize("case", [SHAPE_CASES[i] for i in (0, 2, 5)], ids=repr)
def test_a_basis_without_a_frame_is_degenerate(case):
    _, shape = case.scene(1, batch=(2,), seed=12)
    shape[0, 2] = 0.4 * shape[0, 0] + 0.6 * shape[0, 1]  # three points of a line
    turn = torch.linalg.qr(random(2, MANY, 3, 3)).Q
    seen = shape[:, None] @ turn.mT
    points = (500 * seen[..., :2] / (6 + seen[..., 2:])).unbind(-2)
    for given in (points, tuple(p.float() for p in points)):
        assert dyn.fit(case.invariant, *given).status.tolist() == [dyn.Status.DEGENERATE, dyn.Status.OK]
    assert case.invariant.compose(shape)[0].abs().max() == 0
    if case.n == 8:  # nearly on a line: the frames of the views are what the noise makes of them
        noisy = [p + random(*p.shape, seed=i) for i, p in enumerate(points)]
        assert dyn.fit(case.invariant, *noisy).status.tolist() == [dyn.Status.AMBIGUOUS, dyn.Status.OK]


def test_affine_views_that_share_no_basis_stay_incomplete():
    case = STATIC[-1]
    points, shape = case.scene(8, batch=(1,), seed=13)
    x = torch.stack(points, -2)
    x[:, ::2, 5:] = torch.nan
    x[:, 1::2, :4] = torch.nan
    apart = dyn.fit(case.invariant, *x.unbind(-2))
    assert apart.status.tolist() == [dyn.Status.TOO_FEW] and apart.singular_values.isfinite().all()
    # two whole views are enough, and what the others lack follows from them
    whole = torch.cat([x, torch.stack(case.scene(8, batch=(1,), seed=13)[0], -2)[:, :2]], dim=1)
    assert case.apart(ok(dyn.fit(case.invariant, *whole.unbind(-2))).tensor, case.invariant.compose(shape)) < 1e-8


# The algebra against what it is derived from: determinants, closed forms, exact counts.


FREE = {("general", 6): 5, ("general", 7): 11, ("general", 8): 23, ("plane", 6): 3, ("plane", 7): 6, ("plane", 8): 9}


def contracted(tensor, points, lines):
    """The form on the points whose slot takes a point and on the lines of the others."""
    vectors = [p if a == 2 else line for a, p, line in zip(shape_rows.PROFILES[4 + len(points)], points, lines, strict=True)]
    for u in vectors:
        tensor = torch.tensordot(u, tensor, dims=1)
    return tensor


@pytest.mark.parametrize(("frame", "n"), FREE)
def test_the_form_is_the_determinant_of_four_lines(frame, n):
    others = random(n - 4, 4)
    cameras = dual_cameras(others) if frame == "general" else reference_cameras(others)
    tensor = shape_rows.form(cameras).reshape((3,) * (n - 4))
    ratios = []
    for seed in range(4):
        first, second = random(2, n - 4, 3, seed=seed)
        rows = [torch.stack([a, b]) @ c for a, b, c in zip(first, second, cameras, strict=True)]
        chosen = [r[:a] for r, a in zip(rows, shape_rows.PROFILES[n], strict=True)]
        ratios.append(contracted(tensor, torch.linalg.cross(first, second), first) / torch.linalg.det(torch.cat(chosen)))
    torch.testing.assert_close(torch.stack(ratios), ratios[0].sign() * torch.ones(4).double())


def test_closed_forms_beside_a_reference_plane():
    v = random(4, 3)
    six = shape_rows.form(shape_rows.finite_cameras(v[:2])).reshape(3, 3)
    p, q = random(2, 3, seed=1)
    torch.testing.assert_close((p @ six @ q).abs(), (torch.linalg.cross(p, q) @ (v[0] - v[1])).abs())
    eight = shape_rows.form(shape_rows.finite_cameras(v)).reshape(3, 3, 3, 3)
    lines = random(4, 3, seed=2)
    others = [torch.linalg.det(torch.stack([lines[j] for j in range(4) if j != i])) for i in range(4)]
    expected = sum((-1) ** i * (lines[i] @ v[i]) * others[i] for i in range(4))
    torch.testing.assert_close(contracted(eight, lines, lines).abs(), expected.abs())


@pytest.mark.parametrize(("frame", "n"), FREE)
def test_free_coefficients_are_those_that_exact_counts_leave(frame, n):
    general = frame == "general"
    basis = shape_rows.free(n, torch.device("cpu")) if general else shape_rows.plane_map(n, torch.device("cpu")).mT
    assert rank(basis) == FREE[frame, n]
    if (frame, n) != ("plane", 8):  # among the tests of counting
        synthetic = counting.count("shape_tensor", points=n, general=general, synthetic=True, images=0)
        assert 3 ** (n - 4) - synthetic.rank == FREE[frame, n]
    counted = counting.count("shape_tensor", points=n, general=general, synthetic=True, images=5)
    assert counted.rank == 3 ** (n - 4) - 1 and counted.minimal == ShapeTensor(frame, n).minimal()
    # all points at one place u: of the basis, or anywhere
    places = torch.cat([torch.eye(3), torch.ones(1, 3)]).double() if general else random(50, 3)
    rows = shape_rows._products(torch.nn.functional.normalize(places, dim=-1)[:, None].expand(-1, n - 4, 3))
    assert (rows @ basis.mT).abs().max() < 1e-12
    if (frame, n) == ("plane", 8):
        # products of vectors within planes span what annihilates the tensors: nine dimensions are left
        assert 81 - FREE[frame, n] == counting.dim_v(3, 4, 2) == 72
        vectors = random(4, 200, 1, 2) @ random(200, 2, 3, seed=1)
        products = torch.einsum("na,nb,nc,nd->nabcd", *vectors[:, :, 0]).flatten(1)
        assert rank(products) == 72 and (products @ basis.mT).abs().max() < 1e-10


@pytest.mark.parametrize("case", [c for c in SHAPE_CASES if (c.frame, c.n) in FREE], ids=repr)
def test_the_tensor_is_the_null_vector_of_all_coefficients(case):
    """The reference that solves for all of 9, 27, 81: many more views without the synthetic constraints, no more with them."""
    points, shape = case.scene(10, seed=3)
    x = torch.stack([torch.nn.functional.pad(p, (0, 1), value=1.0) for p in points], -2)
    rows = shape_rows._products(shape_rows.canonical(x)[0]).flatten(0, 1)
    assert rank(rows) == rows.shape[1] - 1
    null = torch.linalg.svd(rows).Vh[-1].reshape(case.invariant.shape())
    assert case.apart(null, case.invariant.compose(shape)) < 1e-7


def test_frame_of_the_view_is_that_of_the_four_points():
    x = torch.nn.functional.pad(random(3, 7, 2), (0, 1), value=1.0)
    q, noise = shape_rows.canonical(x)
    for view, found in zip(x, q, strict=True):
        scale = torch.linalg.solve(view[:3].mT, view[3])
        expected = torch.nn.functional.normalize(torch.linalg.solve(view[:3].mT * scale, view[4:].mT).mT, dim=-1)
        torch.testing.assert_close(found * (found * expected).sum(-1, keepdim=True).sign(), expected)
    lines = shape_rows.lines_through(q)
    torch.testing.assert_close(lines @ lines.mT, torch.eye(2).double().expand(3, 3, 2, 2))
    assert (lines @ q[..., None]).abs().max() < 1e-14 and (noise > 0).all()
    # the noise of a point is about what moving all points does to it
    turns = torch.stack(
        [shape_rows.canonical(x + 1e-6 * random(3, 7, 3, seed=s) * torch.tensor([1, 1, 0]))[0] - q for s in range(60)]
    )
    size = shape_rows.local(x)[1][:, None]
    measured = turns.square().sum(-1).mean(0).sqrt() / (1e-6 * size)
    assert ((measured / noise > 0.2) & (measured / noise < 1.5)).all()


def test_misuse_is_a_value_error_with_its_remedy():
    points, _ = SHAPE_CASES[2].scene(4)
    tensor = dyn.fit(ShapeTensor, *points).tensor
    assert_refused(
        (lambda: dyn.fit(ShapeTensor, *points[:5]), r"'general' needs at least 6 points, got 5; .*'affine'"),
        (lambda: dyn.fit(ShapeTensor("affine"), *points[:4]), "at least 5 points, got 4; add points"),
        (lambda: dyn.fit(ShapeTensor, *points, *points), "takes 6, 7 or 8 points, got 16"),
        (lambda: dyn.fit(ShapeTensor("general", 7), *points), "takes 7 points, .* got 8 arguments"),
        (lambda: dyn.fit(ShapeTensor, *points[:7], points[7][:, :1]), r"point 8 .*expected \(\*batch, n, 2\)"),
        (lambda: dyn.fit(ShapeTensor, *points[:7], points[7][:2]), "all points need the same"),
        (lambda: dyn.fit(ShapeTensor, *points[:7], points[7].float()), "all points need one dtype"),
        (lambda: dyn.fit(ShapeTensor, *points, static=torch.ones(4)), "no rows for labelled static"),
        (lambda: dyn.robust_fit(ShapeTensor, *points), "fit again with weights"),
        (lambda: dyn.core.algebraic(ShapeTensor, tensor, *points), "no single algebraic residual"),
        (lambda: dyn.sampson(ShapeTensor, tensor[0], *points), r"must be \(\*batch, 3, 3, 3, 3\)"),
        (lambda: ShapeTensor("metric"), "one of general, plane, affine, got 'metric'"),
        (lambda: ShapeTensor.minimal(), "does not know its number of points"),
        (lambda: ShapeTensor.decompose(tensor), "does not know its number of points"),
    )
    assert_refused((lambda: dyn.fit(ShapeTensor, *points, times=points[0]), "no argument 'times'"), error=TypeError)

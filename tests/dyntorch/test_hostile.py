"""Hostile numbers and types: a ValueError that names the argument, or an honest status, and never a NaN."""

import math
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import pytest
import torch
from torch import Tensor

import dyntorch as dyn
from dyntorch import scenes
from dyntorch.counting import count, dim_v
from dyntorch.geometry.bundle import bundle_adjust
from dyntorch.geometry.triangulation import reproject, resect, triangulate
from dyntorch.invariants.multibody import multibody_matrix
from dyntorch.numerics.blocks import Draws
from dyntorch.numerics.nullspace import eigenvalues, null_space, real_eigenvalues, spectrum
from dyntorch.numerics.subspaces import affine_factorization, canonical_correlation, orthonormal_basis
from dyntorch.tasks.planes.closed_forms import infinity_closed_form
from dyntorch.tasks.segment.affine import affine_segmentation
from tests.draws import seeded
from tests.grid import assert_refused

F64 = torch.float64


def numbers(*shape: int, seed: int = 0) -> Tensor:
    return torch.rand(*shape, generator=seeded(seed), dtype=F64)


CAMERAS, POINTS = numbers(5, 3, 4), numbers(20, 4, seed=1)
IMAGES = reproject(CAMERAS, POINTS)
FUNCTIONS: dict[str, tuple[Callable[..., Any], tuple[Tensor, ...]]] = {
    "null_space": (null_space, (numbers(10, 4),)),
    "orthonormal_basis": (orthonormal_basis, (numbers(10, 3),)),
    "canonical_correlation": (canonical_correlation, (numbers(3, 9, 2), numbers(4, 9, 2))),
    "affine_factorization": (affine_factorization, (numbers(3, 10, 2),)),
    "triangulate": (triangulate, (CAMERAS, IMAGES)),
    "resect": (resect, (POINTS, IMAGES)),
    "reproject": (reproject, (CAMERAS, POINTS)),
    "bundle_adjust": (lambda x, p, y: bundle_adjust(x, None, p, y, iterations=2), (IMAGES, CAMERAS, POINTS)),
    "affine_segmentation": (affine_segmentation, (numbers(40, 2), numbers(40, 2, seed=1))),
    "multibody_matrix": (lambda a, b: multibody_matrix(a, b, 2), (numbers(60, 2), numbers(60, 2, seed=1))),
}


def hostile(x: Tensor) -> Iterator[Any]:
    """Other types, other shapes, other numbers."""
    yield from (x.numpy(), x.tolist(), None, "x", x.long(), x > 0, x.half(), x.bfloat16(), x.to(torch.complex128), x.float())
    yield from (x * torch.nan, x * torch.inf, x * 1e300, x * 1e-300)
    for value in (torch.nan, 1e300):
        one = x.clone()
        one.view(-1)[0] = value
        yield one
    yield from (x.sum(), x.flatten(), x.expand(3, *x.shape), x[None][:0], x[..., :0, :], x[:0], x[..., :1, :])
    yield x.expand(2, 1, *x.shape)


def tensors(value: Any) -> Iterator[Tensor]:
    if isinstance(value, Tensor):
        yield value
    elif isinstance(value, tuple):
        for part in value:
            yield from tensors(part)
    elif hasattr(value, "__dict__"):
        yield from tensors(tuple(vars(value).values()))


@pytest.mark.parametrize("name", FUNCTIONS)
def test_anything_gives_a_value_error_or_numbers(name):
    function, arguments = FUNCTIONS[name]

    def tried(*given: Any) -> Any:
        try:
            return function(*given)
        except ValueError as error:
            return str(error)

    for i, argument in enumerate(arguments):
        for bad in hostile(argument):
            found = tried(*arguments[:i], bad, *arguments[i + 1 :])
            assert not isinstance(found, str) or (len(found) < 300 and "\n" not in found)
            assert not any(x.is_floating_point() and x.isnan().any() for x in tensors(found))


@pytest.mark.parametrize("bad", [torch.nan, torch.inf, 1e300, 1e-310])
def test_eigenvalues_of_a_hostile_matrix_leave_its_neighbours_alone(bad):
    matrices = numbers(3, 4, 4)
    matrices = matrices + matrices.mT
    hostile = matrices.clone()
    hostile[1] = bad
    values, vectors = spectrum(hostile)
    expected = spectrum(matrices)
    for found in (values, eigenvalues(hostile)):
        assert torch.allclose(found[::2], expected[0][::2], rtol=0, atol=1e-12) and found.isfinite().all()
    assert torch.equal(vectors[::2], expected[1][::2])
    held = bad if math.isfinite(bad) else 0.0
    assert values[1, -1] == pytest.approx(4 * held, rel=1e-9)
    assert real_eigenvalues(hostile).amax(-1)[0] == pytest.approx(float(values[0, -1]))


@pytest.mark.parametrize("frame", ["general", "plane"])
def test_a_failed_shape_leaves_the_scores_of_others_alone(frame):
    structure = numbers(6, 4)
    if frame == "plane":
        structure[:4, 2] = 0.0
    points = reproject(numbers(4, 3, 4, seed=2), structure).unbind(-2)
    family = dyn.ShapeTensor(frame, 6)
    tensor = family.compose(structure)
    found = family.score(torch.stack([torch.zeros_like(tensor), tensor]), *(x.expand(2, -1, -1) for x in points))
    assert found[0].isnan().all() and found[1].max() < 1e-9


@pytest.mark.parametrize("scale", [1e160, 1e300, 0.0])
def test_times_out_of_range_leave_other_moving_shapes_alone(scale):
    rows = dyn.Polynomial(1).rows(torch.linspace(-1, 1, 12, dtype=F64))
    x = torch.einsum("vb,bnk,vkd->vnd", rows, numbers(2, 8, 3), numbers(12, 3, 2, seed=1)).expand(2, -1, -1, -1)
    both = dyn.shapes.fit_shapes(x, torch.stack([rows, scale * rows]))
    alone = dyn.shapes.fit_shapes(x[:1], rows[None])
    assert torch.allclose(both.residual[0], alone.residual[0], rtol=0, atol=1e-9) and both.residual[0].max() < 1e-9
    assert not any(part.is_floating_point() and part.isnan().any() for part in tensors(both))


@pytest.mark.parametrize("scale", [1e-160, 1e300, torch.nan])
def test_images_out_of_range_leave_other_factorizations_alone(scale):
    both = dyn.tasks.projective_factorization(torch.stack([IMAGES, scale * IMAGES]), 4)
    alone = dyn.tasks.projective_factorization(IMAGES, 4)
    assert both.residual[0] < 1e-9 and alone.residual < 1e-9
    assert not any(part.is_floating_point() and part.isnan().any() for part in tensors(both))


def test_cameras_of_any_unit_and_such_that_are_not_finite():
    turn = torch.linalg.qr(torch.randn(5, 3, 3, generator=seeded(4), dtype=F64))[0]
    shape, cameras, _ = affine_factorization(numbers(20, 3) @ turn[:, :2].mT)
    expected, known = dyn.numerics.metric_upgrade(shape, cameras)
    assert known
    for scale in (1e-200, 1e200):
        found, known = dyn.numerics.metric_upgrade(shape, scale * cameras)
        assert known and torch.allclose(found / found.norm(), expected / expected.norm(), atol=1e-9)
    for bad in (torch.nan, torch.inf):
        found, known = dyn.numerics.metric_upgrade(shape, bad * cameras)
        assert not known and torch.equal(found, shape)


def test_planes_whose_entries_lie_far_apart_leave_others_alone():
    draw = seeded()
    exponents = -300 * torch.rand(300, 4, 3, 3, generator=draw, dtype=F64)
    planes = torch.randn(300, 4, 3, 3, generator=draw, dtype=F64) * 10**exponents
    e, n = torch.rand(2, 4, 3, generator=draw, dtype=F64)
    planes[7] = torch.eye(3, dtype=F64) + e[:, :, None] * n[:, None, :]
    found, residual = infinity_closed_form(planes)
    assert residual[7] < 1e-9 and torch.allclose(found[7].abs(), torch.eye(3, dtype=F64), atol=1e-7) and found.isfinite().all()


def test_a_lens_is_not_believed_where_points_leave_the_range():
    views = scenes.two_view(60, sigma=0.1, generator=seeded()).views
    found = dyn.geometry.fit_distortion(1e160 * views[0], views[1], sizes=((640, 480),) * 2)
    assert not found.significant


def test_infinite_weights_are_missing_matches():
    x1, x2 = numbers(60, 2), numbers(60, 2, seed=1)
    weights = torch.ones(60, dtype=F64)
    weights[3] = torch.inf
    for found in (affine_segmentation(x1, x2, weights), multibody_matrix(x1, x2, 2, weights=weights)):
        assert all(x.isfinite().all() for x in tensors(found)) and found.labels[3] == 0


def test_random_matches_of_a_line_are_not_taken_for_a_collineation():
    noise = [torch.randn(400, 12, 1, generator=seeded(v), dtype=F64) for v in range(2)]
    assert (dyn.fit(dyn.Collineation(1), *noise).status == dyn.Status.OK).double().mean() < 0.01
    for n, sigma in ((8, 0.01), (12, 0.03), (20, 0.1)):
        x2 = 2 * torch.rand(400, n, 1, generator=seeded(3), dtype=F64) - 1
        x1 = (x2 + 0.3) / (0.2 * x2 + 1) + sigma * torch.randn(x2.shape, generator=seeded(4), dtype=F64)
        assert (dyn.fit(dyn.Collineation(1), x1, x2).status == dyn.Status.OK).double().mean() > 0.97


def test_a_singular_collineation_is_degenerate():
    # all points of view 1 but one are the same: the only matrix that fulfils all matches maps onto that point
    x1, x2 = torch.zeros(12, 1, dtype=F64), torch.randn(12, 1, generator=seeded(), dtype=F64)
    x1[3] = 1.0
    assert dyn.fit(dyn.Collineation(1), x1, x2).status == dyn.Status.DEGENERATE


def test_what_cannot_be_mapped_over_says_what_to_do():
    views = tuple(x.expand(2, *x.shape) for x in scenes.planar(40, generator=seeded()).views)
    one, fit, robust = [x[0] for x in views], partial(dyn.fit, dyn.HomographyTensor), partial(dyn.robust_fit, dyn.HomographyTensor)
    times, points = torch.linspace(0, 1, 20).double(), torch.randn(6, 20, 2, generator=seeded()).double()

    def mapped(function: Callable[..., Tensor], *given: Tensor) -> Callable[[], Any]:
        return lambda: torch.func.vmap(function)(*given)

    weights, kinds = -torch.ones(2, 40), torch.ones(2, 40, dtype=torch.long)
    everything = r"mapped over by torch.func.vmap; give all problems at once"
    assert_refused(
        (mapped(lambda *v: robust(*v, threshold=1.5), *views), everything),
        (mapped(lambda *v: dyn.align_planar(*v), *views), everything),
        (mapped(lambda *v: fit(*v).check().tensor, *views), r"status is mapped over .* look at its status behind that"),
        (
            mapped(lambda w: fit(*one, weights=w).tensor, weights),
            "weights must not be negative, got -1; use 0 to leave a match out",
        ),
        (mapped(lambda d: fit(*one, dimensions=d).tensor, kinds), r"dimensions is mapped over .* from outside of the function"),
        (
            mapped(lambda t: dyn.fit(dyn.DynamicShapeTensor, *points, times=t).tensor, times.expand(2, -1)),
            r"holds numbers that torch.func transforms .* an interval of times",
        ),
    )


def test_solutions_that_are_mapped_over_have_statuses_and_a_representation():
    views = scenes.planar(40, sigma=0.5, batch=3, generator=seeded()).views
    views[0][1, :20] = torch.nan
    shown = []

    def answers(*views: Tensor) -> tuple[Tensor, Tensor]:
        solution = dyn.fit(dyn.HomographyTensor, *views)
        shown.append(repr(solution))
        return solution.status, solution.singular_values

    status, values = torch.func.vmap(answers)(*views)
    expected = dyn.fit(dyn.HomographyTensor, *views)
    assert status.equal(expected.status) and int(status[1]) == dyn.Status.TOO_FEW
    assert shown == ["Solution(HomographyTensor, matches=40, batch=(): mapped over)"]
    torch.testing.assert_close(values, expected.singular_values)


def test_a_solution_is_indexed_and_moved_like_a_tensor():
    scene = scenes.planar(40, batch=6, sigma=0.5, generator=seeded())
    views = [x.unflatten(0, (2, 3)) for x in scene.views]
    whole = dyn.refine(dyn.fit(dyn.HomographyTensor, *views), *views, iterations=3)
    for key in (1, slice(0, 1), (1, 2), torch.tensor([[True, False, True], [False, True, False]])):
        part = whole[key]
        for one, two in zip((part.tensor, part.sigma, *part.motion), (whole.tensor, whole.sigma, *whole.motion), strict=True):
            torch.testing.assert_close(one, two[key])
        torch.testing.assert_close(part.singular_values, whole.singular_values[key])
    dyn.refine(whole[1], *(x[1] for x in views), iterations=1)
    assert whole.to(torch.float32).motion[0].dtype == torch.float32 and whole.to("cpu").tensor.equal(whole.tensor)
    assert ", sigma about " in repr(whole) and ", sigma 0." in repr(whole[0, 0])
    with pytest.raises(IndexError, match="one problem"):
        whole[0, 0][0]
    with pytest.raises(ValueError, match="float32 or float64"):
        whole.to(torch.float16)


def test_draws_of_a_problem_do_not_depend_on_the_others():
    both, one = Draws(2, seeded(), torch.device("cpu")), Draws(2, seeded(), torch.device("cpu"))
    both(torch.arange(2), 5)
    first, second = both(torch.arange(2), 3), (one(torch.tensor([1]), 5), one(torch.tensor([1]), 3))[1]
    assert torch.equal(first[1], second[0])


def test_half_precision_complex_matches_and_what_would_not_fit_are_refused():
    for dtype, words in ((torch.float16, r"too few digits; use .float\(\)"), (torch.complex64, r"use .double\(\)")):
        with pytest.raises(ValueError, match=words):
            dyn.fit(dyn.HomographyTensor, *[numbers(40, 2).to(dtype)] * 3)
    with pytest.raises(ValueError, match=r"times must be 4 finite numbers, one per view, got shape \(4, 2\)"):
        dyn.reconstruct(numbers(4, 30, 2), motion="constant_velocity_2d", times=torch.zeros(4, 2))
    for views, words in (([2] * 30, "unknowns are too many"), ([10**6] * 2, "are too many"), ([3000], "projections have")):
        with pytest.raises(ValueError, match=words):
            count(max(3, len(views), views[0]) if len(views) == 1 else 50, views=views)
    for n, m, k in ((3, 5000, 2), (2, 10**9, 1), (60, 60, 59)):
        with pytest.raises(ValueError, match="take a smaller"):
            dim_v(n, m, k)
    assert dim_v(3, 500, 500) == 3**500
    x = torch.zeros(1, 3, 2, dtype=F64)
    with pytest.raises(ValueError, match="unknowns; up to 4,096 are estimated"):
        dyn.fit(dyn.GrassmannTensor(50, (2,) * 25 + (1,)), *([x] * 26))


def test_tasks_take_thresholds_beyond_the_range():
    views = tuple(numbers(30, 3, seed=v) for v in range(3))
    for threshold in (1e300, 1e-300):
        found = dyn.align_points(*views, model="rigid", threshold=threshold, generator=seeded())
        assert not any(x.is_floating_point() and x.isnan().any() for x in (found.A, found.sigma, found.covariance))
    one = tuple(x.clone() for x in views)
    one[0][0, 0] = 1e300
    assert dyn.align_points(*one, model="rigid", generator=seeded()).A.isfinite().all()

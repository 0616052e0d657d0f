"""segment: synthetic scenes of one to three bodies with outliers, and what the result must and must not depend on."""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import pytest
import torch

import dyntorch as dyn
from dyntorch import scenes
from dyntorch.core.outcome import Status
from dyntorch.geometry.epipolar import sampson_squared
from dyntorch.geometry.homogeneous import apply
from dyntorch.geometry.homography import homography_sampson_squared
from dyntorch.metrics import misclassification, relative_error
from dyntorch.tasks.segment.result import SegmentNotice
from tests.dyntorch.tasks.segment.videos import F64, draw

NAMES = ("labels", "bodies", "fundamentals", "homographies", "probabilities", "residuals", "coherence", "status", "threshold")


def scene_of(n: int = 80, bodies: int = 2, seed: int = 1, **options):
    return scenes.bodies(n, bodies, **{"sigma": 0.5, **options}, generator=draw(seed))


def two_bodies(seed: int = 0, **options):
    return scene_of(120, 2, seed, **{"outliers": 0.2, **options})


def random_points(n: int, seed: int) -> torch.Tensor:
    return 500 * torch.rand(n, 2, generator=draw(seed), dtype=F64)


def codes(found):
    return {notice.code for notice in found.warnings}


def checked(x1, x2, seed: int = 0, **options):
    """The result, its parts checked against each other."""
    found = dyn.segment(x1, x2, generator=draw(seed), **options)
    batch, n, count = x1.shape[:-2], x1.shape[-2], found.fundamentals.shape[-3]
    assert found.labels.shape == found.residuals.shape == found.coherence.shape == (*batch, n)
    assert found.probabilities.shape == (*batch, n, count + 1)
    assert found.homographies.shape == found.fundamentals.shape == (*batch, count, 3, 3)
    assert found.bodies.shape == found.status.shape == found.threshold.shape == batch
    assert all(bool(getattr(found, name).isfinite().all()) for name in NAMES[:8])
    assert bool((found.labels >= 0).all()) and bool((found.labels <= found.bodies[..., None]).all())
    assert repr(found).startswith("Segmentation(")
    return found


def segmented(scene, seed: int = 9, **options):
    return checked(*scene.views, seed, **options)


def error(found, scene) -> float:
    return float(misclassification(found.labels, scene.labels).max())


@pytest.mark.slow
@pytest.mark.parametrize("known", [True, False])
@pytest.mark.parametrize(
    ("bodies", "outliers", "worst"), [(1, 0.5, 0.03), (2, 0.0, 0.0), (2, 0.3, 0.03), (2, 0.5, 0.04), (3, 0.2, 0.05)]
)
def test_bodies_and_outliers(bodies, outliers, worst, known):
    for seed in range(2):
        scene = scenes.bodies(80 * bodies, bodies, sigma=0.5, outliers=outliers, generator=draw(seed))
        found = segmented(scene, bodies=bodies if known else None).check()
        assert int(found.bodies) == bodies and int(found.status) == Status.OK
        assert error(found, scene) <= worst
        wrong = scene.labels == 0
        if bool(wrong.any()):
            assert float(found.coherence[~wrong].median()) > 0.35 > 0.2 > float(found.coherence[wrong].median())


def test_interleaved_bodies_by_geometry_alone():
    scene = two_bodies(1, interleaved=True, outliers=0.1)
    found = segmented(scene, bodies=2, spatial=False).check()
    assert error(found, scene) < 0.15  # matches near both epipolar lines are anyone's
    assert bool((found.coherence == 0).all())


def test_planes_and_rotations_have_homographies():
    scene = scenes.bodies(240, 3, sigma=0.3, planar=(2,), rotating=(3,), generator=draw(2))
    found = segmented(scene, bodies=3).check()
    assert error(found, scene) < 0.02
    assert sorted(found.models) == ["fundamental", "homography", "homography"]
    for k, model in enumerate(found.models):
        members = found.labels == k + 1
        x1, x2 = (x[members] for x in scene.views)
        flat = model == dyn.tasks.BodyModel.HOMOGRAPHY
        assert flat == (int(scene.labels[members].mode().values) > 1)
        if flat:
            assert float((apply(found.homographies[k], x1) - x2).norm(dim=-1).median()) < 0.6
            assert float(found.homographies[k].norm()) == pytest.approx(1.0)
        else:
            assert bool((found.homographies[k] == 0).all())


def test_parts_of_the_result_fit_together():
    scene = two_bodies(3, planar=(2,))
    x1, x2 = scene.views
    found = segmented(scene)
    sizes = torch.bincount(found.labels)[1:].tolist()
    assert sizes == sorted(sizes, reverse=True) and len(sizes) == int(found.bodies) == len(found.models) == 2
    torch.testing.assert_close(found.fundamentals.flatten(1).norm(dim=-1), torch.ones(2, dtype=F64))
    assert float(torch.linalg.det(found.fundamentals).abs().max()) < 1e-12
    torch.testing.assert_close(found.probabilities.sum(-1), torch.ones(120, dtype=F64))
    assert torch.equal(found.probabilities.argmax(-1), found.labels)
    assert float(found.threshold) == 2.5
    flat = torch.tensor([model == dyn.tasks.BodyModel.HOMOGRAPHY for model in found.models])[:, None]
    squares = homography_sampson_squared(found.homographies, x1, x2), sampson_squared(found.fundamentals, x1, x2)
    distance = torch.where(flat, *squares).sqrt()
    own = distance.gather(0, (found.labels - 1).clamp(min=0)[None])[0]
    torch.testing.assert_close(found.residuals, torch.where(found.labels > 0, own, distance.amin(0)), rtol=1e-5, atol=1e-6)
    assert float(found.residuals[found.labels > 0].max()) < 3 * 2.5
    assert found.check() is found and found.warnings == ()
    text = repr(found)
    assert "matches=120" in text and "1 OK" in text and "body 2:" in text and "outliers:" in text


@pytest.mark.parametrize("scale", [0.0, 1e-300, 1e-150, 1e300])
@pytest.mark.parametrize("views", [(0,), (0, 1)])
def test_tiny_and_huge_matches_fail_alone(views, scale):
    scene = scenes.bodies(60, 2, sigma=0.5, outliers=0.1, generator=draw(4))
    alone = dyn.segment(*scene.views, generator=draw(5))
    both = [torch.stack([x, x * scale if i in views else x]) for i, x in enumerate(scene.views)]
    found = dyn.segment(*both, generator=draw(5))
    assert int(found.status[0]) == int(alone.status) == Status.OK
    assert torch.equal(found.labels[0], alone.labels)
    torch.testing.assert_close(found.fundamentals[0], alone.fundamentals, rtol=0, atol=1e-9)
    torch.testing.assert_close(found.probabilities[0], alone.probabilities, rtol=0, atol=1e-9)
    # what is tiny beside the threshold is near everything, in one place nothing; what overflows is missing
    assert int(found.status[1]) == (Status.AMBIGUOUS if 0 < scale < 1 else Status.TOO_FEW)
    assert int(found.bodies[1]) == 0 and not bool(found.labels[1].any())
    assert all(bool(getattr(found, name).isfinite().all()) for name in NAMES)


@pytest.mark.slow
def test_order_of_matches_and_views_unit_and_origin_do_not_matter():
    scene = two_bodies(6)
    x1, x2 = scene.views
    found = segmented(scene)
    order = torch.randperm(120, generator=draw(7))
    mixed = checked(x1[order], x2[order], 8)
    assert float(misclassification(mixed.labels, found.labels[order])) <= 0.02
    swapped = checked(x2, x1, 8)
    assert float(misclassification(swapped.labels, found.labels)) <= 0.02
    # bodies of nearly the same size may change places
    turned = swapped.fundamentals.mT
    cross = relative_error(turned[:, None].expand(2, 2, 3, 3), found.fundamentals.expand(2, 2, 3, 3))
    assert float(cross.amin(1).max()) < 0.02
    shift = torch.tensor([300.0, -200.0], dtype=F64)
    for scale in (3.0, 1e-4, 1e5):
        moved = checked(scale * (x1 + shift), scale * (x2 - shift), 9, threshold=2.5 * scale)
        assert torch.equal(moved.labels, found.labels) and moved.models == found.models
        torch.testing.assert_close(moved.residuals / scale, found.residuals, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_dtype_of_the_input_is_that_of_the_result(dtype):
    scene = two_bodies(8)
    found = dyn.segment(*(x.to(dtype) for x in scene.views), generator=draw(9))
    for name in ("fundamentals", "homographies", "probabilities", "residuals", "coherence", "threshold"):
        assert getattr(found, name).dtype == dtype
    assert found.labels.dtype == found.bodies.dtype == found.status.dtype == torch.int64
    assert error(found, scene) <= 0.03
    assert not any(getattr(found, name).requires_grad for name in NAMES)


@pytest.mark.slow
def test_missing_matches_and_those_without_weight_are_absent_and_weights_are_relative():
    scene = two_bodies(9, planar=(1,))
    x1, x2 = scene.views
    found = segmented(scene)
    stray = random_points(20, 1)
    wide1, wide2 = torch.cat([stray, x1]), torch.cat([stray.flip(0), x2])
    weights = torch.ones(140, dtype=F64)
    weights[:20] = 0.0
    missing1, missing2 = wide1.clone(), wide2.clone()
    missing1[:10], missing2[10:20] = torch.nan, torch.inf
    for result in (checked(wide1, wide2, 9, weights=weights), checked(missing1, missing2, 9)):
        assert torch.equal(result.labels[20:], found.labels) and bool((result.labels[:20] == 0).all())
        torch.testing.assert_close(result.fundamentals, found.fundamentals)
        assert bool((result.probabilities[:20] == 0).all()) and bool((result.residuals[:20] == 0).all())
        assert bool((result.coherence[:20] == 0).all())
    for weight in (1e-6, 1e6):
        scaled = segmented(scene, weights=torch.full((120,), weight, dtype=F64))
        assert torch.equal(scaled.labels, found.labels) and scaled.models == found.models
        torch.testing.assert_close(scaled.fundamentals, found.fundamentals, rtol=0, atol=1e-6)


@pytest.mark.slow
def test_threshold_is_estimated():
    """The distance from a homography has two components, that from an epipolar line one."""
    for sigma in (0.1, 0.2, 1.0):
        scene = two_bodies(11, sigma=sigma)
        found = segmented(scene, threshold=None)
        assert 3 * sigma < float(found.threshold) < 7.5 * sigma and error(found, scene) <= 0.05
        planes = segmented(scene_of(200, 2, 3, planar=(1, 2), sigma=sigma), threshold=None)
        assert planes.models == (dyn.tasks.BodyModel.HOMOGRAPHY,) * 2
        assert float(planes.threshold) == pytest.approx(5 * sigma, rel=0.25)


@pytest.mark.slow
def test_one_bad_problem_leaves_the_others_alone_and_is_named():
    scene = two_bodies(12)
    x1, x2 = scene.views
    failed = checked(torch.stack([x1, x1]), torch.stack([x2, random_points(120, 2)]), 9, bodies=2)
    assert failed.status.tolist() == [Status.OK, Status.NO_CONSENSUS]
    with pytest.raises(ValueError, match="problem 1 of 2: NO_CONSENSUS"):
        failed.check()
    assert {(notice.code, notice.problem) for notice in failed.warnings} == {
        (SegmentNotice.FEWER_BODIES, (1,)),
        (SegmentNotice.INCOHERENT, (1,)),
    }
    assert torch.equal(failed.labels[0], segmented(scene, bodies=2).labels)


@pytest.mark.slow
def test_very_many_matches_are_labelled_by_what_some_of_them_show():
    scene = scenes.bodies(3000, sigma=0.5, outliers=0.2, generator=draw(3))
    found = segmented(scene)
    assert int(found.bodies) == 2 and error(found, scene) < 0.03


@pytest.mark.slow
def test_options_decide():
    scene, shipped = two_bodies(), dyn.SegmentOptions()
    assert int(segmented(scene).bodies) == 2
    assert int(segmented(scene, options=replace(shipped, max_bodies=1)).bodies) == 1
    few = segmented(scene, options=replace(shipped, max_searched=60, num_starts=4))
    assert int(few.bodies) == 2 and few.labels.shape == segmented(scene).labels.shape


@pytest.mark.slow
def test_options_of_the_search_by_geometry_decide():
    scene, shipped = scenes.bodies((80, 60), sigma=0.3, interleaved=True, generator=draw(3)), dyn.SegmentOptions()
    assert int(segmented(scene, spatial=False).bodies) == 2
    assert int(segmented(scene, spatial=False, options=replace(shipped, false_alarms=1e-200)).bodies) == 0
    assert int(segmented(scene, spatial=False, options=replace(shipped, max_samples=6000)).bodies) == 2
    outliers = [
        int((segmented(scene, spatial=False, options=replace(shipped, outlier_share=p)).labels == 0).sum()) for p in (0.005, 0.2)
    ]
    assert outliers[0] <= outliers[1]


@pytest.mark.slow
@pytest.mark.parametrize("spatial", [True, False])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_default_dtype_decides_nothing(dtype, spatial):
    views = [x.to(dtype) for x in two_bodies().views]
    known = dyn.segment(*views, spatial=spatial, generator=draw(0))
    before = torch.get_default_dtype()
    torch.set_default_dtype(torch.float64)
    try:
        found = dyn.segment(*views, spatial=spatial, generator=draw(0))
    finally:
        torch.set_default_dtype(before)
    for name in ("labels", "fundamentals", "probabilities", "residuals"):
        torch.testing.assert_close(getattr(found, name), getattr(known, name), rtol=0, atol=0)


X1, X2 = scene_of().views


@pytest.mark.parametrize(
    ("message", "arguments"),
    [
        ("at least 8 matches, got 7: add 1", {"x1": X1[:7], "x2": X2[:7]}),
        ("at least 8 matches, got 0", {"x1": X1[:0], "x2": X2[:0]}),
        ("21 in all, got 20: add 1, or ask for at most 2", {"x1": X1[:20], "x2": X2[:20], "bodies": 3}),
        ("bodies must be a positive whole number.* got 0", {"bodies": 0}),
        ("bodies must be a positive whole number.* got -1", {"bodies": -1}),
        ("bodies must be a positive whole number.* got True", {"bodies": True}),
        ("bodies must be a positive whole number.* got 2.5", {"bodies": 2.5}),
        ("bodies must be a positive whole number.* got '2'", {"bodies": "2"}),
        ("threshold must be a positive distance.* got 0", {"threshold": 0}),
        ("threshold must be a positive distance.* got -1", {"threshold": -1.0}),
        ("threshold must be a positive distance.* got nan", {"threshold": float("nan")}),
        ("threshold must be a positive distance.* got inf", {"threshold": float("inf")}),
        ("threshold must be a positive distance.* got 'wide'", {"threshold": "wide"}),
        ("same", {"x2": X2[:-1]}),
        (r"expected \(\*batch, n, 2\), got \(80, 3\)", {"x1": torch.zeros(80, 3), "x2": torch.zeros(80, 3)}),
        (r"expected \(\*batch, n, 2\), got \(2,\)", {"x1": X1[0], "x2": X2[0]}),
        ("floating point, got torch.int64", {"x1": X1.long(), "x2": X2.long()}),
        ("one dtype", {"x1": X1.float()}),
        ("must be a torch.Tensor, got list", {"x1": X1.tolist()}),
        ("weights must not be negative, got -1", {"weights": -torch.ones(80)}),
        ("weights must be", {"weights": torch.ones(79)}),
        (r"options must be SegmentOptions, got \{\}; use dataclasses\.replace", {"options": {}}),
        (r"x1\[:, 0\]", {"x1": X1[:, None], "x2": X2[:, None]}),
        ("manual_seed", {"generator": 0}),
    ],
)
def test_misuse_is_refused_in_one_line(message, arguments):
    with pytest.raises(ValueError, match=message) as raised:
        dyn.segment(**{"x1": X1, "x2": X2, **arguments})
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize("bodies", [None, 2])
@pytest.mark.parametrize("kind", ["missing", "weightless", "one point", "seven copied"])
def test_too_few_different_matches(kind, bodies):
    x1, x2, options = X1, X2, {}
    if kind == "missing":
        x1 = torch.full_like(X1, torch.nan)
    elif kind == "weightless":
        options = {"weights": torch.zeros(80)}
    elif kind == "one point":
        x1, x2 = X1[:1].expand(80, 2), X2[:1].expand(80, 2)
    else:
        x1, x2 = X1[:7].repeat(9, 1), X2[:7].repeat(9, 1)
    found = checked(x1, x2, bodies=bodies, **options)
    assert int(found.status) == Status.TOO_FEW and int(found.bodies) == 0
    assert bool((found.labels == 0).all())
    # what is missing is not repeated
    assert codes(found) == ({SegmentNotice.REPEATED} if kind in ("one point", "seven copied") else set())
    with pytest.raises(ValueError, match="TOO_FEW"):
        found.check()


def test_random_matches_are_no_body():
    for n, copies in ((60, 1), (300, 1), (60, 6)):
        x1, x2 = (random_points(n, seed).repeat(copies, 1) for seed in (1, 2))
        for bodies in (None, 2):
            found = checked(x1, x2, bodies=bodies)
            assert int(found.status) == Status.NO_CONSENSUS and int(found.bodies) == 0
            assert bool((found.labels == 0).all()) and SegmentNotice.INCOHERENT in codes(found)


@pytest.mark.parametrize("bodies", [None, 2, 3])
def test_one_body(bodies):
    assert checked(*scene_of(8, 1).views, bodies=bodies and 1).labels.tolist() == [1] * 8
    scene = scene_of(80, 1)
    found = checked(*scene.views, bodies=bodies)
    if bodies is None:
        assert bool((found.labels == 1).all())
    # asked for more, it is divided, or the result says that there are fewer
    assert int(found.bodies) == (bodies or 1) or (
        int(found.status) == Status.NO_CONSENSUS and SegmentNotice.FEWER_BODIES in codes(found)
    )
    assert int((found.labels == 0).sum()) <= 4


@pytest.mark.slow
def test_sheets_that_bend_are_no_bodies():
    refused = 0
    for seed in range(8):
        place = torch.rand(130, 3, generator=draw(seed), dtype=F64) * 2 - 1 + torch.tensor([0.0, 0.0, 7.0], dtype=F64)
        waves = torch.stack([(2 * place[:, 1]).sin(), (3 * place[:, 0]).cos(), (2 * place[:, 2]).sin()], dim=-1)
        x1, x2 = (900 * x[:, :2] / x[:, 2:] for x in (place, place + 0.25 * waves))
        x1, x2 = (x + 0.5 * torch.randn(x.shape, generator=draw(20 + seed), dtype=F64) for x in (x1, x2))
        found = checked(x1, x2)
        refused += int(found.status) == Status.NO_CONSENSUS and SegmentNotice.MISFIT in codes(found)
    assert refused >= 7
    rigid = [segmented(scene_of(120, 2, seed, sigma=1.0, outliers=0.2)) for seed in range(8)]
    assert not any(SegmentNotice.MISFIT in codes(found) for found in rigid)


def small_motion(seed, size):
    """Two bodies side by side whose motions differ by about ``size`` pixels, at a noise of .5."""
    place = torch.rand(2, 65, 3, generator=draw(seed), dtype=F64) * 2 - 1
    turn, shift = (
        part * size * torch.randn(2, 1, 3, generator=draw(seed + k), dtype=F64) for k, part in ((40, 0.003), (60, 0.008))
    )
    moved = place + torch.linalg.cross(turn.expand_as(place), place) + shift
    centre = torch.tensor([[[-1.2, 0.0, 7.0]], [[1.2, 0.0, 7.0]]], dtype=F64)
    images = [(900 * x[..., :2] / x[..., 2:]).flatten(0, 1) for x in (place + centre, moved + centre)]
    return [x + 0.5 * torch.randn(x.shape, generator=draw(seed + 80 + k), dtype=F64) for k, x in enumerate(images)]


@pytest.mark.slow
def test_what_moves_hardly_more_than_the_noise_is_no_body_without_a_word():
    found = [dyn.segment(*small_motion(seed, 1.5), generator=draw(0)) for seed in range(12)]
    silent = [SegmentNotice.UNDECIDED not in codes(one) for one in found if int(one.bodies) == 1]
    assert len(silent) >= 6 and sum(silent) <= 0.5 * len(silent)
    still = [dyn.segment(*small_motion(seed, 0.0), generator=draw(0)) for seed in range(12)]
    clear = [dyn.segment(*scene_of(120, 1, seed).views, generator=draw(0)) for seed in range(12)]
    assert sum(SegmentNotice.UNDECIDED in codes(one) for one in [*still, *clear]) <= 2


@pytest.mark.parametrize("threshold", [2.5, None])
def test_a_static_pair_is_one_body_of_a_homography(threshold):
    found = checked(X1, X1, threshold=threshold).check()
    assert found.models == (dyn.tasks.BodyModel.HOMOGRAPHY,) and bool((found.labels == 1).all())
    H = found.homographies[0] / found.homographies[0, 2, 2]
    torch.testing.assert_close(H, torch.eye(3, dtype=F64), rtol=0, atol=1e-4)
    assert float(found.residuals.max()) < 1e-3


@pytest.mark.parametrize("bodies", [None, 1, 2])
def test_matches_on_one_line(bodies):
    place = 300 * torch.rand(60, 1, generator=draw(3), dtype=F64)
    x1, x2 = place * torch.tensor([1.0, 0.5], dtype=F64), place * torch.tensor([1.1, 0.3], dtype=F64) + 5
    found = checked(x1, x2, bodies=bodies)
    assert int(found.bodies) >= 1 and float((found.labels > 0).double().mean()) > 0.9


@pytest.mark.slow
def test_copies_and_garbage_change_nothing_but_a_notice():
    scene = scene_of(80, 2, outliers=0.2)
    found = checked(*(x.repeat(3, 1) for x in scene.views))
    assert float(misclassification(found.labels, scene.labels.repeat(3))) <= 0.03
    assert torch.equal(found.labels[:80], found.labels[80:160]) and codes(found) == {SegmentNotice.REPEATED}
    scene = scene_of(120, 2)
    place = torch.cat([torch.zeros(300, dtype=torch.long), torch.arange(120)])
    found = checked(*(50 * x[place] for x in scene.views), threshold=2.5 * 50)
    assert float(misclassification(found.labels[300:], scene.labels)) <= 0.03
    scene = scene_of(80, 2)
    y1, y2 = (x.clone() for x in scene.views)
    y1[:3], y2[2:5] = 1e9 * torch.randn(3, 2, generator=draw(4), dtype=F64), -1e9
    found = checked(y1, y2, threshold=None)
    assert 1.5 < float(found.threshold) < 3.5
    assert float(misclassification(found.labels[5:], scene.labels[5:])) <= 0.02


@pytest.mark.slow
def test_a_body_that_got_lost_is_no_spare_one():
    scene = scene_of(80, 1)
    for bodies in range(2, 9):
        found = checked(*scene.views, bodies=bodies)
        spare = [notice.value for notice in found.warnings if notice.code == SegmentNotice.SPARE_BODY]
        assert spare in ([], [bodies - 1])
        assert not {SegmentNotice.SPARE_BODY, SegmentNotice.FEWER_BODIES} <= codes(found)


@pytest.mark.parametrize("batch", [(0,), (2, 0)])
def test_empty_batches(batch):
    found = checked(torch.zeros(*batch, 20, 2), torch.zeros(*batch, 20, 2))
    assert found.warnings == () and found.check() is found
    assert found.models == ((),) * batch[0]


@pytest.mark.slow
def test_batches_are_loops():
    scene = scenes.bodies(60, 2, batch=(2, 3), sigma=0.5, generator=draw(2))
    x1, x2 = (x.clone() for x in scene.views)
    x1[0, 1], x2[1, 0] = torch.nan, random_points(60, 5)
    found = checked(x1, x2, 5)
    assert found.status.tolist() == [[Status.OK, Status.TOO_FEW, Status.OK], [Status.NO_CONSENSUS, Status.OK, Status.OK]]
    good = found.status == Status.OK
    assert float(misclassification(found.labels[good], scene.labels[good]).max()) <= 0.04
    assert [[len(models) for models in row] for row in found.models] == found.bodies.tolist() == [[2, 0, 2], [0, 2, 2]]
    assert "batch=(2, 3)" in repr(found) and "4 OK" in repr(found) and "bodies: 0 to 2" in repr(found)
    generator = draw(5)
    for place in product(range(2), range(3)):
        one = dyn.segment(x1[place], x2[place], generator=generator)
        count = int(one.bodies)
        assert torch.equal(found.labels[place], one.labels) and found.models[place[0]][place[1]] == one.models
        torch.testing.assert_close(found.fundamentals[place][:count], one.fundamentals)
        assert bool((found.fundamentals[place][count:] == 0).all())
        torch.testing.assert_close(found.probabilities[place][:, : count + 1], one.probabilities)
        torch.testing.assert_close(found.residuals[place], one.residuals)


@pytest.mark.slow
@pytest.mark.parametrize("spatial", [True, False])
def test_far_origins_and_garbage(spatial):
    scene = scene_of(80, 2)
    x1, x2 = scene.views
    plain = checked(x1, x2, bodies=2, spatial=spatial)
    far = checked(x1 + 1e6, x2 - 1e6, bodies=2, spatial=spatial)
    assert float(misclassification(far.labels, plain.labels)) <= (0.0 if spatial else 0.05)
    y1, y2 = x1.clone(), x2.clone()
    y1[:3], y2[2:5] = 1e9 * torch.randn(3, 2, generator=draw(4), dtype=F64), -1e9
    found = checked(y1, y2, bodies=2, spatial=spatial)
    assert float(misclassification(found.labels[5:], scene.labels[5:])) <= (0.02 if spatial else 0.1)
    if spatial:
        assert found.labels[:5].tolist() == [0] * 5


def test_a_threshold_in_another_unit_is_named():
    scene = scenes.bodies(120, sigma=0.3, generator=torch.Generator().manual_seed(0))
    found = dyn.segment(*(x / 640 for x in scene.views))
    assert int(found.status) == Status.AMBIGUOUS and int(found.bodies) == 0
    assert [notice.code for notice in found.warnings] == [SegmentNotice.COARSE]
    assert int(dyn.segment(*(x / 640 for x in scene.views), threshold=2.5 / 640).bodies) == 2

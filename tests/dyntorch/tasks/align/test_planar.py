"""The motion of a camera over a plane on which points stand still, move, or are mismatched."""

import pytest
import torch

import dyntorch as dyn
from dyntorch import scenes
from dyntorch.core.outcome import Notice, Status
from dyntorch.metrics import grid_transfer_error, label_scores
from dyntorch.tasks.align.planar import align_planar
from dyntorch.tasks.align.result import AlignNotice
from tests.battery.steps import convoy, equal_steps


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


def error(result, motion):
    """Pixels over the image, the worse one of A and B."""
    return torch.stack([grid_transfer_error(a, b, 640, 480) for a, b in zip((result.A, result.B), motion, strict=True)]).amax(0)


def codes(result):
    return {notice.code for notice in result.warnings}


def visible(scene):
    """Matches whose label the geometry can tell: all but the mismatches of static points, whose determinant stays 0."""
    return (scene.labels > 0) | scene.extras["moving"]


@pytest.mark.slow
@pytest.mark.parametrize(("static", "outliers"), [(0.3, 0.2), (0.1, 0.3), (0.0, 0.4)])
@pytest.mark.parametrize("threshold", [1.5, None])
def test_outliers_are_found_and_the_motion_survives_them(static, outliers, threshold):
    draw = generator(1)
    scene = scenes.planar(100 if static else 200, batch=3, sigma=0.5, static=static, outliers=outliers, generator=draw)
    result = align_planar(*scene.views, threshold=threshold, generator=draw)
    assert (result.status == Status.OK).all()
    assert error(result, scene.motion).max() < 3
    right = (result.labels == scene.labels)[visible(scene)]
    assert right.double().mean() > 0.95  # an outlier may come to lie near its line by chance
    assert (result.sigma - 0.5).abs().max() < 0.2
    assert static or codes(result) <= {AlignNotice.UNVERIFIED}


@pytest.mark.slow
@pytest.mark.parametrize(("n", "sigma"), [(50, 0.5), (80, 2.0)])
def test_labels_and_accuracy_are_those_of_known_labels(n, sigma):
    draw = generator(3)
    scene = scenes.planar(n, batch=4, sigma=sigma, static=0.4, generator=draw)
    result = align_planar(*scene.views, threshold=3 * sigma, generator=draw)
    assert label_scores(result.labels, scene.labels).recall.mean(0).min() > 0.98
    assert label_scores(result.labels, scene.labels).precision[..., 1].min() > 0.9  # hardly a moving point called static
    # the oracle: refinement that is told every label
    still = scene.labels == 1
    told = dyn.refine(dyn.fit(dyn.HomographyTensor, *scene.views, static=still), *scene.views, static=still)
    oracle = torch.stack([grid_transfer_error(a, b, 640, 480) for a, b in zip(told.motion, scene.motion, strict=True)]).amax(0)
    assert error(result, scene.motion).median() < 1.1 * oracle.median()
    # and labelling gains over treating all matches as moving
    refined = dyn.refine(dyn.fit(dyn.HomographyTensor, *scene.views), *scene.views)
    unlabelled = torch.stack([grid_transfer_error(a, b, 640, 480) for a, b in zip(refined.motion, scene.motion, strict=True)])
    assert error(result, scene.motion).median() < 0.8 * unlabelled.amax(0).median()


@pytest.mark.slow
def test_exact_matches_give_the_exact_motion():
    scene = scenes.planar(60, batch=2, static=0.3, generator=generator(4))
    for threshold in (0.5, None):
        result = align_planar(*scene.views, threshold=threshold, generator=generator())
        assert error(result, scene.motion).max() < 1e-8
        assert (result.labels == scene.labels).all()


def test_exactly_static_scenes_are_solved_with_a_warning():
    scene = scenes.planar(60, batch=2, static=1.0, generator=generator(5))
    assert (dyn.fit(dyn.HomographyTensor, *scene.views).status != Status.OK).all()  # rank 10
    result = align_planar(*scene.views, generator=generator())
    assert error(result, scene.motion).max() < 1e-8
    assert (result.labels == 1).all()
    assert (result.status == Status.OK).all()
    assert result.has_notice("degenerate").all() and result.has_notice(AlignNotice.FEW_MOVING).all()
    ranks = [notice.value for notice in result.warnings if notice.code == AlignNotice.DEGENERATE]
    assert ranks == [10, 10]


def test_static_scenes_with_noise_are_flagged_and_as_good_as_two_homographies():
    scene = scenes.planar(100, batch=4, sigma=0.5, static=1.0, generator=generator(6))
    result = align_planar(*scene.views, generator=generator())
    assert (result.status == Status.OK).all()
    assert result.has_notice("near_static").all()
    with pytest.raises(ValueError, match="'nonsense'"):
        result.has_notice("nonsense")
    pairs = [dyn.fit(dyn.Collineation(2), scene.views[0], x) for x in scene.views[1:]]
    direct = torch.stack(
        [grid_transfer_error(pair.motion[0], m, 640, 480) for pair, m in zip(pairs, scene.motion, strict=True)]
    ).amax(0)
    assert error(result, scene.motion).median() < 1.05 * direct.median()


def on_lines(count, n, sigma, seed):
    """Moving points on a few lines of the plane, and static ones."""
    draw = generator(seed)
    scene = scenes.planar(n, static=1.0, generator=draw)
    A, B = scene.motion
    x1, x2, x3 = (x.clone() for x in scene.views)
    half = n // 2
    for k in range(half):
        base, step = torch.tensor([100.0 + 120 * (k % count), 60.0]).double(), torch.tensor([0.3 * (k % count), 1.0]).double()
        at = base + step * (40 + torch.rand(3, 1, generator=draw, dtype=torch.float64) * 300)
        x1[k] = at[0]
        x2[k] = dyn.HomographyTensor.transfer(dyn.HomographyTensor.compose(A, B), at[1:2], source=1, target=2)[0]
        x3[k] = dyn.HomographyTensor.transfer(dyn.HomographyTensor.compose(A, B), at[2:3], source=1, target=3)[0]
    noisy = [x + sigma * torch.randn(n, 2, generator=draw, dtype=torch.float64) for x in (x1, x2, x3)]
    return noisy, scene.motion


@pytest.mark.slow
@pytest.mark.parametrize(("count", "expected"), [(1, True), (3, True), (4, False)])
def test_few_trajectory_lines_are_counted(count, expected):
    views, motion = on_lines(count, 80, 0.3, 8)
    result = align_planar(*views, threshold=0.9, generator=generator())
    assert float(error(result, motion)) < 1.5
    found = [notice for notice in result.warnings if notice.code == AlignNotice.FEW_LINES]
    assert bool(found) == expected
    if expected:
        assert found[0].value == count
    assert (AlignNotice.ONE_LINE in codes(result)) == (count == 1)


@pytest.mark.slow
def test_mismatches_of_static_points_are_reported_as_unverified():
    scene = scenes.planar(100, sigma=0.3, static=0.5, generator=generator(10))
    x3 = scene.views[2].clone()
    wrong = (scene.labels == 1).nonzero()[:6, 0]
    x3[wrong] += torch.tensor([60.0, -45.0], dtype=torch.float64)
    result = align_planar(scene.views[0], scene.views[1], x3, threshold=0.9, generator=generator())
    assert result.unverified is not None
    assert result.unverified[wrong].all() and (result.labels[wrong] == 2).all()
    notice = next(n for n in result.warnings if n.code == AlignNotice.UNVERIFIED)
    assert notice.value == int(result.unverified.sum()) and "paused" in result.ambiguity


def test_labelled_static_matches_are_never_called_moving():
    scene = scenes.planar(20, batch=3, sigma=0.3, static=0.5, generator=generator(11))
    known = scene.labels == 1
    views = [x.clone() for x in scene.views]
    first = int(known[0].nonzero()[0, 0])
    views[1][0, first] += 50.0
    result = align_planar(*views, threshold=0.9, static=known, generator=generator())
    assert (result.status == Status.OK).all()
    assert error(result, scene.motion).max() < 3
    assert not (result.labels[known] == 2).any()
    assert result.labels[0, first] == 0 and (result.labels == 0).sum() <= 3


def test_single_precision_few_moving_points_and_empty_batches():
    scene = scenes.planar(80, sigma=0.5, static=0.9, generator=generator(9)).to(torch.float32)
    result = align_planar(*scene.views, generator=generator())
    assert result.A.dtype == result.covariance.dtype == torch.float32 and result.labels.dtype == torch.int64
    assert result.solution is not None and result.solution.tensor.dtype == torch.float32
    assert error(result, scene.motion) < 2
    assert [notice.value for notice in result.warnings if notice.code == "few_moving"] == [8.0]
    assert all(words in repr(result) for words in ("Alignment(matches=80", "8 moving", AlignNotice.FEW_MOVING.value))
    empty = align_planar(*torch.zeros(3, 0, 40, 2))
    assert empty.A.shape == (0, 3, 3) and empty.labels.shape == (0, 40) and empty.warnings == ()
    assert "empty" in repr(empty)


@pytest.mark.slow
def test_a_batch_is_solved_problem_by_problem_and_one_bad_problem_harms_no_other():
    scene = scenes.planar(60, batch=(2, 2), sigma=0.5, static=0.4, generator=generator(12))
    views = [x.clone() for x in scene.views]
    views[0][0, 1] = torch.nan
    views[1][1, 0] = 7.0
    result = align_planar(*views, threshold=3.0, generator=generator())
    assert result.A.shape == (2, 2, 3, 3) and result.labels.shape == (2, 2, 60) and result.covariance.shape == (2, 2, 18, 18)
    assert result.status[0, 1] == Status.TOO_FEW
    assert result.status[1, 0] != Status.OK
    assert result.status[0, 0] == Status.OK == result.status[1, 1]
    for part in (result.A, result.B, result.sigma, result.covariance):
        assert part.isfinite().all()
    assert (result.A[0, 1] == 0).all() and (result.labels[0, 1] == 0).all()
    for place in ((0, 0), (1, 1)):
        alone = align_planar(*(x[place] for x in scene.views), threshold=3.0, generator=generator())
        torch.testing.assert_close(alone.A, result.A[place], atol=1e-5, rtol=1e-4)
        assert (alone.labels == result.labels[place]).double().mean() > 0.98
    with pytest.raises(ValueError, match="TOO_FEW"):
        result.check()
    assert all(isinstance(notice, Notice) and len(notice.problem) == 2 for notice in result.warnings)


@pytest.mark.slow
def test_covariance_is_the_spread_over_repeated_noise():
    exact = scenes.planar(60, static=0.4, generator=generator(13))
    draw = generator(14)
    views = [x + 0.25 * torch.randn(40, 60, 2, generator=draw, dtype=torch.float64) for x in exact.views]
    # a bound of six times the noise: the search is over at its first starts
    result = align_planar(*views, threshold=1.5, generator=draw)
    A, B = exact.motion
    difference = torch.cat([(result.A - A).flatten(1), (result.B - B).flatten(1)], dim=-1)
    expected = result.covariance.diagonal(dim1=-2, dim2=-1).mean(0).sqrt()
    ratio = difference.square().mean(0).sqrt() / expected
    assert ratio.min() > 0.6 and ratio.max() < 1.6


@pytest.mark.slow
def test_points_on_a_line_equal_repeated_and_random_ones_determine_nothing():
    draw = generator(15)
    t = torch.rand(3, 40, 1, generator=draw, dtype=torch.float64) * 500
    line = t * torch.tensor([1.0, 0.5]).double() + torch.tensor([20.0, 30.0]).double()
    for sigma in (0.0, 0.5):
        views = line + sigma * torch.randn(line.shape, generator=draw, dtype=torch.float64)
        result = align_planar(*views, generator=generator())
        assert result.status != Status.OK and AlignNotice.COLLINEAR in codes(result)
        assert result.A.isfinite().all() and result.covariance.isfinite().all()
    assert align_planar(*torch.full((3, 40, 2), 3.0).double(), generator=generator()).status == Status.DEGENERATE
    twice = [x.repeat(3, 1) for x in scenes.planar(13, sigma=0.5, generator=generator(16)).views]
    assert align_planar(*twice, generator=generator()).status != Status.OK
    random = torch.rand(3, 1, 40, 2, generator=generator(17), dtype=torch.float64) * 500
    for threshold in (1.5, None):
        assert (align_planar(*random, threshold=threshold, generator=generator()).status != Status.OK).all()


@pytest.mark.slow
def test_weights_of_zero_and_missing_matches_are_left_out():
    scene = scenes.planar(60, sigma=0.5, static=0.4, generator=generator(18))
    views = [x.clone() for x in scene.views]
    weights = torch.ones(60, dtype=torch.float64)
    weights[:5] = 0
    views[0][:5] = 1e4
    views[2][5:10] = torch.nan
    result = align_planar(*views, weights=weights, generator=generator())
    assert (result.labels[:10] == 0).all() and (result.labels[10:] > 0).double().mean() > 0.95
    assert error(result, scene.motion) < 3
    none = align_planar(*scene.views, weights=torch.zeros(60), generator=generator())
    assert none.status == Status.TOO_FEW and (none.A == 0).all() and (none.labels == 0).all()


NO_DISTANCE = r"threshold must be a positive distance .*, got .*; None estimates it"
BAD = ("wide", 0, -1.0, float("nan"), float("inf"), torch.ones(2))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda v: {"x1": v[0][:20], "x2": v[1][:20], "x3": v[2][:20]}, "at least 26 matches, got 20"),
        (lambda v: {"x2": v[1][:30]}, "same"),
        (lambda v: {"x2": v[1].float()}, "one dtype"),
        (lambda v: {"x1": v[0][:, :1]}, "view 1"),
        *((lambda v, bad=bad: {"threshold": bad}, NO_DISTANCE) for bad in BAD),
        (lambda v: {"weights": -torch.ones(40)}, "not be negative"),
        (lambda v: {"static": torch.ones(39, dtype=torch.bool)}, "static must be"),
        (lambda v: {"x1": v[0].tolist()}, "torch.Tensor"),
    ],
)
def test_misuse_is_refused_with_the_value_and_the_remedy(change, message):
    views = scenes.planar(40, generator=generator()).views
    with pytest.raises(ValueError, match=message):
        align_planar(**{**dict(zip(("x1", "x2", "x3"), views, strict=True)), **change(views)})


@pytest.mark.slow
def test_static_points_choose_among_the_cameras_that_equal_steps_leave():
    for threshold in (1.5, None):
        draw = generator()
        result = align_planar(*equal_steps(60, still=0.0, generator=draw), threshold=threshold, generator=draw)
        assert result.status == Status.AMBIGUOUS and result.has_notice("other_solution")
    draw = generator(1)
    result = align_planar(*equal_steps(60, still=0.4, generator=draw), generator=draw)
    assert result.status == Status.OK and (result.labels[:24] == 1).double().mean() > 0.9
    torch.testing.assert_close(result.A / result.A[2, 2], torch.eye(3, dtype=torch.float64), atol=2.0, rtol=0)


@pytest.mark.slow
@pytest.mark.parametrize("still", [15, 25, 40])
def test_a_convoy_and_what_it_passes_are_each_others_background(still):
    draw = generator(still)
    views = convoy(10, 70, still=still, step=(18.0, 9.0), sigma=0.5, size=640.0, generator=draw)
    result = align_planar(*views, generator=draw)
    assert (result.status == Status.AMBIGUOUS).all() and result.has_notice(AlignNotice.OTHER_BACKGROUND).all()
    told = [n for n in result.notices if n.code == AlignNotice.OTHER_BACKGROUND]
    assert all(abs(n.values["still"] + n.value - 70) <= 5 and abs(n.value - min(still, 70 - still)) <= 4 for n in told)
    assert "static=" in told[0].text
    # who knows what stands still, or that most does, has an answer
    known = (torch.arange(70) < 5).expand(10, 70)
    settled = align_planar(*views, static=known, generator=draw)
    assert (settled.status == Status.OK).all()
    assert error(settled, [torch.eye(3, dtype=torch.float64).expand(10, 3, 3)] * 2).max() < 3
    most = align_planar(*views, generator=draw, options=dyn.AlignOptions(min_static_share=0.45))
    assert (most.status == Status.OK).all()


@pytest.mark.slow
def test_movers_that_differ_leave_no_other_background():
    draw = generator(20)
    for still in (0.2, 0.35, 0.6):
        scene = scenes.planar(90, batch=20, sigma=0.5, static=still, generator=draw)
        assert (align_planar(*scene.views, generator=draw).status == Status.OK).all()

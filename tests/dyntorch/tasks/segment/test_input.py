"""segment on bad input: refused in one line, or failed as data, with well-formed parts; nothing poisons its neighbours."""

from __future__ import annotations

import pytest
import torch

import dyntorch as dyn
from dyntorch import scenes
from dyntorch.core.outcome import Status
from dyntorch.metrics import misclassification
from dyntorch.tasks.segment.result import SegmentNotice

F64 = torch.float64


def draw(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def scene_of(n: int = 80, bodies: int = 2, **options):
    return scenes.bodies(n, bodies, **{"sigma": 0.5, **options}, generator=draw(1))


def random_points(n: int, seed: int) -> torch.Tensor:
    return 500 * torch.rand(n, 2, generator=draw(seed), dtype=F64)


def segmented(x1, x2, **options):
    """The result, its parts checked against each other."""
    found = dyn.segment(x1, x2, generator=draw(), **options)
    batch, n, count = x1.shape[:-2], x1.shape[-2], found.fundamentals.shape[-3]
    assert found.labels.shape == found.residuals.shape == found.coherence.shape == (*batch, n)
    assert found.probabilities.shape == (*batch, n, count + 1)
    assert found.homographies.shape == found.fundamentals.shape == (*batch, count, 3, 3)
    assert found.bodies.shape == found.status.shape == found.threshold.shape == batch
    for part in (found.fundamentals, found.homographies, found.probabilities, found.residuals, found.coherence):
        assert bool(part.isfinite().all())
    assert bool((found.labels >= 0).all()) and bool((found.labels <= found.bodies[..., None]).all())
    assert repr(found).startswith("Segmentation(")
    return found


def codes(found):
    return {notice.code for notice in found.warnings}


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
    found = segmented(x1, x2, bodies=bodies, **options)
    assert int(found.status) == Status.TOO_FEW and int(found.bodies) == 0
    assert bool((found.labels == 0).all())
    # what is missing is not repeated
    assert codes(found) == ({SegmentNotice.REPEATED} if kind in ("one point", "seven copied") else set())
    with pytest.raises(ValueError, match="TOO_FEW"):
        found.check()


def test_eight_matches_of_one_body():
    scene = scene_of(8, 1)
    for bodies in (None, 1):
        assert segmented(*scene.views, bodies=bodies).labels.tolist() == [1] * 8


def test_random_matches_are_no_body():
    for n, copies in ((60, 1), (300, 1), (60, 6)):
        x1, x2 = (random_points(n, seed).repeat(copies, 1) for seed in (1, 2))
        for bodies in (None, 2):
            found = segmented(x1, x2, bodies=bodies)
            assert int(found.status) == Status.NO_CONSENSUS and int(found.bodies) == 0
            assert bool((found.labels == 0).all()) and SegmentNotice.INCOHERENT in codes(found)


@pytest.mark.parametrize("bodies", [None, 2, 3])
def test_one_body(bodies):
    scene = scene_of(80, 1)
    found = segmented(*scene.views, bodies=bodies)
    if bodies is None:
        assert bool((found.labels == 1).all())
    # asked for more, it is divided, or the result says that there are fewer
    assert int(found.bodies) == (bodies or 1) or (
        int(found.status) == Status.NO_CONSENSUS and SegmentNotice.FEWER_BODIES in codes(found)
    )
    assert int((found.labels == 0).sum()) <= 4


@pytest.mark.parametrize("threshold", [2.5, None])
def test_a_static_pair_is_one_body_of_a_homography(threshold):
    found = segmented(X1, X1, threshold=threshold).check()
    assert found.models == (dyn.tasks.BodyModel.HOMOGRAPHY,) and bool((found.labels == 1).all())
    H = found.homographies[0] / found.homographies[0, 2, 2]
    torch.testing.assert_close(H, torch.eye(3, dtype=F64), rtol=0, atol=1e-4)
    assert float(found.residuals.max()) < 1e-3


@pytest.mark.parametrize("bodies", [None, 1, 2])
def test_matches_on_one_line(bodies):
    place = 300 * torch.rand(60, 1, generator=draw(3), dtype=F64)
    x1, x2 = place * torch.tensor([1.0, 0.5], dtype=F64), place * torch.tensor([1.1, 0.3], dtype=F64) + 5
    found = segmented(x1, x2, bodies=bodies)
    assert int(found.bodies) >= 1 and float((found.labels > 0).double().mean()) > 0.9


def test_copies_of_matches_change_nothing_but_a_notice():
    scene = scene_of(80, 2, outliers=0.2)
    found = segmented(*(x.repeat(3, 1) for x in scene.views))
    assert float(misclassification(found.labels, scene.labels.repeat(3))) <= 0.03
    assert torch.equal(found.labels[:80], found.labels[80:160]) and codes(found) == {SegmentNotice.REPEATED}


@pytest.mark.parametrize("unit", [1.0, 50.0])
def test_copies_of_one_match_may_be_the_majority(unit):
    scene = scene_of(120, 2)
    place = torch.cat([torch.zeros(300, dtype=torch.long), torch.arange(120)])
    found = segmented(*(unit * x[place] for x in scene.views), threshold=2.5 * unit)
    assert float(misclassification(found.labels[300:], scene.labels)) <= 0.03


@pytest.mark.slow
def test_a_body_that_got_lost_is_no_spare_one():
    scene = scene_of(80, 1)
    for bodies in range(2, 9):
        found = segmented(*scene.views, bodies=bodies)
        spare = [notice.value for notice in found.warnings if notice.code == SegmentNotice.SPARE_BODY]
        assert spare in ([], [bodies - 1])
        assert not {SegmentNotice.SPARE_BODY, SegmentNotice.FEWER_BODIES} <= codes(found)


def test_garbage_does_not_spoil_the_estimated_threshold():
    scene = scene_of(80, 2)
    y1, y2 = (x.clone() for x in scene.views)
    y1[:3], y2[2:5] = 1e9 * torch.randn(3, 2, generator=draw(4), dtype=F64), -1e9
    found = segmented(y1, y2, threshold=None)
    assert 1.5 < float(found.threshold) < 3.5
    assert float(misclassification(found.labels[5:], scene.labels[5:])) <= 0.02


@pytest.mark.parametrize("batch", [(0,), (2, 0)])
def test_empty_batches(batch):
    found = segmented(torch.zeros(*batch, 20, 2), torch.zeros(*batch, 20, 2))
    assert found.warnings == () and found.check() is found
    assert found.models == ((),) * batch[0]


@pytest.mark.slow
def test_one_bad_problem_leaves_the_others_alone():
    scene = scenes.bodies(60, 2, batch=(2, 3), sigma=0.5, generator=draw(2))
    x1, x2 = (x.clone() for x in scene.views)
    x1[0, 1], x2[1, 0] = torch.nan, random_points(60, 5)
    found = segmented(x1, x2)
    assert found.status.tolist() == [[Status.OK, Status.TOO_FEW, Status.OK], [Status.NO_CONSENSUS, Status.OK, Status.OK]]
    good = found.status == Status.OK
    assert float(misclassification(found.labels[good], scene.labels[good]).max()) <= 0.04
    assert [[len(models) for models in row] for row in found.models] == found.bodies.tolist() == [[2, 0, 2], [0, 2, 2]]


@pytest.mark.slow
@pytest.mark.parametrize("spatial", [True, False])
def test_far_origins_and_garbage(spatial):
    scene = scene_of(80, 2)
    x1, x2 = scene.views
    plain = segmented(x1, x2, bodies=2, spatial=spatial)
    far = segmented(x1 + 1e6, x2 - 1e6, bodies=2, spatial=spatial)
    assert float(misclassification(far.labels, plain.labels)) <= (0.0 if spatial else 0.05)
    y1, y2 = x1.clone(), x2.clone()
    y1[:3], y2[2:5] = 1e9 * torch.randn(3, 2, generator=draw(4), dtype=F64), -1e9
    found = segmented(y1, y2, bodies=2, spatial=spatial)
    assert float(misclassification(found.labels[5:], scene.labels[5:])) <= (0.02 if spatial else 0.1)
    if spatial:
        assert found.labels[:5].tolist() == [0] * 5


def test_a_threshold_in_another_unit_is_named():
    scene = scenes.bodies(120, sigma=0.3, generator=torch.Generator().manual_seed(0))
    found = dyn.segment(*(x / 640 for x in scene.views))
    assert int(found.status) == Status.AMBIGUOUS and int(found.bodies) == 0
    assert [notice.code for notice in found.warnings] == [SegmentNotice.COARSE]
    assert int(dyn.segment(*(x / 640 for x in scene.views), threshold=2.5 / 640).bodies) == 2


def test_points_in_the_shape_of_opencv_are_named():
    x = torch.rand(20, 1, 2)
    with pytest.raises(ValueError, match=r"x1\[:, 0\]"):
        dyn.segment(x, x)


def test_a_seed_is_no_generator():
    x = torch.rand(20, 2)
    with pytest.raises(ValueError, match="manual_seed"):
        dyn.segment(x, x, generator=0)

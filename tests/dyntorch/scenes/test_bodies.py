"""Two views of several bodies: each obeys its own motion, and is as flat, still or apart from the others as was asked."""

import pytest
import torch

from dyntorch.geometry.homogeneous import apply, homogeneous, skew, unit
from dyntorch.metrics import relative_error
from dyntorch.scenes import bodies, translating_planes
from tests.draws import seeded
from tests.grid import assert_refused

K = torch.tensor([[800.0, 0.0, 320.0], [0.0, 800.0, 240.0], [0.0, 0.0, 1.0]], dtype=torch.float64)


def epipolar(scene, views, body):
    """Distances in view 2 of all matches from the epipolar lines of a body, pixels."""
    x1, x2 = (homogeneous(x) for x in views)
    line = x1 @ scene.motion[body - 1].mT
    return (x2 * line).sum(-1).abs() / line[..., :2].norm(dim=-1)


@pytest.mark.parametrize("options", [{}, {"interleaved": True}, {"planar": (1, 3)}, {"interleaved": True, "planar": (2,)}])
def test_matches_obey_the_motion_of_their_own_body_only(options):
    scene = bodies(120, 3, batch=4, generator=seeded(), **options)
    for body in (1, 2, 3):
        distance = epipolar(scene, scene.exact, body)
        assert distance[scene.labels == body].max() < 1e-9
        assert distance[scene.labels != body].median() > 1
    assert all(torch.equal(a, b) for a, b in zip(scene.views, scene.exact, strict=True))


def test_views_are_projections_of_the_moved_points():
    scene = bodies((10, 20), batch=3, generator=seeded())
    points, label = scene.extras["points"], scene.labels
    for problem in range(3):
        for body in (1, 2):
            x = points[problem][label[problem] == body]
            turn, shift = (scene.extras[name][problem, body - 1] for name in ("rotations", "translations"))
            torch.testing.assert_close(turn @ turn.mT, torch.eye(3, dtype=torch.float64))
            for view, seen in zip(scene.exact, (x, x @ turn.mT + shift), strict=True):
                assert seen[:, 2].min() > 3
                image = seen @ K.mT
                torch.testing.assert_close(view[problem][label[problem] == body], image[:, :2] / image[:, 2:])
            inverse = torch.linalg.inv(K)
            torch.testing.assert_close(scene.motion[body - 1][problem], unit(inverse.mT @ skew(shift) @ turn @ inverse))


def test_flat_and_rotating_bodies_have_homographies():
    scene = bodies((40, 40, 40, 40), batch=3, planar=(2,), rotating=(3,), generator=seeded())
    homographies = scene.extras["homographies"]
    for body in (2, 3):
        moved = apply(homographies[:, body - 1], scene.exact[0])
        right = scene.labels == body
        torch.testing.assert_close(moved[right], scene.exact[1][right], rtol=0, atol=1e-8)
        torch.testing.assert_close(torch.linalg.matrix_norm(homographies[:, body - 1]), torch.ones(3, dtype=torch.float64))
    assert homographies[:, [0, 3]].abs().max() == 0
    assert scene.motion[2].abs().max() == 0 and scene.extras["translations"][:, 2].abs().max() == 0
    # a rotating body has depth, and a flat one moves
    depth = scene.extras["points"][..., 2]
    assert depth[scene.labels == 3].std() > 0.5
    assert scene.motion[1].abs().amax((-2, -1)).min() > 0.1
    flat = homogeneous(scene.extras["points"][0][scene.labels[0] == 2])
    assert torch.linalg.svdvals(flat)[-1] < 1e-12 < 0.1 < torch.linalg.svdvals(homogeneous(scene.extras["points"][0]))[-1]


def test_bodies_lie_apart_unless_interleaved():
    apart, mixed = (bodies(400, 4, interleaved=mix, generator=seeded()) for mix in (False, True))

    def boxes(scene):
        return [(x.amin(0), x.amax(0)) for x in (scene.exact[0][scene.labels == k] for k in (1, 2, 3, 4))]

    def overlap(scene):
        found = boxes(scene)
        return [bool(((a[0] < b[1]) & (b[0] < a[1])).all()) for i, a in enumerate(found) for b in found[:i]]

    assert not any(overlap(apart)) and all(overlap(mixed))
    for scene in (apart, mixed):
        assert scene.exact[0].amin() > 0 and (scene.exact[0].amax(0) < torch.tensor([640.0, 480.0])).all()


def test_numbers_of_matches_and_outliers():
    scene = bodies((27, 8), batch=5, outliers=0.2, sigma=0.5, generator=seeded())
    assert ((scene.labels == 0).sum(-1) == 7).all()
    body = scene.extras["bodies"]
    assert ((body == 1).sum(-1) == 27).all() and ((body == 2).sum(-1) == 8).all()
    assert torch.equal(body[scene.labels > 0], scene.labels[scene.labels > 0])
    assert torch.equal(scene.extras["moving"], body == 2)
    assert not torch.equal(body[0], body[1])
    wrong = torch.where(body == 1, *(epipolar(scene, scene.views, k) for k in (1, 2)))
    assert wrong[scene.labels > 0].max() < 4 < wrong[scene.labels == 0].median()
    assert [int((bodies(11, 3, generator=seeded()).labels == k).sum()) for k in (1, 2, 3)] == [4, 4, 3]


def test_body_one_stands_still_and_the_others_move_visibly():
    scene = bodies(300, 3, batch=20, generator=seeded())
    turn, shift = scene.extras["rotations"], scene.extras["translations"]
    camera = turn[:, :1].mT @ turn
    assert (camera[:, 0].diagonal(dim1=-2, dim2=-1).sum(-1) > 3 - 1e-12).all()
    still = (scene.extras["points"] @ turn[:, 0].mT + shift[:, None, 0]) @ K.mT
    moved = (scene.exact[1] - still[..., :2] / still[..., 2:]).norm(dim=-1)
    assert moved[scene.labels == 1].max() < 1e-9
    assert 20 < moved[scene.labels > 1].median() < 100


def test_the_seed_decides_and_precision_is_as_asked():
    a, b, c = (bodies(30, batch=2, sigma=0.3, outliers=0.1, generator=seeded(s)) for s in (1, 1, 2))
    assert torch.equal(a.views[1], b.views[1]) and not torch.equal(a.views[1], c.views[1])
    single = bodies(30, batch=2, sigma=0.3, outliers=0.1, generator=seeded(1), dtype=torch.float32)
    assert single.views[0].dtype == torch.float32 and single.labels.dtype == torch.int64
    torch.testing.assert_close(single.views[1], a.views[1].float(), rtol=1e-5, atol=1e-3)


# Scenes of planes and bodies that translate independently are what they say they are.


def rank_gap(vectors):
    values = torch.linalg.svdvals(vectors)
    return values[..., 2] / values[..., 0]


def test_planes_and_bodies_obey_their_matrices():
    scene = translating_planes(4, 2, n=20, batch=3, generator=seeded())
    assert torch.allclose(apply(scene.homographies, scene.x1), scene.x2)
    lines = homogeneous(scene.body_x1) @ scene.body_fundamentals.mT
    assert bool(((homogeneous(scene.body_x2) * lines).sum(-1).abs() < 1e-9).all())
    # several planes of one camera pair: H - Hinf has rank one at the right scale
    second = skew(scene.epipoles[..., :4, :]) @ scene.homographies
    assert relative_error(second, skew(scene.epipoles[..., :4, :]) @ scene.infinity[:, None]).max() < 1e-9
    depth = 1 / (homogeneous(scene.x1) @ scene.normals[..., None])
    assert bool((depth > 0).all()) and scene.body_x1.shape == (3, 2, 20, 2)
    noisy, exact = (translating_planes(3, n=500, sigma=s, generator=seeded(1)) for s in (0.5, 0.0))
    for a, b in ((noisy.x1, exact.x1), (noisy.x2, exact.x2)):
        assert float((a - b).std()) == pytest.approx(0.5, rel=0.05)
    single = translating_planes(3, dtype=torch.float32, generator=seeded())
    assert single.x1.dtype == single.infinity.dtype == torch.float32 and single.sigma == 0.0


def test_special_positions():
    options = {"n": 5, "batch": 4, "generator": seeded(2)}
    assert rank_gap(translating_planes(5, **options).translations).min() > 1e-2
    assert rank_gap(translating_planes(5, collinear_epipoles=True, **options).epipoles).max() < 1e-12
    assert rank_gap(translating_planes(5, coplanar_normals=True, **options).normals).max() < 1e-9
    shared = translating_planes(5, shared=2, **options)
    assert torch.equal(shared.epipoles[:, 0], shared.epipoles[:, 1])
    static = translating_planes(5, static=True, **options)
    assert relative_error(static.homographies[:, 4], static.infinity).max() < 1e-12


def test_misuse_is_named():
    assert_refused(
        (lambda: bodies(1, 2), "at least one match"),
        (lambda: bodies(10, 0), "at least one match"),
        (lambda: bodies((5, 0)), "at least one match"),
        (lambda: bodies((5, 5), 3), "one n per body"),
        (lambda: bodies(10, 2, planar=(3,)), "planar must name bodies from 1 to 2"),
        (lambda: bodies(10, 2, rotating=(0,)), "rotating must name"),
        (lambda: bodies(10, outliers=1.2), "outliers is a share"),
        (lambda: translating_planes(planes=-1), "expected planes"),
        (lambda: translating_planes(patch=0.0), "expected planes"),
        (lambda: translating_planes(shared=9), "expected planes"),
        (lambda: translating_planes(bodies=-2), "expected planes"),
    )

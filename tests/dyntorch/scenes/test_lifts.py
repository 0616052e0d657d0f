"""Lifted scenes: static points of a higher projective space, with the ranks of the estimation matrices that the theory counts."""

from itertools import combinations

import pytest
import torch

from dyntorch.counting import count
from dyntorch.scenes import lifted_points
from dyntorch.scenes.lifts import KINDS
from dyntorch.scenes.scene import OUTLIER
from tests.draws import seeded
from tests.dyntorch.counting.test_lifted import TABLE
from tests.grid import assert_refused

VELOCITY_2D = "constant_velocity_2d"
DIRECTION_3D, PLANES_3D, VELOCITY_3D = "constant_direction_3d", "constant_velocity_planes_3d", "constant_velocity_3d"
SENSORS = "constant_velocity_3d_sensors"


def project(points, cameras):
    q = torch.einsum("...vij,...vnj->...vni", cameras, points)
    return q[..., :-1] / q[..., -1:]


def minors(matrix, order):
    """All minors of the rows, ``(n, rows choose order, columns choose order)``, one determinant at a time."""
    rows, columns = matrix.shape[-2:]
    return torch.stack(
        [
            torch.stack(
                [torch.linalg.det(matrix[..., list(i), :][..., :, list(j)]) for j in combinations(range(columns), order)], -1
            )
            for i in combinations(range(rows), order)
        ],
        -2,
    )


def rank(tracks, profile):
    """Of the estimation matrix of tracks, a list of ``(n, l)``: the products of minors of the hyperplanes through the points."""
    rows = torch.ones(len(tracks[0]), 1, 1, dtype=torch.float64)
    for x, alpha in zip(tracks, profile, strict=True):
        x = (x - x.mean(0)) / x.std()
        planes = torch.cat([torch.eye(x.shape[-1], dtype=x.dtype).expand(len(x), -1, -1), -x[..., None]], dim=-1)
        factor = minors(planes, alpha)
        rows = torch.einsum("nij,nkl->nikjl", rows, factor).flatten(3).flatten(1, 2)
    rows = rows.flatten(0, 1)
    s = torch.linalg.svdvals(rows / rows.norm(dim=-1, keepdim=True))
    return int((s > 1e-10 * s[0]).sum())


@pytest.mark.parametrize("motion", KINDS)
@pytest.mark.parametrize("views", [None, 6])
def test_exact_tracks_are_the_projections_of_the_structure(motion, views):
    scene = lifted_points(motion, 30, views, static=0.3, outliers=0.2, sigma=0.5, batch=(2, 2), generator=seeded())
    projections = scene.projections
    points = scene.structure[..., None, :, :].expand(2, 2, projections.shape[2], *scene.structure.shape[-2:])
    torch.testing.assert_close(project(points, projections), scene.exact, rtol=0, atol=1e-9)
    if scene.lifts is not None:
        torch.testing.assert_close(scene.cameras @ scene.lifts, projections)
    # enough equations for a point of P^k
    assert scene.exact.shape[-3] * scene.exact.shape[-1] >= scene.structure.shape[-1] - 1


@pytest.mark.parametrize("motion", [m for m in KINDS if KINDS[m].bodies == 1])
def test_points_move_as_the_name_says(motion):
    times = torch.tensor([0.0, 1.0, 2.5, 3.0, 7.0])
    scene = lifted_points(motion, 2000, times=times, generator=seeded())
    d, t = KINDS[motion].dim, times.double()[:, None, None]
    x, v = scene.points, scene.velocities
    a = torch.zeros_like(x)
    axes = KINDS[motion].axes
    if KINDS[motion].degree > 1:
        a[:, :axes] = scene.structure[:, -axes:]
        assert 0.027 < a.square().sum(-1).mean().sqrt() < 0.033
    path = x + t * v + t**2 * a
    seen = project(torch.cat([path, torch.ones_like(path[..., :1])], -1), scene.cameras)
    torch.testing.assert_close(seen, scene.exact, rtol=0, atol=1e-9)
    middle = x + t.mean() * v + t.mean() ** 2 * a
    assert 0.95 < middle.square().sum(-1).mean().sqrt() < 1.05
    speed = (v + 2 * t.mean() * a).square().sum(-1).mean().sqrt()
    assert 0.115 < speed < 0.125 if axes else speed == 0
    assert (v[:, axes:] == 0).all() and torch.linalg.matrix_rank(v) == axes and x.shape[-1] == d


@pytest.mark.parametrize("motion", ["two_bodies_2d", "two_bodies_3d"])
def test_bodies_move_as_a_whole(motion):
    scene = lifted_points(motion, 40, 4, outliers=0.1, batch=3, generator=seeded())
    assert scene.lifts is None and scene.velocities is None
    body2 = scene.structure[..., -1] == 1
    assert torch.equal(body2[scene.labels > 0], scene.labels[scene.labels > 0] == 2)
    assert (scene.labels == 2).sum(-1).tolist() == [18] * 3
    path = scene.points[:, None] + torch.where(body2[:, None, :, None], scene.displacements[:, :, None], 0.0)
    seen = project(torch.cat([path, torch.ones_like(path[..., :1])], -1), scene.cameras)
    torch.testing.assert_close(seen, scene.exact, rtol=0, atol=1e-9)
    # relative motion that is not uniform
    assert scene.displacements.diff(n=2, dim=1).norm(dim=-1).min() > 0.01


@pytest.mark.parametrize("motion", [m for m in KINDS if not KINDS[m].sensors])
def test_cameras_see_the_scene_in_front_of_them(motion):
    scene = lifted_points(motion, 200, 6, batch=50, generator=seeded())
    cameras = scene.cameras / scene.cameras[..., 2, :3].norm(dim=-1)[..., None, None]
    if KINDS[motion].dim == 3:
        depth = (torch.cat([scene.points, torch.ones_like(scene.points[..., :1])], -1)[:, None] @ cameras[..., 2, :, None])[..., 0]
        assert depth.min() > 0.3
        centre = -torch.linalg.solve(scene.cameras[..., :3], scene.cameras[..., 3])
        assert 3.8 < centre.norm(dim=-1).mean() < 4.4
        # not uniform
        assert centre.diff(n=2, dim=1).norm(dim=-1).mean() > 0.5
    inside = ((scene.exact > 0) & (scene.exact < 1000)).all(-1).double().mean()
    assert inside > 0.9 and 150 < (scene.exact - scene.exact.mean(2, keepdim=True)).norm(dim=-1).mean() < 450


@pytest.mark.parametrize(("motion", "profile"), [row[:2] for row in TABLE if row[2] < 243])
def test_ranks_are_those_that_are_counted(motion, profile):
    """Of moving points, and of static ones or one body alone."""
    moving, still = (lifted_points(motion, 45, len(profile), generator=seeded(2), **o).exact for o in ({}, {"static": 1.0}))
    assert rank(moving, profile) == count(motion, profile=profile).rank
    alone = {} if motion.startswith("static") else {"objects": [80, 0]} if motion.startswith("two") else {"static": 80}
    assert rank(still, profile) == count(motion, profile=profile, **alone).rank


def test_rank_of_two_sensors_and_a_camera():
    first, second, third = lifted_points(SENSORS, 80, generator=seeded()).exact
    camera = torch.tensor([[1.0, 0.2, 0.1, 0.0], [-0.1, 1.0, 0.3, 0.2], [0.1, -0.2, 0.2, 4.0]], dtype=torch.float64)
    image = project(torch.cat([third, torch.ones_like(third[:, :1])], -1)[None], camera[None])[0]
    assert rank([first, second, image], (3, 3, 1)) == 47


@pytest.mark.parametrize(
    ("motion", "profile", "drift", "expected"),
    [
        (VELOCITY_2D, (2, 2, 1), 0.0, 26),
        (DIRECTION_3D, (2, 2, 1), 0.0, 22),
        (DIRECTION_3D, (2, 2, 1), 1.0, 26),
        (PLANES_3D, (2, 2, 1, 1), 0.0, 74),
        (PLANES_3D, (2, 2, 1, 1), 1.0, 80),
        (VELOCITY_3D, (2, 2, 2, 1), 0.0, 75),
        (VELOCITY_3D, (2, 2, 2, 1), 1.0, 75),
    ],
)
def test_ranks_of_turning_and_of_uniformly_moving_cameras(motion, profile, drift, expected):
    times = [0.0, 1.0, 2.5, 3.0][: len(profile)]
    scene = lifted_points(motion, 80, times=times, jitter=0.0, drift=drift, generator=seeded(2))
    assert rank(scene.exact, profile) == expected


@pytest.mark.parametrize("motion", [VELOCITY_2D, VELOCITY_3D, SENSORS])
def test_outliers_and_gaps_are_those_asked_for(motion):
    scene = lifted_points(motion, 400, 6, sigma=0.0, outliers=0.25, missing=0.5, static=0.2, batch=2, generator=seeded())
    seen = scene.tracks.isfinite().all(-1)
    assert torch.equal(seen, ~scene.tracks.isnan().any(-1))
    k, size = scene.structure.shape[-1] - 1, scene.tracks.shape[-1]
    assert seen.sum(-2).min() == -(-k // size) and 0.45 < seen.double().mean() < 0.75
    off = torch.where(seen[..., None], scene.tracks - scene.exact, 0.0)
    wrong = (off != 0).any(-1)
    # one observed view of each outlier, none of the others
    assert torch.equal(wrong.sum(-2), (scene.labels == OUTLIER).long())
    reach = 0.3 if motion == SENSORS else 100.0
    assert 0.95 * reach < off.abs().max() < reach and (wrong.sum(-1) > 0).all()
    assert [(scene.labels == kind).sum(-1).tolist() for kind in (0, 1, 2)] == [[100] * 2, [60] * 2, [240] * 2]


@pytest.mark.parametrize("motion", KINDS)
def test_generator_reproduces_and_types_convert(motion):
    options = {"batch": 2, "sigma": 0.1, "outliers": 0.2, "missing": 0.1}
    a, b, c = (lifted_points(motion, 20, generator=seeded(s), **options) for s in (5, 5, 6))
    torch.testing.assert_close(a.tracks, b.tracks, rtol=0, atol=0, equal_nan=True)
    assert torch.equal(a.labels, b.labels) and not torch.equal(a.exact, c.exact)
    assert (a.exact[0] - a.exact[1]).abs().max() > 1e-3
    single = lifted_points(motion, 20, generator=seeded(5), dtype=torch.float32, **options)
    assert single.exact.dtype == single.cameras.dtype == single.times.dtype == torch.float32 and single.labels.dtype == torch.int64
    torch.testing.assert_close(single.exact, a.exact.float(), rtol=1e-6, atol=1e-4)
    noisy = lifted_points(motion, 2000, sigma=0.5, generator=seeded())
    noise = (noisy.tracks - noisy.exact).flatten(0, 1)
    torch.testing.assert_close(noise.std(0), torch.full_like(noise[0], 0.5), rtol=0.05, atol=0)
    assert noisy.sigma == 0.5


def test_misuse_is_named():
    assert_refused(
        (lambda: lifted_points("fast"), "motion must be one of"),
        (lambda: lifted_points(VELOCITY_2D, 0), "n >= 1"),
        (lambda: lifted_points(VELOCITY_2D, views=0), "views >= 1"),
        (lambda: lifted_points(VELOCITY_2D, views=3, times=[0.0, 1.0]), "one per view"),
        (lambda: lifted_points(VELOCITY_2D, missing=1.0), "missing is a share"),
        (lambda: lifted_points(VELOCITY_2D, sigma=-1.0), "sigma must be"),
        (lambda: lifted_points(VELOCITY_2D, outliers=2.0), "outliers is a share"),
    )

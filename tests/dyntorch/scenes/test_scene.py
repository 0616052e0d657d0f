"""The scenes obey the equations that define them, give the ranks that the theory counts, and are what they say they are."""

import pytest
import torch
from torch.nn.functional import normalize

from dyntorch.geometry.extensors import compound, plucker, plucker_form
from dyntorch.geometry.homogeneous import apply, homogeneous, unit
from dyntorch.scenes import collineation, constant_velocity, lines_concurrent, moving_points, planar, translating_lines, two_view
from tests.battery.projections import hyperplanes
from tests.draws import random, seeded
from tests.grid import assert_refused, grid

LABELLED = [planar, lines_concurrent, moving_points, constant_velocity, translating_lines]
ALL = [*LABELLED, two_view, collineation]


def make(function, n=40, **options):
    return function(2, n, **options) if function is collineation else function(n, **options)


def lift(x):
    """Unit homogeneous points."""
    return normalize(homogeneous(x), dim=-1)


def rows(*factors):
    """Kronecker products of the factors, match by match."""
    result = factors[0]
    for factor in factors[1:]:
        result = (result[..., :, None] * factor[..., None, :]).flatten(-2)
    return result


def centred(x):
    """Points moved and scaled to order 1, which changes no rank."""
    flat = x.flatten(0, -2)
    return (x - flat.mean(0)) / flat.std(0)


def rank(matrix):
    s = torch.linalg.svdvals(matrix)
    return int((s > 1e-9 * s[0]).sum())


def spectrum_in_first(scene, views):
    """Singular values of the three points of each match, brought to view 1 and of unit norm."""
    first, second, third = (normalize(v, dim=-1) for v in views)
    a, b = scene.motion
    return torch.linalg.svdvals(torch.stack([first, normalize(second @ a.mT, dim=-1), normalize(third @ b.mT, dim=-1)], dim=-2))


@pytest.mark.parametrize("function", [planar, moving_points])
def test_moving_points_are_collinear_and_static_points_coincide(function):
    scene = make(function, 60, batch=4, static=0.4, generator=seeded())
    s = spectrum_in_first(scene, [homogeneous(v) for v in scene.exact])
    static, moving = scene.labels == 1, scene.labels == 2
    assert s[..., 2].max() < 1e-12
    assert s[static][:, 1].max() < 1e-12
    assert s[moving][:, 1].min() > 1e-4
    x1, x2, x3 = scene.exact
    a, b = scene.motion
    torch.testing.assert_close(apply(a, x2)[static], x1[static], rtol=0, atol=1e-9)
    torch.testing.assert_close(apply(b, x3)[static], x1[static], rtol=0, atol=1e-9)


def test_planar_points_move_by_the_steps_and_not_at_constant_speed():
    scene = planar(2000, step=(25.0, 80.0), generator=seeded())
    x1, x2, x3 = scene.exact
    a, b = scene.motion
    to_second = torch.linalg.inv(a)
    back, forth = apply(to_second, x1) - x2, apply(to_second @ b, x3) - x2
    for path in (back.norm(dim=-1), forth.norm(dim=-1)):
        assert path.min() > 25 - 1e-6 and path.max() < 80 + 1e-6 and path.std() > 10
    turned = (back * forth).sum(-1) > 0
    assert 0.45 < turned.double().mean() < 0.55
    assert x2.amin() >= 0 and (x2.amax(0) <= torch.tensor([640.0, 480.0])).all()


def test_lines_are_concurrent_and_static_lines_coincide():
    scene = lines_concurrent(60, batch=4, static=0.4, generator=seeded())
    a, b = (torch.linalg.inv(m).mT for m in scene.motion)
    # in units of the image, where a line is not dominated by its constant
    units = torch.diag(torch.tensor([1.0, 1.0, 1 / 300.0], dtype=torch.float64))
    stack = [normalize(line @ units, dim=-1) for line in (scene.exact[0], scene.exact[1] @ a.mT, scene.exact[2] @ b.mT)]
    s = torch.linalg.svdvals(torch.stack(stack, dim=-2))
    assert s[..., 2].max() < 1e-12
    assert rank(rows(*(normalize(line[scene.labels == 2] @ units, dim=-1)[:36] for line in scene.exact))) == 26
    assert s[scene.labels == 1][:, 1].max() < 1e-11
    assert s[scene.labels == 2][:, 1].median() > 0.1
    for v, line in enumerate(scene.exact):
        torch.testing.assert_close(line[..., :2].norm(dim=-1), torch.ones(4, 60, dtype=torch.float64))
        # pixels: the line has a unit normal
        assert (line * homogeneous(scene.extras["points"][:, v])).sum(-1).abs().max() < 1e-9


def test_noise_of_lines_comes_from_their_points():
    scene = lines_concurrent(3000, sigma=0.5, generator=seeded())
    distance = (scene.views[0][:, None] * homogeneous(scene.extras["segments"][0])).sum(-1)
    assert distance.abs().max() < 1e-9
    off = (scene.views[0] * homogeneous(scene.extras["points"][0])).sum(-1)
    # between two noisy points at about equal distance the line is off by sigma / sqrt 2
    assert 0.3 < off.std() < 0.45


@pytest.mark.parametrize("sensors", ["projective", "affine", "rigid"])
@pytest.mark.parametrize("camera", [False, True])
def test_constant_velocity_is_seen_by_its_sensors(sensors, camera):
    scene = constant_velocity(50, batch=3, sensors=sensors, static=0.2, camera=camera, generator=seeded())
    x, v = scene.extras["points"], scene.extras["velocities"]
    for t in range(3):
        torch.testing.assert_close(apply(scene.motion[t], x + t * v), scene.exact[t])
    assert torch.equal(v.norm(dim=-1) == 0, scene.labels == 1)
    assert scene.exact[2].shape[-1] == (2 if camera else 3)
    last = scene.motion[0][..., 3, :3]
    assert (last.abs().max() > 0.01) == (sensors == "projective")


@pytest.mark.parametrize("function", [moving_points, constant_velocity, translating_lines])
def test_rigid_sensors_are_rigid(function):
    motion = function(5, batch=6, sensors="rigid", generator=seeded()).motion[0]
    block = motion[..., :3, :3] / motion[..., 3:, 3:]
    torch.testing.assert_close(block @ block.mT, torch.eye(3, dtype=torch.float64).expand(6, 3, 3))
    assert (torch.linalg.det(block) > 0).all() and motion[..., 3, :3].abs().max() == 0


@pytest.mark.parametrize(("velocities", "dimension"), [("general", 3), ("planar", 2), ("linear", 1), ("equal", 1)])
def test_velocities_span_what_they_say(velocities, dimension):
    v = constant_velocity(40, batch=5, velocities=velocities, generator=seeded()).extras["velocities"]
    assert torch.equal(torch.linalg.matrix_rank(v), torch.full((5,), dimension))
    assert (v.std(dim=-2).max() < 1e-12) == (velocities == "equal")


@pytest.mark.parametrize("motion", ["in_plane", "translation", "objects"])
def test_lines_meet_their_images(motion):
    scene = translating_lines(50, batch=3, motion=motion, static=0.2, static_points=4, generator=seeded())
    (a,) = scene.motion
    l1, l2 = (normalize(plucker(x), dim=-1) for x in scene.exact)
    mapped = normalize(l2 @ compound(a, 2).mT, dim=-1)
    assert torch.einsum("bni,ij,bnj->bn", l1, plucker_form(), mapped).abs().max() < 1e-12
    same = (l1 * mapped).sum(-1).abs()
    assert (1 - same[scene.labels == 1]).max() < 1e-10 and (1 - same[scene.labels == 2]).max() > 1e-3
    torch.testing.assert_close(apply(a, scene.extras["points2"]), scene.extras["points1"])
    # the measured ends do not correspond
    ends = apply(a, scene.exact[1].flatten(1, 2)).unflatten(1, (50, 2))
    assert (ends - scene.exact[0])[scene.labels == 1].norm(dim=-1).median() > 0.1


def test_two_views_obey_the_epipolar_constraint():
    scene = two_view(50, batch=3, generator=seeded())
    (f,) = scene.motion
    x1, x2 = (homogeneous(x) for x in scene.exact)
    line = x1 @ f.mT
    assert ((x2 * line).sum(-1) / line[..., :2].norm(dim=-1)).abs().max() < 1e-9
    moved = scene.extras["points"] @ scene.extras["rotation"].mT + scene.extras["translation"][:, None]
    k = torch.tensor([[700.0, 0.0, 320.0], [0.0, 700.0, 240.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
    torch.testing.assert_close((moved @ k.T)[..., :2] / moved[..., 2:], scene.exact[1])
    assert moved[..., 2].min() > 0


@pytest.mark.parametrize("dim", [1, 2, 3])
def test_collineations_map_their_matches(dim):
    scene = collineation(dim, 20, batch=3, generator=seeded())
    torch.testing.assert_close(apply(scene.motion[0], scene.exact[1]), scene.exact[0])
    design = (hyperplanes(scene.exact[0])[0][..., :, :, None] * homogeneous(scene.exact[1])[0][:, None, None, :]).flatten(2)
    assert rank(design.flatten(0, 1)) == (dim + 1) ** 2 - 1


def design_of(name, scene):
    """Estimation matrix of one invariant, row by row from its definition."""
    x = [lift(centred(v)) for v in scene.exact]
    if name == "constant_velocity":
        planes = hyperplanes(centred(scene.exact[2]))
        return rows(x[0][:, None], x[1][:, None], planes).flatten(0, 1)
    if name == "minimal_join":
        return rows(x[0], x[1], x[2] @ random(3, 4, seed=9).T)
    return rows(*x)


@grid(
    (
        ("name", "scene", "expected"),
        [
            ("homography", lambda g: planar(60, generator=g), 26),
            ("homography", lambda g: planar(60, static=1.0, generator=g), 10),
            ("homography", lambda g: planar(20, static=0.5, generator=g), 20),
            ("join", lambda g: moving_points(120, generator=g), 60),
            ("join", lambda g: moving_points(120, static=1.0, generator=g), 20),
            ("minimal_join", lambda g: moving_points(120, generator=g), 47),
            ("constant_velocity", lambda g: constant_velocity(60, generator=g), 63),
            ("constant_velocity", lambda g: constant_velocity(21, generator=g), 63),
            ("constant_velocity", lambda g: constant_velocity(60, camera=True, generator=g), 47),
            ("constant_velocity", lambda g: constant_velocity(60, static=1.0, generator=g), 36),
            ("constant_velocity", lambda g: constant_velocity(60, velocities="equal", generator=g), 36),
            ("constant_velocity", lambda g: constant_velocity(60, velocities="linear", generator=g), 49),
            ("constant_velocity", lambda g: constant_velocity(60, velocities="planar", generator=g), 58),
            ("fundamental", lambda g: two_view(60, generator=g), 8),
        ],
    )
)
def test_ranks_are_those_of_the_theory(name, scene, expected):
    assert rank(design_of(name, scene(seeded(3)))) == expected


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ({"motion": "in_plane"}, 35),
        ({"motion": "translation"}, 31),
        ({"motion": "objects", "objects": 1}, 20),
        ({"motion": "objects", "objects": 2}, 28),
        ({"motion": "objects", "objects": 3}, 31),
        ({"static": 1.0}, 20),
    ],
)
def test_ranks_of_translating_lines(options, expected):
    scene = translating_lines(90, generator=seeded(), **options)
    l1, l2 = (normalize(plucker(x), dim=-1) for x in scene.exact)
    assert rank(rows(l2, l1)) == expected


@pytest.mark.parametrize("function", ALL)
@pytest.mark.parametrize("batch", [(), (3,), (2, 3)])
def test_batch_shapes_and_normalized_motion(function, batch):
    scene = make(function, 12, batch=batch, sigma=0.01, outliers=0.25, generator=seeded())
    assert scene.labels.shape == (*batch, 12)
    for view, exact in zip(scene.views, scene.exact, strict=True):
        assert view.shape == exact.shape and view.shape[: len(batch) + 1] == (*batch, 12)
    for m in scene.motion:
        assert m.shape[:-2] == batch
        torch.testing.assert_close(unit(m), m)
    if batch:
        first = scene.exact[0].flatten(0, len(batch) - 1)
        assert (first[0] - first[1]).abs().min() > 0


@pytest.mark.parametrize("function", ALL)
def test_generator_reproduces_and_seeds_differ(function):
    options = {"batch": 2, "sigma": 0.1, "outliers": 0.2}
    a, b, c = (make(function, **options, generator=seeded(s)) for s in (5, 5, 6))
    assert all(torch.equal(x, y) for x, y in zip(a.views + a.motion, b.views + b.motion, strict=True))
    assert torch.equal(a.labels, b.labels)
    assert not torch.equal(a.views[0], c.views[0])
    # single precision is the rounded scene
    single = make(function, **options, generator=seeded(5), dtype=torch.float32)
    for x, y in zip(single.views + single.motion, a.views + a.motion, strict=True):
        assert x.dtype == torch.float32
        torch.testing.assert_close(x, y.float(), rtol=1e-5, atol=1e-5 * float(y.abs().max()))
    moved = a.to(dtype=torch.float32, device="cpu")
    assert (moved.views[0].dtype, moved.labels.dtype, moved.extras["moving"].dtype) == (torch.float32, torch.int64, torch.bool)


@pytest.mark.parametrize("function", LABELLED)
@pytest.mark.parametrize(("static", "outliers"), [(0.3, 0.2), (0.0, 0.5), (1.0, 0.1), (0.37, 0.0)])
def test_shares_are_exact_in_every_scene(function, static, outliers):
    scene = make(function, 100, batch=4, static=static, outliers=outliers, generator=seeded())
    wrong = round(100 * outliers)
    counts = [(scene.labels == kind).sum(-1).tolist() for kind in (0, 1, 2)]
    still = round(static * (100 - wrong))
    assert counts == [[wrong] * 4, [still] * 4, [100 - wrong - still] * 4]
    assert ((~scene.extras["moving"]).sum(-1) == still + round(static * wrong)).all()
    assert torch.equal(scene.extras["moving"][scene.labels == 2], torch.ones(counts[2][0] * 4, dtype=torch.bool))
    if 0 < outliers < 1:
        # the order of the labels is random
        assert not torch.equal(scene.labels[0], scene.labels[1])


@pytest.mark.parametrize("function", [f for f in ALL if f is not lines_concurrent])
def test_outliers_replace_one_later_view_inside_its_box(function):
    scene = make(function, 200, batch=3, outliers=0.3, generator=seeded())
    changed = torch.stack([(v != e).flatten(2).any(-1) for v, e in zip(scene.views, scene.exact, strict=True)])
    assert not changed[0].any()
    assert torch.equal(changed.sum(0) == 1, scene.labels == 0) and changed.sum(0).max() == 1
    if len(changed) == 3:
        assert 0.3 < changed[1].sum() / changed.sum() < 0.7
    for view, exact in zip(scene.views, scene.exact, strict=True):
        low, high = exact.flatten(1, -2).amin(1), exact.flatten(1, -2).amax(1)
        flat = view.flatten(1, -2)
        assert (flat >= low[:, None] - 1e-9).all() and (flat <= high[:, None] + 1e-9).all()


@pytest.mark.parametrize("function", [f for f in ALL if f is not lines_concurrent])
def test_noise_is_isotropic_of_the_given_size(function):
    scene = make(function, 2000, batch=2, sigma=0.3, generator=seeded())
    for view, exact in zip(scene.views, scene.exact, strict=True):
        noise = (view - exact).flatten(0, -2)
        torch.testing.assert_close(noise.std(0), torch.full_like(noise[0], 0.3), rtol=0.06, atol=0)
        assert noise.mean(0).abs().max() < 0.03


def test_misuse_is_named():
    assert_refused(
        (lambda: planar(0), "n >= 1"),
        (lambda: planar(5, sigma=-1.0), "sigma must be"),
        (lambda: planar(5, static=1.5), "static is a share"),
        (lambda: two_view(5, outliers=-0.1), "outliers is a share"),
        (lambda: moving_points(5, sensors="lens"), "sensors must be"),
        (lambda: constant_velocity(5, velocities="fast"), "velocities must be"),
        (lambda: translating_lines(5, motion="fast"), "motion must be"),
        (lambda: translating_lines(5, objects=0), "objects must be"),
        (lambda: collineation(0), "dim must be"),
    )

"""translating_planes: exact and noisy scenes, missing and bad input, reconstruction."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

import dyntorch as dyn
from dyntorch import scenes
from dyntorch.core.outcome import Status
from dyntorch.geometry.homogeneous import apply, skew, unit
from dyntorch.metrics import relative_error
from dyntorch.tasks.planes.notices import PlanesNotice
from dyntorch.tasks.planes.planes import translating_planes
from tests.draws import seeded

F64 = torch.float64


def errors(found, scene):
    return relative_error(found.homography_at_infinity, scene.infinity)


def codes(found):
    return {notice.code for notice in found.warnings}


def measured(scene):
    return dyn.fit(dyn.Collineation(2), scene.x2, scene.x1).tensor


@pytest.mark.slow
@pytest.mark.parametrize("planes", [3, 4, 5, 8])
@pytest.mark.parametrize("matched", [False, True])
def test_exact_planes_give_everything(planes, matched):
    scene = scenes.translating_planes(planes, batch=4, generator=seeded())
    views = {"x1": scene.x1, "x2": scene.x2} if matched else {}
    scaled = scene.homographies * torch.linspace(-3, 2, planes, dtype=F64)[:, None, None]
    found = translating_planes(scaled, **views).check()
    assert errors(found, scene).max() < 1e-8
    assert relative_error(found.epipoles, scene.epipoles, dims=1).max() < 1e-8
    expected = skew(scene.epipoles) @ scene.infinity[:, None]
    assert relative_error(found.fundamentals, expected).max() < 1e-8
    again = found.homography_at_infinity[:, None] + found.epipoles[..., :, None] * found.normals[..., None, :]
    assert torch.allclose(found.scales[..., None, None] * again, unit(scaled), atol=1e-9)
    assert found.warnings == () and bool(found.used.all())
    if matched:
        assert relative_error(found.normals, scene.normals, dims=1).max() < 1e-8
        # depth is positive where the points are
        assert bool((found.depth(0, scene.x1[:, 0]) > 0).all())


@pytest.mark.parametrize(("method", "planes"), [("linear", 4), ("thesis", 5), ("closed_form", 3)])
def test_every_method_starts_alone(method, planes):
    scene = scenes.translating_planes(planes, batch=2, generator=seeded(1))
    start = translating_planes(scene.homographies, method=method, refine=False)
    assert errors(start, scene).max() < 1e-5
    assert errors(translating_planes(scene.homographies, method=method), scene).max() < 1e-9


@pytest.mark.parametrize(("planes", "bodies", "method"), [(2, 1, "mixed"), (0, 2, "fundamentals"), (3, 2, "auto")])
def test_bodies_with_known_fundamental_matrices(planes, bodies, method):
    scene = scenes.translating_planes(planes, bodies, batch=3, generator=seeded(2))
    F = scene.body_fundamentals
    H = scene.homographies if planes else None
    found = translating_planes(H, fundamentals=F, method=method).check()
    assert errors(found, scene).max() < 1e-8
    assert relative_error(found.fundamentals[:, planes:], F).max() < 1e-8
    assert found.epipoles.shape == (3, planes + bodies, 3) and found.normals.shape == (3, planes, 3)
    matches = {"x1": scene.x1, "x2": scene.x2} if planes else {}
    full = translating_planes(H, fundamentals=F, body_matches=(scene.body_x1, scene.body_x2), **matches)
    assert errors(full, scene).max() < 1e-8


@pytest.mark.slow
def test_matches_beat_matrices_and_matrices_the_thesis():
    scene = scenes.translating_planes(8, batch=12, sigma=0.5, generator=seeded(3))
    H = measured(scene)
    thesis = translating_planes(H, method="thesis", refine=False)
    alone = translating_planes(H)
    full = translating_planes(H, x1=scene.x1, x2=scene.x2)
    median = [float(errors(found, scene).median()) for found in (thesis, alone, full)]
    assert median[2] < 0.75 * median[1] and median[1] < 0.75 * median[0]
    # the noise is that of the matches: rms of what is left of 0.5 px
    assert float(full.residual.median()) == pytest.approx(0.5, rel=0.1)
    # bodies help planes
    scene = scenes.translating_planes(3, 1, batch=8, sigma=0.5, generator=seeded(4))
    few = translating_planes(x1=scene.x1, x2=scene.x2)
    both = translating_planes(x1=scene.x1, x2=scene.x2, body_matches=(scene.body_x1, scene.body_x2))
    assert float(errors(both, scene).median()) < 0.7 * float(errors(few, scene).median())


def test_the_covariance_is_that_of_the_error():
    scene = scenes.translating_planes(6, n=20, sigma=0.2, patch=300.0, generator=seeded(5))
    noise = 0.2 * torch.randn(30, 2, *scene.x1.shape, generator=seeded(6), dtype=F64)
    exact = apply(scene.homographies, scene.x1)
    found = translating_planes(x1=scene.x1 + noise[:, 0], x2=exact + noise[:, 1])
    # in units in which all entries are of order 1
    frame = torch.tensor([[1 / 400, 0, -1], [0, 1 / 400, -1], [0, 0, 1]], dtype=F64)
    lift = torch.kron(frame, torch.linalg.inv(frame).mT)
    truth = lift @ scene.infinity.flatten()
    estimate = found.homography_at_infinity.flatten(-2) @ lift.mT
    difference = estimate / estimate.norm(dim=-1, keepdim=True) - truth / truth.norm()
    basis = torch.linalg.qr(torch.cat([truth[:, None], torch.eye(9, dtype=F64)], dim=1)[:, :9])[0][:, 1:]
    covariance = basis.mT @ (lift @ found.covariance @ lift.mT) @ basis / truth.norm() ** 2
    inside = difference @ basis
    mahalanobis = (inside * torch.linalg.solve(covariance, inside)).sum(-1)
    assert 6 < float(mahalanobis.mean()) < 11  # 8 degrees of freedom


@pytest.mark.slow
def test_batch_equals_loop_and_neither_order_nor_units_of_the_image_matter():
    scene = scenes.translating_planes(5, batch=(2, 2), sigma=0.1, generator=seeded(11))
    H = measured(scene)
    whole = translating_planes(H, x1=scene.x1, x2=scene.x2)
    assert whole.homography_at_infinity.shape == (2, 2, 3, 3) and whole.covariance.shape == (2, 2, 9, 9)
    one = translating_planes(H[1, 0], x1=scene.x1[1, 0], x2=scene.x2[1, 0])
    assert torch.allclose(one.homography_at_infinity, whole.homography_at_infinity[1, 0], atol=1e-7)
    turned = translating_planes(H[1, 0].flip(0), x1=scene.x1[1, 0].flip(0), x2=scene.x2[1, 0].flip(0))
    assert torch.allclose(one.epipoles, turned.epipoles.flip(0), atol=1e-5)
    moved = torch.tensor([[2.0, 0, 30], [0, 2, -20], [0, 0, 1]], dtype=F64)
    x1, x2 = (apply(moved.expand(2, 2, 1, 3, 3), x) for x in (scene.x1, scene.x2))
    other = translating_planes(moved @ H @ torch.linalg.inv(moved), x1=x1, x2=x2)
    back = torch.linalg.inv(moved) @ other.homography_at_infinity @ moved
    assert relative_error(back, whole.homography_at_infinity).max() < 1e-6
    assert torch.allclose(other.residual / whole.residual, torch.tensor(2.0, dtype=F64), rtol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("scale", [1e-300, 1e300])
@pytest.mark.parametrize("given", ["matrices", "matches", "both"])
def test_tiny_and_huge_problems_leave_their_neighbours_alone(given, scale):
    scene = scenes.translating_planes(4, sigma=0.1, generator=seeded(11))
    H = {} if given == "matches" else {"H": scene.homographies}
    views = {} if given == "matrices" else {"x1": scene.x1, "x2": scene.x2}
    alone = translating_planes(**H, **views)
    factor = {"H": 1.0 if views else scale, "x1": scale, "x2": scale}
    found = translating_planes(**{name: torch.stack([x, x * factor[name]]) for name, x in (H | views).items()})
    assert int(found.status[0]) == int(alone.status) == Status.OK
    assert torch.allclose(found.homography_at_infinity[0], alone.homography_at_infinity, rtol=0, atol=1e-9)
    assert torch.allclose(found.epipoles[0], alone.epipoles, rtol=0, atol=1e-9)
    assert int(found.status[1]) != Status.OK and bool(found.homography_at_infinity.isfinite().all())


def test_missing_planes_are_left_out():
    scene = scenes.translating_planes(6, batch=3, generator=seeded(13))
    H = scene.homographies.clone()
    H[0, 0] = torch.nan
    H[1, 1] = torch.tensor([[1.0, 0, 0], [0, 1, 0], [1, 1, 0]], dtype=F64)
    H[2, :4] = torch.nan
    found = translating_planes(H)
    assert found.status.tolist() == [Status.OK, Status.OK, Status.TOO_FEW]
    assert errors(found, scene)[:2].max() < 1e-8
    assert found.used.sum(-1).tolist() == [5, 5, 2]
    assert codes(found) == {PlanesNotice.UNUSED_PLANE, PlanesNotice.FEW_PLANES}
    for name in ("homography_at_infinity", "epipoles", "fundamentals", "normals", "scales", "covariance", "residual"):
        assert bool(getattr(found, name).isfinite().all()), name
    assert bool((found.homography_at_infinity[2] == 0).all()) and bool((found.epipoles[0, 0] == 0).all())
    none = translating_planes(torch.tensor([0.0, torch.inf], dtype=F64)[:, None, None, None].expand(2, 4, 3, 3))
    assert none.status.tolist() == [Status.TOO_FEW] * 2
    assert bool(none.homography_at_infinity.isfinite().all()) and bool(none.fundamentals.isfinite().all())


@pytest.mark.slow
def test_matches_in_lists_and_missing_ones():
    scene = scenes.translating_planes(4, n=12, generator=seeded(14))
    first, second = [x.clone() for x in scene.x1], [x.clone() for x in scene.x2]
    first[1], second[1] = first[1][:7], second[1][:7]
    second[2][3] = torch.nan
    found = translating_planes(None, x1=first, x2=second).check()
    assert errors(found, scene) < 1e-8
    few = translating_planes(
        scene.homographies,
        x1=[x[:3] if i == 0 else x for i, x in enumerate(first)],
        x2=[x[:3] if i == 0 else x for i, x in enumerate(second)],
    )
    assert few.used.tolist() == [False, True, True, True]


def test_calibration_gives_the_rotation_and_the_scene():
    scene = scenes.translating_planes(4, 1, batch=2, generator=seeded(15))
    found = translating_planes(scene.homographies, fundamentals=scene.body_fundamentals, calibration=scene.calibration)
    assert torch.allclose(found.rotation, scene.rotation, atol=1e-9)
    assert relative_error(found.translations, scene.translations, dims=1).max() < 1e-8
    # a body's points, up to its scale, from its matches
    points = found.reconstruct(4, scene.body_x1[:, 0], scene.body_x2[:, 0])
    first, second = found.cameras()
    for camera, x in ((first, scene.body_x1[:, 0]), (second[:, 4], scene.body_x2[:, 0])):
        assert torch.allclose(apply(camera, points), x, atol=1e-6)
    flat = found.reconstruct(0, scene.x1[:, 0], scene.x2[:, 0])
    depth = flat[..., 2] * (scene.normals[:, 0] @ to_rays(scene.x1[:, 0]).mT).diagonal(dim1=0, dim2=1).mT
    assert torch.allclose(depth, depth[:, :1].expand_as(depth), rtol=1e-6)


def to_rays(x):
    return torch.cat([x, torch.ones_like(x[..., :1])], dim=-1)


def test_reconstruction_is_affine():
    scene = scenes.translating_planes(5, generator=seeded(16))
    found = translating_planes(scene.homographies, x1=scene.x1, x2=scene.x2)
    for i in range(5):
        X = found.reconstruct(i, scene.x1[i], scene.x2[i])
        truth = to_rays(scene.x1[i]) / (to_rays(scene.x1[i]) @ scene.normals[i])[:, None]
        ratio = X / truth
        assert torch.allclose(ratio, ratio[0, 0].expand_as(ratio), rtol=1e-6)
        assert torch.allclose(X[:, 2], found.depth(i, scene.x1[i]), rtol=1e-6)


def test_float32_empty_batch_and_repr():
    scene = scenes.translating_planes(5, generator=seeded(17)).to(torch.float32)
    found = translating_planes(scene.homographies, x1=scene.x1, x2=scene.x2)
    assert found.homography_at_infinity.dtype == torch.float32 and errors(found, scene) < 1e-2
    none = translating_planes(torch.zeros(0, 4, 3, 3))
    assert none.homography_at_infinity.shape == (0, 3, 3) and none.warnings == ()
    assert "empty" in repr(none)
    text = repr(translating_planes(scenes.translating_planes(3, 0, shared=2, batch=2, generator=seeded(18)).homographies))
    assert text.startswith("TranslatingPlanes(planes=3, bodies=0, batch=(2,): ") and "shared_body: 2 of 2 problems" in text
    for planes, shared, said in ((4, 2, False), (3, 3, True)):
        found = translating_planes(scenes.translating_planes(planes, shared=shared, generator=seeded(38)).homographies)
        assert ("three planes do not suffice then" in repr(found)) is said


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"H": torch.eye(3, dtype=F64).expand(2, 3, 3)}, "H and fundamentals hold 2 planes; method 'auto' needs at least 3 planes"),
        ({"H": torch.eye(3, dtype=F64).expand(3, 3, 3), "method": "linear"}, "needs at least 4 planes"),
        ({"H": torch.eye(3, dtype=F64).expand(4, 3, 3), "method": "best"}, "method must be 'auto' or one of linear"),
        ({"H": torch.eye(4, dtype=F64).expand(4, 4, 4)}, "H must be a floating point tensor"),
        ({"H": torch.ones(4, 3, 3, dtype=torch.long)}, "H must be a floating point tensor"),
        ({"H": [[1.0]]}, "H must be a torch.Tensor"),
        ({"fundamentals": torch.eye(3, dtype=F64)[None]}, "hold 1 fundamental matrix; method"),
        ({"H": torch.ones(1, 3, 3), "fundamentals": torch.ones(1, 3, 3)}, "2 planes and 1 fundamental matrix"),
        ({"H": torch.ones(4, 3, 3), "fundamentals": torch.ones(2, 1, 3, 3)}, "one batch and dtype"),
        ({"H": torch.ones(4, 3, 3), "x1": torch.ones(4, 9, 2)}, "x1 and x2 belong together, got only x1"),
        ({"H": torch.ones(4, 3, 3), "x1": torch.ones(4, 9, 2), "x2": torch.ones(4, 8, 2)}, "must be two views"),
        ({"H": torch.ones(4, 3, 3), "x1": torch.ones(3, 9, 2), "x2": torch.ones(3, 9, 2)}, "4 planes as the matrices have"),
        ({"H": torch.ones(4, 3, 3), "x1": [torch.ones(9, 3)], "x2": [torch.ones(9, 3)]}, "must be lists of tensors"),
        ({"H": torch.ones(4, 3, 3), "calibration": torch.ones(3, 3)}, "calibration must be finite and invertible"),
        ({"H": torch.ones(4, 3, 3), "calibration": torch.ones(2, 2)}, "calibration must be K"),
        ({"H": torch.ones(4, 3, 3), "calibration": torch.ones(2, 3, 3)}, r"batch \(\), or a pair .* got \(2, 3, 3\)"),
        ({"H": torch.ones(4, 3, 3), "calibration": 800.0}, "calibration must be K .* got float"),
        ({"H": torch.ones(4, 3, 3), "calibration": torch.eye(3).numpy()}, r"got numpy.ndarray \(use torch.as_tensor"),
        (
            {"H": torch.ones(1, 3, 3), "x1": [torch.ones(9, 2), torch.ones(5, 2)], "x2": [torch.ones(5, 2), torch.ones(9, 2)]},
            r"same points in both views, got \[9, 5\] and \[5, 9\]",
        ),
        ({"body_matches": (torch.ones(2, 9, 2),)}, "body_matches must be two views, .* got 1: Tensor"),
        ({"body_matches": (torch.ones(2, 9, 2), None)}, "body_matches must be two views, .* got 2: Tensor, NoneType"),
        ({}, "needs H"),
        (
            {"H": torch.ones(3, 3, 3), "fundamentals": torch.ones(1, 3, 3)} | dict.fromkeys(("x1", "x2"), torch.ones(3, 9, 2)),
            "planes or of the bodies only",
        ),
        ({"H": torch.ones(3, 3, 3), "options": {}}, r"options must be PlanesOptions, got \{\}; use dataclasses\.replace"),
    ],
)
def test_misuse_is_refused_in_one_line(arguments, message):
    with pytest.raises(ValueError, match=message) as raised:
        translating_planes(**arguments)
    assert "\n" not in str(raised.value)


@pytest.mark.slow
def test_options_decide():
    scene, shipped = scenes.translating_planes(5, sigma=0.5, generator=seeded()), dyn.PlanesOptions()
    matches = {"x1": scene.x1, "x2": scene.x2}
    assert int(translating_planes(**matches).status) == Status.OK
    sure = replace(shipped, max_error=0.0)
    assert int(translating_planes(**matches, options=sure).status) == Status.AMBIGUOUS
    # without steps the matches are fitted worse; one start alone misses the best minimum of four planes in some problem
    unrefined = translating_planes(**matches, options=replace(shipped, max_steps=0))
    assert float(unrefined.residual) > 1.5 * float(translating_planes(**matches).residual)
    few = scenes.translating_planes(4, sigma=0.5, batch=40, generator=seeded())
    several, one = (
        translating_planes(x1=few.x1, x2=few.x2, options=replace(shipped, num_refined=number)).residual for number in (4, 1)
    )
    assert float((one / several).amin()) > 1 - 1e-6 and float((one / several).amax()) > 1.001
    # a body of more weight keeps the fundamental matrix that it was given
    given = scenes.translating_planes(4, bodies=2, sigma=0.5, batch=6, generator=seeded())
    F = dyn.fit(dyn.FundamentalMatrix, given.body_x1, given.body_x2).tensor
    away = [
        float(relative_error(translating_planes(measured(given), fundamentals=F, options=option).fundamentals[:, 4:], F).mean())
        for option in (replace(shipped, body_weight=1.0), shipped)
    ]
    assert away[1] < 0.2 * away[0]
    careful = translating_planes(**matches, options=replace(shipped, risk=1e-6))
    assert float(careful.uncertainty) > float(translating_planes(**matches).uncertainty)

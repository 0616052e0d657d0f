"""Scenes of planes and bodies that translate independently are what they say they are."""

import pytest
import torch

from dyntorch.geometry.homogeneous import apply, homogeneous, skew
from dyntorch.metrics import relative_error
from dyntorch.scenes import translating_planes


def seeded(seed=0):
    return torch.Generator().manual_seed(seed)


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


def test_noise_is_that_of_both_views():
    noisy, exact = (translating_planes(3, n=500, sigma=s, generator=seeded(1)) for s in (0.5, 0.0))
    for a, b in ((noisy.x1, exact.x1), (noisy.x2, exact.x2)):
        assert float((a - b).std()) == pytest.approx(0.5, rel=0.05)


def test_special_positions():
    options = {"n": 5, "batch": 4, "generator": seeded(2)}
    assert rank_gap(translating_planes(5, **options).translations).min() > 1e-2
    assert rank_gap(translating_planes(5, collinear_epipoles=True, **options).epipoles).max() < 1e-12
    assert rank_gap(translating_planes(5, coplanar_normals=True, **options).normals).max() < 1e-9
    shared = translating_planes(5, shared=2, **options)
    assert torch.equal(shared.epipoles[:, 0], shared.epipoles[:, 1])
    static = translating_planes(5, static=True, **options)
    assert relative_error(static.homographies[:, 4], static.infinity).max() < 1e-12


def test_other_types_and_bad_input():
    scene = translating_planes(3, dtype=torch.float32, generator=seeded())
    assert scene.x1.dtype == scene.infinity.dtype == torch.float32 and scene.sigma == 0.0
    for wrong in ({"planes": -1}, {"patch": 0.0}, {"shared": 9}, {"bodies": -2}):
        with pytest.raises(ValueError, match="expected planes"):
            translating_planes(**wrong)

"""align_lines: scenes of known motion, the family that translation leaves, static points, degenerate and bad input."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from dyntorch import scenes
from dyntorch.core.outcome import Status
from dyntorch.geometry.extensors import plucker
from dyntorch.metrics import relative_error
from dyntorch.tasks.align.lines import align_lines, as_points
from dyntorch.tasks.align.result import MOVING, OUTLIER, STATIC

F64 = torch.float64


def draw(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


@pytest.mark.slow
def test_exact_from_the_fewest_lines() -> None:
    scene = scenes.translating_lines(35, batch=1, generator=draw())
    found = align_lines(*scene.views, threshold=1e-3, generator=draw(1)).check()
    assert bool((relative_error(found.A, scene.motion[0]) < 1e-6).all())
    assert found.B is None and bool((found.labels == MOVING).all())


@pytest.mark.slow
@pytest.mark.parametrize(("threshold", "batch"), [(0.015, 3), (None, 1)])
def test_noise_and_static_lines(threshold: float | None, batch: int) -> None:
    scene = scenes.translating_lines(90, batch=batch, sigma=0.005, static=0.3, generator=draw(2))
    found = align_lines(*scene.views, threshold=threshold, generator=draw(3)).check()
    assert bool((relative_error(found.A, scene.motion[0]) < 0.01).all())
    assert float((found.labels == scene.labels).double().mean()) > 0.93
    assert bool(((found.sigma / 0.005 - 1).abs() < 0.35).all())
    assert found.covariance.shape == (batch, 16, 16)


@pytest.mark.slow
def test_static_lines_help_where_samples_of_many_lines_are_never_clean() -> None:
    scene = scenes.translating_lines(120, batch=6, sigma=0.005, static=0.4, outliers=0.2, generator=draw(0))
    scene = replace(scene, views=tuple(v[1:3] for v in scene.views), motion=(scene.motion[0][1:3],), labels=scene.labels[1:3])
    found = align_lines(*scene.views, threshold=0.015, generator=draw(1)).check()
    assert bool((relative_error(found.A, scene.motion[0]) < 0.02).all())
    assert bool(((found.labels == scene.labels).double().mean(-1) > 0.95).all())


def test_pluecker_coordinates_give_the_same_motion() -> None:
    scene = scenes.translating_lines(60, sigma=0.002, generator=draw(6))
    by_points = align_lines(*scene.views, threshold=0.012, generator=draw(7)).check()
    by_pluecker = align_lines(*(plucker(x) for x in scene.views), threshold=0.012, generator=draw(7)).check()
    assert relative_error(by_points.A, by_pluecker.A) < 0.01
    # the two points lie on the line that they stand for
    line = plucker(scene.views[0])[None]
    again = plucker(as_points((line,), torch.ones(1, 60, dtype=F64))[0])
    parallel = (torch.nn.functional.normalize(line, dim=-1) * torch.nn.functional.normalize(again, dim=-1)).sum(-1).abs()
    torch.testing.assert_close(parallel, torch.ones(1, 60, dtype=F64))


class TestPureTranslation:
    @pytest.mark.parametrize("sigma", [0.0, 0.005])
    def test_without_static_points_it_says_what_remains(self, sigma: float) -> None:
        scene = scenes.translating_lines(60, batch=2, sigma=sigma, motion="translation", generator=draw(8))
        found = align_lines(*scene.views, threshold=0.015, generator=draw(9))
        assert bool((found.status != Status.OK).all())
        assert bool(found.has_notice("pure_translation").all())
        assert "four degrees of freedom" in str(found.warnings[0]) and "static points" in str(found.warnings[0])
        assert "position and the scale" in found.ambiguity

    @pytest.mark.parametrize(("motion", "count", "sigma"), [("translation", 2, 0), ("objects", 2, 0), ("translation", 4, 0.005)])
    def test_static_points_make_it_unique(self, motion: str, count: int, sigma: float) -> None:
        scene = scenes.translating_lines(60, batch=2, sigma=sigma, motion=motion, static_points=count, generator=draw(10))
        known = (scene.extras["points1"], scene.extras["points2"])
        found = align_lines(*scene.views, static_points=known, threshold=max(1e-3, 3 * sigma), generator=draw(11)).check()
        assert bool((relative_error(found.A, scene.motion[0]) < max(1e-6, 6 * sigma)).all())

    @pytest.mark.slow
    def test_noise_does_not_decide_what_the_lines_leave_open(self) -> None:
        kind = {"motion": "objects", "objects": 1, "static_points": 2}
        for sigma in (0.0, 0.001):
            scene = scenes.translating_lines(90, batch=3, sigma=sigma, generator=draw(14), **kind)
            points = (scene.extras["points1"], scene.extras["points2"])
            found = align_lines(*scene.views, static_points=points, threshold=max(3 * sigma, 1e-6), generator=draw(15))
            assert bool((found.status != Status.OK).all())


def test_labelled_static_lines_missing_ones_and_a_few_outliers() -> None:
    scene = scenes.translating_lines(80, batch=2, sigma=0.003, static=0.3, outliers=0.05, generator=draw(14))
    views = [x.clone() for x in scene.views]
    views[0][0, 3] = math.nan
    found = align_lines(views[0], views[1], static=scene.labels == STATIC, threshold=0.009, generator=draw(15)).check()
    assert bool((relative_error(found.A, scene.motion[0]) < 0.01).all())
    assert int(found.labels[0, 3]) == OUTLIER
    assert float((found.labels == OUTLIER)[scene.labels == OUTLIER].double().mean()) > 0.8
    empty = torch.zeros(0, 40, 2, 3)
    assert align_lines(empty, empty, threshold=0.1).A.shape == (0, 4, 4)


@pytest.mark.slow
def test_degenerate_data_have_a_status() -> None:
    same = torch.ones(40, 2, 3, dtype=F64) + torch.tensor([[0.0], [1.0]], dtype=F64)
    found = align_lines(same, same, threshold=0.01, generator=draw(16))
    assert int(found.status) != Status.OK
    assert bool(found.A.isfinite().all()) and bool(found.covariance.isfinite().all())


@pytest.mark.parametrize(
    ("count", "change", "text"),
    [
        (30, {}, "needs at least 35 lines, got 30 and 0 static points"),
        (40, {"threshold": -1.0}, "threshold must be a positive distance.*got -1"),
        (40, {"static_points": (torch.zeros(2, 3, dtype=F64), torch.zeros(3, 3, dtype=F64))}, "static_points must be two"),
        (40, {"static_points": (torch.zeros(2, 3), torch.zeros(2, 3))}, "static_points must be torch.float64"),
        (40, {"static_points": (torch.full((2, 3), math.nan, dtype=F64),) * 2}, "static_points must be finite"),
        (40, {"weights": torch.ones(7, dtype=F64)}, "weights must be"),
    ],
)
def test_misuse(count: int, change: dict[str, object], text: str) -> None:
    scene = scenes.translating_lines(count, generator=draw())
    with pytest.raises(ValueError, match=text):
        align_lines(*scene.views, **change)  # type: ignore[arg-type]

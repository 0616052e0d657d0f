"""align_points: every model against scenes of known motion, up to all points moving; degenerate and bad input."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from dyntorch import scenes
from dyntorch.core.outcome import Status
from dyntorch.core.robust import robust_fit
from dyntorch.geometry.rigid import moved_by, nearest_rotation, rigid_alignment, rigid_motion, rotation_exponential
from dyntorch.metrics import label_scores, point_error, relative_error, rotation_error, translation_error
from dyntorch.tasks.align import labelling
from dyntorch.tasks.align.points import Model, align_points
from dyntorch.tasks.align.result import MOVING, OUTLIER, STATIC, AlignNotice
from dyntorch.tasks.align.rigid import RigidSightings, normal_equations, squares
from tests.battery.steps import convoy

F64 = torch.float64


def draw(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def between(maps: tuple[Tensor, ...]) -> tuple[Tensor, Tensor]:
    """A and B of world to sensor maps."""
    return maps[0] @ torch.linalg.inv(maps[1]), maps[0] @ torch.linalg.inv(maps[2])


def second_difference(motion: tuple[Tensor, ...], scene: scenes.Scene) -> Tensor:
    """RMS of P1 - 2 A P2 + B P3 over the exact matches of moving points, which no common velocity changes."""
    y2, y3 = (
        torch.cat([x, torch.ones_like(x[..., :1])], dim=-1) @ (m / m[..., 3:, 3:]).mT
        for m, x in zip(motion, scene.exact[1:], strict=True)
    )
    return (scene.exact[0] - 2 * y2[..., :3] + y3[..., :3]).square().sum(-1).mean(-1).sqrt()


class TestRigidAlgebra:
    def test_alignment_against_scipy(self) -> None:
        x, y = torch.randn(2, 9, 3, generator=draw(), dtype=F64)
        found = rigid_alignment(x, y)
        first, second = x - x.mean(0), y - y.mean(0)
        rotation = torch.from_numpy(Rotation.align_vectors(first.numpy(), second.numpy())[0].as_matrix())
        torch.testing.assert_close(found[:3, :3], rotation)
        torch.testing.assert_close(found[:3, 3], x.mean(0) - rotation @ y.mean(0))

    def test_similarity_recovers_its_scale_and_weights_leave_out(self) -> None:
        turn = rotation_exponential(torch.tensor([0.3, -1.0, 0.5], dtype=F64))
        y = torch.randn(4, 8, 3, generator=draw(1), dtype=F64)
        x = 2.5 * y @ turn.mT + 1
        x[:, 0] += 100
        weights = torch.ones(4, 8, dtype=F64)
        weights[:, 0] = 0
        found = rigid_alignment(x, y, weights, scale=True)
        torch.testing.assert_close(found, rigid_motion(2.5 * turn, torch.ones(3, dtype=F64)).expand(4, 4, 4))

    def test_rotations(self) -> None:
        axis = torch.tensor([[0.2, -0.7, 1.1], [0.0, 0.0, 0.0], [3.0, 0.1, 0.0]], dtype=F64)
        turn = rotation_exponential(axis)
        skews = torch.linalg.matrix_exp(torch.stack([torch.linalg.cross(v.expand(3, 3), torch.eye(3, dtype=F64)).mT for v in axis]))
        torch.testing.assert_close(turn, skews)
        mirrored = nearest_rotation(torch.diag(torch.tensor([1.0, 1.0, -3.0], dtype=F64)))
        assert torch.linalg.det(mirrored) == pytest.approx(1.0)

    @pytest.mark.parametrize("motion", ["straight", "constant_velocity"])
    @pytest.mark.parametrize("mixed", [False, True])
    def test_gradient_of_the_residuals(self, motion: str, mixed: bool) -> None:
        x1, x2, x3 = torch.randn(3, 6, 3, generator=draw(2), dtype=F64)
        data = RigidSightings(x1, x2, x3, torch.rand(6, generator=draw(3), dtype=F64), motion)
        pose = moved_by(torch.eye(4, dtype=F64).expand(2, 4, 4), torch.randn(2, 6, generator=draw(4), dtype=F64))
        still = torch.arange(6) % 3 == 0 if mixed else None

        def cost(step: Tensor) -> Tensor:
            moving, static = squares(moved_by(pose, step.unflatten(-1, (2, 6))), data)
            return (data.weights * (moving if still is None else torch.where(still, static, moving))).sum() / 2

        h = 1e-6
        numeric = torch.stack([(cost(h * e) - cost(-h * e)) / (2 * h) for e in torch.eye(12, dtype=F64)])
        gradient, matrix = normal_equations(pose, data, data.weights, still)
        torch.testing.assert_close(gradient, numeric, atol=1e-7, rtol=1e-6)
        assert bool((torch.linalg.eigvalsh(matrix) > -1e-12).all())


class TestRigid:
    def test_exact_with_everything_moving(self) -> None:
        scene = scenes.moving_points(12, batch=3, sensors="rigid", generator=draw())
        found = align_points(*scene.views, model="rigid", threshold=1e-3, generator=draw(1)).check()
        for estimated, true in zip((found.A, found.B), scene.motion, strict=True):
            assert bool((rotation_error(estimated, true) < 1e-5).all())
            assert bool((translation_error(estimated, true) < 1e-7).all())
        assert bool((found.labels == MOVING).all())
        # alignment that takes movers for noise
        naive = rigid_alignment(scene.views[0], scene.views[1])
        assert float(rotation_error(naive, scene.motion[0]).min()) > 0.1

    @pytest.mark.parametrize("threshold", [0.03, None])
    def test_movers_alone_with_outliers(self, threshold: float | None) -> None:
        scene = scenes.moving_points(60, batch=6, sigma=0.01, outliers=0.3, sensors="rigid", generator=draw(2))
        found = align_points(*scene.views, model="rigid", threshold=threshold, generator=draw(3)).check()
        assert bool((rotation_error(found.A, scene.motion[0]) < 1.0).all())
        assert bool((translation_error(found.B, scene.motion[1]) < 0.06).all())
        assert label_scores(found.labels, scene.labels).recall.mean() > 0.97
        assert bool(((found.sigma / 0.01 - 1).abs() < 0.35).all())

    def test_static_and_moving_are_told_apart(self) -> None:
        scene = scenes.moving_points(40, batch=4, sigma=0.01, static=0.5, sensors="rigid", generator=draw(6))
        found = align_points(*scene.views, model="rigid", threshold=0.03, generator=draw(7)).check()
        assert float((found.labels == scene.labels).double().mean()) > 0.98
        assert "unique" in found.ambiguity

    def test_constant_velocity_finds_the_static_background(self) -> None:
        scene = scenes.constant_velocity(40, batch=4, sigma=0.01, static=0.3, outliers=0.2, sensors="rigid", generator=draw(8))
        found = align_points(*scene.views, model="rigid", motion="constant_velocity", threshold=0.03, generator=draw(9)).check()
        A, B = between(scene.motion)
        assert bool((rotation_error(found.A, A) < 1.0).all()) and bool((translation_error(found.B, B) < 0.06).all())
        assert label_scores(found.labels, scene.labels).recall.mean() > 0.97
        assert found.velocities is not None
        inside = scene.labels == MOVING
        turned = (scene.motion[0] / scene.motion[0][..., 3:, 3:])[..., :3, :3]
        true = scene.extras["velocities"] @ turned.mT
        assert float((found.velocities - true)[inside].norm(dim=-1).median()) < 0.03

    def test_constant_velocity_without_background_says_so(self) -> None:
        scene = scenes.constant_velocity(20, batch=3, sigma=0.005, sensors="rigid", generator=draw(10))
        found = align_points(*scene.views, model="rigid", motion="constant_velocity", threshold=0.015, generator=draw(11)).check()
        assert bool(found.has_notice("common_velocity").all())
        assert bool((second_difference((found.A, found.B), scene) < 0.05).all())
        assert found.velocities is not None
        assert float(found.velocities.mean(-2).norm(dim=-1).max()) < 1e-6

    @pytest.mark.slow
    def test_covariance_matches_the_scatter_over_noise(self) -> None:
        scene = scenes.moving_points(30, sensors="rigid", generator=draw(12))
        noise = 0.005 * torch.randn(3, 60, 30, 3, generator=draw(13), dtype=F64)
        found = align_points(
            *(x + e for x, e in zip(scene.views, noise, strict=True)), model="rigid", threshold=0.02, generator=draw(14)
        )
        entries = torch.stack([found.A, found.B], dim=1).flatten(1)
        scatter = torch.cov(entries.mT).diagonal()
        said = found.covariance.mean(0).diagonal()
        assert float(said.sum() / (scatter.sum() * (found.sigma.mean() / 0.005) ** 2)) == pytest.approx(1.0, abs=0.3)

    def test_labelled_static_matches_carry_the_motion(self) -> None:
        scene = scenes.moving_points(10, batch=3, sigma=0.005, static=0.4, sensors="rigid", generator=draw(15))
        found = align_points(*scene.views, model="rigid", threshold=0.015, static=scene.labels == STATIC, generator=draw(16))
        assert bool((rotation_error(found.A, scene.motion[0]) < 1.5).all())
        assert bool((found.labels[scene.labels == STATIC] == STATIC).all())

    def test_one_bad_problem_leaves_the_others(self) -> None:
        scene = scenes.moving_points(20, batch=3, sigma=0.005, static=0.5, sensors="rigid", generator=draw(17))
        broken = [x.clone() for x in scene.views]
        broken[1][1] = math.nan
        found = align_points(*broken, model="rigid", threshold=0.015, generator=draw(18))
        assert found.status.tolist() == [Status.OK, Status.TOO_FEW, Status.OK]
        assert bool((found.A[1] == 0).all()) and bool((found.labels[1] == OUTLIER).all())
        assert bool((rotation_error(found.A[[0, 2]], scene.motion[0][[0, 2]]) < 1.0).all())
        with pytest.raises(ValueError, match=r"problem 1 of \d: TOO_FEW"):
            found.check()

    def test_points_on_a_line_or_in_one_place_are_not_ok(self) -> None:
        line = torch.linspace(0, 5, 15, dtype=F64)[:, None] * torch.tensor([1.0, 2.0, 3.0], dtype=F64)
        found = align_points(line, line + 1, line + 2, model="rigid", threshold=0.01, generator=draw(19))
        assert int(found.status) in (Status.DEGENERATE, Status.AMBIGUOUS)
        same = torch.ones(12, 3, dtype=F64)
        alike = [align_points(same, same, same, model="rigid", threshold=t, generator=draw(20)) for t in (0.01, None)]
        assert all(int(one.status) != Status.OK for one in alike)
        assert all(bool(one.A.isfinite().all()) and bool(one.covariance.isfinite().all()) for one in (found, *alike))


class TestAffineConstantVelocity:
    def test_seven_matches_suffice(self) -> None:
        scene = scenes.constant_velocity(7, batch=4, sensors="affine", generator=draw())
        found = align_points(*scene.views, model="affine_constant_velocity", threshold=1e-3, generator=draw(1))
        assert bool((found.status == Status.OK).all())
        assert bool((second_difference((found.A, found.B), scene) < 0.5).all())
        last = found.A / found.A[..., 3:, 3:]
        torch.testing.assert_close(last[..., 3, :3], torch.zeros(4, 3, dtype=F64), atol=1e-9, rtol=0)

    @pytest.mark.slow
    def test_outliers_and_background(self) -> None:
        scene = scenes.constant_velocity(40, batch=3, sigma=0.005, static=0.4, outliers=0.2, sensors="affine", generator=draw(2))
        found = align_points(*scene.views, model="affine_constant_velocity", threshold=0.015, generator=draw(3)).check()
        A, B = between(scene.motion)
        assert bool((torch.maximum(relative_error(found.A, A), relative_error(found.B, B)) < 0.03).all())
        assert label_scores(found.labels, scene.labels).recall.mean() > 0.95
        assert not bool(found.has_notice("common_velocity").any())

    def test_planar_velocities_are_degenerate(self) -> None:
        scene = scenes.constant_velocity(30, batch=2, velocities="planar", sensors="affine", generator=draw(4))
        found = align_points(*scene.views, model="affine_constant_velocity", threshold=1e-3, generator=draw(5))
        assert bool((found.status == Status.DEGENERATE).all())
        assert bool(found.has_notice("planar_velocities").all())
        assert bool((found.A == 0).all())


class TestProjective:
    @pytest.mark.slow
    def test_constant_velocity(self) -> None:
        scene = scenes.constant_velocity(60, batch=1, sigma=0.002, static=0.3, generator=draw())
        found = align_points(*scene.views, model="constant_velocity", threshold=0.006, generator=draw(1)).check()
        A, B = between(scene.motion)
        assert bool((point_error(found.A, A, scene.exact[1]) < 0.03).all())
        assert bool((point_error(found.B, B, scene.exact[2]) < 0.03).all())
        assert float((found.labels == scene.labels).double().mean()) > 0.95
        assert found.velocities is not None and bool(found.velocities.isfinite().all())

    @pytest.mark.parametrize(("velocities", "code"), [("planar", "planar_velocities"), ("linear", "linear_velocities")])
    def test_degenerate_velocities_are_named(self, velocities: str, code: str) -> None:
        scene = scenes.constant_velocity(60, velocities=velocities, generator=draw(2))
        found = align_points(*scene.views, model="constant_velocity", threshold=1e-3, generator=draw(3))
        assert int(found.status) != Status.OK
        assert bool(found.has_notice(code))

    @pytest.mark.slow
    @pytest.mark.parametrize("model", ["join", "minimal_join"])
    def test_join(self, model: str) -> None:
        # a bound of six times the noise: the search is over at its first starts
        scene = scenes.moving_points(100, batch=1, sigma=0.001, static=0.3, generator=draw(4))
        found = align_points(*scene.views, model=model, threshold=0.006, generator=draw(5)).check()  # type: ignore[arg-type]
        assert bool((point_error(found.A, scene.motion[0], scene.exact[1]) < 0.01).all())
        assert bool((point_error(found.B, scene.motion[1], scene.exact[2]) < 0.01).all())
        assert float((found.labels == scene.labels).double().mean()) > 0.95
        assert found.covariance.shape == (1, 32, 32)

    @pytest.mark.slow
    def test_fewer_matches_than_the_tensor_needs_with_labels(self) -> None:
        scene = scenes.moving_points(20, sigma=0.001, static=0.5, generator=draw(6))
        found = align_points(*scene.views, static=scene.labels == STATIC, threshold=0.003, generator=draw(7))
        assert bool((point_error(found.A, scene.motion[0], scene.exact[1]) < 0.05).all())

    @pytest.mark.slow
    def test_one_trajectory_line_is_flagged(self) -> None:
        t = torch.linspace(-2, 2, 48, dtype=F64)[:, None] * torch.tensor([1.0, 0.5, 0.2], dtype=F64)
        speed = torch.rand(48, 1, generator=draw(8), dtype=F64)
        found = align_points(t, t + speed, t + 2.5 * speed, threshold=0.01, generator=draw(9))
        assert int(found.status) != Status.OK and bool(found.A.isfinite().all())


X1, X2, X3 = scenes.moving_points(30, generator=draw()).views


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"model": "affine"}, "model must be one of join.*got 'affine'"),
        ({"motion": "curved", "model": "rigid"}, "motion must be one of straight.*got 'curved'"),
        ({"motion": "constant_velocity"}, "belongs to model='rigid'"),
        ({"threshold": 0.0}, "threshold must be a positive distance.*got 0.0"),
        ({}, "needs at least 47 matches, got 30; add matches"),
        ({"weights": -torch.ones(30, dtype=F64)}, "weights must not be negative"),
        ({"static": torch.zeros(7, dtype=torch.bool)}, r"static must be .*30.*got \(7,\)"),
        ({"P2": X2.float()}, "one dtype"),
        ({"P2": X2[..., :2]}, "view 2"),
        ({"P2": X2[:29]}, "same"),
    ],
)
def test_misuse(change: dict[str, Any], text: str) -> None:
    with pytest.raises(ValueError, match=text):
        align_points(**{"P1": X1, "P2": X2, "P3": X3, **change})


@pytest.mark.slow
@pytest.mark.parametrize("model", ["join", "rigid", "constant_velocity", "affine_constant_velocity"])
def test_random_matches_are_refused_with_the_noise_unknown(model: Model) -> None:
    found = align_points(*torch.randn(3, 60, 3, generator=draw(50), dtype=F64), model=model, generator=draw(51))
    # what the best of no good samples lacks depends on the last digits
    assert found.status in (Status.NO_CONSENSUS, Status.DEGENERATE)
    assert not found.covariance.isnan().any() and not found.labels.any()
    assert found.sigma == 0 and "0 static, 0 moving, 60 outlier" in repr(found)


@pytest.mark.slow
@pytest.mark.parametrize("model", ["join", "rigid"])
def test_a_convoy_and_what_it_passes_are_each_others_background(model: Model) -> None:
    views = convoy(2, 90, still=30, step=(0.3, -0.2, 0.1), sigma=0.01, size=4.0, generator=draw(52))
    found = align_points(*views, model=model, threshold=0.03, generator=draw(53))
    assert (found.status == Status.AMBIGUOUS).all() and bool(found.has_notice(AlignNotice.OTHER_BACKGROUND).all())
    known = (torch.arange(90) < 6).expand(2, 90)
    settled = align_points(*views, model=model, threshold=0.03, static=known, generator=draw(53))
    assert (settled.status == Status.OK).all() and (settled.labels[:, :30] == STATIC).double().mean() > 0.95


def test_static_points_carry_a_rigid_sensor_among_random_movers() -> None:
    x1 = 4 * torch.rand(8, 60, 3, generator=draw(54), dtype=F64)
    wild = (torch.arange(60) >= 36)[:, None] * 0.4
    views = [x1, *(x1 + wild * torch.randn(x1.shape, generator=draw(seed), dtype=F64) for seed in (55, 56))]
    views = [x + 0.01 * torch.randn(x1.shape, generator=draw(57 + k), dtype=F64) for k, x in enumerate(views)]
    found = align_points(*views, model="rigid", threshold=0.03, generator=draw(60))
    assert (found.status == Status.OK).all()
    # within lines alone, movers could carry what stands still along
    assert (found.labels[:, :36] == STATIC).double().mean() > 0.95 and (found.A[:, :3, 3]).norm(dim=-1).max() < 0.05


def test_empty_batch_and_float32() -> None:
    empty = torch.zeros(0, 10, 3)
    found = align_points(empty, empty, empty, model="rigid", threshold=0.1)
    assert found.A.shape == (0, 4, 4) and found.labels.shape == (0, 10)
    scene = scenes.moving_points(20, sigma=0.01, sensors="rigid", generator=draw(21), dtype=torch.float32)
    single = align_points(*scene.views, model="rigid", threshold=0.03, generator=draw(22))
    assert single.A.dtype == torch.float32
    assert bool(rotation_error(single.A, scene.motion[0]) < 1.5)


@pytest.mark.slow
def test_the_full_tensor_is_only_searched_for_where_the_minimal_one_leaves_doubt(monkeypatch: pytest.MonkeyPatch) -> None:
    searched: list[tuple[str, Tensor]] = []

    def noted(invariant: Any, *views: Tensor, **options: Any) -> Any:
        searched.append((repr(invariant), (options["weights"] > 0).any(-1)))
        return robust_fit(invariant, *views, **options)

    monkeypatch.setattr(labelling, "robust_fit", noted)
    still, moving = (
        scenes.moving_points(70, sigma=0.01, static=share, generator=torch.Generator().manual_seed(0)).views for share in (1.0, 0.3)
    )
    views = [torch.stack(pair) for pair in zip(still, moving, strict=True)]
    found = align_points(*views, model="join", threshold=0.03, generator=torch.Generator().manual_seed(1))
    asked = [(name, where.tolist()) for name, where in searched]
    assert asked == [("MinimalJoinTensor", [True, True]), ("JoinTensor", [True, False])]
    assert (found.status == Status.OK).all() and ((found.labels != OUTLIER).sum(-1) > 65).all()

"""reconstruct: every motion, any times, gaps, batches, custom lifts: structure, consistency of what is returned, gauge."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

import dyntorch as dyn
from dyntorch import metrics, scenes
from dyntorch.core.outcome import Status
from dyntorch.scenes.lifts import KINDS
from dyntorch.tasks.reconstruct.motions import MOTIONS, Motion
from dyntorch.tasks.reconstruct.result import Reconstruction, ReconstructNotice
from tests.draws import seeded

F64 = torch.float64
NAMES = list(KINDS)
LIFTED = [name for name in NAMES if MOTIONS[name].lift is not None]


def scene_of(name: str, n: int = 60, **options: object) -> scenes.LiftedState:
    """At least n tracks, and a quarter more than the fewest of the model."""
    if "times" not in options:
        options.setdefault("views", max(4, KINDS[name].views))
    views = range(options.get("views") or len(options["times"]))
    n = max(n, math.ceil(1.25 * MOTIONS[name].min_views_and_tracks(options.get("times") or [*map(float, views)])[1]))
    return scenes.lifted_points(name, n, generator=seeded(3), **options)


def error(found: Reconstruction, scene: scenes.LiftedState) -> Tensor:
    if scene.lifts is not None:
        return metrics.lifted_error(found.structure, scene.structure, scene.lifts).position
    swapped = torch.where(scene.labels > 0, 3 - scene.labels, 0)
    either = [metrics.body_error(found.points, scene.points, labels).amax(-1) for labels in (scene.labels, swapped)]
    return torch.minimum(*either)


def off(found: Reconstruction, scene: scenes.LiftedState) -> Tensor:
    """Distances of the images of ``at(times)`` by the cameras from the tracks, ``(*batch, views, n)``."""
    places = torch.stack([found.at(t) for t in scene.times.tolist()], dim=-3)
    image = torch.cat([places, torch.ones_like(places[..., :1])], -1) @ found.cameras.mT
    return (image[..., :-1] / image[..., -1:] - scene.tracks).norm(dim=-1)


@pytest.mark.parametrize("name", NAMES)
def test_exact_scenes_in_a_batch_with_gaps(name: str) -> None:
    scene = scene_of(name, n=90, batch=(2, 1), missing=0.1, views=max(4, KINDS[name].views) + 1)
    found = dyn.reconstruct(scene.tracks, name, scene.times)
    assert (found.status == Status.OK).all()
    assert found.cameras.shape[:3] == (2, 1, len(scene.times))
    assert bool((error(found, scene) < 1e-8).all())
    assert bool((found.residual < 1e-6).all())
    assert bool((found.points.abs().amax((-1, -2)) < 30).all())


@pytest.mark.parametrize("name", LIFTED)
def test_cameras_points_and_velocities_agree(name: str) -> None:
    scene = scene_of(name, times=[-3.0, -2.2, 0.5, 0.7, 4.0])
    found = dyn.reconstruct(scene.tracks, name, scene.times)
    assert found.status == Status.OK
    assert bool((off(found, scene) < 1e-6).all())
    torch.testing.assert_close(found.at(0.0), found.points)
    step = 1e-4
    torch.testing.assert_close((found.at(step) - found.at(-step)) / (2 * step), found.velocities, rtol=1e-4, atol=1e-6)
    torch.testing.assert_close(found.image(found.cameras[2], 0.5), scene.tracks[2], rtol=0, atol=1e-6)


@pytest.mark.slow
def test_a_lost_problem_leaves_the_others_alone() -> None:
    scene = scene_of("constant_direction_3d", batch=(3,))
    tracks = scene.tracks.clone()
    tracks[1] = torch.nan
    found = dyn.reconstruct(tracks, "constant_direction_3d")
    assert found.status.tolist() == [Status.OK, Status.TOO_FEW, Status.OK]
    alone = dyn.reconstruct(scene.tracks[[0, 2]], "constant_direction_3d")
    assert bool((metrics.lifted_error(found.structure[[0, 2]], alone.structure, scene.lifts).position < 1e-8).all())
    assert bool(found.points[1].isnan().all()) and bool((found.cameras[1] == 0).all())
    assert "2 OK, 1 TOO_FEW" in repr(found) and "warning few_observed: 1 of 3 problems" in repr(found)
    with pytest.raises(ValueError, match="problem 1 of 3: TOO_FEW"):
        found.check()


@pytest.mark.parametrize("name", ["constant_velocity_2d", "constant_velocity_3d", "constant_direction_2d"])
def test_static_points_fix_the_common_motion(name: str) -> None:
    scene = scene_of(name, static=0.3)
    still = scene.labels == 1
    found = dyn.reconstruct(scene.tracks, name, static=still)
    assert bool((found.velocities[still].abs() < 1e-8).all())
    assert bool((found.velocities[~still].norm(dim=-1).median() > 1e-2).all())
    half = dyn.reconstruct(scene.tracks, name, static=still & (torch.arange(60) % 2 == 0))
    assert torch.equal(half.labels, scene.labels)  # also the static points that were not given


def test_float32_and_units() -> None:
    scene = scene_of("constant_velocity_2d")
    single = dyn.reconstruct(scene.tracks.float(), "constant_velocity_2d", scene.times)
    assert single.points.dtype == single.cameras.dtype == torch.float32
    assert repr(single).startswith("Reconstruction(constant_velocity_2d, views=4, points=60, batch=(): 1 OK)")
    assert "60 moving" in repr(single) and "velocity common to all points" in repr(single)
    assert single.labels.dtype == torch.long and single.inliers.dtype == torch.bool
    assert float(metrics.lifted_error(single.structure.double(), scene.structure, scene.lifts).position) < 1e-4
    milli = dyn.reconstruct(scene.tracks, "constant_velocity_2d", scene.times * 1e-3)
    assert bool((off(milli, replace(scene, times=scene.times * 1e-3)) < 1e-6).all())


@pytest.mark.parametrize("name", ["constant_velocity_2d", "constant_velocity_3d"])
def test_times_far_from_zero(name: str) -> None:
    scene = scene_of(name, times=[1000.0, 1000.6, 1002.0, 1003.0, 1003.3])
    found = dyn.reconstruct(scene.tracks, name, scene.times)
    assert found.status == Status.OK
    assert float(error(found, scene)) < 1e-8
    assert bool((off(found, scene) < 1e-3).all())


def test_observations_of_weight_zero_do_not_count() -> None:
    scene = scene_of("constant_velocity_2d", views=5)
    tracks, weights = scene.tracks.clone(), torch.ones(5, 60, dtype=F64)
    tracks[0, :5], weights[0, :5] = 999.0, 0.0
    weights[:, 7] = 0.0
    found = dyn.reconstruct(tracks, "constant_velocity_2d", weights=weights)
    assert float(found.residual) < 1e-6 and bool(found.residuals[0, :5].isnan().all())
    assert found.labels[7] == 0 and bool(found.points[7].isnan().all())


def falling(t: Tensor) -> Tensor:
    lift = torch.zeros(3, 4, dtype=F64)
    lift[:, :3] = torch.eye(3)
    lift[1, 3] = t**2
    return lift


def circling(t: Tensor) -> Tensor:
    """All points turn at one known rate about centres of their own."""
    c, s = math.cos(0.7 * float(t)), math.sin(0.7 * float(t))
    return torch.tensor([[1.0, 0, 0, c, -s], [0, 1, 0, s, c], [0, 0, 1, 0, 0]], dtype=F64)


@pytest.mark.parametrize("lift", [falling, circling])
def test_custom_lifts(lift) -> None:
    times = [0.0, 1.0, 2.5, 3.0, 4.2]
    motion = Motion(lift, lift.__name__)
    rows, size = lift(torch.tensor(0.0)).shape
    rand = seeded(1)
    structure = torch.randn(60, size, generator=rand, dtype=F64)
    structure[:, rows - 1] = 1.0
    structure[:, rows:] *= 0.2
    cameras = scenes.lifted_points(f"static_{rows - 1}d", 5, times=times, generator=rand).cameras
    lifts = motion.lifts(times)
    image = structure @ (cameras @ lifts).mT
    found = dyn.reconstruct(image[..., :2] / image[..., 2:], motion, times)
    assert found.status == Status.OK
    assert float(metrics.lifted_error(found.structure, structure, lifts).position) < 1e-6
    assert bool((found.points.norm(dim=-1) < 100).all())


@pytest.mark.slow
def test_known_static_points_determine_what_the_tensor_does_not() -> None:
    """Two columns of cars on a road: two velocities leave the tensor degenerate, the cameras follow from the road."""
    scene = scene_of("constant_velocity_2d", static=0.5)
    still = scene.labels == 1
    structure = scene.structure / scene.structure[..., 2:3]
    columns = torch.tensor([[0.08, 0.05], [-0.06, 0.1]], dtype=F64)[torch.arange(60) % 2]
    structure = torch.where(still[..., None], structure, torch.cat([structure[..., :3], columns], -1))
    images = structure[..., None, :, :] @ scene.projections.mT
    exact = images[..., :2] / images[..., 2:]
    tracks = exact + 0.3 * torch.randn(exact.shape, generator=seeded(4), dtype=F64)
    linear = dyn.fit(MOTIONS["constant_velocity_2d"].tensor(3), *exact[:3])
    assert linear.status == Status.DEGENERATE
    found = dyn.reconstruct(tracks, "constant_velocity_2d", scene.times, static=still)
    assert found.status == Status.OK
    assert float(found.velocities[still].abs().max()) < 1e-9
    assert float(metrics.lifted_error(found.structure, structure, scene.lifts).position) < 0.05


def test_one_wrong_track_is_found_without_losing_the_others() -> None:
    scene = scene_of("constant_velocity_2d", sigma=0.4)
    tracks = scene.tracks.clone()
    tracks[1, 5] += 40.0
    found = dyn.reconstruct(tracks, "constant_velocity_2d", scene.times)
    assert found.status == Status.OK
    assert not bool(found.inliers[1, 5]) and float(found.inliers.double().mean()) > 0.95
    assert float(metrics.lifted_error(found.structure, scene.structure, scene.lifts).position) < 0.05


def test_a_moving_point_said_to_stand_still_is_named() -> None:
    scene = scenes.lifted_points("constant_velocity_2d", 60, views=6, sigma=0.5, static=0.5, generator=seeded(4))
    given = (scene.labels == 1) & (scene.labels == 1).cumsum(-1).le(10)
    wrong = int((scene.labels == 2).nonzero()[0])
    given[wrong] = True
    found = dyn.reconstruct(scene.tracks, "constant_velocity_2d", scene.times, static=given)
    assert found.status == Status.OK and int(found.labels[wrong]) == 2
    assert [w.value for w in found.warnings if w.code == "static_moves"] == [1.0]
    assert float(error(found, scene)) < 0.01


@pytest.mark.slow
def test_tracks_shorter_than_the_recording_lead_from_view_to_view() -> None:
    times = [0.4 * i for i in range(16)]
    scene = scenes.lifted_points("constant_velocity_2d", 160, times=times, sigma=0.2, jitter=0.1, drift=2.0, generator=seeded(2))
    start = torch.randint(-3, 12, (160,), generator=seeded(3))
    frame = torch.arange(16)[:, None]
    tracks = torch.where(((frame < start) | (frame >= start + 8))[..., None], torch.nan, scene.tracks)
    found = dyn.reconstruct(tracks, "constant_velocity_2d", scene.times, threshold=math.inf)
    assert found.status == Status.OK
    assert float(metrics.lifted_error(found.structure, scene.structure, scene.lifts).position) < 0.05


@pytest.mark.slow
def test_wrong_observations_in_most_tracks_cost_only_themselves() -> None:
    scene = scenes.lifted_points("constant_velocity_2d", 80, times=[0.5 * i for i in range(10)], sigma=0.5, generator=seeded(1))
    wrong = torch.rand(10, 80, generator=seeded(4)) < 0.1
    off = 100 * (torch.rand(10, 80, 2, generator=seeded(6), dtype=F64) - 0.5)
    tracks = torch.where(wrong[..., None], scene.tracks + off, scene.tracks)
    found = dyn.reconstruct(tracks, "constant_velocity_2d", scene.times, threshold=1.5)
    assert found.status == Status.OK
    far = wrong & (off.norm(dim=-1) > 5)
    assert not bool(found.inliers[far].any()) and float(found.inliers[~wrong].double().mean()) > 0.97
    assert float(error(found, scene)) < 0.01


@pytest.mark.slow
def test_options_decide() -> None:
    scene = scenes.lifted_points("constant_velocity_2d", 60, views=4, outliers=0.3, sigma=0.3, generator=seeded(3))

    def found(**options: float) -> dyn.Reconstruction:
        given = dyn.ReconstructOptions(**options)
        return dyn.reconstruct(scene.tracks, "constant_velocity_2d", threshold=1.5, generator=source, options=given)

    source = seeded(5)
    assert int(found().status) == Status.OK
    assert int(found(min_inlier_share=0.9).status) == Status.NO_CONSENSUS
    assert int(found(max_uncertainty=0.0).status) == Status.AMBIGUOUS
    before = source.get_state()
    found(max_search_rounds=1)  # the first start is all points: nothing is drawn
    assert torch.equal(source.get_state(), before)
    found(max_search_rounds=2, min_inlier_share=0.9)
    assert not torch.equal(source.get_state(), before)


NAN = float("nan")
CV = "constant_velocity_2d"


def tracks() -> Tensor:
    return scenes.lifted_points(CV, 30, views=4, sigma=0.3, generator=seeded()).tracks


def half_lift(t: Tensor) -> Tensor:
    return torch.eye(2, 3, dtype=torch.float64)


UNIX = 1.7e9 + 1.5 * torch.arange(4, dtype=torch.float64)

CASES = {
    "times of torch.float32 near 1.7e.09 are rounded by up to 1e.02, .*float64": {"times": UNIX.float()},
    "times of torch.float32 .* count them from the first view": {"times": UNIX.float().numpy()},
    r"times reach 1.7e\+09, .* in torch.float64 .*count times from the first view": {"times": (UNIX - 1.7e9) / 1e3 + 1.7e9},
    "threshold must be a positive number in the unit of the tracks, got True": {"threshold": True},
    "generator must be a torch.Generator or None, got 0": {"generator": 0},
    r"static must be a bool tensor .*got \(3,\) torch.bool": {"static": [True, False, True]},
    "static must be a bool tensor .*got str": {"static": "all"},
    "lift of 'pole' is not finite at time 3": {"motion": Motion(lambda t: torch.eye(3, 4) / (3 - t), "pole")},
    r"lift of 'flat' must have rank d \+ 1 = 3, got 2 at time 2": {
        "motion": Motion(lambda t: torch.diag(torch.stack([t * 0 + 1, t * 0 + 1, 2 - t])), "flat")
    },
    r"tracks must be .*, got \(30, 2\)": {"tracks": torch.zeros(30, 2)},
    r"tracks must be .*, got \(4, 30, 5\)": {"tracks": torch.zeros(4, 30, 5)},
    "tracks must be a floating point torch.Tensor, got torch.int64": {"tracks": torch.zeros(4, 30, 2).long()},
    "needs at least 3 views, got 2": {"views": 2},
    "no declared motion takes 1 views of 30 tracks; 'static_2d' needs 2 views and 4 tracks": {"motion": "auto", "views": 1},
    r"times must be 30 finite .*tracks are \(\*batch, views, n, 2\); yours look transposed": {
        "times": UNIX,
        "tracks": torch.zeros(30, 4, 2),
    },
    "needs at least 13 tracks through 3 views, got 12": {"n": 12},
    "all times are 1": {"times": [1.0, 1, 1, 1]},
    "needs views at 3 different times or more, got 2 in 4 views": {"times": [0.0, 0, 1, 1]},
    "times must be 4 finite numbers": {"times": [0.0, 1.0]},
    "times must be 4 finite": {"times": [0.0, 1.0, NAN, 2.0]},
    "motion must be 'auto', a dyntorch.Motion or one of": {"motion": "walk"},
    "3D sensors.*; choose a motion for tracks of 2 coordinates, or motion='auto'": {"motion": "constant_velocity_3d_sensors"},
    "no number of views determines 'half'": {"motion": Motion(half_lift, "half")},
    "needs at least 40 tracks through 4 views, got 30": {"motion": "constant_velocity_3d"},
    "threshold must be a positive number in the unit of the tracks, got -1": {"threshold": -1.0},
    "threshold must be a positive number": {"threshold": "much"},
    "static must be a bool tensor": {"static": torch.ones(30)},
    r"static must be a bool tensor \(\*batch, n\) = \(30,\), got \(2, 30\)": {"static": torch.ones(2, 30, dtype=torch.bool)},
    "weights must not be negative or NaN, got -1": {"weights": -torch.ones(4, 30)},
    r"weights must be a tensor \(\*batch, views, n\) = \(4, 30\), got \(30,\)": {"weights": torch.ones(30)},
}


@pytest.mark.parametrize("message", CASES)
def test_refused(message: str) -> None:
    options = {"motion": CV, "tracks": tracks(), **CASES[message]}
    x = options.pop("tracks")[: options.pop("views", None), : options.pop("n", None)]
    with pytest.raises(ValueError, match=message):
        dyn.reconstruct(x, **options)


@pytest.mark.slow
def test_problems_with_too_little_say_so_and_times_keep_their_digits() -> None:
    x = tracks()
    once, few = x.clone(), x.clone()
    once[1:], few[1:, :20] = NAN, NAN
    found = dyn.reconstruct(torch.stack([x, x * NAN, once, few]), CV)
    assert found.status.tolist() == [Status.OK, *[Status.TOO_FEW] * 3]
    few_observed = [w for w in found.warnings if w.code == ReconstructNotice.FEW_OBSERVED]
    assert [(w.problem, w.value) for w in few_observed] == [((1,), 0), ((2,), 0), ((3,), 10)]
    with pytest.raises(ValueError, match=r"problem 1, 2, 3 of 4: TOO_FEW; .* needs 13 through the same ones"):
        found.check()
    found = [dyn.reconstruct(x, CV, times) for times in (UNIX, UNIX.tolist(), UNIX.numpy(), list(UNIX.numpy()))]
    assert all(one.times.equal(UNIX) and one.velocities.equal(found[0].velocities) for one in found)
    early = dyn.reconstruct(x, CV, 1.5 * torch.arange(4, dtype=torch.float64))
    assert abs(float(found[0].residual - early.residual)) < 1e-6


@pytest.mark.parametrize("options", [{}, {"threshold": 1.0}, {"static": torch.ones(30, dtype=torch.bool)}, {"motion": "auto"}])
def test_empty_batch(options: dict[str, object]) -> None:
    found = dyn.reconstruct(torch.empty(0, 4, 30, 2, dtype=torch.float64), times=UNIX, **{"motion": CV, **options})
    assert found.points.shape[:2] == (0, 30) and found.cameras.shape[:3] == (0, 4, 3)
    assert "empty" in repr(found)


def test_float32_times_that_are_exact_enough() -> None:
    x = tracks()
    for times in (torch.arange(4.0) + 20000, torch.arange(4.0) / 30):
        assert dyn.reconstruct(x, CV, times).status == Status.OK
    with pytest.raises(ValueError, match=r"times reach 1e\+06, .* in torch.float32 .*count times from the first view"):
        dyn.reconstruct(x.float(), CV, [1e6, 1e6 + 1, 1e6 + 2, 1e6 + 3])
    assert dyn.reconstruct(x.float(), CV, [1e3, 1e3 + 1, 1e3 + 2, 1e3 + 3]).status == Status.OK
    # nor do they matter where nothing moves
    x = scenes.lifted_points("static_2d", 30, views=2, sigma=0.3, generator=seeded()).tracks.float()
    assert dyn.reconstruct(x, "static_2d", UNIX[:2].float()).status == Status.OK


@pytest.mark.slow
def test_static_of_any_kind() -> None:
    scene = scenes.lifted_points(CV, 30, views=4, sigma=0.3, static=0.3, generator=seeded())
    known = scene.velocities.norm(dim=-1) < 1e-12
    assert known.any()
    first = dyn.reconstruct(scene.tracks, CV, static=known)
    for kind in (known.tolist(), known.numpy()):
        again = dyn.reconstruct(scene.tracks, CV, static=kind)
        assert again.points.equal(first.points) and again.labels.equal(first.labels)
    assert "given static points fix the common motion" in first.ambiguity


def test_no_static_point_is_none_given() -> None:
    scene = scenes.lifted_points(CV, 30, views=4, sigma=0.3, static=0.3, generator=seeded())
    known = scene.velocities.norm(dim=-1) < 1e-12
    alone = dyn.reconstruct(scene.tracks, CV)
    nothing = dyn.reconstruct(scene.tracks, CV, static=[False] * 30)
    assert nothing.ambiguity == alone.ambiguity and not nothing.warnings and nothing.labels.equal(alone.labels)
    both = dyn.reconstruct(scene.tracks.expand(2, 4, 30, 2), CV, static=torch.stack([known, known & False]))
    assert both.labels[1].equal(alone.labels) and not both.warnings
    torch.testing.assert_close(both.residuals[1], alone.residuals, rtol=1e-4, atol=1e-4)


def test_two_bodies_say_nothing_about_other_times() -> None:
    scene = scenes.lifted_points("two_bodies_2d", 30, views=3, generator=seeded())
    found = dyn.reconstruct(scene.tracks, "two_bodies_2d")
    assert found.velocities is None and torch.equal(found.at(3.0), found.points)
    with pytest.raises(ValueError, match="says nothing about times between the views"):
        found.image(found.cameras[0], 0.5)
    assert "body 1" in repr(found)

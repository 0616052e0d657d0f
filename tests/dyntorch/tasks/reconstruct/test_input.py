"""reconstruct refuses bad input by name, value and remedy; a bad problem of a batch is a status."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

import dyntorch as dyn
from dyntorch import scenes
from dyntorch.core.outcome import Status
from dyntorch.tasks.reconstruct.motions import Motion
from dyntorch.tasks.reconstruct.result import ReconstructNotice

NAN = float("nan")
CV = "constant_velocity_2d"


def tracks() -> Tensor:
    return scenes.lifted_points(CV, 30, views=4, sigma=0.3, generator=torch.Generator().manual_seed(0)).tracks


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
    "needs at least 3 views, got 2": {"views": 2},
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
    options = {"motion": CV, **CASES[message]}
    x = tracks()[: options.pop("views", 4), : options.pop("n", 30)]
    with pytest.raises(ValueError, match=message):
        dyn.reconstruct(x, **options)


@pytest.mark.parametrize("given", [torch.zeros(30, 2), torch.zeros(4, 30, 2, dtype=torch.int64), [[1.0]], torch.zeros(4, 30, 5)])
def test_tracks_refused(given: object) -> None:
    with pytest.raises(ValueError, match="tracks must be"):
        dyn.reconstruct(given, CV)


def test_nothing_fits_for_auto() -> None:
    with pytest.raises(ValueError, match="no declared motion takes 1 views of 30 tracks; 'static_2d' needs 2 views and 4 tracks"):
        dyn.reconstruct(tracks()[:1], "auto")


@pytest.mark.slow
def test_problems_with_too_little_are_statuses_with_reasons() -> None:
    x = tracks()
    once, few = x.clone(), x.clone()
    once[1:], few[1:, :20] = NAN, NAN
    found = dyn.reconstruct(torch.stack([x, x * NAN, once, few]), CV)
    assert found.status.tolist() == [Status.OK, *[Status.TOO_FEW] * 3]
    few_observed = [w for w in found.warnings if w.code == ReconstructNotice.FEW_OBSERVED]
    assert [(w.problem, w.value) for w in few_observed] == [((1,), 0), ((2,), 0), ((3,), 10)]
    with pytest.raises(ValueError, match=r"problem 1, 2, 3 of 4: TOO_FEW; .* needs 13 through the same ones"):
        found.check()


@pytest.mark.parametrize("options", [{}, {"threshold": 1.0}, {"static": torch.ones(30, dtype=torch.bool)}, {"motion": "auto"}])
def test_empty_batch(options: dict[str, object]) -> None:
    found = dyn.reconstruct(torch.empty(0, 4, 30, 2, dtype=torch.float64), times=UNIX, **{"motion": CV, **options})
    assert found.points.shape[:2] == (0, 30) and found.cameras.shape[:3] == (0, 4, 3)
    assert "empty" in repr(found)


def test_transposed_tracks() -> None:
    with pytest.raises(ValueError, match=r"times must be 30 finite .*tracks are \(\*batch, views, n, 2\); yours look transposed"):
        dyn.reconstruct(tracks().transpose(0, 1), CV, UNIX)


@pytest.mark.slow
def test_times_keep_their_digits() -> None:
    x = tracks()
    found = [dyn.reconstruct(x, CV, times) for times in (UNIX, UNIX.tolist(), UNIX.numpy(), list(UNIX.numpy()))]
    assert all(one.times.equal(UNIX) and one.velocities.equal(found[0].velocities) for one in found)
    early = dyn.reconstruct(x, CV, 1.5 * torch.arange(4, dtype=torch.float64))
    assert abs(float(found[0].residual - early.residual)) < 1e-6


def test_float32_times_that_are_exact_enough() -> None:
    x = tracks()
    for times in (torch.arange(4.0) + 20000, torch.arange(4.0) / 30):
        assert dyn.reconstruct(x, CV, times).status == Status.OK
    with pytest.raises(ValueError, match=r"times reach 1e\+06, .* in torch.float32 .*count times from the first view"):
        dyn.reconstruct(x.float(), CV, [1e6, 1e6 + 1, 1e6 + 2, 1e6 + 3])
    assert dyn.reconstruct(x.float(), CV, [1e3, 1e3 + 1, 1e3 + 2, 1e3 + 3]).status == Status.OK


def test_times_do_not_matter_where_nothing_moves() -> None:
    x = scenes.lifted_points("static_2d", 30, views=2, sigma=0.3, generator=torch.Generator().manual_seed(0)).tracks.float()
    assert dyn.reconstruct(x, "static_2d", UNIX[:2].float()).status == Status.OK


@pytest.mark.slow
def test_static_of_any_kind() -> None:
    scene = scenes.lifted_points(CV, 30, views=4, sigma=0.3, static=0.3, generator=torch.Generator().manual_seed(0))
    known = scene.velocities.norm(dim=-1) < 1e-12
    assert known.any()
    first = dyn.reconstruct(scene.tracks, CV, static=known)
    for kind in (known.tolist(), known.numpy()):
        again = dyn.reconstruct(scene.tracks, CV, static=kind)
        assert again.points.equal(first.points) and again.labels.equal(first.labels)
    assert "given static points fix the common motion" in first.ambiguity


def test_no_static_point_is_none_given() -> None:
    scene = scenes.lifted_points(CV, 30, views=4, sigma=0.3, static=0.3, generator=torch.Generator().manual_seed(0))
    known = scene.velocities.norm(dim=-1) < 1e-12
    alone = dyn.reconstruct(scene.tracks, CV)
    nothing = dyn.reconstruct(scene.tracks, CV, static=[False] * 30)
    assert nothing.ambiguity == alone.ambiguity and not nothing.warnings and nothing.labels.equal(alone.labels)
    both = dyn.reconstruct(scene.tracks.expand(2, 4, 30, 2), CV, static=torch.stack([known, known & False]))
    assert both.labels[1].equal(alone.labels) and not both.warnings
    torch.testing.assert_close(both.residuals[1], alone.residuals, rtol=1e-4, atol=1e-4)

"""reconstruct refuses bad input by name, value and remedy; a bad problem of a batch is a status."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

import dyntorch as dyn
from dyntorch import scenes
from dyntorch.motions import Motion
from dyntorch.solution import Status
from dyntorch.tasks.notices import NoticeCode

NAN = float("nan")
CV = "constant_velocity_2d"


def tracks() -> Tensor:
    return scenes.lifted(CV, 30, views=4, sigma=0.3, generator=torch.Generator().manual_seed(0)).tracks


def half_lift(t: Tensor) -> Tensor:
    return torch.eye(2, 3, dtype=torch.float64)


CASES = {
    "needs at least 3 views, got 2": {"views": 2},
    "needs at least 13 tracks through 3 views, got 12": {"n": 12},
    "all times are 1": {"times": [1.0, 1, 1, 1]},
    "needs views at 3 different times or more, got 2 in 4 views": {"times": [0.0, 0, 1, 1]},
    "times must be 4 finite numbers": {"times": [0.0, 1.0]},
    "times must be 4 finite": {"times": [0.0, 1.0, NAN, 2.0]},
    "motion must be 'auto', a dyntorch.Motion or one of": {"motion": "walk"},
    "takes tracks of 3D sensors": {"motion": "constant_velocity_3d_sensors"},
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


def test_problems_with_too_little_are_statuses_with_reasons() -> None:
    x = tracks()
    once, few = x.clone(), x.clone()
    once[1:], few[1:, :20] = NAN, NAN
    found = dyn.reconstruct(torch.stack([x, x * NAN, once, few]), CV)
    assert found.status.tolist() == [Status.OK, *[Status.TOO_FEW] * 3]
    few_observed = [w for w in found.warnings if w.code == NoticeCode.FEW_OBSERVED]
    assert [(w.problem, w.value) for w in few_observed] == [((1,), 0), ((2,), 0), ((3,), 10)]
    with pytest.raises(ValueError, match=r"problem 1, 2, 3 of 4: TOO_FEW; .* needs 13 through the same ones"):
        found.check()


def test_empty_batch() -> None:
    found = dyn.reconstruct(torch.empty(0, 4, 30, 2, dtype=torch.float64), CV)
    assert found.points.shape == (0, 30, 2) and found.cameras.shape == (0, 4, 3, 3)
    assert "empty" in repr(found)

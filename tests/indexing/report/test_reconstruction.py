"""The report on a reconstruction: what is written, drawn and said."""

from __future__ import annotations

import csv
import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from dyntorch import Status
from dyntorch.core.outcome import Notice, NoticeCode
from dyntorch.tasks.reconstruct.result import Ranked, Reconstruction
from indexing.readers.tracks import TrackSet
from indexing.report.canvas import around, sample
from indexing.report.reconstruction import ReconstructionReport, as_first_camera, nearest_frame, points_csv
from indexing.report.summary import write_report
from tests.indexing.report.people import SCRIPT, draw_all


class Told(NoticeCode):
    HOSTILE = "hostile", SCRIPT
    WHY = "why", "why"
    WEAK_STACK = "weak_stack", "nearly one centre"
    FEW = "few_observed", "few"
    BEHIND = "behind", "1 is behind"


def report(dim: int = 2, **changes) -> ReconstructionReport:
    """Five points that move by (1, 0, ...) per view, of which the last is missing, seen by two cameras."""
    rng = np.random.default_rng(0)
    points = rng.uniform(1, 5, size=(5, dim))
    speed = np.eye(dim)[0]
    positions = points + np.arange(2.0)[:, None, None] * speed
    cameras = np.stack([np.eye(3, dim + 1), np.eye(3, dim + 1)])
    cameras[:, 2] = np.eye(dim + 1)[-1] + 0.1 * np.eye(dim + 1)[-2]
    rays = positions @ cameras[0, :, :-1].T + cameras[0, :, -1]
    tracks = TrackSet("t.csv", rays[..., :2] / rays[..., 2:], (SCRIPT, "=1+1", "-2", "d", "e"), ("0", SCRIPT), np.arange(2.0))
    points[4] = positions[:, 4] = tracks.values[1, 4] = np.nan
    motion = changes.pop("motion", SimpleNamespace(name="constant_velocity_2d", bodies=1, static=False))
    values = {
        "cameras": cameras, "points": points, "velocities": np.tile(speed, (5, 1)), "labels": np.array([1, 2, 0, 2, 0]),
        "residual": np.array(0.1), "residuals": np.full((2, 5), 0.1), "sigma": np.array(0.1), "status": np.array(0),
        "structure": np.ones((5, 2 * dim + 1)), "projections": np.ones((2, 3, 2 * dim + 1)),
        "inliers": np.ones((2, 5), dtype=bool), "times": np.arange(2.0),
    }  # fmt: skip
    changed = {name: changes.pop(name, value) for name, value in values.items()}
    positions = changes.pop("positions", positions)
    tensors = {name: None if value is None else torch.as_tensor(value) for name, value in changed.items()}
    candidates = (Ranked("constant_velocity_2d", 1.0, 0.1), Ranked(SCRIPT, float("inf"), float("nan"), SCRIPT))
    said = changes.pop("said", (Told.HOSTILE,))
    notices = tuple(Notice(code, 1.0) for code in said)
    result = Placed(motion=motion, **tensors, ambiguity="", notices=notices, candidates=candidates)
    result.__dict__["positions"] = torch.as_tensor(positions)
    return ReconstructionReport(**{"result": result, "heading": SCRIPT, "tracks": tracks, **changes})


class Placed(Reconstruction):
    """A reconstruction whose points are told to be somewhere at the times of the views."""

    def at(self, time):
        return self.__dict__["positions"][int(time)]


TWO = SimpleNamespace(name="two_bodies_2d", bodies=2, static=False)


def test_what_comes_from_files_is_escaped(tmp_path):
    page = write_report(tmp_path, report()).read_text()
    assert SCRIPT not in page and "&lt;script&gt;" in page
    rows = list(csv.reader(points_csv(report()).splitlines()))
    assert [row[0] for row in rows[1:]] == [SCRIPT, "'=1+1", "-2", "d", "e"]
    assert [row[2] for row in rows[1:]] == ["static", "moving", "outlier", "moving", "missing"] and rows[5][3:5] == ["", ""]


@pytest.mark.slow
def test_every_kind_of_data_can_be_drawn(tmp_path):
    nothing = np.full((5, 2), np.nan)
    made = [
        report(3),
        report(cameras=np.zeros((2, 3, 3)), points=nothing, positions=np.stack([nothing] * 2), status=Status.DEGENERATE),
        report(2, motion=TWO, velocities=None),
        report(3, motion=TWO, velocities=None),
        report(labels=np.zeros(5, dtype=int)),
        report(velocities=np.zeros((5, 2)), positions=np.stack([report().arrays.points] * 2)),
    ]  # fmt: skip
    draw_all(made, tmp_path, "reconstruction.json")


@pytest.mark.parametrize("dim", [2, 3])
def test_what_the_pictures_show(dim):
    made = report(dim, labels=np.full(5, 2))
    seen = as_first_camera(made)
    np.testing.assert_allclose(seen[:, :4], made.tracks.values[:, :4], atol=1e-12)  # both cameras are the same
    assert np.isnan(seen[:, 4]).all() and as_first_camera(report(velocities=None)) is None
    # an affinity of the positions: equal steps stay equal, and the plane comes near its image
    shown = nearest_frame(report(dim, labels=np.array([2, 2, 2, 2, 0])))
    steps = shown[1, :4] - shown[0, :4]
    np.testing.assert_allclose(steps, np.broadcast_to(steps[0], steps.shape), atol=1e-9)


def test_a_point_without_a_position_is_missing_where_too_few_views_show_it_and_an_outlier_otherwise():
    made = report()
    values, points = np.repeat(report().tracks.values, 2, axis=0), made.arrays.points.copy()
    values[2:, 3], points[2:] = np.nan, np.nan  # four coordinates for the four unknowns of a point, eight, and four
    weights = np.ones((4, 5))
    weights[1:, 2] = 0
    for given, kind in ((None, "outlier"), (weights, "missing")):
        tracks = dataclasses.replace(made.tracks, values=values, weights=given)
        assert report(tracks=tracks, points=points).kinds == ["static", "moving", kind, "missing", "missing"]
    assert ",0,missing,," in points_csv(report())


@pytest.mark.slow
def test_what_a_refused_report_says_and_does_not(tmp_path):
    write_report(tmp_path, report())
    assert (tmp_path / "scene.png").exists()
    said = [Told.WEAK_STACK, Told.FEW, Told.BEHIND]
    made = report(status=Status.AMBIGUOUS, said=said, inliers=np.arange(10).reshape(2, 5) > 0)
    page = write_report(tmp_path, made).read_text()
    assert not (tmp_path / "scene.png").exists() and "The scene</h2>" not in page and page.count("early one centre") == 1
    assert "Refused: views too alike." in page and "Points behind a camera." in page and "No camera sees what is behind it" in page
    assert "1 single observation left out" in page


def test_paths_fit_into_the_picture_and_long_ones_are_sampled():
    rng = np.random.default_rng(0)
    starts = rng.uniform(size=(200, 2))
    paths = np.stack([starts, starts + rng.uniform(-0.3, 0.3, size=(200, 2))])
    low, high = around(paths, 0.9)
    assert (paths > low).all() and (paths < high).all()
    paths[1, 0] = 100  # a stray
    assert (around(paths, 0.9)[1] < 2).all()
    assert len(sample(paths, (low, high))) == 60 and len(set(sample(paths, (low, high)).tolist())) == 60
    assert len(sample(paths[:, :50], (low, high))) == 50
    assert len(sample(paths[0] + 0.001 * np.arange(2.0)[:, None, None], (low, high))) == 200

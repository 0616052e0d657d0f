"""The report on bodies through many frames: what is written, drawn and said."""

from __future__ import annotations

import csv
from io import BytesIO

import numpy as np
import pytest
import torch
from PIL import Image

from dyntorch import Status
from dyntorch.core.outcome import Notice, NoticeCode
from dyntorch.tasks.segment.result import TrackSegmentation
from indexing.readers.matches import Photograph
from indexing.readers.tracks import TrackSet
from indexing.report.bodies import BodiesReport, as_json, describe, labels_csv, picture_of, rows_of, tracks_csv
from indexing.report.summary import write_report
from tests.indexing.report.people import SCRIPT, draw_all

FRAMES = 6


class Told(NoticeCode):
    HOSTILE = "hostile", SCRIPT
    CUT = "cut", "it changes at {frames}", Status.AMBIGUOUS


def report(bodies: int = 2, count: int = 9, **changes) -> BodiesReport:
    """Tracks of the outliers and the bodies in turn, body k at k pixels a frame; the last one is seen once."""
    rng = np.random.default_rng(0)
    labels = np.arange(count) % (bodies + 1)
    labels[-1] = 0
    steps = np.arange(FRAMES)[:, None, None] * (labels[:, None] * np.array([1.0, 0.0]))
    values = rng.uniform(10, 80, size=(count, 2)) + steps
    values[1:, -1] = np.nan
    views = changes.pop("views", tuple(str(10 * k) for k in range(FRAMES)))
    known = changes.pop("known", None)
    ids = (SCRIPT, "=1+1", "-2", *(f"t{i}" for i in range(3, count)))
    tracks = TrackSet("t.csv", values, ids, views, changes.pop("times", None), known=known, by_time=changes.pop("by_time", False))
    geometry = np.tile(np.eye(3), (2, bodies, 1, 1))
    geometry[1] = 0
    planar = np.zeros((2, bodies), bool)
    planar[0, 1:] = True
    result = {
        "labels": labels, "bodies": np.array(bodies), "static_body": np.array(1), "pairs": np.array([[0, 5], [-1, -1]]),
        "geometries": geometry, "homographies": geometry * planar[..., None, None], "planar": planar,
        "probabilities": np.eye(bodies + 1)[labels] * 0.95 + 0.05 / (bodies + 1), "residuals": np.full(count, 0.5),
        "status": np.array(0), "threshold": np.array(2.5),
    }  # fmt: skip
    made = {name: torch.as_tensor(changes.pop(name, value)) for name, value in result.items()}
    found = TrackSegmentation(**made, notices=(Notice(changes.pop("said", Told.HOSTILE), 1.0, changes.pop("told", {})),))
    return BodiesReport(**{"result": found, "tracks": tracks, "heading": SCRIPT, "notes": [SCRIPT], **changes})


def photographs(wide: int = 100, tall: int = 80) -> dict[int, Photograph]:
    gray = np.random.default_rng(1).random((tall, wide), dtype=np.float32)
    return {view: Photograph(SCRIPT, gray, (float(wide), float(tall))) for view in (1, 3, 5)}


@pytest.mark.slow
def test_what_comes_from_files_is_escaped(tmp_path):
    page = write_report(tmp_path, report(photographs=photographs())).read_text()
    assert SCRIPT not in page and "&lt;script&gt;" in page
    rows = list(csv.reader(labels_csv(report()).splitlines()))
    assert [row[0] for row in rows[1:4]] == [SCRIPT, "'=1+1", "-2"]
    assert [row[2] for row in rows[1:4]] == ["outlier", "body 1", "body 2"]
    assert rows[-1][1:] == ["0", "too short", "", "", "1", "0", "0"]


@pytest.mark.slow
def test_every_kind_of_data_can_be_drawn(tmp_path):
    made = [
        report(1, 12),
        report(0),
        report(0, status=Status.NO_CONSENSUS),
        report(11, 60),  # more bodies than colours
        report(labels=np.zeros(9, dtype=int)),
        report(size=(640.0, 200.0)),
        report(photographs=photographs()),
        report(photographs=photographs(200, 40)),
        report(static_body=0, by_time=True, times=np.arange(6) / 5, views=tuple(f"{k / 5:g}" for k in range(6))),
    ]  # fmt: skip
    for i, (one, found) in enumerate(zip(made, draw_all(made, tmp_path, "segmentation.json"), strict=True)):
        assert len(found["bodies"]) == one.bodies
        assert np.load(tmp_path / str(i) / "segmentation.npz")["labels"].tolist() == one.arrays.labels.tolist()


def test_numbers_of_a_report_and_of_bodies_that_leave():
    made = report(residuals=np.array([9.0, 1.0, 3.0, 9.0, 2.0, 4.0, 9.0, 0.0, 0.0]))
    assert made.counts == {"body 1": 3, "body 2": 2, "outlier": 3, "too short": 1}
    assert made.rms(1) == pytest.approx(np.sqrt(5 / 3)) and np.isnan(report(0).rms())
    assert made.motion(1) == pytest.approx(0.1) and made.motion(2) == pytest.approx(0.2)  # views are ten frames apart
    assert made.planar(1) is False and made.planar(2) is True
    assert [row[:3] for row in rows_of(made)] == [["3", "38 %", "0 to 50"], ["2", "25 %", "0 to 50"]]
    found = as_json(made)
    assert found["pairs"] == [["0", "50"]] and found["bodies"][1]["planar"] and found["static_body"] == 1
    assert report(static_body=5).static == 0  # of a body that is none of them nothing is said
    made = report(count=30)
    made.tracks.values[3:, made.arrays.labels == 2] = np.nan
    assert made.life(1) == (0, 5) and made.life(2) == (0, 2) and as_json(made)["bodies"][1]["last_frame"] == "20"
    made.tracks.values[:, made.arrays.labels == 2] = np.nan
    assert report(labels=np.ones(9, dtype=int)).life(2) is None


@pytest.mark.parametrize(
    ("made", "says"),
    [
        (report(), "Of 8 tracks through 6 frames, 5 move with one of 2 bodies (3 and 2); 3 fit none. Body 1 stands still."),
        (report(static_body=0), "The tracks do not say which body stands still."),
        (report(1), "Of 8 tracks through 6 frames, 4 move as one body; 4 fit none."),
        (report(status=3, said=Told.CUT, told={"frames": [2, 4]}), "decide what moves with what. It changes at 20, 40. What"),
    ],
)
def test_the_summary(made, says):
    assert says in describe(made)


def test_known_labels_are_compared(tmp_path):
    made = report(known=np.array([0, 2, 1, 0, 2, 1, 1, 1, 0]))
    assert made.misclassification == pytest.approx(2 / 8)
    assert "Compared with the labels of the file" in write_report(tmp_path, made).read_text()


def test_tracks_keep_their_names_and_times():
    rows = list(csv.DictReader(tracks_csv(report(times=np.arange(6) / 5)).splitlines()))
    assert list(rows[0]) == ["frame", "time", "id", "x", "y", "label"] and rows[-1]["frame"] == "50" and rows[-1]["time"] == "1"
    named = tracks_csv(report(by_time=True, times=np.arange(6) / 5, views=tuple(f"{k / 5:g}" for k in range(6))))
    assert named.startswith("time,id,x,y,label\n0,") and "\n0.2," in named


@pytest.mark.slow
def test_wide_pictures_are_stacked():
    wide, square = (Image.open(BytesIO(picture_of(report(photographs=photographs(*size))))) for size in ((300, 60), (100, 80)))
    assert wide.height > 0.5 * wide.width and square.width > square.height

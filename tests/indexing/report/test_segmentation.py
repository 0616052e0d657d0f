"""The report on a segmentation: what is written, drawn and said."""

from __future__ import annotations

import csv
from io import BytesIO

import numpy as np
import pytest
import torch
from PIL import Image

from dyntorch import Segmentation, Status
from dyntorch.core.outcome import Notice, NoticeCode
from indexing.readers.matches import MatchedPair, Photograph
from indexing.report.canvas import DARK, LIGHT
from indexing.report.segmentation import SegmentationReport, as_json, colour_of, labels_csv, picture_of
from indexing.report.summary import write_report
from tests.indexing.report.people import SCRIPT, draw_all


class Told(NoticeCode):
    HOSTILE = "hostile", SCRIPT
    UNCERTAIN = "uncertain", "it is open"
    WHY = "why", "why"


def report(bodies: int = 2, count: int = 8, **changes) -> SegmentationReport:
    """Matches that belong to the bodies and the outliers in turn, of which the last is missing."""
    rng = np.random.default_rng(0)
    x1 = rng.uniform(0, 100, size=(count, 2))
    x2 = x1 + 5
    x2[-1] = np.nan
    ids = (SCRIPT, "=1+1", "-2", *(f"m{i}" for i in range(3, count)))
    labels = np.arange(count) % (bodies + 1)
    labels[-1] = 0
    probabilities = np.eye(bodies + 1)[labels] * 0.95 + 0.05 / (bodies + 1)
    probabilities[-1] = 0
    result = {
        "labels": labels, "bodies": np.array(bodies), "fundamentals": np.tile(np.eye(3), (bodies, 1, 1)),
        "homographies": np.zeros((bodies, 3, 3)), "probabilities": probabilities, "residuals": np.full(count, 0.5),
        "coherence": np.ones(count), "status": np.array(0), "threshold": np.array(2.5), "planar": np.zeros(bodies, dtype=bool),
    }  # fmt: skip
    known = {name: torch.as_tensor(changes.pop(name, value)) for name, value in result.items()}
    said = (Notice(changes.pop("said", Told.HOSTILE), 1.0),)
    found = Segmentation(**known, notices=said)
    pair = MatchedPair("m.csv", SCRIPT, x1, x2, ids)
    return SegmentationReport(**{"result": found, "pair": pair, "heading": SCRIPT, "notes": [SCRIPT], **changes})


def photograph(wide: int = 100, tall: int = 80) -> Photograph:
    return Photograph(SCRIPT, np.random.default_rng(1).random((tall, wide), dtype=np.float32), (float(wide), float(tall)))


@pytest.mark.slow
def test_what_comes_from_files_is_escaped(tmp_path):
    page = write_report(tmp_path, report(photographs=[photograph(), photograph()])).read_text()
    assert SCRIPT not in page and "&lt;script&gt;" in page
    rows = list(csv.reader(labels_csv(report()).splitlines()))
    assert [row[0] for row in rows[1:4]] == [SCRIPT, "'=1+1", "-2"]
    assert [row[6] for row in rows[1:]] == ["outlier", "body 1", "body 2", "outlier", "body 1", "body 2", "outlier", "missing"]
    assert rows[2][7:] == ["0.9667", "0.5"] and rows[8][3:6] == ["", "", "0"] and rows[8][7:] == ["", ""]


@pytest.mark.slow
def test_every_kind_of_data_can_be_drawn(tmp_path):
    made = [
        report(1, 12),
        report(0),
        report(0, status=Status.NO_CONSENSUS),
        report(11, 40),  # more bodies than colours
        report(labels=np.zeros(8, dtype=int)),
        report(planar=np.array([False, True]), homographies=np.tile(np.eye(3), (2, 1, 1))),
        report(size=(640.0, 200.0)),
        report(photographs=[photograph(), photograph(60, 90)]),
        report(photographs=[photograph(200, 40), photograph(200, 40)]),
        report(pair=MatchedPair("m", "m", np.ones((8, 2)), np.ones((8, 2)), tuple("abcdefgh"))),
    ]  # fmt: skip
    for i, (one, found) in enumerate(zip(made, draw_all(made, tmp_path, "segmentation.json"), strict=True)):
        assert len(found["bodies"]) == one.bodies
        assert np.load(tmp_path / str(i) / "segmentation.npz")["labels"].tolist() == one.arrays.labels.tolist()


def test_numbers_of_a_report_and_panels():
    made = report(residuals=np.array([9.0, 1.0, 3.0, 9.0, 2.0, 4.0, 9.0, 0.0]))
    assert made.counts == {"body 1": 2, "body 2": 2, "outlier": 3, "missing": 1}
    assert made.rms(1) == pytest.approx(np.sqrt(2.5)) and made.rms(2) == pytest.approx(np.sqrt(12.5))
    assert made.rms() == pytest.approx(np.sqrt(7.5)) and np.isnan(report(0).rms())
    found = as_json(made)
    assert [part["share"] for part in found["bodies"]] == [2 / 7, 2 / 7] and found["doubtful"] == 0
    doubtful = made.arrays.probabilities.copy()
    doubtful[1] = [0.2, 0.5, 0.3]
    assert report(probabilities=doubtful).is_doubtful.tolist() == [False, True, *[False] * 6]
    assert len({colour_of(label) for label in range(1, 9)}) == 8  # neighbouring bodies differ
    line = np.linspace([0, 0], [1, 500], 8)
    image = Image.open(BytesIO(picture_of(report(pair=MatchedPair("m", "m", line, line, tuple("abcdefgh"))), LIGHT)))
    assert image.width > 0.4 * image.height


def test_what_is_known_is_compared_and_what_is_refused_is_said_once(tmp_path):
    pair = report().pair
    known = MatchedPair(pair.path, "m", pair.x1, pair.x2, pair.ids, known=np.array([0, 2, 1, 0, 2, 1, 1, 1]))
    made = report(pair=known, status=Status.AMBIGUOUS, said=Told.UNCERTAIN)
    page = write_report(tmp_path, made).read_text()
    assert "Compared with the labels of the file" in page and f"{100 * made.misclassification:.2g} %" in page
    assert "Refused: uncertain." in page and page.count("It is open.") == 2 and "<b>Uncertain." not in page
    assert "Compared" not in write_report(tmp_path, report()).read_text()


@pytest.mark.slow
def test_outliers_are_counted_in_words(tmp_path):
    page = write_report(tmp_path, report(count=300)).read_text()
    assert "100 outliers<" in page and "100 outlier<" not in page
    labels = np.ones(300, dtype=int)
    labels[7] = 0
    page = write_report(tmp_path / "one", report(count=300, labels=labels)).read_text()
    assert "1 outlier<" in page and "1 outliers" not in page and "under 1 % of the matches" in page


@pytest.mark.slow
def test_photographs_are_faded_and_wide_ones_stacked():
    def shape(made, theme=LIGHT):
        image = Image.open(BytesIO(picture_of(made, theme)))
        return image.size, np.asarray(image.convert("L")).mean()

    (wide, tall), light = shape(report(photographs=[photograph(), photograph()]))
    assert wide > 2 * tall and light > 190 and shape(report(photographs=[photograph(), photograph()]), DARK)[1] < 80
    (wide, tall), _ = shape(report(photographs=[photograph(200, 60), photograph(200, 60)]))
    assert tall > 0.5 * wide

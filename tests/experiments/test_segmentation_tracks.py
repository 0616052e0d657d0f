"""The tables of whole videos, on tiny data, with a segmentation that is told the answer."""

import json
from types import SimpleNamespace

import numpy as np
import pytest
import torch

import dyntorch as dyn
from dyntorch.scenes import StreetOptions
from experiments.recognition import protocol
from experiments.segmentation import data as segmentation_data
from experiments.segmentation import tracks as experiment

WRONG = 2
"""Labels that the segmentation that is told the answer gets wrong."""


@pytest.fixture
def data(tmp_path, monkeypatch):
    """A data folder with one sequence of each set: complete, cut, and cut with outliers."""
    rng = np.random.default_rng(0)
    y = rng.random((6, 12, 2), dtype=np.float32)
    np.savez(tmp_path / "hopkins155.npz", names=np.array(["cars1"]), **{"cars1/y": y, "cars1/s": np.repeat([1, 2], 6)})
    seen = np.ones((6, 12), dtype=bool)
    seen[3:, :3], seen[:2, 9:] = False, False  # a body has no track that the last frame shows, but for three
    for name, labels in (("kt3dmoseg_half", np.repeat([2, 1, 3], [3, 6, 3])), ("mtpv62_half", np.repeat([0, 1, 2], 4))):
        stored = np.where(seen[..., None], y + len(name), 0)
        rows = {f"clip/{key}": value for key, value in (("y", stored), ("vis", seen), ("s", labels.astype(np.uint8)))}
        np.savez(tmp_path / f"{name}.npz", names=np.array(["clip"]), **rows)
    monkeypatch.setenv(protocol.DATA, str(tmp_path))
    return y, seen


@pytest.fixture
def told(data, monkeypatch):
    """Segmentations that answer the truth, but for two tracks; what they were asked is kept."""
    asked, truth = [], {}
    videos = [*segmentation_data.hopkins_tracks(), *segmentation_data.kt3d_tracks(), *segmentation_data.mtpv_tracks()]
    made = experiment.made_streets

    def of(x):
        return float(x.nan_to_num().sum())

    def remembered(*args):
        found = made(*args)
        for video in found:
            truth[of(video.tracks)] = video.labels
            pair = video.pair(7, 13)
            truth[of(pair.x1)] = pair.labels
        return found

    truth |= {of(video.tracks): video.labels for video in videos}
    pairs = [video.pair() for video in videos]
    truth |= {of(pair.x1): pair.labels for pair in pairs} | {of(torch.stack([pair.x1, pair.x2])): pair.labels for pair in pairs}
    monkeypatch.setattr(experiment, "made_streets", remembered)

    def answer(x, bodies):
        asked.append((x.shape[-2], bodies))
        labels = truth[of(x)].clone()
        labels[labels.nonzero()[:WRONG]] = 0
        return SimpleNamespace(labels=labels, bodies=labels.max())

    monkeypatch.setattr(dyn, "segment_tracks", lambda x, bodies=None, generator=None: answer(x, bodies), raising=False)
    monkeypatch.setattr(dyn, "segment", lambda x1, x2, bodies=None, generator=None: answer(x1, bodies), raising=False)
    return asked


def test_whole_sequences_have_gaps_where_a_point_is_not_seen(data):
    y, seen = data
    (whole,), (cut,) = segmentation_data.hopkins_tracks(), segmentation_data.kt3d_tracks()
    assert np.array_equal(whole.tracks.numpy(), y.astype(float)) and whole.bodies == 2
    assert torch.equal(cut.tracks.isfinite().all(-1), torch.from_numpy(seen)) and cut.tracks.dtype == torch.float64
    np.testing.assert_allclose(cut.tracks.numpy()[seen], (y + 14)[seen], rtol=1e-6)
    assert cut.labels.dtype == torch.int64 and cut.bodies == 3
    # of two frames: the tracks that both show, numbered without gaps; outliers stay outliers
    pair = cut.pair()
    assert pair.labels.tolist() == [1] * 6 and pair.x1.shape == pair.x2.shape == (6, 2)
    assert cut.pair(0, 2).labels.tolist() == [2] * 3 + [1] * 6 and cut.pair(2, 4).labels.tolist() == [1] * 6 + [2] * 3
    (mixed,) = segmentation_data.mtpv_tracks()
    assert mixed.pair(2, 5).labels.tolist() == [0, 1, 1, 1, 1, 2, 2, 2, 2]


def test_tables_count_errors_and_bodies(told, tmp_path, capsys):
    names = ("kt3d", "kt3d_two_views", "hopkins", "mtpv", "streets", "streets_two_views")
    experiment.run(experiment.Config(only=names, scenes=1, out=tmp_path / "out.json"))
    tables = json.loads((tmp_path / "out.json").read_text())["tables"]
    of = {name: {row["task"]: row for row in tables[experiment.TABLES[name][0]][::-1]} for name in names}
    assert of["kt3d"]["K known, mean error"]["measured"] == pytest.approx(100 * WRONG / 12)
    assert of["kt3d"]["K unknown, K right"]["measured"] == 100 and of["hopkins"]["K unknown, K right"]["goal"] == 95
    assert of["kt3d_two_views"]["K known, mean error"]["measured"] == pytest.approx(100 * WRONG / 6)
    # of MTPV62 with its outliers and without
    whole, part = [row["measured"] for row in tables[experiment.TABLES["mtpv"][0]] if row["task"] == "K known, mean error"]
    assert whole == pytest.approx(100 * WRONG / 12) and part == pytest.approx(100 * WRONG / 8)
    assert of["streets"]["K known, mean error"]["measured"] == pytest.approx(100 * WRONG / 500)
    assert (12, 3) in told and (12, None) in told and (6, 1) in told and (500, 2) in told and (500, None) in told
    assert "Not verified" in capsys.readouterr().out


@pytest.mark.slow
def test_other_streets_are_of_other_kinds(told, tmp_path, monkeypatch):
    monkeypatch.setattr(experiment, "OTHERS", {"night": (120, StreetOptions(texture=0.15))})
    experiment.run(experiment.Config(only=("other_streets",), scenes=6, quick=True, out=tmp_path / "out.json"))
    (rows,) = json.loads((tmp_path / "out.json").read_text())["tables"].values()
    assert rows[0]["task"] == "night, K known, mean error" and rows[0]["measured"] == pytest.approx(100 * WRONG / 120)
    assert [ask for ask in told if ask[1] is not None] == [(120, 2), (120, 3)]


@pytest.mark.parametrize(("wrong", "message"), [({"only": ("streats",)}, "only must name tables"), ({"scenes": 0}, "at least 1")])
def test_misuse_is_named(data, wrong, message):
    with pytest.raises(ValueError, match=message):
        experiment.run(experiment.Config(**wrong))

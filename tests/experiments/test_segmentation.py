"""The tables and benchmarks of the segmentation into bodies, on tiny data, with a segmentation that is told the answer."""

import json
from types import SimpleNamespace

import numpy as np
import pytest
import torch

import dyntorch as dyn
from dyntorch import scenes
from dyntorch.metrics import misclassification, relative_error
from dyntorch.tasks.segment import labels
from experiments.benchmarks import segmentation as benchmark
from experiments.recognition import protocol
from experiments.segmentation import data as segmentation_data
from experiments.segmentation import matrix_noise as segmentation_matrix_noise
from experiments.segmentation import segmentation, sensitivity

WRONG = 2
"""Labels that the segmentation that is told the answer gets wrong."""


def seeded(seed=0):
    return torch.Generator().manual_seed(seed)


@pytest.fixture
def data(tmp_path, monkeypatch):
    """A data folder with two pairs of photographs, a pair of planes, and a sequence of tracks."""
    rng = np.random.default_rng(0)
    pairs = {"names": np.array(["cube", "walls", "breadcube"])}
    for name, kind, bodies in (("cube", "F", 1), ("walls", "H", 2), ("breadcube", "F", 2)):
        pairs |= {f"{name}/x1": rng.random((40, 2), dtype=np.float32), f"{name}/x2": rng.random((40, 2), dtype=np.float32)}
        pairs |= {f"{name}/label": np.arange(40) % (bodies + 1), f"{name}/type": np.array(kind)}
    np.savez(tmp_path / "adelaidermf.npz", **pairs)
    tracks = {"cars1/y": rng.random((5, 12, 2)), "cars1/s": np.repeat([1, 2], 6).astype(np.uint8)}
    np.savez(tmp_path / "hopkins155.npz", names=np.array(["cars1"]), **tracks)
    monkeypatch.setenv(protocol.DATA, str(tmp_path))
    return tracks


@pytest.fixture
def told(data, monkeypatch):
    """dyn.segment answers the truth of the data folder, but for two outliers too many; what it was asked is kept."""
    truth = {p.x1.sum().item(): p.labels for p in (*segmentation_data.motion_pairs(), *segmentation_data.hopkins_pairs())}
    asked = []

    def segment(x1, x2, bodies=None, threshold=2.5, generator=None, options=None):
        asked.append((len(x1), bodies, threshold))
        labels = truth[x1.sum().item()].clone()
        labels[labels.nonzero()[:WRONG]] = 0
        return SimpleNamespace(labels=labels, bodies=labels.max())

    monkeypatch.setattr(dyn, "segment", segment, raising=False)
    return asked


def test_pairs_of_photographs_and_of_frames(data):
    pairs = segmentation_data.motion_pairs()
    assert [(p.name, p.bodies, len(p.labels)) for p in pairs] == [("cube", 1, 40), ("breadcube", 2, 40)]
    assert pairs[0].x1.dtype == torch.float64 and pairs[0].labels.dtype == torch.int64
    (cars,) = segmentation_data.hopkins_pairs()
    assert np.array_equal(cars.x1.numpy(), data["cars1/y"][0]) and np.array_equal(cars.x2.numpy(), data["cars1/y"][-1])
    assert cars.labels.tolist() == [1] * 6 + [2] * 6


def test_tables_of_recordings_count_errors_and_bodies(told, tmp_path, capsys):
    segmentation.run(segmentation.Config(seeds=2, out=tmp_path / "out.json"))
    tables = json.loads((tmp_path / "out.json").read_text())["tables"]
    adelaide, hopkins = ({row["task"]: row for row in tables[name][::-1]} for name in segmentation.TABLES)
    assert (
        adelaide["cube"]["measured"] == pytest.approx(100 * WRONG / 40) and "published: Prog-X 3.3" in adelaide["cube"]["setting"]
    )
    assert adelaide["mean"]["measured"] == adelaide["mean, cross-validated"]["measured"] == pytest.approx(100 * WRONG / 40)
    assert adelaide["K right"]["measured"] == 100
    assert hopkins["K known, mean error"]["measured"] == pytest.approx(100 * WRONG / 12)
    # two pairs, two seeds, every threshold, and the number of bodies is told for the tracks only
    assert told.count((40, None, segmentation.DEFAULT)) == 4 and len(told) == 4 * len(segmentation.THRESHOLDS) + 2
    assert (12, 2, segmentation.DEFAULT) in told and (12, None, segmentation.DEFAULT) in told
    assert "not run here" in capsys.readouterr().out


def test_left_out_pairs_choose_nothing():
    # the pair a would take 1; the others make it take 2
    errors = {1.0: {"a": 0.0, "b": 9.0, "c": 9.0}, 2.0: {"a": 4.0, "b": 3.0, "c": 3.0}}
    assert segmentation.left_out(errors) == pytest.approx((4 + 3 + 3) / 3)
    errors = {1.0: {"a": 0.0, "b": 9.0}, 2.0: {"a": 4.0, "b": 5.0}}
    assert segmentation.left_out(errors) == pytest.approx((4 + 9) / 2)


def exact_pair(bodies=2, outliers=0.0):
    return benchmark.synthetic("exact", 120, bodies, outliers, 0)


def test_greedy_search_takes_one_body_after_the_other():
    scene = scenes.bodies(120, 2, sigma=0.5, generator=seeded())
    calls = []

    def oracle(x1, x2):
        calls.append(len(x1))
        return scene.motion[(len(calls) - 1) % 2]

    search = benchmark.greedy(oracle)
    pair = exact_pair()
    assert float(misclassification(search(pair, 2, 0), pair.labels)) < 0.2 and len(calls) == 2 and calls[1] < calls[0] == 120
    # of unknown length: it stops when nothing is left to explain
    calls.clear()
    found = search(pair, None, 0)
    assert found.max() == 2 and len(calls) <= 3
    assert benchmark.greedy(lambda x1, x2: None)(pair, 3, 0).tolist() == [0] * 120


def test_peers_find_a_single_body():
    pair = exact_pair(bodies=1)
    for name, search in benchmark.peers().items():
        assert float(misclassification(search(pair, 1, 0), pair.labels)) < 0.05, name


def test_exact_problems_in_a_batch_are_solved():
    error = [row for row in benchmark.batch(benchmark.Config(quick=True)) if "error" in row.setting]
    assert error[0].measured == 0


def test_candidates_keep_what_every_round_found():
    pair = exact_pair(outliers=0.1)
    candidate = benchmark.Candidate(lambda p, bodies, seed: p.labels if seed else 0 * p.labels, [pair], known=True)
    for _ in range(2):
        candidate()
    assert candidate.error() == pytest.approx(100 * 0.9 / 2) and candidate.counted() == 50


def test_refinement_starts_where_it_is_told():
    scene = scenes.bodies((40, 40), batch=3, sigma=0.2, interleaved=True, generator=seeded())
    solution = dyn.fit(dyn.SegmentationMatrix, *scene.views)
    started = segmentation_matrix_noise.started(solution, scene.motion)
    for found, true in zip(segmentation_matrix_noise.fundamentals(started), scene.motion, strict=True):
        assert relative_error(found, true).max() < 1e-9
    refined = segmentation_matrix_noise.refined(scene, started)
    labels = dyn.SegmentationMatrix.labels(*refined, *scene.views)
    assert misclassification(labels, scene.labels).max() < 0.05


@pytest.mark.slow
def test_all_methods_are_better_than_guessing():
    scene = scenes.bodies((60, 60), batch=4, sigma=0.05, interleaved=True, generator=seeded())
    methods = segmentation_matrix_noise.methods(scene)
    assert set(methods) >= set(segmentation_matrix_noise.PROTOTYPE[25])
    for name, solve in methods.items():
        if name != "segment":
            labels = dyn.SegmentationMatrix.labels(*solve(), *scene.views)
            assert misclassification(labels, scene.labels).mean() < 0.2, name


def test_the_sensitivity_takes_values_on_both_sides_of_each_constant():
    for module, name, values in sensitivity.VARIED:
        assert min(values) < getattr(module, name) < max(values), name


def test_the_sensitivity_patches_one_constant_at_a_time(data, monkeypatch, capsys):
    shipped, seen = labels.OUTLIER_COST, []

    def segmented(pair, bodies=None, threshold=2.5, seed=0):
        seen.append(tuple(getattr(module, name) for module, name, _ in sensitivity.VARIED))
        return segmentation.Outcome(float(labels.OUTLIER_COST), pair.bodies, 0.0)

    monkeypatch.setattr(sensitivity, "segmented", segmented)
    rows = sensitivity.sensitivity(sensitivity.Config(scenes=1, quick=True))
    assert {values[0] for values in seen} == {0.7, 1.0, 1.4} and shipped == labels.OUTLIER_COST
    assert len(set(seen)) == 7
    least = [row for row in rows if row.setting.startswith("least")]
    assert len(least) == 2 and all(row.measured == pytest.approx(0.7) for row in least)
    assert "OUTLIER_COST 1.4" in capsys.readouterr().out

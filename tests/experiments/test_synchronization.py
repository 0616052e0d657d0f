"""The tables of the synchronization, on tiny data, with a synchronization that is told the answer."""

import json
import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch

import dyntorch as dyn
from dyntorch.numerics.nullspace import null_space
from experiments.recognition import protocol
from experiments.synchronization import baselines, data, motions, synchronization
from experiments.synchronization import real as real_synchronization

TOLD = 0.25
"""Frames of b by which the synchronization that is told the answer is wrong."""


def takes(count, frames=700, seed=0):
    """People ``(frames, 31, 3)`` whose joints swing about different places at different speeds, at 60 fps."""
    rng = np.random.default_rng(seed)
    seconds = np.arange(frames)[:, None, None] / data.RECORDED
    place = rng.uniform([-0.4, 0.0, -0.3], [0.4, 1.7, 0.3], (count, 1, 31, 3))
    swing = 0.2 * np.sin(rng.uniform(2, 5, (count, 1, 31, 3)) * seconds + rng.uniform(0, 6, (count, 1, 31, 3)))
    return torch.from_numpy(place + swing)


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A data folder with three takes of motion capture, four cameras around a person, and a drone."""
    people = takes(3, 1300).numpy()
    known = {"names": np.array(["1", "2", "3"]), "description": np.array(["walk", "run", "jump"])}
    np.savez(tmp_path / "cmu_mocap_60fps.npz", joints=people.reshape(-1, 31, 3), offsets=np.arange(4) * 1300, **known)
    (tmp_path / "pose2sim").mkdir()
    keypoints = np.concatenate([people[0, None, :100, :25, :2].repeat(4, 0), np.full((4, 100, 25, 1), 0.9)], axis=-1)
    keypoints[0, 3, 4] = (0, 0, 0.1)
    np.savez(tmp_path / "pose2sim" / "pose2sim_balancing.npz", keypoints=keypoints.astype(np.float32), fps=60.0)
    (tmp_path / "drone_tracking").mkdir()
    rng, drone = np.random.default_rng(1), {"cameras": np.array(["one", "mate7", "two"])}
    for index, frames in enumerate((90, 50, 60)):
        detected = np.concatenate([np.arange(1, frames + 1)[:, None], rng.uniform(100, 900, (frames, 2))], axis=1)
        drone |= {f"cam{index}/det": detected.astype(np.float32), f"cam{index}/fps": (30.0, 25.0, 20.0)[index]}
        drone |= {f"cam{index}/K": np.array([[900.0, 0, 500], [0, 900.0, 500], [0, 0, 1]]), f"cam{index}/dist": np.zeros(5)}
    alpha, beta = np.full((3, 3), 0.6667), np.full((3, 3), 2.0)
    np.savez(tmp_path / "drone_tracking" / "dataset3.npz", alpha=alpha, beta=beta, **drone)
    monkeypatch.setenv(protocol.DATA, str(tmp_path))


def shift(offset, fps, rate=1.0, ok=True, points=None):
    """As much of a Shift as the tables read."""
    found = SimpleNamespace(offset=offset, rate=rate, ok=ok, points=points, fps=fps, sigma=0.001, rate_sigma=0.0)
    found.confidence, found.method, found.reason, found.frames = 0.9, "told", "" if ok else "no", offset * fps[1]
    found.at = lambda moment: torch.as_tensor(moment * rate + offset)
    return found


@pytest.fixture
def told(monkeypatch):
    """dyn.synchronize answers the truth of every pair that is made, but for a part of a frame; what it was asked is kept."""
    truth, asked, make = {}, [], data.Pair

    def key(a, b):
        return a.nan_to_num().sum().item(), b[0].nan_to_num().sum().item()

    def pair(*args, **kwargs):
        made = make(*args, **kwargs)
        truth[key(made.a, made.b)] = made
        return made

    def synchronize(a, b, correspondence, fps=None, times=None, max_shift=None, camera="auto"):
        asked.append((correspondence, camera, max_shift))
        known = truth.get(key(a, b))
        if known is None:
            return shift(0.0, fps or (30.0, 20.0), ok=False)
        points = None if known.wrong is None else ~known.wrong
        return shift(known.offset + TOLD / fps[1], fps, known.rate, points=points)

    for module in (data, real_synchronization):
        monkeypatch.setattr(module, "Pair", pair)
    monkeypatch.setattr(dyn, "synchronize", synchronize, raising=False)
    return asked


def test_pairs_show_one_scene_at_the_true_shift():
    """Both clocks, different rates included, lead to the same moments: one fundamental matrix fits what both cameras see then."""
    generator = data.seeded(1)
    pair = data.cmu_pair(takes(1)[0], generator, fps=(60.0, 25.0), rate=1.01, noise_mm=0.0, points="all")
    first, last = pair.overlap
    moments = torch.linspace(first, last, 30, dtype=torch.float64)

    def seen(offset):
        at_b = (moments * pair.rate + offset) * pair.fps[1]
        splines = [data.CubicSpline(np.arange(len(x)), x.numpy()) for x in (pair.a, pair.b)]
        x, y = (torch.from_numpy(s(at.numpy())).flatten(0, 1) for s, at in zip(splines, (moments * pair.fps[0], at_b), strict=True))
        x, y = ((p - p.mean(0)) / p.std() for p in (x, y))
        x, y = (torch.cat([p, torch.ones_like(p[:, :1])], dim=1) for p in (x, y))
        rows = torch.einsum("ni,nj->nij", x, y).flatten(1)
        return float((rows @ null_space(rows)[0]).abs().median())

    # splines through 25 frames per second are wrong by a little
    assert seen(pair.offset) < 0.1 * seen(pair.offset + 2 / pair.fps[1])
    assert pair.error(pair.offset, pair.rate) == pytest.approx(0)
    assert pair.error(pair.offset + 0.04, pair.rate) == pytest.approx(1)


def test_pairs_are_drawn_as_asked(folder):
    few, many = data.cmu_pairs(2, seed=5), data.cmu_pairs(4, seed=5)
    assert all(torch.equal(x.a, y.a) and x.offset == y.offset for x, y in zip(few, many, strict=False))
    assert few[0].a.shape == few[0].b.shape == (120, 17, 2) and abs(few[0].offset) <= 35 / 30
    pair = data.cmu_pair(takes(1)[0], data.seeded(2), missing=0.25, wrong_joints=2, fps=(24.0, 50.0))
    assert pair.a.isnan().any(-1).double().mean(0).tolist() == pytest.approx([0.25] * 17)
    assert pair.a.shape[0] == 120 and pair.b.shape[0] == 250 and pair.wrong.sum() == 2
    pair = data.cmu_pair(takes(1)[0], data.seeded(3), points="different")
    assert pair.a.shape[1] == pair.b.shape[1] == data.DIFFERENT
    short = data.cmu_pair(takes(1, 150)[0], data.seeded(4))
    assert 50 < len(short.a) < 75 and (len(short.a) / 30 + abs(short.offset)) <= 150 / 60


def test_outliers_lie_anywhere_and_noise_is_millimetres():
    clean, noisy, struck = (
        data.cmu_pair(takes(1)[0], data.seeded(6), noise_mm=noise, outliers=share, points="all")
        for noise, share in ((0, 0), (15, 0), (0, 0.15))
    )
    assert float((noisy.a - clean.a).std()) == pytest.approx(noisy.noise[0], rel=0.1)
    assert noisy.noise[0] == pytest.approx(0.015 * 1300 / 4.5, rel=0.4)
    moved = (struck.a - clean.a).norm(dim=-1) > 1e-9
    assert float(moved.double().mean()) == pytest.approx(0.15, abs=0.02)


def test_people_who_cannot_be_synchronized():
    joints = takes(2)
    steady = motions.periodic_pair(joints[0], data.seeded(0), noise_mm=0.0, frames=300)
    spectrum = torch.fft.rfft((steady.a - steady.a.mean(0))[:, 4, 0]).abs()
    assert float(spectrum.sort(descending=True).values[:24].square().sum() / spectrum.square().sum()) > 0.9
    still = motions.still_pair(joints[0], data.seeded(0), noise_mm=0.0)
    assert 0 < float((still.a - still.a.mean(0)).norm(dim=-1).max()) < 10
    assert math.isnan(motions.unrelated_pair(joints[0], joints[1], data.seeded(0)).offset)
    assert math.isnan(motions.reversed_pair(joints[0], data.seeded(0)).offset)


def test_long_takes_are_smooth(folder):
    take = motions.long_take(50.0, data.seeded(0))
    assert len(take) >= 3000
    # joints of two takes are up to 2 m apart, and one becomes the other within a second
    assert float((take[1:] - take[:-1]).norm(dim=-1).max()) < 0.1


def test_baselines_find_a_shift_of_whole_frames():
    seconds = torch.arange(150, dtype=torch.float64)[:, None] / 30
    height = torch.sin(2 * seconds**1.5 + torch.arange(5.0))
    whole = torch.stack([0.3 * height, height], dim=-1) * 100
    a, b = whole[10:], whole[:-10]
    a[3:6, 2] = torch.nan
    for method in (baselines.pose2sim, baselines.vertical, baselines.activity):
        assert method(a, b, 30.0).offset == pytest.approx(10 / 30)
        assert method(a, b, 30.0, parabola=True).offset == pytest.approx(10 / 30, abs=0.1 / 30)
        assert abs(method(a, b, 30.0, max_shift=0.2).offset) <= 0.2
    found = baselines.pose2sim(a, b, 30.0)
    x, y = (baselines._smooth(np.abs(baselines._velocity(t, 30.0)[..., 1]).sum(-1), 30.0) for t in (a, b))
    assert found.correlations[found.lags == 7] == pytest.approx(np.corrcoef(x[:-7], y[7:])[0, 1])


@pytest.mark.slow
def test_tables_of_virtual_cameras(folder, told, tmp_path, capsys):
    synchronization.run(synchronization.Config(trials=3, quick=True, out=tmp_path / "out.json"))
    tables = json.loads((tmp_path / "out.json").read_text())["tables"]
    assert list(tables) == list(synchronization.TABLES)
    same = [row for row in tables["Same joints"] if row["task"] == "auto, right"]
    assert [row["measured"] for row in same] == [1.0] * len(synchronization.NOISE) and all(row["reached"] for row in same)
    (middle,) = (row for row in tables["Same joints"] if row["task"] == "auto, median error")
    assert middle["measured"] == pytest.approx(TOLD) and not middle["reached"]
    named = {row["task"]: row["measured"] for row in tables["Bad detections"]}
    assert named["wrong joints named"] == 1 and named["good joints called wrong"] == 0
    assert all(row["measured"] == 0 for row in tables["Refusal"])
    clocks = {row["task"]: row for row in tables["Two clocks"]}
    assert clocks["drift error, median"]["measured"] == pytest.approx(0, abs=1e-6)
    assert clocks["error at the ends, worst"]["measured"] == pytest.approx(TOLD)
    assert {camera for _, camera, _ in told} == {"auto", "perspective", "affine"} and {limit for *_, limit in told} == {2.0}
    assert "goals reached" in capsys.readouterr().out


def test_summary_counts_what_is_trusted():
    pairs = [data.Pair("", torch.zeros(60, 1, 2), torch.zeros(60, 1, 2), (30.0, 30.0), 0.5) for _ in range(4)]
    answers = [shift(0.5 + frames / 30, (30.0, 30.0), ok=ok) for frames, ok in ((0.2, True), (3, True), (-0.5, False), (9, False))]
    found = synchronization.summary(pairs, answers)
    assert (found.right, found.ok, found.trusted) == (0.5, 0.5, 0.5) and found.error == pytest.approx(1.75)
    assert "none" in str(synchronization.summary(pairs[3:], answers[3:]))


def test_recorded_keypoints_are_shifted_by_what_is_said():
    x = torch.arange(40.0, dtype=torch.float64)[:, None, None].expand(40, 2, 2).clone()
    for frames in (*real_synchronization.SHIFTS, -0.5, 0.5):
        pair = real_synchronization.shifted(x, x, frames, 60.0)
        both = min(len(pair.a), len(pair.b))
        # a straight line: a's frame i and b's frame i + shift show the same
        assert torch.allclose(pair.a[:both] - pair.b[:both], torch.full((both, 2, 2), frames, dtype=torch.float64))


def test_tables_of_recordings(folder, told, tmp_path, monkeypatch):
    films = iter([np.zeros((20, 4, 4), np.uint8), np.ones((20, 4, 4), np.uint8)])
    monkeypatch.setattr(real_synchronization, "gray", lambda path: next(films))
    answer = lambda a, b, method, fps, max_shift: shift((len(b) - len(a)) / fps, (fps, fps), ok=method == "tracks")  # noqa: E731
    monkeypatch.setattr(real_synchronization, "synchronize", answer)
    real_synchronization.run(real_synchronization.Config(out=tmp_path / "out.json"))
    drone, people, videos = json.loads((tmp_path / "out.json").read_text())["tables"].values()
    # clocks of 30 and 20 fps whose frames are .6667 and 2 apart: the answer 0 is wrong by 2 frames, and more with the rate
    assert drone[0]["task"] == "one - two" and drone[0]["measured"] == pytest.approx(2.0, abs=0.01)
    assert drone[1]["measured"] == 0
    own = [row for row in people if row["task"].startswith("same")]
    assert [row["measured"] for row in own] == [1.0] * 3 and "half frames" in people[-1]["setting"]
    assert all(row["measured"] == 0 for row in videos) and len(videos) == 4 * len(real_synchronization.TRIMS)

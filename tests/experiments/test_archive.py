"""The experiments of the archive, on people who are made up: what is right, compared and multiplied, and every script once."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from experiments.archive import exhaustive, growth, moments, performances, scenes
from experiments.archive.exhaustive import Ranking
from experiments.benchmarks import archive as benchmark
from indexing import Clip, ClipSet
from indexing.action.bank import JointMetric, Windows, fused_residual
from indexing.actors import Person, perform
from indexing.archive import search
from indexing.archive.search import Hit

PARENTS = [-1, 0, 0, 0, 1, 4, 5, 6, 2, 8, 9, 10, 3, 12, 13, 13, 13, 14, 17, 15, 19, 20, 21, 21, 22, 16, 25, 26, 27, 27, 28]
NAMES = [
    *("root", "lhipjoint", "rhipjoint", "lowerback", "lfemur", "ltibia", "lfoot", "ltoes", "rfemur", "rtibia", "rfoot", "rtoes"),
    *("upperback", "thorax", "lowerneck", "lclavicle", "rclavicle", "upperneck", "head", "lhumerus", "lradius", "lwrist", "lhand"),
    *("lthumb", "lfingers", "rhumerus", "rradius", "rwrist", "rhand", "rthumb", "rfingers"),
]


def take(seconds: float, rng: np.random.Generator) -> np.ndarray:
    """``(frames, 31, 3)`` somebody whose bones swing, each in its own way."""
    times = np.arange(round(seconds * scenes.CAPTURED) + 1)[:, None, None] / scenes.CAPTURED
    rest = rng.normal((0.0, 0.05, 0.0), 0.1, (1, 31, 3))
    rest[0, [4, 5, 8, 9], 1] -= 0.4  # legs go down, the head is up
    rest[0, [12, 13, 18], 1] += 0.2
    rest[0, 1], rest[0, 2] = (0.1, 0.0, 0.0), (-0.1, 0.0, 0.0)
    phases = (2 * np.pi * times * rng.uniform(0.15, 0.9, (1, 31, 1)) + rng.uniform(0, 6, (1, 31, 1)) for _ in range(3))
    waves = sum(rng.normal(0, 0.12, (1, 31, 3)) * np.sin(phase) for phase in phases)
    return scenes.joints_of(rest + waves, tuple(PARENTS))


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A data folder with six takes, and a set of clips of four actions by three people, in 3D."""
    folder, rng = tmp_path_factory.mktemp("data"), np.random.default_rng(3)
    takes = [take(seconds, rng) for seconds in (6.0, 7.0, 8.0, 5.0, 9.0, 6.5)]
    ends = np.cumsum([0, *map(len, takes)])
    np.savez(folder / scenes.FILE, joints=np.concatenate(takes), offsets=ends, joint_names=NAMES, parents=PARENTS)
    clips = [
        perform(action, Person.random(person), fps=15.0, rng=10 * person + repeat).replace(
            name=f"{action} {person} {repeat}", label=action, meta={"subject": person}
        )
        for action in ("squat", "kick", "wave")
        for person in (1, 2, 3)
        for repeat in (0, 1)
    ]
    ClipSet(clips).save(folder / "utkinect.npz")
    return folder


@pytest.fixture
def people(data: Path, monkeypatch: pytest.MonkeyPatch) -> scenes.Takes:
    """The takes, and the folder named."""
    monkeypatch.setenv("DYNTORCH_DATA", str(data))
    return scenes.captured()


def tables(folder: Path) -> dict[str, Any]:
    """What a script wrote."""
    return json.loads((folder / "figures.json").read_text())["tables"]


# ---- scenes ------------------------------------------------------------------------------------------------------------
def test_every_joint_has_its_twin(people: scenes.Takes) -> None:
    twins = np.array(people.twins)
    assert (twins[twins] == np.arange(31)).all()
    assert NAMES[twins[NAMES.index("lhand")]] == "rhand" and twins[NAMES.index("lowerneck")] == NAMES.index("lowerneck")
    assert len(people.skeleton.bones) == len(scenes.JOINTS) - 1


def test_a_distractor_has_the_legs_of_one_take_and_limbs_that_stay_of_one_length(people: scenes.Takes) -> None:
    # people of straight bones: the lengths of one of them are the same in every frame, and so must a distractor's be
    still = tuple(one[:1].repeat(len(one), axis=0) for one in people.takes)
    stiff = scenes.Takes(still, people.joints, people.parents, people.twins)
    made = scenes.invented(stiff, np.random.default_rng(1))
    lengths = np.linalg.norm(scenes.bones_of(made, people.parents)[:, 1:], axis=2)
    np.testing.assert_allclose(lengths, lengths[:1].repeat(len(lengths), axis=0), atol=1e-9)
    known = [np.linalg.norm(scenes.bones_of(one[:1], people.parents)[0, 1:], axis=1) for one in stiff.takes]
    # a limb of the legs is one take's, or its twin's, times a factor near 1
    leg = people.joints.index("ltibia") - 1, people.joints.index("rtibia") - 1
    assert min(abs(np.log(lengths[0, leg[0]] / one[side])) for one in known for side in leg) < 0.6


def test_a_rolled_camera_turns_the_image(people: scenes.Takes) -> None:
    still = scenes.Cameras(noise=0.0, spread=0.0)
    rolled = scenes.Cameras(noise=0.0, spread=0.0, roll=90.0)
    first, second = (
        scenes.filmed_person(people.takes[0][::2], people, np.random.default_rng(4), one).joints for one in (still, rolled)
    )
    np.testing.assert_allclose(np.abs(second), np.abs(first[..., ::-1]), atol=1e-5)


def test_a_question_shows_the_moment_that_it_names(people: scenes.Takes) -> None:
    exact = scenes.Cameras(noise=0.0)
    rng = np.random.default_rng(5)
    archived = {clip.name: clip for clip in scenes.every_take(people, rng, exact)}
    (question,) = scenes.questions(people, 1.0, 1, rng, exact)
    assert question.clip.duration == pytest.approx(1.0) and question.end - question.start == pytest.approx(1.0)
    metric = JointMetric.learn(torch.rand(5, 12, 20, 2), torch.ones(5, 20, dtype=torch.bool), 0.25)
    measure, source = exhaustive.exact(metric), [archived[question.source]]
    asked, none = exhaustive.asked([question.clip], 12), np.zeros(1, np.intp)
    found = {
        shift: float(measure.compare(asked, exhaustive.windows_at(source, none, np.array([question.start + shift]), 1.0, 12)))
        for shift in (0.0, 0.2, -0.2)
    }
    assert found[0.0] > max(found[0.2], found[-0.2])


def test_questions_longer_than_every_take_are_refused(people: scenes.Takes) -> None:
    with pytest.raises(ValueError, match=r"no take lasts 30.5 s; give 8.5 at most"):
        scenes.questions(people, 30.0, 1, np.random.default_rng(0))


# ---- everything with everything ----------------------------------------------------------------------------------------
@pytest.mark.slow
def test_rankings_are_those_of_every_window(people: scenes.Takes, monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(6)
    clips = scenes.every_take(people, rng)[:3]
    asked = scenes.questions(people, 1.0, 2, rng)
    monkeypatch.setattr(search, "MIN_SEPARATION", 0.0)  # every window may be a hit
    seen = torch.ones(40, 20, dtype=torch.bool)
    metric = JointMetric.learn(torch.rand(40, 12, 20, 2), seen, 0.25)
    measures = {"exact": exhaustive.exact(metric)}
    found = exhaustive.rankings([one.clip for one in asked], clips, 1.0, measures, (1.0,))
    for question, ranking in zip(asked, found["exact"], strict=True):
        scores = {}
        for i, clip in enumerate(clips):
            for start in np.arange(0.0, clip.duration - 1.0 + 1e-9, exhaustive.STEP):
                window = exhaustive.windows_at([clip], np.zeros(1, np.intp), np.array([start]), 1.0, 12)
                query = exhaustive.asked([question.clip], 12)
                scores[i, round(float(start), 3)] = -float(fused_residual(query, [Windows(window.values, window.seen)], metric))
        assert len(ranking.owner) == len(scores)
        best = max(scores, key=scores.__getitem__)
        assert (int(ranking.owner[0]), round(float(ranking.start[0]), 3)) == best
        np.testing.assert_allclose(ranking.score, sorted(scores.values(), reverse=True), atol=1e-4)


def test_peaks_against_a_loop() -> None:
    rng = np.random.default_rng(7)
    scores, owner = torch.from_numpy(rng.random((3, 40))), np.repeat([0, 1, 2], [15, 5, 20])
    found = exhaustive.peaks(scores, owner, 4)
    for q in range(3):
        for n in range(40):
            near = [m for m in range(40) if abs(m - n) <= 4 and owner[m] == owner[n]]
            expected = scores[q, n] if scores[q, n] >= max(scores[q, m] for m in near) else -np.inf
            assert found[q, n] == expected


def test_neighbours_are_merged_as_a_loop_does() -> None:
    rng = np.random.default_rng(8)
    start = rng.uniform(0, 20, 200)
    ranking = Ranking(rng.integers(0, 3, 200), start, start + rng.uniform(0.5, 2.0, 200), np.sort(rng.random(200))[::-1])
    kept: list[int] = []
    for i in range(200):
        if all(
            ranking.owner[i] != ranking.owner[j]
            or min(ranking.end[i], ranking.end[j]) - max(start[i], start[j])
            < 0.5 * min(ranking.end[i] - start[i], ranking.end[j] - start[j])
            for j in kept
        ):
            kept.append(i)
    assert [begin for _, begin, _, _ in exhaustive.merged(ranking, 500, 0.5)] == start[kept].tolist()


# ---- what is right -----------------------------------------------------------------------------------------------------
def test_the_place_of_the_moment() -> None:
    question = scenes.Question(Clip(np.zeros((31, 20, 2))), "take 3", 4.0, 5.0)
    found = [Hit("take 3", "", 6.0, 7.0, 3.0), Hit("take 2", "", 4.0, 5.0, 2.0), Hit("take 3", "", 4.0, 5.4, 1.0)]
    assert moments.place(found, question) == 2
    assert moments.place(found[:2], question) == np.inf
    assert moments.recall([0, 3, 20, np.inf]) == [0.25, 0.5]


def test_figures_of_hits_by_hand() -> None:
    stretch = performances.Stretch
    known = {
        "a": performances.Known(Clip(np.zeros((9, 3, 2)), name="a"), (stretch("x", 0, 4), stretch("y", 4, 9))),
        "b": performances.Known(Clip(np.zeros((9, 3, 2)), name="b"), (stretch("x", 0, 3),)),
    }
    spans = [("a", 0, 1), ("a", 1, 2), ("a", 5, 6), ("b", 8, 9), ("b", 1, 2)]
    found = [Hit(source, "", start, end, -i) for i, (source, start, end) in enumerate(spans)]
    # right, right again, other label, nothing there, right; of two stretches one is first and one third of those that are any
    assert performances.figures((found, found), "x", known) == [3 / 5, 3 / 10, pytest.approx((1 + 2 / 3) / 2)]


# ---- the scripts, once -------------------------------------------------------------------------------------------------
@pytest.mark.slow
def test_moments_among_distractors_are_found(people: scenes.Takes, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    moments.run(moments.Config(windows=900, queries=6, durations=(1.0,), candidates=(30,), out=tmp_path))
    first, others, options = tables(tmp_path).values()
    line = {name: dict(zip(first["columns"], values, strict=True)) for name, values in first["lines"].items()}
    assert set(line) == set(moments.WAYS)
    assert line[moments.ARCHIVE]["1 s @10"] >= 0.8 and line[moments.EXHAUSTIVE]["1 s @10"] >= 0.8
    assert line[moments.ARCHIVE]["1 s @10"] >= line[moments.PLAIN]["1 s @10"]
    assert "from the ceiling, 60 degrees" in others["lines"] and "30 candidates" in options["lines"]
    assert "recall@10, .95 of exhaustive" in capsys.readouterr().out


@pytest.mark.slow
def test_other_people_are_found(people: scenes.Takes, tmp_path: Path) -> None:
    performances.run(performances.Config(sets=("utkinect",), changes=(), dtw=False, most=6, out=tmp_path))
    found = tables(tmp_path)
    assert len(found) == len(performances.TURNS)
    for table in found.values():
        assert table["lines"][performances.ARCHIVE][0] >= 0.5  # of five, four are right at most
    with pytest.raises(ValueError, match="changes: 'magic' is none of"):
        performances.run(performances.Config(changes=("magic",), out=tmp_path))


def test_an_archive_is_multiplied_whole(people: scenes.Takes, tmp_path: Path) -> None:
    archive = growth.recorded(tmp_path / "growing.archive", 90 / growth.HOUR, seed=0)
    once = len(archive)
    original = growth.Original.of(archive)
    assert growth.grow(original, 1, 5, seed=0) == 5
    assert len(archive) == 5 * once
    info = archive.info()
    assert info.sources == 5 * len(original.sources) and info.segments == 2  # four copies fit into one
    report = archive.verify()
    assert report.ok, report.problems
    names = {row.source for row in archive.recordings()}
    assert {"take 0", "take 0 copy 1", "take 0 copy 4"} <= names and "take 0 copy 5" not in names
    (question,) = scenes.questions(people, 1.0, 1, np.random.default_rng(2))
    found = {hit.source for hit in archive.search(question.clip, k=5)}
    assert len(found & {f"{question.source} copy {i}" for i in range(1, 5)}) >= 3
    copied = archive.clip("take 2 copy 3")
    np.testing.assert_array_equal(copied.joints, archive.clip("take 2").joints)


@pytest.mark.slow
def test_growth_is_measured(people: scenes.Takes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(growth, "HOUR", 60.0)
    growth.run(growth.Config(hours=(1, 3), durations=(1.0,), queries=1, cold=1, out=tmp_path))
    (table,) = tables(tmp_path).values()
    small, large = (dict(zip(table["columns"], values, strict=True)) for values in table["lines"].values())
    assert int(large["windows"].replace(",", "")) == 3 * int(small["windows"].replace(",", ""))
    assert 0 < large["warm, query of 1 s (s)"] < 30 and large["on disk (MB)"] > small["on disk (MB)"]
    assert (tmp_path / "growth.png").read_bytes().startswith(b"\x89PNG")
    with pytest.raises(ValueError, match="hours must grow"):
        growth.run(growth.Config(hours=(3, 1), out=tmp_path))


@pytest.mark.slow
def test_adding_is_timed_and_workers_agree(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    config = benchmark.Config(hours=0.005, frames=60, files=2, minutes=0.4, queries=2, rounds=1, dask=False)
    rows = benchmark.adding(config)
    assert [row.task for row in rows][-1] == "archive" and all(row.measured > 0 for row in rows)
    rows = benchmark.two_workers(config)
    assert rows[-1].task == "the same hits, bit for bit" and rows[-1].measured == 1.0

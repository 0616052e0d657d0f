"""Which person of one camera is which of the other, and who is followed."""

from __future__ import annotations

import numpy as np
import pytest
import torch

import dyntorch
from indexing.clip import Clip
from indexing.readers import read
from indexing.sync.people import Pairing, decide, disagreements, jumps, match_people
from indexing.sync.recordings import SyncOptions, Take, take_of
from indexing.sync.synchronize import pair, synchronize
from tests.indexing.sync.scene import FPS, cut, filmed, moved, shift, write_openpose

# torch's own, when it first loads its transforms; hidden outside of tests
pytestmark = pytest.mark.filterwarnings("ignore:.torch.jit.script. is deprecated")


def test_one_person_is_one_candidate_and_several_are_several(cameras, tmp_path):
    other = filmed(seed=5, skipped=(0,))[0]
    alone = take_of(write_openpose(tmp_path / "alone", [cameras[0]]), fps=FPS)
    both = take_of(write_openpose(tmp_path / "both", [cameras[0], moved(cut(other, 4), 900.0)]), fps=FPS)
    assert len(alone.people) == len(alone.everyone) == 1 and len(both.everyone) == 2 and 2 <= len(both.people) <= 3
    assert len(take_of(tmp_path / "both", fps=FPS, person="largest").people) == 1
    assert len(take_of(tmp_path / "both", fps=FPS, options=SyncOptions(num_candidates=0)).people) == 1
    found = read(tmp_path / "both", person="everyone", fps=FPS)  # without ids
    assert [(clip.meta["person"], len(clip)) for clip in found] == [(0, len(cameras[0])), (1, len(other) - 4)]
    assert np.allclose(found[0].joints, cameras[0].joints, equal_nan=True)
    with pytest.raises(ValueError, match=r"person='all' needs tracked people"):
        read(tmp_path / "both", person="all")


def test_the_best_pairing_is_taken_and_named(monkeypatch, cameras):
    people = [clip.replace(meta={"person": i}) for i, clip in enumerate(cameras)]
    a, b = (Take(name, "keypoints", people=tuple(people[:2]), fps=FPS, count=191) for name in ("left", "right"))
    says = {(0, 0): (0.3, 0.5, False), (0, 1): (1.0, 0.95, True), (1, 0): (1.01, 0.9, True), (1, 1): (2.0, 0.2, True)}

    def answer(x, y, *_, **__):
        i, j = (next(k for k, clip in enumerate(people) if len(clip) == len(points)) for points in (x, y))
        offset, confidence, ok = says[i, j]
        return shift(offset, confidence=confidence, ok=ok)

    monkeypatch.setattr(dyntorch, "synchronize", answer, raising=False)
    found = pair(a, b)
    assert found.people == (0, 1) and found.shift.ok and found.shift.offset == 1.0 and not found.rivals
    note = "several people in view: compared person 0 of left with person 1 of right, the best of 3 pairings"
    assert found.shift.notes == (note,)  # of 4: two people of each camera say the same, which is enough


def said(offset, confidence, people=(0, 0), ok=True) -> Pairing:
    return Pairing(shift(offset, confidence=confidence, ok=ok), people)


def test_pairings_that_contradict_each_other():
    sure = said(1.0, 0.9)
    for found, offset, rivals in (
        ([sure, said(1.02, 0.99, (0, 1)), said(3.0, 0.99, (1, 1), ok=False)], 1.0, ()),
        ([sure, said(2.0, 0.8, (0, 1)), said(0.0, 0.1, (1, 1))], 1.0, (2.0,)),
        ([said(1.0, 0.8), said(2.0, 0.99, (0, 1)), said(1.01, 0.7, (1, 1))], 1.0, ()),  # two people against one
        ([said(1.0, 0.3, ok=False), said(2.0, 0.4, ok=False)], 2.0, ()),
    ):
        best, others = decide(found, 1 / FPS)
        assert best.shift.offset == pytest.approx(offset, abs=0.03) and others == rivals


def test_a_fast_look_finds_the_pairing_and_a_thorough_one_decides(cameras):
    a, b = (Take(name, "keypoints", people=(cameras[0], cameras[1]), fps=FPS) for name in ("left", "right"))
    same = {id(cameras[0]): 0, id(cameras[1]): 1}
    asked = []

    def solver(says, kind):
        def solve(one, other):
            people = same[id(one)], same[id(other)]
            asked.append((kind, people))
            return says.get(people, says["else"])

        return solve

    nothing = shift(ok=False, confidence=0.1, reason="periodic")
    sure = {(1, 0): shift(1.0), "else": nothing}
    found = match_people(a, b, solver({(1, 0): shift(1.01), "else": nothing}, "slow"), solver(sure, "fast"))
    assert (
        found.people == (1, 0) and found.shift.offset == 1.01 and [people for kind, people in asked if kind == "slow"] == [(1, 0)]
    )
    asked.clear()
    unsure = {(1, 1): shift(ok=False, confidence=0.4), "else": nothing}
    found = match_people(a, b, solver({(1, 1): shift(3.0), "else": nothing}, "slow"), solver(unsure, "fast"))
    assert found.people == (1, 1) and found.shift.ok and found.shift.offset == 3.0
    assert len([kind for kind, _ in asked if kind == "slow"]) == 3
    torn = {(0, 0): shift(1.0), (0, 1): shift(2.0), "else": nothing}
    found = match_people(a, b, solver(torn, "slow"), solver(torn, "fast"))
    assert (
        not found.shift.ok
        and "one pairing of people says +1.000 s, but pairings of other people say +2.000 s" in found.shift.reason
    )


def test_stretches_of_another_person_are_noticed():
    """Affine cameras, so that F is known: x_b depends on x_a's y alone."""
    rng = np.random.default_rng(0)
    times = np.arange(120) / FPS
    still, swing = rng.uniform(0, 400, (17, 2)), rng.uniform(10, 60, (17, 2))
    a = still + swing * np.sin(2 * times[:, None, None] + np.arange(17)[:, None])
    b = np.stack([rng.uniform(0, 400, (120, 17)), a[..., 1]], axis=2) + rng.normal(size=(120, 17, 2))
    b[60:90] += 150.0
    matrix = torch.tensor([[0, 0, 0], [0, 0, 1.0], [0, -1, 0]], dtype=torch.float64) / 2**0.5
    one, other = Clip(a, fps=FPS), Clip(b, times=times + 0.7)
    known = shift(0.7, fundamental=matrix)
    [(start, end, times_usual)] = disagreements(one, other, known)
    assert start == pytest.approx(60 / FPS, abs=3 / FPS) and end == pytest.approx(89 / FPS, abs=3 / FPS) and times_usual > 20
    b[60:90] -= 150.0
    assert disagreements(one, Clip(b, times=times + 0.7), known) == []
    assert jumps(one) == [] and jumps(Clip(np.zeros((1, 3, 2)))) == []
    a[70:80] += 700.0
    a[100:103] += 700.0  # too short for anybody
    assert jumps(Clip(a, fps=FPS)) == pytest.approx([70 / FPS, 80 / FPS])
    assert disagreements(one, other, shift(0.7)) == []


@pytest.mark.slow
def test_the_right_people_among_several(tmp_path):
    scenes = filmed(seed=1, skipped=(0, 12)), filmed(seed=7, skipped=(0, 12), actions=("punch", "bow"))
    first, second = ([cut(clip, 0, 95) for clip in scene] for scene in scenes)
    folders = [
        write_openpose(tmp_path / "cam1", [first[0], moved(second[0], 800.0)]),
        write_openpose(tmp_path / "cam2", [moved(second[1], 800.0), first[1]]),
    ]
    found = synchronize(*folders, fps=FPS)
    assert found.ok and found.frames == pytest.approx(-12, abs=0.5) and "several people in view" in found.notes[-1], found

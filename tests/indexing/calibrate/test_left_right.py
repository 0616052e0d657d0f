"""Left and right exchanged: found by what the other cameras see."""

from itertools import pairwise, product

import numpy as np
import pytest

from indexing.calibrate import left_right
from indexing.calibrate.left_right import LIMBS, SideNotice, _reprojection_cost, _viterbi, correct_sides, paired_joints
from indexing.skeleton import BODY25, COCO17
from tests.indexing.calibrate.crowd import NAMES, cameras, crossing, filmed

AROUND = (0.2, 1.5, 3.1, 4.6)
PAIRS = paired_joints(NAMES)


def turned(tracks, rows, limbs=LIMBS, person=0):
    """Tracks ``(frames, n, 2)`` with left and right exchanged in some frames."""
    out = tracks.copy()
    for limb in limbs:
        for left, right in PAIRS[limb]:
            a, b = person * len(NAMES) + left, person * len(NAMES) + right
            out[rows, a], out[rows, b] = tracks[rows, b], tracks[rows, a]
    return out


def scene(count=1, azimuths=AROUND, noise=4.0, frames=90):
    rig = cameras(azimuths, offsets=[0.0, 0.3, -0.2, 0.11][: len(azimuths)])
    seen = filmed(crossing(np.random.default_rng(2), count), rig, frames=frames, noise=noise)
    return rig, [one.reshape(frames, -1, 2) for one in seen]


@pytest.mark.parametrize("count", [3, 4])
def test_a_mirrored_camera_is_outvoted(count):
    rig, truth = scene(azimuths=AROUND[:count])
    given = [*truth[:2], turned(truth[2], slice(None)), *truth[3:]]
    found = correct_sides(given, rig, NAMES)
    assert found.status == 0 and [e.limb for e in found.exchanges] == ["body"]
    assert found.exchanges[0].camera == 2 and found.exchanges[0].start == 0.0 and found.exchanges[0].evidence > 0
    for own, right in zip(found.tracks, truth, strict=True):
        assert np.array_equal(own, right)
    assert found.notices[0].code is SideNotice.MENDED and "body of person 0 exchanged in camera 2" in found.notices[0].text


@pytest.mark.parametrize(
    ("count", "mirrored", "names", "said"),
    [
        (2, 1, NAMES, SideNotice.TWO),
        (4, 2, NAMES, SideNotice.TIED),  # as many for as against
        (4, 0, [f"joint_{k}" for k in range(len(NAMES))], SideNotice.SIDELESS),
    ],
)
def test_what_nothing_decides_is_left_and_said(count, mirrored, names, said):
    rig, truth = scene(azimuths=AROUND[:count])
    given = [turned(one, slice(None)) if i < mirrored else one for i, one in enumerate(truth)]
    found = correct_sides(given, rig, names)
    assert found.status == 0 and {notice.code for notice in found.notices} == {said} and not found.exchanges
    assert all(np.array_equal(own, one) for own, one in zip(found.tracks, given, strict=True))


def test_stretches_of_a_limb_are_mended_within_a_few_frames():
    rig, truth = scene()
    given = list(truth)
    given[1] = turned(given[1], slice(20, 45), ["legs"])
    given[3] = turned(given[3], slice(60, 80), ["arms"])
    weights = [np.where(np.isfinite(one).all(2), 1.0, 0.0) for one in given]
    weights[1][30, PAIRS["legs"][0][0]] = 0.25
    found = correct_sides(given, rig, NAMES, weights=weights)
    wrong = [(own != right).any(2) for own, right in zip(found.tracks, truth, strict=True)]
    assert sum(int(one.any(1).sum()) for one in wrong) <= 4  # at the ends of stretches noise decides
    assert {(e.camera, e.limb) for e in found.exchanges} == {(1, "legs"), (3, "arms")}
    by_limb = {e.limb: e for e in found.exchanges}
    assert by_limb["legs"].start == pytest.approx(20 / 30, abs=2 / 30) and by_limb["legs"].end == pytest.approx(44 / 30, abs=2 / 30)
    assert found.exchanged[1][:, 0, LIMBS.index("legs")].sum() == pytest.approx(25, abs=2)
    left, right = PAIRS["legs"][0]
    assert found.weights[1][30, right] == 0.25 and found.weights[1][30, left] == 1.0  # trust goes with the position


def test_nothing_is_exchanged_where_nothing_is_and_people_side_by_side():
    rig, truth = scene(noise=8.0)
    truth[0][10:30, 4:9] = np.nan
    found = correct_sides(truth, rig, NAMES)
    assert not found.exchanges
    assert all(np.array_equal(own, right, equal_nan=True) for own, right in zip(found.tracks, truth, strict=True))
    rig, truth = scene(2)
    found = correct_sides([turned(truth[0], slice(30, 70), person=1), *truth[1:]], rig, NAMES)
    assert {(e.camera, e.person) for e in found.exchanges} == {(0, 1)}
    assert (found.tracks[0] != truth[0]).any(2).any(1).sum() <= 3


def test_lenses_and_frame_rates():
    rig = cameras(AROUND, k1=-0.2)
    rates = (30.0, 25.0, 30.0, 50.0)
    truth = [
        filmed(crossing(np.random.default_rng(2), 1), rig, frames=round(3 * f), fps=f)[k].reshape(round(3 * f), -1, 2)
        for k, f in enumerate(rates)
    ]
    given = [truth[0], turned(truth[1], slice(None)), *truth[2:]]
    found = correct_sides(given, rig, NAMES, times=[np.arange(len(one)) / rate for one, rate in zip(given, rates, strict=True)])
    assert (found.tracks[1] == truth[1]).all(2).all(1).mean() > 0.97
    assert all((own == right).all(2).all(1).mean() > 0.97 for own, right in zip(found.tracks, truth, strict=True))


def test_viterbi_is_the_best_of_all_ways_and_what_is_right_has_no_misfit(monkeypatch):
    states = np.array(list(product((0, 1), repeat=2)))
    steps = np.abs(states[:, None] - states).sum(-1)
    for seed in range(20):
        energy = np.random.default_rng(seed).uniform(0, 3, (5, 4))

        def cost(way, energy=energy):
            return energy[range(5), way].sum() + 0.7 * sum(steps[a, b] for a, b in pairwise(way))

        best = min(cost(list(way)) for way in product(range(4), repeat=5))
        assert cost(list(_viterbi(energy, states, 0.7))) == pytest.approx(best)
    coco, body = (paired_joints(layout.joints) for layout in (COCO17, BODY25))
    assert [len(coco[limb]) for limb in ("trunk", "arms", "legs")] == [4, 2, 2] and len(body["legs"]) == 5
    rig = cameras(AROUND[:3])
    points = np.random.default_rng(0).uniform([-0.5, -0.5, 0.2], [0.5, 0.5, 1.6], (4, 6, 3))
    P = np.concatenate([(rig.K @ rig.R).numpy(), (rig.K @ rig.t[..., None]).numpy()], axis=2)
    seen = np.einsum("cij,tkj->tcki", P[..., :3], points) + P[None, :, None, :, 3]
    x = seen[..., :2] / seen[..., 2:]
    weight = np.ones(x.shape[:3])
    assert np.abs(_reprojection_cost(x, weight, P, 500.0)).max() < 1e-6
    x[0, 1, 2] += 60.0
    off = _reprojection_cost(x, weight, P, 500.0)
    assert off[0] > 1.0 and np.abs(off[1:]).max() < 1e-6
    monkeypatch.setattr(left_right, "MAX_JOINT_EVIDENCE", 0.5)
    assert _reprojection_cost(x, weight, P, 500.0)[0] == 0.5


def test_bad_input():
    rig, x = scene()
    for change, said in (
        ({"tracks": x[:3]}, "3 given, and there are 4 cameras"),
        ({"tracks": [x[0][:, :5], *x[1:]]}, r"expected \(frames, people \* 13 joints, 2\)"),
        ({"times": [np.zeros(90)] * 4}, "increasing seconds"),
        ({"weights": [np.ones((90, 2))] * 4}, "as the tracks have it"),
    ):
        with pytest.raises(ValueError, match=said):
            correct_sides(**{"tracks": x, "cameras": rig, "joints": NAMES, **change})

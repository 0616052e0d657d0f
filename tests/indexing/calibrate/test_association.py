"""Who is who in cameras that nobody calibrated."""

from itertools import product

import numpy as np
import pytest
import torch

from dyntorch import Status
from indexing.calibrate.people import PeopleNotice, associate, tracklets
from indexing.calibrate.people.pair_geometry import arrange, common_frames, distances
from indexing.calibrate.people.tracklets import cluster, sightings, split_tracks
from indexing.clip import Clip
from indexing.skeleton import Skeleton
from tests.indexing.calibrate.crowd import NAMES, Person, cameras, clips, crossing, filmed

AROUND = (0.2, 1.5, 3.6)


def exchanged(tracks, frames):
    """The two first tracks of a camera with their numbers exchanged from each of these frames on."""
    out = tracks.copy()
    for frame in frames:
        out[frame:, [0, 1]] = out[frame:, [1, 0]]
    return out


def right(found, truth):
    """Share of the people in all frames that have their identity; truth: per camera ``(frames, tracks)``, -1 nobody."""
    agreed = np.zeros((max(int(one.max()) for one in truth) + 1, found.people))
    total = 0
    for tracks, who in zip(found.tracks, truth, strict=True):
        total += (who >= 0).sum()
        for k in range(found.people):
            rows = np.flatnonzero(tracks[:, k] >= 0)
            people = who[rows, tracks[rows, k]]
            agreed[:, k] += np.bincount(people[people >= 0], minlength=len(agreed))
    from scipy.optimize import linear_sum_assignment

    rows, columns = linear_sum_assignment(-agreed)
    return agreed[rows, columns].sum() / total


@pytest.fixture(scope="module")
def scene():
    """Two people in three cameras: numbers exchanged here and there, clocks apart."""
    rig = cameras(AROUND, offsets=[0.0, 0.31, -0.22])
    seen = filmed(crossing(np.random.default_rng(3)), rig)
    order, swaps = ([0, 1], [1, 0], [0, 1]), ([60], [40, 100], [75])
    tracks = [exchanged(one[:, which], at) for one, which, at in zip(seen, order, swaps, strict=True)]
    numbers = [np.tile(np.array(which), (len(one), 1)) for one, which in zip(seen, order, strict=True)]
    truth = [exchanged(one, at) for one, at in zip(numbers, swaps, strict=True)]
    return rig, tracks, truth, seen


@pytest.mark.slow
def test_people_are_told_through_exchanges_and_false_detections(scene):
    rig, tracks, truth, seen = scene
    found = associate([clips(one, name=f"cam{k}") for k, one in enumerate(tracks)])
    assert found.ok and found.people == 2
    assert right(found, truth) > 0.99
    assert (found.clocks.offsets - rig.clocks.offsets).abs().max() < 0.5 / 30
    first = int(truth[0][0, found.tracks[0][0, 0]])
    for own, one in zip(found.joints, seen, strict=True):  # the positions are those of the person, in every camera
        there = np.isfinite(own[:, 0, 0, 0])
        assert np.array_equal(own[there, 0], one[there, first])
    assert {(e.camera, round(e.time * 30)) for e in found.exchanges} >= {(0, 60), (1, 40), (1, 100), (2, 75)}
    assert found.mean_certainty > 0.9
    assert all(len(found.clips(k)) == 2 and found.clips(k)[1].meta["person"] == 1 for k in range(3))
    rng = np.random.default_rng(5)
    ghost = np.full((150, 1, len(NAMES), 2), np.nan)
    ghost[30:70, 0] = seen[0][100, 0] + [300.0, -90.0] + 2 * rng.standard_normal((40, len(NAMES), 2))
    given = [np.concatenate([tracks[0], ghost], axis=1), tracks[1].copy(), tracks[2].copy()]
    given[1][80:110, 0] = np.nan
    who = [np.concatenate([truth[0], np.full((150, 1), -1)], axis=1), truth[1].copy(), truth[2]]
    who[1][80:110, 0] = -1
    found = associate([clips(one, name=f"cam{k}") for k, one in enumerate(given)], clocks=rig.clocks.offsets.numpy())
    assert found.ok and found.people == 2
    assert right(found, who) > 0.98
    assert found.left_out[0][30:70, 2].all() and not (found.tracks[0] == 2).any()
    assert any(notice.code is PeopleNotice.ALONE and "cam0" in notice.text for notice in found.notices)
    away = np.isnan(found.joints[1]).all((2, 3))
    assert away[80:110].sum() == 30 and (found.tracks[1][80:110] == -1).sum() == 30


@pytest.mark.slow
def test_fundamental_matrices_are_those_of_the_cameras(scene):
    rig, tracks, _, _ = scene
    found = associate([clips(one) for one in tracks], clocks=rig.clocks.offsets.numpy())
    points = torch.from_numpy(np.random.default_rng(0).uniform([-0.8, -0.8, 0.1], [0.8, 0.8, 1.7], (40, 3)))
    seen = (points @ rig.R.mT + rig.t[:, None]) @ rig.K.mT
    x = (seen / seen[..., 2:]).numpy()
    for (i, j), matrix in found.fundamentals.items():
        line = x[i] @ matrix.T
        away = np.abs((x[j] * line).sum(1)) / np.linalg.norm(line[:, :2], axis=1)
        assert np.median(away) < 4.0
    assert found.clocks is None and np.allclose(found.offsets_rates[:, 0], rig.clocks.offsets)


def test_distances_are_sampsons_at_common_moments():
    rng = np.random.default_rng(1)
    F, x, y = rng.standard_normal((3, 3)), rng.standard_normal((1, 2, 5, 2)), rng.standard_normal((1, 3, 5, 2))
    found = distances(F, x, y)
    for a, b, k in product(range(2), range(3), range(5)):
        p, q = np.append(x[0, a, k], 1), np.append(y[0, b, k], 1)
        below = np.hypot(np.linalg.norm((F @ p)[:2]), np.linalg.norm((F.T @ q)[:2]))
        assert found[0, a, b, k] == pytest.approx(q @ F @ p / below)
    seen = filmed([Person(np.random.default_rng(0), [0, 0], [1, 0])], cameras((0.0, 1.0), offsets=[0.0, 0.25]), noise=0.0)
    a, b = (arrange(one, split_tracks(one)) for one in (sightings(clips(x), "") for x in seen))
    both = common_frames(a, b, 0.25, 1.0)
    # what b saw a quarter of a second later by its own clock, between two of its frames
    expected = 0.5 * (seen[1][7:9, 0] + seen[1][8:10, 0])
    assert np.abs(both.b[:2, 0] - expected).max() < 1e-9


@pytest.mark.slow
def test_other_layouts_are_compared_by_name(scene):
    rig, tracks, truth, _ = scene
    order = np.random.default_rng(2).permutation(len(NAMES))
    other = Skeleton("turned", (*(NAMES[k] for k in order), "tail"))
    with_tail = np.concatenate([tracks[1][:, :, order], tracks[1][:, :, :1] + 50], axis=2)
    found = associate([clips(tracks[0]), clips(with_tail, layout=other), clips(tracks[2])], clocks=rig.clocks.offsets.numpy())
    assert found.ok and right(found, truth) > 0.99
    assert found.joints[1].shape == (150, 2, len(NAMES) + 1, 2)
    few = Skeleton("few", ("nose", *(f"x{k}" for k in range(len(NAMES) - 1))))
    with pytest.raises(ValueError, match="1 joints of the same name, 8 are needed"):
        associate([clips(tracks[0]), clips(tracks[1], layout=few)])


def test_two_who_do_the_same_side_by_side_before_far_cameras_are_refused():
    # far away and level: whoever steps aside on the floor stays on the epipolar lines
    rng = np.random.default_rng(4)
    one, two = Person(rng, [0.0, -0.6], [0.1, 0.0]), Person(rng, [0.0, 0.6], [0.1, 0.0])
    two.rates, two.phases, two.sizes, two.speed = one.rates, one.phases, one.sizes, one.speed
    rig = cameras((0.2, 1.4), distance=400.0, focal=110_000.0)
    rig.t[:, 1] += 0.0
    found = associate([clips(x) for x in filmed([one, two], rig)], clocks=[0.0, 0.0])
    assert not found.ok and found.status == Status.AMBIGUOUS
    assert "persons 0 and 1 exchanged fit as well" in found.reason
    with pytest.raises(ValueError, match="do the same at the same time"):
        found.check()


@pytest.mark.slow
def test_a_camera_of_other_people_is_named(scene):
    tracks = scene[1]
    strangers = filmed(crossing(np.random.default_rng(99)), cameras((0.4, 2.0)), seed=7)[0]
    given = [clips(tracks[0], name="a"), clips(tracks[1], name="b"), clips(strangers, name="elsewhere")]
    found = associate(given, clocks=[0.0, 0.31, 0.0])
    assert not found.ok and "elsewhere" in found.reason


def test_nobody():
    nothing = clips(np.full((50, 1, len(NAMES), 2), np.nan))
    found = associate([nothing, nothing])
    assert not found.ok and found.people == 0 and found.status == Status.TOO_FEW
    assert "nobody is seen" in found.reason and np.isnan(found.mean_certainty)


def test_bad_input():
    x = clips(np.zeros((20, 1, len(NAMES), 2)) + np.arange(20)[:, None, None, None])
    deep = Clip(np.zeros((20, 5, 3)) + np.arange(3), fps=30.0, name="deep")
    bare = Clip(np.zeros((20, 5, 2)), fps=30.0)
    for takes, more, said in (
        ([x], {}, "two at least"),
        ([x, []], {}, "no people given"),
        ([x, [deep]], {}, "deep: has 3D joints"),
        ([x, [*x, bare]], {}, "people of one camera have the same"),
        ([x, [bare]], {}, "have no names"),
        ([x, x], {"clocks": [0.0]}, "for each of 2 cameras"),
        ([x, x], {"clocks": [[0.0, 1.0], [0.0, -1.0]]}, "for each of 2 cameras"),
    ):
        with pytest.raises((ValueError, TypeError), match=said):
            associate(takes, **more)


# The stages.


def test_pieces_follow_the_body_whatever_number_it_has():
    seen = filmed(crossing(np.random.default_rng(3)), cameras(AROUND))[0]
    pieces = split_tracks(sightings(clips(exchanged(seen, [50])), "a"))
    assert len(pieces) == 2
    assert pieces.number[0, 0] == pieces.number[149, 1] and pieces.number[0, 1] == pieces.number[149, 0]
    assert pieces.conflicts.tolist() == [[False, True], [True, False]]


def test_pieces_end_where_two_bodies_are_one():
    rng = np.random.default_rng(0)
    body = filmed(crossing(np.random.default_rng(3)), cameras(AROUND), 61, noise=0.0)[0][:1, 0]
    way = np.linspace(-150, 150, 61)[:, None, None] * [1.0, 0.0]
    both = np.stack([body + way, body - way], axis=1) + rng.standard_normal((61, 2, len(NAMES), 2))
    pieces = split_tracks(sightings(clips(both), "a"))
    assert len(pieces) > 2
    first, last = pieces.number[0], pieces.number[-1]
    assert not set(first.tolist()) & set(last.tolist())
    for piece in range(len(pieces)):  # before and after they meet, a piece is one of both
        rows, tracks = np.nonzero(pieces.number == piece)
        far = np.abs(rows - 30) > 3
        assert len(set(tracks[far].tolist())) <= 1 or len({row > 30 for row in rows[far]}) == 1


def test_clusters_are_nearly_always_the_best_of_all(monkeypatch):
    every = [[0]]
    for _ in range(6):  # all labelings up to the names of the groups
        every = [[*one, k] for one in every for k in range(max(one) + 2)]
    best_of_all = 0
    for seed in range(12):
        rng = np.random.default_rng(seed)
        scores, conflicts = np.triu(rng.standard_normal((7, 7)) * 3, 1), np.triu(rng.uniform(size=(7, 7)) < 0.3, 1)
        conflicts |= conflicts.T
        same = [np.equal.outer(one, one) for one in (cluster(scores + scores.T, conflicts, np.arange(7.0)), *every)]
        mine, *others = [scores[one].sum() for one in same if not (conflicts & one).any()]
        assert not (conflicts & same[0]).any()
        best_of_all += mine > max(others) - 1e-9
    assert best_of_all >= 9
    assert cluster(np.zeros((0, 0)), np.zeros((0, 0), dtype=bool), np.zeros(0)).shape == (0,)
    assert sorted(cluster(np.full((3, 3), -1.0), np.zeros((3, 3), dtype=bool), np.arange(3.0)).tolist()) == [0, 1, 2]
    monkeypatch.setattr(tracklets, "MAX_SWEEPS", 1)
    # 0, 1 then 2, 3: the pieces of both moments were put together the wrong way round
    scores = np.zeros((4, 4))
    for p, q, s in ((0, 2, -2.0), (1, 3, -2.0), (0, 3, 2.0), (1, 2, 2.0)):
        scores[p, q] = scores[q, p] = s
    conflicts = np.zeros((4, 4), dtype=bool)
    conflicts[0, 1] = conflicts[1, 0] = conflicts[2, 3] = conflicts[3, 2] = True
    labels = cluster(scores, conflicts, np.array([0.0, 0.0, 1.0, 1.0]))
    assert labels[0] == labels[3] != labels[1] == labels[2]

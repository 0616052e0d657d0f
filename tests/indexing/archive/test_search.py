"""Searching: the same movement from other cameras, against looking at every window exactly; and what cannot be searched."""

import numpy as np
import pytest

from indexing import Archive, ArchiveOptions, Clip
from indexing.actors import ACTIONS, Person, detect, perform, stream
from indexing.archive.search import MAX_OVERLAP, MIN_SEPARATION, Places, _separate, check_example, queries_of, residuals
from indexing.skeleton import Skeleton

FINGERS = tuple(f"finger {i}a" for i in range(17))


def filmed(points, azimuth, seed, name=""):
    return detect(points, azimuth=azimuth, rng=seed).replace(name=name)


@pytest.fixture(scope="module")
def streams():
    """Five people, each doing eight actions in a row."""
    rng = np.random.default_rng(0)
    return [stream(rng.choice(ACTIONS, 8).tolist(), Person.random(seed), rng=seed) for seed in range(5)]


@pytest.fixture(scope="module")
def archive(streams, tmp_path_factory):
    found = Archive(tmp_path_factory.mktemp("searched") / "lab")
    found.add([filmed(points, 70.0, seed, f"stream {seed}") for seed, (points, _) in enumerate(streams)])
    return found


def shows(hit, streams):
    """The action that lasts during most of a hit, if one does."""
    _, intervals = streams[int(hit.source.rpartition(" ")[2])]
    shared = {label: min(hit.end, end) - max(hit.start, start) for label, start, end in intervals}
    label = max(shared, key=shared.get)
    return label if shared[label] > 0.5 * (hit.end - hit.start) else None


@pytest.mark.slow
def test_the_same_action_from_elsewhere(archive, streams):
    for azimuth in (0.0, 90.0, 200.0):
        right = moment = 0
        for seed, (points, intervals) in enumerate(streams):
            for label, start, end in intervals[:4]:
                hits = archive.search(filmed(points, azimuth, 50 + seed).between(start, end), k=3)
                right += shows(hits[0], streams) == label
                middles = [(hit.start + hit.end) / 2 for hit in hits if hit.source == f"stream {seed}"]
                moment += any(abs(middle - (start + end) / 2) < 0.25 * (end - start) for middle in middles)
        assert right >= 14 and moment >= 14, azimuth  # of 20


def rolled(clip, degrees):
    c, s = np.cos(np.deg2rad(degrees)), np.sin(np.deg2rad(degrees))
    return clip.replace(joints=clip.joints @ np.array([[c, s], [-s, c]]))


@pytest.mark.slow
def test_a_camera_may_be_rolled(archive, streams):
    points, intervals = streams[1]
    for degrees in (30.0, 90.0):
        clip = rolled(filmed(points, 0.0, 9), degrees)
        hits = [archive.search(clip.between(a, b), k=1)[0] for _, a, b in intervals[:4]]
        assert sum(hit.source == "stream 1" for hit in hits) >= 3, degrees


@pytest.mark.slow
def test_joints_may_be_missing(archive, streams):
    points, intervals = streams[2]
    clip = filmed(points, 20.0, 9)
    joints = clip.joints.copy()
    joints[:, 13:] = np.nan  # legs out of view
    found = [archive.search(clip.replace(joints=joints).between(a, b), k=3) for _, a, b in intervals[:4]]
    assert sum(any(hit.source == "stream 2" for hit in hits) for hits in found) >= 3


def test_hits_are_those_of_looking_at_everything(archive, streams):
    """All windows on the grid of stored poses by the exact residual: the best one is the first hit."""
    points, intervals = streams[3]
    _, start, end = intervals[2]
    clip = filmed(points, 130.0, 9).between(start, end)
    snapshot = archive._open_snapshot()
    asked = check_example(clip, 0.5)
    query = queries_of(asked, snapshot.contents)[1]
    metric = snapshot.contents.layouts[1].joint_metric()
    best, where = -np.inf, (0, 0.0)
    for number, segment in enumerate(snapshot.segments):
        for track, rows in enumerate(segment.tracks[:, 3].tolist()):
            begin = np.arange(0, (rows - 1) / 15 - asked.duration, 1 / 15)
            places = Places(np.full(len(begin), number), np.full(len(begin), track), begin, begin + asked.duration)
            if len(begin):
                every = residuals(query.windows, np.zeros(len(begin), int), places, snapshot.segments, metric)
                if -every.min() > best:
                    best, where = -every.min(), (int(segment.tracks[track, 0]), segment.starts[track] + begin[every.argmin()])
    hit = archive.search(clip, k=1)[0]
    assert hit.source == archive.recordings()[where[0] - 1].source
    assert abs(hit.start - where[1]) < 0.15 * asked.duration and hit.score >= best - 0.6


def test_hits_are_distinct_in_order_and_no_more_than_candidates(archive, streams):
    points, intervals = streams[0]
    clip = filmed(points, 0.0, 5).between(*intervals[0][1:])
    assert len(Archive(archive.path, ArchiveOptions(num_candidates=3)).search(clip, k=40)) <= 3
    hits = archive.search(clip, k=40)
    scores = [hit.score for hit in hits]
    assert len(hits) == 40 and scores == sorted(scores, reverse=True)
    for i, one in enumerate(hits):
        assert one.start < one.end
        for other in hits[:i]:
            shared = min(one.end, other.end) - max(one.start, other.start)
            if one.source == other.source:
                assert shared < MAX_OVERLAP * min(one.end - one.start, other.end - other.start) + 1e-6


def test_other_tempos_are_found(tmp_path):
    person, slow = Person.random(1), Person.random(2)
    kick = perform("kick", person, rng=1)
    archive = Archive(tmp_path / "a")
    stretched = filmed(kick, 90.0, 3, "slow kick")
    others = [filmed(perform(action, slow, rng=4), 90.0, 4, action) for action in ("squat", "wave", "bow", "throw")]
    archive.add([stretched.replace(times=stretched.times * 1.25, fps=None), *others])
    hit = archive.search(filmed(kick, 0.0, 5), k=1)[0]
    assert hit.source == "slow kick"
    assert hit.end - hit.start == pytest.approx(1.25 * kick.duration, rel=0.05)


def test_the_mirror_image_where_it_is_asked_for(tmp_path):
    left, right = (perform("kick", Person.random(1), rng=3), perform("throw", Person.random(2), rng=3))
    archive = Archive(tmp_path / "a")
    archive.add([filmed(left, 60.0, 1, "kick"), filmed(right, 60.0, 1, "throw")])
    clip = filmed(left, 0.0, 2)
    swap = [0, 2, 1, 4, 3, 6, 5, 8, 7, 10, 9, 12, 11, 14, 13, 16, 15]
    mirrored = clip.replace(joints=clip.joints[:, swap] * [-1.0, 1.0], confidence=None)
    (plain,), (hit,) = archive.search(mirrored, k=1), archive.search(mirrored, k=1, mirror=True)
    assert (hit.source, hit.mirrored) == ("kick", True) and not plain.mirrored
    assert hit.score > plain.score + 1.0


def test_movement_in_3d_is_searched_and_found(tmp_path):
    people = [Person.random(seed) for seed in range(3)]
    clips = [perform(action, people[0], rng=1).replace(name=action) for action in ("kick", "squat", "wave", "bow")]
    archive = Archive(tmp_path / "a")
    archive.add(clips)
    assert archive.search(filmed(perform("squat", people[0], rng=1), 30.0, 2), k=1)[0].source == "squat"
    assert archive.search(perform("wave", people[0], rng=1), k=1)[0].source == "wave"
    hits = archive.search(filmed(perform("bow", people[0], rng=1), 30.0, 2), k=10)
    assert len({(hit.source, round(hit.start, 1)) for hit in hits}) == len(hits)  # one hit for both images


def test_what_cannot_be_searched(archive, streams):
    clip = filmed(streams[0][0], 0.0, 5)
    for query, message in (
        (clip.between(1.0, 1.3), "the shortest window lasts 0.5 s"),
        (clip.replace(joints=np.full_like(clip.joints, np.nan)), "nobody is in view"),
        (clip.replace(times=clip.times * 50), "an example 30 s at most"),
        (Clip(clip.joints[:60, :9], fps=30.0), "too few in common"),
        (clip.replace(joints=np.ones_like(clip.joints)), "at one place"),
        (clip.between(1, 3).replace(skeleton=Skeleton("hand", FINGERS)), "too few in common"),
    ):
        with pytest.raises(ValueError, match=message):
            archive.search(query)
    for k in (0, -1, 2.5, True, "3"):
        with pytest.raises(ValueError, match="k must be a whole number"):
            archive.search(clip.between(1.0, 2.0), k=k)


def test_candidates_keep_their_distance_from_all_that_are_better():
    rng = np.random.default_rng(0)
    middle, half, person = rng.uniform(0, 20, 400), rng.choice([0.4, 1.0, 1.3], 400), rng.integers(0, 3, 400)
    order, kept = rng.permutation(400), []
    for i in order:
        reach = 2 * MIN_SEPARATION * np.minimum(half[i], half[kept])
        if all((np.abs(middle[i] - middle[kept]) > reach) | (person[i] != person[kept])):
            kept.append(i)
    assert len(kept) < 350
    assert [_separate(middle, half, order, person, count).tolist() for count in (30, 400)] == [kept[:30], kept]

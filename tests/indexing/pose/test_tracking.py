"""Tracks to people: who goes on, by time and place, whatever the order of the work."""

from __future__ import annotations

from itertools import count

import numpy as np
import pytest

from indexing.pose import tracking as room
from indexing.pose.tracking import Sightings, concatenate, identities, largest, windows
from tests.grid import grid

BODY = np.array([[0.0, 0.0], [20.0, 30.0], [10.0, 80.0]])


def tracks(*some, frames=60, fps=10.0):
    """Sightings of tracks, each (first frame, last frame, x of the first, step, size)."""
    rows = []
    for number, (first, last, x, step, size) in enumerate(some):
        rows += [(frame, number, size * BODY + [x + step * (frame - first), 0]) for frame in range(first, last + 1)]
    rows.sort(key=lambda row: row[0])
    at, track, joints = (np.array([row[k] for row in rows]) for k in range(3))
    return Sightings(np.arange(frames) / fps, at, track, joints, np.ones(joints.shape[:2]))


def groups(seen, **how):
    return [sorted({int(seen.tracks[row]) for row in rows}) for rows in identities(seen, **how)]


def test_a_track_goes_on_where_another_ended_soon_and_nearby():
    assert groups(tracks((0, 20, 0, 0, 1), (25, 59, 8, 0, 1))) == [[0, 1]]
    assert groups(tracks((0, 20, 0, 0, 1), (50, 59, 8, 0, 1))) == [[0], [1]]  # three seconds later
    assert groups(tracks((0, 20, 0, 0, 1), (22, 59, 90, 0, 1))) == [[1], [0]]  # two bodies away
    assert groups(tracks((0, 20, 0, 0, 1), (50, 59, 8, 0, 1)), max_absence=5.0) == [[0, 1]]
    assert groups(tracks((0, 40, 0, 0, 1), (30, 59, 5, 0, 1))) == [[0], [1]]  # both there at once
    cut = tracks((0, 29, 0, 0, 1), (0, 29, 30, 0, 1.1), (30, 59, 31, 0, 1.1), (30, 59, 1, 0, 1))
    assert groups(cut) == [[1, 2], [0, 3]]  # everybody goes on with the nearest, the largest over time first
    assert groups(tracks((0, 59, 0, 0, 1), (0, 9, 300, 0, 2))) == [[0], [1]]
    assert groups(tracks((0, 59, 0, 0, 1), (0, 39, 300, 0, 2))) == [[1], [0]]


def test_one_sighting_a_frame_is_of_the_largest_who_is_there():
    seen = tracks((0, 59, 0, 0, 1), (20, 39, 300, 0, 3))
    rows = largest(seen, identities(seen))
    assert seen.at[rows].tolist() == list(range(60))
    assert seen.tracks[rows].tolist() == [0] * 20 + [1] * 20 + [0] * 20


def test_parts_joined_keep_their_tracks_apart_and_nobody_is_nobody():
    one, other = tracks((0, 3, 0, 0, 1), frames=4), tracks((1, 2, 0, 0, 1), (2, 3, 90, 0, 1), frames=4)
    both = concatenate([one, other])
    assert both.at.tolist() == [0, 1, 2, 3, 5, 6, 6, 7] and len(both.times) == 8
    assert both.tracks.tolist() == [0, 0, 0, 0, 1, *other.tracks[1:] + 1]
    nobody = Sightings(np.arange(3.0), *(np.zeros(0, dtype=np.int64),) * 2, np.zeros((0, 3, 2)), np.zeros((0, 3)))
    assert identities(nobody) == [] and largest(nobody, []).tolist() == []
    assert concatenate([nobody, nobody]).times.tolist() == [0, 1, 2, 0, 1, 2]


def every_pair(seen: Sightings, max_absence: float) -> list[list[int]]:
    """The same as identities(), with a look at everybody who ever was."""
    rows = [np.flatnonzero(seen.tracks == track) for track in np.unique(seen.tracks)]
    left = sorted((room._stretch(seen, one) for one in rows), key=lambda one: (one.begin, -one.size))
    owners: list[list[room._Stretch]] = []
    for moment in sorted({one.begin for one in left}):
        fresh = [one for one in left if one.begin == moment]
        pairs = sorted(
            (room._association_cost(owner[-1], one, max_absence), i, j)
            for i, owner in enumerate(owners)
            for j, one in enumerate(fresh)
        )
        taken: dict[int, int] = {}
        for far, i, j in pairs:
            if far <= 1 and i not in taken.values() and j not in taken:
                taken[j] = i
        for j, one in enumerate(fresh):
            if j in taken:
                owners[taken[j]].append(one)
            else:
                owners.append([one])
    people = [np.sort(np.concatenate([one.rows for one in owner])) for owner in owners]
    areas = [float((np.ptp(seen.joints[one], axis=1)).prod(axis=1).sum()) for one in people]
    return [people[k].tolist() for k in sorted(range(len(people)), key=lambda k: (-areas[k], people[k][0]))]


@grid(("seed", range(60)))
def test_who_may_return_is_found_as_among_everybody(seed):
    rng = np.random.default_rng(seed)
    first = rng.integers(0, 50, rng.integers(1, 25))
    some = [
        (int(a), int(min(59, a + rng.integers(0, 12))), float(rng.integers(0, 6)) * 20, 0, float(rng.integers(1, 3))) for a in first
    ]
    seen, max_absence = tracks(*some), float(rng.choice([0.1, 0.5, 2.0]))
    assert [rows.tolist() for rows in identities(seen, max_absence)] == every_pair(seen, max_absence)


@pytest.mark.slow
def test_thousands_of_tracks_are_not_compared_with_each_other(monkeypatch):
    number, looks = 20_000, count(1)
    apart = room._association_cost

    def counted(*what):
        assert next(looks) < 40 * number
        return apart(*what)

    monkeypatch.setattr(room, "_association_cost", counted)
    at = np.arange(number)
    seen = Sightings(3.0 * at, at, at, np.tile(BODY, (number, 1, 1)), np.ones((number, len(BODY))))
    assert len(identities(seen)) == number


@grid((("width", "height", "shrink"), [(1920, 1080, 1), (1920, 1080, 2), (1080, 1920, 3), (640, 640, 2)]))
def test_windows_cover_a_picture_and_overlap(width, height, shrink):
    side = max(width, height) / shrink
    found = windows(width, height, side)
    covered = np.zeros((height // 20, width // 20), dtype=int)
    y, x = np.mgrid[: height // 20, : width // 20] * 20 + 10
    for one in found:
        covered += (abs(x - one.x) <= side / 2) & (abs(y - one.y) <= side / 2)
    assert covered.min() >= 1 and len(found) == (1 if shrink == 1 else len(found))
    steps = np.diff(sorted({one.x for one in found}))
    assert (steps <= side / 2 + 1e-6).all()

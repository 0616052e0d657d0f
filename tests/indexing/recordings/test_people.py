"""Which tracks of a recording are people, what they are called, and who comes, goes and changes places."""

from __future__ import annotations

import numpy as np
import pytest

from indexing.clip import Clip
from indexing.recordings.people import Appearance, Exchange, of_recording, tracked_people

BOX = np.array([[0.0, 0.0], [40.0, 0.0], [40.0, 90.0], [0.0, 90.0]])
FPS = 30.0


def track(spans, person, *, place=100.0, size=1.0, by="position", joints=4, still=False):
    """A person who is seen in some spans of seconds, and slowly walks; by ids, one clip from the first to the last."""
    first, last = round(spans[0][0] * FPS), round(spans[-1][1] * FPS)
    frames = np.arange(first, last + 1)
    walk = np.zeros(len(frames)) if still else 0.1 * frames
    poses = size * BOX + np.stack([place + walk, np.zeros(len(frames))], axis=1)[:, None]
    away = ~np.any([(frames >= round(a * FPS)) & (frames <= round(b * FPS)) for a, b in spans], axis=0)
    poses[away] = np.nan
    poses[:, joints:] = np.nan
    return Clip(poses, times=frames / FPS, meta={"person": person, "followed": by})


def names(crowd):
    return [person.name for person in crowd.people]


# ---- names -------------------------------------------------------------------------------------------------------------
def test_people_are_numbered_by_size_then_by_their_first_appearance():
    small, big, later = track([(0, 6)], 0, size=0.5), track([(0, 6)], 1, place=400), track([(1, 6)], 2, place=900, size=0.5)
    crowd = tracked_people([later, small, big], "take.json")
    assert names(crowd) == ["1", "2", "3"]
    assert [person.clip.meta["person"] for person in crowd.people] == [1, 0, 2]
    assert [person.clip.name for person in crowd.people] == ["take.json#1", "take.json#2", "take.json#3"]
    assert not crowd.by_ids and not crowd.ghosts and not crowd.absences
    # the ids of the file are the names; one person has none, a ghost beside him or not
    crowd = tracked_people([track([(0, 6)], 7, by="ids"), track([(0, 6)], "coach", place=400, size=2.0, by="ids")])
    assert names(crowd) == ["coach", "7"] and crowd.by_ids
    alone = track([(0, 6)], None)
    for tracks in ([alone], [alone, track([(2, 2.2)], 1, place=900)]):
        (person,) = tracked_people(tracks, "take.json").people
        assert person.name == "" and person.clip.name == "take.json"
        np.testing.assert_array_equal(person.clip.joints, alone.joints)


def test_clips_of_a_set_are_no_people_of_one_recording():
    assert of_recording([track([(0, 1)], 1)])
    assert not of_recording([track([(0, 1)], 1).replace(meta={"person": 1})]) and not of_recording([])


# ---- ghosts ------------------------------------------------------------------------------------------------------------
def test_ghosts_are_left_out_and_counted_by_reason():
    real = [track([(0, 6)], 0), track([(0, 6)], 1, place=500)]
    one = track([(1, 3)], 5, place=1500)
    spot = one.replace(joints=np.full_like(one.joints, 7.0))
    crowd = tracked_people(
        [*real, track([(2, 2.3)], 2, place=900), track([(3, 3.2)], 3, place=50), track([(1, 4)], 4, joints=2), spot]
    )
    assert len(crowd.people) == 2
    assert crowd.ghosts == {"too short": 2, "too few joints": 1, "at one place": 1}
    flickers = [track([(t, t + 0.1)], i, place=500.0 * i, by="ids") for i, t in enumerate((0, 3, 6, 9))]
    crowd = tracked_people(flickers)
    assert crowd.people == () and crowd.ghosts == {"too short": 4} and crowd.appearances == ()


def test_who_is_seen_long_enough_is_a_person():
    """Half a second at a time, unless all are shorter or less is asked for; of one or two joints, each."""
    stays, point = track([(0, 6)], 0, by="ids"), track([(0, 3)], 1)
    for spans, options, people in (
        ([(2, 2.4)], {}, 1), ([(2, 2.6)], {}, 2), ([(1, 1.05), (5, 5.05)], {}, 1), ([(2, 2.3)], {"min_seconds": 0.2}, 2),
    ):  # fmt: skip
        assert len(tracked_people([stays, track(spans, 1, place=900, by="ids")], **options).people) == people, spans
    assert len(tracked_people([track([(0, 0.1)], 0), track([(0, 0.1)], 1, place=500)]).people) == 2
    for joints in (1, 2):
        clip = point.replace(joints=point.joints[:, :joints])
        assert len(tracked_people([clip, clip.replace(joints=clip.joints + 500)]).people) == 2


# ---- coming and going ----------------------------------------------------------------------------------------------------
def test_by_position_whoever_returns_is_another_person_and_that_is_said():
    stays, leaves = track([(0, 60)], 0, place=2000), track([(0, 38.0), (41.2, 60)], 1)
    crowd = tracked_people([stays, leaves])
    assert names(crowd) == ["1", "2", "3"]
    assert [round(person.clip.times[0], 2) for person in crowd.people] == [0.0, 0.0, 41.2]
    assert crowd.appearances == (Appearance("3", pytest.approx(41.2), "2", pytest.approx(38.0), True),)
    assert crowd.absences == ()


def test_by_ids_whoever_returns_is_the_same_and_that_is_said():
    stays, leaves = track([(0, 60)], 1, place=2000, by="ids"), track([(0, 38.0), (41.2, 60)], 2, by="ids")
    crowd = tracked_people([stays, leaves])
    assert names(crowd) == ["1", "2"] and crowd.appearances == ()
    (away,) = crowd.absences
    assert (away.person, round(away.start, 2), round(away.end, 2)) == ("2", 38.0, 41.2)


def test_who_appears_elsewhere_may_be_the_same_or_not():
    stays = track([(0, 20)], 1, place=5000, by="ids")
    crowd = tracked_people([stays, track([(0, 8)], 2, by="ids"), track([(9, 20)], 3, place=1500, by="ids")])
    assert crowd.appearances == (Appearance("3", 9.0, "2", 8.0, False),)
    # who comes while all others stay is nobody who left
    assert tracked_people([track([(0, 20)], 1), track([(5, 20)], 2, place=900)]).appearances == ()


def test_never_two_in_view_and_no_ids_is_one_lane_whose_pauses_are_said():
    first, second = track([(0, 10)], 0), track([(14, 20)], 1, place=900)
    crowd = tracked_people([first, second])
    (person,) = crowd.people
    assert person.name == "" and len(person.clip) == len(first) + len(second)
    assert [(round(gap.start, 2), round(gap.end, 2)) for gap in crowd.absences] == [(10.0, 14.0)]
    by_ids = [clip.replace(meta={"person": 4 + i, "followed": "ids"}) for i, clip in enumerate((first, second))]
    assert names(tracked_people(by_ids)) == ["4", "5"]
    whole = track([(0, 20)], None)
    keep = (whole.times < 5) | (whole.times > 9)  # a pause of the recording is no absence
    assert tracked_people([whole.replace(joints=whole.joints[keep], times=whole.times[keep])]).absences == ()


# ---- ids that swap -------------------------------------------------------------------------------------------------------
def test_ids_that_swap_are_said_and_left_as_they_are():
    a, b = track([(0, 10)], 1, by="ids"), track([(0, 10)], 2, place=800, by="ids")
    joints = [a.joints.copy(), b.joints.copy()]
    joints[0][150:], joints[1][150:] = b.joints[150:], a.joints[150:]
    swapped = [clip.replace(joints=places) for clip, places in zip((a, b), joints, strict=True)]
    crowd = tracked_people(swapped)
    assert crowd.exchanges == (Exchange("1", "2", pytest.approx(5.0)),)
    np.testing.assert_array_equal(crowd.people[0].clip.joints, joints[0])
    # who passes another does not swap, nor who is found elsewhere
    way, away = np.linspace(0, 700, len(a))[:, None, None] * [1.0, 0.0], a.joints.copy()
    away[150:] += 3000
    for others in ([a.replace(joints=a.joints + way), b.replace(joints=b.joints - way)], [a.replace(joints=away), b]):
        assert tracked_people(others).exchanges == ()


# ---- nobody --------------------------------------------------------------------------------------------------------------

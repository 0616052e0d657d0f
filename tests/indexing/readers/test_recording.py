"""Who is followed where a frame shows several people."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from indexing.readers import read, read_clip, recording
from indexing.readers.recording import link_by_position
from tests.grid import grid

Write = Callable[..., Path]
FRAMES = 8
WAITING = recording.MAX_WAITING


def walk(x: float, size: float, step: float = 0.0, confidence: float = 0.8) -> np.ndarray:
    """``(8, 4, 3)``: a square of four joints that moves to the right."""
    square = np.array([[0, 0], [size, 0], [size, size], [0, size]], dtype=float)
    xy = square + [x, 100.0] + np.arange(FRAMES)[:, None, None] * [step, 0.0]
    return np.concatenate([xy, np.full((FRAMES, 4, 1), confidence)], axis=2)


BIG, SMALL = walk(100, 60, confidence=0.6), walk(400, 40, confidence=0.9)


def shuffled(*people: np.ndarray) -> dict[int, list[np.ndarray]]:
    """All people in every frame, in changing order."""
    return {i: [people[(k + i) % len(people)][i] for k in range(len(people))] for i in range(FRAMES)}


def corner(clip_joints: np.ndarray) -> list[float]:
    return clip_joints[:, 0, 0].tolist()


def test_the_order_of_people_in_the_file_does_not_matter(openpose_folder: Write) -> None:
    folder = openpose_folder(shuffled(BIG, SMALL))
    for rule, who in (("largest", BIG), ("confident", SMALL), ("tracked", BIG)):
        np.testing.assert_array_equal(read_clip(folder, person=rule).joints, who[..., :2])
    with pytest.raises(ValueError, match=r"take: person='all' needs tracked people, but it has no person ids; run a tracker"):
        read(folder, person="all")


def test_largest_does_not_hop_when_another_is_larger_for_a_moment(openpose_folder: Write) -> None:
    crouching = BIG.copy()
    crouching[3:5, 2:, 1] -= 50  # flat for two frames: smaller than the other person
    clip = read_clip(openpose_folder(shuffled(crouching, SMALL)))
    np.testing.assert_array_equal(clip.joints, crouching[..., :2])


@grid(("ids", [True, False]))
def test_where_the_person_is_absent_largest_goes_on_and_tracked_waits(openpose_folder: Write, ids: bool) -> None:
    frames = {i: [SMALL[i], BIG[i]] if i not in (3, 4) else [SMALL[i]] for i in range(FRAMES)}
    names = {i: [9, 2][: len(people)] for i, people in frames.items()} if ids else None
    folder = openpose_folder(frames, f"{ids}", ids=names)
    largest = read_clip(folder, person="largest")
    assert corner(largest.joints)[2:6] == [100, 400, 400, 100]
    tracked = read_clip(folder, person="tracked")
    # by ids, the one seen in most frames; by position, the larger, and frames without it are empty
    assert tracked.seen.any(axis=1).tolist() == ([True] * 8 if ids else [i not in (3, 4) for i in range(8)])
    assert np.nanmax(tracked.joints[:, 0, 0]) == (400 if ids else 100)


def test_people_who_cross_keep_their_identity(openpose_folder: Write) -> None:
    left, right = walk(100, 60, step=20), walk(240, 50, step=-20)
    clip = read_clip(openpose_folder(shuffled(left, right)), person="tracked")
    np.testing.assert_array_equal(clip.joints, left[..., :2])


def test_broken_tracks_of_one_person_join(openpose_folder: Write) -> None:
    frames = {i: [BIG[i]] for i in range(FRAMES)}
    folder = openpose_folder(frames, ids={i: [1 if i < 4 else 5] for i in range(FRAMES)})
    assert read_clip(folder).seen.all()
    assert read_clip(folder, person="confident").seen.all()
    assert read_clip(folder, person="tracked").seen.any(axis=1).sum() == 4


def test_all_gives_one_clip_per_id_that_spans_what_was_seen(openpose_folder: Write) -> None:
    frames = {i: [BIG[i]] + ([SMALL[i]] if i in (2, 3, 5) else []) for i in range(FRAMES)}
    clips = read(openpose_folder(frames, ids={i: [3, 7][: len(people)] for i, people in frames.items()}), person="all", fps=10.0)
    assert [clip.name for clip in clips] == ["take#3", "take#7"]
    assert clips.column("person").tolist() == [3, 7]
    assert [len(clip) for clip in clips] == [8, 4]
    assert clips[1].times.tolist() == [0.2, 0.3, 0.4, 0.5]
    assert clips[1].seen.any(axis=1).tolist() == [True, True, False, True]


def test_ids_that_repeat_in_a_frame_are_no_identities(openpose_folder: Write) -> None:
    folder = openpose_folder(shuffled(BIG, SMALL), ids={i: [0, 0] for i in range(FRAMES)})
    np.testing.assert_array_equal(read_clip(folder).joints, BIG[..., :2])
    with pytest.raises(ValueError, match=r"take: .*ids repeat in frame 0; run a tracker"):
        read(folder, person="all")


def test_people_without_an_id_stand_in(openpose_folder: Write) -> None:
    frames = shuffled(SMALL)
    frames[4] = [BIG[4]]
    folder = openpose_folder(frames, ids={i: [-1 if i == 4 else 6] for i in range(FRAMES)})
    assert corner(read_clip(folder).joints)[3:6] == [400, 100, 400]
    assert not read_clip(folder, person="tracked").seen[4].any()
    assert len(read(folder, person="all")) == 1


def test_confident_needs_confidences(write_json: Write) -> None:
    two = [{"class": 0, "box": {}, "keypoints": {"x": p[0, :, 0].tolist(), "y": p[0, :, 1].tolist()}} for p in (BIG, SMALL)]
    with pytest.raises(ValueError, match=r"take\.json: has no confidences, so person='confident' .*use person='largest'"):
        read(write_json([two]), person="confident")


BOX = np.array([[0.0, 0.0], [10.0, 20.0]])


def test_link_waits_for_people_and_does_not_reach_too_far(monkeypatch: pytest.MonkeyPatch) -> None:
    at, joints = np.array([0, 0, 1, 4, 4]), np.stack([BOX, BOX + 100, BOX + 1, BOX + 101, BOX + 300])
    assert link_by_position(at, joints).tolist() == [0, 1, 0, 1, 2]
    at, joints = np.arange(3), np.stack([BOX, BOX + 5, BOX + 10])
    assert link_by_position(at, joints).tolist() == [0, 0, 0]
    monkeypatch.setattr(recording, "MAX_STEP_DIAGONALS", 0.1)
    assert link_by_position(at, joints).tolist() == [0, 1, 2]


def test_link_compares_only_joints_that_both_show() -> None:
    full = np.array([[0.0, 0.0], [10.0, 20.0], [5.0, 40.0]])
    half = full.copy()
    half[2] = np.nan
    other = half + np.array([11.0, 0.0])
    assert link_by_position(np.array([0, 1, 1]), np.stack([full, other, half])).tolist() == [0, 1, 0]
    hidden = np.full_like(full, np.nan)
    hidden[2] = full[2]
    assert link_by_position(np.array([0, 1]), np.stack([half, hidden])).tolist() == [0, 1]


@grid(("seed", range(5)))
def test_identities_do_not_depend_on_the_order_within_frames(seed: int) -> None:
    rng = np.random.default_rng(seed)
    people = rng.uniform(0, 2000, size=(5, 1, 1, 2)) + rng.normal(scale=40, size=(5, 1, 6, 2)) + rng.normal(size=(5, 20, 6, 2))
    at = np.repeat(np.arange(20), 5)
    joints = people.transpose(1, 0, 2, 3).reshape(100, 6, 2)
    order = np.concatenate([5 * i + rng.permutation(5) for i in range(20)])
    ids = link_by_position(at, joints[order])
    truth = np.tile(np.arange(5), 20)[order]
    assert len(set(zip(ids.tolist(), truth.tolist(), strict=True))) == len(set(ids.tolist())) == 5


def test_strangers_in_every_frame_are_compared_with_the_latest_only(monkeypatch: pytest.MonkeyPatch) -> None:
    compared: list[int] = []
    distances = recording._distances

    def counted(awaited: np.ndarray, found: np.ndarray, size: np.ndarray) -> np.ndarray:
        compared.append(len(awaited) * len(found))
        return distances(awaited, found, size)

    monkeypatch.setattr(recording, "_distances", counted)
    at = np.repeat(np.arange(4 * WAITING), 2)
    joints = BOX + 1000.0 * np.arange(len(at))[:, None, None]
    assert link_by_position(at, joints).tolist() == list(range(len(at)))
    assert max(compared) == 2 * WAITING and sum(compared) <= len(at) * WAITING


def test_who_was_seen_lately_is_waited_for_however_many_come_and_go() -> None:
    frames = 3 * WAITING
    strangers = BOX + 1000.0 * np.arange(1, frames + 1)[:, None, None]
    at = np.concatenate([np.arange(frames), np.arange(0, frames, WAITING // 2)])
    ids = link_by_position(at, np.concatenate([strangers, np.repeat(BOX[None], 6, axis=0)]))
    assert len(set(ids[frames:].tolist())) == 1 and len(set(ids.tolist())) == frames + 1


def test_a_crowd_larger_than_what_is_waited_for_is_followed() -> None:
    crowd = BOX + 100.0 * np.arange(WAITING + 40)[:, None, None]
    ids = link_by_position(np.repeat(np.arange(3), len(crowd)), np.concatenate([crowd, crowd + 1, crowd[::-1] + 2]))
    first, second, third = ids.reshape(3, -1)
    assert (first == second).all() and (first == third[::-1]).all()


def test_everyone_says_how_people_are_followed(openpose_folder: Write) -> None:
    both = shuffled(BIG, SMALL)
    by_place = read(openpose_folder(both), person="everyone")
    assert [clip.meta for clip in by_place] == [{"person": 0, "followed": "position"}, {"person": 1, "followed": "position"}]
    ids = {i: [9, -1] for i in range(FRAMES)}
    (one,) = read(openpose_folder(both, "ids", ids=ids), person="everyone")
    assert one.meta == {"person": 9, "followed": "ids", "untracked": FRAMES}


def test_one_person_far_apart_between_frames_is_the_whole_recording(openpose_folder: Write) -> None:
    frames = {i: [walk(500.0 * i, 60)[i]] if i not in (0, 3) else [] for i in range(FRAMES)}
    folder = openpose_folder(frames)
    (alone,) = read(folder, person="everyone")
    for rule in ("largest", "tracked"):
        clip = read_clip(folder, person=rule)
        np.testing.assert_array_equal(alone.joints, clip.joints)
        assert alone.name == clip.name
    assert alone.meta == {"person": None, "followed": "position"}


def test_a_person_s_clip_keeps_no_frames_of_long_absences(openpose_folder: Write, monkeypatch: pytest.MonkeyPatch) -> None:
    frames = {i: [BIG[i % FRAMES]] + [SMALL[0]] * (i in (5, 7, 60)) for i in range(70)}
    folder = openpose_folder(frames, ids={i: [1, 2][: len(people)] for i, people in frames.items()})
    clips = read(folder, person="all", fps=10.0)
    assert [len(clip) for clip in clips] == [70, 4]
    assert clips[1].times.tolist() == [0.5, 0.6, 0.7, 6.0]
    monkeypatch.setattr(recording, "MAX_ABSENCE_SECONDS", 10.0)
    kept = read(folder, person="all", fps=10.0)
    assert len(kept[1]) == 56

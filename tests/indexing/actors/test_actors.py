"""Synthetic actors: bodies keep their bones, joints bend as people's do, and the detector errs as much as it is told to."""

import numpy as np
import pytest

from indexing.actors import ACTIONS, Person, dataset, detect, perform, stream
from indexing.actors.perform import interpolate
from indexing.cameras import virtual
from indexing.skeleton import COCO17
from tests.grid import grid

AT = {name: i for i, name in enumerate(COCO17.joints)}
RIGID = [bone for bone in COCO17.bones if set(bone) not in ({5, 11}, {6, 12})]  # the waist turns: shoulder to hip is no bone
FLYING = ("run", "jumping_jack")
PEOPLE = [Person(), *(Person.random(seed) for seed in range(5))]


@pytest.fixture(scope="module")
def clips():
    return [(person, perform(action, person, rng=7)) for person in PEOPLE for action in ACTIONS]


def limb(joints, *names):
    return (joints[:, AT[name]] for name in names)


def bend(joints, side, names):
    """Sine-weighted bend of a limb about the axis from the right hip to the left one: > 0 where the last segment swings back."""
    a, b, c = limb(joints, *(f"{side}_{name}" for name in names))
    left, right = limb(joints, "left_hip", "right_hip")
    return (np.cross(b - a, c - b) * (left - right)).sum(axis=1) / np.linalg.norm(left - right, axis=1)


def test_clips_are_labelled_of_natural_length_and_move_as_bodies_do(clips):
    for _, clip in clips:
        assert clip.label in ACTIONS and clip.joints.shape[1:] == (17, 3) and clip.skeleton == COCO17 and clip.up == "y"
        assert np.isfinite(clip.joints).all()
        assert 1.2 < clip.duration < 5.0
        for a, b in RIGID:
            assert np.ptp(np.linalg.norm(clip.joints[:, a] - clip.joints[:, b], axis=1)) < 1e-9
        spine = np.linalg.norm(clip.joints[:, 5:7].mean(axis=1) - clip.joints[:, 11:13].mean(axis=1), axis=1)
        assert np.ptp(spine) < 1e-9
        lowest = clip.joints[:, 15:17, 1].min(axis=1)  # the floor, except in flight
        assert np.abs(lowest).max() < 1e-9 or (clip.label in FLYING and lowest.min() > -1e-9 and 0.03 < lowest.max() < 0.25)
        assert clip.joints[..., 1].min() > -0.05  # no hand or knee through the floor
        if clip.label not in ("walk", "run", "jumping_jack"):  # standing feet do not slide
            assert np.ptp(clip.joints[:, 15:17][..., [0, 2]], axis=0).max(axis=1).min() < 0.06
        for side in ("left", "right"):
            assert bend(clip.joints, side, ("hip", "knee", "ankle")).min() > -1e-3
            if clip.label in ("walk", "run", "bow", "squat"):  # the arms keep near the sagittal plane
                assert bend(clip.joints, side, ("shoulder", "elbow", "wrist")).max() < 1e-3
    assert {clip.label for _, clip in clips if clip.joints[:, 15:17, 1].min(axis=1).max() > 0.03} == set(FLYING)


def test_each_action_does_what_it_is_called():
    person = Person()
    joints = {action: perform(action, person).joints for action in ACTIONS}
    height = {action: at[..., 1] for action, at in joints.items()}
    hips = {action: at[:, 11:13].mean(axis=1) for action, at in joints.items()}
    assert hips["squat"][:, 1].min() < 0.6 * hips["squat"][0, 1]
    assert np.ptp(height["squat"][[0, -1], 0]) < 0.05
    assert hips["sit_down"][-1, 1] < 0.65 * hips["sit_down"][0, 1] < 0.7 * hips["stand_up"][-1, 1]
    assert height["wave"][:, AT["right_wrist"]].max() > height["wave"][0, AT["nose"]] > height["wave"][:, AT["left_wrist"]].max()
    assert height["jumping_jack"][:, [AT["left_wrist"], AT["right_wrist"]]].min(axis=1).max() > height["jumping_jack"][0, 0]
    assert height["kick"][:, AT["right_ankle"]].max() > 0.7 > 0.2 > height["kick"][:, AT["left_ankle"]].max()
    assert height["bow"][:, 0].min() < 1.25
    assert height["bow"][:, 11].min() > 0.9 * height["bow"][0, 11]
    stride = joints["lunge"][:, AT["left_ankle"], 2] - joints["lunge"][:, AT["right_ankle"], 2]
    assert stride.max() > 0.7  # the right foot lands ahead, towards -z
    assert height["pick_up"][:, AT["right_wrist"]].min() < 0.25


def test_arms_swing_against_the_legs_and_left_handers_are_mirrored():
    for action in ("walk", "run"):
        forward = -perform(action, Person()).joints[..., 2]
        legs = forward[:, AT["left_ankle"]] - forward[:, AT["right_ankle"]]
        arms = forward[:, AT["left_wrist"]] - forward[:, AT["right_wrist"]]
        assert np.corrcoef(legs, arms)[0, 1] < -0.8
    right, left = (perform("punch", Person(handed=handed, sway=0.0)).joints for handed in (1, -1))
    twin = [0, *(j for i in range(1, 17, 2) for j in (i + 1, i))]
    np.testing.assert_allclose(left, right[:, twin] * [-1, 1, 1], atol=1e-9)


def test_the_data_are_right_handed_and_the_picture_is_a_photograph():
    clip = perform("bow", Person(), rng=None)
    first = clip.joints[0]
    left = first[AT["left_shoulder"]] - first[AT["right_shoulder"]]
    forward = first[AT["nose"]] - first[[AT["left_ear"], AT["right_ear"]]].mean(axis=0)
    assert np.cross([0.0, 1.0, 0.0], forward) @ left > 0  # up x forward = left
    front = detect(clip, azimuth=0.0, noise=0.0, dropout=0.0, outliers=0.0)
    pixels = front.joints[0]
    assert pixels[AT["left_shoulder"], 0] > pixels[AT["right_shoulder"], 0]
    assert pixels[AT["nose"], 1] < pixels[AT["left_ankle"], 1]
    assert front.up == "-y"
    assert (front.confidence[0] > 0.5).all()


def test_detector_and_virtual_camera_are_the_same_camera():
    clip = perform("throw", Person(), rng=3)
    seen = detect(clip, azimuth=70.0, elevation=-0.2, noise=0.0, dropout=0.0, outliers=0.0, image=(4000, 4000))
    height = float(np.median(np.ptp(clip.joints[..., 1], axis=1)))
    same = virtual(clip, 70.0, -0.2, height=height)
    pixels = (seen.joints - 2000.0) * [-1, -1] * 4.5 / (0.72 * 4000)
    np.testing.assert_allclose(pixels, same.joints, atol=1e-9)


def test_same_seed_same_data_other_seed_other_data():
    person = Person.random(4)
    assert person == Person.random(4) != Person.random(5)
    np.testing.assert_array_equal(perform("walk", person).joints, perform("walk", person).joints)
    for make in (
        lambda seed: perform("walk", person, rng=seed).joints,
        lambda seed: stream(["bow"], person, rng=seed)[0].joints,
        lambda seed: detect(perform("bow", person), azimuth=20.0, rng=seed).joints,
        lambda seed: dataset(1, ["kick"], rng=seed)[0].joints,
    ):
        np.testing.assert_array_equal(make(1), make(1))
        assert make(1).shape != make(2).shape or not np.array_equal(make(1), make(2), equal_nan=True)


def test_stream_truth_is_ordered_and_inside():
    actions = ["walk", "sit_down", "stand_up", "kick", "sit_down", "run", "stand_up"]
    clip, truth = stream(actions, PEOPLE[2], rng=3, rest=(0.5, 0.9))
    assert [label for label, _, _ in truth] == actions
    borders = np.array([time for _, start, end in truth for time in (start, end)])
    assert (np.diff(borders) > 0.45).all()
    assert borders[0] > 0.45 and borders[-1] < clip.times[-1] - 0.45
    assert np.ptp(borders.reshape(-1, 2), axis=1).min() > 1.0
    assert clip.label is None
    speed = np.abs(np.diff(clip.joints, axis=0)).max() * 30
    assert speed < 10.0  # no jump where actions meet rests
    low = clip.between(truth[1][2], truth[2][1]).joints[:, 11:13, 1]
    assert low.max() < 0.62  # seated between sit_down and stand_up
    clip, truth = stream(["jumping_jack", "run"], Person(), rng=0, rest=(1.0, 1.0))
    rest = clip.between(truth[0][2] + 0.05, truth[1][1] - 0.05).joints  # is quiet
    assert np.abs(np.diff(rest, axis=0)).max() * 30 < 0.3


@grid(("dropout", [0.0, 0.05, 0.3]))
def test_dropout_is_about_as_asked_and_only_nan(dropout):
    clips = [detect(perform(action, Person(), rng=1), azimuth=60.0, rng=i, dropout=dropout) for i, action in enumerate(ACTIONS)]
    lost = np.concatenate([~clip.seen.ravel() for clip in clips])
    assert abs(lost.mean() - dropout) < 0.02 + 0.15 * dropout
    for clip in clips:
        assert not np.isinf(clip.joints).any()
        assert ((clip.confidence >= 0) & (clip.confidence <= 1)).all()
        assert (clip.confidence[~clip.seen] == 0).all()


def test_noise_and_outliers_are_about_as_asked():
    clip, _ = stream(list(ACTIONS), Person(), rng=1)
    clean = detect(clip, azimuth=20.0, noise=0.0, dropout=0.0, outliers=0.0).joints
    noisy = detect(clip, azimuth=20.0, noise=0.012, dropout=0.0, outliers=0.0).joints
    metres = (noisy - clean) / (0.72 * 1280 / 4.5)
    assert 0.011 < metres.std() < 0.018  # hidden joints have more
    correlation = np.corrcoef(metres[:-1].ravel(), metres[1:].ravel())[0, 1]
    assert 0.4 < correlation < 0.7
    wrong = detect(clip, azimuth=20.0, noise=0.0, dropout=0.0, outliers=0.04).joints
    share = (np.linalg.norm(wrong - clean, axis=2) > 0).mean()
    assert 0.03 < share < 0.05
    # hidden joints are trusted less
    clip = perform("walk", Person())
    side = detect(clip, azimuth=90.0, dropout=0.0, outliers=0.0).confidence.mean(axis=0)
    back = detect(clip, azimuth=180.0, dropout=0.0, outliers=0.0).confidence.mean(axis=0)
    far, near = ("left", "right") if side[AT["left_ear"]] < side[AT["right_ear"]] else ("right", "left")
    assert side[AT[f"{near}_hip"]] > side[AT[f"{far}_hip"]] + 0.2
    assert back[AT["nose"]] < 0.6 < back[AT["left_shoulder"]]


def test_dataset_films_one_execution_with_all_cameras():
    clips = dataset(2, ("squat", "wave"), azimuth=(0, 90), takes=2, rng=3, noise=0.0, dropout=0.0, outliers=0.0)
    assert len(clips) == 16
    assert sorted(set(clips.labels)) == ["squat", "wave"]
    pair = clips.select(subject=1, take=0)[:2]
    assert len(pair[0]) == len(pair[1])
    assert {clip.meta["azimuth"] for clip in pair} == {0.0, 90.0}
    solid = dataset([Person()], ("bow",), azimuth=None)
    assert solid[0].dims == 3


def test_actions_are_not_told_apart_by_their_duration():
    clips = dataset(6, azimuth=None, rng=2)
    durations = np.array([clip.duration for clip in clips])
    subject = clips.column("subject")
    nearest = np.abs(durations[subject >= 3][:, None] - durations[subject < 3]).argmin(axis=1)
    assert (clips.labels[subject < 3][nearest] == clips.labels[subject >= 3]).mean() < 0.35


def test_interpolation_keeps_between_its_keys():
    rng = np.random.default_rng(0)
    times, values = np.cumsum(rng.uniform(0.1, 0.5, 9)), rng.normal(size=(9, 3))
    at = np.linspace(times[0], times[-1], 500)
    curve = interpolate(times, values, at)
    i = np.clip(np.searchsorted(times, at, side="right") - 1, 0, 7)
    assert (curve >= np.minimum(values[i], values[i + 1]) - 1e-12).all()
    assert (curve <= np.maximum(values[i], values[i + 1]) + 1e-12).all()
    np.testing.assert_allclose(interpolate(times, values, times), values, atol=1e-12)


def test_misuse_says_what_to_do():
    for call, message in (
        (lambda: perform("fly", Person()), "unknown action 'fly'.*walk, run, squat"),
        (lambda: stream(["walk", "fly"], Person()), "unknown action 'fly'"),
        (lambda: perform("walk", Person(), fps=0.0), "fps"),
        (lambda: perform("walk", Person(), repeats=0), "repeats"),
        (lambda: stream(["walk"], Person(), rest=(2.0, 1.0)), "rest"),
        (lambda: Person(height=-1.0), "positive"),
        (lambda: Person(handed=0), "handed"),
        (lambda: Person(style=(1.0,)), "style"),
        (lambda: detect(perform("bow", Person()), azimuth=0.0, dropout=1.0), "dropout"),
        (lambda: detect(perform("bow", Person()), azimuth=0.0, noise=-1.0), "noise"),
        (lambda: detect(perform("bow", Person()), azimuth=0.0, distance=0.3), "distance"),
        (lambda: detect(detect(perform("bow", Person()), azimuth=0.0), azimuth=0.0), "17 COCO joints"),
    ):
        with pytest.raises(ValueError, match=message):
            call()

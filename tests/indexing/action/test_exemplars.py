"""Mirror images: which joints change places, and which actions are still themselves in the mirror."""

import numpy as np
import pytest
import torch

from indexing import ActionIndexer
from indexing.action.bank import mirror
from indexing.action.exemplars import mirror_permutation, permutation_from_layouts, permutation_from_names, turn
from indexing.actors import Person, dataset
from indexing.skeleton import BODY25, COCO17, HALPE26, MEDIAPIPE33, OPENPOSE18, Skeleton

COCO = [0, 2, 1, 4, 3, 6, 5, 8, 7, 10, 9, 12, 11, 14, 13, 16, 15]


SIDES = (
    ("left_knee", "right_knee"), ("LeftKnee", "RightKnee"), ("LEFT KNEE", "RIGHT KNEE"), ("kneeLeft", "kneeRight"),
    ("lfemur", "rfemur"), ("lfoot", "rfoot"), ("LKnee", "RKnee"), ("lKnee", "rKnee"), ("L_knee", "R_knee"),
    ("l.knee", "r.knee"), ("knee.l", "knee.r"), ("knee_R", "knee_L"), ("hand_l", "hand_r"), ("hand-L", "hand-R"),
    ("mouth_left", "mouth_right"), ("L Knee", "R Knee"), ("lowerleg_l", "lowerleg_r"), ("upper_arm.L", "upper_arm.R"),
)  # fmt: skip
WITHOUT_SIDES = (
    ("nose", "neck"), ("left_knee", "nose"), ("1", "2", "3"), ("lower", "roof"), ("root", "lumbar", "thorax"), ("leftover", "rim"),
)  # fmt: skip


def test_sides_in_names():
    for left, right in SIDES:
        assert permutation_from_names(("nose", left, "thorax", right)).tolist() == [0, 3, 2, 1], left
    for names in WITHOUT_SIDES:
        assert permutation_from_names(names) is None, names
    for skeleton in (COCO17, BODY25, HALPE26, MEDIAPIPE33, OPENPOSE18):
        swap = permutation_from_names(skeleton.joints)
        assert torch.equal(swap[swap], torch.arange(len(swap))), skeleton.name
        for i, j in enumerate(swap.tolist()):
            mirrored = skeleton.joints[i].replace("left", "@").replace("right", "left").replace("@", "right")
            assert skeleton.joints[j] == mirrored
    odd = Skeleton("odd", ("left_a", "right_a", *(f"x{i}" for i in range(15))))
    assert mirror_permutation(odd, torch.zeros(1, 4, 17, 2)).tolist() == [1, 0, *range(2, 17)]  # names come before data


@pytest.mark.slow
def test_layouts_are_recognized_without_names(windows_of, lesson):
    for azimuth in (0.0, 45.0, 90.0):
        assert permutation_from_layouts(windows_of(dataset(3, azimuth=azimuth, rng=4)).values).tolist() == COCO, azimuth
    windows = windows_of(lesson).values
    order = torch.randperm(17, generator=torch.Generator().manual_seed(3))
    assert permutation_from_layouts(windows[:, :, order]) is None
    assert permutation_from_layouts(windows[:, :, :11]) is None
    for every in (13, 2):  # clips in which a joint is never seen
        clips = [clip.replace(skeleton=None) for clip in lesson]
        for i in range(0, 13, every):
            joints = clips[i].joints.copy()
            joints[:, 9] = np.nan
            clips[i] = clips[i].replace(joints=joints)
        model = ActionIndexer(scorer="nearest").fit(clips, lesson.labels).model_
        assert model.symmetry is not None and model.symmetry.tolist() == COCO


def test_mirrored_and_turned_cards():
    x, swap = torch.randn(2, 8, 6, 2), torch.tensor([0, 2, 1, 3, 5, 4])
    once = mirror(x, swap)
    assert torch.equal(mirror(once, swap), x)
    torch.testing.assert_close(once[:, :, 1], x[:, :, 2] * torch.tensor([-1.0, 1.0]))
    centred = x - x.mean(dim=(1, 2), keepdim=True)
    turned = turn(x, np.array([np.pi / 3, np.pi]), np.zeros(2))
    torch.testing.assert_close(turned[..., 1], centred[..., 1], atol=1e-5, rtol=0)  # keeps its heights, and is squeezed
    torch.testing.assert_close(turned[..., 0], centred[..., 0] * torch.tensor([0.5, -1.0])[:, None, None], atol=1e-5, rtol=0)


def sides(actions, people, azimuth, rng):
    """Every action once as it is and once mirrored, as 2D clips about x = 0."""
    right, left = [], []
    for clip in dataset(people, actions, azimuth=azimuth, rng=rng, image=(1280, 720)):
        joints = clip.joints - [640.0, 0.0]
        right.append(clip.replace(joints=joints, label=f"right {clip.label}"))
        left.append(clip.replace(joints=mirror(torch.from_numpy(joints)[None], torch.tensor(COCO))[0], label=f"left {clip.label}"))
    return right, left


def test_left_and_right_as_different_actions_are_not_mirrored():
    people = [Person.random(1)]
    right, left = sides(["punch", "kick"], people, 0.0, 1)
    ordinary = [clip.replace(joints=clip.joints - [640.0, 0.0]) for clip in dataset(people, ["wave", "squat"], azimuth=0.0, rng=1)]
    clips = [*right, *left, *ordinary]
    indexer = ActionIndexer().fit(clips)
    told = {clip.label: bool(flag) for clip, flag in zip(clips, indexer.model_.mirrored, strict=True)}
    assert told == {
        "right punch": False, "right kick": False, "left punch": False, "left kick": False, "wave": True, "squat": True,
    }  # fmt: skip
    other_right, other_left = sides(["punch", "kick"], [Person.random(7)], 30.0, 5)
    assert indexer.score([*other_right, *other_left], [clip.label for clip in [*other_right, *other_left]]) == 1.0


def test_one_sided_actions_are_found_on_the_other_side():
    actions = ["punch", "kick", "wave", "throw"]
    right, _ = sides(actions, [Person.random(1)], 0.0, 1)
    _, left = sides(actions, [Person.random(7), Person.random(8)], 0.0, 2)
    labels = [clip.label.replace("left", "right") for clip in left]
    free = ActionIndexer(scorer="nearest").fit(right)
    assert free.model_.mirrored.all()
    assert free.score(left, labels) == 1.0
    bound = ActionIndexer(scorer="nearest", mirror=False).fit(right)
    assert bound.model_.symmetry is None and not bound.model_.mirrored.any()
    assert bound.score(left, labels) < free.score(left, labels)


def test_everything_is_mirrored_where_it_is_asked_for_and_nothing_where_sides_are_not_known(lesson, random_clip):
    model = ActionIndexer(scorer="nearest", mirror=True).fit(lesson).model_
    assert model.symmetry is not None and model.mirrored.all()
    clips = [random_clip(seed=s, label="ab"[s % 2]) for s in range(4)]
    indexer = ActionIndexer().fit(clips)
    assert indexer.model_.symmetry is None and indexer.predict(clips).tolist() == list("abab")

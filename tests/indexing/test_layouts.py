"""Joint layouts against the forward kinematics and against the mirror symmetries known of each format."""

import numpy as np
import pytest
import torch

from indexing.actors import Person, perform
from indexing.actors.body import LANDMARKS, SIZES, joints, landmarks, limited
from indexing.actors.layouts import LAYOUTS, agree, layout_map
from indexing.shape.symmetry import _LAYOUTS, from_names
from indexing.skeleton import BODY25, COCO17


@pytest.fixture(scope="module")
def poses():
    rng = np.random.default_rng(0)
    return limited(rng.normal(scale=40.0, size=(50, 27)))


@pytest.mark.parametrize("name", LAYOUTS)
def test_every_format_is_a_map_of_the_landmarks_with_its_known_symmetry(name):
    weights = layout_map(LAYOUTS[name])
    assert weights.shape == (len(LAYOUTS[name]), len(LANDMARKS))
    assert np.allclose(weights.sum(axis=1), 1.0)  # moving the body moves the joints
    swap = from_names(LAYOUTS[name])
    tables = [torch.arange(len(swap)) for _ in _LAYOUTS[len(swap)]]
    for table, pairs in zip(tables, _LAYOUTS[len(swap)], strict=True):
        for i, j in pairs:
            table[i], table[j] = j, i
    assert sum(torch.equal(swap, table) for table in tables) == 1
    sides = torch.from_numpy(layout_map(LANDMARKS)[from_names(LANDMARKS)])
    assert np.allclose(weights[swap.numpy()], weights @ sides.numpy())  # the mirror image of a joint is that joint's


def test_coco_is_the_first_landmarks_and_the_rest_lies_between():
    person = Person.random(3)
    clip = perform("squat", person)
    poses = limited(np.random.default_rng(1).normal(scale=40.0, size=(20, 27)))
    points = landmarks(poses, np.array([getattr(person, size) for size in SIZES]))
    assert clip.joints.shape[1] == 17
    apart = points[:, :17] - joints(poses, person)
    assert np.abs(apart - apart[:, :1]).max() < 1e-12  # but for where the body stands
    body = layout_map(BODY25.joints) @ points
    assert np.allclose(body[:, 8], (points[:, 11] + points[:, 12]) / 2)
    assert np.allclose(body[:, 1], (points[:, 5] + points[:, 6]) / 2)


def test_hands_and_feet_are_rigid_and_feet_point_ahead(poses):
    sizes = np.array([1.7, 1.0, 1.0, 1.0, 1.0, 1.0])
    at = {name: i for i, name in enumerate(LANDMARKS)}
    points = landmarks(poses, sizes)
    for side in ("left", "right"):
        hand, wrist, elbow = (points[:, at[f"{side}_{part}"]] for part in ("hand", "wrist", "elbow"))
        assert np.allclose(np.cross(hand - wrist, wrist - elbow), 0.0, atol=1e-12)
        length = np.linalg.norm(points[:, at[f"{side}_toes"]] - points[:, at[f"{side}_heel"]], axis=1)
        assert np.allclose(length, 0.16 * 1.7)
    standing = landmarks(np.zeros((1, 27)), sizes)[0]
    assert standing[at["left_toes"], 2] < standing[at["left_ankle"], 2] < standing[at["left_heel"], 2]  # faces -z
    assert standing[at["left_toes"], 1] < standing[at["left_ankle"], 1]
    assert standing[at["left_hand"], 0] < 0 < standing[at["right_hand"], 0]


def test_every_pose_may_be_another_persons(poses):
    people = [Person.random(seed) for seed in range(len(poses))]
    sizes = np.array([[getattr(person, size) for size in SIZES] for person in people])
    together = landmarks(poses, sizes)
    alone = np.stack([landmarks(poses[i : i + 1], sizes[i])[0] for i in range(len(poses))])
    assert np.array_equal(together, alone)


def test_names_in_other_spellings():
    plain = layout_map(("left_shoulder", "right_knee", "kinect_hip_centre", "left_hand"))
    assert np.array_equal(plain[:2], layout_map(("ShoulderLeft", "knee.r"))[:2])
    assert np.array_equal(layout_map(("l_hip", "mid_hip")), layout_map(("LeftHip", "pelvis")))
    assert layout_map(("left_hip", "tail")) is None
    assert layout_map(()) is None


def test_names_may_fit_a_format_but_not_with_the_sides_exchanged():
    exchanged = tuple(name.replace("left", "x").replace("right", "left").replace("x", "right") for name in COCO17.joints)
    assert agree(LAYOUTS["COCO-17"], COCO17.joints)
    assert agree(LAYOUTS["COCO-17"], tuple(str(i) for i in range(17)))
    assert not agree(LAYOUTS["COCO-17"], exchanged)
    assert agree(LAYOUTS["Kinect-20"], tuple(name.replace("kinect_", "") for name in LAYOUTS["Kinect-20"]))
    assert not agree(LAYOUTS["Kinect-20"], LAYOUTS["COCO-17"])

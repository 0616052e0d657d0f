"""Random people: bodies stay bodies, feet stay on the floor, cameras are pinholes, and the seed decides everything."""

import numpy as np
import pytest

from indexing.actors import random_poses
from indexing.actors.body import LANDMARKS
from indexing.actors.random_poses import random_actors, random_views
from indexing.cameras import rotation

AT = {name: i for i, name in enumerate(LANDMARKS)}
BONES = [
    (f"{side}_{a}", f"{side}_{b}")
    for side in ("left", "right")
    for a, b in (("hip", "knee"), ("knee", "ankle"), ("elbow", "wrist"))
]


@pytest.fixture(scope="module")
def actors():
    return random_actors(300, 10, np.random.default_rng(0))


def test_bones_keep_their_length_and_differ_between_people(actors):
    for a, b in BONES:
        length = np.linalg.norm(actors[:, :, AT[a]] - actors[:, :, AT[b]], axis=2)
        assert np.ptp(length, axis=1).max() < 1e-9
        assert 0.05 < length[:, 0].std() / length.mean() < 0.25


def test_feet_stand_on_the_floor_and_the_body_moves_over_them(actors):
    ankles = actors[:, :, [AT["left_ankle"], AT["right_ankle"]]]
    assert np.abs(ankles[..., 1].min(axis=2)).max() < 1e-9
    path = np.ptp(ankles.mean(axis=2)[..., [0, 2]], axis=1).max(axis=1)
    assert 0.6 < np.mean(path < 1e-9) < 0.9  # the others walk


def test_most_stand_some_sit_and_arms_hang_more_often_than_not(actors):
    hips, knees = (actors[:, :, AT[f"left_{name}"], 1] for name in ("hip", "knee"))
    assert 0.05 < np.mean((hips - knees) < 0.25) < 0.35
    hanging = actors[:, :, AT["left_wrist"], 1] < actors[:, :, AT["left_elbow"], 1]
    assert 0.5 < hanging.mean() < 0.9


def test_cameras_are_pinholes_at_the_distances_asked_for(monkeypatch):
    monkeypatch.setattr(random_poses, "OFFSET", 0.0)
    views = random_views(5, 10, np.eye(len(LANDMARKS)), 3)
    distances = np.linspace(2.5, 8.0, 1101)[:, None, None, None]
    a, b = ([AT[bone[end]] for bone in BONES] for end in (0, 1))
    for image, depth in zip(views.image, views.depth, strict=True):
        flat = image[None] * ((depth + distances[..., 0]) / distances[..., 0])[..., None]
        points = np.concatenate([flat, np.broadcast_to(depth[..., None], (*flat.shape[:3], 1))], axis=3)
        lengths = np.linalg.norm(points[:, :, a] - points[:, :, b], axis=3)
        assert lengths.std(axis=1).max(axis=1).min() < 1e-3  # at the true distance bones keep their length
    assert np.abs(views.depth.mean(axis=(1, 2))).max() < 1e-9


def test_rotations_are_those_of_the_virtual_cameras():
    yaw, tilt = np.array([0.4, -2.0]), np.array([0.1, -0.3])
    assert np.allclose(random_poses._rotations(yaw, tilt), [rotation(0.4, 0.1), rotation(-2.0, -0.3)])


def test_the_seed_decides_everything():
    one, same, other = (random_views(4, 5, np.eye(len(LANDMARKS)), seed).image for seed in (1, 1, 2))
    assert np.array_equal(one, same)
    assert not np.allclose(one, other)

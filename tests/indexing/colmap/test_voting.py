"""The votes over the graph of pairs, on bodies that are made up: who is static is decided by reach, not by numbers."""

from __future__ import annotations

import numpy as np

from indexing.colmap.voting import DividedPair, vote
from tests.grid import grid

IMAGES = 5
WIDE = 64  # points of the scene, one in every cell
MANY = 200  # of a body, in the middle


class World:
    """Points that all images see: the scene, and bodies in few cells."""

    def __init__(self, *places):
        self.body = np.repeat(np.arange(1 + len(places)), [WIDE, *[MANY] * len(places)])
        cells = [np.arange(64), *(np.resize(place, MANY) for place in places)]
        self.count = len(self.body)
        self.cells = np.tile(np.concatenate(cells), IMAGES)
        self.image = np.repeat(np.arange(IMAGES), self.count)

    def pair(self, i, j, *groups):
        """Two images that tell the given groups of things apart."""
        labels = np.zeros(self.count, dtype=np.int64)
        for label, group in enumerate(groups, start=1):
            labels[np.isin(self.body, group)] = label
        ids = np.arange(self.count)
        return DividedPair(i * self.count + ids, j * self.count + ids, labels)

    def voted(self, pairs):
        return vote(pairs, self.cells, self.image)

    def things(self, found):
        """Mean vote on the keypoints of each thing, over the images that have any."""
        known = found.keypoints.reshape(IMAGES, -1)
        known = known[np.abs(known).any(axis=1)]
        return [float(known[:, self.body == k].mean()) for k in range(int(self.body.max()) + 1)]


MIDDLE = [18, 19, 20, 26, 27, 28, 34, 35, 36]
CORNER = [45, 46, 53, 54]
PAIRS = [(i, j) for i in range(IMAGES) for j in range(i + 1, IMAGES)]


@grid(("first", [0, 1]))
def test_the_scene_is_static_though_the_body_has_more_matches(first):
    world = World(MIDDLE)
    found = world.voted([world.pair(i, j, first, 1 - first) for i, j in PAIRS])
    assert all(signs[first] == 1 and signs[1 - first] == -1 for signs in found.signs)
    scene, body = world.things(found)
    assert scene > 0.9 and body < -0.9
    assert found.lead > 2 and not found.open
    assert (found.spread > 0.8).all()


def test_bodies_are_told_apart_whatever_the_order_of_pairs():
    world = World(MIDDLE, CORNER)
    pairs = [world.pair(i, j, (i + j) % 3, (i + j + 1) % 3, (i + j + 2) % 3) for i, j in PAIRS]
    first, second = world.voted(pairs), world.voted(pairs[::-1])
    assert np.allclose(first.keypoints, second.keypoints)
    assert all(np.array_equal(a, b) for a, b in zip(first.signs, second.signs[::-1], strict=True))
    # in every third pair the body moves with the scene, and in another third with a second body
    groups = [((0, 1), 2), (0, (1, 2)), (0, 1, 2)]
    found = world.voted([world.pair(i, j, *groups[k % 3]) for k, (i, j) in enumerate(PAIRS)])
    scene, *bodies = world.things(found)
    assert scene > 0.5 and max(bodies) < -0.2


def test_parts_of_the_scene_and_of_the_graph_are_decided_by_themselves():
    world = World(MIDDLE)
    world.body[:WIDE][np.arange(WIDE) % 8 > 4] = 2  # the right side
    apart = (0, 7)
    found = world.voted(
        [world.pair(i, j, 0, 1, 2) if k in apart else world.pair(i, j, (0, 2), 1) for k, (i, j) in enumerate(PAIRS)]
    )
    left, body, right = world.things(found)
    assert min(left, right) > 0.3 and body < -0.9
    assert all(found.signs[k].tolist() == [1, -1, 1] for k in apart)
    # images 0 to 2 and images 3 and 4 share nothing; the second part has a scene of its own
    world = World(MIDDLE)
    found = world.voted([world.pair(0, 1, 1, 0), world.pair(1, 2, 1, 0), world.pair(3, 4, 0, 1)])
    assert [signs.tolist() for signs in found.signs] == [[-1, 1], [-1, 1], [1, -1]]


def test_two_things_of_equal_reach_are_open():
    world = World(np.arange(64))
    found = world.voted([world.pair(i, j, 0, 1) for i, j in PAIRS])
    assert found.open == tuple(range(IMAGES))
    assert not found.keypoints.any() and found.lead < 1.15


def test_a_single_body_stands_still_pairs_without_bodies_learn_from_the_others_and_nothing_is_nothing():
    world = World()
    found = world.voted([world.pair(i, j, 0) for i, j in PAIRS])
    assert np.isinf(found.lead) and (found.keypoints > 0).all()
    world = World(MIDDLE)
    pairs = [world.pair(i, j, 0, 1) if j < 4 else world.pair(i, j) for i, j in PAIRS]
    known = world.voted(pairs).keypoints.reshape(IMAGES, -1)
    assert (known[:4] != 0).all() and not known[4].any()  # nothing is of a body there
    found = world.voted([world.pair(0, 1)])
    assert not found.keypoints.any() and [len(signs) for signs in found.signs] == [0]

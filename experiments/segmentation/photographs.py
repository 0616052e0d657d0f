"""Photographs of a scene in which bodies move, as COLMAP's database knows them: keypoints and matches, with their truth."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
WIDTH, HEIGHT, FOCAL = 960, 720, 700.0
"""Of the images, pixels."""
POOL = 4000
"""Points of the scene, and of a body nearly as many, of which as many are taken as the matches ask for."""
SEEN = 0.75
"""Probability that a detector finds a point that is in view."""
FAR = 8.0
"""Images apart at which a match is found with probability 1/e."""


@dataclass(frozen=True, eq=False)
class Photographs:
    """Images, and what is true of them.

    Attributes:
        names: of the images.
        centres: ``(images, 3)`` where the camera stood.
        keypoints: ``(n, 2)`` float32 of each image, pixels.
        bodies: ``(n,)`` of each image: 0 stands still, 1.. the moving bodies, -1 a detection of nothing.
        tracks: ``(n,)`` of each image: the point that it is of, -1 none.
        matches: ``(m, 2)`` uint32 rows of keypoints, by pair of images.
    """

    names: tuple[str, ...]
    centres: FloatArray
    keypoints: tuple[NDArray[np.float32], ...]
    bodies: tuple[IntArray, ...]
    tracks: tuple[IntArray, ...]
    matches: dict[tuple[int, int], NDArray[np.uint32]]

    def still(self, first: int, second: int, matches: NDArray[np.integer]) -> NDArray[np.bool_]:
        """``(m,)`` which matches are right and stand still."""
        return self.right(first, second, matches) & (self.bodies[first][matches[:, 0]] == 0)

    def right(self, first: int, second: int, matches: NDArray[np.integer]) -> NDArray[np.bool_]:
        """``(m,)`` which matches are of one point."""
        own, other = self.tracks[first][matches[:, 0]], self.tracks[second][matches[:, 1]]
        return np.asarray((own == other) & (own >= 0))

    @property
    def share(self) -> float:
        """Of the right matches, how many move."""
        right = [(self.right(*pair, rows), self.still(*pair, rows)) for pair, rows in self.matches.items()]
        return 1 - sum(int(still.sum()) for _, still in right) / sum(int(each.sum()) for each, _ in right)


def photographs(
    images: int = 12,
    bodies: int = 1,
    moving: float = 0.6,
    matches: int = 225,
    sigma: float = 0.5,
    wrong: float = 0.1,
    seed: int = 0,
) -> Photographs:
    """A camera on an arc before a scene of walls, ground and things, with boxes that move and turn in front of it.

    Args:
        images: how many, all pairs of which are matched; of those far apart fewer points.
        bodies: how many boxes move; with none, nothing does.
        moving: share of the right matches that are theirs, each of them as many.
        matches: right ones of a pair, on average.
        sigma: noise of a keypoint, pixels.
        wrong: share of the matches that are wrong.
        seed: of all randomness.

    Example:
        >>> scene = photographs(images=3, seed=1)
        >>> len(scene.keypoints), sorted(scene.matches), 0.55 < scene.share < 0.65
        (3, [(0, 1), (0, 2), (1, 2)], True)
    """
    rng = np.random.default_rng(seed)
    times = np.linspace(-1, 1, images)
    centres, turns = _path(times, rng)
    parts = [_Part(*_static(rng)), *(_box(times, number, bodies, rng) for number in range(bodies))]
    body = np.repeat(np.arange(len(parts)), [len(part.points) for part in parts])
    pixels, visible = (np.stack(each) for each in zip(*(_seen(parts, i, centres[i], turns[i]) for i in range(images)), strict=True))
    found = visible & (rng.random(visible.shape) < SEEN)
    pairs = [(i, j) for i in range(images) for j in range(i + 1, images)]
    held = {(i, j): found[i] & found[j] & (rng.random(len(body)) < math.exp(-(j - i) / FAR)) for i, j in pairs}
    each = np.sum(list(held.values()), axis=0)
    there = [max(1, int(each[body == k].sum())) for k in range(len(parts))]
    wanted = matches * len(pairs)
    own = [min(moving / bodies * wanted, held_by) for held_by in there[1:]]  # a box may hardly be in view
    still = sum(own) * (1 - moving) / moving if bodies else wanted
    used = rng.random(len(body)) < np.array([count / held_by for count, held_by in zip([still, *own], there, strict=True)])[body]
    return _photographed(
        pixels, found & used, {pair: there & used for pair, there in held.items()}, body, centres, (sigma, wrong), rng
    )


def _photographed(
    pixels: FloatArray,
    found: NDArray[np.bool_],
    held: dict[tuple[int, int], NDArray[np.bool_]],
    body: IntArray,
    centres: FloatArray,
    errors: tuple[float, float],
    rng: np.random.Generator,
) -> Photographs:
    """Keypoints in any order, with noise and detections of nothing, and the matches, some of them wrong."""
    sigma, wrong = errors
    keypoints, bodies, tracks, rows = [], [], [], np.full(found.shape, -1)
    for i, there in enumerate(found):
        ids = rng.permutation(np.flatnonzero(there))
        nothing = len(ids) // 4
        rows[i, ids] = np.arange(len(ids))
        places = np.concatenate([pixels[i, ids] + rng.normal(0, sigma, (len(ids), 2)), rng.random((nothing, 2)) * [WIDTH, HEIGHT]])
        keypoints.append(places.astype(np.float32))
        bodies.append(np.concatenate([body[ids], np.full(nothing, -1)]))
        tracks.append(np.concatenate([ids, np.full(nothing, -1)]))
    matches = {}
    for (i, j), there in held.items():
        right = np.stack([rows[i, there], rows[j, there]], axis=1)
        count = round(wrong * len(right) / (1 - wrong))
        free = (np.setdiff1d(np.arange(len(keypoints[k])), right[:, side]) for side, k in enumerate((i, j)))
        chosen = [rng.permutation(each)[:count] for each in free]
        least = min(map(len, chosen))
        false = np.stack([each[:least] for each in chosen], axis=1)
        matches[i, j] = rng.permutation(np.concatenate([right, false])).astype(np.uint32)
    names = tuple(f"{i:03d}.png" for i in range(len(found)))
    return Photographs(names, centres, tuple(keypoints), tuple(bodies), tuple(tracks), matches)


# ----------------------------------------------------------------------------------------------------------------------
# The camera, the scene, and the boxes: x to the right, y down, z ahead.


@dataclass(frozen=True, eq=False)
class _Part:
    """The scene or a box: points ``(n, 3)``, their normals, and where they are in every image, None = always there."""

    points: FloatArray
    normals: FloatArray | None = None
    poses: Sequence[tuple[FloatArray, FloatArray]] | None = None


def _path(times: FloatArray, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    """Where the camera stands ``(images, 3)`` and how it is turned ``(images, 3, 3)``, world to camera."""
    sway, forth = (np.sin(rate * times + rng.uniform(0, 6)) for rate in (2, 3))
    centres = np.stack([3.5 * times, 0.4 * sway - 0.5, 1.2 * times**2 + 0.3 * forth], axis=1)
    centres += rng.normal(0, 0.08, centres.shape)
    return centres, np.stack([_towards(np.array([0.0, 0, 11]) + rng.normal(0, 0.3, 3) - centre) for centre in centres])


def _towards(ahead: FloatArray) -> FloatArray:
    """A camera that looks ahead and stands upright."""
    z = ahead / np.linalg.norm(ahead)
    x = np.cross([0.0, 1, 0], z)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z])


def _static(rng: np.random.Generator) -> tuple[FloatArray]:
    """Points on walls, on the ground, and on things between."""
    third = POOL // 3
    low = np.repeat([[-16, -9, 14], [-10, 2.5, 4], [-11, -3, 8]], third, axis=0)
    high = np.repeat([[16, 3, 20], [10, 2.7, 16], [11, 2.5, 14]], third, axis=0)
    return (rng.uniform(low, high),)


def _box(times: FloatArray, number: int, bodies: int, rng: np.random.Generator) -> _Part:
    """A box that moves and turns about its middle: a large one, or several smaller ones side by side."""
    alone = bodies == 1
    size = np.array([4.2, 3.0, 2.5] if alone else [2.2, 2.0, 1.6]) * rng.uniform(0.9, 1.1, 3)
    areas = size.prod() / size
    axis, side = rng.choice(3, POOL, p=areas / areas.sum()), rng.choice([-0.5, 0.5], POOL)
    points, normals = rng.uniform(-0.5, 0.5, (POOL, 3)), np.zeros((POOL, 3))
    points[np.arange(POOL), axis], normals[np.arange(POOL), axis] = side, 2 * side
    place = 0.0 if alone else (number - (bodies - 1) / 2) * 2.6
    middle = np.array([place + rng.uniform(-0.3, 0.3), 0.6, 7.5 if alone else rng.uniform(6.5, 9)])
    way = rng.uniform([0.5, 0.08, 0.5], [1.2, 0.2, 1.0]) * rng.choice([-1, 1], 3)
    turn = np.array([0.1, 1, 0.1]) * rng.choice([-1, 1]) * rng.uniform(0.3, 0.7) + rng.normal(0, 0.05, 3)
    start, sway = _turned(np.array([0, rng.uniform(-0.6, 0.6), 0])), rng.uniform(0, 6)
    poses = [(_turned(turn * t) @ start, middle + way * t + 0.2 * math.sin(3 * t + sway)) for t in times.tolist()]
    return _Part(points * size, normals, poses)


def _turned(vector: FloatArray) -> FloatArray:
    """The rotation about a vector by its length."""
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_rotvec(vector).as_matrix())


def _seen(parts: Sequence[_Part], image: int, centre: FloatArray, turn: FloatArray) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Pixels ``(n, 2)`` of all points, and which are in view: not behind a box, nor on its far side."""
    from scipy.spatial import Delaunay

    pixels, seen, depths, boxes = list[FloatArray](), list[NDArray[np.bool_]](), list[FloatArray](), []
    for part in parts:
        rotation, middle = part.poses[image] if part.poses is not None else (np.eye(3), np.zeros(3))
        world = part.points @ rotation.T + middle
        local = (world - centre) @ turn.T
        places = local[:, :2] / np.maximum(local[:, 2:], 1e-6) * FOCAL + np.array([WIDTH, HEIGHT]) / 2
        there = (local[:, 2] > 1) & (places > 2).all(axis=1) & (places < np.array([WIDTH, HEIGHT]) - 2).all(axis=1)
        if part.normals is not None:
            sight = centre - world
            there &= ((sight * (part.normals @ rotation.T)).sum(axis=1)) > 0.1 * np.linalg.norm(sight, axis=1)
            boxes.append((len(pixels), float(local[:, 2].mean()), Delaunay(places)))
        pixels.append(places)
        seen.append(there)
        depths.append(local[:, 2])
    for own, places in enumerate(pixels):
        for box, depth, hull in boxes:
            if box != own:
                seen[own] &= ~((hull.find_simplex(places) >= 0) & (depths[own] > depth))
    return np.concatenate(pixels), np.concatenate(seen)

"""Which matches of a COLMAP database stand still: its stages in order."""

from __future__ import annotations

import io
from collections.abc import Callable
from concurrent.futures import Executor
from dataclasses import dataclass
from pathlib import Path, PurePosixPath, PureWindowsPath

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from scipy.ndimage import distance_transform_edt
from scipy.spatial import cKDTree

from indexing.archive.workers import InOrder
from indexing.colmap.database import MatchDatabase, PairGeometry, write_database
from indexing.colmap.pair_segmentation import (
    VERIFICATION_DISTANCE,
    PairBodies,
    SeenImage,
    StaticOptions,
    divide,
    left_open,
    prepare_image,
    select_pairs,
    task,
    verify,
)
from indexing.colmap.voting import GRID_CELLS, DividedPair, Votes, vote
from indexing.files import prepare, write_bytes
from indexing.opening import clip_text, count, error, listing

IntArray = NDArray[np.int64]
Told = Callable[[int, int], None]

MIN_PARALLEL_PAIRS = 40  # pairs from which on the command line takes all cores: a process takes as long to start as ten
MIN_ANSWERED_SHARE = 0.5  # of the images with matches, or else all are refused


@dataclass(frozen=True, eq=False)
class StaticPoints:
    """What stands still in the images of a database.

    Attributes:
        database: what was read.
        keypoints: for each image ``(n,)``: 1 stands still, -1 moves, 0 not known.
        bodies: for each pair how it was divided.
        signs: for each pair ``(K,)`` of its bodies: 1 static, -1 moving, 0 undecided.
        kept: for each pair ``(k, 2)`` its static matches.
        geometries: for each pair what COLMAP's estimation makes of them.
        spread: ``(images,)`` in [0, 1] how far static keypoints spread over each image.
        lead: spread of the static body over that of the next one.
        refused: places of the images in which too little stands still.
        reason: why there is no answer; empty where there is.
        notes: what a reader should know, a sentence each.
    """

    database: MatchDatabase
    keypoints: tuple[IntArray, ...]
    bodies: tuple[PairBodies, ...]
    signs: tuple[IntArray, ...]
    kept: tuple[IntArray, ...]
    geometries: tuple[PairGeometry, ...]
    spread: NDArray[np.float64]
    lead: float
    refused: tuple[int, ...]
    reason: str = ""
    notes: tuple[str, ...] = ()

    @property
    def ok(self) -> bool:
        """Whether there is an answer."""
        return not self.reason

    def check(self) -> StaticPoints:
        """Itself.

        Raises:
            ValueError: there is no answer; the message names the images, and says what to do.
        """
        if self.reason:
            raise ValueError(f"{self.database.path}: {self.reason}")
        return self

    def write(self, path: str | Path) -> Path:
        """Write a copy of the database that holds static matches only; see :func:`indexing.colmap.database.write_database`.

        Raises:
            ValueError: there is no answer, or the file is there already or cannot be written.
        """
        self.check()
        pairs = self.database.pairs
        matches = {pair.key: kept for pair, kept in zip(pairs, self.kept, strict=True)}
        geometries = {pair.key: found for pair, found in zip(pairs, self.geometries, strict=True)}
        return write_database(self.database, path, matches, geometries)


def find_static(
    database: MatchDatabase,
    threshold: float | None = 2.5,
    spatial: bool = True,
    seed: int = 0,
    options: StaticOptions | None = None,
    progress: Told | None = None,
    executor: Executor | None = None,
) -> StaticPoints:
    """The matches of a COLMAP database that stand still, by what moves apart in its pairs of images.

    Each pair is divided into bodies by itself (:func:`dyntorch.segment`), bodies of different pairs that share keypoints vote on
    each other, and of the answers that are possible the one is taken whose points spread widest over all images, however many
    matches the others have.  COLMAP's own estimation then verifies what is kept.

    Args:
        database: of :func:`indexing.colmap.read_database`.
        threshold: of :func:`dyntorch.segment`, pixels; None estimates it for each pair.
        spatial: whether bodies are regions of the images.
        seed: of the random samples.
        options: how much of each pair, and what is too little.
        progress: called with how many pairs are divided, and of how many.
        executor: whoever divides pairs, anything with the interface of ``concurrent.futures``; None does it here.

    Raises:
        ValueError: pycolmap is not installed (``pip install 'dyntorch[colmap]'``), or it does not know a camera.
    """
    images = [prepare_image(database, image) for image in database.images]
    options = options or StaticOptions()
    places = select_pairs(database, options)
    bodies = [left_open(pair) for pair in database.pairs]
    tasks = (task(database.pairs[place], images, threshold, spatial, seed, options) for place in places)
    for done, (place, (_, divided)) in enumerate(zip(places, InOrder(divide, executor)(tasks), strict=True)):
        if isinstance(divided, PairBodies):  # a pair that its workers did not survive is left to the votes
            bodies[place] = divided
        if progress is not None:
            progress(done + 1, len(places))
    starts = np.cumsum([0, *(len(image.points) for image in database.images)])
    votes = _vote(database, bodies, starts)
    reach = threshold if threshold is not None else VERIFICATION_DISTANCE
    kept = [_static_matches(database, place, bodies[place], votes, starts, reach) for place in range(len(database.pairs))]
    geometries = [verify(database, pair, rows, images, seed) for pair, rows in zip(database.pairs, kept, strict=True)]
    return _result(database, bodies, votes, kept, geometries, starts, images, options)


def _vote(database: MatchDatabase, bodies: list[PairBodies], starts: IntArray) -> Votes:
    """The votes over the graph of pairs."""
    pairs = [
        DividedPair(starts[pair.first] + pair.matches[:, 0], starts[pair.second] + pair.matches[:, 1], found.labels)
        for pair, found in zip(database.pairs, bodies, strict=True)
    ]
    cells = np.concatenate([_cells(image.points, image.camera.width, image.camera.height) for image in database.images])
    image = np.repeat(np.arange(len(database.images)), np.diff(starts))
    return vote(pairs, cells, image)


def _cells(points: NDArray[np.float64], width: int, height: int) -> IntArray:
    """The cell of the grid that each keypoint is in; those outside of the image are in the nearest."""
    at = np.floor(points / [width, height] * GRID_CELLS).astype(np.int64).clip(0, GRID_CELLS - 1)
    return np.asarray(at[:, 1] * GRID_CELLS + at[:, 0])


def _static_matches(
    database: MatchDatabase, place: int, bodies: PairBodies, votes: Votes, starts: IntArray, reach: float
) -> IntArray:
    """The static matches of a pair."""
    pair, signs = database.pairs[place], votes.signs[place]
    first, second = (votes.keypoints[starts[image] + pair.matches[:, k]] for k, image in enumerate((pair.first, pair.second)))
    moves, stands = np.minimum(first, second) < 0, np.minimum(first, second) > 0
    static = np.flatnonzero(signs > 0)
    if not len(static):
        return pair.matches[stands & ~np.isin(bodies.labels, 1 + np.flatnonzero(signs < 0))]
    near = bodies.distances[static].min(axis=0) <= reach
    mine = np.isin(bodies.labels, 1 + static)
    return pair.matches[(mine & ~moves) | (~mine & stands & near)]


def _result(
    database: MatchDatabase,
    bodies: list[PairBodies],
    votes: Votes,
    kept: list[IntArray],
    geometries: list[PairGeometry],
    starts: IntArray,
    images: list[SeenImage],
    options: StaticOptions,
) -> StaticPoints:
    """All of it, and whether it is an answer."""
    held: list[set[int]] = [set() for _ in images]
    matched: set[int] = set()
    for pair, found in zip(database.pairs, geometries, strict=True):
        matched |= {pair.first, pair.second}
        held[pair.first].update(found.inliers[:, 0].tolist())
        held[pair.second].update(found.inliers[:, 1].tolist())
    refused = tuple(sorted(place for place in matched if len(held[place]) < options.min_static_points))
    names = [image.name for image in database.images]
    few = f"fewer than {options.min_static_points} points stand still in {listing(names[place] for place in refused)}"
    reason, notes = "", []
    if len(matched) - len(refused) < max(2, MIN_ANSWERED_SHARE * len(matched)):
        reason = f"{few}, {len(refused)} of {count(len(matched), 'image')}; add images, or matches of what stands still"
        if len(set(refused) & set(votes.open)) > len(refused) / 2:
            where = listing(names[place] for place in votes.open)
            reason = f"what stands still is open: two bodies spread alike over {where}; add images that show more of the scene"
    elif refused:
        notes.append(f"{few}: COLMAP will leave {'it' if len(refused) == 1 else 'them'} out")
    if not reason and not any((signs < 0).any() for signs in votes.signs):
        notes.append("nothing moves: no pair of images has a second body; what is left out are wrong matches")
    keypoints = np.split(np.sign(votes.keypoints).astype(np.int64), starts[1:-1])
    return StaticPoints(
        database,
        tuple(keypoints),
        tuple(bodies),
        votes.signs,
        tuple(kept),
        tuple(geometries),
        votes.spread,
        votes.lead,
        refused,
        reason,
        tuple(notes),
    )


# ----------------------------------------------------------------------------------------------------------------------
# Masks around what moves, as COLMAP reads them.


Mask = NDArray[np.uint8]
BLACK, WHITE = 0, 255

MIN_DISC_RADIUS = 0.008  # around a moving keypoint, of the diagonal of the image
MAX_DISC_RADIUS = 0.05  # of the diagonal
DISC_RADIUS_FACTOR = 2.0  # over the distance to the third nearest moving keypoint: discs of a body close up
MASK_SIDE = 1024  # pixels of the longer side at which a mask is drawn; then it is enlarged


def mask_name(path: Path, name: str) -> PurePosixPath:
    """Where the mask of an image stands, within the folder of masks."""
    parts = PurePosixPath(name.replace("\\", "/"))
    if parts.is_absolute() or PureWindowsPath(name).drive or ".." in parts.parts or not parts.name or "\0" in name:
        said = f"the name of image {clip_text(repr(name))} leads out of the folder of images"
        raise error(path, said, "extract the features again with --image_path at their folder")
    return parts.with_name(f"{parts.name}.png")


def draw_mask(moving: NDArray[np.float64], static: NDArray[np.float64], size: tuple[int, int]) -> Mask:
    """The mask ``(height, width)`` of one image: 0 around moving keypoints, 255 elsewhere."""
    width, height = size
    if not len(moving):
        return np.full((height, width), WHITE, dtype=np.uint8)
    scale = min(1.0, MASK_SIDE / max(size))
    wide, tall = max(1, round(width * scale)), max(1, round(height * scale))
    to_mask = np.array([wide / width, tall / height])

    def distance(points: NDArray[np.float64]) -> NDArray[np.float64]:
        free = np.ones((tall, wide), dtype=bool)
        at = np.floor(points * to_mask).astype(np.int64).clip(0, [wide - 1, tall - 1])
        free[at[:, 1], at[:, 0]] = False
        return np.asarray(distance_transform_edt(free)) if len(points) else np.full(free.shape, np.inf)

    from_moving = distance(moving)
    black = (from_moving <= _radius(moving, size) * scale) & (from_moving <= distance(static))
    small = np.where(black, BLACK, WHITE).astype(np.uint8)
    rows, columns = (np.arange(full) * part // full for full, part in ((height, tall), (width, wide)))
    return np.ascontiguousarray(small[np.ix_(rows, columns)])


def _radius(moving: NDArray[np.float64], size: tuple[int, int]) -> float:
    """Of the discs, pixels."""
    diagonal = float(np.hypot(*size))
    apart = 0.0
    if len(moving) > 3:
        apart = float(np.median(cKDTree(moving).query(moving, k=4)[0][:, 3]))
    return float(np.clip(DISC_RADIUS_FACTOR * apart, MIN_DISC_RADIUS * diagonal, MAX_DISC_RADIUS * diagonal))


def write_masks(folder: str | Path, found: StaticPoints) -> Path:
    """Write the mask of every image of a database, each whole or not at all."""
    images = found.database.images
    names = [mask_name(found.database.path, image.name) for image in images]
    where = prepare(folder)
    for image, name, kind in zip(images, names, found.keypoints, strict=True):
        size = (image.camera.width, image.camera.height)
        mask = draw_mask(image.points[kind < 0], image.points[kind > 0], size)
        prepare((where / name).parent)
        write_bytes(where / name, gray_png(mask))
    return where


def gray_png(mask: Mask) -> bytes:
    """Gray values ``(height, width)`` as a PNG."""
    stream = io.BytesIO()
    Image.fromarray(mask).save(stream, "PNG")
    return stream.getvalue()

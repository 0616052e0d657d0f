"""Pairs of images of a COLMAP database divided into bodies, and what COLMAP's own estimation makes of those that stand still."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree

import dyntorch as dyn
from indexing.colmap.database import DatabaseImage, DatabasePair, MatchDatabase, PairGeometry
from indexing.opening import clip_text, error

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
INSTALL = "install it with pip install 'dyntorch[colmap]'"

NUM_NEIGHBOURS = 5  # divided matches nearest in both images whose majority another match joins
MIN_VERIFIED_MATCHES = 15  # of a pair: COLMAP's mapper leaves out pairs of fewer
VERIFICATION_DISTANCE = 4.0  # pixels, of COLMAP's verification: COLMAP's default


@dataclass(frozen=True)
class StaticOptions:
    """Options of :func:`indexing.colmap.find_static`: how long a pair may take, and what is too little."""

    min_matches: int = 16
    """Matches of a pair below which it is not divided: two bodies of eight.  Votes of other pairs decide about it."""
    max_matches: int = 1500
    """Matches of a pair that are divided, drawn at random; the others join the bodies of those beside them.  Bounds the time of a
    pair to about a second."""
    pairs_per_image: int = 30
    """Pairs of an image, those with most matches, that are divided; the votes decide about its others."""
    min_static_points: int = 15
    """Static keypoints below which an image is refused by name."""


@dataclass(frozen=True, eq=False)
class PairBodies:
    """A pair, divided."""

    labels: IntArray  # ``(m,)`` 0 = of no body or not divided, 1..K the bodies
    distances: FloatArray  # ``(K, m)`` epipolar (Sampson) distances from each body's motion, pixels
    state: str = ""  # how the division ended, ``"OK"`` or the name of a status; ``""`` where it was left to the votes


def colmap() -> Any:
    """pycolmap."""
    try:
        import pycolmap
    except ImportError as problem:
        raise ValueError(f"COLMAP databases: pycolmap cannot be imported ({problem}); {INSTALL}") from None
    return pycolmap


@dataclass(frozen=True, eq=False)
class SeenImage:
    """An image as both estimations take it: COLMAP's camera, and keypoints ``(n, 2)`` as a camera without lens distortion sees
    them, of the same focal length; NaN where there are none."""

    camera: Any
    points: FloatArray


def prepare_image(database: MatchDatabase, image: DatabaseImage) -> SeenImage:
    known, module = image.camera, colmap()
    who = f"the camera of image {clip_text(image.name)}"
    try:
        camera = module.Camera(
            model=module.CameraModelId(known.model), width=known.width, height=known.height, params=list(known.params)
        )
        camera.has_prior_focal_length = known.prior
        good = camera.verify_params()
    except (RuntimeError, TypeError, ValueError) as problem:
        said = f"{who} is of a model that pycolmap {module.__version__} does not know (number {known.model}: {clip_text(problem)})"
        raise error(database.path, said, "install the newest pycolmap") from None
    if not good:
        said = f"{who} has {len(known.params)} parameters, which are not those of its model"
        raise error(database.path, said, "extract the features again")
    if getattr(camera, "is_spherical", lambda: False)():
        raise error(database.path, f"{who} sees all around, and bodies are told apart in plane images", "cut it into views")
    if camera.is_undistorted() or not len(image.points):
        return SeenImage(camera, image.points)
    middle = np.array([camera.principal_point_x, camera.principal_point_y])
    straight = np.asarray(camera.cam_from_img(image.points), dtype=np.float64)[:, :2] * camera.mean_focal_length() + middle
    # near the edge of a wide lens the inverse of its distortion leads anywhere
    far = np.abs(straight - middle).max(axis=1) > 10 * max(known.width, known.height)
    straight[far] = np.nan
    return SeenImage(camera, straight)


def select_pairs(database: MatchDatabase, options: StaticOptions) -> list[int]:
    """The pairs to divide: of each image those with most matches; places in the list of pairs."""
    order = sorted(range(len(database.pairs)), key=lambda place: -len(database.pairs[place].matches))
    taken, used = [], [0] * len(database.images)
    for place in order:
        pair = database.pairs[place]
        if len(pair.matches) < options.min_matches:
            break
        # a pair is left out only where both of its images have their share
        if min(used[pair.first], used[pair.second]) < options.pairs_per_image:
            taken.append(place)
            used[pair.first] += 1
            used[pair.second] += 1
    return sorted(taken)


def left_open(pair: DatabasePair) -> PairBodies:
    """A pair that is left to the votes of others."""
    return PairBodies(np.zeros(len(pair.matches), dtype=np.int64), np.zeros((0, len(pair.matches))))


@dataclass(frozen=True, eq=False)
class PairTask:
    """A pair to divide: matches ``(m, 2)`` in both images, the rows of those that are divided, arguments of
    :func:`dyntorch.segment`."""

    x1: FloatArray
    x2: FloatArray
    rows: IntArray
    threshold: float | None
    spatial: bool
    seed: int


def task(
    pair: DatabasePair, images: list[SeenImage], threshold: float | None, spatial: bool, seed: int, options: StaticOptions
) -> PairTask:
    """What is to be done about a pair; its random numbers are its own, so that no pair depends on which others there are."""
    x1, x2 = images[pair.first].points[pair.matches[:, 0]], images[pair.second].points[pair.matches[:, 1]]
    draw = np.random.default_rng([seed, pair.first, pair.second])
    rows = np.sort(draw.permutation(len(x1))[: options.max_matches])
    return PairTask(x1, x2, rows, threshold, spatial, int(draw.integers(2**31)))


def divide(task: PairTask) -> PairBodies:
    """The bodies of a pair, by :func:`dyntorch.segment`."""
    x1, x2, rows = torch.from_numpy(task.x1), torch.from_numpy(task.x2), torch.from_numpy(task.rows)
    generator = torch.Generator().manual_seed(task.seed)
    found = dyn.segment(x1[rows], x2[rows], threshold=task.threshold, spatial=task.spatial, generator=generator)
    state, bodies = dyn.Status(int(found.status)).name, int(found.bodies)
    if not bodies:
        return PairBodies(np.zeros(len(x1), dtype=np.int64), np.zeros((0, len(x1))), state)
    distances = dyn.sampson(dyn.FundamentalMatrix, found.fundamentals, *(x.expand(bodies, -1, -1) for x in (x1, x2)))
    labels = torch.zeros(len(x1), dtype=torch.long).index_copy(0, rows, found.labels).numpy()
    return PairBodies(_assign_others(task, labels, distances.numpy(), float(found.threshold)), distances.numpy(), state)


def _assign_others(task: PairTask, labels: IntArray, distances: FloatArray, threshold: float) -> IntArray:
    """The labels with those of the matches that were not divided: of the body of most matches beside them, if its motion agrees."""
    places = np.concatenate([task.x1, task.x2], axis=1)
    rest = np.isfinite(places).all(axis=1) & ~np.isin(np.arange(len(labels)), task.rows)
    known = np.flatnonzero(labels > 0)
    near = min(NUM_NEIGHBOURS, len(known))
    if not rest.any() or not near:
        return labels
    _, found = cKDTree(places[known]).query(places[rest], k=[*range(1, near + 1)])
    beside = labels[known[found]]
    counts = (beside[..., None] == np.arange(1, len(distances) + 1)).sum(axis=1)
    body = counts.argmax(axis=1)
    agrees = (2 * counts.max(axis=1) > near) & (distances[body, np.flatnonzero(rest)] <= threshold)
    labels = labels.copy()
    labels[rest] = np.where(agrees, body + 1, 0)
    return labels


def verify(database: MatchDatabase, pair: DatabasePair, matches: IntArray, images: list[SeenImage], seed: int) -> PairGeometry:
    """What COLMAP's own estimation makes of some matches of a pair, as its matchers would have written it."""
    module = colmap()
    settings = module.TwoViewGeometryOptions()
    settings.min_num_inliers = MIN_VERIFIED_MATCHES
    settings.ransac.max_error = VERIFICATION_DISTANCE
    settings.ransac.random_seed = seed
    none = PairGeometry(int(module.TwoViewGeometryConfiguration.DEGENERATE), np.zeros((0, 2), dtype=np.int64))
    if len(matches) < MIN_VERIFIED_MATCHES:
        return none
    first, second = database.images[pair.first], database.images[pair.second]
    found = module.estimate_two_view_geometry(
        images[pair.first].camera, first.points, images[pair.second].camera, second.points, matches.astype(np.uint32), settings
    )
    inliers = np.asarray(found.inlier_matches, dtype=np.int64).reshape(-1, 2)
    if len(inliers) < MIN_VERIFIED_MATCHES:
        return none
    return PairGeometry(int(found.config), inliers, *(_matrix(getattr(found, name, None)) for name in "FEH"))


def _matrix(values: Any) -> FloatArray | None:
    return None if values is None or not np.any(values) else np.asarray(values, dtype=np.float64)

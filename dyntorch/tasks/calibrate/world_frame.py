r"""The coordinates of the world: up, the ground, and the scale, from bodies that keep their lengths.

A distance between two points has a spread :math:`s_{ab} = q_{.9}\bigl| |X_a - X_b| - \mathrm{med} \bigr| / 1.645`.  Of all pairs
whose :math:`s_{ab}` is a small share of the distance, those of a spanning forest with the least shares tie a body together; people
stand side by side in one set of points and fall apart into trees of their own.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import combinations

import torch
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components, minimum_spanning_tree
from torch import Tensor
from torch.nn.functional import normalize

from dyntorch.tasks.calibrate.input import Scale


def rigid_pairs(points: Tensor, known: Tensor, spread: float) -> tuple[Tensor, Tensor, Tensor]:
    """The pairs of a spanning forest whose distances vary least. points ``(T, n, 3)``, known ``(T, n)`` -> ``(B, 2)``."""
    n = points.shape[1]
    if n < 2:
        return torch.zeros(0, 2, dtype=torch.long), points.new_zeros(0), points.new_zeros(0)
    first, second = torch.tensor(list(combinations(range(n), 2))).unbind(-1)
    both = known[:, first] & known[:, second]
    far = torch.where(both, (points[:, first] - points[:, second]).norm(dim=-1), torch.nan)
    length = far.nanmedian(0).values
    # two people may keep their distance for half of the time: nine tenths of it count
    away = (far - length).abs().nanquantile(0.9, dim=0) / 1.645
    share = (away / length).nan_to_num(torch.inf)
    order = share.argsort(stable=True)
    # ranks: exact data have shares of 0, which would be no edges
    rank = order.argsort()[share <= spread] + 1
    ends = torch.stack([first, second], dim=-1)[share <= spread]
    tree = minimum_spanning_tree(coo_array((rank.numpy(), tuple(ends.mT.numpy())), shape=(n, n)).tocsr())
    chosen = order[torch.from_numpy(tree.data).long() - 1].sort().values
    return torch.stack([first[chosen], second[chosen]], dim=-1), length[chosen], share[chosen]


def bodies(ends: Tensor, points: int) -> list[list[int]]:
    """Points that bones ``(B, 2)`` tie together, largest body first; those without bones in none.

    Example:
        >>> import torch
        >>> bodies(torch.tensor([[0, 1], [3, 4], [1, 2]]), 6)
        [[0, 1, 2], [3, 4]]
    """
    graph = coo_array((torch.ones(len(ends)).numpy(), tuple(ends.mT.numpy())), shape=(points, points))
    count, labels = connected_components(graph, directed=False)
    groups = [[k for k in range(points) if labels[k] == label] for label in range(count)]
    return sorted((group for group in groups if len(group) > 1), key=len, reverse=True)


@dataclass(frozen=True)
class World:
    """A similarity from the coordinates of the adjustment: :math:`X' = s (Q X) + o`."""

    turn: Tensor  # ``(3, 3)`` rotation Q
    scale: float  # s
    origin: Tensor  # ``(3,)`` o
    metric: bool  # whether s makes metres
    upright: float  # the share of the long axes of bodies that point up; NaN where there is none
    by_people: bool  # whether these decided

    def points(self, points: Tensor) -> Tensor:
        """Points ``(..., 3)`` in the world."""
        return self.scale * points @ self.turn.mT + self.origin

    def cameras(self, R: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
        """Cameras ``(c, 3, 3)``, ``(c, 3)`` of the world."""
        turned = R @ self.turn.mT
        return turned, self.scale * t - (turned @ self.origin[:, None])[..., 0]


MIN_UPRIGHT_SHARE = 0.4  # of the axes
MAX_WORLD_MOMENTS = 2_000  # evenly spread
GROUND_QUANTILE = 0.01  # of the points' heights
MAX_BODY_SPREAD = 0.15  # of a distance over itself up to which two points belong to one body


def estimate_world(R: Tensor, centers: Tensor, points: Tensor, scale: Scale) -> World:
    r"""Up from the long axes of upright bodies, the ground below them, the scale from a height or lengths. R ``(c, 3, 3)``,
    centers ``(c, 3)``, points ``(T, n, 3)``."""
    points = points[:: max(1, len(points) // MAX_WORLD_MOMENTS)]
    n = points.shape[1]
    # several people stand side by side: what keeps its distances is one body
    ends, _, _ = rigid_pairs(points.nan_to_num(0.0), points.isfinite().all(-1), MAX_BODY_SPREAD)
    groups = bodies(ends, n) or [list(range(n))]
    from_cameras = normalize(-R[:, 1].sum(0), dim=0)
    up, share = estimate_up(points, groups, from_cameras)
    by_people = share >= MIN_UPRIGHT_SHARE
    up = up if by_people else from_cameras
    ahead = R[0, 2] - (R[0, 2] @ up) * up
    ahead = normalize(ahead, dim=0) if float(ahead.norm()) > 1e-6 else normalize(torch.linalg.cross(up, R[0, 0]), dim=0)
    turn = torch.stack([torch.linalg.cross(ahead, up), ahead, up])
    turned = points @ turn.mT
    size, metric = _scale(turned, centers, points, groups[0], scale)
    known = turned.flatten(0, 1)
    known = known[known.isfinite().all(-1)]
    if not len(known):
        return World(turn, size, torch.zeros(3, dtype=torch.float64), metric, share, by_people)
    low = torch.stack([*known[:, :2].median(0).values, known[:, 2].quantile(GROUND_QUANTILE)])
    return World(turn, size, -size * low, metric, share, by_people)


UPRIGHT_DEGREES = 15.0  # from their middle within which long axes of bodies count as upright
MIN_AXIS_POINTS = 0.6  # share of the points of a body that a long axis takes
MIN_ELONGATION = 1.5  # ratio of the first two principal spreads
MAX_CAMERA_TILT = 40.0  # degrees of the long axes from the cameras' own upward direction: nobody stands on a wall


def estimate_up(points: Tensor, groups: list[list[int]], guess: Tensor) -> tuple[Tensor, float]:
    """The direction ``(3,)`` that most long axes of bodies have, and the share of the axes that have it."""
    axes = []
    for group in groups:
        body = points[:, group]
        seen = body.isfinite().all(-1)
        enough = seen.sum(1) >= max(3, math.ceil(MIN_AXIS_POINTS * len(group)))
        body, seen = body[enough].nan_to_num(0.0), seen[enough].double()[..., None]
        centred = (body - (body * seen).sum(1, keepdim=True) / seen.sum(1, keepdim=True)) * seen
        values, vectors = torch.linalg.eigh(centred.mT @ centred)
        long = values[:, 2].clamp(min=0).sqrt() > MIN_ELONGATION * values[:, 1].clamp(min=1e-300).sqrt()
        axes.append(vectors[long, :, 2])
    every = torch.cat(axes)
    if not len(every):
        return guess, math.nan
    every = every * torch.where(every @ guess < 0, -1.0, 1.0)[:, None]
    up = normalize(every.median(0).values, dim=0)
    for _ in range(50):
        weight = 1 / (1 - every @ up).clamp(min=0).sqrt().clamp(min=1e-3)
        up = normalize((every * weight[:, None]).sum(0), dim=0)
    near = every @ up > math.cos(math.radians(UPRIGHT_DEGREES))
    if float(up @ guess) < math.cos(math.radians(MAX_CAMERA_TILT)):
        return guess, 0.0
    return normalize(every[near].mean(0), dim=0) if bool(near.any()) else up, float(near.double().mean())


MIN_HEIGHT_POINTS = 0.9  # the same for its height, or as many as ever are
STANDING_QUANTILE = 0.75  # of the extent upwards


def _scale(turned: Tensor, centers: Tensor, points: Tensor, body: list[int], scale: Scale) -> tuple[float, bool]:
    """Units of the world per unit of the adjustment, and whether they are metres."""
    if scale.lengths:
        found = []
        for (a, b), length in scale.lengths.items():
            far = (points[:, a] - points[:, b]).norm(dim=-1)
            if bool(far.isfinite().any()):
                found.append(length / float(far.nanmedian()))
        if found:
            return float(torch.tensor(found).median()), True
    if scale.height is not None:
        up = turned[:, body, 2]
        share = up.isfinite().double().mean(1)
        whole = up[share >= min(MIN_HEIGHT_POINTS, float(share.max()))]
        extent = whole.nan_to_num(-math.inf).amax(1) - whole.nan_to_num(math.inf).amin(1)
        if len(extent):
            return scale.height / float(extent.quantile(STANDING_QUANTILE)), True
    seen = points.flatten(0, 1)
    seen = seen[seen.isfinite().all(-1)]
    middle = seen.median(0).values if len(seen) else centers.mean(0)
    return 1 / float((centers - middle).norm(dim=-1).median()), False

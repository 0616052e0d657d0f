"""One fixed, uncalibrated perspective camera and the points of a rigid body that moves before it: the motion, by factorization."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import combinations

import torch
from torch import Tensor

from dyntorch.core.outcome import Notice
from dyntorch.geometry.homogeneous import homogeneous
from dyntorch.geometry.rigid import BodyProblem, FilmedBody, fit_body, nearest_rotation
from dyntorch.geometry.triangulation import resect, triangulate
from dyntorch.numerics.least_squares import LeastSquaresOptions
from dyntorch.numerics.subspaces import affine_factorization, metric_upgrade
from dyntorch.tasks.reconstruct.factorization import projective_factorization
from dyntorch.tasks.synchronize.result import ShiftNotice, SynchronizeOptions
from dyntorch.tasks.synchronize.tracks import Tracks


@dataclass(frozen=True, eq=False)
class BodyMotion:
    """What one camera says of the body."""

    body: FilmedBody  # one problem, one camera, in normalized images: ``(x - centre) / scale``
    seen: Tensor  # ``(frames,)`` bool, frames whose motion is known
    points: Tensor  # ``(n,)`` bool, those on the body
    information: Tensor  # ``(frames, 6, 6)`` of the motions per square pixel of noise, 0 where they are not known
    residuals: Tensor  # ``(n,)`` rms reprojection error of a coordinate, pixels; NaN where a point could not be placed
    residual: float  # the same of all points on the body
    centre: Tensor  # ``(2,)`` pixels
    scale: float  # pixels

    @property
    def turn_angle(self) -> float:
        """Radians: rms angle of the body about its mean attitude."""
        rotations = self.body.motions[0, self.seen, :, :3]
        mean = nearest_rotation(rotations.mean(0))
        cosine = ((rotations * mean).sum((-2, -1)) - 1) / 2
        return float(cosine.clamp(-1, 1).acos().square().mean().sqrt())

    @property
    def thickness(self) -> float:
        """Pixels: rms distance of the points from their best plane, as the camera would see it from the side."""
        x = self.body.points[0]
        least = torch.linalg.svdvals(x - x.mean(0))[-1] / math.sqrt(len(x))
        depth = self.body.images(torch.zeros(len(x), dtype=torch.long, device=x.device))[1][0, self.seen]
        return float(least * self.body.calibrations[0, 0, 0, 0] / depth.median()) * self.scale


MIN_POINTS = 6  # Points on the body: fewer leave projective depths undecided.
MIN_VISIBLE_SHARE = 0.5  # Share of the frames in which a point must be visible.
MIN_RELATIVE_NOISE = 1e-6  # Floor of the noise over the RMS coordinate: rounding.
MIN_THICKNESS_RATIO = 3.0  # Thickness of the body in the image, over the noise, below which it is planar.
MIN_TURN_RATIO = 5.0  # RMS angle over the noise at the distance of the points below which the body does not turn.


def body_motion(name: str, tracks: Tracks, options: SynchronizeOptions | None = None) -> BodyMotion | Notice:
    r"""The motion of a rigid body before one camera, up to a similarity. tracks ``(frames, n, 2)``."""
    seen = tracks.weights > 0
    often = seen.double().mean(0) >= MIN_VISIBLE_SHARE
    if int(often.sum()) < MIN_POINTS:
        values = {"which": name, "needed": MIN_POINTS}
        return Notice(ShiftNotice.FEW_ON_BODY, float(often.sum()), values)
    centre = tracks.x[seen].mean(0)
    scale = float((tracks.x[seen] - centre).square().mean().sqrt().clamp(min=1e-300))
    take = _BodyTracks(
        torch.where(seen[..., None], (tracks.x - centre) / scale, 0.0), seen, tracks.noise / scale, options or SynchronizeOptions()
    )
    found = take.fit(often)
    if found is None or not found.agrees(often):
        found = take.fit_subsets(often) or found
    if found is None:
        return Notice(ShiftNotice.NO_BODY, math.inf, {"which": name, "noise": tracks.noise})
    motion = _summarize(take, found, centre, scale)
    if not found.agrees(found.points):
        return Notice(ShiftNotice.NO_BODY, motion.residual, {"which": name, "noise": tracks.noise})
    noise = max(motion.residual, MIN_RELATIVE_NOISE * scale)
    if motion.thickness < MIN_THICKNESS_RATIO * noise:
        return Notice(ShiftNotice.FLAT_BODY, motion.thickness, {"which": name, "noise": noise})
    if motion.turn_angle < MIN_TURN_RATIO * noise / _extent(motion):
        return Notice(ShiftNotice.NO_TURN, motion.turn_angle, {"which": name})
    return motion


def _extent(motion: BodyMotion) -> float:
    """Rms distance of the body's images from their middle in each frame, pixels."""
    points = motion.body.points[0]
    images = motion.body.images(torch.zeros(len(points), dtype=torch.long, device=points.device))[0][0, motion.seen]
    return float((images - images.mean(1, keepdim=True)).square().sum(-1).mean().sqrt()) * motion.scale


def _summarize(take: _BodyTracks, found: _BodyFit, centre: Tensor, scale: float) -> BodyMotion:
    information = take.problem(found.points, found.frames).information(found.body)[0] * scale**2
    return BodyMotion(
        body=found.body,
        seen=found.frames,
        points=found.points,
        information=torch.where(found.frames[:, None, None], information, 0.0),
        residuals=found.residuals * scale,
        residual=float(found.rms) * scale,
        centre=centre,
        scale=scale,
    )


@dataclass(frozen=True, eq=False)
class _BodyFit:
    """A body ``(1, ...)`` of the points ``(n,)`` in the frames ``(frames,)``, rms ``(n,)`` of every point about it."""

    body: FilmedBody
    points: Tensor
    frames: Tensor
    residuals: Tensor
    rms: Tensor
    limit: float
    """Rms of a point that is on the body, at most."""

    def agrees(self, points: Tensor) -> bool:
        """Whether these points are on the body."""
        return bool((self.residuals[points] <= self.limit).all())


MIN_POINTS_PER_FRAME = 4  # Points that place a known body in a frame.
MIN_FRAMES = 10  # Frames with enough points.
MAX_ITERATIONS = 60  # Steps of the adjustment of all frames.
NUM_TRIANGULATION_STEPS = 3  # Gauss-Newton steps that place a point on a body of known motion.
MAX_MISFIT_RATIO = 3.0  # RMS of a point about the body, over its noise, beyond which it is not on it.
MAX_SUBSETS = 100  # Subsets of points that are ranked where some are not on the body.
MAX_FITTED_SUBSETS = 8  # Of them those that are fitted.


@dataclass(frozen=True, eq=False)
class _BodyTracks:
    """Normalized tracks ``(frames, n, 2)``, which are seen ``(frames, n)``, and their noise."""

    x: Tensor
    seen: Tensor
    noise: float
    options: SynchronizeOptions

    def problem(self, points: Tensor, frames: Tensor) -> BodyProblem:
        """All frames that count, of these points."""
        weights = (self.seen[:, points] & frames[:, None]).to(self.x)
        return BodyProblem(self.x[None, :, points], weights[None], _camera(int(points.sum()), self.x))

    def fit(self, points: Tensor) -> _BodyFit | None:
        """The body that these points ``(n,)`` bool are on, if there is one."""
        chosen, frames = self._start(points)
        if len(frames) < MIN_FRAMES:
            return None
        body = start_body(self.x[frames][:, chosen], self.options)
        if body is None:
            return None
        placed = self._resect_frames(body, chosen, frames)
        return None if placed is None else self._adjust(*placed, points, chosen)

    def _start(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Points and frames that see all of them, some, spread evenly: the points seen least are left out where they have to be."""
        count = torch.where(points, self.seen.sum(0), -1)
        for left in range(int(points.sum()), MIN_POINTS - 1, -1):
            chosen = torch.zeros_like(points)
            chosen[count.argsort(descending=True, stable=True)[:left]] = True
            whole = self.seen[:, chosen].all(-1).nonzero()[:, 0]
            if len(whole) >= MIN_FRAMES:
                break
        views = min(len(whole), self.options.num_views)
        return chosen, whole[torch.linspace(0, max(len(whole) - 1, 0), views).round().long()]

    def _resect_frames(self, body: FilmedBody, chosen: Tensor, frames: Tensor) -> tuple[FilmedBody, Tensor] | None:
        """The body in all frames, by resection or as in the nearest frame of the start, whichever fits; and where it is known."""
        x, seen = self.x[:, chosen], self.seen[:, chosen]
        projections = torch.linalg.inv(body.calibrations[0, 0]) @ resect(homogeneous(body.points[0]), x, seen.to(x))
        size = torch.linalg.det(projections[..., :3])
        known = size.abs() > 1e-30
        size = torch.where(known, size.sign() * size.abs().clamp(min=1e-30) ** (1 / 3), 1.0)
        projections = projections / size[:, None, None]
        own = torch.where(known[:, None, None], projections, torch.eye(3, 4, dtype=x.dtype, device=x.device))
        own = torch.cat([nearest_rotation(own[..., :3]), own[..., 3:]], -1)
        near = (torch.arange(len(x), device=x.device)[:, None] - frames).abs().argmin(1)
        both = torch.stack([own, body.motions[0, near]])
        whole = body._replace(motions=both, **{k: getattr(body, k).expand(2, *getattr(body, k).shape[1:]) for k in _FIXED})
        images, depth = whole.images(_camera(x.shape[1], x))
        square = torch.where(seen, (images - x).square().sum(-1), 0.0).sum(-1)
        square = torch.where(((depth > 0) | ~seen).all(-1) & square.isfinite(), square, torch.inf)
        usable = square.amin(0).isfinite() & (seen.sum(-1) >= MIN_POINTS_PER_FRAME)
        if int(usable.sum()) < MIN_FRAMES:
            return None
        best = torch.where((square[0] <= square[1])[:, None, None], both[0], both[1])
        return body._replace(motions=best[None]), usable

    def _adjust(self, body: FilmedBody, usable: Tensor, points: Tensor, chosen: Tensor) -> _BodyFit | None:
        """All frames, then all points together; the others are placed on the body that they are compared with."""
        options = LeastSquaresOptions(iterations=MAX_ITERATIONS, tolerance=1e-9)
        body, cost = fit_body(self.problem(chosen, usable), body, options)
        if not bool(cost.isfinite().all()):
            return None
        if not bool((chosen == points).all()):
            everyone = self._triangulate_points(body, usable)
            body = body._replace(points=everyone[None, points])
            body, cost = fit_body(self.problem(points, usable), body, options)
            if not bool(cost.isfinite().all()):
                return None
        everyone = self._triangulate_points(body, usable)
        everyone[points] = body.points[0]
        images, depth = body._replace(points=everyone[None]).images(_camera(len(points), self.x))
        counted = self.seen & usable[:, None] & (depth[0] > 0)
        square = torch.where(counted, (images[0] - self.x).square().sum(-1), 0.0)
        residuals = (square.sum(0) / (2 * counted.sum(0))).sqrt()
        # unknowns that the errors pay for: six of a frame, three of a point, five of the camera, seven of the gauge less
        rows = 2 * int(counted[:, points].sum())
        spare = rows - 6 * int(usable.sum()) - 3 * int(points.sum()) + 2
        rms = (square[:, points].sum() / max(spare, 1)).sqrt()
        limit = max(MAX_MISFIT_RATIO * self.noise, MIN_RELATIVE_NOISE)
        return _BodyFit(body, points, usable, residuals.nan_to_num(nan=math.inf), rms, limit)

    def _triangulate_points(self, body: FilmedBody, usable: Tensor) -> Tensor:
        """All points ``(n, 3)`` on a body whose motion is known."""
        projections = body.calibrations[0] @ body.motions[0]
        found = triangulate(projections, self.x, (self.seen & usable[:, None]).to(self.x), steps=NUM_TRIANGULATION_STEPS)
        return found[:, :3] / torch.where(found[:, 3:].abs() > 1e-12, found[:, 3:], 1e-12)

    def fit_subsets(self, often: Tensor) -> _BodyFit | None:
        """The body of the most points: subsets of six that move most like affine views of one body are tried first."""
        index = often.nonzero()[:, 0].tolist()
        whole = self.seen[:, often].all(-1)
        if len(index) <= MIN_POINTS or int(whole.sum()) < MIN_FRAMES:
            return None
        sets = self._subsets(index)
        left = affine_factorization(torch.stack([self.x[whole][:, part] for part in sets]))
        energy = torch.stack(
            [(self.x[whole][:, part] - self.x[whole][:, part].mean(1, keepdim=True)).square().sum() for part in sets]
        )
        best: _BodyFit | None = None
        for i in (left[2] * energy).argsort(stable=True)[:MAX_FITTED_SUBSETS].tolist():
            found = self.fit(torch.zeros_like(often).index_fill(0, sets[i], True))
            if found is None or not found.agrees(found.points):
                continue
            joined = self.fit(often & (found.residuals <= found.limit))
            found = joined if joined is not None and joined.agrees(joined.points) else found
            if best is None or int(found.points.sum()) > int(best.points.sum()):
                best = found
            if 2 * int(best.points.sum()) > len(index):
                break
        return best

    def _subsets(self, index: list[int]) -> list[Tensor]:
        size = MIN_POINTS
        if math.comb(len(index), size) <= MAX_SUBSETS:
            parts = [list(part) for part in combinations(index, size)]
        else:
            # a generator of its own: the same tracks get the same answer
            generator = torch.Generator().manual_seed(0)
            draws = (torch.randperm(len(index), generator=generator)[:size].sort().values.tolist() for _ in range(MAX_SUBSETS))
            parts = [[index[i] for i in part] for part in draws]
        return [torch.tensor(part, device=self.x.device) for part in parts]


_FIXED = ("calibrations", "sights", "points")


def _camera(n: int, like: Tensor) -> Tensor:
    return torch.zeros(n, dtype=torch.long, device=like.device)


# ----------------------------------------------------------------------------------------------------------------------
# A body from a few frames that see all of its points.


NUM_FIRST_ITERATIONS = 10  # Steps from each start.
NUM_CONTINUED_STARTS = 3  # Starts that are continued.
NUM_START_ITERATIONS = 50  # Further steps of these.


def start_body(x: Tensor, options: SynchronizeOptions) -> FilmedBody | None:
    """The best body ``(1, ...)`` of tracks ``(views, n, 2)`` of order 1, without outliers; None where nothing descends."""
    focal = torch.tensor(options.focal_lengths, dtype=x.dtype, device=x.device)
    starts = [*_projective(x, focal), *_affine(x, focal)]
    body = FilmedBody(*(torch.cat(parts) for parts in zip(*starts, strict=True)))
    count = len(body.points)
    weights = torch.ones(count, *x.shape[:2], dtype=x.dtype, device=x.device)
    problem = BodyProblem(x.expand(count, *x.shape), weights, _camera(x.shape[1], x))
    for steps, kept in ((NUM_FIRST_ITERATIONS, NUM_CONTINUED_STARTS), (NUM_START_ITERATIONS, 1)):
        body, cost = fit_body(problem, body, LeastSquaresOptions(iterations=steps, tolerance=1e-6))
        best = cost.argsort(stable=True)[:kept]
        body, problem = FilmedBody(*(part[best] for part in body)), problem.subset(best)
    return body if bool(cost[best].isfinite().all()) else None


def _projective(x: Tensor, focal: Tensor) -> list[FilmedBody]:
    r"""Starts from projective depths: the dual quadric Q that makes :math:`K^{-1} P_t\, Q\, P_t^T K^{-T} \simeq I`, for each K."""
    found = projective_factorization(x, 4)
    if not bool(found.projections.any()):
        return []
    inner = torch.diag_embed(torch.stack([1 / focal, 1 / focal, torch.ones_like(focal)], -1))
    seen = inner[:, None] @ found.projections
    seen = seen * (math.sqrt(3) / torch.linalg.matrix_norm(seen, keepdim=True).clamp(min=1e-300))
    a, b, c = seen.unbind(-2)
    rows = [_quadric_rows(p, q) for p, q in ((a, b), (a, c), (b, c))]
    rows += [_quadric_rows(a, a) - _quadric_rows(other, other) for other in (b, c)]
    quadric = torch.linalg.svd(torch.cat(rows, 1))[2][:, -1]
    i, j = torch.triu_indices(4, 4, device=x.device)
    matrix = x.new_zeros(len(focal), 4, 4)
    matrix[:, i, j] = matrix[:, j, i] = quadric
    values, vectors = torch.linalg.eigh(matrix * matrix.diagonal(dim1=-2, dim2=-1).sum(-1).sign()[:, None, None])
    roots = values[:, None, 1:].clamp(min=1e-6 * values[:, -1:, None].clamp(min=1e-30)).sqrt()
    change = torch.cat([vectors[..., 1:] * roots, vectors[..., :1]], -1)
    points = torch.linalg.solve(change, found.structure.mT.expand(len(focal), -1, -1)).mT
    return [_bodies_of_projections(seen @ change[:, None], points, focal)]


def _quadric_rows(p: Tensor, q: Tensor) -> Tensor:
    """Coefficients ``(..., 10)`` of :math:`p^T Q q` in the upper triangle of the symmetric Q."""
    i, j = torch.triu_indices(4, 4, device=p.device)
    outer = p[..., :, None] * q[..., None, :]
    outer = outer + outer.mT
    return torch.where(i == j, outer[..., i, j] / 2, outer[..., i, j])


def _bodies_of_projections(seen: Tensor, points: Tensor, focal: Tensor) -> FilmedBody:
    """Bodies of projections ``(k, views, 3, 4)`` that are nearly :math:`s\\,[R \\mid T]`, and homogeneous points ``(k, n, 4)``."""
    size = torch.linalg.det(seen[..., :3])
    size = torch.where(size < 0, -1.0, 1.0) * size.abs().clamp(min=1e-30) ** (1 / 3)
    seen = seen / size[..., None, None]
    rotation, translation = nearest_rotation(seen[..., :3]), seen[..., 3]
    x = points[..., :3] / torch.where(points[..., 3:].abs() > 1e-12, points[..., 3:], 1e-12)
    depth = (x[:, None] @ rotation.mT)[..., 2] + translation[..., None, 2]
    # what is behind the camera is in front of it when mirrored in the origin
    side = torch.where((depth > 0).double().mean((1, 2)) < 0.5, -1.0, 1.0)[:, None, None]
    return _body(rotation, translation * side, x * side, focal)


def _affine(x: Tensor, focal: Tensor) -> list[FilmedBody]:
    """Starts from scaled orthography, at each focal length, as it is and mirrored in depth."""
    shape, cameras, _ = affine_factorization(x)
    metric, decided = metric_upgrade(shape, cameras)
    if not bool(decided):
        return []
    middle = x.mean(1)
    metric = metric - metric.mean(0)
    linear = torch.linalg.lstsq(metric.expand(len(x), -1, -1), x - middle[:, None], driver="gelsd").solution.mT
    u, s, vt = torch.linalg.svd(linear, full_matrices=False)
    size, upper = s.mean(-1).clamp(min=1e-12), u @ vt
    rotation = torch.cat([upper, torch.linalg.cross(upper[:, 0], upper[:, 1])[:, None]], 1)
    translation = torch.cat([(middle / size[:, None]).expand(len(focal), -1, -1), (focal[:, None] / size)[..., None]], -1)
    turned = torch.tensor([-1.0, -1.0, 1.0], dtype=x.dtype, device=x.device)[:, None] * rotation
    pairs = ((rotation, metric), (turned, -metric))
    return [_body(r.expand(len(focal), *r.shape), translation, y.expand(len(focal), *y.shape), focal) for r, y in pairs]


def _body(rotation: Tensor, translation: Tensor, points: Tensor, focal: Tensor) -> FilmedBody:
    calibration = torch.diag_embed(torch.stack([focal, focal, torch.ones_like(focal)], -1))[:, None]
    sight = torch.eye(3, 4, dtype=focal.dtype, device=focal.device).expand(len(focal), 1, 3, 4)
    return FilmedBody(calibration, sight, torch.cat([rotation, translation[..., None]], -1), points)

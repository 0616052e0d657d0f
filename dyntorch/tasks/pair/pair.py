"""reconstruct_pair(): a moving, bending scene in space from two static cameras that nobody calibrated."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import normalize

from dyntorch.core.normalize import hartley
from dyntorch.core.outcome import Notice, Status, is_failure, select_problem, solve_one_by_one, trim_padding
from dyntorch.core.residual import sampson
from dyntorch.core.robust import robust_fit
from dyntorch.geometry.homogeneous import homogeneous, similarity, skew
from dyntorch.geometry.rigid import BodyProblem, FilmedBody, fit_body
from dyntorch.geometry.triangulation import reproject, triangulate
from dyntorch.invariants.fundamental_matrix import FundamentalMatrix
from dyntorch.numerics.arguments import check_options, check_threshold, check_together, on_cpu
from dyntorch.numerics.blocks import one_thread
from dyntorch.numerics.least_squares import LeastSquaresOptions
from dyntorch.tasks.pair.affine import MIN_POINTS, Transfer, solve
from dyntorch.tasks.pair.result import PairNotice, PairReconstruction, Refusal, failure
from dyntorch.tasks.pair.tracks import (
    MAX_ALONG_EXTENT,
    MAX_ALONG_RATIO,
    MAX_RESIDUAL_SIGMAS,
    Overlap,
    fill_gaps,
    match_tracks,
    mutually_nearest,
    overlap,
)
from dyntorch.tasks.synchronize.projective import MAX_MISFIT, Poses, common_motion
from dyntorch.tasks.synchronize.result import Shift
from dyntorch.tasks.synchronize.rigid_body import MAX_ITERATIONS, MIN_RELATIVE_NOISE, BodyMotion, body_motion
from dyntorch.tasks.synchronize.tracks import Tracks


@dataclass(frozen=True)
class PairOptions:
    """What a user can set in :func:`dyntorch.reconstruct_pair`."""

    min_frames: int = 12
    """Frames in common: fewer are explained by any tracks."""
    min_seen_share: float = 0.5
    """Share of the frames in which a track of different points must be seen; longer gaps would be guessed, not interpolated."""
    max_samples: int = 4000
    """Positions of corresponding points that the fundamental matrix is estimated from, about."""
    num_chance_draws: int = 5
    """Unrelated motions, of the same spectrum and covariance, that the likelihood of different points is compared with."""
    min_chance_margin: float = 1.0
    """Ranges of their likelihoods that the one of the cameras must be above the highest of them: two views of one scene have 2 to
    16 (3 px of noise and less, 60 frames and more); of 12 pairs of unrelated bodies one is above 1."""


# ----------------------------------------------------------------------------------------------------------------------
# Two projective cameras that see different points of one rigid body, from its motion before each.


def body_pair(seen: Overlap, threshold: float | None, explained: float) -> PairReconstruction | Refusal:
    r"""One body, two cameras, points of either's own:"""
    tracks = [_tracks(x, seen) for x in (seen.a, seen.b)]
    motions = []
    for name, one in zip("ab", tracks, strict=True):
        motion = body_motion(name, one)
        if isinstance(motion, Notice):
            return motion, motion.code.refuses or Status.DEGENERATE
        motions.append(motion)
    first, second = motions
    poses = [Poses.of(motion, seen.times) for motion in motions]
    shared, misfit = common_motion(poses[0], poses[1])
    if not misfit <= MAX_MISFIT:
        return Notice(PairNotice.TWO_MOTIONS, misfit), Status.NO_CONSENSUS
    body, problem = _joint_problem(first, second, shared, tracks)
    body, cost = fit_body(problem, body, LeastSquaresOptions(iterations=MAX_ITERATIONS, tolerance=1e-10))
    if not bool(cost.isfinite().all()):
        return Notice(PairNotice.TWO_MOTIONS, math.inf), Status.NO_CONSENSUS
    return _body_reconstruction(seen, body, first, second, threshold, explained)


def _tracks(x: Tensor, seen: Overlap) -> Tracks:
    known = x.isfinite().all(-1)
    step = float(seen.times.diff().median())
    return Tracks(torch.where(known[..., None], x, 0.0), known.double(), seen.times, step)


def _joint_problem(
    first: BodyMotion, second: BodyMotion, shared: tuple[Tensor, ...], tracks: list[Tracks]
) -> tuple[FilmedBody, BodyProblem]:
    """The start in the frame of a, and the problem of both cameras' tracks, each in its own unit."""
    turn, seat, (scale, *rest) = shared[0], shared[1], shared[2].split([1, 3, 3])
    place, origin = rest
    moved = (second.body.points[0] + origin) @ seat.mT / scale
    sight = torch.cat([turn, (place / scale)[:, None]], -1)
    body = FilmedBody(
        calibrations=torch.cat([first.body.calibrations, second.body.calibrations], 1),
        sights=torch.cat([first.body.sights, sight[None, None]], 1),
        motions=_merge_motions(first, second, shared),
        points=torch.cat([first.body.points, moved[None]], 1),
    )
    x, weights, camera = [], [], []
    for k, (motion, one) in enumerate(zip((first, second), tracks, strict=True)):
        own = one.x[:, motion.points]
        x.append((own - motion.centre) / motion.scale)
        noise = max(motion.residual, MIN_RELATIVE_NOISE * motion.scale)
        known = (one.weights[:, motion.points] > 0) & (first.seen | second.seen)[:, None]
        weights.append(known * (motion.scale / noise) ** 2)
        camera.append(torch.full((own.shape[1],), k, device=own.device))
    w = torch.cat(weights, 1)
    return body, BodyProblem(torch.cat(x, 1)[None], (w / w.max())[None], torch.cat(camera))


def _merge_motions(first: BodyMotion, second: BodyMotion, shared: tuple[Tensor, ...]) -> Tensor:
    """a's motions ``(1, frames, 3, 4)``; where only b knows one, b's in a's frame."""
    turn, seat, rest = shared
    own, other = first.body.motions[0], second.body.motions[0]
    rotation = turn.mT @ other[..., :3] @ seat.mT
    place = ((other[..., 3] - rest[1:4] - (other[..., :3] @ rest[4:])) @ turn) / rest[0]
    return torch.where(first.seen[:, None, None], own, torch.cat([rotation, place[..., None]], -1))[None]


def _body_reconstruction(
    seen: Overlap, body: FilmedBody, first: BodyMotion, second: BodyMotion, threshold: float | None, explained: float
) -> PairReconstruction:
    n, m, frames = seen.a.shape[1], seen.b.shape[1], len(seen.times)
    kept = torch.cat([first.points, second.points])
    back = torch.stack([similarity(torch.as_tensor(one.scale).to(one.centre), -one.centre / one.scale) for one in (first, second)])
    inner = back @ body.calibrations[0]
    cameras = inner @ body.sights[0]
    placed = normalize(homogeneous(body.points_in_camera()[0]), dim=-1)
    known = first.seen | second.seen
    points = placed.new_full((frames, n + m, 4), math.nan)
    points[:, kept] = torch.where(known[:, None, None], placed, math.nan)
    both = reproject(cameras, points.nan_to_num().flatten(0, 1)).unflatten(1, (frames, n + m))
    both = torch.where(points.isnan().any(-1)[None, ..., None], math.nan, both)
    missed = torch.cat([both[0, :, :n] - seen.a, both[1, :, n:] - seen.b], 1)
    apart = missed.norm(dim=-1)
    residuals = apart.square().nanmean(0).sqrt()
    strangers = torch.cat([first.residuals, second.residuals]) * math.sqrt(2)
    residuals = torch.where(kept, residuals, torch.where(strangers.isfinite(), strangers, math.nan))
    # 1.1774: the median length of a two-dimensional error of unit variance
    sigma = float(apart[:, kept].nanmedian()) / 1.1774
    limit = MAX_RESIDUAL_SIGMAS * sigma if threshold is None else threshold
    counted = apart.isfinite()
    share = (counted & (apart <= max(limit, MIN_RELATIVE_NOISE * first.scale))).sum(0) / counted.sum(0).clamp(min=1)
    good = kept & (share >= explained)
    matches, distances = _match(both, good, n, float(apart[:, good].square().nanmean().sqrt()))
    rotation, place = body.sights[0, 1].split([3, 1], -1)
    F = torch.linalg.inv(inner[1]).mT @ skew(place[:, 0]) @ rotation @ torch.linalg.inv(inner[0])
    return PairReconstruction(
        cameras=cameras / torch.linalg.matrix_norm(cameras, keepdim=True),
        points=torch.where(good[:, None], points, math.nan),
        times=seen.times,
        source=(torch.arange(n + m, device=kept.device) >= n).long(),
        labels=good.long(),
        r2=torch.where(kept, share.double(), 0.0),
        matches=matches,
        distances=distances,
        normals=F.new_full((2, 2), math.nan),
        fundamental=F / F.norm(),
        residuals=residuals,
        residual=float(apart[:, good].square().nanmean().sqrt()),
        status=torch.tensor(int(Status.OK), device=F.device),
    )


def _match(both: Tensor, good: Tensor, n: int, residual: float) -> tuple[Tensor, Tensor]:
    """The track of a that a track of b is ``(m,)``, -1 = none, and rms distances ``(n, m)`` of all pairs in a's pixels."""
    apart = torch.stack([(x[:, :n, None] - x[:, None, n:]).square().sum(-1).nanmean(0).sqrt() for x in both])
    pairs = good[:n, None] & good[None, n:]
    distances = torch.where(pairs, apart[0], math.nan)
    worst = torch.where(pairs, apart.amax(0), math.inf)
    if not worst.numel():
        return torch.full((worst.shape[1],), -1, dtype=torch.long, device=good.device), distances
    extent = float((both[0] - both[0].nanmean(1, keepdim=True)).square().sum(-1).nanmean().sqrt())
    best, track = mutually_nearest(worst)
    return torch.where(best <= max(MAX_ALONG_RATIO * residual, MAX_ALONG_EXTENT * extent), track, -1), distances


# ----------------------------------------------------------------------------------------------------------------------
# Two static cameras that see the same points: one fundamental matrix for the whole take, and projective structure per frame.


MIN_POSITIONS = 12  # in both cameras: with fewer, agreement with some fundamental matrix is no evidence


def projective(
    seen: Overlap, threshold: float | None, explained: float, generator: torch.Generator | None, max_samples: int
) -> PairReconstruction | Refusal:
    """The reconstruction of corresponding points."""
    frames, n = seen.a.shape[:2]
    both = (seen.a.isfinite() & seen.b.isfinite()).all(-1)
    if int(both.sum()) < MIN_POSITIONS:
        return Notice(PairNotice.FEW_OBSERVED, float(both.sum()), {"needed": MIN_POSITIONS}), Status.TOO_FEW
    # of unit size: neither the solver's nor the triangulation's precision depends on the unit
    x1, x2 = seen.a.nan_to_num(), seen.b.nan_to_num()
    chosen = both.flatten().nonzero()[:, 0]
    stride = -(-len(chosen) // max_samples)
    part = chosen[::stride]
    fitted = robust_fit(FundamentalMatrix, x1.flatten(0, 1)[part], x2.flatten(0, 1)[part], threshold=threshold, generator=generator)
    status = Status(int(fitted.status))
    if bool(is_failure(fitted.status)):
        return Notice(PairNotice.DEGENERATE, float(len(part))), status
    F = fitted.tensor
    distance = sampson(FundamentalMatrix, F, x1.flatten(0, 1), x2.flatten(0, 1)).unflatten(0, (frames, n))
    distance = torch.where(both, distance.abs(), torch.nan)
    sigma = 0.0 if fitted.sigma is None else float(fitted.sigma)
    limit = threshold if threshold is not None else max(MAX_RESIDUAL_SIGMAS * sigma, 1e-9 * float(x1.abs().max()))
    share = torch.where(both, distance <= limit, False).sum(0) / both.sum(0).clamp(min=1)
    good = (share >= explained) & (both.sum(0) > 0)
    cameras, points = _structure(F, x1, x2, both, fitted.motion)
    points = torch.where((good & both)[..., None], points, torch.nan)
    residuals = distance.square().nanmean(0).sqrt()
    residual = float(distance[:, good].square().nanmean().sqrt())
    index = torch.arange(n, device=F.device)
    return PairReconstruction(
        cameras=cameras,
        points=points,
        times=seen.times,
        source=torch.zeros_like(index),
        labels=good.long(),
        r2=torch.where(both.any(0), share.double(), torch.nan),
        matches=torch.where(good, index, -1),
        distances=F.new_full((n, n), torch.nan),
        normals=F.new_full((2, 2), torch.nan),
        fundamental=F,
        residuals=residuals,
        residual=residual,
        status=torch.tensor(int(status), device=F.device),
    )


TRIANGULATION_ITERATIONS = 3  # then the reprojection error no longer falls


def _structure(F: Tensor, x1: Tensor, x2: Tensor, both: Tensor, motion: tuple[Tensor, ...]) -> tuple[Tensor, Tensor]:
    """Cameras ``(2, 3, 4)`` and points ``(frames, n, 4)``: the frame of :math:`[I \\mid 0],\\ [A \\mid e_2]`, of unit size."""
    views = torch.stack([x1.flatten(0, 1), x2.flatten(0, 1)])
    weights = both.flatten().to(views)
    T = hartley(views[..., None, :], weights.expand(2, -1))
    A, e2 = motion
    homography, epipole = T[1] @ A @ torch.linalg.inv(T[0]), T[1] @ e2
    second = torch.cat([homography / homography.norm(), (epipole / epipole.norm())[:, None]], dim=-1)
    first = torch.eye(3, 4, dtype=F.dtype, device=F.device)
    normal = torch.stack([first, second])
    moved = views * T[:, None, :1, 0] + T[:, None, :2, 2]
    points = triangulate(normal, moved, weights.expand(2, -1), steps=TRIANGULATION_ITERATIONS)
    cameras = torch.linalg.inv(T) @ normal
    return cameras / torch.linalg.matrix_norm(cameras, keepdim=True), points.unflatten(0, both.shape)


@one_thread
@on_cpu
def reconstruct_pair(
    a: Tensor,
    b: Tensor,
    shift: Shift | float,
    correspondence: bool = False,
    *,
    fps: float | Sequence[float] | None = None,
    times: Sequence[Any] | None = None,
    explained: float = 0.8,
    threshold: float | None = None,
    camera: str = "auto",
    generator: torch.Generator | None = None,
    options: PairOptions | None = None,
) -> PairReconstruction:
    r"""Trajectories in space of points that two static, uncalibrated cameras see, even where each camera tracks other points.

    With ``correspondence=False`` the cameras are affine, and the points of either camera move as constant affine combinations
    of those of the other: joints and what is between them, points of a few bodies, of a face.  Across the epipolar lines, along
    :math:`m_a, m_b`, both see the same coordinate of space; in both directions of sight

    .. math:: m_b \cdot y_j(t) = c \sum_i q_{ij}\, m_a \cdot x_i(t) + o
       \quad\Rightarrow\quad x_j(t) = \sum_i q_{ij}\, x_i(t), \qquad \sum_i q_{ij} = 1,

    which transfers every track to the other camera and so gives its depth.  :math:`m_a, m_b` maximize the likelihood from a
    search over all directions, the :math:`q_{ij}` come from the ridge regression of most evidence, out of tracks whose noise is
    told from motion by their own spectrum in time and by their correlations.  With ``correspondence=True`` point i of a is
    point i of b, the cameras are projective, and one fundamental matrix of all frames gives the structure of each.

    Different points before perspective cameras (``camera="projective"``): six or more of each camera, of one rigid body that turns.
    Scaled by their projective depths, the rows of both cameras are linear in the same 12 functions of time, the body's motion

    .. math:: \lambda_{ti}\,(x_{ti}, 1) = P_a\, M(t)\, X_i, \qquad \mu_{tj}\,(y_{tj}, 1) = P_b\, M(t)\, Y_j,

    which brings both cameras, and the points of both, into one frame, without one point in common.

    A search: it computes on the CPU wherever its tensors are, and the result returns to their device.

    Args:
        a: ``(frames_a, n, 2)`` pixels, NaN = missing.
        b: ``(frames_b, m, 2)`` pixels; m = n where points correspond.  Both may have batch dimensions in front, ``shift`` and
            ``times`` too: takes of different lengths end in frames of NaN; each problem is searched by itself.
        shift: b's clock against a's, of :func:`dyntorch.synchronize`; or its offset in seconds (then with ``fps`` or ``times``).
        correspondence: whether point i of a is point i of b.
        fps: frames per second, one number or (of a, of b); default: those of the shift.
        times: (seconds of a's frames, of b's frames) instead of ``fps``.
        explained: share of a point's motion that the other camera must predict for the point to be transferred (affine), share of
            its frames within the threshold (corresponding points).
        threshold: pixels, Sampson distance of corresponding points, of different ones before projective cameras the distance from
            the reprojection; three standard deviations of the noise.  None estimates it.
        camera: ``"affine"`` or ``"projective"``; ``"auto"``: affine for different points, projective for corresponding ones.
        generator: of the random samples for corresponding points.
        options: :class:`PairOptions`; None = the defaults.

    Returns:
        A :class:`~dyntorch.tasks.pair.result.PairReconstruction` in the frames of a that both cameras show, in the dtype and on the
        device of a: ``cameras (2, 3, 4)``, ``points (frames, n + m, 3)`` up to one affinity (corresponding points: ``(frames, n,
        4)`` homogeneous, up to one collineation), ``labels`` (0 = outlier), ``r2``, ``matches``, ``residual``, ``status``.

    Raises:
        ValueError: misuse - shapes, types, a shift that is no shift, times that do not increase.

    Source: Wolf and Zomet 2002, Correspondence-free synchronization and reconstruction in a non-rigid scene; thesis chapter 7.

    Example:
        >>> import torch
        >>> from dyntorch.scenes.two_cameras import nonrigid_pair
        >>> from dyntorch.tasks.pair.pair import reconstruct_pair
        >>> scene = nonrigid_pair(12, 10, 90, sigma=0.3, offset=0.41, generator=torch.Generator().manual_seed(0))
        >>> found = reconstruct_pair(scene.a, scene.b, scene.offset, fps=scene.fps)
        >>> found.points.shape, bool(found.status == 0), int(found.labels.sum())
        (torch.Size([77, 22, 3]), True, 22)
    """
    if isinstance(a, Tensor) and isinstance(b, Tensor) and max(a.ndim, b.ndim) > 3:
        return _batch(
            a, b, shift, times, correspondence, camera, fps=fps, explained=explained, threshold=threshold, generator=generator,
            options=options,
        )  # fmt: skip
    _check(a, b, correspondence, explained, camera)
    check_threshold(threshold)
    options = PairOptions() if options is None else options
    check_options(options, PairOptions)
    with torch.no_grad():
        seen = overlap(a, b, shift, fps=fps, times=times)
        short = _short(seen, options.min_frames)
        if short is not None:
            found: PairReconstruction | Refusal = short, Status.TOO_FEW
        elif correspondence:
            found = projective(seen, threshold, explained, generator, options.max_samples)
        elif camera == "projective":
            found = body_pair(seen, threshold, explained)
        else:
            found = _affine(seen, explained, options)
    if isinstance(found, tuple):
        found = failure(a.shape[1], b.shape[1], seen.times, found, correspondence, camera)
    return _to_dtype(found, a.dtype)


def _to_dtype(found: PairReconstruction, dtype: torch.dtype) -> PairReconstruction:
    """In the precision of the tracks; times keep theirs."""
    changed = {
        f.name: getattr(found, f.name).to(dtype=dtype)
        for f in fields(found)
        if isinstance(getattr(found, f.name), Tensor) and getattr(found, f.name).is_floating_point() and f.name != "times"
    }
    return replace(found, **changed)


def _batch(
    a: Tensor, b: Tensor, shift: Any, times: Sequence[Any] | None, correspondence: bool, camera: str, **more: Any
) -> PairReconstruction:
    """All problems one after the other: a search shares nothing between takes."""
    batch = check_together(a=(a, 3), b=(b, 3))

    def solve(place: int) -> PairReconstruction:
        first, second = (trim_padding(select_problem(x, place, batch, 3)) for x in (a, b))
        own = select_problem(shift, place, batch, 0)
        if isinstance(shift, Shift) and shift.status.ndim:
            own = shift.problem(*(int(i) for i in np.unravel_index(place, tuple(batch))))
        clocks = None
        if times is not None:
            clocks = [select_problem(x, place, batch, 1)[: len(take)] for x, take in zip(times, (first, second), strict=True)]
        own = float(own) if isinstance(own, Tensor) else own
        return reconstruct_pair(first, second, own, correspondence, times=clocks, camera=camera, **more)

    def spare(said: str) -> PairReconstruction:
        none = torch.zeros(0, dtype=torch.float64, device=a.device)
        refusal = Notice(PairNotice.UNUSABLE, 0.0, {"said": said}), Status.TOO_FEW
        return _to_dtype(failure(a.shape[-2], b.shape[-2], none, refusal, correspondence, camera), a.dtype)

    return solve_one_by_one(batch, solve, spare)


CAMERAS = ("auto", "affine", "projective")


def _check(a: Tensor, b: Tensor, correspondence: bool, explained: float, camera: str) -> None:
    if camera not in CAMERAS:
        raise ValueError(f"camera must be one of {', '.join(CAMERAS)}, got {camera!r}")
    if camera == "affine" and correspondence is True:
        raise ValueError("camera='affine' is for different points: give correspondence=False, or leave it out")
    if not isinstance(correspondence, bool):
        raise ValueError(f"correspondence must be True or False, got {correspondence!r}")
    for name, x in (("a", a), ("b", b)):
        if not isinstance(x, Tensor) or x.ndim != 3 or x.shape[-1] != 2 or not x.is_floating_point():
            got = f"{tuple(x.shape)} {x.dtype}" if isinstance(x, Tensor) else type(x).__name__
            raise ValueError(f"{name} must be a floating point tensor (frames, points, 2), got {got}")
    if correspondence and a.shape[1] != b.shape[1]:
        raise ValueError(
            f"corresponding points need as many in a as in b, got {a.shape[1]} and {b.shape[1]}; correspondence=False?"
        )
    if isinstance(explained, bool) or not isinstance(explained, float | int) or not 0 <= explained < 1:
        raise ValueError(f"explained must be a share from 0 to below 1, got {explained!r}")


def _short(seen: Overlap, needed: int) -> Notice | None:
    frames = len(seen.times)
    return Notice(PairNotice.SHORT_OVERLAP, float(frames), {"needed": needed}) if frames < needed else None


MIN_SPARE_FRAMES = 6  # beyond the number of points of either camera: fewer are explained by any tracks


def _affine(seen: Overlap, explained: float, options: PairOptions) -> PairReconstruction | Refusal:
    """The reconstruction of different points."""
    often = [x.isfinite().all(-1).double().mean(0) >= options.min_seen_share for x in (seen.a, seen.b)]
    for name, kept in zip("ab", often, strict=True):
        if int(kept.sum()) < MIN_POINTS:
            values = {"case": "shown", "which": name, "needed": MIN_POINTS}
            return Notice(PairNotice.FEW_POINTS, float(kept.sum()), values), Status.TOO_FEW
    tracks = [fill_gaps(x[:, kept], s * s) for x, kept, s in zip((seen.a, seen.b), often, seen.noise, strict=True)]
    most = max(x.shape[1] for x in tracks)
    wrong = _short(seen, most + MIN_SPARE_FRAMES) or _unusable(tracks, seen.noise)
    if wrong is not None:
        return wrong, wrong.code.refuses or Status.DEGENERATE
    centres = [x.mean((0, 1)) for x in tracks]
    found = solve(tracks[0] - centres[0], tracks[1] - centres[1], seen.noise, explained, options.num_chance_draws)
    split = int(often[0].sum())
    if isinstance(found, Tensor):
        counts = int(found[:split].sum()), int(found[split:].sum())
        notice = Notice(PairNotice.FEW_POINTS, float(min(counts)), {"case": "explained", "a": counts[0], "b": counts[1]})
        return notice, Status.NO_CONSENSUS
    if found.beyond < options.min_chance_margin:
        return Notice(PairNotice.CHANCE, found.beyond), Status.NO_CONSENSUS
    return _assemble(seen, found, tracks, centres, torch.cat(often))


MIN_ACROSS_SIGMAS = 3.0  # motion across a line, over the noise
MOTION_ROUNDING = 1e-7  # motion over the extent of the points


def _unusable(tracks: list[Tensor], noise: tuple[float, float]) -> Notice | None:
    """Why the motion of one camera cannot be used, if so."""
    for name, x, sigma in zip("ab", tracks, noise, strict=True):
        moved = (x - x.mean(0)).flatten(0, 1)
        least, most = torch.linalg.eigvalsh(moved.mT @ moved / len(moved)).clamp(min=0).sqrt().tolist()
        extent = float((x - x.mean((0, 1))).square().mean().sqrt())
        # third differences of a fast motion are no noise: it is at least seven times as large
        if most <= max(MOTION_ROUNDING * extent, math.sqrt(2) * sigma):
            return Notice(PairNotice.STATIC_SCENE, most, {"which": name, "noise": sigma})
        if least <= max(MOTION_ROUNDING * extent, min(MIN_ACROSS_SIGMAS * sigma, 0.01 * most)):
            return Notice(PairNotice.COLLINEAR, least, {"which": name})
    return None


def _assemble(seen: Overlap, found: Transfer, tracks: list[Tensor], centres: list[Tensor], often: Tensor) -> PairReconstruction:
    """Cameras, trajectories, matches in the frame (u, w_a, w_b): along the common normal, and along the epipolar lines of each."""
    n, split = seen.a.shape[1], tracks[0].shape[1]
    kept = often.clone()
    kept[often] = found.good
    u, v = (_axes(normal) for normal in found.normals)
    first = (found.x + tracks[0].mean(0) - centres[0]) @ u.mT
    second = ((found.y + tracks[1].mean(0) - centres[1]) @ v.mT - found.normals.new_tensor([found.offset, 0.0])) / found.scale
    whole = torch.cat(
        [
            torch.cat([first, (second[..., 1] @ found.backward)[..., None]], dim=-1),
            torch.stack([second[..., 0], first[..., 1] @ found.forward, second[..., 1]], dim=-1),
        ],
        dim=1,
    )
    points = seen.a.new_full((len(first), len(often), 3), torch.nan)
    points[:, often] = torch.where(found.good[:, None], whole, torch.nan)
    cameras = seen.a.new_zeros(2, 3, 4)
    cameras[0, :2, 0], cameras[0, :2, 1] = u[0], u[1]
    cameras[1, :2, 0], cameras[1, :2, 2] = found.scale * v[0], found.scale * v[1]
    cameras[0, :2, 3], cameras[1, :2, 3] = centres[0], centres[1] + found.offset * v[0]
    cameras[:, 2, 3] = 1.0
    missed = torch.cat(
        [first[..., 0] - second[..., 0] @ found.backward, found.scale * (second[..., 0] - first[..., 0] @ found.forward)], dim=1
    )
    residuals, r2 = (points.new_full(often.shape, torch.nan) for _ in range(2))
    residuals[often] = torch.where(found.good, missed.square().mean(0).sqrt(), torch.nan)
    r2[often] = found.r2
    matches, distances = match_tracks(points, n, found.residual)
    places = {"a": split, "b": len(found.good) - split}
    return PairReconstruction(
        cameras=cameras,
        points=points,
        times=seen.times,
        source=(torch.arange(len(often), device=points.device) >= n).long(),
        labels=kept.long(),
        r2=r2,
        matches=matches,
        distances=distances,
        normals=found.normals,
        fundamental=_fundamental(cameras),
        residuals=residuals,
        residual=found.residual,
        status=torch.tensor(int(Status.OK), device=points.device),
        notices=() if found.affine else (Notice(PairNotice.FREE_PLACES, found.residual, places),),
    )


def _axes(normal: Tensor) -> Tensor:
    """Rows: the normal, and the direction of the epipolar lines."""
    return torch.stack([normal, torch.stack([-normal[1], normal[0]])])


def _fundamental(cameras: Tensor) -> Tensor:
    """Of affine cameras in the frame of the normals: :math:`m_b \\cdot y - o = c\\, m_a \\cdot x`."""
    normal, other = cameras[0, :2, 0], cameras[1, :2, 0]
    scale = other.square().sum()
    F = cameras.new_zeros(3, 3)
    F[:2, 2], F[2, :2] = other / scale, -normal
    F[2, 2] = normal @ cameras[0, :2, 3] - other @ cameras[1, :2, 3] / scale
    return F / torch.linalg.matrix_norm(F)

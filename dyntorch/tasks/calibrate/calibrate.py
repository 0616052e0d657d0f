"""Calibrate cameras on tripods from the people who move before them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from dyntorch.core.outcome import Notice, status_from
from dyntorch.geometry.homography import homography, homography_sampson_squared
from dyntorch.geometry.rigid import nearest_rotation
from dyntorch.numerics.arguments import check_options, on_cpu
from dyntorch.numerics.blocks import one_thread
from dyntorch.tasks.calibrate.adjustment import LENS, PARAMETERS
from dyntorch.tasks.calibrate.averaging import LAST_CUTOFFS, Graph, PairGeometry, pair_graph
from dyntorch.tasks.calibrate.bundle import (
    RAYLEIGH,
    Freedom,
    Pose,
    RigSolution,
    adjust_bundle,
    compare_starts,
    pose_of,
    triangulate_frames,
)
from dyntorch.tasks.calibrate.input import MIN_NOISE, Rig, RigViews, Scale, clocks_as_given, common_views, read_clocks, read_rig
from dyntorch.tasks.calibrate.result import Calibration, CalibrationNotice
from dyntorch.tasks.calibrate.world_frame import World, bodies, estimate_world
from dyntorch.tasks.synchronize.cameras import synchronize_cameras
from dyntorch.tasks.synchronize.result import Clocks


@dataclass(frozen=True)
class CalibrateOptions:
    """What a user can set in :func:`dyntorch.calibrate`: how much it takes, and what it may answer."""

    min_matches: int = 60
    """Positions that two cameras must see at the same moments: ten times the seven unknowns of F is little."""
    max_positions: int = 7_000
    """Points times moments that are adjusted, the moments evenly spread: half as many are 1.2 times as far off, in .6 of the time
    (20 rigs of 300 frames and 17 points)."""
    max_rotation_sigma: float = 0.8
    """Degrees: standard deviation of the rotation of a camera beyond which a rig is refused."""
    max_focal_sigma: float = 0.08
    """The same of the focal length, as a share: Pose2Sim's recording of 1.5 s leaves 5 to 6 %, is 4 to 6 % off, and its rotations
    are within 1.6 degrees."""
    max_center_sigma: float = 0.04
    """The same of a centre, as a share of the distance from the people."""


# ----------------------------------------------------------------------------------------------------------------------
# What the data leave open: motion that does not decide, rigs that fit as well, cameras that moved or do not belong.


def pose_differences(one: Pose, other: Pose) -> tuple[Tensor, Tensor]:
    """By how much the cameras of two solutions differ, after the similarity that fits most: degrees, hundredths of the
    distance."""
    turns = one.R.mT @ other.R
    turn = nearest_rotation(turns.sum(0))
    for _ in range(10):  # the rotation with the least sum of angles: a camera that moved has no say
        away = (turns - turn).flatten(1).norm(dim=-1).clamp(min=1e-6)
        turn = nearest_rotation((turns / away[:, None, None]).sum(0))
    relative = (one.R @ turn @ other.R.mT).diagonal(dim1=-2, dim2=-1).sum(-1)
    angle = torch.rad2deg(((relative - 1) / 2).clamp(-1, 1).arccos())
    a, b = one.centers, other.centers @ turn.mT
    away = torch.ones(len(a), dtype=torch.float64)
    for _ in range(10):
        share = (1 / away.clamp(min=1e-6) / (1 / away.clamp(min=1e-6)).sum())[:, None]
        p, q = a - (share * a).sum(0), b - (share * b).sum(0)
        scale = (share * p * q).sum() / (share * q.square()).sum().clamp(min=1e-300)
        away = (p - scale * q).norm(dim=-1)
    return angle, 100 * away / (a - one.middle).norm(dim=-1).clamp(min=1e-12)


def check_matches(graph: Graph, rig: Rig, options: CalibrateOptions) -> Notice | None:
    """Cameras that share too little with others to have a place in the rig."""
    together = bodies(torch.tensor(list(graph)).reshape(-1, 2), len(rig.tracks))
    lost = tuple(sorted(set(range(len(rig.tracks))) - set(together[0] if together else [0])))
    if not lost:
        return None
    return Notice(CalibrationNotice.APART, 0.0, {"cameras": lost, "needed": options.min_matches})


MIN_MOTION_SIGMAS = 2.0  # motion of the points over their noise


def check_motion(rig: Rig) -> Notice | None:
    """Whether no camera sees anything move."""
    ratios = []
    for track in rig.tracks:
        x = torch.where((track.weights > 0)[..., None], track.x, torch.nan)
        away = (x - x.nanmedian(0).values).norm(dim=-1)
        ratios.append(float(away.nanmedian()) / max(track.noise, MIN_NOISE))
    ratio = max(ratios)
    return Notice(CalibrationNotice.STILL, ratio) if ratio < MIN_MOTION_SIGMAS else None


MIN_PLANE_RATIO = 2.0  # residual of the best homography over that of F


def check_plane(graph: Graph) -> Notice | None:
    """Whether every pair of cameras sees one plane, as two cameras see people who walk along one line seen from the side."""
    ratios = {pair: _plane_residual(geometry) / geometry.sigma for pair, geometry in graph.items()}
    if not ratios or max(ratios.values()) > MIN_PLANE_RATIO:
        return None
    return Notice(CalibrationNotice.PLANE, max(ratios.values()), {"pairs": tuple(ratios)})


def _plane_residual(pair: PairGeometry) -> float:
    """Robust standard deviation, px, of what the best homography leaves, in both pictures: of a plane it is what F leaves."""
    scale = LAST_CUTOFFS[0] * pair.sigma / pair.unit
    H, _ = homography(pair.x1, pair.x2, pair.weights[None], scale)
    away = homography_sampson_squared(H[0], pair.x1, pair.x2).sqrt()
    return pair.unit * float(away[pair.weights > 0].median()) / RAYLEIGH


MIN_RIVAL_MARGIN = 10.0  # twice the logarithm of the likelihood ratio to another rig
MIN_RIVAL_DEGREES = 2.0  # from which on two rigs are different


def check_rivals(best: Pose, others: Sequence[tuple[Pose, float]]) -> Notice | None:
    """Another solution that differs and is hardly worse."""
    for pose, worse in others:
        angle = float(pose_differences(best, pose)[0].max())
        if worse < MIN_RIVAL_MARGIN and angle > MIN_RIVAL_DEGREES:
            return Notice(CalibrationNotice.RIVAL, angle)
    return None


MAX_LINE_SPREAD = 0.06  # of the cameras across a line over that along it


def are_collinear(centers: Tensor) -> bool:
    """Whether three cameras or more stand nearly in a line."""
    if len(centers) < 3:
        return False
    spread = torch.linalg.svdvals(centers - centers.mean(0))
    return bool(spread[1] < MAX_LINE_SPREAD * spread[0])


def check_sigmas(found: RigSolution, rig: Rig, options: CalibrateOptions) -> Notice | None:
    """Whether standard deviations are too large, the focal lengths first: they are what most often stays open."""
    variance = found.covariance.diagonal(dim1=-2, dim2=-1)
    if len(rig.tracks) == 2 and not bool(rig.focals.isfinite().any()) and not rig.one_lens:
        return Notice(CalibrationNotice.TWO_FOCALS)
    pose = found.pose
    center = variance[:, 3:6].sum(-1).sqrt() / (pose.centers - pose.middle).norm(dim=-1)
    for code, unit, sigma, limit in (
        (CalibrationNotice.FOCAL, 100, variance[:, 6].sqrt(), options.max_focal_sigma),
        (CalibrationNotice.ROTATION, 1, torch.rad2deg(variance[:, :3].sum(-1).sqrt()), options.max_rotation_sigma),
        (CalibrationNotice.CENTER, 100, center, options.max_center_sigma),
    ):
        if float(sigma.max()) > limit:
            case = {"case": "line"} if code == CalibrationNotice.FOCAL and are_collinear(pose.centers) else {}
            return Notice(code, unit * float(sigma.max()), {"cameras": tuple((sigma > limit).nonzero().flatten().tolist()), **case})
    return None


MIN_INLIER_SHARE = 0.6  # of the positions of a camera


def check_inliers(inliers: Tensor) -> Notice | None:
    """Cameras most of whose positions do not agree with the others."""
    which = tuple((inliers < MIN_INLIER_SHARE).nonzero().flatten().tolist())
    return Notice(CalibrationNotice.DISAGREES, 100 * float(inliers.min()), {"cameras": which}) if which else None


MAX_MOVED_DEGREES = 1.5  # between the poses of a camera in both halves of the recording
MAX_MOVED_PERCENT = 4.5  # the same of its place, hundredths of its distance from the people
MAX_MOVED_SIGMAS = 5.0  # the same in standard deviations


def check_halves(halves: tuple[RigSolution, RigSolution] | None) -> Notice | None:
    """Cameras whose poses in both halves of the take differ by more than they may."""
    if halves is None:
        return None
    one, other = halves
    angle, away = pose_differences(one.pose, other.pose)
    variance = one.covariance.diagonal(dim1=-2, dim2=-1) + other.covariance.diagonal(dim1=-2, dim2=-1)
    sigma = torch.rad2deg(variance[:, :3].sum(-1).sqrt())
    far = (one.pose.centers - one.pose.middle).norm(dim=-1)
    spread = 100 * variance[:, 3:6].sum(-1).sqrt() / far
    turned = (angle > MAX_MOVED_DEGREES) & (angle > MAX_MOVED_SIGMAS * sigma)
    went = (away > MAX_MOVED_PERCENT) & (away > MAX_MOVED_SIGMAS * spread)
    which = turned | went
    if not bool(which.any()):
        return None
    # the one that moved pulls at the others: it is the farthest
    worst = int(torch.where(which, angle + away, -1.0).argmax())
    return Notice(CalibrationNotice.MOVED, float(angle[worst]), {"cameras": (worst,)})


# ----------------------------------------------------------------------------------------------------------------------
# The verb.


NUM_START_MOMENTS = 60  # evenly spread, at which starts and halves are adjusted


@one_thread
@on_cpu
def calibrate(
    tracks: Sequence[Tensor],
    fps: float | Sequence[float] = 30.0,
    sizes: Any = None,
    *,
    focal: float | Sequence[float | None] | None = None,
    clocks: Any = None,
    height: float | None = None,
    lengths: Mapping[tuple[int, int], float] | None = None,
    times: Sequence[Tensor | None] | None = None,
    weights: Sequence[Tensor] | None = None,
    calibration: Sequence[Any] | None = None,
    one_lens: bool = False,
    max_shift: float | None = None,
    rate: float | None = None,
    options: CalibrateOptions | None = None,
) -> Calibration:
    r"""Cameras, lenses and clocks from what moves before them: no board, no known lens, no common clock.

    The stages:

    1. clocks of all pairs from the same tracks (:func:`dyntorch.synchronize_cameras`);
    2. F of every pair at common moments; for focal lengths that are tried, rotations and centres by averaging over the pairs;
    3. the best of these starts adjusted: cameras, focal lengths, one term of distortion, clocks and points at once (see
       ``bundle.py`` for what is minimized);
    4. up from upright bodies, the scale from a height or lengths;
    5. what the data leave open: standard deviations, rival rigs, halves of the take.

    It computes on the CPU wherever its tensors are, and the result returns to their device.

    Args:
        tracks: per camera ``(frames, n, 2)`` px, NaN = missing; point k is point k in all of them.  Several people stand side by
            side.
        fps: frames per second, of all cameras or of each.
        sizes: width and height of the pictures in px, of all cameras or of each.
        focal: focal length in px, of all cameras or of each; None = unknown.
        clocks: None = unknown; else offsets in seconds ``(c,)``, offsets and rates ``(c, 2)``, or what ``synchronize_cameras``
            returned: these are held.
        height: metres between the highest and the lowest point of the tallest body when it stands upright.
        lengths: metres between points (k, l), instead of ``height``.
        times: per camera ``(frames,)`` seconds of its clock, instead of ``fps``.
        weights: per camera ``(frames, n)``, confidences of the positions; 0 = ignore.
        calibration: per camera ``(K, dist)`` of a known lens as for ``synchronize_cameras``, or None.
        one_lens: whether focal length and distortion are the same in all cameras.
        max_shift: seconds that clocks differ by at most.
        rate: of all clocks against the first one's, which is held, such as 1 where one clock drives all cameras; by default found.
        options: :class:`~dyntorch.tasks.calibrate.calibrate.CalibrateOptions`; None = the defaults.

    Returns:
        See :class:`dyntorch.Calibration`; ``ok`` is False, and ``reason`` says why, where the data do not decide.

    Raises:
        ValueError: fewer than two cameras or more than eight, tracks of other points, sizes that contradict the positions, a camera
            that is given twice, cameras that never run at the same time, or numbers that are none.

    Source: thesis, chapter 7 for the clocks; Triggs et al. 2000; Pan et al. 2024; Lee et al. 2022, Extrinsic camera calibration
    from a moving person, which takes known lenses and clocks.

    Example:
        >>> import torch
        >>> from dyntorch.geometry.rigid import rotation_exponential
        >>> g = torch.Generator().manual_seed(0)
        >>> t = torch.arange(120, dtype=torch.float64)[:, None, None] / 30
        >>> way = torch.randn(3, 8, 3, generator=g, dtype=torch.float64)
        >>> body = 0.4 * way[0] + 0.6 * torch.sin(1.3 * t + way[1]) + 0.3 * torch.sin(2.9 * t + way[2])
        >>> tracks = []
        >>> for k in range(4):
        ...     turn = rotation_exponential(torch.tensor([0.3 * (k % 2), 1.5 * k, 0.0], dtype=torch.float64))
        ...     seen = body @ turn.mT + torch.tensor([0.1 * k, 0.0, 5.0], dtype=torch.float64)
        ...     tracks.append(1500 * seen[..., :2] / seen[..., 2:] + torch.tensor([960.0, 540.0], dtype=torch.float64))
        >>> rig = calibrate(tracks, fps=30.0, sizes=(1920, 1080), clocks=[0.0, 0.0, 0.0, 0.0])
        >>> rig.ok, [round(f, -1) for f in rig.focals.tolist()]
        (True, [1500.0, 1500.0, 1500.0, 1500.0])
    """
    options = CalibrateOptions() if options is None else options
    check_options(options, CalibrateOptions)
    if sizes is None:
        raise ValueError("sizes: give the width and height of the pictures in px, (w, h), or one pair per camera")
    rig = read_rig(tracks, fps, times, sizes, focal, calibration, weights, one_lens, Scale(height, lengths))
    n = rig.tracks[0].x.shape[1]
    # 1. clocks
    found_clocks = _clocks(rig, clocks, max_shift, rate)
    notices = _clock_notices(found_clocks)
    if bool(found_clocks.offsets.isnan().any()):
        return Calibration.unknown(rig.sizes, n, found_clocks, rig.fps, notices)
    # 2. first cameras
    values = torch.stack([found_clocks.offsets, found_clocks.rates], dim=-1)
    views = common_views(rig.tracks, rig.centers, values)
    own = torch.stack([(values[:, 1] - 1) * views.middle + values[:, 0], values[:, 1].log()], dim=-1)
    used = views.thin(max(1, math.ceil(options.max_positions / n)))
    graph = pair_graph(used, own, options.min_matches)
    hopeless = check_matches(graph, rig, options) or check_motion(rig)
    if hopeless is not None:
        return Calibration.unknown(rig.sizes, n, found_clocks, rig.fps, (*notices, hopeless))
    freedom = Freedom.of(rig, own, clocks is not None, rate is not None, found_clocks.rate_sigmas)
    few = used.thin(NUM_START_MOMENTS)
    starts, worse = compare_starts(rig, few, graph, own, freedom)
    # 3. space and time at once
    best = adjust_bundle(used, starts.of(torch.tensor([0])), freedom)
    halves = _adjust_halves(used, best, freedom)
    # 4. the world, and the points of every frame
    others = [(pose_of(starts, k), float(worse[k])) for k in range(1, len(worse))]
    limits = [check_plane(graph), check_sigmas(best, rig, options), check_rivals(pose_of(starts), others), check_halves(halves)]
    return _result(rig, views, best, found_clocks, [*notices, *(limit for limit in limits if limit is not None)])


def _clocks(rig: Rig, clocks: Any, max_shift: float | None, rate: float | None) -> Clocks:
    """As given, or as the tracks say."""
    c = len(rig.tracks)
    if clocks is not None:
        return clocks_as_given(clocks, read_clocks(clocks, c), float(rig.tracks[0].times.mean()))
    return synchronize_cameras(
        rig.x,
        times=[track.times for track in rig.tracks],
        weights=[track.weights for track in rig.tracks],
        max_shift=max_shift,
        rate=rate,
    )


def _clock_notices(clocks: Clocks) -> tuple[Notice, ...]:
    """What synchronization says that concerns the rig."""
    if not clocks.ok:
        # the sentence itself, so that whoever prints it names its cameras and arguments
        first = next((notice.text for notice in clocks.notices if notice.code.refuses is not None), clocks.reason)
        return (Notice(CalibrationNotice.CLOCKS, 0.0, {"first": first}),)
    return ()


MIN_HALF_POSITIONS = 1_000  # that a half must have to be judged by itself
MIN_HALF_SECONDS = 2.5  # a detector's error goes on for a second and looks like a camera that moved


def _adjust_halves(views: RigViews, best: RigSolution, freedom: Freedom) -> tuple[RigSolution, RigSolution] | None:
    """Both halves of the take by themselves, from the whole; None where a half has too little."""
    held = replace(freedom, whole=_pose_columns(freedom.whole), shape=_pose_columns(freedom.shape))
    found = []
    for part in (views.between(-math.inf, 0.0), views.between(0.0, math.inf)):
        if not len(part.times) or float(part.times.abs().max()) < MIN_HALF_SECONDS:
            return None
        if int((part.steady_weights(best.state.clocks) > 0).sum()) < MIN_HALF_POSITIONS:
            return None
        few = part.thin(NUM_START_MOMENTS)
        found.append(adjust_bundle(few, best.state, held))
    return found[0], found[1]


def _pose_columns(basis: Tensor) -> Tensor:
    """The columns that change nothing but poses."""
    other = basis.view(-1, PARAMETERS, basis.shape[1])[:, LENS.start :].abs().sum((0, 1))
    return basis[:, other == 0]


def _result(rig: Rig, views: RigViews, best: RigSolution, clocks: Clocks, limits: list[Notice]) -> Calibration:
    """The solution in its world, with the points of all frames."""
    state, c = best.state, len(rig.tracks)
    found = triangulate_frames(views, best)
    foreign = check_inliers(found.inliers)
    limits += [foreign] if foreign is not None else []
    world = estimate_world(state.R[0], state.centers[0], found.points, rig.scale)
    R, t = world.cameras(state.R[0], state.t[0])
    K = torch.eye(3, dtype=torch.float64).repeat(c, 1, 1)
    K[:, 0, 0] = K[:, 1, 1] = state.lens[0, :, 0].exp()
    K[:, :2, 2] = rig.centers
    distortion = torch.zeros(c, max([5, *(len(lens[1]) for lens in rig.lenses if lens is not None)]), dtype=torch.float64)
    distortion[:, :2] = state.lens[0, :, 1:]
    for i, lens in enumerate(rig.lenses):
        if lens is not None:
            K[i], distortion[i, : len(lens[1])] = lens
    if not any(limit.code.refuses for limit in limits):
        limits += _more_notices(rig, world, state.centers[0])
    return Calibration(
        K=K, R=R, t=t, distortion=distortion, sizes=rig.sizes,
        clocks=_adjusted_clocks(clocks, best, views.middle),
        times=views.times + views.middle,
        points=world.points(found.points),
        sigmas=world.scale * found.sigmas,
        metric=world.metric, upright=world.by_people,
        covariance=_covariance_in_world(best.covariance, world),
        residuals=found.residuals, inliers=found.inliers, fps=rig.fps,
        status=status_from(limits), notices=tuple(limits),
    )  # fmt: skip


def _more_notices(rig: Rig, world: World, centers: Tensor) -> list[Notice]:
    """What to know beside a good result."""
    found = []
    if len(rig.tracks) == 2:
        found.append(Notice(CalibrationNotice.TWO))
    if are_collinear(centers):
        found.append(Notice(CalibrationNotice.LINE))
    if not world.metric:
        found.append(Notice(CalibrationNotice.UNKNOWN_SCALE))
    if not world.by_people:
        found.append(Notice(CalibrationNotice.CAMERA_UP, 100 * (0.0 if math.isnan(world.upright) else world.upright)))
    return found


def _adjusted_clocks(clocks: Clocks, best: RigSolution, middle: float) -> Clocks:
    """Offsets and rates after the adjustment, and their standard deviations at the middle."""
    values, variance = best.state.clocks[0], best.covariance.diagonal(dim1=-2, dim2=-1)
    rates = values[:, 1].exp()
    if not bool(variance[:, 9:].any()):
        return clocks
    return replace(
        clocks, offsets=values[:, 0] - (rates - 1) * middle, rates=rates, sigmas=variance[:, 9].sqrt(),
        rate_sigmas=variance[:, 10].sqrt() * rates, center=middle,
    )  # fmt: skip


def _covariance_in_world(covariance: Tensor, world: World) -> Tensor:
    """Centres of the world's coordinates; what else a covariance is about does not change with them."""
    change = torch.eye(covariance.shape[-1], dtype=torch.float64)
    change[3:6, 3:6] = world.scale * world.turn
    return change @ covariance @ change.mT

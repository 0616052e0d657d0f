"""What the data leave open: motion that does not decide, rigs that fit as well, cameras that moved or do not belong."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from dyntorch.core.outcome import Notice
from dyntorch.geometry.homography import homography, homography_sampson_squared
from dyntorch.geometry.rigid import nearest_rotation
from dyntorch.tasks.calibrate.averaging import LAST_CUTOFFS, Graph, PairGeometry
from dyntorch.tasks.calibrate.bundle import RAYLEIGH, Pose, RigSolution
from dyntorch.tasks.calibrate.input import Rig
from dyntorch.tasks.calibrate.observations import MIN_NOISE
from dyntorch.tasks.calibrate.options import CalibrateOptions
from dyntorch.tasks.calibrate.result import CalibrationNotice
from dyntorch.tasks.calibrate.world_frame import bodies


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
    focal = variance[:, 6].sqrt()
    pose = found.pose
    if float(focal.max()) > options.max_focal_sigma:
        case = "line" if are_collinear(pose.centers) else ""
        which = tuple((focal > options.max_focal_sigma).nonzero().flatten().tolist())
        return Notice(CalibrationNotice.FOCAL, 100 * float(focal.max()), {"case": case, "cameras": which})
    turn = torch.rad2deg(variance[:, :3].sum(-1).sqrt())
    if float(turn.max()) > options.max_rotation_sigma:
        which = tuple((turn > options.max_rotation_sigma).nonzero().flatten().tolist())
        return Notice(CalibrationNotice.ROTATION, float(turn.max()), {"cameras": which})
    away = variance[:, 3:6].sum(-1).sqrt() / (pose.centers - pose.middle).norm(dim=-1)
    if float(away.max()) > options.max_center_sigma:
        which = tuple((away > options.max_center_sigma).nonzero().flatten().tolist())
        return Notice(CalibrationNotice.CENTER, 100 * float(away.max()), {"cameras": which})
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

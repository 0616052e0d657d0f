"""What the data leave open: motion that does not decide, rigs that fit as well, cameras that moved or do not belong."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from dyntorch.core.outcome import Notice
from dyntorch.geometry.homogeneous import homogeneous
from dyntorch.geometry.rigid import nearest_rotation
from dyntorch.tasks.calibrate.adjusting import Pose, RigSolution
from dyntorch.tasks.calibrate.averaging import Graph, PairGeometry
from dyntorch.tasks.calibrate.input import Rig
from dyntorch.tasks.calibrate.options import CalibrateOptions
from dyntorch.tasks.calibrate.result import CalibrationNotice


def differences(one: Pose, other: Pose) -> tuple[Tensor, Tensor]:
    """By how much the cameras of two solutions differ, after the similarity that fits most: degrees, hundredths of the distance.

    Args:
        one, other: the same cameras.

    Returns:
        ``(c,)`` each.
    """
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


def unmatched(graph: Graph, rig: Rig, options: CalibrateOptions) -> Notice | None:
    """Cameras that share too little with others to have a place in the rig."""
    c = len(rig.tracks)
    reached = {0}
    for _ in range(c):
        reached |= {camera for pair in graph if reached & set(pair) for camera in pair}
    lost = tuple(camera for camera in range(c) if camera not in reached)
    if len(lost) == c - 1 and c > 2:
        lost = (0,) if len({camera for pair in graph for camera in pair}) == c - 1 else lost
    if not lost:
        return None
    return Notice(CalibrationNotice.APART, 0.0, {"cameras": lost, "needed": options.input.fewest_matches})


def still(rig: Rig, options: CalibrateOptions) -> Notice | None:
    """Whether no camera sees anything move."""
    ratios = []
    for track in rig.tracks:
        x = torch.where((track.weights > 0)[..., None], track.x, torch.nan)
        away = (x - x.nanmedian(0).values).norm(dim=-1)
        ratios.append(float(away.nanmedian()) / max(track.noise, options.adjust.least_noise))
    ratio = max(ratios)
    return Notice(CalibrationNotice.STILL, ratio) if ratio < options.trust.still else None


def planar(graph: Graph, options: CalibrateOptions) -> Notice | None:
    """Whether every pair of cameras sees one plane, as two cameras see people who walk along one line seen from the side."""
    ratios = {pair: _plane_residual(geometry) / geometry.sigma for pair, geometry in graph.items()}
    if not ratios or max(ratios.values()) > options.trust.plane:
        return None
    return Notice(CalibrationNotice.PLANE, max(ratios.values()), {"pairs": tuple(ratios)})


def _plane_residual(pair: PairGeometry) -> float:
    """Robust standard deviation, px, across the lines of F of what the best homography predicts.

    Both are one coordinate of an error: a homography that is right leaves what F leaves, along the lines as across them.
    """
    one, two = homogeneous(pair.x1), homogeneous(pair.x2)
    # a camera that sees the plane from its edge predicts nothing of the other picture, but that predicts its own
    scale = min(_transfer_residual(one, two, pair.weights), _transfer_residual(two, one, pair.weights))
    # the median of a distance in two coordinates is 1.18 standard deviations of one; both pictures share the error
    return scale * pair.unit / 1.18 / math.sqrt(2)


def _transfer_residual(one: Tensor, two: Tensor, given: Tensor) -> float:
    """Median distance of points ``(m, 3)`` from where the best homography of others puts them, reweighted until it stays."""
    weights, scale = given, given.new_zeros(())
    for _ in range(6):
        zero = torch.zeros_like(one)
        first = torch.cat([one, zero, -two[:, :1] * one], dim=-1) * weights[:, None]
        second = torch.cat([zero, one, -two[:, 1:2] * one], dim=-1) * weights[:, None]
        rows = torch.cat([first, second])
        H = torch.linalg.eigh(rows.mT @ rows).eigenvectors[:, 0].view(3, 3)
        image = one @ H.mT
        away = (image[:, :2] / image[:, 2:] - two[:, :2]).norm(dim=-1).nan_to_num(1e3)
        scale = away[given > 0].median().clamp(min=1e-9)
        weights = given / (1 + (away / scale).square()) / image[:, 2].abs().clamp(min=1e-6)
    return float(scale)


def rival(best: Pose, others: Sequence[tuple[Pose, float]], options: CalibrateOptions) -> Notice | None:
    """Another solution that differs and is hardly worse.

    Args:
        best: the solution.
        others: solutions with twice the logarithm of how much less likely they are.
        options: see :class:`CalibrateOptions`.
    """
    for pose, worse in others:
        angle = float(differences(best, pose)[0].max())
        if worse < options.trust.rival and angle > options.trust.apart:
            return Notice(CalibrationNotice.RIVAL, angle)
    return None


def collinear(centers: Tensor) -> bool:
    """Whether three cameras or more stand nearly in a line."""
    if len(centers) < 3:
        return False
    spread = torch.linalg.svdvals(centers - centers.mean(0))
    return bool(spread[1] < 0.06 * spread[0])


def unsure(found: RigSolution, rig: Rig, options: CalibrateOptions) -> Notice | None:
    """Whether standard deviations are too large, the focal lengths first: they are what most often stays open."""
    variance = found.covariance.diagonal(dim1=-2, dim2=-1)
    if len(rig.tracks) == 2 and not bool(rig.focals.isfinite().any()) and not rig.one_lens:
        return Notice(CalibrationNotice.TWO_FOCALS)
    focal = variance[:, 6].sqrt()
    pose = found.pose
    if float(focal.max()) > options.trust.focal:
        case = "line" if collinear(pose.centers) else ""
        which = tuple((focal > options.trust.focal).nonzero().flatten().tolist())
        return Notice(CalibrationNotice.FOCAL, 100 * float(focal.max()), {"case": case, "cameras": which})
    turn = torch.rad2deg(variance[:, :3].sum(-1).sqrt())
    if float(turn.max()) > options.trust.rotation:
        which = tuple((turn > options.trust.rotation).nonzero().flatten().tolist())
        return Notice(CalibrationNotice.ROTATION, float(turn.max()), {"cameras": which})
    away = variance[:, 3:6].sum(-1).sqrt() / (pose.centers - pose.middle).norm(dim=-1)
    if float(away.max()) > options.trust.center:
        which = tuple((away > options.trust.center).nonzero().flatten().tolist())
        return Notice(CalibrationNotice.CENTER, 100 * float(away.max()), {"cameras": which})
    return None


def foreign(inliers: Tensor, options: CalibrateOptions) -> Notice | None:
    """Cameras most of whose positions do not agree with the others."""
    which = tuple((inliers < options.trust.agree).nonzero().flatten().tolist())
    return Notice(CalibrationNotice.DISAGREES, 100 * float(inliers.min()), {"cameras": which}) if which else None


def moved(halves: tuple[RigSolution, RigSolution] | None, options: CalibrateOptions) -> Notice | None:
    """Cameras whose poses in both halves of the take differ by more than they may."""
    if halves is None:
        return None
    one, other = halves
    angle, away = differences(one.pose, other.pose)
    variance = one.covariance.diagonal(dim1=-2, dim2=-1) + other.covariance.diagonal(dim1=-2, dim2=-1)
    sigma = torch.rad2deg(variance[:, :3].sum(-1).sqrt())
    far = (one.pose.centers - one.pose.middle).norm(dim=-1)
    spread = 100 * variance[:, 3:6].sum(-1).sqrt() / far
    turned = (angle > options.trust.moved) & (angle > options.trust.moved_sigmas * sigma)
    went = (away > 3 * options.trust.moved) & (away > options.trust.moved_sigmas * spread)
    which = turned | went
    if not bool(which.any()):
        return None
    # the one that moved pulls at the others: it is the farthest
    worst = int(torch.where(which, angle + away, -1.0).argmax())
    return Notice(CalibrationNotice.MOVED, float(angle[worst]), {"cameras": (worst,)})

"""What should be known about the matches of a plane before its result is trusted."""

from __future__ import annotations

import torch
from torch import Tensor

from dyntorch.algebra.homogeneous import homogeneous, inhomogeneous
from dyntorch.algebra.rank_two import cofactors
from dyntorch.chi_square import three_sigma
from dyntorch.fitting import fit_matches
from dyntorch.invariants.agreement import static_residual
from dyntorch.invariants.homography_tensor import HomographyTensor
from dyntorch.matches import Matches
from dyntorch.solution import Status, failed
from dyntorch.tasks.alignment import MOVING, OUTLIER, STATIC
from dyntorch.tasks.labelling import Evidence, Labelled
from dyntorch.tasks.notices import Notice, NoticeCode, notices

RANK = 1e-9
"""Singular value of the estimation matrix, over the largest, that rounding alone leaves."""
NEAR = 2.0
"""Strength of the weakest equation of the tensor: 0.4 to 0.7 where all stands still, 1.3 to 1.6 where points move by 1 to 5 pixels
at 0.5 pixels of noise, 15 to 25 where they move by 25 to 80 (100 matches)."""
UNDECIDED = 1.2
"""The same, corrected for the matches that 26 equations use up, below which moving matches alone leave a family of motions.  0.7 to
0.9 where all make equal steps (80 matches), 0.5 where all stands still; at 3 px of motion at changing speed on either side."""
SUPPORT, CHANCE = 10, 3.0
"""Static matches that settle such a family: so many, and so many for each that is expected by chance.  A motion of the family that
is off makes 0 to 6 of 80 matches static at steps of 10 to 40 px, and up to 16 at 3 px, where 3 to 5 are expected."""
WIDER = 3.0
"""Times the limit of static matches within which those that are static by chance spread evenly, over a plane of velocities."""
THIN = 3.0
"""Standard deviations of the noise across a line of points, below which they may as well lie on it."""
ROOM = 3.0
"""Standard deviations of the noise within which a match belongs to a trajectory line."""
LINES, FEWEST = 4, 16
"""Trajectory lines, and moving matches, that the tensor needs where nothing stands still (thesis chapter 2)."""
MINIMAL = 4
"""Static matches that determine the motion."""


def planar_notices(
    evidence: Evidence, best: Labelled, tensor: tuple[Tensor, Tensor], status: Tensor, batch: tuple[int, ...]
) -> tuple[Notice, ...]:
    """All notices on a flat batch of problems with final labels, in the order of the problems; ``tensor`` from
    :func:`tensor_rank`."""
    data, sigma = evidence.data, best.sigma
    rank, strength = tensor
    solved = ~failed(status)
    moving = best.labels == MOVING
    count = moving.sum(-1)
    found: list[Notice] = []

    def note(code: NoticeCode, message: str, values: Tensor, flagged: Tensor) -> None:
        found.extend(notices(code, message, values, flagged, batch))

    text = "the matches leave {value:g} of 26 equations on the tensor; the motion rests on its static matches"
    note(NoticeCode.DEGENERATE, text, rank, solved & (rank < HomographyTensor.width() - 1))
    text = "the weakest equation on the tensor is only {value:.2g} times the noise; the motion rests on its static matches"
    note(NoticeCode.NEAR_STATIC, text, strength, solved & (rank >= HomographyTensor.width() - 1) & (strength < NEAR))
    text = "the moving matches fit a family of motions, and only {value:g} static ones choose among them; give more static matches"
    family = (status == Status.AMBIGUOUS) & undecided(evidence, best, tensor)
    note(NoticeCode.OTHER_SOLUTION, text, (best.labels == STATIC).sum(-1), family)
    text = f"{{value:g}} matches move, {FEWEST} would determine the motion without static ones"
    note(NoticeCode.FEW_MOVING, text, count, solved & (count < FEWEST))
    lines = trajectory_lines(evidence, best, moving)
    text = f"the moving matches lie on {{value:g}} lines, {LINES} would determine the motion without static ones"
    note(NoticeCode.FEW_LINES, text, lines, solved & (lines > 0) & (lines < LINES))
    note(NoticeCode.ONE_LINE, "all moving matches lie on one line", lines, solved & (lines == 1))
    thin = thinness(evidence, sigma)
    text = "the points of a view lie on a line, to {value:.2g} standard deviations; a plane needs points off it"
    note(NoticeCode.COLLINEAR, text, thin, (data.weights > 0).any(-1) & (thin < THIN))
    doubtful = (best.labels == MOVING) & unverified(evidence, best)
    text = "{value:g} matches stand still between two views only: a point that paused, or a static one mismatched in one view"
    note(NoticeCode.UNVERIFIED, text, doubtful.sum(-1), solved & doubtful.any(-1))
    return tuple(sorted(found, key=lambda notice: notice.problem))


def tensor_rank(inliers: Matches, evidence: Evidence, sigma: Tensor) -> tuple[Tensor, Tensor]:
    """Numeric rank ``(b,)`` of the estimation matrix, and how far its 26th singular value is above the noise."""
    values = fit_matches(HomographyTensor(), inliers).singular_values
    rank = (values > RANK * values[:, :1]).sum(-1)
    # a row of unit length changes by about the noise of the normalized coordinates
    noise = sigma * torch.stack(evidence.norm.scales).square().mean(0).sqrt() * inliers.weights.square().sum(-1).sqrt()
    return rank, values[:, -2] / noise.clamp(min=torch.finfo(values.dtype).tiny)


def undecided(evidence: Evidence, best: Labelled, tensor: tuple[Tensor, Tensor]) -> Tensor:
    """Where the moving matches leave a family of motions ``(b,)``, and no more are static than some motion of it makes by chance.

    Points that make equal steps move as straight if the camera moves along at any velocity common to all.  The motion that makes
    most of them static is the true one if these are many; else some happen to have about that velocity.
    """
    rank, strength = tensor
    used = (best.labels != OUTLIER).sum(-1)
    equations = HomographyTensor.width() - 1
    spare = ((used - equations).clamp(min=1) / used.clamp(min=1)).sqrt()
    family = (rank >= equations) & (strength < UNDECIDED * spare)
    still = (best.labels == STATIC) & (evidence.data.weights > 0)
    if evidence.data.static is not None:
        family = family & ((still & evidence.data.static).sum(-1) < MINIMAL)
    square = evidence.residuals(best.theta)[1].square().sum(-1)
    limit = WIDER**2 * three_sigma(4) * best.sigma.square()[:, None]
    beside = ((square <= limit) & ~still & (evidence.data.weights > 0)).sum(-1)
    return family & (still.sum(-1) < SUPPORT + CHANCE * beside / (WIDER**2 - 1))


def unverified(evidence: Evidence, best: Labelled) -> Tensor:
    """Matches ``(b, n)`` that two views agree on as static, whatever the third says."""
    parts = evidence.problem(best.labels).parts(best.theta)
    first, second, third = evidence.views
    s1, s2, s3 = evidence.norm.scales
    between = cofactors(parts[0]).mT @ parts[1]  # view 3 to view 2
    pairs = (
        static_residual([parts[0]], (first, second), (s1, s2)),
        static_residual([parts[1]], (first, third), (s1, s3)),
        static_residual([between], (second, third), (s2, s3)),
    )
    limit = three_sigma(2) * best.sigma.square()[:, None]
    agree = torch.stack([pair.square().sum(-1) <= limit for pair in pairs])
    return agree.any(0) & (evidence.data.weights > 0)


def trajectory_lines(evidence: Evidence, best: Labelled, moving: Tensor) -> Tensor:
    """How many lines hold the paths of all moving matches ``(b,)``, counted up to LINES.

    Greedy: the longest path determines its line best; all matches on that line go, and so on.
    """
    parts = evidence.problem(best.labels).parts(best.theta)
    places = torch.stack(
        [evidence.views[0], *(inhomogeneous(homogeneous(x) @ m.mT) for m, x in zip(parts, evidence.views[1:], strict=True))]
    )
    ends = torch.stack([places[1] - places[0], places[2] - places[0], places[2] - places[1]])
    length, widest = ends.norm(dim=-1).max(dim=0)
    along = ends.gather(0, widest[None, ..., None].expand(1, -1, -1, 2))[0] / length[..., None].clamp(min=1e-12)
    normal = torch.stack([-along[..., 1], along[..., 0]], dim=-1)
    problem = torch.arange(len(length), device=length.device)
    left, count = moving, torch.zeros(len(length), dtype=torch.long, device=length.device)
    noise = ROOM * (evidence.norm.scales[0] * best.sigma)[:, None]
    for _ in range(LINES):
        longest = torch.where(left, length, -1.0).argmax(-1)
        centre, across, base = places[:, problem, longest].mean(0), normal[problem, longest], length[problem, longest]
        offset = places - centre[:, None]
        distance = (offset * across[:, None]).sum(-1).abs()
        # away from the path its line is known by angle only
        reach = 1 + offset.norm(dim=-1) / base[:, None].clamp(min=1e-12)
        count = count + left.any(-1)
        left = left & ~(distance <= noise * reach).all(0)
        left = left.index_put((problem, longest), torch.zeros_like(problem, dtype=torch.bool))
    return count


def thinness(evidence: Evidence, sigma: Tensor) -> Tensor:
    """Least standard deviation of the points across their main direction, over the views, in standard deviations of the noise."""
    weights = (evidence.data.weights > 0).double()
    share = weights / weights.sum(-1, keepdim=True).clamp(min=1.0)
    found = []
    for x, scale in zip(evidence.views, evidence.norm.scales, strict=True):
        centred = x - (share[..., None] * x).sum(-2, keepdim=True)
        covariance = (share[..., None] * centred).mT @ centred
        # the smaller eigenvalue of a symmetric 2 x 2 matrix
        mean, det = covariance.diagonal(dim1=-2, dim2=-1).sum(-1) / 2, torch.linalg.det(covariance)
        across = det / (mean + (mean.square() - det).clamp(min=0).sqrt()).clamp(min=torch.finfo(mean.dtype).tiny)
        found.append(across.clamp(min=0).sqrt() / (scale * sigma.maximum(evidence.floor)))
    return torch.stack(found).amin(0)

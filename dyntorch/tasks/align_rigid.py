"""Rigid motions of a metric sensor among points that move, as few as there are, up to all of them."""

from __future__ import annotations

import torch
from torch import Tensor

from dyntorch.algebra.homogeneous import similarity
from dyntorch.algebra.rigid import rigid_alignment
from dyntorch.chi_square import three_sigma
from dyntorch.eigenspace import spectrum
from dyntorch.matches import Matches
from dyntorch.solution import NOISY, Status, failed
from dyntorch.tasks.alignment import MOVING, OUTLIER, STATIC, Alignment
from dyntorch.tasks.labelling import SIGMAS
from dyntorch.tasks.notices import Notice, NoticeCode, notices
from dyntorch.tasks.rigid import MOTIONS, Sightings, combinations, squares
from dyntorch.tasks.rigid_search import Rigid, search

MINIMAL = {"straight": 6, "constant_velocity": 3}
"""Moving matches for the 12 (9) degrees of freedom, at 2 (3) conditions each; static ones give 6."""
INDETERMINATE = 1e-10  # information on the worst direction over that on the best: rounding error below it
AMBIGUOUS = 0.3
"""Standard deviation of the worst direction, in radians or sizes of the scene, above which the motion is not known at all."""
UNCERTAIN = 0.05
"""The same, from where a notice says so: 3 degrees."""
CONSENSUS = 0.4  # share of inliers below which the best motion may be an accident
SPARE = 4  # conditions beyond the degrees of freedom: a minimal set fulfils those whatever it is

AMBIGUITY = {
    "straight": (
        "A and B are unique with their scale, unless all points keep one ratio of their two steps (constant velocity): then the "
        "translations are known up to a velocity common to all points."
    ),
    "constant_velocity": (
        "A velocity common to all points cannot be told from a motion of the sensor: the largest group of matches of one velocity "
        "(at least 3 and a tenth of all) is taken as static; without it the mean velocity is taken as zero."
    ),
}


def align_rigid(data: Matches, threshold: float | None, motion: str, generator: torch.Generator | None) -> Alignment:
    """:func:`dyntorch.align_points` with ``model="rigid"``, for checked matches."""
    weights = data.weights / data.weights.amax(-1, keepdim=True).clamp(min=torch.finfo(torch.float64).tiny)
    centres, scale = _frame(data.views, weights)
    x1, x2, x3 = ((x - c[:, None]) * scale[:, None, None] for x, c in zip(data.views, centres, strict=True))
    sightings = Sightings(x1, x2, x3, weights, motion)
    sigma = None if threshold is None else threshold / SIGMAS * scale
    none = x1.new_zeros(len(x1), 0, 2, 4, 4)
    starts = none if data.static is None else _from_static(sightings, data.static & (weights > 0))
    found = search(sightings, sigma, data.static, starts, generator, floor=100 * torch.finfo(data.dtype).eps)
    return _result(data, sightings, found, centres, scale)


def _frame(views: tuple[Tensor, ...], weights: Tensor) -> tuple[list[Tensor], Tensor]:
    """Medians of each view ``(b, 3)``, and one scale ``(b,)`` for all views that makes their spread about 1."""
    hidden = torch.where(weights[..., None] > 0, torch.stack(views), torch.nan)
    centres = hidden.nanmedian(dim=-2, keepdim=True).values.nan_to_num()
    spread = (hidden - centres).abs().amax(-1).nanmedian(dim=-1).values.nan_to_num().amax(0)
    return list(centres[..., 0, :]), torch.where(spread > 0, 1 / torch.where(spread > 0, spread, 1.0), 1.0)


def _from_static(data: Sightings, known: Tensor) -> Tensor:
    """``(b, 1, 2, 4, 4)`` motions of the labelled static matches, of all where there are fewer than three."""
    weights = torch.where((known.sum(-1) >= 3)[:, None], data.weights * known, data.weights)
    return torch.stack([rigid_alignment(data.x1, x, weights) for x in (data.x2, data.x3)], dim=1)[:, None]


def _result(data: Matches, sightings: Sightings, found: Rigid, centres: list[Tensor], scale: Tensor) -> Alignment:
    motion = sightings.motion
    labels = _labels(sightings, found)
    dof = torch.where(found.grounded, 12, 9)
    values, covariance = _inverse(found.information, dof)
    worst = found.sigma * values.clamp(min=torch.finfo(values.dtype).tiny).rsqrt()
    top = found.information.diagonal(dim1=-2, dim2=-1).amax(-1)
    noisy = found.sigma.isfinite() & (found.sigma > NOISY)
    status = _status(labels, sightings.weights, worst, noisy, values <= INDETERMINATE * top, dof, MOTIONS[motion])
    none = failed(status)
    labels = torch.where(none[:, None], OUTLIER, labels)
    matrices, entries = _measured(found.motions, covariance * found.sigma.square()[:, None, None], centres, scale)
    # a noise beyond the range of the numbers is not known, and nor is the covariance
    known = found.sigma.isfinite() & entries.isfinite().flatten(1).all(-1)
    entries = torch.where(known[:, None, None], entries, torch.inf)
    u, _, _, _ = combinations(found.motions, sightings)
    velocity = torch.where((labels == OUTLIER)[..., None], 0.0, -u / 2**0.5 / scale[:, None, None])
    zero = none[:, None, None]
    warnings = _notices(labels, worst, found.grounded, none, motion, data.batch)
    return Alignment(
        A=data.back(torch.where(zero, 0.0, matrices[:, 0])),
        B=data.back(torch.where(zero, 0.0, matrices[:, 1])),
        labels=data.back(labels),
        status=data.back(status),
        sigma=data.back(torch.where(none, 0.0, found.sigma / scale)),
        covariance=data.back(torch.where(zero, 0.0, entries)),
        ambiguity=AMBIGUITY[motion],
        warnings=warnings,
        velocities=data.back(torch.where(zero, 0.0, velocity)) if motion == "constant_velocity" else None,
    )


def _labels(data: Sightings, found: Rigid) -> Tensor:
    moving, static = squares(found.motions, data)
    square = found.sigma.square()[:, None]
    still = found.still & (static <= three_sigma(6) * square)
    path = found.inliers & (moving <= three_sigma(data.conditions) * square)
    return torch.where(still, STATIC, torch.where(path, MOVING, OUTLIER))


def _inverse(information: Tensor, dof: Tensor) -> tuple[Tensor, Tensor]:
    """Least eigenvalue ``(b,)`` of the degrees of freedom, and the pseudo-inverse ``(b, 12, 12)`` on them."""
    values, vectors = spectrum(torch.where(information.isfinite().flatten(1).all(-1)[:, None, None], information, 0.0))
    used = torch.arange(12, device=dof.device) >= 12 - dof[:, None]
    least = values.gather(-1, 12 - dof[:, None])[:, 0]
    floor = 1e-14 * values[:, -1:].clamp(min=torch.finfo(values.dtype).tiny)
    inverse = torch.where(used, 1 / values.clamp(min=floor), 0.0)
    return least, (vectors * inverse[:, None]) @ vectors.mT


def _status(
    labels: Tensor, weights: Tensor, worst: Tensor, noisy: Tensor, undetermined: Tensor, dof: Tensor, conditions: int
) -> Tensor:
    present = (weights > 0).sum(-1)
    still, moving = (labels == STATIC).sum(-1), (labels == MOVING).sum(-1)
    accident = (still + moving < CONSENSUS * present) | (6 * still + conditions * moving < dof + SPARE) | noisy
    status = torch.full_like(present, int(Status.OK))
    status = torch.where(worst > AMBIGUOUS, int(Status.AMBIGUOUS), status)
    status = torch.where(accident, int(Status.NO_CONSENSUS), status)
    status = torch.where(undetermined & ~accident, int(Status.DEGENERATE), status)
    return torch.where(present < 3, int(Status.TOO_FEW), status)


def _measured(motions: Tensor, covariance: Tensor, centres: list[Tensor], scale: Tensor) -> tuple[Tensor, Tensor]:
    """Motions ``(b, 2, 4, 4)`` in the unit of the points, and the covariance ``(b, 32, 32)`` of their entries."""
    first, *others = centres
    result = motions.clone()
    back = torch.stack(others, dim=1)
    result[..., :3, 3] = motions[..., :3, 3] / scale[:, None, None] + first[:, None]
    result[..., :3, 3] -= (motions[..., :3, :3] @ back[..., None])[..., 0]
    # a tangent turns and shifts about the centre of view 1, in normalized size
    basis = torch.zeros(6, 4, 4, dtype=motions.dtype, device=motions.device)
    for k, (i, j) in enumerate(((2, 1), (0, 2), (1, 0))):
        basis[k, i, j], basis[k, j, i], basis[3 + k, k, 3] = 1.0, -1.0, 1.0
    outward, inward = similarity(1 / scale, -first * scale[:, None]), similarity(scale, first)
    moved = outward[:, None] @ basis @ inward[:, None]  # (b, 6, 4, 4)
    derivative = motions.new_zeros(len(scale), 2, 16, 12)
    for part in range(2):
        derivative[:, part, :, 6 * part : 6 * part + 6] = (moved @ result[:, part, None]).flatten(2).mT
    derivative = derivative.flatten(1, 2)
    return result, derivative @ covariance @ derivative.mT


def _notices(
    labels: Tensor, worst: Tensor, grounded: Tensor, none: Tensor, motion: str, batch: tuple[int, ...]
) -> tuple[Notice, ...]:
    moving, solved = (labels == MOVING).sum(-1), ~none
    found = notices(
        NoticeCode.UNCERTAIN,
        "the worst direction of the motion has a standard deviation of {value:.2g} radians or sizes of the scene; add matches, "
        "static ones or movers that change their speed",
        worst,
        solved & (worst > UNCERTAIN),
        batch,
    )
    text = "no static match fixes the velocity common to all points, so their mean is taken as zero; label static ones (static=)"
    found += notices(NoticeCode.COMMON_VELOCITY, text, worst, solved & ~grounded, batch)
    few = solved & (moving < MINIMAL[motion]) & ((labels == STATIC).sum(-1) < 3)
    text = f"{{value:g}} matches move, {MINIMAL[motion]} would determine the motion without static ones"
    found += notices(NoticeCode.FEW_MOVING, text, moving, few, batch)
    return tuple(sorted(found, key=lambda notice: notice.problem))

"""Configurations of translating planes that are degenerate, or nearly so, by name."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from dyntorch.core.limits import quantile
from dyntorch.core.outcome import Notice, NoticeCode, Status, in_order, noting
from dyntorch.geometry.homogeneous import two_sided
from dyntorch.geometry.rigid import nearest_rotation
from dyntorch.numerics.nullspace import eigenvalues, spectrum
from dyntorch.tasks.planes.input import GivenPlanes

_ALIKE = "{value:a pair of planes or bodies moves|# pairs of planes or bodies move} alike, as of one body"
_REST = "{value:a plane does not move, or is at infinity: it has|# planes do not move, or are at infinity: they have} no epipole"
_THREE = "; three planes do not suffice then"
_INFINITY = "one homography at infinity leaves {value:.0%} of what the homographies differ by"


ROUNDING_ERROR = 1e-7  # sine or ratio
MAX_NEAR_ZERO = 0.1  # sine or ratio below which noise is asked whether it is zero
ZERO_CONFIDENCE = 0.99  # probability that noise leaves what is zero within the limit
MAX_RELATIVE_NOISE = 0.4  # of residuals over what it would be without epipoles and normals; 1200 scenes: .37 at most
MAX_CHANCE_NOISE = 0.43  # the same, from which random homographies would do as well, for very many planes
CHANCE_NOISE_DECREASE = 0.62  # of that limit, times the root of the residuals to spare
MAX_ENTRY_NOISE = 0.065  # of homographies of norm 1 in normalized coordinates; in those scenes .059 at most
MAX_F_DEVIATE = 3.09  # normal deviate of the F ratio, exceeded once in a thousand
MAX_CERTAIN_F_DEVIATE = 2.33  # the same, once in a hundred: from there the ratio is taken for an error of the model
MAX_MATCH_NOISE = 0.25  # over the extent of planes and bodies: .03 at 1 px in 120 px, .4 to .5 where matches are random
MIN_SPARE_RESIDUALS = 8  # of the separate matrices, for these to say what the noise is
RESIDUAL_ROUNDING = 1e-5  # in normalized coordinates, in single precision
MAX_ROTATION_DISTANCE = 0.01  # that a calibration to two or three digits leaves
MAX_ROTATION_DISTANCE_DEVIATION = 0.01  # with four planes
MIN_ROTATION_DEVIATIONS = 8.0  # standard deviations of that distance that noise is believed to reach


class PlanesNotice(NoticeCode):
    """What limits the result of translating planes, and how it is said."""

    COLLINEAR_EPIPOLES = (
        "collinear_epipoles",
        "the epipoles are within {value:.1g} of one line: all motion is parallel to one plane",
    )
    """The epipoles lie on one line: all motion is parallel to one plane."""
    COPLANAR_NORMALS = "coplanar_normals", "the normals are within {value:.1g} of one plane: all planes are parallel to one line"
    """The normals of the planes lie in one plane: all planes are parallel to one line."""
    SHARED_BODY = "shared_body", {"": _ALIKE, "three": f"{_ALIKE}{_THREE}"}
    """Two planes or bodies that move alike."""
    STATIC_BODY = "static_body", {"": _REST, "three": f"{_REST}{_THREE}"}
    """A plane that does not move against the cameras, or is infinitely far."""
    UNUSED_PLANE = (
        "unused_plane",
        "{value:a matrix is not finite, singular, or has too few matches; it was|# matrices are not finite, singular, or have "
        "too few "
        "matches; they were} left out",
    )
    """A homography or fundamental matrix that is singular, not finite, or has too few matches."""
    FEW_PLANES = (
        "few_planes",
        "{value:# plane or body is|# planes and bodies are} left: give 3 planes, 2 planes and 1 body, or 2 bodies",
    )
    """Fewer planes and bodies than determine the homography at infinity."""
    OTHER_SOLUTION = "other_solution", "another homography at infinity fits the {value:g} planes and bodies as well; add others"
    """Another solution fits as well."""
    UNCERTAIN = "uncertain", "the noise leaves a relative error of {value:.2g} in the homography at infinity; add larger planes"
    """The noise leaves the motion so uncertain that it says little."""
    NO_COMMON_INFINITY = (
        "no_common_infinity",
        {
            "matches": "the planes and bodies differ from what one homography at infinity allows by {value:.2g} times the noise "
            "(variances): some rotate, or are no planes; leave them out",
            "": f"{_INFINITY}: some rotate, or the noise is large; leave some out, or give larger planes",
        },
    )
    """No homography at infinity is common to the planes, or they are too noisy to tell."""
    CHANCE = "chance", f"{_INFINITY}, as of random ones: give more planes, larger ones, or their matches"
    """Random data of the kind would fit as well."""
    INCOHERENT = (
        "incoherent",
        "the matches are off any homographies and fundamental matrices by {value:.0%} of the extent of the planes and bodies: "
        "check "
        "that x1 and x2 are the same points in the same order",
    )
    """The matches agree with no homographies and fundamental matrices."""
    CALIBRATION = (
        "calibration",
        "the homography at infinity makes the calibration {value:.2g} from a rotation, more than the noise does: check K, or the "
        "planes",
    )
    """The homography at infinity and the calibration do not make a rotation."""


POSITIONS = (PlanesNotice.SHARED_BODY, PlanesNotice.STATIC_BODY)
"""What three planes do not suffice with."""


@dataclass(frozen=True)
class Figures:
    """What is known of the planes and bodies of a flat batch, in normalized coordinates."""

    epipoles: Tensor  # ``(b, c, 3)`` unit vectors
    epipole_covariance: Tensor  # ``(b, c, 3, 3)`` of them
    normals: Tensor  # ``(b, p, 3)`` unit vectors
    normal_covariance: Tensor  # ``(b, p, 3, 3)`` of them
    moving: Tensor  # ``(b, c)`` those that move, and count
    used: Tensor  # ``(b, c)`` those that count

    @cached_property
    def line(self) -> tuple[Tensor, Tensor]:
        """How far the epipoles are from one line ``(b,)``, and whether noise explains it."""
        return _flatness(self.epipoles, self.epipole_covariance, self.moving)

    @cached_property
    def plane(self) -> tuple[Tensor, Tensor]:
        """The same for the normals and one plane."""
        return _flatness(self.normals, self.normal_covariance, self.moving[:, : self.normals.shape[1]])

    def several(self) -> Tensor:
        """Where more than one homography at infinity fits the planes, by their position ``(b,)``."""
        planes = self.normals.shape[1]
        count, bodies = self.used[:, :planes].sum(-1), self.used[:, planes:].sum(-1)
        groups, known = self.groups
        parallel = (bodies == 0) & self.line[1] & self.plane[1] & (count <= 4)
        return (groups < 2) | ((groups == 2) & (known < 2)) | parallel

    @cached_property
    def same_epipole(self) -> Tensor:
        """Which pairs have one epipole within the noise, ``(b, c, c)`` bool; no pair with itself."""
        e = torch.where(self.moving[..., None], self.epipoles, 0.0)
        sign = (e @ e.mT).sign()
        square = (e[:, :, None] - sign[..., None] * e[:, None]).square().sum(-1)
        spread = self.epipole_covariance.diagonal(dim1=-2, dim2=-1).sum(-1)
        variance = (spread[:, :, None] + spread[:, None]) / 2
        limit = quantile(ZERO_CONFIDENCE, 2) * (variance + ROUNDING_ERROR**2)
        near = (square < MAX_NEAR_ZERO**2) & (square <= limit)
        both = self.moving[:, :, None] & self.moving[:, None]
        return near & both & ~torch.eye(e.shape[1], dtype=torch.bool, device=e.device)

    @cached_property
    def groups(self) -> tuple[Tensor, Tensor]:
        """How many bodies move, and of how many the fundamental matrix is known, given or from two planes; ``(b,)`` each."""
        count = self.epipoles.shape[1]
        near = self.same_epipole.double()
        reach = near + torch.eye(count, dtype=near.dtype, device=near.device)
        for _ in range(count.bit_length()):
            reach = (reach @ reach).sign()
        own = torch.arange(count, device=near.device) >= self.normals.shape[1]
        known = near.any(-1) | (own & self.moving)
        first = self.moving & ~reach.tril(diagonal=-1).any(-1)
        return first.sum(-1), (first & (reach @ known.double()[..., None] > 0)[..., 0]).sum(-1)


def planes_notices(
    figures: Figures, enough: Tensor, said: Mapping[PlanesNotice, tuple[Tensor, Tensor]], given: GivenPlanes
) -> tuple[Notice, ...]:
    """Notices on all problems, in their order. enough ``(b,)``, said ``(b,)``."""
    used, still = figures.used.sum(-1), (figures.used & ~figures.moving).sum(-1)
    missing = figures.used.shape[1] - used
    line, collinear = figures.line
    plane, coplanar = figures.plane
    pairs = figures.same_epipole.sum((-2, -1)) // 2
    # one or two bodies are in one line and one plane by themselves
    several = enough & (figures.groups[0] >= 3)
    rows = {
        PlanesNotice.UNUSED_PLANE: (missing, missing > 0),
        PlanesNotice.FEW_PLANES: (used, ~enough),
        PlanesNotice.COLLINEAR_EPIPOLES: (line, collinear & several),
        PlanesNotice.COPLANAR_NORMALS: (plane, coplanar & several),
        PlanesNotice.SHARED_BODY: (pairs, (pairs > 0) & enough),
        PlanesNotice.STATIC_BODY: (still, (still > 0) & enough),
        **said,
    }
    found, note = noting(given.batch)
    three = (used <= 3) & (figures.normals.shape[1] >= 3)
    for code, (values, flagged) in rows.items():
        if code in POSITIONS:
            note(code, values, flagged & three, case="three")
            note(code, values, flagged & ~three)
        else:
            note(code, values, flagged, case="matches" if given.matched and "matches" in code.templates else "")
    return in_order(found)


def _flatness(vectors: Tensor, covariance: Tensor, count: Tensor) -> tuple[Tensor, Tensor]:
    """Smallest over largest singular value ``(b,)`` of at least three vectors, and whether it is 0 within the noise."""
    kept = torch.where(count[..., None], vectors, 0.0)
    values, directions = spectrum(kept.mT @ kept)
    ratio = (values[:, 0].clamp(min=0) / values[:, 2].clamp(min=1e-30)).sqrt()
    across = directions[:, None, :, 0]
    distance = (kept * across).sum(-1)
    variance = (across[..., None, :] @ covariance @ across[..., :, None])[..., 0, 0]
    square = (distance.square() / (variance + ROUNDING_ERROR**2)).sum(-1)
    spare = (count.sum(-1) - 2).clamp(min=1)
    return ratio, (count.sum(-1) >= 3) & (ratio < MAX_NEAR_ZERO) & (square <= quantile(ZERO_CONFIDENCE, 2) * spare)


# ----------------------------------------------------------------------------------------------------------------------
# What speaks against a fit of translating planes: a residual that noise does not explain, and a calibration that does not fit.


@dataclass(frozen=True)
class Misfit:
    """What speaks against one homography at infinity for all, ``(b,)`` each."""

    ratio: Tensor
    excess: Tensor  # variance of what one homography at infinity leaves over that of the noise, 1 where these may be the same
    apart: Tensor  # whether noise does not explain the ratio
    chance: Tensor  # whether random homographies would have it as well. Three have one residual to spare, which says nothing
    vagueness: Tensor  # noise of the matches over the extent of what they are of; 0 without matches
    vague: Tensor  # whether they agree with any homographies and fundamental matrices as badly


def misfit(given: GivenPlanes, cost: Tensor, separate: Tensor) -> Misfit:
    r"""How far the planes and bodies are from one homography at infinity, and whether noise does not explain it. cost ``(b,)``,
    separate ``(b,)``."""
    rows, spare = given.rows()
    sigma, used = (cost / spare.clamp(min=1)).sqrt(), given.present()
    p = given.homographies.shape[1]
    if given.matched:
        planes, bodies = used[:, :p].sum(-1), used[:, p:].sum(-1)
        free = rows - 8 * planes - 7 * bodies
        variance = (separate / free.clamp(min=1)).clamp(min=(RESIDUAL_ROUNDING / given.frames[1][:, 0, 0]) ** 2)
        more = (spare - free).clamp(min=1)
        ratio = (cost - separate) / more / variance
        told, unusual = (free >= MIN_SPARE_RESIDUALS) & (spare > free), deviate(ratio, more, free.clamp(min=1))
        excess = torch.where(told & (unusual > MAX_CERTAIN_F_DEVIATE), ratio, 1.0)
        apart = told & (unusual > MAX_F_DEVIATE)
        # the given matrices may fit badly where they are linear, and the common ones where none is common
        vagueness = sigma.minimum(variance.sqrt()) / _extent(given).clamp(min=torch.finfo(sigma.dtype).tiny)
        return Misfit(ratio, excess, apart, torch.zeros_like(apart), vagueness, (vagueness > MAX_MATCH_NOISE) & (spare > 0))
    entries = given.homographies.flatten(-2)
    different = used[:, :p].sum(-1) - eigenvalues(entries.mT @ entries)[:, -1]
    ratio = sigma / (different / (rows - 8).clamp(min=1)).clamp(min=torch.finfo(sigma.dtype).tiny).sqrt()
    told = (spare > 1) & (used[:, p:].sum(-1) == 0) & (sigma > RESIDUAL_ROUNDING)
    chance = told & (ratio > MAX_CHANCE_NOISE - CHANCE_NOISE_DECREASE / spare.clamp(min=1).sqrt())
    apart = told & ((ratio > MAX_RELATIVE_NOISE) | (sigma > MAX_ENTRY_NOISE))
    return Misfit(ratio, torch.ones_like(ratio), apart, chance, torch.zeros_like(ratio), torch.zeros_like(told))


def deviate(ratio: Tensor, above: Tensor, below: Tensor) -> Tensor:
    """Normal deviate that an F ratio is exceeded as often as, by its degrees of freedom above and below."""
    a, b = 2 / (9 * above), 2 / (9 * below)
    root = ratio.clamp(min=0).pow(1 / 3)
    return ((1 - b) * root - (1 - a)) / (b * root.square() + a).sqrt()


def _extent(given: GivenPlanes) -> Tensor:
    """Root mean square distance per coordinate ``(b,)`` of matches from the middle of their plane or body, in the view where it is
    less, in the unit of the matches."""
    found = []
    for view, frame in enumerate(given.frames):
        square, count = torch.zeros_like(frame[:, 0, 0]), torch.zeros_like(frame[:, 0, 0])
        for seen in (given.planes, given.bodies):
            w = seen.weights[..., None]
            middle = (w * seen.views[view]).sum(-2, keepdim=True) / w.sum(-2, keepdim=True).clamp(min=1)
            square = square + (w * (seen.views[view] - middle).square()).flatten(1).sum(-1)
            count = count + 2 * w.flatten(1).sum(-1)
        found.append((square / count.clamp(min=1)).sqrt() / frame[:, 0, 0])
    return torch.stack(found).amin(0)


def rotation_distance(given: GivenPlanes, infinity: Tensor, covariance: Tensor, status: Tensor) -> tuple[Tensor, Tensor]:
    r"""Distance ``(b,)`` of :math:`K_2^{-1} H_\infty K_1`, of determinant 1, from a rotation, and whether noise is no reason."""
    if given.calibration is None:
        return torch.zeros_like(infinity[:, 0]), torch.zeros_like(status, dtype=torch.bool)
    first, second = given.calibration.unbind(1)
    before = given.frames[0] @ first
    after = torch.linalg.inv_ex(given.frames[1] @ second)[0]
    moved = after @ infinity.unflatten(-1, (3, 3)) @ before
    det = torch.linalg.det(moved)
    scale = (det.sign() * det.abs().clamp(min=torch.finfo(det.dtype).tiny).pow(1 / 3))[:, None, None]
    rotation = nearest_rotation(moved / scale)
    eye = torch.eye(3, dtype=moved.dtype, device=moved.device)
    distance = torch.linalg.matrix_norm(moved / scale - rotation)
    # the symmetric part of R^T M, without its trace, is what no rotation and no scale takes up
    lift = two_sided(rotation.mT @ after, before).unflatten(1, (3, 3)) / scale[..., None]
    lift = (lift + lift.transpose(1, 2)) / 2
    lift = lift - eye[:, :, None] * torch.einsum("biij->bj", lift)[:, None, None] / 3
    lift = lift.flatten(1, 2)
    deviation = (lift @ covariance @ lift.mT).diagonal(dim1=-2, dim2=-1).sum(-1).clamp(min=0).sqrt()
    # from one residual, as of three planes, nobody knows the noise
    known = (status == Status.OK) & (given.rows()[1] > 1)
    # the fit of four small planes may be another minimum, far from what its covariance says
    used, p = given.present(), given.homographies.shape[1]
    known = known & ((used[:, :p].sum(-1) >= 5) | used[:, p:].any(-1) | (deviation < MAX_ROTATION_DISTANCE_DEVIATION))
    return distance, known & (distance > MAX_ROTATION_DISTANCE) & (distance > MIN_ROTATION_DEVIATIONS * deviation)

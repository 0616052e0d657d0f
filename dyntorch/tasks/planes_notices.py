"""Configurations of translating planes that are degenerate, or nearly so, by name."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from dyntorch.chi_square import quantile
from dyntorch.eigenspace import spectrum
from dyntorch.tasks.notices import Notice, NoticeCode, notices
from dyntorch.tasks.planes_input import Given

EXACT = 1e-7
"""Sine or ratio that is rounding error."""
NEAR = 0.1
"""Sine or ratio below which noise is asked whether it is zero; above, nothing is degenerate."""
CHI_SQUARE = quantile(0.99, 2)
"""Squared distance in standard deviations, of two degrees of freedom, exceeded once in a hundred."""

MESSAGES: dict[NoticeCode, str | tuple[str, str] | dict[bool, str]] = {
    NoticeCode.COLLINEAR_EPIPOLES: "the epipoles are within {value:.1g} of one line: all motion is parallel to one plane",
    NoticeCode.COPLANAR_NORMALS: "the normals are within {value:.1g} of one plane: all planes are parallel to one line",
    NoticeCode.SHARED_BODY: (
        "a pair of planes or bodies moves alike, as of one body",
        "{value:g} pairs of planes or bodies move alike, as of one body",
    ),
    NoticeCode.STATIC_BODY: (
        "a plane does not move, or is at infinity: it has no epipole",
        "{value:g} planes do not move, or are at infinity: they have no epipole",
    ),
    NoticeCode.UNUSED_PLANE: (
        "a matrix is not finite, singular, or has too few matches; it was left out",
        "{value:g} matrices are not finite, singular, or have too few matches; they were left out",
    ),
    NoticeCode.FEW_PLANES: (
        "1 plane or body is left: give 3 planes, 2 planes and 1 body, or 2 bodies",
        "{value:g} planes and bodies are left: give 3 planes, 2 planes and 1 body, or 2 bodies",
    ),
    NoticeCode.OTHER_SOLUTION: "another homography at infinity fits the {value:g} planes and bodies as well; add others",
    NoticeCode.UNCERTAIN: "the noise leaves a relative error of {value:.2g} in the homography at infinity; add larger planes",
    NoticeCode.NO_COMMON_INFINITY: {
        True: "the planes and bodies differ from what one homography at infinity allows by {value:.2g} times the noise "
        "(variances): some rotate, or are no planes; leave them out",
        False: "one homography at infinity leaves {value:.0%} of what the homographies differ by: some rotate, or the noise is "
        "large; leave some out, or give larger planes",
    },
    NoticeCode.CHANCE: "one homography at infinity leaves {value:.0%} of what the homographies differ by, as of random ones: give "
    "more planes, larger ones, or their matches",
    NoticeCode.INCOHERENT: "the matches are off any homographies and fundamental matrices by {value:.0%} of the extent of the "
    "planes and bodies: check that x1 and x2 are the same points in the same order",
    NoticeCode.CALIBRATION: "the homography at infinity makes the calibration {value:.2g} from a rotation, more than the noise "
    "does: check K, or the planes",
}
"""Of each code: where the figure is 1 and where it is not, or with matches and without, where these differ."""
POSITIONS = (NoticeCode.SHARED_BODY, NoticeCode.STATIC_BODY)
"""What three planes do not suffice with."""


@dataclass(frozen=True)
class Figures:
    """What is known of the planes and bodies of a flat batch, in normalized coordinates.

    Attributes:
        epipoles: ``(b, c, 3)`` unit vectors.
        epipole_covariance: ``(b, c, 3, 3)`` of them.
        normals: ``(b, p, 3)`` unit vectors.
        normal_covariance: ``(b, p, 3, 3)`` of them.
        moving: ``(b, c)`` those that move, and count.
        used: ``(b, c)`` those that count.
    """

    epipoles: Tensor
    epipole_covariance: Tensor
    normals: Tensor
    normal_covariance: Tensor
    moving: Tensor
    used: Tensor

    @cached_property
    def line(self) -> tuple[Tensor, Tensor]:
        """How far the epipoles are from one line ``(b,)``, and whether noise explains it."""
        return _flatness(self.epipoles, self.epipole_covariance, self.moving)

    @cached_property
    def plane(self) -> tuple[Tensor, Tensor]:
        """The same for the normals and one plane."""
        return _flatness(self.normals, self.normal_covariance, self.moving[:, : self.normals.shape[1]])

    def several(self) -> Tensor:
        """Where more than one homography at infinity fits the planes, by their position ``(b,)``.

        All that moves alike is one body, and two planes of it are worth its fundamental matrix.  Three bodies are enough, two if
        both fundamental matrices are known.  A static plane adds nothing: it may as well be one more plane of any of them.
        Four planes with collinear epipoles and coplanar normals have two solutions.
        """
        planes = self.normals.shape[1]
        count, bodies = self.used[:, :planes].sum(-1), self.used[:, planes:].sum(-1)
        groups, known = self.groups
        parallel = (bodies == 0) & self.line[1] & self.plane[1] & (count <= 4)
        return (groups < 2) | ((groups == 2) & (known < 2)) | parallel

    @cached_property
    def alike(self) -> Tensor:
        """Which pairs have one epipole within the noise, ``(b, c, c)`` bool; no pair with itself."""
        e = torch.where(self.moving[..., None], self.epipoles, 0.0)
        sign = (e @ e.mT).sign()
        square = (e[:, :, None] - sign[..., None] * e[:, None]).square().sum(-1)
        spread = self.epipole_covariance.diagonal(dim1=-2, dim2=-1).sum(-1)
        variance = (spread[:, :, None] + spread[:, None]) / 2
        near = (square < NEAR**2) & (square <= CHI_SQUARE * (variance + EXACT**2))
        both = self.moving[:, :, None] & self.moving[:, None]
        return near & both & ~torch.eye(e.shape[1], dtype=torch.bool, device=e.device)

    @cached_property
    def groups(self) -> tuple[Tensor, Tensor]:
        """How many bodies move, and of how many the fundamental matrix is known, given or from two planes; ``(b,)`` each."""
        count = self.epipoles.shape[1]
        near = self.alike.double()
        reach = near + torch.eye(count, dtype=near.dtype, device=near.device)
        for _ in range(count.bit_length()):
            reach = (reach @ reach).sign()
        own = torch.arange(count, device=near.device) >= self.normals.shape[1]
        known = near.any(-1) | (own & self.moving)
        first = self.moving & ~reach.tril(diagonal=-1).any(-1)
        return first.sum(-1), (first & (reach @ known.double()[..., None] > 0)[..., 0]).sum(-1)


def planes_notices(
    figures: Figures, enough: Tensor, said: Mapping[NoticeCode, tuple[Tensor, Tensor]], given: Given
) -> tuple[Notice, ...]:
    """Notices on all problems, in their order.

    Args:
        figures: of the planes and bodies.
        enough: ``(b,)`` whether there are enough of them.
        said: further figures ``(b,)`` of the fit, and where they are worth a notice ``(b,)``.
        given: what was fitted.
    """
    used, still = figures.used.sum(-1), (figures.used & ~figures.moving).sum(-1)
    missing = figures.used.shape[1] - used
    line, collinear = figures.line
    plane, coplanar = figures.plane
    pairs = figures.alike.sum((-2, -1)) // 2
    # one or two bodies are in one line and one plane by themselves
    several = enough & (figures.groups[0] >= 3)
    rows = {
        NoticeCode.UNUSED_PLANE: (missing, missing > 0),
        NoticeCode.FEW_PLANES: (used, ~enough),
        NoticeCode.COLLINEAR_EPIPOLES: (line, collinear & several),
        NoticeCode.COPLANAR_NORMALS: (plane, coplanar & several),
        NoticeCode.SHARED_BODY: (pairs, (pairs > 0) & enough),
        NoticeCode.STATIC_BODY: (still, (still > 0) & enough),
        **said,
    }
    found = []
    for code, (values, flagged) in rows.items():
        single, message = _message(code, given.matched)
        three = "; three planes do not suffice then" if code in POSITIONS else ""
        few = (used <= 3) & (figures.normals.shape[1] >= 3)
        for text, one in ((single, values == 1), (message, values != 1)):
            found += notices(code, text + three, values, flagged & one & few, given.batch)
            found += notices(code, text, values, flagged & one & ~few, given.batch)
    return tuple(sorted(found, key=lambda notice: notice.problem))


def _message(code: NoticeCode, matched: bool) -> tuple[str, str]:
    """The sentence where the figure is 1, and where it is not."""
    message = MESSAGES[code]
    if isinstance(message, dict):
        message = message[matched]
    return message if isinstance(message, tuple) else (message, message)


def _flatness(vectors: Tensor, covariance: Tensor, count: Tensor) -> tuple[Tensor, Tensor]:
    """Smallest over largest singular value ``(b,)`` of at least three vectors, and whether it is 0 within the noise."""
    kept = torch.where(count[..., None], vectors, 0.0)
    values, directions = spectrum(kept.mT @ kept)
    ratio = (values[:, 0].clamp(min=0) / values[:, 2].clamp(min=1e-30)).sqrt()
    across = directions[:, None, :, 0]
    distance = (kept * across).sum(-1)
    variance = (across[..., None, :] @ covariance @ across[..., :, None])[..., 0, 0]
    square = (distance.square() / (variance + EXACT**2)).sum(-1)
    spare = (count.sum(-1) - 2).clamp(min=1)
    return ratio, (count.sum(-1) >= 3) & (ratio < NEAR) & (square <= CHI_SQUARE * spare)

"""Where the fit of translating planes starts: coordinates of order 1, and homographies at infinity in closed form."""

from __future__ import annotations

import torch
from torch import Tensor

from dyntorch.algebra.homogeneous import similarity
from dyntorch.algebra.infinity_epipoles import infinity_from_fundamentals, infinity_from_mixed
from dyntorch.algebra.infinity_extensors import infinity_linear, infinity_thesis
from dyntorch.algebra.infinity_from_planes import infinity_closed_form
from dyntorch.algebra.rank_one_pencils import plane_parts, unit_determinant
from dyntorch.algebra.rank_two import null_vectors
from dyntorch.constants import constant
from dyntorch.normalize import hartley
from dyntorch.tasks.planes_problem import Layout

LEAST = {"linear": (4, 0), "closed_form": (3, 0), "thesis": (5, 0), "mixed": (2, 1), "fundamentals": (0, 2)}
"""Planes and bodies with a known fundamental matrix that each method takes."""
AUTOMATIC = ("closed_form", "linear", "mixed", "fundamentals")
FEW = 5
"""Planes of which each is tried as if it stood still.  That raises the share of problems of 4 planes at 0.5 px that reach the best
minimum from 90 to 98 %; with 8 planes 97 % reach it without."""
EXTENT = 2.0
"""Focal lengths per half image.  The error of H alone at 1 is 1.3 times as large, at 3 the same."""
CENTRES = ((0.0, 0.0), (0.5, 0.4))
"""Where the middle of the image may be, in focal lengths: at the origin, or where pixels are counted from a corner.  With its
estimate from the homographies instead, the error of the homography at infinity is 1.1 to 1.4 times as large (0.5 px)."""
FOCAL = (-1.0, 4.5, 56)
"""Decimal logarithms of the least and largest focal length, and how many are tried."""


def frames_of_matches(views: tuple[Tensor, Tensor], weights: Tensor) -> tuple[Tensor, Tensor]:
    """One similarity for all points of each view ``(b, n, 2)``."""
    first, second = (hartley(x[..., None, :], weights) for x in views)
    return first, second


def frames_of_calibration(calibration: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor]:
    """Similarities, but for skew, in which known cameras have images of size about 1."""
    first, second = (torch.linalg.inv_ex(k)[0] for k in calibration)
    size = torch.tensor([EXTENT, EXTENT, 1.0], dtype=first.dtype, device=first.device)[:, None]
    return size * first, size * second


def frames_of_matrices(homographies: Tensor, fundamentals: Tensor) -> tuple[Tensor, Tensor]:
    r"""Similarities for images that nothing is known of, from what homographies between them look like.

    In the coordinates of calibrated cameras :math:`H_\infty` is a rotation, and a homography of determinant 1 has its least
    norm there.  So the focal length, common to both views, is the one with the least :math:`\prod_i \|T H_i T^{-1}\|`.

    Args:
        homographies: ``(b, p, 3, 3)``, zero where one is missing.
        fundamentals: ``(b, m, 3, 3)``; only where there are no homographies, by the sizes of their entries.

    Returns:
        ``(b, 3, 3)`` for view 1 and view 2, the same.
    """
    if not homographies.shape[1]:
        square = fundamentals.square()
        near, far = square[..., :2, :2].sum((-3, -2, -1)), square[..., :2, 2].sum((-2, -1)) + square[..., 2, :2].sum((-2, -1))
        scale = torch.where((near > 0) & (far > 0), near / far, 1.0).sqrt()
        frame = similarity(scale, torch.zeros_like(fundamentals[:, 0, 0, :2]))
        return frame, frame
    frames, inverses = _frames(homographies.device)
    scaled = unit_determinant(homographies)
    size = torch.stack([(frame @ scaled @ inverse).square().sum((-2, -1)) for frame, inverse in zip(frames, inverses, strict=True)])
    best = torch.where(size > 0, size, 1.0).log().sum(-1).argmin(0)
    frame = frames[best] * torch.tensor([EXTENT, EXTENT, 1.0], dtype=frames.dtype, device=frames.device)[:, None]
    return frame, frame


@constant
def _frames(device: torch.device) -> tuple[Tensor, Tensor]:
    """All similarities that are tried, and their inverses."""
    focal = torch.logspace(*FOCAL, dtype=torch.float64, device=device)
    centres = torch.tensor(CENTRES, dtype=torch.float64, device=device)
    frames = similarity((1 / focal)[:, None].expand(-1, len(centres)), focal[:, None, None] * centres).flatten(0, 1)
    return frames, torch.linalg.inv(frames)


def starts(method: str, homographies: Tensor, fundamentals: Tensor, several: bool = True) -> list[Tensor]:
    """Homographies at infinity ``(b, 3, 3)`` of norm about 1 by one method, or by all that the numbers of planes and bodies allow.

    Args:
        method: a key of ``LEAST``, or ``"auto"``.
        homographies: ``(b, p, 3, 3)`` in coordinates of order 1, zero where one is missing.
        fundamentals: ``(b, m, 3, 3)``.
        several: with ``"auto"``, each of a few planes besides, as if it stood still.
    """
    planes, bodies = homographies.shape[1], fundamentals.shape[1]
    filled, known = _filled(homographies), _filled(fundamentals)
    chosen = AUTOMATIC if method == "auto" else (method,)
    found = []
    for name in chosen:
        if planes < LEAST[name][0] or bodies < LEAST[name][1]:
            continue
        if name == "mixed":
            found.append(infinity_from_mixed(known[:, 0], filled)[0])
        elif name == "fundamentals":
            found.append(infinity_from_fundamentals(known)[0])
        else:
            solve = {"linear": infinity_linear, "closed_form": infinity_closed_form, "thesis": infinity_thesis}[name]
            found.append(solve(filled)[0])
    if method == "auto" and several and bodies < 2 and planes <= FEW:
        found += unit_determinant(filled).unbind(1)
    eye = torch.eye(3, dtype=homographies.dtype, device=homographies.device)
    return [
        torch.where((x.isfinite() & (x.abs().amax((-2, -1), True) > 0)).flatten(1).all(-1)[:, None, None], x, eye) for x in found
    ]


def _filled(matrices: Tensor) -> Tensor:
    """The first matrix that is there in the place of each missing one: the same plane again says nothing new."""
    if not matrices.shape[1]:
        return matrices
    there = (matrices != 0).flatten(2).any(-1)
    first = there.double().argmax(-1)
    again = matrices.gather(1, first[:, None, None, None].expand(-1, 1, 3, 3))
    return torch.where(there[..., None, None], matrices, again)


def parameters(homographies: Tensor, fundamentals: Tensor, infinity: Tensor) -> Tensor:
    """The parameters ``(b, size)`` of :class:`Layout` with a given homography at infinity."""
    parts = plane_parts(homographies, infinity) if homographies.shape[1] else None
    epipoles = null_vectors(fundamentals)[0]
    planes = infinity.new_zeros(len(infinity), 0, 4)
    if parts is not None:
        epipoles = torch.cat([parts.epipole, epipoles], dim=-2)
        planes = torch.cat([parts.normal, torch.ones_like(parts.scale)[..., None]], dim=-1)
    return Layout.pack(infinity, epipoles, planes)

"""Epipoles of projections P^k -> P^l, and joint epipoles, the images of the line that meets three centres."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import one_hot

from dyntorch.geometry.extensors import compound, dual, meet
from dyntorch.geometry.homogeneous import cofactors, null_vectors, unit, unit_vectors
from dyntorch.numerics.blocks import one_thread

FLAT = 1e-12
"""Sine of the angle between two lines below which their intersection is rounding."""


@dataclass(frozen=True)
class JointEpipoles:
    """Joint epipoles of three views and how well they are defined."""

    epipoles: Tensor
    """``(*batch, 3, 3)``: view, homogeneous image coordinates; unit vectors, zero where undefined."""
    lines: Tensor
    """``(*batch, 3, 2, 3)``: in every view the images of the other two centres, in order of views; unit vectors."""
    definedness: Tensor
    """``(*batch,)`` the least sine over the views of the angle between both lines; near 0 there is no joint epipole."""


def epipoles(projections: Sequence[Tensor]) -> Tensor:
    r"""Images of centres that are points: :math:`e_{ij} = M_i c_j,\ M_j c_j = 0`. projections ``(*batch, m, m + 1)`` ->
    ``(*batch, v, v, m)``."""
    shapes = {tuple(m.shape[-2:]) for m in projections}
    if len(shapes) != 1 or next(iter(shapes))[0] + 1 != next(iter(shapes))[1]:
        raise ValueError(f"projections must all be (*batch, m, m + 1), whose centre is a point; got {sorted(shapes)}")
    views = torch.stack(torch.broadcast_tensors(*projections), dim=-3)
    maps = torch.where(views.isfinite().flatten(-2).all(-1)[..., None, None], views.double(), 0.0)
    centres = meet(*maps.unbind(-2))
    images = torch.einsum("...imk,...jk->...ijm", maps, centres)
    own = torch.eye(len(projections), dtype=torch.bool, device=views.device)[..., None]
    return _orient(images.masked_fill(own, 0.0)).to(views.dtype)


@one_thread
def joint_epipoles(projections: Sequence[Tensor]) -> JointEpipoles:
    r"""Where the images of the other two centres meet: :math:`e_i \sim M_i L_j \times M_i L_k`.

    The centre of :math:`M : P^4 \to P^2` is a line L, the meet of its rows.  Three lines of :math:`P^4` have one transversal,
    the meet of the hyperplanes :math:`L_1 \vee L_2,\ L_1 \vee L_3,\ L_2 \vee L_3`; it passes through the centre of every view,
    which therefore sees it as a point, the joint epipole.  For points of space that move in one direction it is the vanishing
    point of that direction.  For points of the plane with constant velocities the three centres lie in one hyperplane: both
    lines are the image of the line at infinity, and there is no joint epipole.

    Args:
        projections: three of ``(*batch, 3, 5)``, of any scale.

    Returns:
        epipoles, lines and definedness; the angles are those after a change of image coordinates that makes the rows of every
        projection orthonormal, so that they do not depend on the unit of the images.

    Raises:
        ValueError: not three projections P^4 -> P^2.

    Source: thesis chapter 3 and section 10.1.

    Example:
        >>> import torch
        >>> rand = torch.Generator().manual_seed(0)
        >>> P = torch.randn(3, 3, 4, generator=rand, dtype=torch.float64)
        >>> direction = torch.tensor([1.0, 2.0, 2.0, 0.0], dtype=torch.float64)
        >>> M = [torch.cat([p, t * (p @ direction)[:, None]], -1) for t, p in enumerate(P)]
        >>> e = joint_epipoles(M).epipoles
        >>> bool(torch.linalg.cross(e, P @ direction).abs().max() < 1e-12)
        True
    """
    if len(projections) != 3 or any(m.shape[-2:] != (3, 5) for m in projections):
        raise ValueError(f"joint epipoles take three projections (*batch, 3, 5), got {[tuple(m.shape) for m in projections]}")
    views = torch.stack(torch.broadcast_tensors(*projections), dim=-3)
    lower, rows = _orthonormal_rows(views.double())
    centres = meet(*rows.unbind(-2))
    maps = compound(rows, 2)
    others = [(maps[..., i, :, :] @ centres[..., _others(i), :].mT).mT for i in range(3)]
    return _meeting(dual(torch.stack(others, dim=-3), 3, 2), lower, views.dtype)


def joint_epipoles_of_tensor(tensor: Tensor) -> JointEpipoles:
    r"""The joint epipoles of a Grassmann tensor of profile (2, 2, 1), without its projections. tensor ``(*batch, 3, 3, 3)``."""
    if tensor.shape[-3:] != (3, 3, 3):
        raise ValueError(f"tensor must be (*batch, 3, 3, 3), of profile (2, 2, 1), got {tuple(tensor.shape)}")
    # pairs of rows -> points, in both views
    finite = tensor.isfinite().flatten(-3).all(-1)[..., None, None, None]
    slices = torch.where(finite, tensor.double(), 0.0).movedim(-1, -3)
    slices = dual(dual(slices, 3, 2).mT, 3, 2).mT  # (*batch, k, i, j)
    size = torch.linalg.vector_norm(slices.detach(), dim=(-3, -2, -1), keepdim=True)
    slices = slices / torch.where(size > 0, size, 1.0)
    left, right = null_vectors(slices)
    of_first, of_second = null_vectors(left)[1], null_vectors(right)[1]
    first = _third_line(slices.movedim(-3, -1), of_first)
    second = _third_line(slices.mT.movedim(-3, -1), of_second)
    lines = torch.stack(
        [
            torch.stack([of_first, first], -2),
            torch.stack([of_second, second], -2),
            torch.stack([_image_in_third(slices, of_first, of_second), _image_in_third(slices.mT, of_second, of_first)], -2),
        ],
        dim=-3,
    )
    eye = torch.eye(3, dtype=lines.dtype, device=lines.device)
    return _meeting(lines, eye.expand(*lines.shape[:-2], 3, 3), tensor.dtype)


def _others(view: int) -> list[int]:
    return [j for j in range(3) if j != view]


def _orthonormal_rows(views: Tensor) -> tuple[Tensor, Tensor]:
    """M = L O with orthonormal rows of O; the identity and zero for what is not finite."""
    finite = views.isfinite().flatten(-2).all(-1)[..., None, None]
    q, r = torch.linalg.qr(torch.where(finite, views, torch.eye(3, 5, dtype=views.dtype, device=views.device)).mT)
    return r.mT, torch.where(finite, q.mT, 0.0)


def _third_line(slices: Tensor, line: Tensor) -> Tensor:
    """The line chi of det A(p, .) = (phi . p)^2 (chi . p), from slices ``(*batch, i, j, k)``."""
    # three points with phi . p = 1: phi, and one more along either direction across it
    across = _across(line)
    points = torch.cat([line[..., None, :], line[..., None, :] + across], dim=-2)
    at_line, *others = torch.linalg.det(torch.einsum("...ai,...ijk->...ajk", points, slices)).unbind(-1)
    along = torch.stack([other - at_line for other in others], dim=-1)
    return at_line[..., None] * line + (along[..., None] * across).sum(-2)


def _across(line: Tensor) -> Tensor:
    """Two unit vectors orthogonal to a unit vector and to each other."""
    least = one_hot(line.abs().argmin(dim=-1), 3).to(line)
    first = unit_vectors(torch.linalg.cross(line, least))
    return torch.stack([first, torch.linalg.cross(line, first)], dim=-2)


def _image_in_third(slices: Tensor, first: Tensor, second: Tensor) -> Tensor:
    """M_3 L_1: the image under A(p, .) of the line psi of view 2, for p off the line phi of view 1; slices (*batch, k, i, j)."""
    homography = torch.einsum("...kij,...i->...kj", slices, first)
    return (cofactors(homography) @ second[..., None])[..., 0]


def _meeting(lines: Tensor, coordinates: Tensor, dtype: torch.dtype) -> JointEpipoles:
    """Intersections of both lines ``(*batch, 3, 2, 3)`` of every view, in image coordinates that ``coordinates`` leads back to."""
    lines = unit_vectors(lines)
    crossing = torch.linalg.cross(lines[..., 0, :], lines[..., 1, :])
    sine = torch.linalg.vector_norm(crossing, dim=-1)
    points = torch.where((sine > FLAT)[..., None], (coordinates @ crossing[..., None])[..., 0], 0.0)
    seen = lines @ cofactors(coordinates).mT
    return JointEpipoles(_orient(points).to(dtype), _orient(seen).to(dtype), sine.amin(-1).to(dtype))


def _orient(vectors: Tensor) -> Tensor:
    """Unit vectors whose largest entry is positive."""
    return unit(vectors[..., None])[..., 0]

r"""Rows of shape tensors: what one view of n points says about their shape, whatever the camera.

In the frame of four basis points of the image the camera of a view has four unknowns m, :math:`\lambda p_i = \hat P(P_i)\, m`:
camera and point have changed places (Carlsson and Weinshall), and six, seven, eight points fulfil the dual of the fundamental,
trifocal and quadrifocal constraint.
"""

from __future__ import annotations

import torch
from torch import Tensor

from dyntorch.algebra.grassmann import grassmann_tensor
from dyntorch.algebra.homogeneous import unit_vectors
from dyntorch.constants import constant
from dyntorch.nullspace import null_space
from dyntorch.primitives.base import inverse

PROFILES = {6: (2, 2), 7: (2, 1, 1), 8: (1, 1, 1, 1)}
"""Points to how many lines through each of those behind the basis enter the tensor (2: the point itself)."""
FLAT = 1e-6
"""Of the squared extent of a view: triangles of basis points below it have no frame (float32 rounding leaves 1e-7)."""
RIDGE = 1e-14


def canonical(x: Tensor) -> tuple[Tensor, Tensor]:
    r"""The points of each view in the frame in which the first four are :math:`e_1, e_2, e_3` and :math:`(1, 1, 1)`.

    Args:
        x: ``(*batch, views, n, 3)`` points (x, y, 1), (0, 0, 0) where missing.

    Returns:
        ``(*batch, views, n - 4, 3)`` unit vectors of the others, 0 where the point is missing or the four have no frame (three
        of them on a line); and ``(*batch, views, n - 4)`` how noise of the view turns each of them, about, in units of its RMS
        extent: :math:`q_k` is a ratio of triangles, and a corner moves an area by the length of the side across.
    """
    p = local(x)[0]
    corners, others = p[..., :3, :], p[..., 3:, :]
    sides = torch.linalg.cross(corners[..., [1, 2, 0], :], corners[..., [2, 0, 1], :])
    areas = others @ sides.mT
    edges = (corners[..., [1, 2, 0], :2] - corners[..., [2, 0, 1], :2]).square().sum(-1)
    spokes = (others[..., None, :2] - corners[..., None, :, :2]).square().sum(-1)
    slopes = edges[..., None, :] + spokes.sum(-1, keepdim=True) - spokes
    one, areas = areas[..., :1, :], areas[..., 1:, :]
    whole = (corners[..., 0, :] * sides[..., 0, :]).sum(-1)
    sound = (one[..., 0, :].abs().amin(-1) > FLAT) & (whole.abs() > FLAT)
    one = torch.where(sound[..., None, None], one, 1.0)
    q = torch.where(sound[..., None, None] & (others[..., 1:, 2:] > 0), areas / one, 0.0)
    length = q.square().sum(-1)
    unit = unit_vectors(q)
    across = (slopes[..., 1:, :] + q.square() * slopes[..., :1, :]) / one.square() * (1 - unit.square())
    return unit, torch.where(length > 0, across.sum(-1) / torch.where(length > 0, length, 1.0), 1.0).sqrt()


def local(x: Tensor) -> tuple[Tensor, Tensor]:
    """Points ``(..., n, 3)`` of each view about the mean of those that are seen, at unit RMS distance; missing ones 0.

    Returns:
        the points, and by what they were multiplied, ``(...)``.
    """
    xy, seen = x[..., :2], x[..., 2:]
    count = seen.sum(-2, keepdim=True).clamp(min=1.0)
    centred = (xy - (xy * seen).sum(-2, keepdim=True) / count) * seen
    square = centred.square().sum((-2, -1), keepdim=True) / count
    factor = torch.where(square > 0, square, 1.0).rsqrt()
    return torch.cat([centred * factor, seen], dim=-1), factor[..., 0, 0]


def lines_through(q: Tensor) -> Tensor:
    """Two orthonormal lines through each point ``(..., 3)`` of norm 1, ``(..., 2, 3)``; 0 through a zero one."""
    # two rows of the reflection that takes the point to the third axis
    shifted = torch.cat([q[..., :2], q[..., 2:] + torch.where(q[..., 2:] < 0, -1.0, 1.0)], dim=-1)
    scale = 2.0 / shifted.square().sum(-1).clamp(min=1e-300)
    rows = torch.eye(2, 3, dtype=q.dtype, device=q.device) - scale[..., None, None] * q[..., :2, None] * shifted[..., None, :]
    return rows * (q != 0).any(-1)[..., None, None]


def _products(q: Tensor) -> Tensor:
    """Products of what each point ``(..., n - 4, 3)`` puts into its slot, ``(..., r, 3^k)``: itself, or two lines through it."""
    lines = lines_through(q)
    product = torch.ones_like(q[..., 0, :1, None])
    for i, a in enumerate(PROFILES[q.shape[-2] + 4]):
        slot = q[..., i, None, :] if a == 2 else lines[..., i, :, :]
        product = torch.einsum("...ra,...sb->...rsab", product, slot).flatten(-2).flatten(-3, -2)
    return product


def general_rows(x: Tensor) -> Tensor:
    """Rows of six, seven or eight points in general position, in the coordinates of :func:`free`: ``(..., 1 | 4 | 16, free)``."""
    return _products(canonical(x)[0]) @ free(x.shape[-2], x.device).mT


def plane_rows(x: Tensor) -> Tensor:
    r"""Rows of points beside a reference plane, in the coordinates of :func:`centred`: ``(..., 2 (n - 4), 3 (n - 5))``.

    With the four coplanar points as the frame :math:`p_i \sim v_i + c`, so :math:`l (v_i + c) = 0` for lines l through
    :math:`p_i` is linear in the points v and the camera c at once.  The camera of the view is projected out.  Each point
    weighs as much as it is sure: with 8 points, 20 views and noise of 1 px new views are 2.5 px off, not 4.5 (true shape: 2.1).
    """
    q, noise = canonical(x)
    count = q.shape[-2]
    camera = (lines_through(q) / noise[..., None, None]).flatten(-3, -2)  # (.., 2 m, 3)
    own = torch.eye(count, dtype=q.dtype, device=q.device).repeat_interleave(2, 0)
    points = (own[..., None] * camera[..., None, :]).flatten(-2)  # (.., 2 m, 3 m)
    square = camera.mT @ camera
    eye = torch.eye(3, dtype=q.dtype, device=q.device)
    # a view of one point has no square inverse, but nothing is lost: what the ridge leaves open both sides map to 0
    shared = inverse(square + RIDGE * (1 + square.diagonal(dim1=-2, dim2=-1).sum(-1)[..., None, None]) * eye)
    rows = points
    for _ in range(2):
        # the second pass takes what the ridge and rounding leave: up to 1e-8 where all points look alike, then 1e-13
        rows = rows - camera @ (shared @ (camera.mT @ rows))
    basis = centred(count, x.device)
    return (rows.unflatten(-1, (count, 3)).mT @ basis.mT).mT.flatten(-2)


def affine_rows(x: Tensor) -> Tensor:
    """The two centred coordinates of all points of each view, in the coordinates of :func:`centred`: ``(..., 2, n - 1)``."""
    xy = x[..., :2] - x[..., :2].mean(-2, keepdim=True)
    square = xy.square().mean((-2, -1), keepdim=True)
    xy = xy * torch.where(square > 0, square, 1.0).rsqrt()
    return xy.mT @ centred(x.shape[-2], x.device).mT


@constant
def centred(count: int, device: torch.device) -> Tensor:
    """Orthonormal basis ``(count - 1, count)`` of the vectors of sum 0."""
    return null_space(torch.ones(1, count, dtype=torch.float64), count - 1).to(device)


@constant
def free(points: int, device: torch.device) -> Tensor:
    r"""Orthonormal basis ``(5 | 11 | 23, 3^k)`` of the tensors of six, seven or eight points that fulfil the synthetic constraints.

    These hold for all shapes: a camera whose centre is the basis point :math:`P_b` shows all others wherever it likes, so the
    form vanishes with all points equal to :math:`u \in \{e_1, e_2, e_3, (1, 1, 1)\}`.
    """
    special = torch.cat([torch.eye(3, dtype=torch.float64), torch.full((1, 3), 3**-0.5, dtype=torch.float64)])
    rows = _products(special[:, None].expand(4, points - 4, 3)).flatten(0, 1)
    return null_space(rows, rows.shape[-1] - int(torch.linalg.matrix_rank(rows))).to(device)


@constant
def plane_map(points: int, device: torch.device) -> Tensor:
    r"""The tensor of six, seven or eight points, four of them coplanar, as a linear function ``(3^k, 3 k)`` of v5, v6, ...

    It takes a common shift to 0; its image is the space in which all synthetic constraints hold.
    """
    count = points - 4
    v = torch.eye(3 * count, dtype=torch.float64).unflatten(-1, (count, 3))
    return form(finite_cameras(v)).mT.to(device)


def finite_cameras(v: Tensor) -> list[Tensor]:
    """The matrices [I | v] of points ``(*batch, k, 3)`` beside a reference plane."""
    eye = torch.eye(3, dtype=v.dtype, device=v.device).expand(*v.shape[:-2], 3, 3)
    return [torch.cat([eye, u[..., None]], dim=-1) for u in v.unbind(-2)]


def form(cameras: list[Tensor]) -> Tensor:
    """The tensor, flat ``(*batch, 3^k)``, of matrices ``(*batch, 3, 4)`` that take a camera to each point's image.

    A slot of two lines is written for their meet, the point itself.
    """
    profile = PROFILES[len(cameras) + 4]
    return by_lines(grassmann_tensor(cameras, profile), profile).flatten(-len(profile))


def by_lines(tensor: Tensor, profile: tuple[int, ...]) -> Tensor:
    """From the form of :func:`form` to a Grassmann tensor ``(*batch, 3, 3, ...)``, and back.

    Minors 01, 02, 12 of two lines are the coordinates 2, -1, 0 of their meet.
    """
    sign = torch.tensor([1.0, -1.0, 1.0], dtype=tensor.dtype, device=tensor.device)
    for slot, a in enumerate(profile):
        if a == 2:
            axis = slot - len(profile)
            tensor = tensor.flip(axis) * sign.reshape(3, *[1] * (-axis - 1))
    return tensor

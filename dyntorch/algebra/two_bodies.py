"""Two bodies in relative translation: from points on two hyperplanes of P^k to the cameras and the affine shape of each."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from dyntorch.algebra.extensors import meet
from dyntorch.algebra.homogeneous import inhomogeneous, nonzero_sign, unit_vectors
from dyntorch.blocks import one_thread
from dyntorch.nullspace import gram_null_space, null_space

PARALLEL = 1e-12
"""1 - cos^2 of the angle between hyperplanes below which they are one."""


@dataclass(frozen=True)
class TwoBodies:
    """Cameras and affine points of two bodies with a common linear part; all but ``determined`` carry gradients."""

    cameras: Tensor
    """``(*batch, 2, v, m, d + 1)``: :math:`[Q_i | q_i]` of body 1, :math:`[Q_i | q_i + r_i]` of body 2; depths are positive."""
    points: Tensor
    """``(*batch, n, d)`` affine coordinates, each point in the frame of its own body; X / w where the label is 0."""
    collineation: Tensor
    """``(*batch, K, K)`` G, with :math:`G\\,Y \\sim (X, 1, 0)` on body 1 and :math:`(X, 1, 1)` on body 2."""
    determined: Tensor
    """``(*batch, 2)`` bool: the body has K - 1 points, so that its hyperplane is known, and the hyperplanes differ."""


@one_thread
def two_bodies(projections: Tensor, structure: Tensor, hyperplanes: Tensor, labels: Tensor) -> TwoBodies:
    r"""The collineation that makes two hyperplanes those of two translating bodies, and with it the bodies.

    Every view sees :math:`x \sim Q_i X + q_i` of body 1 and :math:`x \sim Q_i (X + d_i) + q_i` of body 2, that is
    :math:`M_i = [Q_i | q_i | Q_i d_i]` and points :math:`Y = (X, w, \lambda)` with :math:`\lambda = 0` or
    :math:`\lambda = w`.  In any projective frame, :math:`\lambda = h_1 \cdot Y`, :math:`w = (h_1 + h_2) \cdot Y`, and X are
    d = K - 2 coordinates that vanish nowhere on :math:`h_1 \cap h_2` (where infinity is):

    .. math:: G = \begin{bmatrix} N \\ h_1^T + h_2^T \\ h_1^T \end{bmatrix}, \qquad M_i G^{-1} = [Q_i | q_i | r_i].

    The signs of :math:`h_1, h_2` are those for which w has the sign of the depth.  What remains is an affinity of both bodies
    with one linear part, a translation of each, and the size of one body against the other.  Nothing observes the last one where
    :math:`m < K - 1` (bodies in space): here either body gets its median at the origin and median radius 1.  Where
    :math:`m = K - 1` (bodies that translate in one plane), the centre :math:`(d_i, 0, -1)` of every view has w = 0, which gives
    the ratio of :math:`h_1` and :math:`h_2`; then only the common size is a matter of gauge, and the median radius over both is
    1.  The gauge is held constant in derivatives.

    Args:
        projections: ``(*batch, v, m, K)``, :math:`M_i` of any scale and sign, the last row that of the depth.
        structure: ``(*batch, n, K)`` homogeneous points of any scale and sign.
        hyperplanes: ``(*batch, 2, K)`` of any scale and sign: :func:`~dyntorch.algebra.hyperplane_pair.hyperplane_pair`.
        labels: ``(*batch, n)`` 1 or 2; 0 for a point of neither.

    Returns:
        cameras, points, collineation and determined.  A point that noise leaves beside its hyperplane keeps the coordinates
        X / w; a bundle adjustment with the cameras is what moves it to where its images want it.

    Raises:
        ValueError: shapes that do not fit, or labels outside 0 to 2.

    Source: thesis chapter 3 (two bodies in relative translation).

    Example:
        >>> import torch
        >>> from dyntorch.algebra.hyperplane_pair import hyperplane_pair
        >>> rand = torch.Generator().manual_seed(1)
        >>> Y = torch.rand(12, 4, generator=rand, dtype=torch.float64)
        >>> Y[:, 2], Y[:, 3] = 1.0, torch.arange(12) >= 7  # seven points of body 1
        >>> P = torch.rand(2, 3, 3, generator=rand, dtype=torch.float64)
        >>> d = torch.tensor([[0.3, 0.2], [0.1, -0.4]], dtype=torch.float64)
        >>> M = torch.cat([P, P[:, :, :2] @ d[..., None]], -1)
        >>> pair = hyperplane_pair(Y)
        >>> bodies = two_bodies(M, Y, pair.hyperplanes, pair.labels)
        >>> bodies.cameras.shape, bodies.points.shape, bodies.determined.tolist()
        (torch.Size([2, 2, 3, 3]), torch.Size([12, 2]), [True, True])
    """
    _check(projections, structure, hyperplanes, labels)
    views, points, pair = (torch.nan_to_num(t.double()) for t in (projections, structure, hyperplanes))
    bodies = torch.stack([labels == 1, labels == 2], dim=-2)
    views, points = _positive_depths(views, points, labels > 0)
    pair, apart = _oriented(pair, points, bodies)
    if views.shape[-2] == views.shape[-1] - 1:
        pair = pair * _ratio(views, pair)[..., None]
    size = points.shape[-1]
    frame = null_space(pair, size - 2)  # orthonormal rows across h_1 and h_2
    centres, sizes = _gauge(points, frame, pair, bodies, together=views.shape[-2] == size - 1)
    pair = pair * sizes.flip(-1)[..., None]  # X / w of body 1 has h_2 below, and the other way round
    linear = frame - centres.mT @ pair.flip(-2)
    collineation = torch.cat([linear, pair.sum(-2, keepdim=True), pair[..., :1, :]], dim=-2)
    # the columns of G^-1: across the pencil, and in it where h_2 = 1 on body 1, h_1 = 1 on body 2
    gram = torch.where(apart[..., None, None], pair @ pair.mT, torch.eye(2, dtype=pair.dtype, device=pair.device))
    origins = centres @ frame + (torch.linalg.inv_ex(gram)[0] @ pair).flip(-2)
    back = torch.cat([frame[..., None, :, :].expand(*pair.shape[:-1], *frame.shape[-2:]), origins[..., None, :]], dim=-2)
    cameras = views[..., None, :, :, :] @ back.mT[..., None, :, :]
    coordinates = inhomogeneous(points @ collineation[..., :-1, :].mT)
    determined = (bodies.sum(-1) >= size - 1) & apart[..., None]
    dtype = structure.dtype
    return TwoBodies(cameras.to(dtype), coordinates.to(dtype), collineation.to(dtype), determined)


def _check(projections: Tensor, structure: Tensor, hyperplanes: Tensor, labels: Tensor) -> None:
    if structure.ndim < 2 or not structure.is_floating_point() or structure.shape[-1] < 3:
        raise ValueError(
            f"structure must be a floating point tensor (*batch, n, K), got {tuple(structure.shape)} {structure.dtype}"
        )
    size = structure.shape[-1]
    if projections.ndim < 3 or projections.shape[-1] != size:
        raise ValueError(f"projections must be (*batch, v, m, {size}) for this structure, got {tuple(projections.shape)}")
    if hyperplanes.shape[-2:] != (2, size):
        raise ValueError(f"hyperplanes must be (*batch, 2, {size}) for this structure, got {tuple(hyperplanes.shape)}")
    if labels.shape != structure.shape[:-1] or bool(((labels < 0) | (labels > 2)).any()):
        got = (
            f"shape {tuple(labels.shape)}"
            if labels.shape != structure.shape[:-1]
            else f"{int(labels.min())} to {int(labels.max())}"
        )
        raise ValueError(f"labels must be 0, 1 or 2 for each of the points {tuple(structure.shape[:-1])}, got {got}")


def _positive_depths(views: Tensor, points: Tensor, known: Tensor) -> tuple[Tensor, Tensor]:
    """Projections and unit points with the signs for which the last coordinate of M_i Y_n is positive."""
    points = unit_vectors(points)
    depth = (views[..., -1, :] @ points.mT).detach().sign() * known[..., None, :]
    of_view = nonzero_sign((depth * depth[..., :1, :]).sum(-1))
    of_point = nonzero_sign((depth * of_view[..., None]).sum(-2))
    return views * of_view[..., None, None], points * of_point[..., None]


def _oriented(pair: Tensor, points: Tensor, bodies: Tensor) -> tuple[Tensor, Tensor]:
    """Unit hyperplanes, each positive on the points of the other body, and whether they are two."""
    pair = unit_vectors(pair)
    sign = nonzero_sign(((pair @ points.mT).detach() * bodies.flip(-2)).sum(-1))
    cosine = (pair[..., 0, :] * pair[..., 1, :]).sum(-1)
    nonzero = (pair != 0).any(-1).all(-1)
    return pair * sign[..., None], nonzero & (1 - cosine.square() > PARALLEL)


def _ratio(views: Tensor, pair: Tensor) -> Tensor:
    """Scales ``(*batch, 2)`` of the hyperplanes for which h_1 + h_2 vanishes at the centre of every view."""
    at_centres = meet(*unit_vectors(views).unbind(-2)) @ pair.mT
    rows = unit_vectors(at_centres)
    # a positive pair: the signs are those of the depths
    scales = gram_null_space(rows.mT @ rows).basis[..., 0, :].abs()
    return torch.where((scales > 0).all(-1, keepdim=True), scales, 1.0)


@torch.no_grad()
def _gauge(points: Tensor, frame: Tensor, pair: Tensor, bodies: Tensor, *, together: bool) -> tuple[Tensor, Tensor]:
    """Median point ``(*batch, 2, d)`` of either body in units of its size, and the sizes ``(*batch, 2)``: of both if together."""
    across = (points @ frame.mT)[..., None, :, :]
    depth = (points @ pair.mT).mT.flip(-2)[..., None]
    position = inhomogeneous(torch.cat([across.expand(*depth.shape[:-1], -1), depth], dim=-1))
    member = bodies[..., None]
    centre = position.masked_fill(~member, torch.nan).nanmedian(dim=-2, keepdim=True).values.nan_to_num()
    radius = (position - centre).norm(dim=-1).masked_fill(~bodies, torch.nan)
    if together:
        size = radius.flatten(-2).nanmedian(dim=-1, keepdim=True).values.expand(radius.shape[:-1])
    else:
        size = radius.nanmedian(dim=-1).values
    size = torch.where(size > 0, size, 1.0)
    return centre[..., 0, :] / size[..., None], size

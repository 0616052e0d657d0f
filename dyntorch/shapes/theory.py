r"""Moving shapes that few points and projective cameras determine: for understanding and tests, too ill-conditioned for noise.

The degrees and counts are those of the thesis: general projective views of six points take 49 frames, a static reference plane
with two moving points 8, four static points and a moving one 3, and of five points seen at an unknown time one condition is left.
"""

from __future__ import annotations

import torch
from torch import Tensor

from dyntorch.numerics.blocks import constant
from dyntorch.numerics.nullspace import null_space
from dyntorch.shapes.basis import Polynomial
from dyntorch.shapes.static import canonical, general_rows

SIX_DEGREE = 9
"""Degree in the time of the dual fundamental matrix of six points of constant velocity."""


def six_point_rows(x: Tensor, times: Tensor) -> Tensor:
    r"""Rows of :math:`p_5^T F(t)\, p_6 = 0` for six points of constant velocity and projective cameras, F of degree 9 in t.

    The synthetic constraints leave 5 coefficients of the dual fundamental matrix, each a polynomial with 10: 50 unknowns.

    Args:
        x: ``(*batch, views, 6, 2)`` image points.
        times: ``(*batch, views)`` in [-1, 1].

    Returns:
        ``(*batch, views, 50)``, null space of dimension 1 from 49 views on.

    Source: thesis chapter 4; Carlsson and Weinshall 1998 (duality).

    Example:
        >>> import torch
        >>> six_point_rows(torch.rand(3, 6, 2).double(), torch.rand(3).double()).shape
        torch.Size([3, 50])
    """
    row = general_rows(_homogeneous(x, 6))[..., 0, :]
    return (Polynomial(SIX_DEGREE).rows(times)[..., None] * row[..., None, :]).flatten(-2)


def reference_plane_rows(x: Tensor, times: Tensor) -> Tensor:
    r"""Rows of :math:`(p_5 \times p_6)^T (e_0 + e_1 t + e_2 t^2) = 0`: four static coplanar points and two of constant velocity.

    In the frame of the four points all cameras are :math:`[I \mid c]`, and the line through the two images contains the
    direction between the two points, whatever the camera.

    Args:
        x: ``(*batch, views, 6, 2)`` image points, the first four static and in one plane.
        times: ``(*batch, views)`` in [-1, 1].

    Returns:
        ``(*batch, views, 9)``, null space of dimension 1 from 8 views on.

    Source: thesis chapter 4 and section 9.1.

    Example:
        >>> import torch
        >>> reference_plane_rows(torch.rand(3, 6, 2).double(), torch.rand(3).double()).shape
        torch.Size([3, 9])
    """
    first, second = canonical(_homogeneous(x, 6))[0].unbind(-2)
    line = torch.linalg.cross(first, second)
    return (Polynomial(2).rows(times)[..., None] * line[..., None, :]).flatten(-2)


def moving_point(x: Tensor, times: Tensor) -> Tensor:
    r"""The affine coordinates of a point of constant velocity in four static ones: :math:`x_5 = \sum_i (\alpha_i + t \beta_i) x_i`.

    With :math:`\sum \alpha_i = 1` and :math:`\sum \beta_i = 0` eliminated, 6 unknowns and two equations per view: three views.

    Args:
        x: ``(*batch, views, 5, 2)`` affine views, the moving point last.
        times: ``(*batch, views)``.

    Returns:
        ``(*batch, 2, 4)``: alpha and beta.

    Raises:
        ValueError: fewer than three views, or not five points.

    Source: thesis chapter 4.

    Example:
        >>> import torch
        >>> g = torch.Generator().manual_seed(0)
        >>> still, t = torch.randn(4, 3, generator=g).double(), torch.tensor([0.0, 1.0, 3.0]).double()
        >>> moving = still[0] + t[:, None] * (still[1] - still[3])
        >>> shapes = torch.cat([still.expand(3, 4, 3), moving[:, None]], dim=1)
        >>> moving_point(shapes @ torch.randn(3, 3, 2, generator=g).double(), t).round(decimals=6).abs().tolist()
        [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 1.0]]
    """
    if x.shape[-2] != 5 or x.shape[-3] < 3:
        raise ValueError(f"x must be (*batch, views >= 3, 5, 2), got {tuple(x.shape)}")
    differences = x[..., [0, 1, 2, 4], :] - x[..., 3:4, :]
    known = (times[..., None, None, None] ** torch.arange(2, device=x.device)[:, None, None]) * differences[..., None, :3, :]
    matrix = known.flatten(-3, -2).mT.flatten(-3, -2)  # (.., 2 views, 6)
    right = differences[..., 3, :].flatten(-2)
    q, r = torch.linalg.qr(matrix)
    found = torch.linalg.solve_triangular(r, q.mT @ right[..., None], upper=True)[..., 0].unflatten(-1, (2, 3))
    total = torch.tensor([1.0, 0.0], dtype=x.dtype, device=x.device)
    return torch.cat([found, (total - found.sum(-1))[..., None]], dim=-1)


def resultant(annihilator: Tensor, x: Tensor) -> tuple[Tensor, Tensor]:
    r"""The condition on a view of five points at an unknown time, and that time.

    The two coordinates of :math:`N(t)^T x = 0` are polynomials of degree d = 3 r in t.  They have a root in common where their
    Sylvester matrix is singular; the powers of that root are its null vector.

    Args:
        annihilator: ``(*batch, d + 1, 5, 1)`` of :class:`dyntorch.DynamicShapeTensor`, ``form="basis"``, polynomial trajectory.
        x: ``(*batch, 5, 2)`` image points.

    Returns:
        The determinant ``(*batch,)`` of the Sylvester matrix of the two polynomials at norm 1, and the root ``(*batch,)``, in
        [-1, 1] where the view belongs to the shape.

    Raises:
        ValueError: not five points.

    Source: thesis chapter 4 (elimination of the time); Sylvester's resultant.

    Example:
        >>> import torch
        >>> N = torch.zeros(2, 5, 1).double()
        >>> N[[0, 1], [0, 1]], N[:, 2] = 1.0, -1.0  # (x_1 - x_3) + t (x_2 - x_3) = 0
        >>> det, t = resultant(N, torch.tensor([[1.0, 2.0], [-2.0, -4.0], [0, 0], [0, 0], [0, 0]]).double())
        >>> bool(det.abs() < 1e-12), round(float(t), 6)
        (True, 0.5)
    """
    if x.shape[-2] != 5 or annihilator.shape[-2:] != (5, 1):
        raise ValueError(f"a resultant takes five points, got {tuple(annihilator.shape)} and {tuple(x.shape)}")
    centred = x - x.mean(-2, keepdim=True)
    chebyshev = torch.einsum("...ki,...id->...dk", annihilator[..., 0], centred)
    degree = chebyshev.shape[-1] - 1
    powers = chebyshev @ _to_powers(degree, x.device)  # (.., 2, d + 1), lowest first
    powers = powers / powers.norm(dim=-1, keepdim=True).clamp(min=torch.finfo(x.dtype).tiny)
    shifted = [torch.nn.functional.pad(powers, (k, degree - 1 - k)) for k in range(degree)]
    sylvester = torch.stack(shifted, dim=-2).flatten(-3, -2)  # rows t^k p, t^k q; columns 1, t, ..., t^{2 d - 1}
    null = null_space(sylvester)[..., 0, :]
    # all ratios of neighbours are the root: least squares
    low, high = null[..., :-1], null[..., 1:]
    root = (low * high).sum(-1) / low.square().sum(-1).clamp(min=torch.finfo(x.dtype).tiny)
    return torch.linalg.det(sylvester), root


@constant
def _to_powers(degree: int, device: torch.device) -> Tensor:
    """From Chebyshev coefficients to those of powers, ``(d + 1, d + 1)``."""
    nodes = Polynomial(degree).nodes(degree + 1)
    vandermonde = nodes[:, None] ** torch.arange(degree + 1)
    return torch.linalg.solve(vandermonde, Polynomial(degree).rows(nodes)).mT.to(device)


def _homogeneous(x: Tensor, count: int) -> Tensor:
    if x.shape[-2:] != (count, 2):
        raise ValueError(f"x must be (*batch, views, {count}, 2), got {tuple(x.shape)}")
    return torch.cat([x, torch.ones_like(x[..., :1])], dim=-1)

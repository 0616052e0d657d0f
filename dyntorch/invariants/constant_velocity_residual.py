"""Residuals of points at constant velocity before three sensors, whitened by the noise of all three."""

from __future__ import annotations

import torch
from torch import Tensor

from dyntorch.algebra.projection import adjugate, project
from dyntorch.residual import whiten


def inverses(motion: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
    r"""Sensor to world: :math:`A_0^{-1}, A_1^{-1}, A_2^{-1}` up to scale; a camera, ``(*batch, 3, 4)``, stays as it is.

    Args:
        motion: :math:`A_0, A_1, A_2`, ``(*batch, 4, 4)`` each, the last ``(*batch, 3, 4)`` for a camera.

    Example:
        >>> import torch
        >>> inverses((2 * torch.eye(4),))[0].diagonal().tolist()
        [8.0, 8.0, 8.0, 8.0]
    """
    return tuple(adjugate(part) if part.shape[-2] == part.shape[-1] else part for part in motion)


def moving_residual(inverses: tuple[Tensor, ...], views: tuple[Tensor, ...], scales: tuple[Tensor, ...]) -> Tensor:
    r"""The second difference :math:`e = y_0 - 2 y_1 + y_2` of the world positions :math:`y_t = \pi(A_t^{-1} P_t)`, whitened.

    With a camera as the third view the prediction is compared in the image, :math:`e = \pi(A_2 (2 y_1 - y_0, 1)) - x_3`.
    The square sum follows :math:`\chi^2` with 3 (2) degrees of freedom, and depends neither on an affinity of the world nor
    on a common velocity.

    Args:
        inverses: :func:`inverses` of the motion.
        views: ``(*batch, n, 3)``, the last ``(*batch, n, 2)`` for a camera.
        scales: ``(*batch,)`` standard deviation of the noise of each view, in the unit of its points.

    Returns:
        ``(*batch, n, 3)``, or ``(*batch, n, 2)`` with a camera.

    Example:
        >>> import torch
        >>> one, eye = torch.tensor(1.0), torch.eye(4)
        >>> places = [torch.tensor([[x, 0.0, 0.0]]) for x in (0.0, 1.0, 2.0 + 6.0**0.5)]
        >>> [round(x, 4) for x in moving_residual((eye, eye, eye), tuple(places), (one, one, one))[0].tolist()]
        [1.0, 0.0, 0.0]
    """
    (y0, j0), (y1, j1) = project(inverses[0], views[0]), project(inverses[1], views[1])
    j0, j1 = scales[0][..., None, None, None] * j0, 2 * scales[1][..., None, None, None] * j1
    if views[2].shape[-1] == 3:
        y2, j2 = project(inverses[2], views[2])
        j2 = scales[2][..., None, None, None] * j2
        return whiten(y0 - 2 * y1 + y2, j0 @ j0.mT + j1 @ j1.mT + j2 @ j2.mT)
    seen, j = project(inverses[2], 2 * y1 - y0)
    noise = torch.eye(2, dtype=seen.dtype, device=seen.device) * scales[2][..., None, None, None].square()
    return whiten(seen - views[2], j @ (j0 @ j0.mT + j1 @ j1.mT) @ j.mT + noise)


def resting_residual(inverses: tuple[Tensor, ...], views: tuple[Tensor, ...], scales: tuple[Tensor, ...]) -> Tensor:
    r"""The differences :math:`(y_1 - y_0, y_2 - y_1)` of points that stand still, whitened; with a camera the second in the image.

    The square sum follows :math:`\chi^2` with 6 (5) degrees of freedom.  Unlike :func:`moving_residual` it depends on the common
    velocity, which it holds at 0.

    Args:
        inverses, views, scales: as in :func:`moving_residual`.

    Returns:
        ``(*batch, n, 6)``, or ``(*batch, n, 5)`` with a camera.

    Example:
        >>> import torch
        >>> one, eye = torch.tensor(1.0), torch.eye(4)
        >>> same = torch.ones(1, 3)
        >>> float(resting_residual((eye, eye, eye), (same, same, same), (one, one, one)).norm())
        0.0
    """
    (y0, j0), (y1, j1) = project(inverses[0], views[0]), project(inverses[1], views[1])
    q0 = scales[0][..., None, None, None].square() * (j0 @ j0.mT)
    q1 = scales[1][..., None, None, None].square() * (j1 @ j1.mT)
    if views[2].shape[-1] == 3:
        y2, j2 = project(inverses[2], views[2])
        last, cross, corner = y2 - y1, -q1, q1 + scales[2][..., None, None, None].square() * (j2 @ j2.mT)
    else:
        seen, j = project(inverses[2], y1)
        noise = torch.eye(2, dtype=seen.dtype, device=seen.device) * scales[2][..., None, None, None].square()
        last, cross, corner = seen - views[2], j @ q1, j @ q1 @ j.mT + noise
    covariance = torch.cat([torch.cat([q0 + q1, cross.mT], dim=-1), torch.cat([cross, corner], dim=-1)], dim=-2)
    return whiten(torch.cat([y1 - y0, last], dim=-1), covariance)

r"""Line cameras: how a camera maps the lines of space to the lines of its image, and back from such maps to cameras of points."""

from __future__ import annotations

import torch
from torch import Tensor

from dyntorch.algebra.extensors import compound, dual
from dyntorch.algebra.homogeneous import unit
from dyntorch.algebra.klein_quadric import klein_frame
from dyntorch.algebra.line_collineation import compound_rows


def line_camera(camera: Tensor) -> Tensor:
    r"""The projection of lines, :math:`l \sim M L`, of a projection of points: :math:`M (A \wedge B) = (P A) \times (P B)`.

    Its rows are the 2-minors of pairs of rows of P, the "meets" of the planes that these rows stand for: a line L meets the
    ray of the image point x iff :math:`x^T M L = 0`.

    Args:
        camera: ``(*batch, 3, 4)`` P, points of space to points of the image, of any scale.

    Returns:
        ``(*batch, 3, 6)`` M, of the square of that scale; lines in the order 01, 02, 03, 12, 13, 23.

    Raises:
        ValueError: another shape.

    Source: thesis section 1.3; Avidan and Shashua 2000, "Trajectory triangulation".

    Example:
        >>> import torch
        >>> line_camera(torch.eye(3, 4)).int().tolist()
        [[0, 0, 0, 1, 0, 0], [0, -1, 0, 0, 0, 0], [1, 0, 0, 0, 0, 0]]
    """
    if camera.ndim < 2 or camera.shape[-2:] != (3, 4):
        raise ValueError(f"camera must be (*batch, 3, 4), points of space to points of the image, got {tuple(camera.shape)}")
    return dual(compound(camera, 2).mT, 3, 2).mT


def camera_of_lines(matrix: Tensor) -> Tensor:
    r"""The camera of points whose line camera is given up to scale: the inverse of :func:`line_camera`.

    Row i of P, a plane, is common to the two lines in which it meets the other rows.  The scales follow from
    :math:`k_{ij} = \langle p_i \wedge p_j, C_{ij} \rangle / \|p_i \wedge p_j\|^2 = c\, \rho_i \rho_j`: up to a common factor
    :math:`\rho_i = k_{ij} k_{il}`, also where c is negative.

    Args:
        matrix: ``(*batch, 3, 6)`` of any scale and sign; with noise least squares in each step.

    Returns:
        ``(*batch, 3, 4)`` of norm 1; 0 for a matrix that is 0 or not finite.

    Raises:
        ValueError: another shape.

    Source: derived here.

    Example:
        >>> import torch
        >>> (camera_of_lines(-2 * line_camera(torch.eye(3, 4))) * 3**0.5).abs().round().int().tolist()
        [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]]
    """
    if matrix.ndim < 2 or matrix.shape[-2:] != (3, 6):
        raise ValueError(f"matrix must be (*batch, 3, 6), lines of space to lines of the image, got {tuple(matrix.shape)}")
    good = (matrix.isfinite().flatten(-2).all(-1) & (matrix.abs().amax((-1, -2)) > 0))[..., None, None]
    standard = line_camera(torch.eye(3, 4, dtype=torch.float64, device=matrix.device))
    safe = torch.where(good, matrix.double(), standard)
    lines = dual((safe / torch.linalg.matrix_norm(safe, keepdim=True)).mT, 3, 1).mT
    rows, ratio = compound_rows(lines, 3)
    k01, k02, k12 = ratio.unbind(-1)
    scale = torch.stack([k01 * k02, k01 * k12, k02 * k12], dim=-1)
    return torch.where(good, unit(scale[..., None] * rows), 0.0).to(matrix.dtype)


def cameras_of_lines(projections: Tensor) -> Tensor:
    r"""Cameras from projections P^5 to P^2 of lines that are known up to one collineation of P^5, as a tensor gives them.

    :math:`M_i = \mu_i\, C(P_i)\, H` with unknown H: the images of at least five views show where H has put the Klein quadric
    (:func:`~dyntorch.algebra.klein_quadric.klein_frame`).

    Args:
        projections: ``(*batch, views, 3, 6)``, five or more views, of any scale and sign each.

    Returns:
        ``(*batch, views, 3, 4)`` of norm 1, up to a collineation of space; 0 where the projections are not finite or have a
        common null vector.

    Raises:
        ValueError: another shape or fewer than five views.

    Source: derived here; thesis section 1.3 leaves it open.

    Example:
        >>> import torch
        >>> g = torch.Generator().manual_seed(0)
        >>> cameras, H = torch.randn(6, 3, 4, generator=g).double(), torch.randn(6, 6, generator=g).double()
        >>> found = cameras_of_lines(line_camera(cameras) @ H)
        >>> found.shape
        torch.Size([6, 3, 4])
    """
    return camera_of_lines(projections @ klein_frame(projections)[..., None, :, :])

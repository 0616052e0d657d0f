"""Cameras of known calibration: the nearest ones to any matrices, and the steps that stay among them."""

from __future__ import annotations

from dataclasses import dataclass
from math import prod

import torch
from torch import Tensor

from dyntorch.numerics.least_squares import damped_step

TINY = 1e-300


@dataclass(frozen=True)
class CalibratedCameras:
    r"""Cameras :math:`P \sim K\,[R_{:d} \mid *]` of known K: their first d columns are those of a rotation, the others are
    free."""

    matrices: Tensor
    """``(b, v, l + 1, l + 1)``."""
    turned: int
    """d."""

    def parts(self, cameras: Tensor) -> tuple[Tensor, Tensor]:
        """The orthonormal columns ``(b, v, 3, d)`` next to a camera and the others ``(b, v, 3, *)``, in units of the same
        scale."""
        seen = torch.linalg.solve_ex(self.matrices, cameras)[0]
        if cameras.shape[-2] == 4:
            last = seen[..., -1:, -1:]
            seen = seen / torch.where(last.abs() > TINY, last, 1.0)
        d = self.turned
        seen = torch.where(seen.isfinite(), seen, 0.0)[..., :3, :]
        u, s, vh = torch.linalg.svd(seen[..., :d], full_matrices=False)
        size = s.mean(-1)[..., None, None].clamp(min=TINY) if cameras.shape[-2] == 3 else torch.ones_like(s[..., :1, None])
        return u @ vh, seen[..., d:] / size

    def nearest(self, cameras: Tensor) -> Tensor:
        """The cameras of these calibrations next to any, ``(b, v, l + 1, a + 1)`` of any scale."""
        turn, rest = self.parts(cameras)
        found = torch.cat([turn, rest], dim=-1)
        if cameras.shape[-2] == 4:
            last = torch.eye(4, dtype=found.dtype, device=found.device)[3:, -found.shape[-1] :]
            found = torch.cat([found, last.expand(*found.shape[:-2], 1, -1)], dim=-2)
        return self.matrices @ found

    def tangents(self, cameras: Tensor) -> Tensor:
        """Changes of the entries of cameras of these calibrations, ``(b, v, (l + 1)(a + 1), p)``: turns, then the free columns."""
        turn, rest = self.parts(cameras)
        d, free = self.turned, rest.shape[-1]
        eye = torch.eye(3, dtype=cameras.dtype, device=cameras.device)
        size = torch.linalg.matrix_norm(torch.cat([turn, rest], dim=-1), keepdim=True)
        turns = torch.linalg.cross(eye[:, None, None, None, :], turn.mT[None], dim=-1).mT  # (3, b, v, 3, d)
        total = cameras.new_zeros(3 + 3 * free, *cameras.shape[:2], cameras.shape[-2], cameras.shape[-1])
        total[:3, :, :, :3, :d] = turns
        for column in range(free):
            for row in range(3):
                total[3 + 3 * column + row, :, :, row, d + column] = 1.0
        return (self.matrices @ total / size).flatten(-2).permute(1, 2, 3, 0)

    def step(self, cameras: Tensor, gradient: Tensor, matrix: Tensor, damping: Tensor) -> Tensor:
        """The damped step within these cameras, from the gradient by their entries and its matrix ``(b, p, p)``."""
        basis = self.tangents(cameras)
        b, v, entries, free = basis.shape
        inner = torch.einsum("bvep,bvewf,bwfq->bvpwq", basis, matrix.view(b, v, entries, v, entries), basis)
        slope = (basis.mT @ gradient.flatten(2)[..., None]).flatten(1)
        move = damped_step(slope, inner.reshape(b, v * free, v * free), damping).view(b, v, free, 1)
        return (basis @ move).view_as(cameras)


def calibrations(calibration: Tensor, batch: tuple[int, ...], views: int, like: Tensor, size: int = 2) -> Tensor:
    """K of every view, ``(b, views, size + 1, size + 1)``, from one for all, one for each view, or also for each problem."""
    want = (*batch, views, size + 1, size + 1)
    shapes = ((size + 1, size + 1), want[-3:], want)
    if not isinstance(calibration, Tensor) or tuple(calibration.shape) not in shapes:
        got = tuple(calibration.shape) if isinstance(calibration, Tensor) else type(calibration).__name__
        raise ValueError(f"calibration must be a tensor K {' or '.join(map(str, dict.fromkeys(shapes)))}, got {got}")
    K = calibration.detach().to(like).expand(want).reshape(prod(batch), views, size + 1, size + 1)
    if not bool(K.isfinite().all()) or bool((torch.linalg.det(K) == 0).any()):
        raise ValueError("calibration must be finite and invertible; a camera has K = [f 0 u; 0 f v; 0 0 1]")
    if size == 2 and bool((K[..., 2, :2] != 0).any()):
        raise ValueError(
            f"calibration must have the last row (0, 0, 1), got {K[..., 2, :].reshape(-1, 3)[0].tolist()}; transposed?"
        )
    return K

"""Scenes of shapes seen by uncalibrated cameras, and what the theory says of their tensors: one entry per form of ShapeTensor."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from dyntorch.invariants.shape_tensor import ShapeTensor


@dataclass(frozen=True)
class ShapeCase:
    """One form and its counts, by the theory."""

    invariant: ShapeTensor
    minimal: int
    """Fewest views."""
    width: int
    """Unknowns that the synthetic constraints leave."""
    dof: int
    conditions: int
    """What the exact coordinates of one view fulfil."""

    @property
    def frame(self) -> str:
        return self.invariant.frame

    @property
    def n(self) -> int:
        return self.invariant.n

    def scene(
        self, views: int, *, batch: tuple[int, ...] = (), seed: int = 0, sigma: float = 0.0
    ) -> tuple[tuple[Tensor, ...], Tensor]:
        """Images ``(*batch, views, 2)`` of every point, in pixels, and the points of space ``(*batch, n, 3)``."""
        g = torch.Generator().manual_seed(seed)
        shape = spread(self.n, batch, g)
        if self.frame == "plane":
            corners = shape[..., :3, :]
            shape[..., 3, :] = corners[..., 0, :] + corners[..., 1, :] - corners[..., 2, :]
        turn = torch.linalg.qr(torch.randn(*batch, views, 3, 3, generator=g, dtype=torch.float64)).Q
        seen = shape[..., None, :, :] @ turn.mT
        depth = 1.0 if self.frame == "affine" else 6.0 + seen[..., 2:]
        x = 300 + 800 * seen[..., :2] / depth
        x = x + sigma * torch.randn(x.shape, generator=g, dtype=torch.float64)
        return x.unbind(-2), shape

    def changed(self, points: tuple[Tensor, ...], *, similar: bool = False, seed: int = 5) -> tuple[Tensor, ...]:
        """The same after a change of coordinates of every view, its own: a similarity, or what the cameras leave open."""
        g = torch.Generator().manual_seed(seed)
        x = torch.stack(points, dim=-2)
        frame = torch.eye(3, dtype=torch.float64) + 0.25 * torch.randn(*x.shape[:-2], 3, 3, generator=g, dtype=torch.float64)
        frame[..., 2, :] = torch.tensor([0.0, 0.0, 1.0])
        if similar:
            angle, size = torch.rand(2, *x.shape[:-2], generator=g, dtype=torch.float64)
            cosine, sine = (0.2 + size) * (6 * angle).cos(), (0.2 + size) * (6 * angle).sin()
            frame[..., :2, :2] = torch.stack([cosine, -sine, sine, cosine], dim=-1).unflatten(-1, (2, 2))
        elif self.frame != "affine":
            frame[..., 2, :2] = 1e-4 * torch.randn(*x.shape[:-2], 2, generator=g, dtype=torch.float64)
        moved = torch.nn.functional.pad(x, (0, 1), value=1.0) @ frame.mT
        return (moved[..., :2] / moved[..., 2:]).unbind(-2)

    def apart(self, first: Tensor, second: Tensor) -> float:
        """How far two tensors are apart, up to sign or basis."""
        count = self.invariant.nullity
        rows = [t.flatten(-len(self.invariant.shape())).reshape(-1, count, self.size) for t in (first, second)]
        left, right = (r.mT @ r for r in rows)
        return float((left - right).abs().max()) if left.numel() else 0.0

    @property
    def size(self) -> int:
        return torch.Size(self.invariant.shape()).numel()

    def __repr__(self) -> str:
        return f"{self.frame}{self.n}"


def spread(n: int, batch: tuple[int, ...], generator: torch.Generator) -> Tensor:
    """Points ``(*batch, n, 3)`` in general position: corners of a cube in turn, moved about."""
    corners = torch.tensor([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1], [-1, -1, -1], [-1, 1, 1], [1, -1, 1], [1, 1, -1]])
    places = corners.double().repeat(-(-n // 8), 1)[:n]
    return places + 0.35 * torch.randn(*batch, n, 3, generator=generator, dtype=torch.float64)


SHAPE_CASES = [
    ShapeCase(ShapeTensor("general", 6), 4, 5, 3, 1),
    ShapeCase(ShapeTensor("general", 7), 3, 11, 6, 3),
    ShapeCase(ShapeTensor("general", 8), 2, 23, 9, 5),
    ShapeCase(ShapeTensor("plane", 6), 2, 3, 2, 1),
    ShapeCase(ShapeTensor("plane", 7), 2, 6, 5, 3),
    ShapeCase(ShapeTensor("plane", 8), 2, 9, 8, 5),
    ShapeCase(ShapeTensor("plane", 11), 2, 18, 17, 11),
    ShapeCase(ShapeTensor("affine", 5), 2, 4, 3, 2),
    ShapeCase(ShapeTensor("affine", 9), 2, 8, 15, 10),
]

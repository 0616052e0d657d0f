"""Scenes of shapes seen by uncalibrated cameras, and what the theory says of their tensors: one entry per form of them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

import dyntorch as dyn


@dataclass(frozen=True)
class ShapeCase:
    """One form and its counts, by the theory."""

    invariant: dyn.ShapeTensor | dyn.DynamicShapeTensor | dyn.LiftedShapeTensor
    minimal: int
    """Fewest views."""
    width: int
    """Unknowns that the synthetic constraints leave."""
    dof: int
    conditions: int
    """What the exact coordinates of one view fulfil."""
    exact: float = 1e-9
    """Error of tensors that should be the same: descents stop where the cost does, at the root of its digits."""

    @property
    def frame(self) -> str:
        return "affine" if self.timed else self.invariant.frame

    @property
    def timed(self) -> bool:
        """Whether the points move; the times of the views then stand behind the points, ``(*batch, views, 1)``."""
        return isinstance(self.invariant, dyn.DynamicShapeTensor)

    @property
    def dims(self) -> tuple[int, int]:
        return (self.invariant.k, self.invariant.l) if isinstance(self.invariant, dyn.LiftedShapeTensor) else (3, 2)

    @property
    def n(self) -> int:
        return self.invariant.points

    @property
    def many(self) -> int:
        """More views than needed."""
        return max(8, 2 * self.minimal)

    def arguments(self, views: tuple[Tensor, ...]) -> tuple[tuple[Tensor, ...], dict[str, Tensor]]:
        return (views[:-1], {"times": views[-1][..., 0]}) if self.timed else (views, {})

    def fit(self, views: tuple[Tensor, ...], **options: Tensor) -> dyn.Solution:
        """By an invariant that does not know the number of points."""
        points, given = self.arguments(views)
        return dyn.fit(replace(self.invariant, points=5 if self.timed else None), *points, **given, **options)

    def refine(self, solution: dyn.Solution, views: tuple[Tensor, ...]) -> dyn.Solution:
        points, given = self.arguments(views)
        return dyn.refine(solution, *points, **given)

    def sampson(self, tensor: Tensor, views: tuple[Tensor, ...]) -> Tensor:
        points, given = self.arguments(views)
        return dyn.sampson(self.invariant, tensor, *points, **given)

    def rows(self, views: tuple[Tensor, ...]) -> Tensor:
        points, given = self.arguments(views)
        invariant, measured = self.invariant.bind_arguments(points, **given)
        return invariant.primitives[0].vectors(measured[0])

    def scene(
        self, views: int, *, batch: tuple[int, ...] = (), seed: int = 0, sigma: float = 0.0
    ) -> tuple[tuple[Tensor, ...], Tensor]:
        """Images ``(*batch, views, 2)`` of every point, in pixels (and times), and the points of space ``(*batch, n, 3)``."""
        g, (k, d) = torch.Generator().manual_seed(seed), self.dims
        shape = spread(self.n, batch, g, k)
        if self.timed:
            return self._moving(shape, views, sigma, g)
        if self.frame == "plane":
            corners = shape[..., :k, :]
            shape[..., k, :] = corners[..., :-1, :].sum(-2) - (k - 2) * corners[..., -1, :]
        turn = torch.linalg.qr(torch.randn(*batch, views, k, k, generator=g, dtype=torch.float64)).Q
        seen = shape[..., None, :, :] @ turn.mT
        depth = 1.0 if self.frame == "affine" else 6.0 + seen[..., d : d + 1]
        x = 300 + 800 * seen[..., :d] / depth
        x = x + sigma * torch.randn(x.shape, generator=g, dtype=torch.float64)
        return x.unbind(-2), shape

    def _moving(self, shape: Tensor, views: int, sigma: float, g: torch.Generator) -> tuple[tuple[Tensor, ...], Tensor]:
        """The same of points in motion, at times that reach from -1 to 1 however few the views are; shapes ``(*batch, n, 3 B)``."""
        *batch, n, _ = shape.shape
        trajectory = self.invariant.trajectory
        ways = 0.6 * torch.randn(*batch, trajectory.size - 1, n, 3, generator=g, dtype=torch.float64)
        shapes = torch.cat([shape[..., None, :, :], ways], dim=-3)
        inner = 2 * torch.rand(*batch, max(0, views - 2), generator=g, dtype=torch.float64) - 1
        ends = torch.tensor([-1.0, 1.0], dtype=torch.float64).expand(*batch, 2)
        times = torch.cat([inner, ends], dim=-1)[..., -views:]
        turn = torch.linalg.qr(torch.randn(*batch, views, 3, 3, generator=g, dtype=torch.float64)).Q
        x = 300 + 800 * torch.einsum("...vb,...bnk,...vkd->...vnd", trajectory.rows(times), shapes, turn[..., :2])
        x = x + sigma * torch.randn(x.shape, generator=g, dtype=torch.float64)
        return (*x.unbind(-2), times[..., None]), shapes.movedim(-3, -2).flatten(-2)

    def changed(self, points: tuple[Tensor, ...], *, similar: bool = False, seed: int = 5) -> tuple[Tensor, ...]:
        """The same after a change of coordinates of every view, its own: a similarity, or what the cameras leave open."""
        g = torch.Generator().manual_seed(seed)
        x = torch.stack(points[: self.n], dim=-2)
        d = self.dims[1]
        frame = torch.eye(d + 1).double() + 0.25 * torch.randn(*x.shape[:-2], d + 1, d + 1, generator=g, dtype=torch.float64)
        frame[..., d, :] = torch.eye(d + 1, dtype=torch.float64)[d]
        if similar and d == 2:
            angle, size = torch.rand(2, *x.shape[:-2], generator=g, dtype=torch.float64)
            cosine, sine = (0.2 + size) * (6 * angle).cos(), (0.2 + size) * (6 * angle).sin()
            frame[..., :2, :2] = torch.stack([cosine, -sine, sine, cosine], dim=-1).unflatten(-1, (2, 2))
        elif similar:
            size = 0.2 + torch.rand(*x.shape[:-2], 1, 1, generator=g, dtype=torch.float64)
            frame[..., :d, :d] = size * torch.linalg.qr(frame[..., :d, :d]).Q
        elif self.frame != "affine":
            frame[..., d, :d] = 1e-4 * torch.randn(*x.shape[:-2], d, generator=g, dtype=torch.float64)
        moved = torch.nn.functional.pad(x, (0, 1), value=1.0) @ frame.mT
        return (*(moved[..., :d] / moved[..., d:]).unbind(-2), *points[self.n :])

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
        form = f"{self.invariant.form}-{type(self.invariant.trajectory).__name__}-" if self.timed else self.frame
        lifted = f"P{self.dims[0]}-P{self.dims[1]}-" if isinstance(self.invariant, dyn.LiftedShapeTensor) else ""
        return f"{lifted}{form}{self.n}"


def spread(n: int, batch: tuple[int, ...], generator: torch.Generator, k: int = 3) -> Tensor:
    """Points ``(*batch, n, k)`` in general position: corners of a cube in turn, moved about."""
    if k != 3:
        return 1.3 * torch.randn(*batch, n, k, generator=generator, dtype=torch.float64).clamp(-2, 2)
    corners = torch.tensor([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1], [-1, -1, -1], [-1, 1, 1], [1, -1, 1], [1, 1, -1]])
    places = corners.double().repeat(-(-n // 8), 1)[:n]
    return places + 0.35 * torch.randn(*batch, n, 3, generator=generator, dtype=torch.float64)


SHAPE_CASES = [
    ShapeCase(dyn.ShapeTensor("general", 6), 4, 5, 3, 1),
    ShapeCase(dyn.ShapeTensor("general", 7), 3, 11, 6, 3),
    ShapeCase(dyn.ShapeTensor("general", 8), 2, 23, 9, 5),
    ShapeCase(dyn.ShapeTensor("plane", 6), 2, 3, 2, 1),
    ShapeCase(dyn.ShapeTensor("plane", 7), 2, 6, 5, 3),
    ShapeCase(dyn.ShapeTensor("plane", 8), 2, 9, 8, 5),
    ShapeCase(dyn.ShapeTensor("plane", 11), 2, 18, 17, 11),
    ShapeCase(dyn.ShapeTensor("affine", 5), 2, 4, 3, 2),
    ShapeCase(dyn.ShapeTensor("affine", 9), 2, 8, 15, 10),
    ShapeCase(dyn.DynamicShapeTensor(form="basis", points=7), 7, 40, 27, 6),
    ShapeCase(dyn.DynamicShapeTensor(form="span", points=9), 3, 8, 12, 4),
    ShapeCase(dyn.DynamicShapeTensor(points=8), 7, 52, 33, 8, exact=1e-5),
    ShapeCase(dyn.DynamicShapeTensor(dyn.Fourier(1), points=7), 12, 70, 45, 6, exact=1e-5),
]

LIFTED_CASES = [
    ShapeCase(dyn.LiftedShapeTensor(4, points=8), 10, 21, 8, 2),
    ShapeCase(dyn.LiftedShapeTensor(4, points=9), 6, 47, 12, 4),
    ShapeCase(dyn.LiftedShapeTensor(4, 3, points=8), 2, 29, 8, 5),
    ShapeCase(dyn.LiftedShapeTensor(2, 1, points=6), 4, 5, 4, 1),
    ShapeCase(dyn.LiftedShapeTensor(3, points=7), 3, 11, 6, 3),
    ShapeCase(dyn.LiftedShapeTensor(4, 3, "plane", 9), 2, 12, 11, 8),
    ShapeCase(dyn.LiftedShapeTensor(6, 2, "affine", 10), 3, 9, 18, 6),
]
"""Any projections P^k -> P^l."""

"""The least squares problem that refinement solves: whitened residuals of all matches in the entries of a motion."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from dyntorch.forward import by_match
from dyntorch.invariant import Invariant
from dyntorch.residual import multilinear_derivative

BLOCK = 1 << 18
"""Entries of the Jacobian per block of the batch: larger ones leave the cache, smaller ones pay for the calls."""


@dataclass(frozen=True)
class Problem:
    """Least squares in the entries of a motion, over a block of problems."""

    invariant: Invariant
    shapes: tuple[torch.Size, ...]
    views: tuple[Tensor, ...]
    scales: tuple[Tensor, ...]
    weights: Tensor
    static: Tensor | None

    def parts(self, theta: Tensor) -> tuple[Tensor, ...]:
        """The motion ``(b, *shape)`` of parameters ``(b, p)``."""
        return parts_of(theta, self.shapes)

    def subset(self, keep: Tensor) -> Problem:
        """Only some of the problems."""
        cut = [x[keep] for x in self.views], [s[keep] for s in self.scales], self.weights[keep]
        static = None if self.static is None else self.static[keep]
        return Problem(self.invariant, self.shapes, tuple(cut[0]), tuple(cut[1]), cut[2], static)

    def residual(self, theta: Tensor, piece: slice) -> tuple[Tensor, Tensor]:
        """Weighted whitened residuals ``(b, rows)`` of some of the matches, and their derivative ``(b, p, rows)``."""
        views, weights = tuple(x[:, piece] for x in self.views), self.weights[:, piece]
        still = None if self.static is None else self.static[:, piece]
        moving = weights if still is None else weights * ~still
        value, derivative = self.moving(theta, views)
        root = moving.sqrt()[..., None].expand(*moving.shape, value.shape[1] // max(1, moving.shape[1])).flatten(1)
        value, derivative = value * root, derivative * root[:, None]
        if still is None:
            return value, derivative
        resting = (weights * still).sqrt()[..., None]
        more = self.resting(theta, views)
        more = (
            (more[0].unflatten(1, (views[0].shape[1], -1)) * resting).flatten(1),
            more[1] * resting.expand(*resting.shape[:2], more[0].shape[1] // max(1, resting.shape[1])).flatten(1)[:, None],
        )
        return torch.cat([value, more[0]], dim=-1), torch.cat([derivative, more[1]], dim=-1)

    def moving(self, theta: Tensor, views: tuple[Tensor, ...]) -> tuple[Tensor, Tensor]:
        """Unweighted residuals of matches that may move, and their derivative."""
        known = self.invariant.linearized(self.parts(theta), views, self.scales)
        if known is not None:
            return known
        empty = tuple(x[:0] for x in views), tuple(scale[:0] for scale in self.scales)
        if self.invariant.whitened(self.parts(theta[:0]), *empty) is not None:
            shared, slope = self.invariant.shared_derivative(self.parts(theta))
            value, derivative = self._by_match(self.invariant.whitened_shared, flattened(shared), views)
            return value, derivative if slope is None else slope @ derivative
        # one row per match: by hand through the tensor, several times cheaper than forward mode through the matches
        tensor, slope = self.invariant.compose_derivative(self.parts(theta))
        shape = self.invariant.shape()
        value, derivative = multilinear_derivative(self.invariant, tensor.unflatten(1, shape), views, self.scales)
        return value, slope @ derivative.mT

    def resting(self, theta: Tensor, views: tuple[Tensor, ...]) -> tuple[Tensor, Tensor]:
        """Unweighted residuals of matches that do not move, and their derivative."""
        return self._by_match(self.invariant.whitened_static, theta, views)

    def _by_match(self, function: Callable[..., Tensor], theta: Tensor, views: tuple[Tensor, ...]) -> tuple[Tensor, Tensor]:
        """Residuals ``(b, n c)`` and derivative ``(b, p, n c)``."""

        def residual(copies: Tensor, scales: tuple[Tensor, ...], single: tuple[Tensor, ...]) -> Tensor:
            return function(self.parts(copies), single, scales)

        return by_match(residual, theta, self.scales, views)

    def pieces(self, width: int) -> list[slice]:
        """The matches in slices whose Jacobians fit into memory, whatever their number."""
        n = self.weights.shape[-1]
        step = max(256, 8 * BLOCK // (max(1, width) * max(1, self.weights.shape[0])))
        return [slice(start, start + step) for start in range(0, max(n, 1), step)]

    def normal_equations(self, theta: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Cost ``(b,)``, gradient ``(b, p)`` and Gauss-Newton matrix ``(b, p, p)``."""
        cost = torch.zeros(theta.shape[0], dtype=theta.dtype, device=theta.device)
        gradient, matrix = torch.zeros_like(theta), theta.new_zeros(*theta.shape, theta.shape[-1])
        for piece in self.pieces(theta.shape[-1]):
            value, derivative = self.residual(theta, piece)
            cost = cost + value.square().sum(-1)
            gradient = gradient + (derivative @ value[..., None])[..., 0]
            matrix = matrix + derivative @ derivative.mT
        return torch.where(cost.isfinite(), cost, torch.inf), gradient, matrix


def parts_of(theta: Tensor, shapes: Sequence[torch.Size]) -> tuple[Tensor, ...]:
    """The inverse of :func:`flattened`."""
    sizes = [shape.numel() for shape in shapes]
    return tuple(part.unflatten(-1, shape) for part, shape in zip(theta.split(sizes, -1), shapes, strict=True))


def flattened(parts: tuple[Tensor, ...]) -> Tensor:
    """All entries of a motion, ``(b, p)``."""
    return torch.cat([part.flatten(1) for part in parts], dim=-1)

"""What a fit returns: the tensor, an honest status per problem, and what later steps need."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Self

import torch
from torch import Tensor

from dyntorch.core.invariant import Invariant
from dyntorch.core.matches import Matches
from dyntorch.core.matrix import triangular_factor
from dyntorch.core.normalize import Normalization, denormalize_motion
from dyntorch.core.outcome import Outcome, Status, check_status, is_failure
from dyntorch.numerics.arguments import check_precision
from dyntorch.numerics.blocks import select
from dyntorch.numerics.function_transforms import mapped_over, over_problems

NOISY = 0.05
"""Estimated noise over the extent of the points above which agreement with a tensor is an accident: random matches of space, with
the noise estimated, agreed with every model, at 0.29 to 1.0."""


@dataclass(frozen=True, eq=False, repr=False)
class Solution(Outcome):
    """Result of :func:`dyntorch.fit`, :func:`dyntorch.robust_fit` and :func:`dyntorch.refine`.

    It refers to the matches it was given, without a copy: what is computed on first use (``singular_values``) follows them.

    Attributes:
        invariant: what was fitted.
        tensor: ``(*batch, *axes)``, ``(*batch, nullity, *axes)`` where the nullity is above 1; Frobenius norm 1, zero where
            the status says that there is none.
        uncertainty: ``(*batch,)`` expected relative error of the tensor from the noise that the residuals show; 0 where the
            matches are as few as can be (nothing is left to judge by).
        inliers: ``(*batch, n)`` bool, after robust estimation.
        covariance: ``(*batch, p, p)`` of the entries of all parts of ``motion``, one after the other, after refinement.
        sigma: ``(*batch,)`` noise of one coordinate that the residuals show, after robust estimation or refinement.
    """

    invariant: Invariant
    tensor: Tensor
    uncertainty: Tensor
    matches: Matches = field(repr=False)
    normalization: Normalization = field(repr=False)
    normalized: Tensor = field(repr=False)
    """The tensor of the normalized matches, flat batch, float64."""
    inliers: Tensor | None = None
    covariance: Tensor | None = None
    sigma: Tensor | None = None
    refined: tuple[Tensor, ...] | None = field(default=None, repr=False)
    """Motion in normalized coordinates, flat batch, where it does not come from the tensor."""

    @cached_property
    def motion(self) -> tuple[Tensor, ...]:
        """The parts of the motion in the coordinates of the matches; decomposed in normalized ones, which is more accurate."""
        state = self.normalized, self.status.reshape(-1), self.normalization.transforms, self.refined
        return tuple(self.matches.back(part) for part in over_problems(self._motion, *state))

    def _motion(
        self, normalized: Tensor, status: Tensor, transforms: tuple[Tensor, ...], refined: tuple[Tensor, ...] | None
    ) -> tuple[Tensor, ...]:
        """:attr:`motion`, flat batch, float64."""
        parts = self.invariant.normalize(transforms).motion_of(normalized) if refined is None else refined
        moved = denormalize_motion(self.invariant, parts, _frames(transforms))
        return tuple(select(~is_failure(status.to(part.device)), part, 0.0) for part in moved)

    @cached_property
    def singular_values(self) -> Tensor:
        """``(*batch, D)`` of the estimation matrix of the normalized, weighted matches, descending.

        Computed on first use from the matrix itself, so that they are accurate down to the rounding of the largest one.
        """
        m = self.matches
        if self.invariant.motion_alone:
            raise ValueError(f"{self.invariant!r} has no estimation matrix: it holds the motion of all views, and no tensor")
        views, weights, static = with_copies(self.invariant, m.views, m.weights, m.static)
        moved = self.normalization.apply(self.invariant, views)
        values = torch.linalg.svdvals(triangular_factor(self.normalization.primitives, moved, weights, static))
        width = self.invariant.width()
        return self.matches.back(torch.nn.functional.pad(values, (0, width - values.shape[-1])))

    def normalized_motion(self) -> tuple[Tensor, ...]:
        """Parts of the motion in normalized coordinates, flat batch, float64."""
        if self.refined is not None:
            return self.refined
        return self.base().motion_of(self.normalized)

    def base(self) -> Invariant:
        """The invariant of the normalized matches."""
        return self.invariant.normalize(self.normalization.transforms)

    def frames(self) -> tuple[Tensor, ...]:
        """What normalized the views, ``(b, d + 1, d + 1)`` each, without an axis of copies."""
        return _frames(self.normalization.transforms)

    def back(self, data: Matches) -> Solution:
        """This solution of flat float64 problems in the batch, dtype and device of the caller's matches."""
        return self._each(data.back, lambda part: part, data)

    def __getitem__(self, key: Any) -> Solution:
        """The solution of some problems of the batch: an index, a slice, a mask or several of them, as a tensor takes them."""
        batch = self.matches.batch
        if not batch:
            raise IndexError("the solution is that of one problem; there is no batch to index")
        chosen = torch.arange(math.prod(batch)).reshape(batch)[key]
        flat = chosen.reshape(-1).to(self.normalized.device)

        def some(part: Tensor) -> Tensor:
            return part.flatten(0, len(batch) - 1)[flat.to(part.device)].reshape((*chosen.shape, *part.shape[len(batch) :]))

        data = self.matches
        static = None if data.static is None else data.static[flat]
        views, weights = tuple(x[flat] for x in data.views), data.weights[flat]
        data = replace(data, views=views, weights=weights, static=static, batch=tuple(chosen.shape))
        return replace(self._each(some, lambda part: part[flat], data), notices=())

    def to(self, *target: torch.device | torch.dtype | str) -> Solution:
        """The solution on another device, in another dtype, or both, as ``torch.Tensor.to`` takes them.

        What is computed inside stays float64; devices without it get results computed on the CPU.

        Raises:
            ValueError: a dtype that is neither float32 nor float64.
        """
        data = self.matches
        dtype = next((t for t in target if isinstance(t, torch.dtype)), data.dtype)
        device = next((torch.device(t) for t in target if not isinstance(t, torch.dtype)), data.device)
        check_precision("a solution", dtype)
        home = torch.device("cpu") if device.type == "mps" else device

        def there(part: Tensor) -> Tensor:
            return part.to(device=device, dtype=dtype if part.is_floating_point() else part.dtype)

        static = None if data.static is None else data.static.to(home)
        views, weights = tuple(x.to(home) for x in data.views), data.weights.to(home)
        data = replace(data, views=views, weights=weights, static=static, dtype=dtype, device=device)
        return self._each(there, lambda part: part.to(home), data)

    def _each(self, outer: Callable[[Tensor], Tensor], inner: Callable[[Tensor], Tensor], data: Matches) -> Solution:
        """Another solution: ``outer`` of what the caller sees, ``inner`` of flat float64 tensors, and these matches."""
        names = ("tensor", "uncertainty", "status", "inliers", "covariance", "sigma")
        shown: dict[str, Any] = {name: outer(part) for name in names if (part := getattr(self, name)) is not None}
        return replace(
            self,
            **shown,
            matches=data,
            normalization=Normalization.of(self.invariant, tuple(map(inner, self.normalization.transforms))),
            normalized=inner(self.normalized),
            refined=None if self.refined is None else tuple(map(inner, self.refined)),
        )

    def check(self) -> Self:
        """Raise where any problem failed.

        Raises:
            ValueError: says which problems of the batch failed, how, and what to do.
        """
        check_status(repr(self.invariant), self.status, self.notices)
        return self

    def __repr__(self) -> str:
        if mapped_over(self.status):
            return f"Solution({self.invariant!r}, matches={self.matches.count}, batch={tuple(self.status.shape)}: mapped over)"
        noise = "" if self.sigma is None else _noise_text(self.sigma[self.status == Status.OK])
        shape = tuple(self.status.shape)
        return f"Solution({self.invariant!r}, matches={self.matches.count}, batch={shape}: {self.count_statuses()}{noise})"


def _frames(transforms: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
    return tuple(t.reshape(t.shape[0], *t.shape[-2:]) for t in transforms)


def _noise_text(sigma: Tensor) -> str:
    """The noise for a repr: of a batch the median."""
    return f", sigma {'about ' if sigma.numel() > 1 else ''}{float(sigma.detach().median()):.2g}" if sigma.numel() else ""


def with_copies(
    invariant: Invariant, views: tuple[Tensor, ...], weights: Tensor, static: Tensor | None
) -> tuple[tuple[Tensor, ...], Tensor, Tensor | None]:
    """Views, weights and labels with the dimension of copies behind the batch, for an invariant that has it."""
    if invariant.copies is None:
        return views, weights, static
    return tuple(x[:, None] for x in views), weights[:, None], None if static is None else static[:, None]

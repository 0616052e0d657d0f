"""What a synthetic scene consists of, and the steps common to all of them: labels, noise, outliers, sensor poses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import TypeVar

import torch
from torch import Tensor
from torch.nn.functional import normalize

from dyntorch.geometry.homogeneous import skew, unit
from dyntorch.numerics.blocks import each

OUTLIER, STATIC, MOVING = 0, 1, 2


Record = TypeVar("Record")


def convert(record: Record, dtype: torch.dtype | None, device: torch.device | str | None = None) -> Record:
    """A record with its tensors in another floating point type or on another device; integers stay integers."""
    return each(lambda x: x.to(device=device, dtype=dtype if x.is_floating_point() else None), record)


@dataclass(frozen=True)
class Scene:
    """Measurements with their ground truth.

    Attributes:
        views: the noisy measurements, one tensor ``(*batch, n, ...)`` per view.
        exact: the same without noise and outliers.
        motion: the true matrices, ``(*batch, rows, columns)`` each, of Frobenius norm 1 and canonical sign.
        labels: ``(*batch, n)``: 0 outlier, 1 static, 2 moving.
        sigma: standard deviation of the noise, in the unit of the views.
        extras: further truth by name, see the function that made the scene; always ``moving`` ``(*batch, n)``, what a match
            was before an outlier replaced it.
    """

    views: tuple[Tensor, ...]
    exact: tuple[Tensor, ...]
    motion: tuple[Tensor, ...]
    labels: Tensor
    sigma: float
    extras: dict[str, Tensor] = field(default_factory=dict)

    def to(self, dtype: torch.dtype | None = None, device: torch.device | str | None = None) -> Scene:
        """The scene in another floating point type or on another device; labels stay integers, flags stay booleans."""
        extras = {name: convert(x, dtype, device) for name, x in self.extras.items()}
        return replace(convert(self, dtype, device), extras=extras)


class Draw:
    """The random choices of one batch of scenes: checks the common arguments, assigns the labels, draws in float64."""

    def __init__(
        self,
        n: int,
        batch: int | Sequence[int],
        sigma: float,
        static: float,
        outliers: float,
        generator: torch.Generator | None,
        dtype: torch.dtype,
    ) -> None:
        self.batch = (batch,) if isinstance(batch, int) else tuple(batch)
        if n < 1 or any(b < 0 for b in self.batch):
            raise ValueError(f"a scene needs n >= 1 matches and batch sizes >= 0, got n={n}, batch={self.batch}")
        if not sigma >= 0:
            raise ValueError(f"sigma must be >= 0, got {sigma}")
        for name, share in (("static", static), ("outliers", outliers)):
            if not 0 <= share <= 1:
                raise ValueError(f"{name} is a share from 0 to 1, got {share}")
        self.n, self.sigma, self.generator, self.dtype = n, sigma, generator, dtype
        self.labels, self.moving = self._labels(static, outliers)

    def uniform(self, *shape: int, low: float = 0.0, high: float = 1.0) -> Tensor:
        """``(*batch, *shape)`` uniform numbers."""
        device = self.generator.device if self.generator is not None else None
        return torch.rand(*self.batch, *shape, generator=self.generator, dtype=torch.float64, device=device) * (high - low) + low

    def normal(self, *shape: int) -> Tensor:
        """``(*batch, *shape)`` standard normal numbers."""
        device = self.generator.device if self.generator is not None else None
        return torch.randn(*self.batch, *shape, generator=self.generator, dtype=torch.float64, device=device)

    def directions(self, *shape: int) -> Tensor:
        """``(*batch, *shape)`` unit vectors in all directions."""
        return torch.nn.functional.normalize(self.normal(*shape), dim=-1)

    def rotations(self, *shape: int, spread: float) -> Tensor:
        """``(*batch, *shape, 3, 3)`` rotations by about ``spread`` radians."""
        return torch.linalg.matrix_exp(skew(spread * self.normal(*shape, 3)))

    def sensors(self, count: int, kind: str) -> Tensor:
        """``(*batch, count, 4, 4)`` world to sensor maps; the plane at infinity stays clear of the scene."""
        if kind not in ("projective", "affine", "rigid"):
            raise ValueError(f"sensors must be 'projective', 'affine' or 'rigid', got {kind!r}")
        upper = torch.cat([self.rotations(count, spread=0.3), 0.5 * self.normal(count, 3, 1)], dim=-1)
        last = torch.zeros_like(upper[..., :1, :])
        last[..., 3] = 1.0
        if kind != "rigid":
            upper = upper + 0.15 * self.normal(count, 3, 4)
        if kind == "projective":
            last[..., :3] = self.uniform(count, 1, 3, low=-0.06, high=0.06)
        return torch.cat([upper, last], dim=-2)

    def _labels(self, static: float, outliers: float) -> tuple[Tensor, Tensor]:
        """Labels and the kind before the outliers, in random order; ``static`` is the share among inliers and outliers alike."""
        wrong = round(outliers * self.n)
        still = round(static * (self.n - wrong))
        place = self.uniform(self.n).argsort(dim=-1)
        labels = torch.full_like(place, MOVING)
        labels = torch.where(place < wrong + still, STATIC, labels)
        labels = torch.where(place < wrong, OUTLIER, labels)
        return labels, (labels == MOVING) | (place < wrong - round(static * wrong))

    def scene(self, exact: Sequence[Tensor], motion: Sequence[Tensor], **extras: Tensor) -> Scene:
        """Add the noise and the outliers: one view of the second and later, uniform in the bounding box of that view."""
        views = [x + self.sigma * self.normal(*x.shape[len(self.batch) :]) for x in exact]
        chosen = 1 + (self.uniform(self.n) * (len(views) - 1)).long()
        for v in range(1, len(views)):
            item = views[v].shape[len(self.batch) + 1 :]
            spread = views[v].flatten(len(self.batch), -2)
            low, high = spread.amin(-2), spread.amax(-2)
            shape = (*self.batch, *(1 for _ in item), item[-1])
            random = low.reshape(shape) + self.uniform(self.n, *item) * (high - low).reshape(shape)
            hit = (self.labels == OUTLIER) & (chosen == v)
            views[v] = torch.where(hit.reshape(*hit.shape, *(1 for _ in item)), random, views[v])
        found = Scene(
            tuple(views), tuple(exact), tuple(unit(m) for m in motion), self.labels, self.sigma, {"moving": self.moving, **extras}
        )
        return found.to(dtype=self.dtype)


# ----------------------------------------------------------------------------------------------------------------------
# Calibrated cameras that look at a point of the scene.


def looking_at(position: Tensor, target: Tensor, up: Tensor) -> Tensor:
    r"""World to camera maps :math:`[R \mid -R c]` of cameras at c whose optical axis passes through a target. position
    ``(*batch, 3)``, target ``(*batch, 3)``, up ``(*batch, 3)`` -> ``(*batch, 3, 4)``."""
    axis = normalize(target - position, dim=-1)
    right = normalize(torch.linalg.cross(axis, up), dim=-1)
    rotation = torch.stack([right, torch.linalg.cross(axis, right), axis], dim=-2)
    return torch.cat([rotation, -rotation @ position[..., None]], dim=-1) + 0.0  # no negative zeros


def calibration(focal: Tensor, centre: float) -> Tensor:
    """Calibration matrices ``(*batch, 3, 3)`` of square pixels: focal length ``(*batch,)`` and principal point in pixels."""
    one, zero = torch.ones_like(focal), torch.zeros_like(focal)
    entries = [focal, zero, centre * one, zero, focal, centre * one, zero, zero, one]
    return torch.stack(entries, dim=-1).unflatten(-1, (3, 3))

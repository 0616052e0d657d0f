"""Grassmann tensors for the battery: scenes, conditions and errors, from determinants one by one and not from the library."""

from __future__ import annotations

from collections.abc import Callable
from itertools import combinations, product
from typing import Any

import torch
from torch import Tensor

from dyntorch import scenes
from dyntorch.scenes import Scene

Motion = tuple[Tensor, ...]


def lifted(motion: str, times: tuple[float, ...], **fixed: Any) -> Callable[..., Scene]:
    """The maker of views of points that are static in a higher space, with the projections from it."""

    def make(**options: Any) -> Scene:
        made = scenes.lifted_points(motion, times=times, **fixed, **options)
        return Scene(made.tracks.unbind(-3), made.exact.unbind(-3), unit(made.projections).unbind(-3), made.labels, made.sigma)

    return make


def collinear_images(
    n: int, *, batch: int | tuple[int, ...] = (), sigma: float = 0.0, outliers: float = 0.0, generator: torch.Generator
) -> Scene:
    """One point in each of three views on the image of a line, which a matrix takes from the plane of the lines."""
    batch = (batch,) if isinstance(batch, int) else batch

    def draw(*shape: int) -> Tensor:
        return torch.randn(*batch, *shape, generator=generator, dtype=torch.float64)

    motion = tuple(unit(torch.eye(3, dtype=torch.float64) + 0.3 * draw(3, 3)) for _ in range(3))
    lines, exact = torch.cat([draw(n, 2), 0.5 * draw(n, 1)], dim=-1), []
    for m in motion:
        image = lines @ m.mT
        normal, offset = image[..., :2], image[..., 2:]
        foot = -offset * normal / normal.square().sum(-1, keepdim=True)
        along = torch.stack([-normal[..., 1], normal[..., 0]], dim=-1) / normal.norm(dim=-1, keepdim=True)
        exact.append(foot + draw(n, 1) * along)
    labels = torch.where(torch.rand(*batch, n, generator=generator) < outliers, 0, 2)
    off = torch.where(labels == 0, 1.0, 0.0)[..., None]
    views = (exact[0] + off * draw(n, 2), *exact[1:])
    return Scene(tuple(x + sigma * draw(n, 2) for x in views), tuple(exact), motion, labels, sigma)


def unit(matrix: Tensor) -> Tensor:
    return matrix / matrix.norm(dim=(-2, -1), keepdim=True)


def hyperplanes(x: Tensor) -> Tensor:
    """The hyperplanes [I | -x] through points ``(..., d)``: ``(..., d, d + 1)``."""
    eye = torch.eye(x.shape[-1], dtype=x.dtype, device=x.device).expand(*x.shape, -1)
    return torch.cat([eye, -x[..., None]], dim=-1)


def minors(profile: tuple[int, ...], motion: Motion) -> Tensor:
    """All determinants of rows of the projections, so many of each as the profile says, one by one: ``(*batch, D)``."""
    sets = product(*(combinations(range(m.shape[-2]), a) for a, m in zip(profile, motion, strict=True)))
    stacks = [torch.cat([m[..., list(rows), :] for m, rows in zip(motion, chosen, strict=True)], dim=-2) for chosen in sets]
    return torch.linalg.det(torch.stack(stacks, dim=-3))


def tensor_error(profile: tuple[int, ...], estimated: Motion, true: Motion) -> Tensor:
    """Relative distance of the minors of the projections, which a collineation of the space scales alike."""
    a, b = (torch.nn.functional.normalize(minors(profile, m), dim=-1) for m in (estimated, true))
    return torch.minimum((a - b).norm(dim=-1), (a + b).norm(dim=-1))


def seen(motion: Motion, *views: Tensor) -> Tensor:
    """One point of the space lies on all hyperplanes that the images span: what is left of them at the nearest one.

    A choice of hyperplanes whose determinants vanish would do, too, but also where the chosen ones themselves are dependent.
    """
    rows = torch.cat([hyperplanes(x) @ m for x, m in zip(views, motion, strict=True)])
    if rows.shape[0] == rows.shape[1]:
        return torch.linalg.det(rows)[None]
    return rows @ torch.linalg.eigh(rows.mT @ rows)[1][:, 0]


def on_image_lines(motion: Motion, *views: Tensor) -> Tensor:
    """The lines of the plane that the points allow meet in the one that is seen."""
    points = [torch.cat([x, torch.ones_like(x[:1])]) for x in views]
    return torch.linalg.det(torch.stack([p @ m for p, m in zip(points, motion, strict=True)]))[None]


def in_a_flat(step: int, motion: Motion, x1: Tensor, *others: Tensor) -> Tensor:
    """All positions carried into view 1 span so many dimensions: every minor of one order more is zero."""
    carried = torch.stack([lifted_point(x1), *(m @ lifted_point(x) for m, x in zip(motion, others, strict=True))])
    rows, columns = (combinations(range(size), step + 1) for size in carried.shape)
    sets = list(product(rows, columns))
    return torch.linalg.det(torch.stack([carried[list(r)][:, list(c)] for r, c in sets]))


def lifted_point(x: Tensor) -> Tensor:
    return torch.cat([x, torch.ones_like(x[:1])])

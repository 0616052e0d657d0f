"""Epipolar geometry for the battery, of one body, of two, and of a road and its traffic: scenes, truths, errors, conditions."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

import dyntorch as dyn
from dyntorch import metrics, scenes
from dyntorch.scenes import Scene

Motion = tuple[Tensor, ...]
NEAR = 10.0  # px


def lift(x: Tensor) -> Tensor:
    return torch.cat([x, torch.ones_like(x[..., :1])], dim=-1)


def cross(v: Tensor) -> Tensor:
    """The matrix of the cross product with a vector of space."""
    eye = torch.eye(3, dtype=v.dtype, device=v.device)
    return torch.linalg.cross(*torch.broadcast_tensors(v[..., None, :], eye)).mT


def parts_error(estimated: Motion, true: Motion) -> Tensor:
    """The worst relative error of the collineations, each up to scale and sign."""
    return torch.stack([metrics.relative_error(e, t) for e, t in zip(estimated, true, strict=True)]).amax(0)


def two_bodies(n: int, **options: Any) -> Scene:
    """Two static scenes in one, without the third of their matches that are nearest to fitting the other.

    Of a match on both bodies the distance is not of first order in the noise.
    """
    one, two = (scenes.two_view(2 * n, **options) for _ in range(2))
    parts = []
    for scene, other, count in ((one, two, (n + 1) // 2), (two, one, n // 2)):
        away = dyn.sampson(dyn.FundamentalMatrix, other.motion[0], *scene.exact).argsort(dim=-1, descending=True)
        clear = away[..., : 5 * n // 3].gather(-1, away[..., : 5 * n // 3].argsort(dim=-1))[..., :count]
        views, exact = ([x.take_along_dim(clear[..., None], dim=-2) for x in xs] for xs in (scene.views, scene.exact))
        parts.append((views, exact, scene.labels.gather(-1, clear)))
    views, exact = (tuple(torch.cat(pair, dim=-2) for pair in zip(*(p[i] for p in parts), strict=True)) for i in (0, 1))
    return replace(one, views=views, exact=exact, motion=one.motion + two.motion, labels=torch.cat([p[2] for p in parts], dim=-1))


def traffic(n: int, **options: Any) -> Scene:
    """Static and moving matches, those left out that are near both relations: a match on both has no distance of first order."""
    scene = scenes.convergent_motions(2 * n, **options)
    distances = [dyn.sampson(dyn.FundamentalMatrix, F, *scene.exact) for F in scene.motion]
    chosen = (torch.maximum(*distances) < NEAR).byte().argsort(dim=-1, stable=True)[..., :n]
    views, exact = (tuple(x.take_along_dim(chosen[..., None], dim=-2) for x in xs) for xs in (scene.views, scene.exact))
    motion = tuple(scene.extras[part] for part in ("homography", "epipole", "vertex"))
    return replace(scene, views=views, exact=exact, labels=scene.labels.gather(-1, chosen), motion=motion)


def epipolar_error(estimated: Motion, true: Motion) -> Tensor:
    """Any homography of a plane serves: only the product with the epipole counts."""
    return metrics.relative_error(cross(estimated[1]) @ estimated[0], cross(true[1]) @ true[0])


def epipolar_truth(motion: Motion) -> Motion:
    """Homography of a plane and epipole of a fundamental matrix."""
    u, s, vh = torch.linalg.svd(motion[0])
    left, right = u[..., :, 2], vh[..., 2, :]
    return -cross(left) @ motion[0] + s[..., :1, None] * left[..., :, None] * right[..., None, :], left


def two_epipolar_truths(motion: Motion) -> Motion:
    return *epipolar_truth(motion[:1]), *epipolar_truth(motion[1:])


def two_epipolar_errors(estimated: Motion, true: Motion) -> Tensor:
    """The worse of both bodies, in the better order of them."""
    orders = [
        torch.maximum(epipolar_error(estimated[:2], true[a : a + 2]), epipolar_error(estimated[2:], true[2 - a : 4 - a]))
        for a in (0, 2)
    ]
    return torch.minimum(*orders)


def two_centres_errors(estimated: Motion, true: Motion) -> Tensor:
    """One plane and two centres, in the better order of these."""
    found, (plane, first, second) = ((m[0], m[1][..., None], m[2][..., None]) for m in (estimated, true))
    return torch.minimum(*(parts_error(found, (plane, *centres)) for centres in ((first, second), (second, first))))


def on_epipolar_line(motion: Motion, x1: Tensor, x2: Tensor) -> Tensor:
    return torch.stack([lift(x2) @ torch.linalg.cross(motion[1], motion[0] @ lift(x1))])


def on_either_epipolar_line(motion: Motion, x1: Tensor, x2: Tensor) -> Tensor:
    return on_epipolar_line(motion[:2], x1, x2) * on_epipolar_line(motion[2:], x1, x2)


def on_either_line_in_plane(motion: Motion, x1: Tensor, x2: Tensor) -> Tensor:
    return on_epipolar_line(motion[:2], x1, x2) * on_epipolar_line(motion[::2], x1, x2)

"""Matches of two rigid bodies for the battery."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch

import dyntorch as dyn
from dyntorch import scenes
from dyntorch.scenes import Scene


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

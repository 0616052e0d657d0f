"""What a segmentation of two views costs: distances from the epipolar geometries, links cut, and the relief of each body."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from dyntorch.geometry.epipolar import sampson_squared
from dyntorch.geometry.homogeneous import homogeneous, null_vectors, skew
from dyntorch.tasks.segment.coherence import Links

THRESHOLD_PIXELS = 2.5  # threshold in pixels to which all figures in pixels refer
SAMPSON_NOISE_PIXELS = 0.7  # standard deviation of a Sampson distance
ENERGY_MAX_SQUARED_DISTANCE = 4.0  # over the variance of the noise
CUT_COST = 4.0  # of a link of weight 1 between two bodies
PARALLAX_WEIGHT = 0.2  # of motion along the epipolar lines beside that of the body's mean plane
PARALLAX_FREEDOM = 2.0  # degrees of freedom of Student's distribution of the parallax
MIN_PARALLAX_PIXELS = 2.0  # least scale of the parallax
NUM_PLANE_FITS = 6  # reweighted fits of the mean plane of a body
NUM_PARALLAX_SCALE_UPDATES = 2  # in each of them


@dataclass(frozen=True)
class View:
    """The matches of one problem, centred and scaled alike in both views."""

    x1: Tensor  # ``(n, 2)``
    x2: Tensor
    pixel: float  # the threshold / ``THRESHOLD_PIXELS``, in these coordinates: a pixel at the default threshold
    links: Links  # between matches

    def subset(self, keep: Tensor) -> View:
        """Some of the matches (indices)."""
        return View(self.x1[keep], self.x2[keep], self.pixel, self.links.subset(keep))


def energy(view: View, fundamentals: Tensor, member: Tensor) -> Tensor:
    r"""Cost of labellings with their fundamental matrices: fundamentals ``(B, K, 3, 3)``, member ``(B, K, n)`` -> ``(B,)``."""
    square = sampson_squared(fundamentals, view.x1, view.x2) / (SAMPSON_NOISE_PIXELS * view.pixel) ** 2
    distances = (square.clamp(max=ENERGY_MAX_SQUARED_DISTANCE) * member).sum((-2, -1))
    cost = relief(view, fundamentals, member)
    return distances + CUT_COST * view.links.cut(member) + PARALLAX_WEIGHT * (cost * member).sum((-2, -1))


def relief(view: View, fundamentals: Tensor, member: Tensor, min_scale: float = MIN_PARALLAX_PIXELS) -> Tensor:
    r"""Cost ``(B, K, n)`` of the parallax of every match beside every body:
    :math:`(\nu + 1) \log(1 + p^2 / \nu t^2) + \log t^2`."""
    value, scale = parallax(view, fundamentals, member, min_scale)
    return (PARALLAX_FREEDOM + 1) * torch.log1p(value.square() / (PARALLAX_FREEDOM * scale[..., None])) + scale.log()[..., None]


def parallax(view: View, fundamentals: Tensor, member: Tensor, min_scale: float = MIN_PARALLAX_PIXELS) -> tuple[Tensor, Tensor]:
    r"""Distances along the epipolar lines from the robust mean plane of each body, and their squared scale, in pixels.
    fundamentals ``(B, K, 3, 3)``, member ``(B, K, n)`` -> ``(B, K, n)``."""
    first, second = homogeneous(view.x1), homogeneous(view.x2)
    epipole = null_vectors(fundamentals)[0]
    mapped = first @ (skew(epipole) @ fundamentals).mT
    other = torch.linalg.cross(second.expand_as(mapped), epipole[..., None, :].expand_as(mapped))
    this = torch.linalg.cross(second.expand_as(mapped), mapped)
    depth = -(this * other).sum(-1) / other.square().sum(-1).clamp(min=1e-20)
    # how far the image moves with depth
    across = epipole[..., None, :2] * mapped[..., 2:] - mapped[..., :2] * epipole[..., None, 2:]
    lever = across.norm(dim=-1) / (mapped[..., 2] + depth * epipole[..., None, 2]).square().clamp(min=1e-12) / view.pixel
    lever = lever.clamp(max=1e6)
    moments = (first[:, :, None] * first[:, None, :]).flatten(1)
    total = member.sum(-1) + 1e-9
    eye = torch.eye(3, dtype=first.dtype, device=first.device)
    weight, scale, value = member, torch.zeros_like(total), depth
    for turn in range(NUM_PLANE_FITS):
        heavy = weight * lever.square()
        inner = (heavy @ moments).unflatten(-1, (3, 3))
        ridge = 1e-9 * inner.diagonal(dim1=-2, dim2=-1).sum(-1)[..., None, None] + 1e-20
        plane = torch.linalg.solve_ex(inner + ridge * eye, ((heavy * depth) @ first)[..., None])[0]
        value = (depth - (first @ plane)[..., 0]) * lever
        square = value.square()
        if turn == 0:
            scale = ((member * value.abs()).sum(-1) / total).square()
        for _ in range(NUM_PARALLAX_SCALE_UPDATES):
            share = (PARALLAX_FREEDOM + 1) / (PARALLAX_FREEDOM + square / scale.clamp(min=min_scale * min_scale)[..., None])
            scale = ((member * share * square).sum(-1) / total).clamp(min=min_scale * min_scale)
        weight = member * (PARALLAX_FREEDOM + 1) / (PARALLAX_FREEDOM + square / scale[..., None])
    return value, scale


# ----------------------------------------------------------------------------------------------------------------------
# Probabilities of labels that neighbours share: the mean field of costs and links.


def mean_field(cost: Tensor, links: Links, cut: float, turns: int, start: Tensor | None = None) -> Tensor:
    """Probabilities of labels ``(*batch, K, n)`` that cost so much, with ``cut`` times the links between different labels."""
    member = torch.softmax(-cost, -2) if start is None else start
    for _ in range(turns):
        member = 0.5 * (member + torch.softmax(cut * links.pull(member) - cost, -2))
    return member

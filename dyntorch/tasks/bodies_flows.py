"""Starts of a segmentation: several affine flows at a time, from random patches of the image that move alike."""

from __future__ import annotations

import torch
from torch import Tensor

from dyntorch.sampling import uniform
from dyntorch.tasks.bodies_field import mean_field
from dyntorch.tasks.coherence import Links

PATCHES = (12, 20, 30, 45)
"""Matches of the patches that runs start from, in turns: small bodies need small ones, noisy flows large ones."""
ROUNDS, TURNS, SCALES = 8, 3, 2
CUT = 2.0
"""Weight of the links that a labelling cuts."""
FREEDOM = 3.0
"""Of Student's distribution of the deviations from a flow: bodies have depth."""


def affine_flows(x1: Tensor, x2: Tensor, links: Links, bodies: Tensor, noise: float, generator: torch.Generator | None) -> Tensor:
    r"""Labellings by robust affine flows :math:`x_2 = A_k x_1 + b_k`, smooth over the links.

    Expectation maximization of Student's distributions with a mean field over the labels, many runs at a time, in single precision.

    Args:
        x1, x2: ``(n, 2)`` of about unit size.
        links: between matches.
        bodies: ``(runs,)`` number of flows of each run.
        noise: least standard deviation of a flow.
        generator: source of the patches.

    Returns:
        ``(runs, n)`` labels from 0; some below ``bodies`` may be empty.
    """
    a = torch.cat([x1, torch.ones_like(x1[:, :1])], dim=-1).float()
    b = x2.float()
    width = int(bodies.max())
    absent = (torch.arange(width, device=x1.device) >= bodies[:, None])[..., None]
    member = _patches(x1.float(), (x2 - x1).float(), bodies, width, generator).masked_fill(absent, 0.0)
    moments, targets = (a[:, :, None] * a[:, None, :]).flatten(1), (a[:, :, None] * b[:, None, :]).flatten(1)
    eye = torch.eye(3, device=a.device)
    weight, variance = member, None
    for _ in range(ROUNDS):
        inner = (weight @ moments).unflatten(-1, (3, 3))
        ridge = 1e-6 * inner.diagonal(dim1=-2, dim2=-1).sum(-1)[..., None, None] + 1e-12
        flow = torch.linalg.solve_ex(inner + ridge * eye, (weight @ targets).unflatten(-1, (3, 2)))[0]
        square = (a @ flow - b).square().sum(-1)
        total = 2 * member.sum(-1) + 1e-9
        for _ in range(SCALES):
            heavy = 1.0 if variance is None else (FREEDOM + 2) / (FREEDOM + square / variance[..., None])
            variance = ((member * heavy * square).sum(-1) / total).clamp(min=noise * noise)
        assert variance is not None
        ratio = square / variance[..., None]
        cost = (FREEDOM + 2) * torch.log1p(ratio / FREEDOM) + 2 * variance.log()[..., None]
        member = mean_field(cost.masked_fill(absent, torch.inf), links, CUT, TURNS)
        weight = member * (FREEDOM + 2) / (FREEDOM + ratio)
    return member.argmax(1)


def _patches(x: Tensor, motion: Tensor, bodies: Tensor, width: int, generator: torch.Generator | None) -> Tensor:
    """Members ``(runs, width, n)`` of patches: nearest matches in place and motion of seeds that are far from each other."""
    apart = _scaled_distances(x) + _scaled_distances(motion)
    runs, count = len(bodies), len(x)
    seeds = (uniform(runs, 1, generator=generator, device=x.device) * count).long().clamp(max=count - 1)
    for _ in range(1, width):
        far = apart[seeds].amin(1).double().cumsum(-1)
        pick = uniform(runs, 1, generator=generator, device=x.device) * far[:, -1:]
        seeds = torch.cat([seeds, torch.searchsorted(far, pick).clamp(max=count - 1)], dim=-1)
    sizes = torch.tensor(PATCHES, device=x.device)[torch.arange(runs, device=x.device) % len(PATCHES)]
    order = apart[seeds].topk(min(max(PATCHES), count), dim=-1, largest=False).indices
    chosen = (torch.arange(order.shape[-1], device=x.device) < sizes[:, None, None].clamp(max=max(4, count // 2))).expand_as(order)
    return torch.zeros(runs, width, count, device=x.device).scatter_(-1, order, chosen.float())


def _scaled_distances(x: Tensor) -> Tensor:
    square = torch.cdist(x, x).square()
    return square / square.median().clamp(min=1e-12)

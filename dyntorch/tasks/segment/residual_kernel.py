r"""Which tracks move alike: those that prefer the same hypotheses about the motion between two frames, in many pairs of frames.

Hypotheses are affine maps, homographies and fundamental matrices of a few tracks near each other.  Each track ranks them by its
distance; the share of the first ranks that two tracks have in common says how alike they move, whatever the noise.  Affine maps
and homographies tell cars on one road apart that share an epipolar geometry, fundamental matrices hold together what has depth.

Source: Chin, Wang and Suter, The ordered residual kernel for robust motion subspace clustering, 2009; Xu, Cheong and Li, Motion
segmentation by exploiting complementary geometric models, 2018 (several models, many pairs of frames).
"""

from __future__ import annotations

import torch
from torch import Tensor

from dyntorch.geometry.homogeneous import cofactors, homogeneous
from dyntorch.numerics.blocks import uniform
from dyntorch.tasks.segment.coherence import Links
from dyntorch.tasks.segment.frame_pairs import FramePair, TrackSet, select_near_pairs

TINY = 1e-12


KERNEL_GAPS = (1, 2, 4, 8)  # frames between those of a pair
KERNEL_PAIRS_PER_GAP = 20  # in a video as long as its tracks; longer ones have more
MIN_KERNEL_TRACKS = 16  # that both frames of such a pair must show
PREFERRED_SHARE = 0.1  # of the hypotheses, that fit a track best
MIN_SAMPLE_RADIUS = 0.05  # about its first track in which a hypothesis finds the others, over the extent of all
MAX_SAMPLE_RADIUS = 0.7  # the largest one


def preference_kernel(film: TrackSet, searched: Tensor, generator: torch.Generator | None, num_hypotheses: int) -> Tensor:
    r"""How alike tracks move: the mean share of preferred hypotheses that they have in common, searched ``(m,)`` -> ``(n, m)``."""
    count = film.x.shape[1]
    place = torch.full((count,), -1, device=searched.device)
    place[searched] = torch.arange(len(searched), device=searched.device)
    kernel = torch.zeros(count, len(searched), dtype=torch.float32, device=searched.device)
    met = torch.zeros_like(kernel)
    for pair in select_near_pairs(film, KERNEL_GAPS, KERNEL_PAIRS_PER_GAP, MIN_KERNEL_TRACKS):
        both = film.pair(pair)
        column = place[both.index]
        own = (column >= 0).nonzero().flatten()
        if len(own) < MIN_KERNEL_TRACKS:
            continue
        liked = _rank_hypotheses(both, own, generator, num_hypotheses)
        shared = liked @ liked[own].mT
        rows, columns = both.index[:, None], column[own][None]
        kernel[rows, columns] += shared
        met[rows, columns] += 1
    kernel = kernel / met.clamp(min=1)
    kernel[searched, torch.arange(len(searched), device=searched.device)] = 0.0
    return kernel


def _rank_hypotheses(both: FramePair, own: Tensor, generator: torch.Generator | None, number: int) -> Tensor:
    """``(m, 3 h)`` 1 for what a track prefers, else 0, over the root of the number of preferences."""
    x1, x2 = both.view.x1, both.view.x2
    # three of eight tracks give an affine map, four a homography, all of them a fundamental matrix
    sample = own[_samples(x1[own], generator, number)]
    a, b = x1[sample], x2[sample]
    squares = [
        _transfer(affine_map(a[:, :3], b[:, :3]), x1, x2),
        _transfer(homography_of_four(a[:, :4], b[:, :4]), x1, x2),
        _epipolar(fundamental_of_eight(a, b), x1, x2),
    ]
    few = max(1, round(PREFERRED_SHARE * len(sample)))
    # exactly so many, also where several fit alike
    best = [square.topk(few, dim=0, largest=False).indices for square in squares]
    liked = [torch.zeros_like(square).scatter_(0, index, 1.0) for square, index in zip(squares, best, strict=True)]
    return torch.cat(liked).mT / (3 * few) ** 0.5


def _samples(x: Tensor, generator: torch.Generator | None, number: int) -> Tensor:
    """``(h, 8)`` different points ``(m, 2)``: one at random, the others by a normal distribution about it, of some width."""
    count = len(x)
    low, high = x.quantile(x.new_tensor([0.02, 0.98]), dim=0)
    extent = (high - low).norm() / 2**0.5
    seed = (uniform(number, generator=generator, device=x.device) * count).long().clamp(max=count - 1)
    radius = (
        MIN_SAMPLE_RADIUS
        * (MAX_SAMPLE_RADIUS / MIN_SAMPLE_RADIUS) ** uniform(number, 1, generator=generator, device=x.device)
        * extent
    )
    # Gumbel's trick: the largest of log p + noise are a sample without replacement
    noise = -(-uniform(number, count, generator=generator, device=x.device).clamp(min=1e-300).log()).log()
    chance = noise - torch.cdist(x[seed], x).square() / (2 * radius.square()).clamp(min=TINY)
    chance.scatter_(1, seed[:, None], torch.inf)
    return chance.topk(8, dim=-1).indices


def affine_map(x1: Tensor, x2: Tensor) -> Tensor:
    """Affine maps ``(*batch, 3, 3)`` that take three points ``(*batch, 3, 2)`` to three others; huge where these are on a line."""
    here, there = homogeneous(x1).mT, homogeneous(x2).mT
    adjoint = cofactors(here).mT
    determinant = (here[..., 0, :] * adjoint[..., :, 0]).sum(-1)
    return there @ adjoint / torch.where(determinant.abs() < TINY, TINY, determinant)[..., None, None]


def homography_of_four(x1: Tensor, x2: Tensor) -> Tensor:
    """Homographies ``(*batch, 3, 3)`` of norm 1 that take four points ``(*batch, 4, 2)`` to four others."""

    def basis(x: Tensor) -> Tensor:
        points = homogeneous(x).mT
        weights = cofactors(points[..., :3]).mT @ points[..., 3:]
        return points[..., :3] * weights.mT

    found = basis(x2) @ cofactors(basis(x1)).mT
    return found / found.flatten(-2).norm(dim=-1).clamp(min=1e-300)[..., None, None]


def fundamental_of_eight(x1: Tensor, x2: Tensor) -> Tensor:
    """Matrices ``(*batch, 3, 3)`` of norm 1 with :math:`x_2^T F x_1 = 0` for eight matches ``(*batch, 8, 2)``, of any rank."""
    rows = (homogeneous(x2)[..., :, None] * homogeneous(x1)[..., None, :]).flatten(-2)
    found, info = torch.linalg.solve_ex(rows[..., :8], -rows[..., 8:])
    found = torch.cat([torch.where((info == 0)[..., None], found[..., 0], 0.0), torch.ones_like(rows[..., 0, :1])], dim=-1)
    return (found / found.norm(dim=-1, keepdim=True)).unflatten(-1, (3, 3))


def _transfer(H: Tensor, x1: Tensor, x2: Tensor) -> Tensor:
    """Squared distances ``(h, m)`` in the second frame."""
    mapped = (H @ homogeneous(x1).mT).float()
    finite = mapped[:, 2].abs() > 1e-9
    depth = torch.where(finite, mapped[:, 2], 1.0)
    x, y = x2.float().mT
    square = (mapped[:, 0] / depth - x).square() + (mapped[:, 1] / depth - y).square()
    return torch.where(finite, square, 1e30).nan_to_num(nan=1e30, posinf=1e30)


def _epipolar(F: Tensor, x1: Tensor, x2: Tensor) -> Tensor:
    """Squared Sampson distances ``(h, m)``, in single precision: they are only ranked."""
    first, second = homogeneous(x1).mT, homogeneous(x2).mT
    lines, others = (F @ first).float(), (F.mT[:, :2] @ second).float()
    value = (lines * second.float()).sum(-2)
    return value.square() / (lines[:, :2].square().sum(-2) + others.square().sum(-2)).clamp(min=1e-30)


def common_share(kernel: Tensor) -> float:
    """How much the usual track has in common with the five that move most like it, from a kernel ``(n, m)``."""
    return float(kernel.topk(min(5, kernel.shape[1]), dim=-1).values.mean(-1).median())


def strongest(kernel: Tensor, neighbours: int) -> Tensor:
    """A symmetric kernel ``(m, m)`` with the largest entries of every row or column alone."""
    kept = min(neighbours, len(kernel) - 1)
    least = kernel.topk(kept, dim=-1).values[:, -1:]
    sparse = torch.where((kernel >= least) & (kernel > 0), kernel, 0.0)
    return torch.maximum(sparse, sparse.mT)


def links_of(sparse: Tensor, total: float) -> Links:
    r"""Links of weight :math:`t\, W_{ij} / \sqrt{d_i d_j}` with the degrees d: about ``total`` for each track."""
    degree = sparse.sum(-1).clamp(min=1e-9)
    weight = sparse / (degree[:, None] * degree).sqrt() * total
    width = max(1, int((weight > 0).sum(-1).max()))
    top = weight.topk(width, dim=-1)
    return Links(top.indices, top.values.double())

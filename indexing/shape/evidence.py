"""The epipolar residual as a function of joint weights: everything it needs, tabled once for the pairs that matter.

A joint's weight multiplies its squared coordinates after the joint metric's whitening, so every 2x2 product that the largest
canonical correlation is made of is *linear* in the weights: with the products of every joint at hand, another set of weights
costs one matrix product and a closed form, whatever the length of the clips.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import cast

import torch
from torch import Tensor

from indexing.shape.bank import EPSILON, NEAREST, Windows, fused_residual
from indexing.shape.channels import JointMetric

CANDIDATES = 2  # nearest exemplars per class that a query is compared with: as many as the scorer averages
ABSENT = -100.0  # score of a class with no exemplar in another group
RIDGE = 1e-6  # of a 2x2 Gram, relative to its trace: as in dyntorch.orthonormal_basis


@dataclass(frozen=True)
class Evidence:
    """Products of every joint's coordinates, for queries and the exemplars nearest to them.

    cross, left, right: ``(channels, classes, Q, K, 2, 2, joints)``: of query with exemplar, and of each with itself; hub:
    ``(classes, Q, K)``, taken off each residual; valid: the same shape, which exist; labels, groups: ``(Q,)``.
    """

    cross: Tensor
    left: Tensor
    right: Tensor
    hub: Tensor
    valid: Tensor
    labels: Tensor
    groups: Tensor

    def scores(self, joints: Tensor, channels: Tensor) -> Tensor:
        """Minus the mean log residual to the nearest exemplars, for ``B`` sets of weights at once.

        Args:
            joints: ``(B, channels, classes or 1, joints)``; channels: ``(B, channels)``.

        Returns:
            ``(B, Q, classes)``.
        """
        weights = joints.expand(-1, -1, self.cross.shape[1], -1).permute(1, 2, 3, 0)
        shape = (*self.cross.shape[:-1], len(joints))
        tables = (self.cross, self.left, self.right)
        # a GEMM each; nothing is copied
        products = ((table.flatten(2, 5) @ weights).view(shape).flatten(4, 5).unbind(4) for table in tables)
        cross, left, right = (cast("Entries", entries) for entries in products)
        logs = (epipolar(cross, left, right) + EPSILON).log()
        total = torch.einsum("xcqkn,nx->ncqk", logs, channels) - self.hub
        count = self.valid.sum(2)
        mean = torch.where(self.valid, total, 0.0).sum(3) / count.clamp(min=1)
        return torch.where(count > 0, -mean, ABSENT).mT


Entries = tuple[Tensor, Tensor, Tensor, Tensor]  # 00, 01, 10, 11 of 2x2 matrices


def epipolar(cross: Entries, left: Entries, right: Entries) -> Tensor:
    r"""Residual :math:`1 - s_1` of two images from their products: differentiable, closed form.

    .. math:: s_1^2 = \tfrac12\bigl(t + \sqrt{t^2 - 4d}\bigr),\quad t = \operatorname{tr}(L^{-1} C R^{-1} C^T),
        \quad d = \frac{\det(C)^2}{\det L \det R}

    Args:
        cross, left, right: entries of the 2x2 matrices :math:`C = X^T Y`, :math:`L = X^T X`, :math:`R = Y^T Y`, any shape.

    Returns:
        as one entry, in [0, 1].

    Source: thesis chapter 7 (rank of stacked measurements); canonical correlation.

    Example:
        >>> x = torch.tensor([[1.0, 0.0], [0.0, 1.0], [0.0, 0.0]])
        >>> y = torch.tensor([[0.0, 1.0], [0.6, 0.0], [0.8, 0.0]])
        >>> one, other, both = (m.flatten().unbind() for m in (x.mT @ x, y.mT @ y, x.mT @ y))
        >>> round(float(epipolar(both, one, other)), 2), round(float(epipolar(one, one, one)), 2)
        (0.0, 0.0)
    """
    c00, c01, c10, c11 = cross
    l00, l01, l11, left_det = _ridged(left)
    r00, r01, r11, right_det = _ridged(right)
    # D = adj(L) C, then tr(D adj(R) C^T), whose entries are products of these
    d00, d01 = l11 * c00 - l01 * c10, l11 * c01 - l01 * c11
    d10, d11 = l00 * c10 - l01 * c00, l00 * c11 - l01 * c01
    trace = (
        d00 * (r11 * c00 - r01 * c01) + d01 * (r00 * c01 - r01 * c00)
        + d10 * (r11 * c10 - r01 * c11) + d11 * (r00 * c11 - r01 * c10)
    ) / (left_det * right_det)  # fmt: skip
    det = (c00 * c11 - c01 * c10).square() / (left_det * right_det)
    # where both correlations are the same the root has no derivative; a floor far below the noise gives it the value 0
    root = (trace.square() - 4 * det).clamp(min=1e-10).sqrt()
    return 1 - ((trace + root) / 2).clamp(min=1e-10, max=1.0).sqrt()


def _ridged(gram: Entries) -> Entries:
    """Entries 00, 01, 11 and the determinant of symmetric 2x2 matrices, with a ridge."""
    scale = (gram[0] + gram[3]).clamp(min=1e-30)
    a, b, d = gram[0] + RIDGE * scale, gram[1], gram[3] + RIDGE * scale
    return a, b, d, (a * d - b * b).clamp(min=1e-30)


def gather(
    query: Windows,
    owner: Tensor,
    copies: list[Windows],
    metrics: tuple[JointMetric, JointMetric],
    channels: Tensor,
    labels: Tensor,
    groups: Tensor,
    hub: Tensor,
) -> Evidence:
    """The tables of queries and, of each class, the exemplars of other groups that are nearest to them.

    Args:
        metrics: of the tables, and by which the nearest exemplars are found; channels: weights by which these are found.
        others: as in :func:`~indexing.shape.joint_weights.learn_joint_weights`.
    """
    metric, found_by = metrics
    table = fused_residual(query, copies[:1], found_by, NEAREST, channels)
    which = torch.zeros(table.shape, dtype=torch.long)
    for number, copy in enumerate(copies[1:], 1):
        other = fused_residual(query, [copy], found_by, NEAREST, channels)
        which[other < table] = number
        table = torch.minimum(table, other)
    table = torch.where(groups[owner][:, None] == groups[None], torch.inf, table - hub)
    chosen, valid = [], []
    for action in range(int(labels.max()) + 1):
        mine = (labels == action).nonzero()[:, 0]
        value, place = table[:, mine].topk(min(CANDIDATES, len(mine)), dim=1, largest=False)
        room = (0, CANDIDATES - place.shape[1])
        chosen.append(torch.nn.functional.pad(mine[place], room))
        valid.append(torch.nn.functional.pad(value.isfinite(), room))
    index = torch.stack(chosen)  # (classes, Q, K)
    place = which.gather(1, index.transpose(0, 1).flatten(1)).view_as(index.transpose(0, 1)).transpose(0, 1) * len(labels) + index
    every = Windows(torch.cat([copy.values for copy in copies]), torch.cat([copy.seen for copy in copies]))
    nearest = every[place.flatten()]
    tables = torch.stack([_products(query, nearest, metric, name, index.shape) for name in NEAREST], dim=1)
    cross, left, right = tables.unbind(0)
    return Evidence(cross, left, right, hub[index], torch.stack(valid), labels[owner], groups[owner])


def _products(query: Windows, nearest: Windows, metric: JointMetric, name: str, shape: torch.Size) -> Tensor:
    """``(3, *shape, 2, 2, joints)`` tables of one channel; a joint that either side has not seen counts for nothing."""
    count = query.values.shape[2]
    x, y = (metric.apply(_filled(part), name).unflatten(1, (-1, count)) for part in (query, nearest))
    y = y.unflatten(0, shape)
    own = torch.einsum("qtja,qtjb->qabj", x, x)[None, :, None].expand(*shape, 2, 2, count)
    pairs = torch.einsum("qtja,cqktjb->cqkabj", x, y), own, torch.einsum("cqktja,cqktjb->cqkabj", y, y)
    both = query.seen[None, :, None] & nearest.seen.unflatten(0, shape)
    return torch.stack(pairs) * both[..., None, None, :]


def _filled(windows: Windows) -> Tensor:
    """Joints never seen moved to the middle of the others, where they change no mean."""
    known = windows.seen[:, None, :, None].to(windows.values)
    middle = (windows.values * known).sum(dim=2, keepdim=True) / known.sum(dim=2, keepdim=True).clamp(min=1.0)
    return torch.where(known > 0, windows.values, middle)

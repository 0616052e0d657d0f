"""Learned weights of scorer A's channels: which evidence tells these actions apart."""

from __future__ import annotations

import torch
from torch import Tensor

from indexing.shape.bank import NEAREST, Windows, fused_residual
from indexing.shape.channels import JointMetric

PULL = 0.5  # strength of the prior towards equal weights, per sqrt(exemplar)
ROUNDS = 3


def channel_weights(originals: Windows, copies: list[Windows], metric: JointMetric, labels: Tensor, classes: int) -> Tensor:
    r"""Weights :math:`w \ge 0` with mean 1 that make leave-one-out classification of the exemplars most likely.

    With :math:`x_{ic}` the log residuals (one per channel) of exemplar i to its nearest exemplar of class c other than
    itself, :math:`p(c | i) \propto \exp(-w^T x_{ic})`.  Nearest exemplars and weights are found in turn.

    Args:
        originals: the whole exemplars, ``N`` windows; copies: their crops and mirror images; labels: ``(N,)``.

    Returns:
        ``(channels,)``; ones where no class has two exemplars.
    """
    counts = torch.bincount(labels, minlength=classes)
    if int(counts.max()) < 2:
        return torch.ones(len(NEAREST))
    table = torch.stack([fused_residual(originals, copies, metric, (name,)) for name in NEAREST], dim=2)
    table.diagonal(dim1=0, dim2=1).fill_(torch.inf)
    usable = counts[labels] > 1
    log_weights = torch.zeros(len(NEAREST), requires_grad=True)
    for _ in range(ROUNDS):
        weights = _positive(log_weights.detach())
        fused = (table * weights).sum(dim=2)
        nearest = torch.stack([fused[:, labels == c].argmin(dim=1) for c in range(classes)], dim=1)
        members = [torch.nonzero(labels == c)[:, 0] for c in range(classes)]
        rows = torch.arange(len(labels))
        x = torch.stack([table[rows, members[c][nearest[:, c]]] for c in range(classes)], dim=1)[usable]
        target = labels[usable]
        optimizer = torch.optim.LBFGS([log_weights], max_iter=50, line_search_fn="strong_wolfe")

        def loss(x: Tensor = x, target: Tensor = target, optimizer: torch.optim.Optimizer = optimizer) -> Tensor:
            optimizer.zero_grad()
            value = torch.nn.functional.cross_entropy(-(x * _positive(log_weights)).sum(dim=2), target)
            value = value + PULL * log_weights.square().sum() / len(target) ** 0.5
            value.backward()
            return value

        optimizer.step(loss)
    return _positive(log_weights.detach())


def _positive(log_weights: Tensor) -> Tensor:
    weights = log_weights.exp()
    return weights / weights.mean()

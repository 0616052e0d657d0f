"""How wrong a segmentation into bodies is, whatever numbers the bodies were given."""

from __future__ import annotations

from scipy.optimize import linear_sum_assignment  # type: ignore[import-untyped]
from torch import Tensor
from torch.nn.functional import one_hot

OUTLIER = 0


def misclassification(labels: Tensor, truth: Tensor) -> Tensor:
    r"""Share of matches with the wrong label, under the best assignment of the bodies found to the true ones.

    .. math:: 1 - \frac 1n \max_\pi \Bigl(|\{i : l_i = t_i = 0\}| + \sum_k |\{i : l_i = \pi(k),\ t_i = k\}|\Bigr)

    with :math:`\pi` one-to-one.  Outliers are no body: label 0 is right only where the truth is 0, and all matches of a body
    found beyond the true ones are wrong.

    Args:
        labels: ``(*batch, n)`` integers, 0 outlier, 1.. the bodies found, in any order.
        truth: ``(*batch, n)`` integers, 0 outlier, 1.. the bodies; their number may differ from that of ``labels``.

    Returns:
        ``(*batch,)`` float64 share in [0, 1].

    Raises:
        ValueError: labels of different shapes, no matches, negative or not integers.

    Source: the misclassification error of Tron and Vidal, CVPR 2007, with an outlier class.

    Example:
        >>> import torch
        >>> misclassification(torch.tensor([2, 2, 1, 1, 0, 3]), torch.tensor([1, 1, 2, 2, 0, 0]))
        tensor(0.1667, dtype=torch.float64)
    """
    if labels.shape != truth.shape or labels.ndim == 0 or labels.shape[-1] == 0:
        raise ValueError(f"labels must have one shape (*batch, n), n >= 1, got {tuple(labels.shape)} and {tuple(truth.shape)}")
    for name, given in (("labels", labels), ("truth", truth)):
        if given.is_floating_point() or given.is_complex():
            raise ValueError(f"{name} must be integers, 0 outlier, 1.. the bodies, got {given.dtype}")
        if (given < OUTLIER).any():
            raise ValueError(f"{name} must not be negative (0 is an outlier), got {int(given.min())}")
    found, true = (_members(x.long().reshape(-1, x.shape[-1])) for x in (labels, truth))
    common = (found.mT @ true).cpu()
    best = [float(table[linear_sum_assignment(table.numpy(), maximize=True)].sum()) for table in common[:, 1:, 1:]]
    right = common[:, OUTLIER, OUTLIER] + common.new_tensor(best)
    return (1 - right / labels.shape[-1]).reshape(labels.shape[:-1]).to(labels.device)


def _members(labels: Tensor) -> Tensor:
    """``(problems, n, K + 1)``: 1 where a match has the label."""
    return one_hot(labels, int(labels.max()) + 1 if labels.numel() else 1).double()

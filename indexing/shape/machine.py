"""A trained kernel machine as plain arrays: scikit-learn fits it, this evaluates it, and a model file can hold it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from sklearn.svm import SVC
from torch import Tensor

from indexing.modelfile import Parts


@dataclass(frozen=True)
class PairwiseMachine:
    """One support vector machine per pair of classes, over a precomputed kernel.

    support: ``(S,)`` rows of the training windows, sorted by class; dual: ``(classes - 1, S)``; intercept:
    ``(classes (classes - 1) / 2,)``; counts: ``(classes,)`` support vectors per class.
    """

    support: Tensor
    dual: Tensor
    intercept: Tensor
    counts: Tensor

    PENALTY = 10.0  # C; 2 and 30 differ by less than 1 % on UTKinect, Florence3D and JHMDB

    @classmethod
    def fit(cls, kernel: Tensor, classes: np.ndarray) -> PairwiseMachine:
        """From a ``(N, N)`` kernel matrix and class numbers 0..C-1."""
        machine = SVC(C=cls.PENALTY, kernel="precomputed").fit(kernel.cpu().numpy().astype(np.float64), classes)
        # for two classes scikit-learn stores the decision negated
        sign = -1.0 if len(machine.classes_) == 2 else 1.0
        return cls(
            torch.from_numpy(machine.support_.astype(np.int64)),
            torch.from_numpy(sign * machine.dual_coef_).float(),
            torch.from_numpy(sign * machine.intercept_).float(),
            torch.from_numpy(machine.n_support_.astype(np.int64)),
        )

    def __call__(self, kernel: Tensor) -> Tensor:
        """Votes per class, ordered among equals by the summed margins.

        Args:
            kernel: ``(Q, S)`` of queries to the support rows.

        Returns:
            ``(Q, classes)``, larger is better: the one-against-one vote plus a confidence below one half.
        """
        ends = torch.cumsum(self.counts, 0).tolist()
        spans = [slice(end - int(n), end) for end, n in zip(ends, self.counts, strict=True)]
        classes = len(spans)
        votes = kernel.new_zeros(len(kernel), classes)
        margins = kernel.new_zeros(len(kernel), classes)
        dual, pair = self.dual.to(kernel), 0
        for i in range(classes):
            for j in range(i + 1, classes):
                value = kernel[:, spans[i]] @ dual[j - 1, spans[i]] + kernel[:, spans[j]] @ dual[i, spans[j]]
                value = value + self.intercept[pair].to(kernel)
                votes[:, i] += value > 0
                votes[:, j] += value <= 0
                margins[:, i] += value
                margins[:, j] -= value
                pair += 1
        return votes + margins / (3 * (margins.abs() + 1))


def read_machine(parts: Parts, classes: int, rows: int) -> PairwiseMachine:
    """The machine of a model file, whose tensors are named ``machine.support``, ``dual``, ``intercept`` and ``counts``.

    Args:
        rows: of the training windows that are kept.

    Raises:
        ValueError: its parts do not belong together.
    """
    counts = parts.whole("machine.counts", classes, below=rows + 1)
    if int(counts.sum()) != rows:
        raise ValueError(f"machine.counts: {int(counts.sum())} support vectors, and {rows} are there")
    return PairwiseMachine(
        parts.whole("machine.support", rows),
        parts.real("machine.dual", classes - 1, rows),
        parts.real("machine.intercept", classes * (classes - 1) // 2),
        counts,
    )

"""What is learned from exemplars, and how a query scores against it.  Tensors only; the estimator is in indexer.py.

Scorer A is the nearest exemplar under the fused epipolar residual, helped by comparing flat cards that may turn about the
vertical: it needs no training and no common viewpoint.  Scorer B is a kernel machine over virtual
views of the exemplars: it learns what tells the classes apart.  Viewpoint free (``any``) they are added as :class:`Blend` says;
on one side (``same``) B works alone.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from sklearn.svm import SVC
from torch import Tensor

from indexing.action.bank import JointMetric, Kernels, Windows, fused_residual
from indexing.action.exemplars import Exemplars
from indexing.action.joint_weights import JointWeights
from indexing.action.options import ActionOptions, BlendOptions, MachineOptions
from indexing.action.symmetry import mirror
from indexing.modelfile import part, stored
from indexing.scoring import DecisionOptions

# ----------------------------------------------------------------------------------------------------------------------
# A trained kernel machine as plain arrays: scikit-learn fits it, this evaluates it, and a model file can hold it.


@dataclass(frozen=True)
class PairwiseMachine:
    """One support vector machine per pair of classes, over a precomputed kernel.

    support: ``(S,)`` rows of the training windows, sorted by class; dual: ``(classes - 1, S)``; intercept:
    ``(classes (classes - 1) / 2,)``; counts: ``(classes,)`` support vectors per class.
    """

    support: Tensor = field(metadata=stored("whole", "rows"))
    dual: Tensor = field(metadata=stored("real", "others", "rows"))
    intercept: Tensor = field(metadata=stored("real", "pairs"))
    counts: Tensor = field(metadata=stored("whole", "classes", below=2**31))

    @classmethod
    def fit(cls, kernel: Tensor, classes: np.ndarray, penalty: float = MachineOptions.penalty) -> PairwiseMachine:
        """From a ``(N, N)`` kernel matrix and class numbers 0..C-1."""
        machine = SVC(C=penalty, kernel="precomputed").fit(kernel.cpu().numpy().astype(np.float64), classes)
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


# ----------------------------------------------------------------------------------------------------------------------
# Whether a clip shows one of the known actions at all: how good its best score is, and how far that stands out.


def evidence(scores: Tensor, classes: int, options: ActionOptions = ActionOptions()) -> Tensor:
    r"""``(Q,)`` evidence for a known action: :math:`s_1 + (s_1 - \bar s) + (s_1 - s_2)` of the sorted class scores.

    The best score alone tells known from unknown actions with an AUROC of .90 / .86 (UTKinect, camera turned 0 / 90 degrees) and
    .83 / .83 (Florence3D); with the others .92 / .88 and .87 / .85.  Weights learned per model overfit: .71 instead of .75 where
    the hubs of the exemplars do not know the unknown actions either.

    Args:
        scores: ``(Q, classes)``, or one column less where a class was left out.
        classes: of the model; with fewer than ``options.nearest.classes`` the best score stands alone.

    Example:
        >>> evidence(torch.tensor([[1.0, 5.0, 2.0, 0.0]]), 4).tolist()
        [11.0]
    """
    if classes < options.nearest.classes:
        return scores.max(dim=1).values
    best, second = scores.topk(2, dim=1).values.unbind(dim=1)
    return best + (best - scores.mean(dim=1)) + (best - second)


def without_own(scores: Tensor, labels: Tensor) -> Tensor:
    """``(N, classes - 1)`` the scores had the own class never been learned."""
    keep = torch.nn.functional.one_hot(labels, scores.shape[1]) == 0
    return scores[keep].unflatten(0, (len(scores), -1))


MOMENT_TERMS = ("epi", "nn")  # on short windows what is bound to the view helps even at 90 degrees: .83/.82 -> .93/.85


@dataclass(frozen=True)
class Blend:
    """How much each scorer counts once it is standardized over the classes of a query, and how sure the sum is.

    kernel, nearest: weights of B and A; sharpness: of the softmax over the sum, again standardized.
    """

    kernel: float = 1.0
    nearest: float = BlendOptions.balance
    sharpness: float = DecisionOptions.sharpness


@dataclass(frozen=True)
class ShapeModel:
    """Learned state; ``classes`` are numbers 0..C-1 and ``labels`` holds one per exemplar."""

    exemplars: Exemplars = field(metadata=part(""))
    labels: Tensor = field(metadata=stored("every", "exemplars", below="classes"))
    classes: int
    view: str
    scorer: str  # "nearest" (A), "kernel" (B) or "both"
    metric: JointMetric = field(metadata=part(""))
    symmetry: Tensor | None = field(metadata=stored("every", "joints", below="joints"))  # of the mirror image's joints
    mirrored: Tensor = field(metadata=stored("truth", "exemplars"))  # which exemplars also count mirrored
    parts: JointWeights = field(metadata=part())  # how much each joint and each channel of A counts
    hub: Tensor = field(metadata=stored("real", "exemplars"))  # how close an exemplar is to other classes
    moment_hub: Tensor = field(metadata=stored("real", "moments"))  # the same of its short windows
    kernels: Kernels | None
    support: Windows | None = field(metadata=part(rows="rows"))  # windows behind the machine's support rows
    machine: PairwiseMachine | None = field(metadata=part())
    # (N,) evidence of exemplars whose class was left out
    evidence_out: Tensor = field(default_factory=lambda: torch.zeros(0), metadata=stored("real", None))
    blend: Blend = field(default_factory=lambda: Blend())
    options: ActionOptions = ActionOptions()

    def to(self, device: str | torch.device) -> ShapeModel:
        """The model on another device."""
        if torch.device(device) == self.labels.device:
            return self
        moved: dict[str, Any] = {name: _moved(value, device) for name, value in self.__dict__.items()}
        return dataclasses.replace(self, **moved)

    # ---- scoring -------------------------------------------------------------------------------------------------
    def copies(self) -> list[Windows]:
        """The exemplars' crops and mirror images, each a list of N windows."""
        plain = [self.exemplars.crop(i) for i in range(len(self.exemplars.crops) // max(1, len(self.exemplars)))]
        if self.symmetry is None or not bool(self.mirrored.any()):
            return plain
        return plain + [mirror_some(one, self.symmetry, self.mirrored) for one in plain]

    def residuals(self, query: Windows) -> Tensor:
        """``(Q, N)`` fused epipolar residual to every exemplar, and that of turned cards, less the exemplar's hub share."""
        copies = self.copies()
        epipolar = self.parts.residual(query, copies, self.metric, self.labels)
        return epipolar + self.options.nearest.turned * fused_residual(query, copies, self.metric, terms=("turned",)) - self.hub

    def whole_residuals(self, query: Windows, chosen: Tensor) -> Tensor:
        """``(Q, chosen)`` the same of whole exemplars, without their crops, which would match windows that are cut short."""
        copies = [copy[chosen] for copy in self.copies()[:: max(1, len(self.exemplars.crops) // max(1, len(self.exemplars)))]]
        epipolar = self.parts.residual(query, copies, self.metric, self.labels[chosen])
        turned = fused_residual(query, copies, self.metric, terms=("turned",))
        return epipolar + self.options.nearest.turned * turned - self.hub[chosen]

    def moment_residuals(self, query: Windows) -> Tensor:
        """``(Q, M)`` residual of short windows to every short window of the exemplars, less the hub share."""
        copies = [self.exemplars.moments]
        if self.symmetry is not None and bool(self.mirrored.any()):
            copies.append(mirror_some(copies[0], self.symmetry, self.mirrored[self.exemplars.owner]))
        return fused_residual(query, copies, self.metric, terms=MOMENT_TERMS) - self.moment_hub

    def moment_scores(self, query: Windows) -> Tensor:
        """``(Q, classes)`` minus the residual to the nearest short window of each class."""
        residual, labels = self.moment_residuals(query), self.labels[self.exemplars.owner]
        return torch.stack([-residual[:, labels == c].min(dim=1).values for c in range(self.classes)], dim=1)

    def nearest_scores(self, query: Windows) -> Tensor:
        """``(Q, classes)`` scorer A: minus the mean residual to the nearest exemplars of each class."""
        return class_scores(self.residuals(query), self.labels, self.classes, options=self.options)

    def machine_scores(self, query: Windows) -> Tensor:
        """``(Q, classes)`` scorer B."""
        if self.kernels is None or self.support is None or self.machine is None:
            raise ValueError("this model has no kernel machine")
        return self.machine(self.kernels(query, self.support))

    def scores(self, query: Windows) -> Tensor:
        """``(Q, classes)`` larger is better: A, B, or the blend, standardized over the classes of each query."""
        if self.scorer == "nearest":
            return self.nearest_scores(query)
        if self.scorer == "kernel":
            return self.machine_scores(query)
        total = self.blend.kernel * standardized(self.machine_scores(query))
        return total + self.blend.nearest * standardized(self.nearest_scores(query))

    def evidence(self, query: Windows) -> Tensor:
        """``(Q,)`` how well a query shows one of the known actions rather than another one."""
        return evidence(self.nearest_scores(query), self.classes, options=self.options)


def class_scores(residuals: Tensor, labels: Tensor, classes: int, options: ActionOptions = ActionOptions()) -> Tensor:
    """``(Q, classes)`` minus the mean of the smallest residuals in each class; -inf where a class has no (finite) exemplar."""
    out = residuals.new_full((len(residuals), classes), float("-inf"))
    for c in range(classes):
        mine = residuals[:, labels == c]
        if mine.shape[1]:
            least = mine.topk(min(options.nearest.neighbours, mine.shape[1]), dim=1, largest=False).values
            there = least.isfinite()
            mean = torch.where(there, least, 0.0).sum(dim=1) / there.sum(dim=1).clamp(min=1)
            out[:, c] = torch.where(there.any(dim=1), -mean, out[:, c])
    return out


def standardized(scores: Tensor) -> Tensor:
    """Zero mean and unit deviation over the classes of each query; two classes keep their margin (else it were +-1)."""
    centred = scores - scores.mean(dim=1, keepdim=True)
    if scores.shape[1] == 2:
        return centred / (1 + centred.abs())
    return centred / scores.std(dim=1, keepdim=True, correction=0).clamp(min=1e-9)


def mirror_some(windows: Windows, symmetry: Tensor, chosen: Tensor) -> Windows:
    """Mirror the chosen windows and leave the others as they are."""
    symmetry, chosen = symmetry.to(windows.values.device), chosen.to(windows.values.device)
    values = torch.where(chosen[:, None, None, None], mirror(windows.values, symmetry), windows.values)
    return Windows(values, torch.where(chosen[:, None], windows.seen[:, symmetry], windows.seen))


def _moved(value: object, device: str | torch.device) -> object:
    """Tensors, and dataclasses of tensors, on another device."""
    if isinstance(value, Tensor):
        return value.to(device)
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return dataclasses.replace(value, **{f.name: _moved(getattr(value, f.name), device) for f in dataclasses.fields(value)})
    return value

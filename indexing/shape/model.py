"""What is learned from exemplars, and how a query scores against it.  Tensors only; the estimator is in indexer.py.

Scorer A is the nearest exemplar under the fused epipolar residual: it needs no training and no common viewpoint.  Scorer B
is a kernel machine over virtual views of the exemplars: it learns what tells the classes apart.  Viewpoint free
(``any``) they are added; on one side (``same``) B works alone.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Tensor

from indexing.shape.bank import NEAREST, Kernels, Windows, fused_residual, stack
from indexing.shape.channels import JointMetric
from indexing.shape.exemplars import Exemplars
from indexing.shape.fusion import channel_weights
from indexing.shape.machine import PairwiseMachine
from indexing.shape.views import mirror

WHITENING = 0.25  # power of the joint metric: UTKinect A .909 -> .919, few shots +3 %; .5 whitens too much
NEIGHBOURS = 2  # exemplars per class that score A averages (1: -1 %)
HUB_SHARE, HUB_NEIGHBOURS = 0.5, 5  # of an exemplar's closeness to other classes, taken off: +2..3 %, one shot +4 %
MOMENT_TERMS = ("epi", "nn")  # on short windows what is bound to the view helps even at 90 degrees: .83/.82 -> .93/.85
MOMENT_SAMPLE = 500  # short windows whose closeness to others sets the hub shares
BALANCE = 1.5  # weight of A against B after standardizing over classes; 1 .. 2 differ by 1 %
BALANCE_SOLID = 0.5  # the same for exemplars with depth: B then sees true views (1.5: -1.5 % on Florence3D, UTKinect +-0)
KERNEL_WHITENING = 0.0  # power of the joint metric of B: .15 gives UTKinect +1 %, takes 1 % from Florence3D
ROWS, ROWS_SOLID = 3000, 5000  # training rows of B at most (its fit grows with their square); true views are worth more


@dataclass(frozen=True)
class ShapeModel:
    """Learned state; ``classes`` are numbers 0..C-1 and ``labels`` holds one per exemplar."""

    exemplars: Exemplars
    labels: Tensor
    classes: int
    view: str
    scorer: str  # "nearest" (A), "kernel" (B) or "both"
    metric: JointMetric
    symmetry: Tensor | None  # joint permutation of the mirror image, or None
    mirrored: Tensor  # (N,) which exemplars also count mirrored
    weights: Tensor  # (channels of A,)
    hub: Tensor  # (N,) how close an exemplar is to other classes
    moment_hub: Tensor  # (M,) the same of its short windows
    kernels: Kernels | None
    support: Windows | None  # windows behind the machine's support rows
    machine: PairwiseMachine | None
    evidence_out: Tensor = field(default_factory=lambda: torch.zeros(0))  # (N,) best evidence for a wrong class

    def to(self, device: str | torch.device) -> ShapeModel:
        """The model on another device."""
        if torch.device(device) == self.labels.device:
            return self
        return _replace(self, **{name: _moved(value, device) for name, value in self.__dict__.items()})

    # ---- scoring -------------------------------------------------------------------------------------------------
    def copies(self) -> list[Windows]:
        """The exemplars' crops and mirror images, each a list of N windows."""
        plain = [self.exemplars.crop(i) for i in range(len(self.exemplars.crops) // max(1, len(self.exemplars)))]
        if self.symmetry is None or not bool(self.mirrored.any()):
            return plain
        return plain + [mirror_some(one, self.symmetry, self.mirrored) for one in plain]

    def residuals(self, query: Windows) -> Tensor:
        """``(Q, N)`` fused epipolar residual to every exemplar, less the exemplar's hub share."""
        return fused_residual(query, self.copies(), self.metric, NEAREST, self.weights) - self.hub

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
        return class_scores(self.residuals(query), self.labels, self.classes)

    def machine_scores(self, query: Windows) -> Tensor:
        """``(Q, classes)`` scorer B."""
        if self.kernels is None or self.support is None or self.machine is None:
            raise ValueError("this model has no kernel machine")
        return self.machine(self.kernels(query, self.support))

    def scores(self, query: Windows) -> Tensor:
        """``(Q, classes)`` larger is better: A, B or their sum, standardized over the classes of each query."""
        if self.scorer == "nearest":
            return self.nearest_scores(query)
        if self.scorer == "kernel":
            return self.machine_scores(query)
        share = float(self.exemplars.solid.float().mean())
        balance = share * BALANCE_SOLID + (1 - share) * BALANCE
        return _standard(self.machine_scores(query)) + balance * _standard(self.nearest_scores(query))


def class_scores(residuals: Tensor, labels: Tensor, classes: int) -> Tensor:
    """``(Q, classes)`` minus the mean of the smallest residuals in each class; -inf where a class has no exemplar."""
    out = residuals.new_full((len(residuals), classes), float("-inf"))
    for c in range(classes):
        mine = residuals[:, labels == c]
        if mine.shape[1]:
            out[:, c] = -mine.topk(min(NEIGHBOURS, mine.shape[1]), dim=1, largest=False).values.mean(dim=1)
    return out


def _standard(scores: Tensor) -> Tensor:
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


# ---- learning ----------------------------------------------------------------------------------------------------------
def learn(
    exemplars: Exemplars,
    labels: Tensor,
    classes: int,
    *,
    view: str,
    scorer: str,
    learned: bool,
    symmetry: Tensor | None,
    guard: bool = True,
) -> ShapeModel:
    """Learn everything from the exemplars' windows.

    Args:
        labels: ``(N,)`` class numbers; view: ``"any"`` or ``"same"``; scorer: ``"nearest"``, ``"kernel"`` or ``"both"``.
        learned: weigh the channels of A by what tells the exemplars apart (else equally).
        symmetry: joint permutation of the mirror image, or ``None`` to go without mirror images.
        guard: leave out mirror images of classes that they would turn into one another.
    """
    originals = exemplars.crop(0)
    metric = JointMetric.learn(originals.values, originals.seen, WHITENING)
    weights = torch.ones(len(NEAREST))
    none = torch.zeros(len(labels), dtype=torch.bool)
    model = ShapeModel(
        exemplars, labels, classes, view, scorer, metric, symmetry, none, weights,
        torch.zeros(len(labels)), torch.zeros(len(exemplars.owner)), None, None, None,
    )  # fmt: skip
    if symmetry is not None:
        model = _replace(model, mirrored=_mirror_is_same_action(model, originals) if guard else ~none)
    if learned:
        model = _replace(model, weights=channel_weights(originals, model.copies(), metric, labels, classes))
    model = _with_hubs(model, originals)
    if scorer != "nearest":
        model = _with_machine(model)
    return model


def _moved(value: object, device: str | torch.device) -> object:
    """Tensors, and dataclasses of tensors, on another device."""
    if isinstance(value, Tensor):
        return value.to(device)
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return dataclasses.replace(value, **{f.name: _moved(getattr(value, f.name), device) for f in dataclasses.fields(value)})
    return value


def _replace(model: ShapeModel, **changes: object) -> ShapeModel:
    return dataclasses.replace(model, **changes)  # type: ignore[arg-type]


def _mirror_is_same_action(model: ShapeModel, originals: Windows) -> Tensor:
    """``(N,)`` whether the mirror image of an exemplar is still the same action.

    Where left and right are different actions, the mirror images of each look like the other: two classes most of whose
    mirror images are nearest to one another are not mirrored.  (One direction alone is ordinary confusion.)
    """
    if model.symmetry is None:
        return model.mirrored
    flipped = mirror_some(originals, model.symmetry, torch.ones_like(model.mirrored))
    nearest = model.labels[model.residuals(flipped).argmin(dim=1)]
    own = torch.nn.functional.one_hot(model.labels, model.classes).float()
    lands = own.mT @ torch.nn.functional.one_hot(nearest, model.classes).float() / own.sum(dim=0).clamp(min=1)[:, None]
    mutual = (lands > 0.5) & (lands.mT > 0.5)
    mutual.fill_diagonal_(False)
    return ~mutual.any(dim=1)[model.labels]


def _with_hubs(model: ShapeModel, originals: Windows) -> ShapeModel:
    """Measure, among the exemplars, how close each is to other classes, and the evidence that wrong classes reach."""
    residual = model.residuals(originals)
    hub = _hub(residual, model.labels, model.labels)
    model = _replace(model, hub=hub, evidence_out=_foreign_evidence(residual, model))
    sample = torch.arange(0, len(model.exemplars.moments), max(1, len(model.exemplars.moments) // MOMENT_SAMPLE))
    labels = model.labels[model.exemplars.owner]
    return _replace(model, moment_hub=_hub(model.moment_residuals(model.exemplars.moments[sample]), labels[sample], labels))


def _foreign_evidence(residual: Tensor, model: ShapeModel) -> Tensor:
    """``(N,)`` the best evidence each exemplar finds for a wrong class, were its own class unknown.

    The hubs must not know the class either: with it in them, 10 % asked for were 18 to 21 % (14 % so; 30 %: 53, now 35).
    """
    out = residual.new_empty(len(model.labels))
    for c in range(model.classes):
        mine, rest = model.labels == c, model.labels != c
        hub = _hub(residual[rest][:, rest], model.labels[rest], model.labels[rest])
        scores = class_scores(residual[mine][:, rest] - hub, model.labels[rest], model.classes)
        out[mine] = scores.max(dim=1).values
    return out


def _hub(residual: Tensor, rows: Tensor, columns: Tensor) -> Tensor:
    """``(columns,)`` half the mean residual from the nearest windows of other classes: near to everything = little evidence."""
    other = rows[:, None] != columns[None]
    count = max(1, min(HUB_NEIGHBOURS, int(other.sum(dim=0).min())))
    foreign = torch.where(other, residual, torch.inf).topk(count, dim=0, largest=False).values.mean(dim=0)
    # a class that the sampled rows hold alone has nothing to compare with: it gets the usual share
    known = foreign.isfinite()
    return HUB_SHARE * torch.where(known, foreign, foreign[known].mean() if known.any() else foreign.new_tensor(0.0))


def _with_machine(model: ShapeModel) -> ShapeModel:
    """Train scorer B on the exemplars, their virtual views and mirror images, as many as the budget of rows allows."""
    exemplars, count = model.exemplars, len(model.exemplars)
    both = model.symmetry is not None and bool(model.mirrored.any())
    rows_at_most = ROWS_SOLID if bool(exemplars.solid.any()) else ROWS
    copies = max(1, rows_at_most // (count * (1 + both)))
    parts = [exemplars.crop(0)] + [exemplars.view(i) for i in range(min(copies - 1, len(exemplars.views) // count))]
    rows, labels = stack(parts), model.labels.repeat(len(parts))
    if both and model.symmetry is not None:
        chosen = model.mirrored.repeat(len(parts))
        rows = stack([rows, mirror_some(rows[chosen], model.symmetry, chosen[chosen])])
        labels = torch.cat([labels, labels[chosen]])
    kernels = Kernels(JointMetric(model.metric.covariance, KERNEL_WHITENING), one_side=model.view == "same")
    machine = PairwiseMachine.fit(kernels.fit(rows), labels.numpy().astype(np.int64))
    return _replace(model, kernels=kernels, support=rows[machine.support], machine=machine)

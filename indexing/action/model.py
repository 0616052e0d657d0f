"""What is learned from exemplars, and how a query scores against it.  Tensors only; the estimator is in indexer.py.

Scorer A is the nearest exemplar under the fused epipolar residual, helped by comparing flat cards that may turn about the
vertical: it needs no training and no common viewpoint.  Scorer B is a kernel machine over virtual
views of the exemplars: it learns what tells the classes apart.  Viewpoint free (``any``) they are added as :class:`Blend` says;
on one side (``same``) B works alone.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any, Self

import numpy as np
import torch
from numpy.typing import NDArray
from sklearn.svm import SVC
from torch import Tensor

from indexing.action.bank import (
    CHANNELS,
    EPSILON,
    NEAREST,
    Bank,
    Copy,
    Describer,
    JointMetric,
    Windows,
    fused_residuals,
    mirror,
    planes_of,
    stack,
)
from indexing.action.exemplars import Exemplars
from indexing.action.joint_weights import MAX_WEIGHT, JointWeights
from indexing.action.kernels import Kernels
from indexing.modelfile import Parts, number, part, read_fields, store
from indexing.opening import quote

TURNED_CARD_WEIGHT = 0.3  # one shot +1.3 %, Florence3D +.8 %; .6 is too much
NUM_NEIGHBOURS = 2  # exemplars per class that are averaged (1: -1 %)
MIN_CLASSES_TO_COMPARE = 4  # from which evidence compares the best with the others: fewer are nothing to stand out from
PROFILE_FLOOR = 0.3  # added to the variances of profiles, in parts of them (experiments.recognition.open_set)
PROFILE_WEIGHT = 2.5  # of an unusual profile in evidence (experiments.recognition.open_set)
MIN_EXEMPLARS_TO_PROJECT = 500  # fewer are compared in less time than it takes to learn their principal directions
MAX_DIRECTION_WINDOWS = 2000  # that principal directions are learned from: with 1000 they leave out .012 of others, with 4000 .0101
PENALTY = 10.0  # C of the support vector machine; 2 and 30 differ by less than 1 % on three sets
NEAREST_WEIGHT = 1.5  # of scorer A against B, standardized over classes; 1 .. 2 differ by 1 %

# ----------------------------------------------------------------------------------------------------------------------
# A trained kernel machine as plain arrays: scikit-learn fits it, this evaluates it, and a model file can hold it.


@dataclass(frozen=True)
class PairwiseMachine:
    """One support vector machine per pair of classes, over a precomputed kernel."""

    support: Tensor = field(metadata=store("integers", "rows"))
    dual: Tensor = field(metadata=store("real", "others", "rows"))
    intercept: Tensor = field(metadata=store("real", "pairs"))
    counts: Tensor = field(metadata=store("integers", "classes", below=2**31))

    @classmethod
    def fit(cls, kernel: Tensor, classes: np.ndarray, penalty: float = PENALTY) -> PairwiseMachine:
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
        """Votes per class, ordered among equals by the summed margins. kernel ``(Q, S)`` -> ``(Q, classes)``."""
        classes, dual = len(self.counts), self.dual.to(kernel)
        parts = zip(kernel.split(self.counts.tolist(), dim=1), dual.split(self.counts.tolist(), dim=1), strict=True)
        # (Q, classes, classes - 1): what the support vectors of each class say against each of the others
        against = torch.stack([mine @ others.mT for mine, others in parts], dim=1)
        i, j = torch.triu_indices(classes, classes, 1, device=kernel.device)
        value = against[:, i, j - 1] + against[:, j, i] + self.intercept.to(kernel)
        won = (value > 0).to(kernel)
        votes = kernel.new_zeros(len(kernel), classes).index_add_(1, i, won).index_add_(1, j, 1 - won)
        margins = kernel.new_zeros(len(kernel), classes).index_add_(1, i, value).index_add_(1, j, -value)
        return votes + margins / (3 * (margins.abs() + 1))


# ----------------------------------------------------------------------------------------------------------------------
# Whether a clip shows one of the known actions at all: how good its best score is, and how far that stands out.


def evidence(
    scores: Tensor,
    classes: int,
    unusual: Tensor | None = None,
    hidden: int = 0,
) -> Tensor:
    r"""``(Q,)`` evidence for a known action: how good the best class score is, how far it stands out, how usual the others are."""
    best, at = scores[:, : scores.shape[1] - hidden].max(dim=1)
    if classes >= MIN_CLASSES_TO_COMPARE or hidden:
        second = scores.scatter(1, at[:, None], -torch.inf).max(dim=1).values
        best = best + (best - scores.mean(dim=1)) + (best - second)
    return best if unusual is None else best - PROFILE_WEIGHT * unusual


# ----------------------------------------------------------------------------------------------------------------------
# What a clip of a known action says of all actions, not of its own alone: profiles of class scores, and how usual one is.
#
# A clip of a known action is near to its own exemplars, about as far from those of each other action as its own exemplars are, and
# these distances belong together.  A clip of an unknown action may be as near to some class as that, but hardly in such company.
# So the exemplars, each asked as if it had not been learned, tell what the profiles of their class look like.


@dataclass(frozen=True)
class ClassProfiles:
    r"""The profiles of the exemplars of each class: their mean, and how they scatter about it."""

    centres: Tensor = field(metadata=store("real", "known", "columns"))
    precision: Tensor = field(metadata=store("real", "columns", "columns"))

    @classmethod
    def learn(cls, profiles: Tensor, labels: Tensor, known: int) -> Self | None:
        """From the profiles of the exemplars, each asked without itself. profiles ``(N, columns)``."""
        usable = profiles.isfinite().all(dim=1) & (labels < known)
        own = torch.nn.functional.one_hot(labels[usable], known).to(profiles)
        counts = own.sum(dim=0)
        if not known or int(counts.min()) < 2:
            return None
        centres = own.mT @ profiles[usable] / counts[:, None]
        apart = (profiles[usable] - own @ centres).double()
        scatter = apart.mT @ apart / len(apart)
        ridge = (PROFILE_FLOOR * scatter.diagonal()).clamp(min=1e-9)
        return cls(centres, torch.linalg.inv(scatter + ridge.diag()).to(profiles))

    def distance(self, profiles: Tensor, classes: int) -> Tensor:
        r"""``(Q,)`` how unusual profiles ``(Q, columns)`` are, in standard deviations of the class whose they resemble most."""
        apart = profiles[:, None] - self.centres
        # who is nearer to a class than usual, as the same person is, is not unusual for it
        known, columns = self.centres.shape
        own = torch.arange(columns, device=apart.device) % classes == torch.arange(known, device=apart.device)[:, None]
        apart = torch.where(own, apart.clamp(max=0.0), apart)
        squares = torch.einsum("qci,ij,qcj->qc", apart, self.precision, apart)
        return squares.amin(dim=1).clamp(min=0.0).sqrt()


MOMENT_TERMS = ("epi", "nn")  # on short windows what is bound to the view helps even at 90 degrees: .83/.82 -> .93/.85


@dataclass(frozen=True)
class Blend:
    """How much each scorer counts once it is standardized over the classes of a query."""

    kernel: float = 1.0
    nearest: float = NEAREST_WEIGHT


class Cache:
    """What a model makes on first use and keeps; copies of it and what is saved of it start with nothing."""

    def __init__(self) -> None:
        self._made: dict[Hashable, Any] = {}

    def get(self, name: Hashable, make: Callable[[], Any]) -> Any:
        """What has the name, made by now."""
        if name not in self._made:
            self._made[name] = make()
        return self._made[name]

    def __reduce__(self) -> tuple[type[Cache], tuple[()]]:
        return Cache, ()


@dataclass(frozen=True)
class ShapeModel:
    """Learned state; ``classes`` are numbers 0..C-1 and ``labels`` holds one per exemplar."""

    exemplars: Exemplars = field(metadata=part(""))
    labels: Tensor = field(metadata=store("every", "exemplars", below="classes"))
    classes: int
    view: str
    scorer: str  # "nearest" (A), "kernel" (B) or "both"
    metric: JointMetric = field(metadata=part(""))
    symmetry: Tensor | None = field(metadata=store("every", "joints", below="joints"))  # of the mirror image's joints
    mirrored: Tensor = field(metadata=store("truth", "exemplars"))  # which exemplars also count mirrored
    hub: Tensor = field(metadata=store("real", "exemplars"))  # how close an exemplar is to other classes
    moment_hub: Tensor = field(metadata=store("real", "moments"))  # the same of its short windows
    kernels: Kernels | None
    support: Windows | None = field(metadata=part(rows="rows"))  # windows behind the machine's support rows
    machine: PairwiseMachine | None = field(metadata=part())
    # (N,) evidence of exemplars whose class was left out
    evidence_out: Tensor = field(default_factory=lambda: torch.zeros(0), metadata=store("real", None))
    blend: Blend = field(default_factory=lambda: Blend())
    profiles: ClassProfiles | None = field(default=None, metadata=part())  # of the exemplars' class scores; older files have none
    joint_weights: JointWeights | None = field(default=None, metadata=part("parts"))  # of A, where they are not equal
    hidden: int = 0
    cache: Cache = field(default_factory=lambda: Cache(), init=False, repr=False, compare=False)  # exemplars as they are compared

    def to(self, device: str | torch.device) -> ShapeModel:
        """The model on another device, the same one again for the next call."""
        if torch.device(device) == self.labels.device:
            return self
        there: ShapeModel = self.cache.get(torch.device(device), lambda: self._copy_to(device))
        return there

    def _copy_to(self, device: str | torch.device) -> ShapeModel:
        moved: dict[str, Any] = {f.name: _to_device(getattr(self, f.name), device) for f in dataclasses.fields(self) if f.init}
        return dataclasses.replace(self, **moved)

    def joint_sets(self) -> NDArray[np.bool_]:
        """``(sets, joints)`` the sets of joints that exemplars show."""
        return np.asarray(self.cache.get("shown", lambda: self.exemplars.crop(0).seen.unique(dim=0).cpu().numpy()))

    # ---- scoring -------------------------------------------------------------------------------------------------
    def _copies(self, windows: Windows, mirrored: Tensor) -> list[Copy]:
        """Windows, and the mirror images of those that count mirrored, too."""
        if self.symmetry is None or not bool(mirrored.any()):
            return [Copy(windows)]
        return [Copy(windows), Copy(windows, None if bool(mirrored.all()) else mirrored.nonzero()[:, 0], self.symmetry)]

    def _crops(self, count: int | None, weights: JointWeights | None = None) -> list[Bank]:
        """Banks of the exemplars' crops (the first ones), under weights or with all joints alike."""

        def make() -> list[list[Bank]]:
            count = len(self.exemplars.crops) // max(1, len(self.exemplars))
            crops = [self._copies(self.exemplars.crop(i), self.mirrored) for i in range(count)]
            return (
                weights.banks(crops, self.metric, self.labels) if weights else [[Bank(one, self._planes("crops"))] for one in crops]
            )

        return [bank for crop in self.cache.get(("crops", weights is None), make)[:count] for bank in crop]

    def _planes(self, name: str) -> Describer:
        """What describes crops or moments where all joints count alike, always the same one."""

        def some() -> Windows:
            windows: Windows = getattr(self.exemplars, name)
            few = windows[:: max(1, len(windows) // MAX_DIRECTION_WINDOWS)]
            if self.symmetry is None or not bool(self.mirrored.any()):
                return few
            return stack([few, mirror_some(few, self.symmetry, torch.ones(len(few), dtype=torch.bool))])

        many = len(self.exemplars) >= MIN_EXEMPLARS_TO_PROJECT
        return self.cache.get(("planes", name), lambda: planes_of(self.metric, some if many else None))

    def _residuals(self, query: Windows, crops: int | None, chosen: Tensor | None) -> Tensor:
        weights = self.joint_weights
        if weights is None:  # both from the same products
            near, card = fused_residuals(query, self._crops(crops), [("epi",), ("turned",)], chosen)
        else:
            (near,) = fused_residuals(query, self._crops(crops, weights), [("epi",)], chosen, weights.channels.tolist())
            (card,) = fused_residuals(query, self._crops(crops), [("turned",)], chosen)
        hub = self.hub if chosen is None else self.hub[chosen]
        return near.add_(card, alpha=TURNED_CARD_WEIGHT).sub_(hub)

    def residuals(self, query: Windows) -> Tensor:
        """``(Q, N)`` fused epipolar residual to every exemplar, and that of turned cards, less the exemplar's hub share."""
        return self._residuals(query, None, None)

    def whole_residuals(self, query: Windows, chosen: Tensor) -> Tensor:
        """``(Q, chosen)`` the same of whole exemplars, without their crops, which would match windows that are cut short."""
        return self._residuals(query, 1, chosen)

    def moment_residuals(self, query: Windows) -> Tensor:
        """``(Q, M)`` residual of short windows to every short window of the exemplars, less the hub share."""

        def make() -> Bank:
            moments, owner = self.exemplars.moments, self.exemplars.owner
            return Bank(self._copies(moments, self.mirrored[owner]), self._planes("moments"))

        (found,) = fused_residuals(query, [self.cache.get("moments", make)], [MOMENT_TERMS])
        return found.sub_(self.moment_hub)

    def moment_scores(self, query: Windows) -> Tensor:
        """``(Q, classes)`` minus the residual to the nearest short window of each class."""
        each = by_class(self.moment_residuals(query), self.labels[self.exemplars.owner], self.classes)
        return torch.stack([-mine.min(dim=1).values for mine in each], dim=1)

    def nearest_scores(self, query: Windows) -> Tensor:
        """``(Q, classes)`` scorer A: minus the mean residual to the nearest exemplars of each class."""
        return class_scores(self.residuals(query), self.labels, self.classes)

    def machine_scores(self, query: Windows) -> Tensor:
        """``(Q, classes)`` scorer B."""
        if self.kernels is None or self.support is None or self.machine is None:
            raise ValueError("this model has no kernel machine")
        return self.machine(self.kernels(query, self.cache.get("support", partial(self.kernels.bank, self.support))))

    def scores(self, query: Windows, nearest: Tensor | None = None) -> Tensor:
        """``(Q, classes)`` larger is better: A, B, or the blend, standardized over the classes of each query."""
        if self.scorer == "kernel":
            return self.machine_scores(query)
        nearest = self.nearest_scores(query) if nearest is None else nearest
        if self.scorer == "nearest":
            return nearest
        return self.blend.kernel * standardize(self.machine_scores(query)) + self.blend.nearest * standardize(nearest)

    def evidence(self, query: Windows, nearest: Tensor | None = None) -> Tensor:
        """``(Q,)`` how well a query shows one of the known actions rather than another one."""
        if self.num_known == 1:
            return self.plain_scores(query)[:, 0]
        nearest = self.nearest_scores(query) if nearest is None else nearest
        unusual = None
        if self.profiles is not None:
            alike = [self.kernel_scores(query)] if self.kernels is not None else []
            unusual = self.profiles.distance(torch.cat([nearest, *alike], dim=1), self.classes)
        return evidence(nearest, self.classes, unusual, self.hidden)

    def plain_scores(self, query: Windows) -> Tensor:
        """``(Q, classes)`` scorer A without the hubs, comparable between classes: of one action alone that is its evidence."""
        return class_scores(self.residuals(query) + self.hub, self.labels, self.classes)

    def kernel_scores(self, query: Windows) -> Tensor:
        """``(Q, classes)`` of the nearest exemplars by the kernel of scorer B, as :meth:`nearest_scores` are by the residual."""
        return class_scores(self.kernel_residuals(query), self.labels, self.classes)

    def kernel_residuals(self, query: Windows) -> Tensor:
        """``(Q, N)`` minus the logarithm of the kernel between queries and exemplars."""
        if self.kernels is None:
            raise ValueError("this model has no kernels")
        bank = self.cache.get("originals", partial(self.kernels.bank, self.exemplars.crop(0)))
        return -(self.kernels(query, bank) + EPSILON).log()

    @property
    def num_known(self) -> int:
        """How many classes are answers."""
        return self.classes - self.hidden

    @property
    def num_calibration_classes(self) -> int:
        """How many classes tell, one after the other left out, what evidence an unknown action has for the known ones."""
        return self.classes if self.num_known > 1 else self.hidden


def class_scores(residuals: Tensor, labels: Tensor, classes: int) -> Tensor:
    """``(Q, classes)`` minus the mean of the smallest residuals in each class; -inf where a class has no (finite) exemplar."""
    out = residuals.new_full((len(residuals), classes), float("-inf"))
    for c, mine in enumerate(by_class(residuals, labels, classes)):
        if mine.shape[1]:
            least = _smallest(mine, NUM_NEIGHBOURS)
            there = least.isfinite()
            mean = torch.where(there, least, 0.0).sum(dim=1) / there.sum(dim=1).clamp(min=1)
            out[:, c] = torch.where(there.any(dim=1), -mean, out[:, c])
    return out


def by_class(residuals: Tensor, labels: Tensor, classes: int) -> Sequence[Tensor]:
    """``(Q, exemplars)`` the columns of each class; sorted once, which is faster than a mask for each."""
    order, counts = labels.argsort(stable=True), torch.bincount(labels, minlength=classes).tolist()
    return residuals.index_select(1, order).split(counts, dim=1)[:classes]


def _smallest(values: Tensor, count: int) -> Tensor:
    """``(Q, count)`` the smallest of each row, at most all: taken one after the other, which is five times faster than ``topk``."""
    found = []
    for _ in range(min(count, values.shape[1])):
        least, at = values.min(dim=1, keepdim=True)
        found.append(least)
        values = values.scatter(1, at, torch.inf)
    return torch.cat(found, dim=1)


def standardize(scores: Tensor) -> Tensor:
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


def _to_device(value: object, device: str | torch.device) -> object:
    """Tensors, and dataclasses of tensors, on another device."""
    if isinstance(value, Tensor):
        return value.to(device)
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return dataclasses.replace(value, **{f.name: _to_device(getattr(value, f.name), device) for f in dataclasses.fields(value)})
    return value


# ----------------------------------------------------------------------------------------------------------------------
# Reading a model from its file.


SCORERS = ("nearest", "kernel", "both")
MIN_SCALE = 1e-7  # of a kernel, over distances from 0 to 2


def read_shape_model(
    parts: Parts, header: Mapping[str, Any], classes: int, hidden: int, joints: int, length: int, crops: int
) -> ShapeModel:
    """A model whose parts belong together; ``classes`` are the known ones, ``hidden`` the kinds of background."""
    sizes = _sizes(parts, classes + hidden, joints, length, crops)
    view, scorer, trained = header["view"], header["scorer"], "scales" in parts
    if view != header["parameters"]["view"] or scorer not in SCORERS or trained != (scorer != "nearest"):
        raise ValueError(f"view, scorer: {quote(view)} and {quote(scorer)} do not fit the rest")
    stored_fields = read_fields(ShapeModel, parts, sizes)
    if sizes["views"] % sizes["exemplars"]:
        raise ValueError(f"views: {sizes['views']} windows of {sizes['exemplars']} exemplars")
    if not trained:
        stored_fields |= {"support": None, "machine": None}
    kernels = None
    if trained:
        kernels = Kernels(view == "same")
        kernels.scales = parts.real("scales", kernels.count, least=MIN_SCALE)
        counts = stored_fields["machine"].counts
        if int(counts.sum()) != sizes["rows"]:
            raise ValueError(f"machine.counts: {int(counts.sum())} support vectors, and {sizes['rows']} are there")
    blend = {name: number(value, name, 0, MAX_WEIGHT) for name, value in header["blend"].items() if name != "sharpness"}
    weights = stored_fields["joint_weights"]
    if weights is not None and not weights.is_usable:
        raise ValueError("parts: no joint or no channel counts")
    if weights is not None and weights.is_uniform:
        stored_fields["joint_weights"] = None  # older files hold equal ones
    about = {"classes": sizes["classes"], "view": view, "scorer": scorer, "kernels": kernels, "blend": Blend(**blend)}
    return ShapeModel(**stored_fields, **about, hidden=hidden)


def _sizes(parts: Parts, classes: int, joints: int, length: int, crops: int) -> dict[str, int]:
    """How many there are of what the tensors of a model are about."""
    exemplars = len(parts.truth("solid", None))
    if classes < 2 or exemplars < classes:
        raise ValueError(f"{exemplars} exemplars of {classes} classes")
    return {
        "classes": classes, "others": classes - 1, "pairs": classes * (classes - 1) // 2, "exemplars": exemplars,
        "crops": exemplars * crops, "length": length, "joints": joints, "channels": len(CHANNELS), "nearest": len(NEAREST),
    }  # fmt: skip

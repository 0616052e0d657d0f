"""Model files of action indexers: safetensors with JSON metadata.  Nothing in them can run."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from indexing.action.bank import CHANNELS, NEAREST, JointMetric, Kernels, Windows
from indexing.action.exemplars import Exemplars
from indexing.action.joint_weights import JointWeights
from indexing.action.model import Blend, ShapeModel, read_machine
from indexing.action.options import ActionOptions
from indexing.estimator import check_device, read_options
from indexing.modelfile import (
    Parts,
    labels_from_json,
    labels_to_json,
    number,
    read_model,
    skeleton_from_json,
    skeleton_to_json,
    usable,
    whole,
    write_model,
)
from indexing.opening import shown

if TYPE_CHECKING:
    from indexing.action.indexer import ActionIndexer

FORMAT = "dyntorch.action-indexer"
VERSION = 2
SCORERS = ("nearest", "kernel", "both")
JOINTS = 10_000  # at most; the largest layouts have some hundred
MOST_WEIGHT = 1e6  # of a joint or a scorer, the mean being 1
LEAST_SCALE = 1e-7  # of a kernel, over distances from 0 to 2
PLAIN = ("labels", "symmetry", "mirrored", "hub", "moment_hub", "evidence_out")  # tensors as they are

Indexer = TypeVar("Indexer", bound="ActionIndexer")


def save(indexer: ActionIndexer, path: str | Path) -> None:
    """Write a fitted indexer.

    Raises:
        ValueError: the file cannot be written, or the labels are neither text nor numbers.
    """
    about = {
        "classes": labels_to_json(indexer.classes_),
        "joints": indexer.n_joints_,
        "view": indexer.model_.view,
        "scorer": indexer.model_.scorer,
        "blend": dataclasses.asdict(indexer.model_.blend),
        "parts": [indexer.model_.parts.gain, indexer.model_.parts.sigma],
        "groups": None if indexer.groups_ is None else indexer.groups_.tolist(),
        "skeleton": skeleton_to_json(indexer.skeleton_),
    }
    write_model(path, FORMAT, VERSION, indexer.saved_parameters(), about, _tensors(indexer.model_))


def load(kind: type[Indexer], path: str | Path, device: str = "cpu") -> Indexer:
    """Read a fitted indexer; see :meth:`indexing.ActionIndexer.load`."""
    check_device(device)
    header, parts = read_model(path, FORMAT, VERSION)
    with usable(path):
        parameters = _known(header)
        indexer = kind(
            **{**parameters, "tempi": tuple(parameters["tempi"])}, options=read_options(ActionOptions, header), device=device
        )
        indexer.check_parameters()
        indexer.classes_ = labels_from_json(header["classes"])
        indexer.n_joints_ = whole(header["joints"], "joints", 1, JOINTS)
        indexer.skeleton_ = skeleton_from_json(header["skeleton"], indexer.n_joints_)
        indexer.model_ = _model(parts, header, Sizes.of(parts, indexer), indexer._options)
        indexer.groups_ = _groups(header["groups"], len(indexer.model_.labels))
        indexer._calibrate()
    return indexer


@dataclasses.dataclass(frozen=True)
class Sizes:
    """How many there are of what the tensors of a model are about."""

    classes: int
    exemplars: int
    crops: int
    length: int
    joints: int

    @classmethod
    def of(cls, parts: Parts, indexer: ActionIndexer) -> Sizes:
        """As the parameters and the first tensors say.

        Raises:
            ValueError: these contradict each other.
        """
        exemplars = len(parts.truth("solid", None))
        crops = len(indexer._options.exemplars.crops) if indexer.search else 1
        if len(indexer.classes_) < 2 or exemplars < len(indexer.classes_):
            raise ValueError(f"{exemplars} exemplars of {len(indexer.classes_)} classes")
        return cls(len(indexer.classes_), exemplars, crops, int(indexer.length), indexer.n_joints_)


def _known(header: dict[str, Any]) -> dict[str, Any]:
    """The parameters of a model file, of which older ones hold one more.

    Raises:
        ValueError: its exemplars were given a guessed depth, which is no longer done.
    """
    if header.get("layout") is not None:
        raise ValueError("layout: depth of 2D examples is no longer guessed")
    return {name: value for name, value in header["parameters"].items() if name not in ("depth", "options")}


def _groups(found: Any, exemplars: int) -> NDArray[Any] | None:
    if found is None:
        return None
    if len(found) != exemplars or not all(isinstance(name, str) for name in found):
        raise ValueError(f"groups: {len(found)} names for {exemplars} exemplars")
    return np.array(found, dtype=str)


def _tensors(model: ShapeModel) -> dict[str, Tensor]:
    exemplars = model.exemplars
    named: dict[str, Tensor | None] = {name: getattr(model, name) for name in PLAIN}
    named |= {"metric": model.metric.covariance, "metric_power": torch.tensor(model.metric.power)}
    named |= {f"parts.{name}": getattr(model.parts, name) for name in ("joints", "channels", "by_class")}
    named |= {"owner": exemplars.owner, "solid": exemplars.solid}
    named |= {**_windows("crops", exemplars.crops), **_windows("views", exemplars.views), **_windows("moments", exemplars.moments)}
    if model.kernels is not None and model.support is not None and model.machine is not None:
        machine = model.machine
        named |= {"scales": model.kernels.scales, **_windows("support", model.support), "machine.support": machine.support}
        named |= {"machine.dual": machine.dual, "machine.intercept": machine.intercept, "machine.counts": machine.counts}
    return {name: value for name, value in named.items() if value is not None}


def _windows(name: str, windows: Windows) -> dict[str, Tensor]:
    return {f"{name}.values": windows.values, f"{name}.seen": windows.seen}


def _model(parts: Parts, header: dict[str, Any], sizes: Sizes, options: ActionOptions) -> ShapeModel:
    n, joints = sizes.exemplars, sizes.joints
    view, scorer, trained = header["view"], header["scorer"], "scales" in parts
    if view != header["parameters"]["view"] or scorer not in SCORERS or trained != (scorer != "nearest"):
        raise ValueError(f"view, scorer: {shown(view)} and {shown(scorer)} do not fit the rest")
    moments = _read_windows(parts, "moments", sizes, None)
    owner = parts.every("owner", len(moments), below=n)
    crops = _read_windows(parts, "crops", sizes, sizes.crops * n)
    views = _read_windows(parts, "views", sizes, None)
    if len(views) % n:
        raise ValueError(f"views: {len(views)} windows of {n} exemplars")
    power = float(parts.real("metric_power", least=0, most=10))
    metric = JointMetric(parts.real("metric", len(CHANNELS), joints, joints), power, floor=options.nearest.floor)
    kernels = (
        Kernels(JointMetric(metric.covariance, options.machine.whitening, floor=metric.floor), view == "same") if trained else None
    )
    if kernels is not None:
        kernels.scales = parts.real("scales", kernels.count, least=LEAST_SCALE)
    support = _read_windows(parts, "support", sizes, None) if trained else None
    symmetry = parts.every("symmetry", joints, below=joints) if "symmetry" in parts else None
    blend = {name: number(value, name, 0, MOST_WEIGHT) for name, value in header["blend"].items()}
    return ShapeModel(
        exemplars=Exemplars(crops, views, moments, owner, parts.truth("solid", n)),
        labels=parts.every("labels", n, below=sizes.classes),
        classes=sizes.classes,
        view=view,
        scorer=scorer,
        metric=metric,
        symmetry=symmetry,
        mirrored=parts.truth("mirrored", n),
        parts=_joint_weights(parts, header["parts"], sizes),
        hub=parts.real("hub", n),
        moment_hub=parts.real("moment_hub", len(moments)),
        kernels=kernels,
        support=support,
        machine=read_machine(parts, sizes.classes, len(support)) if support is not None else None,
        evidence_out=parts.real("evidence_out", None),
        blend=Blend(**blend),
        options=options,
    )


def _read_windows(parts: Parts, name: str, sizes: Sizes, count: int | None) -> Windows:
    values = parts.real(f"{name}.values", count, sizes.length, sizes.joints, 2)
    seen = parts.truth(f"{name}.seen", len(values), sizes.joints)
    return Windows(values, seen)


def _joint_weights(parts: Parts, learned: Any, sizes: Sizes) -> JointWeights:
    joints = parts.real("parts.joints", len(NEAREST), sizes.joints, least=0, most=MOST_WEIGHT)
    channels = parts.real("parts.channels", len(NEAREST), least=0, most=MOST_WEIGHT)
    named = "parts.by_class"
    by_class = parts.real(named, sizes.classes, sizes.joints, least=0, most=MOST_WEIGHT) if named in parts else None
    weights = joints if by_class is None else joints[:, None] * by_class
    if not bool((weights.sum(-1) > 0).all()) or not bool(channels.sum() > 0):
        raise ValueError("parts: no joint or no channel counts")
    gain, sigma = (number(value, "parts") for value in learned)
    return JointWeights(joints, channels, by_class, gain, sigma)

"""Model files: safetensors with JSON metadata.  Nothing in them can run."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
import torch
from torch import Tensor

from indexing.checks import check_device, check_parameters
from indexing.modelfile import AGAIN, labels_from_json, labels_to_json, read_model, write_model
from indexing.shape.bank import NEAREST, Kernels, Windows
from indexing.shape.bodies import Bodies, Layout
from indexing.shape.channels import CHANNELS, JointMetric
from indexing.shape.exemplars import Exemplars
from indexing.shape.joint_weights import JointWeights
from indexing.shape.learning import KERNEL_WHITENING
from indexing.shape.machine import PairwiseMachine
from indexing.shape.model import Blend, ShapeModel
from indexing.skeleton import Skeleton

if TYPE_CHECKING:
    from indexing.indexer import ActionIndexer

FORMAT = "dyntorch.action-indexer"
VERSION = 2
PLAIN = ("labels", "symmetry", "mirrored", "hub", "moment_hub", "evidence_out")  # tensors as they are

Indexer = TypeVar("Indexer", bound="ActionIndexer")


def save(indexer: ActionIndexer, path: str | Path) -> None:
    """Write a fitted indexer.

    Raises:
        ValueError: the file cannot be written, or the labels are neither text nor numbers.
    """
    skeleton = indexer.skeleton_
    about = {
        "classes": labels_to_json(indexer.classes_),
        "joints": indexer.n_joints_,
        "view": indexer.model_.view,
        "scorer": indexer.model_.scorer,
        "blend": dataclasses.asdict(indexer.model_.blend),
        "parts": [indexer.model_.parts.gain, indexer.model_.parts.sigma],
        "layout": None if indexer.layout_ is None else dataclasses.asdict(indexer.layout_),
        "groups": None if indexer.groups_ is None else indexer.groups_.tolist(),
        "skeleton": None if skeleton is None else [skeleton.name, list(skeleton.joints), [list(b) for b in skeleton.bones]],
    }
    write_model(path, FORMAT, VERSION, indexer.get_params(), about, _tensors(indexer.model_))


def load(kind: type[Indexer], path: str | Path, device: str = "cpu") -> Indexer:
    """Read a fitted indexer; see :meth:`indexing.ActionIndexer.load`."""
    check_device(device)
    metadata, tensors = read_model(path, FORMAT, VERSION)
    try:
        parameters = metadata["parameters"]
        indexer = kind(**{**parameters, "tempi": tuple(parameters["tempi"])}, device=device)
        indexer.classes_ = labels_from_json(metadata["classes"])
        indexer.n_joints_ = int(metadata["joints"])
        name, joints, bones = metadata["skeleton"] or (None, (), ())
        indexer.skeleton_ = Skeleton(name, tuple(joints), tuple((a, b) for a, b in bones)) if name is not None else None
        layout = metadata["layout"]
        indexer.layout_ = None if layout is None else Layout(tuple(layout["joints"]), bool(layout["photograph"]))
        indexer.groups_ = None if metadata["groups"] is None else np.array(metadata["groups"], dtype=str)
        indexer.model_ = _model(tensors, metadata, len(indexer.classes_), indexer.layout_)
        check_parameters(indexer)
        _check_fit(indexer)
        indexer._calibrate()
    except (KeyError, TypeError, IndexError, ValueError, RuntimeError, AttributeError) as error:
        raise ValueError(f"{path}: not a model that can be used ({type(error).__name__}: {error}); {AGAIN}") from None
    return indexer


def _check_fit(indexer: ActionIndexer) -> None:
    """Raise where the parts of a file do not belong together."""
    model, parts = indexer.model_, indexer.model_.exemplars
    count, joints = len(model.labels), indexer.n_joints_
    skeleton = indexer.skeleton_
    fine = {
        "labels": len(parts) == count and int(model.labels.max()) + 1 == model.classes,
        "owner": len(parts.owner) == len(parts.moments) and len(parts.owner.unique()) == count,
        "joints": parts.crops.values.shape[2] == joints and (skeleton is None or len(skeleton.joints) == joints),
        "metric": model.metric.covariance.shape == (len(CHANNELS), joints, joints),
        "joints.weights": model.parts.joints.shape == (len(NEAREST), joints) and len(model.parts.channels) == len(NEAREST),
        "view": model.view == indexer.view,
        "scorer": model.scorer in ("nearest", "kernel", "both") and (model.machine is None) == (model.scorer == "nearest"),
    }
    for name, windows in (("crops", parts.crops), ("views", parts.views), ("moments", parts.moments)):
        fine[name] = len(windows.values) == len(windows.seen) and (name == "moments" or len(windows) % count == 0)
    fine |= {name: len(getattr(model, name)) == count for name in ("hub", "mirrored", "evidence_out")}
    if model.bodies is not None:
        solid = model.bodies.windows.values
        fine["bodies"] = solid.ndim == 4 and len(solid) % count == 0 and bool(solid.isfinite().all())
    values = (parts.crops.values, parts.views.values, parts.moments.values)
    for name, value in (
        ("metric", model.metric.covariance),
        ("hub", model.hub),
        ("moment_hub", model.moment_hub),
        ("joints.weights", model.parts.joints),
    ):
        fine[name] = fine.get(name, True) and bool(value.isfinite().all())
    fine["windows"] = all(bool(value.isfinite().all()) for value in values)
    fine["evidence"] = not bool(model.evidence_out.isnan().any())
    if model.machine is not None:
        machine, pairs = model.machine, model.classes * (model.classes - 1) // 2
        fine["machine.counts"] = len(machine.counts) == model.classes and int(machine.counts.sum()) == len(machine.support)
        fine["machine.intercept"] = len(machine.intercept) == pairs and bool(machine.intercept.isfinite().all())
        fine["machine.dual"] = (
            bool(machine.dual.isfinite().all()) and model.support is not None and len(model.support) == len(machine.support)
        )
        fine["machine"] = model.machine.dual.shape == (model.classes - 1, len(model.machine.support))
    wrong = [name for name, good in fine.items() if not good]
    if wrong:
        raise ValueError(f"{', '.join(wrong)} do not fit the rest")


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
    if model.bodies is not None:
        named |= _windows("bodies", model.bodies.windows)
    return {name: value for name, value in named.items() if value is not None}


def _windows(name: str, windows: Windows) -> dict[str, Tensor]:
    return {f"{name}.values": windows.values, f"{name}.seen": windows.seen}


def _model(tensors: dict[str, Tensor], metadata: dict[str, Any], classes: int, layout: Layout | None) -> ShapeModel:
    view = metadata["view"]

    def windows(name: str) -> Windows:
        return Windows(tensors[f"{name}.values"], tensors[f"{name}.seen"])

    metric = JointMetric(tensors["metric"], float(tensors["metric_power"]))
    trained = "scales" in tensors
    rich = view == "same" or layout is not None
    kernels = Kernels(JointMetric(metric.covariance, KERNEL_WHITENING), rich, tensors["scales"]) if trained else None
    bodies = Bodies(windows("bodies"), layout) if layout is not None else None
    gain = metadata["parts"]
    parts = JointWeights(tensors["parts.joints"], tensors["parts.channels"], tensors.get("parts.by_class"), *gain)
    machine = PairwiseMachine(*(tensors[f"machine.{n}"] for n in ("support", "dual", "intercept", "counts"))) if trained else None
    exemplars = Exemplars(windows("crops"), windows("views"), windows("moments"), tensors["owner"], tensors["solid"])
    plain: dict[str, Any] = {name: None if name == "symmetry" and name not in tensors else tensors[name] for name in PLAIN}
    return ShapeModel(
        exemplars=exemplars,
        classes=classes,
        view=view,
        scorer=metadata["scorer"],
        metric=metric,
        kernels=kernels,
        support=windows("support") if trained else None,
        machine=machine,
        blend=Blend(**metadata["blend"]),
        bodies=bodies,
        parts=parts,
        **plain,
    )

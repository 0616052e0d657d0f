"""Model files: safetensors with JSON metadata.  Nothing in them can run."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import torch
from torch import Tensor

from indexing.checks import check_parameters
from indexing.modelfile import AGAIN, labels_from_json, labels_to_json, read_model, write_model
from indexing.shape.bank import NEAREST, Kernels, Windows
from indexing.shape.channels import CHANNELS, JointMetric
from indexing.shape.exemplars import Exemplars
from indexing.shape.machine import PairwiseMachine
from indexing.shape.model import KERNEL_WHITENING, ShapeModel
from indexing.skeleton import Skeleton

if TYPE_CHECKING:
    from indexing.indexer import ActionIndexer

FORMAT = "dyntorch.action-indexer"
VERSION = 1
PLAIN = ("labels", "symmetry", "mirrored", "weights", "hub", "moment_hub", "evidence_out")  # tensors as they are

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
        "skeleton": None if skeleton is None else [skeleton.name, list(skeleton.joints), [list(b) for b in skeleton.bones]],
    }
    write_model(path, FORMAT, VERSION, indexer.get_params(), about, _tensors(indexer.model_))


def load(kind: type[Indexer], path: str | Path, device: str = "cpu") -> Indexer:
    """Read a fitted indexer; see :meth:`indexing.ActionIndexer.load`."""
    metadata, tensors = read_model(path, FORMAT, VERSION)
    try:
        indexer = kind(**metadata["parameters"], device=device)
        indexer.classes_ = labels_from_json(metadata["classes"])
        indexer.n_joints_ = int(metadata["joints"])
        name, joints, bones = metadata["skeleton"] or (None, (), ())
        indexer.skeleton_ = Skeleton(name, tuple(joints), tuple((a, b) for a, b in bones)) if name is not None else None
        indexer.model_ = _model(tensors, len(indexer.classes_), metadata["view"], metadata["scorer"])
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
        "weights": len(model.weights) == len(NEAREST),
        "view": model.view == indexer.view,
        "scorer": model.scorer in ("nearest", "kernel", "both") and (model.machine is None) == (model.scorer == "nearest"),
    }
    for name, windows in (("crops", parts.crops), ("views", parts.views), ("moments", parts.moments)):
        fine[name] = len(windows.values) == len(windows.seen) and (name == "moments" or len(windows) % count == 0)
    fine |= {name: len(getattr(model, name)) == count for name in ("hub", "mirrored", "evidence_out")}
    values = (parts.crops.values, parts.views.values, parts.moments.values)
    for name, value in (
        ("metric", model.metric.covariance),
        ("hub", model.hub),
        ("moment_hub", model.moment_hub),
        ("weights", model.weights),
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
    named |= {"owner": exemplars.owner, "solid": exemplars.solid}
    named |= {**_windows("crops", exemplars.crops), **_windows("views", exemplars.views), **_windows("moments", exemplars.moments)}
    if model.kernels is not None and model.support is not None and model.machine is not None:
        machine = model.machine
        named |= {"scales": model.kernels.scales, **_windows("support", model.support), "machine.support": machine.support}
        named |= {"machine.dual": machine.dual, "machine.intercept": machine.intercept, "machine.counts": machine.counts}
    return {name: value for name, value in named.items() if value is not None}


def _windows(name: str, windows: Windows) -> dict[str, Tensor]:
    return {f"{name}.values": windows.values, f"{name}.seen": windows.seen}


def _model(tensors: dict[str, Tensor], classes: int, view: str, scorer: str) -> ShapeModel:
    def windows(name: str) -> Windows:
        return Windows(tensors[f"{name}.values"], tensors[f"{name}.seen"])

    metric = JointMetric(tensors["metric"], float(tensors["metric_power"]))
    trained = "scales" in tensors
    kernels = Kernels(JointMetric(metric.covariance, KERNEL_WHITENING), view == "same", tensors["scales"]) if trained else None
    machine = PairwiseMachine(*(tensors[f"machine.{n}"] for n in ("support", "dual", "intercept", "counts"))) if trained else None
    exemplars = Exemplars(windows("crops"), windows("views"), windows("moments"), tensors["owner"], tensors["solid"])
    plain: dict[str, Any] = {name: None if name == "symmetry" and name not in tensors else tensors[name] for name in PLAIN}
    return ShapeModel(
        exemplars=exemplars,
        classes=classes,
        view=view,
        scorer=scorer,
        metric=metric,
        kernels=kernels,
        support=windows("support") if trained else None,
        machine=machine,
        **plain,
    )

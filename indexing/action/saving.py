"""Model files of action indexers: safetensors with JSON metadata.  Nothing in them can run."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from indexing.action.bank import CHANNELS, NEAREST, JointMetric, Kernels
from indexing.action.joint_weights import MOST_WEIGHT, JointWeights
from indexing.action.model import Blend, ShapeModel
from indexing.action.options import ActionOptions
from indexing.estimator import read_options
from indexing.modelfile import (
    Parts,
    labels_from_json,
    labels_to_json,
    number,
    read_fields,
    read_model,
    skeleton_from_json,
    skeleton_to_json,
    tensors_of,
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
MOST = 10_000  # joints, or kinds of background; the largest layouts have some hundred
LEAST_SCALE = 1e-7  # of a kernel, over distances from 0 to 2

Indexer = TypeVar("Indexer", bound="ActionIndexer")


def save(indexer: ActionIndexer, path: str | Path) -> None:
    """Write a fitted indexer."""
    kernels = indexer.model_.kernels
    tensors = tensors_of(indexer.model_)
    if kernels is not None and kernels.scales is not None:
        tensors["scales"] = kernels.scales
    about = {
        "classes": labels_to_json(indexer.classes_),
        "hidden": indexer.model_.hidden,
        "joints": indexer.n_joints_,
        "view": indexer.model_.view,
        "scorer": indexer.model_.scorer,
        "blend": dataclasses.asdict(indexer.model_.blend),
        "parts": [indexer.model_.parts.gain, indexer.model_.parts.sigma],
        "groups": None if indexer.groups_ is None else indexer.groups_.tolist(),
        "skeleton": skeleton_to_json(indexer.skeleton_),
    }
    write_model(path, FORMAT, VERSION, indexer.saved_parameters(), about, tensors)


def load(kind: type[Indexer], path: str | Path, device: str = "cpu") -> Indexer:
    """Read a fitted indexer; see :meth:`indexing.ActionIndexer.load`."""
    header, parts = read_model(path, FORMAT, VERSION)
    with usable(path):
        parameters = _known(header)
        indexer = kind(
            **{**parameters, "tempi": tuple(parameters["tempi"])}, options=read_options(ActionOptions, header), device=device
        )
        indexer.check_parameters()
        indexer.classes_ = labels_from_json(header["classes"])
        indexer.n_joints_ = whole(header["joints"], "joints", 1, MOST)
        indexer.skeleton_ = skeleton_from_json(header["skeleton"], indexer.n_joints_)
        hidden = whole(header.get("hidden", 0), "hidden", 0, MOST)  # older files know no background
        indexer.model_ = _model(parts, header, _sizes(parts, indexer, hidden), hidden, indexer._options)
        indexer.groups_ = _groups(header["groups"], len(indexer.model_.labels))
        indexer._calibrate()
    return indexer


def _sizes(parts: Parts, indexer: ActionIndexer, hidden: int) -> dict[str, int]:
    """How many there are of what the tensors of a model are about."""
    classes, exemplars = len(indexer.classes_) + hidden, len(parts.truth("solid", None))
    if classes < 2 or exemplars < classes:
        raise ValueError(f"{exemplars} exemplars of {classes} classes")
    return {
        "classes": classes, "others": classes - 1, "pairs": classes * (classes - 1) // 2, "exemplars": exemplars,
        "crops": exemplars * (len(indexer._options.exemplars.crops) if indexer.search else 1), "length": int(indexer.length),
        "joints": indexer.n_joints_, "channels": len(CHANNELS), "nearest": len(NEAREST),
    }  # fmt: skip


def _known(header: dict[str, Any]) -> dict[str, Any]:
    """The parameters of a model file, of which older ones hold one more."""
    if header.get("layout") is not None:
        raise ValueError("layout: depth of 2D examples is no longer guessed")
    return {name: value for name, value in header["parameters"].items() if name not in ("depth", "options")}


def _groups(found: Any, exemplars: int) -> NDArray[Any] | None:
    if found is None:
        return None
    if len(found) != exemplars or not all(isinstance(name, str) for name in found):
        raise ValueError(f"groups: {len(found)} names for {exemplars} exemplars")
    return np.array(found, dtype=str)


def _model(parts: Parts, header: dict[str, Any], sizes: dict[str, int], hidden: int, options: ActionOptions) -> ShapeModel:
    view, scorer, trained = header["view"], header["scorer"], "scales" in parts
    if view != header["parameters"]["view"] or scorer not in SCORERS or trained != (scorer != "nearest"):
        raise ValueError(f"view, scorer: {shown(view)} and {shown(scorer)} do not fit the rest")
    found = read_fields(ShapeModel, parts, sizes)
    if sizes["views"] % sizes["exemplars"]:
        raise ValueError(f"views: {sizes['views']} windows of {sizes['exemplars']} exemplars")
    if not trained:
        found |= {"support": None, "machine": None}
    metric, kernels = dataclasses.replace(found.pop("metric"), floor=options.nearest.floor), None
    if trained:
        kernels = Kernels(JointMetric(metric.covariance, options.machine.whitening, floor=metric.floor), view == "same")
        kernels.scales = parts.real("scales", kernels.count, least=LEAST_SCALE)
        if int(found["machine"].counts.sum()) != sizes["rows"]:
            raise ValueError(f"machine.counts: {int(found['machine'].counts.sum())} support vectors, and {sizes['rows']} are there")
    blend = {name: number(value, name, 0, MOST_WEIGHT) for name, value in header["blend"].items()}
    weights = _joint_weights(found.pop("parts"), header["parts"])
    about = {"classes": sizes["classes"], "view": view, "scorer": scorer, "kernels": kernels, "blend": Blend(**blend)}
    return ShapeModel(**found, **about, metric=metric, parts=weights, options=options, hidden=hidden)


def _joint_weights(found: JointWeights, learned: Any) -> JointWeights:
    weights = found.joints if found.by_class is None else found.joints[:, None] * found.by_class
    if not bool((weights.sum(-1) > 0).all()) or not bool(found.channels.sum() > 0):
        raise ValueError("parts: no joint or no channel counts")
    gain, sigma = (number(value, "parts") for value in learned)
    return dataclasses.replace(found, gain=gain, sigma=sigma)

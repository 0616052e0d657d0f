"""Files of phase indexers."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
import torch
from torch import Tensor

from indexing.modelfile import AGAIN, labels_from_json, labels_to_json, read_model, write_model
from indexing.phase.checks import check_phase_parameters
from indexing.phase.course import Course
from indexing.phase.model import PhaseModel
from indexing.scoring import reject_threshold
from indexing.shape.bank import Windows
from indexing.skeleton import Skeleton

if TYPE_CHECKING:
    from indexing.phase.indexer import PhaseIndexer

FORMAT = "dyntorch.phase-indexer"
VERSION = 1

Indexer = TypeVar("Indexer", bound="PhaseIndexer")


def save(indexer: PhaseIndexer, path: str | Path) -> None:
    """Write a fitted indexer.

    Raises:
        ValueError: the file cannot be written, or the labels are neither text nor numbers.
    """
    skeleton, model = indexer.skeleton_, indexer.model_
    about = {
        "classes": labels_to_json(indexer.classes_),
        "joints": indexer.n_joints_,
        "mirrored": indexer.mirrored_.tolist(),
        "periodic": indexer.periodic_.tolist(),
        "skeleton": None if skeleton is None else [skeleton.name, list(skeleton.joints), [list(b) for b in skeleton.bones]],
    }
    tensors = {"bank.values": model.bank.values, "bank.seen": model.bank.seen, "label": model.label, "phase": model.phase}
    tensors["wrong"] = model.wrong
    for c, course in enumerate(model.courses):
        tensors |= {f"course.{c}.shapes": course.shapes, f"course.{c}.seen": course.seen}
    write_model(path, FORMAT, VERSION, indexer.get_params(), about, tensors)


def load(kind: type[Indexer], path: str | Path, device: str = "cpu") -> Indexer:
    """Read a fitted indexer; see :meth:`indexing.phase.indexer.PhaseIndexer.load`."""
    metadata, tensors = read_model(path, FORMAT, VERSION)
    try:
        indexer = kind(**metadata["parameters"], device=device)
        check_phase_parameters(indexer)
        _restore(indexer, metadata, tensors)
    except (KeyError, TypeError, IndexError, ValueError, RuntimeError, AttributeError) as error:
        raise ValueError(f"{path}: not a model that can be used ({type(error).__name__}: {error}); {AGAIN}") from None
    return indexer


def _restore(indexer: PhaseIndexer, metadata: dict[str, Any], tensors: dict[str, Tensor]) -> None:
    """The fitted attributes.

    Raises:
        ValueError: parts that do not belong together.
    """
    classes = labels_from_json(metadata["classes"])
    periodic = np.array(metadata["periodic"], dtype=bool)
    courses = tuple(
        Course(tensors[f"course.{c}.shapes"], bool(periodic[c]), tensors[f"course.{c}.seen"]) for c in range(len(classes))
    )
    bank = Windows(tensors["bank.values"], tensors["bank.seen"])
    label, phase, wrong, joints = tensors["label"], tensors["phase"], tensors["wrong"], int(metadata["joints"])
    fine = {
        "bank": bank.values.shape[1:] == (1, joints, 2) and bank.seen.shape == (len(bank), joints),
        "label": label.shape == (len(bank),) and int(label.min()) >= 0 and int(label.max()) < len(classes),
        "phase": phase.shape == (len(bank),),
        "course": all(c.shapes.ndim == 4 and c.shapes.shape[2:] == (joints, 3) and c.seen.shape == (joints,) for c in courses),
        "values": all(bool(t.isfinite().all()) for t in (bank.values, phase, wrong, *(c.shapes for c in courses))),
        "mirrored": len(metadata["mirrored"]) == len(periodic) == len(classes),
    }
    misfits = [part for part, good in fine.items() if not good]
    if misfits:
        raise ValueError(f"{', '.join(misfits)} do not fit the rest")
    name, joint_names, bones = metadata["skeleton"] or (None, (), ())
    indexer.skeleton_ = Skeleton(name, tuple(joint_names), tuple((a, b) for a, b in bones)) if name is not None else None
    indexer.model_ = PhaseModel(bank, label, phase.to(torch.float64), courses, wrong)
    indexer.classes_, indexer.periodic_, indexer.n_joints_ = classes, periodic, joints
    indexer.mirrored_ = np.array(metadata["mirrored"], dtype=bool)
    indexer.reject_threshold_ = reject_threshold(indexer.reject, wrong)

"""Files of phase indexers."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from indexing.action.bank import Windows
from indexing.estimator import read_options
from indexing.modelfile import (
    Parts,
    labels_from_json,
    labels_to_json,
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
from indexing.phase.frames import LEAST
from indexing.phase.model import Course, PhaseModel
from indexing.phase.options import PhaseOptions
from indexing.scoring import reject_threshold

if TYPE_CHECKING:
    from indexing.phase.indexer import PhaseIndexer

FORMAT = "dyntorch.phase-indexer"
VERSION = 1
JOINTS = 10_000  # at most; the largest layouts have some hundred

Indexer = TypeVar("Indexer", bound="PhaseIndexer")


def save(indexer: PhaseIndexer, path: str | Path) -> None:
    """Write a fitted indexer."""
    model = indexer.model_
    about = {
        "classes": labels_to_json(indexer.classes_),
        "joints": indexer.n_joints_,
        "mirrored": indexer.mirrored_.tolist(),
        "periodic": indexer.periodic_.tolist(),
        "skeleton": skeleton_to_json(indexer.skeleton_),
    }
    tensors = tensors_of(model)
    for c, course in enumerate(model.courses):
        tensors |= tensors_of(course, f"course.{c}.")
    write_model(path, FORMAT, VERSION, indexer.saved_parameters(), about, tensors)


def load(kind: type[Indexer], path: str | Path, device: str = "cpu") -> Indexer:
    """Read a fitted indexer; see :meth:`indexing.phase.indexer.PhaseIndexer.load`."""
    header, parts = read_model(path, FORMAT, VERSION)
    with usable(path):
        parameters = header["parameters"] | {"options": read_options(PhaseOptions, header)}
        indexer = kind(**parameters, device=device)
        indexer.check_parameters()
        _restore(indexer, header, parts)
    return indexer


def _restore(indexer: PhaseIndexer, header: dict[str, Any], parts: Parts) -> None:
    """The fitted attributes."""
    classes, joints = labels_from_json(header["classes"]), whole(header["joints"], "joints", LEAST, JOINTS)
    periodic, mirrored = (_flags(header[name], name, len(classes)) for name in ("periodic", "mirrored"))
    sizes = {"classes": len(classes), "joints": joints, "basis": 2 * indexer.harmonics + 1}
    courses = tuple(
        Course(**read_fields(Course, parts, sizes, f"course.{c}."), periodic=bool(periodic[c])) for c in range(len(classes))
    )
    courses = tuple(replace(course, shapes=course.shapes.double()) for course in courses)
    if not all(len(course.shapes) for course in courses):
        raise ValueError("course: an action without a shape")
    found = read_fields(PhaseModel, parts, sizes)
    found |= {"bank": Windows(found["bank"].values.double(), found["bank"].seen), "phase": found["phase"].double()}
    indexer.skeleton_ = skeleton_from_json(header["skeleton"], joints)
    indexer.model_ = PhaseModel(**found, courses=courses, options=indexer._options, camera=indexer.camera)
    indexer.classes_, indexer.periodic_, indexer.n_joints_, indexer.mirrored_ = classes, periodic, joints, mirrored
    indexer.reject_threshold_ = reject_threshold(indexer.reject, indexer.model_.wrong)


def _flags(found: Any, name: str, count: int) -> NDArray[np.bool_]:
    if not isinstance(found, list) or len(found) != count or not all(isinstance(value, bool) for value in found):
        raise ValueError(f"{name}: expected {count} truth values, got {shown(found)}")
    return np.array(found, dtype=bool)

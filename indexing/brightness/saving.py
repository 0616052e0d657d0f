"""Model files of the brightness indexer: safetensors with JSON metadata.  Nothing in them can run."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from indexing.brightness.library import Exemplars
from indexing.brightness.parameters import check_parameters
from indexing.brightness.sight import LENGTH
from indexing.checks import check_device
from indexing.modelfile import Parts, labels_from_json, labels_to_json, read_model, usable, write_model
from indexing.opening import shown

if TYPE_CHECKING:
    from indexing.brightness.indexer import BrightnessIndexer

KIND = "dyntorch.brightness-indexer"
VERSION = 1
FRAMES = 2**31  # of a video, at most
ROUNDING = 1e-3  # of a unit vector
PARTS = ("motion", "lengths", "labels")

Indexer = TypeVar("Indexer", bound="BrightnessIndexer")


def save(indexer: BrightnessIndexer, path: str | Path) -> None:
    """Write a fitted indexer.

    Raises:
        ValueError: the file cannot be written, or labels or parameters are neither text nor numbers.
    """
    tensors = {name: getattr(indexer.exemplars_, name) for name in PARTS}
    write_model(path, KIND, VERSION, indexer.get_params(), {"classes": labels_to_json(indexer.classes_)}, tensors)


def load(kind: type[Indexer], path: str | Path, device: str = "cpu") -> Indexer:
    """Read a fitted indexer; see :meth:`indexing.BrightnessIndexer.load`."""
    check_device(device)
    header, parts = read_model(path, KIND, VERSION)
    with usable(path):
        indexer = kind(**_known(header["parameters"]), device=device)
        check_parameters(indexer)
        classes = labels_from_json(header["classes"])
        return indexer._learn(_exemplars(parts, len(classes)), classes)


def _known(parameters: dict[str, Any]) -> dict[str, Any]:
    """The parameters of a model file, of which older ones hold one more.

    Raises:
        ValueError: it mixed window kernels into the scores, which is no longer done.
    """
    known = {name: value for name, value in parameters.items() if name != "temporal_weight"}
    weight = parameters.get("temporal_weight", 0.0)
    if weight != 0.0:
        raise ValueError(f"temporal_weight={shown(weight)}: window kernels are no longer mixed into scores")
    return known


def _exemplars(parts: Parts, classes: int) -> Exemplars:
    if classes < 2:
        raise ValueError(f"{classes} class")
    lengths = parts.whole("lengths", None, below=FRAMES)
    motion = parts.real("motion", int(lengths.sum()), LENGTH, least=-1 - ROUNDING, most=1 + ROUNDING)
    labels = parts.every("labels", len(lengths), below=classes)
    if not bool((lengths > 0).all()):
        raise ValueError("lengths: a video without frames")
    return Exemplars(motion.float(), lengths, labels)

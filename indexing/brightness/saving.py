"""Model files of the brightness indexer: safetensors with JSON metadata.  Nothing in them can run."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import torch
from torch import Tensor

from indexing.brightness.library import Exemplars
from indexing.brightness.parameters import check_parameters
from indexing.brightness.sight import HALF, LENGTH
from indexing.modelfile import AGAIN, labels_from_json, labels_to_json, read_model, write_model

if TYPE_CHECKING:
    from indexing.brightness.indexer import BrightnessIndexer

KIND = "dyntorch.brightness-indexer"
VERSION = 1
PARTS = ("motion", "kernels", "lengths", "labels")

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
    header, tensors = read_model(path, KIND, VERSION)
    try:
        indexer = kind(**header["parameters"], device=device)
        check_parameters(indexer)
        classes = labels_from_json(header["classes"])
        return indexer._learn(_exemplars(tensors, len(classes), indexer.temporal_weight > 0), classes)
    except (KeyError, TypeError, IndexError, ValueError, RuntimeError, AttributeError) as error:
        raise ValueError(f"{path}: not a model that can be used ({type(error).__name__}: {error}); {AGAIN}") from None


def _exemplars(tensors: dict[str, Tensor], classes: int, kernels: bool) -> Exemplars:
    found = Exemplars(*(tensors[name] for name in PARTS))
    total, flat = int(found.lengths.sum()), (2 * HALF + 1) ** 2 if kernels else 0
    fine = {
        "motion": found.motion.shape == (total, LENGTH) and bool(found.motion.isfinite().all()),
        "kernels": found.kernels.shape == (total, flat) and bool(found.kernels.isfinite().all()),
        "lengths": bool((found.lengths > 0).all()),
        "labels": len(found.labels) == len(found.lengths) and torch.equal(found.labels.unique(), torch.arange(classes)),
    }
    wrong = [name for name, good in fine.items() if not good]
    if wrong:
        raise ValueError(f"{', '.join(wrong)} do not fit the rest")
    return found

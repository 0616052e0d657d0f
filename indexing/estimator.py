"""What all indexers share as estimators: one thread, their accuracy, and their model files."""

from __future__ import annotations

from collections.abc import Iterable
from importlib import import_module
from pathlib import Path
from typing import Any, ClassVar, Self, cast

import numpy as np
from numpy.typing import ArrayLike
from sklearn.base import BaseEstimator, ClassifierMixin
from sklearn.utils.validation import check_is_fitted

from indexing.action.inputs import check_labels


class SavedClassifier(ClassifierMixin, BaseEstimator):  # type: ignore[misc]
    """A classifier of recordings that can be written to a file.

    A subclass names the attribute that fitting sets, and the module whose ``save(indexer, path)`` and ``load(kind, path, device)``
    know its parts; that is imported when a file is written or read.
    """

    FITTED: ClassVar[str]
    FILES: ClassVar[str]

    def score(self, clips: Iterable[Any], labels: ArrayLike, sample_weight: ArrayLike | None = None) -> float:
        """Mean accuracy of ``predict``; labels that were never learned count as wrong."""
        answers = self.predict(clips)
        truth = check_labels(labels, len(answers))
        right = np.asarray([a == b for a, b in zip(answers.tolist(), truth.tolist(), strict=True)], dtype=float)
        return float(np.average(right, weights=None if sample_weight is None else np.asarray(sample_weight)))

    def save(self, path: str | Path) -> None:
        """Write a ``.safetensors`` file with JSON metadata; atomically, and without pickle."""
        check_is_fitted(self, self.FITTED)
        import_module(self.FILES).save(self, path)

    @classmethod
    def load(cls, path: str | Path, device: str = "cpu") -> Self:
        """Read what :meth:`save` wrote, for computing on ``device`` (the file does not say where).

        Raises:
            ValueError: the file is missing, or is not such a model.
        """
        return cast("Self", import_module(cls.FILES).load(cls, path, device))

    def __sklearn_is_fitted__(self) -> bool:
        return hasattr(self, self.FITTED)

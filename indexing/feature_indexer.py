"""The kernel machine of the action indexer for features that are there already: one vector per clip, as a 2D table."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Self

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from sklearn.base import BaseEstimator, ClassifierMixin
from sklearn.utils.multiclass import check_classification_targets
from sklearn.utils.validation import check_is_fitted, validate_data

from dyntorch import one_thread
from indexing.modelfile import labels_from_json, labels_to_json, number, read_model, usable, write_model
from indexing.scoring import probabilities
from indexing.shape.bank import KERNEL_WIDTH, cosine_distance, kernel_scale
from indexing.shape.machine import PairwiseMachine, read_machine

Array = NDArray[Any]
KIND, VERSION = "dyntorch.feature-indexer", 1
LONGEST = 1e150  # of a feature: its square is a number
LEAST_SCALE = 1e-12  # of a kernel
PARTS = ("support", "dual", "intercept", "counts")  # of the machine, as tensors


class FeatureIndexer(ClassifierMixin, BaseEstimator):  # type: ignore[misc]
    r"""Recognize actions from one feature vector per clip: from a network, from a histogram, from anything.

    The second stage of :class:`~indexing.ActionIndexer`: support vector machines, one for every two classes, that vote; over
    the kernel :math:`\exp(-(1 - \cos(x, e)) / s)`, with s half the median distance between training vectors.  It compares
    directions: neither the length of a vector nor the unit of the features matters, so centre features that have an origin
    of their own.

    Args:
        width: of the kernel, in median distances of the training vectors.

    Attributes:
        classes_: ``(classes,)`` labels as given.  machine_: the learned :class:`~indexing.shape.machine.PairwiseMachine`.
        support_: ``(S, features)`` the vectors it stands on.  scale_: s.  n_features_in_: features per clip.

    Example:
        >>> features = np.array([[3.0, 0.1], [2.0, -0.1], [0.1, 2.5], [-0.2, 3.0]])
        >>> indexer = FeatureIndexer().fit(features, ["walk", "walk", "wave", "wave"])
        >>> indexer.predict([[9.0, 1.0], [0.3, 0.9]]).tolist()
        ['walk', 'wave']

    Source: Cortes and Vapnik 1995 (support vector machines), voting one against one.
    """

    def __init__(self, width: float = KERNEL_WIDTH) -> None:
        self.width = width

    @one_thread
    def fit(self, X: ArrayLike, y: ArrayLike) -> Self:
        """Learn from a ``(clips, features)`` table and ``(clips,)`` labels.

        Raises:
            ValueError: the table is no table of finite numbers, the labels are no classes, or only one class.
        """
        table, labels = validate_data(self, X, y, dtype=np.float64)
        check_classification_targets(labels)
        classes, numbers = np.unique(labels, return_inverse=True)
        if len(classes) < 2:
            raise ValueError(f"labels: only one class ({classes[0]!r}); give clips of at least two actions")
        self._check_width()
        vectors = torch.tensor(table)
        distances = cosine_distance(vectors, vectors)
        self.classes_ = classes
        self.scale_ = float(kernel_scale(distances, self.width))
        self.machine_ = PairwiseMachine.fit((-distances / self.scale_).exp(), numbers)
        self.support_ = table[self.machine_.support.numpy()]
        return self

    def _check_width(self) -> None:
        if not (isinstance(self.width, (int, float, np.number)) and 0 < self.width < np.inf):
            raise ValueError(f"width must be a positive number, got {self.width!r}")

    def _votes(self, X: ArrayLike) -> Array:
        check_is_fitted(self)
        table = validate_data(self, X, dtype=np.float64, reset=False)
        distances = cosine_distance(torch.tensor(table), torch.from_numpy(self.support_))
        return np.asarray(self.machine_((-distances / self.scale_).exp()).numpy())

    @one_thread
    def decision_function(self, X: ArrayLike) -> Array:
        """``(clips, classes)`` votes, larger is better; as in scikit-learn ``(clips,)`` for two classes, positive = the second."""
        votes = self._votes(X)
        return votes[:, 1] - votes[:, 0] if len(self.classes_) == 2 else votes

    @one_thread
    def predict_proba(self, X: ArrayLike) -> Array:
        """``(clips, classes)`` probabilities, rows sum to 1."""
        return probabilities(self._votes(X))

    @one_thread
    def predict(self, X: ArrayLike) -> Array:
        """``(clips,)`` labels."""
        best = self._votes(X).argmax(axis=1)
        return np.asarray(self.classes_[best])

    def save(self, path: str | Path) -> None:
        """Write a ``.safetensors`` file with JSON metadata; atomically, and without pickle.

        Raises:
            ValueError: the file cannot be written, or a label or parameter is neither text nor number.
        """
        check_is_fitted(self)
        tensors = {name: getattr(self.machine_, name) for name in PARTS} | {"vectors": torch.from_numpy(self.support_)}
        about = {"classes": labels_to_json(self.classes_), "scale": self.scale_}
        write_model(path, KIND, VERSION, self.get_params(), about, tensors)

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read what :meth:`save` wrote.

        Raises:
            ValueError: the file is missing, or is not such a model.
        """
        header, parts = read_model(path, KIND, VERSION)
        with usable(path):
            indexer = cls(**header["parameters"])
            indexer._check_width()
            indexer.classes_, indexer.scale_ = labels_from_json(header["classes"]), number(header["scale"], "scale", LEAST_SCALE)
            vectors = parts.real("vectors", None, None, least=-LONGEST, most=LONGEST)
            indexer.machine_ = read_machine(parts, len(indexer.classes_), len(vectors))
            indexer.support_ = vectors.double().numpy()
            indexer.n_features_in_ = int(indexer.support_.shape[1])
            if len(indexer.classes_) < 2 or not indexer.support_.size:
                raise ValueError(f"{len(indexer.classes_)} classes, {indexer.n_features_in_} features")
        return indexer

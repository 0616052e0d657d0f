"""What all indexers share as estimators: the check of their parameters, their accuracy, and their model files."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, ClassVar, Self, TypeVar, cast, get_type_hints

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from sklearn.base import BaseEstimator, ClassifierMixin
from sklearn.utils.validation import check_is_fitted
from torch import Tensor

from indexing.action.inputs import check_labels
from indexing.clip import is_number
from indexing.modelfile import Parts, read_model, usable, write_model
from indexing.opening import quote
from indexing.scoring import SHARPNESS, probabilities, refuse

Options = TypeVar("Options")


@dataclass(frozen=True)
class Rule:
    """What a parameter may be."""

    accepts: Callable[[Any], bool]
    wanted: str
    """Follows "must be" in the message."""


def is_positive(value: Any) -> bool:
    """Whether a value is a number above zero."""
    return is_number(value) and bool(value > 0)


def is_whole(value: Any) -> bool:
    """Whether a value is a whole number, and not a truth value."""
    return isinstance(value, (int, np.integer)) and not isinstance(value, bool)


def one_of(*accepted: Any) -> Rule:
    """A rule for a choice."""
    return Rule(
        lambda value: isinstance(value, (str, int, np.bool_)) and value in accepted, f"one of {', '.join(map(repr, accepted))}"
    )


def _seeds(value: Any) -> bool:
    try:
        np.random.default_rng(value)
    except (TypeError, ValueError):
        return False
    return True


POSITIVE = Rule(is_positive, "a positive number")
SECONDS = Rule(lambda value: is_number(value) and value >= 0, "seconds, 0 or more")
REJECT = Rule(lambda value: value is None or is_number(value), "None, a rate between 0 and 1 or a threshold")
RANDOM_STATE = Rule(_seeds, "None, a whole number from 0, or a generator")


def check_device(device: str) -> None:
    """Raise where there is no such device."""
    try:
        torch.empty(0, device=device)
    except (RuntimeError, AssertionError, TypeError) as error:
        raise ValueError(f"device {device!r} is not there: {str(error).splitlines()[0]}; use device='cpu'") from None


def read_options(kind: type[Options], header: Mapping[str, Any]) -> Options | None:
    """The options of a model file: ``None`` where all of them were the defaults, as in files that know none."""
    changed = header["parameters"].get("options")
    if changed is None:
        return None
    if not isinstance(changed, dict):
        raise ValueError(f"options: expected fields with their values, got {quote(changed)}")
    hints, usual = get_type_hints(kind), kind()
    for name, value in changed.items():
        if name not in hints:
            raise ValueError(f"options: there is no {quote(name)}")
        if not (is_whole(value) if hints[name] is int else is_number(value)):
            raise ValueError(f"options.{name}: expected a value like {getattr(usual, name)!r}, got {quote(value)}")
    return replace(cast("Any", usual), **changed)


class SavedClassifier(ClassifierMixin, BaseEstimator):  # type: ignore[misc]
    """A classifier of recordings that can be written to a file; subclasses say what of it is stored, and how it is read back."""

    FITTED: ClassVar[str]
    FORMAT: ClassVar[str]
    VERSION: ClassVar[int]
    OPTIONS: ClassVar[type]
    RULES: ClassVar[Mapping[str, Rule]]

    def check_parameters(self) -> None:
        """Raise on parameters that make no sense, naming the parameter and what it accepts."""
        for name, rule in self.RULES.items():
            if not rule.accepts(getattr(self, name)):
                raise ValueError(f"{name} must be {rule.wanted}, got {quote(getattr(self, name))}")
        check_device(self.device)

    def saved_parameters(self) -> dict[str, Any]:
        """The parameters as a model file holds them: options only where they are not the defaults."""
        parameters: dict[str, Any] = self.get_params()
        options = parameters.pop("options", None)
        each = {} if options is None else {one.name: (getattr(options, one.name), one.default) for one in fields(options)}
        changed = {name: value for name, (value, default) in each.items() if value != default}
        return parameters | ({"options": changed} if changed else {})

    def score(self, clips: Iterable[Any], labels: ArrayLike, sample_weight: ArrayLike | None = None) -> float:
        """Mean accuracy of ``predict``; labels that were never learned count as wrong."""
        answers = self.predict(clips)
        truth = check_labels(labels, len(answers))
        right = np.asarray([a == b for a, b in zip(answers.tolist(), truth.tolist(), strict=True)], dtype=float)
        return float(np.average(right, weights=None if sample_weight is None else np.asarray(sample_weight)))

    def save(self, path: str | Path) -> None:
        """Write a ``.safetensors`` file with JSON metadata; atomically, and without pickle."""
        check_is_fitted(self, self.FITTED)
        about, tensors = self._export_state()
        write_model(Path(path), self.FORMAT, self.VERSION, self.saved_parameters(), about, tensors)

    @classmethod
    def load(cls, path: str | Path, device: str = "cpu") -> Self:
        """Read what :meth:`save` wrote, for computing on ``device`` (the file does not say where)."""
        check_device(device)
        header, parts = read_model(Path(path), cls.FORMAT, cls.VERSION)
        with usable(path):
            parameters = cls._stored_parameters(header)
            indexer = cls(**{**parameters, "options": read_options(cls.OPTIONS, header), "device": device})
            indexer.check_parameters()
            indexer._restore(header, parts)
        return indexer

    @classmethod
    def _stored_parameters(cls, header: Mapping[str, Any]) -> dict[str, Any]:
        """The parameters of a model file, without those of older versions."""
        return dict(header["parameters"])

    def _export_state(self) -> tuple[dict[str, Any], dict[str, Tensor]]:
        """What the header of the file says of a fitted indexer besides its parameters, and its tensors."""
        raise NotImplementedError

    def _restore(self, header: Mapping[str, Any], parts: Parts) -> None:
        """Set the fitted attributes from a file."""
        raise NotImplementedError

    def __sklearn_is_fitted__(self) -> bool:
        return hasattr(self, self.FITTED)

    @property
    def _options(self) -> Any:
        """Those in force."""
        return self.OPTIONS() if self.options is None else self.options


class ScoreClassifier(SavedClassifier):
    """A classifier whose answers stand on its scores alone, ``decision_function``."""

    def evidence(self, clips: Iterable[Any]) -> NDArray[Any]:
        """``(clips,)`` score of the best class: how much nearer a recording is to one action than to the others."""
        return np.asarray(self.decision_function(clips).max(axis=1))

    def predict_proba(self, clips: Iterable[Any]) -> NDArray[Any]:
        """``(clips, classes)`` probabilities of the known classes, rows sum to 1 (a softmax of the standardized scores)."""
        return probabilities(self.decision_function(clips), SHARPNESS)

    def predict(self, clips: Iterable[Any]) -> NDArray[Any]:
        """``(clips,)`` labels; ``none_label`` where ``reject`` is set and no class explains the recording."""
        scores = self.decision_function(clips)
        labels = self.classes_[scores.argmax(axis=1)]
        if self.reject_threshold_ is None:
            return np.asarray(labels)
        return refuse(labels, scores.max(axis=1) < self.reject_threshold_, self.none_label)

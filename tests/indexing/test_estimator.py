"""What every indexer promises; ``CASES`` are the indexers.

scikit-learn's own battery feeds tables of floats; an estimator of lists of clips of different lengths can be tagged so that every
check is skipped, which proves nothing.  What those checks are for is tested here instead, on what the indexers are made for.
"""

from __future__ import annotations

import pydoc
from collections.abc import Callable
from copy import deepcopy
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import pytest
import torch
from sklearn.base import clone, is_classifier
from sklearn.exceptions import NotFittedError
from sklearn.model_selection import GridSearchCV, LeaveOneGroupOut

from indexing import ActionIndexer
from indexing.actors import Person, dataset, detect, stream
from indexing.brightness.indexer import BrightnessIndexer
from indexing.phase.indexer import PhaseIndexer
from tests.battery.pretend_device import accelerators

FEW = ("kick", "squat", "wave")
VERBS = ("predict", "decision_function", "predict_proba", "evidence")


@dataclass(frozen=True)
class Lesson:
    """What is learned and what is asked: items in a list, labels, who shows them, and a recording."""

    items: list[Any]
    labels: np.ndarray
    groups: np.ndarray
    asked: list[Any]
    truth: np.ndarray
    recording: Any


@cache
def keypoints() -> Lesson:
    """Three actions by two people in one view, and by another from a little further round."""
    train = dataset([Person.random(seed) for seed in (20, 21)], FEW, azimuth=0.0, rng=1, fps=12.0)
    test = dataset([Person.random(24)], FEW, azimuth=15.0, rng=2, fps=12.0)
    recording = detect(stream(FEW[:2], Person.random(24), rng=3, fps=12.0)[0], azimuth=30.0, rng=4)
    return Lesson(list(train), train.labels, train.column("subject"), list(test), test.labels, recording)


@cache
def videos() -> Lesson:
    """A bright blob that moves along, across, or to and fro."""

    def film(kind: str, seed: int) -> np.ndarray:
        rng = np.random.default_rng(seed)
        t = np.linspace(0.0, 1.0, 18)
        travel = {"kick": 30 * t - 15, "squat": 0 * t, "wave": 12 * np.sin(4 * np.pi * t)}[kind], 24 * (kind == "squat") * (t - 0.5)
        rows, columns = np.mgrid[:48, :64]
        blob = [np.exp(-((columns - 32 - x) ** 2 + (rows - 24 - y) ** 2) / 20.0) for x, y in zip(*travel, strict=True)]
        return np.clip(40 + 180 * np.array(blob) + rng.normal(scale=2.0, size=(18, 48, 64)), 0, 255).astype(np.uint8)

    train = [film(kind, 10 * subject + i) for subject in range(2) for i, kind in enumerate(FEW)]
    test = [film(kind, 90 + i) for i, kind in enumerate(FEW)]
    return Lesson(train, np.array(FEW * 2), np.arange(6) // 3, test, np.array(FEW), np.concatenate(test))


@dataclass(frozen=True, eq=False)
class Case:
    """An indexer, the lesson it is made for, and values of one parameter to choose from (none where another case of the same class
    stands for it).

    apart: how far scores may be when the same is computed in another order; draws: whether anything is drawn at random; alone:
    whether one class is enough.
    """

    name: str
    kind: type
    lesson: Callable[[], Lesson]
    options: dict[str, Any] = field(default_factory=dict)
    grid: dict[str, list[Any]] = field(default_factory=dict)
    apart: float = 1e-9
    draws: bool = False
    alone: bool = False

    def make(self, **options: Any) -> Any:
        """A new one, unfitted."""
        return self.kind(**{**self.options, **options})


SMALL = {"length": 8, "search": False, "virtual_views": 1, "tempi": (1.0,)}
CASES = [
    Case("keypoints", ActionIndexer, keypoints, {"length": 8}, {"scorer": ["nearest", "both"]}, 1e-3, True, True),
    *(
        Case(name, ActionIndexer, keypoints, {**SMALL, **options}, {}, 1e-3, options.get("scorer") != "nearest", True)
        for name, options in (
            ("nearest, learned weights", {"scorer": "nearest", "weights": "learned"}),
            ("kernel, refusing", {"scorer": "kernel", "reject": 0.05, "none_label": "none", "repair": True}),
            ("same view", {"view": "same"}),
        )
    ),
    Case("frames", PhaseIndexer, keypoints, {"harmonics": 1}, {"mirror": ["auto", False]}, alone=True),
    Case("videos", BrightnessIndexer, videos, {"size": 40}, {"window": [0.3, 0.5]}, 1e-5),
]

EACH = pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
ONE = pytest.mark.parametrize("case", [case for case in CASES if case.grid], ids=lambda case: case.name)
"""One case of each class."""


@cache
def fitted(case: Case, count: int = len(FEW)) -> Any:
    """Fitted to the lesson, or to the last classes of it; shared, so look but do not touch."""
    lesson = case.lesson()
    kept = np.flatnonzero(np.isin(lesson.labels, FEW[-count:]))
    return case.make().fit(picked(lesson.items, kept), lesson.labels[kept])


def answers(case: Case, indexer: Any) -> dict[str, Any]:
    """Everything that a fitted indexer says about the lesson's queries."""
    return {verb: getattr(indexer, verb)(case.lesson().asked) for verb in VERBS if hasattr(indexer, verb)}


def finds(case: Case, indexer: Any) -> dict[str, Any]:
    """What it says about the recording."""
    recording, verbs = case.lesson().recording, [verb for verb in ("score_frames", "find") if hasattr(indexer, verb)]
    return {verb: getattr(indexer, verb)(recording) for verb in verbs}


@cache
def answered(case: Case) -> dict[str, Any]:
    """What the shared one says, asked once."""
    return answers(case, fitted(case)) | finds(case, fitted(case))


def same(one: dict[str, Any], other: dict[str, Any]) -> None:
    assert one.keys() == other.keys()
    for verb in one:
        np.testing.assert_array_equal(np.asarray(one[verb], dtype=object), np.asarray(other[verb], dtype=object), err_msg=verb)


def picked(items: list[Any], index: Any) -> list[Any]:
    return [items[i] for i in index]


def first_of_each(lesson: Lesson) -> list[int]:
    return [int(np.flatnonzero(lesson.labels == label)[0]) for label in FEW]


# ---- parameters --------------------------------------------------------------------------------------------------------
@ONE
def test_parameters_go_in_and_come_out(case: Case) -> None:
    made = case.make()
    assert made.get_params().items() >= case.options.items()
    twin = clone(made)
    assert twin is not made and twin.get_params() == made.get_params()
    other = {name: value for name, (*_, value) in case.grid.items()}
    assert made.set_params(**other) is made and made.get_params() == {**twin.get_params(), **other}
    assert is_classifier(made)
    with pytest.raises(ValueError, match="Invalid parameter 'veiw'"):
        made.set_params(veiw="any")
    odd = {name: object() for name in made.get_params()}
    assert vars(case.kind(**odd)) == odd  # nothing is done before fit


def test_unknown_values_are_refused_by_name() -> None:
    lesson, wrong = keypoints(), {"harmonics": 0, "course": "often", "reject": "often", "fps": 0.0, "mirror": "maybe"}
    for name, value in {**wrong, "window": -1.0, "device": "abacus"}.items():
        with pytest.raises(ValueError, match=name):
            PhaseIndexer(**{name: value}).fit(lesson.items, lesson.labels)


@ONE
def test_an_unfitted_one_says_so(case: Case, tmp_path: Path) -> None:
    lesson, bare = case.lesson(), clone(fitted(case))
    verbs = [verb for verb in (*VERBS, "score_frames", "find", "scan", "exemplar") if hasattr(bare, verb)]
    for verb in verbs:
        with pytest.raises(NotFittedError):
            getattr(bare, verb)(lesson.asked)
    with pytest.raises(NotFittedError):
        bare.save(tmp_path / "m.safetensors")
    assert list(tmp_path.iterdir()) == []


# ---- fit ---------------------------------------------------------------------------------------------------------------
@ONE
def test_fit_returns_itself_adds_names_that_end_in_an_underscore_and_forgets(case: Case) -> None:
    lesson, made = case.lesson(), deepcopy(fitted(case, 2))
    assert made.classes_.tolist() == list(FEW[1:])
    assert made.fit(lesson.items, lesson.labels) is made
    added = set(vars(made)) - set(vars(case.make()))
    assert "classes_" in added
    assert all(name.endswith("_") or name.startswith("_") for name in added), added
    assert made.get_params() == case.make().get_params()
    again = answers(case, made)
    same(again, {verb: answered(case)[verb] for verb in again})  # the same random_state, the same answers


@ONE
def test_what_is_handed_in_stays_and_labels_keep_their_type(case: Case) -> None:
    lesson = case.lesson()
    few = first_of_each(lesson)
    given, asked, labels = deepcopy(picked(lesson.items, few)), deepcopy(lesson.asked), lesson.labels[few]
    case.make().fit(given, labels).predict(asked)
    np.testing.assert_array_equal(labels, lesson.labels[few])
    for mine, theirs in ((given, picked(lesson.items, few)), (asked, lesson.asked)):
        for one, other in zip(mine, theirs, strict=True):
            np.testing.assert_array_equal(getattr(one, "joints", one), getattr(other, "joints", other))
    few = picked(lesson.items, first_of_each(lesson))
    options = {"reject": None} if "reject" in case.options else {}
    for labels in ([7, -2, 3], np.array(FEW, dtype=object)):
        indexer = case.make(**options).fit(few, labels)
        said, kind = indexer.predict(few), np.asarray(labels).dtype
        assert indexer.classes_.dtype == said.dtype == kind
        assert said.tolist() == np.asarray(labels).tolist()
        assert kind.kind != "i" or indexer.score(few, said.astype(float)) == 1.0
        assert indexer.classes_.tolist() == sorted(said.tolist())


@EACH
def test_answers_agree_with_one_another_in_any_order_of_examples(case: Case) -> None:
    lesson = case.lesson()
    order = np.random.default_rng(0).permutation(len(lesson.labels))
    turned = case.make().fit(picked(lesson.items, order), lesson.labels[order])
    assert turned.classes_.tolist() == fitted(case).classes_.tolist()
    if case.draws:  # virtual views are drawn in order: other views, the same answers
        assert turned.predict(lesson.items).tolist() == fitted(case).predict(lesson.items).tolist()
    else:
        close = {"rtol": 0, "atol": max(case.apart, 1e-5)}
        np.testing.assert_allclose(turned.decision_function(lesson.asked), fitted(case).decision_function(lesson.asked), **close)
    for count in (2, 3):
        indexer = fitted(case, count)
        asked = lesson.asked
        scores, chances, said = indexer.decision_function(asked), indexer.predict_proba(asked), indexer.predict(asked)
        assert scores.shape == chances.shape == (len(lesson.truth), count)
        assert np.isfinite(scores).all() and (chances >= 0).all()
        np.testing.assert_allclose(chances.sum(axis=1), 1.0, rtol=1e-6)
        np.testing.assert_array_equal(chances.argmax(axis=1), scores.argmax(axis=1))
        accepted = [i for i, label in enumerate(said) if label in FEW]
        np.testing.assert_array_equal(said[accepted], indexer.classes_[scores.argmax(axis=1)][accepted])
        if not getattr(indexer, "reject", None):
            assert len(accepted) == len(said)


@pytest.mark.slow
@EACH
def test_one_example_of_each_class_is_enough(case: Case) -> None:
    lesson = case.lesson()
    few = picked(lesson.items, first_of_each(lesson))
    options = {"reject": None} if "reject" in case.options else {}
    indexer = case.make(**options).fit(few, FEW)
    assert indexer.predict(few).tolist() == list(FEW)
    alone = np.flatnonzero(lesson.labels == FEW[0])
    only = picked(lesson.items, alone), lesson.labels[alone]
    if case.alone:
        indexer = case.make(**options).fit(*only)
        said = indexer.predict(few).tolist()
        assert said[0] == FEW[0] and set(said) <= {FEW[0], getattr(indexer, "none_label", FEW[0])}
    else:
        with pytest.raises(ValueError, match=r"labels: only one class .*'kick'"):
            case.make().fit(*only)


# ---- answers -----------------------------------------------------------------------------------------------------------


@EACH
def test_a_batch_is_its_loop(case: Case) -> None:
    lesson, indexer = case.lesson(), fitted(case)
    alone = np.concatenate([indexer.decision_function(picked(lesson.asked, [i])) for i in range(len(lesson.truth))])
    np.testing.assert_allclose(indexer.decision_function(lesson.asked), alone, rtol=0, atol=case.apart)
    assert indexer.predict(iter(lesson.asked)).tolist() == indexer.predict(lesson.asked).tolist()


@ONE
def test_score_is_the_mean_accuracy(case: Case) -> None:
    lesson, indexer = case.lesson(), fitted(case)
    right = indexer.predict(lesson.asked) == lesson.truth
    assert indexer.score(lesson.asked, lesson.truth) == pytest.approx(right.mean())
    weights = np.arange(len(right)) + 1.0
    assert indexer.score(lesson.asked, lesson.truth, weights) == pytest.approx(np.average(right, weights=weights))
    assert indexer.score(lesson.asked, ["never learned"] * len(right)) == 0.0
    assert right.mean() > 0.6


@EACH
def test_what_is_loaded_answers_the_same(case: Case, tmp_path: Path) -> None:
    indexer = fitted(case)
    indexer.save(tmp_path / "m.safetensors")
    loaded = case.kind.load(tmp_path / "m.safetensors")
    same(answers(case, loaded) | finds(case, loaded), answered(case))
    for name, value in indexer.get_params().items():
        np.testing.assert_array_equal(getattr(loaded, name), value)
    loaded.save(tmp_path / "again.safetensors")
    assert (tmp_path / "again.safetensors").read_bytes() == (tmp_path / "m.safetensors").read_bytes()


TAUGHT_BY: dict[type, tuple[str, Callable[..., torch.Tensor]]] = {
    ActionIndexer: ("indexing.action.indexer.learn", lambda exemplars, labels, *_: exemplars.crops.values),
    PhaseIndexer: ("indexing.phase.learning.learn_course", lambda frames, *_: frames),
    BrightnessIndexer: ("indexing.brightness.indexer.build_library", lambda exemplars, *_: exemplars.motion),
}
"""What does the work of ``fit``, and a tensor that it is given."""


@pytest.mark.slow
@EACH
def test_an_accelerator_answers_the_same(case: Case) -> None:
    lesson, (teacher, given) = case.lesson(), TAUGHT_BY[case.kind]
    for device in accelerators():
        with mock.patch(teacher, wraps=pydoc.locate(teacher)) as learning:
            there = case.make(device=device).fit(lesson.items, lesson.labels)
        # where the work is done; what was learned is handled on the CPU
        assert {given(*call.args).device.type for call in learning.call_args_list} == {device}
        np.testing.assert_allclose(there.decision_function(lesson.asked), fitted(case).decision_function(lesson.asked), atol=0.01)
        assert there.predict(lesson.asked).tolist() == fitted(case).predict(lesson.asked).tolist()


# ---- model selection ---------------------------------------------------------------------------------------------------
@ONE
def test_cross_validation_chooses_among_lists_of_clips(case: Case) -> None:
    lesson = case.lesson()
    splits = list(LeaveOneGroupOut().split(lesson.items, lesson.labels, lesson.groups))
    search = GridSearchCV(case.make(), case.grid, cv=splits[:1], error_score="raise").fit(lesson.items, lesson.labels)
    assert set(search.best_params_) == set(case.grid) and search.classes_.tolist() == list(FEW) and search.best_score_ > 0.5
    assert search.score(lesson.asked, lesson.truth) > 0.6

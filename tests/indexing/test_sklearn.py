"""scikit-learn's conventions.

``sklearn.utils.estimator_checks`` does not apply: it feeds 2D tables of floats, and an estimator of lists of clips of different
lengths can be tagged so that every check is skipped, which proves nothing.  What those checks are for is tested here instead:
clone, get_params and set_params, no logic in ``__init__``, fit returns self, fitting twice, refusing before fit, and the
model-selection tools on lists of clips.
"""

import numpy as np
import pytest
from sklearn.base import clone, is_classifier
from sklearn.exceptions import NotFittedError
from sklearn.metrics import accuracy_score
from sklearn.model_selection import GridSearchCV, LeaveOneGroupOut, cross_val_predict, cross_val_score

from indexing import ActionIndexer
from indexing.actors import Person, dataset

FEW = ("squat", "wave", "kick", "bow")


@pytest.fixture(scope="module")
def few():
    """Four actions by three people in one view, and by two others from elsewhere."""
    people = [Person.random(seed) for seed in range(20, 25)]
    return dataset(people[:3], FEW, azimuth=0.0, rng=1), dataset(people[3:], FEW, azimuth=(70.0,), rng=2)


def test_parameters():
    made = ActionIndexer(view="same", reject=0.2, none_label="none", tempi=[1.0])
    assert set(made.get_params()) >= {"view", "weights", "reject", "none_label", "fps", "random_state", "device"}
    twin = clone(made)
    assert twin is not made and twin.get_params() == made.get_params()
    assert made.set_params(view="any", length=16) is made and (made.view, made.length) == ("any", 16)
    assert is_classifier(made)
    odd = object()
    assert ActionIndexer(view=odd).view is odd  # nothing is checked or changed before fit
    with pytest.raises(ValueError, match="Invalid parameter 'veiw'"):
        made.set_params(veiw="any")


def test_clone_of_a_fitted_one_is_unfitted_and_fit_returns_self(few):
    train, _ = few
    indexer = ActionIndexer()
    assert indexer.fit(train) is indexer
    for verb in (lambda m: m.predict(train), lambda m: m.find(train[0]), lambda m: m.save("x"), lambda m: m.exemplar(0)):
        with pytest.raises(NotFittedError):
            verb(clone(indexer))


@pytest.mark.parametrize("options", [{}, {"view": "same"}, {"weights": "learned"}])
def test_fitting_twice_gives_the_same(few, options):
    train, test = few
    indexer = ActionIndexer(**options)
    first = indexer.fit(train).decision_function(test)
    np.testing.assert_array_equal(indexer.fit(train).decision_function(test), first)
    np.testing.assert_array_equal(clone(indexer).fit(list(train), list(train.labels)).decision_function(test), first)
    assert (
        not np.array_equal(ActionIndexer(**options, random_state=5).fit(train).decision_function(test), first) or "view" in options
    )


def test_fitting_changes_neither_clips_nor_parameters(few):
    train, _ = few
    before, parameters = [clip.joints.copy() for clip in train], ActionIndexer().get_params()
    indexer = ActionIndexer().fit(train)
    indexer.predict(train)
    for clip, joints in zip(train, before, strict=True):
        np.testing.assert_array_equal(clip.joints, joints)
    assert indexer.get_params() == parameters


@pytest.mark.parametrize("kind", [list, lambda clips: clips], ids=["list", "ClipSet"])
def test_model_selection_on_lists_of_clips(few, kind):
    train, _ = few
    clips, labels, groups = kind(train), train.labels, train.column("subject")
    scores = cross_val_score(ActionIndexer(), clips, labels, groups=groups, cv=LeaveOneGroupOut(), error_score="raise")
    assert scores.shape == (3,) and (scores > 0.7).all()
    answers = cross_val_predict(ActionIndexer(), clips, labels, groups=groups, cv=LeaveOneGroupOut())
    assert accuracy_score(labels, answers) == pytest.approx(scores.mean())


def test_grid_search(few):
    train, test = few
    grid = {"scorer": ["nearest", "both"], "length": [8, 12]}
    search = GridSearchCV(ActionIndexer(), grid, cv=LeaveOneGroupOut(), error_score="raise", scoring="accuracy")
    search.fit(list(train), train.labels, groups=train.column("subject"))
    assert set(search.best_params_) == set(grid)
    assert search.score(list(test), test.labels) == 1.0
    assert search.classes_.tolist() == sorted(FEW)


def test_score(indexer, others):
    queries = others[:13]
    right = indexer.predict(queries) == queries.labels
    assert indexer.score(queries, queries.labels) == pytest.approx(right.mean())
    wrong = ["never learned"] * 13
    assert indexer.score(queries, wrong) == 0.0
    weights = np.arange(13.0)
    assert indexer.score(queries, queries.labels, weights) == pytest.approx(np.average(right, weights=weights))


def test_score_compares_numbers_as_numbers(few):
    train, _ = few
    indexer = ActionIndexer().fit(train, np.unique(train.labels, return_inverse=True)[1])
    assert indexer.score(train, indexer.predict(train).astype(float)) == 1.0

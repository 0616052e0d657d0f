"""Learning further clips, and refusing actions that were never learned."""

import numpy as np
import pytest

from indexing import ActionIndexer
from indexing.actors import ACTIONS, Person, dataset
from indexing.scoring import reject_threshold

FEW = ("squat", "wave", "kick", "bow")


@pytest.fixture(scope="module")
def crowd():
    """Four people in the view that is learned from, and four others, all actions each."""
    people = [Person.random(seed) for seed in range(8)]
    return dataset(people[:4], ACTIONS, azimuth=0.0, rng=0), dataset(people[4:], ACTIONS, azimuth=0.0, rng=50)


# ---- partial_fit -------------------------------------------------------------------------------------------------------
@pytest.mark.slow
@pytest.mark.parametrize("scorer", ["both", "nearest", "kernel"])
def test_partial_fit_is_as_good_as_fit_on_all(crowd, scorer):
    train, test = (clips.select(action=FEW) for clips in crowd)
    grown = ActionIndexer(scorer=scorer)
    for subject in range(4):
        part = train.select(subject=subject)
        assert grown.partial_fit(part, part.labels, classes=FEW) is grown
    whole = ActionIndexer(scorer=scorer).fit(train)
    assert grown.classes_.tolist() == whole.classes_.tolist() and len(grown.model_.labels) == 16
    assert grown.score(test, test.labels) == whole.score(test, test.labels) == 1.0
    if scorer == "nearest":  # nothing in it is drawn at random
        np.testing.assert_allclose(grown.decision_function(test), whole.decision_function(test), atol=1e-3)


def test_partial_fit_keeps_every_exemplar_with_its_own_copies(crowd):
    train, _ = crowd
    first, second = train.select(subject=0, action=FEW), train.select(subject=1, action=(*FEW, "lunge", "run"))
    grown = ActionIndexer().fit(first).partial_fit(second)
    order = ActionIndexer().fit([*first, *second])
    for i in range(6):
        np.testing.assert_array_equal(grown.model_.exemplars.crop(i).values, order.model_.exemplars.crop(i).values)
    np.testing.assert_array_equal(grown.model_.exemplars.owner, order.model_.exemplars.owner)
    np.testing.assert_array_equal(grown.classes_[grown.model_.labels], [*first.labels, *second.labels])
    assert len(grown.model_.exemplars.views) == len(order.model_.exemplars.views)


def test_new_classes_appear_and_old_ones_stay(crowd):
    train, test = crowd
    one = train.select(subject=0)
    indexer = ActionIndexer().fit(one.select(action=FEW[:2]))
    assert indexer.classes_.tolist() == ["squat", "wave"]
    indexer.partial_fit(one.select(action=["jumping_jack"]))  # a longer name than any before, and one class alone
    assert indexer.classes_.tolist() == ["jumping_jack", "squat", "wave"]
    asked = test.select(action=["jumping_jack", "squat", "wave"])
    assert indexer.score(asked, asked.labels) == 1.0


def test_partial_fit_with_numbers(crowd):
    one = crowd[0].select(subject=0, action=FEW)
    indexer = ActionIndexer().partial_fit(one[:3], [5, 3, 9]).partial_fit(one[3:], [1])
    assert indexer.classes_.tolist() == [1, 3, 5, 9] and indexer.classes_.dtype.kind == "i"
    assert indexer.predict(one).tolist() == [5, 3, 9, 1]
    with pytest.raises(ValueError, match="labels: the fitted labels are of type int64, the new ones <U3"):
        indexer.partial_fit(one[3:], ["bow"])


def test_partial_fit_without_a_seed(crowd, tmp_path):
    one = crowd[0].select(subject=0, action=FEW)
    indexer = ActionIndexer(random_state=None).fit(one[:3])
    indexer.save(tmp_path / "m.safetensors")
    loaded = ActionIndexer.load(tmp_path / "m.safetensors").partial_fit(one[3:])
    assert loaded.predict(one).tolist() == one.labels.tolist()


# ---- reject ------------------------------------------------------------------------------------------------------------
@pytest.fixture(scope="module")
def strangers(crowd):
    """Per action: an indexer that was not taught it, and how well other people's clips of that action fit all the same."""
    train, test = crowd
    fitted = [ActionIndexer(scorer="nearest").fit(train[train.labels != action]) for action in ACTIONS]
    return [(one, one.evidence(test[test.labels == action])) for one, action in zip(fitted, ACTIONS, strict=True)]


@pytest.mark.slow
@pytest.mark.parametrize("rate", [0.1, 0.3])
def test_unknown_actions_are_not_taken_for_known_ones_more_often_than_asked_for(strangers, rate):
    def taken(classes):
        return np.mean([found >= reject_threshold(rate, one.model_.evidence_out, classes) for one, found in strangers])

    counted = len(ACTIONS) - 1
    assert taken(counted) <= 1.2 * rate
    assert 0.2 * rate <= taken(None) <= 1.6 * rate  # of clips as if each were of an action of its own
    assert taken(counted) <= taken(None)


@pytest.mark.slow
def test_a_stricter_rate_refuses_more_and_known_actions_pass(crowd):
    train, test = crowd
    indexer = ActionIndexer(scorer="nearest", none_label="none")
    answers = [indexer.set_params(reject=rate).fit(train).predict(test) for rate in (0.5, 0.1, 0.02)]
    refused = [(answer == "none").mean() for answer in answers]
    assert refused == sorted(refused)
    assert refused[1] < 0.15  # known actions by other people
    assert (answers[1] == test.labels).mean() > 0.85


@pytest.mark.slow
def test_reject_only_ever_replaces_answers(crowd):
    train, test = crowd
    train = train.select(subject=[0, 1])
    free, bound = ActionIndexer().fit(train), ActionIndexer(reject=0.02, none_label="none").fit(train)
    np.testing.assert_array_equal(free.decision_function(test), bound.decision_function(test))
    answers = bound.predict(test)
    kept = answers != "none"
    np.testing.assert_array_equal(answers[kept], free.predict(test)[kept])
    np.testing.assert_array_equal(kept, bound.evidence(test) >= bound.reject_threshold_)


@pytest.mark.slow
def test_a_threshold_is_taken_as_it_is(crowd):
    train, test = (clips.select(action=FEW) for clips in crowd)
    evidence = ActionIndexer().fit(train).evidence(test)
    level = float(np.median(evidence))
    assert level > 1
    indexer = ActionIndexer(reject=level, none_label="none").fit(train)
    assert indexer.reject_threshold_ == level
    np.testing.assert_array_equal(indexer.predict(test) == "none", evidence < level)
    assert (ActionIndexer(reject=1e9, none_label="none").fit(train).predict(test) == "none").all()
    assert (ActionIndexer(reject=-1e9, none_label="none").fit(train).predict(test) != "none").all()


@pytest.mark.parametrize(
    ("labels", "none_label", "kind"),
    [("int", -1, "i"), ("str", "a long name for nothing", "U"), ("str", -1, "O"), ("str", None, "O"), ("float", -1.0, "f")],
)
def test_none_label_keeps_the_type_where_it_can(crowd, labels, none_label, kind):
    train = crowd[0].select(subject=[0, 1], action=FEW)
    y = train.labels if labels == "str" else np.unique(train.labels, return_inverse=True)[1].astype(labels)
    indexer = ActionIndexer(reject=1e9, none_label=none_label).fit(train, y)
    answer = indexer.predict(train)
    assert answer.dtype.kind == kind
    assert answer.tolist() == [none_label] * len(train)
    assert indexer.score(train, y) == 0.0

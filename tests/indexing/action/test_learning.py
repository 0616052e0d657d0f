"""How scorers are weighed by people who were left out, and what tells known actions from unknown ones."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from indexing import ActionIndexer
from indexing.action import learning
from indexing.action.bank import EPSILON, JointMetric, factorize, flatten_channel, fuse_terms
from indexing.action.learning import BLENDS, _fewest_mistakes, leave_out
from indexing.action.model import Blend, ShapeModel, evidence
from indexing.actors import Person, dataset

ACTIONS = ("squat", "wave", "kick", "bow", "punch")


@pytest.fixture(scope="module")
def lesson():
    return dataset([Person.random(i) for i in range(3)], ACTIONS, azimuth=0.0, rng=1)


@pytest.fixture(scope="module")
def learned(lesson):
    return ActionIndexer(weights="learned", virtual_views=2).fit(lesson)


def test_people_are_left_out_whole():
    groups = torch.tensor([4, 4, 9, 1, 9, 7, 3, 3, 2, 5])
    folds = leave_out(groups)
    for person in groups.unique():
        assert len(folds[groups == person].unique()) == 1
    assert sorted(folds.unique().tolist()) == [0, 1, 2, 3, 4]


def test_the_scorer_that_is_right_is_chosen():
    draw = torch.Generator().manual_seed(0)
    truth = torch.arange(5).repeat(20)
    right = torch.nn.functional.one_hot(truth, 5).double() + 0.1 * torch.rand(100, 5, generator=draw, dtype=torch.float64)
    wrong = 1.2 * right.roll(1, dims=1)
    only_a = _fewest_mistakes(torch.stack([2 * wrong, right]), truth, Blend())
    only_b = _fewest_mistakes(torch.stack([right, wrong]), truth, Blend())
    assert (only_a.kernel, only_a.nearest) == (1.0, 3.0)
    assert (only_b.kernel, only_b.nearest) == (1.0, 0.5)
    same = _fewest_mistakes(torch.stack([right, right]), truth, Blend())
    assert (same.kernel, same.nearest) == (1.0, Blend().nearest)  # nothing gained, nothing changed
    assert (Blend().kernel, Blend().nearest) in BLENDS


@pytest.mark.slow
def test_a_learned_indexer_knows_who_performs(learned, lesson):
    assert learned.groups_.tolist() == [str(clip.meta["subject"]) for clip in lesson]
    alone = ActionIndexer(weights="learned", virtual_views=2).fit([clip.replace(meta={}) for clip in lesson])
    assert alone.groups_ is None and alone.model_.blend == Blend()
    told = ActionIndexer(weights="learned", virtual_views=2).fit(
        [clip.replace(meta={}) for clip in lesson], groups=lesson.column("subject")
    )
    assert told.model_.blend == learned.model_.blend
    with pytest.raises(ValueError, match=r"groups: expected one per clip \(15\)"):
        ActionIndexer(weights="learned").fit(lesson, groups=[1, 2])


@pytest.mark.slow
def test_joints_that_wander_count_less():
    rng, clips = np.random.default_rng(0), []
    for clip in dataset(4, ACTIONS, azimuth=None, rng=1):
        junk = np.cumsum(rng.normal(size=(len(clip), 6, 3)), axis=0)
        joints = np.concatenate([clip.joints, clip.joints.mean() + 2 * junk / np.abs(junk).max()], axis=1)
        clips.append(clip.replace(joints=joints, confidence=None, skeleton=None))
    model = ActionIndexer(weights="learned", scorer="nearest", virtual_views=2).fit(clips).model_
    weights = model.joint_weights.joints.mean(dim=0)
    assert weights[:-6].mean() > 2 * weights[-6:].mean()
    assert ActionIndexer(scorer="nearest", virtual_views=2).fit(clips).model_.joint_weights is None


def test_turned_cards_fit_one_another():
    cards = torch.rand(2, 6, 5, 2, generator=torch.Generator().manual_seed(3))
    weights = JointMetric.learn(cards, torch.ones(2, 5, dtype=torch.bool), 0.25).weights("clip")
    behind, there = (flatten_channel(x, "clip", weights) for x in (cards * torch.tensor([-1.0, 1.0]), cards))
    (table,) = fuse_terms(factorize(behind), factorize(there), [("turned",)], (1.0,), EPSILON)
    assert table.diagonal().max() < EPSILON + 1e-5 and table[0, 1] > 0.01
    # brute force over turns: x of a card that is seen from elsewhere shrinks by the cosine
    a, b = behind[0] / behind[0].norm(), there[1] / there[1].norm()
    x, y = (a * b).sum(dim=1)
    best = float((x * torch.linspace(0, 2 * torch.pi, 2000).cos() + y).max())
    assert float(table[0, 1]) == pytest.approx(1 - best + EPSILON, abs=1e-4)


def test_known_from_unknown():
    draw = torch.Generator().manual_seed(4)
    labels = torch.arange(6).repeat(10)
    clips = 2.0 * torch.randn(60, 1, generator=draw)  # some are near to every exemplar
    scores = clips + torch.randn(60, 6, generator=draw) + 2.0 * torch.nn.functional.one_hot(labels, 6)
    foreign = scores[torch.nn.functional.one_hot(labels, 6) == 0].view(60, 5)  # had the own class never been learned

    def auroc(measure):
        return float((measure(scores)[:, None] > measure(foreign)[None]).float().mean())

    assert auroc(lambda x: evidence(x, 6)) > auroc(lambda x: x.max(dim=1).values) > 0.6
    few = scores[:, :2]
    assert torch.equal(evidence(few, 2), few.max(dim=1).values)


def test_of_many_exemplars_a_part_of_each_class_is_compared_with_all(monkeypatch):
    rng = np.random.default_rng(5)
    labels = np.arange(60) % 3
    waves = np.sin(np.linspace(0, 6, 12))[:, None, None] * rng.normal(size=(3, 1, 6, 2))
    clips = rng.normal(size=(6, 2)) + waves[labels] + 0.1 * rng.normal(size=(60, 12, 6, 2))
    whole = ActionIndexer(search=False, virtual_views=0).fit(clips, labels)
    asked, residuals = [], ShapeModel.residuals
    monkeypatch.setattr(ShapeModel, "residuals", lambda self, query: (asked.append(len(query)), residuals(self, query))[1])
    monkeypatch.setattr(learning, "MAX_PAIRS", 60 * 20)
    monkeypatch.setattr(learning, "MAX_TRAINING_ROWS", 30)
    many = ActionIndexer(search=False, virtual_views=0, weights="learned", reject=0.05)
    with pytest.warns(UserWarning, match="60 exemplars are too many to compare each with each: .*weights stay equal"):
        many.fit(clips, labels, groups=labels)
    assert set(asked) == {20} and many.model_.evidence_out.shape == (20,) and many.model_.blend == Blend()
    assert 0 < len(many.model_.support) <= 30 and many.model_.hub.shape == (60,)
    torch.testing.assert_close(many.model_.hub, whole.model_.hub, atol=0.3, rtol=0)
    assert (many.model_.scores(whole._queries(clips)).argmax(dim=1).numpy() == labels).all()

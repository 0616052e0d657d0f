"""Learned joint weights: the tables against the residual itself, gradients against differences, planted joints found."""

import dataclasses

import pytest
import torch

from indexing.action import joint_weights
from indexing.action.bank import NEAREST, JointMetric, Windows, flatten_channel
from indexing.action.joint_weights import JointWeights, WeightedMetric, epipolar, gather, learn_joint_weights
from tests.indexing.residuals import fused_residual, weighted_residual

JOINTS, LENGTH = 6, 8
TELLING = 4


@pytest.fixture(scope="module", autouse=True)
def one_round():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(joint_weights, "NUM_ROUNDS", 1)
        yield


@pytest.fixture(scope="module")
def plain(one_round):
    """Planted windows of five people, and what is learned from them."""
    bank, labels, groups = planted(5)
    return bank, labels, groups, learn(bank, labels, groups)


def seen(values):
    return Windows(values, torch.ones(values.shape[0], values.shape[2], dtype=torch.bool))


def planted(people, actions=3, seed=0, noise=0.3, dtype=torch.float32):
    """Windows in which one joint draws a curve of the action, and the others wander; labels; and who it is."""
    generator = torch.Generator().manual_seed(seed)
    curves = torch.randn(actions, LENGTH, 2, generator=torch.Generator().manual_seed(99), dtype=dtype)
    labels, groups = torch.arange(actions).repeat(people), torch.arange(people).repeat_interleave(actions)
    values = torch.randn(len(labels), LENGTH, JOINTS, 2, generator=generator, dtype=dtype)
    telling = curves[labels] + noise * torch.randn(len(labels), LENGTH, 2, generator=generator, dtype=dtype)
    values[:, :, TELLING] = telling
    return seen(values), labels, groups


def learn(bank, labels, groups, symmetry=None):
    owner, hub = torch.arange(len(labels)), torch.zeros(len(labels))
    return learn_joint_weights(bank, owner, [bank], a_metric(bank), labels, groups=groups, hub=hub, symmetry=symmetry)


def a_metric(windows, power=0.25):
    return JointMetric.learn(windows.values, windows.seen, power)


def evidence_of(windows, labels, groups, metric):
    zero = torch.zeros(len(labels), dtype=windows.values.dtype)
    ones = torch.ones(len(NEAREST))
    return gather(windows, torch.arange(len(labels)), [windows], (metric, metric), ones, labels, groups, zero)


def accuracy(weights, query, truth, bank, labels, metric):
    residual = weighted_residual(query, [bank], metric, labels, weights)
    return float((labels[residual.argmin(dim=1)] == truth).double().mean())


def test_the_closed_form_is_the_largest_singular_value():
    generator = torch.Generator().manual_seed(1)
    x, y = torch.randn(2, 5, 9, 2, generator=generator, dtype=torch.float64)
    y[0] = x[0] @ torch.tensor([[2.0, 1.0], [0.5, -1.0]], dtype=torch.float64)  # the same plane
    first, second = torch.linalg.qr(x)[0], torch.linalg.qr(y)[0]
    expected = 1 - torch.linalg.svdvals(first.mT @ second)[:, 0]
    entries = [gram.flatten(1).unbind(1) for gram in (x.mT @ y, x.mT @ x, y.mT @ y)]
    torch.testing.assert_close(epipolar(*entries), expected, atol=1e-5, rtol=0)


def test_tables_give_the_fused_residual_under_any_weights():
    windows, labels, groups = planted(3)
    metric = a_metric(windows)
    table = evidence_of(windows, labels, groups, metric)
    generator = torch.Generator().manual_seed(2)
    joints, channels = torch.rand(3, JOINTS, generator=generator) + 0.2, torch.rand(3, generator=generator) + 0.5
    residual = weighted_residual(windows, [windows], metric, labels, JointWeights(joints, channels))
    other = groups[:, None] != groups[None]  # two exemplars of each class: both are candidates
    mean = torch.stack([residual.where(other & (labels == c), 0.0).sum(dim=1) / 2 for c in range(3)], dim=1)
    torch.testing.assert_close(table.scores(joints[None, :, None], channels[None])[0], -mean, atol=2e-3, rtol=1e-3)


def test_gradients_against_finite_differences():
    windows, labels, groups = planted(3, dtype=torch.float64)
    table = evidence_of(windows, labels, groups, a_metric(windows))
    generator = torch.Generator().manual_seed(3)
    joints = (torch.rand(2, 3, 3, JOINTS, generator=generator, dtype=torch.float64) + 0.5).requires_grad_()
    channels = torch.ones(2, 3, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(table.scores, (joints, channels), fast_mode=True, atol=1e-5)


def test_weights_act_after_whitening_and_for_each_class_its_own():
    windows, labels, _ = planted(2)
    metric = a_metric(windows)
    equal = JointWeights.uniform(JOINTS)
    assert equal.metric(metric) is metric and equal.is_uniform
    table = weighted_residual(windows, [windows], metric, labels, equal)
    torch.testing.assert_close(table, fused_residual(windows, [windows], metric))
    roots = torch.rand(3, JOINTS, generator=torch.Generator().manual_seed(4))
    weighted = WeightedMetric(metric.covariance, metric.power, roots)
    plain, found = (flatten_channel(windows.values, "frame", one.weights("frame")) for one in (metric, weighted))
    torch.testing.assert_close(found, (plain.unflatten(2, (-1, JOINTS)) * roots[1]).flatten(2))
    metric, generator = a_metric(windows), torch.Generator().manual_seed(5)
    weights = JointWeights(torch.ones(3, JOINTS), torch.ones(3), torch.rand(3, JOINTS, generator=generator) + 0.1)
    found = weighted_residual(windows, [windows], metric, labels, weights)
    for action in range(3):
        alone = fused_residual(windows, [windows], weights.metric(metric, action))
        # float32, and the terms are added in another order
        torch.testing.assert_close(found[:, labels == action], alone[:, labels == action], rtol=2e-5, atol=1e-4)


def test_a_planted_joint_is_found_and_pays_with_new_people(plain):
    bank, labels, _, learned = plain
    query, truth, _ = planted(8, seed=7)
    metric = a_metric(bank)
    assert not learned.is_uniform
    assert learned.joints.mean(dim=0).argmax() == TELLING
    torch.testing.assert_close(learned.joints.mean(dim=1), torch.ones(3))
    assert accuracy(learned, query, truth, bank, labels, metric) >= accuracy(None, query, truth, bank, labels, metric) + 0.1


@pytest.mark.slow
def test_each_action_gets_the_joint_that_tells_it():
    def own_joints(people, seed):
        """Joint c draws the curve of action c; in other actions it wanders."""
        _, labels, groups = planted(people, seed=seed)
        curves = torch.randn(3, LENGTH, 2, generator=torch.Generator().manual_seed(98))
        noise = torch.randn(len(labels), LENGTH, JOINTS + 3, 2, generator=torch.Generator().manual_seed(seed))
        rows = torch.arange(len(labels))
        noise[rows, :, labels] = 1.2 * curves[labels] + 0.3 * noise[rows, :, labels]
        return seen(noise), labels, groups

    bank, labels, groups = own_joints(10, seed=0)
    query, truth, _ = own_joints(20, seed=5)
    metric = a_metric(bank)
    found = learn(bank, labels, groups)
    assert found.by_class is not None
    assert found.by_class.argmax(dim=1).tolist() == [0, 1, 2]
    shared = dataclasses.replace(found, by_class=None)
    assert accuracy(found, query, truth, bank, labels, metric) > accuracy(shared, query, truth, bank, labels, metric)


def test_the_order_of_joints_changes_nothing_but_the_order_and_mirror_images_share_a_weight(plain):
    bank, labels, groups, learned = plain
    order = torch.tensor([3, 5, 0, 4, 1, 2])
    turned = Windows(bank.values[:, :, order], bank.seen[:, order])
    torch.testing.assert_close(learn(turned, labels, groups).joints, learned.joints[:, order], atol=0.03, rtol=0.03)
    found = learn(bank, labels, groups, torch.tensor([0, 1, 2, 3, 5, 4]))
    torch.testing.assert_close(found.joints[:, 4], found.joints[:, 5])


def test_equal_weights_where_nothing_can_be_learned():
    for people, noise, together in ((4, 0.3, True), (1, 0.3, False), (2, 0.3, False), (4, 1e3, False)):
        bank, labels, groups = planted(people, noise=noise)
        assert learn(bank, labels, torch.zeros_like(groups) if together else groups) is None, (people, noise)


def test_few_exemplars_are_padded_and_a_joint_that_nobody_saw_counts_for_nothing():
    bank, labels, groups = planted(3)
    kept = torch.arange(len(labels))[~((labels == 2) & (groups > 0))]  # one exemplar of class 2
    part = Windows(bank.values[kept], bank.seen[kept])
    table = evidence_of(part, labels[kept], groups[kept], a_metric(part))
    alone = (labels[kept] == 2).nonzero()[0, 0]
    assert not bool(table.valid[2, alone].any()) and table.hub.shape == (3, len(kept), 2)
    assert bool(table.scores(torch.ones(1, 3, 1, JOINTS), torch.ones(1, 3)).isfinite().all())
    without = Windows(bank.values[:, :, :-1], bank.seen[:, :-1])
    blind = Windows(bank.values, bank.seen & (torch.arange(JOINTS) < JOINTS - 1))
    tables = [evidence_of(part, labels, groups, a_metric(part, power=0.0)) for part in (without, blind)]
    scores = [table.scores(torch.ones(1, 3, 1, table.cross.shape[-1]), torch.ones(1, 3)) for table in tables]
    torch.testing.assert_close(*scores, atol=1e-4, rtol=1e-4)

"""Shapes: channels, the joint metric, all-pairs residuals and kernels, and the kernel machine, against slow references."""

import copy
import dataclasses
import pickle
from itertools import product

import numpy as np
import pytest
import torch
from sklearn.svm import SVC

from dyntorch.numerics import canonical_correlation, orthonormal_basis
from indexing import ActionIndexer
from indexing.action.bank import (
    CHANNELS,
    EPSILON,
    NEAREST,
    Bank,
    Copy,
    JointMetric,
    Windows,
    channel,
    entries,
    epipolar_correlation,
    factorize,
    flatten_channel,
    fused_residuals,
    order_free_moments,
    planes_of,
    principal_directions,
)  # fmt: skip
from indexing.action.joint_weights import JointWeights
from indexing.action.kernels import Kernels
from indexing.action.model import MOMENT_TERMS, PENALTY, TURNED_CARD_WEIGHT, PairwiseMachine, mirror_some
from tests.indexing.residuals import fused_residual, weighted_residual

LENGTH, JOINTS = 8, 6


def random(*shape, seed=0):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64).float()


def random_windows(count, seed=0, holes=False):
    values = random(count, LENGTH, JOINTS, 2, seed=seed)
    seen = torch.ones(count, JOINTS, dtype=torch.bool)
    if holes:
        seen[::2, 1] = False
        seen[::3, 4] = False
        values = values * seen[:, None, :, None]
    return Windows(values, seen)


def metric_of(windows, power=0.25):
    return JointMetric.learn(windows.values, windows.seen, power)


def test_channels_and_moments_by_definition():
    x = random(3, LENGTH, JOINTS, 2).numpy()
    expected = {
        "clip": x - x.mean(axis=(1, 2), keepdims=True), "frame": x - x.mean(axis=2, keepdims=True),
        "motion": x - x.mean(axis=1, keepdims=True), "velocity": x[:, 2:] - x[:, :-2],
    }  # fmt: skip
    for name in CHANNELS:
        np.testing.assert_allclose(channel(torch.from_numpy(x), name), expected[name], atol=1e-6)
    with pytest.raises(ValueError, match="unknown channel 'pose'; known: clip, frame, motion, velocity"):
        channel(torch.zeros(1, 4, 3, 2), "pose")
    for whole_image in (False, True):
        f = expected["frame"].astype(float)
        f = f.reshape(3, LENGTH, -1) if whole_image else f[..., 1]
        parts = f, f - f.mean(axis=1, keepdims=True), np.diff(f, axis=1)
        moments = np.stack([np.einsum("nti,ntj->nij", a, a).reshape(3, -1) for a in parts])
        np.testing.assert_allclose(order_free_moments(torch.from_numpy(x), whole_image), moments, atol=1e-4)


def test_the_joint_metric_by_definition_keeps_the_rank_condition():
    windows = random_windows(7, seed=1)
    metric = metric_of(windows)
    for k, name in enumerate(CHANNELS):
        x = channel(windows.values, name).double().numpy()
        x = x / np.sqrt((x**2).sum(axis=(1, 2, 3), keepdims=True))
        sigma = np.einsum("ntjd,ntkd->jk", x, x)
        sigma *= JOINTS / np.trace(sigma)
        np.testing.assert_allclose(metric.covariance[k], sigma, atol=1e-6)
        values, vectors = np.linalg.eigh(sigma + 0.1 * np.eye(JOINTS))
        np.testing.assert_allclose(metric.weights(name), vectors @ np.diag(values**-0.25) @ vectors.T, atol=1e-5)
    assert metric_of(windows, power=0.0).weights("clip") is None
    holed = random_windows(9, seed=2, holes=True)
    moved = Windows((holed.values + 50) * holed.seen[:, None, :, None], holed.seen)  # the image has its origin elsewhere
    torch.testing.assert_close(metric_of(moved).covariance, metric_of(holed).covariance, atol=1e-3, rtol=0)
    shape = random(LENGTH * JOINTS, 3, seed=3).double()
    views = torch.stack([shape @ random(3, 2, seed=3 + i).double() + 5.0 * i for i in (1, 2)]).unflatten(1, (LENGTH, JOINTS))
    metric = metric_of(random_windows(7, seed=6))
    for name in CHANNELS:
        weights = metric.weights(name)
        a, b = (flatten_channel(view[None], name, weights).mT for view in views)
        assert (a - channel(views[:1], name).flatten(1, 2)).abs().max() > 1e-3  # it does weigh
        assert abs(float(canonical_correlation(torch.linalg.qr(a).Q, torch.linalg.qr(b).Q)) - 1) < 1e-6
    pair = [Windows(view[None].float(), torch.ones(1, JOINTS, dtype=torch.bool)) for view in views]
    assert float(fused_residual(pair[0], [pair[1]], metric)) == pytest.approx(3 * np.log(EPSILON), abs=0.5)


def slow_residual(query, exemplar, metric, terms, powers):
    """One pair in float64: SVD bases, and only the joints that both saw."""
    total, both = 0.0, (query[1] & exemplar[1]).nonzero()[:, 0]
    for name, power in zip(NEAREST, powers, strict=True):
        w = metric.weights(name, slice(None) if len(both) == JOINTS else both)
        a, b = (
            torch.einsum("jk,tkd->tjd", w.double(), channel(values[None, :, both].double(), name)[0]).flatten(0, 1)
            for values, _ in (query, exemplar)
        )
        for term in terms:
            if term == "epi":
                u, v = (torch.linalg.svd(x, full_matrices=False).U for x in (a, b))
                r = 1 - torch.linalg.svdvals(u.mT @ v)[0]
            else:
                across, heights = (a[:, 0] @ b[:, 0], a[:, 1] @ b[:, 1])
                across = across.abs() if term == "turned" else across
                r = 1 - (across + heights) / (a.norm() * b.norm())
            total += power * float(torch.log(r + EPSILON))
    return total


def test_residuals_against_singular_values_pair_by_pair(monkeypatch):
    for (holes, powers), terms in product(((False, (1.0, 1.0, 1.0)), (True, (0.5, 1.0, 2.0))), (("epi",), ("epi", "turned", "nn"))):
        query, bank, second = random_windows(5, 7, holes), random_windows(7, 8, holes), random_windows(7, 9)
        metric = metric_of(bank)
        table = fused_residual(query, [bank, second], metric, terms, powers)
        for i, j in product(range(5), range(7)):
            pair = (query.values[i], query.seen[i])
            expected = min(slow_residual(pair, (x.values[j], x.seen[j]), metric, terms, powers) for x in (bank, second))
            assert float(table[i, j]) == pytest.approx(expected, abs=5e-3), (holes, terms, powers)
        with monkeypatch.context() as patch:
            patch.setattr("indexing.action.bank.PAIR_BLOCK", 4)
            tiled = fused_residual(query, [bank, second], metric, terms, powers)
            torch.testing.assert_close(tiled, table, atol=1e-5, rtol=0)


def test_pairs_with_too_few_common_joints_get_the_worst_residual_and_any_number_of_queries_is_compared_alike():
    bank, queries = random_windows(7, 32), random_windows(300, 33)
    metric = metric_of(bank)
    whole = fused_residual(queries, [bank], metric)
    alone = torch.cat([fused_residual(queries[at : at + 1], [bank], metric) for at in (0, 128, 299)])
    torch.testing.assert_close(alone, whole[[0, 128, 299]], atol=1e-4, rtol=0)
    assert fused_residual(queries[:0], [bank], metric).shape == (0, 7)
    for common in (0, 1, 2):
        query, bank = random_windows(1, 15), random_windows(1, 16)
        query.seen[0, 4:] = False
        bank.seen[0, : 4 - common] = False
        assert float(fused_residual(query, [bank], metric)) == pytest.approx(3 * np.log(1 + EPSILON), abs=1e-3), common


@pytest.mark.parametrize("count", [3, 20])
def test_planes_against_the_bases_of_the_library(count):
    left, right = (random(n, 2, 24, seed=21 + n) for n in (count, 7))
    (u, own), (v, other) = factorize(left), factorize(right)
    c = entries(u, v)
    bases = [orthonormal_basis(x.mT.double()) for x in (left, right)]
    torch.testing.assert_close(torch.stack(c), torch.einsum("qri,erj->ijqe", *bases).flatten(0, 1).float(), atol=2e-5, rtol=0)
    torch.testing.assert_close(epipolar_correlation(c).double(), canonical_correlation(*bases), atol=1e-5, rtol=0)
    for x, basis, factor in ((left, u, own), (right, v, other)):
        zero = torch.zeros(len(x))
        triangle = torch.stack([factor[:, 0], zero, factor[:, 1], factor[:, 2]], dim=1).unflatten(1, (2, 2))
        torch.testing.assert_close(triangle @ basis, x / x.flatten(1).norm(dim=1)[:, None, None], atol=1e-5, rtol=0)
    line = random(1, 1, 24, seed=22)  # planes of nothing and of lines are no numbers gone wrong
    nothing = (torch.full((1, 2, 24), value) for value in (0.0, torch.nan, torch.inf))
    images = torch.cat([next(nothing), torch.cat([line, 2 * line], dim=1), *nothing])
    basis, factor = factorize(images)
    assert basis.isfinite().all() and factor.isfinite().all()
    assert not basis[[0, 2, 3]].any() and float(basis.abs().max()) <= 1


# ---- exemplars described once ------------------------------------------------------------------------------------------
SWAP = torch.tensor([0, 2, 1, 3, 5, 4])


def test_a_bank_is_the_least_over_its_copies_and_their_mirror_images():
    query, bank = random_windows(6, 23, holes=True), random_windows(8, 24, holes=True)
    metric, mirrored = metric_of(bank), torch.tensor([True, False] * 4)
    kept = Bank([Copy(bank), Copy(bank, mirrored.nonzero()[:, 0], SWAP)], planes_of(metric))
    fusions = (("epi",), ("turned",), MOMENT_TERMS)
    tables = fused_residuals(query, [kept], fusions)
    for terms, table in zip(fusions, tables, strict=True):
        expected = fused_residual(query, [bank, mirror_some(bank, SWAP, mirrored)], metric, terms)
        torch.testing.assert_close(table, expected, atol=1e-4, rtol=0)
    chosen = torch.tensor([1, 2, 6])
    for table, part in zip(tables, fused_residuals(query, [kept], fusions, chosen), strict=True):
        torch.testing.assert_close(part, table[:, chosen], atol=1e-4, rtol=0)


def test_many_exemplars_are_compared_among_their_principal_directions(monkeypatch):
    """As few as hold all but a hundredth of their energy; what they leave out bounds what correlations are off by."""
    draw = random(300, 2, 6, seed=40) @ random(6, 24, seed=41) + 0.05 * random(300, 2, 24, seed=42)
    axes, query = factorize(draw)[0], factorize(random(5, 2, 24, seed=43))[0]
    directions = principal_directions(axes, 0.01)
    count = directions.shape[1]
    assert 3 < count < 16
    torch.testing.assert_close(directions.mT @ directions, torch.eye(count), atol=1e-5, rtol=0)
    values = torch.linalg.svdvals(axes.flatten(0, 1).double()).square()
    left = [float(values[kept:].sum() / values.sum()) for kept in (count, count - 1)]
    assert left[0] <= 0.01 < left[1]
    exact = epipolar_correlation(entries(query, axes))
    found = epipolar_correlation(entries(query @ directions, axes @ directions))
    rest = torch.linalg.matrix_norm(axes - axes @ directions @ directions.mT, 2)
    assert float(((found - exact).abs() - rest).max()) < 1e-5
    assert principal_directions(factorize(random(300, 2, 24, seed=44))[0], 0.01) is None
    # in a bank: of windows that show all joints, and only where there are many
    bank, asked = random_windows(40, 45, holes=True), random_windows(4, 46, holes=True)
    plain = fused_residuals(asked, [Bank([Copy(bank)], planes_of(metric_of(bank)))], [("epi",)])[0]
    projected = Bank([Copy(bank)], planes_of(metric_of(bank), lambda: bank))
    torch.testing.assert_close(fused_residuals(asked, [projected], [("epi",)])[0], plain, atol=1e-5, rtol=0)
    monkeypatch.setattr("indexing.action.bank.MIN_TO_PROJECT", 10)
    monkeypatch.setattr("indexing.action.bank.MAX_LEFT_OUT", dict.fromkeys(NEAREST, 0.05))
    projected = Bank([Copy(bank)], planes_of(metric_of(bank), lambda: bank))
    error = (fused_residuals(asked, [projected], [("epi",)])[0] - plain).abs()
    assert 1e-4 < float(error.max()) < 0.5


def test_exemplars_are_described_once_for_every_set_of_joints(monkeypatch):
    bank, first, second = random_windows(9, 29), random_windows(2, 30), random_windows(3, 31)
    second.seen[:, 2] = False
    described, planes = [], planes_of(metric_of(bank))

    def describer(joints):
        describe = planes(joints)
        return lambda values: (described.append(len(values)), describe(values))[1]

    kept = Bank([Copy(bank), Copy(bank, torch.arange(4), SWAP)], describer)
    answers = [fused_residuals(query, [kept], [("epi",)])[0] for query in (first, second, first, second)]
    assert described == [9, 4, 2, 9, 4, 3, 2, 3]
    torch.testing.assert_close(answers[2:], answers[:2], atol=1e-4, rtol=0)
    monkeypatch.setattr("indexing.action.bank.MAX_CACHE_BYTES", 0)  # the set of joints used last stays in any case
    described.clear()
    for query in (first, first, second, first):
        fused_residuals(query, [kept], [("epi",)])
    assert described == [2, 2, 9, 4, 3, 9, 4, 2]


@pytest.fixture(scope="module")
def fitted():
    rng = np.random.default_rng(34)
    body, waves = rng.normal(size=(JOINTS, 2)), np.sin(np.linspace(0, 6, 20))[:, None, None]
    styles = rng.normal(size=(3, JOINTS, 2))
    labels = np.repeat(np.arange(3), 4)
    clips = [body + waves * styles[label] + 0.05 * rng.normal(size=(20, JOINTS, 2)) for label in labels]
    indexer = ActionIndexer(length=LENGTH).fit(clips, labels)
    symmetric = dataclasses.replace(indexer.model_, symmetry=SWAP, mirrored=torch.from_numpy(labels != 1))
    return indexer, symmetric, clips


def slow_residuals(model, query, crops, chosen):
    copies = [windows for i in range(crops) for windows in (model.exemplars.crop(i),)]
    copies += [mirror_some(windows, model.symmetry, model.mirrored) for windows in copies]
    copies = [windows[chosen] for windows in copies]
    epipolar = weighted_residual(query, copies, model.metric, model.labels[chosen], model.joint_weights)
    turned = fused_residual(query, copies, model.metric, ("turned",))
    return epipolar + TURNED_CARD_WEIGHT * turned - model.hub[chosen]


@pytest.mark.slow
@pytest.mark.parametrize("learned", [False, True])
def test_a_model_scores_as_if_it_kept_nothing(fitted, learned):
    _, model, _ = fitted
    query = random_windows(5, 35, holes=True)
    if learned:
        weights = JointWeights(random(3, JOINTS, seed=36).exp(), torch.tensor([0.5, 1.0, 1.5]))
        model = dataclasses.replace(model, joint_weights=weights)
    every, some = torch.arange(12), torch.tensor([0, 3, 4, 9])
    for _ in range(2):
        crops = len(model.exemplars.crops) // len(model.exemplars)
        torch.testing.assert_close(model.residuals(query), slow_residuals(model, query, crops, every), atol=1e-4, rtol=0)
        torch.testing.assert_close(model.whole_residuals(query, some), slow_residuals(model, query, 1, some), atol=1e-4, rtol=0)
        moments = model.exemplars.moments
        copies = [moments, mirror_some(moments, SWAP, model.mirrored[model.exemplars.owner])]
        expected = fused_residual(query, copies, model.metric, MOMENT_TERMS) - model.moment_hub
        torch.testing.assert_close(model.moment_residuals(query), expected, atol=1e-4, rtol=0)


def test_what_a_model_keeps_stays_with_it_alone(fitted):
    indexer, model, clips = fitted
    before = len(pickle.dumps(model))
    answer = model.scores(random_windows(3, 37))
    assert len(pickle.dumps(model)) == before
    for other in (pickle.loads(pickle.dumps(model)), copy.deepcopy(model), dataclasses.replace(model, hub=model.hub + 1)):
        assert other.cache is not model.cache
    torch.testing.assert_close(copy.deepcopy(model).scores(random_windows(3, 37)), answer, atol=1e-3, rtol=0)
    assert model.to("meta") is model.to("meta") and model.to("cpu") is model
    first = indexer.model_
    indexer = copy.copy(indexer).partial_fit(clips[:1], [2])
    assert indexer.model_.cache is not first.cache and len(indexer.decision_function(clips[:2])) == 2


@pytest.mark.parametrize("one_side", [False, True])
def test_kernel_by_definition(one_side):
    query, bank = random_windows(4, 18), random_windows(9, 19)
    kernels = Kernels(one_side)
    with pytest.raises(ValueError, match="fit them first"):
        kernels(query, bank)
    kernel = kernels.fit(bank)
    torch.testing.assert_close(kernel, kernel.mT, atol=1e-5, rtol=0)
    torch.testing.assert_close(kernel.diagonal(), torch.ones(9), atol=2e-2 if one_side else 1e-4, rtol=0)
    assert kernel.min() >= 0 and (one_side or torch.linalg.eigvalsh(kernel.double()).min() > -1e-4)

    def distances(a, b):
        unit = torch.nn.functional.normalize
        x, y = ([channel(windows.values, name).double() for name in CHANNELS] for windows in (a, b))
        for p, q in zip(x, y, strict=True):
            for one, other in ((p[..., 1], q[..., 1]), (p, q)):
                yield 1 - unit(one.flatten(1), dim=1) @ unit(other.flatten(1), dim=1).mT
            if one_side:
                bases = [orthonormal_basis(part.flatten(1, 2)) for part in (p, q)]
                yield 1 - canonical_correlation(*bases)
                yield 1 - canonical_correlation(*bases, shared=2)
        for whole_image in (False, True)[: 1 + one_side]:
            for p, q in zip(order_free_moments(a.values, whole_image), order_free_moments(b.values, whole_image), strict=True):
                yield 1 - unit(p.double(), dim=1) @ unit(q.double(), dim=1).mT

    off = ~torch.eye(9, dtype=torch.bool)
    scales = [d[off].median() / 2 for d in distances(bank, bank)]
    torch.testing.assert_close(kernels.scales.double(), torch.stack(scales), atol=1e-5, rtol=1e-4)
    expected = sum(torch.exp(-d / s) for d, s in zip(distances(query, bank), scales, strict=True)) / len(scales)
    torch.testing.assert_close(kernels(query, bank).double(), expected, atol=1e-4, rtol=0)


@pytest.mark.parametrize("classes", [2, 6])
def test_pairwise_machine_is_the_support_vector_machine(classes):
    rng = np.random.default_rng(classes)
    labels = np.arange(60) % classes
    x = rng.normal(size=(60, 4)) + 1.5 * rng.normal(size=(classes, 4))[labels]
    gram, cross = x @ x.T, rng.normal(size=(40, 4)) * 2 @ x.T
    machine = PairwiseMachine.fit(torch.from_numpy(gram).float(), labels)
    got = machine(torch.from_numpy(cross).float()[:, machine.support]).numpy()
    reference = SVC(C=PENALTY, kernel="precomputed", decision_function_shape="ovr").fit(gram, labels)
    assert got.shape == (40, classes)
    if classes == 2:
        np.testing.assert_array_equal(got.argmax(axis=1), reference.predict(cross))
    else:
        np.testing.assert_allclose(got, reference.decision_function(cross), atol=2e-3)

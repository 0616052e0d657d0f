"""The best segments that do not overlap, against looking at every explanation there is."""

from itertools import pairwise

import numpy as np
import pytest

from indexing.recordings.decoding import best_tiling, posterior, through


def explanations(windows, cells):
    """Every set of windows that do not overlap, as tuples of their numbers."""

    def grow(edge):
        if edge >= cells:
            yield ()
            return
        yield from grow(edge + 1)
        for number in np.flatnonzero(windows[:, 0] == edge).tolist():
            for rest in grow(int(windows[number, 1])):
                yield (number, *rest)

    return list(grow(0))


@pytest.fixture(params=range(4))
def problem(request):
    rng, cells = np.random.default_rng(request.param), 6
    windows = np.array([(a, b) for b in range(1, cells + 1) for a in range(b) if rng.random() < 0.6])
    return windows, rng.normal(size=(len(windows), 2)) * 2, rng.normal(size=cells)


def worth(chosen, windows, values, background):
    outside = np.ones(len(background), dtype=bool)
    for number in chosen:
        outside[windows[number, 0] : windows[number, 1]] = False
    return background[outside].sum() + sum(values[number].max() for number in chosen)


def test_the_best_explanation_is_found(problem):
    windows, values, background = problem
    every = [worth(chosen, *problem) for chosen in explanations(windows, len(background))]
    segments, value = best_tiling(windows, values, background)
    assert value == pytest.approx(max(every))
    assert value == pytest.approx(worth([one.window for one in segments], *problem))
    assert all(a.last <= b.first for a, b in pairwise(segments))
    assert all(one.label == values[one.window].argmax() for one in segments)


def test_the_best_explanation_through_each_window(problem):
    windows, values, background = problem
    every = explanations(windows, len(background))
    want = [max(worth(chosen, *problem) for chosen in every if number in chosen) for number in range(len(windows))]
    np.testing.assert_allclose(through(windows, values, background), want)


def test_posteriors_are_sums_over_all_explanations(problem):
    windows, values, background = problem
    want, total = np.zeros((len(background), 2)), 0.0
    for chosen in explanations(windows, len(background)):
        outside = np.ones(len(background), dtype=bool)
        for number in chosen:
            outside[windows[number, 0] : windows[number, 1]] = False
        weight = np.exp(background[outside].sum() / 0.7 + sum(np.logaddexp.reduce(values[k] / 0.7) for k in chosen))
        total += weight
        for number in chosen:
            share = np.exp(values[number] / 0.7 - np.logaddexp.reduce(values[number] / 0.7))
            want[windows[number, 0] : windows[number, 1]] += weight * share
    np.testing.assert_allclose(posterior(windows, values, background, 0.7), want / total, atol=1e-9)


def test_where_no_window_is_there_is_background():
    nothing, values = np.empty((0, 2), dtype=np.intp), np.empty((0, 3))
    assert best_tiling(nothing, values, np.ones(4)) == ([], 4.0)
    assert not posterior(nothing, values, np.ones(4), 1.0).any()

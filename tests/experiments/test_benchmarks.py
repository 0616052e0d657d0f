"""The benchmarks run end to end on tiny problems, and their accuracy columns are right."""

from __future__ import annotations

import json

import pytest
import torch

from dyntorch import scenes
from experiments.benchmarks import first_answers, fits, neighbours, null_space, robust_peers, synchronization
from experiments.common.timing import interleaved, threads


def figures(rows, word):
    return {row.task: row.measured for row in rows if word in row.task}


def test_candidates_take_turns_and_the_median_counts():
    order = []
    found = interleaved({"a": lambda: order.append("a"), "b": lambda: order.append("b")}, rounds=3)
    assert order == ["a", "b"] * 4 and set(found) == {"a", "b"} and all(seconds >= 0 for seconds in found.values())


def test_threads_are_put_back_even_after_an_error():
    before, seen = torch.get_num_threads(), []

    def fail():
        with threads(1):
            seen.append(torch.get_num_threads())
            raise KeyError

    with pytest.raises(KeyError):
        fail()
    assert seen == [1] and torch.get_num_threads() == before


def test_rows_and_svd_give_the_same_tensor_on_exact_matches():
    scene = scenes.planar(n=40, batch=2, sigma=0.0, generator=torch.Generator().manual_seed(0))
    invariant = fits.SCENES["HomographyTensor"][0]
    small = tuple(x / 300 - 1 for x in scene.views)
    ours = fits.dyn.fit(invariant, *small).tensor.flatten(1)
    theirs = fits.rows_and_svd(invariant, small)[:, 0]
    assert ((ours * theirs).sum(-1).abs() > 1 - 1e-9).all()


def test_small_invariants_are_as_accurate_as_the_peers():
    rows = fits.small(fits.Config(quick=True))
    for title in ("fundamental matrix", "homography"):
        rms = figures([row for row in rows if row.task.startswith(title)], "rms")
        assert rms[f"{title}: dyntorch, rms"] < 1.02 * rms[f"{title}: kornia, rms"] < 1.0


def test_robust_fits_are_as_accurate_as_the_peers():
    rms = figures(robust_peers.measure("homography", 0.3, robust_peers.Config(quick=True)), "rms")
    assert all(value < 1.0 for value in rms.values()) and "homography: dyntorch, one batch, rms" in rms


@pytest.mark.parametrize("case", [null_space.Case(null_space.SOLVE, 27), null_space.Case(null_space.MINIMAL, 27)])
def test_null_spaces_are_as_accurate_as_the_goal_says(case):
    figure = null_space.on_one_thread(case, null_space.Config(batch=16, rounds=1, quick=True))
    assert figure.angle <= 1e-10 and figure.reference > 0 and figure.ours > 0


@pytest.mark.slow
def test_all_ways_to_evaluate_shifts_find_the_true_one():
    config = synchronization.Config(quick=True)
    rows = [*synchronization.same_points(config), *synchronization.different_points(config), *synchronization.long_takes(config)]
    errors = figures(rows, "error")
    assert errors and all(value == 0 for value in errors.values()), errors


@pytest.mark.slow
def test_first_answers_and_busy_neighbours_are_measured(capsys):
    first_answers.answer("fit")
    first, warm = json.loads(capsys.readouterr().out)
    assert first > 0 and warm > 0
    row = neighbours.table(neighbours.Config(rounds=1, only="robust_fit"))[0]
    assert row.measured > 0 and row.task == "robust_fit"

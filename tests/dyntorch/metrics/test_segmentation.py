"""The error of a segmentation is the least over all ways to name the bodies."""

from itertools import permutations

import pytest
import torch

from dyntorch.metrics import misclassification


def least(labels, truth):
    """Over all one-to-one assignments of the bodies found, by trying every one; 0 stays 0."""
    size = max(*labels, *truth, 1)
    return min(
        sum((0, *names)[given] != true for given, true in zip(labels, truth, strict=True))
        for names in permutations(range(1, size + 1))
    ) / len(labels)


def draw(high, *shape, seed=0):
    return torch.randint(0, high, shape, generator=torch.Generator().manual_seed(seed))


@pytest.mark.parametrize(("found", "true"), [(2, 2), (3, 3), (5, 3), (3, 6), (1, 4), (4, 1), (1, 1)])
def test_it_is_the_least_over_all_assignments(found, true):
    labels, truth = draw(found, 3, 4, 25, seed=found), draw(true, 3, 4, 25, seed=10 + true)
    error = misclassification(labels, truth)
    assert error.shape == (3, 4) and error.dtype == torch.float64
    expected = [[least(a.tolist(), b.tolist()) for a, b in zip(*rows, strict=True)] for rows in zip(labels, truth, strict=True)]
    torch.testing.assert_close(error, torch.tensor(expected, dtype=torch.float64))
    # one problem by itself
    assert float(misclassification(labels[1, 2], truth[1, 2])) == pytest.approx(expected[1][2])


def test_names_of_bodies_do_not_matter_but_outliers_are_no_body():
    truth = draw(4, 60)
    assert float(misclassification(torch.tensor([0, 3, 1, 2])[truth], truth)) == 0
    swapped = torch.tensor([1, 0, 2, 3])[truth]
    assert float(misclassification(swapped, truth)) == pytest.approx(float((truth < 2).double().mean()))
    # numbers that are not used change nothing
    assert float(misclassification(7 * truth, truth)) == 0


def test_empty_batches_and_other_integers():
    assert misclassification(torch.zeros(0, 5, dtype=torch.long), torch.zeros(0, 5, dtype=torch.long)).shape == (0,)
    assert float(misclassification(torch.tensor([1, 1], dtype=torch.uint8), torch.tensor([2, 2]))) == 0


@pytest.mark.parametrize(
    ("labels", "truth", "message"),
    [
        ([0, 1], [0, 1, 2], "one shape"),
        ([], [], "n >= 1"),
        ([0.0, 1.0], [0, 1], "labels must be integers"),
        ([0, 1], [0, -1], "truth must not be negative"),
    ],
)
def test_misuse_is_named(labels, truth, message):
    labels, truth = torch.tensor(labels), torch.tensor(truth)
    with pytest.raises(ValueError, match=message):
        misclassification(labels, truth)

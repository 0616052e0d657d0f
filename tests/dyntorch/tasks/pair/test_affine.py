"""Evidence, gauge and left-out predictions of the ridge regression against their definitions, by brute force."""

import math

import pytest
import torch

from dyntorch.tasks.pair.affine import (
    NOISE_FLOOR,
    NUM_FOLDS,
    Motions,
    Rows,
    column_ridges,
    combination_weights,
    information,
    leave_out_residuals,
    likelihood,
    peaks,
    refine_directions,
    regress,
)
from dyntorch.tasks.pair.tracks import match_tracks


def normal(*shape, seed=0):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def log_likelihood(x, y, ridge):
    """Of columns of y, ~ N(0, s2 (I + x x^T / ridge)), at the best s2, up to a constant."""
    cov = torch.eye(len(x), dtype=torch.float64) + x @ x.T / ridge
    energy = (y * torch.linalg.solve(cov, y)).sum()
    count = y.numel()
    return -0.5 * count * math.log(float(energy) / count) - 0.5 * y.shape[1] * float(torch.logdet(cov))


def test_evidence_and_predictions_are_those_of_their_definition():
    x, q = normal(30, 5), 0.3 * normal(5, 4, seed=1)
    y = x @ q + 0.4 * normal(30, 4, seed=2)
    found = regress(Rows.of(x[None], y[None]), means=False)
    ridge = float(found.ridge[0])
    assert abs(float(found.evidence[0]) - log_likelihood(x, y, ridge)) < 1e-8
    assert all(log_likelihood(x, y, ridge * factor) <= float(found.evidence[0]) for factor in (0.3, 3.0))
    assert 0.1 < float(found.variance[0]) < 0.25 and 0.5 < ridge < 6
    apart = column_ridges(x, y)
    for k in range(4):
        own = log_likelihood(x, y[:, k : k + 1], float(apart[k]))
        assert all(log_likelihood(x, y[:, k : k + 1], float(apart[k]) * factor) <= own + 1e-9 for factor in (0.1, 10.0))
    x, y = normal(23, 4), normal(23, 3, seed=1)
    ridge = torch.tensor([0.5, 2.0, 7.0], dtype=torch.float64)
    found = leave_out_residuals(x, y, ridge)
    for rows in torch.arange(23).chunk(NUM_FOLDS):
        rest = torch.tensor([t for t in range(23) if t not in rows.tolist()])
        for k in range(3):
            gram = x[rest].T @ x[rest] + ridge[k] * torch.eye(4, dtype=torch.float64)
            q = torch.linalg.solve(gram, x[rest].T @ y[rest, k])
            torch.testing.assert_close(found[rows, k], y[rows, k] - x[rows] @ q)


@pytest.mark.slow
def test_scale_and_offset_of_affine_combinations():
    weights = normal(6, 5)
    weights = weights + (1 - weights.sum(0)) / 6
    x, places = normal(40, 6, seed=1), 3 * normal(6, seed=2)
    y, other = 1.7 * x @ weights, 1.7 * places @ weights + 2.5
    rows = Rows.of(x[None], y[None], (places[None], other[None]))
    found = regress(rows, means=True)
    torch.testing.assert_close(found.gauge, torch.tensor([[2.5, 1.7]], dtype=torch.float64))
    torch.testing.assert_close(combination_weights(rows, found.ridge, found.gauge)[0], 1.7 * weights)


def pair(sigma=0.0):
    """Motions that share the coordinates along 40 and 115 degrees."""
    turns = [torch.tensor([[math.cos(a), math.sin(a)], [-math.sin(a), math.cos(a)]], dtype=torch.float64) for a in (0.7, 2.0)]
    shared, weights = normal(80, 4), normal(4, 9, seed=1)
    u, own = shared @ weights, normal(80, 9, seed=2)
    z = torch.stack([u, own], dim=-1)
    x, y = z[:, :5] @ turns[0], z[:, 5:] @ turns[1]
    x, y = (part + sigma * normal(*part.shape, seed=3 + k) for k, part in enumerate((x, y)))
    return Motions(x, y, sigma**2, 80.0, (normal(5, 2), normal(4, 2)))


def test_information_is_that_of_the_covariances_and_common_directions_are_found():
    motions = pair(0.3)
    angles = torch.tensor([[0.2, 1.1]], dtype=torch.float64)
    x, y = (part @ torch.stack([a.cos(), a.sin()]) for part, a in zip((motions.x, motions.y), angles[0], strict=True))
    both = torch.cat([x, y], dim=1)
    C = both.T @ both / 80 + NOISE_FLOOR * 0.09 * torch.eye(9, dtype=torch.float64)
    expected = 0.5 * (torch.logdet(C[:5, :5]) + torch.logdet(C[5:, 5:]) - torch.logdet(C))
    assert abs(float(information(motions, angles)[0] - expected)) < 1e-9
    for sigma, allowed in ((0.0, 1e-8), (0.05, 0.05)):
        motions = pair(sigma)
        best = peaks(motions)[0]
        found, level = refine_directions(motions, best)
        error = torch.sin(found - torch.tensor([0.7, 2.0], dtype=torch.float64)).abs().max()
        assert float(error) < allowed
        assert level >= float(likelihood(motions, best[None])[0])


def test_matches_need_to_be_near_and_alone():
    walk = normal(50, 5, 3).cumsum(0)
    far = walk[:, :1] + 0.2
    points = torch.cat([walk, walk[:, [3]] + 0.001 * normal(50, 1, 3), far * torch.nan, walk[:, :1] + 30], dim=1)
    matches, distances = match_tracks(points, 5, 0.01)
    assert matches.tolist() == [3, -1, -1] and bool(distances[:, 1].isnan().all())

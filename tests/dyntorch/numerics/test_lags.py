"""Sums at all lags against loops over the lags."""

import numpy as np
import pytest
import torch

from dyntorch.numerics import lags
from tests.grid import assert_refused, grid

WINDOWS = [
    (6, 6, None),
    (5, 9, None),
    (9, 5, (-3, 2)),
    (9, 9, (2, 4)),
    (9, 7, (-5, -3)),
    (6, 8, (-9, 11)),
    (4, 4, (10, 12)),
    (1, 1, None),
]


def normal(seed, *shape):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def span(frames1, frames2, window):
    return window or (1 - frames1, frames2 - 1)


def overlaps(frames1, frames2, window):
    """Of every lag the slices of both sequences, None where nothing overlaps."""
    lo, hi = span(frames1, frames2, window)
    for s in range(lo, hi + 1):
        begin, end = max(0, -s), min(frames1, frames2 - s)
        yield (slice(begin, end), slice(begin + s, end + s)) if end > begin else None


def products(a, b, window):
    """``(L, p, q)`` in numpy, one lag after the other."""
    a, b = a.numpy(), b.numpy()
    zero = np.zeros((a.shape[1], b.shape[1]))
    return torch.from_numpy(np.stack([a[w[0]].T @ b[w[1]] if w else zero for w in overlaps(len(a), len(b), window)]))


def assert_same(found, expected):
    assert found.shape == expected.shape and found.dtype == torch.float64
    assert (found - expected).abs().max() <= 1e-10 * expected.abs().max().clamp(min=1e-300)


@pytest.mark.parametrize(("frames1", "frames2", "window"), WINDOWS)
def test_products_equal_the_loop(frames1, frames2, window):
    a, b = normal(0, 2, 3, frames1, 3), normal(1, 2, 3, frames2, 2)
    found = lags.lag_products(a, b, window)
    expected = torch.stack([products(x, y, window) for x, y in zip(a.flatten(0, 1), b.flatten(0, 1), strict=True)])
    assert_same(found, expected.unflatten(0, (2, 3)))
    assert_same(lags.lag_products(a[0, 0], b, window)[1, 1], products(a[0, 0], b[1, 1], window))  # batches broadcast


@grid(
    ("window", [(-40, 30), (20, 45), (-60, -7), (0, 0)]), (("frames1", "frames2"), [(20000, 20000), (18000, 21000), (21000, 17500)])
)
def test_blocks_of_long_takes_equal_the_loop(frames1, frames2, window):
    a, b = normal(0, frames1, 2), normal(1, frames2, 2)
    assert lags._lengths(frames1, frames2, *window)[1] < frames1 / 3
    assert_same(lags.lag_products(a, b, window), products(a, b, window))


def test_pieces_for_memory_change_nothing(monkeypatch):
    a, b = normal(0, 2, 50, 7), normal(1, 2, 60, 5)
    expected = lags.lag_products(a, b, (-9, 9)), *lags.lag_covariances(a, b, (-9, 9))
    monkeypatch.setattr(lags, "ELEMENTS", 1)
    monkeypatch.setattr(lags, "MIN_PIECE", 4)
    found = lags.lag_products(a, b, (-9, 9)), *lags.lag_covariances(a, b, (-9, 9))
    for x, y in zip(found, expected, strict=True):
        assert_same(x, y)


def points(frames1, frames2, n, seed=0):
    """Points, weights with zeros (of whole frames too), and NaN where they are."""
    x1, x2 = normal(seed, frames1, n, 2), normal(seed + 1, frames2, n, 2) + 0.3
    generator = torch.Generator().manual_seed(seed)
    pairs = []
    for x in (x1, x2):
        w = torch.rand(x.shape[:-1], generator=generator, dtype=torch.float64)
        w[w < 0.3] = 0.0
        w[len(w) // 2] = 0.0
        x[w == 0] = torch.tensor([float("nan"), float("inf")], dtype=torch.float64)
        pairs.append(w)
    return x1, x2, tuple(pairs)


def moments(x1, x2, weights, window):
    """``(n, L, d, d)`` and ``(n, L)``, frame by frame."""
    n, found, counts = x1.shape[1], [], []
    for j in range(n):
        for pair in overlaps(len(x1), len(x2), window):
            d = len(epipolar(torch.zeros(2), torch.zeros(2)))
            total, count = torch.zeros(d, d, dtype=torch.float64), 0.0
            for i, k in zip(*(range(s.start, s.stop) for s in pair), strict=True) if pair else ():
                w = float(weights[0][i, j] * weights[1][k, j])
                if w > 0:
                    z = epipolar(x1[i, j], x2[k, j])
                    total, count = total + w * torch.outer(z, z), count + w
            found.append(total)
            counts.append(count)
    return torch.stack(found).reshape(n, -1, d, d), torch.tensor(counts, dtype=torch.float64).reshape(n, -1)


def one(x):
    return torch.cat([x, x.new_ones(1)])


def epipolar(x1, x2):
    return torch.outer(one(x2), one(x1)).flatten()


@pytest.mark.parametrize(("frames1", "frames2", "window"), WINDOWS)
def test_moments_equal_the_loop(frames1, frames2, window):
    x1, x2, weights = points(frames1, frames2, 3)
    expected, counts = moments(x1, x2, weights, window)
    for per_point, combine in ((True, lambda t: t), (False, lambda t: t.sum(0))):
        found, number = lags.epipolar_moments(x1, x2, window, weights, per_point=per_point)
        assert_same(found, combine(expected))
        assert_same(number, combine(counts))
        # nothing seen in common is exactly zero, not rounding
        assert torch.equal(number == 0, combine(counts) == 0) and (found[number == 0] == 0).all()


def test_without_weights_what_is_not_finite_is_missing():
    x1, x2, weights = points(8, 9, 4)
    found, counts = lags.epipolar_moments(x1, x2)
    expected, number = lags.epipolar_moments(x1, x2, weights=tuple((w > 0).double() for w in weights))
    assert torch.equal(found, expected) and torch.equal(counts, number)
    assert torch.equal(lags.epipolar_moments(x1, x2, weights=(torch.ones(8, 4), torch.ones(9, 4)))[0], expected)
    assert torch.equal(counts, counts.round())


def test_batches_of_moments_equal_single_ones():
    sets = [points(7, 6, 2, seed) for seed in (0, 10, 20)]
    x1, x2, w1, w2 = (torch.stack(part) for part in zip(*((a, b, *w) for a, b, w in sets), strict=True))
    for per_point in (False, True):
        found, counts = lags.epipolar_moments(x1, x2, (-3, 3), (w1, w2), per_point=per_point)
        for k, (a, b, w) in enumerate(sets):
            expected, number = lags.epipolar_moments(a, b, (-3, 3), w, per_point=per_point)
            assert_same(found[k], expected)
            assert_same(counts[k], number)


def test_moments_of_long_takes_equal_those_of_the_whole(monkeypatch):
    x1, x2, weights = points(9000, 9100, 2)
    found, counts = lags.epipolar_moments(x1, x2, (-20, 20), weights)
    monkeypatch.setattr(lags, "_lengths", lambda frames1, frames2, lo, hi: (18_432, frames1))
    expected, number = lags.epipolar_moments(x1, x2, (-20, 20), weights)
    assert_same(found, expected)
    assert_same(counts, number)


def covariances(a, b, window, weights=None):
    """numpy.cov of every overlap."""
    w1, w2 = weights or (torch.ones(len(a)), torch.ones(len(b)))
    p, found, counts = a.shape[1], [], []
    for pair in overlaps(len(a), len(b), window):
        shared = (w1[pair[0]] * w2[pair[1]]).double() if pair else torch.zeros(0)
        seen = shared > 0
        counts.append(float(shared.sum()))
        if not seen.any():
            found.append(torch.zeros(p + b.shape[1], p + b.shape[1], dtype=torch.float64))
            continue
        joint = torch.cat([a[pair[0]][seen], b[pair[1]][seen]], dim=-1)
        found.append(torch.from_numpy(np.cov(joint.mT.numpy(), ddof=0, aweights=shared[seen].numpy())))
    joint = torch.stack(found)
    return joint[:, :p, :p], joint[:, p:, p:], joint[:, :p, p:], torch.tensor(counts, dtype=torch.float64)


@pytest.mark.parametrize(("frames1", "frames2", "window"), [*WINDOWS, (300, 280, (-20, 9)), (60, 200, None)])
@pytest.mark.parametrize("weighted", [False, True])
def test_covariances_equal_those_of_every_overlap(frames1, frames2, window, weighted):
    a, b = normal(0, 2, frames1, 3) + 1000.0, normal(1, 2, frames2, 2) - 500.0
    weights = None
    if weighted:
        weights = tuple((normal(seed, 2, x.shape[1]).abs() - 0.4).clamp(min=0.0) for seed, x in ((2, a), (3, b)))
        for x, w in zip((a, b), weights, strict=True):
            x[w == 0] = float("nan")
    *found, counts = lags.lag_covariances(a, b, window, weights)
    for k in range(2):
        *expected, number = covariances(a[k], b[k], window, weights and tuple(w[k] for w in weights))
        assert_same(counts[k] if weighted else counts, number)
        for x, y in zip(found, expected, strict=True):
            assert (x[k] - y).abs().max() < 1e-10


def test_compression_keeps_what_is_above_the_noise():
    mixed = normal(0, 500, 3) @ normal(1, 3, 12) + 7.0
    noisy = mixed + 1e-3 * normal(2, 500, 12)
    by_noise, by_rank = lags.compress(noisy, noise=3e-3), lags.compress(noisy, rank=3)
    assert by_noise.shape == (500, 3) and torch.equal(by_noise, by_rank)
    assert by_rank.mean(0).abs().max() < 1e-12
    u, s, _ = torch.linalg.svd(noisy - noisy.mean(0), full_matrices=False)
    assert_same(by_rank @ by_rank.T, (u[:, :3] * s[:3].square()) @ u[:, :3].T)
    assert lags.compress(torch.zeros(2, 5, 4), noise=1.0).shape == (2, 5, 1)
    assert lags.compress(normal(3, 500, 3) * torch.tensor([1.0, 0.2, 0.01]), noise=0.1).shape == (
        500,
        2,
    )  # no variance


X = torch.zeros(4, 3, 2)


def test_misuse_says_what_to_do():
    assert_refused(
        (lambda: lags.lag_products(torch.zeros(0, 2), torch.zeros(3, 2)), r"at least one frame"),
        (lambda: lags.lag_products(torch.zeros(3), torch.zeros(3, 2)), r"at least one frame"),
        (lambda: lags.lag_products(torch.zeros(3, 2), torch.zeros(3, 2), (2, 1)), r"first <= last, got \(2, 1\)"),
        (lambda: lags.epipolar_moments(X, X[:, :2]), r"same points in both cameras"),
        (lambda: lags.epipolar_moments(X, X, weights=(torch.ones(4, 3), torch.ones(3, 3))), r"weights must be \(4, 3\)"),
        (lambda: lags.epipolar_moments(X, X, weights=(torch.ones(4, 3), -torch.ones(4, 3))), r"not negative"),
        (lambda: lags.lag_covariances(X[0], X[0], weights=(torch.ones(2), torch.ones(3))), r"weights must be .*one per frame"),
        (lambda: lags.resection_moments(X.mT, X), r"frames, n, 2\) in a camera and \(\*batch, frames, n, 3\) in space"),
        (lambda: lags.compress(X), r"either rank or noise"),
        (lambda: lags.compress(X, rank=3), r"rank must be from 1 to the 2 rows, got 3"),
    )


def test_the_engine_lifts_blocks_not_sequences():
    seen = []

    def lift(x):
        seen.append(x.shape[1])
        return x.movedim(1, -1)

    x = normal(0, 1, 20_000, 1, 1)
    lags.correlate(x, x, (-5, 5), lift)
    assert max(seen) <= 2048


@pytest.mark.parametrize("per_point", [False, True])
def test_resection_moments_equal_the_loop(per_point):
    x, X, w1, w2 = normal(20, 7, 3, 2), normal(21, 9, 3, 3), normal(22, 7, 3).abs(), normal(23, 9, 3).abs()
    w1[2, 1], w2[4] = 0.0, 0.0
    x[2, 1], X[3, 2] = torch.nan, torch.inf
    found, counts = lags.resection_moments(x, X, None, (w1, w2), per_point)
    w1, w2 = (torch.where(y.isfinite().all(-1), w, 0.0) for y, w in ((x, w1), (X, w2)))
    x, X = (torch.where(w[..., None] > 0, y, 0.0) for y, w in ((x, w1), (X, w2)))
    X = torch.cat([X, torch.ones(9, 3, 1)], -1)
    of_image = torch.stack([torch.ones(7, 3), x[..., 0], x[..., 1], x.square().sum(-1)], -1)
    for k, window in enumerate(overlaps(7, 9, None)):
        a, b = window
        w = w1[a] * w2[b]
        expected = torch.einsum("tn,tnk,tni,tnj->nkij", w, of_image[a], X[b], X[b])
        assert_same(found[:, k] if per_point else found[k], expected if per_point else expected.sum(0))
        assert torch.allclose(counts[:, k] if per_point else counts[k], w.sum(0) if per_point else w.sum())

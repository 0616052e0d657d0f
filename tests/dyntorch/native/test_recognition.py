"""The kernel of recognition against its definitions, on every instruction set of this processor."""

from itertools import combinations

import numpy as np
import torch

from dyntorch.native import library, recognition
from dyntorch.numerics import native_correlations, native_deviations, native_residuals
from indexing.action.bank import EPSILON, factorize, fuse_terms
from tests.draws import random
from tests.dyntorch.native.test_library import compiled, levels


def line_deviation(places, times, own, near):
    """Of one sighting, by the definition; all sorted whole."""
    slopes = [(places[b] - places[a]) / (times[b] - times[a]) for a, b in combinations(near, 2) if b - a > 1]
    rest = places[near] - np.quantile(slopes, 0.5, axis=0, method="lower") * (times[near] - times[own])[:, None]
    middle = np.quantile(rest, 0.5, axis=0, method="lower")
    return np.abs(places[own] - middle), 1.4826 * np.quantile(np.abs(rest - middle), 0.5, axis=0, method="lower")


@compiled
def test_deviations_are_those_of_sorting_everything(monkeypatch):
    draw, wrong = np.random.default_rng(0), []
    places, times = draw.normal(size=(60, 3)).cumsum(0), draw.uniform(0.01, 0.1, 60).cumsum()
    rows, cuts = np.sort(draw.permutation(60)[:37]), np.array([0, 8, 13, 40, 60])
    expected = []
    for row in rows:
        begin, end = cuts[cuts <= row].max(), cuts[cuts > row].min()
        first = max(begin, min(row - 4, end - 9))
        expected.append(line_deviation(places, times, row, np.arange(first, min(first + 9, end))))
    for level in levels(monkeypatch):
        monkeypatch.setattr(recognition, "load", library.load)
        for offset in (0.0, 1e6):  # a sighting is compared with its neighbours, wherever the origin is
            out = np.empty((37, 3), np.float32), np.empty((37, 3), np.float32)
            assert native_deviations(places + offset, times, rows, cuts, 9, out)
            error = np.abs(np.stack(out, axis=1) - np.array(expected)).max()
            wrong += [(level, offset, error)] if error > 1e-5 else []
    assert wrong == []
    assert not native_deviations(places, times, rows, cuts, recognition.WIDTH + 1, out)


@compiled
def test_residuals_of_all_pairs_are_those_of_torch(monkeypatch):
    """Any numbers of queries and exemplars, tables that hold less already, exemplars in some columns."""
    wrong = []
    for level in levels(monkeypatch):
        monkeypatch.setattr(recognition, "load", library.load)
        for queries, exemplars, sizes in ((1, 1, (5,)), (7, 33, (40, 17, 3)), (4, 70, (24, 24, 20)), (6, 70, (9, 33, 20))):
            left, right = (
                [part.float() for i, size in enumerate(sizes) for part in factorize(random(count, 2, size, seed=i + seed))]
                for count, seed in ((queries, 0), (exemplars, 9))
            )
            for fusions in ([("epi",)], [("epi", "nn")], [("epi",), ("turned",)]):
                expected = fuse_terms(left, right, fusions, [1.0] * len(sizes), EPSILON)
                columns = torch.randperm(exemplars + 3, generator=torch.Generator().manual_seed(0))[:exemplars]
                tables = [torch.full((queries, exemplars + 3), 0.8) for _ in fusions]
                done = native_residuals(left, right, fusions, EPSILON, tables, columns)
                if not done:
                    assert level == "base"
                    continue
                for table, truth in zip(tables, expected, strict=True):
                    full = torch.full_like(table, 0.8)
                    full[:, columns] = truth.clamp(max=0.8)
                    error = float((table.log() - full.log()).abs().max())
                    wrong += [(level, queries, exemplars, fusions, error)] if error > 2e-3 else []
    assert wrong == []
    double = [part.double() for part in left]
    assert not native_residuals(double, right, fusions, EPSILON, tables)


@compiled
def test_correlations_of_windows_are_those_of_their_planes(monkeypatch):
    """Of windows in a row and of any, more than a block of the kernel and few, by the definition in numpy."""
    draw, wrong = np.random.default_rng(1), []
    for samples, stride, probes, k in ((4, 3, 2, 5), (16, 1, 1, 5), (4, 3, 2, 8), (5, 2, 1, 8)):
        codes, scales = draw.integers(-127, 128, (700, 2, k)).astype(np.int8), draw.uniform(0.01, 0.02, 700).astype(np.float32)
        poses = codes * scales[:, None, None].astype(float)
        axes = np.linalg.qr(draw.normal(size=(probes, samples * k, 2)))[0].transpose(0, 2, 1).reshape(probes, 2, samples, k)
        axes = np.ascontiguousarray(axes, dtype=np.float32)
        rows = draw.integers(0, 700 - samples * stride, 90)
        for first in (rows, rows[:3], 5):
            begins = 5 + stride * np.arange(150) if isinstance(first, int) else first
            window = poses[begins[:, None] + stride * np.arange(samples)].transpose(0, 2, 1, 3).reshape(len(begins), 2, -1)
            basis = np.linalg.qr(window.transpose(0, 2, 1))[0]
            products = np.einsum("wfd,pef->pwde", basis, axes.reshape(probes, 2, -1))
            expected = np.linalg.svd(products, compute_uv=False)[..., 0] ** 2
            for level in levels(monkeypatch):
                monkeypatch.setattr(recognition, "load", library.load)
                out = np.empty((probes, len(begins)), np.float32)
                assert native_correlations(codes, scales, axes, stride, first, 1e-6, out)
                error = np.abs(out - expected).max()
                wrong += [(level, samples, len(begins), error)] if error > 1e-4 else []
    assert wrong == []
    assert not native_correlations(codes, scales.astype(float), axes, 1, rows, 1e-6, out)

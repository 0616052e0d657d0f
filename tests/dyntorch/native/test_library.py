"""The kernel against eigh and its own neighbours, on every instruction set of this processor; and what stands in for it."""

from pathlib import Path

import pytest
import torch

import dyntorch as dyn
from dyntorch import scenes
from dyntorch.core.consensus import Search
from dyntorch.core.fit import fit_matches
from dyntorch.core.kernel_fit import refined_kinds
from dyntorch.core.matches import matches
from dyntorch.core.refine import descend, move_to
from dyntorch.core.robust import _polish_by_kernel, distances
from dyntorch.native import build, library
from dyntorch.numerics import native
from dyntorch.numerics.eigenspaces import RESOLVED
from dyntorch.numerics.nullspace import gram_null_space, null_space
from tests.draws import random, seeded

compiled = pytest.mark.skipif(not library.LIBRARY.exists(), reason="no C compiler when this was installed")


def levels(monkeypatch):
    """Each instruction set that this processor has, in turn."""
    for level in library.INSTRUCTIONS:
        monkeypatch.setenv("DYNTORCH_NATIVE", level)
        functions, name = library.load.__wrapped__()
        if functions:
            monkeypatch.setattr(library, "load", lambda functions=functions, name=name: (functions, name))
            yield level
            monkeypatch.undo()


def grams(batch, size, dim, seed=0):
    """Grams of rows whose last singular values are a tenth of the one before, and the rows."""
    left, right = (
        torch.linalg.qr(random(batch, 2 * size, size, seed=seed)).Q,
        torch.linalg.qr(random(batch, size, size, seed=seed + 1)).Q,
    )
    values = torch.linspace(1, 0.2, size, dtype=torch.float64)
    values[size - dim :] *= 0.1
    rows = (left * values) @ right.mT
    return rows.mT @ rows, rows


@compiled
def test_null_spaces_are_those_of_eigh(monkeypatch):
    wrong = []
    for level in levels(monkeypatch):
        for size, dim in ((4, 1), (9, 1), (10, 3), (27, 1), (30, 5), (36, 2), (64, 1)):
            gram, rows = grams(11, size, dim)
            values, vectors = torch.linalg.eigh(gram)
            basis, residual, total, following, certified = library.null_of_grams(gram, dim)
            apart = (vectors[..., :dim] - basis.mT @ (basis @ vectors[..., :dim])).norm(dim=(-2, -1)).max()
            trace = gram.diagonal(dim1=-2, dim2=-1).sum(-1)
            errors = (
                apart,
                (residual - values[:, :dim]).abs().max(),
                (total * values[:, dim] - (values[:, dim, None] / values[:, dim:]).sum(-1)).abs().max() / 1e3,
                (1 - following * trace / values[:, dim]).clamp(min=0).max(),  # from above
            )
            by_rows, _, sure, kept = library.null_of_rows(rows, dim, always=False, keep=True)
            errors += (
                (vectors[..., :dim] - by_rows.mT @ (by_rows @ vectors[..., :dim])).norm(dim=(-2, -1)).max(),
                (kept - gram).abs().max(),
            )
            if not (certified.all() and sure.all() and max(map(float, errors)) < 1e-10):
                wrong.append((level, size, dim, [float(e) for e in errors]))
    assert wrong == []


@compiled
def test_what_is_not_finite_or_not_decided_spoils_no_neighbour(monkeypatch):
    for level in levels(monkeypatch):
        gram, _ = grams(16, 9, 1)
        sound = library.null_of_grams(gram, 1)
        bad = gram.clone()
        bad[1, 2, 3] = bad[1, 3, 2] = torch.nan
        bad[4], bad[6], bad[9, 0, 0] = 0.0, torch.inf, -torch.inf
        bad[11] = torch.diag(torch.tensor([1.0, 1, 1, 1, 1, 1, 1, 0, 0], dtype=torch.float64))
        found = library.null_of_grams(bad, 1)
        accepted = found[4] & (found[3] > RESOLVED)
        assert (~accepted).nonzero()[:, 0].tolist() == [1, 4, 6, 9, 11], level
        assert all(torch.equal(part[accepted], expected[accepted]) for part, expected in zip(found, sound, strict=True)), level


def test_both_paths_say_the_same_of_every_matrix(monkeypatch):
    gram, rows = grams(40, 12, 2)
    gram[3], gram[5, 0, 0], rows[3], rows[5, 0, 0] = 0.0, torch.nan, 0.0, torch.nan
    gram[7] = torch.diag(torch.tensor([1.0] * 9 + [0.0] * 3, dtype=torch.float64))
    space, basis = gram_null_space(gram, 2), null_space(rows, 2)
    monkeypatch.setattr(library, "load", lambda: ({}, "torch"))
    other, reference = gram_null_space(gram, 2), null_space(rows, 2)
    assert space.degenerate.tolist() == other.degenerate.tolist() and space.degenerate.sum() == 3
    sound = ~space.degenerate
    torch.testing.assert_close(space.basis[sound], other.basis[sound], rtol=0, atol=1e-11)
    torch.testing.assert_close(space.residual, other.residual)
    torch.testing.assert_close(space.competing[sound], other.competing[sound])
    keep = torch.arange(40) != 3
    torch.testing.assert_close(basis[keep].mT @ basis[keep], reference[keep].mT @ reference[keep], rtol=0, atol=1e-11)


def searched(invariant, n=60, batch=3):
    """Noisy matches of order 1 with wrong ones among them, in the normalized coordinates of a search."""
    if isinstance(invariant, dyn.FundamentalMatrix):
        views = tuple(x / 300 - 1 for x in scenes.two_view(n=n, batch=batch, sigma=0.5, outliers=0.3, generator=seeded(0)).views)
    elif isinstance(invariant, dyn.HomographyTensor):
        views = tuple(x / 300 - 1 for x in scenes.planar(n=n, batch=batch, sigma=0.5, outliers=0.3, generator=seeded(0)).views)
    else:
        x = random(batch, n, invariant.n)
        change = torch.eye(invariant.n + 1, dtype=torch.float64) + 0.1 * random(batch, invariant.n + 1, invariant.n + 1, seed=1)
        views = invariant.transfer(change, x) + 1e-3 * random(batch, n, invariant.n, seed=2), x
        views[0][:, ::4] += 0.5 * random(batch, n, invariant.n, seed=3)[:, ::4]
    return Search(invariant, matches(invariant, views), seeded(0))


@compiled
@pytest.mark.parametrize(
    "invariant", [dyn.FundamentalMatrix(), dyn.Collineation(2), dyn.Collineation(3), dyn.HomographyTensor()], ids=repr
)
def test_distances_evidence_and_descent_are_those_of_torch(invariant, monkeypatch):
    cut = torch.full((3,), 0.02, dtype=torch.float64)
    answers = []

    def answer():
        search = searched(invariant)
        solution = fit_matches(invariant, search.data)
        motion = solution.normalized_motion()
        start, end = (descend(solution, search.data, motion, steps) for steps in (0, 30))
        found = move_to(solution, motion, end).normalized.flatten(1)
        # what the motion leaves open differs by rounding, so of where the descent ends only the tensor and its cost are the same
        own = distances(solution), search.evidence(solution.normalized, cut), start.cost, *start.terms, end.cost
        answers.append((*own, found[:, :, None] * found[:, None]))
        return bool(search.kinds)

    assert all(answer() for _ in levels(monkeypatch))
    monkeypatch.setattr(library, "load", lambda: ({}, "torch"))
    assert not answer()
    for found in answers[:-1]:
        for part, other in zip(found, answers[-1], strict=True):
            torch.testing.assert_close(part, other, rtol=1e-6, atol=1e-6 * float(other.abs().max()))


@compiled
def test_samples_are_distinct_matches_with_weight_and_annealing_finds_their_tensor(monkeypatch):
    """Among sixty percent of wrong matches a search from samples ends at the right tensor, which one from all does not reach."""
    next(levels(monkeypatch))  # also where torch was asked for
    search = searched(dyn.Collineation(2), n=80, batch=20)
    search.weights[:, :2] = 0
    seeds, limit = torch.arange(20), torch.full((20,), 1e-2, dtype=torch.float64)
    numbers = {"starts": 64, "keep": 2, "iterations": 10, "mode": library.FROM_SAMPLES}
    found, again = (search._by_kernel(search.everyone, limit, seeds, **numbers) for _ in range(2))
    assert torch.equal(found.basis, again.basis)
    right = torch.ones(80, dtype=torch.bool)
    right[::4] = right[:2] = False
    assert found.inliers[:, right].double().mean() > 0.98 and found.inliers[:, ::4].double().mean() < 0.1


@compiled
def test_subsets_guided_by_motions_find_homography_tensors(monkeypatch):
    """Half of the matches wrong: 16 subsets, which one start in four follows without a guide, end at the right tensors."""
    scene = scenes.planar(n=200, batch=3, sigma=0.5, outliers=0.5, generator=seeded(3))
    right, limit = scene.labels != 0, torch.full((3,), 1.7, dtype=torch.float64)
    for level in levels(monkeypatch):
        search = Search(dyn.HomographyTensor(), matches(dyn.HomographyTensor(), scene.views), seeded(0))
        found, again = (search._solve(search.everyone, limit * search.unit, 16) for _ in range(2))
        assert search.kinds and torch.equal(found.basis, again.basis), level
        assert ((found.inliers & right).sum(-1) >= 0.9 * right.sum(-1)).all() and (found.evidence < 0).all(), level


@compiled
def test_estimated_thresholds_are_those_of_torch_on_average(monkeypatch):
    """From other random subsets: that of one scene differs by a third from seed to seed, on either path."""
    scene = scenes.planar(n=100, batch=8, sigma=0.5, outliers=0.1, generator=seeded(5))
    data = matches(dyn.HomographyTensor(), scene.views)
    found = [Search(dyn.HomographyTensor(), data, seeded(0)).scale().log().mean() for _ in levels(monkeypatch)]
    monkeypatch.setattr(library, "load", lambda: ({}, "torch"))
    expected = Search(dyn.HomographyTensor(), data, seeded(0)).scale().log().mean()
    assert all(abs(mean - expected) < 0.2 for mean in found), (found, expected)


@compiled
def test_polish_of_a_homography_tensor_starts_from_the_motion_of_decompose(monkeypatch):
    """Without a step the motion of the kernel is that of the tensor; with steps both paths end at one tensor."""
    next(levels(monkeypatch))
    scene = scenes.planar(n=80, batch=4, sigma=0.5, outliers=0.2, generator=seeded(1))
    exact = scenes.planar(n=40, batch=4, generator=seeded(2))
    data = matches(dyn.HomographyTensor(), exact.views)
    search, cut = Search(dyn.HomographyTensor(), data, seeded(0)), torch.full((4,), 1.0, dtype=torch.float64)
    found, _ = _polish_by_kernel(search, search.run(cut, (1,)), cut, (0,), refined_kinds(search.invariant, data))
    for part, other in zip(found.refined, search.invariant.decompose(found.normalized), strict=True):
        torch.testing.assert_close(part, other, rtol=0, atol=1e-8)
    answers = []
    for level in ("native", "torch"):
        if level == "torch":
            monkeypatch.setattr(library, "load", lambda: ({}, "torch"))
        answers.append(dyn.robust_fit(dyn.HomographyTensor, *scene.views, threshold=1.7, generator=seeded(0)))
    tensors, covariances = (
        [part / part.norm() for part in parts] for parts in zip(*((a.tensor, a.covariance) for a in answers), strict=True)
    )
    assert torch.equal(answers[0].inliers, answers[1].inliers)
    torch.testing.assert_close(tensors[0].abs(), tensors[1].abs(), rtol=0, atol=1e-7)
    torch.testing.assert_close(covariances[0], covariances[1], rtol=1e-4, atol=1e-8)


def test_without_a_kernel_one_line_says_why(monkeypatch, tmp_path):
    """A compiler that fails, one that is not there, a place that cannot be written; a library of another processor or version."""
    assert native().startswith(("native (", "torch ("))
    monkeypatch.setenv("CC", "false")
    assert "false: exit code 1" in build.compile_library(tmp_path / "kernel.so") and not list(tmp_path.iterdir())
    monkeypatch.setenv("CC", "no-such-compiler")
    assert build.compile_library(tmp_path / "kernel.so") == "no C compiler named no-such-compiler"
    monkeypatch.delenv("CC")
    monkeypatch.setattr(build.shutil, "which", lambda name: name)
    monkeypatch.setattr(build, "_run", lambda command: (Path(command[command.index("-o") + 1]).write_text("") and "") or "")
    assert (reason := build.compile_library(tmp_path / "none" / "kernel.so")) and "\n" not in reason
    broken = tmp_path / "kernel.so"
    monkeypatch.setattr(library, "LIBRARY", broken)
    for words, wanted in {"DYNTORCH_NATIVE=0": "0", "not compiled": "", "cannot be loaded": ""}.items():
        if words == "cannot be loaded":
            broken.write_bytes(b"\x7fELF of another processor")
        monkeypatch.setenv("DYNTORCH_NATIVE", wanted)
        functions, sentence = library.load.__wrapped__()
        assert not functions and sentence.startswith("torch (") and words in sentence and "\n" not in sentence


@compiled
def test_a_library_of_another_version_is_not_used(monkeypatch):
    monkeypatch.setenv("DYNTORCH_NATIVE", "sse9")
    assert "sse9 is none of 0" in library.load.__wrapped__()[1]
    monkeypatch.setattr(library, "source_digest", lambda: "another")
    functions, sentence = library.load.__wrapped__()
    assert not functions and "made from another version" in sentence

"""The kernel against eigh and its own neighbours, on every instruction set of this processor; and what stands in for it."""

from pathlib import Path

import pytest
import torch

from dyntorch.native import build, library
from dyntorch.numerics import native
from dyntorch.numerics.eigenspaces import RESOLVED
from dyntorch.numerics.nullspace import gram_null_space, null_space
from tests.draws import random

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

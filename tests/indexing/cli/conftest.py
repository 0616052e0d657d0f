"""The files of ``dyntorch demo --examples``, and each command on them, run once for all tests that look at what it said."""

from __future__ import annotations

import contextlib
import io
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import pytest

from indexing.cli import main


@dataclass(frozen=True)
class Outcome:
    """What a command said, and the folder in which it ran."""

    code: int
    out: str
    err: str
    folder: Path


@pytest.fixture(scope="session")
def outcome(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Outcome]:
    """Runs a line in the folder of the examples; the same line again is answered from memory."""
    folder = tmp_path_factory.mktemp("examples")

    @cache
    def run(line: str) -> Outcome:
        out, err = io.StringIO(), io.StringIO()
        with contextlib.chdir(folder), contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            code = main(line.split())
        return Outcome(code, out.getvalue(), err.getvalue(), folder)

    assert run("demo --examples .").code == 0
    return run

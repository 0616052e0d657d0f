"""Every statement of the thesis is measured again, and comes out as the page says."""

from __future__ import annotations

import pytest

from experiments.thesis.checked import CHAPTERS
from experiments.thesis.statements import Chapter, Finding, Statement

SLOW = {("3", "ambiguity"), ("6", "noise"), *(("7", name) for name in ("synchronization", "planar", "outliers", "reconstruction"))}
"""Statements on noise and on whole tasks: chapter and measurement."""


def statements():
    every = [(chapter, statement) for chapter in CHAPTERS for statement in chapter.statements]
    for number, (chapter, statement) in enumerate(every):
        name = statement.measure.__name__
        slow = pytest.mark.slow if (str(chapter.number), name) in SLOW else ()
        yield pytest.param(chapter, statement, id=f"{chapter.number}-{name}-{number}", marks=slow)


@pytest.mark.parametrize(("chapter", "statement"), list(statements()))
def test_a_statement_comes_out_as_the_page_says(chapter: Chapter, statement: Statement) -> None:
    *_, measured, verdict = statement.row()
    assert verdict != "FAILS", f"{statement.place}: {statement.says}: {measured}"


def test_chapters_state_something_and_contradictions_fail() -> None:
    holds, breaks = (Statement("1, p. 1", "one", lambda value=value: Finding(value, "")) for value in (True, False))
    corrected = Statement("1, p. 1", "one", breaks.measure, "two")
    surprising = Statement("1, p. 1", "one", holds.measure, "two")
    assert [s.row()[-1] for s in (holds, breaks, corrected, surprising)] == ["holds", "FAILS", "wrong as printed: two", "FAILS"]
    assert [chapter.number for chapter in CHAPTERS] == list(range(1, 11))
    assert all(chapter.statements for chapter in CHAPTERS)

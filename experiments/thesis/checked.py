"""The thesis, checked: every statement of all chapters beside what is measured on data made from its own definitions.

    python -m experiments.thesis.checked

One chapter alone: ``python -m experiments.thesis.checked --chapters 8``.
"""

from __future__ import annotations

from dataclasses import dataclass

from experiments.common.runner import BaseConfig, Tables, Words, experiment
from experiments.thesis import chapter1, chapter2, chapter3, chapter4, chapter5, chapter6, chapter7, chapter8, chapter9, chapter10
from experiments.thesis.statements import HEAD

MODULES = (chapter1, chapter2, chapter3, chapter4, chapter5, chapter6, chapter7, chapter8, chapter9, chapter10)
CHAPTERS = tuple(module.CHAPTER for module in MODULES)


@dataclass(frozen=True)
class Config(BaseConfig):
    """The statements of the thesis."""

    chapters: tuple[int, ...] = tuple(range(1, 11))
    """Which chapters."""


@experiment(Config(), quick={"chapters": (1,)})
def tables(config: Config) -> Tables:
    """Chapter by chapter.

    Raises:
        SystemExit: code 1, a statement fails.
    """
    verdicts: list[str] = []
    for chapter in CHAPTERS:
        if chapter.number in config.chapters:
            words = Words(HEAD, chapter.rows())
            verdicts += [line[-1] for line in words.lines]
            yield f"Chapter {chapter.number}: {chapter.title}", words
    wrong = sum(verdict.startswith("wrong") for verdict in verdicts)
    failed, held = verdicts.count("FAILS"), verdicts.count("holds")
    answered = sum(verdict.startswith("open") for verdict in verdicts)
    summary = f"{held} hold, {wrong} are wrong as printed, {answered} were open and are answered, {failed} fail"
    yield "", f"{len(verdicts)} statements: {summary}"
    if failed:
        raise SystemExit(1)

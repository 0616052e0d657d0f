"""What the thesis states, and what comes of it: the parts that the scripts of all chapters share.

A chapter is a list of functions; each makes data from the thesis's own words, measures, and says whether the statement holds.  A
statement that is wrong as printed carries its correction, and is checked to be wrong: FAILS is an error of
ours.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

from experiments.common.tables import note

HEAD = ("where", "the thesis", "measured", "verdict")


@dataclass(frozen=True)
class Finding:
    """What was measured, in words with figures, and whether the statement holds as the thesis prints it."""

    holds: bool
    measured: str


@dataclass(frozen=True)
class Statement:
    """One sentence of the thesis.

    ``place`` is its section and its page; ``says`` is the sentence in our words; ``correction`` is what is right where the printed
    sentence is not, and empty otherwise; ``answer`` is what has come of a question that it leaves open; ``measure`` makes the
    data and looks.
    """

    place: str
    says: str
    measure: Callable[[], Finding]
    correction: str = ""
    answer: str = ""

    def row(self) -> tuple[str, str, str, str]:
        """The statement measured: its line of the table."""
        found = self.measure()
        return self.place, self.says, found.measured, self.verdict(found)

    def verdict(self, found: Finding) -> str:
        """``holds``, ``wrong as printed: ...`` with the correction, or ``FAILS`` where the measurement says otherwise."""
        if found.holds != (not self.correction):
            return "FAILS"
        if self.answer:
            return f"open there, answered here: {self.answer}"
        return f"wrong as printed: {self.correction}" if self.correction else "holds"


@dataclass
class Chapter:
    """The statements of a chapter, in its order."""

    number: int
    title: str
    statements: list[Statement] = field(default_factory=list)

    def states(
        self, place: str, says: str, correction: str = "", answer: str = ""
    ) -> Callable[[Callable[[], Finding]], Callable[[], Finding]]:
        """A decorator: the function below measures this statement."""

        def keep(measure: Callable[[], Finding]) -> Callable[[], Finding]:
            self.statements.append(Statement(place, says, measure, correction, answer))
            return measure

        return keep

    def rows(self) -> list[tuple[str, str, str, str]]:
        """Its statements, measured; each draws from generators of its own, so that it gives the same alone and among the others."""
        rows = []
        for statement in self.statements:
            note(f"... chapter {self.number}: {statement.says}")
            rows.append(statement.row())
        return rows

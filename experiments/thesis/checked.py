"""The thesis, checked: every statement of all chapters beside what is measured on data made from its own definitions.

    python -m experiments.thesis.checked

One chapter alone: ``python -m experiments.thesis.chapter8``.
"""

from __future__ import annotations

from experiments.common.tables import command
from experiments.thesis import chapter1, chapter2, chapter3, chapter4, chapter5, chapter6, chapter7, chapter8, chapter9, chapter10
from experiments.thesis.statements import main

MODULES = (chapter1, chapter2, chapter3, chapter4, chapter5, chapter6, chapter7, chapter8, chapter9, chapter10)
CHAPTERS = tuple(module.CHAPTER for module in MODULES)

if __name__ == "__main__":
    command(lambda: main(CHAPTERS))

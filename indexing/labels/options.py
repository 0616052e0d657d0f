"""The numbers that decide about labels."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class LabelOptions:
    """What is let pass without a word, and where reading stops."""

    slack: float = 0.1
    """Seconds that a label may reach beyond its recording without a word: players stop some frames before or after the last one."""
    named: int = 3
    """Examples that a notice names."""
    deepest: int = 64
    """Elements of an ELAN file inside each other, at most: ELAN writes five."""
    elements: int = 20_000_000
    """Elements of an ELAN file at most: a million annotations take five million."""

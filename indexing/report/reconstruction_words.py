"""What the notices of a reconstruction mean, in plain words."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence

Candidate = tuple[str, float, float, str]
HEADINGS = {"weak_stack": "views too alike", "behind": "points behind a camera"}
MEANING = {
    "weak_stack": (
        "Where and how fast a point moves is found from the differences between the views; here they hardly differ in one respect, "
        "so that a small error of a track becomes a large error of its point."
    ),
    "behind": (
        "No camera sees what is behind it: the places found for these points, or for that camera, are wrong, however well they fit."
    ),
}


def heading(code: str) -> str:
    """What a notice is about.

    Example:
        >>> heading("weak_stack"), heading("static_scene")
        ('views too alike', 'static scene')
    """
    return HEADINGS.get(code, code.replace("_", " "))


def one(message: str) -> str:
    """A message with the singular where its number is 1.

    Example:
        >>> one("1 points are behind a camera"), one("11 points are behind a camera")
        ('1 point is behind a camera', '11 points are behind a camera')
    """
    return re.sub(r"\b(?<![\d.,])1 (\w+)s are\b", r"1 \1 is", message)


def left_out(candidates: Sequence[Candidate]) -> str:
    """Which models were not tried and why, and which were without success; empty where all were compared.

    Example:
        >>> left_out([("a", 1.0, 0.1, ""), ("b", math.inf, math.nan, "needs 4 views"), ("c", math.inf, math.nan, "")])
        'not tried: b (needs 4 views); found no scene: c'
    """
    untried = [f"{name} ({reason})" for name, _, _, reason in candidates if reason]
    failed = [name for name, score, _, reason in candidates if not reason and not math.isfinite(score)]
    parts = (("not tried", untried), ("found no scene", failed))
    return "; ".join(f"{said}: {', '.join(names)}" for said, names in parts if names)

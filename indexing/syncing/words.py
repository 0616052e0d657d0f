"""Messages that speak of recordings a and b, in the names of the cameras."""

from __future__ import annotations

import re

LETTER = re.compile(r"(^|\b(?:in|of) |[;:] )([ab])(?=[:;]|$| (?:has \d|changes|fits|must|is)\b)")


def in_names(text: str, a: str, b: str) -> str:
    """A message of the library with the cameras' names for a and b; an article stays what it is.

    Example:
        >>> in_names("nothing moves in a; film a longer take", "left", "right")
        'nothing moves in left; film a longer take'
        >>> in_names("b has 8 frames, 12 are needed at least", "left", "right")
        'right has 8 frames, 12 are needed at least'
    """
    names = {"a": a or "a", "b": b or "b"}
    return LETTER.sub(lambda found: found[1] + names[found[2]], text)

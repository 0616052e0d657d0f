"""Messages about a and b, in the names of the cameras."""

from __future__ import annotations

import pytest

from indexing.sync.synchronize import in_names


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("no point is seen in b; check the detections", "no point is seen in right; check the detections"),
        ("b: 10 frames; at least 20 are needed", "right: 10 frames; at least 20 are needed"),
        ("all of a changes: its camera moves fast", "all of left changes: its camera moves fast"),
        ("nothing moves in a; choose a take; nothing moves in b", "nothing moves in left; choose a take; nothing moves in right"),
        ("b fits as well when played backwards", "right fits as well when played backwards"),
        ("calibration of a: dist must be finite", "calibration of left: dist must be finite"),
        ("film a larger motion, or a longer take in a hall", "film a larger motion, or a longer take in a hall"),
        ("a camera has moved; b is fine", "a camera has moved; right is fine"),
    ],
)
def test_letters_become_names_and_articles_stay(text, said):
    assert in_names(text, "left", "right") == said
    assert in_names(text, "", "") == text

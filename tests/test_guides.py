"""What the guides show is what happens, as in the README."""

from __future__ import annotations

import importlib.util
import re
from pathlib import Path

import pytest

from tests.documents import run

DOCS = Path(__file__).parents[1] / "docs"
GUIDES = sorted(path for path in (DOCS / "guide").glob("*.md") if path.stem != "index")
PAGES = sorted(path for room in ("guide", "explanation", "results") for path in (DOCS / room).glob("*.md"))


@pytest.mark.slow
@pytest.mark.parametrize("guide", GUIDES, ids=lambda path: path.stem)
def test_everything_a_guide_shows_happens(guide, tmp_path):
    pytest.importorskip("av")  # the videos of the examples
    assert run(guide, tmp_path) == []


def test_what_pages_point_to_is_there():
    targets = [(page, target) for page in PAGES for target in re.findall(r"\]\(([^)#:]+)\)", page.read_text(encoding="utf-8"))]
    assert len(targets) > 20
    assert [
        (page.name, target) for page, target in targets if not (page.parent / target).exists() and "auto_gallery" not in target
    ] == []


def test_scripts_that_pages_name_are_there():
    named = {
        name for page in PAGES for name in re.findall(r"python -m (experiments\.[a-z_.]+[a-z])", page.read_text(encoding="utf-8"))
    }
    assert len(named) > 20
    assert not [name for name in named if importlib.util.find_spec(name) is None]

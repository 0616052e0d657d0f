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


@pytest.mark.parametrize("page", PAGES, ids=lambda path: path.stem)
def test_what_a_page_points_to_is_there(page):
    for target in re.findall(r"\]\(([^)#:]+)\)", page.read_text(encoding="utf-8")):
        assert (page.parent / target).exists() or "auto_gallery" in target, target


def test_scripts_that_pages_name_are_there():
    named = {
        name for page in PAGES for name in re.findall(r"python -m (experiments\.[a-z_.]+[a-z])", page.read_text(encoding="utf-8"))
    }
    assert len(named) > 20
    assert not [name for name in named if importlib.util.find_spec(name) is None]

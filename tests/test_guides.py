"""What the guides show is what happens, as in the README."""

from __future__ import annotations

import importlib.util
import re
from pathlib import Path

import pytest

from tests.documents import run

DOCS = Path(__file__).parents[1] / "docs"
GUIDES = sorted(path for path in (DOCS / "guide").glob("*.md") if path.stem != "index")
ROOT = DOCS.parent
PAGES = [ROOT / "README.md", *sorted(path for room in ("guide", "explanation", "results") for path in (DOCS / room).glob("*.md"))]


@pytest.mark.slow
@pytest.mark.parametrize("guide", GUIDES, ids=lambda path: path.stem)
def test_everything_a_guide_shows_happens(guide, tmp_path):
    pytest.importorskip("av")  # the videos of the examples
    assert run(guide, tmp_path) == []


def test_what_pages_point_to_is_there():
    targets = [(page, target) for page in PAGES for target in re.findall(r"\]\(([^)#:]+)\)", page.read_text(encoding="utf-8"))]
    assert len(targets) > 20
    made = [pair for pair in targets if "auto_gallery" not in pair[1]]
    assert [(page.name, target) for page, target in made if not (page.parent / target).exists()] == []


def test_scripts_that_pages_name_are_there():
    texts = [page.read_text(encoding="utf-8") for page in PAGES]
    named = {name for text in texts for name in re.findall(r"python -m (experiments\.[a-z_.]+[a-z])", text)}
    assert len(named) > 20
    assert not [name for name in named if importlib.util.find_spec(name) is None]

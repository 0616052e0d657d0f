"""Every public name has its text, and stands in the API reference; checked without building the site."""

from __future__ import annotations

import dataclasses
import importlib.util
import inspect
import re
import sys
from pathlib import Path

import pytest

import dyntorch
import indexing

DOCS = Path(__file__).parents[1] / "docs"
ROOMS = [getattr(dyntorch, room) for room in dyntorch._MODULES if hasattr(getattr(dyntorch, room), "__all__")]
PUBLIC = [(package, name) for package in (dyntorch, indexing, *ROOMS) for name in package.__all__]


@pytest.fixture(scope="module")
def reference():
    """The script of the reference, with what its pages are about read: the packages are imported before a test is timed."""
    spec = importlib.util.spec_from_file_location("docs_reference", DOCS / "reference.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # where dataclasses look their module up
    spec.loader.exec_module(module)
    module.pages()
    return module


@pytest.mark.slow
def test_every_public_name_has_its_text():
    wrong = []
    for package, name in PUBLIC:
        value = getattr(package, name)
        if not (inspect.isroutine(value) or inspect.isclass(value) or inspect.ismodule(value)):
            continue  # a table or a type: what it holds is printed
        said = value.__doc__ or ""
        made_up = inspect.isclass(value) and dataclasses.is_dataclass(value) and said.startswith(f"{name}(")
        if len(said.split()) < 5 or made_up:
            wrong.append(f"{package.__name__}.{name}")
    assert wrong == []


@pytest.mark.slow
def test_every_public_name_is_in_the_reference(reference):
    pages = reference.pages()
    written = "\n".join(reference.text(page) for page in pages)
    listed = set(re.findall(r"^\.\. (?:auto(?:class|function)|py:data):: (\S+)$", written, re.MULTILINE))
    rooms = {page.title for page in pages}
    for package, name in PUBLIC:
        whole = f"{package.__name__}.{name}"
        assert whole in listed or whole in rooms or getattr(package, name) in ROOMS, whole
    names = [name for page in pages for name in page.names]
    assert len(names) == len(set(names))
    assert all(f"   {page.file}\n" in reference.index(pages) for page in pages)


def test_results_without_a_public_name_stand_beside_their_verbs(reference):
    listed = {name for page in reference.pages() for _, name in page.names}
    assert {"Alignment", "Reconstruction"} <= listed


def test_unquoted_names_are_no_markup(reference):
    assert reference.escaped("``labels_`` and classes_, (*batch, n), *this* stays") == (
        "``labels_`` and classes\\_, (\\*batch, n), *this* stays"
    )


def test_methods_that_may_be_called_on_the_class_keep_their_text(reference):
    assert reference.member_text(dyntorch.ShapeTensor, "shape") == "Shape of one tensor."
    assert "matches" in reference.member_text(dyntorch.HomographyTensor, "minimal")
    assert not reference.member_text(dyntorch.Collineation, "dof").startswith("int(")
    assert reference.member_text(dyntorch.Collineation, "nullity") is None


def test_a_page_tells_of_each_name_once(reference):
    page = next(page for page in reference.pages() if ("dyntorch", "fit") in page.names)
    text = reference.text(page)
    assert text.count(".. autofunction:: dyntorch.fit\n") == 1
    assert ":func:`fit <dyntorch.fit>`" in text

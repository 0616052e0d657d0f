"""A scene in which more moves than stands still, as the database that COLMAP would have made of it."""

from __future__ import annotations

from pathlib import Path

import pytest

from indexing.colmap import StaticPoints, find_static, read_database

pytest.importorskip("pycolmap")

from experiments.segmentation.colmap import write_scene
from experiments.segmentation.photographs import Photographs, photographs


@pytest.fixture(scope="session")
def scene() -> Photographs:
    """Six images, one large body with 60 % of the matches."""
    return photographs(images=6, bodies=1, matches=130, seed=5)


@pytest.fixture(scope="session")
def given(scene: Photographs, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Its database."""
    return write_scene(tmp_path_factory.mktemp("colmap") / "database.db", scene)


@pytest.fixture(scope="session")
def found(given: Path) -> StaticPoints:
    """What stands still in it."""
    return find_static(read_database(given))


@pytest.fixture(scope="session")
def static(found: StaticPoints, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The database that was written."""
    return found.write(tmp_path_factory.mktemp("static") / "static.db")

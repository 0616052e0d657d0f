"""What an installation is made of: the wheel and the sdist hold what they must and nothing else; make says what it does."""

from __future__ import annotations

import shutil
import subprocess
import tarfile
import tomllib
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent


def of_packages() -> set[str]:
    """Files of both packages, as a checkout has them."""
    found = (path for package in ("dyntorch", "indexing") for path in (ROOT / package).rglob("*"))
    return {path.relative_to(ROOT).as_posix() for path in found if path.is_file() and "__pycache__" not in path.parts}


def test_the_wheel_holds_both_packages_and_nothing_else(tmp_path: Path) -> None:
    wheel = pytest.importorskip("hatchling.builders.wheel", reason="needs hatchling, which 'make install' brings")
    (made,) = wheel.WheelBuilder(str(ROOT)).build(directory=str(tmp_path), versions=["standard"])
    held = set(zipfile.ZipFile(made).namelist())
    about = {name for name in held if name.partition("/")[0].endswith(".dist-info")}
    assert held - about == of_packages()
    assert {name.partition("/")[2] for name in about} == {"METADATA", "WHEEL", "RECORD", "entry_points.txt", "licenses/LICENSE"}
    assert {"dyntorch/py.typed", "indexing/py.typed", "indexing/report/base.css", "indexing/report/base.html.j2"} <= held


@pytest.mark.slow
def test_the_sdist_holds_the_sources_and_nothing_else(tmp_path: Path) -> None:
    sdist = pytest.importorskip("hatchling.builders.sdist", reason="needs hatchling, which 'make install' brings")
    (made,) = sdist.SdistBuilder(str(ROOT)).build(directory=str(tmp_path), versions=["standard"])
    with tarfile.open(made) as archive:
        held = {name.partition("/")[2] for name in archive.getnames()}
    assert of_packages() <= held
    assert {name.partition("/")[0] for name in held} == {
        "dyntorch", "indexing", "tests", "experiments", "docs", "Makefile", "constraints.txt", "README.md", "CHANGELOG.md",
        "CITATION.cff", "CONTRIBUTING.md", "LICENSE", "pyproject.toml", "PKG-INFO", ".gitignore",
    }  # fmt: skip
    assert not [name for name in held if "__pycache__" in name]


def test_the_constraints_fulfil_what_the_project_asks_for() -> None:
    packaging = pytest.importorskip("packaging.requirements")
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    lines = (line for line in (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines() if not line.startswith("#"))
    pinned = dict(line.split("==") for line in lines)
    asked = [*project["dependencies"], *(text for extra in project["optional-dependencies"].values() for text in extra)]
    for requirement in map(packaging.Requirement, asked):
        if requirement.name not in ("dyntorch", "poselib"):  # poselib: benchmarks only, any version from 2 on
            assert pinned[requirement.name] in requirement.specifier, requirement


@pytest.mark.skipif(shutil.which("make") is None, reason="needs make")
@pytest.mark.parametrize(("torch", "asked"), [("cpu", True), ("gpu", False)])
def test_make_asks_for_torch_without_cuda_where_no_gpu_is_seen(torch: str, asked: bool, tmp_path: Path) -> None:
    for name in ("Makefile", "constraints.txt", "pyproject.toml"):
        shutil.copy(ROOT / name, tmp_path)
    done = subprocess.run(
        ["make", "--dry-run", "install", f"TORCH={torch}", "TORCH_INDEX=x"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=True,
    )
    assert ("--index-url x 'torch==" in done.stdout) == asked
    assert "--constraint constraints.txt --editable '.[dev]'" in done.stdout

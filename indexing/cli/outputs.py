"""Where commands write: checked before the work begins, and never over their own inputs."""

from __future__ import annotations

import contextlib
import os
import secrets
from collections.abc import Iterable
from pathlib import Path

from indexing.cli.console import SHOWN

REPORT_FILES = ("report.html", "metrics.json", "manifest.json", "events.csv", "confusion.png", "timeline.png")


def check_folder(folder: Path) -> Path:
    """The folder, if files can be written in it; it is not made yet, so that a failure later leaves nothing behind.

    Raises:
        ValueError: something is in the way, or it cannot be written.
    """
    folder = folder.expanduser()
    there = next((part for part in (folder, *folder.absolute().parents) if part.exists()), Path.cwd())
    if not there.is_dir():
        raise ValueError(f"output folder {str(folder)!r}: {str(there)!r} is a file; choose another folder, or move it away")
    probe = there / f".dyntorch-{secrets.token_hex(8)}.tmp"
    try:
        os.close(os.open(probe, os.O_CREAT | os.O_EXCL | os.O_WRONLY))
    except OSError as error:
        raise ValueError(
            f"output folder {str(folder)!r}: {str(there)!r} cannot be written ({error.strerror or error}); "
            "choose a folder you may write to"
        ) from None
    finally:
        with contextlib.suppress(OSError):
            probe.unlink()
    return folder


def check_file(path: Path, inputs: Iterable[Path]) -> Path:
    """The file to write, if it can be written.

    Raises:
        ValueError: it is a folder or one of the inputs, or its folder cannot be written.
    """
    path = path.expanduser()
    if path.is_dir():
        raise ValueError(f"{path}: is a folder; name the file to write in it, e.g. -o {path / 'moves.safetensors'}")
    check_folder(path.parent)
    keep(inputs, [path])
    return path


def check_report(folder: Path | None, inputs: Iterable[Path], files: Iterable[str] = REPORT_FILES) -> Path | None:
    """The folder of a report, if it can be written and no file of the report would replace an input."""
    if folder is None:
        return None
    folder = check_folder(folder)
    keep(inputs, [folder / name for name in files])
    return folder


def keep(inputs: Iterable[Path], outputs: Iterable[Path]) -> None:
    """Raise where an output would replace an input."""
    written = {path.resolve() for path in outputs}
    lost = [path for path in inputs if path.expanduser().resolve() in written]
    if lost:
        listed = ", ".join(map(str, lost[:SHOWN]))
        raise ValueError(f"{listed}: is an input, and the output would replace it; choose another name for the output")

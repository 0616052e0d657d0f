"""Opening files and folders: what every format needs before it looks at a single keypoint."""

from __future__ import annotations

import csv
import json
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from indexing.clip import FloatArray

VIDEOS = (".mp4", ".mov", ".avi", ".mkv", ".webm", ".m4v", ".mpg", ".mpeg", ".wmv")
HEADER_ROWS = 5  # enough to tell every CSV format apart


class FrameFile(NamedTuple):
    """One file of a folder that holds one file per frame."""

    number: int
    path: Path
    data: Any


@dataclass(frozen=True)
class Source:
    """An opened input.

    Args:
        path: as the caller gave it.
        kind: ``"npz"``, ``"json"``, ``"csv"``, ``"json folder"`` or ``"txt folder"``.
        data: nothing, the parsed JSON, the first rows, a list of :class:`FrameFile` (JSON parsed; text not yet read).
    """

    path: Path
    kind: str
    data: Any = None

    def need(self, name: str, *kinds: str) -> None:
        """Refuse an input that cannot be of the format ``name``."""
        if self.kind not in kinds:
            raise error(
                self.path,
                f"is a {self.kind}, but the format {name!r} is a {' or a '.join(kinds)}",
                "leave format= away to detect it",
            )


def error(path: str | Path, what: str, remedy: str) -> ValueError:
    """The one shape of every message: file, what is wrong, what to do."""
    return ValueError(f"{path}: {' '.join(what.split())}; {remedy}")  # what is quoted from a file may hold line breaks


def open_source(path: str | Path) -> Source:
    """Look at what a path holds, without deciding on a format.

    Raises:
        ValueError: it does not exist, is empty, or cannot hold keypoints (a video, a model, a pickle, HDF5).
    """
    path = Path(path).expanduser()
    if path.is_dir():
        return _open_folder(path)
    if not path.is_file():
        raise error(path, "no such file or folder", "check the path")
    suffix = path.suffix.lower()
    if suffix in VIDEOS:
        raise error(
            path,
            "is a video, but keypoints are expected, and no pose estimator ships here",
            "run one first (RTMPose/MMPose, Ultralytics, OpenPose, MediaPipe, DeepLabCut) and give its keypoint file",
        )
    with path.open("rb") as file:
        head = file.read(512)
    if not head.strip():
        raise error(path, "the file is empty", "export it again")
    _refuse_binary(path, suffix, head)
    if head.startswith(b"PK") or suffix == ".npz":
        return Source(path, "npz")
    if head.removeprefix(b"\xef\xbb\xbf").lstrip()[:1] in (b"{", b"["):
        return Source(path, "json", load_json(path))
    rows = [cells for _, cells in islice(_rows(path), HEADER_ROWS)]
    if not rows:
        raise error(path, "the file is empty", "export it again")
    return Source(path, "csv", rows)


def _refuse_binary(path: Path, suffix: str, head: bytes) -> None:
    if suffix == ".safetensors" or head[8:10] == b'{"':
        raise error(path, "is a model file, but keypoints are expected", "give it with -m (--model), or to ActionIndexer.load")
    if head.startswith(b"\x89HDF"):
        raise error(
            path,
            "is an HDF5 file, which is not read here",
            "export CSV instead (SLEAP: File > Export Analysis CSV, or sleap-convert; DeepLabCut: save_as_csv=True)",
        )
    if suffix in (".pkl", ".pickle", ".pt", ".pth", ".joblib"):
        raise error(path, "is a pickle, which can run code when it is read", "export JSON, CSV or a clip-set .npz instead")
    if head.startswith(b"\x93NUMPY"):
        raise error(path, "is a bare .npy array", "save it as a clip set: np.savez(file, joints=array, fps=...)")
    if b"\0" in head and not head.startswith(b"PK") and suffix != ".npz":
        raise error(path, "is a binary file that no reader knows", "give keypoints as JSON, CSV or a clip-set .npz")


def _open_folder(folder: Path) -> Source:
    visible = sorted(entry for entry in folder.iterdir() if not entry.name.startswith("."))
    for suffix in (".json", ".txt"):
        files = [entry for entry in visible if entry.suffix.lower() == suffix and entry.name != "classes.txt"]
        if not files:
            continue
        numbered: dict[int, Path] = {}
        for file in files:
            number = frame_number(file.name)
            if number is None:
                raise error(
                    file,
                    "the file name has no frame number",
                    "a folder holds one file per frame of one recording; name other files singly",
                )
            if number in numbered:
                raise error(
                    folder,
                    f"{numbered[number].name} and {file.name} are both frame {number}",
                    "a folder holds one recording: put each recording in a folder of its own",
                )
            numbered[number] = file
        read = load_json if suffix == ".json" else _nothing
        return Source(folder, f"{suffix[1:]} folder", [FrameFile(n, f, read(f)) for n, f in sorted(numbered.items())])
    inside = ", ".join(entry.name for entry in visible[:5]) or "nothing"
    raise error(folder, f"the folder has no .json or .txt keypoint files (it has {inside})", "give the folder of one recording")


def _nothing(path: Path) -> None:
    """Text files are read by the one format that uses them."""


def frame_number(name: str) -> int | None:
    """The frame number in a file name: before ``_keypoints``, else the last number before the suffix.

    Example:
        >>> frame_number("squat2_000000000012_keypoints.json"), frame_number("7.jpg"), frame_number("a.jpg")
        (12, 7, None)
    """
    stem = re.sub(r"\.\w+$", "", name)
    found = re.search(r"(\d{1,18})_keypoints", stem) or re.search(r"(\d{1,18})\D*$", stem)  # 18 digits fit int64
    return int(found.group(1)) if found else None


def load_json(path: Path) -> Any:
    """Parsed JSON (``NaN`` allowed).

    Raises:
        ValueError: empty, not text, or not JSON; the message has line and column.
    """
    text = _text(path)
    if not text.strip():
        raise error(path, "the file is empty", "export it again")
    try:
        return json.loads(text)
    except json.JSONDecodeError as problem:
        raise error(
            path,
            f"not valid JSON at line {problem.lineno}, column {problem.colno} ({problem.msg})",
            "the file may be truncated: export it again",
        ) from None
    except RecursionError:
        raise error(path, "the JSON is nested too deeply for keypoints", "export it again") from None


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError:
        raise error(path, "is not a text file in UTF-8", "give keypoints as JSON, CSV or a clip-set .npz") from None


def read_columns(path: Path, skip: int, numeric: Sequence[int], text: Sequence[int] = ()) -> tuple[FloatArray, list[list[str]]]:
    """Some columns of a CSV file.

    Args:
        skip: header rows; the last of them names the columns in messages.
        numeric: indices of the columns to convert; empty cells are NaN.
        text: indices of the columns to keep as text.

    Returns:
        ``(rows, len(numeric))`` values and, per text column, its cells.

    Raises:
        ValueError: no rows, a short row, or a cell that is not a number; the message has row and column.
    """
    header: list[str] = []
    values: list[FloatArray] = []
    words: list[list[str]] = [[] for _ in text]
    for index, (line, cells) in enumerate(_rows(path)):
        if index < skip:
            header = cells
            continue
        if len(cells) < len(header):
            raise error(
                path, f"row {line} has {len(cells)} cells, the header {len(header)}", "the file may be truncated: export it again"
            )
        try:
            values.append(np.array([float(cells[c]) for c in numeric]))
        except ValueError:
            values.append(np.array([_number(path, line, header[c], cells[c]) for c in numeric]))
        for column, c in zip(words, text, strict=True):
            column.append(cells[c].strip())
    if not values:
        raise error(path, "the file has a header but no rows", "export it again")
    return np.stack(values), words


def _number(path: Path, line: int, column: str, cell: str) -> float:
    if cell.strip().lower() in ("", "na", "n/a", "none", "null", "nan"):
        return float("nan")
    try:
        return float(cell)
    except ValueError:
        raise error(
            path, f"row {line}, column {column!r}: {cell!r} is not a number", "correct the cell or leave it empty"
        ) from None


def _rows(path: Path) -> Iterator[tuple[int, list[str]]]:
    """Line number (1-based) and cells of every row that is not blank."""
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            first = file.readline()
            file.seek(0)
            delimiter = max(",;\t", key=first.count)
            for line, cells in enumerate(csv.reader(file, delimiter=delimiter), start=1):
                if any(cells):
                    # where ";" separates cells, the spreadsheet wrote decimal commas
                    yield line, [cell.replace(",", ".") for cell in cells] if delimiter == ";" else cells
    except (UnicodeDecodeError, csv.Error):
        raise error(path, "is not a text file in UTF-8", "give keypoints as JSON, CSV or a clip-set .npz") from None

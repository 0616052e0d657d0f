"""Segments: the immutable files that hold the movement of an archive, mapped into memory and never read whole.

A segment is a safetensors file: ``joints`` int16 ``(rows, n, 2)``, ``codes`` int8 ``(rows, 2, k)`` and their ``scales``; of each
track a row in ``tracks`` (recording, view, first row, rows), ``starts``, ``origins``, ``steps``; and what was learned of its joint
layout, so that the file explains itself.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import math
import mmap
import os
import secrets
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray
from safetensors.numpy import save

from indexing.archive.tracks import Layout, StorageFormat, Track, positions
from indexing.files import replacing, sha256_of
from indexing.modelfile import skeleton_to_json

FORMAT, VERSION = "dyntorch.archive-segment", 1
HEADER = 2**26  # bytes of a header at most
COLUMNS = 4  # of the table of tracks
TYPES: dict[str, type[np.generic]] = {"I16": np.int16, "I8": np.int8, "F32": np.float32, "F64": np.float64, "I64": np.int64}
SHAPES = {"joints": 3, "codes": 3, "scales": 1, "tracks": 2, "starts": 1, "origins": 2, "steps": 1}
MAPPED = ("joints", "codes", "scales")
SCATTERED = ("joints",)  # read here and there: with what lies around them, a system reads gigabytes for a thousand windows


@dataclass(frozen=True)
class WrittenSegment:
    """A file that was written: its name, bytes, and the hash of these."""

    file: str
    size: int
    sha256: str


def write_segment(folder: Path, tracks: Sequence[Track], layout: Layout, storage: StorageFormat) -> WrittenSegment:
    """Write tracks of one layout as a new file, on disk before this returns."""
    rows = np.cumsum([0, *map(len, tracks)])
    each = [layout.codes(track.positions()) for track in tracks]
    table = [(track.recording, track.view, rows[i], len(track)) for i, track in enumerate(tracks)]
    tensors = {
        "joints": np.concatenate([track.joints for track in tracks]),
        "codes": np.concatenate([codes for codes, _ in each]),
        "scales": np.concatenate([scales for _, scales in each]),
        "tracks": np.array(table, dtype=np.int64).reshape(-1, COLUMNS),
        "starts": np.array([track.start for track in tracks], dtype=np.float64),
        "origins": np.array([track.origin for track in tracks], dtype=np.float64),
        "steps": np.array([track.scale for track in tracks], dtype=np.float64),
        "layout": np.frombuffer(layout.dump(), dtype=np.int8),
    }
    about = {
        "format": FORMAT,
        "version": str(VERSION),
        "rate": str(storage.rate),
        "skeleton": json.dumps(skeleton_to_json(layout.skeleton)),
    }
    name = f"{secrets.token_hex(8)}.safetensors"
    data = save(tensors, about)
    with replacing(folder / name) as stream:
        stream.write(data)
        stream.flush()
        os.fsync(stream.fileno())
    _sync_folder(folder)
    return WrittenSegment(name, len(data), hashlib.sha256(data).hexdigest())


def is_intact(path: Path, sha256: str) -> bool:
    """Whether a file is there and still what was written."""
    try:
        return sha256_of(path) == sha256
    except OSError:
        return False


def _sync_folder(folder: Path) -> None:
    """The new name on disk, too, where the system can be asked for that."""
    with contextlib.suppress(OSError):
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


@dataclass(frozen=True, eq=False)
class ArchiveSegment:
    """A segment as it lies on disk: arrays that are mapped, not read."""

    path: Path
    joints: NDArray[np.int16]
    codes: NDArray[np.int8]
    scales: NDArray[np.float32]
    tracks: NDArray[np.int64]
    starts: NDArray[np.float64]
    origins: NDArray[np.float64]
    steps: NDArray[np.float64]
    rate: float

    @classmethod
    def open(cls, path: Path) -> ArchiveSegment:
        """Map a file."""
        size = path.stat().st_size
        with open(path, "rb") as stream:
            if hasattr(os, "posix_fadvise"):  # only what is asked for is read of the table of tracks
                os.posix_fadvise(stream.fileno(), 0, 0, os.POSIX_FADV_RANDOM)
            length = int.from_bytes(stream.read(8), "little")
            if not 2 <= length <= min(HEADER, size - 8):
                raise damage_error(path, "its header is cut off")
            header = _header(path, stream.read(length))
            try:
                places = {name: _place(header[name], 8 + length) for name in SHAPES}
                rate = float(header["__metadata__"]["rate"])
            except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as problem:
                raise damage_error(path, "its header makes no sense") from problem
            arrays = {name: _array(path, stream, name, *places[name], size) for name in SHAPES}
        segment = cls(path, **arrays, rate=rate)
        wrong = segment.check()
        if wrong is not None:
            raise damage_error(path, wrong)
        return segment

    def __len__(self) -> int:
        return len(self.tracks)

    @property
    def firsts(self) -> NDArray[np.int64]:
        """``(tracks,)`` the first row of each track."""
        return self.tracks[:, 2]

    def positions(self, track: int, first: int = 0, end: int | None = None) -> NDArray[np.float32]:
        """``(rows, joints, 2)`` some poses of a track."""
        begin, rows = self.tracks[track, 2:4].tolist()
        part = np.asarray(self.joints[begin + first : begin + (rows if end is None else min(end, rows))])
        return positions(part, self.origins[track], float(self.steps[track]))

    def poses(self, track: NDArray[np.int64], row: NDArray[np.intp]) -> NDArray[np.float32]:
        """``(poses, joints, 2)`` one pose each of some tracks."""
        stored = np.asarray(self.joints[self.firsts[track] + row])
        return positions(stored, self.origins[track, None], self.steps[track, None, None])

    def only(self, track: int) -> ArchiveSegment:
        """One track by itself, mapped as before."""
        first, rows = self.tracks[track, 2:4].tolist()
        mine, one = slice(first, first + rows), slice(track, track + 1)
        table = self.tracks[one].copy()
        table[0, 2] = 0
        return replace(
            self, joints=self.joints[mine], codes=self.codes[mine], scales=self.scales[mine], tracks=table, starts=self.starts[one],
            origins=self.origins[one], steps=self.steps[one],
        )  # fmt: skip

    def track(self, number: int) -> Track:
        """One track as it was added."""
        recording, view, begin, rows = self.tracks[number, :4].tolist()
        joints = np.array(self.joints[begin : begin + rows])
        return Track(recording, view, float(self.starts[number]), joints, self.origins[number], float(self.steps[number]))

    def check(self) -> str | None:
        """What is wrong with how its tracks lie in it, or nothing."""
        if self.tracks.shape[1] != COLUMNS or not len(self.tracks) == len(self.starts) == len(self.origins) == len(self.steps):
            return "its table of tracks does not fit"
        rows = self.tracks[:, 3]
        whole = len(self.joints) == len(self.codes) == len(self.scales) == rows.sum()
        return None if whole and (self.firsts == np.cumsum(rows) - rows).all() else "its tracks do not lie end to end"


def damage_error(path: Path, what: str) -> ValueError:
    """The one message of a file that is not what it should be."""
    return ValueError(f"{path}: {what}; dyntorch archive verify says what is lost: remove those sources and add them again")


def _header(path: Path, data: bytes) -> dict[str, Any]:
    """What a file says of itself, where it is a segment that can be read here."""
    try:
        header: dict[str, Any] = json.loads(data)
        about = header.get("__metadata__", {})
        form, version = about.get("format"), int(about.get("version", 0))
    except (TypeError, ValueError, AttributeError, OverflowError) as problem:
        raise damage_error(path, "its header makes no sense") from problem
    if form != FORMAT:
        raise damage_error(path, "it is no segment of an archive")
    if version > VERSION:
        raise ValueError(f"{path}: written by a newer dyntorch (segment version {version}); update dyntorch")
    return header


def _place(entry: dict[str, Any], base: int) -> tuple[int, int, tuple[int, ...], type[np.generic]]:
    """What a header says of an array: its first byte in the file and the one behind it, shape, and type."""
    begin, end = map(int, entry["data_offsets"])
    return base + begin, base + end, tuple(map(int, entry["shape"])), TYPES[entry["dtype"]]


def _array(
    path: Path, stream: BinaryIO, name: str, begin: int, end: int, shape: tuple[int, ...], kind: type[np.generic], size: int
) -> NDArray[Any]:
    """One array of the file, which must lie in it: mapped where there is a row of it for each pose, read otherwise."""
    expected = math.prod(shape) * np.dtype(kind).itemsize
    if len(shape) != SHAPES[name] or min(shape) < 0 or end - begin != expected or end > size or begin < 0:
        raise damage_error(path, "it is cut off")
    if expected == 0:
        return np.zeros(shape, kind)
    if name not in MAPPED:
        stream.seek(begin)
        return np.frombuffer(stream.read(expected), kind).reshape(shape)
    lead = begin % mmap.ALLOCATIONGRANULARITY
    mapped = mmap.mmap(stream.fileno(), expected + lead, access=mmap.ACCESS_READ, offset=begin - lead)
    if name in SCATTERED and hasattr(mapped, "madvise"):
        mapped.madvise(mmap.MADV_RANDOM)
    return np.frombuffer(mapped, kind, offset=lead).reshape(shape)

"""Files are written whole or not at all: whoever is killed, whoever writes at the same time, and where the disk is full."""

from __future__ import annotations

import resource
import signal
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from indexing import ActionIndexer, Clip, ClipSet
from indexing.files import recover_folder, replace_folder, replacing, write_bytes, write_text

CLIPS = ClipSet([Clip(np.random.default_rng(0).normal(size=(50, 17, 2)), label="a", name="a")])


@contextmanager
def small_disk(size: int = 1000) -> Iterator[None]:
    """Files may not grow beyond so many bytes, as on a full disk."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def save_clips(path: Path) -> None:
    CLIPS.save(path)


def save_model(path: Path) -> None:
    joints = np.random.default_rng(0).normal(size=(2, 20, 17, 2))
    ActionIndexer(scorer="nearest", search=False).fit(list(joints), ["a", "b"]).save(path)


def save_table(path: Path) -> None:
    write_text(path, "label,start,end\n" * 1000)


@pytest.mark.parametrize("save", [save_clips, save_model, save_table])
def test_a_full_disk_or_a_missing_folder_is_said_and_keeps_the_old_file(save, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    path = tmp_path / "out.file"
    path.write_text("the old one")
    with small_disk(), pytest.raises(ValueError, match=r"cannot write .*out\.file.* \(File too large\); free the name or the disk"):
        save(path)
    assert path.read_text() == "the old one"
    with pytest.raises(ValueError, match=r"no.*out"):
        save(tmp_path / "no" / "out.file")
    assert [entry.name for entry in tmp_path.iterdir()] == ["out.file"]


def test_a_killed_or_failed_write_leaves_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_text("the old one")
    code = (
        "import os, signal, sys\nfrom indexing.files import replacing\n"
        "with replacing(sys.argv[1]) as stream:\n    stream.write(b'half of the new')\n    stream.flush()\n"
        "    os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    done = subprocess.run([sys.executable, "-c", code, str(path)], check=False)
    assert done.returncode == -signal.SIGKILL
    with pytest.raises(KeyError), replacing(path) as stream:  # noqa: PT012
        stream.write(b"half")
        raise KeyError
    assert path.read_text() == "the old one"


def folder(path: Path, text: str) -> Path:
    path.mkdir()
    for name in "abc":
        (path / name).write_text(text)
    return path


def contents(path: Path) -> set[str]:
    return {file.read_text() for file in path.iterdir()}


def test_several_who_write_one_place_leave_one_whole_file_or_folder(tmp_path: Path) -> None:
    path, texts, target = tmp_path / "a.csv", [bytes([65 + i]) * 100_000 for i in range(4)], tmp_path / "pose-sync"
    with ThreadPoolExecutor(4) as pool:
        list(pool.map(lambda i: write_bytes(path, texts[i % 4]), range(40)))
        list(pool.map(lambda i: replace_folder(folder(tmp_path / f"new{i}", f"{i}"), target), range(24)))
    assert path.read_bytes() in texts and len(contents(target)) == 1 and len(list(target.iterdir())) == 3
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["a.csv", "pose-sync"]


def test_a_folder_put_aside_by_whoever_was_killed_comes_back_and_one_that_cannot_be_replaced_stays(tmp_path: Path) -> None:
    target = tmp_path / "pose-sync"
    folder(tmp_path / ".pose-sync-0123.old", "old")
    recover_folder(target)
    assert contents(target) == {"old"}
    folder(tmp_path / ".pose-sync-4567.old", "older")
    recover_folder(target)  # there is one: it stays
    assert contents(target) == {"old"}
    with pytest.raises(ValueError, match=r"cannot write .*pose-sync.* \(No such file or directory\)"):
        replace_folder(tmp_path / "none", target)
    assert contents(target) == {"old"}

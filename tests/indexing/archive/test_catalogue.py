"""What the catalogue says is there: counts agree, damage is found, what is removed makes room, and only one writes at once."""

from __future__ import annotations

import json
import os
import shutil
import signal
import sqlite3
import tempfile
import threading
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.numpy import save

from indexing import Archive, ArchiveOptions, Clip
from indexing.archive import writer
from indexing.archive.catalogue import CATALOGUE, LOCK, Catalogue, drop_recordings
from indexing.archive.segments import ArchiveSegment
from indexing.archive.tracks import StorageFormat, windows_of

EAGER = ArchiveOptions(max_small_segments=3, relearn_factor=np.inf)  # puts four small segments together
NOBODY = 65534


@pytest.fixture
def three(tmp_path: Path, moves: Callable[..., Clip]) -> Archive:
    """Three recordings in two segments."""
    made = Archive(tmp_path / "lab.archive")
    made.add([moves(0, name="a"), moves(1, name="b")])
    made.add(moves(2, name="c"))
    return made


def segments(archive: Archive) -> list[Path]:
    """Files, oldest first."""
    return [archive.path / "segments" / row.file for row in Catalogue(archive.path).contents().segments]


def change(archive: Archive, statement: str) -> None:
    """Somebody writes into the catalogue."""
    with closing(sqlite3.connect(archive.path / CATALOGUE)) as connection:
        connection.execute(statement)
        connection.commit()


def names(archive: Archive) -> list[str]:
    return [row.source for row in archive.recordings()]


# ---- counts --------------------------------------------------------------------------------------------------------------
def test_all_counts_agree_and_joints_are_those_that_were_added(three: Archive, moves) -> None:
    info, found, rows = three.info(), three.verify(), three.recordings()
    opened = [ArchiveSegment.open(path) for path in segments(three)]
    counted = sum(windows_of(int(rows), StorageFormat()) for one in opened for rows in one.tracks[:, 3])
    assert len(three) == info.windows == found.windows == counted > 0
    assert info.sources == info.recordings == len(rows) == 3 and info.segments == found.segments == len(opened) == 2
    assert info.seconds == pytest.approx(sum(row.seconds for row in rows)) == pytest.approx(sum(one[2] for one in info.layouts))
    assert info.size >= sum(path.stat().st_size for path in segments(three)) and info.version == 1 and info.dead == 0
    assert found.ok and not found.orphans
    for row in rows:
        clip = three.clip(row.source)
        assert (clip.times[0], clip.times[-1]) == pytest.approx((row.start, row.end)) and clip.name == row.source
        assert row.path == "" and row.person == "" and row.layout == "8 joints"
    assert repr(three) == f"Archive({str(three.path)!r}, {len(three):,} windows)"
    for number, name in enumerate("abc"):
        clip, stored = moves(number), three.clip(name)
        assert np.allclose(stored.joints, clip.joints[: 2 * len(stored) : 2], atol=0.05 * np.ptp(clip.joints))
        part = three.clip(name, 1.0, 2.0)
        assert (part.times[0], part.times[-1]) == pytest.approx((1.0, 2.0)) and np.array_equal(part.joints, stored.joints[15:31])
    for ask in (lambda: three.remove("d"), lambda: three.clip("d"), lambda: three.clip("a", person="2")):
        with pytest.raises(ValueError, match=r"has no (source|recording) '[ad]'.*info --sources lists them"):
            ask()
    assert len(three.recordings()) == 3


def test_an_archive_of_nothing(tmp_path: Path, moves) -> None:
    empty = Archive(tmp_path / "a")
    assert len(empty) == 0 and repr(empty).endswith("0 windows)")
    for ask in (empty.recordings, empty.info, empty.verify, lambda: empty.remove("x"), lambda: empty.clip("x")):
        with pytest.raises(ValueError, match="is no archive yet; add recordings first"):
            ask()
    empty.add(Clip(np.full((9, 4, 2), np.nan), fps=30.0, name="nobody"))
    assert len(empty) == 0 and empty.info().sources == 1 and empty.verify().ok and empty.recordings() == []
    with pytest.raises(ValueError, match="holds no movement yet"):
        empty.search(moves(0))


# ---- removal and tidying -------------------------------------------------------------------------------------------------
def test_what_is_removed_is_found_no_more(three: Archive, moves) -> None:
    before = len(three)
    assert three.search(moves(0), k=1)[0].source == "a"
    assert three.remove("a") == 1
    assert names(three) == ["b", "c"] and len(three) < before
    assert three.info().dead == before - len(three) and three.verify().ok
    assert {hit.source for hit in three.search(moves(0), k=10)} <= {"b", "c"}
    with pytest.raises(ValueError, match="has no source 'a'"):
        three.remove("a")
    three.add(moves(0, name="a"))
    assert three.search(moves(0), k=1)[0].source == "a" and len(three) == before


def test_segments_of_nothing_go_and_those_of_little_are_written_anew(three: Archive, moves) -> None:
    files = segments(three)
    three.remove("c")
    assert segments(three) == files[:1] and not files[1].exists()
    three.add([moves(3, seconds=9.0, name="long"), moves(4, name="short")])
    long, short = segments(three)[-1], three.clip("short").joints
    three.remove("long")
    assert not long.exists() and three.info().dead == 0 and three.verify().ok
    assert np.array_equal(three.clip("short").joints, short)
    for name in ("a", "b", "short"):
        three.remove(name)
    assert list((three.path / "segments").iterdir()) == [] and len(three) == 0 and three.verify().ok


@pytest.mark.slow
def test_small_segments_are_put_together_unchanged(tmp_path: Path, moves) -> None:
    archive = Archive(tmp_path / "a", EAGER)
    for number in range(3):
        archive.add([moves(number, name=f"{number}"), moves(10 + number, joints=5, name=f"five {number}")])
    archive.remove("1")
    stored = {name: archive.clip(name).joints for name in names(archive)}
    asked = moves(0).between(0.5, 1.5), moves(11, joints=5).between(1.0, 2.0)
    hits = [archive.search(clip, k=1)[0] for clip in asked]
    before, windows = archive.info(), len(archive)
    assert before.segments == 5  # the one of nothing went
    archive.add(moves(8, name="8"))
    archive.add(moves(9, name="9"))
    assert archive.info().segments == 4 and archive.verify().ok and archive.info().dead == 0
    archive.remove("8")
    archive.remove("9")
    assert len(archive) == windows and set(names(archive)) == set(stored)
    assert all(np.array_equal(archive.clip(name).joints, stored[name], equal_nan=True) for name in stored)
    for clip, hit in zip(asked, hits, strict=True):
        again = archive.search(clip, k=1)[0]
        assert again.source == hit.source and (again.start, again.end) == pytest.approx((hit.start, hit.end), abs=0.1)
    left = {path.name for path in (archive.path / "segments").iterdir()}
    assert left == {path.name for path in segments(archive)}


@pytest.mark.slow
def test_who_asks_while_segments_are_put_together_gets_an_answer(tmp_path: Path, moves) -> None:
    archive, other = Archive(tmp_path / "a", EAGER), Archive(tmp_path / "a", EAGER)
    for number in range(3):
        archive.add(moves(number, name=f"{number}"))
    assert other.search(moves(1), k=1)[0].source == "1"
    archive.add(moves(3, name="3"))
    assert archive.info().segments == 1
    assert other.search(moves(1), k=3) == archive.search(moves(1), k=3)
    assert [other.search(moves(number), k=1)[0].source for number in range(4)] == list("0123")


def test_a_full_disk_while_tidying_is_no_failure_of_what_was_asked(tmp_path: Path, moves, monkeypatch) -> None:
    archive = Archive(tmp_path / "a", EAGER)
    for number in range(3):
        archive.add(moves(number, name=f"{number}"))
    write, written = writer.write_segment, []

    def once(*given):
        written.append(given)
        if len(written) > 1:
            raise ValueError("cannot write (No space left on device); free the disk")
        return write(*given)

    monkeypatch.setattr(writer, "write_segment", once)
    assert archive.add(moves(3, name="3")).of("added")
    assert len(written) == 2 and archive.info().segments == 4 and archive.verify().ok
    monkeypatch.undo()
    assert archive.add(moves(3, name="3")).of("known") and archive.info().segments == 1 and len(archive.recordings()) == 4


def test_damage_is_not_hidden_by_tidying_or_learning_again(tmp_path: Path, moves) -> None:
    archive = Archive(tmp_path / "a", EAGER)
    for number in range(3):
        archive.add(moves(number, name=f"{number}"))
    flip(segments(archive)[1], -500)
    archive.add(moves(3, name="3"))
    archive.add(moves(4, name="4"))
    (problem,) = archive.verify().problems
    assert "is not what was written" in problem and problem.endswith("remove and add again 1")
    assert archive.remove("1") == 1 and archive.add(moves(1, name="1")).of("added") and archive.verify().ok
    assert sorted(names(archive)) == list("01234")
    archive = Archive(tmp_path / "b", ArchiveOptions(relearn_factor=2.0))
    archive.add(moves(0, name="0"))
    flip(segments(archive)[0], -500)
    archive.add(moves(1, seconds=9.0, name="1"))
    (problem,) = archive.verify().problems
    assert "is not what was written" in problem and problem.endswith("remove and add again 0")
    assert archive.remove("0") == 1 and archive.verify().ok
    archive.add([moves(0, name="0"), moves(2, seconds=30.0, name="2")])  # now all is learned from again
    assert archive.info().segments == 1 and archive.verify().ok and archive.search(moves(0), k=1)[0].source == "0"


# ---- damage --------------------------------------------------------------------------------------------------------------
def refused(ask: Callable[[], object]) -> str | None:
    """The one line of a refusal, or nothing."""
    try:
        ask()
    except ValueError as problem:
        return str(problem)
    return None


def flip(path: Path, place: int) -> None:
    data = bytearray(path.read_bytes())
    data[place] ^= 0x10
    path.write_bytes(data)


def test_flipped_bytes_of_a_segment_are_found(three: Archive) -> None:
    path = segments(three)[0]
    data = path.read_bytes()
    for place in np.random.default_rng(0).choice(len(data), 40, replace=False).tolist():
        flip(path, place)
        (problem,) = three.verify().problems
        assert str(path) in problem and "2 recordings lost: remove and add again a, b" in problem
        path.write_bytes(data)
    assert three.verify().ok
    length = int.from_bytes(data[:8], "little")
    opened = 0
    for place in [*range(24), *range(24, 8 + length, 3)]:
        flip(path, place)
        said = refused(lambda: ArchiveSegment.open(path))
        assert said is None or (str(path) in said and "\n" not in said)
        opened += said is None  # a byte that decides nothing, or the rate: only its hash tells
        path.write_bytes(data)
    assert opened < 0.15 * length


def test_a_segment_cut_off_or_gone_is_found_and_can_be_mended(three: Archive, moves) -> None:
    first, second = segments(three)
    size = first.stat().st_size
    for keep in (0, 4, 100, size // 2, size - 1):
        os.truncate(first, keep)
        assert "is not what was written" in three.verify().problems[0]
        with pytest.raises(ValueError, match="verify says what is lost"):
            Archive(three.path).search(moves(0))
    second.unlink()
    problems = three.verify().problems
    assert len(problems) == 2 and "No such file" in problems[1] and problems[1].endswith("1 recording lost: remove and add again c")
    for name in "abc":
        assert three.remove(name) == 1
    assert three.verify().ok and len(three) == 0
    three.add([moves(number, name=name) for number, name in enumerate("abc")])
    assert three.search(moves(2), k=1)[0].source == "c"


def test_another_file_in_the_place_of_a_segment_is_found(three: Archive, tmp_path: Path, moves) -> None:
    first, second = segments(three)
    data = second.read_bytes()
    second.write_bytes(first.read_bytes())
    assert "is not what was written" in three.verify().problems[0]
    second.write_bytes(save({"joints": np.zeros((3, 2, 2), np.int16)}))
    with pytest.raises(ValueError, match="it is no segment of an archive"):
        ArchiveSegment.open(second)
    second.write_bytes(data.replace(b'"version":"1"', b'"version":"9"'))
    with pytest.raises(ValueError, match=r"segment version 9.*update dyntorch"):
        ArchiveSegment.open(second)


CHANGED_ROWS = (
    ("UPDATE recordings SET windows = windows + 1 WHERE name = 'b'", "does not hold what the catalogue says of b"),
    ("UPDATE recordings SET ends = ends + 1 WHERE name = 'b'", "does not hold what the catalogue says of b"),
    ("UPDATE recordings SET seconds = 0 WHERE name = 'b'", "does not hold what the catalogue says of b"),
    ("UPDATE recordings SET segment = 2 WHERE name = 'b'", "does not hold what the catalogue says of b"),
    ("UPDATE recordings SET segment = 7 WHERE name = 'b'", "b: its segment is not in the catalogue"),
    ("UPDATE recordings SET source = 7 WHERE name = 'b'", "b: belongs to no source"),
    ("UPDATE recordings SET name = 'a', source = 1 WHERE name = 'b'", "a: is there twice"),
    ("DELETE FROM recordings WHERE name = 'b'", "of them removed; the catalogue says"),
    ("DELETE FROM segments WHERE id = 1", "a: its segment is not in the catalogue"),
    ("DELETE FROM sources WHERE name = 'b'", "b: belongs to no source"),
    ("DELETE FROM layouts", "its joint layout is not in the catalogue"),
    ("UPDATE layouts SET joints = 5", "has other joints"),
    ("UPDATE segments SET windows = 3 WHERE id = 1", "the catalogue says 3 and 0"),
    ("UPDATE segments SET dead = 3 WHERE id = 1", "0 of them removed"),
    ("UPDATE segments SET sha256 = 'x' WHERE id = 1", "is not what was written"),
    ("UPDATE segments SET file = 'x' WHERE id = 1", "x: No such file"),
)
SENSELESS = (
    "UPDATE meta SET value = 'x' WHERE key = 'version'", "DELETE FROM meta WHERE key = 'version'", "DROP TABLE meta",
    "DROP TABLE recordings", "UPDATE meta SET value = '{' WHERE key = 'storage'", "DELETE FROM meta WHERE key = 'storage'",
    "UPDATE meta SET value = '{\"rate\": 3, \"speed\": 1}' WHERE key = 'storage'", "UPDATE layouts SET learned = x'00'",
    "UPDATE layouts SET learned = substr(learned, 1, 900)", "UPDATE layouts SET skeleton = '['",
)  # fmt: skip


def test_every_change_of_the_catalogue_is_found(three: Archive, tmp_path: Path, moves) -> None:
    for number, (statement, says) in enumerate([*CHANGED_ROWS, *((statement, "") for statement in SENSELESS)]):
        copy = Archive(shutil.copytree(three.path, tmp_path / f"{number}"))
        change(copy, statement)
        if says:
            result = copy.verify()
            assert not result.ok and any(says in problem for problem in result.problems), (statement, result.problems)
            assert all("\n" not in problem for problem in result.problems)
            continue
        for ask in (lambda path=copy.path: Archive(path).search(moves(0)), lambda path=copy.path: Archive(path).verify()):
            line = refused(ask)
            assert line is not None and CATALOGUE in line and "\n" not in line, statement


def test_a_damaged_catalogue_is_found(three: Archive) -> None:
    path = three.path / CATALOGUE
    data = path.read_bytes()
    found_whole = list[bool]()
    for place in range(100, len(data), 2003):  # some of the file is free space
        flip(path, place)
        said = refused(lambda: found_whole.append(three.verify().ok))
        assert said is None or (str(three.path) in said and "\n" not in said)
        path.write_bytes(data)
    assert sum(found_whole) < len(data) // 2003
    path.write_bytes(data[: len(data) // 2])
    with pytest.raises(ValueError, match=CATALOGUE):
        three.verify()
    path.write_bytes(b"not a database, but some text that is longer than its header is, which has a hundred bytes" * 9)
    with pytest.raises(ValueError, match="restore it from a copy"):
        Archive(three.path)


# ---- what is no archive --------------------------------------------------------------------------------------------------
def test_a_newer_version_is_refused(three: Archive, moves) -> None:
    change(three, "UPDATE meta SET value = '2' WHERE key = 'version'")
    for ask in (lambda: Archive(three.path), lambda: three.add(moves(5, name="e")), lambda: three.search(moves(0))):
        with pytest.raises(ValueError, match="is an archive of version 2, this dyntorch reads up to version 1; update dyntorch"):
            ask()


def test_folders_and_files_of_others_are_refused(tmp_path: Path, moves, saved) -> None:
    (tmp_path / "file").write_text("x")
    with pytest.raises(ValueError, match="is a file; an archive is a folder"):
        Archive(tmp_path / "file")
    with pytest.raises(ValueError, match=r"below: cannot be written \(Not a directory\)"):
        Archive(tmp_path / "file" / "below").add(moves(0))
    other = saved("week/a.npz").parent
    with pytest.raises(ValueError, match="is no archive; make one with"):
        Archive(other)
    with pytest.raises(ValueError, match=r"is a folder with other files \(a.npz\)"):
        Catalogue.make(other, StorageFormat())
    assert sorted(path.name for path in other.iterdir()) == ["a.npz"]
    foreign = tmp_path / "foreign"
    foreign.mkdir()
    with closing(sqlite3.connect(foreign / CATALOGUE)) as connection:
        connection.execute("CREATE TABLE books (title)")
    with pytest.raises(ValueError, match="so it is no catalogue of an archive"):
        Archive(foreign)


def test_an_interrupted_archive_is_empty_and_leftovers_are_said(tmp_path: Path, moves, three: Archive) -> None:
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / CATALOGUE).touch()
    options = ArchiveOptions(rate=10.0)
    begun = Archive(tmp_path / "a", options)
    assert len(begun) == 0 and begun.recordings() == [] and begun.verify().ok and begun.info().sources == 0
    assert (tmp_path / "a" / CATALOGUE).stat().st_size == 0  # reading writes nothing
    begun.add(moves(0, name="a"))
    assert Archive(tmp_path / "a").clip("a").fps == 10.0 and begun.verify().ok
    (three.path / "segments" / "0123.safetensors").write_bytes(b"x")
    (three.path / "segments" / ".half.tmp").write_bytes(b"x")
    found = three.verify()
    assert found.ok and set(found.orphans) == {"0123.safetensors", ".half.tmp"}
    three.add(moves(0, name="a"))
    assert three.verify().orphans == ()


def test_a_lost_catalogue_does_not_cost_the_segments(three: Archive, moves) -> None:
    files = segments(three)
    (three.path / CATALOGUE).write_bytes(b"")
    with pytest.raises(ValueError, match="is empty, but segments are there; restore it from a copy"):
        Archive(three.path).add(moves(5, name="e"))
    (three.path / CATALOGUE).unlink()
    with pytest.raises(ValueError, match="is no archive"):
        Archive(three.path)
    with pytest.raises(ValueError, match=r"is a folder with other files \(segments\)"):
        three.add(moves(5, name="e"))
    assert all(path.exists() for path in files)


# ---- others who write or read --------------------------------------------------------------------------------------------
def test_two_who_add_at_once(three: Archive, moves) -> None:
    with closing(sqlite3.connect(three.path / LOCK, isolation_level=None)) as other:  # as Catalogue.write_lock does
        other.execute("BEGIN EXCLUSIVE")
        for change_it in (lambda: three.add(moves(3, name="d")), lambda: three.remove("a")):
            with pytest.raises(ValueError, match="is locked, another process adds to it or removes from it; try again") as raised:
                change_it()
            assert "\n" not in str(raised.value) and str(three.path) in str(raised.value)
        # whoever only reads is not kept from it
        assert Archive(three.path).search(moves(0), k=1)[0].source == "a" and len(three) and three.info() and three.verify().ok
    assert three.add(moves(3, name="d")).of("added")


def test_many_who_make_it_at_once_make_one(tmp_path: Path) -> None:
    folder, problems = tmp_path / "a", list[BaseException]()
    gate = threading.Barrier(8)

    def make() -> None:
        gate.wait()
        try:
            Catalogue.make(folder, StorageFormat()).contents()
        except BaseException as problem:
            problems.append(problem)

    threads = [threading.Thread(target=make) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert problems == [] and Catalogue(folder).moment()[1:] == ([], [])


def test_a_verification_is_of_one_moment(three: Archive, moves, monkeypatch) -> None:

    look, looks = writer._segment_problems, []

    def meanwhile(*given):
        if not looks:  # while the first segment is looked at, somebody removes what is in it
            looks.append(given)
            three.remove("a")
            three.remove("b")
        return look(*given)

    monkeypatch.setattr(writer, "_segment_problems", meanwhile)
    assert three.verify().ok and names(three) == ["c"]


def test_a_change_is_made_whole_or_not_at_all(three: Archive) -> None:
    catalogue = Catalogue(three.path)
    before = catalogue.generation()

    def half() -> None:
        with catalogue.writing() as connection:
            drop_recordings(connection, 1)
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        half()
    assert names(three) == ["a", "b", "c"] and catalogue.generation() == before and three.verify().ok


@pytest.mark.skipif(not hasattr(os, "setuid") or os.geteuid() != 0, reason="only root can become somebody without rights")
def test_who_may_not_write_can_search(three: Archive, moves) -> None:
    with tempfile.TemporaryDirectory() as folder:  # those of the tests are closed to others
        shutil.copytree(three.path, Path(folder) / "lab.archive")
        for path in [Path(folder), *Path(folder).rglob("*")]:
            path.chmod(0o755 if path.is_dir() else 0o644)
        found = _as_nobody(Path(folder) / "lab.archive", moves(1), moves(5, name="e"))
    assert found[:3] == ["b", 3, True] and "check the disk and the permissions" in found[3], found


def _as_nobody(folder: Path, query: Clip, new: Clip) -> list[Any]:
    """What somebody without rights is answered."""
    heard, say = os.pipe()
    child = os.fork()
    if not child:  # pragma: no cover
        try:
            signal.alarm(60)
            os.chdir("/")
            os.setuid(NOBODY)
            torch.set_num_threads(1)  # the threads of a process do not follow into its fork
            archive = Archive(folder)
            said: list[Any] = [archive.search(query, k=1)[0].source, len(archive.recordings()), archive.verify().ok]
            try:
                archive.add(new)
            except ValueError as problem:
                said.append(str(problem))
        except BaseException as problem:
            said = [repr(problem)]
        os.write(say, json.dumps(said).encode())
        os._exit(0)
    os.close(say)
    os.waitpid(child, 0)
    with os.fdopen(heard) as stream:
        return list(json.loads(stream.read()))

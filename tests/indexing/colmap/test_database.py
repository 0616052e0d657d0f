"""COLMAP's database: read as it is, copied with other matches, never written to; what is none is refused in one line."""

from __future__ import annotations

import contextlib
import hashlib
import shutil
import sqlite3

import numpy as np
import pycolmap
import pytest

from indexing.colmap.database import PairGeometry, check_target, read_database, write_database


def sha256(path):
    return hashlib.sha256(path.read_bytes()).hexdigest()


def changed(source, target, *commands):
    """A copy of a database after some SQL."""
    shutil.copy(source, target)
    with contextlib.closing(sqlite3.connect(target)) as database, database:
        database.execute("PRAGMA foreign_keys = OFF")
        for command in commands:
            database.execute(command)
    return target


def test_what_is_read_is_what_was_written_and_copies_are_whole(scene, given, tmp_path):
    database = read_database(given)
    assert [image.name for image in database.images] == list(scene.names)
    for image, points in zip(database.images, scene.keypoints, strict=True):
        assert np.array_equal(image.points, points)
        assert (image.camera.width, image.camera.height, image.camera.prior) == (960, 720, False)
    assert {(pair.first, pair.second) for pair in database.pairs} == set(scene.matches)
    for pair in database.pairs:
        assert np.array_equal(pair.matches, scene.matches[pair.first, pair.second])
    F, E = np.arange(9.0).reshape(3, 3), np.arange(9.0, 18).reshape(3, 3)
    rows = {pair.key: pair.matches[:20] for pair in database.pairs}
    geometries = {pair.key: PairGeometry(2, pair.matches[:15], F, E) for pair in database.pairs}
    written = write_database(database, tmp_path / "copy.db", rows, geometries)
    assert list(tmp_path.iterdir()) == [written]
    with contextlib.closing(sqlite3.connect(given)) as old, contextlib.closing(sqlite3.connect(written)) as new:
        for table in ("cameras", "images", "keypoints", "descriptors"):
            assert old.execute(f"SELECT * FROM {table}").fetchall() == new.execute(f"SELECT * FROM {table}").fetchall()
        assert old.execute("SELECT sql FROM sqlite_master").fetchall() == new.execute("SELECT sql FROM sqlite_master").fetchall()
    copy = pycolmap.Database.open(written)
    pair = database.pairs[0]
    keys = [database.images[place].key for place in (pair.first, pair.second)]
    kept = copy.read_two_view_geometry(*keys)
    assert np.array_equal(kept.F, F) and np.array_equal(kept.E, E)
    assert np.array_equal(kept.inlier_matches, pair.matches[:15]) and int(kept.config) == 2
    assert np.array_equal(copy.read_matches(*keys), pair.matches[:20])
    copy.close()


def test_reading_leaves_nothing_behind_also_where_a_program_has_it_open(given, tmp_path):
    path = tmp_path / "a b#c.db"  # a name that a URI would take apart
    shutil.copy(given, path)
    before = sha256(path)
    pairs = len(read_database(path).pairs)
    assert sha256(path) == before and list(tmp_path.iterdir()) == [path]
    with contextlib.closing(sqlite3.connect(path)) as writer:
        writer.execute("PRAGMA journal_mode = WAL")
        writer.execute("DELETE FROM matches WHERE pair_id = (SELECT min(pair_id) FROM matches)")
        writer.execute("DELETE FROM two_view_geometries WHERE pair_id = (SELECT min(pair_id) FROM two_view_geometries)")
        writer.commit()
        assert (tmp_path / "a b#c.db-wal").exists()
        assert len(read_database(path).pairs) == pairs - 1
    # inlier matches stand for matches that are not there
    part = read_database(changed(given, tmp_path / "inliers.db", "UPDATE matches SET rows = 0, data = x''"))
    assert 0 < part.matches < read_database(given).matches


def test_a_copy_that_fails_leaves_nothing(given, tmp_path):
    database = read_database(given)
    broken = {pair.key: PairGeometry(object(), pair.matches) for pair in database.pairs}
    with pytest.raises(ValueError, match=r"copy\.db: cannot be written"):
        write_database(database, tmp_path / "copy.db", {}, broken)
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(ValueError, match=r"copy\.db: cannot be written .*; free the name"):
        write_database(database, tmp_path / "no folder" / "copy.db", {}, {})


def test_older_databases_keep_their_form(given, tmp_path):
    """COLMAP 3.6 had no qvec and tvec, 3.8 no rigs: what is written has the columns that are there."""
    drops = [f"ALTER TABLE two_view_geometries DROP COLUMN {name}" for name in ("qvec", "tvec", "camera1", "camera2")]
    path = changed(given, tmp_path / "old.db", *drops, "DROP TABLE rigs", "DROP TABLE frames")
    database = read_database(path)
    geometries = {pair.key: PairGeometry(3, pair.matches, np.eye(3)) for pair in database.pairs}
    written = write_database(database, tmp_path / "new.db", {}, geometries)
    assert read_database(written).matches == database.matches


CONTRADICTIONS = [
    ("DROP TABLE two_view_geometries", r"is no database of COLMAP: it has no table two_view_geometries"),
    ("ALTER TABLE matches RENAME COLUMN data TO bytes", r"its table matches has no column data"),
    ("UPDATE keypoints SET rows = rows + 1", r"keypoints of image 1: \d+ rows of 2, and \d+ numbers"),
    ("UPDATE keypoints SET data = x'00', rows = 1", r"keypoints of image 1: no row of numbers"),
    ("UPDATE keypoints SET rows = 1, data = x'0000c07f0000c07f'", r"keypoints of image 1: a coordinate is no number"),
    ("DELETE FROM keypoints WHERE image_id = 2", r"a match of image 001\.png is keypoint \d+, and it has 0"),
    ("DELETE FROM images WHERE image_id = 3", r"are of image 3, which is not there; match the images again"),
    ("UPDATE images SET camera_id = 9", r"image 000\.png has camera 9, which is not there"),
    ("UPDATE cameras SET width = 0", r"camera 1 has a size of 0 x 720"),
    ("DELETE FROM matches; DELETE FROM two_view_geometries", "holds 6 images and no matches; run a matcher first"),
]


def test_contradictions_are_named(given, tmp_path):
    for i, (commands, said) in enumerate(CONTRADICTIONS):
        path = changed(given, tmp_path / f"{i}.db", *commands.split(";"))
        with pytest.raises(ValueError, match=said) as caught:
            read_database(path)
        assert str(caught.value).startswith(str(path)) and "\n" not in str(caught.value)


def test_what_is_no_database(tmp_path):
    path = tmp_path / "a.db"
    for content, said in (
        (None, r"a\.db: no such database; give the database that colmap"),
        (b"", "is empty"),
        (b"\x89PNG and so on, long enough", "is no SQLite database"),
        (b"SQLite format 3\0" + bytes(200), r"a\.db: cannot be read"),
    ):
        if content is not None:
            path.write_bytes(content)
        with pytest.raises(ValueError, match=said):
            read_database(path)
    with pytest.raises(ValueError, match="is a folder"):
        read_database(tmp_path)


def test_the_target_must_be_free(given, tmp_path):
    (tmp_path / "link.db").symlink_to(given)
    for name in ("there.db", "left.db-wal"):
        (tmp_path / name).touch()
    for path, said in (
        (given, "is the database that is read"),
        (tmp_path / "link.db", "is the database that is read"),
        (tmp_path / "there.db", r"there\.db: is there already"),
        (tmp_path / "left.db", r"left\.db-wal: is there already"),
    ):
        with pytest.raises(ValueError, match=said):
            check_target(path, given)
    assert check_target(tmp_path / "free.db", given) == tmp_path / "free.db"

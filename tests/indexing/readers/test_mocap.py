"""Tables of points in space, and what tells them from MediaPipe's, whose z was never measured."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from indexing.readers import read, read_clip
from indexing.skeleton import MEDIAPIPE33
from tests.indexing.readers.tools import refused

POINTS = np.random.default_rng(0).normal(size=(5, 3, 3)) * 2 + 5  # metres, beyond 0 to 1
NAMES = ("LHip", "RHip", "Head")


def table(
    path: Path, points: np.ndarray, names: Sequence[str] = NAMES, first: str | None = "time", more: str = "", delimiter: str = ","
) -> Path:
    """A row per frame at 50 Hz; ``more`` is a fourth column of each point, .5 everywhere."""
    kinds = ("x", "y", "z", more) if more else ("x", "y", "z")
    if more:
        points = np.concatenate([points, np.full((*points.shape[:2], 1), 0.5)], axis=2)
    lines = [[*([first] if first else []), *(f"{name}_{kind}" for name in names for kind in kinds)]]
    for i, row in enumerate(points):
        stamp = [str(i if first == "frame" else i / 50)] if first else []
        lines.append([*stamp, *("" if np.isnan(value) else repr(float(value)) for value in row.ravel())])
    path.write_text("\n".join(delimiter.join(cells) for cells in lines))
    return path


@pytest.mark.parametrize("delimiter", [",", ";", "\t"])
@pytest.mark.parametrize("first", ["time", "t", "Seconds", "frame", None])
def test_coordinates_and_times_are_those_of_the_table(tmp_path: Path, first: str | None, delimiter: str) -> None:
    clip = read_clip(table(tmp_path / "a.csv", POINTS, first=first, delimiter=delimiter), fps=50.0)
    np.testing.assert_array_equal(clip.joints, POINTS)
    np.testing.assert_allclose(clip.times, np.arange(5) / 50)
    assert clip.skeleton is not None and clip.skeleton.joints == NAMES
    assert (clip.up, clip.confidence, clip.fps_assumed) == ("z", None, False)


def test_empty_cells_and_nan_are_points_not_seen(tmp_path: Path) -> None:
    points = POINTS.copy()
    points[1, 2] = np.nan
    points[3, 0, 2] = np.nan  # a point without its depth is none
    path = table(tmp_path / "a.csv", points)
    expected = points.copy()
    expected[3, 0] = np.nan
    np.testing.assert_array_equal(read_clip(path).joints, expected)
    path.write_text(path.read_text().replace(",,,", ",NaN,nan,"))
    np.testing.assert_array_equal(read_clip(path).joints, expected)


def test_a_row_per_point_and_people_in_a_column(tmp_path: Path) -> None:
    rows = ["frame,joint,x,y,z"]
    rows += [
        f"{i},{n},{','.join(map(repr, map(float, p)))}" for i, one in enumerate(POINTS) for n, p in zip(NAMES, one, strict=True)
    ]
    (tmp_path / "long.csv").write_text("\n".join(rows))
    np.testing.assert_array_equal(read_clip(tmp_path / "long.csv").joints, POINTS)
    rows = ["frame,person," + ",".join(f"{n}_{k}" for n in NAMES for k in "xyz")]
    rows += [
        f"{i},{who}," + ",".join(repr(float(v)) for v in (one + 9 * k).ravel())
        for i, one in enumerate(POINTS)
        for k, who in enumerate("ab")
    ]
    (tmp_path / "two.csv").write_text("\n".join(rows))
    first, second = read(tmp_path / "two.csv", person="all")
    assert (first.meta["person"], second.meta["person"]) == ("a", "b")
    np.testing.assert_allclose(second.joints - first.joints, 9)


def test_a_confidence_is_kept(tmp_path: Path) -> None:
    clip = read_clip(table(tmp_path / "a.csv", POINTS, more="score"))
    assert clip.dims == 3 and clip.confidence is not None and (clip.confidence == 0.5).all()


@pytest.mark.parametrize(
    ("names", "more", "scale", "dims"),
    [
        (MEDIAPIPE33.joints, "visibility", 1000.0, 2),
        (MEDIAPIPE33.joints, "visibility", 1.0, 2),
        (MEDIAPIPE33.joints, "", 1.0, 2),
        (NAMES, "visibility", 1000.0, 2),
        (NAMES, "confidence", 1.0, 2),
        (NAMES, "confidence", 1000.0, 3),
        (NAMES, "", 1000.0, 3),
        (MEDIAPIPE33.joints[11:], "", 1000.0, 3),
    ],
)
def test_what_tells_them_from_mediapipe(tmp_path: Path, names: Sequence[str], more: str, scale: float, dims: int) -> None:
    points = scale * np.random.default_rng(1).uniform(0.1, 0.9, size=(4, len(names), 3))
    assert read_clip(table(tmp_path / "a.csv", points, names, more=more)).dims == dims


@pytest.mark.parametrize(
    ("names", "scale", "word"), [(NAMES, 1.0, "from 0 to 1"), (MEDIAPIPE33.joints, 1000.0, "MediaPipe's landmarks")]
)
def test_what_may_be_either_is_refused_until_it_is_said(tmp_path: Path, names: Sequence[str], scale: float, word: str) -> None:
    points = scale * np.random.default_rng(1).uniform(0.1, 0.9, size=(4, len(names), 3))
    path = table(tmp_path / "a.csv", points, names)
    refused(path, word, "format='mocap'", "format='mediapipe'")
    assert read_clip(path, format="mocap").dims == 3 and read_clip(path, format="mediapipe").dims == 2


def test_tables_without_z_of_every_point(tmp_path: Path) -> None:
    (tmp_path / "some.csv").write_text("time,a_x,a_y,a_z,b_x,b_y\n0,1,2,3,4,5\n")
    refused(tmp_path / "some.csv", "not of b", "format='mocap'")
    (tmp_path / "flat.csv").write_text("time,a_x,a_y\n0,1,2\n")
    assert read_clip(tmp_path / "flat.csv").dims == 2
    refused(tmp_path / "flat.csv", "has no z of a", format="mocap")
    (tmp_path / "none.csv").write_text("date,price\n1,2\n")
    refused(tmp_path / "none.csv", "hip_x, hip_y, hip_z", format="mocap")

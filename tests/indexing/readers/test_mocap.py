"""Tables of points in space, and what tells them from MediaPipe's, whose z was never measured."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from indexing.readers import read, read_clip
from indexing.readers.recording import NobodySeen
from indexing.skeleton import COCO17, H36M17, HALPE26, MEDIAPIPE33
from tests.grid import grid
from tests.indexing.readers import tools
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


@grid(("delimiter", [",", ";", "\t"]), ("first", ["time", "t", "Seconds", "frame", None]))
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


@grid(
    (
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
)
def test_what_tells_them_from_mediapipe(tmp_path: Path, names: Sequence[str], more: str, scale: float, dims: int) -> None:
    points = scale * np.random.default_rng(1).uniform(0.1, 0.9, size=(4, len(names), 3))
    clip = read_clip(table(tmp_path / "a.csv", points, names, more=more))
    assert clip.dims == dims
    assert (clip.confidence is not None) == bool(more) and (not more or (clip.confidence == 0.5).all())


def test_what_may_be_either_is_refused_until_it_is_said(tmp_path: Path) -> None:
    for names, scale, word in ((NAMES, 1.0, "from 0 to 1"), (MEDIAPIPE33.joints, 1000.0, "MediaPipe's landmarks")):
        path = table(tmp_path / "a.csv", scale * np.random.default_rng(1).uniform(0.1, 0.9, size=(4, len(names), 3)), names)
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


# Marker files (TRC, C3D), arrays of numpy, folders of FreeMoCap, and AlphaPose


HALPE_POINTS = tools.standing(HALPE26, dims=3)
HALPE_NAMES = HALPE26.joints


# ---- TRC -----------------------------------------------------------------------------------------------------------------
@grid((("units", "scale"), [("m", 1.0), ("mm", 0.001), ("cm", 0.01)]))
def test_trc_is_metres_with_its_own_times(units: str, scale: float, tmp_path: Path) -> None:
    points = HALPE_POINTS.copy()
    points[2, 3] = np.nan
    points[4, 5] = 0.0
    clip = read_clip(tools.trc(tmp_path / "a.trc", points, HALPE_NAMES, rate=100.0, units=units))
    points[4, 5] = np.nan
    np.testing.assert_allclose(clip.joints, scale * points, atol=1e-6)
    np.testing.assert_allclose(clip.times, np.arange(12) / 100, atol=1e-9)
    assert (clip.up, clip.fps, clip.fps_assumed, clip.confidence) == ("y", pytest.approx(100), False, None)
    assert clip.skeleton is not None and clip.skeleton.joints == HALPE_NAMES


def test_trc_that_starts_later_keeps_its_clock(tmp_path: Path) -> None:
    path = tools.trc(tmp_path / "a.trc", HALPE_POINTS, HALPE_NAMES, start=301)
    text = path.read_text().split("\n")
    path.write_text(
        "\n".join([*text[:5], *(re.sub(r"^(\d+)\t([\d.]+)", lambda m: f"{m[1]}\t{float(m[2]) + 5:.6f}", t) for t in text[5:])])
    )
    assert read_clip(path).times[0] == pytest.approx(5.0)
    path.write_text("\n".join([*text[:5], *(re.sub(r"^(\d+)\t[\d.]+", r"\1\t", t) for t in text[5:])]))
    np.testing.assert_allclose(read_clip(path).times, np.arange(12) / 60)  # no times: frame number / DataRate


def test_the_direction_up_is_the_bodys_and_other_tables_are_not_mediapipes(tmp_path: Path, person: np.ndarray) -> None:
    for axes, up in (([0, 2, 1], "z"), ([0, 1, 2], "y")):
        assert read_clip(tools.trc(tmp_path / "a.trc", HALPE_POINTS[..., axes], HALPE_NAMES)).up == up
        assert read_clip(tools.trc(tmp_path / "b.trc", HALPE_POINTS[..., axes], [f"M{i}" for i in range(26)])).up == "y"
    rows = ["frame," + ",".join(f"{name}_{kind}" for name in COCO17.joints for kind in ("x", "y"))]
    rows += [f"{i}," + ",".join(f"{v:.3f}" for v in frame[:, :2].ravel()) for i, frame in enumerate(person)]
    (tmp_path / "a.csv").write_text("\n".join(rows))
    assert "may_lag" not in read_clip(tmp_path / "a.csv").meta


def test_people_of_a_marker_file_have_names_before_a_colon(tmp_path: Path) -> None:
    both = np.concatenate([HALPE_POINTS, HALPE_POINTS + 2.0], axis=1)
    names = [f"{who}:{joint}" for who in ("anna", "ben") for joint in HALPE_NAMES]
    clips = read(tools.trc(tmp_path / "a.trc", both, names), person="all")
    assert [clip.meta["person"] for clip in clips] == ["anna", "ben"]
    np.testing.assert_allclose(clips[1].joints, HALPE_POINTS + 2.0, atol=1e-6)
    (alone,) = read(tools.trc(tmp_path / "b.trc", HALPE_POINTS, names[:26]))
    assert alone.skeleton is not None and alone.skeleton.joints == HALPE_NAMES


BROKEN = [
    ("PathFileType", "PathFileTyp", ("",)),
    ("Frame#", "Rows", ("begins with Frame#",)),
    ("\tm\t", "\tfeet\t", ("Units is 'feet'",)),
    ("nose", "left_eye", ("names the marker 'left_eye' twice",)),
    ("12\t26", "12\t25", ("NumMarkers is 25, but line 4 names 26",)),
    ("1\t0.000000", "x\t0.000000", ("line 6, 'Frame#': 'x' is no number",)),
    ("0.016667", "abc", ("line 7, 'Time'", "'abc'")),
    ("3\t0.033333", "2\t0.033333", ("frame numbers must increase",)),
    ("0.033333", "0.016667", ("times must increase",)),
    ("\n3\t0.033333", "\n3\t0.033333\t" + "1\t" * 90, ("line 8 has", "26 markers")),
    ("60.0\t60.0\t12", "1e30\t60.0\t12", ("DataRate",)),
    ("\n1\t0.000000", "\n1\tinf", ("no time, or one beyond any recording",)),
]


def test_broken_marker_files_are_refused(tmp_path: Path) -> None:
    path = tools.trc(tmp_path / "a.trc", HALPE_POINTS, HALPE_NAMES)
    text = path.read_text()
    lines = text.split("\n")
    cases = [(text.replace(old, new, 1), words) for old, new, words in BROKEN if old in text]
    assert len(cases) == len(BROKEN)
    cases += [
        ("\n".join(lines[:count]), (word,)) for count, word in ((2, "three lines of header"), (4, "no frames"), (5, "no frames"))
    ]
    for content, words in [*cases, ("\n".join([*lines[:9], lines[9][:1]]), ("line 10 has no frame and time",))]:
        path.write_text(content)
        refused(path, *words)
    with pytest.raises(NobodySeen):
        read(tools.trc(tmp_path / "b.trc", np.full_like(HALPE_POINTS, np.nan), HALPE_NAMES))


# ---- C3D -----------------------------------------------------------------------------------------------------------------
def test_c3d_is_a_recording(tmp_path: Path) -> None:
    (tmp_path / "a.c3d").write_bytes(tools.c3d())
    clip = read_clip(tmp_path / "a.c3d", fps=50.0)
    assert (len(clip), clip.joints.shape[1:], clip.up) == (5, (4, 3), "z")
    assert clip.skeleton is not None and clip.skeleton.joints == ("mk0", "mk1", "mk2", "mk3")
    np.testing.assert_allclose(clip.times, np.arange(5) / 50)
    (tmp_path / "b.c3d").write_bytes(tools.c3d()[:700])
    refused(tmp_path / "b.c3d", "truncated")
    (tmp_path / "c.c3d").write_bytes(b"something else altogether")
    refused(tmp_path / "c.c3d", "C3D")


# ---- arrays --------------------------------------------------------------------------------------------------------------
def test_arrays_have_the_layout_and_the_direction_of_their_body(tmp_path: Path) -> None:
    for layout, turn, up in ((COCO17, [0, 1, 2], "y"), (H36M17, [0, 2, 1], "z"), (MEDIAPIPE33, [0, 2, 1], "z")):
        np.save(tmp_path / "a.npy", tools.standing(layout, dims=3)[..., turn])
        clip = read_clip(tmp_path / "a.npy")
        assert (clip.skeleton, clip.up, clip.dims, clip.fps_assumed) == (layout, up, 3, True)
    np.save(tmp_path / "a.npy", tools.standing(COCO17).astype(np.float32))
    clip = read_clip(tmp_path / "a.npy", fps=25.0)
    assert (clip.skeleton, clip.up, dict(clip.meta)) == (COCO17, "-y", {"layout": "recognized: COCO-17"})
    np.save(tmp_path / "a.npy", np.random.default_rng(0).normal(size=(9, 17, 2)))
    assert read_clip(tmp_path / "a.npy").meta == {"layout": "guessed: COCO-17, not H36M-17"}
    np.save(tmp_path / "a.npy", np.random.default_rng(0).normal(size=(9, 7, 3)))
    assert read_clip(tmp_path / "a.npy").skeleton is None


def test_a_third_number_beside_pixels_is_the_confidence(tmp_path: Path) -> None:
    pixels = tools.standing(COCO17)
    third = np.random.default_rng(0).uniform(0.1, 1, (*pixels.shape[:2], 1))
    np.save(tmp_path / "a.npy", np.concatenate([pixels, third], axis=2))
    clip = read_clip(tmp_path / "a.npy")
    np.testing.assert_array_equal(clip.joints, pixels)
    np.testing.assert_array_equal(clip.confidence, third[..., 0])
    np.save(tmp_path / "a.npy", np.concatenate([pixels / 1000, third], axis=2))
    refused(tmp_path / "a.npy", "it may be depth or confidence")


def test_arrays_that_are_no_joints_over_time_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.npy"
    for shape in ((3,), (4, 4), (2, 3, 4), (0, 17, 2), (2, 3, 4, 5)):
        np.save(path, np.zeros(shape))
        refused(path, "not joints over time", "np.savez(file, joints=array, fps=...)")
    np.save(path, tools.standing(COCO17))
    path.write_bytes(path.read_bytes()[:500])
    refused(path, "truncated")
    np.save(path, np.array([{}, None], dtype=object), allow_pickle=True)
    refused(path, "Python objects")
    np.save(path, np.zeros((5, 17, 2)))
    with pytest.raises(NobodySeen):
        read(path)


# ---- FreeMoCap -----------------------------------------------------------------------------------------------------------
BODY = 1000 * tools.standing(MEDIAPIPE33, dims=3)[..., [0, 2, 1]]


@grid(("name", ["body", "skeleton", "old", "raw"]))
def test_a_recording_of_freemocap_opens_by_any_of_its_folders(name: str, tmp_path: Path) -> None:
    folder = tools.freemocap(tmp_path / name / "session", BODY, name=name)
    bodies = [path for path in (folder / "output_data").rglob("*.npy") if "hand_3d" not in path.name]
    for path in [folder, folder / "output_data", *bodies]:
        clip = read_clip(path, fps=30.0)
        np.testing.assert_allclose(clip.joints, BODY)
        assert (clip.skeleton, clip.up, clip.dims) == (MEDIAPIPE33, "z", 3)
    assert len(bodies) == 1 and read_clip(folder).name == "session"


def test_without_3d_every_camera_of_freemocap_is_a_clip(tmp_path: Path) -> None:
    cameras = np.stack([np.concatenate([tools.standing(MEDIAPIPE33, seed=i), np.ones((12, 33, 1))], axis=2) for i in range(3)])
    cameras[2] = np.nan  # saw nobody
    clips = read(tools.freemocap(tmp_path / "session", cameras=np.pad(cameras, ((0, 0), (0, 0), (0, 42), (0, 0)))))
    assert [clip.name for clip in clips] == ["session[0]", "session[1]"]
    assert clips.column("camera").tolist() == [0, 1]
    np.testing.assert_allclose(clips[1].joints, cameras[1, ..., :2])
    assert (clips[0].up, clips[0].skeleton) == ("-y", MEDIAPIPE33)


def test_folders_of_arrays_that_are_no_body_are_refused(tmp_path: Path) -> None:
    folder = tools.freemocap(tmp_path / "session", BODY)
    path = folder / "output_data" / "mediapipe_body_3d_xyz.npy"
    path.unlink()
    refused(folder, "no array of a body (it has mediapipe")
    for values, said in ((BODY[:, :20], "without the 33 points of a body"), (BODY[..., :2], "have 2 coordinates")):
        np.save(path, values)
        with pytest.raises(ValueError, match=said):
            read(folder)
    (tmp_path / "empty" / "output_data").mkdir(parents=True)
    refused(tmp_path / "empty", "no array of a body (it has none)")


# ---- MediaPipe's smoothing -----------------------------------------------------------------------------------------------
def smoothed(points: np.ndarray, fps: float = 30.0, lowest: float = 0.05, beta: float = 80.0) -> np.ndarray:
    """The filter of MediaPipe's landmarks: a low pass whose frequency rises with the speed, in body heights per second."""

    def share(frequency: Any) -> Any:
        return 1 / (1 + fps / (2 * np.pi * frequency))

    size = float(np.ptp(points[..., 1]))
    out, speed = points.copy(), np.zeros_like(points[0])
    for i in range(1, len(points)):
        speed += share(1.0) * ((points[i] - points[i - 1]) * fps / size - speed)
        weight = share(lowest + beta * np.abs(speed))
        out[i] = weight * points[i] + (1 - weight) * out[i - 1]
    return out


def landmarks(path: Path, points: np.ndarray) -> Path:
    names = MEDIAPIPE33.joints
    lines = ["frame," + ",".join(f"{name}_{kind}" for name in names for kind in ("x", "y", "visibility"))]
    lines += [f"{i}," + ",".join(f"{x:.6f},{y:.6f},0.9" for x, y in frame) for i, frame in enumerate(points / 1000)]
    path.write_text("\n".join(lines))
    return path


@grid(("noise", [0.0, 0.001, 0.003, 0.005, 0.01]))
def test_what_mediapipe_smoothed_is_always_said(noise: float, tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    calm = np.clip(np.sin(np.arange(240) / 30), 0, None)[:, None, None]  # moves, and rests
    body = tools.standing(MEDIAPIPE33, frames=1) + 80 * calm * rng.normal(size=(1, 33, 2))
    raw = body + noise * 500 * rng.normal(size=body.shape)
    assert read_clip(landmarks(tmp_path / "a.csv", smoothed(raw))).meta == {"may_lag": True}
    said = read_clip(landmarks(tmp_path / "b.csv", raw)).meta
    assert said == {} or noise < 0.003  # noise at rest shows that nothing was smoothed


# ---- what is not read ----------------------------------------------------------------------------------------------------
def test_other_netcdf_and_hdf5_say_what_they_are(tmp_path: Path) -> None:
    (tmp_path / "a.nc").write_bytes(b"CDF\x01" + bytes(60))
    refused(tmp_path / "a.nc", "netCDF file of version 3", "engine='h5netcdf'")
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["temperature"] = [1.0, 2.0]
    refused(tmp_path / "a.h5", "HDF5 without keypoints that a reader knows (it has temperature)")

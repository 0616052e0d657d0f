"""DeepLabCut, SLEAP and MediaPipe tables."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from indexing.readers import read, read_clip
from indexing.skeleton import COCO17, HAND21, MEDIAPIPE33

Rows = Sequence[Sequence[Any]]
NAMES = COCO17.joints


@pytest.fixture
def write_csv(tmp_path: Path) -> Callable[..., Path]:
    def write(rows: Rows, name: str = "take.csv", delimiter: str = ",") -> Path:
        path = tmp_path / name
        cells = [["" if cell is None or cell != cell else str(cell) for cell in row] for row in rows]
        if delimiter == ";":  # a spreadsheet in a country with decimal commas
            cells = [[cell.replace(".", ",") if cell[-1:].isdigit() else cell for cell in row] for row in cells]
        path.write_text("".join(f"{delimiter.join(row)}\n" for row in cells))
        return path

    return write


Write = Callable[..., Path]


def deeplabcut(person: np.ndarray, index: Callable[[int], Any] = int) -> list[list[Any]]:
    return [
        ["scorer", *["DLC_resnet50"] * 51],
        ["bodyparts", *np.repeat(NAMES, 3)],
        ["coords", *["x", "y", "likelihood"] * 17],
        *([index(i), *one.ravel()] for i, one in enumerate(person)),
    ]


def deeplabcut_animals(people: dict[str, np.ndarray]) -> list[list[Any]]:
    stacked = np.concatenate([p.reshape(len(p), -1) for p in people.values()], axis=1)
    return [
        ["scorer", *["DLC"] * 51 * len(people), "DLC", "DLC", "DLC"],
        ["individuals", *np.repeat(list(people), 51), "single", "single", "single"],
        ["bodyparts", *list(np.repeat(NAMES, 3)) * len(people), "lamp", "lamp", "lamp"],
        ["coords", *["x", "y", "likelihood"] * 17 * len(people), "x", "y", "likelihood"],
        *([i, *row, 5.0, 5.0, 1.0] for i, row in enumerate(stacked)),
    ]


def sleap(person: np.ndarray, track: str = "") -> list[list[Any]]:
    header = ["track", "frame_idx", "instance.score", *(f"{n}.{kind}" for n in NAMES for kind in ("x", "y", "score"))]
    return [header, *([track, i, 0.9, *one.ravel()] for i, one in enumerate(person))]


def wide(person: np.ndarray, columns: Callable[[int, str], str], first: str | None = "frame") -> list[list[Any]]:
    with_z = np.insert(person, 2, -0.25, axis=2)
    header = [columns(i, kind) for i in range(person.shape[1]) for kind in ("x", "y", "z", "visibility")]
    rows = [[*([i] if first is not None else []), *one.ravel()] for i, one in enumerate(with_z)]
    return [[*([first] if first is not None else []), *header], *rows]


def long(person: np.ndarray, key: Callable[[int], Any], column: str = "landmark") -> list[list[Any]]:
    rows = [[i, key(j), x, y, 0.1, v] for i, one in enumerate(person) for j, (x, y, v) in enumerate(one)]
    return [["frame", column, "x", "y", "z", "visibility"], *rows]


SHORT = {"x": "x", "y": "y", "z": "z", "visibility": "v"}
VARIANTS: dict[str, Callable[[np.ndarray], Rows]] = {
    "deeplabcut": deeplabcut,
    "deeplabcut images": lambda p: deeplabcut(p, "labeled-data/walk/img{:04d}.png".format),
    "deeplabcut one animal": lambda p: deeplabcut_animals({"mouse": p}),
    "sleap": sleap,
    "sleap tracked": lambda p: sleap(p, "track_0"),
    "mediapipe names": lambda p: wide(p, lambda i, k: f"{NAMES[i]}_{k}"),
    "mediapipe capitals": lambda p: wide(p, lambda i, k: f"{NAMES[i].upper()}_{k.upper()}", "Frame"),
    "mediapipe dots": lambda p: wide(p, lambda i, k: f"{NAMES[i]}.{k}", "frame_number"),
    "mediapipe landmark_0_x": lambda p: wide(p, lambda i, k: f"landmark_{i}_{k}"),
    "mediapipe x0": lambda p: wide(p, lambda i, k: f"{SHORT[k]}{i}", None),
    "mediapipe x_0": lambda p: wide(p, lambda i, k: f"{k}_{i}", ""),
    "mediapipe from 1": lambda p: wide(p, lambda i, k: f"{SHORT[k]}{i + 1}"),
    "mediapipe long": lambda p: long(p, int),
    "mediapipe long from 1": lambda p: long(p, lambda j: j + 1, "landmark_id"),
    "mediapipe long names": lambda p: long(p, lambda j: NAMES[j].upper(), "landmark_name"),
}


@pytest.mark.parametrize("delimiter", [",", ";", "\t"])
@pytest.mark.parametrize("variant", VARIANTS)
def test_every_variant_gives_the_same_clip(
    write_csv: Write, person: np.ndarray, expected: np.ndarray, variant: str, delimiter: str
) -> None:
    clip = read_clip(write_csv(VARIANTS[variant](person), delimiter=delimiter), fps=25.0)
    np.testing.assert_array_equal(clip.joints, expected)
    np.testing.assert_array_equal(clip.confidence, person[..., 2])
    np.testing.assert_allclose(clip.times, np.arange(6) / 25)
    assert (clip.up, clip.name, clip.fps_assumed) == ("-y", "take.csv", False)
    assert clip.skeleton is not None
    if "_0" not in variant and "x0" not in variant and "from 1" not in variant and variant != "mediapipe long":
        assert tuple(name.lower() for name in clip.skeleton.joints) == NAMES


@pytest.mark.parametrize("delimiter", [",", ";"])
def test_mediapipe_layouts(write_csv: Write, delimiter: str) -> None:
    pose = np.random.default_rng(0).uniform(0.1, 0.9, size=(3, 33, 3))
    for rows in (wide(pose, lambda i, k: f"x{i}".replace("x", SHORT[k])), long(pose, int), wide(pose, lambda i, k: f"{k}_{i + 1}")):
        clip = read_clip(write_csv(rows, delimiter=delimiter))
        assert clip.skeleton is MEDIAPIPE33
        np.testing.assert_array_equal(clip.joints, pose[..., :2])


def test_mediapipe_long_names_come_in_mediapipes_order(write_csv: Write) -> None:
    pose = np.random.default_rng(0).uniform(0.1, 0.9, size=(2, 3, 3))
    names = ["right_hip", "nose", "left_hip"]
    clip = read_clip(write_csv(long(pose, lambda j: names[j])))
    assert clip.skeleton is not None
    assert clip.skeleton.joints == ("nose", "left_hip", "right_hip")
    np.testing.assert_array_equal(clip.joints, pose[:, [1, 2, 0], :2])


def test_hands_have_no_visibility(write_csv: Write) -> None:
    hand = np.random.default_rng(0).uniform(0.1, 0.9, size=(3, 21, 3))
    hand[..., 2] = 0.0
    clip = read_clip(write_csv(wide(hand, lambda i, k: f"{k}_{i}")))
    assert clip.confidence is None
    assert clip.seen.all()
    assert clip.skeleton is HAND21


def test_size_undoes_the_aspect_ratio(write_csv: Write, person: np.ndarray, expected: np.ndarray) -> None:
    person[..., :2] /= [640, 480]
    rows = wide(person, lambda i, k: f"{NAMES[i]}_{k}")
    np.testing.assert_allclose(read_clip(write_csv(rows), size=(640, 480)).joints, expected)
    np.testing.assert_allclose(read_clip(write_csv(rows)).joints, expected / [640, 480])


@pytest.mark.parametrize(
    ("column", "stamps"),
    [
        ("time", [0.0, 0.04, 0.1, 0.12, 0.2, 0.24]),
        ("timestamp", [0.0, 0.04, 0.1, 0.12, 0.2, 0.24]),
        ("timestamp", [0, 40, 100, 120, 200, 240]),
        ("timestamp_ms", [0, 40, 100, 120, 200, 240]),
        ("time (s)", [0.0, 0.04, 0.1, 0.12, 0.2, 0.24]),
        ("timestamp", [0, 40_000, 100_000, 120_000, 200_000, 240_000]),
        ("time_us", [0, 40_000, 100_000, 120_000, 200_000, 240_000]),
    ],
)
@pytest.mark.parametrize("table", [wide, long])
def test_a_time_column_gives_the_times(write_csv: Write, person: np.ndarray, column: str, stamps: list[float], table: Any) -> None:
    rows = wide(person, lambda i, k: f"{NAMES[i]}_{k}") if table is wide else long(person, int)
    timed = [[column, *rows[0]], *([stamps[row[0]], *row] for row in rows[1:])]
    clip = read_clip(write_csv(timed), fps=10.0)
    np.testing.assert_allclose(clip.times, [0.0, 0.04, 0.1, 0.12, 0.2, 0.24])
    assert not clip.fps_assumed
    bare = [[cell for i, cell in enumerate(row) if i != 1] for row in timed]  # no frame column: times alone
    np.testing.assert_allclose(read_clip(write_csv(bare)).times, clip.times)


def test_empty_cells_and_zero_rows_are_missing(write_csv: Write, person: np.ndarray) -> None:
    person[1], person[4] = np.nan, 0.0
    for rows in (wide(person, lambda i, k: f"{NAMES[i]}_{k}"), deeplabcut(person), sleap(person)):
        clip = read_clip(write_csv(rows))
        assert clip.seen.any(axis=1).tolist() == [True, False, True, True, False, True]
        assert clip.times[5] == pytest.approx(5 / 30)


def test_several_people(write_csv: Write, person: np.ndarray, expected: np.ndarray) -> None:
    other = person.copy()
    other[..., :2] = other[..., :2] / 2 + 900
    other[3] = 0.0
    poses = [
        [["person", *rows[0]], *([name, *row] for row in rows[1:])]
        for name, rows in (("0", long(person, int)), ("1", long(other, int)))
    ]
    tables = {
        "take.csv#": deeplabcut_animals({"a": other, "b": person}),
        "sleap": [*sleap(other, "t1"), *sleap(person, "t0")[1:]],
        "mediapipe": [*poses[1], *poses[0][1:]],
    }
    for rows in tables.values():
        np.testing.assert_array_equal(read_clip(write_csv(rows)).joints, expected)
        clips = read(write_csv(rows), person="all")
        assert [len(clip) for clip in clips] == [6, 6]
        assert sorted(clip.meta["person"] for clip in clips) in (["a", "b"], ["t0", "t1"], ["0", "1"])
    untracked = [*sleap(other), *sleap(person)[1:]]
    np.testing.assert_array_equal(read_clip(write_csv(untracked), person="tracked").joints, expected)


def test_deeplabcut_in_3d_and_without_likelihood(write_csv: Write) -> None:
    joints = np.random.default_rng(0).normal(size=(3, 2, 3))
    header = [["scorer", *"aaaaaa"], ["bodyparts", *"ppp", *"qqq"], ["coords", *"xyzxyz"]]
    clip = read_clip(write_csv([*header, *([i, *one.ravel()] for i, one in enumerate(joints))]))
    np.testing.assert_array_equal(clip.joints, joints)
    header = [["scorer", "", "", *"aaaa"], ["bodyparts", "", "", *"ppqq"], ["coords", "", "", *"xyxy"]]
    rows = [["labeled-data", "walk", f"img{7 * i:03d}.png", *one[:, :2].ravel()] for i, one in enumerate(joints)]
    clip = read_clip(write_csv([*header, *rows]))
    np.testing.assert_array_equal(clip.joints, joints[..., :2])
    assert clip.confidence is None
    np.testing.assert_allclose(clip.times, np.array([0, 7, 14]) / 30)


def test_sleap_labels_without_scores(write_csv: Write, person: np.ndarray, expected: np.ndarray) -> None:
    rows = sleap(np.where(np.arange(3) == 2, np.nan, person))
    clip = read_clip(write_csv(rows))
    np.testing.assert_array_equal(clip.joints, expected)
    assert clip.confidence is None


def changed(rows: Rows, row: int, column: int, cell: Any) -> Rows:
    out = [list(cells) for cells in rows]
    out[row][column] = cell
    return out


ONE = np.arange(1.0, 52.0).reshape(1, 17, 3).repeat(4, axis=0)
MP = wide(ONE, lambda i, k: f"{NAMES[i]}_{k}")


@pytest.mark.parametrize(
    ("rows", "words"),
    [
        (changed(MP, 2, 1, "abc"), ("row 3, column 'nose_x'", "'abc' is not a number", "leave it empty")),
        (changed(deeplabcut(ONE), 4, 2, "?"), ("row 5, column 'y'", "'?'")),
        (changed(sleap(ONE), 1, 3, "?"), ("row 2, column 'nose.x'", "'?'")),
        ([*MP[:3], MP[3][:7]], ("row 4 has 7 cells, the header 69", "truncated")),
        (MP[:1], ("header but no rows", "export it again")),
        (deeplabcut(ONE)[:3], ("header but no rows", "export it again")),
        (changed(MP, 2, 0, 7), ("frame numbers must increase, but 2 follows 7", "sort")),
        (changed(MP, 2, 0, 0), ("frame 0 comes twice", "column 'person'")),
        (changed(MP, 2, 0, ""), ("data row 2 has no frame number", "number every row")),
        (changed(long(ONE, int), 2, 1, 10**9), ("landmark 1000000000", "at most")),
        (changed(MP, 2, 1, "inf"), ("frame 1, joint 0: infinite", "leave them empty")),
        ([["scorer", "a"], ["bodyparts"], ["coords", "x", "y"]], ("different lengths", "save_as_csv")),
        ([[""], [""]], ("empty", "export it again")),
        (changed(changed(MP, 0, 0, "time_s"), 2, 0, 9.0), ("times must increase", "2 s after 9 s", "sort the rows by time")),
        (changed(changed(MP, 0, 0, "time"), 2, 0, ""), ("frame 1 has no time", "fps=")),
        (changed(MP, 1, 4, ""), ("frame 0, joint 0", "confidence is NaN", "write 0")),
        ([MP[0], *([i, *[0.0] * 68] for i in range(3))], ("no person was detected in any of 3 frames", "threshold")),
        (changed(long(ONE, int), 2, 1, 0), ("landmark '0' comes twice",)),
        ([row[1:] for row in long(ONE, int)], ("no frame or time column", "export one")),
        (deeplabcut(ONE)[:1] + deeplabcut(ONE)[2:], ("no header row 'bodyparts'", "save_as_csv")),
        (changed(deeplabcut(ONE), 2, 2, "likelihood"), ("nose has the columns x, likelihood",)),
        (changed(deeplabcut(ONE), 4, 0, "first"), ("frame 'first' has no number",)),
        (changed(deeplabcut(ONE), 4, 0, 0), ("frame numbers must increase, but 0 follows 0", "drop repeated")),
        (changed(sleap(ONE), 0, 4, "nose.q"), ("no column 'nose.y'", "Export Analysis CSV")),
        (changed(sleap(ONE), 2, 1, ""), ("data row 2 has no frame number", "number every row")),
    ],
)
def test_what_is_broken_is_named(write_csv: Write, rows: Rows, words: tuple[str, ...]) -> None:
    with pytest.raises(ValueError, match=r"take\.csv: ") as caught:
        read(write_csv(rows))
    assert "\n" not in str(caught.value)
    for word in words:
        assert word in str(caught.value), str(caught.value)


def test_animals_with_other_parts_are_refused(write_csv: Write) -> None:
    rows = deeplabcut_animals({"a": ONE, "b": ONE})
    rows[2] = [cell if i < 52 else f"{cell}2" for i, cell in enumerate(rows[2])]
    with pytest.raises(ValueError, match=r"take\.csv: the individual 'b' has other body parts"):
        read(write_csv(rows))

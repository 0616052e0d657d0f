"""OpenPose, COCO, MMPose and Ultralytics: every variant gives the same clip, and what is broken is named."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from indexing.readers import read, read_clip
from indexing.skeleton import COCO17, HALPE26, HALPE136, HAND21, MEDIAPIPE33, WHOLEBODY133
from tests.grid import grid
from tests.indexing.readers.tools import refused

Write = Callable[..., Path]


def triples(one: np.ndarray) -> list[float]:
    return one.ravel().tolist()


def coco_results(person: np.ndarray, image: Callable[[int], Any] = int, **extra: Any) -> list[dict[str, Any]]:
    return [{"image_id": image(i), "category_id": 1, "keypoints": triples(p), "score": 0.9} | extra for i, p in enumerate(person)]


def coco_dataset(person: np.ndarray, offset: int = 100) -> dict[str, Any]:
    people = [{"id": i, "image_id": offset + i, "keypoints": triples(p), "track_id": 3} for i, p in enumerate(person)]
    return {
        "images": [{"id": offset + i, "file_name": f"walk/{i:06d}.jpg", "width": 640, "height": 480} for i in range(len(person))],
        "annotations": people,
        "categories": [{"id": 1, "name": "person", "keypoints": list(COCO17.joints), "skeleton": [[1, 2], [1, 3]]}],
    }


def mmpose_instance(one: np.ndarray, **extra: Any) -> dict[str, Any]:
    return {
        "keypoints": one[:, :-1].tolist(),
        "keypoint_scores": one[:, -1].tolist(),
        "bbox": [[1.0, 2.0, 3.0, 4.0]],
        "bbox_score": 0.9,
    } | extra


def yolo_person(one: np.ndarray, **extra: Any) -> dict[str, Any]:
    points = {"x": one[:, 0].tolist(), "y": one[:, 1].tolist(), "visible": one[:, 2].tolist()}
    box = {"x1": 1.0, "y1": 2.0, "x2": 3.0, "y2": 4.0}
    return {"name": "person", "class": 0, "confidence": 0.9, "box": box, "keypoints": points} | extra


META = {
    "dataset_name": "mine",
    "keypoint_id2name": {str(i): f"j{i}" for i in range(17)},
    "skeleton_links": [[0, 1]],
    "dataset_keypoint_weights": {"__ndarray__": [1.0]},
}

VARIANTS: dict[str, Callable[[np.ndarray], Any]] = {
    "openpose list": lambda p: [{"people": [{"pose_keypoints_2d": triples(one)}]} for one in p],
    "openpose old key": lambda p: [{"people": [{"pose_keypoints": triples(one)}]} for one in p],
    "alphapose open": lambda p: {
        f"{i}.jpg": {"version": 0.1, "people": [{"pose_keypoints_2d": triples(one)}]} for i, one in enumerate(p)
    },
    "alphapose cmu": lambda p: {f"{i}.jpg": {"version": 0.1, "bodies": [{"joints": triples(one)}]} for i, one in enumerate(p)},
    "coco int": coco_results,
    "coco names": lambda p: coco_results(p, "{:06d}.jpg".format),
    "coco reversed": lambda p: coco_results(p)[::-1],
    "coco rows": lambda p: [{"image_id": i, "keypoints": one.tolist()} for i, one in enumerate(p)],
    "alphapose idx": lambda p: coco_results(p, "{}.jpg".format, idx=[0.0], box=[1, 2, 3, 4]),
    "coco attributes": lambda p: coco_results(p, idx=None, attributes={"track_id": 4, "idx": 2}),
    "coco dataset": coco_dataset,
    "mmpose frames": lambda p: [[mmpose_instance(one)] for one in p],
    "mmpose inferencer": lambda p: [{"frame_id": i, "instances": [mmpose_instance(one)]} for i, one in enumerate(p)],
    "mmpose demo": lambda p: {
        "meta_info": META,
        "instance_info": [{"frame_id": i + 1, "instances": [mmpose_instance(one, track_id=4)]} for i, one in enumerate(p)],
    },
    "mmpose nested": lambda p: [[mmpose_instance(one) | {"keypoints": [one[:, :2].tolist()]}] for one in p],
    "ultralytics frames": lambda p: [[yolo_person(one)] for one in p],
    "ultralytics strings": lambda p: [json.dumps([yolo_person(one)]) for one in p],
}


@grid(("variant", list(VARIANTS)))
def test_every_variant_gives_the_same_clip(write_json: Write, person: np.ndarray, expected: np.ndarray, variant: str) -> None:
    clip = read_clip(write_json(VARIANTS[variant](person)), fps=25.0)
    np.testing.assert_array_equal(clip.joints, expected)
    np.testing.assert_array_equal(clip.confidence, person[..., 2])
    np.testing.assert_allclose(clip.times, np.arange(6) / 25)
    assert (clip.up, clip.name, clip.fps_assumed, clip.label) == ("-y", "take.json", False, None)
    assert clip.skeleton is not None
    assert len(clip.skeleton.bones) > 0


FOLDERS: dict[str, Callable[[int, np.ndarray], Any]] = {
    "openpose": lambda _, one: {"people": [{"person_id": [-1], "pose_keypoints_2d": triples(one), "face_keypoints_2d": []}]},
    "coco": lambda number, one: coco_results(one[None], lambda _: f"{number}.jpg"),
    "mmpose": lambda _, one: [mmpose_instance(one)],
    "mmpose wrapped": lambda _, one: [[mmpose_instance(one)]],
    "ultralytics": lambda _, one: [yolo_person(one)],
}


@grid(("variant", list(FOLDERS)))
def test_a_folder_of_frames(write_json: Write, person: np.ndarray, expected: np.ndarray, variant: str) -> None:
    numbers = [10, 11, 12, 20, 21, 22]
    for number, one in zip(numbers, person, strict=True):
        path = write_json(FOLDERS[variant](number, one), f"{variant}/run/frame_{number}.json")
    clip = read_clip(path.parent)
    np.testing.assert_array_equal(clip.joints, expected)
    np.testing.assert_allclose(clip.times, np.array(numbers) / 30)  # the gap stays a gap in time
    assert clip.name == "run"
    assert clip.fps_assumed


def test_frames_without_people_are_nan_rows(write_json: Write, person: np.ndarray) -> None:
    empty, one = {"people": []}, mmpose_instance(person[0])
    for data in (
        [empty, {"people": [{"pose_keypoints_2d": triples(person[0])}]}, empty],
        [{"frame_id": i, "instances": [one] if i == 1 else []} for i in range(3)],
        [[], [yolo_person(person[0])], "[]"],
        coco_dataset(person[:3]) | {"annotations": coco_dataset(person)["annotations"][1:2]},
    ):
        clip = read_clip(write_json(data))
        assert clip.seen.any(axis=1).tolist() == [False, True, False]
        assert clip.confidence is not None
        assert (clip.confidence[[0, 2]] == 0).all()
        assert clip.times[1] == pytest.approx(1 / 30)


@grid(("variant", ["coco names", "alphapose open", "alphapose cmu"]), ("layout", [COCO17, HALPE26, WHOLEBODY133, HALPE136]))
def test_layouts_are_known_by_their_number(write_json: Write, variant: str, layout: Any) -> None:
    rng, count = np.random.default_rng(0), len(layout.joints)
    person = np.concatenate([rng.uniform(10, 400, (6, count, 2)), rng.uniform(0.1, 1, (6, count, 1))], axis=2)
    clip = read_clip(write_json(VARIANTS[variant](person)))
    assert clip.skeleton is layout
    np.testing.assert_allclose(clip.joints, person[..., :2])
    np.testing.assert_allclose(clip.confidence, person[..., 2])
    np.testing.assert_allclose(clip.times, np.arange(6) / 30)


def test_names_of_the_file_are_kept(write_json: Write, person: np.ndarray) -> None:
    demo = read_clip(write_json(VARIANTS["mmpose demo"](person))).skeleton
    assert demo is not None
    assert (demo.name, demo.joints[:2], demo.bones) == ("mine", ("j0", "j1"), ((0, 1),))
    dataset = read_clip(write_json(coco_dataset(person))).skeleton
    assert dataset is not None
    assert (dataset.joints, dataset.bones) == (COCO17.joints, ((0, 1), (0, 2)))


def test_3d_joints_of_a_lifter_have_z_up_and_those_of_openpose_are_read(write_json: Write) -> None:
    joints = np.random.default_rng(0).normal(size=(4, 17, 3))
    joints[:, 0] = 0.0  # the pelvis: a real place in 3D
    clip = read_clip(write_json([[{"keypoints": one.tolist(), "keypoint_scores": [[1.0] * 17]}] for one in joints]))
    np.testing.assert_array_equal(clip.joints, joints)
    assert (clip.up, clip.skeleton) == ("z", None)
    table = np.random.default_rng(0).uniform(1, 2, size=(25, 4))
    people = {"people": [{"pose_keypoints_2d": [], "pose_keypoints_3d": triples(table)}]}
    clip = read_clip(write_json(people, "f_3_keypoints.json"))
    np.testing.assert_array_equal(clip.joints[0], table[:, :3])
    assert clip.times.tolist() == [0.1]


def test_no_confidence_in_the_file(write_json: Write, person: np.ndarray, expected: np.ndarray) -> None:
    bare = [[{"keypoints": {"x": one[:, 0].tolist(), "y": one[:, 1].tolist()}, "class": 0, "box": {}}] for one in person]
    clip = read_clip(write_json(bare))
    assert clip.confidence is None
    np.testing.assert_array_equal(clip.joints, expected)
    with pytest.raises(ValueError, match=r"take\.json: .*no confidences.*min_confidence at 0"):
        read(write_json(bare), min_confidence=0.5)
    person[0, 5] = [0.0, 0.0, 0.4]  # what YOLO sets to zero is missing, whatever its confidence
    assert not read_clip(write_json([[yolo_person(one)] for one in person])).seen[0, 5]


def test_min_confidence_and_size(write_json: Write, person: np.ndarray, expected: np.ndarray) -> None:
    clip = read_clip(write_json(coco_results(person)), min_confidence=0.7)
    np.testing.assert_array_equal(clip.seen, person[..., 2] >= 0.7)
    with pytest.raises(ValueError, match=r"no person was detected in any of 6 frames.*min_confidence"):
        read(write_json(coco_results(person)), min_confidence=2.0)
    small = person.copy()
    small[..., :2] /= [640, 480]
    clip = read_clip(write_json([[yolo_person(one)] for one in small]), size=(640, 480))
    np.testing.assert_allclose(clip.joints, expected)
    with pytest.raises(ValueError, match=r"take\.json: size= .*leave size out"):
        read(write_json(coco_results(person)), size=(640, 480))


GOOD = [1.0, 2.0, 0.5] * 17


BROKEN: list[tuple[Any, tuple[str, ...]]] = [
    ([{"image_id": 0, "keypoints": [1.0, 2.0]}], ("annotation 0 (image_id 0), keypoints", "3 numbers per joint", "(2,)")),
    (
        [{"image_id": 0, "keypoints": GOOD}, {"image_id": 1, "keypoints": GOOD[:-3]}],
        ("frame 1", "(16, 2)", "(17, 2)", "same joint layout"),
    ),
    ([{"image_id": 0, "keypoints": ["a", 1, 1]}], ("annotation 0", "expected numbers", "'a'")),
    ([{"image_id": 0, "keypoints": GOOD}, {"image_id": 1, "bbox": []}], ("annotation 1", "needs image_id and keypoints")),
    ([{"image_id": 0, "category_id": 1, "bbox": [1, 2, 3, 4]}], ("annotation 0", "needs image_id and keypoints")),
    ([{"image_id": "a.jpg", "keypoints": GOOD}], ("'a.jpg' has no number", "name the images")),
    ([{"image_id": None, "keypoints": GOOD}], ("image_id must be",)),
    (
        [{"image_id": f"{c}/1.jpg", "keypoints": GOOD} for c in "ab"],
        ("'a/1.jpg' and 'b/1.jpg' are both frame 1", "one recording per file"),
    ),
    ([{"image_id": 0, "keypoints": [0.0] * 51}], ("no person was detected in any of 1 frames", "threshold")),
    ([{"image_id": 0, "keypoints": [1.0, 2.0, float("nan")] * 17}], ("frame 0, joint 0", "confidence is NaN", "write 0")),
    ([{"image_id": 10**30, "keypoints": GOOD}], ("frame number 1000", "number images by frame")),
    ([{"image_id": 0, "keypoints": [float("inf"), 2.0, 0.5] * 17}], ("frame 0, joint 0: infinite", "leave them empty")),
    ({"annotations": []}, ("no person was detected", "threshold")),
    ({"annotations": [{"image_id": 1, "keypoints": GOOD}], "images": [{"name": "x"}]}, ("'images'", "export the dataset again")),
    ({"people": []}, ("no person was detected in any of 1 frames", "threshold")),
    ({"people": [{"pose_keypoints_2d": [1, 2]}]}, ("frame 0, person 0, pose_keypoints_2d", "3 numbers per joint")),
    ({"people": None}, ("frame 0: no list 'people'", "--write_json")),
    ({"people": [3]}, ("frame 0: no list 'people'", "--write_json")),
    ([[{"keypoint_scores": [1.0]}]], ("frame 0, instance 0: no keypoints", "pred_out_dir")),
    ([[{"keypoints": [[1, 2, 3, 4]], "keypoint_scores": [1]}]], ("frame 0, instance 0", "(1, 4)")),
    ([[{"keypoints": [[1, 2], [3]], "keypoint_scores": [1, 1]}]], ("frame 0, instance 0, keypoints", "expected numbers")),
    ([[{"keypoints": [[1, 2], [3, 4]], "keypoint_scores": [1, 1, 1]}]], ("2 keypoints, but keypoint_scores of shape (3,)",)),
    ({"instance_info": {}}, ("no list of frames", "--save-predictions")),
    ([[{"class": 0, "box": {}, "name": "person"}]], ("frame 0, person 0: no keypoints", "pose model")),
    ([[{"class": 0, "box": {}, "keypoints": {"x": [1, 2], "y": [1]}}]], ("frame 0, person 0", "different lengths")),
    (["[{]"], ("frame 0: not valid JSON", "to_json")),
]


def test_what_is_broken_is_named(write_json: Write) -> None:
    for data, words in BROKEN:
        refused(write_json(data), *words)


# DeepLabCut, SLEAP and MediaPipe tables


Rows = Sequence[Sequence[Any]]
NAMES = COCO17.joints


def save_rows(path: Path, rows: Rows, delimiter: str = ",") -> Path:
    cells = [["" if cell is None or cell != cell else str(cell) for cell in row] for row in rows]
    if delimiter == ";":  # a spreadsheet in a country with decimal commas
        cells = [[cell.replace(".", ",") if cell[-1:].isdigit() else cell for cell in row] for row in cells]
    path.write_text("".join(f"{delimiter.join(row)}\n" for row in cells))
    return path


@pytest.fixture
def write_csv(tmp_path: Path) -> Callable[..., Path]:
    return partial(save_rows, tmp_path / "take.csv")


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
TABLES: dict[str, Callable[[np.ndarray], Rows]] = {
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


@grid(("delimiter", [",", ";", "\t"]), ("variant", list(TABLES)))
def test_every_table_gives_the_same_clip(write_csv, person, expected, variant, delimiter):
    clip = read_clip(write_csv(TABLES[variant](person), delimiter=delimiter), fps=25.0)
    np.testing.assert_array_equal(clip.joints, expected)
    np.testing.assert_array_equal(clip.confidence, person[..., 2])
    np.testing.assert_allclose(clip.times, np.arange(6) / 25)
    assert (clip.up, clip.name, clip.fps_assumed) == ("-y", "take.csv", False)
    assert clip.skeleton is not None
    if "_0" not in variant and "x0" not in variant and "from 1" not in variant and variant != "mediapipe long":
        assert tuple(name.lower() for name in clip.skeleton.joints) == NAMES


def test_mediapipe_layouts(write_csv: Write) -> None:
    pose = np.random.default_rng(0).uniform(0.1, 0.9, size=(3, 33, 3))
    for rows in (wide(pose, lambda i, k: f"{SHORT[k]}{i}"), long(pose, int), wide(pose, lambda i, k: f"{k}_{i + 1}")):
        clip = read_clip(write_csv(rows))
        assert clip.skeleton is MEDIAPIPE33
        np.testing.assert_array_equal(clip.joints, pose[..., :2])
    names = ["right_hip", "nose", "left_hip"]
    clip = read_clip(write_csv(long(pose[:, :3], lambda j: names[j])))  # long names come in MediaPipe's order
    assert clip.skeleton is not None and clip.skeleton.joints == ("nose", "left_hip", "right_hip")
    np.testing.assert_array_equal(clip.joints, pose[:, [1, 2, 0], :2])
    hand = pose[:, :21] * [1, 1, 0]
    clip = read_clip(write_csv(wide(hand, lambda i, k: f"{k}_{i}")))
    assert clip.confidence is None and clip.seen.all() and clip.skeleton is HAND21  # hands have no visibility


def test_size_undoes_the_aspect_ratio(write_csv: Write, person: np.ndarray, expected: np.ndarray) -> None:
    person[..., :2] /= [640, 480]
    rows = wide(person, lambda i, k: f"{NAMES[i]}_{k}")
    np.testing.assert_allclose(read_clip(write_csv(rows), size=(640, 480)).joints, expected)
    np.testing.assert_allclose(read_clip(write_csv(rows)).joints, expected / [640, 480])


STAMPS = np.array([0.0, 0.04, 0.1, 0.12, 0.2, 0.24])


@grid(
    (
        ("column", "unit"),
        [
            *(("time", 1), ("timestamp", 1), ("timestamp", 1e3), ("timestamp_ms", 1e3), ("time (s)", 1)),
            *(("timestamp", 1e6), ("time_us", 1e6)),
        ],
    ),
    ("table", [wide, long]),
)
def test_a_time_column_gives_the_times(write_csv: Write, person: np.ndarray, column: str, unit: float, table: Any) -> None:
    rows = wide(person, lambda i, k: f"{NAMES[i]}_{k}") if table is wide else long(person, int)
    timed = [[column, *rows[0]], *([f"{unit * STAMPS[row[0]]:g}", *row] for row in rows[1:])]
    clip = read_clip(write_csv(timed), fps=10.0)
    np.testing.assert_allclose(clip.times, STAMPS)
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


BROKEN_TABLES: list[tuple[Rows, tuple[str, ...]]] = [
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
]


def test_broken_tables_are_named(write_csv: Write) -> None:
    for rows, words in BROKEN_TABLES:
        refused(write_csv(rows), *words)
    rows = deeplabcut_animals({"a": ONE, "b": ONE})
    rows[2] = [cell if i < 52 else f"{cell}2" for i, cell in enumerate(rows[2])]
    refused(write_csv(rows), "the individual 'b' has other body parts")

"""OpenPose, COCO, MMPose and Ultralytics: every variant gives the same clip, and what is broken is named."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from indexing.readers import read, read_clip
from indexing.skeleton import BODY25, COCO17, HALPE26

Write = Callable[..., Path]


def triples(one: np.ndarray) -> list[float]:
    return one.ravel().tolist()


def coco_results(person: np.ndarray, image: Callable[[int], Any] = int, **extra: Any) -> list[dict[str, Any]]:
    return [{"image_id": image(i), "category_id": 1, "keypoints": triples(p), "score": 0.9} | extra for i, p in enumerate(person)]


def coco_dataset(person: np.ndarray, offset: int = 100) -> dict[str, Any]:
    people = [{"id": i, "image_id": offset + i, "category_id": 1, "keypoints": triples(p)} for i, p in enumerate(person)]
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
        "instance_info": [{"frame_id": i + 1, "instances": [mmpose_instance(one)]} for i, one in enumerate(p)],
    },
    "mmpose nested": lambda p: [[mmpose_instance(one) | {"keypoints": [one[:, :2].tolist()]}] for one in p],
    "ultralytics frames": lambda p: [[yolo_person(one)] for one in p],
    "ultralytics strings": lambda p: [json.dumps([yolo_person(one)]) for one in p],
}


@pytest.mark.parametrize("variant", VARIANTS)
def test_every_variant_gives_the_same_clip(write_json: Write, person: np.ndarray, expected: np.ndarray, variant: str) -> None:
    clip = read_clip(write_json(VARIANTS[variant](person)), fps=25.0)
    np.testing.assert_array_equal(clip.joints, expected)
    np.testing.assert_array_equal(clip.confidence, person[..., 2])
    np.testing.assert_allclose(clip.times, np.arange(6) / 25)
    assert (clip.up, clip.name, clip.fps_assumed, clip.label) == ("-y", "take.json", False, None)
    assert clip.skeleton is not None
    assert len(clip.skeleton.bones) > 0


FOLDERS: dict[str, Callable[[np.ndarray], Any]] = {
    "openpose": lambda one: {"people": [{"person_id": [-1], "pose_keypoints_2d": triples(one), "face_keypoints_2d": []}]},
    "coco": lambda one: None,  # filled below: it needs the image's name
    "mmpose": lambda one: [mmpose_instance(one)],
    "mmpose wrapped": lambda one: [[mmpose_instance(one)]],
    "ultralytics": lambda one: [yolo_person(one)],
}


@pytest.mark.parametrize("variant", FOLDERS)
def test_a_folder_of_frames(write_json: Write, person: np.ndarray, expected: np.ndarray, variant: str) -> None:
    numbers = [10, 11, 12, 20, 21, 22]
    for number, one in zip(numbers, person, strict=True):
        data = coco_results(one[None], lambda _, n=number: f"{n}.jpg") if variant == "coco" else FOLDERS[variant](one)
        path = write_json(data, f"run/frame_{number}.json")
    clip = read_clip(path.parent)
    np.testing.assert_array_equal(clip.joints, expected)
    np.testing.assert_allclose(clip.times, np.array(numbers) / 30)  # the gap stays a gap in time
    assert clip.name == "run"
    assert clip.fps_assumed


@pytest.mark.parametrize("name", ["openpose", "mmpose", "ultralytics", "coco dataset"])
def test_frames_without_people_are_nan_rows(write_json: Write, person: np.ndarray, name: str) -> None:
    data = {
        "openpose": [{"people": []}, {"people": [{"pose_keypoints_2d": triples(person[0])}]}, {"people": []}],
        "mmpose": [
            {"frame_id": 0, "instances": []},
            {"frame_id": 1, "instances": [mmpose_instance(person[0])]},
            {"frame_id": 2, "instances": []},
        ],
        "ultralytics": [[], [yolo_person(person[0])], "[]"],
        "coco dataset": coco_dataset(person[:3]) | {"annotations": coco_dataset(person)["annotations"][1:2]},
    }[name]
    clip = read_clip(write_json(data))
    assert clip.seen.any(axis=1).tolist() == [False, True, False]
    assert clip.confidence is not None
    assert (clip.confidence[[0, 2]] == 0).all()
    assert clip.times[1] == pytest.approx(1 / 30)


def test_layouts(openpose_folder: Write, write_json: Write) -> None:
    rng = np.random.default_rng(0)
    assert read_clip(openpose_folder({0: [rng.uniform(1, 9, size=(25, 3))]})).skeleton is BODY25
    halpe = [{"image_id": "0.jpg", "keypoints": rng.uniform(1, 9, size=78).tolist()}]
    assert read_clip(write_json(halpe)).skeleton is HALPE26


def test_names_of_the_file_are_kept(write_json: Write, person: np.ndarray) -> None:
    demo = read_clip(write_json(VARIANTS["mmpose demo"](person))).skeleton
    assert demo is not None
    assert (demo.name, demo.joints[:2], demo.bones) == ("mine", ("j0", "j1"), ((0, 1),))
    dataset = read_clip(write_json(coco_dataset(person))).skeleton
    assert dataset is not None
    assert (dataset.joints, dataset.bones) == (COCO17.joints, ((0, 1), (0, 2)))


def test_3d_joints_of_a_lifter_have_z_up(write_json: Write) -> None:
    joints = np.random.default_rng(0).normal(size=(4, 17, 3))
    joints[:, 0] = 0.0  # the pelvis: a real place in 3D
    frames = [[{"keypoints": one.tolist(), "keypoint_scores": [[1.0] * 17]}] for one in joints]
    clip = read_clip(write_json(frames))
    np.testing.assert_array_equal(clip.joints, joints)
    assert (clip.up, clip.skeleton) == ("z", None)


def test_3d_openpose(write_json: Write) -> None:
    joints = np.random.default_rng(0).uniform(1, 2, size=(25, 4))
    clip = read_clip(
        write_json({"people": [{"pose_keypoints_2d": [], "pose_keypoints_3d": triples(joints)}]}, "f_3_keypoints.json")
    )
    np.testing.assert_array_equal(clip.joints[0], joints[:, :3])
    assert clip.times.tolist() == [0.1]


def test_points_that_yolo_sets_to_zero_are_missing_whatever_their_confidence(write_json: Write, person: np.ndarray) -> None:
    person[0, 5] = [0.0, 0.0, 0.4]
    clip = read_clip(write_json([[yolo_person(one)] for one in person]))
    assert not clip.seen[0, 5]


def test_no_confidence_in_the_file(write_json: Write, person: np.ndarray, expected: np.ndarray) -> None:
    bare = [[{"keypoints": {"x": one[:, 0].tolist(), "y": one[:, 1].tolist()}, "class": 0, "box": {}}] for one in person]
    clip = read_clip(write_json(bare))
    assert clip.confidence is None
    np.testing.assert_array_equal(clip.joints, expected)
    with pytest.raises(ValueError, match=r"take\.json: .*no confidences.*min_confidence at 0"):
        read(write_json(bare), min_confidence=0.5)


def test_min_confidence(write_json: Write, person: np.ndarray) -> None:
    clip = read_clip(write_json(coco_results(person)), min_confidence=0.7)
    np.testing.assert_array_equal(clip.seen, person[..., 2] >= 0.7)
    with pytest.raises(ValueError, match=r"no person was detected in any of 6 frames.*min_confidence"):
        read(write_json(coco_results(person)), min_confidence=2.0)


def test_size_undoes_normalized_coordinates_and_refuses_pixels(write_json: Write, person: np.ndarray, expected: np.ndarray) -> None:
    small = person.copy()
    small[..., :2] /= [640, 480]
    clip = read_clip(write_json([[yolo_person(one)] for one in small]), size=(640, 480))
    np.testing.assert_allclose(clip.joints, expected)
    with pytest.raises(ValueError, match=r"take\.json: size= .*leave size out"):
        read(write_json(coco_results(person)), size=(640, 480))


GOOD = [1.0, 2.0, 0.5] * 17


@pytest.mark.parametrize(
    ("data", "words"),
    [
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
        (
            {"annotations": [{"image_id": 1, "keypoints": GOOD}], "images": [{"name": "x"}]},
            ("'images'", "export the dataset again"),
        ),
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
    ],
)
def test_what_is_broken_is_named(write_json: Write, data: Any, words: tuple[str, ...]) -> None:
    with pytest.raises(ValueError, match=r"take\.json: ") as caught:
        read(write_json(data))
    assert "\n" not in str(caught.value)
    for word in words:
        assert word in str(caught.value), str(caught.value)

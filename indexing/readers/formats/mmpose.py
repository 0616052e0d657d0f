"""MMPose / RTMPose predictions: frames of instances ``{keypoints, keypoint_scores, bbox, bbox_score}``.

Variants: a list of frames, each a list of instances; a list of ``{"frame_id", "instances"}`` (the inferencer, counting from
0); ``{"meta_info", "instance_info"}`` (the demo scripts, counting frames from 1; a single image has the instances
themselves); a folder with one file per image.  Joints are 2D pixels, or 3D from a pose lifter, which MMPose writes z up.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from indexing.clip import ClipSet
from indexing.opening import error
from indexing.readers.files import Format, Options, Source
from indexing.readers.recording import Detection, collect_detections, parse_numbers, to_clips, track_id
from indexing.skeleton import Skeleton, candidates, usual_layout

REMEDY = "export with MMPoseInferencer(..., pred_out_dir=...) or a demo script's --save-predictions"


def read(source: Source, options: Options) -> ClipSet:
    """Read MMPose predictions."""
    people = [
        (number, [_detection(source, number, i, instance) for i, instance in enumerate(instances)])
        for number, instances in _frames(source)
    ]
    recording = collect_detections(source.path, people)
    joints, dims = recording.joints.shape[1:]
    layout, up = _layout(source, joints), "-y" if dims == 2 else "z"
    rivals = candidates(joints) if layout is None and dims == 3 else ()  # a lifter's, which are Human3.6M's as a rule
    if layout is None and dims == 2:
        layout = usual_layout(joints)
    return to_clips(source.path, replace(recording, skeleton=layout, up=up, layouts=rivals), options)


def _frames(source: Source) -> list[tuple[int, list[Any]]]:
    if source.kind == "json folder":
        return [(frame.number, _one_frame(source, frame.number, frame.data)) for frame in source.data]
    data = source.data
    demo = isinstance(data, dict)
    if demo:
        data = data.get("instance_info")
    if not isinstance(data, list):
        raise error(source.path, "has no list of frames", REMEDY)
    if any(isinstance(item, dict) and "keypoints" in item for item in data):  # the instances of a single image
        return [(0, data)]
    ids = [item["frame_id"] for item in data if isinstance(item, dict) and isinstance(item.get("frame_id"), int)]
    if len(ids) < len(data):
        ids = list(range(len(data)))
    elif demo and 0 not in ids:  # the demo scripts count from 1; times start at the video's first frame
        ids = [i - 1 for i in ids]
    return [(i, _one_frame(source, i, item)) for i, item in zip(ids, data, strict=True)]


def _one_frame(source: Source, number: int, frame: Any) -> list[Any]:
    if isinstance(frame, dict):
        frame = frame.get("instances", frame.get("instance_info"))
    if isinstance(frame, list) and len(frame) == 1 and isinstance(frame[0], list):  # one file per image wraps it once more
        frame = frame[0]
    if not isinstance(frame, list):
        raise error(source.path, f"frame {number}: no list of instances", REMEDY)
    return frame


def _detection(source: Source, number: int, index: int, instance: Any) -> Detection:
    where = f"frame {number}, instance {index}"
    if not isinstance(instance, dict) or "keypoints" not in instance:
        raise error(source.path, f"{where}: no keypoints", REMEDY)
    joints = parse_numbers(source.path, f"{where}, keypoints", instance["keypoints"])
    joints = joints[0] if joints.ndim == 3 and len(joints) == 1 else joints
    if joints.ndim != 2 or joints.shape[1] not in (2, 3):
        raise error(source.path, f"{where}: keypoints must be (joints, 2 or 3), got shape {joints.shape}", REMEDY)
    scores = instance.get("keypoint_scores")
    confidence = None
    if scores is not None:
        confidence = np.atleast_1d(parse_numbers(source.path, f"{where}, keypoint_scores", scores).squeeze())
        if confidence.shape != joints.shape[:1]:
            raise error(source.path, f"{where}: {len(joints)} keypoints, but keypoint_scores of shape {confidence.shape}", REMEDY)
    return Detection(joints, confidence, track_id(instance.get("track_id")))


def _layout(source: Source, joints: int) -> Skeleton | None:
    """The layout in ``meta_info``, where it is there and whole."""
    meta = source.data.get("meta_info") if isinstance(source.data, dict) else None
    try:
        named = {int(i): str(name) for i, name in meta["keypoint_id2name"].items()}  # type: ignore[index]
        bones = tuple((int(a), int(b)) for a, b in meta.get("skeleton_links", ()))  # type: ignore[union-attr]
        names = tuple(named[i] for i in range(joints))
        if "neck_base" in names and "left_ankle" not in names:  # Human3.6M's word for the ankles
            names = tuple(name.replace("_foot", "_ankle") for name in names)
        return Skeleton(str(meta.get("dataset_name", "MMPose")), names, bones)  # type: ignore[union-attr]
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError):
        return None  # names are a convenience: without them the joints are as good


def matches(source: Source) -> bool:
    """The object of a demo script, or a list of frames or of instances."""
    match source.data:
        case {"instance_info": _} | [{"instances": _} | {"keypoint_scores": _}]:
            return True
    return False


FORMAT = Format(("MMPose",), ("json", "json folder"), read, matches, order=20)

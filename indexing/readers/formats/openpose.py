"""OpenPose JSON: a folder with one file per frame, ``people[].pose_keypoints_2d`` = x, y, c per joint.

Also read: a single frame; files with all frames in a list; AlphaPose's ``--format open`` and ``cmu`` (one object per image
name, ``bodies[].joints``); the old key ``pose_keypoints``; 3D output (``pose_keypoints_3d``) where there is no 2D.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from indexing import skeleton
from indexing.clip import ClipSet
from indexing.opening import error
from indexing.readers.files import Format, Options, Source, frame_number
from indexing.readers.recording import Detection, collect_detections, parse_flat_joints, to_clips, track_id

# layouts by number of joints; AlphaPose and RTMPose write their own in OpenPose's form
LAYOUTS = {
    25: skeleton.BODY25, 18: skeleton.OPENPOSE18, 15: skeleton.OPENPOSE_MPI15, 17: skeleton.COCO17, 33: skeleton.MEDIAPIPE33,
    26: skeleton.HALPE26, 133: skeleton.WHOLEBODY133, 136: skeleton.HALPE136,
}  # fmt: skip
RIVALS = {25: (skeleton.BODY25, skeleton.BODY25B)}
"""Models of OpenPose that a number of joints does not tell apart."""


def read(source: Source, options: Options) -> ClipSet:
    """Read OpenPose JSON; the frame number is the one in the file's name."""
    recording = collect_detections(source.path, [(number, _people(source, number, frame)) for number, frame in _frames(source)])
    joints = recording.joints.shape[1]
    recording = replace(recording, skeleton=LAYOUTS.get(joints), layouts=RIVALS.get(joints, ()))
    return to_clips(source.path, recording, options)


def _frames(source: Source) -> list[tuple[int, Any]]:
    if source.kind == "json folder":
        return [(frame.number, frame.data) for frame in source.data]
    data = source.data
    if isinstance(data, list):
        return list(enumerate(data))
    if isinstance(data, dict) and not {"people", "bodies"} & data.keys():
        numbers = [frame_number(name) for name in data]
        if None in numbers or len(set(numbers)) < len(numbers):
            return list(enumerate(data.values()))  # names without usable numbers: the order of the file
        return [(number, frame) for number, frame in zip(numbers, data.values(), strict=True) if number is not None]
    return [(frame_number(source.path.name) or 0, data)]


def _people(source: Source, number: int, frame: Any) -> list[Detection]:
    people = frame.get("people", frame.get("bodies")) if isinstance(frame, dict) else None
    if not isinstance(people, list) or not all(isinstance(person, dict) for person in people):
        raise error(source.path, f"frame {number}: no list 'people'", "write OpenPose JSON with --write_json, one file per frame")
    detections = []
    for i, person in enumerate(people):
        where = f"frame {number}, person {i}"
        track = track_id(person.get("person_id", person.get("idx")))  # [-1] unless a tracker ran
        flat_2d = next((person[key] for key in ("pose_keypoints_2d", "pose_keypoints", "joints") if person.get(key)), None)
        if flat_2d:
            detections.append(Detection(*parse_flat_joints(source.path, f"{where}, pose_keypoints_2d", flat_2d), track))
        elif person.get("pose_keypoints_3d"):
            detections.append(
                Detection(*parse_flat_joints(source.path, f"{where}, pose_keypoints_3d", person["pose_keypoints_3d"], 4), track)
            )
    return detections


def matches(source: Source) -> bool:
    """An object with a list of people, a list of such objects, or one by the name of each image."""
    match source.data:
        case {"people": _} | {"bodies": _} | [{"people": _} | {"bodies": _}]:
            return True
        case {"instance_info": _} | {"annotations": _}:
            return False
        case dict(images):
            first = next(iter(images.values()), None)
            return isinstance(first, dict) and ("people" in first or "bodies" in first)
    return False


FORMAT = Format(("OpenPose", "AlphaPose"), ("json folder", "json"), read, matches, order=10)

"""COCO keypoints: a results list (one object per person: ``image_id``, ``keypoints`` = x, y, c per joint), or a dataset file.

AlphaPose and MMPose's evaluation write the results list (AlphaPose: also one list per image in a folder, and the person's
identity in ``idx``); annotation tools write the dataset file, ``{"images", "annotations", "categories"}``, where the third
number per joint is the visibility flag 0, 1 or 2 and is kept as confidence.
"""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import replace
from typing import Any

from indexing.clip import ClipSet
from indexing.opening import error, quote
from indexing.readers.files import Format, Options, Source, frame_number
from indexing.readers.recording import Detection, collect_detections, parse_flat_joints, to_clips, track_id
from indexing.skeleton import Skeleton, usual_layout

REMEDY = "export COCO keypoint results: a list of {image_id, category_id, keypoints, score}"
IDENTITIES = ("track_id", "tracking_id", "person_id", "idx")


def read(source: Source, options: Options) -> ClipSet:
    """Read COCO keypoints; the frame number is ``image_id``, or the number in the image's name."""
    people, images, names, bones = _parts(source)
    frames: dict[Hashable, list[Detection]] = {image: [] for image in images}
    for i, person in enumerate(people):
        where = f"annotation {i}"
        if not isinstance(person, dict) or "image_id" not in person or "keypoints" not in person:
            raise error(source.path, f"{where}: needs image_id and keypoints", REMEDY)
        image = person["image_id"]
        if not isinstance(image, (int, str)):
            raise error(source.path, f"{where}: image_id must be a number or a file name, got {quote(image)}", REMEDY)
        where = f"{where} (image_id {quote(image)}), keypoints"
        detections = frames.setdefault(image, [])
        if person["keypoints"]:
            detections.append(Detection(*parse_flat_joints(source.path, where, person["keypoints"]), _track(person)))
    if not frames:
        raise error(source.path, "no person was detected in any frame", "check the video or the pose estimator's threshold")
    numbers = _numbers(source, {image: images.get(image, image) for image in frames})
    recording = collect_detections(source.path, [(numbers[image], detections) for image, detections in frames.items()])
    joints = recording.joints.shape[1]
    layout = Skeleton(source.path.stem, names, bones) if len(names) == joints else usual_layout(joints)
    return to_clips(source.path, replace(recording, skeleton=layout), options)


def _parts(source: Source) -> tuple[list[Any], dict[Hashable, Any], tuple[str, ...], tuple[tuple[int, int], ...]]:
    """People, images (id -> name), joint names and bones of any variant."""
    data = source.data
    if source.kind == "json folder":
        data = [person for frame in data for person in (frame.data if isinstance(frame.data, list) else [frame.data])]
    if isinstance(data, list):
        return data, {}, (), ()
    if not isinstance(data, dict) or not isinstance(data.get("annotations"), list):
        raise error(source.path, "is neither a list of people nor an object with 'annotations'", REMEDY)
    try:
        images = {image["id"]: image.get("file_name", image["id"]) for image in data.get("images", [])}
        category: dict[str, Any] = next((c for c in data.get("categories", []) if c.get("keypoints")), {})
        names = tuple(str(name) for name in category.get("keypoints", ()))
        bones = tuple((int(a) - 1, int(b) - 1) for a, b in category.get("skeleton", ()))  # COCO counts joints from 1
        Skeleton("", names, bones)
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as problem:
        raise error(source.path, f"'images' or 'categories' are not as in COCO ({problem})", "export the dataset again") from None
    people = [person for person in data["annotations"] if not isinstance(person, dict) or person.get("keypoints")]
    return people, images, names, bones


def _numbers(source: Source, images: dict[Hashable, Any]) -> dict[Hashable, int]:
    """Frame number of each image."""
    numbers: dict[Hashable, int] = {}
    owner: dict[int, Any] = {}
    for image, name in images.items():
        number = name if isinstance(name, int) else frame_number(str(name))
        if number is None:
            raise error(source.path, f"image {quote(name)} has no number in its name", "name the images by frame: 000012.jpg")
        if number in owner:
            what = f"images {quote(owner[number])} and {quote(name)} are both frame {number}"
            raise error(source.path, what, "give one recording per file, with images numbered by frame")
        numbers[image], owner[number] = number, name
    return numbers


def _track(person: dict[str, Any]) -> Hashable | None:
    attributes = person.get("attributes")
    told = {**attributes, **person} if isinstance(attributes, dict) else person
    return next((track_id(told[key]) for key in IDENTITIES if told.get(key) is not None), None)


def matches(source: Source) -> bool:
    """A dataset, or a list of people with the image of each."""
    match source.data:
        case {"annotations": _} | [{"image_id": _}]:
            return True
    return False


FORMAT = Format(("COCO", "AlphaPose"), ("json", "json folder"), read, matches, order=40)

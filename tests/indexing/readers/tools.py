"""Files as the tools make them: the same structure, names and types, with people that a test chooses; and how they are refused."""

from __future__ import annotations

import json
import pickle
import re
import struct
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from indexing.joints import HEIGHT
from indexing.readers import read
from indexing.readers.recording import NobodySeen
from indexing.skeleton import COCO17, Skeleton

SCORER = "DLC_resnet50_walkJan1shuffle1_100000"


@dataclass(frozen=True)
class Sample:
    """A file as a tool writes it, and what reading it must give; confidences are .75 where there are some."""

    path: Path
    fps: float | None = None  # where it has times
    people: tuple[str | int, ...] = ()  # who is tracked
    layout: Skeleton | None = COCO17  # whose names the joints have; None: others
    dims: int = 2
    clips: int = 1


def list_failures(cases: Mapping[str, Callable[[], None]]) -> dict[str, str]:
    """Which of many checks of one property fail, and how."""
    wrong = {}
    for name, check in cases.items():
        try:
            check()
        except (Exception, pytest.fail.Exception) as problem:
            wrong[name] = f"{type(problem).__name__}: {problem}"[:300]
    return wrong


def refused(path: Path, *words: str, action: Callable[..., Any] = read, **options: Any) -> None:
    """Reading fails with one line of bearable length that names the file, has a remedy, and all the words."""
    with pytest.raises(ValueError, match=re.escape(path.name)) as caught:
        action(path, **options)
    said = str(caught.value)
    assert type(caught.value) in (ValueError, NobodySeen)
    assert "\n" not in said and "; " in said and len(said.replace(str(path), "")) < 400
    assert all(word in said for word in words), said


# ---- DeepLabCut: data frames of pandas -----------------------------------------------------------------------------------
def deeplabcut_columns(animals: Sequence[str], parts: Sequence[str], kinds: Sequence[str]) -> list[tuple[str, ...]]:
    """Names of columns: of several animals, with a row for them."""
    if not animals:
        return [(SCORER, part, kind) for part in parts for kind in kinds]
    return [(SCORER, animal, part, kind) for animal in animals for part in parts for kind in kinds]


def deeplabcut(
    path: Path,
    people: Mapping[str, np.ndarray] | np.ndarray,
    parts: Sequence[str],
    layout: str = "table",
    index: Sequence[Any] | None = None,
    key: str = "df_with_missing",
) -> Path:
    """What ``analyze_videos`` writes (``table``), and label files (``fixed``); ``(frames, parts, 2 | 3)`` or one per animal."""
    several = isinstance(people, Mapping)
    arrays = list(people.values()) if isinstance(people, Mapping) else [people]
    kinds = ("x", "y", "likelihood")[: arrays[0].shape[2]]
    columns = deeplabcut_columns(list(people) if several else [], parts, kinds)
    values = np.concatenate([array.reshape(len(array), -1) for array in arrays], axis=1)
    rows = np.arange(len(values)) if index is None else np.asarray(index)
    rows = rows.astype("S") if rows.dtype.kind == "U" else rows
    names = ["scorer", *(["individuals"] if several else []), "bodyparts", "coords"]
    with h5py.File(path, "w") as file:
        file.attrs.update({"CLASS": np.bytes_("GROUP"), "PYTABLES_FORMAT_VERSION": np.bytes_("2.1"), "VERSION": np.bytes_("1.0")})
        group = file.create_group(key)
        group.attrs.update({"encoding": np.bytes_("UTF-8"), "errors": np.bytes_("strict")})
        (_table if layout == "table" else _fixed)(group, columns, names, values, rows)
    return path


def _table(group: Any, columns: list[tuple[str, ...]], names: list[str], values: np.ndarray, rows: np.ndarray) -> None:
    width = values.shape[1]
    records = np.zeros(len(values), dtype=[("index", rows.dtype), ("values_block_0", "<f8", (width,))])
    records["index"], records["values_block_0"] = rows, values
    table = group.create_dataset("table", data=records)
    table.attrs["values_block_0_kind"] = np.bytes_(pickle.dumps(columns, 0))
    table.attrs.update({"index_kind": np.bytes_("integer"), "NROWS": len(values)})
    info = {1: {"names": names, "type": "MultiIndex"}, "index": {}}
    group.attrs.update({"pandas_type": np.bytes_("frame_table"), "table_type": np.bytes_("appendable_frame"), "levels": 1})
    group.attrs.update({"info": np.bytes_(pickle.dumps(info, 0)), "non_index_axes": np.bytes_(pickle.dumps([(1, columns)], 0))})


def _fixed(group: Any, columns: list[tuple[str, ...]], names: list[str], values: np.ndarray, rows: np.ndarray) -> None:
    group.attrs.update({"pandas_type": np.bytes_("frame"), "ndim": 2, "nblocks": 1, "axis0_variety": np.bytes_("multi")})
    group.attrs.update({"axis1_variety": np.bytes_("regular"), "block0_items_variety": np.bytes_("multi")})
    for axis in ("axis0", "block0_items"):
        group.attrs[f"{axis}_nlevels"] = len(names)
        for k, name in enumerate(names):
            words = sorted({column[k] for column in columns})
            level = group.create_dataset(f"{axis}_level{k}", data=np.array(words, dtype="S"))
            level.attrs.update({"kind": np.bytes_("string"), "name": np.bytes_(name), "transposed": np.uint8(1)})
            group.create_dataset(f"{axis}_label{k}", data=np.array([words.index(column[k]) for column in columns], dtype=np.int8))
    group.create_dataset("axis1", data=rows)
    block = group.create_dataset("block0_values", data=values)
    block.attrs.update({"transposed": np.uint8(1), "FLAVOR": np.bytes_("numpy")})


# ---- SLEAP ---------------------------------------------------------------------------------------------------------------
def sleap_analysis(path: Path, people: Mapping[str, np.ndarray], nodes: Sequence[str], preset: str = "matlab") -> Path:
    """File > Export Analysis HDF5: ``(frames, nodes, 3)`` per track; the newer one says which axis is which."""
    stacked = np.stack(list(people.values()))  # track, frame, node, x y score
    xy, scores = stacked[..., :2], stacked[..., 2]
    with h5py.File(path, "w") as file:
        if preset == "matlab":
            tracks, points, order = xy.transpose(0, 3, 2, 1), scores.transpose(0, 2, 1), None
        else:
            tracks, points = xy.transpose(1, 0, 2, 3), scores.transpose(1, 0, 2)
            order = {"tracks": ["frame", "track", "node", "xy"], "point_scores": ["frame", "track", "node"]}
        file.create_dataset("tracks", data=tracks, compression="gzip")
        file.create_dataset("point_scores", data=points, compression="gzip")
        file.create_dataset("track_occupancy", data=np.isfinite(xy).any(axis=(2, 3)).T.astype(np.uint8))
        file.create_dataset("node_names", data=np.array(nodes, dtype="S"))
        file.create_dataset("track_names", data=np.array(list(people), dtype="S"))
        file.create_dataset("edge_inds", data=np.array([[i, i + 1] for i in range(len(nodes) - 1)], dtype=np.int64))
        for name, axes in (order or {}).items():
            file[name].attrs["dims"] = json.dumps(axes)
    return path


def sleap_project(
    path: Path,
    predicted: Mapping[str, np.ndarray],
    nodes: Sequence[str],
    by_hand: Mapping[tuple[int, str], np.ndarray] | None = None,
    videos: Sequence[str] = ("walk.mp4",),
    fps: float | None = None,
    order: Sequence[int] | None = None,
    format_id: float = 1.4,
) -> Path:
    """A project: predictions ``(frames, nodes, 3)`` per track, and ``(nodes, 2)`` that a person set, by frame and track.

    order: of the skeleton's nodes among those of the project; tracks are untracked where their name is empty.
    """
    kind = [("instance_id", "<i8"), ("instance_type", "u1"), ("frame_id", "<u8"), ("skeleton", "<u4"), ("track", "<i4")]
    kind += [("from_predicted", "<i8"), ("score", "<f4"), ("point_id_start", "<u8"), ("point_id_end", "<u8")]
    frames: list[tuple[int, ...]] = []
    instances: list[tuple[Any, ...]] = []
    points: list[tuple[Any, ...]] = []
    sure: list[tuple[Any, ...]] = []
    tracks = [name for name in predicted if name]
    count = max((len(one) for one in predicted.values()), default=0)
    for i in range(count):
        first = len(instances)
        for name, one in predicted.items():
            if np.isfinite(one[i, :, :2]).any():
                at = len(points)
                points += [(x, y, bool(np.isfinite(x)), False, s) for x, y, s in one[i]]
                track = tracks.index(name) if name else -1
                instances.append((len(instances), 1, i, 0, track, -1, 0.9, at, len(points)))
        for (frame, name), one in (by_hand or {}).items():
            if frame == i:
                at = len(sure)
                sure += [(x, y, bool(np.isfinite(x)), True) for x, y in one]
                track = tracks.index(name) if name else -1
                instances.append((len(instances), 0, i, 0, track, -1, 0.0, at, len(sure)))
        frames.append((i, i % len(videos), i, first, len(instances)))
    place = list(range(len(nodes))) if order is None else list(order)
    listed = [{"name": nodes[place.index(i)], "weight": 1.0} for i in range(len(nodes))]
    edge = {"py/reduce": [{"py/type": "sleap.skeleton.EdgeType"}, {"py/tuple": [1]}]}
    links = [{"source": place[0], "target": place[1], "type": edge}] if len(nodes) > 1 else []
    links += [{"source": place[1], "target": place[i], "type": {"py/id": 1}} for i in range(2, len(nodes))]
    skeleton = {"directed": True, "graph": {"name": "Skeleton-0"}, "links": links, "nodes": [{"id": i} for i in place]}
    about = {"version": "2.0.0", "skeletons": [skeleton], "nodes": listed, "videos": [], "tracks": []}
    text = h5py.string_dtype("utf-8")
    with h5py.File(path, "w") as file:
        group = file.create_group("metadata")
        group.attrs["format_id"], group.attrs["json"] = format_id, np.bytes_(json.dumps(about))
        ids = [(name, "<u8") for name in ("frame_id", "instance_id_start", "instance_id_end", "frame_idx")]
        file["frames"] = np.array(
            [(f, v, i, a, b) for f, v, i, a, b in frames], dtype=[ids[0], ("video", "<u4"), ids[3], *ids[1:3]]
        )
        file["instances"] = np.array(instances, dtype=kind)
        xy = [("x", "<f8"), ("y", "<f8"), ("visible", "?"), ("complete", "?")]
        file["points"], file["pred_points"] = np.array(sure, dtype=xy), np.array(points, dtype=[*xy, ("score", "<f8")])
        backend = {"fps": fps} if fps is not None else {}
        texts = [json.dumps({"filename": name, "backend": {"filename": name, **backend}}) for name in videos]
        file.create_dataset("videos_json", data=texts, dtype=text)
        file.create_dataset("tracks_json", data=[json.dumps([0, name]) for name in tracks], dtype=text)
    return path


# ---- movement ------------------------------------------------------------------------------------------------------------
def movement(
    path: Path,
    people: Mapping[str, np.ndarray],
    names: Sequence[str],
    fps: float | None = 25.0,
    seconds: bool = True,
    axes: Sequence[str] = ("time", "space", "keypoints", "individuals"),
) -> Path:
    """``dataset.to_netcdf(path)``: ``(frames, keypoints, 3)`` per individual; netCDF 4 keeps axes as scales of HDF5."""
    stacked = np.stack(list(people.values()), axis=3)  # time, keypoint, x y score, individual
    position, confidence = stacked[:, :, :2].transpose(0, 2, 1, 3), stacked[:, :, 2]
    usual = ("time", "space", "keypoints", "individuals")
    position = position.transpose([usual.index(axis) for axis in axes])
    rest = [axis for axis in axes if axis != "space"]
    confidence = confidence.transpose([("time", "keypoints", "individuals").index(axis) for axis in rest])
    frames = len(stacked)
    with h5py.File(path, "w") as file:
        text = h5py.string_dtype("utf-8")
        clock = np.arange(frames) / (fps or 1.0) if seconds and fps else np.arange(frames, dtype=np.float64)
        file["time"] = clock
        for axis, words in (("space", ["x", "y"]), ("keypoints", list(names)), ("individuals", list(people))):
            file.create_dataset(axis, data=words, dtype=text)
        for i, axis in enumerate(usual):
            file[axis].make_scale(axis)
            file[axis].attrs["_Netcdf4Dimid"] = np.int32(i)
        for name, values, order in (("position", position, axes), ("confidence", confidence, rest)):
            file[name] = values
            file[name].attrs["_Netcdf4Coordinates"] = np.array([usual.index(axis) for axis in order], dtype=np.int32)
            for k, axis in enumerate(order):
                file[name].dims[k].attach_scale(file[axis])
        file.attrs.update({"time_unit": np.bytes_("seconds" if seconds and fps else "frames"), "ds_type": np.bytes_("poses")})
        if fps is not None:
            file.attrs["fps"] = np.array([fps])
    return path


# ---- text, arrays, pickles -----------------------------------------------------------------------------------------------
def trc(path: Path, points: np.ndarray, names: Sequence[str], rate: float = 60.0, units: str = "m", start: int = 1) -> Path:
    """``(frames, markers, 3)`` as Pose2Sim and OpenCap write it; a marker that was not seen is blank."""
    frames, count = points.shape[:2]
    keys = "DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits\tOrigDataRate\tOrigDataStartFrame\tOrigNumFrames"
    lines = [
        f"PathFileType\t4\t(X/Y/Z)\t{path.name}",
        keys,
        f"{rate}\t{rate}\t{frames}\t{count}\t{units}\t{rate}\t{start}\t{frames}",
    ]
    lines += [
        "Frame#\tTime\t" + "\t\t\t".join(names) + "\t\t",
        "\t\t" + "\t".join(f"{k}{i + 1}" for i in range(count) for k in "XYZ"),
    ]
    for i, row in enumerate(points):
        cells = ["" if not np.isfinite(value) else f"{value:.6f}" for value in row.ravel()]
        lines.append("\t".join([str(start + i), f"{i / rate:.6f}", *cells]))
    path.write_text("\n".join(lines) + "\n")
    return path


def freemocap(folder: Path, body: np.ndarray | None = None, cameras: np.ndarray | None = None, name: str = "body") -> Path:
    """A recording's folder with a body ``(frames, 33, 3)`` in millimetres, or 2D ``(cameras, frames, points, 3)``."""
    data = folder / "output_data"
    (data / "raw_data").mkdir(parents=True)
    (folder / "synchronized_videos").mkdir()
    if body is not None:
        hands = np.concatenate([body, np.zeros((len(body), 520, 3))], axis=1)
        file = {
            "body": ("mediapipe_body_3d_xyz.npy", body),
            "skeleton": ("mediapipe_skeleton_3d.npy", hands),
            "old": ("mediaPipeSkel_3d_body_hands_face.npy", hands),
            "raw": ("raw_data/mediapipe_3dData_numFrames_numTrackedPoints_spatialXYZ.npy", hands),
        }[name]
        np.save(data / file[0], file[1])
        np.save(data / "mediapipe_right_hand_3d_xyz.npy", body[:, :21])
    if cameras is not None:
        np.save(data / "raw_data" / "mediapipe_2dData_numCams_numFrames_numTrackedPoints_pixelXY.npy", cameras)
    return folder


def alphapose(path: Path, people: Sequence[np.ndarray]) -> Path:
    """``alphapose-results.json``: ``(frames, joints, 3)`` per person, with the tracker's identities."""
    about = {"category_id": 1, "score": 2.7, "box": [1.0, 2.0, 30.0, 60.0]}
    frames = enumerate(zip(*people, strict=True))
    listed = [
        {"image_id": f"{i}.jpg", "keypoints": one.ravel().tolist(), "idx": who + 1, **about}
        for i, frame in frames
        for who, one in enumerate(frame)
    ]
    path.write_text(json.dumps(listed))
    return path


def pyskl(
    path: Path,
    clips: Mapping[str, np.ndarray],
    labels: Sequence[int],
    split: Mapping[str, Sequence[str]] | None = None,
    bare: bool = False,
    protocol: int = 4,
    half: bool = True,
) -> Path:
    """Annotations ``(people, frames, joints, 3)`` by name: x, y, score; half floats, as pyskl keeps them."""
    kind = np.float16 if half else np.float32
    annotations = [
        {
            "frame_dir": name, "label": label, "img_shape": (1080, 1920), "original_shape": (1080, 1920),
            "total_frames": one.shape[1], "keypoint": one[..., :2].astype(kind), "keypoint_score": one[..., 2].astype(kind),
        }
        for (name, one), label in zip(clips.items(), labels, strict=True)
    ]  # fmt: skip
    data: Any = annotations if bare else {"split": {k: list(v) for k, v in (split or {}).items()}, "annotations": annotations}
    path.write_bytes(pickle.dumps(data, protocol=protocol))
    return path


def standing(layout: Any, frames: int = 12, dims: int = 2, seed: int = 0) -> np.ndarray:
    """``(frames, joints, dims)`` somebody who stands and moves a little, in pixels (y down) or metres (y up)."""
    rng = np.random.default_rng(seed)
    arms = {"elbow": 0.63, "wrist": 0.49, "hand": 0.46, "hand_tip": 0.43, "thumb": 0.45, "pinky": 0.45, "index": 0.44}
    names = [joint.removeprefix("left_").removeprefix("right_") for joint in layout.joints]
    high = np.array([HEIGHT.get(name, arms.get(name, 0.9)) for name in names])
    wide = {"eye": 0.02, "ear": 0.04, "hip": 0.09} | dict.fromkeys(("knee", "ankle", "heel", "foot", "big_toe"), 0.1)
    side = np.array([(joint.startswith("left_")) * 1.0 - joint.startswith("right_") for joint in layout.joints])
    across = side * np.array([wide.get(name, 0.13) for name in names])
    body = np.stack([across, high, 0.05 * np.ones(len(high))], axis=1)
    moved = body + 0.01 * rng.normal(size=(frames, len(high), 3)) + 0.002 * np.arange(frames)[:, None, None]
    return moved if dims == 3 else np.stack([400 + 500 * moved[..., 0], 900 - 500 * moved[..., 1]], axis=2)


def c3d(
    places: np.ndarray | None = None,
    labels: Sequence[str] = (),
    order: str = "<",
    scale: float = -1,
    first: int = 1,
    analog: int = 0,
) -> bytes:
    """A C3D file, written after the user guide: header, parameters (POINT:LABELS), frames of x, y, z, residual."""
    places = np.random.default_rng(0).normal(size=(5, 4, 3)) * 100 if places is None else places
    labels = labels or [f"mk{i}" for i in range(places.shape[1])]
    frames, count = places.shape[:2]
    letters = max(map(len, labels))
    body = struct.pack("bB", -1, 2) + bytes([letters, count]) + "".join(label.ljust(letters) for label in labels).encode() + b"\0"
    record = b""
    for number, name, rest in ((-1, b"POINT", b"\0"), (1, b"LABELS", body)):
        record += struct.pack("bb", len(name), number) + name + struct.pack(f"{order}h", len(rest) + 2) + rest
    parameters = (bytes([1, 80, 1, {"<": 84, ">": 86}[order]]) + record).ljust(512, b"\0")
    header = bytes([2, 0x50]) + struct.pack(f"{order}5H", count, analog, first, first + frames - 1, 0)
    header += struct.pack(f"{order}f", scale) + struct.pack(f"{order}2H", 3, analog and 1)
    seen = np.isfinite(places).all(axis=-1, keepdims=True)
    four = np.concatenate([np.nan_to_num(places) / (1 if scale < 0 else scale), np.where(seen, 0.0, -1.0)], axis=-1)
    rows = np.concatenate([four.reshape(frames, -1), np.full((frames, analog), 77)], axis=1)
    rows = rows.astype(f"{order}f4") if scale < 0 else rows.round().astype(f"{order}i2")
    return header.ljust(512, b"\0") + parameters + rows.tobytes()

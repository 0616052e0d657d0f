"""SLEAP: its project files (``.slp``), and what it exports for analysis (``.h5``, CSV).

- CSV: ``track, frame_idx, instance.score``, then ``<node>.x, <node>.y, <node>.score`` per node, a row per animal and frame;
- analysis HDF5: ``tracks`` (tracks, 2, nodes, frames), or with the axes that its attribute ``dims`` names; ``node_names``,
  ``track_names``, ``track_occupancy`` (frames, tracks), ``point_scores`` (tracks, nodes, frames);
- project: tables ``frames``, ``instances``, ``points`` (by hand) and ``pred_points`` (by the network); skeleton, tracks and videos
  as JSON.  What a person labelled or corrected in a frame replaces what was predicted there.

Animals that are not tracked have no identity.
"""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Hashable, Sequence
from typing import Any

import numpy as np

from indexing.clip import COARSEST, FINEST, ClipSet, is_number
from indexing.opening import error, listing, parse_json, quote
from indexing.readers.files import Format, Options, Source, read_columns
from indexing.readers.hdf import Array, Hdf5, open_hdf5
from indexing.readers.recording import Recording, dense_recording, frame_numbers, to_clips
from indexing.skeleton import Skeleton

EXPORT = "export it again from SLEAP (File > Export Analysis HDF5)"
SHIFTED = 1.1  # format_id before which points counted from the corner of a pixel, not from its middle
HAND, PREDICTED = 0, 1  # values of instance_type
WIDEST_BLOCK = 2**27  # values of all animals in all frames of an export: a day of ten animals at 30 frames per second


def read(source: Source, options: Options) -> ClipSet:
    """Read SLEAP's files; times are ``frame_idx`` / fps, the project's own fps where it knows it."""
    if source.kind == "csv":
        return to_clips(source.path, _csv(source), options)
    with open_hdf5(source.path) as file:
        recording = _project(file, options) if "instances" in file else _analysis(file)
    return to_clips(source.path, recording, options)


def _csv(source: Source) -> Recording:
    header = [cell.strip() for cell in source.data[0]]
    index = {name: i for i, name in enumerate(header)}
    nodes = [name[:-2] for name in header if name.endswith(".x")]
    lacking = ["frame_idx"] * ("frame_idx" not in index) + [f"{node}.y" for node in nodes if f"{node}.y" not in index]
    if lacking or not nodes:
        raise error(source.path, f"has no column {quote((lacking or ['<node>.x'])[0])}", "export with File > Export Analysis CSV")
    scored = all(f"{node}.score" in index for node in nodes)
    kinds = ("x", "y", "score") if scored else ("x", "y")
    columns = [index["frame_idx"], *(index[f"{node}.{kind}"] for node in nodes for kind in kinds)]
    values, texts = read_columns(source.path, 1, columns, [index["track"]] if "track" in index else [])
    frames, at = np.unique(frame_numbers(source.path, values[:, 0]), return_inverse=True)
    table = values[:, 1:].reshape(len(values), len(nodes), len(kinds))
    return Recording(
        frames=frames,
        at=at,
        joints=table[..., :2],
        confidence=_scores(table[..., :2], table[..., 2]) if scored else None,
        tracks=[track or None for track in texts[0]] if texts else None,
        skeleton=Skeleton(source.path.stem, tuple(nodes)),
    )


def _scores(joints: Array, scores: Array) -> Array | None:
    """Labels made by hand have no scores: they are sure where there are others, and nothing is said where there are none."""
    if np.isnan(scores).all():
        return None
    seen = ~np.isnan(joints).any(axis=2)
    return np.where(seen & np.isnan(scores), 1.0, scores)


# ---- analysis HDF5 -------------------------------------------------------------------------------------------------------
def _analysis(file: Hdf5) -> Recording:
    nodes = file.texts("node_names")
    names = file.texts("track_names") if "track_names" in file else []
    if not nodes or len(set(nodes)) < len(nodes):
        raise error(file.path, f"node_names are {listing(nodes)}: none, or one twice", EXPORT)
    tracks = _axes(file, "tracks", ("frame", "track", "node", "xy"), ("track", "xy", "node", "frame"))
    frames, animals, points, axes = tracks.shape
    if axes not in (2, 3) or points != len(nodes) or (names and len(names) != animals) or not tracks.size:
        message = f"tracks hold {animals} animals with {points} points of {axes} coordinates in {frames} frames"
        raise error(file.path, f"{message}, but there are {len(nodes)} node_names and {len(names)} track_names", EXPORT)
    scores = None
    if "point_scores" in file:
        scores = _axes(file, "point_scores", ("frame", "track", "node"), ("track", "node", "frame"))
        if scores.shape != tracks.shape[:3]:
            raise error(file.path, f"point_scores are {scores.shape} for tracks {tracks.shape}", EXPORT)
    # occupancy is not needed: an animal that is not there has no coordinates
    joints = tracks.reshape(frames * animals, points, axes).astype(np.float64)
    confidence = None if scores is None else _scores(joints, scores.reshape(-1, points).astype(np.float64))
    people = _number_duplicates(names or [""] * animals) if animals > 1 or any(names) else None
    return dense_recording(file.path, joints, confidence, np.arange(frames), people, nodes, _bones(file, len(nodes)))


def _axes(file: Hdf5, name: str, wanted: Sequence[str], usual: Sequence[str]) -> Array:
    """An array with its axes in the order wanted, from that of its attribute ``dims``, or the usual."""
    text = file.text(name, "dims")
    order = parse_json(file.path, text, EXPORT, f"{name}@dims") if text else list(usual)
    if not isinstance(order, list) or sorted(map(str, order)) != sorted(wanted):
        raise error(file.path, f"{name} has the axes {quote(order)}, not {', '.join(wanted)}", EXPORT)
    if math.prod(file.shape(name)) > WIDEST_BLOCK:
        raise error(file.path, f"{name} is {quote(file.shape(name))}, more animals and frames than any recording", EXPORT)
    return file.array(name, len(wanted), "f").transpose([order.index(axis) for axis in wanted])


def _number_duplicates(names: Sequence[str]) -> list[Hashable | None]:
    """Names of tracks, told apart by their number where two are the same."""
    counts = Counter(names)
    return [name if counts[name] == 1 and name else f"{name or 'track'}#{i}" for i, name in enumerate(names)]


def _bones(file: Hdf5, nodes: int) -> list[tuple[int, int]]:
    if "edge_inds" not in file:
        return []
    edges = file.array("edge_inds", None, "iu")
    if edges.ndim != 2 or edges.shape[1] != 2 or not edges.size or edges.max() >= nodes or edges.min() < 0:
        return []
    return [(int(a), int(b)) for a, b in edges]


# ---- projects ------------------------------------------------------------------------------------------------------------
def _project(file: Hdf5, options: Options) -> Recording:
    frames = file.records("frames", ("video", "frame_idx", "instance_id_start", "instance_id_end"))
    about = _about(file)
    fps = _one_video(file, frames["video"])
    fields: tuple[str, ...] = ("instance_type", "skeleton", "track", "point_id_start", "point_id_end")
    fields += ("from_predicted",) if "from_predicted" in file.fields("instances") else ()
    instances = file.records("instances", fields)
    which = _instances(file, frames, instances)
    kinds = set(instances["skeleton"][which].tolist())
    if len(kinds) > 1:
        raise error(file.path, f"its animals have {len(kinds)} skeletons", "save a project with animals of one kind")
    nodes, bones = _nodes(file, about, kinds.pop() if kinds else 0)
    joints, confidence = _points(file, instances, which, len(nodes))
    number = frame_numbers(file.path, frames["frame_idx"].astype(np.float64))
    order, at = np.unique(number, return_inverse=True)
    owner = np.repeat(np.arange(len(number)), (frames["instance_id_end"] - frames["instance_id_start"]).astype(np.int64))
    names, track = _tracks(file), instances["track"][which]
    if track.size and (track.max() >= len(names)):
        raise error(file.path, f"an animal is of track {track.max()}, but tracks_json has {len(names)}", EXPORT)
    rate = options.fps or fps
    return Recording(
        frames=order,
        at=at.reshape(-1)[owner[which]],
        joints=joints,
        confidence=confidence,
        tracks=[names[i] if i >= 0 else None for i in track.tolist()] if (track >= 0).any() else None,
        times=order / rate if rate is not None else None,
        skeleton=Skeleton(file.path.stem, tuple(nodes), tuple(bones)),
    )


def _about(file: Hdf5) -> dict[str, Any]:
    """The project's JSON: its nodes and skeletons."""
    about = parse_json(file.path, file.text("metadata", "json"), EXPORT, "metadata@json")
    if not isinstance(about, dict) or not isinstance(about.get("nodes"), list) or not isinstance(about.get("skeletons"), list):
        raise error(file.path, "metadata@json has no nodes and skeletons", EXPORT)
    return about


def _one_video(file: Hdf5, video: Array) -> float | None:
    """The frame rate of the only video with labels, where the project knows it."""
    used = sorted(set(video.tolist()))
    try:
        about = [json.loads(text) for text in file.texts("videos_json")] if "videos_json" in file else []
        names = [one.get("filename") or one["backend"]["filename"] for one in about]
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError):
        about, names = [], []
    if len(used) > 1:
        video_names = listing(str(names[i]).replace("\\", "/").rpartition("/")[2] if i < len(names) else i for i in used)
        remedy = "export each video by itself: File > Export Analysis HDF5"
        raise error(file.path, f"has labels in {len(used)} videos ({video_names})", remedy)
    try:
        fps = about[used[0]]["backend"].get("fps")
        return float(fps) if isinstance(fps, (int, float)) and COARSEST <= fps <= FINEST else None
    except (IndexError, KeyError, TypeError, AttributeError):
        return None


def _instances(file: Hdf5, frames: dict[str, Array], instances: dict[str, Array]) -> Array:
    """The animals that count, in the order of the frames: of a track that was labelled by hand in a frame, no prediction."""
    count = len(instances["track"])
    start, end = (frames[name].astype(np.int64) for name in ("instance_id_start", "instance_id_end"))
    ends = np.concatenate([[0], end])
    if (end < start).any() or (start != ends[:-1]).any() or ends[-1] != count:
        raise error(file.path, f"its frames do not share out its {count} instances", EXPORT)
    kind, track = instances["instance_type"], instances["track"]
    corrected = instances.get("from_predicted", np.full(count, -1))
    keep = np.ones(count, dtype=bool)
    for a, b in zip(start.tolist(), end.tolist(), strict=True):
        hand = np.flatnonzero(kind[a:b] == HAND) + a
        if not len(hand):
            continue
        predicted = np.flatnonzero(kind[a:b] != HAND) + a
        same = np.isin(track[predicted], track[hand]) | (track[predicted] < 0) | np.isin(predicted, corrected[hand])
        keep[predicted[same]] = False
    return np.flatnonzero(keep)


def _points(file: Hdf5, instances: dict[str, Array], which: Array, nodes: int) -> tuple[Array, Array | None]:
    """``(m, nodes, 2)`` and ``(m, nodes)``: where each animal's points are, and how sure they are (1 by hand)."""
    kind = instances["instance_type"][which]
    odd = kind[(kind != HAND) & (kind != PREDICTED)]
    if len(odd):
        raise error(file.path, f"instances: an animal is of the type {odd[0]}, neither {HAND} (by hand) nor {PREDICTED}", EXPORT)
    tables = []
    for code, table in ((HAND, "points"), (PREDICTED, "pred_points")):
        rows = np.flatnonzero(kind == code)
        if len(rows):
            tables.append((code, rows, *_own_points(file, table, code, instances, which[rows], nodes)))
    # made once each animal is known to have points of its own: no more than the file holds
    joints = np.full((len(which), nodes, 2), np.nan)
    confidence = np.full((len(which), nodes), np.nan)
    version: Any = file.attribute("metadata", "format_id")
    shift = 0.5 if is_number(version) and version < SHIFTED else 0.0
    for code, rows, records, start in tables:
        index = start[:, None] + np.arange(nodes)
        xy = np.stack([records["x"], records["y"]], axis=1).astype(np.float64)[index] - shift
        xy[~records["visible"][index].astype(bool)] = np.nan
        joints[rows] = xy
        confidence[rows] = records["score"][index] if code == PREDICTED else 1.0
    return joints, _scores(joints, confidence) if (kind == PREDICTED).any() else None


def _own_points(
    file: Hdf5, table: str, code: int, instances: dict[str, Array], which: Array, nodes: int
) -> tuple[dict[str, Array], Array]:
    """A table of points, and where those of each animal begin; no two animals share points."""
    records = file.records(table, ("x", "y", "visible", *(("score",) if code == PREDICTED else ())))
    start, end = (instances[name][which].astype(np.int64) for name in ("point_id_start", "point_id_end"))
    if (end - start != nodes).any() or start.min() < 0 or end.max() > len(records["x"]):
        raise error(file.path, f"{table}: an animal has no {nodes} points, as its skeleton has nodes", EXPORT)
    if len(which) * nodes > len(records["x"]):
        raise error(file.path, f"{table}: {len(which)} animals of {nodes} points share {len(records['x'])}", EXPORT)
    return records, start


def _nodes(file: Hdf5, about: dict[str, Any], which: int) -> tuple[list[str], list[tuple[int, int]]]:
    """Names of the skeleton's nodes, in its own order, and its edges."""
    try:
        skeleton = about["skeletons"][which]
        ids = [int(node["id"]) for node in skeleton["nodes"]]
        names = [str(about["nodes"][i]["name"]) for i in ids]
        place = {node: i for i, node in enumerate(ids)}
    except (KeyError, IndexError, TypeError, ValueError):
        raise error(file.path, f"metadata@json: the nodes of skeleton {which} are not there", EXPORT) from None
    if not names or len(set(names)) < len(names):
        raise error(file.path, f"metadata@json: the skeleton has the nodes {listing(names)}: none, or one twice", EXPORT)
    return names, _edges(skeleton.get("links"), place)


def _edges(links: Any, place: dict[int, int]) -> list[tuple[int, int]]:
    """Bones of a skeleton; pairs of sides are links, too, of another type, which is written out where it comes first."""
    types: list[int] = []
    bones = []
    try:
        for link in links:
            kind = link.get("type") or {"py/id": 1}
            if "py/reduce" in kind:
                types.append(int(kind["py/reduce"][1]["py/tuple"][0]))
                value = types[-1]
            else:
                value = types[int(kind["py/id"]) - 1] if types else 1
            if value == 1:
                bones.append((place[int(link["source"])], place[int(link["target"])]))
    except (KeyError, IndexError, TypeError, ValueError, AttributeError):
        return []  # bones are a convenience
    return bones


def _tracks(file: Hdf5) -> list[Hashable | None]:
    """Names of tracks, from ``[frame, name]`` each."""
    names = []
    for i, text in enumerate(file.texts("tracks_json") if "tracks_json" in file else []):
        one = parse_json(file.path, text, EXPORT, f"tracks_json[{i}]")
        names.append(str(one[1]) if isinstance(one, list) and len(one) > 1 else "")
    return _number_duplicates(names)


def matches(source: Source) -> bool:
    """A table with ``frame_idx`` and ``<node>.x``, or an HDF5 file with the names of SLEAP."""
    if source.kind == "hdf5":
        names = set(source.data.names())
        return {"tracks", "node_names"} <= names or {"frames", "instances", "metadata"} <= names
    header = [cell.strip().lower() for cell in source.data[0]]
    return "frame_idx" in header and any(cell.endswith(".x") for cell in header)


FORMAT = Format(("SLEAP",), ("csv", "hdf5"), read, matches, order=20)

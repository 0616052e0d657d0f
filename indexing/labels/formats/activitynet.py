"""ActivityNet JSON: ``database`` (what people marked) and ``results`` (what a program found), segments in seconds by video.

``{"database": {video: {"duration": s, "annotations": [{"segment": [start, end], "label": name}]}}}`` and
``{"results": {video: [{"segment": [start, end], "label": name, "score": x}]}}``.  What else a label has stands beside its segment.

Source: the evaluation of the ActivityNet challenge (https://github.com/activitynet/ActivityNet).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from indexing.files import write_json
from indexing.labels.format import Gathering, LabelFormat, Request, Target, text_of
from indexing.labels.label import Label, LabelFile, sort_key
from indexing.opening import error, quote

REMEDY = "write segments as {'segment': [start, end], 'label': name}"
TEXTS = ("subject", "tier", "observation", "comment")


def read(data: Mapping[str, Any], asked: Request) -> LabelFile:
    """Read a file of annotations or results."""
    out = Gathering(asked, "activitynet")
    for video, number, segment in _segments(out, data):
        where = f"video {video!r}, segment {number}"
        if not isinstance(segment, dict):
            raise error(asked.path, f"{where} is {quote(segment)}", REMEDY)
        times = segment.get("segment")
        if not isinstance(times, list) or len(times) != 2:
            raise error(asked.path, f"{where}: 'segment' is {quote(times)}, not [start, end]", REMEDY)
        score, modifiers = segment.get("score"), segment.get("modifiers")
        fields: dict[str, Any] = {name: text_of(segment.get(name)) for name in TEXTS}
        fields["score"] = None if score is None else out.seconds(score, where, "score")
        fields["modifiers"] = tuple(map(text_of, modifiers)) if isinstance(modifiers, list) else ()
        out.add(text_of(segment.get("label")), times[0], times[1], where, media=video, **fields)
    return out.finish()


def _segments(out: Gathering, data: Mapping[str, Any]) -> Iterator[tuple[str, int, Any]]:
    """Video, number from 1, and segment; videos without a segment are watched nevertheless."""
    asked = out.asked
    for part, key in (("database", "annotations"), ("results", None)):
        videos = data.get(part) or {}
        if not isinstance(videos, dict):
            raise error(asked.path, f"{part!r} is {quote(videos)}, no object of videos", REMEDY)
        for video, held in videos.items():
            out.watched.setdefault(("", video))
            out.media.setdefault(video)
            segments = held.get(key) if key is not None and isinstance(held, dict) else held
            if segments is None:
                continue
            if not isinstance(segments, list):
                raise error(asked.path, f"video {video!r}: {quote(segments)} is no list of segments", REMEDY)
            yield from ((video, number, segment) for number, segment in enumerate(segments, start=1))


def write(labels: Sequence[Label], target: Target) -> list[str]:
    """Write results where labels have scores, annotations where they have none; seconds to the microsecond."""
    videos: dict[str, list[dict[str, Any]]] = {media: [] for media in target.media}
    for label in sorted(labels, key=sort_key):
        more = {name: getattr(label, name) for name in (*TEXTS, "modifiers", "score") if getattr(label, name) not in ("", (), None)}
        segment = {"segment": [round(label.start, 6), round(label.end, 6)], "label": label.label}
        videos.setdefault(label.media, []).append(segment | more)
    if any(label.score is not None and math.isfinite(label.score) for label in labels):
        write_json(target.path, {"version": "dyntorch", "results": videos, "external_data": {}})
        return []
    length = {"duration": target.duration} if target.duration is not None else {}
    database = {video: length | {"annotations": own} for video, own in videos.items()}
    write_json(target.path, {"version": "dyntorch", "database": database})
    return []


def matches(data: Any) -> bool:
    """An object with videos in ``database`` or ``results``."""
    match data:
        case {"database": dict()} | {"results": dict()}:
            return True
    return False


FORMAT = LabelFormat("JSON of ActivityNet", ("json",), read, matches, order=30, write=write, written={"activitynet": ".json"})

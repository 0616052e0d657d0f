"""Label Studio: timelines of videos (``timelinelabels``) and segments of sound and series, as exported in JSON or JSON-MIN.

Timelines count frames from 1 to the last one labelled; a second has as many as the recording, which the export does not say.  A
region of one frame is a moment.  Segments of sound are in seconds.

Source: the tags TimelineLabels and Labels of Label Studio 1.14 to 1.20 (https://labelstud.io/tags/timelinelabels).
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from indexing.files import write_json
from indexing.labels.format import Gathering, LabelFormat, Request, Target, base_name, parse_whole, text_of
from indexing.labels.label import Label, LabelFile, sort_key
from indexing.opening import clip_text, count, error, quote

REMEDY = "export it again from Label Studio as JSON"
SOUND = ("labels", "timeserieslabels")
UPLOAD = re.compile(r"^[0-9a-f]{8}-")
TEXTS = ("subject", "tier")


def read(data: Any, asked: Request) -> LabelFile:
    """Read an export."""
    out = Gathering(asked, "label_studio")
    untimed: Counter[str] = Counter()
    for number, task in enumerate(data if isinstance(data, list) else [data], start=1):
        if not isinstance(task, dict):
            raise error(asked.path, f"task {number} is {quote(task)}", REMEDY)
        media = _media(task)
        if media:
            out.media.setdefault(media)
        for who, machine, region in _regions(out, task, f"task {number}"):
            if machine:
                out.machine.setdefault(who)
            _region(out, region, media, who, f"task {number}, region {clip_text(text_of(region.get('id')), 20) or '?'}", untimed)
    if untimed:
        kinds = ", ".join(f"{clip_text(kind, 20) or 'without a type'}: {times}" for kind, times in untimed.most_common(3))
        out.note(f"{count(sum(untimed.values()), 'region')} left out: they mark no time ({kinds})")
    return out.finish()


def _media(task: Mapping[str, Any]) -> str:
    """The file that a task shows."""
    data = task.get("data")
    data = data if isinstance(data, dict) else task
    named = [data.get(key) for key in ("video", "video_url", "audio", "url")]
    address = next((value for value in [*named, *data.values()] if isinstance(value, str) and re.search(r"\.\w{2,5}$", value)), "")
    name = base_name(address).rpartition("=")[2]
    return UPLOAD.sub("", name) if "/upload/" in address else name


def _regions(out: Gathering, task: Mapping[str, Any], where: str) -> Iterator[tuple[str, bool, dict[str, Any]]]:
    """Who marked it, whether that was a program, and the region."""
    if "annotations" not in task and "predictions" not in task and "completions" not in task:
        yield from _compact_regions(task)
        return
    for part in ("annotations", "completions", "predictions"):
        for one in out.list_of(task.get(part), f"{where}, {part}", REMEDY):
            if not isinstance(one, dict):
                continue  # exports without expanded predictions list their numbers
            if one.get("was_cancelled"):
                out.note("annotations that were skipped in Label Studio are left out")
                continue
            machine = part == "predictions"
            who = text_of(one.get("model_version")) or "prediction" if machine else _who(one.get("completed_by"))
            for region in out.list_of(one.get("result"), f"{where}, result", REMEDY):
                if isinstance(region, dict):
                    yield who, machine, region


def _compact_regions(task: Mapping[str, Any]) -> Iterator[tuple[str, bool, dict[str, Any]]]:
    """The regions of JSON-MIN: lists of what is the value of a region elsewhere."""
    for key, held in task.items():
        if isinstance(held, list):
            for value in held:
                if isinstance(value, dict) and ("ranges" in value or "start" in value):
                    kind = next((name for name in ("timelinelabels", *SOUND) if name in value), "")
                    yield _who(task.get("annotator")), False, {"id": key, "type": kind, "value": value}


def _who(found: Any) -> str:
    if isinstance(found, dict):
        return text_of(found.get("email")) or text_of(found.get("id"))
    return f"annotator {found}" if isinstance(found, int) else text_of(found)


def _region(out: Gathering, region: Mapping[str, Any], media: str, who: str, where: str, untimed: Counter[str]) -> None:
    """The labels of a region: one for each of its names and ranges."""
    value, kind = region.get("value"), text_of(region.get("type"))
    if not isinstance(value, dict):
        untimed[kind] += 1
        return
    value_names = value.get(kind) or value.get("timelinelabels")
    names = value_names if isinstance(value_names, list) else []
    times: list[tuple[Any, Any]]
    if isinstance(value.get("ranges"), list):
        times = [_frames(out, one, where) for one in value["ranges"]]
    elif kind in SOUND and "text" not in value and "start" in value:  # with text, they count its letters
        times = [(value["start"], value.get("end"))]
    else:
        untimed[kind] += 1
        return
    meta = region.get("meta")
    meta = meta if isinstance(meta, dict) else {}
    text, modifiers, score = meta.get("text"), meta.get("modifiers"), region.get("score")
    fields: dict[str, Any] = {name: text_of(meta.get(name)) for name in TEXTS}
    fields |= {"media": media, "observation": who, "score": None if score is None else out.seconds(score, where, "score")}
    fields["comment"] = "\n".join(map(text_of, text)) if isinstance(text, list) else text_of(text)
    fields["modifiers"] = tuple(map(text_of, modifiers)) if isinstance(modifiers, list) else ()
    for start, end in times:
        for name in names or [""]:
            out.add(text_of(name), start, end, where, **fields)


def _frames(out: Gathering, one: Any, where: str) -> tuple[float, float]:
    """The times of the first and the last frame of a range."""
    ends = [parse_whole(one.get(key)) if isinstance(one, dict) else None for key in ("start", "end")]
    if ends[0] is None or ends[1] is None:
        raise error(out.asked.path, f"{where}: {quote(one)} is no range of frames", REMEDY)
    if out.asked.fps is None:
        raise error(out.asked.path, "counts frames, and does not say how many a second has", "give them (--fps)")
    return (ends[0] - 1) / out.asked.fps, (ends[1] - 1) / out.asked.fps


def write(labels: Sequence[Label], target: Target) -> list[str]:
    """Write tasks to import: what has no observation as predictions of ``tier``, the rest as annotations of its observation."""
    if target.fps is None:
        raise error(target.path, "Label Studio counts frames, and nobody says how many a second has", "give them (--fps)")
    tasks: dict[str, dict[str, list[dict[str, Any]]]] = {media: {} for media in target.media}
    for number, label in enumerate(sorted(labels, key=sort_key)):
        tasks.setdefault(label.media, {}).setdefault(label.observation, []).append(_result(label, number, target.fps))
    made = [
        {
            "data": {"video": media},
            "annotations": [{"completed_by": {"email": who}, "result": held} for who, held in by.items() if who],
            "predictions": [{"model_version": target.tier, "result": held} for who, held in by.items() if not who],
        }
        for media, by in tasks.items()
    ]
    write_json(target.path, made)
    return ["Label Studio counts frames: times are those of the nearest ones"] * bool(labels)


def _result(label: Label, number: int, fps: float) -> dict[str, Any]:
    frames = {"start": round(label.start * fps) + 1, "end": round(label.end * fps) + 1}
    meta: dict[str, Any] = {name: getattr(label, name) for name in (*TEXTS, "modifiers") if getattr(label, name)}
    return {
        "id": f"label{number}",
        "type": "timelinelabels",
        "from_name": "videoLabels",
        "to_name": "video",
        "origin": "prediction",
        "value": {"ranges": [frames], "timelinelabels": [label.label]},
        **({"score": label.score} if label.score is not None else {}),
        "meta": meta | ({"text": [label.comment]} if label.comment else {}),
    }


def matches(data: Any) -> bool:
    """A list of tasks, or one."""
    if isinstance(data, dict):
        return "annotations" in data or "predictions" in data
    return isinstance(data, list) and bool(data) and all(isinstance(task, dict) for task in data)


FORMAT = LabelFormat("JSON of Label Studio", ("json",), read, matches, order=40, write=write, written={"label_studio": ""})

"""VGG Image Annotator 3 (VIA): temporal segments of a project (JSON) or of its exported CSV, in seconds.

A segment has values of attributes, each an option or free text: every attribute is a tier here, except those that are called as
what else a label has (``subject``, ``comment``, ...).

Source: the project format of VIA 3 (https://gitlab.com/vgg/via).
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

from indexing.files import write_json
from indexing.labels.format import NUM_HEADER_ROWS, Gathering, LabelFormat, Request, Target, base_name, of_recording, text_of
from indexing.labels.label import Label, LabelFile, sort_key
from indexing.opening import Row, clip_text, count, error, parse_json, quote, read_text

REMEDY = "save or export it again from VIA 3"
MACHINE = "dyntorch"  # the description of attributes that a program wrote
TEXT, CHECKBOX, SELECT = 1, 2, 4  # kinds of attributes
VIDEO, LOCAL = 4, 1  # kind and place of a file
FIELDS = {
    "subject": ("subject", "person", "individual"),
    "comment": ("comment", "note"),
    "observation": ("observation", "annotator"),
    "modifiers": ("modifiers",),
    "score": ("score",),
}
PLACES = {  # VIA fills them in
    "pid": "__VIA_PROJECT_ID__",
    "rev": "__VIA_PROJECT_REV_ID__",
    "rev_timestamp": "__VIA_PROJECT_REV_TIMESTAMP__",
}
Attributes = dict[str, dict[str, Any]]


def read(data: Mapping[str, Any] | list[Row], asked: Request) -> LabelFile:
    """Read a project or an export."""
    out = Gathering(asked, "via")
    if isinstance(data, list):
        _read_table(out, data)
    else:
        _read_project(out, data)
    return out.finish()


def _read_project(out: Gathering, data: Mapping[str, Any]) -> None:
    attributes = _attributes(data.get("attribute"))
    files = {
        name: base_name(text_of(one.get("fname")) or text_of(one.get("src"))) if isinstance(one, dict) else ""
        for name, one in data["file"].items()
    }
    views = data.get("view")
    shown_in: dict[str, list[str]] = {}
    for name, view in views.items() if isinstance(views, dict) else ():
        listed = view.get("fid_list") if isinstance(view, dict) else None
        shown_in[name] = [files.get(text_of(fid), "") for fid in listed] if isinstance(listed, list) else []
    out.media.update(dict.fromkeys(name for name in files.values() if name))
    mine = of_recording(out.media, out.asked)
    left: Counter[str] = Counter()
    for name, one in data["metadata"].items():
        where = f"metadata {clip_text(name, 24)!r}"
        if not isinstance(one, dict):
            raise error(out.asked.path, f"{where} is {quote(one)}", REMEDY)
        seen = shown_in.get(text_of(one.get("vid")), [files.get(text_of(one.get("vid")), "")])
        media = next((file for file in seen if mine and file in mine), seen[0] if seen else "")
        _segment(out, where, one.get("z"), one.get("xy"), one.get("av"), attributes, media, left)
    _left_out(out, left)


def _attributes(found: Any) -> Attributes:
    return {name: one for name, one in found.items() if isinstance(one, dict)} if isinstance(found, dict) else {}


def _segment(
    out: Gathering, where: str, times: Any, region: Any, values: Any, attributes: Attributes, media: str, left: Counter[str]
) -> None:
    """The labels of a segment: one for each value of each attribute that is no field of a label."""
    if region:
        left["regions of the picture"] += 1
        return
    if not isinstance(times, list) or not times:
        left["of a whole file"] += 1
        return
    if len(times) > 2:
        raise error(out.asked.path, f"{where}: {quote(times)} is no segment", REMEDY)
    fields: dict[str, Any] = {}
    names: list[tuple[str, str]] = []
    for attribute, value in values.items() if isinstance(values, dict) else ():
        one = attributes.get(attribute, {})
        called = text_of(one.get("aname")) or attribute
        ours = one.get("desc") == MACHINE
        meant = "" if ours else next((field for field, known in FIELDS.items() if called.strip().lower() in known), "")
        texts = _texts(value, one)
        if meant:
            fields[meant] = " ".join(texts)
        elif called and any(texts):
            if ours:
                out.machine.setdefault(called)
            names += [(called, text) for text in texts]
    if "modifiers" in fields:
        fields["modifiers"] = tuple(fields["modifiers"].split("|")) if fields["modifiers"] else ()
    if "score" in fields:
        fields["score"] = out.seconds(fields["score"], where, "score") if fields["score"] else None
    for tier, name in names or [("", "")]:
        out.add(name, times[0], times[-1], where, media=media, tier=tier, **fields)


def _texts(value: Any, attribute: Mapping[str, Any]) -> list[str]:
    """What an attribute says: names of options where it has some, else what was typed."""
    options = attribute.get("options")
    chosen = text_of(value)
    if not isinstance(options, dict):
        return [chosen]
    each = chosen.split(",") if attribute.get("type") == CHECKBOX and chosen not in options else [chosen]
    return [text_of(options.get(one)) or one for one in each]


def _left_out(out: Gathering, left: Counter[str]) -> None:
    for what, times in left.items():
        out.note(f"{count(times, 'annotation')} left out: {what}, without a time that they last")


def _read_table(out: Gathering, rows: list[Row]) -> None:
    """An exported CSV: comments, among them the attributes, the names of the columns, a row for each segment."""
    path = out.asked.path
    attributes: Attributes = {}
    for line in read_text(path, REMEDY).splitlines():
        if line.startswith("# ATTRIBUTE") and "=" in line:
            attributes = _attributes(parse_json(path, line.partition("=")[2], REMEDY, "its attributes"))
    columns: dict[str, int] = {}
    left: Counter[str] = Counter()
    for number, cells in rows:
        names = [cell.rpartition("=")[2].strip(" #").lower() for cell in cells]
        if not columns and ("csv_header" in cells[0].lower() or "temporal_segment_start" in names):
            columns = {name: at for at, name in enumerate(names)}
            if "metadata" not in columns or not {"temporal_coordinates", "temporal_segment_start"} & columns.keys():
                raise error(path, f"line {number}: has no columns 'metadata' and 'temporal_coordinates'", REMEDY)
        elif columns and not cells[0].lstrip().startswith("#"):
            row = {name: cells[at] if at < len(cells) else "" for name, at in columns.items()}
            _table_row(out, row, attributes, f"line {number}", left)
    _left_out(out, left)


def _table_row(out: Gathering, row: Mapping[str, str], attributes: Attributes, where: str, left: Counter[str]) -> None:
    path = out.asked.path
    times: Any = [row.get("temporal_segment_start"), row.get("temporal_segment_end")]
    if "temporal_coordinates" in row:
        times = parse_json(path, row["temporal_coordinates"] or "[]", REMEDY, where)
    region = parse_json(path, row.get("spatial_coordinates") or "[]", REMEDY, where)
    values = parse_json(path, row["metadata"] or "{}", REMEDY, where)
    held = row.get("file_list", "")
    files = parse_json(path, held, REMEDY, where) if held.startswith("[") else [held]
    media = base_name(text_of(files[0])) if isinstance(files, list) and files else ""
    _segment(out, where, times, region, values, attributes, media, left)


# ---- writing -------------------------------------------------------------------------------------------------------------
def write(labels: Sequence[Label], target: Target) -> list[str]:
    """Write a project: an attribute for each tier, with the names as its options; seconds to the microsecond."""
    media = list(dict.fromkeys([*target.media, *(label.media for label in labels)]))
    tiers = list(dict.fromkeys(label.tier or target.tier for label in labels))
    options = {tier: list(dict.fromkeys(one.label for one in labels if (one.tier or target.tier) == tier)) for tier in tiers}
    more = [name for name in FIELDS if any(getattr(label, name) not in ("", (), None) for label in labels)]
    number_of = {tier: str(at) for at, tier in enumerate(tiers, start=1)}
    field_of = {name: str(len(tiers) + 1 + at) for at, name in enumerate(more)}
    codes = {tier: {name: str(at) for at, name in enumerate(options[tier])} for tier in tiers}
    attributes: Attributes = {
        number_of[tier]: _attribute(tier, SELECT, {code: name for name, code in codes[tier].items()}, MACHINE) for tier in tiers
    } | {field_of[name]: _attribute(name, TEXT, {}, "") for name in more}
    metadata = {}
    for number, label in enumerate(sorted(labels, key=sort_key)):
        tier = label.tier or target.tier
        values = {number_of[tier]: codes[tier][label.label]}
        values |= {field_of[name]: _text(getattr(label, name)) for name in more if getattr(label, name) not in ("", (), None)}
        view = str(media.index(label.media) + 1)
        times = [round(label.start, 6), round(label.end, 6)]
        metadata[f"{view}_label{number}"] = {"vid": view, "flg": 0, "z": times, "xy": [], "av": values}
    numbers = [str(number) for number in range(1, len(media) + 1)]
    about = {"pname": "dyntorch", "data_format_version": "3.1.1", "creator": target.annotator, "created": 0, "vid_list": numbers}
    project = {
        "project": PLACES | about,
        "config": {"file": {"loc_prefix": {"1": "", "2": "", "3": "", "4": ""}}, "ui": {}},
        "attribute": attributes,
        "file": {
            number: {"fid": number, "fname": name, "type": VIDEO, "loc": LOCAL, "src": name}
            for number, name in zip(numbers, media, strict=True)
        },
        "metadata": metadata,
        "view": {number: {"fid_list": [number]} for number in numbers},
    }
    write_json(target.path, project)
    return []


def _attribute(name: str, kind: int, options: dict[str, str], description: str) -> dict[str, Any]:
    message = {"aname": name, "anchor_id": "FILE1_Z2_XY0", "type": kind, "desc": description}
    return message | {"options": options, "default_option_id": ""}


def _text(value: Any) -> str:
    return "|".join(value) if isinstance(value, tuple) else value if isinstance(value, str) else json.dumps(value)


def matches(data: Any) -> bool:
    """A project, or a table with the columns of an export below its comments."""
    match data:
        case {"metadata": dict(), "file": dict()}:
            return True
        case list(rows):
            names = [cell.strip().lower() for row in rows[:NUM_HEADER_ROWS] if isinstance(row, tuple) for cell in row[1]]
            return any("csv_header" in name or name == "temporal_segment_start" for name in names)
    return False


FORMAT = LabelFormat("a project or export of VIA", ("json", "table"), read, matches, order=20, write=write, written={"via": ""})

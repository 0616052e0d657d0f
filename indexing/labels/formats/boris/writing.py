"""Write BORIS projects: an observation of its own for each recording, beside those of people, who find theirs as they left them.

What BORIS checks when it opens a project holds: every behaviour is in the ethogram, every subject in the list of subjects, every
START has its STOP, every medium its length.  One subject does one thing once at a time there; labels that overlap nevertheless go
into further observations.
"""

from __future__ import annotations

import datetime
import json
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from string import ascii_lowercase, digits
from typing import Any

from indexing.files import write_text
from indexing.labels.format import Request, Target, correction_error, seal, text_of
from indexing.labels.formats.boris.project import MACHINE, ethogram, files_of
from indexing.labels.label import Label, in_order
from indexing.labels.media import base_name, of_recording
from indexing.opening import clip_text, error, parse_json, read_text

SEAL = re.compile(r"\[([0-9a-f]{8})\]")
LATEST = 1e9  # seconds, thirty years: no time is later
PLAYERS = "12345678"
VERSION = "7.0"
STATE, POINT = "State event", "Point event"
FORBIDDEN = re.compile(r"[(|)`~]")  # in a modifier; a comma stands between several of one set
REMEDY = "save it again in BORIS, or write to another file"


@dataclass
class Draft:
    """A project while it is written."""

    target: Target
    project: dict[str, Any]
    codes: dict[str, tuple[str, bool]] = field(default_factory=dict)
    notices: list[str] = field(default_factory=list)


def write(labels: Sequence[Label], target: Target) -> list[str]:
    """Write a project, or observations into one."""
    text = "" if target.into is None else read_text(target.into, REMEDY)
    project = _empty() if target.into is None else _check_project(target.into, parse_json(target.into, text, REMEDY))
    draft = Draft(target, project)
    _behaviours(draft, labels)
    _subjects(draft, labels)
    _observations(draft, labels)
    if any(FORBIDDEN.search(part) for label in labels for part in label.modifiers):
        draft.notices.append("characters that BORIS forbids in modifiers, ( | ) ` ~, became spaces")
    if any(label.tier for label in labels):
        draft.notices.append("BORIS keeps no tiers")
    indent = re.match(r"\s*\{\r?\n([ \t]*)", text) if text else re.match("()", "")
    if not target.dry:
        write_text(target.path, json.dumps(project, indent=(indent[1] or 1) if indent else None, ensure_ascii=False) + "\n")
    return draft.notices


def _empty() -> dict[str, Any]:
    return {
        "time_format": "hh:mm:ss",
        "project_date": datetime.datetime.now().isoformat(timespec="seconds"),
        "project_name": "dyntorch",
        "project_description": "",
        "project_format_version": VERSION,
        "subjects_conf": {},
        "behaviors_conf": {},
        "behavioral_categories": [],
        "independent_variables": {},
        "coding_map": {},
        "behaviors_coding_map": [],
        "converters": {},
        "observations": {},
    }


def _check_project(path: Path, data: Any) -> dict[str, Any]:
    """A project whose parts are what they should be."""
    if not isinstance(data, dict) or not isinstance(data.get("observations"), dict):
        raise error(path, "is no BORIS project: it has no observations", REMEDY)
    for part in ("subjects_conf", "behaviors_conf"):
        if not isinstance(data.setdefault(part, {}), dict):
            raise error(path, f"is no sound BORIS project: {part} is no object", REMEDY)
    for name, one in data["observations"].items():
        if not isinstance(one, dict):
            raise error(path, f"is no sound BORIS project: observation {clip_text(name)!r} is no object", REMEDY)
    return data


# ---- ethogram and subjects -----------------------------------------------------------------------------------------------
def _behaviours(draft: Draft, labels: Sequence[Label]) -> None:
    """Every label's behaviour, into the ethogram where it is not there; a state where some label lasts."""
    conf = draft.project["behaviors_conf"]
    known = ethogram(Request(draft.target.into or draft.target.path), conf)
    keys = {text_of(one.get("key")).lower() for one in conf.values()}
    by_name: dict[str, list[Label]] = {}
    for label in sorted(labels, key=in_order):
        by_name.setdefault(label.label, []).append(label)
    for name, own in by_name.items():
        code, lasts = name, any(_milli(label.end) > _milli(label.start) for label in own)
        while known.get(code) is False and lasts:  # there as a point event: BORIS cannot tell how long it lasts
            code += " (state)"
        if code != name:
            said = f"{clip_text(name, 40)!r} is a point event in the project; its labels, some of which last, are written as"
            draft.notices.append(f"{said} {clip_text(code, 50)!r}")
        if code not in known:
            known[code] = lasts
            key = next((letter for letter in (code[:1].lower(), *ascii_lowercase, *digits) if letter not in keys), "")
            keys.add(key)
            conf[_free(conf)] = {
                "type": STATE if lasts else POINT,
                "key": key,
                "code": code,
                "description": "",
                "color": "",
                "category": "",
                "modifiers": _modifier_sets(own),
                "excluded": "",
                "coding map": "",
            }
        draft.codes[name] = code, known[code]


def _modifier_sets(labels: Sequence[Label]) -> dict[str, Any]:
    """The modifiers of a behaviour, set by set."""
    sets: list[dict[str, None]] = []
    for label in labels:
        for number, part in enumerate(label.modifiers):
            if number == len(sets):
                sets.append({})
            sets[number].update(dict.fromkeys(value for value in map(str.strip, _modifier(part).split(",")) if value))
    return {
        str(number): {"name": "", "type": 0, "ask at stop": False, "description": "", "values": list(values)}
        for number, values in enumerate(sets)
    }


def _modifier(text: str) -> str:
    return FORBIDDEN.sub(" ", text).strip()


def _subjects(draft: Draft, labels: Sequence[Label]) -> None:
    conf = draft.project["subjects_conf"]
    known = {text_of(one.get("name")) for one in conf.values() if isinstance(one, dict)}
    for subject in dict.fromkeys(label.subject for label in labels):
        if subject and subject not in known:
            conf[_free(conf)] = {"key": "", "name": subject, "description": ""}


def _free(conf: Mapping[str, Any]) -> str:
    """The next number of a table."""
    number = len(conf)
    while str(number) in conf:
        number += 1
    return str(number)


# ---- observations --------------------------------------------------------------------------------------------------------
def _observations(draft: Draft, labels: Sequence[Label]) -> None:
    """An observation per recording, more where labels overlap, in place of those that dyntorch wrote of it."""
    target, before = draft.target, draft.project["observations"]
    known = {media: one for one in before.values() for media in files_of(one)}
    groups: dict[tuple[str, str], list[Label]] = {}
    for label in labels:
        groups.setdefault((label.observation, label.media), []).append(label)
    empty = set(target.media) - {label.media for label in labels}  # nothing was found there: that is what the observation says
    groups |= {("", media): [] for media in target.media if media in empty}
    there = {media: _there(target, known, media) for _, media in groups}
    replaced = [[there[media]] for observation, media in groups if not observation]
    kept = _select_others(target, before, replaced)
    written: dict[str, Any] = {}
    for (observation, media), own in groups.items():
        base = base_name(there[media])
        if sum(base_name(one) == base for one in there.values()) > 1:
            base = there[media]
        layers = _layers(own)
        for number, layer in enumerate(layers):
            name = (observation or f"{target.tier} {base}".strip()) + f" ({number + 1})" * (number > 0)
            if name in kept or name in written:
                raise error(
                    target.into or target.path, f"somebody's observation is called {name!r}", "rename it, or write to another file"
                )
            written[name] = _observation(draft, layer, there[media], known.get(there[media]))
            if not observation:
                by = f" ({target.annotator})" * bool(target.annotator)
                mark = _seal(name, written[name], len(layers))
                written[name]["description"] = f"{MACHINE} found by a program, confirmed by nobody{by} [{mark}]"
    draft.project["observations"] = kept | written


def _select_others(target: Target, before: Mapping[str, Any], replaced: Sequence[list[str]]) -> dict[str, Any]:
    """The observations that stay: all but those that dyntorch wrote of these files."""
    old = {
        name: one
        for name, one in before.items()
        if _machine(one) and name.startswith(f"{target.tier} ") and files_of(one) in replaced
    }
    for name, one in old.items():
        number = sum(files_of(other) == files_of(one) for other in old.values())
        found = SEAL.search(text_of(one.get("description")))
        if found is None or found[1] != _seal(name, one, number):
            raise correction_error(target, f"observation {clip_text(name)!r}")
    return {name: one for name, one in before.items() if name not in old}


def _machine(observation: Any) -> bool:
    return text_of(observation.get("description")).startswith(MACHINE)


def _seal(name: str, observation: Mapping[str, Any], layers: int) -> str:
    """The mark of an observation, one of several that were written of the recording: what a person may correct in it."""
    rows = []
    for event in observation["events"] if isinstance(observation.get("events"), list) else ():
        time = _time(event[0]) if isinstance(event, list) and event else None
        if time is None:
            return ""  # no event of ours
        texts = [" ".join(text_of(part).split()) for part in [*event[1:5], "", "", "", ""][:4]]
        rows.append((time, *("" if text == "None" else text for text in texts)))
    return seal(name, layers, _time(observation.get("time offset")) or 0, *(part for row in sorted(rows) for part in row))


def _time(value: Any) -> int | None:
    """Milliseconds, None where that is no time of ours."""
    return _milli(value) if isinstance(value, int | float) and abs(value) < LATEST else None


def _there(target: Target, known: Mapping[str, Any], media: str) -> str:
    """How the project calls a recording."""
    asked = Request(target.into or target.path, media, target.name)
    if target.name is not None:
        return next(iter(of_recording(known, asked) or {media}))
    try:
        return next(iter(of_recording(known, asked) or {media}))
    except ValueError:  # the project does not have it yet
        return media


def _layers(labels: Sequence[Label]) -> list[list[Label]]:
    """Labels such that in each layer a subject does a thing once at a time; one layer at least."""
    layers: list[list[Label]] = [[]]
    ends: list[dict[tuple[str, str, str], int]] = [{}]
    for label in sorted(labels, key=in_order):
        key = (label.subject, label.label, _format_comment(label))
        start = _milli(label.start)
        at = next((i for i, last in enumerate(ends) if last.get(key, -math.inf) <= start), len(layers))
        if at == len(layers):
            layers.append([])
            ends.append({})
        layers[at].append(label)
        ends[at][key] = _milli(label.end)
    return layers


def _observation(draft: Draft, labels: Sequence[Label], media: str, like: Mapping[str, Any] | None) -> dict[str, Any]:
    """An observation of one recording; what is known of it is taken over from an observation that has it."""
    target = draft.target
    last = max((label.end for label in labels), default=0.0)
    info = {"length": target.duration or last, "fps": target.fps or 0.0, "hasVideo": True, "hasAudio": False}
    known = like.get("media_info") if like is not None else None
    for part, value in info.items():
        values = known.get(part) if isinstance(known, dict) else None
        info[part] = values.get(media, value) if isinstance(values, dict) else value
    return {
        "file": {player: [media] * (player == "1") for player in PLAYERS},
        "type": "MEDIA",
        "date": datetime.datetime.now().isoformat(timespec="seconds"),
        "description": "",
        "time offset": 0.0,
        "events": _events(draft, labels),
        "observation time interval": [0, 0],
        "independent_variables": {},
        "visualize_spectrogram": False,
        "visualize_waveform": False,
        "media_creation_date_as_offset": False,
        "media_scan_sampling_duration": 0,
        "image_display_duration": 1,
        "close_behaviors_between_videos": False,
        "media_info": {part: {media: value} for part, value in info.items()} | {"offset": {"1": 0.0}},
    }


def _events(draft: Draft, labels: Sequence[Label]) -> list[list[Any]]:
    """START and STOP of what lasts, moments as they are, by time."""
    rows = []
    for label in labels:
        code, lasts = draft.codes[label.label]
        says = f"score {label.score:.6g}" if label.score is not None else ""
        comment = "; ".join(part for part in (says, label.comment) if part)
        for number in range(1 + lasts):
            time = label.end if number else label.start
            frame = round(time * draft.target.fps) if draft.target.fps else "NA"
            rows.append([_milli(time) / 1000, label.subject, code, _format_comment(label), "" if number else comment, frame])
    return sorted(rows, key=lambda row: row[0])


def _format_comment(label: Label) -> str:
    return "|".join(map(_modifier, label.modifiers))


def _milli(seconds: float) -> int:
    return round(1000 * seconds)

"""BORIS projects (``.boris``, JSON): observations of media files, of live sessions and of pictures, with point and state events.

A state event is two entries, START and STOP, told apart only by their order: per subject, behaviour and modifiers, every second
one is a STOP.  Times are on the clock of the observation, which is that of its first player plus the observation's ``time offset``;
files of one player run after each other on it, and another player begins ``media_info.offset`` seconds later.

Source: BORIS 7 to 9, ``project_format_version`` 7.0 (https://www.boris.unito.it).
"""

from __future__ import annotations

import datetime
import json
import math
import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from string import ascii_lowercase, digits
from typing import Any

from indexing.files import write_text
from indexing.labels.format import (
    Gathering,
    LabelFormat,
    Request,
    Span,
    Target,
    base_name,
    correction_error,
    list_few,
    of_recording,
    parse_seconds,
    seal,
    split_by_media,
    text_of,
)
from indexing.labels.label import Label, LabelFile, sort_key
from indexing.opening import clip_text, count, error, listing, parse_json, quote, read_text

REMEDY = "save the project again in BORIS"
MACHINE = "dyntorch:"  # how the description of an observation begins that a program wrote
UNMODIFIED = ("", "None")
NUMBERED = re.compile(r" \(\d+\)$")
SCORE = re.compile(r"score (?P<score>-?\d[\d.e+-]*)(?:; (?P<comment>.*))?", re.DOTALL)


@dataclass(frozen=True)
class Entry:
    """An entry of an observation."""

    time: float
    key: tuple[str, str, str]
    comment: str


@dataclass(frozen=True)
class Interval:
    """A point event, or a START with its STOP, on the clock of the observation."""

    start: float
    end: float
    key: tuple[str, str, str]
    comment: str


def read(data: Mapping[str, Any], asked: Request) -> LabelFile:
    """Read a project."""
    out = Gathering(asked, "boris")
    observations = {str(name): _object(asked, value, f"observation {name!r}") for name, value in data["observations"].items()}
    called = _names(observations)
    for name, observation in observations.items():
        out.observations.setdefault(called[name])
        if _by_machine(observation):
            out.machine.setdefault(called[name])
        for media in files_of(observation):
            out.media.setdefault(media)
            out.watched.setdefault((called[name], media))
    for subject in _object(asked, data.get("subjects_conf") or {}, "subjects_conf").values():
        if isinstance(subject, dict) and text_of(subject.get("name")):
            out.subjects.setdefault(text_of(subject["name"]))
    wanted = {name: one for name, one in observations.items() if asked.observation in (None, called[name])}
    mine = of_recording((media for one in wanted.values() for media in files_of(one)), asked)
    types = ethogram(asked, data.get("behaviors_conf"))
    left: Counter[str] = Counter()
    with_media = any(files_of(one) for one in wanted.values())
    for name, observation in wanted.items():
        media_files = set(files_of(observation))
        if mine is None or mine & media_files or not (media_files or with_media):
            _observation(out, (name, called[name]), observation, types, mine)
        else:
            left[name] += len(out.list_of(observation.get("events"), f"observation {name!r}, events", REMEDY))
    left += Counter()  # drops those without events
    if left:
        of = f"of other recordings than {asked.media or asked.recording} ({list_few(left)})"
        out.note(f"{count(len(left), 'observation')} left out: {of}")
    return out.finish()


def _by_machine(observation: Mapping[str, Any]) -> bool:
    return text_of(observation.get("description")).startswith(MACHINE)


def _names(observations: Mapping[str, Any]) -> dict[str, str]:
    """What each observation is called here: of those that a program wrote, the further ones as the first."""
    names = {}
    for name, observation in observations.items():
        first = NUMBERED.sub("", name)
        same = first in observations and _by_machine(observations[first]) and _by_machine(observation)
        names[name] = first if same else name
    return names


def ethogram(asked: Request, conf: Any) -> dict[str, bool]:
    """Behaviours, and whether each is a state, which lasts."""
    lasting = {}
    for key, behaviour in _object(asked, conf or {}, "behaviors_conf").items():
        entry = _object(asked, behaviour, f"behaviors_conf {key!r}")
        lasting[text_of(entry.get("code"))] = text_of(entry.get("type")).lower().startswith("state")
    return lasting


# ---- one observation -----------------------------------------------------------------------------------------------------
def _observation(
    out: Gathering, names: tuple[str, str], observation: Mapping[str, Any], types: Mapping[str, bool], mine: set[str] | None
) -> None:
    """The labels of an observation, on the clock of the recording, or each on the clock of the file that is played then."""
    name, called = names
    where = f"observation {name!r}"
    events = _events(out, observation, where)
    stretches = list(pair_events(out, events, types, where))
    if not stretches:
        return
    # what the observation's clock shows at the first frame of its first player
    offset = out.seconds(observation.get("time offset") or 0.0, where, "time offset")
    spans = clock(out, observation, where, mine)
    cut = 0
    for number, stretch in enumerate(stretches):
        start, end = stretch.start - offset, stretch.end - offset
        pieces = split_by_media(start, end, spans) if spans else [("", start, end)]
        cut += len(pieces) > 1
        pieces = [piece for piece in pieces if mine is None or piece[0] in mine or not spans]
        add_interval(out, stretch, pieces, called, f"{where}, event {number + 1}")
    if cut:
        out.note(f"{where}: {count(cut, 'label')} cut in two, where one file ends and the next begins")
    if not spans and out.asked.recording is not None:
        out.note(f"{where} names no media file; its clock is taken for that of {out.asked.recording}")


def _events(out: Gathering, observation: Mapping[str, Any], where: str) -> list[Entry]:
    """The entries with a time, in order of it."""
    entries: list[Entry] = []
    timeless = 0
    pictures = observation.get("type") == "IMAGES"
    for number, entry in enumerate(out.list_of(observation.get("events"), f"{where}, events", REMEDY), start=1):
        here = f"{where}, event {number}"
        if not isinstance(entry, list) or len(entry) < 3:
            raise error(out.asked.path, f"{here} is {quote(entry)}, not [time, subject, code, modifiers, comment]", REMEDY)
        if entry[0] in (None, "NA") and pictures:
            timeless += 1
            continue
        names = [*entry[1:5], "", "", ""][:4]
        bad = next((value for value in names if not (value is None or isinstance(value, (str, int, float)))), None)
        if bad is not None:
            raise error(out.asked.path, f"{here}: {quote(bad)} is no name", REMEDY)
        subject, code, modifiers, comment = (text_of(value) for value in names)
        entries.append(Entry(out.seconds(entry[0], here, "time"), (subject, code, modifiers), comment))
    if timeless:
        out.note(f"{where}: {count(timeless, 'event')} left out: of pictures without a time")
    entries.sort(key=lambda event: event.time)
    return entries


def pair_events(out: Gathering, events: Sequence[Entry], types: Mapping[str, bool], where: str) -> Iterator[Interval]:
    """Point events as they are, and each START with its STOP."""
    begun: dict[tuple[str, str, str], Entry] = {}
    unknown: Counter[str] = Counter()
    intervals: list[Interval] = []
    for event in events:
        lasts = types.get(event.key[1])
        if lasts is None:
            unknown[event.key[1]] += 1
        elif not lasts:
            intervals.append(Interval(event.time, event.time, event.key, event.comment))
        elif event.key in begun:
            start = begun.pop(event.key)
            intervals.append(Interval(start.time, event.time, event.key, join_comments(start.comment, event.comment)))
        else:
            begun[event.key] = event
    intervals += _pair_modified_stops(out, begun, where)
    for code, times in unknown.items():
        out.note(f"{where}: {count(times, 'event')} left out: {code!r} is not in the ethogram, so nobody knows START from STOP")
    for event in begun.values():
        subject, code, modifiers = event.key
        of = f" of {subject}" * bool(subject) + f" ({modifiers})" * (modifiers not in UNMODIFIED)
        never = f"{code!r}{of} starts at {event.time:.6g} s and never stops"
        out.note(f"{where}: {never}; left out (BORIS: Observations > Close unpaired events)")
    yield from sorted(intervals, key=lambda stretch: stretch.start)


def _pair_modified_stops(out: Gathering, begun: dict[tuple[str, str, str], Entry], where: str) -> list[Interval]:
    """States whose modifiers were asked for at STOP only: the START has none.  They are taken out of ``begun``."""
    intervals = []
    for event in sorted(begun.values(), key=lambda event: event.time):
        subject, code, modifiers = event.key
        if modifiers.strip("|") in UNMODIFIED and event.key in begun:
            later = [
                other
                for other in begun.values()
                if other.key[:2] == (subject, code) and other.key != event.key and other.time >= event.time
            ]
            if later:
                stop = min(later, key=lambda other: other.time)
                del begun[event.key], begun[stop.key]
                intervals.append(Interval(event.time, stop.time, stop.key, join_comments(event.comment, stop.comment)))
    if intervals:
        out.note(f"{where}: {count(len(intervals), 'state')} without modifiers at START paired with the STOP that has them")
    return intervals


def add_interval(out: Gathering, interval: Interval, pieces: Sequence[tuple[str, float, float]], name: str, where: str) -> None:
    """The labels of an interval, one for each file that is played then; what a program wrote has a score in its comment."""
    subject, code, modifiers = interval.key
    comment, score = split_score(interval.comment) if name in out.machine else (interval.comment, None)
    fields: dict[str, Any] = {"subject": subject, "comment": comment, "score": score, "observation": name}
    fields["modifiers"] = tuple(modifiers.split("|")) if modifiers.strip("|") else ()
    for media, start, end in pieces:
        out.add(code, round(start, 6), round(end, 6), where, media=media, **fields)


def join_comments(start: str, stop: str) -> str:
    """The comments at START and STOP, as one."""
    return " / ".join(comment for comment in (start, stop) if comment)


def split_score(comment: str) -> tuple[str, float | None]:
    """A comment of ours without the score that it begins with, and the score."""
    match = SCORE.fullmatch(comment)
    number = parse_seconds(match["score"]) if match else math.nan
    return (match["comment"] or "", number) if match and math.isfinite(number) else (comment, None)


# ---- clocks --------------------------------------------------------------------------------------------------------------
def clock(out: Gathering, observation: Mapping[str, Any], where: str, mine: set[str] | None) -> list[Span]:
    """When which file is played, on the clock of the first player: those of the player that plays the recording, else of the
    first."""
    players = _players(observation)
    if not players:
        return []
    info = observation.get("media_info")
    info = info if isinstance(info, dict) else {}
    player = next((player for player, files in players.items() if mine and mine & set(files)), next(iter(players)))
    begin = 0.0
    if player != next(iter(players)):
        offsets = info.get("offset")
        offset = offsets.get(player) if isinstance(offsets, dict) else None
        begin = out.seconds(offset or 0.0, where, f"offset of player {player}:")
    created = info.get("media_creation_time") if observation.get("media_creation_date_as_offset") else None
    files = players[player]
    spans = []
    for number, media in enumerate(files):
        shift = out.seconds(created.get(media, 0.0), where, "media_creation_time") if isinstance(created, dict) else 0.0
        last = number == len(files) - 1
        length = math.inf if last else _length(out, info, media, where)
        spans.append(Span(media, begin + shift, begin + shift + length))
        begin += length
    if len(players) > 1 and mine is None:
        out.note(f"{where} plays {listing(files[0] for files in players.values())} beside each other; times are those of the first")
    return spans


def _length(out: Gathering, info: Mapping[str, Any], media: str, where: str) -> float:
    lengths = info.get("length")
    value = lengths.get(media) if isinstance(lengths, dict) else None
    if value is None:
        raise error(out.asked.path, f"{where}: does not say how long {media} is, after which another file is played", REMEDY)
    length = out.seconds(value, where, f"length of {media}:")
    if length <= 0:
        raise error(out.asked.path, f"{where}: {media} lasts {length:g} s", REMEDY)
    return length


def _players(observation: Mapping[str, Any]) -> dict[str, list[str]]:
    """The files of each player that has some, by the player's number."""
    players = observation.get("file")
    if not isinstance(players, dict) or observation.get("type") not in (None, "MEDIA"):
        return {}
    players_ = {
        str(player): [name for name in files if isinstance(name, str) and name]
        for player, files in players.items()
        if isinstance(files, list)
    }
    return {player: players_[player] for player in sorted(players_, key=lambda text: (len(text), text)) if players_[player]}


def files_of(observation: Mapping[str, Any]) -> list[str]:
    """All files that an observation plays."""
    return [media for files in _players(observation).values() for media in files]


def _object(asked: Request, value: Any, where: str) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise error(asked.path, f"{where} is {quote(value)}, not an object", REMEDY)
    return value


# ----------------------------------------------------------------------------------------------------------------------
# Write projects: an observation of its own for each recording, beside those of people, who find theirs as they left them


SEAL = re.compile(r"\[([0-9a-f]{8})\]")
LATEST = 1e9  # seconds, thirty years: no time is later
PLAYERS = "12345678"
VERSION = "7.0"
STATE, POINT = "State event", "Point event"
FORBIDDEN = re.compile(r"[(|)`~]")  # in a modifier; a comma stands between several of one set
WRITE_REMEDY = "save it again in BORIS, or write to another file"


@dataclass
class Draft:
    """A project while it is written."""

    target: Target
    project: dict[str, Any]
    codes: dict[str, tuple[str, bool]] = field(default_factory=dict)
    notices: list[str] = field(default_factory=list)


def write(labels: Sequence[Label], target: Target) -> list[str]:
    """Write a project, or observations into one."""
    text = "" if target.into is None else read_text(target.into, WRITE_REMEDY)
    project = _empty_project() if target.into is None else _check_project(target.into, parse_json(target.into, text, WRITE_REMEDY))
    draft = Draft(target, project)
    _add_behaviours(draft, labels)
    _add_subjects(draft, labels)
    _write_observations(draft, labels)
    if any(FORBIDDEN.search(part) for label in labels for part in label.modifiers):
        draft.notices.append("characters that BORIS forbids in modifiers, ( | ) ` ~, became spaces")
    if any(label.tier for label in labels):
        draft.notices.append("BORIS keeps no tiers")
    indent = re.match(r"\s*\{\r?\n([ \t]*)", text) if text else re.match("()", "")
    if not target.dry:
        write_text(target.path, json.dumps(project, indent=(indent[1] or 1) if indent else None, ensure_ascii=False) + "\n")
    return draft.notices


def _empty_project() -> dict[str, Any]:
    about = {"time_format": "hh:mm:ss", "project_date": datetime.datetime.now().isoformat(timespec="seconds")}
    about |= {"project_name": "dyntorch", "project_description": "", "project_format_version": VERSION}
    tables = ("subjects_conf", "behaviors_conf", "independent_variables", "coding_map", "converters", "observations")
    return about | {"behavioral_categories": [], "behaviors_coding_map": []} | {table: {} for table in tables}


def _check_project(path: Path, data: Any) -> dict[str, Any]:
    """A project whose parts are what they should be."""
    if not isinstance(data, dict) or not isinstance(data.get("observations"), dict):
        raise error(path, "is no BORIS project: it has no observations", WRITE_REMEDY)
    for part in ("subjects_conf", "behaviors_conf"):
        if not isinstance(data.setdefault(part, {}), dict):
            raise error(path, f"is no sound BORIS project: {part} is no object", WRITE_REMEDY)
    for name, one in data["observations"].items():
        if not isinstance(one, dict):
            raise error(path, f"is no sound BORIS project: observation {clip_text(name)!r} is no object", WRITE_REMEDY)
    return data


# ---- ethogram and subjects -----------------------------------------------------------------------------------------------
def _add_behaviours(draft: Draft, labels: Sequence[Label]) -> None:
    """Every label's behaviour, into the ethogram where it is not there; a state where some label lasts."""
    conf = draft.project["behaviors_conf"]
    known = ethogram(Request(draft.target.into or draft.target.path), conf)
    keys = {text_of(one.get("key")).lower() for one in conf.values()}
    by_name: dict[str, list[Label]] = {}
    for label in sorted(labels, key=sort_key):
        by_name.setdefault(label.label, []).append(label)
    for name, own in by_name.items():
        code, lasts = name, any(_milli(label.end) > _milli(label.start) for label in own)
        while known.get(code) is False and lasts:  # there as a point event: BORIS cannot tell how long it lasts
            code += " (state)"
        if code != name:
            message = f"{clip_text(name, 40)!r} is a point event in the project; its labels, some of which last, are written as"
            draft.notices.append(f"{message} {clip_text(code, 50)!r}")
        if code not in known:
            known[code] = lasts
            key = next((letter for letter in (code[:1].lower(), *ascii_lowercase, *digits) if letter not in keys), "")
            keys.add(key)
            blank = dict.fromkeys(("description", "color", "category", "excluded", "coding map"), "")
            kind = STATE if lasts else POINT
            conf[_next_number(conf)] = {"type": kind, "key": key, "code": code, "modifiers": _modifier_sets(own)} | blank
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


def _add_subjects(draft: Draft, labels: Sequence[Label]) -> None:
    conf = draft.project["subjects_conf"]
    known = {text_of(one.get("name")) for one in conf.values() if isinstance(one, dict)}
    for subject in dict.fromkeys(label.subject for label in labels):
        if subject and subject not in known:
            conf[_next_number(conf)] = {"key": "", "name": subject, "description": ""}


def _next_number(conf: Mapping[str, Any]) -> str:
    """The next number of a table."""
    number = len(conf)
    while str(number) in conf:
        number += 1
    return str(number)


# ---- observations --------------------------------------------------------------------------------------------------------
def _write_observations(draft: Draft, labels: Sequence[Label]) -> None:
    """An observation per recording, more where labels overlap, in place of those that dyntorch wrote of it."""
    target, before = draft.target, draft.project["observations"]
    known = {media: one for one in before.values() for media in files_of(one)}
    groups: dict[tuple[str, str], list[Label]] = {}
    for label in labels:
        groups.setdefault((label.observation, label.media), []).append(label)
    empty = set(target.media) - {label.media for label in labels}  # nothing was found there: that is what the observation says
    groups |= {("", media): [] for media in target.media if media in empty}
    there = {media: _project_name(target, known, media) for _, media in groups}
    replaced = [[there[media]] for observation, media in groups if not observation]
    others = _select_others(target, before, replaced)
    written: dict[str, Any] = {}
    for (observation, media), own in groups.items():
        base = base_name(there[media])
        if sum(base_name(one) == base for one in there.values()) > 1:
            base = there[media]
        layers = _split_layers(own)
        for number, layer in enumerate(layers):
            name = (observation or f"{target.tier} {base}".strip()) + f" ({number + 1})" * (number > 0)
            if name in others or name in written:
                what = f"somebody's observation is called {name!r}"
                raise error(target.into or target.path, what, "rename it, or write to another file")
            written[name] = _build_observation(draft, layer, there[media], known.get(there[media]))
            if not observation:
                by = f" ({target.annotator})" * bool(target.annotator)
                mark = _seal(name, written[name], len(layers))
                written[name]["description"] = f"{MACHINE} found by a program, confirmed by nobody{by} [{mark}]"
    draft.project["observations"] = others | written


def _select_others(target: Target, before: Mapping[str, Any], replaced: Sequence[list[str]]) -> dict[str, Any]:
    """The observations that stay: all but those that dyntorch wrote of these files."""
    old = {
        name: one
        for name, one in before.items()
        if _by_machine(one) and name.startswith(f"{target.tier} ") and files_of(one) in replaced
    }
    for name, one in old.items():
        number = sum(files_of(other) == files_of(one) for other in old.values())
        mark = SEAL.search(text_of(one.get("description")))
        if mark is None or mark[1] != _seal(name, one, number):
            raise correction_error(target, f"observation {clip_text(name)!r}")
    return {name: one for name, one in before.items() if name not in old}


def _seal(name: str, observation: Mapping[str, Any], layers: int) -> str:
    """The mark of an observation, one of several that were written of the recording: what a person may correct in it."""
    rows = []
    for event in observation["events"] if isinstance(observation.get("events"), list) else ():
        time = _to_milli(event[0]) if isinstance(event, list) and event else None
        if time is None:
            return ""  # no event of ours
        texts = [" ".join(text_of(part).split()) for part in [*event[1:5], "", "", "", ""][:4]]
        rows.append((time, *("" if text == "None" else text for text in texts)))
    return seal(name, layers, _to_milli(observation.get("time offset")) or 0, *(part for row in sorted(rows) for part in row))


def _to_milli(value: Any) -> int | None:
    """Milliseconds, None where that is no time of ours."""
    return _milli(value) if isinstance(value, int | float) and abs(value) < LATEST else None


def _project_name(target: Target, known: Mapping[str, Any], media: str) -> str:
    """How the project calls a recording."""
    try:
        return next(iter(of_recording(known, Request(target.into or target.path, media, target.name)) or {media}))
    except ValueError:  # the project does not have it yet
        if target.name is not None:
            raise
        return media


def _split_layers(labels: Sequence[Label]) -> list[list[Label]]:
    """Labels such that in each layer a subject does a thing once at a time; one layer at least."""
    layers: list[list[Label]] = [[]]
    ends: list[dict[tuple[str, str, str], int]] = [{}]
    for label in sorted(labels, key=sort_key):
        key = (label.subject, label.label, _format_modifiers(label))
        start = _milli(label.start)
        at = next((i for i, last in enumerate(ends) if last.get(key, -math.inf) <= start), len(layers))
        if at == len(layers):
            layers.append([])
            ends.append({})
        layers[at].append(label)
        ends[at][key] = _milli(label.end)
    return layers


def _build_observation(draft: Draft, labels: Sequence[Label], media: str, like: Mapping[str, Any] | None) -> dict[str, Any]:
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
        "events": _format_events(draft, labels),
        "observation time interval": [0, 0],
        "independent_variables": {},
        **dict.fromkeys(("visualize_spectrogram", "visualize_waveform", "media_creation_date_as_offset"), False),
        "media_scan_sampling_duration": 0,
        "image_display_duration": 1,
        "close_behaviors_between_videos": False,
        "media_info": {part: {media: value} for part, value in info.items()} | {"offset": {"1": 0.0}},
    }


def _format_events(draft: Draft, labels: Sequence[Label]) -> list[list[Any]]:
    """START and STOP of what lasts, moments as they are, by time."""
    rows = []
    for label in labels:
        code, lasts = draft.codes[label.label]
        says = f"score {label.score:.6g}" if label.score is not None else ""
        comment = "; ".join(part for part in (says, label.comment) if part)
        for number in range(1 + lasts):
            time = label.end if number else label.start
            frame = round(time * draft.target.fps) if draft.target.fps else "NA"
            rows.append([_milli(time) / 1000, label.subject, code, _format_modifiers(label), "" if number else comment, frame])
    return sorted(rows, key=lambda row: row[0])


def _format_modifiers(label: Label) -> str:
    return "|".join(map(_modifier, label.modifiers))


def _milli(seconds: float) -> int:
    return round(1000 * seconds)


def matches(data: Any) -> bool:
    """An object with observations."""
    return isinstance(data, dict) and isinstance(data.get("observations"), dict)


FORMAT = LabelFormat(
    "a BORIS project", ("json",), read, matches, order=10, write=write, written={"boris": ".boris"}, program="BORIS"
)  # fmt: skip

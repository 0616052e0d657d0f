"""BORIS projects (``.boris``, JSON): observations of media files, of live sessions and of pictures, with point and state events.

A state event is two entries, START and STOP, told apart only by their order: per subject, behaviour and modifiers, every second
one is a STOP.  Times are on the clock of the observation, which is that of its first player plus the observation's ``time offset``;
files of one player run after each other on it, and another player begins ``media_info.offset`` seconds later.

Source: BORIS 7 to 9, ``project_format_version`` 7.0 (https://www.boris.unito.it).
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from indexing.labels.format import Gathering, Request, list_few, parse_seconds, text_of
from indexing.labels.label import LabelFile
from indexing.labels.media import Span, of_recording, split_by_media
from indexing.opening import count, error, listing, shown

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
            left[name] += len(_list(asked, observation.get("events"), f"observation {name!r}, events"))
    left += Counter()  # drops those without events
    if left:
        of = f"of other recordings than {asked.media or asked.recording} ({list_few(left)})"
        out.note(f"{count(len(left), 'observation')} left out: {of}")
    return out.finish()


def _by_machine(observation: Mapping[str, Any]) -> bool:
    return text_of(observation.get("description")).startswith(MACHINE)


def _names(observations: Mapping[str, Any]) -> dict[str, str]:
    """What each observation is called here: of those that a program wrote, the further ones as the first."""
    found = {}
    for name, observation in observations.items():
        first = NUMBERED.sub("", name)
        same = first in observations and _by_machine(observations[first]) and _by_machine(observation)
        found[name] = first if same else name
    return found


def ethogram(asked: Request, conf: Any) -> dict[str, bool]:
    """Behaviours, and whether each is a state, which lasts."""
    found = {}
    for key, behaviour in _object(asked, conf or {}, "behaviors_conf").items():
        entry = _object(asked, behaviour, f"behaviors_conf {key!r}")
        found[text_of(entry.get("code"))] = text_of(entry.get("type")).lower().startswith("state")
    return found


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
    offset = _offset(out, observation, where)
    spans = clock(out, observation, where, mine)
    cut = 0
    for number, stretch in enumerate(stretches):
        subject, code, modifiers = stretch.key
        start, end = stretch.start - offset, stretch.end - offset
        pieces = split_by_media(start, end, spans) if spans else [("", start, end)]
        cut += len(pieces) > 1
        comment, score = (stretch.comment, None) if called not in out.machine else split_score(stretch.comment)
        for media, first, last in pieces:
            if mine is None or media in mine or not spans:
                out.add(
                    code,
                    round(first, 6),
                    round(last, 6),
                    f"{where}, event {number + 1}",
                    subject=subject,
                    media=media,
                    observation=called,
                    comment=comment,
                    score=score,
                    modifiers=() if not modifiers.strip("|") else tuple(modifiers.split("|")),
                )
    if cut:
        out.note(f"{where}: {count(cut, 'label')} cut in two, where one file ends and the next begins")
    if not spans and out.asked.recording is not None:
        out.note(f"{where} names no media file; its clock is taken for that of {out.asked.recording}")


def _events(out: Gathering, observation: Mapping[str, Any], where: str) -> list[Entry]:
    """The entries with a time, in order of it."""
    found: list[Entry] = []
    timeless = 0
    pictures = observation.get("type") == "IMAGES"
    for number, entry in enumerate(_list(out.asked, observation.get("events"), f"{where}, events"), start=1):
        here = f"{where}, event {number}"
        if not isinstance(entry, list) or len(entry) < 3:
            raise error(out.asked.path, f"{here} is {shown(entry)}, not [time, subject, code, modifiers, comment]", REMEDY)
        if entry[0] in (None, "NA") and pictures:
            timeless += 1
            continue
        names = [*entry[1:5], "", "", ""][:4]
        bad = next((value for value in names if not (value is None or isinstance(value, (str, int, float)))), None)
        if bad is not None:
            raise error(out.asked.path, f"{here}: {shown(bad)} is no name", REMEDY)
        subject, code, modifiers, comment = (text_of(value) for value in names)
        found.append(Entry(out.seconds(entry[0], here, "time"), (subject, code, modifiers), comment))
    if timeless:
        out.note(f"{where}: {count(timeless, 'event')} left out: of pictures without a time")
    found.sort(key=lambda event: event.time)
    return found


def pair_events(out: Gathering, events: Sequence[Entry], types: Mapping[str, bool], where: str) -> Iterator[Interval]:
    """Point events as they are, and each START with its STOP."""
    begun: dict[tuple[str, str, str], Entry] = {}
    unknown: Counter[str] = Counter()
    found: list[Interval] = []
    for event in events:
        lasts = types.get(event.key[1])
        if lasts is None:
            unknown[event.key[1]] += 1
        elif not lasts:
            found.append(Interval(event.time, event.time, event.key, event.comment))
        elif event.key in begun:
            start = begun.pop(event.key)
            found.append(Interval(start.time, event.time, event.key, join_comments(start.comment, event.comment)))
        else:
            begun[event.key] = event
    found += _asked_at_stop(out, begun, where)
    for code, times in unknown.items():
        out.note(f"{where}: {count(times, 'event')} left out: {code!r} is not in the ethogram, so nobody knows START from STOP")
    for event in begun.values():
        subject, code, modifiers = event.key
        of = f" of {subject}" * bool(subject) + f" ({modifiers})" * (modifiers not in UNMODIFIED)
        never = f"{code!r}{of} starts at {event.time:.6g} s and never stops"
        out.note(f"{where}: {never}; left out (BORIS: Observations > Close unpaired events)")
    yield from sorted(found, key=lambda stretch: stretch.start)


def _asked_at_stop(out: Gathering, begun: dict[tuple[str, str, str], Entry], where: str) -> list[Interval]:
    """States whose modifiers were asked for at STOP only: the START has none.  They are taken out of ``begun``."""
    found = []
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
                found.append(Interval(event.time, stop.time, stop.key, join_comments(event.comment, stop.comment)))
    if found:
        out.note(f"{where}: {count(len(found), 'state')} without modifiers at START paired with the STOP that has them")
    return found


def join_comments(start: str, stop: str) -> str:
    """The comments at START and STOP, as one."""
    return " / ".join(comment for comment in (start, stop) if comment)


def split_score(comment: str) -> tuple[str, float | None]:
    """A comment of ours without the score that it begins with, and the score."""
    found = SCORE.fullmatch(comment)
    number = parse_seconds(found["score"]) if found else math.nan
    return (found["comment"] or "", number) if found and math.isfinite(number) else (comment, None)


# ---- clocks --------------------------------------------------------------------------------------------------------------
def _offset(out: Gathering, observation: Mapping[str, Any], where: str) -> float:
    """What the observation's clock shows at the first frame of its first player."""
    return out.seconds(observation.get("time offset") or 0.0, where, "time offset")


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
    found = {
        str(player): [name for name in files if isinstance(name, str) and name]
        for player, files in players.items()
        if isinstance(files, list)
    }
    return {player: found[player] for player in sorted(found, key=lambda text: (len(text), text)) if found[player]}


def files_of(observation: Mapping[str, Any]) -> list[str]:
    """All files that an observation plays."""
    return [media for files in _players(observation).values() for media in files]


def _object(asked: Request, value: Any, where: str) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise error(asked.path, f"{where} is {shown(value)}, not an object", REMEDY)
    return value


def _list(asked: Request, value: Any, where: str) -> list[Any]:
    if value is None:
        return []
    if not isinstance(value, list):
        raise error(asked.path, f"{where} is {shown(value)}, not a list", REMEDY)
    return value

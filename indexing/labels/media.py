"""Which file that labels are of is the recording at hand, and whose clock runs when several are played after each other."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from urllib.parse import unquote

from indexing.labels.format import Request
from indexing.opening import error, listing

SUFFIX = re.compile(r"\.\w{1,8}$")
REMEDY = "name the recording as its video is named, or say which it is (--media NAME)"


@dataclass(frozen=True)
class Span:
    """A stretch of a clock on which one file is played."""

    media: str
    begin: float = 0.0
    end: float = math.inf


def split_by_media(start: float, end: float, spans: Sequence[Span]) -> list[tuple[str, float, float]]:
    """A stretch of a clock, by the files that are played then: each file with start and end on its own clock."""
    found = []
    for number, span in enumerate(spans):
        first = -math.inf if number == 0 else span.begin
        last = math.inf if number == len(spans) - 1 else span.end
        inside = first <= start < last if start == end else start < last and end > first
        if inside:
            found.append((span.media, max(start, first) - span.begin, min(end, last) - span.begin))
    return found


def base_name(name: str) -> str:
    """The name of a file without folders, whatever system or address it was written on."""
    plain = unquote(name) if "://" in name or name.startswith("file:") else name
    return re.split(r"[\\/]", plain.rstrip("\\/"))[-1]


def of_recording(names: Iterable[str], asked: Request) -> set[str] | None:
    """Those of the files in a label file that are the recording at hand; None where none is at hand."""
    known = list(dict.fromkeys(name for name in names if name))
    if asked.media is not None:
        same = {name for name in known if name == asked.media} or {name for name in known if base_name(name) == asked.media}
        if not same:
            said = f"has no labels of {asked.media}, only of {listing(known)}"
            raise error(asked.path, said, "give one of these names (--media)")
        return same
    if asked.recording is None or not known:
        return None
    ranks = {name: _likeness(name, str(asked.recording)) for name in known}
    best = max(ranks.values())
    if not best:
        own = base_name(str(asked.recording))
        raise error(asked.path, f"its labels are of {listing(known)}, not of {own}", REMEDY)
    found = [name for name in known if ranks[name] == best]
    if len(found) > 1:
        raise error(asked.path, f"{base_name(str(asked.recording))} may be any of {listing(found)}", REMEDY)
    return set(found)


def same_recording(name: str, other: str) -> bool:
    """Whether two files are called alike, but for their folders and suffixes: a video and its keypoints."""
    return SUFFIX.sub("", base_name(name)).casefold() == SUFFIX.sub("", base_name(other)).casefold()


def _likeness(name: str, recording: str) -> tuple[int, int] | tuple[()]:
    """How much a file of the labels is like the recording: empty where it is another one."""
    folders = [re.split(r"[\\/]", text)[:-1] for text in (name, os.path.abspath(os.path.expanduser(recording)))]
    shared = 0
    for a, b in zip(reversed(folders[0]), reversed(folders[1]), strict=False):
        if a != b:
            break
        shared += 1
    theirs, ours = base_name(name), base_name(recording)
    if theirs == ours:
        return 3, shared
    stems = [SUFFIX.sub("", text).casefold() for text in (theirs, ours)]
    if stems[0] == stems[1]:
        return 2, shared
    if all(stems) and (_holds(stems[1], stems[0]) or _holds(stems[0], stems[1])):
        return 1, len(min(stems, key=len))
    return ()


def _holds(text: str, word: str) -> bool:
    return re.search(rf"(?<![^\W_]){re.escape(word)}(?![^\W_])|^{re.escape(word)}dlc", text) is not None

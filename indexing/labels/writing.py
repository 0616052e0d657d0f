"""Write labels: into a file of their own, or into a tier of their own beside those of a person."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from indexing.labels.detect import registered_formats
from indexing.labels.format import LabelFormat, Target
from indexing.labels.label import Label
from indexing.labels.media import base_name, same_recording
from indexing.opening import count, error, is_regular, listing, shown

FILMS = (".mp4", ".mov", ".avi", ".mkv", ".webm", ".m4v", ".mpg", ".mpeg", ".wmv", ".wav")
"""What annotation programs play."""
UNPRINTABLE = re.compile("[\x00-\x08\x0b\x0c\x0e-\x1f\ud800-\udfff\ufffe\uffff]")  # what XML has no way to write


def write_labels(
    path: str | Path,
    labels: Sequence[Label],
    *,
    recording: str | Path | None = None,
    duration: float | None = None,
    fps: float | None = None,
    into: str | Path | None = None,
    tier: str = "dyntorch",
    annotator: str = "",
    media: str | None = None,
    format: str | None = None,  # noqa: A002
    dry: bool = False,
) -> list[str]:
    """Write labels, of a program or a person.

    Where an ELAN file or a BORIS project is there already, labels go into a tier or an observation of their own in it; what a
    person made stays as it is, and what dyntorch wrote under the same name is replaced, unless somebody has changed it since: then
    nothing is written.  Other files are written anew.

    Args:
        path: its suffix says what is written: ``.boris``, ``.eaf``, ``.csv``, ``.tsv``, ``.json`` (ActivityNet).
        labels: of one recording, or of several that their ``media`` name (ELAN: of one).  Those with a ``tier`` (ELAN) or an
            ``observation`` (BORIS) of their own keep it.
        recording: the video that labels without ``media`` are of, or its keypoints with the video beside them; written also where
            there is no label.
        duration, fps: of the recording, in seconds and frames per second; Label Studio cannot do without ``fps``.
        into: another ``.eaf`` or ``.boris`` whose content is taken over, instead of that of ``path``.
        tier: how the tier (ELAN) or the observation (BORIS) is called.
        annotator: who or what found them, for formats that ask.
        media: how the file that is there calls the recording, where its name is another one there.
        format: ``"boris"``, ``"elan"``, ``"csv"``, ``"tsv"``, ``"activitynet"``, ``"label_studio"`` or ``"via"``; by default the
            suffix decides.
        dry: write nothing; what would be refused is.

    Returns:
        what the format does not keep of these labels, a sentence each.

    Raises:
        ValueError: one line with the file, what is wrong and what to do; a file that is there is then as it was.

    Example:
        >>> import pathlib, tempfile
        >>> from indexing.labels import read_labels
        >>> path = pathlib.Path(tempfile.mkdtemp()) / "found.boris"
        >>> write_labels(path, [Label(1.5, 4.0, "squat", score=4.4)], recording="session.mp4", duration=60)
        []
        >>> read_labels(path, recording="session.json")
        [Label(1.5, 4.0, 'squat', media='session.mp4', observation='dyntorch session.mp4', score=4.4)]
    """
    target = Path(path)
    name, known = _format(target, format)
    _check(target, duration, fps, tier)
    source = _source(target, into, known)
    own = str(recording) if recording is not None else ""
    if own:  # labels may name the video, and the recording be its keypoints
        own = next(
            (label.media for label in labels if label.media and same_recording(label.media, own)), _find_video(own, target, name)
        )
    sound, notices = _clean_labels(labels, own)
    if own and known.program and source is None and Path(own).suffix.lower() not in FILMS:
        notices.append(f"{base_name(own)} is no video: {known.program} asks for one when you open {target.name}")
    recordings = dict.fromkeys(([own] if own else []) + [label.media for label in sound])
    if (dry and not known.program) or known.write is None:
        return notices
    where = Target(target, tuple(recordings), source, tier, duration, fps, annotator, media, dry, name)
    return notices + known.write(sound, where)


def _format(path: Path, name: str | None) -> tuple[str, LabelFormat]:
    """What is written."""
    written = {each: (suffix, known) for known in registered_formats().values() for each, suffix in known.written.items()}
    if name is not None and name not in written:
        raise error(path, f"unknown format={shown(name)}", f"use one of {', '.join(sorted(written))}")
    if name is None:
        name = next((each for each, (suffix, _) in written.items() if suffix and suffix == path.suffix.lower()), None)
    if name is None:
        suffixes = sorted(suffix for suffix, _ in written.values() if suffix)
        said = f"the suffix {path.suffix!r} does not say which format to write"
        raise error(path, said, f"end the name in one of {', '.join(suffixes)}, or give format=")
    return name, written[name][1]


def _check(path: Path, duration: float | None, fps: float | None, tier: str) -> None:
    for what, value in (("duration", duration), ("fps", fps)):
        if value is not None and not 0 < value < math.inf:
            raise error(path, f"{what}={shown(value)} cannot be", "give a positive number, or leave it out")
    if not tier.strip() or not tier.isprintable():
        raise error(path, f"tier={shown(tier)} is no name", "give a name of letters")


def _source(path: Path, into: str | Path | None, known: LabelFormat) -> Path | None:
    """The file whose content is taken over, if any."""
    if into is not None and not known.program:
        kept = [suffix for each in registered_formats().values() if each.program for suffix in each.written.values()]
        raise error(path, f"labels cannot be written beside those of {into}", f"write {listing(kept)}")
    if into is not None:
        return Path(into)
    return path if known.program and is_regular(path) else None


def _find_video(recording: str, target: Path, name: str) -> str:
    """The video of a recording, where it lies beside it, as the format names it: BORIS looks for it from where its project is."""
    path = Path(os.path.expanduser(recording))
    if not path.name:
        return recording
    if path.suffix.lower() not in FILMS:
        path = next((film for film in map(path.with_suffix, FILMS) if is_regular(film)), path)
        if path.suffix.lower() not in FILMS:
            return recording
    if name != "boris" or not is_regular(path):
        return str(path)
    film, folder = path.absolute(), target.absolute().parent
    return film.relative_to(folder).as_posix() if film.is_relative_to(folder) else str(film)


def _clean_labels(labels: Sequence[Label], recording: str) -> tuple[list[Label], list[str]]:
    """Labels in characters that every format can write, each with its recording."""
    found, changed = [], 0
    named = [label for label in labels if label.label.strip()]
    for label in named:
        texts = {name: getattr(label, name) for name in ("label", "subject", "media", "tier", "observation", "comment")}
        sound: dict[str, Any] = {name: UNPRINTABLE.sub("\ufffd", text) for name, text in texts.items()}
        modifiers = tuple(UNPRINTABLE.sub("\ufffd", part) for part in label.modifiers)
        changed += sound != texts or modifiers != label.modifiers
        sound |= {"media": sound["media"] or recording, "modifiers": modifiers}
        sound |= {name: sound[name].strip() for name in ("label", "subject", "tier", "observation")}
        found.append(replace(label, **sound))
    nameless = len(labels) - len(named)
    notices = [f"{count(nameless, 'label')} without a name left out"] * bool(nameless)
    return found, notices + [f"control characters in {count(changed, 'label')} became \ufffd"] * bool(changed)

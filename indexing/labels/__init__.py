"""What people mark in recordings, and what was found there: files of BORIS, ELAN, Label Studio, VIA, ActivityNet, and tables.

The verbs are here; ``label`` is what all share (:class:`Label`, :class:`LabelFile`, :func:`within`).  A format is a file or room in
``formats/`` and registers itself there as ``format.LabelFormat``; ``format`` asks the formats whose a file is, and knows which file
of the labels is which recording and whose clock runs when.  ``markup`` reads XML that may be hostile.
"""

from __future__ import annotations

import math
import os
import re
import warnings
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from indexing.labels.format import (
    LabelFormat,
    Request,
    Target,
    base_name,
    detect,
    list_few,
    of_recording,
    registered_formats,
    same_recording,
)
from indexing.labels.label import Label, LabelFile, within
from indexing.opening import count, error, is_regular, listing, quote, without_garbage_collection

__all__ = ["Label", "LabelFile", "choose_labels", "open_labels", "read_labels", "within", "write_labels"]

FILMS = (".mp4", ".mov", ".avi", ".mkv", ".webm", ".m4v", ".mpg", ".mpeg", ".wmv", ".wav")
"""What annotation programs play."""
UNPRINTABLE = re.compile("[\x00-\x08\x0b\x0c\x0e-\x1f\ud800-\udfff\ufffe\uffff]")  # what XML has no way to write


def open_labels(
    path: str | Path,
    *,
    recording: str | Path | None = None,
    media: str | None = None,
    observation: str | None = None,
    subject: str | None = None,
    tier: str | None = None,
    fps: float | None = None,
    format: str | None = None,  # noqa: A002  (the word users type)
) -> LabelFile:
    """All labels of a file, or those asked for, with notices of what was left out, dropped and assumed.

    Nothing is chosen where nothing is asked: then several observations stand beside each other, and detections beside labels;
    :func:`choose_labels` decides.

    Args:
        path: a BORIS project or one of its exported tables, ELAN, CSV or TSV, or JSON of ActivityNet, Label Studio or VIA.
        recording: the file that labels are wanted for, keypoints or video: labels of other media are left out (the names
            decide, see :func:`indexing.labels.format.of_recording`), and times are on the clock of this one, also where several
            files are played beside or after each other.
        media: the name that the recording has in the file, where it has another one there.
        observation, subject, tier: only those of this name.
        fps: frames per second of the recording, for files that count frames (Label Studio, tables with ``start_frame``).
        format: the name of a file in ``indexing/labels/formats``; by default the content decides.

    Returns:
        labels with times in seconds on the clock of the file that each is of.

    Raises:
        ValueError: one line with the file, the place in it, what is wrong and what to do.

    Example:
        >>> import pathlib, tempfile
        >>> path = pathlib.Path(tempfile.mkdtemp()) / "labels.csv"
        >>> _ = path.write_text("label,start,end,person\\nsquat,1.5,4,Ann\\n,5,6,Ann\\n")
        >>> found = open_labels(path)
        >>> found.labels, found.subjects
        ((Label(1.5, 4.0, 'squat', subject='Ann'),), ('Ann',))
        >>> found.notices
        ('1 label without a name left out ((no name) at 5-6 s)',)
    """
    if format is not None and format not in registered_formats():
        names = ", ".join(sorted(registered_formats()))
        raise error(path, f"unknown format={quote(format)}", f"use one of {names}, or leave it out to detect it")
    if fps is not None and not 0 < fps < math.inf:
        raise error(path, f"fps={quote(fps)} is no frame rate", "give frames per second, such as 29.97")
    asked = Request(Path(path), recording, media, observation, subject, tier, fps)
    with without_garbage_collection():
        detected, data = detect(asked.path)
        if format is not None and format != detected:
            raise error(path, f"is of the format {detected!r}, not {format!r}", "leave format= out to detect it")
        return _select_requested(registered_formats()[detected].read(data, asked), asked)


def choose_labels(file: LabelFile) -> LabelFile:
    """The labels of one hand: those of people where a program's stand beside them, of the one observation that there is.

    Raises:
        ValueError: labels of several observations, of which somebody has to choose one.

    Example:
        >>> from pathlib import Path
        >>> labels = (Label(0, 1, "squat", observation="Ann"), Label(0, 2, "squat", observation="Ben"))
        >>> choose_labels(LabelFile(Path("a.boris"), "boris", labels))
        Traceback (most recent call last):
            ...
        ValueError: a.boris: has labels of 2 observations (Ann, Ben); choose one (--observation NAME)
    """
    labels, notices = list(file.labels), list(file.notices)
    programs = set(file.machine)
    people = [label for label in labels if not programs & {label.observation, label.tier}]
    if people and len(people) < len(labels):
        names = [name for name in file.machine if any(name in (label.observation, label.tier) for label in labels)]
        verb = "--tier" if any(label.tier in names for label in labels) else "--observation"
        left = count(len(labels) - len(people), "label")
        notices.append(f"{left} left out: a program found them ({listing(names)}); {verb} NAME reads them")
        labels = people
    observations = list(dict.fromkeys(label.observation for label in labels))
    if len(observations) > 1:
        message = f"has labels of {len(observations)} observations ({listing(observations)})"
        raise error(file.path, message, "choose one (--observation NAME)")
    tiers = list(dict.fromkeys(label.tier for label in labels))
    if len(tiers) > 1:
        notices.append(f"labels of {len(tiers)} tiers are taken together ({listing(tiers)}); --tier NAME takes one")
    return replace(file, labels=tuple(labels), notices=tuple(notices))


def read_labels(path: str | Path, **selection: Any) -> list[Label]:
    """The labels of one hand, sorted by start: what is to be learned from, or compared with.

    The arguments are those of :func:`open_labels`.  What was left out or assumed is said as Python warnings; to have it as text,
    call :func:`choose_labels` on what :func:`open_labels` finds.

    Raises:
        ValueError: as :func:`open_labels` and :func:`choose_labels`.

    Example:
        >>> import pathlib, tempfile
        >>> path = pathlib.Path(tempfile.mkdtemp()) / "labels.csv"
        >>> _ = path.write_text("label,start,end\\nsquat,1.5,4\\nclap,0.5,0.5\\n")
        >>> read_labels(path)
        [Label(0.5, 0.5, 'clap'), Label(1.5, 4.0, 'squat')]
    """
    file = choose_labels(open_labels(path, **selection))
    for notice in file.notices:
        warnings.warn(f"{path}: {notice}", UserWarning, stacklevel=2)
    return list(file.labels)


def _select_requested(file: LabelFile, asked: Request) -> LabelFile:
    """The labels of the recording, observation, subject and tier that somebody asked for."""
    labels: Iterable[Label] = file.labels
    notices = list(file.notices)
    for what, wanted, known in (
        ("observation", asked.observation, file.observations),
        ("tier", asked.tier, file.tiers),
        ("subject", asked.subject, file.subjects),
    ):
        if wanted is not None:
            if wanted not in known:
                raise error(asked.path, f"has no {what} {quote(wanted)}, only {listing(known)}", f"give one of these (--{what})")
            labels = [label for label in labels if getattr(label, what) == wanted]
    mine = of_recording(file.media, asked)
    names = [name for name in (asked.observation, asked.tier) if name is not None]
    watched = (one for one in file.watched if (not names or one[0] in names) and (mine is None or one[1] in mine))
    if mine is not None:
        others = Counter(label.media for label in labels if label.media and label.media not in mine)
        labels = [label for label in labels if not label.media or label.media in mine]
        if others:
            total = sum(others.values())
            notices.append(f"{count(total, 'label')} left out: of other recordings ({list_few(others)})")
    return replace(file, labels=tuple(labels), watched=tuple(watched), notices=tuple(notices))


# ---- writing -----------------------------------------------------------------------------------------------------------
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
    video = str(recording) if recording is not None else ""
    if video:  # labels may name the video, and the recording be its keypoints
        named = (label.media for label in labels if label.media and same_recording(label.media, video))
        video = next(named, _find_video(video, target, name))
    sound, notices = _clean_labels(labels, video)
    if video and known.program and source is None and Path(video).suffix.lower() not in FILMS:
        notices.append(f"{base_name(video)} is no video: {known.program} asks for one when you open {target.name}")
    recordings = dict.fromkeys(([video] if video else []) + [label.media for label in sound])
    if (dry and not known.program) or known.write is None:
        return notices
    where = Target(target, tuple(recordings), source, tier, duration, fps, annotator, media, dry, name)
    return notices + known.write(sound, where)


def _format(path: Path, name: str | None) -> tuple[str, LabelFormat]:
    """What is written."""
    written = {each: (suffix, known) for known in registered_formats().values() for each, suffix in known.written.items()}
    if name is not None and name not in written:
        raise error(path, f"unknown format={quote(name)}", f"use one of {', '.join(sorted(written))}")
    if name is None:
        name = next((each for each, (suffix, _) in written.items() if suffix and suffix == path.suffix.lower()), None)
    if name is None:
        suffixes = sorted(suffix for suffix, _ in written.values() if suffix)
        message = f"the suffix {path.suffix!r} does not say which format to write"
        raise error(path, message, f"end the name in one of {', '.join(suffixes)}, or give format=")
    return name, written[name][1]


def _check(path: Path, duration: float | None, fps: float | None, tier: str) -> None:
    for what, value in (("duration", duration), ("fps", fps)):
        if value is not None and not 0 < value < math.inf:
            raise error(path, f"{what}={quote(value)} cannot be", "give a positive number, or leave it out")
    if not tier.strip() or not tier.isprintable():
        raise error(path, f"tier={quote(tier)} is no name", "give a name of letters")


def _source(path: Path, into: str | Path | None, known: LabelFormat) -> Path | None:
    """The file whose content is taken over, if any."""
    if into is not None and not known.program:
        suffixes = [suffix for each in registered_formats().values() if each.program for suffix in each.written.values()]
        raise error(path, f"labels cannot be written beside those of {into}", f"write {listing(suffixes)}")
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
    cleaned, changed = [], 0
    named = [label for label in labels if label.label.strip()]
    for label in named:
        texts = {name: getattr(label, name) for name in ("label", "subject", "media", "tier", "observation", "comment")}
        sound: dict[str, Any] = {name: UNPRINTABLE.sub("\ufffd", text) for name, text in texts.items()}
        modifiers = tuple(UNPRINTABLE.sub("\ufffd", part) for part in label.modifiers)
        changed += sound != texts or modifiers != label.modifiers
        sound |= {"media": sound["media"] or recording, "modifiers": modifiers}
        sound |= {name: sound[name].strip() for name in ("label", "subject", "tier", "observation")}
        cleaned.append(replace(label, **sound))
    nameless = len(labels) - len(named)
    notices = [f"{count(nameless, 'label')} without a name left out"] * bool(nameless)
    return cleaned, notices + [f"control characters in {count(changed, 'label')} became \ufffd"] * bool(changed)

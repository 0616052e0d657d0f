"""Read a file of labels: its format by what it holds, its labels by recording, observation, subject and tier."""

from __future__ import annotations

import math
import warnings
from collections import Counter
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

from indexing.labels.detect import detect, registered_formats
from indexing.labels.format import Request, list_few
from indexing.labels.label import Label, LabelFile
from indexing.labels.media import of_recording
from indexing.opening import count, error, listing, shown, without_garbage_collection


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
            decide, see :func:`indexing.labels.media.of_recording`), and times are on the clock of this one, also where several
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
        raise error(path, f"unknown format={shown(format)}", f"use one of {names}, or leave it out to detect it")
    if fps is not None and not 0 < fps < math.inf:
        raise error(path, f"fps={shown(fps)} is no frame rate", "give frames per second, such as 29.97")
    asked = Request(Path(path), recording, media, observation, subject, tier, fps)
    with without_garbage_collection():
        detected, data = detect(asked.path)
        if format is not None and format != detected:
            said = f"is of the format {detected!r}, not {format!r}"
            raise error(path, said, "leave format= out to detect it")
        return _asked_for(registered_formats()[detected].read(data, asked), asked)


def choose_labels(found: LabelFile) -> LabelFile:
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
    labels, notices = list(found.labels), list(found.notices)
    programs = set(found.machine)
    people = [label for label in labels if not programs & {label.observation, label.tier}]
    if people and len(people) < len(labels):
        names = [name for name in found.machine if any(name in (label.observation, label.tier) for label in labels)]
        verb = "--tier" if any(label.tier in names for label in labels) else "--observation"
        notices.append(
            f"{count(len(labels) - len(people), 'label')} left out: a program found them ({listing(names)}); {verb} NAME reads them"
        )
        labels = people
    observations = list(dict.fromkeys(label.observation for label in labels))
    if len(observations) > 1:
        said = f"has labels of {len(observations)} observations ({listing(observations)})"
        raise error(found.path, said, "choose one (--observation NAME)")
    tiers = list(dict.fromkeys(label.tier for label in labels))
    if len(tiers) > 1:
        notices.append(f"labels of {len(tiers)} tiers are taken together ({listing(tiers)}); --tier NAME takes one")
    return replace(found, labels=tuple(labels), notices=tuple(notices))


def read_labels(
    path: str | Path,
    *,
    recording: str | Path | None = None,
    media: str | None = None,
    observation: str | None = None,
    subject: str | None = None,
    tier: str | None = None,
    fps: float | None = None,
    format: str | None = None,  # noqa: A002
) -> list[Label]:
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
    found = choose_labels(
        open_labels(
            path,
            recording=recording,
            media=media,
            observation=observation,
            subject=subject,
            tier=tier,
            fps=fps,
            format=format,
        )
    )
    for notice in found.notices:
        warnings.warn(f"{path}: {notice}", UserWarning, stacklevel=2)
    return list(found.labels)


def _asked_for(found: LabelFile, asked: Request) -> LabelFile:
    """The labels of the recording, observation, subject and tier that somebody asked for."""
    labels: Iterable[Label] = found.labels
    notices = list(found.notices)
    for what, wanted, known in (
        ("observation", asked.observation, found.observations),
        ("tier", asked.tier, found.tiers),
        ("subject", asked.subject, found.subjects),
    ):
        if wanted is not None:
            if wanted not in known:
                raise error(asked.path, f"has no {what} {shown(wanted)}, only {listing(known)}", f"give one of these (--{what})")
            labels = [label for label in labels if getattr(label, what) == wanted]
    mine = of_recording(found.media, asked)
    names = [name for name in (asked.observation, asked.tier) if name is not None]
    watched = (one for one in found.watched if (not names or one[0] in names) and (mine is None or one[1] in mine))
    if mine is not None:
        others = Counter(label.media for label in labels if label.media and label.media not in mine)
        labels = [label for label in labels if not label.media or label.media in mine]
        if others:
            total = sum(others.values())
            notices.append(f"{count(total, 'label')} left out: of other recordings ({list_few(others)})")
    return replace(found, labels=tuple(labels), watched=tuple(watched), notices=tuple(notices))

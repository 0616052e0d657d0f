"""What commands read: example clips as ``label=file``, recordings and known events."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Hashable, Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

from dyntorch.numerics import with_words
from indexing.cli.console import count, flag_words, names
from indexing.cli.flags.shared import Example, Reading, Watched
from indexing.cli.protocol import choose
from indexing.cli.videos import find_keypoints
from indexing.clip import Clip, ClipSet, FloatArray, stretches
from indexing.joints import layout_of, match_joints
from indexing.readers import read
from indexing.readers.recording import NobodySeen
from indexing.recordings.people import Appearance, Crowd, of_recording, tracked_people
from indexing.remarks import FOLLOWED, describe_issues
from indexing.skeleton import Skeleton
from indexing.sync.people import jumps
from indexing.windows import describe_unusable

TRIM = re.compile(r"(?P<path>.+)@(?P<start>\d+(\.\d*)?|\.\d+)?-(?P<end>\d+(\.\d*)?|\.\d+)?")
CUT = 0.1  # seconds that an example may end before it was said to: nobody counts frames
KnownEvent = tuple[Hashable, float, float]


def watch_videos(reading: Reading, paths: Iterable[Path], beside: Path | None) -> Reading:
    """The same, with the keypoints of all videos among some inputs found, and kept beside the output."""
    return replace(reading, watched=find_keypoints(reading.footage, paths, beside, reading.fps))


def read_clips(reading: Reading, path: Path, label: str | None = None) -> ClipSet:
    """All clips of a file or folder: here alone paths become clips."""
    refuse_range(path)
    source = reading.watched.files.get(path, path)
    if isinstance(source, ValueError):
        raise source
    if source != path:  # keypoints of a video go by the name of the video
        plain_reading = replace(reading, watched=Watched({}), size=None, fps=None)
        return _rename_clips(read_clips(plain_reading, source, label), source, path)
    try:
        return read(
            path, format=reading.format, fps=reading.fps, person=reading.person, min_confidence=reading.min_confidence, label=label,
            size=reading.size, layout=reading.layout,
        )  # fmt: skip
    except ValueError as problem:
        if type(problem) is not ValueError:
            raise  # nobody is in view, which some commands say in their own way
        raise ValueError(with_words(problem, WORDS)) from None


def _rename_clips(clips: ClipSet, old: Path, new: Path) -> ClipSet:
    return type(clips)([clip.replace(name=new.name + clip.name.removeprefix(old.name)) for clip in clips], new.name)


@dataclass(frozen=True, eq=False)
class Lane:
    """What is scanned by itself: one person of a recording."""

    name: str
    person: str
    clip: Clip | None
    times: FloatArray


def parse_example(text: str) -> Example:
    """``label=file``, ``label=file@1.5-4`` (seconds; an end may be left open) or ``set.npz``."""
    label, equals, rest = text.partition("=")
    if not equals or (Path(text).expanduser().exists() and not _trim_text(rest).path.expanduser().exists()):
        return _trim_text(text)
    if not label.strip() or not rest:
        raise ValueError(f"example {text!r}: expected label=file, such as squat=a.json; give both the label and the file")
    example = _trim_text(rest)
    if "=" in rest and not example.path.expanduser().exists() and Path(file := rest.rpartition("=")[2]).expanduser().exists():
        raise ValueError(f"example {text!r}: two labels for {file}; give one, as in {label.strip()}={file}")
    return Example(example.path, label.strip(), example.start, example.end)


def _trim_text(text: str) -> Example:
    match = TRIM.fullmatch(text)
    if Path(text).expanduser().exists():
        return Example(Path(text))
    if match is None or match["start"] == match["end"] is None:
        file, at, seconds = text.rpartition("@")
        if at and Path(file).expanduser().exists():
            raise ValueError(f"example {text!r}: @{seconds} is no range; write @start-end in seconds, such as @1.5-4, @1.5- or @-4")
        return Example(Path(text))
    start, end = (None if value is None else float(value) for value in (match["start"], match["end"]))
    if start is not None and end is not None and not start < end:
        raise ValueError(f"example {text!r}: it ends at {end:g} s, but starts at {start:g} s; write file@start-end in seconds")
    return Example(Path(match["path"]), None, start, end)


def refuse_range(path: Path) -> None:
    """Raise where a path that is not there ends in seconds: these are for examples, and all of a recording is looked at."""
    file, at, seconds = str(path).rpartition("@")
    if at and not path.expanduser().exists() and Path(file).expanduser().exists():
        raise ValueError(f"{path}: seconds (@{seconds}) are for examples, and recordings are read as a whole; give {file}")


def camera_numbers(flag: str, given: str | None, cameras: int | None) -> list[float | None]:
    """One positive number for each camera, ``None`` where nothing was given; checked without a number of cameras."""
    if given is None:
        return [None] * (cameras or 0)
    try:
        values: list[float | None] = [float(word) for word in given.split(",")]
    except ValueError:
        values = []
    if not values or not all(value is not None and 0 < value < math.inf for value in values):
        unit, example = ("frames per second", "60,59.94") if flag == "fps" else ("pixels", "1510,1495,1502")
        raise ValueError(f"--{flag} must be a positive number of {unit}, or one per camera as in {example}, got {given}")
    if cameras is not None and len(values) not in (1, cameras):
        raise ValueError(f"--{flag} gives {len(values)} numbers for {cameras} cameras; give one, or one per camera")
    return values * ((cameras or 1) if len(values) == 1 else 1)


def read_examples(examples: Sequence[Example], reading: Reading, select: Sequence[str]) -> tuple[list[Clip], list[str]]:
    """Labelled clips, and what a person should know about them."""
    clips: list[Clip] = []
    notes: list[str] = []
    guessed: list[Clip] = []
    for example in examples:
        found = read_clips(reading, example.path, example.label)
        is_set = example.label is None
        if is_set and all(clip.label is None for clip in found):
            raise ValueError(
                f"{example.path}: says nothing of the action; give it with its label, as in squat={example.path}"
                + (", or save 'action' in the clip set" if example.path.suffix == ".npz" else "")
            )
        if is_set and select:
            found = found[choose(found, select, "--select")]
        if example.start is not None or example.end is not None:
            found, cut = crop_example(found, example)
            notes += cut
        if is_set or len(found) > 1:
            found, left_out = usable(found, example.path)
            notes += left_out
        if is_set:
            notes += assumed_rate_notes(found, example.path)
        else:
            guessed += found
        own, said = of_layout(_check_clips(found, example.path), layout_of([*clips, *found]), example.path)
        notes += said
        clips += own
        first, last = clips[0].joints.shape[1], clips[-1].joints.shape[1]
        if first != last:
            raise ValueError(
                f"{example.path}: has {last} joints, but {examples[0].path} has {first}; use one pose estimator and joint layout"
            )
    return clips, notes + assumed_rate_notes(guessed) + clip_notes(clips, reading) + on_examples(clips) + on_overlaps(examples)


def of_layout(clips: Sequence[Clip], known: Skeleton | None, path: Path) -> tuple[list[Clip], list[str]]:
    """Clips with their joints in the order of those known, and a note where not all are used or nobody knows which is which."""
    matched = [match_joints(clip, known, str(path)) for clip in clips]
    return [clip for clip, _ in matched], list(dict.fromkeys(note for _, note in matched if note))


def crop_example(clips: ClipSet, example: Example) -> tuple[ClipSet, list[str]]:
    """The seconds that count, and a note where the recording does not have all of them."""
    start, end = example.start if example.start is not None else -math.inf, example.end if example.end is not None else math.inf
    cropped = ClipSet((clip.between(start, end) for clip in clips), clips.name)
    alone = [clip for clip in cropped if len(clip) == 1]
    if alone and len(alone) == len(cropped):
        raise ValueError(
            f"{_range_text(example)}: one frame only lies in these seconds ({alone[0].times[0]:.6g} s); give more of them"
        )
    short = [clip for clip in clips if on_range(example, clip.times[0], clip.times[-1])]
    if not short:
        return cropped, []
    left = f"{cropped[0].duration:.3g} s of it" if len(clips) == 1 else "the rest of it"
    return cropped, [f"{said}; {left} is used" for said in on_range(example, short[0].times[0], short[0].times[-1])]


def on_range(example: Example, first: float, last: float) -> list[str]:
    """On an example whose seconds lie beyond its recording, keypoints or video, which runs from ``first`` to ``last``."""
    early = example.start is not None and example.start < first - CUT
    late = example.end is not None and last + CUT < example.end
    return [f"{_range_text(example)}: the recording runs from {first:.6g} to {last:.6g} s"] if early or late else []


def on_overlaps(examples: Sequence[Example]) -> list[str]:
    """On seconds of one file, keypoints or video, that are given to two actions."""
    notes = []
    files: dict[Path, list[Example]] = {}
    for example in examples:
        if example.label is not None:
            files.setdefault(example.path.expanduser().resolve(), []).append(example)
    for one, other in (pair for same in files.values() for pair in combinations(same, 2)):
        start = max(one.start or 0.0, other.start or 0.0)
        end = min(math.inf if one.end is None else one.end, math.inf if other.end is None else other.end)
        if one.label != other.label and end - start > CUT:
            if (one.start, one.end) == (other.start, other.end):
                raise ValueError(
                    f"{one.path}: is given as {one.label} and as {other.label}; correct a label, or give the seconds of each"
                )
            when = f"{start:g} s to the end" if end == math.inf else f"{start:g} to {end:g} s"
            notes.append(
                f"{one.path}: {when} count both as {one.label} and as {other.label}; correct the ranges if they do not overlap"
            )
    return first_sentences(notes)


def _range_text(example: Example) -> str:
    start, end = ("" if value is None else f"{value:g}" for value in (example.start, example.end))
    return f"{example.path}@{start}-{end}"


def _check_clips(clips: Sequence[Clip], path: Path) -> list[Clip]:

    for clip in clips:
        reason = describe_unusable(clip)
        if reason and len(clip) == 1 and path.suffix.lower() == ".json" and path.is_file():
            raise ValueError(
                f"{path}: {reason}; leave it out, or give the folder {path.parent} if every frame is a file of its own"
            )
        if reason:
            raise ValueError(f"{path}: {reason}; leave it out or record it again")
    return list(clips)


def usable(clips: ClipSet, path: Path) -> tuple[ClipSet, list[str]]:
    """The clips with a label that can be compared, and a note on those left out."""
    reasons = [describe_unusable(clip) or ("its action is not known" if clip.label is None else None) for clip in clips]
    bad = [i for i, reason in enumerate(reasons) if reason]
    if not bad:
        return clips, []
    first = f"{clips[bad[0]].name}: {reasons[bad[0]]}"
    if len(bad) == len(clips):
        raise ValueError(f"{path}: none of its {count(len(clips), 'clip')} can be used; the first, {first}")
    return clips[np.setdiff1d(np.arange(len(clips)), bad)], [f"{count(len(bad), 'clip')} of {path} left out; the first, {first}"]


def assumed_rate_notes(clips: Sequence[Clip], path: Path | None = None) -> list[str]:
    """A note on clips whose frame rate nobody said: the names of recordings, or the number of clips of a set."""
    assumed = [clip.name for clip in clips if clip.fps_assumed]
    who = names(list(dict.fromkeys(assumed))) if path is None else f"{count(len(assumed), 'clip')} of {path}"
    return [f"30 frames per second assumed for {who}; --fps says otherwise"] if assumed else []


def read_recordings(
    paths: Sequence[Path], reading: Reading, joints: int, model: Path, skeleton: Skeleton | None = None
) -> tuple[list[Lane], list[str]]:
    """Recordings with names that differ, person by person, checked against the model, and what a reader should know about
    them."""
    lanes_of_files: list[list[Lane]] = []
    notes: list[str] = []
    for path in paths:
        lanes, said = lanes_of(path, reading)
        lanes, more = lanes_in_layout(lanes, skeleton, path)
        notes += said + more
        for clip in _check_clips([lane.clip for lane in lanes if lane.clip is not None], path):
            if clip.joints.shape[1] != joints:
                raise ValueError(
                    f"{path}: has {clip.joints.shape[1]} joints, but the model {model} was learned from clips with {joints}; "
                    "actions are compared joint by joint: use the same pose estimator and joint layout for both"
                )
        lanes_of_files.append(lanes)
    lanes = _distinguish_names(paths, lanes_of_files)
    clips = [lane.clip for lane in lanes if lane.clip is not None]
    alone = [clip for clip in clips if "followed" not in clip.meta or clip.meta.get("person") is None]
    return lanes, notes + clip_notes(clips, reading) + on_gaps(alone) + assumed_rate_notes(clips)


def lanes_in_layout(lanes: Sequence[Lane], known: Skeleton | None, path: Path) -> tuple[list[Lane], list[str]]:
    """The lanes of a file with their joints as :func:`of_layout` has them."""
    clips, notes = of_layout([lane.clip for lane in lanes if lane.clip is not None], known, path)
    same = iter(clips)
    return [replace(lane, clip=None if lane.clip is None else next(same)) for lane in lanes], notes


def _distinguish_names(paths: Sequence[Path], found: Sequence[Sequence[Lane]]) -> list[Lane]:
    """All lanes, under names that tell recordings apart: those that are equal get their path."""
    owners = {(lane.name, i, 0 if lane.person else j) for i, lanes in enumerate(found) for j, lane in enumerate(lanes)}
    times = Counter(name for name, *_ in owners)
    out = []
    for path, lanes in zip(paths, found, strict=True):
        several = len(lanes) > 1
        for lane in lanes:
            longer = f"{path} {lane.name}" if several and not lane.person else str(path)
            out.append(lane if times[lane.name] == 1 else replace(lane, name=longer))
    return out


def lanes_of(path: Path, reading: Reading) -> tuple[list[Lane], list[str]]:
    """What one file holds, person by person, or recording by recording."""
    name = path.name or path.resolve().name
    try:
        clips = list(read_clips(reading, path))
    except NobodySeen as nobody:
        rate = 30.0 if reading.fps is None else reading.fps
        times = nobody.frames / rate if nobody.times is None else nobody.times
        return [Lane(name, "", None, times)], [f"{path}: nobody is in view in any of its {count(len(times), 'frame')}"]
    if of_recording(clips):
        crowd = tracked_people(clips, name)
        times = np.unique(np.concatenate([clip.times for clip in clips]))
        lanes = [Lane(name, who.name, who.clip, who.clip.times) for who in crowd.people] or [Lane(name, "", None, times)]
        return lanes, on_people(name, crowd)
    if len(clips) == 1:  # a recording goes by its file, not by what a set calls its only clip
        clips = [clips[0].replace(name=name)]
    empty = [clip.name for clip in clips if not clip.seen.any()]
    notes = [f"{path}: nobody is in view in any frame" + (f" of {names(empty)}" if len(clips) > 1 else "")] if empty else []
    return [Lane(clip.name, "", clip if clip.seen.any() else None, clip.times) for clip in clips], notes


def on_truth(truth: Sequence[Sequence[KnownEvent] | None], recordings: Sequence[Any]) -> list[str]:
    """On known events that the recordings do not show; of videos that is not known before they are read."""
    notes = []
    for one, events in zip(recordings, truth, strict=True):
        if not isinstance(one, Lane):
            continue
        out = [event for event in events or [] if event[2] < one.times[0] or event[1] > one.times[-1]]
        if out:
            label, start, end = out[0]
            first = f"{label} at {start:g} to {end:g} s" + ", ..." * (len(out) > 1)
            who = f"{one.name}, person {one.person}," if one.person else one.name
            runs = f"{who} runs from {one.times[0]:.6g} to {one.times[-1]:.6g} s"
            notes.append(f"{runs}: {count(len(out), 'known event')} outside of it cannot be found ({first})")
    return notes


# ----------------------------------------------------------------------------------------------------------------------
# What a person should know of the clips that were read: a sentence each, and nothing where all is as it should be.

SLOW, FAST = 5.0, 480.0  # frames per second given by hand, beyond which they are mentioned
STILL = 0.005  # of a body's size: joints that stay this close to their places do not move
LISTED = 3  # moments, and names of joints
WORDS = flag_words("fps", "person", "min_confidence", "format", "layout", size="--size W H")


def clip_notes(clips: Sequence[Clip], reading: Reading) -> list[str]:
    """On clips of any use: who is in them, in which units, and at which rate."""
    notes = [*_people(clips, reading), *(with_words(one, WORDS) for one in describe_issues(clips, reading.size is not None))]
    if reading.fps is not None and not SLOW <= reading.fps <= FAST and clips:
        length = max(clip.duration for clip in clips)
        notes.append(f"--fps {reading.fps:g}: the longest clip lasts {length:.3g} s then; is that so?")
    return notes


def on_examples(clips: Sequence[Clip]) -> list[str]:
    """On clips to learn from."""
    still = [clip.name for clip in clips if _is_still(clip)]
    notes = [f"{names(list(dict.fromkeys(still)))}: nobody moves there; a pose is learned, not an action"] if still else []
    lost: dict[int, list[str]] = {}
    for clip in clips:
        lost.setdefault(int((~clip.seen.any(axis=0)).sum()), []).append(clip.name)
    notes += [
        f"{missing} of {count(clips[0].joints.shape[1], 'joint')} are never seen in {names(list(dict.fromkeys(which)))}; what they "
        "do is not learned"
        for missing, which in sorted(lost.items())
        if missing
    ]
    return [*notes, *on_classes([str(clip.label) for clip in clips])]


def on_classes(labels: Sequence[str]) -> list[str]:
    """On what a model can tell apart."""
    actions = sorted(set(labels))
    if len(actions) != 2:
        return []
    return [
        f"{actions[0]} and {actions[1]} are all that is known, and most of a recording looks like one of two: "
        "add examples of ordinary movement, such as standing and walking about"
    ]


def on_gaps(clips: Sequence[Clip]) -> list[str]:
    """On recordings that pause."""
    notes = []
    for clip in clips:
        cuts = stretches(clip.times)
        if len(cuts) > 1:
            ends = [f"{clip.times[end - 1]:.6g}" for _, end in cuts[:-1].tolist()]
            listed = ", ".join(ends[:LISTED]) + " and more" * (len(ends) > LISTED)
            notes.append(f"{clip.name}: no frames for a while after {listed} s; its {len(cuts)} parts are searched by themselves")
    return notes


def on_people(name: str, crowd: Crowd) -> list[str]:
    """On who is in view, who comes and goes, and what was left out."""
    notes = []
    if len(crowd.people) > 1:
        how = "by the file's ids" if crowd.by_ids else "by position, as the file has no ids to rely on"
        notes.append(
            f"{len(crowd.people)} people in view, told apart {how}; each is scanned by itself; --person largest follows one"
        )
    if not crowd.people:
        notes.append("nobody is in view for long enough to be scanned")
    if crowd.ghosts:
        reasons = ", ".join(f"{number} {reason}" for reason, number in crowd.ghosts.items())
        notes.append(f"{count(sum(crowd.ghosts.values()), 'track')} left out, as of no person ({reasons})")
    if crowd.untracked:
        notes.append(f"{count(crowd.untracked, 'detection')} without an id left out; --person largest uses them")
    notes += first_sentences([_appears(one) for one in crowd.appearances])
    notes += first_sentences([_is_away(who, crowd) for who in dict.fromkeys(one.person for one in crowd.absences)])
    swapped = "change places at {:.2f} s; their ids may be swapped there"
    notes += first_sentences([f"persons {one.first} and {one.second} {swapped.format(one.at)}" for one in crowd.exchanges])
    return [f"{name}: {sentence}" for sentence in notes]


def _appears(one: Appearance) -> str:
    where = "where" if one.near else "elsewhere than"
    perhaps = "may be the same" if one.near else "may be the same or not"
    return f"person {one.person} appears at {one.at:.1f} s {where} person {one.left} left at {one.since:.1f} s: {perhaps}"


def _is_away(who: str, crowd: Crowd) -> str:
    spans = [f"{one.start:.1f} to {one.end:.1f} s" for one in crowd.absences if one.person == who]
    listed = ", ".join(spans[:LISTED]) + f" and {count(len(spans) - LISTED, 'time')} more" * (len(spans) > LISTED)
    if crowd.by_ids:
        return f"person {who} is out of view from {listed}; that it is the same person says the file's id"
    return f"nobody is in view from {listed}; whoever comes then may be somebody else"


def first_sentences(sentences: Sequence[str]) -> list[str]:
    """The first of many, and how many more there are."""
    more = len(sentences) - LISTED
    return [*sentences[:LISTED], *([f"and so {count(more, 'time')} more"] if more > 0 else [])]


def _people(clips: Sequence[Clip], reading: Reading) -> list[str]:

    notes = []
    for clip in clips:
        people = clip.meta.get("people")
        if people is None or reading.person not in FOLLOWED:
            continue
        moments = jumps(clip) if clip.dims == 2 else []
        listed = ", ".join(f"{moment:.2f}" for moment in moments[:LISTED]) + " and more" * (len(moments) > LISTED)
        where = f", somebody else from {listed} s on" if moments else ""
        notes.append(
            f"{clip.name}: {people} people in view; followed is {FOLLOWED[reading.person]}{where}; --person says otherwise"
        )
    return notes


def _is_still(clip: Clip) -> bool:

    seen = clip.joints[:, clip.seen.any(axis=0)]
    if len(seen) < 2:
        return False
    size = float(np.linalg.norm(np.nanmax(seen, axis=(0, 1)) - np.nanmin(seen, axis=(0, 1))))
    moved = np.nanmax(seen, axis=0) - np.nanmin(seen, axis=0)
    return bool(np.nanmax(np.linalg.norm(moved, axis=1)) <= STILL * size)

"""What people have marked, on the command line: whose the labels of a file are, as examples to learn from and as what is known."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from indexing.cli.console import check_file, count, names
from indexing.cli.flags.shared import Example, Labelling, Reading
from indexing.cli.inputs import KnownEvent, Lane, assumed_rate_notes, clip_notes, lanes_in_layout, lanes_of, on_examples
from indexing.clip import Clip
from indexing.files import prepare
from indexing.joints import layout_of
from indexing.labels import Label, LabelFile, choose_labels, open_labels, within, write_labels
from indexing.labels.format import Request, of_recording, registered_formats, same_recording
from indexing.opening import error, listing
from indexing.report import RecordingResult
from indexing.report.results import by_recording
from indexing.windows import describe_unusable

UNCONFIRMED = "?"
"""What a label begins with that was suggested, and that nobody has corrected."""


MIN_EXAMPLE_FRAMES = 4
"""Of fewer, nothing is left of a movement once it is resampled to 12 steps."""
MIN_BACKGROUND_SECONDS = 1.0
"""Between labels: people mark begins and ends some tenths of a second off, and what touches an action looks like it."""


def open_marked(labelling: Labelling, path: Path, recording: str | None, fps: float | None, **others: Any) -> LabelFile:
    """A file of labels, of which only those count that were asked for."""
    return open_labels(
        path.expanduser(),
        recording=recording,
        media=labelling.media,
        observation=labelling.observation,
        tier=labelling.tier,
        fps=fps,
        **others,
    )


def _why_nothing(notes: Sequence[str]) -> str:
    """Why there is no label: what was left out, where anything was."""
    left = next((note.partition(": ")[2] for note in notes if "left out" in note or "suggested" in note), "")
    return f"nothing is marked there ({left})" if left else "nothing is marked there"


# ----------------------------------------------------------------------------------------------------------------------
# Whose labels are which.


def read_marked(labelling: Labelling, lanes: Sequence[Any], reading: Reading) -> tuple[list[list[Label] | None], list[str]]:
    """The labels of each lane, those of moments left out; ``None`` where nothing is known of a person; and what to know of
    them."""
    labels_of_lanes: list[list[Label] | None] = [None] * len(lanes)
    notes: list[str] = []
    recordings = list(dict.fromkeys(lane.name for lane in lanes))
    files = _of_recordings(labelling, recordings, reading)
    for name in recordings:
        mine = [i for i, lane in enumerate(lanes) if lane.name == name]
        for path in files[name]:
            labels, said = _select_labels(labelling, path, name, _rate([lanes[i] for i in mine], reading))
            notes += said
            given, said = _to_people(labelling, path, name, labels, [getattr(lanes[i], "person", "") for i in mine])
            notes += said
            for i, some in zip(mine, given, strict=True):
                if some is not None:
                    labels_of_lanes[i] = [*(labels_of_lanes[i] or []), *some]
    return labels_of_lanes, list(dict.fromkeys(notes))


def _rate(lanes: Sequence[Any], reading: Reading) -> float | None:
    """Frames per second of a recording, for files of labels that count frames; None where nobody knows."""
    clips = [lane.clip for lane in lanes if getattr(lane, "clip", None) is not None]
    return clips[0].fps if reading.fps is None and clips and not clips[0].fps_assumed else reading.fps


def _select_labels(labelling: Labelling, path: Path, recording: str, fps: float | None) -> tuple[list[Label], list[str]]:
    """What a file says of a recording, less moments and subjects that were not asked for."""
    file = choose_labels(open_marked(labelling, path, recording, fps))
    labels, notes = list(file.labels), [f"{path}: {note}" for note in file.notices]
    if labels and all({one.observation, one.tier} & set(file.machine) for one in labels):
        notes.append(f"{path}: a program found what is marked there; it counts as you left it")
    if labelling.subject:
        there = list(dict.fromkeys(one.subject for one in labels))
        strange = next((subject for subject in labelling.people if subject not in there), None)
        if strange is not None:
            raise error(path, f"has no label of the subject {strange!r}, only of {listing(there)}", "give one of these (--subject)")
        labels = [one for one in labels if one.subject in labelling.people]
    kept, said = lasting(path, labels)
    return kept, notes + said


def lasting(path: Path, labels: Sequence[Label]) -> tuple[list[Label], list[str]]:
    """Labels that last, and that somebody has confirmed; and how many others there are."""
    points, open_ = sum(one.point for one in labels), sum(one.label.startswith(UNCONFIRMED) for one in labels)
    notes = [f"{path}: {count(points, 'label')} left out: of a moment, without duration"] if points else []
    if open_:
        notes.append(f"{path}: {count(open_, 'label')} left out: suggested ('{UNCONFIRMED} ...'), and confirmed by nobody")
    return [one for one in labels if not one.point and not one.label.startswith(UNCONFIRMED)], notes


def _of_recordings(labelling: Labelling, recordings: Sequence[str], reading: Reading) -> dict[str, list[Path]]:
    """The files of labels of each recording."""
    if len(recordings) == 1:
        return {recordings[0]: list(labelling.labels)}
    if labelling.media is not None:
        raise ValueError(f"--media {labelling.media}: {len(recordings)} recordings are given; give one, or leave it out")
    out: dict[str, list[Path]] = {name: [] for name in recordings}
    for path in labelling.labels:
        media = open_marked(labelling, path, None, reading.fps).media or (path.name,)
        mine = list(dict.fromkeys(name for medium in media for name in of_medium(medium, recordings)))
        if not mine:
            raise error(
                path, f"is of {listing(media)}, none of the recordings ({listing(recordings)})",
                "give the recording that it is of, or name the file of labels like it",
            )  # fmt: skip
        for name in mine:
            out[name].append(path)
    lost = [name for name in recordings if not out[name]]
    if lost:
        raise error(
            lost[0], f"none of the files of labels is of it ({listing(labelling.labels)})", "leave it out, or add its labels"
        )
    return out


def of_medium(medium: str, recordings: Sequence[str]) -> list[str]:
    """The recordings that one file is which labels are of: those called like it, else those in whose name its name is a word."""
    return [name for name in recordings if same_recording(medium, name)] or [
        name for name in recordings if _is_word_of(medium, name)
    ]


def _is_word_of(medium: str, recording: str) -> bool:

    try:
        return bool(of_recording([medium], Request(Path(medium), recording=recording)))
    except ValueError:  # it is another one
        return False


def _to_people(
    labelling: Labelling, path: Path, recording: str, labels: Sequence[Label], people: Sequence[str]
) -> tuple[list[list[Label] | None], list[str]]:
    """Labels by person, the largest first; ``None`` for those of whom nothing can be known."""
    subjects = list(dict.fromkeys(one.subject for one in labels))
    if len(people) == 1:
        if len([subject for subject in subjects if subject]) > 1:
            raise error(
                path, f"is of {listing(subjects)}, but {recording} shows one person", "choose with --subject whose labels count"
            )  # fmt: skip
        return [list(labels)], []
    owner: dict[str, int] = {}
    for subject in subjects:
        person = labelling.people.get(subject) or subject
        folded = [name.casefold() for name in people]
        if not subject:
            owner[subject] = 0
        elif person.casefold() in folded:
            owner[subject] = folded.index(person.casefold())
        else:
            raise error(
                path, f"subject {person!r} is none of the people of {recording} ({listing(people)})",
                f"say who it is, as in --subject {subject}={people[0]}",
            )  # fmt: skip
    by_person = any(subjects) or not subjects
    found: list[list[Label] | None] = [[] if by_person or i == 0 else None for i in range(len(people))]
    for one in labels:
        mine = found[owner[one.subject]]
        assert mine is not None  # a person's, or the largest's
        mine.append(one)
    if "" not in owner:
        return found, []
    said = f"{path}: does not say whose some labels of {recording} are; they count for person {people[0]}, the largest"
    return found, [said]


def known_events(marked: Sequence[Sequence[Label] | None]) -> list[list[KnownEvent] | None]:
    """Labels as what is known to have happened."""
    return [None if labels is None else [(one.label, one.start, one.end) for one in labels] for labels in marked]


# ----------------------------------------------------------------------------------------------------------------------
# Labels as examples.


@dataclass
class Examples:
    """Clips cut out of recordings, what lies between them, and what a person should know of them."""

    clips: list[Clip] = field(default_factory=list)
    background: list[Clip] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)


def check_labelling(labelling: Labelling, examples: Sequence[Example], throughout: bool) -> None:
    """Raise where flags about labels make no sense beside what is learned from."""
    unnamed = [example for example in examples if example.label is None]
    given = [f"--{name}" for name in ("observation", "tier", "subject", "media") if getattr(labelling, name)]
    given += ["--unlabelled-is-background"] * throughout
    if given and not labelling.labels:
        raise ValueError(f"{given[0]}: of labels only, but there are none; add --labels FILE, or leave it out")
    if labelling.labels and not unnamed:
        raise ValueError(
            f"{labelling.labels[0]}: every example has a label already; give the recording that these labels are of, without label="
        )
    cut = next((one for one in unnamed if labelling.labels and (one.start is not None or one.end is not None)), None)
    if cut is not None:
        raise ValueError(f"{cut.path}: the labels say which seconds count; leave @ out")


def labelled_examples(
    labelling: Labelling,
    paths: Sequence[Path],
    reading: Reading,
    throughout: bool,
    others: Sequence[Clip] = (),
) -> Examples:
    """What is marked in recordings, cut out."""
    lanes, notes = _lanes_of(paths, reading, others)
    several = any(lane.clip is not None and lane.clip.meta.get("people") for lane in lanes)
    if several and any(
        one.subject for path in labelling.labels for one in open_marked(labelling, path, None, _rate(lanes, reading)).labels
    ):
        lanes, notes = _lanes_of(paths, replace(reading, person="everyone"), others)  # the labels say whose they are
    marked, said = read_marked(labelling, lanes, reading)
    out = Examples(notes=notes + said)
    number, reasons = 0, []
    for lane, labels in zip(lanes, marked, strict=True):
        number += len(labels or ())
        if labels is None or lane.clip is None:
            continue
        clips, said, why = _cut_out(lane.clip, lane, labels)
        out.clips += clips
        out.notes += said
        reasons += why
        if throughout:
            out.background += _between(lane.clip, _all_labels(labelling, lane, reading))
    if not out.clips:
        where = names([str(path) for path in labelling.labels])
        first = f"; the first: {reasons[0]}" if reasons else ""
        what = f"none of its {count(number, 'label')} can be learned from{first}" if number else _why_nothing(out.notes)
        raise error(where, what, f"mark actions that {names([path.name for path in paths])} shows, each from its begin to its end")

    out.notes += on_examples(out.clips)
    if throughout:
        seconds = sum(clip.duration for clip in out.background)
        out.notes.append(f"{seconds:.1f} s between labels are learned as background, as if nothing of interest happened there")
    return out


def _lanes_of(paths: Sequence[Path], reading: Reading, others: Sequence[Clip]) -> tuple[list[Lane], list[str]]:
    """The recordings, with their joints as in other clips, and what to know of them."""
    found: list[Lane] = []
    notes: list[str] = []
    seen = list(others)
    for path in paths:
        lanes, said = lanes_of(path, reading)
        known = layout_of([*seen, *(lane.clip for lane in lanes if lane.clip is not None)])
        lanes, more = lanes_in_layout(lanes, known, path)
        notes += said + more
        clips = [lane.clip for lane in lanes if lane.clip is not None]
        seen += clips
        if seen and clips and clips[0].joints.shape[1] != seen[0].joints.shape[1]:
            both = f"has {clips[0].joints.shape[1]} joints, but {seen[0].name} has {seen[0].joints.shape[1]}"
            raise error(path, both, "use one pose estimator and joint layout")
        found += lanes
    clips = seen[len(others) :]
    return found, notes + assumed_rate_notes(clips) + clip_notes(clips, reading)


def _cut_out(clip: Clip, lane: Lane, labels: Sequence[Label]) -> tuple[list[Clip], list[str], list[str]]:
    """The clips of some labels, what to know of them, and why others cannot be learned from."""
    name = f"{lane.name}, person {lane.person}" if lane.person else lane.name
    inside, notes = within(labels, float(clip.times[0]), float(clip.times[-1]), name)
    reasons = list(notes) if len(inside) < len(labels) else []
    clips: list[Clip] = []
    taken: dict[tuple[float, float], Label] = {}
    short = []
    for one in inside:
        shown = (clip.times >= one.start) & (clip.times <= one.end)
        part = clip.between(one.start, one.end) if shown.any() else None
        why = "it lasts no frame" if part is None else describe_unusable(part, MIN_EXAMPLE_FRAMES)
        if part is None or why is not None or len(part) < MIN_EXAMPLE_FRAMES:
            short.append(f"{one.label} at {one.start:.6g} to {one.end:.6g} s: {why or f'{len(part or ())} frames'}")
            continue
        span = (float(part.times[0]), float(part.times[-1]))
        other = taken.setdefault(span, one)
        if other.label != one.label:
            tiers = listing(sorted({one.tier, other.tier} - {""}))
            raise ValueError(
                f"{lane.name}: {span[0]:g} to {span[1]:g} s is marked {other.label!r} and {one.label!r}; correct one of them, or "
                f"choose a tier (--tier, of {tiers})"
            )
        known = {**part.meta, "subject": one.subject} if one.subject else part.meta
        clips.append(part.replace(label=one.label, name=f"{lane.name}@{one.start:g}-{one.end:g}", meta=known))
    if short:
        notes.append(f"{name}: {count(len(short), 'label')} left out, as too short or of nobody in view; the first, {short[0]}")
    return clips, notes, reasons + short


def _all_labels(labelling: Labelling, lane: Lane, reading: Reading) -> list[Label]:
    """All that is marked in a recording, of whatever tier and subject, and suggestions, too: none of it is background."""
    labels: list[Label] = []
    for path in labelling.labels:
        file = open_marked(replace(labelling, tier=None), path, None, _rate([lane], reading))
        if not file.media or labelling.media is not None or any(of_medium(medium, [lane.name]) for medium in file.media):
            labels += open_marked(replace(labelling, tier=None), path, lane.name, _rate([lane], reading)).labels
    return labels


def _between(clip: Clip, labels: Sequence[Label]) -> list[Clip]:
    """What of a recording no label is near."""
    edge = float(clip.times[0])
    out = []
    for start, end in [*sorted((one.start, one.end) for one in labels), (float(clip.times[-1]),) * 2]:
        if start - edge >= MIN_BACKGROUND_SECONDS:
            inside = (clip.times > edge) & (clip.times < start)
            if inside.sum() >= MIN_EXAMPLE_FRAMES:
                out.append(clip.between(float(clip.times[inside][0]), float(clip.times[inside][-1])))
        edge = max(edge, end)
    return out


def film_examples(examples: Sequence[Example], labelling: Labelling, reading: Reading) -> tuple[list[Example], list[str]]:
    """Videos with what is marked in them, as examples with their labels and seconds."""
    given = [example for example in examples if example.label is not None]
    unnamed = [Example(example.path) for example in examples if example.label is None]
    lanes = [Lane(example.path.name, "", None, np.empty(0)) for example in unnamed]
    marked, notes = read_marked(labelling, lanes, reading)
    for example, labels in zip(unnamed, marked, strict=True):
        given += [Example(example.path, one.label, one.start, one.end) for one in labels or ()]
    if len(given) == len(examples) - len(unnamed):
        files = names([str(path) for path in labelling.labels])
        raise error(files, _why_nothing(notes), "mark actions, each from its begin to its end")
    return given, notes


# ----------------------------------------------------------------------------------------------------------------------
# What was found, as labels.


def check_write(
    path: Path | None, inputs: Sequence[Path], recordings: Sequence[Path], media: str | None = None, tier: str = "dyntorch"
) -> Path | None:
    """The file that labels will be written to, if it can be, said before anything is searched."""
    if path is None:
        return None
    formats = {suffix: each for each in registered_formats().values() for suffix in each.written.values() if suffix}
    kind = path.suffix.lower()
    if kind not in formats:
        suffixes = ", ".join(sorted(formats))
        raise error(path, f"{kind or 'without an ending'} is no format that labels are written in", f"give one of {suffixes}")
    if len(recordings) > 1 and formats[kind].one_recording:
        raise error(
            path, f"{formats[kind].title} is of one recording, and {len(recordings)} are given",
            f"write them one by one, or into one file such as {path.with_suffix('.boris').name} or {path.with_suffix('.csv').name}",
        )  # fmt: skip
    path = check_file(path, inputs)
    if not path.exists():
        return path

    if not formats[kind].program:  # no row of it says whether somebody made or corrected it
        beside = ", ".join(sorted(suffix for suffix, each in formats.items() if each.program))
        raise error(path, "is there already", f"give another name, or a format that keeps what is there ({beside})")
    open_labels(path)
    # as it will be done, but for the labels, which nobody knows yet
    alone = recordings[0].expanduser() if len(recordings) == 1 else None
    labels = [Label(0.0, 1.0, UNCONFIRMED, media=one.name) for one in recordings if alone is None]
    write_labels(path, labels, recording=alone, tier=tier, media=media, dry=True)
    return path


def found_labels(results: Sequence[RecordingResult], recordings: Sequence[Path]) -> list[Label]:
    """What was reported, as labels: the subject is the person, the score is kept."""
    alone = len(recordings) == 1
    return [
        Label(
            float(one.start),
            float(one.end),
            str(one.label),
            result.person,
            media="" if alone else result.name,
            score=float(one.score),
        )
        for result in results
        for one in sorted(result.events, key=lambda event: (event.start, event.end))
    ]


def write_found(path: Path, results: Sequence[RecordingResult], recordings: Sequence[Path], labelling: Labelling) -> list[str]:
    """Write what was reported into a file of labels, beside what is there; what the format does not keep."""
    end = max(float(one.times[-1]) for one in results) if len(by_recording(results)) == 1 else None
    return write_to(path, found_labels(results, recordings), recordings, end, labelling)


def write_to(
    path: Path,
    labels: Sequence[Label],
    recordings: Sequence[Path],
    duration: float | None,
    labelling: Labelling,
    tier: str = "dyntorch",
) -> list[str]:
    """Write labels into a tier (or observation) of their own; what the format does not keep."""
    prepare(path.parent)
    alone = recordings[0].expanduser() if len(recordings) == 1 else None
    return write_labels(path, labels, recording=alone, duration=duration, tier=tier, media=labelling.media)

"""``dyntorch index evaluate --labels``: how far a model, or somebody else, agrees with what a person has marked."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from indexing.cli.console import check_report, count, names, progress, say, table
from indexing.cli.labels import Labelling, lasting, of_medium
from indexing.opening import error, listed

if TYPE_CHECKING:
    from indexing.cli.evaluate import Evaluate
    from indexing.comparing import Agreement, ComparedSpan
    from indexing.labels import Label

OF_SETS = ("train", "test", "leave_out", "camera", "azimuth", "exemplars", "shots", "view", "weights", "mirror")
"""Flags of an evaluation on a labelled clip set, in which there is something to learn."""


@dataclass(frozen=True)
class _Compared:
    """What is compared, what the two sides are called, and what a person should know of them."""

    spans: list[ComparedSpan]
    sides: tuple[str, str]
    notes: list[str]
    timings: dict[str, float]


def against_labels(command: Evaluate) -> int:
    """Compare what a model finds in recordings, or what files of labels say, with what a person marked; print and report it."""
    from indexing.report.agreement import FILES

    defaults = type(command).__dataclass_fields__
    given = [name for name in OF_SETS if getattr(command, name) != defaults[name].default]
    if given:
        flag = f"--{given[0].replace('_', '-')}"
        raise ValueError(f"{flag}: of clip sets only, but --labels says what is compared; leave one of them out")
    inputs = [*command.clips, *command.labelling.labels, *([command.model] if command.model is not None else [])]
    folder = check_report(command.report, inputs, FILES)
    compared = _of_files(command) if command.model is None else _of_model(command)
    from indexing.comparing import compare

    both = compare(compared.spans)
    page = None if folder is None else _write(command, folder, both, compared, inputs)
    _show(both, compared.sides)
    for note in compared.notes:
        say(f"note: {note}")
    say(_summary(both, compared))
    if page is not None:
        say(f"report: {page}")
    return 0


def _of_model(command: Evaluate) -> _Compared:
    """What a model finds in recordings, and what is marked in them."""
    from indexing.cli.index import Scan
    from indexing.comparing import ComparedSpan

    if command.found_tier is not None or command.found_observation is not None:
        raise ValueError("--found-tier, --found-observation: of files of labels, but a model says what was found; leave them out")
    assert command.model is not None
    scan = Scan(command.clips, command.model, reject=command.reject, labelling=command.labelling, reading=command.reading)
    _, results, notes, timings = scan.search()
    spans = []
    for result in results:
        if result.truth is not None:
            found = [(event.label, event.start, event.end) for event in result.events]
            ends = float(result.times[0]), float(result.times[-1])
            spans.append(ComparedSpan(result.name, *ends, list(result.truth), found, result.person))
    files = names([path.name for path in command.labelling.labels])
    return _Compared(spans, (files, command.model.name), notes, timings)


# ----------------------------------------------------------------------------------------------------------------------
# Files of labels against files of labels.


def _of_files(command: Evaluate) -> _Compared:
    """What two files of labels say, recording by recording and subject by subject."""
    if len(command.clips) != 1 or len(command.labelling.labels) != 1:
        files = names([str(path) for path in (*command.clips, *command.labelling.labels)])
        raise ValueError(
            f"{files}: compare one file of labels with one, as in dyntorch index evaluate found.eaf --labels yours.eaf, or, with "
            "-m MODEL, what is found in recordings with what is marked there"
        )
    (path,), (other,) = command.clips, command.labelling.labels
    theirs = replace(command.labelling, observation=command.found_observation, tier=command.found_tier, subject=())
    with progress("reading", steps=False):
        known, _, notes = _side(command.labelling, other, command, False)
        found, media, said = _side(theirs, path, command, True)
    notes += said
    known = _renamed(known, command.labelling, other)
    spans, said = _paired(known, found, media, (other, path))
    return _Compared(spans, _called(other, path, command), notes + said, {})


def _called(known: Path, found: Path, command: Evaluate) -> tuple[str, str]:
    """Names of the two sides that differ."""
    if known.name != found.name:
        return known.name, found.name
    first = command.labelling.observation or command.labelling.tier
    second = command.found_observation or command.found_tier
    return (str(first or known), str(second or found)) if (first or known) != (second or found) else ("known", "found")


def _side(labelling: Labelling, path: Path, command: Evaluate, detections: bool) -> tuple[list[Label], list[str], list[str]]:
    """The labels of one hand, the media that they are of, and what to know; of detections those of a program, where one
    looked."""
    from indexing.cli.suggest import TIER
    from indexing.labels import choose_labels

    file = labelling.open(path, None, command.reading.fps)
    programs = {name for name in file.machine if not name.startswith(TIER)}  # a suggestion says nothing of what was found
    ours = [one for one in file.labels if {one.observation, one.tier} & programs]
    asked = labelling.observation is not None or labelling.tier is not None
    looked = [one for one in file.watched if one[0] in programs]
    said = []
    if detections and not asked and (ours or looked):
        which = f"what a program found ({listed(sorted(programs))}); --found-tier, --found-observation choose others"
        said = [f"{path}: compared is {which}"] * (len(ours) < len(file.labels))
        file = replace(file, labels=tuple(ours), watched=tuple(looked))
    media = list(dict.fromkeys([*(one.media for one in file.labels), *(medium for _, medium in file.watched)])) or [""]
    nothing = detections and not file.labels
    file = choose_labels(file)
    labels, others = lasting(path, file.labels)
    said += others
    if nothing:
        said.append(f"{path}: nothing was found there")
    elif not labels:
        remedy = "give a file in which something is marked, from its begin to its end"
        raise error(path, "holds no label that lasts", f"{remedy}, or, for a recording, -m MODEL, too" if detections else remedy)
    return labels, media, [f"{path}: {note}" for note in file.notices] + said


def _renamed(labels: Sequence[Label], labelling: Labelling, path: Path) -> list[Label]:
    """Labels of the subjects that were asked for, under the names that they have on the other side."""
    if not labelling.subject:
        return list(labels)
    there = list(dict.fromkeys(one.subject for one in labels))
    strange = next((subject for subject in labelling.people if subject not in there), None)
    if strange is not None:
        raise error(path, f"has no label of the subject {strange!r}, only of {listed(there)}", "give one of these (--subject)")
    people = labelling.people
    return [replace(one, subject=people[one.subject] or one.subject) for one in labels if one.subject in people]


def _paired(
    known: Sequence[Label], found: Sequence[Label], media: Sequence[str], paths: tuple[Path, Path]
) -> tuple[list[ComparedSpan], list[str]]:
    """What is compared: each recording that both sides know, from 0 to where its last label ends, subject by subject."""
    from indexing.comparing import ComparedSpan

    spans: list[ComparedSpan] = []
    notes: list[str] = []
    recordings, left = _recordings(known, found, media, paths)
    for name, (mine, theirs) in recordings.items():
        low, high = min(0.0, *(one.start for one in (*mine, *theirs))), max(one.end for one in (*mine, *theirs))
        for person, sides in _subjects(mine, theirs, paths).items():
            given = [[(one.label, one.start, one.end) for one in side] for side in sides]
            spans.append(ComparedSpan(name, low, high, given[0], given[1], person))
        notes.append(f"{name}: compared from {low:g} to {high:.6g} s, where the last label of either side ends")
    if left:
        notes.append(f"left out: {names(left)}, of which {paths[1]} says nothing")
    return spans, notes


def _recordings(
    known: Sequence[Label], found: Sequence[Label], searched: Sequence[str], paths: tuple[Path, Path]
) -> tuple[dict[str, tuple[list[Label], list[Label]]], list[str]]:
    """The labels of both sides by recording, and the recordings that are known only."""
    media = [list(dict.fromkeys(one.media for one in known)), searched]
    if len(media[0]) == 1 and (len(media[1]) == 1 and "" in (*media[0], *media[1])):
        name = media[0][0] or media[1][0] or paths[0].name
        return {name: (list(known), list(found))}, []
    out: dict[str, tuple[list[Label], list[Label]]] = {}
    for medium in media[1]:
        same = [name for name in media[0] if name == medium] or (
            of_medium(medium, [name for name in media[0] if name]) if medium else []
        )
        if not same and searched != [medium] and not any(one.media == medium for one in found):
            continue  # nothing is known of it, and nothing was found
        if not same:
            said = f"is of {medium or 'a recording without a name'}, and {paths[0]} of {listed(media[0])}"
            raise error(paths[1], said, "compare labels of the same recordings, under the same names")
        mine = out.setdefault(same[0], ([one for one in known if one.media == same[0]], []))
        mine[1].extend(one for one in found if one.media == medium)
    if not out:
        said = f"is of {listed(searched)}, and {paths[0]} of {listed(media[0])}"
        raise error(paths[1], said, "compare labels of the same recordings, under the same names")
    return out, [name for name in media[0] if name not in out]


def _subjects(
    known: Sequence[Label], found: Sequence[Label], paths: tuple[Path, Path]
) -> dict[str, tuple[list[Label], list[Label]]]:
    """The labels of both sides by subject; all together where one side does not say whose they are."""
    sides = [{one.subject.casefold(): one.subject for one in side} for side in (known, found)]
    if any(set(side) <= {""} for side in sides):
        return {"": (list(known), list(found))}
    if not set(sides[0]) & set(sides[1]):
        both = [listed([name or "(nobody)" for name in side.values()]) for side in sides]
        raise error(
            paths[1], f"is of {both[1]}, and {paths[0]} of {both[0]}: no subject in common",
            "say who is who, as in --subject Ann=1",
        )  # fmt: skip
    people = sides[1] | sides[0]
    return {
        shown or "(nobody)": tuple([one for one in side if one.subject.casefold() == name] for side in (known, found))  # type: ignore[misc]
        for name, shown in people.items()
    }


# ----------------------------------------------------------------------------------------------------------------------
# What is printed and written.


def _show(both: Agreement, sides: tuple[str, str]) -> None:
    from indexing.comparing import NONE
    from indexing.report.agreement import label_rows, overlap_rows

    say(f"confusion over time, in seconds: rows are {sides[0]}, columns {sides[1]}")
    named = [*both.labels, NONE]
    rows = [
        [name, *(f"{value:.1f}" if value >= 0.05 else "" for value in row)]
        for name, row in zip(named, both.seconds.tolist(), strict=True)
    ]
    table(["", *(f"{name} " for name in named)], rows)
    head = ["label", "known (s) ", "found (s) ", "both (s) ", "kappa ", "known ", "found ", *(f"F1@{k:g} " for k in both.segments)]
    table(head, label_rows(both))
    table(["overlap", "right ", "found ", "known ", "precision ", "recall ", "F1 "], overlap_rows(both))


def _summary(both: Agreement, compared: _Compared) -> str:
    from indexing.report.recognition import duration

    recordings = len({span.name for span in compared.spans})
    people = sum(bool(span.person) for span in compared.spans)
    who = f" of {count(people, 'person', 'people')}" if people else ""
    kappa = "does not exist (one label throughout)" if both.kappa != both.kappa else f"{both.kappa:.3f}"
    return (
        f"{compared.sides[1]} against {compared.sides[0]}: {duration(both.compared)}{who} in {count(recordings, 'recording')}; "
        f"the same in {100 * both.agreement:.1f} % of the time, Cohen's kappa over time {kappa}"
    )


def _write(command: Evaluate, folder: Path, both: Agreement, compared: _Compared, inputs: Sequence[Path]) -> Path:
    from indexing.files import manifest
    from indexing.report.agreement import AgreementReport, write_agreement

    arguments: dict[str, Any] = {"command": "index evaluate", **dataclasses.asdict(command)}
    about = manifest(arguments, [path.expanduser() for path in inputs], timings=compared.timings)
    title = f"{compared.sides[1]} against {compared.sides[0]}"
    with progress("drawing the report", steps=False):
        return write_agreement(folder, AgreementReport(title, both, compared.spans, compared.sides, compared.notes, about))

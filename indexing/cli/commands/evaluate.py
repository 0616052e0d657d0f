"""``dyntorch index evaluate``: measure recognition on a labelled clip set, or agreement with what a person marked."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from indexing.action.indexer import ActionIndexer
from indexing.cli.commands.scan import search
from indexing.cli.commands.suggest import TIER
from indexing.cli.console import Progress, check_report, names, present, progress
from indexing.cli.flags.recognition import Evaluate, Scan
from indexing.cli.flags.shared import Labelling
from indexing.cli.inputs import assumed_rate_notes, read_clips, usable
from indexing.cli.labels import check_labelling, lasting, of_medium, open_marked
from indexing.cli.protocol import Cameras, Fold, Viewing, check_classes, check_dims, draw_shots, splits, strangers
from indexing.cli.videos import AsTheyAre, are_films, frame_rate, pixel_indexer, read_set, refuse_film_flags, refuse_keypoint_flags
from indexing.clip import LabelledSet
from indexing.comparing import ComparedSpan, compare
from indexing.files import manifest
from indexing.labels import Label, choose_labels
from indexing.opening import error, listing
from indexing.report import EvaluationResult, RecognitionReport
from indexing.report.agreement import FILES as AGREEMENT_FILES
from indexing.report.agreement import AgreementReport
from indexing.report.recognition import FILES

REJECTED = "(rejected)"


def run(flags: Evaluate) -> int:
    """Read, split, learn and ask for every fold, or compare with labels; write the report and print the numbers."""
    if flags.labelling.labels:
        return against_labels(flags)
    check_labelling(flags.labelling, [], False)
    folder = check_report(flags.report, [path(flags)], FILES)
    started = time.perf_counter()
    with progress("loading", steps=False):
        clips, cameras, notes = _read_videos(flags) if are_films([path(flags)]) else _load(flags)
        folds, warned = splits(clips, flags.train, flags.test, flags.leave_out)
        labels = clips.labels.astype(str)
        check_classes(folds, labels, clips.name)
        folds, few = _shots(flags, folds, labels)
    notes += warned + few + strangers(folds, labels)
    timings = {"load": time.perf_counter() - started, "learn": 0.0, "recognize": 0.0}
    with progress("learning and recognizing") as bar:
        results = _measure(flags, clips, labels, folds, cameras, timings, bar)
    groups = _by_group(results) if flags.leave_out is not None else {}
    report = RecognitionReport(
        f"Recognition of {path(flags).name}",
        evaluations=[result for _, result in results],
        metrics={"accuracy_by_group": groups} if groups else {},
        notes=notes,
        timings=timings,
        manifest={} if folder is None else _manifest(flags, [path(flags)], timings, flags.seed),
    )
    return present(report, folder)


def _manifest(flags: Evaluate, inputs: Sequence[Path], timings: Mapping[str, float], seed: int | None = None) -> dict[str, Any]:
    arguments = {"command": "index evaluate", **dataclasses.asdict(flags)}
    return manifest(arguments, [path.expanduser() for path in inputs], seed, timings)


def path(flags: Evaluate) -> Path:
    """The clip set.

    Raises:
        ValueError: it is not one, or something is asked for that needs labels.
    """
    given = [name for name in ("model", "found_tier", "found_observation") if getattr(flags, name) is not None]
    if given:
        raise ValueError(f"--{given[0].replace('_', '-')}: to compare with labels; add --labels FILE, or leave it out")
    if len(flags.clips) != 1:
        what = names([str(path) for path in flags.clips]) if flags.clips else "no clip set"
        raise ValueError(f"{what}: give one clip set, SET.npz; or recordings with --labels FILE and --model FILE")
    return flags.clips[0]


def _read_videos(flags: Evaluate) -> tuple[LabelledSet[Any], Viewing, list[str]]:

    refuse_keypoint_flags(flags, "camera", "azimuth", "exemplars", "view", "weights", "mirror")
    return read_set(path(flags), flags.reading), AsTheyAre(), []


def _load(flags: Evaluate) -> tuple[LabelledSet[Any], Viewing, list[str]]:

    refuse_film_flags(flags.pixels)
    clips = read_clips(flags.reading, path(flags))
    if all(clip.label is None for clip in clips):
        raise ValueError(f"{path(flags)}: says nothing of the actions; give a clip set with 'action' (and 'action_names')")
    clips, notes = usable(clips, path(flags))
    cameras = Cameras(flags.camera, _azimuths(flags), flags.exemplars == "3d", flags.seed)
    return clips, cameras, notes + assumed_rate_notes(clips, path(flags)) + check_dims(clips, cameras)


def _azimuths(flags: Evaluate) -> tuple[float, ...]:
    if flags.azimuth is None:
        return (0.0,)
    if flags.camera != "virtual":
        raise ValueError(f"--azimuth {flags.azimuth}: only virtual cameras turn; add --camera virtual")
    try:
        return tuple(float(word) for word in flags.azimuth.split(","))
    except ValueError:
        raise ValueError(f"--azimuth {flags.azimuth!r}: expected degrees, such as 0,45,90") from None


def _shots(flags: Evaluate, folds: list[Fold], labels: NDArray[np.str_]) -> tuple[list[Fold], list[str]]:

    if flags.shots is None:
        return folds, []
    drawn = [draw_shots(fold, labels, flags.shots, flags.seed) for fold in folds]
    return [fold for fold, _ in drawn], [note for _, few in drawn for note in few]


def _measure(
    flags: Evaluate, clips: LabelledSet[Any], labels: NDArray[np.str_], folds: list[Fold], cameras: Viewing,
    timings: dict[str, float], bar: Progress,
) -> list[tuple[str, EvaluationResult]]:  # fmt: skip
    """One result per fold and camera, each with the name of its fold."""
    classes = sorted(set(labels))
    out = []
    for number, fold in enumerate(folds):
        started = time.perf_counter()
        examples = [cameras.exemplar(clips[i], int(i)) for i in fold.train]
        indexer = _indexer(flags, examples).fit(examples, labels[fold.train])
        timings["learn"] += time.perf_counter() - started
        for view, setting in enumerate(cameras.settings):
            queries = [cameras.query(clips[i], int(i), view) for i in fold.test]
            started = time.perf_counter()
            predicted = indexer.predict(queries)
            timings["recognize"] += time.perf_counter() - started
            out.append((fold.name, EvaluationResult(classes, labels[fold.test], predicted, setting or fold.name)))
            bar((number + (view + 1) / len(cameras.settings)) / len(folds))
    return out


def _indexer(flags: Evaluate, examples: list[Any]) -> Any:
    """A new indexer of what the examples are."""
    if are_films([path(flags)]):
        return pixel_indexer(flags.pixels, frame_rate(examples), reject=flags.reject, none_label=REJECTED)

    return ActionIndexer(
        view=flags.view, weights=flags.weights, reject=flags.reject, none_label=REJECTED,
        mirror="auto" if flags.mirror else False, random_state=flags.seed,
    )  # fmt: skip


def _by_group(results: list[tuple[str, EvaluationResult]]) -> dict[str, float]:
    """Accuracy of each group that was left out, over all cameras."""
    right: dict[str, list[bool]] = {}
    for name, result in results:
        right.setdefault(name, []).extend(str(a) == str(b) for a, b in zip(result.truth, result.predicted, strict=True))
    return {name: sum(values) / len(values) for name, values in right.items()}


# ----------------------------------------------------------------------------------------------------------------------
# What is found, or what somebody marked, against what a person marked.


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
    defaults = type(command).__dataclass_fields__
    given = [name for name in OF_SETS if getattr(command, name) != defaults[name].default]
    if given:
        flag = f"--{given[0].replace('_', '-')}"
        raise ValueError(f"{flag}: of clip sets only, but --labels says what is compared; leave one of them out")
    inputs = [*command.clips, *command.labelling.labels, *([command.model] if command.model is not None else [])]
    folder = check_report(command.report, inputs, AGREEMENT_FILES)
    compared = _of_files(command) if command.model is None else _of_model(command)
    spans, (known, found) = compared.spans, compared.sides
    about = {} if folder is None else _manifest(command, inputs, compared.timings)
    report = AgreementReport(f"{found} against {known}", compare(spans), spans, compared.sides, compared.notes, about)
    return present(report, folder)


def _of_model(command: Evaluate) -> _Compared:
    """What a model finds in recordings, and what is marked in them."""
    if command.found_tier is not None or command.found_observation is not None:
        raise ValueError("--found-tier, --found-observation: of files of labels, but a model says what was found; leave them out")
    assert command.model is not None
    flags = Scan(command.clips, command.model, reject=command.reject, labelling=command.labelling, reading=command.reading)
    _, results, notes, timings = search(flags)
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
    known = _rename_labels(known, command.labelling, other)
    spans, said = _pair_spans(known, found, media, (other, path))
    return _Compared(spans, _side_names(other, path, command), notes + said, {})


def _side_names(known: Path, found: Path, command: Evaluate) -> tuple[str, str]:
    """Names of the two sides that differ."""
    if known.name != found.name:
        return known.name, found.name
    first = command.labelling.observation or command.labelling.tier
    second = command.found_observation or command.found_tier
    return (str(first or known), str(second or found)) if (first or known) != (second or found) else ("known", "found")


def _side(labelling: Labelling, path: Path, command: Evaluate, detections: bool) -> tuple[list[Label], list[str], list[str]]:
    """The labels of one hand, the media that they are of, and what to know; of detections those of a program, where one
    looked."""
    file = open_marked(labelling, path, None, command.reading.fps)
    programs = {name for name in file.machine if not name.startswith(TIER)}  # a suggestion says nothing of what was found
    ours = [one for one in file.labels if {one.observation, one.tier} & programs]
    asked = labelling.observation is not None or labelling.tier is not None
    looked = [one for one in file.watched if one[0] in programs]
    said = []
    if detections and not asked and (ours or looked):
        which = f"what a program found ({listing(sorted(programs))}); --found-tier, --found-observation choose others"
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


def _rename_labels(labels: Sequence[Label], labelling: Labelling, path: Path) -> list[Label]:
    """Labels of the subjects that were asked for, under the names that they have on the other side."""
    if not labelling.subject:
        return list(labels)
    there = list(dict.fromkeys(one.subject for one in labels))
    strange = next((subject for subject in labelling.people if subject not in there), None)
    if strange is not None:
        raise error(path, f"has no label of the subject {strange!r}, only of {listing(there)}", "give one of these (--subject)")
    people = labelling.people
    return [replace(one, subject=people[one.subject] or one.subject) for one in labels if one.subject in people]


def _pair_spans(
    known: Sequence[Label], found: Sequence[Label], media: Sequence[str], paths: tuple[Path, Path]
) -> tuple[list[ComparedSpan], list[str]]:
    """What is compared: each recording that both sides know, from 0 to where its last label ends, subject by subject."""
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
            said = f"is of {medium or 'a recording without a name'}, and {paths[0]} of {listing(media[0])}"
            raise error(paths[1], said, "compare labels of the same recordings, under the same names")
        mine = out.setdefault(same[0], ([one for one in known if one.media == same[0]], []))
        mine[1].extend(one for one in found if one.media == medium)
    if not out:
        said = f"is of {listing(searched)}, and {paths[0]} of {listing(media[0])}"
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
        both = [listing([name or "(nobody)" for name in side.values()]) for side in sides]
        raise error(
            paths[1], f"is of {both[1]}, and {paths[0]} of {both[0]}: no subject in common",
            "say who is who, as in --subject Ann=1",
        )  # fmt: skip
    people = sides[1] | sides[0]
    return {
        shown or "(nobody)": tuple([one for one in side if one.subject.casefold() == name] for side in (known, found))  # type: ignore[misc]
        for name, shown in people.items()
    }

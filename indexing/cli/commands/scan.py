"""``dyntorch index scan``: find learned actions in long recordings."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Sequence
from typing import Any

import numpy as np

from indexing import ActionOptions
from indexing.action.indexer import ActionIndexer
from indexing.brightness.indexer import BrightnessIndexer
from indexing.cli.console import Progress, check_report, names, present, progress
from indexing.cli.flags.recognition import Scan
from indexing.cli.inputs import KnownEvent, Lane, on_classes, on_truth, read_recordings, watch_videos
from indexing.cli.labels import check_write, known_events, read_marked, write_found
from indexing.cli.videos import FilmRecording, are_films, read_films
from indexing.clip import Clip
from indexing.files import manifest
from indexing.modelfile import model_kind
from indexing.readers.formats.clipset import holds_frames
from indexing.recordings.repetitions import count_repetitions
from indexing.report import RecognitionReport, RecordingResult
from indexing.report.recognition import FILES
from indexing.report.results import by_recording
from indexing.scoring import Event

RESTED = {"strict": 2.0, "usual": 1.0, "off": 0.0}
"""Times the usual weight that resting has against an action."""


def run(flags: Scan) -> int:
    """Read all, scan all, write the report, print the hits."""
    if not flags.recordings:
        raise ValueError("no recordings; give at least one keypoint file or folder to search")
    if flags.truth is not None and flags.labelling.labels:
        raise ValueError(f"--truth {flags.truth}: --labels says what is known, too; give one of them")
    if flags.truth is not None:
        flags = dataclasses.replace(flags, labelling=dataclasses.replace(flags.labelling, labels=(flags.truth,)))
    inputs = [*flags.recordings, flags.model]
    folder = check_report(flags.report, [*inputs, *flags.labelling.labels], FILES)
    target = check_write(flags.write, inputs, flags.recordings, flags.labelling.media)
    inputs += flags.labelling.labels
    indexer, results, notes, timings = search(flags)
    if target is not None:
        with progress(f"writing {target.name}", steps=False):
            notes += write_found(target, results, flags.recordings, flags.labelling)
    number = len(by_recording(results))
    about: dict[str, Any] = {}
    if folder is not None:
        arguments, seed = {"command": "index scan", **dataclasses.asdict(flags)}, getattr(indexer, "random_state", None)
        about = manifest(arguments, [path.expanduser() for path in inputs], seed, timings)
    report = RecognitionReport(
        f"Actions in {results[0].name}" if number == 1 else f"Actions in {number} recordings",
        recordings=results,
        exemplars=exemplars(indexer) if hasattr(indexer, "exemplar") else {},
        notes=notes,
        timings=timings,
        manifest=about,
    )
    return present(report, folder, *([f"written: {target}"] if target is not None else []))


def search(flags: Scan) -> tuple[Any, list[RecordingResult], list[str], dict[str, float]]:
    """The model, what it finds in each recording, person by person, what to know of that, and the seconds it took."""
    started = time.perf_counter()
    with progress("loading", steps=False):
        indexer, recordings, notes = _read_videos(flags) if _of_films(flags) else _clips(flags)
    if flags.reject is not None:
        indexer.set_params(reject=flags.reject)
    truth: list[list[KnownEvent] | None] = [None] * len(recordings)
    if flags.labelling.labels:
        marked, unread = read_marked(flags.labelling, recordings, flags.reading)
        truth = known_events(marked)
        notes = [*notes, *unread, *_unknown(truth, indexer), *on_truth(truth, recordings)]
    loaded = time.perf_counter()
    results = [
        _scan(indexer, one, events, f" ({i} of {len(recordings)})" if len(recordings) > 1 else "")
        for i, (one, events) in enumerate(zip(recordings, truth, strict=True), 1)
    ]
    return indexer, results, notes, {"load": loaded - started, "scan": time.perf_counter() - loaded}


def _of_films(flags: Scan) -> bool:
    """Whether the model was learned from pixels; the recordings must be of the same kind."""
    of_films, by = model_kind(flags.model) == "dyntorch.brightness-indexer", flags.reading.footage.by
    has = "the pixels of videos" if of_films else "keypoints"
    if by == ("keypoints" if of_films else "pixels"):
        raise ValueError(f"--by {by}: the model {flags.model} was learned from {has}; leave --by out")
    if not (are_films(flags.recordings) if of_films else not any(map(holds_frames, flags.recordings))):
        need = "videos" if of_films else "keypoint files, or videos as the camera wrote them"
        raise ValueError(f"{flags.recordings[0]}: the model {flags.model} was learned from {has}; give {need} to search")
    return of_films


def _clips(flags: Scan) -> tuple[ActionIndexer, list[Lane], list[str]]:

    indexer = ActionIndexer.load(flags.model.expanduser())
    options = indexer.options or ActionOptions()
    options = dataclasses.replace(options, rest_weight=RESTED[flags.rest] * options.rest_weight)
    indexer.set_params(options=options)
    reading = watch_videos(flags.reading, flags.recordings, flags.report or (None if flags.write is None else flags.write.parent))
    lanes, notes = read_recordings(flags.recordings, reading, indexer.n_joints_, flags.model, indexer.skeleton_)
    return indexer, lanes, [*reading.watched.notes, *notes, *on_classes([str(label) for label in indexer.classes_])]


def _read_videos(flags: Scan) -> tuple[BrightnessIndexer, list[FilmRecording], list[str]]:

    if flags.rest != "usual":
        raise ValueError(
            f"--rest {flags.rest}: {flags.model} was learned from videos, in which nobody's rest is judged; leave it out"
        )
    return BrightnessIndexer.load(flags.model.expanduser()), *read_films(flags.recordings, flags.reading)


def _scan(indexer: Any, recording: Any, truth: list[KnownEvent] | None, which: str) -> RecordingResult:

    classes = [str(label) for label in indexer.classes_]
    if isinstance(recording, Lane) and recording.clip is None:  # nobody is in view
        nothing = np.full((len(recording.times), len(classes)), np.nan)
        return RecordingResult(recording.name, None, recording.times, classes, nothing, (), truth, repetitions=())
    person = getattr(recording, "person", "")
    with progress(f"scanning {recording.name}{f', person {person}' * bool(person)}{which}") as bar:
        if isinstance(recording, Lane):
            return _of_person(indexer, recording, truth, bar)
        times, scores, events = indexer.scan(recording.source, bar)
        return RecordingResult(recording.name, None, times, classes, scores, events, truth)


def _of_person(indexer: ActionIndexer, lane: Lane, truth: list[KnownEvent] | None, bar: Progress) -> RecordingResult:
    """One person of a recording: explained, and what was found counted."""
    assert lane.clip is not None
    explanation = indexer.decode(lane.clip, bar)
    counts = count_repetitions(lane.clip, explanation.events, exemplars(indexer))

    def renumber(event: Event) -> Event:
        return dataclasses.replace(event, exemplar=within_label(indexer, event.exemplar))

    classes, events = [str(label) for label in explanation.classes], list(map(renumber, explanation.events))
    withheld = [dataclasses.replace(each, event=renumber(each.event)) for each in explanation.withheld]
    return RecordingResult(
        lane.name, lane.clip, lane.times, classes, explanation.scores, events, truth, person=lane.person, withheld=withheld,
        repetitions=counts,
    )  # fmt: skip


def within_label(indexer: ActionIndexer, exemplar: int | None) -> int | None:
    """An exemplar's number among those of its label, from its number in the model."""
    if exemplar is None:
        return None
    labels = indexer.model_.labels
    return int((labels[:exemplar] == labels[exemplar]).sum())


def exemplars(indexer: ActionIndexer) -> dict[Any, list[Clip]]:
    """Label -> the clips it was learned from."""
    clips: dict[Any, list[Clip]] = {}
    for index in range(len(indexer.model_.labels)):
        clip = indexer.exemplar(index)
        clips.setdefault(clip.label, []).append(clip)
    return clips


def _unknown(truth: Sequence[Sequence[KnownEvent] | None], indexer: Any) -> list[str]:
    known = {str(label) for label in indexer.classes_}
    strange = sorted({str(label) for events in truth for label, _, _ in events or []} - known)
    return [f"the model does not know {names(strange)}, which the known events name"] if strange else []

"""``dyntorch index fit``: learn actions from example clips."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from indexing.cli.console import Progress, check_file, check_report, count, names, progress, say, table
from indexing.cli.films import Pixels, are_films, refuse_film_flags
from indexing.cli.inputs import (
    Example,
    Following,
    KnownEvent,
    Lane,
    Reading,
    on_overlaps,
    on_range,
    on_truth,
    parse_example,
    read_examples,
    read_recordings,
    read_truth,
)
from indexing.cli.labels import (
    Labelling,
    check_labelling,
    check_write,
    film_examples,
    known_events,
    labelled_examples,
    read_marked,
    write_found,
)
from indexing.cli.remarks import on_classes

if TYPE_CHECKING:
    from indexing.action.indexer import ActionIndexer
    from indexing.clip import Clip


@dataclass(frozen=True)
class Fit:
    """Learn actions from example clips and write a model file.

    dyntorch index fit squat=a.json "lunge left"=b.json@1.5-4 -o moves.safetensors

    dyntorch index fit clips.npz --select view=1,2 -o moves.safetensors

    dyntorch index fit squat=a.json --background session.json -o squat.safetensors      (one action: "more of this")

    dyntorch index fit raise=a.mp4 wave=b.mp4@3-5 -o moves.safetensors      (videos: by the people in them; --by pixels without)

    dyntorch index fit session.json --labels session.boris -o moves.safetensors      (what was marked in BORIS, ELAN, ...)
    """

    examples: Annotated[tyro.conf.Positional[tuple[str, ...]], tyro.conf.arg(metavar="LABEL=FILE ...", help_behavior_hint="")]
    """keypoint files or OpenPose folders, or videos, one or more per label; label=file@1.5-4 uses these seconds; a labelled set:
    SET.npz; with --labels, recordings in which actions are marked"""
    output: Annotated[Path, tyro.conf.arg(aliases=("-o",), metavar="FILE")]
    """the model to write, usually *.safetensors"""
    select: Annotated[tyro.conf.UseAppendAction[tuple[str, ...]], tyro.conf.arg(metavar="FIELD=VALUES")] = ()
    """of clip sets, learn only from clips with these values, e.g. view=1,2"""
    view: Literal["any", "same"] = "any"
    """from where recordings will be seen: from anywhere, or from about where the examples were"""
    reject: Annotated[float | None, tyro.conf.arg(metavar="R", help_behavior_hint="")] = None
    """share of clips of unknown actions that may be taken for a known one, 0 to 1; any other number is the least score"""
    background: Annotated[tuple[Path, ...], tyro.conf.arg(metavar="FILE ...", help_behavior_hint="")] = ()
    """recordings of other movement, of any length: what resembles them more than the actions is none; one action alone can be
    learned without them, too, and is found more surely with them"""
    unlabelled_is_background: bool = False
    """with --labels: the recordings are labelled throughout, and what lies between labels is other movement, to be told from the
    actions; otherwise nobody knows what it is"""
    weights: Literal["equal", "learned"] = "equal"
    """of the kinds of evidence; learned: by what serves people best who are left out (clip sets with a field 'subject')"""
    report: Annotated[Path | None, tyro.conf.arg(metavar="FOLDER", help_behavior_hint="")] = None
    """where to write report.html and body_parts.png: which body parts tell the actions apart, and how the evidence is weighed"""
    mirror: bool = True
    """let examples count mirrored, too, where left and right are not different actions"""
    seed: int = 0
    """of the virtual views"""
    labelling: Labelling = field(default_factory=Labelling)
    reading: Reading = field(default_factory=Reading)
    pixels: Pixels = field(default_factory=Pixels)

    def run(self) -> int:
        """Read, learn, write, and say what was learned."""
        if not self.examples:
            raise ValueError("no examples; give an action or more, such as squat=a.json lunge=b.json, or a clip set SET.npz")
        examples = [parse_example(text) for text in self.examples]
        check_labelling(self.labelling, examples, self.unlabelled_is_background)
        paths = [example.path for example in examples] + list(self.background) + list(self.labelling.labels)
        output, folder = check_file(self.output, paths), check_report(self.report, paths)
        if not self.reading.footage.as_keypoints([example.path for example in examples]):
            return self._from_pixels(examples, output)
        refuse_film_flags(self.pixels)
        reading = self.reading.watching([*(example.path for example in examples), *self.background], output.parent)
        with progress("reading", steps=False):
            clips, background, notes = self._read(examples, reading)
        notes = [*reading.watched.notes, *notes]
        started = time.perf_counter()
        with progress(f"learning from {count(len(clips), 'clip')}", steps=False):
            from indexing.action.indexer import ActionIndexer
            from indexing.files import prepare

            indexer = ActionIndexer(
                view=self.view, weights=self.weights, reject=self.reject, mirror="auto" if self.mirror else False,
                random_state=self.seed,
            )  # fmt: skip
            indexer.fit(clips, [str(clip.label) for clip in clips], background=background or None)
        seconds = time.perf_counter() - started
        if self.weights == "learned" and (indexer.groups_ is None or len(set(indexer.groups_)) < 2):
            notes.append(
                "--weights learned: nobody could be left out (no field 'subject', or one person), so the usual weights stand"
            )
        prepare(output.parent)
        indexer.save(output)
        page = None if folder is None else self._write(folder, indexer, clips, notes, paths)
        _show(clips)
        notes += _other_movement(indexer)
        for note in notes:
            say(f"note: {note}")
        code = _written(output, seconds)
        if page is not None:
            say(f"report: {page}")
        return code

    def _read(self, examples: list[Example], reading: Reading) -> tuple[list[Clip], list[Clip], list[str]]:
        """Labelled clips, other movement, and what a person should know of them."""
        background = [clip for path in self.background for clip in reading.read(path)]
        if not self.labelling.labels:
            clips, notes = read_examples(examples, reading, self.select)
            return clips, background, notes
        given = [example for example in examples if example.label is not None]
        clips, notes = read_examples(given, reading, self.select) if given else ([], [])
        paths = [example.path for example in examples if example.label is None]
        marked = labelled_examples(self.labelling, paths, reading, self.unlabelled_is_background, clips)
        return [*clips, *marked.clips], [*background, *marked.background], notes + marked.notes

    def _write(self, folder: Path, indexer: ActionIndexer, clips: list[Clip], notes: list[str], paths: list[Path]) -> Path:
        from indexing.files import manifest
        from indexing.report.learned import write_learned

        about = manifest({"command": "index fit", **dataclasses.asdict(self)}, [path.expanduser() for path in paths], self.seed)
        with progress("drawing the report", steps=False):
            return write_learned(folder, indexer, clips, notes, about)

    def _from_pixels(self, examples: list[Example], output: Path) -> int:
        """The same for videos."""
        from indexing.cli import films
        from indexing.files import prepare

        films.refuse_keypoint_flags(self, "view", "weights", "mirror", "seed", "report", "background", "unlabelled_is_background")
        with progress("reading", steps=False):
            notes = [] if self.reading.footage.by == "pixels" or films.are_sets(examples) else [films.NO_MODEL]
            notes += on_overlaps(examples)
            if self.labelling.labels:
                examples, said = film_examples(examples, self.labelling, self.reading)
                notes += said
            sources, labels, lengths = films.read_examples(examples, self.reading, self.select)
            if all(films.is_video(example.path) for example in examples):
                for example, seconds in zip(examples, lengths, strict=True):
                    notes += on_range(example, 0.0, (example.start or 0.0) + seconds)
        _check_two(labels, examples)
        started = time.perf_counter()
        with progress(f"learning from {count(len(sources), 'video')}", steps=False):
            indexer = self.pixels.indexer(films.frame_rate(sources), reject=self.reject).fit(sources, labels)
        prepare(output.parent)
        indexer.save(output)
        lines = []
        for label in sorted(set(labels)):
            mine = [seconds for name, seconds in zip(labels, lengths, strict=True) if name == label]
            lines.append([label, len(mine), f"{sum(mine):.1f}"])
        table(["action", "examples ", "seconds "], lines)
        for note in [*notes, f"learned from pixels, at {indexer.fps:.3g} frames per second"]:
            say(f"note: {note}")
        return _written(output, time.perf_counter() - started)


def _check_two(labels: Sequence[str], examples: Sequence[Example]) -> None:
    if len(set(labels)) < 2:
        files = names([str(example.path) for example in examples])
        raise ValueError(f"{files}: only one action ({labels[0]}); give examples of two or more, such as ordinary movement")


def _other_movement(indexer: ActionIndexer) -> list[str]:
    """What the actions are told from, besides one another."""
    model = indexer.model_
    if not model.hidden:
        return []
    clips = int((model.labels >= model.known).sum())
    return [f"told from a background of {count(clips, 'clip')} in {count(model.hidden, 'kind')}, which are never reported"]


def _written(output: Path, seconds: float) -> int:
    say(f"learned in {seconds:.1f} s; model written to {output} ({max(1, round(output.stat().st_size / 1000)):,} kB)")
    return 0


def _show(clips: list[Clip]) -> None:
    groups: dict[str, list[Clip]] = {}
    for clip in clips:
        groups.setdefault(str(clip.label), []).append(clip)
    rows = []
    for label, mine in sorted(groups.items()):
        kinds = sorted({f"{clip.joints.shape[1]} in {clip.dims}D" for clip in mine})
        rows.append([label, len(mine), f"{sum(clip.duration for clip in mine):.1f}", ", ".join(kinds)])
    table(["action", "examples ", "seconds ", "joints "], rows)


# ----------------------------------------------------------------------------------------------------------------------
# ``dyntorch index scan``: find learned actions in long recordings.


if TYPE_CHECKING:
    from indexing.action.indexer import ActionIndexer
    from indexing.brightness.indexer import BrightnessIndexer
    from indexing.cli.films import FilmRecording
    from indexing.clip import Clip
    from indexing.report import RecordingResult
    from indexing.scoring import Event


Rest = Literal["strict", "usual", "off"]
RESTED = {"strict": 2.0, "usual": 1.0, "off": 0.0}
"""Times the usual weight that resting has against an action."""


@dataclass(frozen=True)
class Scan:
    """Find the actions of a model in untrimmed recordings.

    Score: the evidence for the action, averaged over the time it lasts; higher is better.  Margin: how much more the
    segment is worth than as the next best action; near 0 it might as well be that one.

    dyntorch index scan session.json -m moves.safetensors --report out/

    dyntorch index scan session.mp4 -m moves.safetensors --report out/       (a video: by the people in it)

    dyntorch index scan session.json -m moves.safetensors --write session.eaf      (a tier of its own, beside yours)
    """

    recordings: Annotated[tyro.conf.Positional[tuple[Path, ...]], tyro.conf.arg(metavar="FILE ...", help_behavior_hint="")]
    """keypoint files (a folder in OpenPose form is one recording), or videos"""
    model: Annotated[Path, tyro.conf.arg(aliases=("-m",), metavar="FILE")]
    """what 'dyntorch index fit' wrote"""
    report: Annotated[Path | None, tyro.conf.arg(metavar="FOLDER", help_behavior_hint="")] = None
    """where to write report.html (which plays the recordings), events.csv, repetitions.csv, timeline.png, metrics.json and
    manifest.json; without it, print only"""
    write: Annotated[Path | None, tyro.conf.arg(metavar="FILE", help_behavior_hint="")] = None
    """write what was found for the program in which you look through it: .eaf (ELAN), .boris, .csv, .tsv, or .json (ActivityNet);
    in a file that is there it gets a tier, or observation, of its own, and all else stays as it was"""
    truth: Annotated[Path | None, tyro.conf.arg(metavar="CSV", help_behavior_hint="")] = None
    """what is known to have happened: columns label,start,end in seconds (and file, where there are several recordings)"""
    reject: Annotated[float | None, tyro.conf.arg(metavar="R", help_behavior_hint="")] = None
    """rate of false alarms that is accepted, 0 to 1, or else the least score; by default that of the model"""
    rest: Rest = "usual"
    """who hardly moves rests, and what looks like an action then is held back: strict doubts more, off reports it"""
    labelling: Labelling = field(default_factory=Labelling)
    reading: Following = field(default_factory=Following)

    def run(self) -> int:
        """Read all, scan all, write the report, print the hits."""
        from indexing.report.tallies import held_sentences

        if not self.recordings:
            raise ValueError("no recordings; give at least one keypoint file or folder to search")
        if self.truth is not None and self.labelling.labels:
            raise ValueError(f"--truth {self.truth}: --labels says what is known, too; give one of them")
        inputs = [*self.recordings, self.model, *([self.truth] if self.truth is not None else [])]
        folder, target = check_report(self.report, inputs), check_write(self.write, inputs, self.recordings, self.labelling.media)
        inputs += self.labelling.labels
        indexer, results, notes, timings = self.search()
        if target is not None:
            with progress(f"writing {target.name}", steps=False):
                notes += write_found(target, results, self.recordings, self.labelling)
        page = None if folder is None else self._write(folder, indexer, results, notes, inputs, timings)
        _scan_show(results)
        _counts_show(results)
        for note in notes:
            say(f"note: {note}")
        for sentence in held_sentences(results):
            say(sentence)
        say(_summary(results, timings["scan"]))
        if any(result.truth is not None for result in results):
            for sentence in [_against_truth(results), *_right(results)]:
                say(sentence)
        if target is not None:
            say(f"written: {target}")
        if page is not None:
            say(f"report: {page}")
        return 0

    def search(self) -> tuple[Any, list[RecordingResult], list[str], dict[str, float]]:
        """The model, what it finds in each recording, person by person, what to know of that, and the seconds it took."""
        started = time.perf_counter()
        with progress("loading", steps=False):
            indexer, recordings, notes = self._films() if self._of_films() else self._clips()
        if self.reject is not None:
            indexer.set_params(reject=self.reject)
        names, people = [one.name for one in recordings], [getattr(one, "person", "") for one in recordings]
        truth, unread = self._known(recordings, names, people)
        notes = notes + unread + _unknown(truth, indexer)
        if truth is not None:
            notes += on_truth(truth, recordings)
        loaded = time.perf_counter()
        results = [
            self._scan(indexer, one, None if truth is None else truth[i], f" ({i + 1} of {len(names)})" if len(names) > 1 else "")
            for i, one in enumerate(recordings)
        ]
        return indexer, results, notes, {"load": loaded - started, "scan": time.perf_counter() - loaded}

    def _known(
        self, recordings: Sequence[Any], names: list[str], people: list[str]
    ) -> tuple[list[list[KnownEvent] | None] | None, list[str]]:
        """What is known to have happened in each recording, person by person, where anything is."""
        if self.truth is not None:
            return read_truth(self.truth, names, people)
        if self.labelling.labels:
            marked, notes = read_marked(self.labelling, recordings, self.reading)
            return known_events(marked), notes
        return None, []

    def _of_films(self) -> bool:
        """Whether the model was learned from pixels; the recordings must be of the same kind."""
        from indexing.modelfile import model_kind
        from indexing.readers.formats.clipset import holds_frames

        of_films, by = model_kind(self.model) == "dyntorch.brightness-indexer", self.reading.footage.by
        has = "the pixels of videos" if of_films else "keypoints"
        if by == ("keypoints" if of_films else "pixels"):
            raise ValueError(f"--by {by}: the model {self.model} was learned from {has}; leave --by out")
        if not (are_films(self.recordings) if of_films else not any(map(holds_frames, self.recordings))):
            need = "videos" if of_films else "keypoint files, or videos as the camera wrote them"
            raise ValueError(f"{self.recordings[0]}: the model {self.model} was learned from {has}; give {need} to search")
        return of_films

    def _clips(self) -> tuple[ActionIndexer, list[Lane], list[str]]:
        from indexing import ActionOptions
        from indexing.action.indexer import ActionIndexer

        indexer = ActionIndexer.load(self.model.expanduser())
        options = indexer.options or ActionOptions()
        options = dataclasses.replace(options, rest_weight=RESTED[self.rest] * options.rest_weight)
        indexer.set_params(options=options)
        reading = self.reading.watching(self.recordings, self.report or (None if self.write is None else self.write.parent))
        lanes, notes = read_recordings(self.recordings, reading, indexer.n_joints_, self.model, indexer.skeleton_)
        return indexer, lanes, [*reading.watched.notes, *notes, *on_classes([str(label) for label in indexer.classes_])]

    def _films(self) -> tuple[BrightnessIndexer, list[FilmRecording], list[str]]:
        from indexing.brightness.indexer import BrightnessIndexer
        from indexing.cli.films import read_films

        if self.rest != "usual":
            raise ValueError(
                f"--rest {self.rest}: {self.model} was learned from videos, in which nobody's rest is judged; leave it out"
            )
        return BrightnessIndexer.load(self.model.expanduser()), *read_films(self.recordings, self.reading)

    def _scan(self, indexer: Any, recording: Any, truth: list[KnownEvent] | None, which: str) -> RecordingResult:
        import numpy as np

        from indexing.report import RecordingResult

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

    def _write(
        self, folder: Path, indexer: Any, results: list[RecordingResult], notes: list[str], inputs: list[Path],
        timings: dict[str, float],
    ) -> Path:  # fmt: skip
        from indexing.files import manifest
        from indexing.report import RecognitionReport, write_recognition
        from indexing.report.results import by_recording

        number = len(by_recording(results))
        arguments = {"command": "index scan", **dataclasses.asdict(self)}
        report = RecognitionReport(
            f"Actions in {results[0].name}" if number == 1 else f"Actions in {number} recordings",
            recordings=results,
            exemplars=exemplars(indexer) if hasattr(indexer, "exemplar") else {},
            notes=notes,
            manifest=manifest(arguments, [path.expanduser() for path in inputs], getattr(indexer, "random_state", None), timings),
        )
        with progress("drawing the report", steps=False):
            return write_recognition(folder, report)


def _of_person(indexer: ActionIndexer, lane: Lane, truth: list[KnownEvent] | None, bar: Progress) -> RecordingResult:
    """One person of a recording: explained, and what was found counted."""
    from indexing.recordings.repetitions import count_repetitions
    from indexing.report import RecordingResult

    assert lane.clip is not None
    told = indexer.explain(lane.clip, bar)
    counts = count_repetitions(lane.clip, told.events, exemplars(indexer))

    def named(event: Event) -> Event:
        return dataclasses.replace(event, exemplar=within_label(indexer, event.exemplar))

    held = [dataclasses.replace(one, event=named(one.event)) for one in told.withheld]
    return RecordingResult(
        lane.name, lane.clip, lane.times, [str(label) for label in told.classes], told.scores, list(map(named, told.events)), truth,
        person=lane.person, withheld=held, repetitions=counts,
    )  # fmt: skip


def within_label(indexer: ActionIndexer, exemplar: int | None) -> int | None:
    """An exemplar's number among those of its label, from its number in the model."""
    if exemplar is None:
        return None
    labels = indexer.model_.labels
    return int((labels[:exemplar] == labels[exemplar]).sum())


def exemplars(indexer: ActionIndexer) -> dict[Any, list[Clip]]:
    """Label -> the clips it was learned from."""
    found: dict[Any, list[Clip]] = {}
    for index in range(len(indexer.model_.labels)):
        clip = indexer.exemplar(index)
        found.setdefault(clip.label, []).append(clip)
    return found


def _unknown(truth: Sequence[Sequence[KnownEvent] | None] | None, indexer: Any) -> list[str]:
    known = {str(label) for label in indexer.classes_}
    strange = sorted({str(label) for events in truth or [] for label, _, _ in events or []} - known)
    return [f"the model does not know {names(strange)}, which the known events name"] if strange else []


def _scan_show(results: list[RecordingResult]) -> None:
    """The events as a table, with the recording and the person where there are several."""
    from indexing.report.page import even

    found = [(result, event) for result in results for event in result.events]
    scores, margins = even([event.score for _, event in found]), even([event.margin for _, event in found])
    columns, whose = _whose(results)
    rows = [
        [*whose(result), str(event.label), f"{event.start:.2f}", f"{event.end:.2f}", score, margin]
        for (result, event), score, margin in zip(found, scores, margins, strict=True)
    ]
    if rows:
        table([*columns, "action", "start (s) ", "end (s) ", "score ", "margin "], rows)


def _counts_show(results: list[RecordingResult]) -> None:
    """How often each action was performed, and how."""
    from indexing.report.tallies import COUNTS, count_row

    columns, whose = _whose(results)
    rows = [[*whose(result), *count_row(one)] for result in results for one in result.repetitions or ()]
    if rows:
        table([*columns, *COUNTS], rows)


def _whose(results: Sequence[RecordingResult]) -> tuple[list[str], Callable[[RecordingResult], list[str]]]:
    """Headings that tell recordings and people apart, where there are several, and a result's cells below them."""
    named = {"recording": len({result.name for result in results}) > 1, "person": any(result.person for result in results)}
    columns = [name for name, wanted in named.items() if wanted]
    return columns, lambda result: [result.name] * named["recording"] + [result.person] * named["person"]


def _summary(results: list[RecordingResult], seconds: float) -> str:
    """What was found, where, and how long it took; of a recording with several people, its length counts once."""
    from indexing.report.results import by_recording
    from indexing.report.results import seconds as lasts

    found, files = sum(len(result.events) for result in results), by_recording(results)
    length = sum(map(lasts, files))
    where = f"{count(len(files), 'recording')} ({length:.1f} s long)"
    people = sum(bool(result.person) for result in results)
    who = f" of {count(people, 'person', 'people')}" if people else ""
    return f"{count(found, 'action') if found else 'no action'}{who} found in {where} in {seconds:.1f} s"


def _against_truth(results: list[RecordingResult]) -> str:
    """How many of the known actions an event of the same name overlaps, and which are missed."""
    from indexing.report.results import missed

    lost = [(result, event) for result in results for event in missed(result)]
    known = sum(len(result.truth or ()) for result in results)
    named = ", ".join(f"{label} at {start:.2f} to {end:.2f} s" for _, (label, start, end) in lost[:5])
    more = f" and {len(lost) - 5} more" if len(lost) > 5 else ""
    return f"{known - len(lost)} of {count(known, 'known action')} found" + (f"; missed: {named}{more}" if lost else "")


def _right(results: list[RecordingResult]) -> list[str]:
    """Precision and recall of what was reported, where both times overlap by half or more."""
    from indexing.report.results import matched

    compared = [result for result in results if result.truth is not None]
    right, said = sum(map(matched, compared)), sum(len(result.events) for result in compared)
    known = sum(len(result.truth or ()) for result in compared)
    shares = [f"{name} {right / number:.3f}" for name, number in (("precision", said), ("recall", known)) if number]
    return [f"{right} of {said} reported share half of their time or more with a known one ({', '.join(shares)})"] * bool(shares)

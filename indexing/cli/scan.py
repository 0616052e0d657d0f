"""``dyntorch index scan``: find learned actions in long recordings."""

from __future__ import annotations

import dataclasses
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from indexing.cli.console import count, names, progress, say, table
from indexing.cli.inputs import KnownEvent, Reading, assumed, read_recordings, read_truth
from indexing.cli.outputs import check_report

if TYPE_CHECKING:
    from indexing.clip import Clip
    from indexing.indexer import ActionIndexer
    from indexing.report import RecordingResult


@dataclass(frozen=True)
class Scan:
    """Find the actions of a model in untrimmed recordings.

    dyntorch index scan session.json -m moves.safetensors --report out/
    """

    recordings: Annotated[tyro.conf.Positional[tuple[Path, ...]], tyro.conf.arg(metavar="FILE ...", help_behavior_hint="")]
    """keypoint files; a folder in OpenPose form is one recording"""
    model: Annotated[Path, tyro.conf.arg(aliases=("-m",), metavar="FILE")]
    """what 'dyntorch index fit' wrote"""
    report: Annotated[Path | None, tyro.conf.arg(metavar="FOLDER", help_behavior_hint="")] = None
    """where to write report.html, events.csv, timeline.png, metrics.json and manifest.json; without it, print only"""
    truth: Annotated[Path | None, tyro.conf.arg(metavar="CSV", help_behavior_hint="")] = None
    """what is known to have happened: columns label,start,end in seconds (and file, where there are several recordings)"""
    reject: Annotated[float | None, tyro.conf.arg(metavar="R", help_behavior_hint="")] = None
    """rate of false alarms that is accepted, 0 to 1, or else the least score; by default that of the model"""
    reading: Reading = field(default_factory=Reading)

    def run(self) -> int:
        """Read all, scan all, write the report, print the hits."""
        if not self.recordings:
            raise ValueError("no recordings; give at least one keypoint file or folder to search")
        inputs = [*self.recordings, self.model, *([self.truth] if self.truth is not None else [])]
        folder = check_report(self.report, inputs)
        started = time.perf_counter()
        with progress("loading", steps=False):
            from indexing.indexer import ActionIndexer

            indexer = ActionIndexer.load(self.model.expanduser())
            clips = read_recordings(self.recordings, self.reading, indexer.n_joints_, self.model)
        if self.reject is not None:
            indexer.set_params(reject=self.reject)
        truth, notes = (None, []) if self.truth is None else read_truth(self.truth, clips)
        notes = assumed(clips) + notes + _unknown(truth, indexer)
        loaded = time.perf_counter()
        results = [self._scan(indexer, clip, None if truth is None else truth[i], i, len(clips)) for i, clip in enumerate(clips)]
        timings = {"load": loaded - started, "scan": time.perf_counter() - loaded}
        page = None if folder is None else self._write(folder, indexer, results, notes, inputs, timings)
        _show(results)
        for note in notes:
            say(f"note: {note}")
        say(_summary(results, timings["scan"]))
        if truth is not None:
            say(_against_truth(results))
        if page is not None:
            say(f"report: {page}")
        return 0

    def _scan(self, indexer: ActionIndexer, clip: Clip, truth: list[KnownEvent] | None, index: int, total: int) -> RecordingResult:
        from indexing.report import RecordingResult

        which = f" ({index + 1} of {total})" if total > 1 else ""
        with progress(f"scanning {clip.name}{which}") as bar:
            scores, events = indexer.scan(clip, bar)
        mine = [dataclasses.replace(event, exemplar=within_label(indexer, event.exemplar)) for event in events]
        return RecordingResult(clip.name, clip, clip.times, [str(c) for c in indexer.classes_], scores, mine, truth)

    def _write(
        self, folder: Path, indexer: ActionIndexer, results: list[RecordingResult], notes: list[str], inputs: list[Path],
        timings: dict[str, float],
    ) -> Path:  # fmt: skip
        from indexing.files import manifest
        from indexing.report import RecognitionReport, write_recognition

        arguments = {"command": "index scan", **dataclasses.asdict(self)}
        report = RecognitionReport(
            f"Actions in {results[0].name}" if len(results) == 1 else f"Actions in {len(results)} recordings",
            recordings=results,
            exemplars=exemplars(indexer),
            notes=notes,
            manifest=manifest(arguments, [path.expanduser() for path in inputs], indexer.random_state, timings),
        )
        with progress("drawing the report", steps=False):
            return write_recognition(folder, report)


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


def _unknown(truth: list[list[KnownEvent]] | None, indexer: ActionIndexer) -> list[str]:
    known = {str(label) for label in indexer.classes_}
    strange = sorted({str(label) for events in truth or [] for label, _, _ in events} - known)
    return [f"the model does not know {names(strange)}, which the known events name"] if strange else []


def _show(results: list[RecordingResult]) -> None:
    several = len(results) > 1
    rows = []
    for result in results:
        for event in result.events:
            cells = [str(event.label), f"{event.start:.2f}", f"{event.end:.2f}", f"{event.score:.3g}", f"{event.margin:.3g}"]
            rows.append([result.name, *cells] if several else cells)
    columns = ["action", "start (s) ", "end (s) ", "score ", "margin "]
    if rows:
        table(["recording", *columns] if several else columns, rows)


def _summary(results: list[RecordingResult], seconds: float) -> str:
    found, length = sum(len(result.events) for result in results), sum(result.duration for result in results)
    where = f"{count(len(results), 'recording')} ({length:.1f} s long)"
    return f"{count(found, 'action') if found else 'no action'} found in {where} in {seconds:.1f} s"


def _against_truth(results: list[RecordingResult]) -> str:
    """How many of the known actions an event of the same name overlaps, and which are missed."""
    from indexing.report.measures import missed

    lost = [(result, event) for result in results for event in missed(result)]
    known = sum(len(result.truth or ()) for result in results)
    named = ", ".join(f"{label} at {start:.2f} to {end:.2f} s" for _, (label, start, end) in lost[:5])
    more = f" and {len(lost) - 5} more" if len(lost) > 5 else ""
    return f"{known - len(lost)} of {count(known, 'known action')} found" + (f"; missed: {named}{more}" if lost else "")

"""``dyntorch index evaluate``: measure recognition on a labelled clip set."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from indexing.cli.agreement import against_labels
from indexing.cli.console import Progress, check_report, names, progress, say, table
from indexing.cli.films import Pixels, are_films, refuse_film_flags
from indexing.cli.inputs import Following, assumed, usable
from indexing.cli.labels import Labelling, check_labelling

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from indexing.cli.protocol import Fold, Viewing
    from indexing.clip import LabelledSet
    from indexing.report import EvaluationResult

REJECTED = "(rejected)"
Criteria = Annotated[tyro.conf.UseAppendAction[tuple[str, ...]], tyro.conf.arg(metavar="FIELD=VALUES")]


@dataclass(frozen=True)
class Evaluate:
    """Learn from some clips of a set, recognize the others, and say how often that was right.

    dyntorch index evaluate SET.npz --train view=1,2 --test view=3 --report out/

    dyntorch index evaluate SET.npz --leave-out subject --camera virtual --azimuth 0,45,90

    dyntorch index evaluate session.json -m moves.safetensors --labels session.boris      (a model, against what a person marked)

    dyntorch index evaluate mine.eaf --labels yours.eaf      (two people, or a person and what was found)
    """

    clips: Annotated[tyro.conf.Positional[tuple[Path, ...]], tyro.conf.arg(metavar="SET.npz", help_behavior_hint="")]
    """a clip set with labels: joints, or frames (then pixels are learned from); with --labels and -m, recordings; with --labels
    alone, a file of labels"""
    train: Criteria = ()
    """learn from the clips with these values, e.g. view=1,2 (repeat the option for further fields); by default all but --test"""
    test: Criteria = ()
    """ask about these clips; by default all but --train"""
    leave_out: Annotated[str | None, tyro.conf.arg(metavar="FIELD", help_behavior_hint="")] = None
    """instead of --train and --test: ask about each value of this field in turn and learn from the others, e.g. subject"""
    camera: Literal["none", "perspective", "virtual"] = "none"
    """none: clips as they are; perspective: x/z, y/z of 3D joints in camera coordinates; virtual: 3D joints rendered with noise"""
    azimuth: Annotated[str | None, tyro.conf.arg(metavar="DEGREES", help_behavior_hint="(default: 0)")] = None
    """of the virtual cameras of queries, e.g. 0,45,90; examples are seen from 0"""
    exemplars: Literal["2d", "3d"] = "2d"
    """3d: learn from the 3D joints, while queries are still images"""
    shots: Annotated[int | None, tyro.conf.arg(metavar="N", help_behavior_hint="")] = None
    """learn from this many examples per action only, drawn at random"""
    view: Literal["any", "same"] = "any"
    """from where queries are seen: from anywhere, or from about where the examples were"""
    weights: Literal["equal", "learned"] = "equal"
    """of the kinds of evidence; learned: by what serves people best who are left out (clip sets with a field 'subject')"""
    reject: Annotated[float | None, tyro.conf.arg(metavar="R", help_behavior_hint="")] = None
    """share of clips of unknown actions that may be taken for a known one, 0 to 1; any other number is the least score"""
    mirror: bool = True
    """let examples count mirrored, too, where left and right are not different actions"""
    seed: int = 0
    """of noise, cameras and drawn examples"""
    model: Annotated[Path | None, tyro.conf.arg(aliases=("-m",), metavar="FILE", help_behavior_hint="")] = None
    """with --labels: what 'dyntorch index fit' wrote, to be compared with what is marked in the recordings"""
    report: Annotated[Path | None, tyro.conf.arg(metavar="FOLDER", help_behavior_hint="")] = None
    """where to write report.html, confusion.png, metrics.json and manifest.json; without it, print only"""
    labelling: Labelling = field(default_factory=Labelling)
    found_tier: Annotated[str | None, tyro.conf.arg(metavar="NAME", help_behavior_hint="")] = None
    """of the file that is compared with --labels, only this tier"""
    found_observation: Annotated[str | None, tyro.conf.arg(metavar="NAME", help_behavior_hint="")] = None
    """of the file that is compared with --labels, only this observation"""
    reading: Following = field(default_factory=Following)
    pixels: Pixels = field(default_factory=Pixels)

    def run(self) -> int:
        """Read, split, learn and ask for every fold, or compare with labels; write the report and print the numbers."""
        if self.labelling.labels:
            return against_labels(self)
        check_labelling(self.labelling, [], False)
        folder = check_report(self.report, [self.path])
        started = time.perf_counter()
        with progress("loading", steps=False):
            import indexing.action.indexer  # noqa: F401  (its import takes longer than the reading)
            from indexing.cli.protocol import check_classes, splits, strangers

            clips, cameras, notes = self._films() if are_films([self.path]) else self._load()
            folds, warned = splits(clips, self.train, self.test, self.leave_out)
            labels = clips.labels.astype(str)
            check_classes(folds, labels, clips.name)
            folds, few = self._shots(folds, labels)
        notes += warned + few + strangers(folds, labels)
        timings = {"load": time.perf_counter() - started, "learn": 0.0, "recognize": 0.0}
        with progress("learning and recognizing") as bar:
            results = self._measure(clips, labels, folds, cameras, timings, bar)
        from indexing.report.results import recognition

        measured = recognition([result for _, result in results])
        groups = _by_group(results) if self.leave_out is not None else {}
        page = None if folder is None else self._write(folder, [result for _, result in results], groups, notes, timings)
        _show(measured, groups)
        for note in notes:
            say(note if note.startswith("warning") else f"note: {note}")
        low, high = measured["accuracy_interval"]
        say(f"accuracy {measured['accuracy']:.3f} ({measured['clips']:,} clips; 95 % interval {low:.3f} to {high:.3f})")
        say(f"learned in {timings['learn']:.1f} s, recognized in {timings['recognize']:.1f} s")
        if page is not None:
            say(f"report: {page}")
        return 0

    @property
    def path(self) -> Path:
        """The clip set.

        Raises:
            ValueError: it is not one, or something is asked for that needs labels.
        """
        given = [name for name in ("model", "found_tier", "found_observation") if getattr(self, name) is not None]
        if given:
            raise ValueError(f"--{given[0].replace('_', '-')}: to compare with labels; add --labels FILE, or leave it out")
        if len(self.clips) != 1:
            what = names([str(path) for path in self.clips]) if self.clips else "no clip set"
            raise ValueError(f"{what}: give one clip set, SET.npz; or recordings with --labels FILE and --model FILE")
        return self.clips[0]

    def _films(self) -> tuple[LabelledSet[Any], Viewing, list[str]]:
        from indexing.cli import films

        films.refuse_keypoint_flags(self, "camera", "azimuth", "exemplars", "view", "weights", "mirror")
        return films.read_set(self.path, self.reading), films.AsTheyAre(), []

    def _load(self) -> tuple[LabelledSet[Any], Viewing, list[str]]:
        from indexing.cli.protocol import Cameras, check_dims

        refuse_film_flags(self.pixels)
        clips = self.reading.read(self.path)
        if all(clip.label is None for clip in clips):
            raise ValueError(f"{self.path}: says nothing of the actions; give a clip set with 'action' (and 'action_names')")
        clips, notes = usable(clips, self.path)
        cameras = Cameras(self.camera, self._azimuths(), self.exemplars == "3d", self.seed)
        return clips, cameras, notes + assumed(clips, self.path) + check_dims(clips, cameras)

    def _azimuths(self) -> tuple[float, ...]:
        if self.azimuth is None:
            return (0.0,)
        if self.camera != "virtual":
            raise ValueError(f"--azimuth {self.azimuth}: only virtual cameras turn; add --camera virtual")
        try:
            return tuple(float(word) for word in self.azimuth.split(","))
        except ValueError:
            raise ValueError(f"--azimuth {self.azimuth!r}: expected degrees, such as 0,45,90") from None

    def _shots(self, folds: list[Fold], labels: NDArray[np.str_]) -> tuple[list[Fold], list[str]]:
        from indexing.cli.protocol import draw_shots

        if self.shots is None:
            return folds, []
        drawn = [draw_shots(fold, labels, self.shots, self.seed) for fold in folds]
        return [fold for fold, _ in drawn], [note for _, few in drawn for note in few]

    def _measure(
        self, clips: LabelledSet[Any], labels: NDArray[np.str_], folds: list[Fold], cameras: Viewing, timings: dict[str, float],
        bar: Progress,
    ) -> list[tuple[str, EvaluationResult]]:  # fmt: skip
        """One result per fold and camera, each with the name of its fold."""
        from indexing.report import EvaluationResult

        classes = sorted(set(labels))
        out = []
        for number, fold in enumerate(folds):
            started = time.perf_counter()
            examples = [cameras.exemplar(clips[i], int(i)) for i in fold.train]
            indexer = self._indexer(examples).fit(examples, labels[fold.train])
            timings["learn"] += time.perf_counter() - started
            for view, setting in enumerate(cameras.settings):
                queries = [cameras.query(clips[i], int(i), view) for i in fold.test]
                started = time.perf_counter()
                predicted = indexer.predict(queries)
                timings["recognize"] += time.perf_counter() - started
                out.append((fold.name, EvaluationResult(classes, labels[fold.test], predicted, setting or fold.name)))
                bar((number + (view + 1) / len(cameras.settings)) / len(folds))
        return out

    def _indexer(self, examples: list[Any]) -> Any:
        """A new indexer of what the examples are."""
        if are_films([self.path]):
            from indexing.cli.films import frame_rate

            return self.pixels.indexer(frame_rate(examples), reject=self.reject, none_label=REJECTED)
        from indexing.action.indexer import ActionIndexer

        return ActionIndexer(
            view=self.view, weights=self.weights, reject=self.reject, none_label=REJECTED,
            mirror="auto" if self.mirror else False, random_state=self.seed,
        )  # fmt: skip

    def _write(
        self, folder: Path, results: list[EvaluationResult], groups: dict[str, float], notes: list[str], timings: dict[str, float]
    ) -> Path:
        from indexing.files import manifest
        from indexing.report import RecognitionReport, write_recognition

        report = RecognitionReport(
            f"Recognition of {self.path.name}",
            evaluations=results,
            metrics={"accuracy_by_group": groups} if groups else {},
            notes=notes,
            manifest=manifest(
                {"command": "index evaluate", **dataclasses.asdict(self)}, [self.path.expanduser()], self.seed, timings
            ),
        )
        with progress("drawing the report", steps=False):
            return write_recognition(folder, report)


def _by_group(results: list[tuple[str, EvaluationResult]]) -> dict[str, float]:
    """Accuracy of each group that was left out, over all cameras."""
    right: dict[str, list[bool]] = {}
    for name, result in results:
        right.setdefault(name, []).extend(str(a) == str(b) for a, b in zip(result.truth, result.predicted, strict=True))
    return {name: sum(values) / len(values) for name, values in right.items()}


def _show(measured: Mapping[str, Any], groups: dict[str, float]) -> None:
    from indexing.report.results import confused_with

    rows = []
    for name, row in measured["per_class"].items():
        wrong = confused_with(measured["confusion"], name)
        taken = f"{wrong[0]} ({wrong[1]})" if wrong else ""
        if row["clips"]:
            rows.append([name, row["clips"], f"{row['recall']:.3f}", f"{row['precision']:.3f}", taken])
    table(["action", "clips ", "recall ", "precision ", "most often taken for"], rows)
    settings = measured["accuracy_by_setting"]
    shown = settings | {name: value for name, value in groups.items() if name not in settings}
    if set(shown) != {""}:
        table(["setting", "accuracy "], [[name, f"{value:.3f}"] for name, value in shown.items()])

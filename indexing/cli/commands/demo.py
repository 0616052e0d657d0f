"""``dyntorch demo``: the whole way on built-in synthetic people."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from indexing.action.indexer import ActionIndexer
from indexing.actors import ACTIONS, Person, dataset, detect, stream
from indexing.cli.console import Progress, check_folder, check_report, count, progress, say, table
from indexing.cli.flags.geometry import Demo
from indexing.clip import Clip
from indexing.examples import write_examples
from indexing.files import manifest
from indexing.report import EvaluationResult, RecognitionReport, RecordingResult, write_recognition
from indexing.report.recognition import FILES
from indexing.report.results import frame_accuracy, missed_actions
from indexing.skeleton import COCO17
from indexing.windows import concatenate_clips, resample_clips


def run(flags: Demo) -> int:
    """Perform, learn, recognize, search, report."""
    if flags.examples is not None:
        return _examples(flags.examples)
    started = time.perf_counter()
    folder = check_report(flags.out, [], FILES)
    assert folder is not None
    with progress("performing, learning, recognizing") as bar:
        shown = demonstrate(people=flags.people, seed=flags.seed, progress=bar)
    with progress("drawing the report", steps=False):
        made = manifest({"command": "demo", **dataclasses.asdict(flags)}, seed=flags.seed, timings=shown.timings)
        page = write_recognition(folder, demo_report(shown, made))
    _show(shown)
    say(f"Report: {page}")
    say(f"Everything took {time.perf_counter() - started:.1f} s. Next: dyntorch index fit --help")
    return 0


def _examples(folder: Path) -> int:
    """Write the example files and print the commands that use them."""
    folder = check_folder(folder)
    with progress("making the examples", steps=False):
        commands = write_examples(folder)
    say(f"Examples: {folder}. Try there (commands.txt has these lines, too):")
    for command in commands:
        say(f"  {command}")
    return 0


def _show(shown: Demonstration) -> None:

    say(f"Learned {count(len(shown.classes), 'action')} from ONE 2D clip each: one person, one camera, noisy keypoints.")
    others = "one other person" if shown.people == 1 else f"{shown.people} other people"
    say(f"Asked about {others}, seen by that camera and by others turned about the person:")
    rows = [[name, f"{ours:.0%}", f"{plain:.0%}"] for name, (ours, plain) in shown.accuracy().items()]
    table(["camera", "dyntorch ", "2D nearest neighbour "], rows)
    say(f"2D nearest neighbour: {shown.BASELINE}.")
    stream = shown.recording
    known = stream.truth or ()
    say(
        f"Searched {stream.duration:.0f} s of another person, camera turned by {shown.stream_azimuth:g} degrees: "
        f"{len(known) - len(missed_actions(stream))} of {count(len(known), 'known action')} found, {len(stream.events)} reported; "
        f"{frame_accuracy(stream):.0%} of the frames in known actions are right."
    )
    times = shown.timings
    say(
        f"Learning took {times['learn']:.1f} s, recognizing {shown.queries:,} clips {times['recognize']:.1f} s, "
        f"searching {times['search']:.1f} s."
    )


# ----------------------------------------------------------------------------------------------------------------------
# The demonstration: one 2D clip per action is enough to recognize other people from other viewpoints.

AZIMUTHS = (0.0, 45.0, 90.0, 150.0)  # degrees
STREAM_AZIMUTH = 60.0
STEPS = 12  # poses per clip that the baseline compares


@dataclass(frozen=True, eq=False)
class Demonstration:
    """What the demonstration found."""

    BASELINE: ClassVar[str] = (
        f"the clip at the least distance, after both are resampled to {STEPS} poses centred on the hips and scaled to one size"
    )

    classes: Sequence[str]
    people: int
    evaluations: Sequence[EvaluationResult]
    recording: RecordingResult
    stream_azimuth: float
    exemplars: Mapping[Hashable, Clip]
    timings: Mapping[str, float]

    @property
    def queries(self) -> int:
        """Clips recognized."""
        return sum(len(result.truth) for result in self.evaluations)

    def accuracy(self) -> dict[str, tuple[float, float]]:
        """Setting -> share right of the indexer and of the baseline."""
        return {
            result.setting: (
                _share(result.truth, result.predicted),
                _share(result.truth, [] if result.baseline is None else result.baseline),
            )
            for result in self.evaluations
        }


def demonstrate(
    *, people: int = 12, seed: int = 0, actions: Sequence[str] = ACTIONS, progress: Progress | None = None
) -> Demonstration:
    """Learn from one synthetic person in one view; recognize others from elsewhere; search an untrimmed recording."""
    if people < 1:
        raise ValueError(f"people must be 1 or more, got {people}")
    tell = progress or (lambda share: None)
    clock = _Stopwatch()
    teacher, others, walker = (np.random.default_rng([seed, part]) for part in range(3))
    examples = dataset(1, actions, azimuth=0.0, rng=teacher)
    tell(0.02)
    queries = dataset(people, actions, azimuth=AZIMUTHS, rng=others)
    clock.lap("perform")
    tell(0.35)
    indexer = ActionIndexer(random_state=seed).fit(examples, examples.labels)
    clock.lap("learn")
    tell(0.45)
    evaluations = []
    for number, azimuth in enumerate(AZIMUTHS):
        asked = queries.select(azimuth=azimuth)
        predicted = indexer.predict(asked)
        clock.lap("recognize")
        plain = nearest_2d(list(examples), examples.labels, list(asked))
        clock.lap("baseline")
        setting = f"turned {azimuth:g}°"
        evaluations.append(EvaluationResult(list(actions), asked.labels, predicted, setting, baseline=plain))
        tell(0.45 + 0.1 * (number + 1))
    recording = _search(indexer, actions, walker, lambda share: tell(0.85 + 0.15 * share), clock)
    exemplars: dict[Hashable, Clip] = {str(clip.label): clip for clip in examples}
    return Demonstration(list(actions), people, evaluations, recording, STREAM_AZIMUTH, exemplars, clock.laps)


def _search(
    indexer: ActionIndexer, actions: Sequence[str], rng: np.random.Generator, tell: Progress, clock: _Stopwatch
) -> RecordingResult:
    """All actions in random order by somebody else, seen from elsewhere."""
    order = [actions[i] for i in rng.permutation(len(actions))]
    solid, truth = stream(order, Person.random(rng), rng=rng)
    seen = detect(solid, azimuth=STREAM_AZIMUTH, rng=rng)
    clock.lap("perform")
    scores, events = indexer.scan(seen, tell)
    clock.lap("search")
    # one example per action: it is number 0 of its label
    found = [dataclasses.replace(event, exemplar=0) for event in events]
    name = f"A recording of another person, camera turned by {STREAM_AZIMUTH:g} degrees"
    return RecordingResult(name, seen, seen.times, [str(label) for label in indexer.classes_], scores, found, truth)


def nearest_2d(examples: Sequence[Clip], labels: Sequence[Any] | NDArray[Any], queries: Sequence[Clip]) -> NDArray[Any]:
    """Labels of the nearest examples by plain 2D shape: the baseline that is bound to the viewpoint."""
    known, asked = _shapes(examples), _shapes(queries)
    nearest = ((asked[:, None] - known[None]) ** 2).sum(axis=2).argmin(axis=1)
    return np.asarray(np.asarray(labels)[nearest])


def _shapes(clips: Sequence[Clip]) -> NDArray[np.float64]:
    values = resample_clips(concatenate_clips(clips), STEPS).numpy().astype(np.float64)
    hips = [COCO17.joints.index(f"{side}_hip") for side in ("left", "right")]
    shapes = (values - values[:, :, hips].mean(axis=2, keepdims=True)).reshape(len(values), -1)
    return np.asarray(shapes / np.linalg.norm(shapes, axis=1, keepdims=True))


def demo_report(shown: Demonstration, made: Mapping[str, Any]) -> RecognitionReport:
    """The page about it."""
    others = "one other person" if shown.people == 1 else f"{shown.people} other people"
    return RecognitionReport(
        "One example per action is enough",
        summary=(
            f"{len(shown.classes)} actions were learned from one 2D clip each: one synthetic person, one camera, keypoints with a "
            f"detector's noise, gaps and mistakes. Then {others} did them, seen by that camera and by others turned about the "
            "person. Last, the actions were searched in an untrimmed recording of one more person. All people are synthetic; "
            "run 'dyntorch index evaluate' for figures on your own recordings."
        ),
        recordings=[shown.recording],
        evaluations=shown.evaluations,
        exemplars=shown.exemplars,
        baseline=("2D nearest neighbour", shown.BASELINE),
        manifest=made,
    )


def _share(truth: Sequence[Any] | NDArray[Any], answers: Sequence[Any] | NDArray[Any]) -> float:
    return float(np.mean(np.asarray(truth).astype(str) == np.asarray(answers).astype(str)))


class _Stopwatch:
    """Seconds spent per step."""

    def __init__(self) -> None:
        self.laps: dict[str, float] = {}
        self._last = time.perf_counter()

    def lap(self, name: str) -> None:
        now = time.perf_counter()
        self.laps[name] = self.laps.get(name, 0.0) + now - self._last
        self._last = now

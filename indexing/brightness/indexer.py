"""BrightnessIndexer: learn actions from one to a few videos each and recognize them in others, from pixels alone."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any, Self

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from sklearn.utils.validation import check_is_fitted

from dyntorch.numerics import one_thread
from indexing.action.inputs import check_labels
from indexing.brightness.descriptors import LENGTH, SMALLEST, BrightnessOptions, Optics
from indexing.brightness.stream import (
    BrightnessStream,
    Recognizer,
    VideoExemplars,
    build_library,
    find_events,
    learn_descriptors,
    mirrors_matter,
    recognize,
    wrong_evidence,
)
from indexing.brightness.videos import Footage, footage, gather
from indexing.clip import is_number
from indexing.estimator import (
    POSITIVE,
    REJECT,
    SECONDS,
    Rule,
    ScoreClassifier,
    is_whole,
    one_of,
)
from indexing.modelfile import Parts, labels_from_json, labels_to_json, read_fields, tensors_of
from indexing.opening import quote
from indexing.scoring import Event, join_labels, reject_threshold

MIN_WINDOW_FRAMES = 5.0  # of exercises at 15 per second, 0 / 60 degrees, 3 name .816 / .690 of the frames, 5 .821 / .751

# ----------------------------------------------------------------------------------------------------------------------
# Parameters of the brightness indexer, checked once.


LARGEST = 100_000  # px of the shorter side: films have some thousand


def is_region(region: Any) -> bool:
    """Whether a value says which part of the frames is looked at."""
    if region is None or (isinstance(region, str) and region == "motion"):
        return True
    fine = isinstance(region, (Sequence, np.ndarray)) and not isinstance(region, str) and len(region) == 4
    return bool(fine and all(is_number(v) for v in region) and region[2] > region[0] and region[3] > region[1])


Array = NDArray[Any]


class BrightnessIndexer(ScoreClassifier):
    r"""Recognize actions in videos without tracks or keypoints.

    Brightness differences weighted by image gradients, :math:`h = I_t \nabla I` (the rows of the thesis's direct measure), are
    rectified and kept where they are: pooled in the cells of a box about what moves, and in rows across the body.  An online
    warping compares them with every exemplar frame and remembers a fraction of a second.

    **What of this is the thesis.**  Its own measure, the rank of the rows of h over a short window, keeps no image position;
    alone it names 12 of 18 arm-raise videos of another person, .54 of their moving frames, and .37 / .37 of the frames of
    exercises, camera turned by 0 / 60 degrees.  The rows h, rectified, with their position kept, and followed by a box about what
    moves, name 18, .963 and .82 / .75.  ``python -m experiments.recognition.brightness_indexing`` measures both.  Mixed into
    these scores at .6 the measure cost more than it gave (12, .61, .59 / .56), so it no longer is.

    Args:
        fps: frame rate of videos given as arrays, and at which everything is compared.
        window: seconds that the warping remembers, at least 5 frames.
        region: ``"motion"``: about what has moved, followed causally, and a little of the whole image; ``None``: the whole image
            alone, which knows a turned camera better (.81 / .78) and a person who stands elsewhere, or at another size, not at
            all; ``(x0, y0, x1, y1)``: that part of it alone, in pixels.
        flip: exemplars also count mirrored: ``"auto"``: unless left and right are different actions here; ``True``; ``False``.
        reject: ``None``: closed set.  A number between 0 and 1: the rate at which a video may find the evidence that
            exemplars find in wrong actions; any other number: the least :meth:`evidence` that is accepted.
        none_label: what :meth:`predict` answers for a rejected video.
        pool: seconds over which :meth:`score_frames` averages, backwards from each frame.
        size: px of the longer side of the image that is worked on.
        device: where to compute, e.g. ``"cuda"``.
        options: what is known of the videos, and what it costs (:class:`indexing.BrightnessOptions`); None: the defaults.

    Attributes:
        classes_: ``(classes,)`` labels as given.  exemplars_: what is kept of the videos.  flip_: whether mirrored exemplars
            count.  reject_threshold_: evidence below it is rejected, or ``None``.

    Example:
        >>> from indexing.actors import Person, perform
        >>> from indexing.actors.textured import render_clip
        >>> def video(action, who):
        ...     return render_clip(perform(action, Person.random(who), rng=who), azimuth=0, image=(80, 60), rng=who)
        >>> indexer = BrightnessIndexer().fit([video("wave", 0), video("squat", 0)], ["wave", "squat"])
        >>> [str(label) for label in indexer.predict([video("squat", 1), video("wave", 1)])]
        ['squat', 'wave']

    Source: Wolf 2003, chapter 7 and section 10.1 (direct measure, after Irani 1999); rectified channels after Efros et al. 2003.
    """

    FITTED = "exemplars_"
    FORMAT = "dyntorch.brightness-indexer"
    VERSION = 1
    OPTIONS = BrightnessOptions
    RULES = {
        "fps": POSITIVE,
        "window": POSITIVE,
        "pool": SECONDS,
        "region": Rule(is_region, "'motion', None or (x0, y0, x1, y1) in pixels with x0 < x1 and y0 < y1"),
        "flip": one_of("auto", True, False),
        "reject": REJECT,
        "options": Rule(lambda value: value is None or isinstance(value, BrightnessOptions), "None or indexing.BrightnessOptions"),
        "size": Rule(
            lambda value: is_whole(value) and SMALLEST <= value <= LARGEST,
            f"a whole number of pixels from {SMALLEST} to {LARGEST}",
        ),
    }

    def __init__(
        self,
        *,
        reject: float | None = None,
        none_label: Any = -1,
        fps: float = 30.0,
        window: float = 0.18,
        region: Any = "motion",
        flip: bool | str = "auto",
        pool: float = 0.33,
        size: int = 80,
        device: str = "cpu",
        options: BrightnessOptions | None = None,
    ) -> None:
        self.fps = fps
        self.window = window
        self.region = region
        self.flip = flip
        self.reject = reject
        self.none_label = none_label
        self.pool = pool
        self.size = size
        self.device = device
        self.options = options

    # ---- files -------------------------------------------------------------------------------------------------------
    @classmethod
    def _stored_parameters(cls, header: Mapping[str, Any]) -> dict[str, Any]:
        parameters = dict(header["parameters"])
        weight = parameters.pop("temporal_weight", 0.0)  # of older files
        if weight != 0.0:
            raise ValueError(f"temporal_weight={quote(weight)}: window kernels are no longer mixed into scores")
        return parameters

    def _export_state(self) -> tuple[dict[str, Any], dict[str, torch.Tensor]]:
        return {"classes": labels_to_json(self.classes_)}, tensors_of(self.exemplars_)

    def _restore(self, header: Mapping[str, Any], parts: Parts) -> None:
        classes = labels_from_json(header["classes"])
        self._learn(_read_exemplars(parts, len(classes)), classes)

    # ---- learning ----------------------------------------------------------------------------------------------------
    @one_thread
    def fit(self, videos: Iterable[Any], labels: ArrayLike) -> Self:
        """Learn from videos; one per action is enough.

        Args:
            videos: list of ``(frames, height, width)`` uint8 or float arrays (colour: ``(..., 3)``), of paths of files, which
                are read chunk by chunk (twice), of :class:`indexing.video.Video`, or of lists of :class:`indexing.video.Chunk`.
            labels: ``(videos,)``.

        Raises:
            ValueError: naming the video or the parameter, what is wrong and what to do.
        """
        self.check_parameters()
        found = gather(videos, float(self.fps))
        classes, numbers = np.unique(check_labels(labels, len(found)), return_inverse=True)
        if len(classes) < 2:
            raise ValueError(f"labels: only one class ({classes.tolist()[0]!r}); give videos of two or more actions")
        return self._learn(self._exemplars(found, numbers), classes)

    @one_thread
    def partial_fit(self, videos: Iterable[Any], labels: ArrayLike, classes: ArrayLike | None = None) -> Self:
        """Learn from further videos, of known or new actions.  Fits where nothing was fitted yet.

        What was learned of the earlier ones stays; of where people stand, the further videos tell each other alone, so scores
        may differ by some thousandths from those of one :meth:`fit` to all.
        """
        if not hasattr(self, "exemplars_"):
            return self.fit(videos, labels)
        self.check_parameters()
        if self._optics() != self._learned_optics:
            raise ValueError("fps, region, size or options were changed since fit; set them back, or fit all videos again")
        found = gather(videos, float(self.fps))
        values = join_labels(self.classes_[self.exemplars_.labels.numpy()], check_labels(labels, len(found)))
        known, numbers = np.unique(values, return_inverse=True)
        old = len(self.exemplars_.labels)
        more = self._exemplars(found, numbers[old:])
        labels = torch.cat([torch.from_numpy(numbers[:old]), more.labels])
        return self._learn(self.exemplars_.join(more, labels), known)

    def _exemplars(self, videos: list[Footage], numbers: Array) -> VideoExemplars:
        views = learn_descriptors(videos, self._optics())
        labels = np.repeat(numbers, [len(each) for each in views])
        return VideoExemplars.of([one for each in views for one in each], torch.from_numpy(labels))

    def _learn(self, exemplars: VideoExemplars, classes: Array) -> Self:
        """Learn everything, and only then change anything."""
        if self.reject is not None and self.none_label in classes.tolist():
            raise ValueError(f"none_label={self.none_label!r} is one of the learned labels; choose another for rejected videos")
        flip = self.flip is True
        if self.flip == "auto":
            flip = not mirrors_matter(self._recognizer(exemplars, len(classes), False), exemplars)
        self.recognizer_ = self._recognizer(exemplars, len(classes), flip)
        self.exemplars_, self.classes_, self.flip_ = exemplars, classes, flip
        self._learned_optics = self._optics()
        self._calibrate()
        return self

    def _recognizer(self, exemplars: VideoExemplars, classes: int, flip: bool) -> Recognizer:
        window, pool = max(MIN_WINDOW_FRAMES, self.window * self.fps), max(1.0, self.pool * self.fps)
        placed = build_library(exemplars.to(self.device), classes, flip, self._options.num_directions)
        return Recognizer(self._optics(), placed, window, pool)

    def _optics(self) -> Optics:
        region = self.region
        if region is not None and not isinstance(region, str):
            x0, y0, x1, y1 = (float(v) for v in region)
            region = (x0, y0, x1, y1)
        return Optics(float(self.fps), int(self.size), region, self.device, self._options)

    def _calibrate(self) -> None:
        wrong = torch.zeros(0)
        if self.reject is not None and 0 < self.reject < 1:
            wrong = wrong_evidence(self.recognizer_, self.exemplars_)[0]
        self.reject_threshold_ = reject_threshold(self.reject, wrong)

    # ---- recognition -------------------------------------------------------------------------------------------------
    @one_thread
    def decision_function(self, videos: Iterable[Any]) -> Array:
        """``(videos, classes)`` scores from 0 to about 1, larger is better; 0 where nothing moves."""
        check_is_fitted(self, "exemplars_")
        found = gather(videos, float(self.fps))
        return np.stack([recognize(self._stream(video.own_rate, video.name), video) for video in found])

    # ---- long recordings ---------------------------------------------------------------------------------------------
    def stream(self, fps: float | None = None) -> BrightnessStream:
        """A stream to push frames into as they come: ``stream.push(frame)`` gives ``(classes,)`` scores.

        Args:
            fps: frame rate of the stream, where it is another than the indexer's.
        """
        check_is_fitted(self, "exemplars_")
        if fps is not None and not (np.isfinite(fps) and fps > 0):
            raise ValueError(f"fps must be a positive number of frames per second, got {fps!r}")
        return self._stream(fps, "stream")

    def _stream(self, fps: float | None, name: str) -> BrightnessStream:
        return BrightnessStream(self.recognizer_, len(self.classes_), name, fps)

    @one_thread
    def score_frames(self, video: Any) -> Array:
        """``(frames, classes)`` score of every frame of an untrimmed video; that of frame t needs the frames up to t alone."""
        return self._scan(video, None)[1]

    def find(self, video: Any) -> list[Event]:
        """The actions in an untrimmed video, in order of time: label, start, end (seconds), score and margin.

        An event needs a class to stand out from the mean of all further than wrong actions do among the exemplars, at a rate
        of ``reject`` (0.3 by default).  Nothing is found where nothing moves.
        """
        return self.scan(video)[2]

    @one_thread
    def scan(self, video: Any, progress: Callable[[float], None] | None = None) -> tuple[Array, Array, list[Event]]:
        """Times ``(frames,)`` in seconds, :meth:`score_frames` and :meth:`find` in one pass.

        Args:
            progress: called with the share done, 0..1.
        """
        times, scores, energy = self._scan(video, progress)
        wrong = wrong_evidence(self.recognizer_, self.exemplars_)[1]
        return times, scores, find_events(scores, times, energy, self.classes_, wrong, self.reject)

    def _scan(self, video: Any, progress: Callable[[float], None] | None) -> tuple[Array, Array, Array]:
        check_is_fitted(self, "exemplars_")
        source = footage(video, "video", float(self.fps))
        stream = self._stream(source.own_rate, source.name)
        begin, end = (0.0, 1.0) if progress is None else source.span
        parts = []
        for frames, times in source:
            parts.append((times, *stream.scan(frames, times)))
            if progress is not None:
                progress(min(1.0, (float(times[-1]) - begin) / max(end - begin, 1e-9)))
        times, scores, energy = (np.concatenate(part) for part in zip(*parts, strict=True))
        return times, scores, energy


def _read_exemplars(parts: Parts, classes: int) -> VideoExemplars:
    if classes < 2:
        raise ValueError(f"{classes} class")
    sizes = {"classes": classes, "descriptor": LENGTH}
    found = VideoExemplars(**read_fields(VideoExemplars, parts, sizes))
    if not bool((found.lengths > 0).all()) or int(found.lengths.sum()) != sizes["frames"]:
        raise ValueError(f"lengths: videos of {quote(found.lengths.tolist())} frames, and {sizes['frames']} are there")
    return replace(found, motion=found.motion.float())

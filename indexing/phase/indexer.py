"""PhaseIndexer: which action a single frame belongs to, and how far the action has come in it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any, Self

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from sklearn.utils.validation import check_is_fitted
from torch import Tensor

from dyntorch.numerics import one_thread
from indexing.action.bank import Windows, stack
from indexing.action.exemplars import mirror_permutation
from indexing.action.inputs import check_queries, gather, gather_labels
from indexing.clip import Clip, stretches
from indexing.estimator import POSITIVE, REJECT, SECONDS, Rule, ScoreClassifier, is_whole, one_of
from indexing.joints import layout_of
from indexing.modelfile import (
    Parts,
    labels_from_json,
    labels_to_json,
    read_fields,
    skeleton_from_json,
    skeleton_to_json,
    tensors_of,
)
from indexing.modelfile import read_integer as whole_number
from indexing.opening import quote
from indexing.phase.learning import learn_model
from indexing.phase.model import (
    MIN_CALIBRATED_CLASSES,
    MIN_FRAME_JOINTS,
    Course,
    PhaseModel,
    PhaseOptions,
    event_levels,
    images,
    query_frames,
)
from indexing.scoring import Event, events, reject_threshold, same_label, smooth

MAX_JOINTS = 10_000  # of a model file; the largest layouts have some hundred
MAX_CYCLE_RATE = 3.0  # per second, where phases are averaged over a window
NUM_RATES = 61  # that are tried, from backwards to forwards

# ----------------------------------------------------------------------------------------------------------------------
# Parameters and phases that users hand in, checked once.


def check_reject(indexer: PhaseIndexer, classes: list[Any]) -> None:
    """Raise where a rate cannot be calibrated, or a refused clip would look like a known one."""
    if indexer.reject is None:
        return
    if any(same_label(value, indexer.none_label) for value in classes):
        raise ValueError(f"none_label={indexer.none_label!r} is one of the learned labels; choose another for rejected clips")
    if 0 < indexer.reject < 1 and len(classes) < MIN_CALIBRATED_CLASSES:
        raise ValueError(
            f"reject={indexer.reject!r} is calibrated by leaving a class out, which takes {MIN_CALIBRATED_CLASSES} classes, got "
            f"{len(classes)}; give further ones, or a threshold outside 0..1"
        )


def check_phases(phases: Sequence[Any] | None, clips: list[Clip], owners: list[int]) -> list[Tensor | None]:
    """For each clip its phases ``(frames,)`` float64, or ``None``."""
    if phases is None:
        return [None] * len(clips)
    if len(phases) != owners[-1] + 1:
        raise ValueError(f"phases: expected one entry per clip ({owners[-1] + 1}), got {len(phases)}; give None for a clip without")
    out: list[Tensor | None] = []
    for clip, owner in zip(clips, owners, strict=True):
        if phases[owner] is None:
            out.append(None)
            continue
        values = np.asarray(phases[owner], dtype=np.float64)
        if values.shape != (len(clip),):
            raise ValueError(f"phases: clip {owner} has {len(clip)} frames, but its phases have shape {values.shape}")
        if not np.isfinite(values).any():
            raise ValueError(f"phases: no phase of clip {owner} is known; give None to have them found")
        out.append(torch.from_numpy(values))
    return out


# ----------------------------------------------------------------------------------------------------------------------
# Phases of neighbouring frames agree on a rate: what a window adds to single frames.


Array = NDArray[Any]


def smooth_phases(phase: Array, times: Array, seconds: float, periodic: Array) -> Array:
    r"""``(T, classes)`` phases, each from its neighbours too."""
    out = np.full_like(phase, np.nan)
    rates = np.linspace(-MAX_CYCLE_RATE, MAX_CYCLE_RATE, NUM_RATES)
    for i, time in enumerate(times):
        near = np.abs(times - time) <= seconds / 2
        for c, turns in enumerate(periodic):
            known = near & np.isfinite(phase[:, c])
            if not known.any():
                continue
            if not turns:
                out[i, c] = np.median(phase[known, c])
                continue
            total = np.exp(2j * np.pi * (phase[known, c] - rates[:, None] * (times[known] - time))).sum(1)
            best = total[np.abs(total).argmax()]
            out[i, c] = (np.angle(best) / (2 * np.pi)) % 1.0 % 1.0
    return out


class PhaseIndexer(ScoreClassifier):
    r"""Recognize actions in single frames, and say how far each of them has come.

    The joints of an action at phase :math:`\phi` span, with all cameras, the subspace :math:`S(\phi) = \mathrm{span}[1, X(\phi)]`
    in Gr(4, n): the dynamic shape tensor in its all-joint form.  X is a Fourier series for an action that repeats and a polynomial
    for one that does not, learned from frames that may each come from another camera.  A frame's residual outside S, least over
    the phases, is joined with its distance from the nearest training images at that phase and held against its distance from
    the images of the other actions.

    Args:
        harmonics: of the series of an action that repeats; polynomials have twice the degree.
        course: ``"auto"``: an action repeats where its clips do; ``"periodic"``; ``"once"``: from the start of a clip to its end.
        camera: ``"affine"``: the shape of a frame as cameras from afar see it; ``"projective"``: from near by, where nearer
            joints are larger.  Phases of walking are 12.6 and 11.5 degrees off at 2 m, 12.7 and 11.5 at 3 m, 12.1 and 11.9
            at 10 m; the AUC is the same near by and .002 lower from afar.
        reject: ``None``: closed set.  A number between 0 and 1: the rate at which a second of an unknown action may be taken for a
            known one, calibrated by leaving each class out (three classes at least).  Any other number: the least
            :meth:`evidence` that is accepted.
        none_label: what :meth:`predict` answers for a rejected clip.
        fps: frame rate of clips given as arrays.
        mirror: ``"auto"``: where an action half a cycle later is its own mirror image (gait), frames also count mirrored;
            ``True``: in every action that repeats; ``False``: never.
        window: seconds of neighbours that a frame's score and phase are averaged over; 0: every frame from itself alone.
        device: where frames are compared, in ``fit`` too, e.g. ``"cuda"``; what was learned is kept on the CPU.
        options: what is learned from, and what it costs (:class:`~indexing.phase.model.PhaseOptions`); None: the defaults.

    Attributes:
        classes_: ``(classes,)`` labels as given.  periodic_: ``(classes,)`` which of them repeat.
        mirrored_: ``(classes,)`` which of them are their own mirror image half a cycle later.
        n_joints_: joints per frame.  model_: the learned :class:`~indexing.phase.model.PhaseModel`.
        reject_threshold_: evidence below it is rejected, or ``None``.

    Example:
        >>> from indexing.actors import dataset
        >>> clips = dataset(2, ["walk", "squat"], azimuth=0, rng=0)
        >>> indexer = PhaseIndexer(harmonics=3).fit(clips, clips.labels)
        >>> scores, phase = indexer.score_frames(clips[0]), indexer.phase(clips[0])
        >>> scores.shape == phase.shape == (len(clips[0]), 2), str(indexer.predict([clips[0]])[0])
        (True, 'walk')

    Source: Wolf 2003, chapter 4 (dynamic shape tensors) and section 10.1.
    """

    FITTED = "model_"
    FORMAT = "dyntorch.phase-indexer"
    VERSION = 1
    OPTIONS = PhaseOptions
    RULES = {
        "course": one_of("auto", "periodic", "once"),
        "camera": one_of("affine", "projective"),
        "mirror": one_of("auto", True, False),
        "harmonics": Rule(lambda value: is_whole(value) and 1 <= value <= 12, "a whole number from 1 to 12"),
        "fps": POSITIVE,
        "window": SECONDS,
        "reject": REJECT,
        "options": Rule(lambda value: value is None or isinstance(value, PhaseOptions), "None or indexing.PhaseOptions"),
    }

    def __init__(
        self,
        harmonics: int = 4,
        *,
        course: str = "auto",
        camera: str = "affine",
        reject: float | None = None,
        none_label: Any = -1,
        fps: float = 30.0,
        mirror: str | bool = "auto",
        window: float = 0.0,
        device: str = "cpu",
        options: PhaseOptions | None = None,
    ) -> None:
        self.harmonics = harmonics
        self.course = course
        self.camera = camera
        self.reject = reject
        self.none_label = none_label
        self.fps = fps
        self.mirror = mirror
        self.window = window
        self.device = device
        self.options = options

    @one_thread
    def fit(self, clips: Iterable[Any], labels: ArrayLike | None = None, phases: Sequence[Any] | None = None) -> Self:
        """Learn from clips.

        Args:
            clips: of :class:`Clip`, or ``(frames, joints, 2 | 3)`` arrays, or tuples of synchronized views of one performance.
            labels: ``(clips,)``; by default the clips' own.  One class alone is scored by how well it fits, not against others.
            phases: for each clip ``(frames,)`` numbers, NaN = not known, of which whole cycles do not matter in an action that
                repeats (0 to 1 in one that does not); or ``None`` for a clip, and all clips of its action are then measured.
                By default they are found from the clips; where a cycle begins is then arbitrary.

        Raises:
            ValueError: naming the clip or the parameter, what is wrong and what to do.
        """
        self.check_parameters()
        items = list(clips) if isinstance(clips, Iterable) and not isinstance(clips, (Clip, str, bytes)) else clips
        found, owners = gather(items, self.fps)
        values = gather_labels(found, owners, labels)
        if found[0].joints.shape[1] < MIN_FRAME_JOINTS:
            raise ValueError(
                f"clips: {found[0].joints.shape[1]} joints, but a frame needs {MIN_FRAME_JOINTS} to tell its phase; "
                "give more joints"
            )
        given = check_phases(phases, found, owners)
        classes, numbers = np.unique(values, return_inverse=True)
        check_reject(self, classes.tolist())
        skeleton = layout_of(found)
        views, which = [], []
        for k, clip in enumerate(found):
            seen_as = images(clip)
            views += seen_as
            which += [k] * len(seen_as)
        order = sorted(range(len(views)), key=lambda i: (str(numbers[which[i]]), views[i].joints.tobytes()))
        model, mirrored = learn_model(
            [views[i] for i in order],
            torch.from_numpy(numbers[which])[order].long(),
            [given[which[i]] for i in order],
            harmonics=self.harmonics,
            course=self.course,
            mirror=self.mirror,
            device=self.device,
            camera=self.camera,
            swap=lambda windows, seen: mirror_permutation(skeleton, windows, seen),
            options=self._options,
        )
        self.model_: PhaseModel = model
        self.classes_ = classes
        self.periodic_ = np.array([course.periodic for course in model.courses])
        self.mirrored_ = np.array(mirrored)
        self.n_joints_ = int(found[0].joints.shape[1])
        self.skeleton_ = skeleton
        self.reject_threshold_ = reject_threshold(self.reject, model.wrong)
        return self

    # ---- files -------------------------------------------------------------------------------------------------------
    def _export_state(self) -> tuple[dict[str, Any], dict[str, Tensor]]:
        about = {
            "classes": labels_to_json(self.classes_),
            "joints": self.n_joints_,
            "mirrored": self.mirrored_.tolist(),
            "periodic": self.periodic_.tolist(),
            "skeleton": skeleton_to_json(self.skeleton_),
        }
        tensors = tensors_of(self.model_)
        for c, course in enumerate(self.model_.courses):
            tensors |= tensors_of(course, f"course.{c}.")
        return about, tensors

    def _restore(self, header: Mapping[str, Any], parts: Parts) -> None:
        classes, joints = (
            labels_from_json(header["classes"]),
            whole_number(header["joints"], "joints", MIN_FRAME_JOINTS, MAX_JOINTS),
        )
        periodic, mirrored = (_flags(header[name], name, len(classes)) for name in ("periodic", "mirrored"))
        sizes = {"classes": len(classes), "joints": joints, "basis": 2 * self.harmonics + 1}
        courses = tuple(
            Course(**read_fields(Course, parts, sizes, f"course.{c}."), periodic=bool(periodic[c])) for c in range(len(classes))
        )
        courses = tuple(replace(course, shapes=course.shapes.double()) for course in courses)
        if not all(len(course.shapes) for course in courses):
            raise ValueError("course: an action without a shape")
        fields = read_fields(PhaseModel, parts, sizes)
        fields |= {"bank": Windows(fields["bank"].values.double(), fields["bank"].seen), "phase": fields["phase"].double()}
        self.skeleton_ = skeleton_from_json(header["skeleton"], joints)
        self.model_ = PhaseModel(**fields, courses=courses, options=self._options, camera=self.camera)
        self.classes_, self.periodic_, self.n_joints_, self.mirrored_ = classes, periodic, joints, mirrored
        self.reject_threshold_ = reject_threshold(self.reject, self.model_.wrong)

    # ---- single frames -----------------------------------------------------------------------------------------------
    @one_thread
    def analyse(self, clip: Any) -> tuple[Array, Array]:
        """:meth:`score_frames` and :meth:`phase` in one pass."""
        check_is_fitted(self, "model_")
        (found,) = check_queries([clip], self.fps, self.n_joints_, self.skeleton_, fewest=1, recordings=True)
        scores, phase = (part.cpu().numpy() for part in self._evidence([found]))
        if self.window > 0:
            phase = smooth_phases(phase, found.times, self.window, self.periodic_)
            scores = smooth(scores, found.times, self.window)
        return np.asarray(scores), np.asarray(phase)

    @one_thread
    def score_frames(self, clip: Any) -> Array:
        """``(frames, classes)`` score of every frame, from itself alone unless ``window`` is set; larger is better.

        0 means as near to the frames of the other actions as to those of this one; a frame that shows fewer than six joints scores
        0 for every class.
        """
        return self.analyse(clip)[0]

    def phase(self, clip: Any) -> Array:
        """``(frames, classes)`` where in each action the frame would be, were it of that action.

        In [0, 1) of the cycle of an action that repeats; from 0, its start, to 1, its end, in one that does not; NaN where fewer
        than six joints are seen.  Where an action goes the same way back (a squat), one frame cannot tell down from up.
        """
        return self.analyse(clip)[1]

    def _evidence(self, clips: Sequence[Clip]) -> tuple[Tensor, Tensor]:
        """Scores and phases of all frames, end to end."""
        return self.model_.to(self.device).evidence(stack([query_frames(clip) for clip in clips]).to(self.device))

    # ---- clips -------------------------------------------------------------------------------------------------------
    @one_thread
    def decision_function(self, clips: Iterable[Any]) -> Array:
        """``(clips, classes)`` mean of the frames' scores; columns are ``classes_``."""
        check_is_fitted(self, "model_")
        found = check_queries(clips, self.fps, self.n_joints_, self.skeleton_, fewest=1, recordings=True)
        scores = self._evidence(found)[0].split([len(clip) for clip in found])
        return np.stack([part.mean(0).cpu().numpy() for part in scores])

    @one_thread
    def find(self, clip: Any) -> list[Event]:
        """The actions in an untrimmed recording, in order of time: where the mean score of a second stands out.

        An event needs a class to score further than wrong actions do, at a rate calibrated by leaving classes out: ``reject``,
        else 0.1 (outside 0..1 it is the least score an event needs).  Two classes have little to stand out from: add a class of
        ordinary movement.
        """
        check_is_fitted(self, "model_")
        (found,) = check_queries([clip], self.fps, self.n_joints_, self.skeleton_, fewest=1, recordings=True)
        if len(self.classes_) < 2:
            raise ValueError("find needs two classes at least to tell one from the other; fit clips of ordinary movement too")
        scores = self._evidence([found])[0].cpu().numpy()
        levels = event_levels(self.model_.wrong, self.reject)
        second = self._options.event_seconds
        parts = [slice(first, end) for first, end in stretches(found.times, second).tolist()]  # no event reaches across a gap
        return [
            event
            for part in parts
            for event in events(smooth(scores[part], found.times[part], second), found.times[part], list(self.classes_), *levels)
        ]


def _flags(values: Any, name: str, count: int) -> NDArray[np.bool_]:
    if not isinstance(values, list) or len(values) != count or not all(isinstance(value, bool) for value in values):
        raise ValueError(f"{name}: expected {count} truth values, got {quote(values)}")
    return np.array(values, dtype=bool)

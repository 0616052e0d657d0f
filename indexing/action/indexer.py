"""ActionIndexer: learn actions from one to a few clips each, recognize them in others, find them in long recordings."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, Self

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from sklearn.utils.validation import check_is_fitted

from dyntorch.numerics import one_thread
from indexing.action.background import (
    FALSE_ALARM_RATE,
    BackgroundClips,
    cut_background,
    event_level,
    find_similar_kinds,
    perform_other_actions,
    remove_background,
    replay_clips,
    segment_evidence,
)
from indexing.action.bank import Windows
from indexing.action.confidence import class_probabilities
from indexing.action.exemplars import (
    CROPS,
    MAX_WINDOWS,
    NUM_VIEWS,
    NUM_VIEWS_SOLID,
    ExemplarPlan,
    Exemplars,
    clip_seconds,
    cut_exemplars,
    mirror_permutation,
)
from indexing.action.inputs import check_common, check_plan, check_queries, gather, gather_groups, gather_labels
from indexing.action.learning import Lesson, learn
from indexing.action.model import ShapeModel, read_shape_model
from indexing.action.stream import ActionOptions, Stream
from indexing.clip import Clip, check_fps
from indexing.estimator import POSITIVE, RANDOM_STATE, REJECT, Rule, SavedClassifier, is_positive, is_whole, one_of
from indexing.joints import layout_of
from indexing.modelfile import Parts, labels_from_json, labels_to_json, skeleton_from_json, skeleton_to_json, tensors_of
from indexing.modelfile import read_integer as whole_number
from indexing.recordings.decoding import Explanation, Withheld, decode
from indexing.recordings.live import ActionStream, LiveSource
from indexing.scoring import Event, join_labels, refuse, reject_threshold, same_label
from indexing.skeleton import Skeleton
from indexing.windows import concatenate_clips, repair_clip, resample_clips

Array = NDArray[Any]


MAX_KINDS_STORED = 10_000  # joints, or kinds of background, of a model file; the largest layouts have some hundred
TEMPI = 100  # at most: a recording is compared once for each of them


class ActionIndexer(SavedClassifier):
    r"""Recognize actions from keypoints, from other viewpoints than they were learned from.

    Two affine images of one space-time shape (all joints over all frames) obey one linear relation, so the largest canonical
    correlation between their coordinate spaces is 1 whatever the two viewpoints are (thesis chapter 7, rank conditions).
    The distance of that correlation from 1, fused over three ways of centring, finds the nearest exemplar; a kernel machine
    over virtual views of the exemplars is added to it.

    Args:
        view: ``"any"``: queries may be seen from elsewhere; ``"same"``: from about where the exemplars were.  Declared, never
            guessed: cross-validation inside one view always prefers what is bound to that view.
        weights: ``"equal"``, or ``"learned"``: how much each kind of evidence counts, and how sure it is, by what serves people
            best who were left out (needs to know who performs: see :meth:`fit`).
        reject: ``None``: closed set.  A number between 0 and 1: the rate at which clips of an unknown action may be taken
            for a known one, calibrated by leaving each class out of the training clips.  Any other number: the least
            :meth:`evidence` that is accepted.
        none_label: what :meth:`predict` answers for a rejected clip.
        fps: frame rate of clips given as arrays.
        length: steps that a window is resampled to.
        search: also compare with crops of the exemplars (extent and tempo).
        mirror: ``"auto"``: exemplars also count mirrored, unless left and right are different actions here; ``True``:
            always; ``False``: never.
        scorer: ``"both"``, ``"nearest"`` (no training, fastest) or ``"kernel"``; ``view="same"`` uses the kernel machine.
        virtual_views: copies of every exemplar for the kernel machine; by default 4, and 12 where exemplars have depth.
        repair: replace joints that jump where their clip gives no reason to (:mod:`indexing.windows`);
            costs nothing on clean clips.
        window, stride, tempi: of the short windows of long recordings: seconds (half an ordinary exemplar at most), seconds between
            those of exemplars, speed factors tried.
        random_state: of the virtual views.
        device: where clips are compared, in ``fit`` too, e.g. ``"cuda"``; what was learned is kept on the CPU.
        options: how long recordings are read (:class:`~indexing.action.stream.ActionOptions`); None: the defaults.

    Attributes:
        classes_: ``(classes,)`` labels as given.  model_: the learned :class:`~indexing.action.model.ShapeModel`.
        n_joints_: joints per frame.  skeleton_: their names, where the clips had them.  groups_: who performed each exemplar.
        reject_threshold_: evidence below it is rejected, or ``None``.

    Example:
        >>> from indexing.actors import Person, dataset
        >>> actors = dataset(3, ["squat", "wave", "kick"], azimuth=0, rng=0)
        >>> indexer = ActionIndexer().fit(actors.select(subject=0), actors.select(subject=0).labels)
        >>> turned = dataset(3, ["squat", "wave", "kick"], azimuth=60, rng=1).select(subject=1)
        >>> [str(label) for label in indexer.predict(turned)]
        ['squat', 'wave', 'kick']

    Source: Wolf 2003, chapters 4 and 7 and section 10.1.
    """

    FITTED = "model_"
    FORMAT = "dyntorch.action-indexer"
    VERSION = 2
    OPTIONS = ActionOptions
    RULES = {
        "view": one_of("any", "same"),
        "weights": one_of("equal", "learned"),
        "scorer": one_of("both", "nearest", "kernel"),
        "mirror": one_of("auto", True, False),
        "fps": POSITIVE,
        "window": POSITIVE,
        "stride": POSITIVE,
        "tempi": Rule(
            lambda value: isinstance(value, Iterable) and 0 < len(list(value)) <= TEMPI and all(map(is_positive, value)),
            f"1 to {TEMPI} positive speed factors such as (0.7, 1.0, 1.4)",
        ),
        "length": Rule(lambda value: is_whole(value) and value >= 4, "a whole number, 4 or more"),
        "virtual_views": Rule(lambda value: value is None or (is_whole(value) and value >= 0), "a whole number, 0 or more"),
        "reject": REJECT,
        "random_state": RANDOM_STATE,
        "options": Rule(lambda value: value is None or isinstance(value, ActionOptions), "None or indexing.ActionOptions"),
    }

    def __init__(
        self,
        view: str = "any",
        weights: str = "equal",
        reject: float | None = None,
        none_label: Any = -1,
        fps: float = 30.0,
        *,
        length: int = 12,
        search: bool = True,
        mirror: str | bool = "auto",
        scorer: str = "both",
        virtual_views: int | None = None,
        repair: bool = True,
        window: float = 1.0,
        stride: float = 0.3,
        tempi: Sequence[float] = (0.7, 1.0, 1.4),
        random_state: int = 0,
        device: str = "cpu",
        options: ActionOptions | None = None,
    ) -> None:
        self.view = view
        self.weights = weights
        self.reject = reject
        self.none_label = none_label
        self.fps = fps
        self.length = length
        self.search = search
        self.mirror = mirror
        self.scorer = scorer
        self.virtual_views = virtual_views
        self.repair = repair
        self.window = window
        self.stride = stride
        self.tempi = tempi
        self.random_state = random_state
        self.device = device
        self.options = options

    # ---- files -------------------------------------------------------------------------------------------------------
    @classmethod
    def _stored_parameters(cls, header: Mapping[str, Any]) -> dict[str, Any]:
        if header.get("layout") is not None:
            raise ValueError("layout: depth of 2D examples is no longer guessed")
        parameters = {name: value for name, value in header["parameters"].items() if name not in ("depth", "pool")}  # older files
        return {**parameters, "tempi": tuple(parameters["tempi"])}

    def _export_state(self) -> tuple[dict[str, Any], dict[str, torch.Tensor]]:
        model, tensors = self.model_, tensors_of(self.model_)
        if model.kernels is not None and model.kernels.scales is not None:
            tensors["scales"] = model.kernels.scales
        about = {
            "classes": labels_to_json(self.classes_),
            "hidden": model.hidden,
            "joints": self.n_joints_,
            "view": model.view,
            "scorer": model.scorer,
            "blend": dataclasses.asdict(model.blend),
            "groups": None if self.groups_ is None else self.groups_.tolist(),
            "skeleton": skeleton_to_json(self.skeleton_),
        }
        return about, tensors

    def _restore(self, header: Mapping[str, Any], parts: Parts) -> None:
        self.classes_ = labels_from_json(header["classes"])
        self.n_joints_ = whole_number(header["joints"], "joints", 1, MAX_KINDS_STORED)
        self.skeleton_ = skeleton_from_json(header["skeleton"], self.n_joints_)
        hidden = whole_number(header.get("hidden", 0), "hidden", 0, MAX_KINDS_STORED)  # older files know no background
        crops = len(CROPS) if self.search else 1
        self.model_: ShapeModel = read_shape_model(
            parts, header, len(self.classes_), hidden, self.n_joints_, int(self.length), crops
        )
        self.groups_ = _groups(header["groups"], len(self.model_.labels))
        self._calibrate()

    # ---- learning ----------------------------------------------------------------------------------------------------
    @one_thread
    def fit(
        self,
        clips: Iterable[Any],
        labels: ArrayLike | None = None,
        groups: ArrayLike | None = None,
        background: Iterable[Any] | None = None,
    ) -> Self:
        """Learn from clips.

        Of one action alone, too: a background is then made of the clips played otherwise and, where the joints have names, of
        synthetic people who do other things (:mod:`indexing.action.background`).  Of more than 10,000 clips a part of each class is
        compared with all, and trains the kernel machine, which a warning says.

        Args:
            clips: of :class:`Clip`, or ``(frames, joints, 2 | 3)`` arrays, or tuples of synchronized views of one
                performance (an array ``(views, frames, joints, 2)`` too).  One 2D clip per action is enough.
            labels: ``(clips,)``; by default the clips' own.
            groups: ``(clips,)`` who performs, for ``weights="learned"``; by default the clips' field ``subject``, if all have it.
            background: clips or recordings, of any length, of other movement: what resembles them more than the actions is none.

        Raises:
            ValueError: naming the clip or the parameter, what is wrong and what to do.
        """
        self.check_parameters()
        items, owners = gather(clips, self.fps)
        people = gather_groups(items, owners, groups)
        values = gather_labels(items, owners, labels)
        classes, numbers = np.unique(values, return_inverse=True)
        rng = np.random.default_rng(self.random_state)
        other = self._make_background(items, len(classes) == 1, background)
        plan = self._plan(NUM_VIEWS_SOLID if any(clip.dims == 3 for clip in items) else NUM_VIEWS)
        exemplars = cut_exemplars([*items, *other.clips], plan, rng)
        numbers = np.concatenate([numbers, len(classes) + other.numbers])
        if people is not None:
            people = np.concatenate([people, [f"background: {kind}" for kind in other.kinds]])
        if len(classes) == 1:
            chosen = self._select_exemplars(exemplars, numbers, 1, np.arange(len(numbers)) < len(items), other)
            if not chosen[len(items) :].any():
                raise ValueError(
                    f"labels: only one class ({classes[0]!r}), and however its clips are played otherwise they come out the same; "
                    "give background=, a recording of other movement, or clips of a second action"
                )
            exemplars, numbers, people = _select(chosen, exemplars, numbers, people)
        given = slice(len(items), len(items) + sum(other.trusted))
        return self._learn(exemplars, classes, numbers, layout_of(items), people, given)

    def _make_background(self, clips: Sequence[Clip], alone: bool, background: Iterable[Any] | None) -> BackgroundClips:
        """What is not one of the actions: what was given, and where there is one action alone what is made."""
        skeleton = layout_of(clips)
        other = BackgroundClips()
        if background is not None:
            lengths = [clip_seconds(clip) for clip in clips]
            other += cut_background(background, self.fps, clips[0].joints.shape[1], skeleton, float(np.median(lengths)))
        if alone:
            # a generator of its own: what is made does not hang on how the exemplars are seen
            rng = np.random.default_rng(0)
            people = perform_other_actions(skeleton, 3 if all(clip.dims == 3 for clip in clips) else 2, rng)
            other += people + replay_clips(clips, not len(people), rng)
        return other

    def _select_exemplars(
        self, exemplars: Exemplars, numbers: Array, num_known: int, new: Array, background: BackgroundClips | None = None
    ) -> Array:
        """``(N,)`` bool, all exemplars but the background that comes out too much like new ones."""
        hidden = numbers >= num_known
        compared = new | hidden
        labels = np.where(hidden, numbers - num_known + 1, 0)[compared]
        kinds = background.kinds if background is not None else ("",) * int(hidden.sum())
        chosen = np.ones(len(numbers), dtype=bool)
        chosen[hidden] = ~find_similar_kinds(exemplars.select(torch.from_numpy(compared)), labels, kinds)
        if background is not None:
            chosen[hidden] |= np.array(background.trusted)
        return chosen

    @one_thread
    def partial_fit(
        self,
        clips: Iterable[Any],
        labels: ArrayLike | None = None,
        classes: ArrayLike | None = None,
        groups: ArrayLike | None = None,
    ) -> Self:
        """Learn from further clips, of known or new actions; the earlier ones stay.  Fits where nothing was fitted yet."""
        if not hasattr(self, "model_"):
            return self.fit(clips, labels, groups)
        self.check_parameters()
        items, owners = gather(clips, self.fps, self.n_joints_, self.skeleton_)
        people = gather_groups(items, owners, groups)
        if self.weights == "learned" and (people is None) != (self.groups_ is None):
            here, there = ("these clips", "the earlier ones") if people is not None else ("the earlier clips", "these")
            raise ValueError(f"groups: {here} say who performs, {there} do not; give groups=, or clips with the field 'subject'")
        both = None if people is None or self.groups_ is None else np.concatenate([self.groups_, people])
        values = gather_labels(items, owners, labels)
        before = self.model_.labels.numpy()
        known = before < self.model_.num_known  # the others are background
        all_classes, joined = np.unique(join_labels(self.classes_[before[known]], values), return_inverse=True)
        numbers = np.concatenate([before - self.model_.num_known + len(all_classes), joined[known.sum() :]])
        numbers[: len(before)][known] = joined[: known.sum()]
        check_plan(self, len(CROPS) if self.search else 1, self.model_.exemplars)
        plan = self._plan(len(self.model_.exemplars.views) // len(before))
        seed = 0 if self.random_state is None else self.random_state
        rng = np.random.default_rng([seed, len(before)])
        exemplars = self.model_.exemplars.join(cut_exemplars(items, plan, rng))
        if self.model_.hidden:
            chosen = self._select_exemplars(exemplars, numbers, len(all_classes), np.arange(len(numbers)) >= len(before))
            if len(all_classes) > 1 or chosen[numbers >= len(all_classes)].any():
                exemplars, numbers, both = _select(chosen, exemplars, numbers, both)
        return self._learn(exemplars, all_classes, numbers, self.skeleton_, both)

    def _plan(self, views: int) -> ExemplarPlan:
        views = views if self.virtual_views is None else self.virtual_views
        return ExemplarPlan(self.length, self.search, views, self.view == "any", self.repair, self.window, self.stride)

    def _learn(
        self,
        exemplars: Exemplars,
        classes: Array,
        numbers: Array,
        skeleton: Skeleton | None,
        groups: Array | None,
        given: slice = slice(0, 0),
    ) -> Self:
        """Learn everything, and only then change anything; given: exemplars of background that are known not to be the action."""
        originals, symmetry = exemplars.crop(0), None
        if self.mirror:
            symmetry = mirror_permutation(skeleton, originals.values[:MAX_WINDOWS], originals.seen[:MAX_WINDOWS])
        if self.mirror is True and symmetry is None:
            raise ValueError(
                "mirror=True: the joints' mirror images are not known; give clips a skeleton with names, or mirror='auto'"
            )
        hidden = int(numbers.max()) + 1 - len(classes)
        if (hidden or self.reject is not None) and any(same_label(value, self.none_label) for value in classes.tolist()):
            raise ValueError(f"none_label={self.none_label!r} is one of the learned labels; choose another for rejected clips")
        lesson = Lesson(
            view=self.view,
            scorer="kernel" if self.view == "same" else self.scorer,
            learned=self.weights == "learned",
            groups=None if groups is None else torch.from_numpy(np.unique(groups, return_inverse=True)[1]).long().to(self.device),
            symmetry=symmetry,
            guard=self.mirror == "auto",
            hidden=hidden,
        )
        there, labels = exemplars.to(self.device), torch.from_numpy(numbers).long().to(self.device)
        model = learn(there, labels, len(classes) + hidden, lesson).to("cpu")
        if len(classes) == 1 and given.stop > given.start:
            # these tell by themselves how near other movement comes to the action
            model = dataclasses.replace(model, evidence_out=model.evidence(originals[given]))
        self.model_ = model
        self.groups_ = groups
        self.classes_ = classes
        self.n_joints_ = int(exemplars.crops.values.shape[2])
        self.skeleton_ = skeleton
        self._calibrate()
        return self

    def _calibrate(self) -> None:
        self.reject_threshold_ = reject_threshold(self._rate, self.model_.evidence_out, self.model_.num_calibration_classes)

    @property
    def _rate(self) -> float | None:
        """The rate of false alarms that is asked for: of one action alone there is always one."""
        return FALSE_ALARM_RATE if self.reject is None and len(self.classes_) == 1 else self.reject

    @property
    def _evidence_level(self) -> float:
        return -np.inf if self.reject_threshold_ is None else self.reject_threshold_

    # ---- recognition -------------------------------------------------------------------------------------------------
    def _queries(self, clips: Iterable[Any]) -> Windows:
        check_is_fitted(self, "model_")
        items = check_queries(clips, self.fps, self.n_joints_, self.skeleton_)
        source = concatenate_clips(items, self.repair)
        check_common(items, source.seen, self.model_.joint_sets())
        return Windows(resample_clips(source, self.length), torch.from_numpy(source.seen)).to(self.device)

    def _model(self) -> ShapeModel:
        check_is_fitted(self, "model_")
        return self.model_.to(self.device)

    @one_thread
    def decision_function(self, clips: Iterable[Any]) -> Array:
        """``(clips, classes)`` scores, larger is better; columns are ``classes_``."""
        return np.asarray(self._model().scores(self._queries(clips)).cpu().numpy())[:, : len(self.classes_)]

    @one_thread
    def evidence(self, clips: Iterable[Any]) -> Array:
        """``(clips,)`` how well a clip shows a known action rather than another one, comparable between clips.

        The nearest-exemplar score of the best class, how far it stands above the next and above the mean of all, and how usual
        the scores of all classes are beside one another (:func:`indexing.action.model.evidence`).
        """
        return np.asarray(self._model().evidence(self._queries(clips)).cpu().numpy())

    @one_thread
    def predict_proba(self, clips: Iterable[Any]) -> Array:
        """``(clips, classes)`` probabilities of the known classes, rows sum to 1; the best is that of :meth:`decision_function`.

        A softmax of the scores that is as sharp as answers were right, of other people, from other sides and badly seen, whose
        best class stood as far above the next one (:mod:`indexing.action.confidence`).  Where there is a background, what is
        missing to 1 is its probability.
        """
        return class_probabilities(self._model(), self._queries(clips))[:, : len(self.classes_)]

    @one_thread
    def predict(self, clips: Iterable[Any]) -> Array:
        """``(clips,)`` labels; ``none_label`` where ``reject`` is set and no class explains the clip, and for background."""
        query = self._queries(clips)
        model = self._model()
        nearest = None if self.reject_threshold_ is None else model.nearest_scores(query)
        numbers = model.scores(query, nearest).argmax(dim=1).cpu().numpy()
        refused = numbers >= model.num_known
        labels = self.classes_[np.where(refused, 0, numbers)]
        if self.reject_threshold_ is not None:
            refused = refused | (model.evidence(query, nearest) < self.reject_threshold_).cpu().numpy()
        return refuse(labels, refused, self.none_label)

    # ---- long recordings ---------------------------------------------------------------------------------------------
    def _stream(self) -> Stream:
        return Stream(self.length, self.window, tuple(self.tempi), self.device, self._options)

    @one_thread
    def decode(self, clip: Any, progress: Callable[[float], None] | None = None) -> Explanation:
        """An untrimmed recording as segments: scores of its frames, events, and what was held back and why.

        Args:
            progress: called with the share done, 0..1.
        """
        check_is_fitted(self, "model_")
        (recording,) = check_queries([clip], self.fps, self.n_joints_, self.skeleton_, recordings=True)
        times, begin = recording.times, float(recording.times[0])
        recording = recording.replace(times=times - begin)  # rounding must not depend on what the clock shows
        recording = repair_clip(recording) if self.repair else recording
        model = self._model()
        labels = [*self.classes_.tolist(), *(("background", i) for i in range(model.hidden))]
        result = decode(model, recording, self._stream(), labels, None if model.hidden else self.reject, progress)
        if model.hidden:
            floor, level = event_level(model, self._rate), self._evidence_level
            result = remove_background(
                result, self.classes_.tolist(), floor, lambda some: segment_evidence(model, recording, some, self.length) >= level
            )

        def shift(event: Event) -> Event:
            return dataclasses.replace(event, start=event.start + begin, end=event.end + begin)

        withheld = [Withheld(shift(one.event), one.reason) for one in result.withheld]
        return dataclasses.replace(result, times=times, events=[shift(event) for event in result.events], withheld=withheld)

    @one_thread
    def scan(self, clip: Any, progress: Callable[[float], None] | None = None) -> tuple[Array, list[Event]]:
        """:meth:`score_frames` and :meth:`find` in one pass.

        Args:
            progress: called with the share done, 0..1.
        """
        result = self.decode(clip, progress)
        return result.scores, list(result.events)

    @one_thread
    def score_frames(self, clip: Any, progress: Callable[[float], None] | None = None) -> Array:
        """``(frames, classes)`` score of every frame of an untrimmed recording, larger is better.

        The logarithm of how likely the frame belongs to a performance of each class, summed over all explanations of the recording
        as segments of the lengths that the exemplars have.
        """
        return self.scan(clip, progress)[0]

    @one_thread
    def find(self, clip: Any, progress: Callable[[float], None] | None = None) -> list[Event]:
        """The actions in an untrimmed recording, in order of time: one event per performance, with label, start, end (seconds),
        score and margin.

        The best explanation of the recording as segments: each is worth its resemblance to whole exemplars and to short windows of
        them, by how long it lasts, and must be worth more than no action at all, which is worth more while the person rests.
        Cyclic actions that touch are one event.  ``reject`` asks for more: a rate at which wrong actions may reach an event's
        score, or, outside 0..1, the least score.  Two or three classes have little to stand out from: add one of ordinary
        movement.
        """
        return self.scan(clip, progress)[1]

    def stream(
        self, fps: float | None = None, *, lag: float | None = None, up: str = "y", skeleton: Skeleton | None = None
    ) -> ActionStream:
        """A stream to push frames into as they come: ``stream.push(joints)`` gives what is decided by then.

        Args:
            fps: of frames that are pushed without times, where it is another than the indexer's.
            lag: seconds after its end at which an event is told; by default a quarter more than the longest action takes, and what
                it takes to look at a moment.
            up, skeleton: of the frames, as of a :class:`Clip`; without a skeleton joints are taken in the order of those learned.

        Raises:
            ValueError: a frame rate that no camera has, or a lag that is shorter than an action.
        """
        model = self._model()
        source = LiveSource(
            model,
            tuple(self.classes_.tolist()),
            self._stream(),
            self._rate if model.hidden else self.reject,
            self._evidence_level,
            self.repair,
            self.n_joints_,
            self.skeleton_,
            check_fps(self.fps if fps is None else fps),
        )
        return ActionStream(source, lag, up, skeleton)

    def exemplar(self, index: int) -> Clip:
        """Exemplar number ``index`` as it is compared: resampled, y up, and as long as it was, where the model knows."""
        check_is_fitted(self, "model_")
        exemplars = self.model_.exemplars
        windows, seconds = exemplars.crop(0), exemplars.seconds
        joints = windows.values[index].numpy().copy()
        joints[:, ~windows.seen[index].numpy()] = np.nan
        timing: dict[str, Any] = {}
        if seconds is not None:
            timing["times"] = (np.arange(len(joints)) + 0.5) * max(float(seconds[index]), 1e-3) / len(joints)
        number = int(self.model_.labels[index])
        label = self.classes_[number] if number < len(self.classes_) else self.none_label
        return Clip(joints, label=label, skeleton=self.skeleton_, name=f"exemplar {index}", **timing)


def _select(chosen: Array, exemplars: Exemplars, numbers: Array, people: Array | None) -> tuple[Exemplars, Array, Array | None]:
    """Some exemplars, their classes numbered anew, and who performs them."""
    numbers = np.unique(numbers[chosen], return_inverse=True)[1]
    return exemplars.select(torch.from_numpy(chosen)), numbers, None if people is None else people[chosen]


def _groups(names: Any, exemplars: int) -> Array | None:
    if names is None:
        return None
    if len(names) != exemplars or not all(isinstance(name, str) for name in names):
        raise ValueError(f"groups: {len(names)} names for {exemplars} exemplars")
    return np.array(names, dtype=str)

"""What is not the action: further classes of a model that are learned and never reported, so that one action alone can be.

They are made of three sources.  Synthetic people who do other things, seen from anywhere, where the joints go by names that theirs
have; the clip itself, played otherwise: by other joints and, where there are no such people, backwards, its halves exchanged, in
another order; and recordings of other movement that somebody gives.  What comes out too much like the action is left out: a squat
played backwards is a squat, and so is somebody else's.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from indexing.action.bank import Windows
from indexing.action.exemplars import Exemplars
from indexing.action.inputs import as_clips
from indexing.action.learning import Lesson, learn
from indexing.action.model import ShapeModel, class_scores
from indexing.actors import ACTIONS, dataset
from indexing.clip import Clip, stretches
from indexing.joints import FEWEST, has_names, match_all, match_joints
from indexing.recordings.decoding import Explanation, Withheld
from indexing.recordings.evidence import MIN_CYCLIC
from indexing.scoring import Event
from indexing.skeleton import Skeleton
from indexing.windows import check_clips, concatenate_clips, sample

NUM_PEOPLE = 2  # synthetic people who perform other actions
NUM_CAMERAS = 2  # that see each of their performances
NUM_EXCHANGES = 2  # times that the clip is played with the movement of each joint done by another one
# below it synthetic people may do the action itself: the same one by others stands at -10 to -16, another at -3.6 to -9.9
SIMILAR_ACTION_RESIDUAL = -9.5
# the same of clips played otherwise: symmetric in time -14 to -19 (jumping jack -9), others -6 to -11.7
SIMILAR_REPLAY_RESIDUAL = -12.0
MAX_PIECES = 60  # of recordings given as background: evenly spread
MAX_KINDS = 6  # that the pieces of one recording make
MIN_PIECE_SHOWN = 0.5  # share of a piece's frames that must show the person
FALSE_ALARM_RATE = 0.1  # where one action is learned and reject is None

Array = NDArray[Any]


@dataclass(frozen=True)
class BackgroundClips:
    """Clips that are not the action, and of which kind each is: kinds are classes of the model that are never reported."""

    clips: tuple[Clip, ...] = ()
    kinds: tuple[str, ...] = ()
    trusted: tuple[bool, ...] = ()

    def __len__(self) -> int:
        return len(self.clips)

    def __add__(self, other: BackgroundClips) -> BackgroundClips:
        return BackgroundClips(self.clips + other.clips, self.kinds + other.kinds, self.trusted + other.trusted)

    @property
    def numbers(self) -> Array:
        """``(clips,)`` the number of each clip's kind."""
        return np.asarray(np.unique(np.array(self.kinds, dtype=str), return_inverse=True)[1])


def _collect(found: Sequence[tuple[str, Clip]], trusted: bool) -> BackgroundClips:
    return BackgroundClips(tuple(clip for _, clip in found), tuple(kind for kind, _ in found), (trusted,) * len(found))


ORDERS = ("backwards", "halves exchanged", "another order")


def replay_clips(clips: Sequence[Clip], ordered: bool, random_state: np.random.Generator) -> BackgroundClips:
    """The clips with the movement of each joint done by another one, and in another order."""
    found = []
    for clip in clips:
        frames = np.arange(len(clip))
        quarters = np.array_split(frames, 4)
        orders = (frames[::-1], np.roll(frames, len(frames) // 2), np.concatenate([quarters[i] for i in (2, 0, 3, 1)]))
        for name, order in zip(ORDERS, orders, strict=True) if ordered else ():
            found.append((name, clip.replace(joints=clip.joints[order], confidence=None)))
        seen = np.asarray(clip.seen.any(axis=0))
        middle = np.zeros((1, *clip.joints.shape[1:]), dtype=clip.joints.dtype)
        middle[0, seen] = np.nanmean(clip.joints[:, seen], axis=0)
        for number in range(NUM_EXCHANGES):
            order = np.arange(len(seen))
            order[seen] = random_state.permutation(order[seen])
            joints = middle + (clip.joints - middle)[:, order]
            found.append((f"other joints {number}", clip.replace(joints=joints, confidence=None)))
    return _collect(found, False)


def perform_other_actions(skeleton: Skeleton | None, dims: int, random_state: np.random.Generator) -> BackgroundClips:
    """Synthetic people who do everyday actions, each seen from somewhere; nothing where the joints cannot be told by name."""
    if not has_names(skeleton):
        return BackgroundClips()
    azimuth = None if dims == 3 else [float(a) for a in random_state.uniform(0.0, 360.0, NUM_CAMERAS)]
    found = []
    for clip in dataset(NUM_PEOPLE, ACTIONS, azimuth=azimuth, rng=random_state):
        try:
            found.append((str(clip.label), match_joints(clip, skeleton)[0]))
        except ValueError:  # too few joints have these names
            return BackgroundClips()
    return _collect(found, False)


def cut_background(
    background: Iterable[Any], fps: float, joints: int, skeleton: Skeleton | None, seconds: float
) -> BackgroundClips:
    """Recordings of other movement, cut into pieces as long as an action."""
    try:
        clips = [part for item in as_clips(background, fps) for part in (item if isinstance(item, tuple) else (item,))]
        clips = match_all(clips, skeleton)
        check_clips(clips, joints, recordings=True)
    except ValueError as problem:
        raise ValueError(f"background: {problem}") from None
    found = [piece for number, clip in enumerate(clips) for piece in _cut_pieces(clip, number, seconds)]
    if not found:
        raise ValueError(
            f"background: no {seconds:.3g} s without a gap in {len(clips)} clips show anybody; give a recording of other movement"
        )
    kept = np.unique(np.linspace(0, len(found) - 1, MAX_PIECES).round().astype(int))
    return _collect([found[i] for i in kept], True)


def _cut_pieces(clip: Clip, number: int, seconds: float) -> list[tuple[str, Clip]]:
    """Pieces of a recording, half a piece apart; neighbours are of one kind, of which a recording gives a few."""
    found = []
    for first, end in stretches(clip.times).tolist():
        times = clip.times[first:end]
        room = max(0.0, float(times[-1] - times[0]) - seconds)
        for start in times[0] + np.linspace(0.0, room, 1 + int(np.ceil(2 * room / seconds))):
            inside = first + np.flatnonzero((times >= start - 1e-9) & (times <= start + seconds + 1e-9))
            joints = clip.joints[inside]
            shown = np.isfinite(joints).all(axis=2)
            if len(inside) < 2 or int(shown.any(axis=0).sum()) < FEWEST or shown.any(axis=1).mean() < MIN_PIECE_SHOWN:
                continue
            found.append(clip.replace(joints=joints, times=clip.times[inside], confidence=None))
    parts = min(MAX_KINDS, len(found))
    label = f"recording {number}" if clip.label is None else str(clip.label)
    return [(f"{label}, part {i * parts // len(found)}" if clip.label is None else label, one) for i, one in enumerate(found)]


# ----------------------------------------------------------------------------------------------------------------------
# What of it is too much like the action, and what a recording tells once background is taken out.


def find_similar_kinds(exemplars: Exemplars, numbers: Array, kinds: Sequence[str]) -> Array:
    """``(kinds,)`` bool, which of the made exemplars are of a kind that may be the action itself."""
    labels = torch.from_numpy(np.asarray(numbers))
    classes = int(labels.max()) + 1
    model = learn(exemplars, labels, classes, Lesson(scorer="nearest", hidden=classes - 1))
    own = labels == 0
    scores = class_scores(model.residuals(exemplars.crop(0)[own]) + model.hub, labels, classes)
    nearest = -scores.amax(dim=0)[labels[~own]].numpy()
    again = exemplars.cyclic is not None and float(exemplars.cyclic[own].median()) > MIN_CYCLIC
    replayed = np.array([kind in ORDERS or kind.startswith("other joints") for kind in kinds])
    cycle = np.array([again and kind in ORDERS for kind in kinds])
    return np.asarray((nearest < np.where(replayed, SIMILAR_REPLAY_RESIDUAL, SIMILAR_ACTION_RESIDUAL)) | cycle)


def event_level(model: ShapeModel, rate: float | None) -> float:
    """The least score of an event, at which other movement is reported at the rate that is asked for."""
    if rate is None:
        return -np.inf
    if not 0 < rate < 1:
        return float(rate)
    labels, owner = model.labels, model.exemplars.owner
    scores = model.moment_scores(model.exemplars.moments)
    total = scores.new_zeros(len(labels), model.classes).index_add_(0, owner, scores)
    own = torch.nn.functional.one_hot(labels, model.classes).bool()
    mean = (total / torch.bincount(owner, minlength=len(labels))[:, None]).masked_fill(own, torch.nan)
    contrast = (mean - mean.nanmean(dim=1, keepdim=True)).masked_fill(own, -torch.inf)
    best, other = contrast[:, : model.num_known].amax(dim=1), contrast[:, model.num_known :].amax(dim=1)
    wrong = torch.where(best > other, best, -torch.inf)
    if model.num_known == 1:
        wrong = wrong[labels > 0]  # nothing is left that its own exemplars could be taken for
    return float(np.quantile(wrong.cpu().numpy(), 1 - rate, method="higher"))


def segment_evidence(model: ShapeModel, clip: Clip, events: Sequence[Event], length: int) -> Array:
    """``(events,)`` the evidence of segments of a recording, each asked as if it had been cut out by hand."""
    if not events:
        return np.zeros(0)
    source, owner = concatenate_clips([clip]), np.zeros(len(events), dtype=np.intp)
    begin, end = (np.array([getattr(event, name) for event in events]) for name in ("start", "end"))
    windows = Windows(sample(source, owner, begin, end, length), torch.from_numpy(source.seen[owner]))
    return np.asarray(model.evidence(windows.to(model.labels.device)).cpu().numpy())


def remove_background(
    told: Explanation, classes: Sequence[Any], least: float, enough: Callable[[Sequence[Event]], NDArray[np.bool_]]
) -> Explanation:
    """What is said of the known actions: other movement is left out, or told as held back where it has their evidence."""
    known = len(classes)
    scores = told.scores[:, :known]
    likely = np.exp(scores).sum(axis=1).clip(0.0, 1.0)
    held = [one for one in told.withheld if one.event.label in told.classes[:known]]
    mine = [event for event in told.events if event.label in told.classes[:known]]
    good = enough(mine)
    events = [event for event, fine in zip(mine, good, strict=True) if fine and event.score >= least]
    held += [
        Withheld(event, "below the level") for event, fine in zip(mine, good, strict=True) if not (fine and event.score >= least)
    ]
    # background wins everywhere else; where the action has evidence, too, that is worth telling
    others = [event for event in told.events if event.label not in told.classes[:known]]
    for event, like in zip(others, enough(others), strict=True):
        inside = (told.times >= event.start) & (told.times <= event.end)
        if like and inside.any():
            label = classes[int(scores[inside].mean(axis=0).argmax())]
            held.append(Withheld(dataclasses.replace(event, label=label), "other movement"))
    held.sort(key=lambda one: one.event.start)
    return dataclasses.replace(told, classes=tuple(classes), scores=scores, events=events, withheld=held, background=1.0 - likely)

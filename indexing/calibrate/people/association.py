"""Who is who in all cameras, which nobody calibrated: the stages, from the people of each camera's tracker to identities."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from dyntorch import Clocks, Status
from dyntorch.core import Notice, Outcome, status_from
from indexing.calibrate.people.assignment import (
    Assignment,
    PeopleNotice,
    assign,
    certainties,
    estimate_clocks,
    estimate_spanning_tree,
    find_ambiguous_people,
    find_unrelated_cameras,
    identities,
    split_inconsistent,
)
from indexing.calibrate.people.pair_geometry import MIN_SEED_SECONDS, PieceView, arrange
from indexing.calibrate.people.tracklets import Booleans, CameraSightings, Floats, Integers, sightings, split_tracks
from indexing.clip import Clip
from indexing.joints import has_names, places
from indexing.skeleton import Skeleton
from indexing.sync.people import MIN_COMMON_JOINTS
from indexing.sync.recordings import Take

MAX_SPLITS = 3  # times that tracklets are split where other cameras see two people in them
MIN_REPORTED_SHARE = 0.02  # of the detections that are nobody
MAX_LISTED_TIMES = 4  # in a notice


def associate(
    takes: Sequence[Take | Clip | Sequence[Clip]],
    clocks: Clocks | ArrayLike | None = None,
) -> Association:
    r"""Who is who in cameras that nobody calibrated, by the epipolar distance over time.

    The joints of one person fulfil :math:`x_j^T F_{ij} x_i = 0` at all times, those of two people hardly ever.  Every camera's
    tracks are cut into pieces of surely one person; clock and F of two cameras come from two pieces that fit each other, confirmed
    by all the others; then pieces are sorted into people

    .. math:: \max_z \sum_{p < q,\ z_p = z_q} s_{pq}, \qquad
              s_{pq} = \sum_t \sum_k \log\frac{p(r_{pq,k}(t) \mid \text{same})}{p(r_{pq,k}(t) \mid \text{others})},

    nobody twice at once in a camera, with r the Sampson distances; and clocks, F and the sorting are repeated with everybody until
    they stay.

    Args:
        takes: per camera what was read of it, or the people that its tracker tells apart: clips with times on the camera's clock.
            Numbers may be exchanged where people cross, people may come and go, and some may not be there at all.
        clocks: where they are known: :class:`dyntorch.Clocks`, offsets ``(cameras,)`` in seconds, or ``(cameras, 2)`` offsets and
            rates, :math:`t_i = \text{rate}_i\, t + \text{offset}_i`.

    Returns:
        The people of all cameras in one order; refused where clocks or identities are not decided.

    Raises:
        ValueError: fewer than two cameras, people with other joints, or clocks of other cameras.

    Source:
        Clustering: Bansal, Blum and Chawla 2004, Correlation clustering; distances: Hartley and Zisserman, section 11.4.3.

    Example:
        >>> from indexing import cameras
        >>> from indexing.actors import Person, stream
        >>> first, _ = stream(["wave", "squat", "kick"], Person(), rng=1)
        >>> second, _ = stream(["kick", "lunge", "wave"], Person(), rng=2)
        >>> both = np.concatenate([first.joints[:150], second.joints[:150] + [1.5, 0.0, 0.5]], axis=1)
        >>> n = first.joints.shape[1]
        >>> left, right = (cameras.virtual(Clip(both, fps=30.0), azimuth=turn).joints for turn in (0.0, 70.0))
        >>> a, b = ([Clip(x[:, k : k + n], fps=30.0) for k in order] for x, order in ((left, (0, n)), (right, (n, 0))))
        >>> found = associate([a, b], clocks=[0.0, 0.0])  # the second camera numbers them the other way round
        >>> found.people, found.tracks[0][0].tolist() == found.tracks[1][0][::-1].tolist()
        (2, True)
    """
    everyone, names = _people(takes)
    joints = _common_joints(everyone, names)
    seen = [sightings(clips, name, places_) for clips, name, places_ in zip(everyone, names, joints, strict=True)]
    known = None if clocks is None else _clock_table(clocks, len(seen))
    views = [arrange(one, split_tracks(one)) for one in seen]
    if not any(len(one.pieces) for one in views):
        empty = Assignment(views, {}, np.zeros(0, dtype=np.int64))
        return _result(everyone, empty, clocks, np.tile([0.0, 1.0], (len(seen), 1)), [])
    times, relations, lost = estimate_spanning_tree(views, known)
    sorting = assign(views, times, relations)
    limits: list[Notice] = []
    if known is None:
        clocks, times, limits = estimate_clocks(sorting, times, lost)
        sorting = assign(sorting.views, times, sorting.relations)
    for _ in range(MAX_SPLITS):
        views, changed = split_inconsistent(sorting)
        if not changed:
            break
        sorting = assign(views, times, sorting.relations)
    lost = sorted({*lost, *find_unrelated_cameras(sorting)})
    if lost:
        limits.append(Notice(PeopleNotice.LOST, float(len(lost)), {"names": ", ".join(names[k] for k in lost)}))
    limits += find_ambiguous_people(sorting, names)
    return _result(everyone, sorting, clocks, times, limits)


# ----------------------------------------------------------------------------------------------------------------------
# What is given.


def _people(takes: Sequence[Take | Clip | Sequence[Clip]]) -> tuple[list[list[Clip]], list[str]]:
    if len(takes) < 2:
        raise ValueError(
            f"takes: {len(takes)} camera given, two at least have somebody in common; give one list of people for each"
        )
    people: list[list[Clip]] = []
    names: list[str] = []
    for number, take in enumerate(takes, start=1):
        clips = list(take.everyone) if isinstance(take, Take) else [take] if isinstance(take, Clip) else list(take)
        name = (take.name if isinstance(take, Take) else clips[0].name if clips else "") or f"camera {number}"
        if not clips:
            raise ValueError(f"{name}: no people given; give the clips of its tracker, or leave the camera out")
        flat = next((clip for clip in clips if clip.dims != 2), None)
        if flat is not None:
            raise ValueError(
                f"{name}: has {flat.dims}D joints, and people are compared by what cameras see; give 2D keypoints in pixels"
            )
        people.append(clips)
        names.append(name)
    if len(set(names)) < len(names):
        names = [f"{name} ({number})" for number, name in enumerate(names, start=1)]
    return people, names


def _common_joints(everyone: Sequence[Sequence[Clip]], names: Sequence[str]) -> list[list[int]]:
    """Per camera the places of the joints that all have, in one order."""
    first = [clips[0] for clips in everyone]
    for name, clips, one in zip(names, everyone, first, strict=True):
        other = next((clip for clip in clips if clip.joints.shape[1] != one.joints.shape[1]), None)
        if other is not None:
            counts = f"{one.joints.shape[1]} and {other.joints.shape[1]}"
            raise ValueError(f"{name}: its people have {counts} joints; people of one camera have the same")
    skeletons = [one.skeleton for one in first]
    widths = {one.joints.shape[1] for one in first}
    if len(widths) == 1 and len({skeleton.joints if skeleton is not None else None for skeleton in skeletons}) == 1:
        return [list(range(first[0].joints.shape[1]))] * len(first)
    nameless = next((name for name, skeleton in zip(names, skeletons, strict=True) if not has_names(skeleton)), None)
    if nameless is not None:
        if len(widths) == 1:
            return [list(range(first[0].joints.shape[1]))] * len(first)
        raise ValueError(f"{nameless}: its joints have no names, and other cameras have another number of joints; name the layout")
    layouts = [skeleton for skeleton in skeletons if skeleton is not None]
    rows = [places(own, layouts[0]) for own in layouts]
    shared = [k for k in range(len(layouts[0].joints)) if all(row[k] >= 0 for row in rows)]
    if len(shared) < MIN_COMMON_JOINTS:
        layouts_ = ", ".join(sorted({layout.name for layout in layouts}))
        raise ValueError(
            f"joints: the cameras ({layouts_}) have {len(shared)} joints of the same name, {MIN_COMMON_JOINTS} are needed; "
            "use one pose model for all"
        )
    return [[row[k] for k in shared] for row in rows]


def _clock_table(clocks: Clocks | ArrayLike, cameras: int) -> Floats:
    """``(cameras, 2)`` offsets and rates."""
    if isinstance(clocks, Clocks):
        values = np.stack([clocks.offsets.numpy(), clocks.rates.numpy()], axis=1)
    else:
        values = np.asarray(clocks, dtype=np.float64)
        values = np.stack([values, np.ones(len(values))], axis=1) if values.ndim == 1 else values
    if values.shape != (cameras, 2) or not np.isfinite(values).all() or (values[:, 1] <= 0).any():
        raise ValueError(f"clocks: expected a finite offset, or offset and rate, for each of {cameras} cameras, got {clocks!r}")
    return values


# ----------------------------------------------------------------------------------------------------------------------
# Putting the result together.


def _result(
    everyone: Sequence[Sequence[Clip]],
    sorting: Assignment,
    clocks: Any,
    times: Floats,
    limits: list[Notice],
) -> Association:
    groups = identities(sorting)
    if not groups and not limits:
        limits = [Notice(PeopleNotice.NOBODY, MIN_SEED_SECONDS)]
    certain = certainties(sorting) if len(sorting.labels) else np.zeros(0)
    joints, confidence, tracks, certainty, left_out, exchanges = [], [], [], [], [], []
    notices: list[Notice] = []
    for camera, (one, clips) in enumerate(zip(sorting.views, everyone, strict=True)):
        frames, own = len(one.times), sorting.of(camera)
        place = np.full(len(own) + 1, -1)
        for k, group in enumerate(groups):
            place[:-1][own == group] = k
        person = place[one.piece]
        rows, slots = np.nonzero(person >= 0)
        track = np.full((frames, len(groups)), -1, dtype=np.int64)
        track[rows, person[rows, slots]] = one.track[rows, slots]
        sure = np.full((frames, len(groups)), np.nan)
        sure[rows, person[rows, slots]] = certain[sorting.starts[camera] :][one.piece[rows, slots]]
        x, w = _gather_joints(one.seen, clips, track)
        missed: Booleans = np.asarray(one.seen.trust.any(2))
        missed[rows, one.track[rows, slots]] = False
        moments = [TrackExchange(camera, k, *row) for k in range(len(groups)) for row in _exchanges(one.times, track[:, k])]
        notices += _camera_notices(one, camera, moments, missed)
        joints.append(x)
        confidence.append(w)
        tracks.append(track)
        certainty.append(sure)
        left_out.append(missed)
        exchanges += moments
    return Association(
        status=status_from(limits),
        notices=(*limits, *notices),
        names=tuple(one.seen.name for one in sorting.views),
        times=tuple(one.times for one in sorting.views),
        joints=tuple(joints),
        confidence=tuple(confidence),
        tracks=tuple(tracks),
        certainty=tuple(certainty),
        left_out=tuple(left_out),
        exchanges=tuple(exchanges),
        clocks=clocks if isinstance(clocks, Clocks) else None,
        offsets_rates=times,
        fundamentals={pair: relation.fundamental for pair, relation in sorting.relations.items()},
        sigmas={pair: relation.sigma for pair, relation in sorting.relations.items()},
        skeletons=tuple(clips[0].skeleton for clips in everyone),
    )


def _gather_joints(seen: CameraSightings, clips: Sequence[Clip], track: Integers) -> tuple[Floats, Floats]:
    """All joints of a camera's clips in the order of identities, and what the detector trusts them."""
    whole = sightings(clips, seen.name)
    clip_index = np.maximum(track, 0)
    rows = np.arange(len(track))[:, None]
    there = (track >= 0)[..., None]
    return np.where(there[..., None], whole.places[rows, clip_index], np.nan), np.where(there, whole.trust[rows, clip_index], 0.0)


def _exchanges(times: Floats, track: Integers) -> list[tuple[float, int, int]]:
    rows = np.flatnonzero(track >= 0)
    changed = np.flatnonzero(np.diff(track[rows])) + 1
    return [(float(times[rows[k]]), int(track[rows[k - 1]]), int(track[rows[k]])) for k in changed]


def _camera_notices(one: PieceView, camera: int, moments: Sequence[TrackExchange], missed: Booleans) -> list[Notice]:
    """What a user should know of a camera."""
    notices = []
    name = one.seen.name
    if moments:
        when = sorted({round(moment.time, 2) for moment in moments})
        listed = ", ".join(f"{time:.2f}" for time in when[:MAX_LISTED_TIMES]) + " s" + " and more" * (len(when) > MAX_LISTED_TIMES)
        notices.append(Notice(PeopleNotice.EXCHANGED, float(len(when)), {"name": name, "times": listed, "camera": camera}))
    there = int(one.seen.trust.any(2).sum())
    if there and missed.sum() > MIN_REPORTED_SHARE * there:
        notices.append(Notice(PeopleNotice.ALONE, 100.0 * float(missed.sum()) / there, {"name": name, "camera": camera}))
    return notices


# ----------------------------------------------------------------------------------------------------------------------
# What is returned.


@dataclass(frozen=True)
class TrackExchange:
    """A moment from which on a tracker gives a person another number.

    Attributes:
        camera: its number.
        person: the identity.
        time: seconds on the camera's clock.
        before, after: the tracks of the camera that were and are this person.
    """

    camera: int
    person: int
    time: float
    before: int
    after: int


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class Association(Outcome):
    """Who is who in all cameras.

    Attributes:
        names: of the cameras.
        times: per camera ``(frames,)`` seconds on its own clock.
        joints: per camera ``(frames, people, joints, 2)`` px, NaN where somebody is not in view.  Person k is person k everywhere.
        confidence: per camera ``(frames, people, joints)`` as given (1 where nobody gave any), 0 where not in view.
        tracks: per camera ``(frames, people)``: the number of the clip that somebody is, -1 = not in view.
        certainty: per camera ``(frames, people)``: probability that this is that person and no other one; NaN = not in view.
        left_out: per camera ``(frames, clips)`` bool: detections that are nobody.
        exchanges: what the trackers exchanged.
        clocks: of all cameras as :class:`dyntorch.Clocks`, found or given; None where they were given as numbers, or nothing tells.
        offsets_rates: ``(cameras, 2)`` the clocks that were used: seconds, and seconds per second.
        fundamentals: of pairs (i, j) of cameras ``(3, 3)`` with x_j^T F x_i = 0, where the cameras have people in common.
        sigmas: of the same pairs, px: how far the same person is from the epipolar lines.
        skeletons: per camera, None = unknown.
    """

    names: tuple[str, ...]
    times: tuple[Floats, ...]
    joints: tuple[Floats, ...]
    confidence: tuple[Floats, ...]
    tracks: tuple[Integers, ...]
    certainty: tuple[Floats, ...]
    left_out: tuple[Booleans, ...]
    exchanges: tuple[TrackExchange, ...]
    clocks: Clocks | None
    offsets_rates: Floats
    fundamentals: Mapping[tuple[int, int], Floats]
    sigmas: Mapping[tuple[int, int], float]
    skeletons: tuple[Skeleton | None, ...]

    TASK = "associate"

    @property
    def ok(self) -> bool:
        """Whether the data decide."""
        return bool(self.status == Status.OK)

    @property
    def notes(self) -> tuple[str, ...]:
        """What a user should know besides the reason."""
        return tuple(notice.text for notice in self.notices if notice.code.refuses is None)

    @property
    def people(self) -> int:
        """How many there are."""
        return self.tracks[0].shape[1] if self.tracks else 0

    @property
    def mean_certainty(self) -> float:
        """Mean certainty of everybody in every frame; NaN where nobody is."""
        every = np.concatenate([one.ravel() for one in self.certainty]) if self.certainty else np.zeros(0)
        known = every[np.isfinite(every)]
        return float(known.mean()) if known.size else float("nan")

    def clips(self, camera: int) -> list[Clip]:
        """The people of a camera, each a clip with all of its frames; ``meta["person"]`` is the identity."""
        fps = 1.0 / float(np.median(np.diff(self.times[camera]))) if len(self.times[camera]) > 1 else 30.0
        return [
            Clip(
                self.joints[camera][:, person], times=self.times[camera], confidence=self.confidence[camera][:, person], fps=fps,
                name=self.names[camera], skeleton=self.skeletons[camera], up="-y", meta={"person": person},
            )
            for person in range(self.people)
        ]  # fmt: skip

    def __repr__(self) -> str:
        state = "ok" if self.ok else f"refused: {self.reason}"
        lines = [f"Association({self.people} people, {len(self.names)} cameras, certainty {self.mean_certainty:.3f}, {state})"]
        for name, tracks in zip(self.names, self.tracks, strict=True):
            seen = (tracks >= 0).mean(0) if len(tracks) else np.zeros(self.people)
            lines.append(f"  {name}: in view " + ", ".join(f"{100 * share:.0f} %" for share in seen))
        return "\n".join([*lines, *(f"  note: {note}" for note in self.notes)])

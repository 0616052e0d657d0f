"""Who is who in all cameras: the result, and what is said about it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Self

import numpy as np

from dyntorch import Status
from dyntorch.core import NoticeCode, Outcome
from indexing.calibrate.people.tracklets import Booleans, Floats, Integers
from indexing.clip import Clip
from indexing.skeleton import Skeleton

if TYPE_CHECKING:
    from dyntorch import Clocks


class PeopleNotice(NoticeCode):
    """What to know of who is who in the cameras, or why it is not decided."""

    NOBODY = (
        "nobody",
        "nobody is seen by two cameras for long enough ({value:g} s); film longer, or lower the confidence that joints need",
        Status.TOO_FEW,
    )
    """Nobody to tell apart."""
    CLOCKS = (
        "clocks",
        "the clocks of the cameras are not decided, so nobody can be compared: {reason}; give the clocks, or film longer",
        Status.AMBIGUOUS,
    )
    """Clocks that the people do not decide."""
    LOST = (
        "unrelated",
        "{names}: nobody there is somebody whom another camera shows; check that all cameras film the same people at the same "
        "time, or leave it out",
        Status.NO_CONSENSUS,
    )
    """A camera that shows other people, another time, or too little."""
    ALIKE = (
        "alike",
        "{names}: persons {first} and {second} exchanged fit as well (by {value:.1f} nats): they do the same at the same time, or "
        "are seen too shortly; add a camera, film them longer, or apart",
        Status.AMBIGUOUS,
    )
    """Two people who can be exchanged in a camera."""
    EXCHANGED = "exchanged", "{name}: the tracker exchanged people {value:g} times, mended ({times})"
    """Numbers of a tracker that were mended."""
    ALONE = "alone", "{name}: {value:.0f} % of the detections are nobody whom another camera shows, and are left out"
    """Detections that belong to nobody."""


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

    def check(self) -> Self:
        """Raise where the data do not decide.

        Raises:
            ValueError: the reason.
        """
        if not self.ok:
            raise ValueError(f"{self.TASK}: {self.reason}")
        return self

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

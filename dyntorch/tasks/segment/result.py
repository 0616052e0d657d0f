"""What segment() and segment_tracks() return: what moves with which body, how each body moved, and how sure that is."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from enum import StrEnum
from typing import Any, ClassVar, Self

import torch
from torch import Tensor

from dyntorch.core.outcome import Notice, NoticeCode, Outcome, Status


class SegmentNotice(NoticeCode):
    """What limits a segmentation of matches or of tracks, and how it is said."""

    MISFIT = (
        "misfit",
        "the matches of a body are off its motion as by a noise of {value:.2g}, {limit:.2g} at most by {arg:threshold}: it bends, "
        "or several move; if the noise is so large, raise {arg:threshold}",
        Status.NO_CONSENSUS,
    )
    """A body does not move rigidly, within the noise."""
    COARSE = (
        "coarse",
        "the threshold is {value:.2g} of the spread of the points, and everything is near everything; give it in their unit",
    )
    """The threshold is large beside the spread of the points."""
    FEWER_BODIES = (
        "fewer_bodies",
        {
            "": "{asked:# body was|# bodies were} asked for, the matches carry {value:g}; ask for fewer, or add matches of the "
            "others",
            "tracks": "{asked:# body was|# bodies were} asked for, the tracks carry {value:g}; ask for fewer, or give more tracks "
            "of the others",
        },
    )
    """The data carry fewer bodies than were asked for."""
    SPARE_BODY = (
        "spare_body",
        {
            "": "{value:# body explains|# bodies explain} the matches no worse than {asked}: one may be a part of another; ask for "
            "fewer",
            "tracks": "two of the {asked} bodies move nearly alike: one may be a part of the other; ask for fewer",
        },
    )
    """Fewer bodies than were asked for explain the data as well."""
    UNDECIDED = (
        "undecided",
        {
            "": "two views hardly decide: another segmentation costs {value:.2g} more, and from 1 on it would be clear; follow the "
            "points through more frames (segment_tracks)",
            "one": "whether anything moves against the rest is open: two bodies explain the matches closer, by {value:.2g}, and "
            "only the penalty of {penalty:.2g} for a body speaks against them; something moves a little, or a lens bends the "
            "picture; take frames farther apart, or follow the points through more of them (segment_tracks)",
        },
    )
    """Another segmentation costs about as much, or two bodies less than one before the penalty for a body."""
    REPEATED = ("repeated", "a share of {value:.2g} of the matches repeats others and says nothing new; remove repeated matches")
    """Many matches are the same."""
    INCOHERENT = (
        "incoherent",
        "the share of matches that move like their neighbours is {value:.2g}; try {arg:spatial=False} if bodies interleave",
    )
    """Few matches move like their neighbours."""
    SHORT = ("short", "no track is in two frames; give tracks that are followed from frame to frame", Status.TOO_FEW)
    """All tracks are shorter than two frames."""
    FEW_COMMON = (
        "few_common",
        "no two frames have more than {value:g} tracks in common, and {least} are needed; give longer tracks, or more of them",
        Status.TOO_FEW,
    )
    """No pair of frames with enough tracks."""
    STILL = (
        "still",
        "nothing moves: no track goes farther than {value:.2g} px, and motion begins at {least:.2g}; take frames farther apart",
        Status.DEGENERATE,
    )
    """No track moves more than the noise."""
    CUT = (
        "cut",
        {
            "": "the video has a cut at frame {frame}: {value:.0%} of the tracks go on; "
            "give the frames before it, or those from it on",
            "jump": "the tracks jump at frame {frame}, {value:.0f} times as far as between other frames, as at a cut; "
            "give the frames before it, or those from it on",
        },
        Status.DEGENERATE,
    )
    """The frames show two scenes."""
    UNRELATED = (
        "unrelated",
        "the tracks move each by itself: a usual one has {value:.0%} of what it prefers in common with the most alike, as random "
        "tracks have; clean the tracks, or follow more points",
        Status.NO_CONSENSUS,
    )
    """Tracks have no motion in common."""
    ONE_BODY = ("one_body", "all tracks move as one body: nothing moves against the rest")
    """There is one body."""
    UNSURE_STATIC = (
        "unsure_static",
        "which body stands still is not clear: the largest has {value:.0%} of the tracks; give {arg:cameras}",
    )
    """No body is so large and wide that it must be what stands still."""
    DISAGREEING = (
        "disagreeing",
        "no body moves as {arg:cameras} say: the nearest is {value:.2g} px off; check their order and their unit",
    )
    """The declared cameras agree with no body."""


class BodyModel(StrEnum):
    """What two views say of the motion of one body."""

    FUNDAMENTAL = "fundamental"
    """A rigid body with depth: a fundamental matrix."""
    HOMOGRAPHY = "homography"
    """A plane, or a body seen under a rotation alone: a homography, and no unique fundamental matrix."""


@dataclass(frozen=True, eq=False, repr=False)
class BodySegmentation(Outcome):
    """What both segmentations say of n matches or tracks; where problems of a batch have different numbers of bodies, K is the
    largest, and what is behind ``bodies`` is 0."""

    labels: Tensor
    bodies: Tensor
    homographies: Tensor
    planar: Tensor
    probabilities: Tensor
    residuals: Tensor
    threshold: Tensor

    UNIT: ClassVar[str] = "matches"
    """What is labelled."""

    def note(self, number: int) -> str:
        """What else is to be said of a body in the representation of a single problem."""
        raise NotImplementedError

    def in_dtype(self, dtype: torch.dtype) -> Self:
        """With floating-point parts of this type, and 0 where a batch is filled up."""
        parts: dict[str, Any] = {one.name: getattr(self, one.name) for one in fields(self)}
        for name, value in parts.items():
            if isinstance(value, Tensor) and value.is_floating_point():
                parts[name] = torch.where(value.isnan(), 0.0, value).to(dtype)
        return replace(self, **parts)

    def __repr__(self) -> str:
        lines = [self.head(**{self.UNIT: self.labels.shape[-1]})]
        if not self.status.ndim:
            counts = torch.bincount(self.labels, minlength=int(self.bodies) + 1).tolist()
            lines += [f"  body {number}: {counts[number]} {self.UNIT}{self.note(number)}" for number in range(1, len(counts))]
            lines.append(f"  outliers: {counts[0]}")
        elif self.bodies.numel():
            lines.append(f"  bodies: {int(self.bodies.min())} to {int(self.bodies.max())}")
        return "\n".join(lines + self.warning_lines())


def count_notices(count: int, asked: int | None, spare: bool, **values: str) -> list[Notice]:
    """What to say where another number of bodies was asked for than the data carry."""
    if asked is not None and count < asked:
        return [Notice(SegmentNotice.FEWER_BODIES, float(count), {"asked": asked, **values})]
    return [Notice(SegmentNotice.SPARE_BODY, count - 1.0, {"asked": asked, **values})] if asked is not None and spare else []


@dataclass(frozen=True, eq=False, repr=False)
class Segmentation(BodySegmentation):
    """Bodies in two views.

    Where problems of a batch have different numbers of bodies, K is the largest; what is behind ``bodies`` is 0.

    Attributes:
        labels: ``(*batch, n)`` int64, 0 outlier, 1..K the bodies: the larger first, of equally large ones that of
            the earliest match.
        bodies: ``(*batch,)`` int64, how many bodies.
        fundamentals: ``(*batch, K, 3, 3)`` of norm 1, :math:`x_2^T F x_1 = 0`.  Where ``planar``, F is one of the family
            :math:`[e]_\\times H` that fit the matches alike.
        homographies: ``(*batch, K, 3, 3)`` of norm 1, view 1 to view 2; 0 where not ``planar``.
        planar: ``(*batch, K)`` bool: two views show the body as a plane, or under a rotation alone; see ``models``.
        probabilities: ``(*batch, n, K + 1)``: column 0 outlier, then the bodies; rows sum to 1 (0 for missing matches).
        residuals: ``(*batch, n)`` Sampson distance from the own body's model, for outliers from the nearest body's, in the unit of
            the points; 0 where there is no body.  Labels are found by the fundamental matrices: where ``planar``, a few matches of
            the body may be far from its plane.
        coherence: ``(*batch, n)`` in [0, 1]: how well a match moves like its neighbours in both images; 0 where ``spatial=False``.
        threshold: ``(*batch,)`` Sampson distance that divides inliers from outliers where nothing else is known, as in
            :func:`dyntorch.segment`, in the unit of the points.
    """

    fundamentals: Tensor
    coherence: Tensor

    TASK = "segment"
    REMEDIES: ClassVar[Mapping[Status, str]] = {
        Status.TOO_FEW: "too few matches are present in both images; give more",
        Status.DEGENERATE: "several segmentations fit all matches exactly; add matches in general position",
        Status.AMBIGUOUS: "other segmentations fit as well; add matches, or say how many {arg:bodies} there are",
        Status.NO_CONSENSUS: "no body moves so that enough of the matches agree; raise {arg:threshold}, or clean the matches",
    }

    @property
    def models(self) -> tuple[Any, ...]:
        """For one problem a tuple of K :class:`BodyModel`, for a batch nested tuples."""

        def models_of(planar: Tensor, bodies: Tensor) -> tuple[Any, ...]:
            if bodies.ndim:
                return tuple(map(models_of, planar, bodies))
            return tuple(BodyModel.HOMOGRAPHY if flat else BodyModel.FUNDAMENTAL for flat in planar[: int(bodies)].tolist())

        return models_of(self.planar, self.bodies)

    def note(self, number: int) -> str:
        """The model of a body."""
        return f", {self.models[number - 1]}"


@dataclass(frozen=True, eq=False, repr=False)
class TrackSegmentation(BodySegmentation):
    """Bodies in the tracks of a video.

    Where problems of a batch have different numbers of bodies or pairs, K and P are the largest; what is behind is 0, in
    ``pairs`` -1.

    Attributes:
        labels: ``(*batch, n)`` int64, 0 outlier or missing, 1..K the bodies: the larger first, of equally large ones that of
            the earliest track.
        bodies: ``(*batch,)`` int64, how many bodies.
        static_body: ``(*batch,)`` int64, the body that stands still, 1..K; 0 where the data do not say which one it is.
        pairs: ``(*batch, P, 2)`` int64 numbers of the frames that were compared, the earlier one first.
        geometries: ``(*batch, P, K, 3, 3)`` fundamental matrices of norm 1, :math:`x_b^T F x_a = 0` for the frames (a, b) of a
            pair; 0 where they have too few tracks of the body in common.  Where ``planar``, F is one of many that fit alike.
        homographies: ``(*batch, P, K, 3, 3)`` of norm 1, frame a to frame b; 0 where the body is no plane there.
        planar: ``(*batch, P, K)`` bool: the body shows a plane, or a rotation alone, between these frames.
        probabilities: ``(*batch, n, K + 1)``: column 0 outlier, then the bodies; rows sum to 1 (0 for missing tracks).
        residuals: ``(*batch, n)`` root mean square of the Sampson distances from the own body, for outliers from the nearest body,
            over the pairs of frames that show the track, in the unit of the tracks.
        threshold: ``(*batch,)`` as given.
    """

    static_body: Tensor
    pairs: Tensor
    geometries: Tensor

    UNIT = "tracks"
    TASK = "segment_tracks"
    REMEDIES: ClassVar[Mapping[Status, str]] = {
        Status.TOO_FEW: "too few tracks are in two frames at once; give more, or longer ones",
        Status.DEGENERATE: "the tracks show no motion, or more than one scene; take other frames",
        Status.AMBIGUOUS: "other segmentations fit as well; add frames, or say how many {arg:bodies} there are",
        Status.NO_CONSENSUS: "no body moves so that enough of the tracks agree; raise {arg:threshold}, or clean the tracks",
    }

    def note(self, number: int) -> str:
        """Whether a body stands still."""
        return ", stands still" if number == int(self.static_body) else ""

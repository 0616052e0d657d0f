"""What the cameras saw, as :func:`dyntorch.calibrate` takes it: the same joints in all, frame by frame on each camera's clock."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from dyntorch.numerics import Message
from indexing.clip import Clip
from indexing.joints import canonical, has_names
from indexing.opening import listing
from indexing.remarks import describe_issues, is_normalized, same_clips
from indexing.skeleton import Skeleton, usual_layout
from indexing.sync.people import MIN_COMMON_JOINTS
from indexing.sync.recordings import Take
from indexing.video.reading import probe

FloatArray = NDArray[np.float64]
Size = tuple[int, int]

MAX_CAMERAS = 8  # two at least
MIN_FRAMES = 12  # of each camera that show somebody: what clocks are estimated from
PICTURE_MARGIN = 0.1  # of width or height; detectors guess cut-off joints up to .05 outside (RTMPose)
MAX_OUTSIDE_SHARE = 0.05  # of the joints beyond that margin before the size is wrong
MAX_CLOCK_SPAN = 20.0  # times its frames that a recording's clock may run over
MAX_CLOCK_FRAMES = 20_000  # that it may run over in any case


@dataclass(frozen=True, eq=False)
class View:
    """One camera's part in a calibration."""

    take: Take  # what it recorded
    people: tuple[Clip | None, ...]  # one clip for each person, in an order that all cameras share
    size: Size  # width and height of its picture, pixels
    times: FloatArray  # ``(frames,)`` seconds on its own clock: all moments at which one of the people may be seen

    @property
    def name(self) -> str:
        """The camera's."""
        return self.take.name

    def table(self, places: Sequence[int]) -> tuple[Tensor, Tensor]:
        """Positions ``(frames, people * n, 2)`` and confidences ``(frames, people * n)``; NaN and 0 where there are none."""
        shape = len(self.times), len(self.people), len(places)
        tracks, trust = np.full((*shape, 2), np.nan), np.zeros(shape)
        here = np.flatnonzero(np.array(places) >= 0)
        own = np.array(places)[here]
        for who, clip in enumerate(self.people):
            if clip is None:
                continue
            rows = np.searchsorted(self.times, clip.times)[:, None]
            sure = np.ones(clip.joints.shape[:2]) if clip.confidence is None else np.nan_to_num(clip.confidence)
            tracks[rows, who, here], trust[rows, who, here] = clip.joints[:, own], np.where(clip.seen, sure, 0.0)[:, own]
        tracks[np.isnan(tracks).any(axis=3)] = np.nan
        flat = (shape[0], shape[1] * shape[2])
        return torch.from_numpy(tracks.reshape(*flat, 2)), torch.from_numpy(trust.reshape(flat))

    def with_joints(self, tracks: FloatArray, trust: FloatArray, places: Sequence[int]) -> View:
        """The same with other positions, as :meth:`table` has them, of the joints that are in both."""
        here = np.flatnonzero(np.array(places) >= 0)
        own = np.array(places)[here]
        shape = len(self.times), len(self.people), len(places)
        x, w = tracks.reshape(*shape, 2), trust.reshape(shape)
        people: list[Clip | None] = []
        for who, clip in enumerate(self.people):
            if clip is None:
                people.append(None)
                continue
            rows = np.searchsorted(self.times, clip.times)[:, None]
            joints = np.array(clip.joints, dtype=np.float64)
            joints[:, own] = x[rows, who, here]
            confidence = None if clip.confidence is None else np.array(clip.confidence, dtype=np.float64)
            if confidence is not None:
                confidence[:, own] = w[rows, who, here]
            people.append(clip.replace(joints=joints, confidence=confidence))
        return dataclasses.replace(self, people=tuple(people))


# ----------------------------------------------------------------------------------------------------------------------
# Which joint of one camera is which of another.


@dataclass(frozen=True)
class Joints:
    """The joints that two cameras or more have."""

    skeleton: Skeleton | None  # their names and bones; None where nobody knows which is which
    count: int
    places: tuple[tuple[int, ...], ...]  # for each camera, where each of them is among the camera's own; -1 = it has none
    note: str = ""  # what to say about layouts that differ


def select_common_joints(clips: Sequence[Clip], names: Sequence[str]) -> Joints:
    """The joints of many layouts by their names: those that two cameras or more have."""
    layouts = [clip.skeleton or usual_layout(clip.joints.shape[1]) for clip in clips]
    sizes = [clip.joints.shape[1] for clip in clips]
    alike = all(layout is None or layouts[0] is None or layout.joints == layouts[0].joints for layout in layouts)
    if len(set(sizes)) == 1 and alike:
        shown = next((layout for layout in layouts if layout is not None), None)
        return Joints(shown, sizes[0], tuple(tuple(range(sizes[0])) for _ in clips))
    unnamed = [i for i, layout in enumerate(layouts) if not has_names(layout)]
    if unnamed:
        i = unnamed[0]
        other = next(j for j in range(len(clips)) if sizes[j] != sizes[i] or layouts[j] != layouts[i])
        text = (
            "{name}: has {own} joints without names, {other} has {many}, so nobody knows which is which; "
            "give {arg:layout=}, or files of one pose estimator"
        )
        raise ValueError(Message(text, name=names[i], own=sizes[i], other=names[other], many=sizes[other]))
    return _match_joint_names([layout for layout in layouts if layout is not None], names)


def _match_joint_names(layouts: Sequence[Skeleton], names: Sequence[str]) -> Joints:
    words = [{canonical(joint): i for i, joint in reversed(list(enumerate(layout.joints)))} for layout in layouts]
    called: dict[str, str] = {}
    for layout in layouts:
        for joint in layout.joints:
            called.setdefault(canonical(joint), joint)
    kept = [word for word in called if sum(word in own for own in words) > 1]
    for name, own, layout in zip(names, words, layouts, strict=True):
        most = max(len(own.keys() & other.keys()) for other in words if other is not own)
        if most < MIN_COMMON_JOINTS:
            text = (
                "{name}: its joints ({own}) share {most} names with those of any other camera, and {needed} are needed; "
                "use files of one kind of pose estimator"
            )
            raise ValueError(Message(text, name=name, own=listing(layout.joints), most=most, needed=MIN_COMMON_JOINTS))
    index = {word: i for i, word in enumerate(kept)}
    bones: dict[tuple[int, int], None] = {}
    for layout in layouts:
        for a, b in layout.bones:
            ends = [index.get(canonical(layout.joints[end]), -1) for end in (a, b)]
            if min(ends) >= 0 and (ends[1], ends[0]) not in bones:
                bones[ends[0], ends[1]] = None
    skeleton = Skeleton("joints of several layouts", tuple(called[word] for word in kept), tuple(bones))
    kinds = list(dict.fromkeys(layout.name for layout in layouts))
    places = tuple(tuple(own.get(word, -1) for word in kept) for own in words)
    return Joints(skeleton, len(kept), places, f"the cameras have {listing(kinds)}: {len(kept)} joints are used, by their names")


# ----------------------------------------------------------------------------------------------------------------------
# Cameras from recordings: their pictures' sizes, their grids, and whether they make sense together.


def to_pixels(take: Take, size: Size | None) -> tuple[Take, Size]:
    """A take in pixels, and how large its picture is."""
    own = _own_size(take)
    size = size or own
    if size is None:
        text = "{name}: the size of its picture is not known; give {arg:size=} such as 1920x1080, of all cameras or of each"
        raise ValueError(Message(text, name=take.name))
    if take.people and is_normalized(take.people[0]):
        scale_remarks = {str(note) for note in describe_issues(take.people[:1])}
        people, everyone = (
            tuple(clip.replace(joints=clip.joints * np.asarray(size, dtype=np.float64)) for clip in clips)
            for clips in (take.people, take.everyone)
        )
        notes = tuple(note for note in take.notes if str(note) not in scale_remarks and "from 0 to 1" not in str(note))
        take = dataclasses.replace(take, people=people, everyone=everyone, notes=notes)
    return take, size


def _own_size(take: Take) -> Size | None:
    """What a keypoint file or a video says of its pictures."""
    for clip in take.people:
        said = clip.meta.get("size")
        if said is not None and np.shape(said) == (2,):
            return int(said[0]), int(said[1])
    if take.path is not None and (take.video is not None or take.kind == "video"):
        info = probe(take.path)
        return info.width, info.height
    return None


def check_size(take: Take, clips: Sequence[Clip], size: Size) -> None:
    """Raise where joints lie outside of the picture by far."""
    places = np.concatenate([clip.joints[clip.seen] for clip in clips]) if clips else np.zeros((0, 2))
    if not len(places):
        return
    share = _outside_share(places, size)
    if share <= MAX_OUTSIDE_SHARE:
        return
    low, high = np.percentile(places, [1, 99], axis=0)
    turned = size[::-1]
    hint = f"is it {turned[0]}x{turned[1]}? " if _outside_share(places, turned) <= MAX_OUTSIDE_SHARE else ""
    text = (
        "{name}: its picture of {size} does not hold its keypoints, which go from {low} to {high} "
        "({share:.0f} % of them are far outside); {hint}give the size of the pictures in which they were found ({arg:size=})"
    )
    low_text, high_text = (f"({x:.0f}, {y:.0f})" for x, y in (low, high))
    values = {"name": take.name, "size": f"{size[0]}x{size[1]}", "low": low_text, "high": high_text, "share": 100 * share}
    raise ValueError(Message(text, **values, hint=hint))


def _outside_share(places: NDArray[np.floating], size: Size) -> float:
    room = PICTURE_MARGIN * np.array(size)
    return float(((places < -room) | (places > np.array(size) + room)).any(axis=1).mean())


def make_view(take: Take, people: Sequence[Clip | None], size: Size) -> View:
    """A camera with who is seen by it."""
    seen = [clip for clip in people if clip is not None]
    check_size(take, seen, size)
    times = np.unique(np.concatenate([clip.times for clip in seen])) if seen else take.times
    span = float(times[-1] - times[0])
    if span * take.fps > max(MAX_CLOCK_SPAN * len(times), MAX_CLOCK_FRAMES):
        text = "{name}: {count} frames over {span:.0f} s at {fps:g} per second: nearly all gap; cut it to the part that all share"
        raise ValueError(Message(text, name=take.name, count=len(times), span=span, fps=take.fps))
    there = len(np.unique(np.concatenate([clip.times[clip.seen.any(axis=1)] for clip in seen]))) if seen else 0
    if there < MIN_FRAMES:
        text = "{name}: {count:# frame shows|# frames show} somebody, {needed} are needed at least; film longer, or give all frames"
        raise ValueError(Message(text, name=str(take.path or take.name), count=there, needed=MIN_FRAMES))
    return View(take, tuple(people), size, np.asarray(times, dtype=np.float64))


def check_cameras(takes: Sequence[Take]) -> None:
    """Raise where recordings cannot be those of one rig."""
    if not 2 <= len(takes) <= MAX_CAMERAS:
        remedy = "add a camera" if len(takes) < 2 else "leave some out, the others share what is measured"
        raise ValueError(f"{len(takes)} camera{'s' * (len(takes) != 1)}: two to {MAX_CAMERAS} are calibrated together; {remedy}")
    bare = next((take for take in takes if take.kind != "keypoints" or not take.people), None)
    if bare is not None:
        text = "{name}: has no keypoints, and cameras are calibrated from people's joints; find them with dyntorch pose first"
        raise ValueError(Message(text, name=str(bare.path or bare.name)))
    twice = same_clips([take.people[0] for take in takes])
    if twice:
        a, b = (takes[i].name for i in twice[0])
        raise ValueError(f"{a} and {b} hold the same recording: a camera is given twice; name every camera once")


def check_overlap(views: Sequence[View], clocks: Tensor) -> None:
    """Raise where cameras whose clocks are known have no moment in common with any other one. clocks ``(cameras, 2)``."""
    starts, ends = (
        [(float(view.times[at]) - offset) / rate for view, (offset, rate) in zip(views, clocks.tolist(), strict=True)]
        for at in (0, -1)
    )
    for i, view in enumerate(views):
        shared = [min(ends[i], ends[j]) - max(starts[i], starts[j]) for j in range(len(views)) if j != i]
        if max(shared) < 0:
            j = 0 if i else 1
            text = (
                "{name} recorded from {start:.3f} to {end:.3f} s, {other} from {first:.3f} to {last:.3f} s of one clock: "
                "they have no time in common; give recordings that overlap, or leave {arg:clocks} out if they are not synchronized"
            )
            values = {"start": starts[i], "end": ends[i], "first": starts[j], "last": ends[j]}
            raise ValueError(Message(text, name=view.name, other=views[j].name, **values))

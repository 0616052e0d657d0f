"""How one camera's clock runs against another's: one verb over keypoints, point tracks and the brightness of videos."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import combinations
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

import dyntorch
from dyntorch import Clocks, Shift
from dyntorch.core import Notice, status_from
from dyntorch.numerics import Message, check_options, with_names
from indexing.clip import Clip
from indexing.remarks import is_normalized
from indexing.sync.brightness import brightness_shift
from indexing.sync.brightness_features import MAX_IMAGE_SIDE
from indexing.sync.calibration import lenses
from indexing.sync.people import Pairing, common_joints, disagreements, jumps, match_people
from indexing.sync.recordings import (
    MEASURES,
    By,
    Measure,
    SyncNotice,
    SyncOptions,
    Take,
    accepted_notices,
    joint_weights,
    reader_notices,
    take_of,
    undecided_shift,
)
from indexing.sync.sound import SoundNotice, check_by_sound, sound_shift
from indexing.sync.soundtrack import read_sound
from indexing.video import Chunk, read_video, track_points

Method = Literal["auto", "keypoints", "tracks", "brightness", "sound"]
METHODS = ("auto", "keypoints", "tracks", "brightness", "sound")
BY: dict[str, By] = {"auto": "auto", "keypoints": "keypoints", "tracks": "pixels", "brightness": "pixels", "sound": "pixels"}
"""What of videos each method compares."""
LISTED = 3  # moments in a note


def synchronize(
    a: Clip | str | Path | ArrayLike | Take,
    b: Clip | str | Path | ArrayLike | Take,
    method: Method = "auto",
    *,
    fps: float | tuple[float, float] | None = None,
    max_shift: float | None = None,
    calibration: Any = None,
    person: str = "auto",
    min_confidence: float = 0.0,
    measure: Measure = "profile",
    sound: bool = True,
    options: SyncOptions | None = None,
    **more: Any,
) -> Shift:
    """Synchronize two cameras that filmed the same scene from different places, neither of them calibrated.

    A moment that camera a shows at its time :math:`t_a` is shown by b at

    .. math:: t_b = \\text{rate}\\; t_a + \\text{offset}.

    Keypoints of one skeleton are the same points in both: their epipolar constraint :math:`x_b^T F x_a = 0` holds at the right
    shift alone.  Keypoints of different skeletons, and tracks of whatever can be followed in two videos, are different points of
    the same moving things: their trajectories span subspaces that meet at the right shift.  Brightness needs no points at all.

    Args:
        a, b: a :class:`~indexing.Clip` with 2D joints, or a ``movement`` dataset of poses; the path of keypoints in any format of
            :mod:`indexing.readers` (a file, or a folder with one file per frame); the path of a video; keypoints
            ``(frames, joints, 2)``, pixels, NaN = missing; or gray frames ``(frames, height, width)``.  One of both may be motion
            capture: a clip with 3D joints, the path of a C3D, TRC or other file of 3D points, or ``(frames, markers, 3)``, in any
            unit and with any axis up.  Joints of the same names are then the same points, others different ones.
        method: ``"keypoints"``, ``"tracks"``, ``"brightness"``, or ``"auto"``: keypoints where both have them, videos too, where a
            pose model is there (:mod:`indexing.pose`); for two videos without one, or whose keypoints do not decide, tracks and
            brightness, of which both must say the same; or ``"sound"``: what the microphones of two videos heard, alone.
        fps: frames per second of arrays and of files that have no times, of both or of each (30 by default, and then a note
            says so).
        max_shift: seconds, the largest offset that is searched; by default as far as the takes overlap enough to tell.
        calibration: lens and matrix of both cameras, as :func:`dyntorch.synchronize` takes it; or the path of a calibration
            file (``.toml`` with ``matrix`` and ``distortions`` for every camera), cameras matched by name, or by order.
        person: who is followed where several people are in view: ``"auto"`` tries the likely pairings and says which was taken;
            ``"largest"``, ``"confident"``, ``"tracked"`` are the rules of :mod:`indexing.readers.recording`.
        min_confidence: joints that the detector trusts less are taken as not seen.
        measure: of ``method="brightness"``: ``"profile"``, how much moves at which height, which the thesis's window kernel must
            confirm; or ``"window"``, that kernel alone (see :func:`indexing.sync.brightness.brightness_shift`).
        sound: whether the sound of two videos is a witness: where it decides, what the pictures say must agree with it (see
            :func:`indexing.sync.sound.sound_shift`).
        options: what is known of the recordings, and what is paid.
        more: for the reader (``format=``, ``size=``, ``layout=``) and for :func:`dyntorch.synchronize`.

    Returns:
        :class:`dyntorch.Shift`: offset and sigma in seconds, rate, confidence, all peaks, ``ok`` and the reason where it is
        false.  Times are those of the files: frame number / fps where they have none of their own.

    Raises:
        ValueError: an input that cannot be read or shows nobody, or a method that does not fit it.

    Source:
        L. Wolf, thesis (2003), chapter 7; L. Wolf and A. Zomet, Sequence-to-sequence self calibration, ECCV 2002.

    Example:
        >>> import numpy as np
        >>> from indexing import cameras
        >>> from indexing.actors import Person, stream
        >>> scene, _ = stream(["wave", "squat", "kick"], Person(), rng=1)
        >>> left, right = (cameras.virtual(scene, azimuth) for azimuth in (0.0, 70.0))
        >>> shift = synchronize(left.joints, right.joints[12:], fps=30.0)  # the second camera starts 12 frames later
        >>> bool(shift.ok), round(shift.frames, 1)
        (True, -12.0)
    """
    if method not in METHODS:
        raise ValueError(f"method must be one of {', '.join(METHODS)}, got {method!r}")
    rates = fps if isinstance(fps, (tuple, list)) else (fps, fps)
    if len(rates) != 2:
        raise ValueError(f"fps must be one number, or one for each of two cameras, got {fps!r}")
    options = SyncOptions() if options is None else options
    check_options(options, SyncOptions)
    how = {name: more.pop(name) for name in ("format", "size", "layout") if name in more}
    takes = [
        take_of(value, name="" if isinstance(value, (Clip, str, Path)) else name, fps=rate, person=person,
                min_confidence=min_confidence, by=BY[method], **how, options=options)
        for value, name, rate in zip((a, b), "ab", rates, strict=True)
    ]  # fmt: skip
    takes = [dataclasses.replace(take, name=take.name or letter) for take, letter in zip(takes, "ab", strict=True)]
    shift = pair(
        takes[0],
        takes[1],
        method,
        max_shift=max_shift,
        calibration=calibration,
        measure=measure,
        sound=sound,
        options=options,
        **more,
    ).shift
    return dataclasses.replace(shift, notices=(*recording_notices(takes), *shift.notices))


def pair(
    a: Take,
    b: Take,
    method: Method = "auto",
    *,
    calibration: Any = None,
    measure: Measure = "profile",
    sound: bool = True,
    options: SyncOptions | None = None,
    **more: Any,
) -> Pairing:
    """:func:`synchronize` for recordings that were read, and which person of each it is about."""
    options = options or SyncOptions()
    _check(a, b, method, measure, options)
    lens = lenses(calibration, [take.name for take in (a, b) if not take.spatial])
    shapeless = [take for take in (a, b) if take.kind == "keypoints" and is_normalized(take.people[0])]
    if lens and shapeless:
        text = "{path}: its coordinates go from 0 to 1, and {arg:calibration=} is of pixels; give {arg:size=}, or leave it out"
        raise ValueError(Message(text, path=str(shapeless[0].path or shapeless[0].name)))
    names = {"a": a.name or "a", "b": b.name or "b"}
    more = {**more, "calibration": _of_both(a, b, lens.values) if lens else None}
    try:
        if method == "sound":
            heard = compare_sound(a, b, **more)
            limits: list[Notice] = []
            found = Pairing(heard, (0, 0), sound=heard)
        else:
            found, limits = _compare(a, b, method, measure, more, options)
            found = _with_sound(found, a, b, more) if sound else found
    except ValueError as problem:
        raise ValueError(with_names(problem, names)) from problem
    said = [notice.with_names(names) for notice in [*reader_notices(lens.notes if lens else ()), *limits, *found.shift.notices]]
    unique = {(notice.code, str(notice.text)): notice for notice in said}
    return dataclasses.replace(found, shift=dataclasses.replace(found.shift, notices=tuple(unique.values())))


def _of_both(a: Take, b: Take, values: Any) -> Any:
    """Lenses of a and of b: motion capture has none."""
    if len(values) == 2 or not (a.spatial or b.spatial):
        return values
    return (None, *values) if a.spatial else (*values, None)


def _compare(
    a: Take, b: Take, method: Method, measure: Measure, more: dict[str, Any], options: SyncOptions
) -> tuple[Pairing, list[Notice]]:
    """What the data say, and what is to be said about the people in them."""
    if a.kind == b.kind == "keypoints":
        found = match_people(
            a,
            b,
            partial(_keypoints, options=options, **more),
            partial(_keypoints, quick=True, options=options, **more),
        )
        limits = _identity_notices(a, b, found)
        if found.shift.ok or method != "auto" or a.video is None or b.video is None:
            return found, limits
        return _add_pixels(found, synchronize_videos(a.video, b.video, method, **more, options=options)), limits

    return Pairing(synchronize_videos(a, b, method, measure, **more, options=options), (0, 0)), []


def compare_sound(a: Take, b: Take, **more: Any) -> Shift:
    """What the sound of two cameras says."""
    known = {name: value for name, value in more.items() if name in ("max_shift", "rate", "risk")}
    sounds = [None if take.footage is None else read_sound(take.footage) for take in (a, b)]
    return sound_shift(sounds[0], sounds[1], fps=(a.fps, b.fps), **known)


def _with_sound(found: Pairing, a: Take, b: Take, more: dict[str, Any]) -> Pairing:
    """What was found, and what the sound of both cameras says to it, where they have any."""
    if a.footage is None or b.footage is None:
        return found
    try:
        heard = compare_sound(a, b, **more)
    except ValueError as problem:  # the pictures could be read, and need no witness
        said = Notice(SoundNotice.OPEN, 0.0, {"why": problem.args[0] if problem.args else str(problem)})
        return dataclasses.replace(found, shift=dataclasses.replace(found.shift, notices=(*found.shift.notices, said)))
    return dataclasses.replace(found, shift=check_by_sound(found.shift, heard), sound=heard)


def _add_pixels(found: Pairing, seen: Shift) -> Pairing:
    """What the pixels of two videos say where the people in them do not decide: taken where it is sure, and said in any case."""
    first = found.shift
    if seen.ok:
        known = Notice(SyncNotice.BY_PIXELS, 0.0, {"keypoints": _reason(first)})
        return dataclasses.replace(found, shift=dataclasses.replace(seen, notices=(known, *seen.notices)))
    known = Notice(SyncNotice.NEITHER, 0.0, {"pixels": _reason(seen)})
    return dataclasses.replace(found, shift=dataclasses.replace(first, notices=(*first.notices, known)))


def _check(a: Take, b: Take, method: Method, measure: Measure, options: SyncOptions) -> None:
    if measure not in MEASURES:
        raise ValueError(f"measure must be one of {', '.join(MEASURES)}, got {measure!r}")
    if measure != "profile" and method != "brightness":
        text = "{arg:measure={measure!r}} is a measure of brightness, and {arg:method={method!r}} was asked for; use "
        raise ValueError(Message(text + "{arg:method='brightness'}", measure=measure, method=method))
    for take in (a, b):
        if take.kind == "keypoints" and take.count < options.min_frames:
            remedy = "give the folder that holds all frames" if take.count == 1 else "film longer"
            frames = f"{take.count} frame{'' if take.count == 1 else 's'}"
            raise ValueError(
                f"{take.path or take.name or 'recording'}: {frames}, {options.min_frames} are needed at least; {remedy}"
            )
        if method == "keypoints" and take.kind != "keypoints":
            text = "{path}: is a video, and {arg:method='keypoints'} needs keypoints; run a pose estimator first, or use "
            raise ValueError(Message(text + "{arg:method='tracks'} or {arg:method='brightness'}", path=str(take.path or take.name)))
        if method == "sound" and take.footage is None:
            text = "{path}: is no video, and {arg:method='sound'} needs their sound; give the videos, or use "
            raise ValueError(Message(text + "{arg:method='keypoints'}", path=str(take.path or take.name)))
        if method == "brightness" and take.kind == "keypoints":
            text = "{path}: holds keypoints, and {arg:method='brightness'} needs videos; give the videos, or use "
            raise ValueError(Message(text + "{arg:method='keypoints'}", path=str(take.path or take.name)))


def _keypoints(
    a: Clip, b: Clip, correspondence: bool | None = None, quick: bool = False, *, options: SyncOptions, **more: Any
) -> Shift:
    """Two people, or one seen twice; ``quick`` looks for no lens distortion, drift, or weak perspective: 5 to 10 times faster."""
    first, second, same, note = common_joints(a, b)
    if correspondence is None:
        correspondence = same
    elif correspondence and not same:
        raise ValueError(
            f"correspondence=True needs the same joints in both, got {a.joints.shape[1]} and {b.joints.shape[1]}; leave it out"
        )
    if quick and correspondence:
        more = {"camera": "perspective", **more, "rate": more.get("rate") or 1.0}
        more["calibration"] = more.get("calibration") or (None, None)
    clips = (first, second) if correspondence else (a, b)
    places = [torch.from_numpy(np.array(clip.joints, dtype=np.float64)) for clip in clips]
    trust = [joint_weights(clip) for clip in clips]
    known = any(clip.confidence is not None for clip in clips)
    shift: Shift = dyntorch.synchronize(
        places[0],
        places[1],
        correspondence=correspondence,
        times=(torch.from_numpy(a.times.copy()), torch.from_numpy(b.times.copy())),
        weights=(torch.from_numpy(trust[0]), torch.from_numpy(trust[1])) if known else None,
        options=options.of_points,
        **more,
    )
    return dataclasses.replace(shift, notices=(*reader_notices([note] if note else []), *shift.notices))


def recording_notices(takes: Sequence[Take]) -> list[Notice]:
    """What to say about the recordings themselves."""
    found = [notice for take in takes for notice in reader_notices(take.notes, take.name)]
    names = [take.name for take in takes if take.fps_assumed]
    if names:
        found.append(Notice(SyncNotice.ASSUMED, 30.0, {"names": ", ".join(names)}))
    same = [f"{a.name} and {b.name}" for a, b in combinations(takes, 2) if _is_same_recording(a, b)]
    return [*found, *(Notice(SyncNotice.SAME, 0.0, {"names": both}) for both in same)]


def _is_same_recording(a: Take, b: Take) -> bool:
    """Whether both are one recording: the best shift is then 0, and says nothing."""
    if a.path is not None and b.path is not None and a.path.resolve() == b.path.resolve():
        return True
    first, second = (take.people[0].joints if take.people else take.frames for take in (a, b))
    if first is None or second is None or first.shape != second.shape:
        return False
    return bool(np.array_equal(first, second, equal_nan=first.dtype.kind == "f"))


def _identity_notices(a: Take, b: Take, found: Pairing) -> list[Notice]:
    """Notes on moments at which somebody else is followed, and on stretches in which the two do not show the same person."""
    people = [take.people[i] for take, i in zip((a, b), found.people, strict=True)]
    found_notes = []
    for take, clip in zip((a, b), people, strict=True):
        moments = jumps(clip)
        if moments:
            listed = ", ".join(f"{moment:.2f}" for moment in moments[:LISTED]) + " and more" * (len(moments) > LISTED)
            found_notes += reader_notices(
                [f"{take.name}: whoever is followed jumps at {listed} s: people swapped, or a cut"], take.name
            )
    first, second, same, _ = common_joints(people[0], people[1])
    bad = disagreements(first, second, found.shift) if same and found.shift.ok else []
    if bad:
        listed = ", ".join(f"{start:.2f} to {end:.2f} s" for start, end, _ in bad[:LISTED]) + " and more" * (len(bad) > LISTED)
        worst = max(times for *_, times in bad)
        said = f"from {listed} on the clock of {a.name} the cameras fit each other {worst:.1f} times worse than otherwise"
        found_notes += reader_notices([f"{said}: people swapped, tracking lost, or a camera moved"])
    return found_notes


# ----------------------------------------------------------------------------------------------------------------------
# Synchronization where a camera gives no keypoints: tracks of whatever moves, and brightness, each a check of the other.


def synchronize_videos(
    a: Take, b: Take, method: str, measure: Measure = "profile", options: SyncOptions | None = None, **more: Any
) -> Shift:
    """Two recordings of which at least one is a video: by tracks, by brightness, or by both."""
    more.pop("correspondence", None)  # tracks of two videos never correspond
    brightness = {name: value for name, value in more.items() if name == "max_shift"}
    if method == "brightness":
        return _brightness(a, b, **brightness, measure=measure)
    tracked = _tracks(a, b, **more, options=options or SyncOptions())
    if method == "tracks" or "keypoints" in (a.kind, b.kind):
        return tracked
    try:
        bright = _brightness(a, b, **brightness)
    except ValueError as problem:  # too short for it; the files can be read, as the tracks show
        said = problem.args[0] if problem.args else str(problem)
        bright = undecided_shift((a.fps, b.fps), "brightness", Notice(SyncNotice.UNUSABLE, 0.0, {"text": said}))
    return combine_methods(tracked, bright)


AGREEMENT_FRAMES = 2.0  # Within this tracks and brightness say the same.


def combine_methods(tracked: Shift, bright: Shift) -> Shift:
    """One answer from two methods: the tracks' where both are sure of the same, a refusal with both where they are not."""
    both = (tracked, bright)
    sure = [shift for shift in both if shift.ok]
    values = {"tracks": _summary(tracked), "brightness": _summary(bright)}
    best = sure[0] if sure else max(both, key=lambda shift: shift.confidence)
    other = bright if best is tracked else tracked
    known = [
        Notice(SyncNotice.METHODS, 0.0, values),
        *accepted_notices(best),
        *(one for one in accepted_notices(other) if one not in accepted_notices(best)),
    ]
    apart = min((abs(offset - _middle(best)) for offset in _candidates(other)), default=float("inf"))
    if sure and apart <= AGREEMENT_FRAMES / min(best.fps):
        return dataclasses.replace(best, notices=tuple(known))
    peaks = torch.cat([best.peaks, other.peaks])  # scores of two methods: each list is in order, and the best one's comes first
    refusal = Notice(SyncNotice.DISAGREE, 0.0, values)
    if not sure:
        refusal = Notice(SyncNotice.UNDECIDED, 0.0, {"tracks": _reason(tracked), "brightness": _reason(bright)})
    limits = (refusal, *known)
    return dataclasses.replace(best, status=status_from(limits), notices=limits, peaks=peaks)


def _reason(shift: Shift) -> str:
    """Why a method does not decide: a message, where there is one."""
    told = [notice.text for notice in shift.notices if notice.code.refuses is not None]
    return told[0] if told else shift.reason


def _summary(shift: Shift) -> str:
    if not len(shift.peaks):
        return "nothing"
    return f"{_middle(shift):+.3f} s ({'sure' if shift.ok else 'not sure'})"


def _middle(shift: Shift) -> float:
    return float(shift.at(shift.center)) - shift.center


def _candidates(shift: Shift) -> list[float]:
    """What a method holds possible: its answer where it is sure, else its peaks."""
    return [_middle(shift)] if shift.ok else [_middle(shift), *shift.peaks[:, 0].tolist()]


MIN_TRACKS = 4  # Moving points that must be followed in each video.


def _tracks(a: Take, b: Take, *, calibration: Any = None, options: SyncOptions, **more: Any) -> Shift:
    """Different points in both: trajectories that span meeting subspaces."""
    found = [points_of(take) for take in (a, b)]
    known = [notice for *_, more in found for notice in more]
    few = [take.name for take, (points, _, _) in zip((a, b), found, strict=True) if points.shape[1] < MIN_TRACKS]
    if few:
        values = {"needed": MIN_TRACKS, "names": " and ".join(few)}
        return undecided_shift((a.fps, b.fps), "subspace", Notice(SyncNotice.FEW_TRACKS, 0.0, values), *known)
    shift: Shift = dyntorch.synchronize(
        found[0][0],
        found[1][0],
        correspondence=False,
        times=(found[0][1], found[1][1]),
        calibration=calibration,
        options=options.of_points,
        **more,
    )
    return dataclasses.replace(shift, notices=(*known, *shift.notices))


def points_of(take: Take) -> tuple[Tensor, Tensor, list[Notice]]:
    """``(frames, n, 2)`` of whatever moves, ``(frames,)`` seconds, and what to say about it."""
    if take.kind == "keypoints":
        clip = take.people[0]
        return torch.from_numpy(np.array(clip.joints, dtype=np.float64)), torch.from_numpy(clip.times.copy()), []
    tracks = track_points(source_of(take))
    return tracks.points, tracks.times, reader_notices([f"{take.name}: {note}" for note in tracks.notes], take.name)


def source_of(take: Take) -> Any:
    """A video as the functions of :mod:`indexing.video` take it."""
    if take.path is not None:
        return take.path
    assert take.frames is not None
    return [Chunk(gray_of(take), take.times)]


def gray_of(take: Take) -> Any:
    """``(frames, height, width)`` uint8; gray values from 0 to 1 are brought to 0 to 255."""
    assert take.frames is not None
    if take.frames.dtype == np.uint8:
        return take.frames
    values = np.nan_to_num(np.asarray(take.frames, dtype=np.float64))
    return (values * (255.0 if values.max(initial=0.0) <= 1.0 else 1.0)).clip(0, 255).astype(np.uint8)


def _brightness(a: Take, b: Take, **more: Any) -> Shift:
    """No points at all."""
    sources = [iter(source_of(take)) if take.path is None else read_video(take.path, size=MAX_IMAGE_SIDE) for take in (a, b)]
    shift: Shift = brightness_shift(*sources, **more)
    return shift


# ----------------------------------------------------------------------------------------------------------------------
# Clocks that break: frames that a camera lost, or wrote twice, without saying so.


Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class RepairedClocks:
    """Recordings whose clocks broke, with times as if they had not."""

    found: Any
    takes: tuple[Take, ...]

    @property
    def is_attributed(self) -> bool:
        """Whether it is known whose clock broke, as far as it can be: of three cameras the other pairs of both must say so, too."""
        return len(self.takes) == 2 or all(one.camera is not None for one in self.found.breaks)

    def as_json(self) -> list[dict[str, Any]]:
        """Every break in plain types."""
        return [
            {
                "camera": None if one.camera is None else self.takes[one.camera].name,
                "candidates": [self.takes[camera].name for camera in one.candidates],
                "times": list(one.moments), "sigma": one.sigma, "jump": one.jump, "jump_sigma": one.jump_sigma,
                "frames": one.frames, "twice": one.is_doubled, "evidence": one.evidence, "residuals": list(one.residuals),
            }
            for one in self.found.breaks
        ]  # fmt: skip


def find_breaks(
    takes: Sequence[Take],
    compared: Mapping[tuple[int, int], Pairing],
    together: Clocks | None = None,
    *,
    calibration: Any = None,
    max_shift: float | None = None,
) -> RepairedClocks | None:
    """Where the clocks of cameras broke; None where they did not, or where nothing tells: other joints in each, or no
    keypoints. compared ``(i, j)``."""
    people = _people(takes, compared)
    if people is None:
        return None
    lens = lenses(calibration, [take.name for take in takes])
    known = any(clip.confidence is not None for clip in people)
    given: dict[str, Any] = {
        "times": tuple(torch.from_numpy(np.array(clip.times, dtype=np.float64)) for clip in people),
        "weights": tuple(torch.from_numpy(joint_weights(clip)) for clip in people) if known else None,
        "calibration": lens.values if lens else None,
        "max_shift": max_shift,
        "options": SyncOptions().of_points,
    }
    tracks = [torch.from_numpy(np.array(clip.joints, dtype=np.float64)) for clip in people]
    if together is None:
        found = dyntorch.tasks.breaks(tracks[0], tracks[1], compared[0, 1].shift, **given)
    else:
        found = dyntorch.tasks.camera_breaks(tracks, together, **given)
    if not (found.ok and found.breaks):
        return None
    names = {str(i): take.name for i, take in enumerate(takes)}
    named = dataclasses.replace(found, notices=tuple(notice.with_names(names) for notice in found.notices))
    changes: list[Floats] = [times.numpy() - clip.times for times, clip in zip(found.times, people, strict=True)]
    return RepairedClocks(
        named,
        tuple(retime(take, np.asarray(clip.times, np.float64), by) for take, clip, by in zip(takes, people, changes, strict=True)),
    )


def _people(takes: Sequence[Take], compared: Mapping[tuple[int, int], Pairing]) -> list[Clip] | None:
    """The person of each camera, with joints that all of them have; None where they have other ones."""
    if any(take.kind != "keypoints" or take.spatial for take in takes):
        return None
    chosen = []
    for number, take in enumerate(takes):
        mine = [(one.shift.confidence, one.people[pair.index(number)]) for pair, one in compared.items() if number in pair]
        chosen.append(take.people[max(mine)[1]])
    first = chosen[0]
    for clip in chosen[1:]:
        first, _, same, _ = common_joints(first, clip)
        if not same:
            return None
    return [common_joints(first, clip)[1] for clip in chosen]


def retime(take: Take, times: Floats, by: Floats) -> Take:
    """A recording whose clock is changed. times ``(k,)``, by ``(k,)``."""

    def new(old: Floats) -> Floats:
        rows = np.clip(np.searchsorted(times, old + 1e-9, side="right") - 1, 0, len(times) - 1)
        return np.asarray(old + by[rows], dtype=np.float64)

    if not by.any():
        return take
    changed = {id(clip): clip.replace(times=new(np.asarray(clip.times, np.float64))) for clip in (*take.people, *take.everyone)}
    people, everyone = (tuple(changed[id(clip)] for clip in clips) for clips in (take.people, take.everyone))
    return dataclasses.replace(take, people=people, everyone=everyone, times=new(take.times))

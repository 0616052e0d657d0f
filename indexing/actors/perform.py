"""Actions performed by a person: one clip, a stream of several, or a set of clips of several people from several cameras."""

from __future__ import annotations

import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from indexing.actors.body import CENTRAL, INDEX, LIMBS, STYLES, Person, clip_angles, joints, mirror_angles
from indexing.actors.detector import detect
from indexing.clip import Clip, ClipSet, FloatArray
from indexing.skeleton import COCO17

# ----------------------------------------------------------------------------------------------------------------------
# The movements, as key poses: what an average right-handed person does, in degrees and seconds.
#
# A pose names only what differs from standing (channels of :mod:`indexing.actors.body`; a name without ``l_`` or ``r_`` sets
# both sides).  The right side is the preferred one: left-handers do the mirror image.


# ruff: noqa: C408  (keyword form keeps the tables of poses readable)


_STAND = dict(lean=1.0, flex=2.0, abd=8.0, rot=15.0, elbow=14.0, hip=2.0, knee=4.0, spread=4.0, out=6.0, grip=0.5)


def pose(base: Mapping[str, float] | None = None, **values: float) -> FloatArray:
    """``(channels,)`` standing, changed by ``base``, changed by ``values``."""
    out = np.zeros(len(INDEX))
    for name, value in (*_STAND.items(), *(base or {}).items(), *values.items()):
        for full in ("l_" + name, "r_" + name) if name in LIMBS else (name,):
            out[INDEX[full]] = value
    return out


@dataclass(frozen=True)
class ActorMove:
    """One action as key poses."""

    keys: tuple[tuple[float, FloatArray], ...]
    loop: tuple[int, int] = (0, 0)
    repeats: tuple[int, int] = (1, 1)
    cycle: bool = False
    legs: float = 0.7
    reach: float = 1.0

    def timeline(self, repeats: int) -> tuple[FloatArray, FloatArray]:
        """``(keys,)`` seconds and ``(keys, channels)`` poses with the loop written out; a cycle gets three periods more."""
        first, end = (0, len(self.keys)) if self.cycle else self.loop
        keys = self.keys[:first] + self.keys[first:end] * (repeats + 3 if self.cycle else repeats) + self.keys[end:]
        steps = np.array([step for step, _ in keys])
        return np.cumsum(steps) - steps[0], np.stack([shape for _, shape in keys])

    @property
    def period(self) -> float:
        """Seconds of one repetition."""
        first, end = (0, len(self.keys)) if self.cycle else self.loop
        return sum(step for step, _ in self.keys[first:end])


def _gait(
    period: float, hip: list[float], knee: list[float], swing: float, elbow: tuple[float, float], air: float, **rest: float
) -> tuple[tuple[float, FloatArray], ...]:
    """One period from thigh and knee angles of the left leg at equal steps from its heel strike; the right is half a period
    late."""
    n, centre, bend = len(hip), rest.pop("flex"), (elbow[1] - elbow[0]) / 2
    keys = []
    for i in range(n):
        j = (i + n // 2) % n
        left = float(np.cos(2 * np.pi * (i / n - 0.03)))  # 1 where the left leg is foremost
        legs = dict(l_hip=hip[i], r_hip=hip[j], l_knee=knee[i], r_knee=knee[j])
        arms = dict(l_flex=centre - swing * left, l_elbow=elbow[0] + bend * (1 - left))
        arms |= dict(r_flex=centre + swing * left, r_elbow=elbow[0] + bend * (1 + left))
        trunk = dict(hips=-4.0 * left, twist=0.25 * swing * left, list=3.0 * float(np.sin(2 * np.pi * i / n)))
        flight = air if i % (n // 2) == n // 2 - 1 else 0.0
        keys.append((period / n, pose({**legs, **arms, **trunk, **rest}, air=flight, grip=0.0)))
    return tuple(keys)


# fmt: off
STAND = pose()
SEATED = pose(hip=88, knee=88, lean=4, flex=32, abd=7, rot=24, elbow=48, out=14)
_ON_LEFT, _ON_RIGHT = pose(l_grip=1, r_grip=0), pose(l_grip=0, r_grip=1)

_WALK = _gait(
    1.12, hip=[24, 19, 9, 0, -9, -16, -7, 13, 26, 28], knee=[5, 17, 15, 8, 6, 14, 42, 62, 45, 12],
    swing=21, elbow=(14, 34), air=0.0, flex=3, lean=2, spread=1.5, abd=7,
)
_RUN = _gait(
    0.74, hip=[33, 25, 11, -6, -19, -20, -6, 22, 43, 43], knee=[22, 40, 41, 29, 16, 32, 78, 106, 86, 44],
    swing=36, elbow=(78, 104), air=0.07, flex=-6, lean=9, spread=1.5, abd=12, rot=28,
)

_WIDE = pose(spread=9, out=18)
_DEEP = pose(spread=9, out=24, hip=90, knee=116, lean=40, nod=-18, flex=122, abd=2, rot=0, elbow=12)
_SQUAT = ((0.0, _WIDE), (0.1, _WIDE), (1.0, _DEEP), (0.2, _DEEP), (0.9, _WIDE), (0.1, _WIDE))

_LUNGING = dict(l_grip=1, r_grip=0, abd=12, elbow=20, lean=4)
_STEP = pose(_LUNGING, r_hip=52, r_knee=58, l_hip=-4, l_knee=10)
_LOW = pose(_LUNGING, r_hip=82, r_knee=84, l_hip=-17, l_knee=70)
_BACK = pose(_LUNGING, r_hip=48, r_knee=64, l_hip=-2, l_knee=12)
_LUNGE = ((0.0, _ON_LEFT), (0.1, _ON_LEFT), (0.5, _STEP), (0.5, _LOW), (0.25, _LOW), (0.5, _BACK), (0.5, _ON_LEFT))

_OPEN = dict(spread=19, abd=158, rot=-20, elbow=22, flex=6)
_AIRBORNE = pose(spread=9, abd=80, rot=0, elbow=16, flex=6, hip=1, knee=5, air=0.1)
_JACK = (
    (0.0, pose(spread=2)),
    (0.14, pose(spread=2, hip=12, knee=26, abd=14)), (0.2, _AIRBORNE), (0.18, pose(_OPEN, hip=6, knee=12)),
    (0.13, pose(_OPEN, hip=14, knee=28)), (0.2, _AIRBORNE), (0.18, pose(spread=2, hip=5, knee=12)),
    (0.06, pose(spread=2)),
)

_WAVING = dict(r_flex=12, r_rot=-88, side=3)
_IN, _OUT = pose(_WAVING, r_abd=66, r_elbow=122), pose(_WAVING, r_abd=72, r_elbow=64)
_WAVE = ((0.0, STAND), (0.1, STAND), (0.5, _OUT), (0.28, _IN), (0.28, _OUT), (0.55, STAND), (0.1, STAND))

_FIGHT = dict(l_hip=20, l_knee=32, r_hip=-9, r_knee=20, spread=7, out=12, l_grip=0, r_grip=1)
_FISTS = _FIGHT | dict(flex=32, abd=12, rot=38, elbow=122, lean=7, nod=6)
_STEP_IN = pose(_FIGHT, l_hip=26, l_knee=48, r_hip=0, r_knee=10, flex=16, elbow=60)
_GUARD = pose(_FISTS, twist=-14)
_HIT = pose(_FISTS, r_flex=96, r_abd=24, r_rot=25, r_elbow=6, twist=34, lean=11, r_hip=-15)
_PUNCH = (
    (0.0, _ON_RIGHT), (0.25, _STEP_IN), (0.3, _GUARD),
    (0.15, _GUARD), (0.2, _HIT), (0.06, _HIT), (0.28, _GUARD),
    (0.25, _STEP_IN), (0.3, _ON_RIGHT),
)

_ONE_LEG = dict(l_grip=1, r_grip=0, l_hip=3, l_knee=10, elbow=42, abd=22)
_SWING = pose(_ONE_LEG, r_hip=-20, r_knee=42, l_hip=7, l_knee=16, r_flex=24, l_flex=-14, lean=8)
_CHAMBER = pose(_ONE_LEG, r_hip=58, r_knee=82, r_flex=-8, l_flex=26, lean=0)
_STRIKE = pose(_ONE_LEG, r_hip=86, r_knee=8, r_flex=-28, l_flex=42, lean=-15, nod=14, twist=10)
_RETRACT = pose(_ONE_LEG, r_hip=48, r_knee=72, lean=0)
_KICK = (
    (0.0, _ON_LEFT), (0.1, _ON_LEFT), (0.36, _SWING), (0.3, _CHAMBER), (0.17, _STRIKE), (0.07, _STRIKE), (0.3, _RETRACT),
    (0.36, _ON_LEFT), (0.1, _ON_LEFT),
)

_BOWED = pose(lean=66, nod=14, hip=9, knee=3, flex=8, elbow=10, abd=4)
_BOW = ((0.0, STAND), (0.15, STAND), (0.95, _BOWED), (0.35, _BOWED), (0.95, STAND), (0.15, STAND))

_FALLING = pose(hip=60, knee=76, lean=40, nod=-12, flex=48, abd=10, elbow=36, out=12)
_LANDED = pose(hip=88, knee=88, lean=16, flex=36, elbow=48, out=14)
_SIT = ((0.0, STAND), (0.15, STAND), (0.8, _FALLING), (0.5, _LANDED), (0.35, SEATED), (0.2, SEATED))
_RISING = pose(hip=72, knee=92, lean=46, nod=-20, flex=54, abd=9, elbow=44, out=12)
_ALMOST_UP = pose(lean=8, hip=10, knee=16, flex=10)
_RISE = ((0.0, SEATED), (0.15, SEATED), (0.6, _RISING), (0.8, _ALMOST_UP), (0.3, STAND), (0.15, STAND))

_COCKED = pose(
    _FIGHT, r_abd=92, r_flex=-14, r_rot=-86, r_elbow=96, l_flex=68, l_elbow=24, twist=-36, lean=-7, look=24,
    l_hip=14, l_knee=20, r_knee=26,
)
_RELEASE = pose(_FIGHT, r_abd=30, r_flex=128, r_rot=-10, r_elbow=18, l_flex=18, l_elbow=62, twist=22, lean=14, r_hip=-16)
_FOLLOW = pose(
    _FIGHT, r_abd=0, r_flex=52, r_rot=30, r_elbow=26, l_flex=-12, l_elbow=56, twist=38, lean=30,
    l_hip=28, l_knee=40, r_hip=-20, r_knee=26,
)
_THROW = (
    (0.0, _ON_RIGHT), (0.2, _ON_RIGHT), (0.55, _COCKED), (0.12, _COCKED), (0.24, _RELEASE), (0.24, _FOLLOW), (0.35, _STEP_IN),
    (0.3, _ON_RIGHT),
)

_REACH = pose(
    lean=74, nod=-14, side=-5, twist=16, hip=66, knee=90, out=18,
    r_flex=80, r_abd=4, r_rot=5, r_elbow=16, l_flex=46, l_elbow=40,
)
_LIFT = pose(lean=44, hip=44, knee=60, out=12, r_flex=58, r_elbow=52, l_flex=32, l_elbow=30)
_CARRY = pose(r_elbow=88, r_flex=8, r_rot=22)
_PICK = ((0.0, STAND), (0.15, STAND), (1.0, _REACH), (0.2, _REACH), (0.5, _LIFT), (0.5, _CARRY), (0.4, STAND))
# fmt: on

MOVES: dict[str, ActorMove] = {
    "walk": ActorMove(_WALK, repeats=(2, 3), cycle=True),
    "run": ActorMove(_RUN, repeats=(3, 4), cycle=True),
    "squat": ActorMove(_SQUAT, loop=(1, 5)),
    "lunge": ActorMove(_LUNGE, loop=(1, 7), legs=0.4),
    "jumping_jack": ActorMove(_JACK, loop=(1, 7), repeats=(2, 3), legs=0.5),
    "wave": ActorMove(_WAVE, loop=(3, 5), repeats=(2, 4)),
    "punch": ActorMove(_PUNCH, loop=(3, 7), repeats=(1, 3)),
    "kick": ActorMove(_KICK, loop=(1, 8)),
    "bow": ActorMove(_BOW, loop=(1, 5)),
    "sit_down": ActorMove(_SIT, legs=0.15),
    "stand_up": ActorMove(_RISE, legs=0.15),
    "throw": ActorMove(_THROW, loop=(1, 8)),
    "pick_up": ActorMove(_PICK, loop=(1, 7), legs=0.1, reach=0.1),
}
ENDS = {"sit_down": (STAND, SEATED), "stand_up": (SEATED, STAND)}  # poses before and after; the others start and end standing


ACTIONS: tuple[str, ...] = tuple(MOVES)
FADE = 0.3  # seconds in which a stream goes from standing into an action and out of it
_ARMS = LIMBS[:4]
_GROUPS: dict[str, list[str]] = {  # channels that vary in size together; feet keep their width
    "trunk": list(CENTRAL[1:-1]),
    "left": ["l_" + name for name in _ARMS],
    "right": ["r_" + name for name in _ARMS],
    "legs": [side + name for side in ("l_", "r_") for name in ("hip", "knee", "out")],
    "jump": ["air"],
}


def perform(
    action: str, person: Person, *, fps: float = 30.0, repeats: int | None = None, rng: np.random.Generator | int | None = None
) -> Clip:
    """One natural execution of an action, about 1.5 to 4 seconds.

    Walk and run are gaits on a treadmill: the body stays and the feet slide back, so no action is told by its path alone.
    Everything else keeps the feet that carry weight where they stand.

    Args:
        action: one of :data:`ACTIONS`.
        fps: frames per second.
        repeats: double steps, waves, jumps, punches, or whole executions of the rest (``sit_down`` and ``stand_up`` are done
            once); default: what is natural, drawn from ``rng``.
        rng: what differs between two executions by the same person (tempo, size, timing, idle sway, phase of a gait);
            ``None`` gives the person's most typical execution, always the same.

    Returns:
        a 3D clip ``(frames, 17, 3)`` in metres, y up, right-handed (frame: :mod:`indexing.actors.body`), labelled with the action.

    Raises:
        ValueError: an unknown action, or a rate or number of repeats that is not positive.

    Example:
        >>> clip = perform("squat", Person(), fps=25.0)
        >>> clip.label, clip.joints.shape[1:], clip.up, 1.5 < clip.duration < 4.0
        ('squat', (17, 3), 'y', True)
    """
    rng = None if rng is None else np.random.default_rng(rng)
    angles = _angles(_move(action), action, person, fps, repeats, rng)
    return _clip(angles, person, fps, rng, label=action, name=action)


def stream(
    actions: Sequence[str],
    person: Person,
    *,
    fps: float = 30.0,
    rng: np.random.Generator | int = 0,
    rest: tuple[float, float] = (0.6, 1.5),
    repeats: int | None = None,
) -> tuple[Clip, list[tuple[str, float, float]]]:
    """Several actions one after the other, with rests between them and at both ends.

    The person stands while resting, or stays seated between ``sit_down`` and ``stand_up``.  Where an action needs the other
    posture (``sit_down`` followed by ``walk``), the change happens during the rest before it, slowly and without a label.

    Args:
        actions: labels from :data:`ACTIONS`, in order.
        rest: shortest and longest rest in seconds.
        repeats: of each action, as in :func:`perform`; default: what is natural.

    Returns:
        the unlabelled 3D clip, and (label, start, end) in seconds on the clip's clock for each action in turn.

    Raises:
        ValueError: an unknown action, or a rest that is not an increasing pair of times.

    Example:
        >>> clip, truth = stream(["bow", "wave"], Person(), rng=1)
        >>> [label for label, _, _ in truth], truth[0][2] < truth[1][1], truth[1][2] < clip.duration
        (['bow', 'wave'], True, True)
    """
    if not (len(rest) == 2 and 0 <= rest[0] <= rest[1] < np.inf):
        raise ValueError(f"rest must be (shortest, longest) in seconds, got {rest!r}")
    rng = np.random.default_rng(rng)
    moves = [(action, _move(action)) for action in actions]
    parts, truth, at, posture = [], [], 0, STAND
    for action, move in moves:
        before, after = ENDS.get(action, (STAND, STAND))
        gap = _perform_rest(posture, before, rng.uniform(*rest), person, fps)
        body = _blend(_angles(move, action, person, fps, repeats, rng), before, after, person, fps)
        truth.append((action, (at + len(gap)) / fps, (at + len(gap) + len(body) - 1) / fps))
        parts += [gap, body]
        at, posture = at + len(gap) + len(body), after
    parts.append(_perform_rest(posture, posture, rng.uniform(*rest), person, fps))
    return _clip(np.concatenate(parts), person, fps, rng, label=None, name="stream"), truth


def dataset(
    people: Sequence[Person] | int,
    actions: Sequence[str] = ACTIONS,
    *,
    azimuth: float | Sequence[float] | None = 0.0,
    takes: int = 1,
    fps: float = 30.0,
    rng: np.random.Generator | int = 0,
    **camera: Any,
) -> ClipSet:
    """Every action by every person as every camera sees it: the cameras film the same execution.

    Args:
        people: the actors, or how many to draw.
        azimuth: degrees, one or several cameras (see :func:`indexing.actors.detect`); ``None`` gives the 3D clips.
        takes: executions of each action by each person.
        camera: further options of :func:`indexing.actors.detect`.

    Returns:
        labelled clips with the fields ``subject``, ``take`` and (2D) ``azimuth``, ordered by person, action, take, camera.

    Example:
        >>> clips = dataset(2, ["bow", "kick"], azimuth=(0.0, 90.0))
        >>> len(clips), clips.fields, len(clips.select(subject=1, azimuth=90.0))
        (8, ('subject', 'take', 'azimuth'), 2)
    """
    rng = np.random.default_rng(rng)
    cast = [Person.random(rng) for _ in range(people)] if isinstance(people, int) else list(people)
    views = [azimuth] if azimuth is None or isinstance(azimuth, (int, float)) else list(azimuth)
    clips = []
    for subject, person in enumerate(cast):
        for action in actions:
            for take in range(takes):
                meta = {"subject": subject, "take": take}
                clip = perform(action, person, fps=fps, rng=rng).replace(name=f"{action}-{subject}-{take}", meta=meta)
                for view in views:
                    if view is None:
                        clips.append(clip)
                    else:
                        seen = detect(clip, azimuth=view, rng=rng, **camera)
                        clips.append(seen.replace(name=f"{clip.name}-{view:g}", meta={**meta, "azimuth": float(view)}))
    return ClipSet(clips, "actors")


def _move(action: str) -> ActorMove:
    if action not in MOVES:
        raise ValueError(f"unknown action {action!r}; the actors know: {', '.join(ACTIONS)}")
    return MOVES[action]


def _angles(
    move: ActorMove, action: str, person: Person, fps: float, repeats: int | None, rng: np.random.Generator | None
) -> FloatArray:
    """``(frames, channels)`` the person's way of doing it, before idle sway."""
    if not (np.isfinite(fps) and fps > 0):
        raise ValueError(f"fps must be a positive number of frames per second, got {fps!r}")
    few, many = move.repeats
    count = repeats if repeats is not None else (few + many) // 2 if rng is None else int(rng.integers(few, many + 1))
    if count < 1:
        raise ValueError(f"repeats must be at least 1, got {repeats!r}")
    habit = _habits(action, person)  # the same for every execution: what makes it this person's squat
    chance = np.zeros(8) if rng is None else np.clip(rng.normal(size=8), -2.5, 2.5)  # differs between executions
    times, poses = move.timeline(count)
    poses = STAND + (poses - STAND) * _gain(move, person, habit, chance)
    tempo = person.tempo * np.exp(0.05 * habit[0] + 0.05 * chance[0])
    start, end = 0.0, times[-1]
    if move.cycle:  # the arms are late, so begin one period in
        shift = 0.0 if rng is None else float(rng.uniform(0.0, move.period))
        start, end = move.period + shift, move.period * (1 + count) + shift
    else:
        times = _warp_times(times, habit[1] + 0.5 * chance[1], habit[2] + 0.5 * chance[2])
        end = times[-1]
    frames = max(2, round((end - start) / tempo * fps) + 1)
    moments = np.linspace(start, end, frames)
    angles = interpolate(times, poses, moments)
    arms = [INDEX[name] for name in _GROUPS["left"] + _GROUPS["right"]]
    angles[:, arms] = interpolate(times, poses[:, arms], moments - (person.lag + 0.015 * chance[3]))
    angles = _personal_angles(angles, person)
    return clip_angles(mirror_angles(angles) if person.handed < 0 else angles)


def _gain(move: ActorMove, person: Person, habit: FloatArray, chance: FloatArray) -> FloatArray:
    """``(channels,)`` how far this execution goes beyond (> 1) or stays behind (< 1) the average one."""
    size = np.log(person.amplitude) + 0.05 * chance[4]
    arms = 0.6 * size + 0.08 * habit[4] + 0.04 * chance[6]
    sizes = {
        "trunk": move.reach * (size + 0.10 * habit[3] + 0.04 * chance[5]),
        "left": move.reach * (arms - person.asymmetry),
        "right": move.reach * (arms + person.asymmetry),
        "legs": move.legs * (size + 0.08 * habit[5] + 0.03 * chance[7]),
        "jump": size,
    }
    gain = np.ones(len(INDEX))
    for group, names in _GROUPS.items():
        gain[[INDEX[name] for name in names]] = np.exp(sizes[group])
    return gain


def _habits(action: str, person: Person) -> FloatArray:
    """``(8,)`` the person's style, seen through this action: standard normal over people, independent between actions."""
    mix = np.random.default_rng(zlib.crc32(action.encode())).normal(size=(8, STYLES))
    habits: FloatArray = np.clip(mix @ np.array(person.style) / np.sqrt(STYLES), -2.0, 2.0)
    return habits


def _personal_angles(angles: FloatArray, person: Person) -> FloatArray:
    """The same movement with the person's carriage: posture, stance, how the arms hang."""
    out = angles.copy()
    carriage = {"lean": person.posture, "nod": -0.5 * person.posture, "turn": 4.0 * person.style[0]}
    sides = {"spread": person.stance, "abd": 2.0 * person.style[1], "elbow": 5.0 * person.style[2], "out": 3.0 * person.style[3]}
    for name, value in {**carriage, **{side + key: v for key, v in sides.items() for side in ("l_", "r_")}}.items():
        out[:, INDEX[name]] += value
    return out


def _warp_times(times: FloatArray, bias: float, ripple: float) -> FloatArray:
    """Key times with the intervals stretched: early ones against late ones, and every other one."""
    steps = np.diff(times)
    place = np.arange(len(steps))
    stretch = 0.08 * bias * np.linspace(-1.0, 1.0, len(steps)) + 0.06 * ripple * np.cos(np.pi * place)
    return np.concatenate([[0.0], np.cumsum(steps * np.exp(stretch))])


def interpolate(times: FloatArray, values: FloatArray, at: FloatArray) -> FloatArray:
    """``(len(at), channels)``: piecewise cubic through the keys that never leaves the range of two neighbouring keys."""
    steps = np.diff(times)[:, None]
    slopes = np.diff(values, axis=0) / steps
    before, after = slopes[:-1], slopes[1:]
    total = np.where(before * after > 0, before + after, 1.0)
    tangents = np.zeros_like(values)
    tangents[1:-1] = np.where(before * after > 0, 2 * before * after / total, 0.0)
    at = np.clip(at, times[0], times[-1])
    i = np.clip(np.searchsorted(times, at, side="right") - 1, 0, len(steps) - 1)
    u = ((at - times[i]) / steps[i, 0])[:, None]
    rise = u * u * (3 - 2 * u)
    bulge = u * (1 - u) * steps[i] * ((1 - u) * tangents[i] - u * tangents[i + 1])
    smooth: FloatArray = (1 - rise) * values[i] + rise * values[i + 1] + bulge
    return smooth


def _ease(u: FloatArray) -> FloatArray:
    """From 0 to 1 with the smoothness of a reaching movement (minimum jerk)."""
    u = np.clip(u, 0.0, 1.0)
    eased: FloatArray = u**3 * (10 - 15 * u + 6 * u * u)
    return eased


def _static_pose(posture: FloatArray, person: Person) -> FloatArray:
    shape = _personal_angles(posture[None], person)
    angles = clip_angles(mirror_angles(shape) if person.handed < 0 else shape)
    return angles.reshape(-1)


def _perform_rest(first: FloatArray, last: FloatArray, seconds: float, person: Person, fps: float) -> FloatArray:
    """Standing or sitting still; where the posture changes, at least 1.4 s long."""
    change = first is not last
    frames = max(1, round(max(seconds, 1.4 if change else 0.0) * fps))
    u = np.linspace(0.0, 1.0, frames)[:, None]
    a, b = _static_pose(first, person), _static_pose(last, person)
    return a + (b - a) * _ease((u - 0.1) / 0.8)


def _blend(angles: FloatArray, before: FloatArray, after: FloatArray, person: Person, fps: float) -> FloatArray:
    """The action, left and entered from a resting posture; never by more than a third of it."""
    frames = np.arange(len(angles))[:, None]
    span = max(1.0, min(FADE * fps, len(angles) / 3))
    a, b = _static_pose(before, person), _static_pose(after, person)
    angles = a + (angles - a) * _ease(frames / span)
    return b + (angles - b) * _ease((len(angles) - 1 - frames) / span)


def _clip(angles: FloatArray, person: Person, fps: float, rng: np.random.Generator | None, **known: Any) -> Clip:
    """Idle sway, then the body."""
    rng = np.random.default_rng(0) if rng is None else rng
    seconds = np.arange(len(angles)) / fps
    size = {"lean": 1.0, "side": 0.8, "twist": 1.2, "nod": 2.0, "look": 3.0, "hips": 0.8, "turn": 1.0}
    size |= {side + name: v for side in ("l_", "r_") for name, v in {"flex": 2.0, "abd": 1.5, "rot": 3.0, "elbow": 3.0}.items()}
    waves, phases = rng.uniform(0.15, 0.8, (3, 1, len(size))), rng.uniform(0.0, 2 * np.pi, (3, 1, len(size)))
    sway = np.sin(2 * np.pi * waves * seconds[:, None] + phases).sum(axis=0) * np.sqrt(2 / 3)  # standard deviation 1
    swayed = angles.copy()
    swayed[:, [INDEX[name] for name in size]] += person.sway * sway * np.array(list(size.values()))
    return Clip(joints(clip_angles(swayed), person), fps=fps, skeleton=COCO17, up="y", **known)

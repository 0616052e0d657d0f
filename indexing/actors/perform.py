"""Actions performed by a person: one clip, a stream of several, or a set of clips of several people from several cameras."""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from typing import Any

import numpy as np

from indexing.actors.body import CENTRAL, INDEX, LIMBS, STYLES, Person, joints, limited, mirrored
from indexing.actors.detector import detect
from indexing.actors.moves import ENDS, MOVES, STAND, Move
from indexing.clip import Clip, ClipSet, FloatArray
from indexing.skeleton import COCO17

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
) -> tuple[Clip, list[tuple[str, float, float]]]:
    """Several actions one after the other, with rests between them and at both ends.

    The person stands while resting, or stays seated between ``sit_down`` and ``stand_up``.  Where an action needs the other
    posture (``sit_down`` followed by ``walk``), the change happens during the rest before it, slowly and without a label.

    Args:
        actions: labels from :data:`ACTIONS`, in order.
        rest: shortest and longest rest in seconds.

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
        gap = _rest(posture, before, rng.uniform(*rest), person, fps)
        body = _faded(_angles(move, action, person, fps, None, rng), before, after, person, fps)
        truth.append((action, (at + len(gap)) / fps, (at + len(gap) + len(body) - 1) / fps))
        parts += [gap, body]
        at, posture = at + len(gap) + len(body), after
    parts.append(_rest(posture, posture, rng.uniform(*rest), person, fps))
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


def _move(action: str) -> Move:
    if action not in MOVES:
        raise ValueError(f"unknown action {action!r}; the actors know: {', '.join(ACTIONS)}")
    return MOVES[action]


def _angles(
    move: Move, action: str, person: Person, fps: float, repeats: int | None, rng: np.random.Generator | None
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
        times = _retimed(times, habit[1] + 0.5 * chance[1], habit[2] + 0.5 * chance[2])
        end = times[-1]
    frames = max(2, round((end - start) / tempo * fps) + 1)
    moments = np.linspace(start, end, frames)
    angles = interpolate(times, poses, moments)
    arms = [INDEX[name] for name in _GROUPS["left"] + _GROUPS["right"]]
    angles[:, arms] = interpolate(times, poses[:, arms], moments - (person.lag + 0.015 * chance[3]))
    angles = _own(angles, person)
    return limited(mirrored(angles) if person.handed < 0 else angles)


def _gain(move: Move, person: Person, habit: FloatArray, chance: FloatArray) -> FloatArray:
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


def _own(angles: FloatArray, person: Person) -> FloatArray:
    """The same movement with the person's carriage: posture, stance, how the arms hang."""
    out = angles.copy()
    carriage = {"lean": person.posture, "nod": -0.5 * person.posture, "turn": 4.0 * person.style[0]}
    sides = {"spread": person.stance, "abd": 2.0 * person.style[1], "elbow": 5.0 * person.style[2], "out": 3.0 * person.style[3]}
    for name, value in {**carriage, **{side + key: v for key, v in sides.items() for side in ("l_", "r_")}}.items():
        out[:, INDEX[name]] += value
    return out


def _retimed(times: FloatArray, bias: float, ripple: float) -> FloatArray:
    """Key times with the intervals stretched: early ones against late ones, and every other one."""
    steps = np.diff(times)
    place = np.arange(len(steps))
    stretch = 0.08 * bias * np.linspace(-1.0, 1.0, len(steps)) + 0.06 * ripple * np.cos(np.pi * place)
    return np.concatenate([[0.0], np.cumsum(steps * np.exp(stretch))])


def interpolate(times: FloatArray, values: FloatArray, at: FloatArray) -> FloatArray:
    """``(len(at), channels)``: piecewise cubic through the keys that never leaves the range of two neighbouring keys.

    Hermite cubics with harmonic-mean tangents (monotone, after Fritsch and Butland): a joint that reaches its turning point at
    a key does not overshoot it.  Held at the first and last key outside ``times``.
    """
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


def _posed(posture: FloatArray, person: Person) -> FloatArray:
    shape = _own(posture[None], person)
    angles = limited(mirrored(shape) if person.handed < 0 else shape)
    return angles.reshape(-1)


def _rest(first: FloatArray, last: FloatArray, seconds: float, person: Person, fps: float) -> FloatArray:
    """Standing or sitting still; where the posture changes, at least 1.4 s long."""
    change = first is not last
    frames = max(1, round(max(seconds, 1.4 if change else 0.0) * fps))
    u = np.linspace(0.0, 1.0, frames)[:, None]
    a, b = _posed(first, person), _posed(last, person)
    return a + (b - a) * _ease((u - 0.1) / 0.8)


def _faded(angles: FloatArray, before: FloatArray, after: FloatArray, person: Person, fps: float) -> FloatArray:
    """The action, left and entered from a resting posture; never by more than a third of it."""
    frames = np.arange(len(angles))[:, None]
    span = max(1.0, min(FADE * fps, len(angles) / 3))
    a, b = _posed(before, person), _posed(after, person)
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
    return Clip(joints(limited(swayed), person), fps=fps, skeleton=COCO17, up="y", **known)

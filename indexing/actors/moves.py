"""The movements, as key poses: what an average right-handed person does, in degrees and seconds.

A pose names only what differs from standing (channels of :mod:`indexing.actors.body`; a name without ``l_`` or ``r_`` sets
both sides).  The right side is the preferred one: left-handers do the mirror image.
"""

# ruff: noqa: C408  (keyword form keeps the tables of poses readable)
from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from indexing.actors.body import INDEX, LIMBS
from indexing.clip import FloatArray

_STAND = dict(lean=1.0, flex=2.0, abd=8.0, rot=15.0, elbow=14.0, hip=2.0, knee=4.0, spread=4.0, out=6.0, grip=0.5)


def pose(base: Mapping[str, float] | None = None, **values: float) -> FloatArray:
    """``(channels,)`` standing, changed by ``base``, changed by ``values``."""
    out = np.zeros(len(INDEX))
    for name, value in (*_STAND.items(), *(base or {}).items(), *values.items()):
        for full in ("l_" + name, "r_" + name) if name in LIMBS else (name,):
            out[INDEX[full]] = value
    return out


@dataclass(frozen=True)
class Move:
    """One action as key poses.

    Args:
        keys: (seconds since the previous key, pose); the first key's time is not used, except in a cycle.
        loop: (first, end) of the keys that are repeated.
        repeats: fewest and most repetitions in one natural execution.
        cycle: the keys are one period of a cycle that has neither start nor end (gait).
        legs, reach: how strongly a person's amplitude changes the legs, and the trunk and arms (1 = fully; nearly 0 where the
            world says how far to go: a chair's height, the floor).
    """

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
    """One period from thigh and knee angles of the left leg at equal steps from its heel strike; the right is half a period late.

    Each arm swings with the opposite leg, ``swing`` degrees to either side of ``flex``, its elbow between two angles; ``air``
    metres above the floor just before each heel strike.
    """
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

MOVES: dict[str, Move] = {
    "walk": Move(_WALK, repeats=(2, 3), cycle=True),
    "run": Move(_RUN, repeats=(3, 4), cycle=True),
    "squat": Move(_SQUAT, loop=(1, 5)),
    "lunge": Move(_LUNGE, loop=(1, 7), legs=0.4),
    "jumping_jack": Move(_JACK, loop=(1, 7), repeats=(2, 3), legs=0.5),
    "wave": Move(_WAVE, loop=(3, 5), repeats=(2, 4)),
    "punch": Move(_PUNCH, loop=(3, 7), repeats=(1, 3)),
    "kick": Move(_KICK, loop=(1, 8)),
    "bow": Move(_BOW, loop=(1, 5)),
    "sit_down": Move(_SIT, legs=0.15),
    "stand_up": Move(_RISE, legs=0.15),
    "throw": Move(_THROW, loop=(1, 8)),
    "pick_up": Move(_PICK, loop=(1, 7), legs=0.1, reach=0.1),
}
ENDS = {"sit_down": (STAND, SEATED), "stand_up": (SEATED, STAND)}  # poses before and after; the others start and end standing

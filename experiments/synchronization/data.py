"""Pairs of unsynchronized virtual cameras around a motion capture person, with the true clocks, and what goes wrong with cameras.

A person moves as recorded, sub-frame positions by cubic splines; two static perspective cameras with random places around it film
with clocks of their own: b's clock = a's clock * rate + offset.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import torch
from scipy.interpolate import CubicSpline
from torch import Generator, Tensor

from experiments.common.real_data import Take, takes


def _film_motion(motion: Motion, generator: Generator, settings: dict[str, Any]) -> Pair:
    """The two cameras, at a random shift."""
    filming = Filming(**settings)
    largest = filming.max_shift / filming.rates[0]
    return filmed(motion, draw(-largest, largest, generator), filming, generator)


def periodic_pair(joints: Tensor, generator: Generator, **settings: Any) -> Pair:
    """Two cameras around a person who repeats .8 to 1.4 s of a take in place, exactly."""
    return _film_motion(periodic_motion(joints, generator), generator, settings)


def periodic_motion(joints: Tensor, generator: Generator) -> Motion:
    """A person who repeats .8 to 1.4 s of a take in place, exactly: six harmonics of it."""
    period, times = draw(0.8, 1.4, generator), torch.linspace(0, 1, 65, dtype=torch.float64)[:-1]
    take, last = played(joints - joints[:, :1] + joints[:, :1].mean(0)), (len(joints) - 1) / RECORDED
    for _ in range(20):
        start = draw(0.0, last - period, generator)
        cycle = take(start + period * times)
        if float((cycle - cycle.mean(0)).square().sum(-1).mean().sqrt()) > MOVING / 2:
            break
    drift = take(torch.tensor([start + period])) - take(torch.tensor([start]))
    spectrum = torch.fft.rfft(cycle - times[:, None, None] * drift, dim=0)[:7] / len(times)
    twice = torch.tensor([1.0] + 6 * [2.0], dtype=torch.float64)

    def motion(moments: Tensor) -> Tensor:
        turns = torch.exp(2j * math.pi * moments[:, None] / period * torch.arange(7))
        return torch.einsum("tk,kni->tni", turns * twice, spectrum).real

    return motion


def still_pair(joints: Tensor, generator: Generator, **settings: Any) -> Pair:
    """Two cameras around a person who stands as in one frame of a take and sways by 3 mm."""
    return _film_motion(still_motion(joints, generator), generator, settings)


def still_motion(joints: Tensor, generator: Generator) -> Motion:
    """A person who stands as in one frame of a take and sways by 3 mm."""
    pose = joints[int(torch.randint(len(joints), (1,), generator=generator))]
    phases, speeds = (2 * math.pi * torch.rand(3, 2, generator=generator, dtype=torch.float64) for _ in range(2))

    def motion(moments: Tensor) -> Tensor:
        sway = torch.sin(moments[:, None, None] * speeds / 2 + phases).sum(-1)
        return pose + 0.003 * sway[:, None] * (pose[:, 1:2] - pose[:, 1].min()) / 1.5

    return motion


def unrelated_pair(joints: Tensor, others: Tensor, generator: Generator, **settings: Any) -> Pair:
    """A camera around one take and a camera around another."""
    first, second = (cmu_pair(take, generator, **settings) for take in (joints, others))
    return replace(first, b=second.b, offset=math.nan)


def reversed_pair(joints: Tensor, generator: Generator, **settings: Any) -> Pair:
    """Two cameras of which one film runs backwards."""
    pair = cmu_pair(joints, generator, **settings)
    return replace(pair, b=pair.b.flip(0), offset=math.nan)


def long_take(seconds: float, generator: Generator, blend: float = 1.0) -> Tensor:
    """Takes in random order as one of at least so many seconds, ``(frames, 31, 3)``: each moved to the middle of the room, and
    smoothly turned into the next within ``blend`` seconds.
    """
    chosen: list[Tensor] = []
    overlap, need = round(blend * RECORDED), seconds * RECORDED
    pool = moving(10.0)
    while sum(len(take) - overlap for take in chosen) < need:
        for index in torch.randperm(len(pool), generator=generator).tolist():
            take = pool[index].joints
            chosen.append(take - take[:, :1].mean(0) * torch.tensor([1.0, 0.0, 1.0], dtype=torch.float64))
    out = chosen[0]
    ramp = torch.linspace(0, 1, overlap, dtype=torch.float64)[:, None, None]
    smooth = ramp**3 * (10 - 15 * ramp + 6 * ramp**2)
    for take in chosen[1:]:
        middle = (1 - smooth) * out[-overlap:] + smooth * take[:overlap]
        out = torch.cat([out[:-overlap], middle, take[overlap:]])
        if len(out) >= need:
            break
    return out


SAME = (0, 1, 2, 4, 5, 8, 9, 12, 13, 14, 15, 16, 18, 19, 21, 25, 27)
"""Joints of a usual skeleton of 17, of the 31 recorded: pelvis, hips, knees, ankles, spine, thorax, neck, shoulders, head, elbows,
wrists."""
DIFFERENT = 14
"""Points per camera where no camera sees a point of the other: drawn anew for every pair."""
RECORDED = 60.0
"""fps of the motion capture."""
SHORTEST = 2.0
"""s: shorter takes hold no overlap worth the name."""
MOVING = 0.1
"""m: root mean square distance of the joints from their mean places; a part of a take that moves less is drawn again."""
SIZE = (1920.0, 1080.0)
"""px."""

Motion = Callable[[Tensor], Tensor]
"""From seconds ``(T,)`` to joints ``(T, n, 3)``, metres, y up."""


@dataclass(frozen=True)
class Pair:
    """What two cameras saw: ``a (frames, n, 2)``, ``b (frames, m, 2)`` px, y down, NaN = missing; the true clocks.

    Attributes:
        offset, rate: b's clock = a's clock * rate + offset, seconds; NaN where both show different events.
        fps: as the user is told.
        wrong: ``(n,)`` bool, points that are another point in b.
        noise: px, standard deviation in a and in b.
    """

    name: str
    a: Tensor
    b: Tensor
    fps: tuple[float, float]
    offset: float
    rate: float = 1.0
    wrong: Tensor | None = None
    noise: tuple[float, float] = (0.0, 0.0)

    @property
    def overlap(self) -> tuple[float, float]:
        """First and last moment of a's clock that both cameras show."""
        last = (len(self.b) - 1) / self.fps[1]
        return max(0.0, -self.offset / self.rate), min((len(self.a) - 1) / self.fps[0], (last - self.offset) / self.rate)

    def error(self, offset: float, rate: float = 1.0, *, at: float = 0.5) -> float:
        """Frames of b by which these clocks are wrong, at a share of the overlap (0 its start, 1 its end)."""
        first, last = self.overlap
        moment = first + at * (last - first)
        return (rate * moment + offset - self.rate * moment - self.offset) * self.fps[1]


@dataclass(frozen=True)
class Filming:
    """How a pair is filmed.

    Attributes:
        frames: of a; b films as long.
        fps: of both, or of a and of b.
        rate: of b's clock.
        noise_mm: standard deviation per coordinate, in the image plane at the joint.
        points: ``"same"``, ``"different"`` or ``"all"``: all joints in both.
        missing: share of each track, in blocks.
        outliers: share of positions that are anywhere around the person.
        wrong_joints: that b takes for others.
        max_shift: frames of a; fractions of frames are drawn as well.
        lens: range of the radial distortion k1 of both cameras, in focal lengths.
    """

    frames: int = 120
    fps: float | tuple[float, float] = 30.0
    rate: float = 1.0
    noise_mm: float = 15.0
    points: str = "same"
    missing: float = 0.0
    outliers: float = 0.0
    wrong_joints: int = 0
    max_shift: float = 35.0
    lens: tuple[float, float] = (0.0, 0.0)

    @property
    def rates(self) -> tuple[float, float]:
        """Frames per second of a and of b."""
        return self.fps if isinstance(self.fps, tuple) else (self.fps, self.fps)


def cmu_pair(joints: Tensor, generator: Generator, **settings: Any) -> Pair:
    """Two cameras around a part of a take that moves.

    Args:
        joints: ``(frames, 31, 3)`` metres, y up, at 60 fps.
        generator: of part, cameras, shift and noise.
        settings: fields of :class:`Filming`.  Takes that are too short for them are filmed for less long, with smaller shifts.
    """
    filming = Filming(**settings)
    seconds, rate = (len(joints) - 1) / RECORDED, filming.rates[0]
    there = seconds * min(1.0, filming.rate) * rate
    frames = min(filming.frames, max(int(0.75 * there), int(there - filming.max_shift)))
    largest = min(filming.max_shift, there - frames)
    filming = replace(filming, frames=frames, max_shift=largest)
    offset, duration = draw(-largest / rate, largest / rate, generator), frames / rate
    before, after = max(0.0, offset / filming.rate), max(duration, (duration - offset) / filming.rate)
    motion = played(joints)
    for _ in range(20):
        start = draw(before, max(before, seconds - after), generator)
        moments = torch.linspace(max(0.0, -offset), min(duration, duration - offset), 50, dtype=torch.float64)
        seen = motion(start + moments)
        if float((seen - seen.mean(0)).square().sum(-1).mean().sqrt()) > MOVING:
            break
    return filmed(lambda times: motion(start + times), offset, filming, generator)


def cmu_pairs(count: int, seed: int = 0, **settings: Any) -> list[Pair]:
    """Pairs of the takes in turn, each with a generator of its own: the first pairs do not depend on how many there are.

    Raises:
        ValueError: no data folder.
    """
    long = moving()
    order = torch.randperm(len(long), generator=seeded(seed, 0)).tolist()
    pairs = []
    for index in range(count):
        take = long[order[index % len(long)]]
        pair = cmu_pair(take.joints, seeded(seed, 1 + index), **settings)
        pairs.append(replace(pair, name=f"{take.name} {take.what}"))
    return pairs


def filmed(motion: Motion, offset: float, filming: Filming, generator: Generator) -> Pair:
    """A motion, that begins with a's clock, in two random cameras."""
    fa, fb = filming.rates
    duration = filming.frames / fa
    at_a = torch.arange(filming.frames, dtype=torch.float64) / fa
    at_b = (torch.arange(round(duration * fb), dtype=torch.float64) / fb - offset) / filming.rate
    first, second = motion(at_a), motion(at_b)
    joints = first.shape[1]
    both = torch.cat([first, second]).reshape(-1, 3)
    wrong = None
    if filming.points == "same":
        first, second = first[:, SAME], second[:, SAME]
    elif filming.points == "different":
        chosen = torch.randperm(joints, generator=generator)
        first, second = first[:, chosen[:DIFFERENT]], second[:, chosen[DIFFERENT : 2 * DIFFERENT]]
    if filming.wrong_joints:
        second, wrong = confused(second, filming.wrong_joints, generator)
    (a, noise_a), (b, noise_b) = (image(side, both, filming, generator) for side in (first, second))
    return Pair("", a, b, (fa, fb), offset, filming.rate, wrong, (noise_a, noise_b))


def image(joints: Tensor, around: Tensor, filming: Filming, generator: Generator) -> tuple[Tensor, float]:
    """Joints ``(T, n, 3)`` in a random camera that has all points ``around (m, 3)`` before it, px, and the noise in px.

    The camera aims at their mean from 4.5 m, or from where the nearest is 1.5 m away; it zooms out as far as all need.
    """
    azimuth, elevation = draw(0.0, 2 * math.pi, generator), draw(-0.1, 0.5, generator)
    ca, sa, ce, se = math.cos(azimuth), math.sin(azimuth), math.cos(elevation), math.sin(elevation)
    about_y = torch.tensor([[ca, 0.0, sa], [0.0, 1.0, 0.0], [-sa, 0.0, ca]], dtype=torch.float64)
    about_x = torch.tensor([[1.0, 0.0, 0.0], [0.0, ce, -se], [0.0, se, ce]], dtype=torch.float64)
    flip = torch.tensor([[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]], dtype=torch.float64)  # y down, z away: a rotation
    rotation, middle = flip @ about_x @ about_y, around.mean(0)
    far, local = (around - middle) @ rotation.T, (joints - middle) @ rotation.T
    distance = max(4.5, 1.5 - float(far[:, 2].min()))
    slope = (far[:, :2] / (far[:, 2:] + distance)).abs().amax(0)
    focal = min(draw(1000.0, 1600.0, generator), 0.48 * SIZE[0] / float(slope[0]), 0.48 * SIZE[1] / float(slope[1]))
    depth = local[..., 2:] + distance
    noise = 1e-3 * filming.noise_mm * torch.randn((*joints.shape[:2], 2), generator=generator, dtype=torch.float64)
    flat = (local[..., :2] + noise) / depth
    bent = flat * (1 + draw(*filming.lens, generator) * flat.square().sum(-1, keepdim=True))
    pixels = bent * focal + torch.tensor(SIZE, dtype=torch.float64) / 2
    pixels = strayed(pixels, filming.outliers, generator)
    return gaps(pixels, filming.missing, generator), 1e-3 * filming.noise_mm * focal / float(depth.mean())


def played(joints: Tensor) -> Motion:
    """A take at any moment within it, by cubic splines."""
    spline = CubicSpline(torch.arange(len(joints)) / RECORDED, joints.numpy(), axis=0)
    return lambda times: torch.from_numpy(spline(times.numpy()))


def confused(joints: Tensor, count: int, generator: Generator) -> tuple[Tensor, Tensor]:
    """Joints of which so many are another joint, at least .4 m away in the mean; and which."""
    chosen = torch.randperm(joints.shape[1], generator=generator)[:count].tolist()
    apart = torch.cdist(joints, joints).mean(0)
    out, wrong = joints.clone(), torch.zeros(joints.shape[1], dtype=torch.bool)
    for joint in chosen:
        others = (apart[joint] > min(0.4, float(apart[joint].max()) / 2)).nonzero()[:, 0]
        out[:, joint] = joints[:, int(others[int(torch.randint(len(others), (1,), generator=generator))])]
        wrong[joint] = True
    return out, wrong


def strayed(pixels: Tensor, share: float, generator: Generator) -> Tensor:
    """Pixels of which a share is anywhere in the box that the person moves in."""
    if not share:
        return pixels
    low, high = pixels.amin((0, 1)), pixels.amax((0, 1))
    anywhere = low + (high - low) * torch.rand(pixels.shape, generator=generator, dtype=torch.float64)
    struck = torch.rand(pixels.shape[:2], generator=generator) < share
    return torch.where(struck[..., None], anywhere, pixels)


def gaps(pixels: Tensor, share: float, generator: Generator) -> Tensor:
    """Pixels with blocks of 5 to 25 frames missing from every track until the share is reached."""
    out = pixels.clone()
    for joint in range(pixels.shape[1]):
        hidden = torch.zeros(len(pixels), dtype=torch.bool)
        while float(hidden.double().mean()) < share:
            length = min(int(torch.randint(5, 26, (1,), generator=generator)), math.ceil(share * len(pixels) - float(hidden.sum())))
            start = int(torch.randint(1 - length, len(pixels), (1,), generator=generator))
            hidden[max(start, 0) : start + length] = True
        out[hidden, joint] = torch.nan
    return out


def moving(minimum: float = SHORTEST) -> list[Take]:
    """Takes of at least so many seconds."""
    return [take for take in takes() if len(take.joints) / RECORDED >= minimum]


def draw(low: float, high: float, generator: Generator) -> float:
    """Uniform."""
    return low + (high - low) * float(torch.rand(1, generator=generator, dtype=torch.float64))


def seeded(*numbers: int) -> Generator:
    """A generator of these numbers."""
    seed = 0
    for number in numbers:
        seed = seed * 1_000_003 + number + 1
    return torch.Generator().manual_seed(seed)

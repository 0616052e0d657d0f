"""What cameras cannot be synchronized by, and takes of minutes: people who repeat themselves, stand, or are someone else."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import torch
from torch import Generator, Tensor

from experiments.synchronization.data import MOVING, RECORDED, Filming, Motion, Pair, cmu_pair, draw, filmed, moving, played


def periodic_pair(joints: Tensor, generator: Generator, **settings: Any) -> Pair:
    """Two cameras around a person who repeats .8 to 1.4 s of a take in place, exactly."""
    filming = Filming(**settings)
    motion = periodic_motion(joints, generator)
    largest = filming.max_shift / filming.rates[0]
    return filmed(motion, draw(-largest, largest, generator), filming, generator)


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
    filming = Filming(**settings)
    motion = still_motion(joints, generator)
    largest = filming.max_shift / filming.rates[0]
    return filmed(motion, draw(-largest, largest, generator), filming, generator)


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

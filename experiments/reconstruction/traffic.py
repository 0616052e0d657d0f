"""Cars filmed from moving cameras and pairs of bodies: held-out frames, labels, and the choice of the motion."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

import dyntorch as dyn
from dyntorch.geometry.homogeneous import apply, homogeneous
from experiments.alignment.real.solvers import listed, median
from experiments.common.real_data import Traffic
from experiments.common.tables import Row
from experiments.reconstruction.data import declared, predicted

PLANAR = ("constant_direction_2d", "constant_velocity_2d")
WRONG = 5.0
"""Pixels, for the background of the held-out frame."""


@dataclass(frozen=True)
class Asked:
    """A held-out frame of a sequence."""

    sequence: Traffic
    frames: list[int]
    held: int
    known: Tensor
    """``(n,)`` bool: the half of the background that resects its camera."""

    def error(self, where: Tensor, cars: bool) -> float:
        """Median distance of the cars, or of the other half of the background."""
        of = ~self.sequence.background if cars else self.sequence.background & ~self.known
        return float((where - self.sequence.tracks[self.held])[of].norm(dim=-1).nan_to_num(nan=math.inf).median())

    def stabilized(self, to: int) -> Tensor:
        """``(3, 3)`` homography of the frame ``to`` to the held-out one, by the known background."""
        known, tracks = self.known, self.sequence.tracks
        return dyn.fit(dyn.Collineation(2), tracks[self.held][known], tracks[to][known]).tensor


def asked(sequence: Traffic, step: int, within: bool, draw: torch.Generator) -> Asked | None:
    """Six frames from the first on, of which the fourth or the last is held out; None where the sequence is too short."""
    frames = list(range(0, len(sequence.tracks), step))[:6]
    if len(frames) < 6:
        return None
    held = frames.pop(3 if within else 5)
    known = sequence.background & (torch.rand(len(sequence.background), generator=draw) < 0.5)
    return Asked(sequence, frames, held, known)


def put(one: Asked) -> tuple[Tensor, str]:
    """Nothing moves: the nearest frame, by a homography."""
    near = min(one.frames, key=lambda f: abs(f - one.held))
    return apply(one.stabilized(near), one.sequence.tracks[near]), "no test"


def straight(one: Asked) -> tuple[Tensor, str]:
    """Straight lines at constant velocity in the stabilized *image*, which a plane seen obliquely does not have."""
    known, tracks = one.sequence.background, one.sequence.tracks
    maps = [dyn.fit(dyn.Collineation(2), tracks[one.held][known], tracks[f][known]).tensor for f in one.frames]
    moved = torch.stack([apply(m, tracks[f]) for m, f in zip(maps, one.frames, strict=True)])
    since = torch.tensor(one.frames).double() - one.held
    rows = torch.stack([torch.ones_like(since), since], dim=-1)
    return (torch.linalg.pinv(rows) @ moved.flatten(1))[0].reshape(-1, 2), "knows the background of all frames"


def affine(one: Asked) -> tuple[Tensor, str]:
    """Tracks interpolated linearly between (beyond) the two nearest frames, then an affine map by the known background."""
    a, b = sorted(sorted(one.frames, key=lambda f: abs(f - one.held))[:2])
    tracks, share = one.sequence.tracks, (one.held - a) / (b - a)
    there = homogeneous((1 - share) * tracks[a] + share * tracks[b])
    fitted = torch.linalg.lstsq(there[one.known], tracks[one.held][one.known]).solution
    return there @ fitted, "no test"


Way = Callable[[Asked], tuple[Tensor, str]]
"""Where the points are in the held-out frame, and a status."""


def model(name: str, threshold: float | None = math.inf) -> Way:
    """By a reconstruction of all points of the other frames."""

    def solve(one: Asked) -> tuple[Tensor, str]:
        times = torch.tensor(one.frames, dtype=torch.float64)
        found = declared(one.sequence.tracks[one.frames], name, times, threshold)
        return predicted(found, float(one.held), one.sequence.tracks[one.held], one.known), dyn.Status(int(found.status)).name

    return solve


WAYS: dict[str, Way] = {
    "all still: homography": put,
    "affine interpolation": affine,
    "straight in the stabilized image": straight,
    **{name: model(name) for name in PLANAR},
}


def traffic_rows(sequences: list[Traffic], steps: Sequence[int], seed: int) -> list[Row]:
    """Distances in held-out frames, medians over the sequences."""
    rows: list[Row] = []
    for within in (True, False):
        for step in steps:
            draw = torch.Generator().manual_seed(seed)
            cases = [case for one in sequences if (case := asked(one, step, within, draw))]
            for name, solve in WAYS.items():
                found = [solve(case) for case in cases]
                cars, others = ([case.error(x, cars) for case, (x, _) in zip(cases, found, strict=True)] for cars in (True, False))
                place = "between" if within else "after"
                setting = f"held out {place} frames {step} apart, {len(cases)} sequences; background {median(others):.2f} px, "
                setting += f"off by more than {WRONG:g} px in {sum(x > WRONG for x in others)}; worst cars {max(cars):.3g} px; "
                rows.append(Row(name, setting + f"{listed(Counter(s for _, s in found))}; cars", median(cars), unit=" px"))
    return rows


def threshold_rows(sequences: list[Traffic], seed: int) -> list[Row]:
    """The same with a threshold, above which observations are outliers."""
    rows = []
    for threshold in (math.inf, 3.0, 1.5, None):
        draw = torch.Generator().manual_seed(seed)
        cases = [case for one in sequences if (case := asked(one, 2, True, draw))]
        found = [model("constant_velocity_2d", threshold)(case) for case in cases]
        cars = [case.error(x, cars=True) for case, (x, _) in zip(cases, found, strict=True)]
        setting = "estimated" if threshold is None else f"{threshold:g} px"
        setting += f", {len(cases)} sequences; worst cars {max(cars):.3g} px; {listed(Counter(s for _, s in found))}; cars"
        rows.append(Row("constant_velocity_2d, threshold", setting, median(cars), unit=" px"))
    return rows


def bodies_rows(sequences: list[Traffic]) -> list[Row]:
    """Share of labels that are right, by the kind of the sequence."""
    rows = []
    kinds: dict[str, Callable[[str], bool]] = {
        "cars": lambda name: name.startswith("cars"),
        "boards": lambda name: not name.startswith("cars"),
    }
    for name in ("two_bodies_2d", "two_bodies_3d"):
        for kind, belongs in kinds.items():
            right, base, sigmas, states = [], [], [], Counter[str]()
            for one in filter(lambda one: belongs(one.name), sequences):
                frames = torch.linspace(0, len(one.tracks) - 1, 6).round().long()
                found = declared(one.tracks[frames], name, frames.double(), math.inf)
                right.append(max(float((found.labels == labels).double().mean()) for labels in (one.bodies, 3 - one.bodies)))
                base.append(float(one.background.double().mean()))
                sigmas.append(float(found.sigma))
                states[dyn.Status(int(found.status)).name] += 1
            setting = (
                f"{len(right)} {kind}: all right in {sum(x == 1 for x in right)}, above 0.95 in {sum(x > 0.95 for x in right)}, "
            )
            setting += (
                f"worst {min(right):.2f}; sigma {median(sigmas):.2f} px; {listed(states)}; larger body {median(base):.2f}; median"
            )
            rows.append(Row(name, setting, median(right)))
    return rows


def auto_rows(sequences: list[Traffic]) -> list[Row]:
    """Which motion is chosen for the traffic, without any label."""
    chosen = Counter[str]()
    for one in sequences:
        case = asked(one, 2, True, torch.Generator().manual_seed(0))
        if case:
            found = declared(one.tracks[case.frames], "auto", torch.tensor(case.frames).double(), None)
            chosen[found.motion.name] += 1
    moving = sum(count for name, count in chosen.items() if not name.startswith("static"))
    return [Row("auto", f"{listed(chosen)}; share that moves", moving / max(1, chosen.total()))]

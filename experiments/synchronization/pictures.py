"""The picture of two synchronized cameras: ``python -m experiments.synchronization.pictures`` draws docs/synchronize.png.

The person is a synthetic one of ours, filmed at 30 fps by two cameras that start 17.4 frames apart, with a detector's errors.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import torch
from torch import Tensor

import dyntorch as dyn
from experiments.alignment.real.pictures import LINES, save
from experiments.synchronization.baselines import Answer, pose2sim
from indexing.actors import Person, detect, stream
from indexing.skeleton import COCO17

FPS = 30.0
FINE = 5
"""Frames of the scene per frame of a camera."""
LATE = 87
"""Frames of the scene by which the second camera starts later."""
ACTIONS = ("jumping_jack", "punch", "kick")
FIRST, SECOND, WRONG = LINES[1], LINES[2], LINES[0]


@dataclass(frozen=True)
class Scene:
    """What two cameras saw: ``a``, ``b (frames, 17, 2)`` px; frame i of a <-> frame i + ``shift`` of b; frames of a to look at."""

    a: Tensor
    b: Tensor
    shift: float
    shown: tuple[int, ...]


def scene(seed: int = 3) -> Scene:
    """A person who does this and that."""
    whole, actions = stream(ACTIONS, Person.random(seed), fps=FPS * FINE, rng=seed)
    cut = [whole.replace(joints=whole.joints[k::FINE], times=whole.times[k::FINE]) for k in (0, LATE)]
    views = ((cut[0], -25.0, 1), (cut[1], 55.0, 2))
    seen = [detect(clip, azimuth=turn, elevation=-0.15, dropout=0.02, rng=rng).joints for clip, turn, rng in views]
    a, b = (torch.tensor(joints, dtype=torch.float64) for joints in seen)
    middles = [start + share * (end - start) for _, start, end in actions for share in (0.3, 0.55)]
    return Scene(a, b, -LATE / FINE, tuple(round(middle * FPS) for middle in middles))


def at(tracks: Tensor, frame: float) -> Tensor:
    """Points ``(n, 2)`` between two frames, on a straight line; NaN outside."""
    whole = int(frame // 1)
    if not 0 <= whole < len(tracks) - 1:
        return torch.full_like(tracks[0], torch.nan)
    return torch.lerp(tracks[whole], tracks[whole + 1], frame - whole)


def picture(path: Path, synchronize: Callable[..., Any]) -> None:
    """Left: the same frame numbers of both cameras, and the same moments; right: what the shift was found by."""
    seen = scene()
    found = synchronize(seen.a, seen.b, correspondence=True, fps=(FPS, FPS))
    other = pose2sim(seen.a, seen.b, FPS)
    figure = plt.figure(figsize=(15, 6.2))
    grid = figure.add_gridspec(3, len(seen.shown), left=0.07, right=0.60, top=0.93, bottom=0.03, wspace=0.02, hspace=0.08)
    rows: tuple[tuple[str, Tensor, str, Callable[[float], float]], ...] = (
        ("camera 1", seen.a, FIRST, lambda frame: frame),
        ("camera 2,\nsame frame\nnumber", seen.b, WRONG, lambda frame: frame),
        ("camera 2,\nsynchronized", seen.b, SECOND, lambda frame: float(found.at(frame / FPS)) * FPS),
    )
    for row, (name, tracks, colour, clock) in enumerate(rows):
        for column, frame in enumerate(seen.shown):
            axis = figure.add_subplot(grid[row, column])
            _person(axis, at(tracks, clock(frame)), tracks, colour)
            if row == 0:
                axis.set_title(f"frame {frame}", fontsize=10, color="0.35")
        figure.text(0.035, 0.79 - 0.305 * row, name, ha="center", va="center", fontsize=11, color=colour)
    _curves(figure, seen, found, other)
    save(figure, path)


def _person(axis: Any, points: Tensor, tracks: Tensor, colour: str) -> None:
    """A stick figure in the part of the image where the person is over time."""
    for i, j in COCO17.bones:
        axis.plot(*points[[i, j]].T, color=colour, lw=2.2, solid_capstyle="round")
    axis.plot(*points.T, "o", color=colour, ms=2.6)
    seen = tracks[tracks.isfinite().all(-1)]
    low, high = seen.quantile(0.002, dim=0), seen.quantile(0.998, dim=0)
    middle, half = (low + high) / 2, float((high - low).max()) / 2 + 20
    axis.set(
        xlim=(float(middle[0]) - 0.8 * half, float(middle[0]) + 0.8 * half), ylim=(float(middle[1]) + half, float(middle[1]) - half)
    )
    axis.set(aspect="equal", xticks=[], yticks=[])
    for spine in axis.spines.values():
        spine.set_color("0.85")


def _curves(figure: Any, seen: Scene, found: Any, other: Answer) -> None:
    """Scores over shifts: ours above, correlation of vertical speeds below."""
    upper, lower = figure.add_axes((0.665, 0.56, 0.325, 0.37)), figure.add_axes((0.665, 0.09, 0.325, 0.37))
    lags = found.lags * FPS
    upper.plot(lags, found.scores, color=SECOND, lw=1.6)
    for offset, score in found.peaks.tolist()[:5]:
        upper.plot(offset * FPS, score, "o", color=SECOND, ms=5)
    sigma = f"{found.frames:.2f} ± {found.sigma * FPS:.2f} frames"
    upper.set_title(f"epipolar score: {sigma} (true {seen.shift:.1f})", fontsize=11)
    lower.plot(other.lags, other.correlations, color=WRONG, lw=1.6)
    best = round(other.offset * FPS)
    lower.plot(best, other.correlations.max(), "o", color=WRONG, ms=5)
    lower.set_title(f"correlation of vertical speeds: {best} frames", fontsize=11)
    lower.set_xlabel("frames of shift")
    for axis in (upper, lower):
        axis.axvline(seen.shift, color="0.5", lw=1, ls=":")
        axis.set_xlim(float(other.lags[0]), float(other.lags[-1]))
        axis.grid(alpha=0.25)


if __name__ == "__main__":
    picture(Path("docs/synchronize.png"), dyn.synchronize)

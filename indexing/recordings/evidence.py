"""What each window of a recording says for each class: one quality per segment, comparable between durations."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from indexing.action.bank import Windows
from indexing.action.model import NUM_NEIGHBOURS, ShapeModel, standardize
from indexing.windows import Ragged, sample

STEPS_PER_ACTION = 6.0  # that the shortest action (median of its exemplars) is divided into: segments begin and end at such steps
MAX_STEP = 0.1  # seconds; .2 costs .03 of the frames of synthetic actors seen from the side
DURATION_RATIO = 1.12  # between neighbouring durations; 1.25 takes a third less time and costs .01 to .03 of the frames
MAX_DENSE_EXEMPLARS = 300  # up to which durations lie so close; of more, every other one is taken, for the time
DURATION_REACH = 0.8  # times the shortest exemplar (and the longest, divided by it)
MAX_DURATION_FACTOR = 3.0  # from what is usual for its class; beyond it a label holds more than the action (UTKinect)
MAX_TEMPO_FACTOR = 2.0  # from an exemplar, up to which a window is compared with it
LOG_DURATION_SIGMA = 0.35  # around each exemplar of a class
MIN_DURATION_LIKELIHOOD = 1e-6
# of an exemplar a cycle later, from which a class counts as cyclic, and fully so: jacks .7 to .9, single movements .3
CYCLIC_CORRELATION = (0.35, 0.65)
MIN_CYCLIC = 0.5  # 0..1, from which segments that touch are one

Array = NDArray[Any]
BLOCK = 2000  # windows compared at once: bounds memory whatever the length of the recording


@dataclass(frozen=True)
class Durations:
    """How long the actions of a model last, and which of them are cycles."""

    seconds: Array
    typical: Array
    cyclic: Array

    @classmethod
    def of(cls, model: ShapeModel, window: float, stride: float) -> Durations:
        """Of a model; where its file does not say, from how many short windows each exemplar was cut into."""
        labels = model.labels.cpu().numpy()
        stored = model.exemplars.seconds
        counts = np.bincount(model.exemplars.owner.cpu().numpy(), minlength=len(labels))
        seconds = (window + stride * (counts - 1.0)) if stored is None else stored.cpu().numpy().astype(float)
        seconds = np.maximum(seconds, 1e-3)
        low, high = CYCLIC_CORRELATION
        again = np.zeros(len(labels)) if model.exemplars.cyclic is None else model.exemplars.cyclic.cpu().numpy()
        each = [labels == c for c in range(model.classes)]
        usual = np.array([np.median(seconds[mine]) for mine in each])[labels]
        seconds = np.where(np.abs(np.log(seconds / usual)) <= np.log(MAX_DURATION_FACTOR), seconds, np.nan)
        return cls(
            seconds,
            np.array([np.nanmedian(seconds[mine]) for mine in each]),
            np.array([np.clip((np.median(again[mine]) - low) / (high - low), 0.0, 1.0) for mine in each]),
        )

    @property
    def unit(self) -> float:
        """Seconds of an ordinary exemplar: what qualities are counted by."""
        return float(np.nanmedian(self.seconds))

    def likelihoods(self, durations: Array, labels: Array) -> Array:
        """``(durations, classes)`` log likelihood of each duration, a kernel density around the exemplars of each class."""
        least = 1e-9  # seconds: windows of one length are equal up to the rounding of their edges
        durations, again = np.unique(np.maximum(np.round(durations / least), 1.0) * least, return_inverse=True)
        log_ratio = np.log(durations)[:, None] - np.log(self.seconds)[None]
        near = np.nan_to_num(np.exp(-0.5 * (log_ratio / LOG_DURATION_SIGMA) ** 2))
        each = [near[:, labels == c].mean(axis=1) for c in range(len(self.typical))]
        return np.log(np.stack(each, axis=1) + MIN_DURATION_LIKELIHOOD).astype(np.float32)[again]


@dataclass(frozen=True)
class Lattice:
    """Where segments of one stretch of a recording may begin and end."""

    edges: Array
    windows: Array

    @classmethod
    def over(cls, begin: float, end: float, durations: Durations, num_durations: int) -> Lattice:
        """Of a stretch: windows of every duration that actions have, from every edge."""
        step = min(MAX_STEP, float(durations.typical.min()) / STEPS_PER_ACTION)
        cells = max(1, round((end - begin) / step))
        shortest, longest = DURATION_REACH * np.nanmin(durations.seconds), np.nanmax(durations.seconds) / DURATION_REACH
        ratio = DURATION_RATIO if len(durations.seconds) <= MAX_DENSE_EXEMPLARS else DURATION_RATIO**2
        count = min(num_durations, int(np.ceil(np.log(longest / shortest) / np.log(ratio))) + 1)
        lengths = np.geomspace(shortest, longest, max(2, count)) / max(end - begin, 1e-9) * cells
        lengths = np.unique(np.clip(np.round(lengths), 1, cells).astype(np.intp))
        # in order of their last edges, then of their first ones: of each last edge the longest that fit, the longest first
        last = np.repeat(np.arange(1, cells + 1), len(lengths))
        windows = np.stack([last - np.tile(lengths[::-1], cells), last], axis=1)
        return cls(begin + np.arange(cells + 1) * ((end - begin) / cells), windows[windows[:, 0] >= 0])

    @property
    def seconds(self) -> Array:
        """``(W,)`` how long each window lasts."""
        return np.asarray(self.edges[self.windows[:, 1]] - self.edges[self.windows[:, 0]])

    def mean(self, cells: Array) -> Array:
        """``(W, columns)`` of ``(cells, columns)`` over each window."""
        total = np.vstack([np.zeros((1, cells.shape[1])), np.cumsum(cells, axis=0)])
        first, last = self.windows.T
        out = np.empty((len(first), cells.shape[1]), dtype=np.float32)  # an hour has hundreds of thousands of windows
        for at in range(0, len(first), BLOCK):
            some = slice(at, at + BLOCK)
            out[some] = (total[last[some]] - total[first[some]]) / (last[some] - first[some])[:, None]
        return out

    def resample(self, source: Ragged, stretch: int, chosen: Array, length: int) -> Windows:
        """Some windows, resampled."""
        first, last = self.windows[chosen].T
        owner = np.full(len(chosen), stretch)
        values = sample(source, owner, self.edges[first], self.edges[last], length)
        return Windows(values, torch.from_numpy(source.seen[owner]))


def whole_scores(model: ShapeModel, lattice: Lattice, resample: Callable[[Array], Windows], durations: Durations) -> Array:
    """``(W, classes)`` minus the mean residual to the nearest whole exemplars of each class that last about as long; NaN: none."""
    labels = model.labels.cpu().numpy()
    out = np.full((len(lattice.windows), model.classes), np.nan, dtype=np.float32)
    cells = lattice.windows[:, 1] - lattice.windows[:, 0]
    for count in np.unique(cells).tolist():
        rows = np.flatnonzero(cells == count)
        lasts = float(np.median(lattice.seconds[rows]))
        near = np.flatnonzero(np.abs(np.log(durations.seconds / max(lasts, 1e-9))) <= np.log(MAX_TEMPO_FACTOR))
        if not len(near):
            continue
        chosen = torch.from_numpy(near).to(model.labels.device)
        for at in range(0, len(rows), BLOCK):
            some = rows[at : at + BLOCK]
            residual = model.whole_residuals(resample(some).to(chosen.device), chosen).cpu().numpy()
            for c in np.unique(labels[near]).tolist():
                mine = residual[:, labels[near] == c]
                count_ = min(NUM_NEIGHBOURS, mine.shape[1])
                out[some, c] = -np.partition(mine, count_ - 1, axis=1)[:, :count_].mean(axis=1)
    return out


def machine_scores(model: ShapeModel, resample: Callable[[Array], Windows], chosen: Array) -> Array:
    """``(chosen, classes)`` of the kernel machine, standardized over the classes of each window."""
    parts = [
        standardize(model.machine_scores(resample(chosen[at : at + BLOCK]).to(model.labels.device))).cpu().numpy()
        for at in range(0, len(chosen), BLOCK)
    ]
    return np.concatenate(parts) if parts else np.zeros((0, model.classes))


def level(values: Array) -> tuple[float, float]:
    """Mean and standard deviation of what is there; 1 where nothing differs."""
    there = values[np.isfinite(values)]
    spread = float(there.std()) if len(there) else 0.0
    return (float(there.mean()) if len(there) else 0.0), (spread if spread > 1e-9 else 1.0)

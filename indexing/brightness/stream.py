"""What is kept of the exemplars, and one video against them, as its frames come in."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from dyntorch.numerics import one_thread
from indexing.brightness.descriptors import Optics, Sight, merge_motion, mirror_rows
from indexing.brightness.videos import Footage, Resampler
from indexing.modelfile import store
from indexing.scoring import Event, event_levels, events

MAX_FRAMES = 2**31  # of a video, at most
MAX_ENTRY = 1.001  # of the entries of a unit vector, with rounding
GAP = 2  # empty rows before each track: no step leads from one track into the next


@dataclass(frozen=True)
class VideoExemplars:
    """Learned videos, one after the other."""

    motion: Tensor = field(metadata=store("real", "frames", "descriptor", least=-MAX_ENTRY, most=MAX_ENTRY))
    lengths: Tensor = field(metadata=store("integers", "videos", below=MAX_FRAMES))  # ``(videos,)`` frames
    labels: Tensor = field(metadata=store("every", "videos", below="classes"))  # ``(videos,)`` numbers of classes

    @classmethod
    def of(cls, videos: list[Tensor], labels: Tensor) -> VideoExemplars:
        """Of the descriptors of each video."""
        return cls(torch.cat(videos), torch.tensor([len(one) for one in videos]), labels)

    def join(self, others: VideoExemplars, labels: Tensor) -> VideoExemplars:
        """With further videos; ``labels`` are those of all."""
        return VideoExemplars(torch.cat([self.motion, others.motion]), torch.cat([self.lengths, others.lengths]), labels)

    def videos(self) -> list[Tensor]:
        """Descriptors of each video."""
        return list(self.motion.split(self.lengths.tolist()))

    def to(self, device: str) -> VideoExemplars:
        """The same on another device."""
        return replace(self, motion=self.motion.to(device))


@dataclass(frozen=True)
class Library:
    """Exemplar frames, track after track, tracks of one class together; GAP rows of zeros before each track."""

    rows: Tensor  # ``(M, K)`` coordinates of rows of at most unit length
    gaps: Tensor  # ``(2 tracks,)`` rows of zeros
    bounds: tuple[int, ...]  # ``(classes + 1,)`` where each class begins
    basis: Tensor  # ``(D, K)`` directions in which the exemplars differ most, orthonormal


def build_library(exemplars: VideoExemplars, classes: int, flip: bool, num_directions: int = 96) -> Library:
    """Lay out the tracks of all exemplars, mirrored ones too where ``flip``, in so many directions."""
    videos, labels = exemplars.videos(), exemplars.labels.tolist()
    rows, gaps, bounds, at = [], [], [0] * (classes + 1), 0
    for i in sorted(range(len(videos)), key=labels.__getitem__):
        for track in [videos[i], mirror_rows(videos[i])] if flip else [videos[i]]:
            rows += [track.new_zeros(GAP, track.shape[1]), track]
            gaps += [at, at + 1]
            at += GAP + len(track)
        bounds[labels[i] + 1] = at
    every = torch.cat(rows)
    basis = principal(every, num_directions)
    return Library(every @ basis, torch.tensor(gaps), tuple(bounds), basis)


def principal(rows: Tensor, count: int) -> Tensor:
    """``(D, count)`` orthonormal directions that hold most of the energy of ``rows (M, D)``; all where there are no more."""
    if rows.shape[1] <= count:
        return torch.eye(rows.shape[1]).to(rows)
    exact = rows.double()
    return torch.linalg.eigh(exact.mT @ exact).eigenvectors[:, -count:].to(rows)


SLACK = 0.02  # price of a step other than 1
# over frames: moments that fit an exemplar well count more than many that fit somewhat (plain mean: .76 / .59 for .80 / .62)
MEAN_SHARPNESS = 20.0
COLD_WEIGHT = 1e-3  # of a video's first window in its score: the warping has seen too little, but a short video has nothing else
MIN_FRAMES = 3  # of an exemplar
MIN_ENERGY = 0.1  # of a frame in which anything moves
MAX_ASKED = 64  # exemplars: bounds the time of calibration
QUIET_ENERGY = 0.7  # of a frame, below which nothing moves
MIN_CONTRAST = 0.02  # of an event: two or three classes have little to stand out from
FALSE_ALARM_RATE = 0.3  # at which a wrong action may reach an event's peak
EXTENT_RATE = 1.7  # times that rate for the level that an event's ends reach
MIRROR_MARGIN = 0.02  # of the score: mirrored exemplars that look so much more like another action make left and right matter

# ----------------------------------------------------------------------------------------------------------------------
# Leaky online warping: every exemplar frame holds how well the last half second fits what led up to it.
#
# .. math:: a_j(t) = g\,\max(a_{j-1},\; a_j - s,\; a_{j-2} - s)(t-1) + (1 - g)\,\langle f_t, f_j\rangle,\qquad g = 1 - 1/window
#
# One float per library frame is all the memory; steps of 0, 1 and 2 library frames allow for half to double tempo.


BLOCK = 32  # frames compared at once: library rows are read once per block


class Warping:
    """The state of one stream against a library."""

    def __init__(self, source: Library, window: float) -> None:
        self.source, self.keep = source, 1 - 1 / window
        self.state = source.rows.new_zeros(len(source.rows))
        self.held = 1.0

    def push(self, rows: Tensor) -> Tensor:
        """``(n, classes)`` scores after each of ``n`` more frames ``(n, D)``: the best exemplar frame's, cold start corrected."""
        rows = rows @ self.source.basis
        return torch.cat([self._block(part) for part in rows.split(BLOCK)]) if len(rows) else self._tops(rows @ self.source.rows.T)

    def _block(self, rows: Tensor) -> Tensor:
        states = rows @ self.source.rows.T
        states *= 1 - self.keep
        slower = torch.empty_like(self.state)
        before = self.state
        known = []
        for state in states:
            torch.sub(before, SLACK, out=slower)
            best = slower.clone()
            torch.maximum(best[2:], slower[:-2], out=best[2:])
            torch.maximum(best[1:], before[:-1], out=best[1:])
            state.add_(best, alpha=self.keep)
            state[self.source.gaps] = 0
            before = state
            self.held *= self.keep
            known.append([1 - self.held])
        self.state = before.clone()
        return self._tops(states) / states.new_tensor(known)

    def _tops(self, states: Tensor) -> Tensor:
        """``(n, classes)`` largest state of each class."""
        sizes = [b - a for a, b in pairwise(self.source.bounds)]
        return torch.stack([part.amax(1) for part in states.split(sizes, dim=1)], dim=1)


Array = NDArray[Any]


@dataclass(frozen=True)
class Recognizer:
    """All that scoring needs: how to look, what to compare with, how long to remember (frames)."""

    optics: Optics
    library: Library
    window: float
    pool: float


class Pool:
    r"""Running mean of scores over frames in which something moves."""

    def __init__(self, classes: int, frames: float) -> None:
        self.keep = 1 - 1 / max(frames, 1.0)
        self.total, self.weight = np.zeros(classes), 0.0

    def push(self, scores: Array, energy: Array) -> Array:
        """``(n, classes)`` means after each of ``n`` more frames; 0 before anything has moved."""
        totals, weights = energy[:, None] * np.exp(MEAN_SHARPNESS * scores), energy.copy()
        for t in range(len(totals)):
            totals[t] += self.keep * self.total
            weights[t] += self.keep * self.weight
            self.total, self.weight = totals[t], weights[t]
        return _mean(totals, weights[:, None])

    def mean(self) -> Array:
        """``(classes,)`` the mean now."""
        return _mean(self.total, self.weight)


def _mean(total: Array, weight: Any) -> Array:
    return np.asarray(np.log(np.maximum(total / np.maximum(weight, 1e-12), 1.0)) / MEAN_SHARPNESS)


class BrightnessStream:
    """Scores of one video, as its frames come in. Made by :meth:`indexing.BrightnessIndexer.stream`."""

    def __init__(self, source: Recognizer, classes: int, name: str, fps: float | None) -> None:
        self.source, self.fps = source, fps
        self.sight = Sight(source.optics, name)
        self.resample = Resampler(source.optics.fps, fps)
        self.warping = Warping(source.library, source.window)
        self.pool = Pool(classes, source.pool)
        self.whole = Pool(classes, float("inf"))
        self.pushed = self.compared = 0
        self.latest = np.zeros(classes)
        self.energy = 0.0

    def push(self, frames: Any, times: Any = None) -> Array:
        """Scores of one more frame, or of several. frames ``(height, width)``, times ``(n,)`` -> ``(classes,)``."""
        frames = torch.as_tensor(frames)
        single = frames.ndim == 2 or (frames.ndim == 3 and frames.shape[-1] == 3)
        scores, _ = self.scan(frames[None] if single else frames, times)
        return scores[0] if single else scores

    @one_thread
    def scan(self, frames: Any, times: Any = None) -> tuple[Array, Array]:
        """Scores ``(n, classes)`` and energies ``(n,)`` (0 where nothing moves, else below 1) after each of n more frames."""
        with torch.no_grad():
            return self._scan(frames, times)

    def _scan(self, frames: Any, times: Any) -> tuple[Array, Array]:
        small = self.sight.small(frames)
        if times is None:
            times = (self.pushed + np.arange(len(small))) / (self.fps or self.source.optics.fps)
        self.pushed += len(small)
        grid, counts = self.resample.push(small, times)
        scores, energy = self.compare(self.sight.push(grid))
        scores, energy = np.concatenate([self.latest[None], scores]), np.concatenate([[self.energy], energy])
        self.latest, self.energy = scores[-1], float(energy[-1])
        return scores[counts], energy[counts]

    def compare(self, seen: Tensor) -> tuple[Array, Array]:
        """Scores ``(n, classes)`` and energies ``(n,)``, float64, of more frames of the grid, given their descriptors."""
        scores = self.warping.push(seen).cpu().numpy().astype(float)
        energy = seen.square().sum(1).cpu().numpy().astype(float)
        warm = np.arange(self.compared, self.compared + len(seen)) >= self.source.window
        self.compared += len(seen)
        self.whole.push(scores, energy * np.where(warm, 1.0, COLD_WEIGHT))
        return self.pool.push(scores, energy), energy


def recognize(stream: BrightnessStream, video: Footage) -> Array:
    """``(classes,)`` scores of a whole video, read chunk by chunk."""
    for frames, times in video:
        stream.push(torch.as_tensor(frames), times)
    return stream.whole.mean()


def learn_descriptors(videos: list[Footage], optics: Optics) -> list[list[Tensor]]:
    """Descriptors of videos to learn from: what a stream of each would give, and what a stream would give that began earlier."""
    first = [_describe_video(video, optics, None) for video in videos]
    moved = [seen for _, seen in first if seen is not None]
    if not moved:
        return [[one] for one, _ in first]
    again = [_describe_video(video, optics, seen)[0] for video, seen in zip(videos, merge_motion(moved), strict=True)]
    return [[one, other] for (one, _), other in zip(first, again, strict=True)]


def _describe_video(video: Footage, optics: Optics, seen: Tensor | None) -> tuple[Tensor, Tensor | None]:
    """Descriptors of a whole video, and where something has moved in the end."""
    sight, resample = Sight(optics, video.name, seen), Resampler(optics.fps, video.own_rate)
    found = torch.cat([sight.push(resample.push(sight.small(frames), times)[0]) for frames, times in video]).cpu()
    if len(found) < MIN_FRAMES:
        raise ValueError(f"{video.name}: {len(found)} frames; motion needs at least {MIN_FRAMES}")
    if not bool((found.square().sum(1) > MIN_ENERGY).any()):
        raise ValueError(f"{video.name}: nothing moves in it; leave it out, or give a video in which the action is seen")
    return found, sight.box.seen


# ----------------------------------------------------------------------------------------------------------------------
# What exemplars find in wrong actions: levels for rejecting and for events, and whether left and right are different here.


def wrong_evidence(source: Recognizer, exemplars: VideoExemplars) -> tuple[torch.Tensor, Array]:
    """What exemplars find in other actions: the evidence of each ``(videos,)``, the contrast of moving frames ``(frames,)``."""
    best, contrasts = [], []
    for i in _sample_exemplars(exemplars):
        stream, seen = _new_stream(source), exemplars.videos()[i]
        label = int(exemplars.labels[i])
        scores, energy = stream.compare(seen.to(source.optics.device))
        others = np.delete(scores, label, axis=1)[energy >= QUIET_ENERGY]
        contrasts.append(others.max(axis=1) - others.mean(axis=1))
        best.append(float(np.delete(stream.whole.mean(), label).max()))
    return torch.tensor(best), np.concatenate(contrasts)


def mirrors_matter(source: Recognizer, exemplars: VideoExemplars) -> bool:
    """Whether some exemplar's mirror image looks clearly more like another action than like its own."""
    for i in _sample_exemplars(exemplars):
        stream, seen = _new_stream(source), exemplars.videos()[i]
        stream.compare(mirror_rows(seen).to(source.optics.device))
        scores = stream.whole.mean()
        label = int(exemplars.labels[i])
        if float(scores.max() - scores[label]) > MIRROR_MARGIN:
            return True
    return False


def find_events(scores: Array, times: Array, energy: Array, classes: Array, wrong: Array, rate: float | None) -> list[Event]:
    """Events of scored frames: where the contrast of the best class exceeds what wrong actions reach at a rate."""
    contrast = scores - scores.mean(axis=1, keepdims=True)
    peak, floor = event_levels(wrong, FALSE_ALARM_RATE if rate is None else rate, EXTENT_RATE, (MIN_CONTRAST, MIN_CONTRAST))
    return events(contrast, times, classes.tolist(), peak, floor, energy < QUIET_ENERGY)


def _sample_exemplars(exemplars: VideoExemplars) -> list[int]:
    """Exemplars to ask, spread over all of them."""
    count = len(exemplars.labels)
    return sorted({round(i) for i in np.linspace(0, count - 1, min(count, MAX_ASKED))})


def _new_stream(source: Recognizer) -> BrightnessStream:
    return BrightnessStream(source, len(source.library.bounds) - 1, "exemplar", None)

"""Synchronization of real recordings: a drone seen by consumer cameras, a person's detected keypoints, and two videos.

    DYNTORCH_DATA=../shared/data python -m experiments.synchronization.real
    DYNTORCH_DATA=../shared/data python -m experiments.synchronization.real --quick

**Drone**: one point, 9 minutes, static cameras of 25 to 60 fps whose nominal rates are wrong by up to 1 %, detections with gaps,
undistorted with the given lenses.  The published map of frames is rounded (rates to 120 ppm), so that errors are given in the
middle of the overlap.  mate7 has no constant rate and is left out.

**Keypoints**: BODY_25B of four synchronized cameras at 60 fps, 100 frames of one person who balances, shifted by known amounts:
whole frames; half a frame at 30 fps, by leaving every other frame out, even ones of a and odd ones of b; other fractions by cubic
splines through one camera (which lowers its noise).  Detections of confidence below .3 are taken out.

**Videos** of two of these cameras, one of them trimmed by known frames: by tracks of points and by brightness.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from statistics import fmean, median
from typing import Literal

import numpy as np
import torch
from scipy.interpolate import CubicSpline
from torch import Tensor

import dyntorch as dyn
from experiments.common.runner import BaseConfig, Tables, experiment
from experiments.common.tables import Row
from experiments.recognition.protocol import Array, data_folder
from experiments.synchronization.baselines import pose2sim
from experiments.synchronization.data import Pair
from indexing.sync.synchronize import synchronize

VARIABLE = "mate7"
"""The camera without a constant frame rate."""
WITHIN = 60.0
"""s: how far the drone's cameras are searched."""
CONFIDENT = 0.3
SHIFTS = (-20.0, -7.0, 0.0, 3.0, 12.0, -5.25, 8.4)
"""Frames at 60 fps."""
TRIMS = (0, 7, -12)
"""Frames at 60 fps cut from the start of the second video, or from that of the first where negative."""
METHODS: tuple[Literal["tracks", "brightness"], ...] = ("brightness", "tracks")


@dataclass(frozen=True)
class Flight:
    """Two cameras that see the drone: places ``(frames, 1, 2)`` px, undistorted; ``times (frames,)`` = frame / nominal fps."""

    name: str
    places: tuple[Tensor, Tensor]
    times: tuple[Tensor, Tensor]
    fps: tuple[float, float]
    offset: float
    rate: float

    @property
    def middle(self) -> float:
        """Of the overlap, on a's clock."""
        ends = [(self.times[1][k].item() - self.offset) / self.rate for k in (0, -1)]
        return (max(self.times[0][0].item(), ends[0]) + min(self.times[0][-1].item(), ends[1])) / 2


def flights() -> list[Flight]:
    """All pairs of cameras with constant rates of the third flight.

    Source: Li et al., Reconstruction of 3D flight trajectories from ad-hoc camera networks, IROS 2020 (CC BY-NC-SA 4.0).
    """
    import cv2

    seen: dict[int, tuple[str, Tensor, Tensor, float]] = {}
    with np.load(data_folder() / "drone_tracking" / "dataset3.npz") as file:
        for index, name in enumerate(str(name) for name in file["cameras"]):
            if name != VARIABLE:
                found, fps = file[f"cam{index}/det"].astype(float), float(file[f"cam{index}/fps"])
                matrix, lens = file[f"cam{index}/K"], file[f"cam{index}/dist"]
                straight = cv2.undistortPoints(found[:, None, 1:], matrix, lens, P=matrix)
                seen[index] = name, torch.from_numpy(straight), torch.from_numpy(found[:, 0] / fps), fps
        alpha, beta = file["alpha"], file["beta"]
    pairs = []
    for i, j in combinations(seen, 2):
        (first, x, tx, fx), (second, y, ty, fy) = seen[i], seen[j]
        pairs.append(
            Flight(f"{first} - {second}", (x, y), (tx, ty), (fx, fy), float(beta[i, j]) / fy, float(alpha[i, j]) * fx / fy)
        )
    return pairs


def drone(config: BaseConfig) -> list[Row]:
    """Every pair: error in the middle, frames of the second camera; error of the rate."""
    rows, near, trusted = [], [], []
    for flight in flights()[:: 4 if config.quick else 1]:
        found = dyn.synchronize(*flight.places, correspondence=True, times=flight.times, max_shift=WITHIN)
        moment = flight.middle
        error = abs(float(found.at(moment)) - flight.rate * moment - flight.offset) * flight.fps[1]
        near.append(error <= 1.5)
        trusted.append(found.ok)
        rate = f"rate off by {1e6 * (found.rate / flight.rate - 1):+.0f} ppm (± {1e6 * found.rate_sigma:.0f}) of {flight.rate:.4f}"
        rows.append(
            Row(flight.name, f"{_said(found)}; {rate}; offset {flight.offset:.1f} s", error, 1.5, at_most=True, unit=" frames")
        )
    right = [good for good, ok in zip(near, trusted, strict=True) if ok]
    return [
        *rows,
        Row("within 1.5 frames", f"{len(near)} pairs", fmean(near), 0.9),
        Row("called ok", f"right of those {fmean(right):.2f}" if right else "", fmean(trusted)),
    ]


def people() -> tuple[Tensor, float]:
    """``(cameras, frames, joints, 2)`` px, NaN where the detector was not sure; and the frame rate."""
    with np.load(data_folder() / "pose2sim" / "pose2sim_balancing.npz") as file:
        found, fps = torch.from_numpy(file["keypoints"].astype(float)), float(file["fps"])
    return torch.where(found[..., 2:] >= CONFIDENT, found[..., :2], torch.nan), fps


def shifted(a: Tensor, b: Tensor, shift: float, fps: float) -> Pair:
    """Two synchronized cameras, frame i of a beside frame i + shift of b."""
    whole = math.ceil(shift)
    if whole > shift:
        b = between(b, whole - shift)
    return Pair("", a[max(whole, 0) : len(a) + min(whole, 0)], b[max(-whole, 0) : len(b) - max(whole, 0)], (fps, fps), shift / fps)


def between(tracks: Tensor, share: float) -> Tensor:
    """Tracks at so much of a frame after each frame, by cubic splines through what was seen; NaN beside gaps."""
    out = torch.full_like(tracks[:-1], torch.nan)
    frames = np.arange(len(tracks))
    for joint in range(tracks.shape[1]):
        seen = tracks[:, joint].isfinite().all(-1)
        both = seen[:-1] & seen[1:]
        if int(seen.sum()) >= 4:
            spline = CubicSpline(frames[seen.numpy()], tracks[seen, joint].numpy())
            out[both, joint] = torch.from_numpy(spline(frames[:-1][both.numpy()] + share))
    return out


def keypoint_pairs(config: BaseConfig) -> Iterator[tuple[str, Pair]]:
    """Every shift of every pair of cameras; kind of the shift."""
    cameras, fps = people()
    for i, j in combinations(range(len(cameras)), 2):
        for shift in SHIFTS[1:3] if config.quick else SHIFTS:
            kind = "whole frames" if shift == int(shift) else "fractions, resampled"
            yield kind, shifted(cameras[i], cameras[j], shift, fps)
        yield "half frames, 30 fps", Pair("", cameras[i, ::2], cameras[j, 1::2], (fps / 2, fps / 2), -0.5 / (fps / 2))


def keypoints(config: BaseConfig) -> list[Row]:
    """Errors in frames, of the library and of Pose2Sim's procedure."""
    pairs: dict[str, list[Pair]] = {}
    for kind, pair in keypoint_pairs(config):
        pairs.setdefault(kind, []).append(pair)
    rows = []
    for kind, chosen in pairs.items():
        answers = {
            "same joints": [dyn.synchronize(pair.a, pair.b, correspondence=True, fps=pair.fps) for pair in chosen],
            "different joints": [
                dyn.synchronize(pair.a[:, ::2], pair.b[:, 1::2], correspondence=False, fps=pair.fps) for pair in chosen
            ],
            "Pose2Sim": [pose2sim(pair.a, pair.b, pair.fps[0]) for pair in chosen],
        }
        for name, found in answers.items():
            errors = [abs(pair.error(x.offset, x.rate)) for pair, x in zip(chosen, found, strict=True)]
            trusted = [error <= 1 for error, x in zip(errors, found, strict=True) if x.ok]
            said = f"ok {len(trusted)} of {len(errors)}, right of those {sum(trusted)}"
            setting = f"{kind}; {said}; median {median(errors):.3f}, worst {max(errors):.2f} frames"
            rows.append(Row(f"{name}, within 1 frame", setting, fmean(error <= 1 for error in errors)))
    return rows


def videos(config: BaseConfig) -> list[Row]:
    """Errors of the pair of videos in frames, by method and trim; what is refused is not wrong."""
    films = [gray(data_folder() / "pose2sim" / f"{name}.mp4") for name in ("cam01", "cam02")]
    rows = []
    for trim in TRIMS[1:2] if config.quick else TRIMS:
        first, second = films[0][max(-trim, 0) :], films[1][max(trim, 0) :]
        for method in METHODS:
            found = synchronize(first, second, method, fps=60.0, max_shift=0.5)
            error = abs(found.frames + trim)
            rows.append(Row(method, f"second film trimmed by {trim} frames; {_said(found)}", error, unit=" frames"))
            rows.append(Row(f"{method}, ok but wrong", f"trimmed by {trim}", float(found.ok and error > 1), 0.0, at_most=True))
    return rows


def gray(path: Path) -> Array:
    """``(frames, height, width)`` uint8."""
    import av

    with av.open(str(path)) as film:
        return np.stack([frame.to_ndarray(format="gray") for frame in film.decode(video=0)])


def _said(found: dyn.Shift) -> str:
    sigma = f"± {found.sigma * found.fps[1]:.2f} frames, confidence {found.confidence:.2f}"
    return f"{found.method}, {'ok' if found.ok else 'refused (' + found.reason + ')'}, {sigma}"


@experiment(BaseConfig())
def tables(config: BaseConfig) -> Tables:
    """Recordings of the folder DYNTORCH_DATA; quick: three pairs of drone cameras, two shifts of keypoints, one of videos."""
    yield "Drone, one point, nine minutes", drone(config)
    yield "Detected keypoints, 100 frames", keypoints(config)
    yield "Videos", videos(config)

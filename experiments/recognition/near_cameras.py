"""People near the camera: phases of single frames and actions of clips at 2, 3, 4.5 and 10 m, by affine or perspective evidence.

    DYNTORCH_DATA=../shared/data python -m experiments.recognition.near_cameras

A camera keeps the person at its distance: the middle of the joints stays where it is, horizontally, so that a walk does not leave
through the lens.  What is learned was filmed from 4.5 m.  Phases: CMU walking as in ``experiments.recognition.gait`` (other takes,
any azimuth, elevation -.1 to .5 rad, 20 mm of noise), ``PhaseIndexer`` with affine and projective cameras; an error is the median
over frames, in degrees.  Actions: UTKinect, subjects left out one at a time, exemplars at azimuth 0, queries turned by 45 and 90
degrees, 15 mm of noise: ``ActionIndexer`` as it is, and the nearest exemplar by one kind of evidence, affine or perspective.
"""

from __future__ import annotations

from collections import defaultdict
from copy import copy
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from dyntorch.numerics import canonical_correlation, orthonormal_basis
from experiments.common.runner import BaseConfig, Tables, experiment
from experiments.common.tables import Row, note
from experiments.recognition import gait
from experiments.recognition.gait import Split, split, walks
from experiments.recognition.protocol import ELEVATION, SPREAD, leave_one_subject_out, load_set
from indexing import ActionIndexer, Clip
from indexing.action.bank import channel
from indexing.cameras import virtual, y_up
from indexing.phase.model import leaning

Array = NDArray[Any]
TRAINED = 4.5
LENGTH = 16
"""Frames of a window of the nearest exemplar."""
TURNS = (45, 90)


@dataclass(frozen=True)
class Config(BaseConfig):
    """People near the camera, on the recordings in the folder DYNTORCH_DATA."""

    distances: tuple[float, ...] = (2.0, 3.0, 4.5, 10.0)
    """Metres."""
    takes: int = 2
    """Walking takes that are asked, one at a time."""
    subjects: int = 5
    """Of UTKinect."""


def followed(clip: Clip) -> Clip:
    """The clip with y up and the middle of its joints in one place horizontally: the camera goes along."""
    joints = y_up(clip).astype(np.float64)
    middle = np.nanmean(joints, axis=1, keepdims=True) * np.array([1.0, 0.0, 1.0])
    return clip.replace(joints=joints - middle, up="y")


def _filmed(config: Config, take: str, distance: float) -> Split:
    def camera(clip: Clip, azimuth: float, elevation: float, **given: Any) -> Clip:
        return virtual(followed(clip), azimuth, elevation, distance=distance, **given)

    return split(take, 4, config.seed, 0.02, camera)


def phases(config: Config) -> list[Row]:
    """Phase error and AUC of walking's frames by distance and camera."""
    error: dict[tuple[str, float], list[tuple[float, float]]] = defaultdict(list)
    for take in walks()[: config.takes]:
        learned = gait.learn(_filmed(config, take, TRAINED), given=True)
        for camera in ("affine", "projective"):
            indexer = copy(learned).set_params(camera=camera)
            indexer.model_ = replace(learned.model_, camera=camera)
            for distance in config.distances:
                auc, off, _ = gait.judge(gait.asked(indexer), _filmed(config, take, distance))
                error[camera, distance].append((auc, off))
                note(f"    {take}, {camera}, {distance:g} m: AUC {auc:.3f}, phase {off:.1f} deg off")
    rows = []
    for distance in config.distances:
        for camera in ("affine", "projective"):
            auc, off = np.mean(error[camera, distance], axis=0)
            rows += [
                Row(f"PhaseIndexer, {camera}: phase error", f"{distance:g} m", float(off), at_most=True, unit=" deg"),
                Row(f"PhaseIndexer, {camera}: AUC", f"{distance:g} m", float(auc)),
            ]
    return rows


def actions(config: Config) -> list[Row]:
    """Share of the clips that are recognized, by distance and evidence."""
    found = load_set("utkinect")
    people = np.unique(found.column("subject"))[: config.subjects]
    chosen = np.flatnonzero(np.isin(found.column("subject"), people))
    solid = [followed(found.clips[i]) for i in chosen]
    labels, subjects = found.labels[chosen], found.column("subject")[chosen]
    rng = np.random.default_rng(config.seed)
    exemplars = [virtual(clip, 0.0, ELEVATION, random_state=rng) for clip in solid]
    rows = []
    for distance in config.distances:
        queries = [
            virtual(clip, turn, ELEVATION + SPREAD * rng.uniform(-1, 1), distance=distance, random_state=rng)
            for turn in TURNS
            for clip in solid
        ]
        right = []
        for train, test in leave_one_subject_out(subjects):
            indexer = ActionIndexer().fit([exemplars[i] for i in train], labels[train])
            asked = [i + k * len(solid) for k in range(len(TURNS)) for i in test]
            right += (indexer.predict([queries[i] for i in asked]) == labels[[i % len(solid) for i in asked]]).tolist()
        note(f"    {distance:g} m: ActionIndexer {np.mean(right):.3f}")
        rows.append(Row("ActionIndexer", f"{distance:g} m", float(np.mean(right))))
        truth, who = np.tile(labels, len(TURNS)), np.tile(subjects, len(TURNS))
        for name, residual in _residuals(windows(queries), windows(exemplars), windows(solid)).items():
            other = np.where(who[:, None] == subjects, np.inf, residual.numpy())
            rows.append(Row(f"nearest exemplar, {name}", f"{distance:g} m", float(np.mean(labels[other.argmin(1)] == truth))))
    return rows


def windows(clips: list[Clip]) -> Tensor:
    """``(clips, LENGTH, joints, dims)``: whole clips, resampled."""
    out = []
    for clip in clips:
        joints = np.nan_to_num(clip.joints.astype(np.float64))
        at = np.linspace(0, len(joints) - 1, LENGTH)
        first = np.minimum(at.astype(int), len(joints) - 2)
        share = (at - first)[:, None, None]
        out.append(joints[first] * (1 - share) + joints[first + 1] * share)
    return torch.from_numpy(np.stack(out))


def _residuals(query: Tensor, bank: Tensor, solid: Tensor) -> dict[str, Tensor]:
    """``(Q, E)`` by one kind of evidence each, on whole clips about their middle."""
    one, other, deep = (channel(x, "clip").flatten(1, 2) for x in (query, bank, solid))
    unit = one / one.flatten(1).norm(dim=1)[:, None, None]
    basis = orthonormal_basis(deep)
    return {
        "one view, affine relation of two views": 1 - canonical_correlation(orthonormal_basis(one), orthonormal_basis(other)),
        "one view, fundamental matrix of two views": fundamental(one, other),
        "3D, affine image": 1 - torch.einsum("enk,qnd->qekd", basis, unit).square().sum((2, 3)),
        "3D, leaning camera": leaning(unit, basis, 0.1),
    }


def fundamental(query: Tensor, bank: Tensor) -> Tensor:
    """``(Q, E)`` least mean square of x^T F x' over |F| = 1, all points of both windows, each at unit RMS distance."""
    rows, columns = torch.triu_indices(3, 3)
    parts = []
    for x in (query, bank):
        p = torch.nn.functional.pad(x / x.square().mean((1, 2), keepdim=True).sqrt(), (0, 1), value=1.0)
        parts.append(p[..., rows] * p[..., columns])
    place = torch.zeros(3, 3, dtype=torch.long)
    place[rows, columns] = place[columns, rows] = torch.arange(6)
    moments = torch.einsum("qpi,epj->qeij", *parts) / query.shape[1]
    i, j = torch.arange(9) // 3, torch.arange(9) % 3
    return torch.linalg.eigvalsh(moments[..., place[i[:, None], i], place[j[:, None], j]])[..., 0]


@experiment(Config(), quick={"distances": (4.5,), "takes": 1, "subjects": 2})
def tables(config: Config) -> Tables:
    """Frames, then clips."""
    yield "phase of single frames, walking against five other actions; learned from 4.5 m", phases(config)
    yield "actions of whole clips, UTKinect, one exemplar view at 4.5 m", actions(config)

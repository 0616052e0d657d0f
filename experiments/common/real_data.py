"""Recordings of points in the folder DYNTORCH_DATA, as tensors: traffic, a board moved by hand, drives, captured bodies."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from experiments.recognition.protocol import data_folder

Array = NDArray[Any]
STANDING = 0.5
"""m/s: boxes of parked vehicles wander by up to 0.36 m/s (95 % of sweeps 0.1 s apart), being annotated by hand."""


@dataclass(frozen=True)
class Traffic:
    """Tracked points of a Hopkins155 sequence: ``tracks (frames, n, 2)`` px and ``bodies (n,)``, the true groups.

    Source: Tron and Vidal, CVPR 2007.
    """

    name: str
    tracks: Tensor
    bodies: Tensor

    @property
    def background(self) -> Tensor:
        """``(n,)`` bool: the largest group.  In cars8 and cars10, where the camera follows the cars, groups are of similar size."""
        return self.bodies == int(torch.bincount(self.bodies).argmax())

    def triple(self, frames: tuple[int, int, int]) -> tuple[Tensor, Tensor, Tensor]:
        """Three views ``(n, 2)``."""
        first, second, third = (self.tracks[k] for k in frames)
        return first, second, third


@dataclass(frozen=True)
class Board:
    """Corners of a flat board moved by hand before four static cameras (caliscope, BSD-2).

    Attributes:
        seen: per camera and instant the corners, ``(points, 2)`` undistorted px, NaN = not seen.
        place: ``(points, 2)`` corners on the board, metres.
    """

    seen: dict[int, dict[int, Tensor]]
    place: Tensor


@dataclass(frozen=True)
class Drive:
    """Boxes of an Argoverse 2 log: ``centres (tracks, sweeps, 3)`` in the sensor frame of each sweep, metres, NaN = absent;
    ``poses (sweeps, 4, 4)`` sensor to city, ``seconds (sweeps,)``.

    Source: Wilson et al., NeurIPS 2021 (CC BY-NC-SA 4.0).
    """

    name: str
    centres: Tensor
    poses: Tensor
    seconds: Tensor

    def triple(self, start: int, step: int) -> tuple[list[Tensor], Tensor, Tensor, Tensor]:
        """Sweeps t, t + k, t + 2k: three views ``(n, 3)`` of the tracks in all of them, which of them move ``(n,)``, and
        the true A, B.
        """
        sweeps = [start, start + step, start + 2 * step]
        boxes, poses = self.centres[:, sweeps], self.poses[sweeps]
        boxes = boxes[boxes.isfinite().all(-1).all(-1)]
        city = torch.einsum("sij,nsj->nsi", poses[:, :3, :3], boxes)
        city = city + poses[:, :3, 3]
        speed = (city[:, 2] - city[:, 0]).norm(dim=-1) / (self.seconds[sweeps[2]] - self.seconds[sweeps[0]])
        inverse = torch.linalg.inv(poses[0])
        return list(boxes.unbind(1)), speed > STANDING, inverse @ poses[1], inverse @ poses[2]


@dataclass(frozen=True)
class Take:
    """A motion capture take: ``joints (frames, 31, 3)`` metres at 60 fps (mocap.cs.cmu.edu, NSF EIA-0196217)."""

    name: str
    what: str
    joints: Tensor


def traffic() -> list[Traffic]:
    """The sequences of cars on roads, each with all its bodies."""
    with np.load(_path("hopkins155.npz")) as file:
        names = sorted((str(n) for n in file["names"] if str(n).startswith("cars") and "_g" not in str(n)), key=_natural)
        return [
            Traffic(name, torch.from_numpy(file[f"{name}/y"].astype(float)), torch.from_numpy(file[f"{name}/s"].astype(int)))
            for name in names
        ]


def board() -> Board:
    """The board in every camera and instant in which some corner was found."""
    with np.load(_path("caliscope_4_cam_recording.npz")) as file:
        columns, rows = [str(c) for c in file["xy_columns"]], file["xy"]
        cameras = json.loads(str(file["camera_array"]))["cameras"]
    column = {name: rows[:, k] for k, name in enumerate(columns)}
    ids = column["keypoint_id"].astype(int)
    place = np.full((ids.max() + 1, 2), np.nan)
    place[ids] = np.stack([column["board_x"], column["board_y"]], axis=-1)
    seen: dict[int, dict[int, Tensor]] = {}
    for camera in np.unique(column["cam_id"]).astype(int):
        lens = cameras[str(camera)]
        seen[int(camera)] = {}
        for instant in np.unique(column["sync_index"][column["cam_id"] == camera]).astype(int):
            these = (column["cam_id"] == camera) & (column["sync_index"] == instant)
            pixels = np.full((len(place), 2), np.nan)
            found = np.stack([column["x"][these], column["y"][these]], axis=-1)
            pixels[ids[these]] = undistorted(found, np.array(lens["matrix"]), np.array(lens["distortions"]))
            seen[int(camera)][int(instant)] = torch.from_numpy(pixels)
    return Board(seen, torch.from_numpy(place))


def undistorted(pixels: Array, matrix: Array, distortions: Array) -> Array:
    """Pixels ``(n, 2)`` of the pinhole camera ``matrix``, from pixels of a lens with Brown's k1, k2, p1, p2, k3."""
    focal, centre = np.array([matrix[0, 0], matrix[1, 1]]), np.array([matrix[0, 2], matrix[1, 2]])
    k1, k2, p1, p2, k3 = distortions
    measured = (pixels - centre) / focal
    ideal = measured
    for _ in range(50):  # fixed point: the lens moves points by a fraction of their distance to the centre
        square, (x, y) = (ideal**2).sum(-1, keepdims=True), ideal.T
        radial = 1 + square * (k1 + square * (k2 + square * k3))
        tangent = np.stack([2 * p1 * x * y + p2 * (square[:, 0] + 2 * x * x), p1 * (square[:, 0] + 2 * y * y) + 2 * p2 * x * y], -1)
        ideal = (measured - tangent) / radial
    return np.asarray(ideal * focal + centre)


def drives() -> list[Drive]:
    """The logs, without the box of the vehicle that carries the sensor."""
    folder = _path("argoverse2")
    found = []
    for path in sorted(folder.glob("*.npz")):
        with np.load(path) as file:
            others = file["category"] != "EGO_VEHICLE"
            pose = torch.from_numpy(file["ego_qxyz"].astype(float))
            matrices = torch.eye(4, dtype=torch.float64).repeat(len(pose), 1, 1)
            matrices[:, :3, :3], matrices[:, :3, 3] = rotation(pose[:, :4]), pose[:, 4:]
            centres = torch.from_numpy(file["box_ego"][others, :, :3].astype(float))
            seconds = torch.from_numpy((file["t_ns"] - file["t_ns"][0]) * 1e-9)
            found.append(Drive(path.stem[:8], centres, matrices, seconds))
    if not found:
        raise ValueError(f"{folder}: no .npz in it")
    return found


def rotation(quaternion: Tensor) -> Tensor:
    """Rotations ``(..., 3, 3)`` of quaternions ``(..., 4)``, w first."""
    w, x, y, z = torch.nn.functional.normalize(quaternion, dim=-1).unbind(-1)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)


def takes() -> list[Take]:
    """The takes of the motion capture set."""
    with np.load(_path("cmu_mocap_60fps.npz")) as file:
        joints, offsets = torch.from_numpy(file["joints"].astype(float)), file["offsets"].tolist()
        return [
            Take(str(name), str(what), joints[start:end])
            for name, what, start, end in zip(file["names"], file["description"], offsets, offsets[1:], strict=False)
        ]


def _path(name: str) -> Path:
    """A file or folder of the data folder.

    Raises:
        ValueError: the data folder is not named, or lacks it.
    """
    path = data_folder() / name
    if not path.exists():
        raise ValueError(f"{path}: no such file or folder")
    return path


def _natural(name: str) -> tuple[int, str]:
    digits = name.removeprefix("cars")
    number = "".join(c for c in digits.split("_")[0] if c.isdigit())
    return int(number), digits

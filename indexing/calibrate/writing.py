"""A rig as others read it: ``Calib_dyntorch.toml`` (Pose2Sim, AniPose), and keypoint files with the same people in all cameras."""

from __future__ import annotations

import json
import re
import secrets
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from indexing.files import recover_folder, replace_folder
from indexing.sync.files import Plan, openpose_files, plan, renumbered

if TYPE_CHECKING:
    from indexing.calibrate.rig import CameraRig
    from indexing.calibrate.views import View

CALIBRATION = "Calib_dyntorch.toml"
ASSOCIATED = "pose-associated"
OTHERS = ("metadata", "capture_volume", "charuco", "checkerboard")
"""Sections of such files that are no cameras."""


def toml_of(rig: CameraRig) -> str:
    """A section for each camera, in the order in which Pose2Sim has their folders, with all digits of every number."""
    found = rig.calibration
    turns = rotation_vectors(found.R.numpy())
    order = sorted(range(len(rig.names)), key=lambda i: _natural(rig.names[i]))
    lines: list[str] = []
    for i in order:
        bent = found.distortion[i].tolist()
        lines += [
            f"[{_key(rig.names[i])}]",
            f"name = {_text(rig.names[i])}",
            f"size = {_numbers(found.sizes[i].tolist())}",
            f"matrix = [ {', '.join(_numbers(row) for row in found.K[i].tolist())} ]",
            f"distortions = {_numbers(bent if any(bent[4:]) else bent[:4])}",
            f"rotation = {_numbers(turns[i].tolist())}",
            f"translation = {_numbers(found.t[i].tolist())}",
            "fisheye = false",
            "",
        ]
    error = float(found.residuals[found.residuals.isfinite()].median()) if bool(found.residuals.isfinite().any()) else 0.0
    lines += [
        "[metadata]", "adjusted = true", f"error = {error!r}", f"units = {_text(rig.units)}",
        f"up = {_text('z' if found.upright else 'z, by the cameras')}", 'generated_by = "dyntorch calibrate"',
    ]  # fmt: skip
    return "\n".join(lines) + "\n"


def rotation_vectors(R: NDArray[np.float64]) -> NDArray[np.float64]:
    """``(cameras, 3)`` axes times angles in radians of rotations ``(cameras, 3, 3)``; NaN where there is none."""
    from scipy.spatial.transform import Rotation

    known = np.isfinite(R).all(axis=(1, 2))
    out = np.full((len(R), 3), np.nan)
    if known.any():
        out[known] = Rotation.from_matrix(R[known]).as_rotvec()
    return out


def _numbers(values: Sequence[float]) -> str:
    return f"[ {', '.join(repr(float(value)) for value in values)} ]"


def _key(name: str) -> str:
    """A section's name, quoted where it is no bare word, and another one where it would be no camera."""
    name = f"{name}_camera" if name in OTHERS else name
    return name if re.fullmatch(r"[A-Za-z0-9_-]+", name) else _text(name)


def _text(value: str) -> str:
    """A string of TOML; what is no text in UTF-8 becomes a question mark."""
    return json.dumps(value.encode("utf-8", "replace").decode(), ensure_ascii=False).replace("\x7f", "\\u007f")


def _natural(name: str) -> list[tuple[int, int, str]]:
    """A key that sorts cam2 before cam10."""
    return [(0, int(part), "") if part.isdecimal() else (1, 0, part.lower()) for part in re.split(r"(\d{1,18})", name) if part]


# ----------------------------------------------------------------------------------------------------------------------
# Keypoint files of all cameras: equal frame numbers are equal moments, and person 1 is the same one in all of them.


def write_associated(folder: Path, rig: CameraRig) -> dict[str, dict[str, Any]]:
    """Write ``pose-associated/<camera>_json/`` for every camera: all of them, or nothing."""
    target = folder / ASSOCIATED
    recover_folder(target)
    building = folder / f".{ASSOCIATED}-{secrets.token_hex(8)}.tmp"
    clocks = rig.calibration.clocks
    done: dict[str, dict[str, Any]] = {}
    try:
        for i, view in enumerate(rig.views):
            one = plan(view.take, float(clocks.offsets[i]), float(clocks.rates[i]), rig.views[0].take.fps)
            name = f"{view.name}_json"
            if len(one.rows):
                _write_camera(building / name, view, one)
            done[view.name] = {
                "folder": f"{ASSOCIATED}/{name}",
                "files": len(one.numbers),
                "rest": one.rest,
                "left_out": one.before,
            }
        replace_folder(building, target)
    except OSError as problem:
        raise ValueError(
            f"cannot write {str(target)!r} ({problem.strerror or problem}); free the name or the disk, or choose another folder"
        ) from problem
    finally:
        shutil.rmtree(building, ignore_errors=True)
    return done


def _write_camera(folder: Path, view: View, one: Plan) -> None:
    folder.mkdir(parents=True)
    texts = _frames(view)
    sources = openpose_files(one.take.path)
    by_row = {}
    if sources:
        by_number = {int(np.rint(time * one.take.fps)): row for row, time in enumerate(one.take.times)}
        by_row = {by_number[number]: path.name for number, path in sources.items() if number in by_number}
    for number, row in zip(one.numbers.tolist(), one.rows.tolist(), strict=True):
        name = renumbered(by_row[row], number) if row in by_row else f"{view.name}_{number:06d}.json"
        (folder / name).write_text(texts[row], encoding="utf-8")


def _frames(view: View) -> list[str]:
    """One text per frame of the recording, all people in each."""
    times = view.take.times
    joints = next(clip.joints.shape[1] for clip in view.people if clip is not None)
    tables = np.zeros((len(times), len(view.people), joints, 3))
    for who, clip in enumerate(view.people):
        if clip is not None:
            rows, seen = np.searchsorted(times, clip.times), clip.seen
            trust = seen.astype(np.float64) if clip.confidence is None else np.asarray(clip.confidence, dtype=np.float64)
            tables[rows, who] = np.where(seen[..., None], np.concatenate([clip.joints, trust[..., None]], axis=2), 0.0)
    return [
        json.dumps({
            "version": 1.3,
            "people": [{"person_id": [who], "pose_keypoints_2d": flat.ravel().tolist()} for who, flat in enumerate(frame)],
        })
        for frame in tables
    ]  # fmt: skip


def drop_associated(folder: Path) -> None:
    """Remove the keypoint files of an earlier run, which this one did not write again."""
    shutil.rmtree(folder / ASSOCIATED, ignore_errors=True)

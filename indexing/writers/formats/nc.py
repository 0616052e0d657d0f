"""Datasets of poses as ``movement`` has them, in memory and as netCDF; xarray is imported here alone, and when it is needed."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from indexing.opening import clip_text, error, read_bytes
from indexing.writers.markers import Writer, align_clips, people_of

if TYPE_CHECKING:
    from indexing.clip import Clip

ENGINES = ("netcdf4", "h5netcdf")  # netCDF 4, which is HDF5; xarray's third one writes netCDF 3
AXES = ("time", "space", "keypoints", "individuals")
INSTALL = "pip install xarray, and for .nc netCDF4, too"


def encode(clips: Sequence[Clip], path: Path, units: str | None = None) -> tuple[bytes, list[str]]:
    """The people of one recording as netCDF 4, which ``xarray.open_dataset`` reads."""
    dataset = dataset_of(clips, path)
    with tempfile.TemporaryDirectory() as folder:  # whoever writes netCDF wants a file of its own
        made = Path(folder) / "poses.nc"
        problems = []
        for engine in ENGINES:
            try:
                dataset.to_netcdf(made, engine=engine)
                break
            except (ValueError, ImportError) as problem:
                problems.append(clip_text(problem, 80))
        else:
            raise error(path, f"xarray cannot write netCDF here ({problems[0]})", INSTALL)
        return read_bytes(made), []


def dataset_of(clips: Sequence[Clip], path: Path = Path("dataset")) -> Any:
    """The people of one recording as an ``xarray.Dataset`` of poses; see :meth:`indexing.Clip.to_movement`."""
    try:
        import xarray
    except ImportError:
        raise ValueError(f"datasets of movement need xarray; {INSTALL}") from None

    clips = list(clips)
    people = people_of(clips, path)
    first = clips[0]
    if len({(clip.joints.shape[1], clip.skeleton) for clip in clips}) > 1:
        raise error(path, "the clips have different joints", "write a file of each")
    times, flat = align_clips(clips)
    shape = (len(times), len(clips), first.joints.shape[1], first.dims)
    position = flat.reshape(shape).transpose(0, 3, 2, 1)
    sure = np.full((len(times), shape[2], shape[1]), np.nan, np.float32)
    for i, clip in enumerate(clips):
        if clip.confidence is not None:
            sure[np.searchsorted(times, clip.times), :, i] = clip.confidence
    joints = first.skeleton.joints if first.skeleton is not None else [f"keypoint_{i}" for i in range(shape[2])]
    clock, unit = times, "seconds"
    if first.fps_assumed:
        clock, unit = np.rint(times * float(first.fps or 30.0)).astype(np.int64), "frames"
    coords = (clock, list("xyz"[: first.dims]), list(joints), [who or "id_0" for who in people])
    return xarray.Dataset(
        data_vars={
            "position": xarray.DataArray(np.ascontiguousarray(position), dims=AXES),
            "confidence": xarray.DataArray(sure, dims=(AXES[0], *AXES[2:])),
        },
        coords=dict(zip(AXES, coords, strict=True)),
        attrs=_attributes(first, unit),
    )


def _attributes(clip: Clip, unit: str) -> dict[str, Any]:
    """What movement expects, and what a clip knows besides: plain values only, as netCDF holds no others."""
    attributes: dict[str, Any] = {"source_software": "dyntorch", "ds_type": "poses", "time_unit": unit, "up": clip.up}
    if unit == "seconds":
        attributes["fps"] = float(clip.fps or 30.0)
    if clip.name:
        attributes["source_file"] = clip.name
    if isinstance(clip.label, (str, int)):
        attributes["label"] = clip.label
    if clip.skeleton is not None:
        attributes["skeleton"] = clip.skeleton.name
        if clip.skeleton.bones:
            attributes["bones"] = np.array(clip.skeleton.bones, dtype=np.int32).ravel()
    return attributes


FORMAT = Writer(("movement",), encode)

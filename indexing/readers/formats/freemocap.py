"""FreeMoCap: the folder of a recording, of whose arrays the body in 3D is read, in millimetres with z up.

In ``output_data``: ``mediapipe_body_3d_xyz.npy`` (frames, 33, 3), or ``mediapipe_skeleton_3d.npy``
(``mediaPipeSkel_3d_body_hands_face.npy`` before 1.4), whose first 33 points are the body.  Where only raw data is there:
``raw_data/..._3dData_numFrames_numTrackedPoints_spatialXYZ.npy``; without 3D, the cameras one by one from
``..._2dData_numCams_numFrames_numTrackedPoints_pixelXY.npy``.  None of them has times: ``fps=`` says how many frames a second has.
"""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from indexing.clip import ClipSet
from indexing.opening import error, listing
from indexing.readers.files import Format, Options, Source
from indexing.readers.formats.mediapipe import may_lag
from indexing.readers.npz import read_npy
from indexing.readers.recording import NobodySeen, Recording, to_clips
from indexing.skeleton import MEDIAPIPE33

BODY = len(MEDIAPIPE33.joints)
NAMES = tuple(
    re.compile(pattern, re.IGNORECASE)
    for pattern in (
        r"mediapipe_body_3d_xyz\.npy",
        r"(mediapipe|freemocap)_?skeleton_3d\.npy|skeleton_3d\.npy",
        r"mediapipeSkel_3d_body_hands_face\.npy|mediapipe_?Skel_3d_origin_aligned\.npy",
        r"mediapipe_?3dData_numFrames_numTrackedPoints_spatialXYZ\.npy",
        r"mediapipe_?2dData_numCams_numFrames_numTrackedPoints_pixelXY\.npy",
    )
)
"""Names of arrays, best first: processed before raw, 3D before 2D."""
REMEDY = "give the folder of a recording, with output_data in it"


def rank(name: str) -> int | None:
    """How good an array with this name is, 0 the best; None where FreeMoCap does not name one so."""
    return next((i for i, pattern in enumerate(NAMES) if pattern.fullmatch(name)), None)


def read(source: Source, options: Options) -> ClipSet:
    """Read the body of a recording; of 2D data, a clip per camera."""
    files: list[Path] = [source.path] if source.kind == "npy" else list(source.data)
    ranked = sorted((place, str(file), file) for file in files if (place := rank(file.name)) is not None)
    if not ranked:
        raise error(source.path, f"has no array of a body (it has {listing(file.name for file in files)})", REMEDY)
    _, _, path = ranked[0]
    values = read_npy(path)
    flat = values.ndim == 4
    if values.dtype.kind not in "fiu" or values.ndim not in (3, 4) or not values.size or values.shape[-2] < BODY:
        raise error(path, f"is an array {values.shape} of {values.dtype}, without the {BODY} points of a body", REMEDY)
    if values.shape[-1] not in ((2, 3) if flat else (3,)):
        raise error(path, f"is an array {values.shape}, whose points have {values.shape[-1]} coordinates", REMEDY)
    name = source.path.name or source.path.resolve().name
    if not flat:
        return to_clips(source.path, _recording(values), options)
    clips, options = [], replace(options, person="largest")  # cameras are no people of one recording
    for i, camera in enumerate(values):
        try:
            (clip,) = to_clips(source.path, _recording(camera[..., :2]), options)
        except NobodySeen:
            continue
        clips.append(clip.replace(name=f"{name}[{i}]", meta={**clip.meta, "camera": i, "may_lag": may_lag(clip)}))
    if not clips:
        raise NobodySeen(source.path, np.arange(values.shape[1]))
    return ClipSet(clips, name)


def _recording(values: NDArray[Any]) -> Recording:
    joints = values[:, :BODY].astype(np.float64)
    frames = np.arange(len(joints))
    return Recording(frames, frames, joints, None, skeleton=MEDIAPIPE33, up="-y" if joints.shape[2] == 2 else "z")


def matches(source: Source) -> bool:
    """A folder of arrays, or an array with a name of FreeMoCap's."""
    return source.kind == "npy folder" or rank(source.path.name) is not None


FORMAT = Format(("FreeMoCap",), ("npy folder", "npy"), read, matches, order=10)

"""Cameras calibrated from the people in view: recordings in, cameras on one clock and the movement in 3D out.

``pipeline`` holds :func:`calibrate` and its steps in order; ``camera_views`` brings recordings to the same joints on even grids,
``priors`` reads what is given of lenses and clocks, and turns a person's height into a length between joints,
``people`` identifies people across cameras, ``left_right`` mends exchanged sides; ``rig`` is the result (:class:`CameraRig`)
and the files that other programs read.
"""

from __future__ import annotations

from indexing.calibrate.pipeline import RigPriors as RigPriors
from indexing.calibrate.pipeline import calibrate as calibrate
from indexing.calibrate.pipeline import calibrate_recordings as calibrate_recordings
from indexing.calibrate.rig import CameraRig as CameraRig

__all__ = ["CameraRig", "RigPriors", "calibrate", "calibrate_recordings"]

"""Cameras calibrated from the people in view: recordings in, cameras on one clock and the movement in 3D out.

``verb`` holds :func:`calibrate` and its steps in order; ``views`` brings recordings to the same joints on even grids, ``stature``
turns a person's height into a length between joints, ``lenses`` knows what is known of the lenses and ``clocks`` what of the
clocks, ``people`` tells who is who in all cameras; ``rig`` is the result (:class:`CameraRig`), ``writing`` the files that other
programs read.  ``options`` has every number that decides.
"""

from __future__ import annotations

from indexing.calibrate.options import RigOptions as RigOptions
from indexing.calibrate.rig import CameraRig as CameraRig
from indexing.calibrate.verb import Known as Known
from indexing.calibrate.verb import calibrate as calibrate
from indexing.calibrate.verb import solve as solve

__all__ = ["CameraRig", "Known", "RigOptions", "calibrate", "solve"]

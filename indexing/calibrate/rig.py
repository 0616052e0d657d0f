"""What calibrate() returns: the cameras, the clocks and the movement in space, with the names of everything."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from numpy.typing import NDArray

from dyntorch.numerics import as_python, worded
from indexing.calibrate.lenses import KnownLenses
from indexing.calibrate.stature import Stature
from indexing.calibrate.views import Joints, View
from indexing.clip import Clip, ClipSet
from indexing.opening import count

if TYPE_CHECKING:
    from dyntorch import Calibration
    from indexing.calibrate.sides import SideExchange

FloatArray = NDArray[np.float64]
UNKNOWN_UNIT = "unknown"
OPEN = ("unknown_scale", "camera_up")
"""Codes of notices that say what cannot be known."""
Y_UP = [1, 2, 0]
"""Axes of the world (z up) in the order in which OpenSim and Pose2Sim have them (y up): a turn, no mirror."""


@dataclass(frozen=True, eq=False)
class CameraRig:
    """Cameras that were calibrated from the people in view.

    Attributes:
        calibration: of :func:`dyntorch.calibrate`, on the cameras' own clocks (seconds of their files).
        views: what the cameras saw.
        joints: which joints were used.
        lenses: what was known of the lenses.
        stature: what the scale rests on, where a height was given.
        lengths: known lengths between joints by their names, metres.
        identities: who is who across cameras, where several people are in view.
        exchanges: where a detector had left for right in a camera, which was mended.
        remarks: on the input, a sentence each.
        words: what whoever reads it calls the arguments that sentences speak of.
    """

    calibration: Calibration
    views: Sequence[View]
    joints: Joints
    lenses: KnownLenses = field(default_factory=KnownLenses)
    stature: Stature | None = None
    lengths: Mapping[tuple[str, str], float] = field(default_factory=dict)
    identities: Any = None
    exchanges: Sequence[SideExchange] = ()
    remarks: Sequence[str] = ()
    words: Callable[[str, str | None], str] = as_python

    @property
    def ok(self) -> bool:
        """Whether the data decide."""
        return bool(self.calibration.ok)

    @property
    def reason(self) -> str:
        """Why not, and what to do; empty where they do."""
        return "" if self.ok else str(self.spoken.refusal(self.words))

    @property
    def state(self) -> str:
        """The status's name in small letters."""
        from dyntorch import Status

        return Status(int(self.calibration.status)).name.lower().replace("_", " ")

    def check(self) -> Self:
        """Raise where the data do not decide.

        Raises:
            ValueError: the reason.
        """
        if not self.ok:
            raise ValueError(f"calibrate: {self.reason}")
        return self

    @functools.cached_property
    def spoken(self) -> Calibration:
        """The calibration, whose notices call the cameras by name."""
        names = {str(number): name for number, name in enumerate(self.names)}
        said = tuple(notice.named(names) for notice in self.calibration.notices)
        return dataclasses.replace(self.calibration, notices=said)

    @functools.cached_property
    def names(self) -> list[str]:
        """Of the cameras."""
        return [view.name for view in self.views]

    @property
    def persons(self) -> int:
        """How many people are in it."""
        return len(self.views[0].people)

    @functools.cached_property
    def joint_names(self) -> tuple[str, ...]:
        """Of the joints of one person."""
        if self.joints.skeleton is not None:
            return self.joints.skeleton.joints
        return tuple(f"joint {i}" for i in range(self.joints.count))

    @functools.cached_property
    def point_names(self) -> list[str]:
        """Of the points of everybody, in the order of ``calibration.points``."""
        several = self.persons > 1
        return [f"{who + 1}:{name}" if several else name for who in range(self.persons) for name in self.joint_names]

    @property
    def units(self) -> str:
        """Of the coordinates: ``m``, or ``unknown`` where nothing fixes the scale."""
        return "m" if self.calibration.metric else UNKNOWN_UNIT

    @functools.cached_property
    def notes(self) -> list[str]:
        """What a reader should know besides, a sentence each."""
        own = [str(notice.worded(self.words).text) for notice in self.spoken.notices if _is_note(notice)]
        known = [*self.remarks, *self.lenses.notes, *([self.stature.note] if self.stature is not None else [])]
        return list(dict.fromkeys([*(worded(note, self.words) for note in known), *own]))

    @functools.cached_property
    def unknown(self) -> list[str]:
        """What cannot be known from these recordings, a sentence each."""
        open_ = [str(notice.worded(self.words).text) for notice in self.spoken.notices if notice.code.value in OPEN]
        return [
            *open_,
            f"where in the world the rig stands: the origin is on the ground below the people, y is ahead of {self.names[0]}",
        ]

    @functools.cached_property
    def _span(self) -> slice:
        """The frames from the first to the last in which any joint is known."""
        seen = np.flatnonzero(np.isfinite(self.calibration.points.numpy()).any(axis=(1, 2)))
        return slice(int(seen[0]), int(seen[-1]) + 1) if len(seen) else slice(0, 0)

    @property
    def moments(self) -> FloatArray:
        """``(T,)`` seconds of the first camera's clock, of all frames of the movement."""
        return np.asarray(self.calibration.times.numpy(), dtype=np.float64)[self._span]

    @property
    def points(self) -> FloatArray:
        """``(T, people * n, 3)`` the movement in the world of the cameras, z up; NaN = unknown."""
        points = np.array(self.calibration.points.numpy(), dtype=np.float64)[self._span]
        points[np.isnan(points).any(axis=2)] = np.nan
        return points

    @functools.cached_property
    def people(self) -> tuple[Clip, ...]:
        """The movement in space, a clip for each person: y up, as OpenSim has it, times of the first camera's clock.

        With the world of the calibration file, whose z is up, :math:`(x, y, z)_{\\text{clip}} = (y, z, x)_{\\text{world}}`.
        """
        times = self.moments
        own = self.points[..., Y_UP].reshape(len(times), self.persons, self.joints.count, 3)
        return tuple(self._person(own[:, who], times, who) for who in range(self.persons)) if len(times) else ()

    def _person(self, joints: FloatArray, times: FloatArray, who: int) -> Clip:
        name = "people in space" if self.persons > 1 else "person in space"
        meta = {"person": str(who + 1), "units": self.units}
        return Clip(
            joints, times, name=f"{name} {who + 1}" if self.persons > 1 else name, skeleton=self.joints.skeleton, up="y", meta=meta
        )

    def save_people(self, path: str | Path) -> list[str]:
        """Write the movement in space: ``.trc``, ``.c3d``, ``.nc``, or a clip set ``.npz``, which ``dyntorch index fit`` takes.

        Raises:
            ValueError: the data do not decide, or the file cannot be written.
        """
        units = self.units if Path(path).suffix.lower() in (".trc", ".c3d") and self.calibration.metric else None
        return ClipSet(self.check().people, "people in space").save(path, units)

    def save_cameras(self, path: str | Path) -> Path:
        """Write the cameras as Pose2Sim and AniPose read them; see :mod:`indexing.calibrate.writing`.

        Raises:
            ValueError: the data do not decide, or the file cannot be written.
        """
        from indexing.calibrate.writing import toml_of
        from indexing.files import write_text

        return write_text(path, toml_of(self.check()))

    def write(self, folder: str | Path, title: str = "") -> Path:
        """Write everything: cameras, movement, figures and the report; see :mod:`indexing.report.calibration`.

        Returns:
            the path of ``report.html``.

        Raises:
            ValueError: the folder or a file in it cannot be written, or is somebody else's.
        """
        from indexing.report.calibration import CalibrationReport, write_calibration

        return write_calibration(folder, CalibrationReport(self, heading=title))[0]

    def __repr__(self) -> str:
        state = "ok" if self.ok else f"refused: {self.reason}"
        lines = [
            f"CameraRig({', '.join(self.names)}; {count(self.persons, 'person', 'people')}, {self.joints.count} joints, {state})"
        ]
        return "\n".join([*lines, *(f"  note: {note}" for note in self.notes)])


def _is_note(notice: Any) -> bool:
    """Whether a notice refuses nothing, and is not told with what cannot be known."""
    return notice.code.refuses is None and notice.code.value not in OPEN

"""The declared motion models, one entry each: everything that the library, the command line and the reports know of a model.

No torch, so that ``dyntorch reconstruct --help`` can name them; ``motions`` makes a :class:`dyntorch.Motion` of every entry.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal


@dataclass(frozen=True)
class SmallerModel:
    """A model of fewer unknowns that leaves the larger one undetermined where it explains the tracks."""

    name: str
    """Of a declared or auxiliary model."""
    notice: str
    """Code of the :class:`~dyntorch.tasks.reconstruct.result.ReconstructNotice` that says so."""
    case: str = ""
    """Which of its sentences."""


@dataclass(frozen=True)
class MotionModel:
    """A motion model as data: by default the first ``directions`` coordinates of a point are polynomials of the time."""

    name: str
    purpose: str
    """What the points do, one sentence."""
    leaves_open: str
    """The ambiguity of uncalibrated cameras."""
    metric_open: str
    """The ambiguity of calibrated cameras."""
    dim: int
    """Of the world."""
    directions: int = 0
    degree: int = 1
    sensor: int = 2
    """Coordinates that a view measures: 2 of images, 3 of 3D sensors."""
    bodies: int = 1
    """2: bodies in relative translation at arbitrary steps, without a lift."""
    smaller: tuple[SmallerModel, ...] = ()
    """Models that make this one degenerate, those of fewest unknowns first."""
    lift: Callable[[float], Sequence[Sequence[float]]] | None = None
    """B(t), ``(d + 1, K)``, of a motion that is no such polynomial."""


_AFFINE = "an affinity of the world and a velocity common to all points"
_PARTLY = "a collineation of the world that keeps the direction{} of motion, and a velocity, linear in the position, added to all"
_BODIES = "an affinity of each body, with a linear part common to both"
_SIMILAR = "a similarity of the {}"
_ALONG = f"{_SIMILAR}, and a velocity along the direction of motion, common to all points"
_COMMON = f"{_SIMILAR}, and a velocity common to all points"
_BESIDE = "a similarity of the world, and a velocity parallel to the planes of motion, common to all points"
_RIGID = "a rigid motion of the world, and a velocity common to all points"
_TWO = "a similarity of each body, with a rotation common to both"

_STATIC_2D = SmallerModel("static_2d", "static_scene")
_STATIC_3D = SmallerModel("static_3d", "static_scene")
_ONE_DIRECTION = SmallerModel("constant_direction_3d", "linear_velocities")
_TURNING = SmallerModel("turning", "uniform_camera")

MOTION_MODELS: tuple[MotionModel, ...] = (
    MotionModel(
        name="static_2d",
        purpose="The points of a plane stand still.",
        leaves_open="a collineation of the plane",
        metric_open=_SIMILAR.format("plane"),
        dim=2,
    ),
    MotionModel(
        name="static_3d",
        purpose="The points stand still.",
        leaves_open="a collineation of space",
        metric_open=_SIMILAR.format("world"),
        dim=3,
        smaller=(SmallerModel("static_2d", "turning_camera"),),
    ),
    MotionModel(
        name="constant_direction_2d",
        purpose="The points move in a plane along one common direction, each at its own speed.",
        leaves_open=_PARTLY.format(""),
        metric_open=_ALONG.format("plane"),
        dim=2,
        directions=1,
        smaller=(_STATIC_2D,),
    ),
    MotionModel(
        name="constant_velocity_2d",
        purpose="The points move in a plane, each at its own constant velocity.",
        leaves_open=_AFFINE,
        metric_open=_COMMON.format("plane"),
        dim=2,
        directions=2,
        smaller=(_STATIC_2D, SmallerModel("constant_direction_2d", "linear_velocities")),
    ),
    MotionModel(
        name="constant_acceleration_2d",
        purpose="The points move in a plane, each with its own constant acceleration.",
        leaves_open=f"{_AFFINE}, and likewise a common acceleration",
        metric_open=f"{_COMMON.format('plane')}, and likewise a common acceleration",
        dim=2,
        directions=2,
        degree=2,
        smaller=(_STATIC_2D, SmallerModel("constant_velocity_2d", "degenerate")),
    ),
    MotionModel(
        name="constant_direction_3d",
        purpose="The points move in space along one common direction, each at its own speed.",
        leaves_open=_PARTLY.format(""),
        metric_open=_ALONG.format("world"),
        dim=3,
        directions=1,
        smaller=(
            SmallerModel("constant_direction_2d", "turning_camera"),
            _STATIC_3D,
            SmallerModel("constant_velocity_2d", "uniform_camera"),
        ),
    ),
    MotionModel(
        name="constant_velocity_planes_3d",
        purpose="The points move in space, parallel to a plane, each at its own constant velocity.",
        leaves_open=_PARTLY.format("s"),
        metric_open=_BESIDE,
        dim=3,
        directions=2,
        smaller=(SmallerModel("constant_velocity_2d", "turning_camera"), _STATIC_3D, _ONE_DIRECTION, _TURNING),
    ),
    MotionModel(
        name="constant_velocity_3d",
        purpose="The points move in space, each at its own constant velocity.",
        leaves_open=_AFFINE,
        metric_open=_COMMON.format("world"),
        dim=3,
        directions=3,
        smaller=(
            _STATIC_3D,
            _ONE_DIRECTION,
            _TURNING,
            SmallerModel("constant_velocity_planes_3d", "planar_velocities"),
        ),
    ),
    MotionModel(
        name="constant_velocity_3d_sensors",
        purpose="The points move in space, each at its own constant velocity, before a 3D sensor.",
        leaves_open=_AFFINE,
        metric_open=_RIGID,
        dim=3,
        directions=3,
        sensor=3,
        smaller=(SmallerModel("static_3d_sensors", "static_scene", "sensors"),),
    ),
    MotionModel(
        name="two_bodies_2d",
        purpose="The points of a plane belong to two bodies, one of which is shifted against the other.",
        leaves_open=_BODIES,
        # the centres of the cameras, where both bodies would meet, show how large one is against the other
        metric_open=f"{_TWO}, which are of one scale",
        dim=2,
        bodies=2,
        smaller=(SmallerModel("static_2d", "one_body"),),
    ),
    MotionModel(
        name="two_bodies_3d",
        purpose="The points belong to two bodies, one of which is shifted against the other.",
        leaves_open=f"{_BODIES}, and the size of one body against the other",
        metric_open=f"{_TWO}, and the size of one body against the other",
        dim=3,
        bodies=2,
        smaller=(SmallerModel("static_3d", "one_body"),),
    ),
)
"""The models that ``reconstruct`` takes by name, and that ``"auto"`` compares."""

if TYPE_CHECKING:
    MotionName = str
else:
    MotionName = Literal[("auto", *(model.name for model in MOTION_MODELS))]
    """What ``--motion`` may be."""

AUXILIARY_MODELS: tuple[MotionModel, ...] = (
    MotionModel(
        name="turning",
        purpose="What a camera that does not accelerate sees of moving points: p + t q, of three coordinates each.",
        leaves_open="",
        metric_open="",
        dim=2,
        lift=lambda t: [[1, 0, 0, t, 0, 0], [0, 1, 0, 0, t, 0], [0, 0, 1, 0, 0, t]],
    ),
    MotionModel(
        name="static_3d_sensors",
        purpose="The points stand still before a 3D sensor.",
        leaves_open="",
        metric_open="",
        dim=3,
        sensor=3,
    ),
)
"""Models that only the diagnosis of larger ones uses."""

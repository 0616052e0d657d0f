"""Ground-truth scenes for tests, benchmarks and experiments: one function per kind of motion, all batched."""

from dyntorch.scenes.bodies import TranslatingScene, bodies, convergent_motions, translating_planes
from dyntorch.scenes.lifts import LiftedScene, lifted_points
from dyntorch.scenes.plane import lines_concurrent, planar, translating_lines
from dyntorch.scenes.scene import Scene
from dyntorch.scenes.space import collineation, constant_velocity, dynamic, moving_points, two_view
from dyntorch.scenes.streets import Street, StreetOptions, streets
from dyntorch.scenes.two_cameras import FilmedScene, NonrigidScene, filmed_person, nonrigid_pair

__all__ = [
    "FilmedScene",
    "LiftedScene",
    "NonrigidScene",
    "Scene",
    "Street",
    "StreetOptions",
    "TranslatingScene",
    "bodies",
    "collineation",
    "constant_velocity",
    "convergent_motions",
    "dynamic",
    "filmed_person",
    "lifted_points",
    "lines_concurrent",
    "moving_points",
    "nonrigid_pair",
    "planar",
    "streets",
    "translating_lines",
    "translating_planes",
    "two_view",
]

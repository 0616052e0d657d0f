"""``dyntorch count``: how many matches an invariant takes, exactly."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from indexing.cli.console import say, table

if TYPE_CHECKING:
    from dyntorch import counting

CONFINED = ("static", "on_plane", "on_line")
"""Kinds of matches that say less than others, of named configurations and of numbers."""
CONFINED_MORE = (
    "static_on_plane",
    "static_on_line",
    "labelled_static",
    "coplanar",
    "equal_velocity",
    "linear_velocity",
    "planar_velocity",
)
Number = Annotated[int | None, tyro.conf.arg(metavar="N", help_behavior_hint="")]
Numbers = Annotated[tuple[int, ...], tyro.conf.arg(metavar="N ...", help_behavior_hint="")]


@dataclass(frozen=True)
class Matches:
    """How many matches of each kind; with none of these, as many as raise the rank."""

    moving: Number = None
    """that move as the configuration lets them"""
    static: Number = None
    """that stay where they are, without anyone knowing it"""
    labelled_static: Number = None
    """that are known to stay where they are"""
    lines: Numbers = ()
    """moving points on each of several trajectory lines"""
    static_lines: Numbers = ()
    """static points on each of several lines"""
    static_points: Number = None
    """of dual_homography and lines: static points, through which all lines match"""
    translating: Number = None
    """of lines: each with a translation of its own"""
    objects: Numbers = ()
    """of lines and two_bodies: how many on each of several rigid objects that translate"""
    equal_velocity: Number = None
    """of constant velocities: all with the same one"""
    linear_velocity: Number = None
    """of constant velocities: along one direction"""
    planar_velocity: Number = None
    """of constant velocities in space: within one plane, such as cars on a road"""
    on_plane: Number = None
    """that stay on one plane of space, moving or not as the configuration lets them; of numbers (--k): in one hyperplane"""
    on_line: Number = None
    """that stay on one line"""
    static_on_plane: Number = None
    """that stand still on one plane of space"""
    static_on_line: Number = None
    """that stand still on one line"""
    dim: Number = None
    """of dynamic: dimension of the space (without it 3)"""
    poses: Number = None
    """of dynamic: how many views (without it 4)"""
    within: Number = None
    """of dynamic: points that span the flat in which a match moves: 2 is a line, 3 a plane (without it 3)"""
    coplanar: Number = None
    """of fundamental, trifocal and quadrifocal: static points of one plane"""
    images: Number = None
    """of shape_tensor, lifted_shape and dynamic_shape"""
    synthetic: tyro.conf.FlagCreatePairsOff[bool] = False
    """of the same: use the constraints that hold without any image"""
    points: Number = None
    """of shape_tensor: 6, 7 or 8 (without it 8) in each image; of lifted_shape (without it 8)"""
    space: Number = None
    """of lifted_shape: k of the projections P^k -> P^l (without it 4)"""
    image: Number = None
    """of lifted_shape: l of the projections P^k -> P^l (without it 2)"""
    degree: Number = None
    """of dynamic_shape: of the positions in the time (without it 1, constant velocity)"""
    coplanar_base: tyro.conf.FlagCreatePairsOff[bool] = False
    """of dynamic_shape: four of the six points stand still in a plane"""
    general: tyro.conf.FlagCreatePairsOff[bool] = False
    """of shape_tensor: points in general position, in place of four in a plane"""

    def given(self) -> dict[str, Any]:
        """The options that were given."""
        return {name: value for name, value in asdict(self).items() if value is not None and value is not False and value != ()}


@dataclass(frozen=True)
class Motion:
    """Of the motion models (constant_velocity_2d...): their views."""

    profile: Numbers = ()
    """hyperplanes used of each view, k + 1 in all, such as 2 2 1; also with --k"""
    times: Numbers = ()
    """of the views; by default random"""
    camera: Literal["generic", "fixed", "constant_velocity", "along"] = "generic"
    """path of the camera: anywhere, in one place (it may rotate), at constant velocity, or along the motion at constant velocity"""

    def given(self) -> dict[str, Any]:
        """The options that were given."""
        return {name: value for name, value in asdict(self).items() if value not in ((), "generic")}


@dataclass(frozen=True)
class General:
    """Instead of a name: a primitive that moves within an extensor of P^k, seen in several views."""

    k: Annotated[int | None, tyro.conf.arg(metavar="K", help_behavior_hint="")] = None
    """projective dimension of the space"""
    views: Numbers = ()
    """projective dimension of each view"""
    m: Annotated[int, tyro.conf.arg(metavar="M")] = 1
    """points that span the primitive: 1 point, 2 line"""
    r: Annotated[int, tyro.conf.arg(metavar="R")] = 1
    """points that span the extensor in which it moves: r = m stays, 2 is a line, 3 a plane"""
    measure: tuple[Literal["join", "hyper"], ...] = ("join",)
    """what a view sees: Pluecker coordinates (a point is a point) or the hyperplanes through it; once, or for each view"""
    matches: Number = None
    """how many; by default as many as raise the rank"""


@dataclass(frozen=True)
class Count:
    """Count how many matches an invariant takes, and the rank they reach: exactly, in a prime field.

    dyntorch count homography --moving 30 --static 2

    dyntorch count constant_velocity_3d --static 100 --camera fixed

    dyntorch count join --on-plane 10 --static 2

    dyntorch count dynamic --dim 2 --poses 5 --within 2

    dyntorch count --k 3 --views 2 2 2 2 --r 2

    dyntorch count --k 6 --profile 2 2 2 1

    dyntorch count --dim-v 3 3 2
    """

    configuration: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="[NAME]", help_behavior_hint="")] = ""
    """of an invariant, such as join, or of a motion model, such as constant_velocity_2d; without it, a table of all"""
    dim_v: Annotated[tuple[int, int, int] | None, tyro.conf.arg(metavar="N M K", help_behavior_hint="")] = None
    """print the dimension of V(n,m,k), the span of products of m vectors of n-space that lie in a common k-space"""
    json: tyro.conf.FlagCreatePairsOff[bool] = False
    """print JSON, with the rank after every match"""
    seed: int = 0
    """of the random matches; the ranks do not depend on it"""
    matches: Matches = field(default_factory=Matches)
    motion: Motion = field(default_factory=Motion)
    general: General = field(default_factory=General)

    def run(self) -> int:
        """Count, and print."""
        from dyntorch import counting

        given, general = self.matches.given(), self.general != General() or bool(self.motion.profile and not self.configuration)
        if not general:
            given |= self.motion.given()
        if (self.configuration != "") + general + (self.dim_v is not None) > 1:
            raise ValueError("a configuration's name, numbers (--k, --views...) and --dim-v exclude each other; give one of them")
        if given and not self.configuration and not (general and given.keys() <= set(CONFINED)):
            flag = "--" + next(iter(given)).replace("_", "-")
            raise ValueError(f"{flag} needs a configuration before it, one of {', '.join(counting.CONFIGURATIONS)}")
        if self.dim_v is not None:
            self._print_dimension(*self.dim_v)
        elif self.configuration:
            name = self.configuration.replace("-", "_")
            if name not in counting.CONFIGURATIONS:
                raise ValueError(f"unknown configuration {self.configuration!r}; known are {', '.join(counting.CONFIGURATIONS)}")
            result = counting.count(name, seed=self.seed, **given)
            self._print(result, purpose(name), unique="profile" in counting.options_of(name), most=self._most(name, given))
        elif general:
            self._print_general(given)
        else:
            results = [counting.count(name, seed=self.seed) for name in counting.CONFIGURATIONS]
            say(json.dumps([asdict(result) for result in results])) if self.json else overview(results)
        return 0

    def _print_dimension(self, n: int, m: int, k: int) -> None:
        from dyntorch import counting

        dimension = counting.dim_v(n, m, k)
        say(json.dumps({"n": n, "m": m, "k": k, "dim_v": dimension}) if self.json else f"dim V({n}, {m}, {k}) = {dimension}")

    def _most(self, name: str, given: dict[str, Any]) -> dict[str, int]:
        """How many matches of each kind that was given count at most."""
        from dyntorch import counting

        asked = [option for option in counting.options_of(name) if option in given and option in (*CONFINED, *CONFINED_MORE)]
        if not asked:
            return {}
        settings = {option: value for option, value in given.items() if option in ("profile", "points", "dim", "poses", "within")}
        found = counting.capacities(name, only=asked, seed=self.seed, **settings)
        return {capacity.option: capacity.matches for capacity in found}

    def _print_general(self, given: dict[str, Any]) -> None:
        from dyntorch import counting

        sizes = self.general.views or (2,) * len(self.motion.profile)
        if self.general.k is None or not sizes:
            raise ValueError("numbers need at least --k, the dimension of the space, and --views, such as --k 2 --views 2 2 2")
        numbers = asdict(self.general) | self.motion.given() | {"views": sizes} | given
        if len(self.general.measure) == 1:
            numbers["measure"] = self.general.measure[0]
        result = counting.count(numbers.pop("k"), seed=self.seed, **numbers)
        what = {1: "points", 2: "lines"}.get(self.general.m, f"extensors of {self.general.m} points")
        within = "that stay" if self.general.m == self.general.r else f"that move within extensors of {self.general.r} points"
        seen = ", ".join(f"P^{size}" for size in sizes)
        self._print(result, f"{what} of P^{self.general.k} {within}, views {seen}")

    def _print(self, result: counting.Count, heading: str, unique: bool = False, most: dict[str, int] | None = None) -> None:
        """Print a count; ``unique``: there is one tensor, unless the views are degenerate; ``most``: how many of a kind count."""
        if self.json:
            say(json.dumps(asdict(result) | ({"at_most": most} if most else {})))
            return
        say(heading)
        if len(result.kinds) > 1:
            rows = [[kind.name, kind.matches, kind.useful, kind.rank] for kind in result.kinds]
            table(["matches", "given ", "useful ", "rank so far "], rows)
        given = len(result.profile)
        taken = f"{result.minimal} of {given}" if result.minimal < given else f"{given}"
        say(f"rank {result.rank} of {result.width}, nullity {result.nullity}, from {taken} {plural(given)}")
        if unique and result.full is not None and result.full < result.width - 1:
            say(f"degenerate views: no matches exceed rank {result.full}, so they do not determine the tensor")
        elif result.missing:
            say(f"not enough: rank {result.full} takes {result.missing} more {plural(result.missing)} ({result.usual})")
        elif result.nullity == 0:
            say("no constraint: no tensor satisfies all matches")
        else:
            say("enough: more matches do not raise the rank")
        if most:
            say("at most " + ", ".join(f"{number} {kind.replace('_', ' ')}" for kind, number in most.items()) + " count")


def overview(results: list[counting.Count]) -> None:
    """A table of what each invariant takes."""
    rows = [[r.name, r.width, r.rank, r.nullity, r.minimal, r.usual, purpose(r.name).partition(":")[0]] for r in results]
    table(["configuration", "unknowns ", "rank ", "nullity ", "matches ", "kind", "of"], rows)


def purpose(name: str) -> str:
    """What a configuration is, in one line."""
    from dyntorch import counting

    return (counting.CONFIGURATIONS[name].__doc__ or name).splitlines()[0].removesuffix(".")


def plural(number: int) -> str:
    """The word for so many matches."""
    return "match" if number == 1 else "matches"

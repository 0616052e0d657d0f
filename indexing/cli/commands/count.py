"""``dyntorch count``: how many matches an invariant takes, exactly."""

from __future__ import annotations

import json
from dataclasses import asdict
from typing import Any

from dyntorch import counting
from indexing.cli.console import say, table
from indexing.cli.flags.geometry import Count, General

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


def run(flags: Count) -> int:
    """Count, and print."""
    given = flags.matches.as_options()
    general = flags.general != General() or bool(flags.motion.profile and not flags.configuration)
    if not general:
        given |= flags.motion.as_options()
    if (flags.configuration != "") + general + (flags.dim_v is not None) > 1:
        raise ValueError("a configuration's name, numbers (--k, --views...) and --dim-v exclude each other; give one of them")
    if given and not flags.configuration and not (general and given.keys() <= set(CONFINED)):
        flag = "--" + next(iter(given)).replace("_", "-")
        raise ValueError(f"{flag} needs a configuration before it, one of {', '.join(counting.CONFIGURATIONS)}")
    if flags.dim_v is not None:
        _print_dimension(flags, *flags.dim_v)
    elif flags.configuration:
        name = flags.configuration.replace("-", "_")
        if name not in counting.CONFIGURATIONS:
            raise ValueError(f"unknown configuration {flags.configuration!r}; known are {', '.join(counting.CONFIGURATIONS)}")
        result = counting.count(name, seed=flags.seed, **given)
        _print(flags, result, purpose(name), unique="profile" in counting.options_of(name), most=_max_counts(flags, name, given))
    elif general:
        _print_general(flags, given)
    else:
        results = [counting.count(name, seed=flags.seed) for name in counting.CONFIGURATIONS]
        say(json.dumps([asdict(result) for result in results])) if flags.json else overview(results)
    return 0


def _print_dimension(flags: Count, n: int, m: int, k: int) -> None:

    dimension = counting.dim_v(n, m, k)
    say(json.dumps({"n": n, "m": m, "k": k, "dim_v": dimension}) if flags.json else f"dim V({n}, {m}, {k}) = {dimension}")


def _max_counts(flags: Count, name: str, given: dict[str, Any]) -> dict[str, int]:
    """How many matches of each kind that was given count at most."""
    asked = [option for option in counting.options_of(name) if option in given and option in (*CONFINED, *CONFINED_MORE)]
    if not asked:
        return {}
    settings = {option: value for option, value in given.items() if option in ("profile", "points", "dim", "poses", "within")}
    found = counting.capacities(name, only=asked, seed=flags.seed, **settings)
    return {capacity.option: capacity.matches for capacity in found}


def _print_general(flags: Count, given: dict[str, Any]) -> None:

    sizes = flags.general.views or (2,) * len(flags.motion.profile)
    if flags.general.k is None or not sizes:
        raise ValueError("numbers need at least --k, the dimension of the space, and --views, such as --k 2 --views 2 2 2")
    numbers = asdict(flags.general) | flags.motion.as_options() | {"views": sizes} | given
    if len(flags.general.measure) == 1:
        numbers["measure"] = flags.general.measure[0]
    result = counting.count(numbers.pop("k"), seed=flags.seed, **numbers)
    what = {1: "points", 2: "lines"}.get(flags.general.m, f"extensors of {flags.general.m} points")
    within = "that stay" if flags.general.m == flags.general.r else f"that move within extensors of {flags.general.r} points"
    seen = ", ".join(f"P^{size}" for size in sizes)
    _print(flags, result, f"{what} of P^{flags.general.k} {within}, views {seen}")


def _print(flags: Count, result: counting.Count, heading: str, unique: bool = False, most: dict[str, int] | None = None) -> None:
    """Print a count; ``unique``: there is one tensor, unless the views are degenerate; ``most``: how many of a kind count."""
    if flags.json:
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
    return (counting.CONFIGURATIONS[name].__doc__ or name).splitlines()[0].removesuffix(".")


def plural(number: int) -> str:
    """The word for so many matches."""
    return "match" if number == 1 else "matches"

"""Minimal conditions on the matches of every invariant: how many on one line or plane, or standing still, count at most.

    python -m experiments.alignment.minimal_conditions

The thesis asks for them in section 10.1 ("up to 10 points on one hyperplane").  Exact ranks over prime fields, of random matches of
each kind by themselves and together with the usual ones; ``dyntorch count NAME --on-plane 10 --static 2`` answers for any mixture.
"""

from __future__ import annotations

from dyntorch import counting
from experiments.common.runner import BaseConfig, Tables, Words, experiment
from indexing.cli.commands.count import purpose

WORDS = {
    "static": "stand still, unknown",
    "labelled_static": "stand still, known",
    "static_points": "static points, through which all lines match",
    "on_plane": "stay on one plane",
    "on_line": "stay on one line",
    "static_on_plane": "stand still on one plane",
    "static_on_line": "stand still on one line",
    "equal_velocity": "move alike",
    "linear_velocity": "velocities along one direction",
    "planar_velocity": "velocities within one plane",
    "translating": "lines that only translate",
    "objects": "of one rigid object",
    "first": "of one body",
    "planar_first": "of one body, on one plane",
}
"""Kinds of the table, in this order; the others repeat one of them."""
OF_FIRST = {"segmentation": {"on_line": "of one body, on one line"}, "shape_tensor": {}}
CENTRES = {"on_plane": "camera centres on one plane", "on_line": "camera centres on one line"}


def rows(name: str) -> list[tuple[str, ...]]:
    """Of one configuration: each kind, how many count, the rank they reach, and what is missing beside them."""
    words = WORDS | OF_FIRST.get(name, {}) | (CENTRES if name == "shape_tensor" else {})
    usual, *_ = counting.options_of(name)
    found = {capacity.option: capacity for capacity in counting.capacities(name)}
    first = found[usual]
    table: list[tuple[str, ...]] = [(name, f"general ({usual})", f"{first.matches}", f"{first.rank} of {first.rank}", "0")]
    for option, word in words.items():
        if option in found and option != usual:
            capacity = found[option]
            table.append(("", word, f"{capacity.matches}", f"{capacity.rank} of {first.rank}", f"{capacity.missing}"))
    return table


@experiment(BaseConfig())
def tables(_: BaseConfig) -> Tables:
    """Every configuration, and what each of them is."""
    head = ("configuration", "matches that", "count at most", "rank by themselves", "general ones needed besides")
    yield "Minimal conditions", Words(head, [row for name in counting.CONFIGURATIONS for row in rows(name)])
    yield "Configurations", Words(("configuration", "of"), [(name, purpose(name)) for name in counting.CONFIGURATIONS])

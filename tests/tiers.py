"""The two tiers of the tests: what takes .3 s of processor time or more is marked slow, and this plugin sees to it.

``make test`` runs the fast ones, ``make test-all`` everything.  Processor time counts, of children too, never time on the clock: a
busy machine fails no test.
"""

from __future__ import annotations

import os
from collections.abc import Generator

import pytest

SLOW_FROM = 0.3
"""Seconds of the processor from which on a test is to be marked."""
TOO_SLOW = 2.0
"""Seconds from which on an unmarked test fails: it would be slow on any machine.  Not with the arithmetic of another processor,
which takes several times as long."""
SLOW_EXAMPLES = (
    "dyntorch.counting.ranks.count",
    "dyntorch.tasks.align.planar.align_planar",
    "dyntorch.tasks.calibrate.calibrate.calibrate",
    "dyntorch.tasks.pair.pair.reconstruct_pair",
    "dyntorch.tasks.pair.result.PairReconstruction.images",
    "dyntorch.tasks.segment.tracks.segment_tracks",
    "dyntorch.tasks.synchronize.breaks.breaks",
    "dyntorch.tasks.synchronize.breaks.camera_breaks",
    "dyntorch.tasks.trajectories.trajectories.trajectory_cameras",
    "indexing.sync.brightness.brightness_shift",
    "indexing.sync.synchronize.synchronize",
)
"""Examples in docstrings, which no decorator can mark."""


def processor_seconds() -> float:
    """Of this process and of the children that it has waited for."""
    times = os.times()
    return times.user + times.system + times.children_user + times.children_system


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    for item in items:
        if isinstance(item, pytest.DoctestItem) and item.name in SLOW_EXAMPLES:
            item.add_marker("slow")


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call(item: pytest.Item) -> Generator[None, object, object]:
    begun = processor_seconds()
    result = yield
    seconds = processor_seconds() - begun
    if item.get_closest_marker("slow") is None:
        item.user_properties.append(("processor_seconds", seconds))
        if seconds > TOO_SLOW and "ATEN_CPU_CAPABILITY" not in os.environ:
            pytest.fail(f"{seconds:.1f} s of the processor: mark it @pytest.mark.slow, or make it faster", pytrace=False)
    return result


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    times = [
        (dict(report.user_properties).get("processor_seconds", 0.0), report.nodeid)
        for report in terminalreporter.stats.get("passed", [])
    ]
    slow = sorted((pair for pair in times if pair[0] >= SLOW_FROM), reverse=True)
    if slow:
        terminalreporter.write_sep("-", f"not marked slow, {SLOW_FROM} s of the processor or more")
        for seconds, name in slow[:40]:
            terminalreporter.write_line(f"{seconds:6.2f} s  {name}")

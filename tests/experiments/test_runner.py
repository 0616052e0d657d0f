"""The runner: tables are printed, compared with their goals and written; and every experiment, once, in its smallest setting."""

from __future__ import annotations

import importlib
import json
import os
import pkgutil
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, fields, replace
from pathlib import Path

import numpy as np
import pytest
import torch

import experiments
from experiments.common import runner
from experiments.common.runner import BaseConfig, Experiment, Grid, SceneConfig, Tables, Words, experiment
from experiments.common.tables import Row, markdown
from experiments.common.timing import interleaved, threads

SMALL = ("scenes", "seeds", "trials", "rigs", "draws", "rounds", "repeats", "cases", "crowds", "windows", "starts")
"""Fields that say how often something is drawn or timed."""
SLOWER = {
    "experiments.archive.growth": "archives of many hours",
    "experiments.archive.killed": "processes that are killed",
    "experiments.labels.story": "a story from end to end",
    "experiments.archive.moments": "300,000 windows at least",
    "experiments.benchmarks.action_indexer": "an hour of keypoints",
    "experiments.benchmarks.first_answers": "verbs in processes of their own",
}
"""What has no small setting."""
SMOKE_SECONDS = 4.0
"""Of the processor that an experiment may take."""
PACKAGES = ("aeon", "DYNTORCH_DATA", "models", "no such file")
"""What a machine may lack, as the error says it."""


@dataclass(frozen=True)
class Config(SceneConfig):
    """Something to measure."""

    noises: tuple[float, ...] = (0.5, 1.0)
    """Pixels."""


@experiment(Config(scenes=40), quick={"scenes": 3})
def tables(config: Config) -> Tables:
    """One table of each kind."""
    yield "errors", [Row("linear", f"{noise:g} px", noise * config.scenes, 30.0, at_most=True) for noise in config.noises]
    yield "words", Words(("a", "b"), [("1", "2")])
    yield "grid", Grid(["x", "y"], {"ours": [0.5, np.nan], "theirs": ["-", 12.0]}, [Row("t", "s", 0.5, 0.4)])
    yield "", "two\nlines"
    yield "dot", b"PNG"


def test_tables_are_printed_compared_and_written(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    tables.run(tables.configure(["--out", str(tmp_path)]), "some")
    printed = capsys.readouterr().out
    assert "### errors" in printed and "| <= 30 | NO" in printed and "2 of 3 goals reached" in printed and "two\nlines" in printed
    written = json.loads((tmp_path / "some.json").read_text())
    assert written["manifest"]["arguments"]["scenes"] == 40 and written["manifest"]["arguments"]["noises"] == [0.5, 1.0]
    assert [row["reached"] for row in written["tables"]["errors"]] == [True, False]
    assert written["tables"]["words"] == [{"a": "1", "b": "2"}]
    assert written["tables"]["grid"]["lines"]["ours"] == [0.5, None]
    assert (tmp_path / "dot.png").read_bytes() == b"PNG"


def test_flags_are_the_fields_and_quick_is_smaller(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    assert tables.configure([]) == Config(scenes=40)
    assert tables.configure(["--quick"]) == Config(scenes=3, quick=True)
    assert tables.configure(["--quick", "--scenes", "5", "--noises", "2"]) == Config(scenes=5, quick=True, noises=(2.0,))
    # bad input is one line and exit code 2
    monkeypatch.setattr(runner.sys, "argv", ["some", "--scenes", "0"])
    with pytest.raises(SystemExit) as stopped:
        tables.main()
    assert stopped.value.code == 2 and capsys.readouterr().err == "error: --scenes must be at least 1, got 0\n"


def test_torch_has_one_thread_unless_told_otherwise(tmp_path: Path) -> None:
    def counted(_: BaseConfig) -> Tables:
        yield "threads", [Row("", "", torch.get_num_threads())]

    with threads(2):
        for one_thread, count in ((True, 1), (False, 2)):
            made = Experiment(counted, BaseConfig(out=tmp_path), {}, one_thread)
            made.run(made.default, "threads")
            assert json.loads((tmp_path / "threads.json").read_text())["tables"]["threads"][0]["measured"] == count
        assert torch.get_num_threads() == 2


def test_goals_are_compared_unrounded_and_rows_are_markdown() -> None:
    lower, upper = (Row("UTKinect", "turned 0", 0.9, 0.9), Row("t", "s", 0.1, 0.2, at_most=True, unit=" s"))
    rows = (lower, replace(lower, measured=0.8999), upper, replace(upper, measured=0.3), Row("t", "s", 0.1))
    assert [row.reached for row in rows] == [True, False, True, False, None]
    lines = markdown(rows[:3]).splitlines()
    assert len({line.count("|") for line in lines}) == 1 and "yes" in lines[2] and "NO" in lines[3] and "<= 0.200 s" in lines[4]


def test_candidates_take_turns_and_the_median_counts() -> None:
    order: list[str] = []
    jobs: dict[str, Callable[[], object]] = {name: (lambda name=name: order.append(name)) for name in "ab"}  # type: ignore[misc]
    seconds = interleaved(jobs, rounds=3)
    assert order == ["a", "b"] * 4 and set(seconds) == {"a", "b"} and all(value >= 0 for value in seconds.values())


def every_experiment() -> Iterator[str]:
    """Modules whose function ``tables`` the runner runs."""
    for module in pkgutil.walk_packages(experiments.__path__, "experiments."):
        text = Path(module.module_finder.path, f"{module.name.rpartition('.')[2]}.py")  # type: ignore[union-attr]
        if text.exists() and "\n@experiment(" in text.read_text(encoding="utf-8"):
            yield module.name


class LongEnoughError(BaseException):
    """Raised where an experiment has run for as long as the test wants it to."""


@contextmanager
def processor_limit(seconds: float) -> Iterator[None]:
    """Ends what runs after so many seconds of the processor."""

    def stop(*_: object) -> None:
        raise LongEnoughError

    before = signal.signal(signal.SIGPROF, stop)
    signal.setitimer(signal.ITIMER_PROF, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        signal.signal(signal.SIGPROF, before)


def smallest(made: Experiment[BaseConfig], out: Path) -> BaseConfig:
    """The quick configuration, everything once."""
    config = replace(made.default, quick=True, out=out, **made.quick)
    once = {field.name: 1 for field in fields(config) if field.name in SMALL and type(getattr(config, field.name)) is int}
    return replace(config, **once)


@pytest.mark.slow
@pytest.mark.parametrize("name", list(every_experiment()))
def test_every_experiment_begins(name: str, tmp_path: Path) -> None:
    """Its first table comes out, or it runs for some seconds without an error."""
    if name in SLOWER:
        pytest.skip(SLOWER[name])
    made = importlib.import_module(name).tables
    assert isinstance(made, Experiment)
    config = smallest(made, tmp_path)
    for field in fields(config):
        if field.name in ("answers", "picture"):
            config = replace(config, **{field.name: tmp_path / field.name})
    try:
        with threads(1), processor_limit(SMOKE_SECONDS):
            _, table = next(iter(made.tables(config)))
    except LongEnoughError:
        return
    except ValueError as problem:
        if any(word in str(problem) for word in PACKAGES) or not os.environ.get("DYNTORCH_DATA"):
            pytest.skip(str(problem))
        raise
    assert not isinstance(table, bytes) and runner.text_of(table)

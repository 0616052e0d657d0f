"""Whoever is killed, interrupted or out of space leaves a whole archive; and whoever does the work, the answers are the same."""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.numpy import load_file

from experiments.archive import killed
from experiments.archive.killed import Deadly, Stage, Trial, aftermath, contents, readable
from indexing import ActionIndexer, Archive, Clip, ClipSet
from indexing.actors import Person, dataset, detect, stream
from indexing.archive import workers
from indexing.archive.workers import InOrder, WorkerLost

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="signals and forked servers are those of Unix")
resource = pytest.importorskip("resource", reason="limits are those of Unix")


@pytest.fixture(scope="module")
def stage(tmp_path_factory: pytest.TempPathFactory) -> Stage:
    """Files to add, and an archive that holds others."""
    return Stage.build(tmp_path_factory.mktemp("stage") / "lab", 6, 4.0)


@pytest.fixture
def quick_pool(monkeypatch: pytest.MonkeyPatch) -> Callable[[int], Executor]:
    """Processes that need not import everything first, here and where broken ones are replaced."""

    def make(workers: int | None = None) -> Executor:
        return ProcessPoolExecutor(workers, mp_context=killed.forkserver())

    monkeypatch.setattr(workers, "QuietProcesses", make)
    return make


def unharmed(trials: Sequence[Trial]) -> None:
    """Nothing lost, nothing twice, nothing unreadable, the same hits as if nothing had been."""
    for trial in trials:
        assert trial.problems == () and trial.lost == trial.twice == 0 and not trial.changed, trial


# ---- adders --------------------------------------------------------------------------------------------------------------
@pytest.mark.slow
def test_killed_adders_leave_an_archive(stage: Stage) -> None:
    trials = killed.killed(stage, 3, np.random.default_rng(1))
    unharmed(trials)
    assert any(trial.disturbed for trial in trials)


@pytest.mark.slow
def test_an_adder_killed_between_segment_and_catalogue_leaves_a_file(stage: Stage, monkeypatch: pytest.MonkeyPatch) -> None:
    from indexing.archive import writer

    def dies(*given: object) -> None:
        raise SystemExit  # as far as one process can die and still be asked

    folder = stage.copy()
    with monkeypatch.context() as patch:
        patch.setattr(writer.Adder, "_enter", dies)
        patch.setattr(writer, "remove_orphans", lambda catalogue: None)
        with pytest.raises(SystemExit):
            Archive(folder).add(stage.new)
    assert len(Archive(folder).verify().orphans) == 1 and len(contents(folder)) == len(stage.earlier)
    unharmed([aftermath(stage, folder, disturbed=True)])


@pytest.mark.slow
def test_an_adder_killed_while_tidying_leaves_both(stage: Stage, monkeypatch: pytest.MonkeyPatch) -> None:
    from indexing.archive import writer

    def dies(*given: object) -> None:
        raise SystemExit

    def until(*given: Any) -> None:
        monkeypatch.setattr(writer, "_unlink", dies)
        tidy(*given)

    folder, tidy = stage.copy(), writer.tidy
    monkeypatch.setattr(writer, "tidy", until)
    with pytest.raises(SystemExit):
        Archive(folder, killed.OPTIONS).add(stage.new)
    monkeypatch.undo()
    found = Archive(folder).verify()
    assert found.ok and found.segments == 1 and found.orphans and contents(folder) == stage.expected[0]
    unharmed([aftermath(stage, folder, disturbed=True)])


def test_two_adders_at_once_add_everything_once(stage: Stage) -> None:
    unharmed(killed.at_once(stage, 1, np.random.default_rng(3)))


@pytest.mark.slow
def test_who_asks_while_somebody_adds_is_answered(stage: Stage) -> None:
    unharmed(killed.asked_meanwhile(stage, 1, np.random.default_rng(4)))


# ---- a full disk ---------------------------------------------------------------------------------------------------------
@pytest.mark.slow
def test_files_that_may_not_grow_are_one_line(stage: Stage) -> None:
    """As on a full disk, where nobody may mount one: no file may be larger than one segment is."""
    folder, before = stage.copy(), resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    small = min(path.stat().st_size for path in (folder / "segments").iterdir()) // 2
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (small, before[1]))
        with pytest.raises(ValueError, match=r"File too large|disk I/O error|disk is full") as raised:
            Archive(folder, killed.OPTIONS).add(stage.new)
        found = readable(stage, folder)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        signal.signal(signal.SIGXFSZ, handler)
    assert "\n" not in str(raised.value) and str(folder) in str(raised.value) and found == []
    unharmed([aftermath(stage, folder, disturbed=True)])


# ---- workers -------------------------------------------------------------------------------------------------------------
def test_a_source_that_kills_its_workers_costs_no_other(
    tmp_path: Path, moves: Callable[..., Clip], quick_pool: Callable[[int], Executor]
) -> None:
    clips = [moves(number, name=f"{number}") for number in range(4)]
    deadly = Deadly(moves(9).joints, name="deadly")
    archive = Archive(tmp_path / "a")
    with quick_pool(1) as pool:
        done = archive.add([*clips[:2], deadly, *clips[2:]], executor=pool)
    assert [one.outcome for one in done.sources] == ["added", "added", "failed", "added", "added"]
    (failed,) = done.failures
    assert failed.source == "deadly" and failed.reason.startswith("deadly: no worker could do it in 3 tries (BrokenProcessPool")
    assert failed.reason.endswith("leave it out, or give its worker more memory") and "\n" not in failed.reason
    assert [row.source for row in archive.recordings()] == list("0123") and archive.verify().ok
    assert archive.add(deadly).of("added")  # who is not sent it is not killed


class Unsteady(Executor):
    """Loses every task of some names, as often as it is asked to, then does it; counts."""

    def __init__(self, losses: dict[int, int]) -> None:
        self.losses, self.asked = losses, list[int]()

    def submit(self, function: Callable[..., object], /, *given: int, **options: object) -> Future:  # type: ignore[override, type-arg]
        future: Future[object] = Future()
        self.asked.append(given[0])
        if self.losses.get(given[0], 0) > 0:
            self.losses[given[0]] -= 1
            future.set_exception(ConnectionError("a worker\nis gone"))
        else:
            future.set_result(function(*given))
        return future


def test_a_task_is_tried_again_and_results_keep_their_order() -> None:
    executor = Unsteady({2: 1, 5: 2, 7: 9})
    found = list(InOrder(lambda task: task * 10, executor, tries=3)(range(9)))
    assert [task for task, _ in found] == list(range(9))
    assert [result for task, result in found if task != 7] == [0, 10, 20, 30, 40, 50, 60, 80]
    lost = found[7][1]
    assert isinstance(lost, WorkerLost) and str(lost) == "no worker could do it in 3 tries (ConnectionError: a worker is gone)"
    assert sorted(executor.asked) == [0, 1, 2, 2, 3, 4, 5, 5, 5, 6, 7, 7, 7, 8]


def test_few_tasks_are_under_way_at_once() -> None:
    taken: list[int] = []

    def tasks() -> Iterator[int]:
        for number in range(200):
            taken.append(number)
            yield number

    results = InOrder(abs, Unsteady({}), ahead=2)(tasks())
    assert next(results) == (0, 0) and len(taken) < 50
    assert [result for _, result in results] == list(range(1, 200))


def test_an_executor_that_has_ended_is_said(tmp_path: Path, moves: Callable[..., Clip]) -> None:
    pool = ThreadPoolExecutor(1)
    pool.shutdown()
    done = Archive(tmp_path / "a").add(moves(0, name="x"), executor=pool)
    assert done.failures[0].reason.startswith(
        "x: no worker could do it in 3 tries (RuntimeError: cannot schedule new futures after"
    )


def test_whoever_stops_leaves_no_tasks_behind() -> None:
    gate, begun = threading.Event(), list[int]()

    def slow(task: int) -> int:
        begun.append(task)
        if task:
            gate.wait(10)
        return task

    with ThreadPoolExecutor(1) as pool:
        results = InOrder(slow, pool)(range(20))
        assert next(results) == (0, 0)
        results.close()  # type: ignore[attr-defined]
        gate.set()
    assert begun in ([0], [0, 1])


# ---- whoever does it -----------------------------------------------------------------------------------------------------
ACTIONS = ("squat", "kick", "wave")


@pytest.fixture(scope="module")
def laboratory(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, ActionIndexer, Clip]:
    """Recordings of three actions, what was learned of these, and an example."""
    folder = tmp_path_factory.mktemp("laboratory")
    (folder / "week").mkdir()
    for number in range(3):
        solid, _ = stream([ACTIONS[(number + j) % 3] for j in range(3)], Person.random(5 + number), rng=number)
        ClipSet([detect(solid, azimuth=40.0 * number, rng=number)]).save(folder / "week" / f"{number}.npz")
    lesson = dataset([Person.random(1)], ACTIONS, azimuth=0.0, rng=0)
    return folder, ActionIndexer().fit(lesson), lesson[1]


@pytest.fixture(scope="module")
def in_process(laboratory: tuple[Path, ActionIndexer, Clip]) -> tuple[Archive, list[object]]:
    """What one process answers by itself."""
    folder, model, query = laboratory
    archive = Archive(folder / "alone")
    archive.add(folder / "week")
    return archive, [archive.search(query, k=8), archive.find(model)]


def _same(
    folder: Path, executor: Executor, laboratory: tuple[Path, ActionIndexer, Clip], alone: tuple[Archive, list[object]]
) -> None:
    """Add, search and find by others, and compare bit for bit."""
    (home, model, query), (one, answers) = laboratory, alone
    archive = Archive(folder)
    done = archive.add(home / "week", executor=executor)
    assert len(done.of("added")) == 3 and archive.recordings() == one.recordings()
    first, second = (load_file(next((each.path / "segments").iterdir())) for each in (archive, one))
    assert first.keys() == second.keys() and all(first[name].tobytes() == second[name].tobytes() for name in first)
    assert [archive.search(query, k=8, executor=executor), archive.find(model, executor=executor)] == answers
    assert len(answers[1]) >= 6  # type: ignore[arg-type]


@pytest.mark.slow
def test_processes_answer_the_same(tmp_path: Path, laboratory, in_process) -> None:
    with workers.QuietProcesses(1) as pool:
        _same(tmp_path / "a", pool, laboratory, in_process)


@pytest.mark.slow
def test_threads_answer_the_same(tmp_path: Path, laboratory, in_process) -> None:
    before = torch.get_num_threads()
    with ThreadPoolExecutor(3) as threads:
        _same(tmp_path / "a", threads, laboratory, in_process)
    assert torch.get_num_threads() == before


def test_a_broken_pool_is_replaced(tmp_path: Path, quick_pool: Callable[[int], Executor], laboratory, in_process) -> None:
    with quick_pool(2) as broken:
        with pytest.raises(Exception, match="terminated abruptly"):
            broken.submit(signal.raise_signal, signal.SIGKILL).result()
        archive = Archive(tmp_path / "a")
        assert len(archive.add(laboratory[0] / "week", executor=broken).of("added")) == 3
        assert archive.search(laboratory[2], k=8, executor=broken) == in_process[1][0]


def test_an_interruption_while_a_process_starts_is_not_lost() -> None:
    after: list[str] = []

    def start() -> None:
        with workers._interruptions_later():
            signal.raise_signal(signal.SIGINT)
            after.append("the block went on")

    with pytest.raises(KeyboardInterrupt):
        start()
    assert after and signal.getsignal(signal.SIGINT) is signal.default_int_handler

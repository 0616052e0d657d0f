"""Whoever does the work: this process, a pool of processes, a cluster; anything with the interface of ``concurrent.futures``.

Results come in the order of the tasks, whoever is quicker.  A worker that dies costs another try of the task that killed it.
"""

from __future__ import annotations

import itertools
import multiprocessing
import os
import signal
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Executor, Future, ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, TypeVar

MIN_TASKS_AHEAD = 32  # nobody says how many workers a cluster has


Task = TypeVar("Task")
Result = TypeVar("Result")


class WorkerLost(Exception):
    """A task's workers died every time, or the task did not reach one."""


def check_done(path: Path, result: Result | WorkerLost) -> Result:
    """The result; raises where nobody could search a segment, FileNotFoundError where its file went meanwhile."""
    if isinstance(result, WorkerLost):
        if not path.exists():
            raise FileNotFoundError(str(path))
        raise ValueError(f"{path}: could not be searched: {result}; try again, or with fewer workers")
    return result


class QuietProcesses(ProcessPoolExecutor):
    """Processes of one thread each, started afresh, that leave an interruption to the process that asked, which ends them."""

    def __init__(self, workers: int | None = None) -> None:
        super().__init__(workers or os.cpu_count() or 1, multiprocessing.get_context("spawn"), initializer=_use_one_thread)

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """As of any pool; a process starts here, where none is idle, and takes after this one."""
        with _interruptions_later():
            return super().submit(fn, *args, **kwargs)


def _use_one_thread() -> None:
    """One thread: the others are the other workers'.  Whoever interrupts means the process that asked."""
    import torch

    signal.signal(signal.SIGINT, signal.SIG_IGN)
    torch.set_num_threads(1)


@contextmanager
def _interruptions_later() -> Iterator[None]:
    """Ctrl-C waits until the block has ended; processes that start in it do not listen to it."""
    if threading.current_thread() is not threading.main_thread():  # no other may say so
        yield
        return
    waiting: list[int] = []
    before = signal.signal(signal.SIGINT, lambda number, frame: waiting.append(number))
    blocked = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT}) if hasattr(signal, "pthread_sigmask") else None
    try:
        yield
    finally:
        if blocked is not None:
            signal.pthread_sigmask(signal.SIG_SETMASK, blocked)
        signal.signal(signal.SIGINT, before)
    if waiting:
        signal.raise_signal(signal.SIGINT)


@dataclass
class _Pending(Generic[Task]):
    task: Task
    future: Future[Any] | None = None
    tries: int = 0


class InOrder(Generic[Task, Result]):
    """Tasks done by an executor, results in the order of the tasks."""

    def __init__(self, function: Callable[[Task], Result], executor: Executor | None, ahead: int = 4, tries: int = 3) -> None:
        self._function, self._executor, self._tries = function, executor, tries
        self._ahead = max(MIN_TASKS_AHEAD, ahead * int(getattr(executor, "_max_workers", 0) or 0))
        self._own: Executor | None = None  # in the place of one that broke

    def __call__(self, tasks: Iterable[Task]) -> Iterator[tuple[Task, Result | WorkerLost]]:
        """Each task with its result, or with what kept it from having one."""
        if self._executor is None:
            for task in tasks:
                yield task, self._function(task)
            return
        waiting, rest = deque[_Pending[Task]](), iter(tasks)
        try:
            while True:
                for task in itertools.islice(rest, self._ahead - len(waiting)):
                    waiting.append(_Pending(task))
                    self._submit(waiting[-1])
                if not waiting:
                    return
                first = waiting.popleft()
                yield first.task, self._result(first, waiting)
        finally:
            for one in waiting:
                if one.future is not None:
                    one.future.cancel()
            if self._own is not None:
                self._own.shutdown(wait=False, cancel_futures=True)

    def _submit(self, one: _Pending[Task]) -> Exception | None:
        """Send a task out; what the executor says where it takes none: it is asked again when the task's turn comes."""
        assert self._executor is not None
        one.future = None
        try:
            one.future = self._executor.submit(self._function, one.task)
        except Exception as problem:  # broken, shut down, disconnected: every executor has words of its own
            return problem
        return None

    def _result(self, one: _Pending[Task], others: Iterable[_Pending[Task]]) -> Result | WorkerLost:
        """Of one task; where its worker died it is tried again by itself, and the others are sent out anew."""
        problem: BaseException | None = None
        while one.tries < self._tries:
            try:
                if one.future is not None:
                    return one.future.result()
            except Exception as error:  # whatever an executor raises: the function's own failures are results
                problem = error
                one.tries += 1
            self._renew(others)
            if one.tries < self._tries:
                refusal = self._submit(one)
                if refusal is not None:
                    problem = refusal
                    one.tries += 1
        said = " ".join(f"{type(problem).__name__}: {problem}".split())
        return WorkerLost(f"no worker could do it in {self._tries} tries ({said})")

    def _renew(self, others: Iterable[_Pending[Task]]) -> None:
        """Another pool where this one is broken; what it had not done is waited for by nobody until its turn comes."""
        pool = self._executor
        if not isinstance(pool, ProcessPoolExecutor) or not getattr(pool, "_broken", False):
            return
        if self._own is not None:
            self._own.shutdown(wait=False, cancel_futures=True)
        workers = int(getattr(pool, "_max_workers", 1))
        self._executor = self._own = QuietProcesses(workers)
        for other in others:
            future = other.future
            if future is not None and not (future.done() and not future.cancelled() and future.exception() is None):
                other.future = None  # what is done is not done again

"""Speed and accuracy of batched null spaces, beside ``torch.linalg.svd`` in float64 and the goals.  Needs no data.

    python -m experiments.benchmarks.null_space            # about two minutes
    python -m experiments.benchmarks.null_space --quick    # does it run at all

Matrices of 200 rows whose singular values fall from 1 to 1/50, with a null space 0.02 to 0.3 below the last of them, as
normalized image measurements give; and minimal samples of exactly D - 1 rows.  The two sides of every ratio take turns in one
process and the figure is the ratio of their medians: CPU time on one thread, wall time on accelerators.  The gain of several
threads compares the best wall times, because other processes on the machine take cores away.  The error is the largest angle
to the null space of the SVD over the batch.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from statistics import median

import torch
from torch import Tensor

from dyntorch.numerics.nullspace import gram_null_space, null_space
from experiments.common.runner import BaseConfig, Tables, Words, experiment
from experiments.common.tables import note

ANGLE = 1e-10
ROWS = 200
SOLVE, MINIMAL, BACKWARD, GRAM = "null space", "D - 1 rows", "forward + backward", "Gram given"


CLOCK_TICK = 1e-7  # seconds: processor time of a tiny batch can read as 0


@dataclass(frozen=True)
class Config(BaseConfig):
    """Speed and accuracy of batched null spaces."""

    batch: int = 1024
    """Problems per call."""
    rounds: int = 7
    """How often the two sides take turns."""


@dataclass(frozen=True)
class Case:
    """One comparison: what is done to matrices of D columns, and how much faster it should be than the SVD."""

    task: str
    size: int
    dim: int = 1
    goal: float | None = None

    @property
    def rows(self) -> int:
        return self.size - self.dim if self.task == MINIMAL else ROWS


@dataclass(frozen=True)
class Figure:
    """A comparison measured: microseconds per problem of both sides, their ratio, and the error."""

    task: str
    where: str
    size: int
    dim: int
    reference: float
    ours: float
    angle: float
    goal: float | None

    @property
    def ratio(self) -> float:
        return self.reference / max(self.ours, CLOCK_TICK)

    @property
    def reached(self) -> bool | None:
        """Whether speed and accuracy reach the goal; ``None`` where there is none."""
        return None if self.goal is None else self.ratio >= self.goal and self.angle <= ANGLE


ONE_THREAD = (
    Case(SOLVE, 9),
    *(Case(SOLVE, size, goal=18.0) for size in (27, 36, 64, 81)),
    Case(SOLVE, 64, dim=4),
    *(Case(GRAM, size) for size in (27, 64)),
    *(Case(MINIMAL, size, goal=6.0) for size in (9, 27, 36, 64)),
    Case(BACKWARD, 27, goal=3.0),
    Case(BACKWARD, 64),
)
SEVERAL_THREADS = (Case(SOLVE, 27, goal=1.8), Case(SOLVE, 64, goal=1.8), Case(MINIMAL, 27))
CUDA = (*(Case(SOLVE, size) for size in (27, 64)), Case(MINIMAL, 27), Case(BACKWARD, 27))


def matrices(case: Case, batch: int) -> Tensor:
    """``(batch, rows, D)`` with the spectrum of normalized measurements."""
    generator = torch.Generator().manual_seed(case.size)

    def random(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    count = min(case.rows, case.size)
    signal = torch.logspace(0.0, -torch.log10(torch.tensor(50.0)).item(), case.size - case.dim, dtype=torch.float64)
    ratio = 0.02 * 15.0 ** torch.rand(batch, 1, generator=generator, dtype=torch.float64)
    null = signal[-1] * ratio * torch.linspace(1.0, 0.5, case.dim, dtype=torch.float64)
    spectrum = torch.cat([signal.expand(batch, -1), null], dim=-1)[:, None, :count]
    left, right = (torch.linalg.qr(random(batch, n, count)).Q for n in (case.rows, case.size))
    product: Tensor = (left * spectrum) @ right.mT
    return product


def svd_null_space(matrix: Tensor, dim: int) -> Tensor:
    """What everybody writes; the full matrix of vectors only where the rows do not suffice, elsewhere it is much slower."""
    rows, size = matrix.shape[-2:]
    basis: Tensor = torch.linalg.svd(matrix, full_matrices=rows < size).Vh[:, -dim:]
    return basis


def backward(solve: Callable[[Tensor, int], Tensor], matrix: Tensor, dim: int) -> Tensor:
    """Solve, and the gradient of a function of the projector."""
    leaf = matrix.detach().requires_grad_()
    basis = solve(leaf, dim)
    basis.square()[..., 0].sum().backward()
    return basis.detach()


def sides(case: Case, matrix: Tensor) -> tuple[Callable[[], Tensor], Callable[[], Tensor]]:
    """The reference and ours."""
    if case.task == GRAM:
        gram = matrix.mT @ matrix
        return lambda: torch.linalg.eigh(gram).eigenvectors[..., : case.dim].mT, lambda: gram_null_space(gram, case.dim).basis
    if case.task == BACKWARD:
        return lambda: backward(svd_null_space, matrix, case.dim), lambda: backward(null_space, matrix, case.dim)
    return lambda: svd_null_space(matrix, case.dim), lambda: null_space(matrix, case.dim)


def alternate(
    first: Callable[[], Tensor],
    second: Callable[[], Tensor],
    rounds: int,
    clock: Callable[[], float],
    typical: Callable[[list[float]], float] = median,
) -> tuple[float, float, Tensor, Tensor]:
    """Typical seconds of both, taking turns, and what they returned."""
    results = first(), second()
    seconds: tuple[list[float], list[float]] = [], []
    for _ in range(rounds):
        for function, taken in zip((first, second), seconds, strict=True):
            start = clock()
            function()
            taken.append(clock() - start)
    return typical(seconds[0]), typical(seconds[1]), *results


def angle(basis: Tensor, expected: Tensor) -> float:
    """Largest sine of the angle between row spaces."""
    return float((basis - basis @ expected.mT @ expected).norm(dim=(-2, -1)).max())


def on_one_thread(case: Case, config: Config) -> Figure:
    """Against the SVD (or eigh, for a Gram) in CPU time."""
    matrix = matrices(case, config.batch)
    reference, ours, expected, basis = alternate(*sides(case, matrix), config.rounds, time.process_time)
    return figure(case, "1 thread", config, reference, ours, angle(basis, expected))


def on_threads(case: Case, threads: int, config: Config) -> Figure:
    """Ours on one thread against ours on several, in wall time."""
    matrix = matrices(case, config.batch)

    def run(count: int) -> Tensor:
        torch.set_num_threads(count)
        return null_space(matrix, case.dim)

    one, several = (lambda: run(1)), (lambda: run(threads))
    reference, ours, expected, basis = alternate(one, several, 5 * config.rounds, time.perf_counter, min)
    torch.set_num_threads(1)
    return figure(case, f"{threads} threads / 1", config, reference, ours, angle(basis, expected))


def on_cuda(case: Case, config: Config) -> Figure:
    """Against the SVD on the same device, in wall time between synchronizations."""

    def clock() -> float:
        torch.cuda.synchronize()
        return time.perf_counter()

    matrix = matrices(case, config.batch).cuda()
    reference, ours, expected, basis = alternate(*sides(case, matrix), config.rounds, clock)
    return figure(case, torch.cuda.get_device_name(), config, reference, ours, angle(basis, expected))


def figure(case: Case, where: str, config: Config, reference: float, ours: float, error: float) -> Figure:
    scale = 1e6 / config.batch
    goal = None if config.quick else case.goal
    return Figure(case.task, where, case.size, case.dim, reference * scale, ours * scale, error, goal)


def measure(config: Config) -> list[Figure]:
    """All comparisons this machine can make."""
    threads = torch.get_num_threads()
    cores = min(threads if threads > 1 else os.cpu_count() or 1, 2)
    torch.set_num_threads(1)
    figures = []
    for case in ONE_THREAD:
        note(f"... {case.task}, {case.rows} x {case.size}")
        figures.append(on_one_thread(case, config))
    for case in SEVERAL_THREADS if cores > 1 else ():
        note(f"... {cores} threads, {case.rows} x {case.size}")
        figures.append(on_threads(case, cores, config))
    torch.set_num_threads(threads)
    for case in CUDA if torch.cuda.is_available() else ():
        note(f"... CUDA, {case.task}, {case.rows} x {case.size}")
        figures.append(on_cuda(case, config))
    return figures


def table(figures: list[Figure]) -> Words:
    """The figures beside their goals; what could not be measured says so."""
    head = ("task", "where", "D", "dim", "reference", "ours", "ratio", "goal", "reached", "largest angle")
    lines: list[Sequence[str]] = []
    for one in figures:
        goal = "" if one.goal is None else f">= {one.goal:g}"
        reached = {None: "", True: "yes", False: "NO"}[one.reached]
        times = (f"{one.reference:.1f}", f"{one.ours:.1f}", f"{one.ratio:.2f}")
        lines.append((one.task, one.where, str(one.size), str(one.dim), *times, goal, reached, f"{one.angle:.0e}"))
    wheres = [one.where for one in figures]
    if not any("threads" in where for where in wheres):
        lines.append(("several threads", "skipped: one core", *[""] * 8))
    if not torch.cuda.is_available():
        lines.append(("CUDA", "skipped: no device", *[""] * 8))
    return Words(head, lines)


@experiment(Config(), quick={"batch": 32, "rounds": 1}, one_thread=False)
def tables(config: Config) -> Tables:
    """Every comparison that this machine can make; quick: goals are not judged."""
    yield f"Null spaces, batch of {config.batch}, float64, µs per problem", table(measure(config))

"""Blocks on a thread pool: the same as the function on the whole batch; cached tables serve every later call."""

from __future__ import annotations

import ast
import os
import threading
import time
import types
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import pytest
import torch

import dyntorch as dyn
from dyntorch.core import matrix, primitives
from dyntorch.geometry import epipolar, epipolar_fit, extensors, grassmann, grassmann_nearest, homogeneous, pairs
from dyntorch.invariants import dynamic_shape_tensor, dynamic_tensor, reprojection
from dyntorch.numerics import eigenspaces, lags
from dyntorch.numerics.blocks import LARGE, constant, each, map_blocks, one_thread, select, workers
from dyntorch.shapes import basis, lifted, static
from dyntorch.shapes.basis import Polynomial
from dyntorch.tasks.planes import closed_forms, problem
from dyntorch.tasks.synchronize import projective
from experiments.common.timing import threads as torch_threads
from tests.grid import grid


@pytest.fixture
def two_threads():
    with torch_threads(2):
        yield


@grid(("batch", [0, 1, 6, 7, 23]), ("threads", [1, 2]))
def test_blocks_equal_the_whole(batch, threads):
    x, y = torch.arange(batch * 3.0).reshape(batch, 3), torch.arange(batch)
    with torch_threads(threads):
        total, twice = map_blocks(lambda a, b: (a.sum(-1) + b, 2 * a), x, y, size=3)
        single = map_blocks(torch.neg, x, size=2)
        nested = map_blocks(lambda x: map_blocks(torch.neg, x, size=1), x, size=2)  # blocks inside blocks wait for no others
    assert torch.equal(total, x.sum(-1) + y) and torch.equal(twice, 2 * x)
    assert torch.equal(single, -x) and torch.equal(nested, -x)


class Pair(NamedTuple):
    total: torch.Tensor
    rest: tuple[torch.Tensor | None, ...]


@dataclass(frozen=True)
class Given:
    views: tuple[torch.Tensor, ...]
    name: str
    pair: Pair
    flags: torch.Tensor | None = None


@grid(("batch", [0, 1, 7]), ("threads", [1, 2]))
def test_records_go_in_and_come_back_as_records(batch, threads):
    a, b = torch.arange(batch * 2.0).reshape(batch, 2), torch.arange(batch)
    given = Given((a, 2 * a), "names stay", Pair(b, (None, 3 * b)))

    def block(one, scale, nothing):
        assert isinstance(one, Given) and isinstance(one.pair, Pair) and (one.name, one.flags, nothing) == (given.name, None, None)
        assert len(one.views[1]) == len(one.pair.total) == len(scale) <= 3
        return Given((one.views[1] * scale[:, None],), one.name, Pair(one.pair.rest[1] + one.pair.total, (None, scale)))

    with torch_threads(threads):
        found = map_blocks(block, given, b, None, size=3)
    assert isinstance(found, Given) and isinstance(found.pair, Pair) and (found.name, found.flags) == ("names stay", None)
    assert torch.equal(found.views[0], 2 * a * b[:, None]) and torch.equal(found.pair.total, 4 * b)
    assert found.pair.rest[0] is None and torch.equal(found.pair.rest[1], b)


def test_records_and_problems_are_taken_whole():
    given = Given(
        (torch.arange(3), torch.ones(3, 2)), "names stay", Pair(torch.zeros(3), (None,)), torch.tensor([True, False, True])
    )
    found = each(lambda x: x[1:], given)
    assert [x.tolist() for x in found.views] == [[1, 2], [[1, 1], [1, 1]]] and found.flags.tolist() == [False, True]
    assert found.name == "names stay" and found.pair.rest == (None,) and len(given.flags) == 3
    mask = torch.tensor([[True, False], [False, True]])
    new, old = torch.rand(2, 2, 3, 4), torch.rand(2, 2, 3, 4)
    found = select(mask, new, old)
    for i, j in ((0, 0), (0, 1), (1, 0), (1, 1)):
        assert torch.equal(found[i, j], (new if mask[i, j] else old)[i, j])
    assert torch.equal(select(mask, mask.double(), 5.0), torch.tensor([[1.0, 5.0], [5.0, 1.0]]).double())


def threads_elsewhere():
    """What a thread that starts now is given."""
    with ThreadPoolExecutor(1) as pool:
        return pool.submit(torch.get_num_threads).result()


def test_blocks_run_at_the_same_time_in_other_threads_of_one(two_threads):
    meeting = threading.Barrier(2, timeout=60)  # broken, hence an error, unless two blocks are there together

    def block(x):
        meeting.wait()
        return torch.full_like(x, threading.get_ident()), torch.full_like(x, torch.get_num_threads())

    found, counts = map_blocks(block, torch.zeros(4, dtype=torch.int64), size=2)
    assert threading.get_ident() not in found.tolist() and len(set(found.tolist())) == 2 and counts.tolist() == [1] * 4
    assert torch.get_num_threads() == threads_elsewhere() == 2  # everybody else keeps theirs
    with torch_threads(1):
        alone = map_blocks(lambda x: torch.full_like(x, threading.get_ident()), torch.zeros(4, dtype=torch.int64), size=1)
    assert set(alone.tolist()) == {threading.get_ident()}


def test_grad_mode_is_the_callers(two_threads):
    x = torch.randn(6, 2, generator=torch.Generator().manual_seed(0), requires_grad=True)
    result = map_blocks(torch.square, x, size=2)
    result.sum().backward()
    torch.testing.assert_close(x.grad, 2 * x.detach())
    with torch.no_grad():
        assert not map_blocks(torch.square, x, size=2).requires_grad
    with torch.inference_mode():
        assert map_blocks(torch.square, x, size=2).is_inference()


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork on this system")
@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_a_forked_process_gets_a_pool_of_its_own(two_threads):
    map_blocks(torch.neg, torch.arange(4), size=1)
    child = os.fork()
    if child == 0:
        ok = torch.equal(map_blocks(torch.neg, torch.arange(4), size=1), -torch.arange(4))
        os._exit(0 if ok else 1)
    for _ in range(6000):
        done, code = os.waitpid(child, os.WNOHANG)
        if done:
            assert code == 0
            return
        time.sleep(0.01)
    os.kill(child, 9)
    os.waitpid(child, 0)
    pytest.fail("the child waits for threads that did not survive the fork")


def test_misuse_is_refused_and_an_error_in_a_block_reaches_the_caller(two_threads):
    with pytest.raises(ValueError, match=r"same leading dimension.*\(2,\).*\(3,\)"):
        map_blocks(torch.add, torch.zeros(2), torch.zeros(3), size=1)
    for nothing in ((torch.tensor(1.0),), ()):
        with pytest.raises(ValueError, match="same leading dimension"):
            map_blocks(torch.neg, *nothing, size=1)
    with pytest.raises(ValueError, match="size must be at least 1"):
        map_blocks(torch.neg, torch.zeros(2), size=0)

    def fail(*_):
        raise KeyError("block")

    with pytest.raises(KeyError, match="block"):
        map_blocks(fail, torch.zeros(4), size=1)
    with pytest.raises(KeyError, match="block"):
        one_thread(fail)()
    assert torch.get_num_threads() == workers() == 2  # the setting comes back


def test_public_functions_run_on_one_thread_and_their_blocks_on_those_of_the_caller(two_threads):
    inside = one_thread(lambda: (torch.get_num_threads(), workers()))
    assert inside() == (1, 2) and (torch.get_num_threads(), workers()) == (2, 2)
    nested = one_thread(lambda: (inside(), torch.get_num_threads()))
    assert nested() == ((1, 2), 1) and torch.get_num_threads() == 2
    one_thread(threads_elsewhere)()
    assert threads_elsewhere() == 2  # what starts in the meantime does not stay on one
    # the blocks of a decorated function still get two workers, which start no teams
    names, seen = set(), []

    def block(x):
        names.add(threading.current_thread().name)
        seen.append(torch.get_num_threads())
        started.wait(10)
        return x

    started = threading.Barrier(2)
    one_thread(lambda: map_blocks(block, torch.zeros(2), size=1))()
    assert len(names) == 2 and seen == [1, 1] and torch.get_num_threads() == 2


def test_callers_in_several_threads_do_not_disturb_each_other(two_threads):
    meet = threading.Barrier(3)

    def body():
        meet.wait(10)
        found = torch.get_num_threads()
        meet.wait(10)
        return found

    def caller(_):
        torch.set_num_threads(2)
        return one_thread(body)(), torch.get_num_threads(), workers()

    with ThreadPoolExecutor(3) as pool:
        assert list(pool.map(caller, range(3))) == [(1, 2, 2)] * 3
    assert torch.get_num_threads() == 2


def test_one_large_problem_may_use_the_threads_of_the_caller(two_threads):
    def run(count):
        def counted(x):
            return torch.full_like(x[:, 0], torch.get_num_threads())

        return one_thread(lambda: map_blocks(counted, torch.zeros(1, count), size=1))()

    assert run(10).item() == 1 and run(LARGE).item() == 2 and torch.get_num_threads() == 2


def test_public_functions_leave_inference_mode():
    with torch.inference_mode():
        x = torch.ones(3)
        found, inside = one_thread(lambda x, several: (x * several[0], torch.is_inference_mode_enabled()))(x, several=[x])
        assert x.is_inference() and not found.is_inference() and not inside and not found.requires_grad


ELEMENTWISE = {
    *("undistort", "distort", "reproject", "sampson", "algebraic", "grassmann_tensor", "line_camera", "points_on_lines"),
    "combine_shifts",
    # of words and checks, not of numbers
    *("as_python", "check_options", "with_names", "status_from", "with_words"),
}
"""Without a search or a factorization: torch starts threads for them only above 32,768 numbers, where they pay."""


@pytest.mark.slow
def test_every_public_verb_runs_on_one_thread():
    faces = [dyn, dyn.core, dyn.geometry, dyn.invariants, dyn.numerics, dyn.shapes, dyn.tasks]
    named = {name: getattr(face, name) for face in faces for name in face.__all__}
    helpers = {"one_thread", "map_blocks", "on_cpu", "native", "native_correlations", "native_deviations", "native_residuals"}
    verbs = {name for name, value in named.items() if isinstance(value, types.FunctionType)} - helpers
    assert {name for name in verbs if not hasattr(named[name], "one_thread")} == ELEMENTWISE


# Cached tables serve every later call, wherever the first one came from.


CPU = torch.device("cpu")
TABLES = {
    **dict.fromkeys((lags._epipolar_places, lags._resection_places, epipolar._plane, epipolar._places), (CPU,)),
    **dict.fromkeys((primitives._above_the_diagonal, epipolar_fit._pairs, pairs._product_table, projective._products), (CPU,)),
    **dict.fromkeys((closed_forms._invariant_basis, problem._frames), (CPU,)),
    **dict.fromkeys((epipolar.polar, epipolar_fit._tables), (torch.float64, CPU)),
    **dict.fromkeys((extensors._laplace, extensors._dual_signs, grassmann._removals, grassmann._insertions), (4, 2, CPU)),
    **dict.fromkeys((homogeneous.factors, homogeneous.collecting, homogeneous.multiplicity), (2, 2, CPU)),
    **dict.fromkeys((static.plane_inverse, static.centring_basis, static.free, static.plane_map), (6, CPU)),
    **dict.fromkeys((dynamic_shape_tensor._nodes, dynamic_shape_tensor._samples), (Polynomial(1), CPU)),
    **dict.fromkeys((lags._packing, basis._to_powers), (3, CPU)),
    **dict.fromkeys((primitives._linear_minor_tables, lifted.chosen_basis), (3, 2, CPU)),
    extensors._levi_civita: (3, torch.float64, CPU),
    extensors._splits: (4, 2, 1, CPU),
    dynamic_tensor.vanishing_forms: (2, 3, 2, CPU),
    grassmann_nearest._determinant_rows: ((2, 1, 1), (3, 3, 3), CPU),
    grassmann.tables: ((2, 1, 1), (3, 3, 3), 2, CPU),
    primitives.triangle: (4, CPU),
    matrix._unpacking: ((3, 3), CPU),
    eigenspaces._generic: (5, 2, CPU),
    closed_forms._joins: (64, CPU),
    homogeneous.symmetric: (2, CPU),
    problem._parameter_places: (3, 1, CPU),
    static._choices: (8, CPU),
    static._basis: ("plane", 4, CPU),
    lifted.partitions: (3, (2, 2), CPU),
    reprojection._maps: (reprojection.CameraKind(affine=True), CPU),
    dynamic_shape_tensor.basis_points_first: (6, (0, 1, 2, 3), CPU),
}
"""All of them: the last test says so."""


def tensors(table):
    if isinstance(table, torch.Tensor):
        return [table]
    parts = table if isinstance(table, tuple) else vars(table).values()
    return [t for part in parts if isinstance(part, torch.Tensor | tuple) for t in tensors(part)]


def is_plain(tensor):
    wrapped = torch._C._functorch.is_functorch_wrapped_tensor(tensor)
    return not (wrapped or tensor.is_inference() or tensor.requires_grad) and tensor.device == CPU


def beside(function):
    return lambda x: (function(), x)[1]


def under(context, function):
    with context:
        function()


AROUND = {
    "grad": lambda f: torch.func.grad(beside(f))(torch.ones(())),
    "vmap": lambda f: torch.func.vmap(beside(f))(torch.ones(2)),
    "jvp": lambda f: torch.func.vmap(lambda t: torch.func.jvp(beside(f), (torch.ones(()),), (t,)))(torch.ones(2)),
    "inference": lambda f: under(torch.inference_mode(), f),
    "another device": lambda f: under(torch.device("meta"), f),
}


@pytest.mark.parametrize("around", AROUND)
def test_what_surrounds_the_first_call_leaves_no_trace(around):
    failures = []
    for table, sizes in TABLES.items():
        for other in TABLES:  # some are made from others
            other.cache_clear()
        AROUND[around](lambda table=table, sizes=sizes: table(*sizes))
        once = table.cache_info().currsize == 1
        cached = tensors(table(*sizes))
        table.cache_clear()
        fresh = tensors(table(*sizes))
        equal = all(is_plain(x) and x.equal(y) for x, y in zip(cached, fresh, strict=False))
        if not (once and len(cached) == len(fresh) > 0 and equal):
            failures.append(table.__name__)
    assert failures == []


def test_a_mistake_is_the_callers():
    @constant
    def table(n):
        raise ValueError(f"no table of {n}")

    with pytest.raises(ValueError, match="no table of 3"):
        table(3)


@pytest.mark.slow
def test_no_other_function_caches_tensors():
    listed = {table.__name__ for table in TABLES}
    decorated, cached = set(), set()
    for path in sorted(Path(extensors.__file__).parents[1].rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.FunctionDef):
                names = {ast.unparse(d).split("(")[0] for d in node.decorator_list}
                decorated |= {node.name} if "constant" in names else set()
                # what comes from a cache of the standard library must not be a tensor
                cached |= {node.name} if names & {"lru_cache", "cache"} and "Tensor" in ast.unparse(node.returns) else set()
    assert decorated == listed | {"count_rows"}  # whose numbers are no tensors
    assert cached == set()

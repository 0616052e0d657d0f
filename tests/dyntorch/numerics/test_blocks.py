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
from dyntorch.core import matrix
from dyntorch.core import primitives as base
from dyntorch.core import primitives as plane
from dyntorch.geometry import epipolar, extensors, grassmann, grassmann_nearest
from dyntorch.geometry import epipolar as epipolar_variance
from dyntorch.geometry import epipolar_fit as epipolar_descent
from dyntorch.geometry import extensors as exterior
from dyntorch.geometry import grassmann as grassmann_recovery
from dyntorch.geometry import homogeneous as monomials
from dyntorch.geometry import pairs as epipole_pairs
from dyntorch.invariants import dynamic_shape_tensor as dynamic_shape_rows
from dyntorch.invariants import dynamic_tensor
from dyntorch.invariants import reprojection as shape_residual
from dyntorch.numerics import eigenspaces, lags
from dyntorch.numerics.blocks import LARGE, constant, each, map_blocks, one_thread, select, workers
from dyntorch.shapes import basis as dynamic_shape_theory
from dyntorch.shapes import lifted
from dyntorch.shapes import static as shape_completion
from dyntorch.shapes import static as shape_points
from dyntorch.shapes import static as shape_rows
from dyntorch.shapes.basis import Polynomial
from dyntorch.tasks.planes import closed_forms as infinity_extensors
from dyntorch.tasks.planes import problem as planes_problem
from dyntorch.tasks.planes import problem as planes_starts
from dyntorch.tasks.synchronize import projective
from tests.grid import grid


@pytest.fixture
def two_threads():
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    yield
    torch.set_num_threads(before)


@grid(("batch", [0, 1, 6, 7, 23]), ("threads", [1, 2]))
def test_blocks_equal_the_whole(batch, threads):
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    x = torch.arange(batch * 3.0).reshape(batch, 3)
    y = torch.arange(batch)
    total, twice = map_blocks(lambda a, b: (a.sum(-1) + b, 2 * a), x, y, size=3)
    torch.set_num_threads(before)
    assert torch.equal(total, x.sum(-1) + y)
    assert torch.equal(twice, 2 * x)


class Pair(NamedTuple):
    total: torch.Tensor
    rest: tuple[torch.Tensor | None, ...]


@dataclass(frozen=True)
class Given:
    views: tuple[torch.Tensor, ...]
    name: str
    pair: Pair
    flags: torch.Tensor | None = None


@pytest.mark.parametrize("batch", [0, 1, 7])
@pytest.mark.parametrize("threads", [1, 2])
def test_records_go_in_and_come_back_as_records(batch, threads):
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    a, b = torch.arange(batch * 2.0).reshape(batch, 2), torch.arange(batch)
    given = Given((a, 2 * a), "names stay", Pair(b, (None, 3 * b)))

    def block(one, scale, nothing):
        assert (
            isinstance(one, Given) and isinstance(one.pair, Pair) and (one.name, one.flags, nothing) == ("names stay", None, None)
        )
        assert len(one.views[1]) == len(one.pair.total) == len(scale) <= 3
        return Given((one.views[1] * scale[:, None],), one.name, Pair(one.pair.rest[1] + one.pair.total, (None, scale)))

    found = map_blocks(block, given, b, None, size=3)
    torch.set_num_threads(before)
    assert isinstance(found, Given) and isinstance(found.pair, Pair) and (found.name, found.flags) == ("names stay", None)
    assert torch.equal(found.views[0], 2 * a * b[:, None]) and torch.equal(found.pair.total, 4 * b)
    assert found.pair.rest[0] is None and torch.equal(found.pair.rest[1], b)


def test_each_takes_the_tensors_of_a_record_one_by_one():
    given = Given(
        (torch.arange(3), torch.ones(3, 2)), "names stay", Pair(torch.zeros(3), (None,)), torch.tensor([True, False, True])
    )
    found = each(lambda x: x[1:], given)
    assert [x.tolist() for x in found.views] == [[1, 2], [[1, 1], [1, 1]]] and found.flags.tolist() == [False, True]
    assert found.name == "names stay" and found.pair.rest == (None,) and len(given.flags) == 3


def test_select_takes_whole_problems():
    mask = torch.tensor([[True, False], [False, True]])
    new, old = torch.rand(2, 2, 3, 4), torch.rand(2, 2, 3, 4)
    found = select(mask, new, old)
    for i, j in ((0, 0), (0, 1), (1, 0), (1, 1)):
        assert torch.equal(found[i, j], (new if mask[i, j] else old)[i, j])
    assert torch.equal(select(mask, mask.double(), 5.0), torch.tensor([[1.0, 5.0], [5.0, 1.0]]).double())


def test_a_single_tensor_comes_back_as_a_tensor(two_threads):
    assert torch.equal(map_blocks(torch.neg, torch.arange(5), size=2), -torch.arange(5))


def test_blocks_run_at_the_same_time_in_other_threads(two_threads):
    meeting = threading.Barrier(2, timeout=60)  # broken, hence an error, unless two blocks are there together

    def block(x):
        meeting.wait()
        return torch.full_like(x, threading.get_ident())

    found = map_blocks(block, torch.zeros(4, dtype=torch.int64), size=2)
    assert threading.get_ident() not in found.tolist()
    assert len(set(found.tolist())) == 2


def test_workers_have_one_thread_and_everybody_else_keeps_theirs(two_threads):
    def block(x):
        time.sleep(0.01)  # both workers take part
        return torch.full_like(x, torch.get_num_threads())

    seen = []
    assert set(map_blocks(block, torch.zeros(8), size=1).tolist()) == {1.0}
    assert torch.get_num_threads() == 2
    other = threading.Thread(target=lambda: seen.append(torch.get_num_threads()))
    other.start()
    other.join()
    assert seen == [2]


def test_grad_mode_is_the_callers(two_threads):
    x = torch.randn(6, 2, generator=torch.Generator().manual_seed(0), requires_grad=True)
    result = map_blocks(torch.square, x, size=2)
    result.sum().backward()
    torch.testing.assert_close(x.grad, 2 * x.detach())
    with torch.no_grad():
        assert not map_blocks(torch.square, x, size=2).requires_grad
    with torch.inference_mode():
        assert map_blocks(torch.square, x, size=2).is_inference()


def test_one_thread_stays_in_the_calling_thread():
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    found = map_blocks(lambda x: torch.full_like(x, threading.get_ident()), torch.zeros(4, dtype=torch.int64), size=1)
    torch.set_num_threads(before)
    assert set(found.tolist()) == {threading.get_ident()}


def test_an_error_in_a_block_reaches_the_caller(two_threads):
    def block(x):
        raise KeyError("block")

    with pytest.raises(KeyError, match="block"):
        map_blocks(block, torch.zeros(4), size=1)


def test_blocks_inside_blocks_do_not_wait_for_each_other(two_threads):
    found = map_blocks(lambda x: map_blocks(torch.neg, x, size=1), torch.arange(8), size=2)
    assert torch.equal(found, -torch.arange(8))


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


def test_misuse_is_refused():
    with pytest.raises(ValueError, match=r"same leading dimension.*\(2,\).*\(3,\)"):
        map_blocks(torch.add, torch.zeros(2), torch.zeros(3), size=1)
    with pytest.raises(ValueError, match="same leading dimension"):
        map_blocks(torch.neg, torch.tensor(1.0), size=1)
    with pytest.raises(ValueError, match="same leading dimension"):
        map_blocks(torch.neg, size=1)
    with pytest.raises(ValueError, match="size must be at least 1"):
        map_blocks(torch.neg, torch.zeros(2), size=0)


def threads_seen(seen):
    seen.append(torch.get_num_threads())
    return torch.get_num_threads()


def test_public_functions_run_on_one_thread_and_their_blocks_on_those_of_the_caller(two_threads):
    inside = one_thread(lambda: (torch.get_num_threads(), workers()))
    assert inside() == (1, 2) and (torch.get_num_threads(), workers()) == (2, 2)
    nested = one_thread(lambda: (inside(), torch.get_num_threads()))
    assert nested() == ((1, 2), 1) and torch.get_num_threads() == 2
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


def test_the_setting_comes_back_after_an_error(two_threads):
    def fail():
        raise KeyError

    with pytest.raises(KeyError):
        one_thread(fail)()
    assert torch.get_num_threads() == 2 and workers() == 2


def test_threads_that_start_meanwhile_get_the_setting_of_the_caller(two_threads):
    seen = []

    def body():
        other = threading.Thread(target=threads_seen, args=(seen,))
        other.start()
        other.join()

    one_thread(body)()
    other = threading.Thread(target=threads_seen, args=(seen,))
    other.start()
    other.join()
    assert seen == [2, 2]


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
        return one_thread(lambda: map_blocks(lambda x: torch.full_like(x[:, 0], threads_seen([])), torch.zeros(1, count), size=1))()

    assert run(10).item() == 1 and run(LARGE).item() == 2 and torch.get_num_threads() == 2


def test_public_functions_leave_inference_mode():
    with torch.inference_mode():
        x = torch.ones(3)
        found, inside = one_thread(lambda x, several: (x * several[0], torch.is_inference_mode_enabled()))(x, several=[x])
        assert x.is_inference() and not found.is_inference() and not inside and not found.requires_grad


ELEMENTWISE = {
    "undistort",
    "distort",
    "reproject",
    "sampson",
    "algebraic",
    "grassmann_tensor",
    "line_camera",
    "points_on_lines",
    "combine_shifts",
    # of words and checks, not of numbers
    "as_python",
    "check_options",
    "with_names",
    "status_from",
    "with_words",
}
"""Without a search or a factorization: torch starts threads for them only above 32,768 numbers, where they pay."""


@pytest.mark.slow
def test_every_public_verb_runs_on_one_thread():
    faces = [dyn, dyn.core, dyn.geometry, dyn.invariants, dyn.numerics, dyn.shapes, dyn.tasks]
    named = {name: getattr(face, name) for face in faces for name in face.__all__}
    helpers = {"one_thread", "map_blocks", "on_cpu"}
    verbs = {name for name, value in named.items() if isinstance(value, types.FunctionType)} - helpers
    assert {name for name in verbs if not hasattr(named[name], "one_thread")} == ELEMENTWISE


# ----------------------------------------------------------------------------------------------------------------------
# Cached tables serve every later call, wherever the first one came from.


CPU = torch.device("cpu")
TABLES = [
    (lags._packing, (3, CPU)),
    (lags._epipolar_places, (CPU,)),
    (lags._resection_places, (CPU,)),
    (epipolar_variance._plane, (CPU,)),
    (extensors._levi_civita, (3, torch.float64, CPU)),
    (extensors._laplace, (4, 2, CPU)),
    (extensors._dual_signs, (4, 2, CPU)),
    (exterior._splits, (4, 2, 1, CPU)),
    (dynamic_tensor.vanishing_forms, (2, 3, 2, CPU)),
    (grassmann._removals, (4, 2, CPU)),
    (grassmann._insertions, (4, 2, CPU)),
    (grassmann_nearest._determinant_rows, ((2, 1, 1), (3, 3, 3), CPU)),
    (grassmann_recovery.tables, ((2, 1, 1), (3, 3, 3), 2, CPU)),
    (plane._linear_minor_tables, (3, 2, CPU)),
    (base.triangle, (4, CPU)),
    (base._above_the_diagonal, (CPU,)),
    (matrix._unpacking, ((3, 3), CPU)),
    (eigenspaces._generic, (5, 2, CPU)),
    (epipolar.polar, (torch.float64, CPU)),
    (epipolar._places, (CPU,)),
    (epipolar_descent._tables, (torch.float64, CPU)),
    (epipolar_descent._pairs, (CPU,)),
    (epipole_pairs._product_table, (CPU,)),
    (infinity_extensors._joins, (64, CPU)),
    (infinity_extensors._invariant_basis, (CPU,)),
    (monomials.symmetric, (2, CPU)),
    (monomials.factors, (2, 2, CPU)),
    (monomials.collecting, (2, 2, CPU)),
    (monomials.multiplicity, (2, 2, CPU)),
    (planes_problem._parameter_places, (3, 1, CPU)),
    (planes_starts._frames, (CPU,)),
    (projective._products, (CPU,)),
    (shape_completion._choices, (8, CPU)),
    (shape_points._basis, ("plane", 4, CPU)),
    (lifted.partitions, (3, (2, 2), CPU)),
    (lifted.chosen_basis, (3, 2, CPU)),
    (shape_points.plane_inverse, (6, CPU)),
    (shape_rows.centring_basis, (5, CPU)),
    (shape_rows.free, (6, CPU)),
    (shape_rows.plane_map, (6, CPU)),
    (shape_residual._maps, (shape_residual.CameraKind(affine=True), CPU)),
    (dynamic_shape_rows.basis_points_first, (6, (0, 1, 2, 3), CPU)),
    (dynamic_shape_rows._nodes, (Polynomial(1), CPU)),
    (dynamic_shape_rows._samples, (Polynomial(1), CPU)),
    (dynamic_shape_theory._to_powers, (3, CPU)),
]
"""All of them: the last test says so."""


def tensors(table):
    if isinstance(table, torch.Tensor):
        return [table]
    return [t for part in (table if isinstance(table, tuple) else vars(table).values()) for t in tensors_of(part)]


def tensors_of(part):
    return tensors(part) if isinstance(part, torch.Tensor | tuple) else []


def within_grad(function):
    torch.func.grad(lambda x: (function(), x)[1])(torch.ones(()))


def within_vmap(function):
    torch.func.vmap(lambda x: (function(), x)[1])(torch.ones(2))


def within_jvp(function):
    torch.func.vmap(lambda t: torch.func.jvp(lambda x: (function(), x)[1], (torch.ones(()),), (t,)))(torch.ones(2))


def within_inference(function):
    with torch.inference_mode():
        function()


def on_another_device(function):
    with torch.device("meta"):
        function()


@pytest.mark.parametrize("around", [within_grad, within_vmap, within_jvp, within_inference, on_another_device])
def test_what_surrounds_the_first_call_leaves_no_trace(around):
    failures = []
    for table, sizes in TABLES:
        for other, _ in TABLES:  # some are made from others
            other.cache_clear()
        around(lambda table=table, sizes=sizes: table(*sizes))
        once = table.cache_info().currsize == 1
        cached = tensors(table(*sizes))
        table.cache_clear()
        fresh = tensors(table(*sizes))
        if not (once and len(cached) == len(fresh) > 0 and all(map(plain_and_equal, cached, fresh))):
            failures.append(table.__name__)
    assert failures == []


def plain_and_equal(tensor, expected):
    return (
        not torch._C._functorch.is_functorch_wrapped_tensor(tensor)
        and not tensor.is_inference()
        and not tensor.requires_grad
        and tensor.device == CPU
        and tensor.equal(expected)
    )


def test_a_mistake_is_the_callers():
    @constant
    def table(n):
        raise ValueError(f"no table of {n}")

    with pytest.raises(ValueError, match="no table of 3"):
        table(3)


@pytest.mark.slow
def test_no_other_function_caches_tensors():
    listed = {table.__name__ for table, _ in TABLES}
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

"""Work on a batch block by block, so that each block stays in the cache of a core, and all cores have one.

Small matrices never wait for a team of threads: whatever is public runs on one thread (:func:`one_thread`), and blocks go to a pool
of workers of one thread each (:func:`map_blocks`).  Beside a busy neighbour a team waits for its slowest member at every operation:
five to twenty times longer than one thread takes for the whole.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import fields, is_dataclass
from functools import _lru_cache_wrapper, lru_cache, partial, wraps
from threading import Barrier, local
from typing import Any, ParamSpec, TypeVar

import torch
from torch import Tensor

Record = TypeVar("Record")
P = ParamSpec("P")
R = TypeVar("R")
LARGE = 1 << 20
"""Numbers in one problem from which its own operations may use all threads."""


class _Caller(local):
    """What each Python thread had set before it entered :func:`one_thread`."""

    threads: int | None = None


_caller = _Caller()


def one_thread(function: Callable[P, R]) -> Callable[P, R]:
    """Decorate a public function: its small operations run on one thread, its blocks on as many workers as torch has threads.

    The setting of the caller (``torch.set_num_threads``) holds again after the call, also after an exception, and all the time
    in other threads.  Within ``torch.inference_mode`` the function runs without gradients instead, on copies of the tensors made
    there: what it differentiates inside needs tensors that may be saved.

    Example:
        >>> import torch
        >>> one_thread(torch.get_num_threads)(), workers() == torch.get_num_threads()
        (1, True)
    """

    @wraps(function)
    def run(*args: P.args, **kwargs: P.kwargs) -> R:
        if torch.is_inference_mode_enabled():
            with torch.inference_mode(False), torch.no_grad():
                return run(*(_outside(x) for x in args), **{name: _outside(x) for name, x in kwargs.items()})
        threads = torch.get_num_threads()
        if threads == 1 or _caller.threads is not None:
            return function(*args, **kwargs)
        _caller.threads = threads
        _set_threads(1, others=threads)
        try:
            return function(*args, **kwargs)
        finally:
            _caller.threads = None
            torch.set_num_threads(threads)

    run.__dict__["one_thread"] = True
    return run


def workers() -> int:
    """Workers that blocks are spread over: the number of threads that torch has, or had before :func:`one_thread`."""
    return _caller.threads or torch.get_num_threads()


def _outside(x: Any) -> Any:
    """Arguments without tensors made in inference mode, which autograd cannot save."""
    if isinstance(x, Tensor):
        return x.clone() if x.is_inference() else x
    if isinstance(x, (tuple, list)) and type(x) in (tuple, list):
        return type(x)(_outside(item) for item in x)
    return x


def _set_threads(count: int, others: int) -> None:
    """Threads for the operations of this Python thread; those that start later get ``others``."""
    torch.set_num_threads(count)
    # the setting holds per thread, but new threads inherit the last one, whoever set it
    _keeper().submit(torch.set_num_threads, others).result()


@lru_cache(maxsize=1)
def _keeper() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(1, thread_name_prefix="dyntorch-keeper")


@contextmanager
def _all_threads(tensors: tuple[Tensor, ...]) -> Iterator[None]:
    """The threads of the caller for a single problem that is large."""
    threads = _caller.threads
    if threads is None or sum(x.numel() for x in tensors) < LARGE:
        yield
        return
    torch.set_num_threads(threads)
    try:
        yield
    finally:
        _set_threads(1, others=threads)


def map_blocks(function: Callable[..., Record], *data: Any, size: int) -> Record:
    r"""Apply ``function`` to blocks of the leading dimension of all tensors, on a thread pool, and concatenate the results.

    On the CPU torch factorizes a batch of matrices one after the other on one core (``svd``, ``eigh``, ``cholesky`` and
    the triangular solves), and releases the interpreter meanwhile; threads over blocks give the other cores their share.
    The pool has :func:`workers` workers, whose own operations run on one thread each: also a single block of many
    small problems goes there from a caller with several threads, because teams of threads on small operations cost ten times what
    they gain.  A single problem, one thread or an accelerator needs no pool.  The caller's grad mode holds in the workers.

    Args:
        function: takes one block of each argument, and returns a tensor or a record of tensors with the same leading dimension.
        *data: tensors ``(batch, ...)``, and records of them: tuples, named ones, dataclasses, nested as you like.  All tensors have
            the same ``batch``; zero is one empty block.  What is no tensor (None for one that is not there) comes as it is.
        size: problems per block.

    Returns:
        what ``function`` returns for the whole batch, of the same kind.

    Raises:
        ValueError: no tensor, different leading dimensions, or a size below 1.

    Example:
        >>> import torch
        >>> map_blocks(lambda a, b: a + b, torch.arange(5), torch.ones(5, dtype=torch.int64), size=2)
        tensor([1, 2, 3, 4, 5])
        >>> map_blocks(lambda views, weights: (views[0] + views[1], weights), (torch.ones(3), torch.arange(3)), None, size=2)
        (tensor([1., 2., 3.]), None)
    """
    tensors = tuple(tensors_of(data))
    lengths = {tensor.shape[0] if tensor.ndim else None for tensor in tensors}
    if len(lengths) != 1 or None in lengths:
        raise ValueError(f"map_blocks needs tensors of the same leading dimension, got {[tuple(t.shape) for t in tensors]}")
    if size < 1:
        raise ValueError(f"size must be at least 1 problem per block, got {size}")
    threads = workers() if tensors[0].device.type == "cpu" else 1
    if len(tensors[0]) <= min(size, 1) or (threads == 1 and len(tensors[0]) <= size):
        with _all_threads(tensors):
            return function(*data)
    if len(tensors[0]) <= size and torch.get_num_threads() == 1:
        return function(*data)
    blocks = [rebuilt(data, iter(block)) for block in zip(*(tensor.split(size) for tensor in tensors), strict=True)]
    if threads == 1:
        return _concatenate([function(*block) for block in blocks])
    grad, inference = torch.is_grad_enabled(), torch.is_inference_mode_enabled()

    def run(block: tuple[Any, ...]) -> Record:
        # grad mode belongs to a thread; a worker starts with the default
        with torch.inference_mode(inference), torch.set_grad_enabled(grad):
            return function(*block)

    return _concatenate(list(_pool(threads).map(run, blocks)))


def each(function: Callable[[Tensor], Tensor], record: Record) -> Record:
    """The record with a function of each of its tensors in its place; what is a record says :func:`map_blocks`."""
    return rebuilt(record, map(function, tensors_of(record)))


def replace_problems(record: Record, at: Tensor, new: Record) -> Record:
    """The record with the problems ``at (k,)`` replaced by those of another record of k problems, in memory of its own."""
    pairs = zip(tensors_of(record), tensors_of(new), strict=True)
    return rebuilt(record, (old.index_put((at,), part) for old, part in pairs))


def select(mask: Tensor, new: Tensor, old: Tensor | float) -> Tensor:
    """``new`` where the mask is true, which has the leading dimensions alone, elsewhere ``old``."""
    return torch.where(mask[(..., *[None] * (new.ndim - mask.ndim))], new, old)


def select_problems(mask: Tensor, new: Record, old: Record) -> Record:
    """The record of the new problems where the mask ``(b,)`` is true, of the old ones elsewhere."""
    return rebuilt(new, map(partial(select, mask), tensors_of(new), tensors_of(old)))


def _concatenate(results: list[Record]) -> Record:
    columns = zip(*(tuple(tensors_of(result)) for result in results), strict=True)
    return rebuilt(results[0], iter([torch.cat(column) for column in columns]))


def tensors_of(record: Any) -> Iterator[Tensor]:
    """The tensors of a record, in the order of its fields."""
    if isinstance(record, Tensor):
        yield record
    else:
        for part in _parts(record) or ():
            yield from tensors_of(part)


def rebuilt(record: Record, tensors: Iterator[Tensor]) -> Record:
    """The same record of other tensors, in the order of :func:`tensors_of`."""
    if isinstance(record, Tensor):
        return next(tensors)  # type: ignore[return-value]
    parts = _parts(record)
    if parts is None:
        return record
    built, kind = [rebuilt(part, tensors) for part in parts], type(record)
    return kind(built) if kind is tuple else kind(*built)  # type: ignore[call-arg]


def _parts(record: Any) -> Iterable[Any] | None:
    """The fields of a record; None for what is none."""
    if isinstance(record, tuple):
        return record
    if is_dataclass(record):
        return [getattr(record, field.name) for field in fields(record)]
    return None


def _one_thread() -> None:
    torch.get_num_threads()  # a thread's first call takes the global setting over, and would undo the next line later
    torch.set_num_threads(1)


@lru_cache(maxsize=1)
def _pool(threads: int) -> ThreadPoolExecutor:
    """Workers whose torch operations do not start teams of their own: ten times slower, with more threads than cores."""
    pool, own = ThreadPoolExecutor(threads, thread_name_prefix="dyntorch", initializer=_one_thread), torch.get_num_threads()
    # every worker has to start before the setting is put right
    started = Barrier(threads)
    for _ in pool.map(lambda _: started.wait(), range(threads)):
        pass
    _set_threads(own, others=threads)
    return pool


if hasattr(os, "register_at_fork"):
    # threads do not survive a fork
    os.register_at_fork(after_in_child=_pool.cache_clear)
    os.register_at_fork(after_in_child=_keeper.cache_clear)


# ----------------------------------------------------------------------------------------------------------------------
# Tables of numbers that depend on sizes alone, made once and shared.


Sizes = ParamSpec("Sizes")
Table = TypeVar("Table")


def constant(make: Callable[Sizes, Table]) -> _lru_cache_wrapper[Table]:
    """Cache the tensors that a function of sizes, and of the device, makes; whoever gets them must not write into them."""

    @lru_cache(maxsize=256)
    @wraps(make)
    def look_up(*args: Sizes.args, **kwargs: Sizes.kwargs) -> Table:
        with ThreadPoolExecutor(1) as alone:
            return alone.submit(make, *args, **kwargs).result()

    return look_up


# ----------------------------------------------------------------------------------------------------------------------
# Random numbers from the caller's generator, wherever it lives.


GOLDEN, SECOND, THIRD = (value - 2**64 for value in (0x9E3779B97F4A7C15, 0xBF58476D1CE4E5B9, 0x94D049BB133111EB))
"""The odd numbers of splitmix64, as int64 has them (Steele, Lea and Flood 2014)."""


class Draws:
    """A stream of random numbers for each problem of a batch: what one gets does not depend on how the others fare.

    The k-th number of a problem is a hash of its seed and k, so all are drawn at once, on any device the same.
    """

    def __init__(self, count: int, generator: torch.Generator | None, device: torch.device) -> None:
        home = device if generator is None else generator.device
        self.seeds = torch.randint(2**62, (count,), generator=generator, device=home).to(device)
        self.drawn = torch.zeros_like(self.seeds)

    def __call__(self, where: Tensor, *shape: int) -> Tensor:
        """The next numbers in [0, 1) of some problems, ``(problems, *shape)`` float64."""
        count = math.prod(shape)
        index = self.drawn[where, None] + torch.arange(1, count + 1, device=self.seeds.device)
        self.drawn[where] += count
        x = self.seeds[where, None] + index * GOLDEN
        for shift, factor in ((30, SECOND), (27, THIRD)):
            x = (x ^ _shift_right(x, shift)) * factor
        x = x ^ _shift_right(x, 31)
        return (_shift_right(x, 11).double() * 2.0**-53).reshape(len(x), *shape)


def _shift_right(x: Tensor, by: int) -> Tensor:
    """Bits of int64 shifted as those of a number without sign."""
    return (x >> by) & ((1 << (64 - by)) - 1)


def uniform(*shape: int, generator: torch.Generator | None, device: torch.device) -> Tensor:
    """Numbers in [0, 1), float64, drawn on the device of the generator (None: on ``device``) and moved to ``device``."""
    home = device if generator is None else generator.device
    return torch.rand(*shape, generator=generator, dtype=torch.float64, device=home).to(device)

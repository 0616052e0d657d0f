"""Work on a batch block by block, so that each block stays in the cache of a core, and all cores have one."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from threading import Barrier
from typing import TypeVar

import torch
from torch import Tensor

Result = TypeVar("Result", Tensor, tuple[Tensor, ...])


def map_blocks(function: Callable[..., Result], *tensors: Tensor, size: int) -> Result:
    r"""Apply ``function`` to blocks of the leading dimension of all tensors, on a thread pool, and concatenate the results.

    On the CPU torch factorizes a batch of matrices one after the other on one core (``svd``, ``eigh``, ``cholesky`` and
    the triangular solves), and releases the interpreter meanwhile; threads over blocks give the other cores their share.
    The pool has ``torch.get_num_threads()`` workers, whose own operations run on one thread each: also a single block of many
    small problems goes there, because teams of threads on small operations cost ten times what they gain.  A single problem,
    one thread or an accelerator needs no pool.  The caller's grad mode holds in the workers.

    Args:
        function: takes one block per tensor and returns a tensor, or a tuple of tensors, with the same leading dimension.
        tensors: ``(batch, ...)``, all with the same ``batch``; zero is one empty block.
        size: problems per block.

    Returns:
        what ``function`` returns for the whole batch.

    Raises:
        ValueError: no tensor, different leading dimensions, or a size below 1.

    Example:
        >>> import torch
        >>> map_blocks(lambda a, b: a + b, torch.arange(5), torch.ones(5, dtype=torch.int64), size=2)
        tensor([1, 2, 3, 4, 5])
    """
    lengths = {tensor.shape[0] if tensor.ndim else None for tensor in tensors}
    if len(lengths) != 1 or None in lengths:
        raise ValueError(f"map_blocks needs tensors of the same leading dimension, got {[tuple(t.shape) for t in tensors]}")
    if size < 1:
        raise ValueError(f"size must be at least 1 problem per block, got {size}")
    threads = torch.get_num_threads() if tensors[0].device.type == "cpu" else 1
    if len(tensors[0]) <= min(size, 1) or (threads == 1 and len(tensors[0]) <= size):
        return function(*tensors)  # one large problem may use all cores in its operations
    blocks = list(zip(*(tensor.split(size) for tensor in tensors), strict=True))
    if threads == 1:
        return _concatenate([function(*block) for block in blocks])
    grad, inference = torch.is_grad_enabled(), torch.is_inference_mode_enabled()

    def run(block: tuple[Tensor, ...]) -> Result:
        # grad mode belongs to a thread; a worker starts with the default
        with torch.inference_mode(inference), torch.set_grad_enabled(grad):
            return function(*block)

    return _concatenate(list(_pool(threads).map(run, blocks)))


def _concatenate(results: list[Result]) -> Result:
    if isinstance(results[0], Tensor):
        return torch.cat(results)
    return tuple(torch.cat(parts) for parts in zip(*results, strict=True))


def _one_thread() -> None:
    torch.get_num_threads()  # a thread's first call takes the global setting over, and would undo the next line later
    torch.set_num_threads(1)


@lru_cache(maxsize=1)
def _pool(threads: int) -> ThreadPoolExecutor:
    """Workers whose torch operations do not start teams of their own: ten times slower, with more threads than cores."""
    pool = ThreadPoolExecutor(threads, thread_name_prefix="dyntorch", initializer=_one_thread)
    # every worker has to start before the setting is put right: it holds per thread, but new threads inherit the last one
    started = Barrier(threads)
    for _ in pool.map(lambda _: started.wait(), range(threads)):
        pass
    torch.set_num_threads(threads)
    return pool


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_pool.cache_clear)  # threads do not survive a fork

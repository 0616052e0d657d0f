"""Tables of numbers that depend on sizes alone, made once and shared."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import _lru_cache_wrapper, lru_cache, wraps
from typing import ParamSpec, TypeVar

Sizes = ParamSpec("Sizes")
Table = TypeVar("Table")


def constant(make: Callable[Sizes, Table]) -> _lru_cache_wrapper[Table]:
    """Cache the tensors that a function of sizes, and of the device, makes; whoever gets them must not write into them.

    The first call may come from anywhere, but a tensor made within ``torch.inference_mode``, a transformation of ``torch.func``,
    a fake mode or for another default device belongs there, and in the cache it would break later calls.  All of these hold for
    one thread: a thread of its own makes the tensors.

    Example:
        >>> import torch
        >>> @constant
        ... def steps(n, device):
        ...     return torch.arange(n, device=device)
        >>> with torch.inference_mode():
        ...     first = steps(3, torch.device("cpu"))
        >>> first.is_inference(), steps(3, torch.device("cpu")) is first
        (False, True)
    """

    @lru_cache(maxsize=256)
    @wraps(make)
    def made(*args: Sizes.args, **kwargs: Sizes.kwargs) -> Table:
        with ThreadPoolExecutor(1) as alone:
            return alone.submit(make, *args, **kwargs).result()

    return made

"""Knows matrices and numbers only, no camera and no point: null spaces, least squares, subspaces, time lags.

Everything here is batched over leading dimensions and computes in float64.  ``nullspace`` is the only place where null spaces
are solved (``eigenspaces`` the means), ``function_transforms`` is what makes solvers that
look at values work within ``torch.func``, ``least_squares`` holds the one Levenberg-Marquardt, ``blocks`` cuts batches into pieces
that fit the cache and gives each to a thread, ``arguments`` checks what a function was given and where it computes, ``messages``
are sentences that keep their data.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from dyntorch import _lazily

if TYPE_CHECKING:  # decorators keep the types of what they decorate only if theirs are known
    from dyntorch.numerics.arguments import on_cpu as on_cpu
    from dyntorch.numerics.blocks import one_thread as one_thread

_HOME = {
    "one_thread": "dyntorch.numerics.blocks",
    "map_blocks": "dyntorch.numerics.blocks",
    "on_cpu": "dyntorch.numerics.arguments",
    "check_options": "dyntorch.numerics.arguments",
    "canonical_correlation": "dyntorch.numerics.subspaces",
    "orthonormal_basis": "dyntorch.numerics.subspaces",
    "affine_factorization": "dyntorch.numerics.subspaces",
    "metric_upgrade": "dyntorch.numerics.subspaces",
    "Message": "dyntorch.numerics.messages",
    "as_python": "dyntorch.numerics.messages",
    "with_words": "dyntorch.numerics.messages",
    "with_names": "dyntorch.numerics.messages",
}
__all__ = sorted(_HOME)


def __getattr__(name: str) -> Any:
    return _lazily(__name__, _HOME, name)


def __dir__() -> list[str]:
    return __all__

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
    **dict.fromkeys(("one_thread", "map_blocks"), "dyntorch.numerics.blocks"),
    **dict.fromkeys(("on_cpu", "check_options"), "dyntorch.numerics.arguments"),
    "native": "dyntorch.native.library",
    "DecisionModel": "dyntorch.numerics.logistic",
    **dict.fromkeys(("native_correlations", "native_deviations", "native_residuals"), "dyntorch.native.recognition"),
    **dict.fromkeys(("canonical_correlation", "orthonormal_basis"), "dyntorch.numerics.subspaces"),
    **dict.fromkeys(("affine_factorization", "metric_upgrade"), "dyntorch.numerics.subspaces"),
    **dict.fromkeys(("Message", "as_python", "with_words", "with_names"), "dyntorch.numerics.messages"),
}
__all__ = sorted(_HOME)


def __getattr__(name: str) -> Any:
    return _lazily(__name__, _HOME, name)


def __dir__() -> list[str]:
    return __all__

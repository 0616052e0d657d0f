"""The one path from matches to a tensor and its motion, the same for every invariant.

In the order in which data passes: ``primitives`` (what a view measures), ``invariant`` (the contract), ``matches`` and
``normalize`` (what was given, checked, at unit size), ``matrix`` (the estimation matrix and its Gram), ``residual``, ``fit``,
``refine``, ``consensus`` (the search behind) ``robust``; what all of them return is in ``solution``, and what every result of
the library derives from, with its status and its notices, in ``outcome``; ``limits`` are numbers that several tasks share.
Nothing here knows an invariant by name.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from dyntorch import _lazily

if TYPE_CHECKING:  # a class to derive from
    from dyntorch.core.outcome import Notice as Notice
    from dyntorch.core.outcome import NoticeCode as NoticeCode
    from dyntorch.core.outcome import Outcome as Outcome

_HOME = {
    "algebraic": "dyntorch.core.residual",
    **dict.fromkeys(("Outcome", "Notice", "NoticeCode", "status_from"), "dyntorch.core.outcome"),
}
__all__ = sorted(_HOME)


def __getattr__(name: str) -> Any:
    return _lazily(__name__, _HOME, name)


def __dir__() -> list[str]:
    return __all__

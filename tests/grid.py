"""A grid of cases as one test."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Sequence
from itertools import product
from typing import Any

import pytest


def grid(*axes: tuple[str | Sequence[str], Sequence[Any]]) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """All combinations of the axes, each as ``pytest.mark.parametrize`` takes it, in one test that lists every one that fails."""
    named = [([names] if isinstance(names, str) else list(names), list(values)) for names, values in axes]

    def decorate(check: Callable[..., None]) -> Callable[..., None]:
        def test(**fixtures: Any) -> None:
            failures = []
            for combination in product(*(values for _, values in named)):
                case: dict[str, Any] = {}
                for (names, _), value in zip(named, combination, strict=True):
                    case.update({names[0]: value} if len(names) == 1 else zip(names, value, strict=True))
                try:
                    check(**fixtures, **case)
                except (AssertionError, pytest.fail.Exception) as error:
                    failures.append(f"{case}: {str(error)[:300]}")
            assert not failures, f"{len(failures)} cases fail:\n" + "\n".join(failures)

        taken = {name for names, _ in named for name in names}
        signature = inspect.signature(check)
        test.__signature__ = signature.replace(parameters=[p for n, p in signature.parameters.items() if n not in taken])  # type: ignore[attr-defined]
        test.__name__, test.__qualname__, test.__doc__, test.__module__ = (
            check.__name__,
            check.__qualname__,
            check.__doc__,
            check.__module__,
        )
        return test

    return decorate


def assert_refused(*cases: tuple[Callable[[], object], str], error: type[Exception] = ValueError) -> None:
    """Every call raises the error in the words beside it; lists all that do not."""
    failures = []
    for number, (call, words) in enumerate(cases):
        try:
            with pytest.raises(error, match=words):
                call()
        except (AssertionError, pytest.fail.Exception) as failure:
            failures.append(f"{number} ({words}): {str(failure)[:300]}")
    assert not failures, f"{len(failures)} calls are not refused as they should be:\n" + "\n".join(failures)

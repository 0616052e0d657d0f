"""What every result derives from: a status per problem, and notices on what limits how far it can be trusted."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields, is_dataclass, replace
from enum import IntEnum, StrEnum
from math import prod
from typing import Any, ClassVar, Self, TypeVar

import numpy as np
import torch
from torch import Tensor

from dyntorch.numerics.arguments import refuse_vmap
from dyntorch.numerics.messages import Message, Words, as_python


class Status(IntEnum):
    """How one problem of a batch ended."""

    OK = 0
    TOO_FEW = 1
    """Fewer matches with weight than determine the tensor.  The tensor is zero."""
    DEGENERATE = 2
    """The matches leave more than the invariant's null space, exactly: several tensors fulfil all of them.  The tensor is zero."""
    AMBIGUOUS = 3
    """Other tensors fit the matches as well as this one, within the noise.  The tensor is one of them."""
    NO_CONSENSUS = 4
    """Robust estimation found no tensor that enough matches agree with.  The tensor is the best one found."""


REMEDY: Mapping[Status, str] = {
    Status.TOO_FEW: "give more matches, or weigh fewer of them 0",
    Status.DEGENERATE: "add matches in general position (other trajectories, other directions of motion), or use a smaller model",
    Status.AMBIGUOUS: "add matches that differ more, lower the noise, or use a model with fewer degrees of freedom",
    Status.NO_CONSENSUS: "raise the {arg:threshold}, or give matches of which more belong to the model",
}
"""What to do, as templates of messages; a task that knows better has its own (:attr:`Outcome.REMEDIES`)."""


def is_failure(status: Tensor) -> Tensor:
    """Where a status leaves no tensor, bool of the same shape."""
    return (status == Status.TOO_FEW) | (status == Status.DEGENERATE)


def has_inliers(status: Tensor) -> Tensor:
    """Where matches agree with what was found, bool of the same shape; elsewhere no match is an inlier of anything."""
    return (status == Status.OK) | (status == Status.AMBIGUOUS)


def status_from(notices: Iterable[Notice]) -> Tensor:
    """The status of one problem with these notices: that of the first that refuses, OK without one."""
    refused = next((notice.code.refuses for notice in notices if notice.code.refuses is not None), Status.OK)
    return torch.tensor(int(refused))


def status_of(degenerate: Tensor, few: Tensor | None = None) -> Tensor:
    """The status where nothing else can fail."""
    status = torch.where(degenerate, int(Status.DEGENERATE), int(Status.OK))
    return status if few is None else torch.where(few, int(Status.TOO_FEW), status)


class NoticeCode(StrEnum):
    """What a :class:`Notice` is about, and its sentence: every task has its own, in its room.

    A member is its code, the template of its message (see :class:`~dyntorch.numerics.messages.Message`; ``value`` is the figure of
    the notice) or one for each case, and for what makes a result refuse the status that it then has.
    """

    templates: Mapping[str, str]
    refuses: Status | None

    def __new__(cls, code: str, template: str | Mapping[str, str], refuses: Status | None = None) -> Self:
        self = str.__new__(cls, code)
        self._value_, self.refuses = code, refuses
        self.templates = {"": template} if isinstance(template, str) else template
        return self


@dataclass(frozen=True)
class Notice:
    """Something about the data of one problem that limits what its result can be trusted for.

    Attributes:
        code: what it is about.
        value: the measured figure behind it.
        values: what else its sentence speaks of, by name; ``case`` chooses among the sentences of the code.
        problem: index into the batch, () for a single problem.
        words: what its sentence calls arguments.
        names: what its sentence calls cameras.
    """

    code: NoticeCode
    value: float = 0.0
    values: Mapping[str, Any] = field(default_factory=dict, hash=False)
    problem: tuple[int, ...] = ()
    words: Words = field(default=as_python, repr=False, compare=False)
    names: Mapping[str, str] = field(default_factory=dict, repr=False, compare=False)

    @property
    def text(self) -> Message:
        """One sentence with the figure and the remedy."""
        template = self.code.templates[self.values.get("case", "")]
        return Message(template, self.words, self.names, **{"value": self.value, **self.values})

    def with_words(self, words: Words) -> Notice:
        """The same, with what a surface calls the arguments."""
        return replace(self, words=words)

    def with_names(self, names: Mapping[str, str]) -> Notice:
        """The same, with the names of cameras; names that were given before stay."""
        values = {key: value.with_names(names) if isinstance(value, Message) else value for key, value in self.values.items()}
        return replace(self, names={**names, **self.names}, values=values)

    def __str__(self) -> str:
        place = f"problem {', '.join(map(str, self.problem))}: " if self.problem else ""
        return f"{place}{self.code}: {self.text}"


def notices(code: NoticeCode, values: Tensor, flagged: Tensor, batch: tuple[int, ...], **more: Any) -> list[Notice]:
    """A notice for every flagged problem. values ``(b,)``, flagged ``(b,)``; what ``more`` it speaks of may be ``(b,)``, too."""
    # one copy: an accelerator would wait for every number
    figures = torch.where(flagged, values.detach().double(), torch.nan), flagged.double()
    collected = []
    for flat, (value, counts) in enumerate(zip(*torch.stack(figures).tolist(), strict=True)):
        if counts:
            place = tuple(int(i) for i in np.unravel_index(flat, batch)) if batch else ()
            own = {name: one[flat].item() if isinstance(one, Tensor) else one for name, one in more.items()}
            collected.append(Notice(code, value, own, place))
    return collected


Note = Callable[..., None]


def noting(batch: tuple[int, ...]) -> tuple[list[Notice], Note]:
    """An empty list, and what adds to it: :func:`notices` of a batch."""
    collected: list[Notice] = []

    def note(code: NoticeCode, values: Tensor, flagged: Tensor, **more: Any) -> None:
        collected.extend(notices(code, values, flagged, batch, **more))

    return collected, note


def in_order(notices: Iterable[Notice]) -> tuple[Notice, ...]:
    """Notices in the order of their problems."""
    return tuple(sorted(notices, key=lambda notice: notice.problem))


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class Outcome:
    """How a verb ended, problem by problem.

    Attributes:
        status: ``(*batch,)`` of :class:`dyntorch.Status` values, () for one problem.
        notices: what limits how far the result can be trusted, in the order of the batch.
    """

    TASK: ClassVar[str] = ""
    """What was tried."""
    REMEDIES: ClassVar[Mapping[Status, str]] = REMEDY
    """What was wrong, and what to do about it, as templates of messages."""

    status: Tensor
    notices: tuple[Notice, ...] = ()

    @property
    def task(self) -> str:
        """What was tried, as :meth:`check` calls it."""
        return self.TASK or type(self).__name__

    @property
    def warnings(self) -> tuple[Notice, ...]:
        """The notices."""
        return self.notices

    @property
    def reason(self) -> str:
        """Why a single problem is not OK, and what to do; empty where it is.  Of a batch: see :meth:`check`."""
        return self.refusal()

    def refusal(self, words: Words | None = None, status: Status | None = None) -> str:
        """:attr:`reason` with what a surface calls the arguments; by default in the words that the notices have.

        Args:
            words: what arguments are called.
            status: another than that of the problem.
        """
        status = self._single() if status is None else status
        if status == Status.OK:
            return ""
        messages = [notice.text if words is None else notice.with_words(words).text for notice in self._telling(status)]
        return "; ".join(messages[:2]) or Message(self.REMEDIES[status], words or as_python)

    def check(self) -> Self:
        """Raise where any problem failed.

        Raises:
            ValueError: says which problems failed, how, and what to do.
        """
        check_status(self.task, self.status, self.notices, self.REMEDIES)
        return self

    def count_statuses(self) -> str:
        """How many problems ended how: ``2 OK, 1 TOO_FEW``."""
        states = Counter(self.status.reshape(-1).tolist())
        return ", ".join(f"{count} {Status(state).name}" for state, count in sorted(states.items())) or "empty"

    def head(self, **what: object) -> str:
        """First line of a representation: the class, what it is of, the batch and its states."""
        of = ", ".join(f"{name}={value}" for name, value in what.items())
        return f"{type(self).__name__}({of}{', ' if of else ''}batch={tuple(self.status.shape)}: {self.count_statuses()})"

    def warning_lines(self) -> list[str]:
        """Lines of a representation: the notices of one problem, or how many problems of a batch have which."""
        if not self.status.ndim:
            return [f"  warning {notice}" for notice in self.notices]
        seen = Counter(code for code, _ in {(notice.code.value, notice.problem) for notice in self.notices})
        return [f"  warning {code}: {count} of {self.status.numel()} problems" for code, count in sorted(seen.items())]

    def _single(self) -> Status:
        if self.status.numel() != 1:
            raise ValueError(f"the result is that of {self.status.numel()} problems, which have no common reason; see status")
        return Status(int(self.status))

    def _telling(self, status: Status) -> Sequence[Notice]:
        """The notices that say why a problem has this status, the first ones first."""
        refusing = [notice for notice in self.notices if notice.code.refuses is not None]
        return refusing or self.notices


def check_status(what: str, status: Tensor, notices: Sequence[Notice] = (), remedies: Mapping[Status, str] = REMEDY) -> None:
    """Raise where any problem failed. status ``(*batch,)``."""
    refuse_vmap("status", status, "return what is needed from the function that is mapped, and look at its status behind that")
    flat = status.reshape(-1)
    places = np.arange(len(flat)).reshape(tuple(status.shape))
    for state in Status:
        where = (flat == state).nonzero().flatten().tolist()
        if state != Status.OK and where:
            shown = ", ".join(map(str, where[:8])) + (", ..." if len(where) > 8 else "")
            problems = f"problem {shown} of {len(flat)}" if status.ndim else "the problem"
            reasons = [str(notice) for notice in notices if int(places[notice.problem]) in where]
            details = f" ({'; '.join(reasons[:3])})" if reasons else ""
            raise ValueError(f"{what}: {problems}: {state.name}; {Message(remedies[state])}{details}")


# ----------------------------------------------------------------------------------------------------------------------
# A batch of problems that a search solves one after the other: results stacked, and one bad problem that spoils no other.


Result = TypeVar("Result")


def solve_one_by_one(batch: Sequence[int], solve: Callable[[int], Result], spare: Callable[[str], Result]) -> Result:
    """The results of all problems, as :func:`stack_results` makes one of them."""
    if not prod(batch):
        raise ValueError(f"the batch {tuple(batch)} holds no problem; give one at least")
    results: list[Result | str] = []
    errors = []
    for place in range(prod(batch)):
        try:
            results.append(solve(place))
        except ValueError as problem:
            errors.append(problem)
            results.append(str(problem))
    if len(errors) == len(results):
        raise errors[0]
    return stack_results([spare(one) if isinstance(one, str) else one for one in results], batch)


def stack_results(results: Sequence[Result], batch: Sequence[int]) -> Result:
    """One result of several: tensors with the batch in front, numbers as tensors ``(*batch,)``, the notices of all problems."""
    first = next((one for one in results if one is not None), None)
    if first is None:
        return results[0]
    if isinstance(first, Tensor):
        return _pad_and_stack([one if isinstance(one, Tensor) else first.new_full((0,) * first.ndim, 0) for one in results], batch)  # type: ignore[return-value]
    if isinstance(first, bool | int | float):
        kind = torch.bool if isinstance(first, bool) else torch.float64 if isinstance(first, float) else torch.int64
        return torch.tensor(results, dtype=kind).reshape(*batch)  # type: ignore[return-value]
    if is_dataclass(first) and not isinstance(first, type):
        parts: dict[str, Any] = {}
        for one in fields(first):
            values = [getattr(result, one.name) for result in results]
            parts[one.name] = _place_notices(values, batch) if one.name == "notices" else stack_results(values, batch)
        return replace(first, **parts)
    tuples = isinstance(first, tuple) and all(isinstance(one, tuple) and len(one) == len(first) for one in results)
    # tensors say no single word on whether they are equal
    plain = not isinstance(first, tuple) or not any(isinstance(part, Tensor) for one in results for part in one)  # type: ignore[attr-defined]
    if plain and all(one == first for one in results):
        return first
    if tuples:
        return tuple(stack_results(part, batch) for part in zip(*results, strict=True))  # type: ignore[return-value]
    return tuple(results)  # type: ignore[return-value]


def _pad_and_stack(tensors: Sequence[Tensor], batch: Sequence[int]) -> Tensor:
    shape = [max(sizes) for sizes in zip(*(x.shape for x in tensors), strict=True)]
    like = tensors[0]
    blank = float("nan") if like.is_floating_point() else 0 if like.dtype == torch.bool else -1
    stacked = like.new_full((len(tensors), *shape), blank)
    for place, x in enumerate(tensors):
        stacked[place][tuple([slice(size) for size in x.shape])] = x
    return stacked.reshape(*batch, *shape)


def _place_notices(notices: Sequence[Sequence[Notice]], batch: Sequence[int]) -> tuple[Notice, ...]:
    """Notices with the places of their problems."""
    places = [tuple(int(i) for i in np.unravel_index(place, tuple(batch))) for place in range(len(notices))]
    return in_order(replace(notice, problem=place) for place, some in zip(places, notices, strict=True) for notice in some)


def trim_padding(x: Tensor) -> Tensor:
    """Tracks ``(frames, n, 2)`` without the last frames that show no point: those fill a batch of takes of different lengths."""
    shown = x.isfinite().all(-1).any(-1).nonzero()
    return x[: int(shown[-1, 0]) + 1] if len(shown) else x[:0]


def select_problem(value: Any, place: int, batch: Sequence[int], own: int) -> Any:
    """The part of a value that belongs to a problem: a tensor with more than ``own`` dimensions has those of the batch in front."""
    if not isinstance(value, Tensor) or value.ndim <= own:
        return value
    return value.expand(*batch, *value.shape[value.ndim - own :]).reshape(prod(batch), *value.shape[value.ndim - own :])[place]

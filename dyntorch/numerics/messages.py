"""Sentences that keep their data: who prints them words the arguments and cameras that they speak of, and parses nothing."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from string import Formatter
from typing import Any

Words = Callable[[str, str | None], str]
"""What a surface calls an argument: takes its name, and what follows the ``=``; None where the argument alone is meant."""


def as_python(name: str, value: str | None) -> str:
    """An argument as a caller of the library writes it.

    Example:
        >>> as_python("threshold", "None"), as_python("static", ""), as_python("max_shift", None)
        ('threshold=None', 'static=', 'max_shift')
    """
    return name if value is None else f"{name}={value}"


class Message(str):
    """A sentence that was made from a template and values, and can be made again in other words.

    As a string it is the sentence in the words of Python.  The template is one of :meth:`str.format`, with four fields of its own:

    - ``{arg:name}``, ``{arg:name=value}``: an argument of a verb;
    - ``{camera:a}``: a camera, by the name that the library has for it;
    - ``{value:# point is|# points are}``: one or many, by the value, which stands for ``#``;
    - ``{ends:pairs}``, ``{which:cameras}``: pairs of cameras and lists of them, by number.

    A value that is a message itself gets the words of the message around it.

    Args:
        template: the sentence.
        words: what arguments are called.
        names: what cameras are called; those that are missing keep their own.
        values: what the fields stand for.

    Example:
        >>> said = Message("nothing moves in {camera:a}; {arg:max_shift} is {value:g}", value=2)
        >>> said
        'nothing moves in a; max_shift is 2'
        >>> said.with_names({"a": "left"}).with_words(lambda name, value: "--" + name.replace("_", "-"))
        'nothing moves in left; --max-shift is 2'
        >>> [Message("{n:# point is|# points are} off", n=n) for n in (1, 11)]
        ['1 point is off', '11 points are off']
    """

    template: str
    values: Mapping[str, Any]
    words: Words
    names: Mapping[str, str]

    def __new__(cls, template: str, words: Words = as_python, names: Mapping[str, str] | None = None, /, **values: Any) -> Message:
        self = super().__new__(cls, _Form(words, names or {}).vformat(template, (), values))
        self.template, self.values, self.words, self.names = template, values, words, names or {}
        return self

    def __getnewargs_ex__(self) -> tuple[tuple[Any, ...], dict[str, Any]]:
        return (self.template, self.words, self.names), dict(self.values)

    def with_words(self, words: Words) -> Message:
        """The same, with what a surface calls the arguments."""
        return Message(self.template, words, self.names, **self.values)

    def with_names(self, names: Mapping[str, str]) -> Message:
        """The same, with the names of the cameras; names that were given before stay."""
        values = {key: value.with_names(names) if isinstance(value, Message) else value for key, value in self.values.items()}
        return Message(self.template, self.words, {**names, **self.names}, **values)


def with_words(text: object, words: Words) -> str:
    """What is said by a message or an error with one, in these words; anything else as it is.

    Example:
        >>> error = ValueError(Message("give {arg:times=}"))
        >>> with_words(error, lambda name, value: f"--{name}"), with_words("a plain one", as_python)
        ('give --times', 'a plain one')
    """
    message = text.args[0] if isinstance(text, Exception) and len(text.args) == 1 else text
    return message.with_words(words) if isinstance(message, Message) else str(text)


def with_names(text: object, names: Mapping[str, str]) -> str:
    """The same with the names of cameras."""
    message = text.args[0] if isinstance(text, Exception) and len(text.args) == 1 else text
    return message.with_names(names) if isinstance(message, Message) else str(text)


class _Form(Formatter):
    """The fields of a template."""

    def __init__(self, words: Words, names: Mapping[str, str]) -> None:
        self.words, self.names = words, names

    def get_value(self, key: int | str, args: Sequence[Any], kwargs: Mapping[str, Any]) -> Any:
        return _OWN[key] if key in _OWN else super().get_value(key, args, kwargs)

    def format_field(self, value: Any, format_spec: str) -> str:
        if value is _OWN["arg"]:
            name, given, rest = format_spec.partition("=")
            return self.words(name, rest if given else None)
        if value is _OWN["camera"]:
            return self._name(format_spec)
        if isinstance(value, Message):
            return value if self.words is as_python else value.with_words(self.words)
        if format_spec == "cameras":
            return f"camera{'s' if len(value) > 1 else ''} {', '.join(map(self._name, value))}"
        if format_spec == "pairs":
            return ", ".join(f"{self._name(i)}-{self._name(j)}" for i, j in value)
        if "|" in format_spec:
            singular, plural = format_spec.split("|")
            return (singular if value == 1 else plural).replace("#", f"{value:g}")
        return str(super().format_field(value, format_spec))

    def _name(self, camera: object) -> str:
        return self.names.get(str(camera), str(camera))


_OWN: dict[int | str, object] = {"arg": object(), "camera": object()}

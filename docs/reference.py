"""The pages of the API reference: one for each room that public names live in, and one for each public module.

Which room a name lives in is asked of the lazy tables of both packages; nothing is listed here by hand but the packages.  Sphinx
is not needed for that, so a test can see that nothing public is left out.
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from importlib import import_module
from types import ModuleType
from typing import Any

PACKAGES = ("dyntorch", "indexing")
FACES = {"indexing": ("actors", "calibrate", "colmap", "labels", "pose")}
"""Public packages that no table names, as they are imported by their own name."""

QUOTED = re.compile(r"(``.*?``|:\w+(?::\w+)?:`.*?`|`.*?`)")
LOOSE_STAR = re.compile(r"(?<![\w*])\*(?=\w)(?![^*]*\w\*)")
LAST_UNDERSCORE = re.compile(r"(?<=\w)_(?!\w)")


@dataclass
class Page:
    """One page: its title, the room (a module), and the public names on it, each as (where to import it from, its name)."""

    title: str
    room: ModuleType
    names: list[tuple[str, str]] = field(default_factory=list)

    @property
    def file(self) -> str:
        """Without ending."""
        return self.title.replace(".", "-")


def pages() -> list[Page]:
    """All pages, in the order in which the tables name the rooms."""
    found: dict[str, Page] = {}
    for name in PACKAGES:
        package = import_module(name)
        _by_room(found, package, package._HOME)
        for module in (*getattr(package, "_MODULES", ()), *FACES.get(name, ())):
            whole = getattr(package, module, None) or import_module(f"{name}.{module}")
            own = [public for public in members(whole) if not (public in package.__all__ and _same(package, whole, public))]
            if hasattr(whole, "_HOME"):
                _by_room(found, whole, {public: whole._HOME[public] for public in own})
            elif own:
                page = found.setdefault(f"{name}.{module}", Page(f"{name}.{module}", whole))
                page.names += [(whole.__name__, public) for public in own]
    for page in found.values():
        listed = {public for _, public in page.names}
        page.names += dict.fromkeys(one for one in _results(page) if one[1] not in listed)
    return list(found.values())


def _by_room(found: dict[str, Page], package: ModuleType, home: Mapping[str, str]) -> None:
    """Put public names of a package on the pages of the rooms that they live in."""
    for public, module in home.items():
        room = room_of(module).__name__
        found.setdefault(room, Page(room, import_module(room))).names.append((package.__name__, public))


def room_of(home: str) -> ModuleType:
    """The package that a module stands in; of a package, itself."""
    module = import_module(home)
    return module if hasattr(module, "__path__") else import_module(home.rpartition(".")[0])


def _same(package: ModuleType, module: ModuleType, name: str) -> bool:
    """Whether a public name of a package is the same thing in one of its modules, and not only called alike."""
    return hasattr(module, name) and getattr(module, name) is getattr(package, name)


def members(module: ModuleType) -> list[str]:
    """Public names of a module: those that it lists, or else what it defines without an underscore."""
    listed = getattr(module, "__all__", None)
    if listed is not None:
        return sorted(listed)
    return sorted(
        name
        for name, value in vars(module).items()
        if not name.startswith("_") and getattr(value, "__module__", None) == module.__name__ and callable(value)
    )


def _results(page: Page) -> Iterator[tuple[str, str]]:
    """What the functions of a page return, where that is a class of the package without a public name."""
    package = import_module(page.room.__name__.partition(".")[0])
    for where, name in tuple(page.names):
        value = inspect.unwrap(getattr(import_module(where), name))
        if not inspect.isfunction(value):
            continue
        for word in re.findall(r"\w+", str(value.__annotations__.get("return", ""))):
            one = value.__globals__.get(word)
            if inspect.isclass(one) and within(one.__module__, package.__name__) and word not in package.__all__:
                yield one.__module__, word


def within(module: str, package: str) -> bool:
    """Whether a module is the package or a part of it."""
    return module == package or module.startswith(f"{package}.")


def text(page: Page) -> str:
    """A page in reST: what the room says of itself, a table of its names, then each with its whole text."""
    room = page.room.__name__
    lines = [
        f"``{page.title}``",
        "=" * (len(page.title) + 4),
        "",
        f".. automodule:: {room}",
        "   :no-members:",
        "   :no-index:",
        "",
    ]
    lines += [".. list-table::", "   :widths: 30 70", ""]
    for where, name in page.names:
        lines += [f"   * - {_link(where, name)}", f"     - {_first(getattr(import_module(where), name))}"]
    for where, name in page.names:
        value = getattr(import_module(where), name)
        if inspect.isclass(value):
            said = [f".. autoclass:: {where}.{name}", "   :members:"]
        elif callable(value):
            said = [f".. autofunction:: {where}.{name}"]
        else:  # a table or a list of names: what it holds is what there is to say
            said = [f".. py:data:: {where}.{name}", "", "   " + ", ".join(f"``{one}``" for one in value)]
        lines += ["", name, "-" * len(name), "", *said]
    return "\n".join(lines) + "\n"


def _link(where: str, name: str) -> str:
    value = getattr(import_module(where), name)
    role = "class" if inspect.isclass(value) else "func" if callable(value) else "data"
    return f":{role}:`{name} <{where}.{name}>`"


def _first(value: Any) -> str:
    """First paragraph of the docstring, on one line."""
    if not (inspect.isclass(value) or callable(value)):
        return ""
    return escaped(" ".join((inspect.getdoc(value) or "").split("\n\n")[0].split()))


def member_text(kind: type, name: str) -> str | None:
    """The docstring of a method or property, its own or the next one above; None of anything else.

    Access to it on the class may give something else: a bound function, a number.
    """
    found = None
    for one in kind.__mro__:
        member = vars(one).get(name)
        function = getattr(member, "function", None) or getattr(member, "fget", None) or member
        if inspect.isroutine(getattr(function, "__func__", function)):
            said = getattr(function, "__doc__", None)
            if said:
                return inspect.cleandoc(said)
            found = ""
    return found


def escaped(line: str) -> str:
    r"""A line of a docstring in which unquoted names that end in ``_`` and shapes that begin with ``*`` are no markup.

    Example:
        >>> escaped("``labels_`` and classes_, (*batch, n), *this* stays")
        '``labels_`` and classes\\_, (\\*batch, n), *this* stays'
    """
    parts = QUOTED.split(line)
    for number in range(0, len(parts), 2):
        parts[number] = LOOSE_STAR.sub(r"\\*", LAST_UNDERSCORE.sub(r"\\_", parts[number]))
    return "".join(parts)


def index(every: list[Page]) -> str:
    """The list of all pages, in reST."""
    lines = ["Reference", "=========", "", "Every public name, by the room that it lives in.", ""]
    lines += [".. list-table::", "   :widths: 30 70", ""]
    for page in every:
        lines += [
            f"   * - :doc:`{page.title} <{page.file}>`",
            "     - " + ", ".join(f"``{name}``" for _, name in page.names),
        ]
    lines += ["", ".. toctree::", "   :hidden:", ""]
    return "\n".join([*lines, *(f"   {page.file}" for page in every)]) + "\n"

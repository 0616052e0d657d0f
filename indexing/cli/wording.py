"""What the parser of the command line says, in our words: one line that names the flag, what was given and what is expected."""

from __future__ import annotations

import difflib
import re
from collections.abc import Callable

from indexing.cli.console import one_line


def reworded(text: str, command: str) -> str:
    """The parser's message, which it draws in a box with rules between the parts, as one line in our words.

    Args:
        command: that explains more.
    """
    parts = [""]
    lines = text.splitlines()
    if len(lines) > 1 and lines[1].strip() and not lines[1].strip().strip("-"):  # no box, but a title above a rule: drop it, too
        lines = lines[2:]
    for line in lines:
        words = line.strip().strip("│|").strip()
        if not words.strip("─-╰╯+"):
            parts.append("")
        elif not words.startswith(("╭", "+")):  # the box's title says what its text says
            parts[-1] += f" {words}"
    kept = [part.strip().removesuffix(".") for part in parts if part.strip() and "Argument helptext:" not in part]
    said = one_line("; ".join(kept)).replace("[bold]", "").replace("[/bold]", "")
    said = re.sub(r"(; )?For full helptext,? .*", "", said)
    for pattern, reword in REWORDED:
        said = re.sub(pattern, reword, said)
    return f"{said or 'the command line makes no sense'}; see {command}".replace("?; see", "? see")


def _kind(types: str) -> str:
    """What a flag expects, from the parser's names of types: ``INT|{auto}`` is a whole number or auto."""
    words = types.strip("{}").replace("{", "").replace("}", "")
    if " " in words and "|" not in words:
        return f"{len(words.split())} numbers"
    names = {"INT": "a whole number", "FLOAT": "a number", "PATH": "a file or folder", "STR": "a word"}
    return " or ".join(names.get(word.strip(), word.strip()) for word in words.split("|"))


def _no_such_type(found: re.Match[str]) -> str:
    return f"{found['flag']} {found['given']}: expected {_kind(found['types'])}"


def _no_number(found: re.Match[str]) -> str:
    return f"{found['flag']} {found['given']}: expected {'a whole number' if found['kind'] == 'int' else 'a number'}"


def _no_choice(found: re.Match[str]) -> str:
    """The choices in alphabetical order (the parser's own differs from run to run), the nearest one first."""
    choices = sorted(set(re.findall(r"'([^']*)'", found["choices"])) - {"None"})
    near = difflib.get_close_matches(found["given"], choices, 1)
    return (
        f"{found['flag']} {found['given']}: " + (f"did you mean {near[0]}? " if near else "") + f"choose from {', '.join(choices)}"
    )


def _no_option(found: re.Match[str]) -> str:
    given = found["given"].split(", ")
    wrong = next((word for word in given if word.startswith("-")), given[0])
    near = re.search(r"Perhaps you meant:?.*?(--[\w-]+)", found["more"] or "")
    if near and wrong.startswith("-"):
        return f"unknown option {wrong}; did you mean {near[1]}?"
    among = re.search(r"Available subcommands: ([^;]*)", found["more"] or "")
    if among:
        near_word = difflib.get_close_matches(wrong, among[1].split(", "), 1)
        meant = f"did you mean {near_word[0]}? " if near_word else ""
        return f"unknown command {wrong}; {meant}choose from {among[1]}"
    return f"unknown option {wrong}" if wrong.startswith("-") else f"unexpected {wrong!r}; leave it out"


def _no_value(found: re.Match[str]) -> str:
    return f"{found['flag']}: " + ("its value is missing" if found["number"] == "1" else f"expected {found['number']} values")


def _missing(found: re.Match[str]) -> str:
    name = re.match(r"(?:--[\w-]+ )?[A-Z]+", found["what"])
    return f"missing: {name[0]} ({found['what'][name.end() :].strip()})" if name else f"missing: {found['what']}"


REWORDED: tuple[tuple[str, Callable[[re.Match[str]], str]], ...] = (
    (
        r"Error parsing (?P<flag>\S+): no type matching (?P<types>.*?) could be instantiated from \[(?P<given>.*?)\]; Got errors:"
        r".*",
        _no_such_type,
    ),
    (
        r"Error parsing (?P<flag>\S+): (?:invalid literal for |could not convert string to )(?P<kind>int|float)\b"
        r".*?(?P<given>'[^']*')",
        _no_number,
    ),
    (
        r"invalid choice '(?P<given>.*?)' for argument '(?P<flag>.*?)'\. Expected one of (?P<choices>\(.*?\))",
        _no_choice,
    ),
    (r"Unrecognized options: (?P<given>[^;]*)(?P<more>;.*)?", _no_option),
    (r"Missing value for argument '(?:\(')?(?P<flag>[^',]*).*?'\. Expected (?P<number>\d+) values", _no_value),
    (r"Missing from dyntorch[^:]*: (?:-\w [A-Z]+, )?(?P<what>.*?) \(required\)", _missing),
)
"""What the parser says -> what we say."""

"""Runs what a document shows, as a reader would who types it: the commands and the Python, in one folder, one after the other.

``$ `` begins a command of ``dyntorch`` (or ``cd``), the lines under it are an excerpt of its output, in order; a Python block is
followed by a block of what it prints, if it prints anything.  Numbers are compared within the digits that are shown.
"""

from __future__ import annotations

import contextlib
import io
import os
import re
import shlex
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from indexing.cli import main

FENCE = re.compile(r"^```(?P<kind>\w*)\n(?P<text>.*?)^```$", re.DOTALL | re.MULTILINE)
EXIT = re.compile(r" # exit code (\d)$")
RULE = re.compile(r"[\s─]*")


@dataclass(frozen=True)
class Step:
    """What is typed, what is shown under it, and, for a command, how it ends."""

    typed: str
    shown: str
    python: bool
    code: int = 0


def steps(text: str) -> Iterator[Step]:
    """The commands and Python blocks of a Markdown document, in order."""
    blocks = [(found["kind"], found["text"]) for found in FENCE.finditer(text)]
    for number, (kind, block) in enumerate(blocks):
        if kind == "python":
            follower, below = blocks[number + 1] if number + 1 < len(blocks) else ("python", "")
            yield Step(block, "" if follower or below.startswith("$ ") else below, True)
        elif not kind and block.startswith("$ "):
            for part in re.split(r"^\$ ", block, flags=re.MULTILINE)[1:]:
                line, _, shown = part.partition("\n")
                code = EXIT.search(line)
                yield Step(EXIT.sub("", line), shown, False, int(code[1]) if code else 0)


def difference(shown: str, printed: str) -> str:
    """Where two outputs differ; empty where they say the same.

    Spaces do not count.  Whole numbers are equal; decimal numbers and percentages may differ by one in the last digit printed,
    as the last digits of a computation differ between processors.
    """
    ours, theirs = (re.findall(r"[-+]?\d+(?:\.\d*)?(?: ?%)?|[^\s\d]+", text) for text in (shown, printed))
    if len(ours) != len(theirs):
        return f"{len(ours)} words shown, {len(theirs)} printed: {printed}"
    for a, b in zip(ours, theirs, strict=True):
        if a == b:
            continue
        try:
            x, y = float(a.rstrip(" %")), float(b.rstrip(" %"))
        except ValueError:
            return f"shown {a!r}, printed {b!r}"
        digits = max(len(number.rstrip(" %").partition(".")[2]) for number in (a, b))
        if not (digits or a.endswith("%")) or abs(x - y) > 1.001 * 10.0**-digits:
            return f"shown {a}, printed {b}"
    return ""


def excerpt(shown: str, printed: str) -> str:
    """The first line of ``shown`` that ``printed`` does not have, after those before it; empty where it has them all in order."""
    left = iter([line for line in printed.splitlines() if not RULE.fullmatch(line)])
    for line in shown.splitlines():
        if not RULE.fullmatch(line) and not any(difference(line, other) == "" for other in left):
            return f"not printed, or not at its place: {line!r}\n{printed}"
    return ""


def run(document: Path, folder: Path) -> list[str]:
    """Run a document in a folder.

    Returns:
        what went otherwise than it says.
    """
    wrong = []
    with contextlib.chdir(folder):
        for step in steps(document.read_text(encoding="utf-8")):
            problem = _python(step, document) if step.python else _command(step)
            if problem:
                wrong.append(f"{document.name}: {step.typed.splitlines()[0]}: {problem}")
    return wrong


def _python(step: Step, document: Path) -> str:
    out = io.StringIO()
    with contextlib.redirect_stdout(out), warnings.catch_warnings():
        warnings.filterwarnings("error", category=DeprecationWarning, message="dyntorch")  # a name that has moved
        exec(compile(step.typed, str(document), "exec"), {"__name__": "__main__"})
    return difference(step.shown, out.getvalue())


def _command(step: Step) -> str:
    program, *words = shlex.split(step.typed, comments=True)
    if program == "cd":
        os.chdir(words[0])
        return ""
    assert program == "dyntorch", step.typed
    words = [name for word in words for name in (sorted(map(str, Path().glob(word))) if "*" in word else [word])]
    out = io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(out):
        code = main(words)
    if code != step.code:
        return f"exit code {code}: {out.getvalue()}"
    return excerpt(step.shown, out.getvalue())

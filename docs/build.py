"""``make docs``: the API reference as HTML in ``site/``, readable without a network.

The packages resolve their public names when these are used; pdoc reads what a module holds.  So all names are resolved first.
Formulas become MathML, which browsers set by themselves: no script is loaded from anywhere.
"""

from __future__ import annotations

import html
import re
import sys
import warnings
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any

import jinja2
import pdoc
from latex2mathml.converter import convert
from pdoc.render_helpers import to_markdown_with_context

PACKAGES = ("dyntorch", "indexing")
ROOMS = ("dyntorch.tasks.alignment", "dyntorch.tasks.reconstruction", "indexing.actors")
"""Beside the public names: the results of the tasks that have no public name, and what makes synthetic people."""
INLINE = re.compile(r":math:`(?P<tex>[^`]+)`")
BLOCK = re.compile(r"^(?P<indent>[ \t]*)\.\. math::(?P<tex>[^\n]*(?:\n(?:[ \t]*\n)*(?P=indent)[ \t]+[^\n]+)*)", re.MULTILINE)
TABLE = re.compile(
    r"^(?P<indent>[ \t]*)(?P<rule>=+(?: +=+)+)\n(?P<body>(?:(?P=indent)[^\n]*\n|[ \t]*\n)+?)(?P=indent)(?P=rule)\n\n", re.MULTILINE
)


def resolve(package: ModuleType) -> None:
    """Put every public name of a package into it, as if it had been imported there."""
    for name in package.__all__:
        vars(package)[name] = getattr(package, name)


def formula(tex: str, display: str) -> str:
    """MathML of a formula; its source where the converter does not know it."""
    text = " ".join(tex.split())
    try:
        return convert(text, display=display)
    except Exception as problem:  # the converter raises what it likes; the formula stays readable as it is
        print(f"docs: left as it is ({type(problem).__name__}): {text}", file=sys.stderr)
        return f"<code>{html.escape(text)}</code>"


def table(found: re.Match[str]) -> str:
    """A simple table of reST as one of Markdown."""
    rule, indent = found["rule"], found["indent"]
    spans = [match.span() for match in re.finditer("=+", rule)]
    ends = [start for start, _ in spans[1:]] + [None]
    lines = [line.removeprefix(indent) for line in found["body"].splitlines() if line.strip() and line.strip() != rule]
    rows = [[line[start:end].strip() for (start, _), end in zip(spans, ends, strict=True)] for line in lines]
    rows.insert(1, ["---"] * len(spans))
    return "\n".join(f"{indent}| {' | '.join(row)} |" for row in rows) + "\n\n"


def with_formulas(docstring: str) -> str:
    """A docstring whose formulas are MathML, and whose tables are Markdown's.

    Example:
        >>> with_formulas("the angle :math:`x`")[:20]
        'the angle <math xmln'
    """
    text = BLOCK.sub(lambda found: f"{found['indent']}{formula(found['tex'], 'block')}\n", docstring)
    text = TABLE.sub(table, text).replace("`~", "`").replace("\\_", "_")
    return INLINE.sub(lambda found: formula(found["tex"], "inline"), text)


@jinja2.pass_context
def to_markdown(context: jinja2.runtime.Context, docstring: str) -> str:
    """pdoc's own conversion, after the formulas."""
    return to_markdown_with_context(context, with_formulas(docstring))


def main(folder: Path = Path("site")) -> None:
    """Write the site."""
    for name in PACKAGES:
        resolve(import_module(name))
    pdoc.render.configure(docformat="google", show_source=True, footer_text="dyntorch")
    filters: dict[str, Any] = pdoc.render.env.filters
    filters["to_markdown"] = to_markdown
    # about the generated __init__ of dataclasses, whose fields are documented anyway
    warnings.filterwarnings("ignore", message="Error parsing type annotation", category=UserWarning)
    pdoc.pdoc(*PACKAGES, *ROOMS, output_directory=folder)
    print(f"docs: {folder / 'index.html'}")


if __name__ == "__main__":
    main()

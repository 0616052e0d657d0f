"""How Sphinx builds the documentation: ``make docs``.  Nothing is fetched, neither while building nor while reading."""

from __future__ import annotations

import html
import re
import sys
from pathlib import Path
from typing import Any

from docutils import nodes
from latex2mathml.converter import convert

HERE = Path(__file__).parent
sys.path[:0] = [str(HERE), str(HERE.parent)]

import reference  # noqa: E402 (it stands beside this file)

import dyntorch  # noqa: E402 (the checkout, wherever it is built)

project = "dyntorch"
author = "The dyntorch authors"
project_copyright = author
version = release = dyntorch.__version__
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx_gallery.gen_gallery"]
exclude_patterns = ["goals.md", "gallery", "_build"]
myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 3
suppress_warnings = ["config.cache"]

# ---- the reference
API = HERE / "api"
toc_object_entries = False
autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_typehints_format = "short"
python_use_unqualified_type_names = True
python_maximum_signature_line_length = 100
autodoc_type_aliases = {"ArrayLike": "ArrayLike"}
autodoc_class_signature = "mixed"
napoleon_numpy_docstring = False
napoleon_use_ivar = True
napoleon_custom_sections = [("Source", "notes_style"), "Sources"]

# ---- the gallery
sphinx_gallery_conf = {
    "examples_dirs": "gallery",
    "gallery_dirs": "auto_gallery",
    "filename_pattern": r"plot_",
    "download_all_examples": False,
    "show_memory": False,
    "show_signature": False,
    "remove_config_comments": True,
    "within_subsection_order": "FileNameSortKey",
    "abort_on_example_error": True,
    "write_computation_times": False,
    "reset_modules": ("style.apply",),
    "subsection_order": ["gallery/recognition", "gallery/cameras", "gallery/geometry"],
    "nested_sections": True,
}

# ---- how it looks
html_theme = "pydata_sphinx_theme"
html_title = "dyntorch"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_copy_source = False
html_show_sourcelink = False
html_show_sphinx = False
html_context = {"default_mode": "auto"}
html_theme_options = {
    "show_prev_next": False,
    "navigation_with_keys": False,
    "navbar_align": "left",
    "navbar_end": ["theme-switcher"],
    "secondary_sidebar_items": ["page-toc"],
    "footer_start": ["copyright"],
    "footer_end": [],
    "show_toc_level": 2,
}
html_math_renderer = "mathml"


def _mathml(self: Any, node: nodes.Element, display: str) -> None:
    """A formula as MathML, which browsers set by themselves; its source where the converter does not know it."""
    try:
        text = convert(" ".join(node.astext().split()), display=display)
    except Exception as problem:  # the converter raises what it likes; with -W the warning stops the build
        from sphinx.util import logging

        logging.getLogger(__name__).warning("formula %r: %s", node.astext(), type(problem).__name__)
        text = f"<code>{html.escape(node.astext())}</code>"
    self.body.append(f'<div class="formula">{text}</div>' if display == "block" else text)
    raise nodes.SkipNode


def _escaped(app: Any, what: str, name: str, obj: Any, options: Any, lines: list[str]) -> None:
    """The text of methods that may be called on the class; names and shapes that look like markup are none."""
    if what in ("method", "property", "attribute"):
        path, member = name.rsplit(".", 1)
        module, kind = path.rsplit(".", 1)
        own = reference.member_text(getattr(sys.modules[module], kind), member)
        if own is not None:
            lines[:] = [*own.splitlines(), ""]
    if what in ("property", "attribute", "data"):
        lines.insert(0, "")  # or napoleon takes what stands before a colon for a type
    lines[:] = [line if line.lstrip().startswith((">>>", "...", "..")) else reference.escaped(line) for line in lines]


def _skipped(app: Any, what: str, name: str, obj: Any, skip: bool, options: Any) -> bool | None:
    """What scikit-learn adds to every estimator is its own matter."""
    return True if re.fullmatch(r"set_\w+_request|get_metadata_routing", name) else None


def _offline(app: Any, problem: Exception | None) -> None:
    """Refuse a site of which a page fetches anything when it is read."""
    for page in () if problem else Path(app.outdir).rglob("*.html"):
        fetched = re.findall(r'<(?:script|link|img|iframe)\b[^>]*(?:src|href)="(https?:[^"]+)"', page.read_text(encoding="utf-8"))
        if fetched:
            raise ValueError(f"{page}: fetched from elsewhere when it is read: {', '.join(fetched)}")


def setup(app: Any) -> None:
    """Write the pages of the reference, and set formulas."""
    app.connect("build-finished", _offline)
    app.connect("autodoc-process-docstring", _escaped, priority=400)
    app.connect("autodoc-skip-member", _skipped)
    app.add_html_math_renderer(
        "mathml", (lambda self, node: _mathml(self, node, "inline"), None), (lambda self, node: _mathml(self, node, "block"), None)
    )
    API.mkdir(exist_ok=True)
    every = reference.pages()
    wanted = {"index": reference.index(every)} | {page.file: reference.text(page) for page in every}
    for old in API.glob("*.rst"):
        if old.stem not in wanted:
            old.unlink()
    for name, text in wanted.items():
        path = API / f"{name}.rst"
        if not path.exists() or path.read_text(encoding="utf-8") != text:
            path.write_text(text, encoding="utf-8")

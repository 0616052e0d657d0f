"""What all pictures of reports share: colours, fonts, and a way from figure to PNG that no user setting disturbs."""

from __future__ import annotations

import io
import re
import unicodedata
import warnings
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

DPI = 150
FONT = "DejaVu Sans"
# Matplotlib's own font has no Chinese, Japanese, Korean, Hindi or Arabic letters; those of these fonts that are installed help out.
FALLBACKS = (
    "Noto Sans", "Noto Sans CJK SC", "Noto Sans CJK JP", "WenQuanYi Zen Hei", "WenQuanYi Micro Hei", "Droid Sans Fallback",
    "IPAGothic", "SimHei", "NanumGothic", "Noto Sans Devanagari", "Noto Sans Arabic", "PingFang SC",
    "Hiragino Sans", "Apple SD Gothic Neo", "Microsoft YaHei", "Yu Gothic", "Malgun Gothic", "Nirmala UI", "Arial Unicode MS",
)  # fmt: skip


@dataclass(frozen=True)
class Theme:
    """Colours of a picture, and the colour map of its heat cells (from "nothing" to "most")."""

    paper: str
    ink: str
    muted: str
    line: str
    heat: tuple[str, ...]


LIGHT = Theme("#ffffff", "#1b2126", "#59636d", "#d5dade", ("#ffffff", "#d3e6ee", "#7fb8cf", "#2b86a5", "#0b4a60"))
DARK = Theme("#181c1f", "#e8ecef", "#a3adb6", "#3a4248", ("#181c1f", "#1f3a45", "#23667c", "#3f9dba", "#b5e8f5"))


def columns(text: str) -> int:
    """Width of a text in letters: those of Chinese, Japanese and Korean are two wide.

    Example:
        >>> columns("squat"), columns("深蹲")
        (5, 4)
    """
    return sum(1 + (unicodedata.east_asian_width(letter) in "WF") for letter in text)


def shorten(value: object, limit: int) -> str:
    """One line at most ``limit`` letters wide; the middle goes, because variants of a name differ at its ends.

    Example:
        >>> shorten("lateral raise, left arm, slow", 15)
        'lateral…m, slow'
    """
    text = re.sub(r"[\x00-\x1f\x7f-\x9f]", " ", str(value)).encode("utf-8", "replace").decode()
    text = " ".join(text.split())
    if columns(text) <= limit:
        return text
    first, last = list(text), list[str]()
    while first and columns("".join(first)) > limit // 2:
        first.pop()
    for letter in reversed(text):
        if columns("".join(last)) + columns(letter) > limit - limit // 2 - 1:
            break
        last.insert(0, letter)
    return f"{''.join(first).rstrip()}…{''.join(last).lstrip()}"


def shorten_all(values: Sequence[object], limit: int) -> list[str]:
    """Names of at most ``limit`` characters that can still be told apart.

    Example:
        >>> shorten_all(["raise the left arm, variant A", "raise the right arm, variant A"], 12)
        ['left a…ant A', 'right…ant A']
    """
    names = [shorten(value, limit) for value in values]
    if len(set(names)) == len(set(map(str, values))):
        return names
    full = [shorten(value, 10_000) for value in values]
    first, last = min(full), max(full)  # what these two share at their beginning, all share
    common = first[: next((i for i, (a, b) in enumerate(zip(first, last, strict=False)) if a != b), 0)]
    common = common[: common.rfind(" ") + 1]
    names = [shorten(name[len(common) :], limit) for name in full]
    twice = {name for name in names if names.count(name) > 1}
    return [f"{i} {shorten(name, limit - 1 - len(str(i)))}" if name in twice else name for i, name in enumerate(names, 1)]


def letters_without_font(texts: Iterable[object]) -> str:
    """The letters of some texts that no font of this computer has that pictures use: they are drawn as boxes."""
    from matplotlib import font_manager
    from matplotlib.ft2font import FT2Font

    wanted = {letter for text in texts for letter in str(text) if ord(letter) > 0x24F and letter.isprintable()}
    if not wanted:
        return ""
    files = {font.name: font.fname for font in font_manager.fontManager.ttflist if font.name in (FONT, *FALLBACKS)}
    have = [set(FT2Font(file).get_charmap()) for file in files.values()]
    return "".join(sorted(letter for letter in wanted if not any(ord(letter) in known for known in have)))


@contextmanager
def style(theme: Theme) -> Iterator[None]:
    """Our own look whatever the user's matplotlibrc says (``usetex``, say, would need LaTeX), and theirs again afterwards."""
    import matplotlib
    from matplotlib import font_manager

    with matplotlib.rc_context(), warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Glyph .* missing")  # a box in the picture; the page's text has the letters
        matplotlib.rcdefaults()
        have = {font.name for font in font_manager.fontManager.ttflist}
        matplotlib.rcParams.update({
            "font.family": [FONT, *(name for name in FALLBACKS if name in have)], "font.size": 8.5,
            "figure.facecolor": theme.paper, "axes.facecolor": theme.paper, "savefig.facecolor": theme.paper,
            "text.color": theme.ink, "axes.labelcolor": theme.muted, "axes.edgecolor": theme.line,
            "xtick.color": theme.line, "ytick.color": theme.line, "xtick.labelcolor": theme.ink, "ytick.labelcolor": theme.ink,
        })  # fmt: skip
        yield


def new_figure(width: float, height: float) -> Any:
    """A figure of this size in inches, on the Agg canvas."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), dpi=DPI)
    FigureCanvasAgg(figure)
    return figure


def cmap(theme: Theme) -> Any:
    """The theme's colour map for heat cells."""
    from matplotlib.colors import LinearSegmentedColormap

    return LinearSegmentedColormap.from_list("report", theme.heat)


def png(figure: Any, tight: bool = False) -> bytes:
    """The figure as PNG; ``tight`` cuts it to what is drawn."""
    options = {"bbox_inches": "tight", "pad_inches": 0.08} if tight else {}
    stream = io.BytesIO()
    figure.savefig(stream, format="png", metadata={"Software": None}, **options)
    return stream.getvalue()

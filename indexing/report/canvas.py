"""What all pictures of reports share: colours, fonts, and a way from figure to PNG that no user setting disturbs."""

from __future__ import annotations

import io
import re
import unicodedata
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from indexing.cameras import y_up
from indexing.clip import Clip
from indexing.readers.matches import Photograph
from indexing.report.page import markup
from indexing.skeleton import usual_layout

DPI = 150
FADE = (0.62, 0.78)  # how much of white and of dark paper is laid over a photograph
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
    """Width of a text in letters: those of Chinese, Japanese and Korean are two wide."""
    return sum(1 + (unicodedata.east_asian_width(letter) in "WF") for letter in text)


def shorten(value: object, limit: int) -> str:
    """One line at most ``limit`` letters wide; the middle goes, because variants of a name differ at its ends."""
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
    """Names of at most ``limit`` characters that can still be told apart."""
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
def style(theme: Theme = LIGHT) -> Iterator[None]:
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


def cmap(theme: Theme = LIGHT) -> Any:
    """The theme's colour map for heat cells."""
    from matplotlib.colors import LinearSegmentedColormap

    return LinearSegmentedColormap.from_list("report", theme.heat)


def png(figure: Any, tight: bool = False) -> bytes:
    """The figure as PNG; ``tight`` cuts it to what is drawn."""
    options = {"bbox_inches": "tight", "pad_inches": 0.08} if tight else {}
    stream = io.BytesIO()
    figure.savefig(stream, format="png", metadata={"Software": None}, **options)
    return stream.getvalue()


# ----------------------------------------------------------------------------------------------------------------------
# Small stick figures as inline SVG: they take the colours of the page (light, dark, print) and weigh a kilobyte.


FRAMES = 5  # key frames of a strip
AROUND = 9  # frames before and after the shown ones that say where a joint should be
FACE = {"nose", "eye", "ear", "mouth"}
WIDTH, HEIGHT = 40.0, 64.0  # of one key frame, in SVG units


def strip(clip: Clip, start: float | None = None, end: float | None = None, *, frames: int = FRAMES, alt: str = "") -> str:
    """A row of key frames of a clip, evenly spaced in time, as one inline ``<svg>``."""
    first = clip.times[0] if start is None else start
    last = clip.times[-1] if end is None else end
    wanted = np.linspace(first, last, frames)
    at = np.unique(np.abs(clip.times[None, :] - wanted[:, None]).argmin(axis=1))
    points = y_up(clip.replace(joints=_right(clip, at), times=clip.times[at], confidence=None))[..., :2].astype(np.float64)
    points[np.isnan(points).any(axis=2)] = np.nan
    seen = ~np.isnan(points[..., 0])
    drawn = seen.any(axis=1)
    if not drawn.any():
        return ""
    points, seen = points[drawn], seen[drawn]
    points[..., 0] -= np.array([np.median(frame[ok, 0]) for frame, ok in zip(points, seen, strict=True)])[:, None]
    seen &= ~(_is_outlier(points[..., 0]) | _is_outlier(points[..., 1]))  # they would shrink the person to a dot
    bounds = [(points[..., axis][seen].min(), points[..., axis][seen].max()) for axis in (0, 1)]
    extent = max((bounds[0][1] - bounds[0][0]) / (WIDTH - 6), (bounds[1][1] - bounds[1][0]) / (HEIGHT - 8))
    scale = 1.0 / extent if extent > 0 else 1.0
    middle = [sum(bound) / 2 for bound in bounds]
    places = np.empty_like(points)
    places[..., 0] = (points[..., 0] - middle[0]) * scale + WIDTH * (0.5 + np.arange(len(points))[:, None])
    places[..., 1] = (middle[1] - points[..., 1]) * scale + HEIGHT / 2  # SVG's y points down
    paths = _paths(clip, places, seen)
    width = WIDTH * len(points)
    drawing = markup("".join(f'<path class="{css}" d="{path}"/>' for css, path in paths.items() if path))
    svg = '<svg class="strip" viewBox="0 0 {width:g} {height:g}" role="img" aria-label="{alt}">{drawing}</svg>'
    return markup(svg, width=width, height=HEIGHT, alt=alt, drawing=drawing)


def _right(clip: Clip, at: NDArray[np.intp]) -> NDArray[Any]:
    """The joints of some frames; those that do not lie on their own path through the frames around them are NaN."""
    from indexing.windows import wrong_joints

    first, last = max(0, int(at[0]) - AROUND), min(len(clip), int(at[-1]) + AROUND + 1)
    joints = np.array(clip.joints[first:last], dtype=np.float32)
    joints[wrong_joints(joints, clip.times[first:last], np.array([0, last - first]))] = np.nan
    return joints[at - first]


def _paths(clip: Clip, places: NDArray[np.float64], seen: NDArray[np.bool_]) -> dict[str, str]:
    """SVG path data by CSS class: left limbs, right limbs, the middle, and dots for joints without bones."""
    skeleton = clip.skeleton or usual_layout(clip.joints.shape[1])
    bones = skeleton.bones if skeleton is not None else ()
    sides = [side_of(name) for name in skeleton.joints] if skeleton is not None else []
    face = [words_of(name) & FACE != set() for name in skeleton.joints] if skeleton is not None else []
    lines: dict[str, list[str]] = {"m": [], "r": [], "l": [], "h": [], "d": []}
    for place, ok in zip(places, seen, strict=True):
        spot = [f"{x:.1f} {y:.1f}" if good else "" for (x, y), good in zip(place, ok, strict=True)]
        if not bones:
            lines["d"] += [f"M{text}h0" for text in spot if text]
        head = _head(place, ok, face, sides)
        lines["h"].append(head)
        for a, b in bones:
            if ok[a] and ok[b] and not (head and face[a] and face[b]):
                both = {sides[a], sides[b]} - {"m"}
                side = both.pop() if len(both) == 1 else "m"
                lines[side].append(f"M{spot[a]}L{spot[b]}")
    return {css: "".join(path) for css, path in lines.items()}


def _head(place: NDArray[np.float64], ok: NDArray[np.bool_], face: list[bool], sides: list[str]) -> str:
    """A circle for the joints of the face, which as lines would look like a mask; ``""`` where they were not seen."""
    seen_face = np.array(face, dtype=bool) & ok if face else np.zeros(len(ok), dtype=bool)
    if not seen_face.any() or not {"l", "r"} <= set(sides):
        return ""
    x, y = place[seen_face].mean(axis=0)
    radius = min(max(float(np.ptp(place[seen_face], axis=0).max()) / 2, 3.6), 6.0)
    arc = f"a{radius:.1f} {radius:.1f} 0 1 0 "
    return f"M{x - radius:.1f} {y:.1f}{arc}{2 * radius:.1f} 0{arc}{-2 * radius:.1f} 0"


def words_of(name: str) -> set[str]:
    """``{"left", "eye"}`` of ``left_eye``, ``LeftEye`` or ``left eye``."""
    return {word.lower() for word in re.findall(r"[A-Z]?[a-z]+|[A-Z]+(?![a-z])", name)}


def side_of(name: str) -> str:
    """``"l"``, ``"r"`` or, in the middle, ``"m"``."""
    found = words_of(name)
    return "l" if found & {"left", "l"} else "r" if found & {"right", "r"} else "m"


def _is_outlier(values: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Which coordinates lie so far from all others that they are a detector's mistake: two spreads beyond the bulk."""
    low, high = np.percentile(values[~np.isnan(values)], [10, 90])
    spread = high - low
    return (values < low - 2 * spread) | (values > high + 2 * spread) if spread > 0 else np.zeros(values.shape, dtype=bool)


def draw_photograph(panel: Any, photograph: Photograph, theme: Theme) -> None:
    """The image in gray, faded into the paper, so that the colours of what is drawn on it stand out."""
    from matplotlib.colors import to_rgb

    wide, tall = photograph.size
    paper = np.array(to_rgb(theme.paper))
    fade = FADE[int(paper.mean() < 0.5)]
    shown = (1 - fade) * photograph.gray[..., None] + fade * paper
    panel.imshow(shown, extent=(-0.5, wide - 0.5, tall - 0.5, -0.5), interpolation="bilinear", zorder=0)


# ----------------------------------------------------------------------------------------------------------------------
# Panels of points and paths: side by side, with equal axes, limits that leave strays out, and a legend below.


FloatArray = NDArray[np.float64]
PAGE_WIDTH, PANEL_FOOT, PANEL_TITLE, PANEL_TICKS = 10.2, 0.4, 0.3, 0.25  # inches
MAX_PATHS = 1500  # drawn; more are a blot
MAX_LONG_PATHS, LONG_PATH = 60, 0.06  # paths drawn where half of them are longer than this share of the picture
PANEL_MARGIN = 0.06  # around the points, of their extent


def aspect(box: tuple[FloatArray, FloatArray]) -> float:
    """Height over width of what a panel shows."""
    low, high = box
    return float(np.clip((high - low)[1] / (high - low)[0], 0.05, 20))


def layout(
    boxes: Sequence[tuple[FloatArray, FloatArray]], tall: float, edge: float, gap: float, columns: int = 2
) -> tuple[Any, list[Any]]:
    """A figure of panels, so many in a row, as wide as they need to be, and the panels."""
    columns = min(columns, len(boxes))
    wide = (PAGE_WIDTH - edge - gap * (columns - 1)) / columns
    sizes = [(min(wide, tall / ratio), min(tall, wide * ratio)) for ratio in map(aspect, boxes)]
    rows = [sizes[i : i + columns] for i in range(0, len(sizes), columns)]
    width = max(edge + sum(across for across, _ in row) + gap * (len(row) - 1) for row in rows)
    height = sum(PANEL_TITLE + max(down for _, down in row) + PANEL_TICKS for row in rows) + PANEL_FOOT
    figure, panels, top = new_figure(width, height), [], 0.0
    for row in rows:
        left, top = edge, top + PANEL_TITLE
        for across, down in row:
            panels.append(figure.add_axes((left / width, 1 - (top + down) / height, across / width, down / height)))
            left += across + gap
        top += max(down for _, down in row) + PANEL_TICKS
    return figure, panels


def limits(points: FloatArray, share: float = 1.0) -> tuple[FloatArray, FloatArray]:
    """Low and high ``(d,)`` around the points ``(..., d)``, but for a share of strays, with room around."""
    flat = points.reshape(-1, points.shape[-1])
    flat = flat[np.isfinite(flat).all(axis=1)]
    if not len(flat):
        return np.zeros(points.shape[-1]), np.ones(points.shape[-1])
    low, high = np.percentile(flat, 100 * (1 - share), axis=0), np.percentile(flat, 100 * share, axis=0)
    room = max(PANEL_MARGIN * float((high - low).max()), 1e-3 * float(np.abs(flat).max()), 1e-6)
    return low - room, high + room


def around(paths: FloatArray, share: float) -> tuple[FloatArray, FloatArray]:
    """Low and high ``(d,)`` around whole paths ``(views, n, d)``, from dot to arrow head, but for those that stray far away."""
    low, high = limits(paths, share)
    with np.errstate(invalid="ignore"):
        near = ((paths > low - (high - low)) & (paths < high + (high - low))).all(axis=(0, 2))
    return limits(paths[:, near]) if near.any() else (low, high)


def sample(paths: FloatArray, box: tuple[FloatArray, FloatArray]) -> NDArray[np.intp]:
    """Of paths ``(views, n, d)`` those to be drawn: all, or where long ones would tangle, every so many."""
    count = paths.shape[1]
    if count <= MAX_LONG_PATHS:
        return np.arange(count)
    ways = np.linalg.norm(paths[-1] - paths[0], axis=-1)
    long = float(np.nanmedian(ways)) > LONG_PATH * float((box[1] - box[0]).max()) if np.isfinite(ways).any() else False
    return np.linspace(0, count - 1, MAX_LONG_PATHS).round().astype(np.intp) if long else np.arange(min(count, MAX_PATHS))


def foot(figure: Any, handles: list[Any], columns: int = 4, ink: str = LIGHT.ink) -> None:
    """The legend at the foot of the figure."""
    anchor = (0.5, 0.28 / figure.get_figheight())
    figure.legend(handles=handles, loc="upper center", bbox_to_anchor=anchor, ncols=columns, frameon=False, labelcolor=ink)


def legend(figure: Any, kinds: NDArray[Any], colours: Mapping[str, str], ink: str = LIGHT.ink, lines: bool = False) -> None:
    """How many points (or lines) of every kind that there is, at the foot of the figure."""
    from matplotlib.lines import Line2D

    handles = []
    line: Any
    for kind, colour in colours.items():
        number, stray = int((kinds == kind).sum()), kind == "outlier"
        if number:
            name = f"{kind}: {number:,}" if " " in kind else f"{number:,} {kind}{'s' * (stray and number > 1)}"
            marker, line = (None, "dotted" if stray else "solid") if lines else ("x" if stray else "o", "")
            handles.append(Line2D([], [], color=colour, marker=marker, linestyle=line, markersize=5, label=name))
    foot(figure, handles, ink=ink)


def widest_axes(points: FloatArray) -> list[int]:
    """The two coordinates in which points ``(..., d)`` extend most, but for strays."""
    flat = points.reshape(-1, points.shape[-1])
    if flat.shape[-1] == 2:
        return [0, 1]
    low, high = np.nanpercentile(flat, [5, 95], axis=0) if len(flat) else (np.zeros(3), np.ones(3))
    return sorted(np.argsort(-np.nan_to_num(high - low), kind="stable")[:2].tolist())


def finish(panel: Any, low: FloatArray, high: FloatArray, down: bool, title: str) -> None:
    """Limits, equal axes and a title."""
    panel.set(xlim=(low[0], high[0]), ylim=(high[1], low[1]) if down else (low[1], high[1]))
    panel.set_aspect("equal", adjustable="box", anchor="N")
    panel.tick_params(length=2.5, labelsize=7.5)
    panel.locator_params(nbins=6)
    panel.ticklabel_format(useOffset=False)
    panel.set_title(title, fontsize=9, loc="left", parse_math=False)
    for side in panel.spines.values():
        side.set_linewidth(0.8)

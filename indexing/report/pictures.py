"""Pictures for reports, as PNG bytes: confusion matrix and score timeline.

Drawn on matplotlib's Figure objects directly: pyplot keeps global state, picks a window system and leaks figures.
matplotlib is imported when a picture is drawn, not before.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from indexing.report.canvas import LIGHT, cmap, columns, new_figure, png, shorten, shorten_all, style
from indexing.report.page import Tip
from indexing.report.results import ReportedEvent, Truth

COLUMNS = 1400  # score values drawn along the time axis: about one per pixel
# White text on these reads at 4.5:1 or better, and so does black text where the style sheet turns them for dark paper; any two are
# 15 apart by CIEDE2000 or more on either paper.  Each is the one that is farthest from those before it.
PALETTE = (
    "#0078b4", "#5a820a", "#820028", "#c85000", "#0a8278", "#785afa", "#464628", "#b45a6e", "#0a14d2", "#8c6e0a",
    "#c832be", "#005a1e", "#8c6450", "#643200", "#785a82", "#144650", "#aa0a00", "#463c3c", "#6e7864", "#5a6478",
)  # fmt: skip
MAX_LANES = 4
STEPS = (0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 30, 60, 120, 300, 600, 900, 1800, 3600, 7200, 14400)  # seconds between ticks
FRAME = "#e8741e"  # around found actions: stands out from the heat colours of both themes
WIDTH, ABOVE, BESIDE = 10.2, 0.12, 0.85  # inches: of a timeline, above its bars, and for the scale on its right
Bar = tuple[str, float, float]  # label, start, end
Span = tuple[float, float]


def colours(names: Sequence[object]) -> dict[str, str]:
    """A colour for each name; beyond as many as the palette has they come again."""
    return {name: PALETTE[i % len(PALETTE)] for i, name in enumerate(dict.fromkeys(map(str, names)))}


@dataclass(frozen=True)
class _View:
    """What both halves of a timeline share: the seconds shown, and the colours."""

    low: float
    high: float
    colours: Mapping[str, str]

    @property
    def minutes(self) -> bool:
        """Whether the time axis says minutes, too."""
        return self.high > 120

    def width(self, start: float, end: float) -> float:
        """Of a bar, in seconds: never thinner than two pixels."""
        return max(end - start, 0.0022 * (self.high - self.low))

    def thin(self, start: float, end: float) -> bool:
        """Whether a full frame would cover what it frames."""
        return end - start < 0.006 * (self.high - self.low)


@dataclass(frozen=True)
class _Layout:
    """Where things are on a timeline, in inches."""

    names: Sequence[str]
    found: Sequence[Bar]
    spans: Sequence[tuple[str, list[list[Bar]]]]
    low: float
    high: float
    left: float
    bars: float
    heat: float
    foot: float

    @property
    def height(self) -> float:
        return ABOVE + self.bars + ABOVE + self.heat + self.foot

    @property
    def width(self) -> float:
        return WIDTH - self.left - BESIDE


def _layout(
    seconds: NDArray[np.float64],
    classes: Sequence[object],
    events: Sequence[ReportedEvent],
    truth: Sequence[Truth] | None,
    span: Span | None,
) -> _Layout:
    found = [(str(event.label), float(event.start), float(event.end)) for event in events]
    known = None if truth is None else [(str(label), float(start), float(end)) for label, start, end in truth]
    names = list(dict.fromkeys([str(name) for name in classes] + [bar[0] for bar in found + (known or [])]))
    spans = [("found", _lanes(found))] + ([] if known is None else [("known", _lanes(known))])
    bounds = [float(seconds[0]), float(seconds[-1]), *(span or ())]
    bounds += [t for _, start, end in found + (known or []) for t in (start, end)]
    low, high = min(bounds), max(bounds)
    high = high if high > low else low + 1.0
    left = 0.45 + 0.075 * max([5] + [columns(name) for name in shorten_all(classes, 22)])
    bars, heat = 0.29 * sum(len(lanes) for _, lanes in spans), 0.25 * len(classes)
    return _Layout(names, found, spans, low, high, left, bars, heat, 0.62 if high > 120 else 0.47)


def timeline_tips(
    times: ArrayLike,
    classes: Sequence[object],
    events: Sequence[ReportedEvent] = (),
    truth: Sequence[Truth] | None = None,
    span: Span | None = None,
) -> list[Tip]:
    """What :func:`timeline` draws as bars, and where: for names that do not fit."""
    at = _layout(np.asarray(times, dtype=np.float64), classes, events, truth, span)
    lanes = [(title, lane) for title, several in at.spans for lane in several]
    tips = []
    for row, (title, lane) in enumerate(lanes):
        for label, start, end in lane:
            left = at.left + at.width * (start - at.low) / (at.high - at.low)
            wide = max(at.width * (end - start) / (at.high - at.low), 0.06)
            top, tall = ABOVE + at.bars * (row + 0.1) / len(lanes), 0.8 * at.bars / len(lanes)
            text = f"{title}: {label}, {start:.2f} to {end:.2f} s"
            tips.append(Tip(left / WIDTH, top / at.height, wide / WIDTH, tall / at.height, text))
    return tips


def confusion(counts: ArrayLike, classes: Sequence[object], sides: tuple[str, str] = ("performed", "recognized as")) -> bytes:
    """PNG of a confusion matrix: a row per true class and a column per predicted one; colour = share of the row. counts
    ``(classes, classes)``."""
    table = np.asarray(counts)
    names = shorten_all(classes, 26)
    if not names or table.shape != (len(names), len(names)):
        raise ValueError(f"counts must be (classes, classes) = ({len(names)}, {len(names)}), at least one, got {table.shape}")
    total = table.sum(axis=1, keepdims=True)
    share = np.divide(table, total, out=np.zeros(table.shape), where=total > 0)
    number = len(names)
    cell = float(np.clip(4.6 / number, 0.27, 0.7))  # inches: 60 classes stay legible, 2 do not fill the page
    size = min(9.0, 3.0 + 18 * cell)
    with style():
        figure = new_figure(cell * number + 2.6, cell * number + 2.3)
        axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
        axes.imshow(share, cmap=cmap(), vmin=0, vmax=1, interpolation="nearest")
        level = number <= 4 and max(map(len, names)) <= 9
        slant = {} if level else {"rotation": 45, "ha": "right", "rotation_mode": "anchor"}
        axes.set_xticks(range(number), labels=names, parse_math=False, fontsize=max(size, 7.0), **slant)
        axes.set_yticks(range(number), labels=names, parse_math=False, fontsize=max(size, 7.0))
        edges = np.arange(-0.5, number)
        axes.hlines(edges, -0.5, number - 0.5, color=LIGHT.line, linewidth=0.6)
        axes.vlines(edges, -0.5, number - 0.5, color=LIGHT.line, linewidth=0.6)
        axes.set(xlim=(-0.5, number - 0.5), ylim=(number - 0.5, -0.5))
        axes.tick_params(length=0)
        axes.set_xlabel(sides[1], labelpad=8, parse_math=False)
        axes.set_ylabel(sides[0], labelpad=8, parse_math=False)
        for row, column in np.argwhere(table > 0):  # zeros stay blank: the eye then finds the errors
            colour = LIGHT.paper if share[row, column] > 0.55 else LIGHT.ink
            text = f"{table[row, column]}"
            fits = min(size, 100 * cell / max(3, len(text)))
            axes.text(column, row, text, color=colour, fontsize=fits, ha="center", va="center")
        return png(figure, tight=True)


def timeline(
    times: ArrayLike,
    scores: ArrayLike,
    classes: Sequence[object],
    events: Sequence[ReportedEvent] = (),
    truth: Sequence[Truth] | None = None,
    span: Span | None = None,
) -> bytes:
    """PNG of scores over time: a heat row per class, found events as labelled bars above, the known ones below those. times
    ``(F,)``, scores ``(F, C)``, truth ``(label, start, end)``."""
    seconds, values = np.asarray(times, dtype=np.float64), np.asarray(scores, dtype=np.float64)
    if values.shape != (len(seconds), len(classes)) or not len(seconds):
        raise ValueError(f"scores must be (frames, classes) = ({len(seconds)}, {len(classes)}), not empty, got {values.shape}")
    at = _layout(seconds, classes, events, truth, span)
    height, low, high = at.height, at.low, at.high
    view = _View(low, high, colours(at.names))
    with style():
        figure = new_figure(WIDTH, height)
        box = (at.left / WIDTH, at.width / WIDTH)
        top = figure.add_axes((box[0], 1 - (ABOVE + at.bars) / height, box[1], at.bars / height))
        _draw_bars(top, at.spans, view)
        below = top
        if len(classes):
            below = figure.add_axes((box[0], at.foot / height, box[1], at.heat / height))
            image = _draw_heat(below, downsample(seconds, values, np.linspace(low, high, COLUMNS + 1)), classes, at.found, view)
            if image is not None:
                _draw_scale(figure, image, (1 - 0.72 / WIDTH, at.foot / height, 0.1 / WIDTH, min(at.heat, 1.6) / height))
            top.tick_params(labelbottom=False, bottom=False)
        _time_axis(below, view)
        return png(figure)


def downsample(times: NDArray[np.float64], scores: NDArray[np.float64], edges: NDArray[np.float64]) -> NDArray[np.float64]:
    """``(columns, C)`` the best score between each two of the ``columns + 1`` edges (seconds); NaN where nothing was scored."""
    begin = np.searchsorted(times, edges[:-1], side="left")
    end = np.append(begin[1:], np.searchsorted(times, edges[-1], side="right"))
    scores = np.where(np.isfinite(scores), scores, np.nan)
    out = np.full((len(begin), scores.shape[1]), np.nan)
    full = np.flatnonzero(end > begin)
    if len(full):
        out[full] = np.fmax.reduceat(scores[: end[full[-1]]], begin[full], axis=0)
    # A column between two frames of a slow stream shows the frame before it; a real pause in the recording stays empty.
    step = float(np.median(np.diff(times))) if len(times) > 1 else np.inf
    between = np.flatnonzero((end <= begin) & (begin > 0))
    near = between[edges[between] - times[begin[between] - 1] <= 1.5 * step]
    out[near] = scores[begin[near] - 1]
    return out


def _draw_bars(axes: Any, spans: Sequence[tuple[str, list[list[Bar]]]], view: _View) -> None:
    row, ticks = 0, []
    for title, lanes in spans:
        ticks.append((row + (len(lanes) - 1) / 2, title))
        for lane in lanes:
            for label in dict.fromkeys(
                bar[0] for bar in lane
            ):  # one collection per label: drawing each bar by itself takes seconds
                bars = [(start, view.width(start, end)) for name, start, end in lane if name == label]
                axes.broken_barh(bars, (row - 0.4, 0.8), facecolor=view.colours[label], edgecolor=LIGHT.paper, linewidth=0.5)
                for start, width in bars:
                    pixels = axes.bbox.width * width / (view.high - view.low)
                    if pixels > 24:  # three letters
                        _write(axes, shorten(label, 22), start + width / 2, row, pixels)
            row += 1
    axes.set(xlim=(view.low, view.high), ylim=(row - 0.5, -0.5))
    axes.set_yticks([at for at, _ in ticks], labels=[title for _, title in ticks], fontweight="bold")
    axes.tick_params(axis="y", length=0, pad=14)
    for side in axes.spines.values():
        side.set_visible(False)
    for at in np.cumsum([len(lanes) for _, lanes in spans])[:-1]:
        axes.axhline(at - 0.5, color=LIGHT.line, linewidth=0.6)


def _write(axes: Any, text: str, x: float, y: float, room: float) -> None:
    """Text centred in a bar of ``room`` pixels, in one line or two; left out where it does not fit: its colour says it."""
    written = axes.text(
        x, y, text, color="#ffffff", fontsize=8, ha="center", va="center", parse_math=False, clip_on=True, linespacing=0.95
    )
    for several, size in ((text, 7), (_in_two(text), 6.5), (_in_two(text), 5.8)):
        if written.get_window_extent().width + 8 > room:
            written.set(text=several, fontsize=size)
    if written.get_window_extent().width + 4 > room:
        written.remove()


def _in_two(text: str) -> str:
    """A name in two lines of about the same length, parted where its words are."""
    places = [match.end() for match in re.finditer(r"[ _\-/]", text[:-1])] or [len(text)]
    at = min(places, key=lambda place: max(place, len(text) - place))
    return f"{text[:at].rstrip()}\n{text[at:]}" if at < len(text) else text


def _draw_heat(axes: Any, cells: NDArray[np.float64], classes: Sequence[object], found: Sequence[Bar], view: _View) -> Any:
    """The heat rows; returns the image, or ``None`` where nothing was scored."""
    image = None
    if np.isfinite(cells).any():
        # Percentiles: one wild score must not wash out the picture of all others.
        bottom, peak = np.nanpercentile(cells, [2, 99.7])
        image = axes.imshow(
            cells.T, extent=(view.low, view.high, len(classes) - 0.5, -0.5), aspect="auto", interpolation="nearest",
            cmap=cmap(), vmin=bottom, vmax=peak if peak > bottom else bottom + 1,
        )  # fmt: skip
    else:
        axes.text((view.low + view.high) / 2, (len(classes) - 1) / 2, "no scores", color=LIGHT.muted, ha="center", va="center")
    for row, name in enumerate(map(str, classes)):
        spans = [(start, end) for label, start, end in found if label == name]
        for thin in (True, False):
            bars = [(start, view.width(start, end)) for start, end in spans if view.thin(start, end) == thin]
            axes.broken_barh(bars, (row - 0.42, 0.84), facecolor="none", edgecolor=FRAME, linewidth=0.7 if thin else 1.2)
        # The colour of the action's bars, beside its name.
        axes.plot(-0.009, row, "s", color=view.colours[name], markersize=5.5, transform=axes.get_yaxis_transform(), clip_on=False)
    axes.set(xlim=(view.low, view.high), ylim=(len(classes) - 0.5, -0.5))
    axes.set_yticks(range(len(classes)), labels=shorten_all(classes, 22), parse_math=False)
    axes.hlines(np.arange(0.5, len(classes) - 1), view.low, view.high, color=LIGHT.paper, linewidth=1)
    axes.tick_params(axis="y", length=0, pad=14)
    return image


def _draw_scale(figure: Any, image: Any, box: tuple[float, float, float, float]) -> None:
    axes = figure.add_axes(box)
    bar = figure.colorbar(image, cax=axes)
    bar.outline.set_visible(False)
    low, high = image.get_clim()
    nearly = 1e-6 * (high - low)  # rounding, where the best score is 0
    bar.set_ticks([low, high], labels=["0" if abs(value) < nearly else f"{value:.2g}" for value in (low, high)])
    axes.tick_params(length=0, labelsize=7.5)
    axes.set_title("score", fontsize=7.5, loc="left", pad=8)


def _time_axis(axes: Any, view: _View) -> None:
    from matplotlib.ticker import MultipleLocator

    step = next((step for step in STEPS if (view.high - view.low) / step <= 10), None)
    if step is not None:
        axes.xaxis.set_major_locator(MultipleLocator(step))
    axes.set_xlabel("time (s, min:s)" if view.minutes else "time (s)")
    if view.minutes:  # as video players show it
        axes.xaxis.set_major_formatter(lambda t, _: f"{t:g}\n{int(t) // 60}:{int(t) % 60:02d}" if t >= 0 else f"{t:g}")


def _lanes(bars: Sequence[Bar]) -> list[list[Bar]]:
    """Bars that overlap go to separate lanes; beyond the fourth they are drawn over each other."""
    lanes: list[list[Bar]] = [[]]
    for bar in sorted(bars, key=lambda bar: bar[1]):
        free = next((lane for lane in lanes if not lane or lane[-1][2] <= bar[1]), None)
        if free is None and len(lanes) < MAX_LANES:
            lanes.append([])
        (free if free is not None else lanes[-1]).append(bar)
    return lanes

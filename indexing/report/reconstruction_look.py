"""What the pictures of a reconstruction share: colours, how much of the data is shown, and the legend."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from indexing.report.canvas import Theme, new_figure

if TYPE_CHECKING:
    from indexing.report.reconstruction import ReconstructionReport

FloatArray = NDArray[np.float64]
# apart for colour-blind eyes, too, on both papers; outliers are crosses besides
COLOURS = {"static": "#2f7fb8", "moving": "#e8741e", "body 1": "#2f7fb8", "body 2": "#e8741e", "outlier": "#8b949c"}
WIDTH, FOOT, TITLE, TICKS = 10.2, 0.4, 0.3, 0.25  # inches
SHOWN = 1500  # tracks drawn; more are a blot
TANGLE, LONG = 60, 0.06  # paths drawn where half of them are longer than this share of the picture
ROOM = 0.06  # around the points, of their extent


def kinds_of(report: ReconstructionReport) -> NDArray[Any]:
    """What every track is drawn as: its kind, or ``unlabelled`` where no scene was decided on."""
    return np.array(report.kinds) if report.drawable else np.full(len(report.tracks.ids), "unlabelled")


def layout(boxes: list[tuple[FloatArray, FloatArray]], tall: float, edge: float, gap: float) -> tuple[Any, list[Any]]:
    """A figure of panels side by side, as wide as they need to be, and the panels.

    Args:
        boxes: low and high that each shows.
        tall: greatest height of a panel, inches.
        edge: at the left.
        gap: between panels.
    """
    wide = (WIDTH - edge - gap * (len(boxes) - 1)) / len(boxes)
    ratios = [float(np.clip((high - low)[1] / (high - low)[0], 0.05, 20)) for low, high in boxes]
    sizes = [(min(wide, tall / ratio), min(tall, wide * ratio)) for ratio in ratios]
    width = edge + sum(size for size, _ in sizes) + gap * (len(boxes) - 1)
    highest = max(size for _, size in sizes)
    height = TITLE + highest + TICKS + FOOT
    figure, left, panels = new_figure(width, height), edge, []
    for across, down in sizes:
        panels.append(figure.add_axes((left / width, 1 - (TITLE + down) / height, across / width, down / height)))
        left += across + gap
    return figure, panels


def colour_of(kind: str, theme: Theme) -> str:
    """The colour of a kind."""
    return COLOURS.get(kind, theme.muted)


def size_of(count: int) -> float:
    """Area of a mark, smaller where there are many."""
    return float(np.clip(2500 / max(1, count), 4, 22))


def limits(points: FloatArray, share: float = 1.0) -> tuple[FloatArray, FloatArray]:
    """Low and high ``(d,)`` around the points ``(..., d)``, but for a share of strays, with room around.

    Example:
        >>> low, high = limits(np.array([[0.0, 0.0], [1.0, 2.0]]))
        >>> low.round(2).tolist(), high.round(2).tolist()
        ([-0.12, -0.12], [1.12, 2.12])
    """
    flat = points.reshape(-1, points.shape[-1])
    flat = flat[np.isfinite(flat).all(axis=1)]
    if not len(flat):
        return np.zeros(points.shape[-1]), np.ones(points.shape[-1])
    low, high = np.percentile(flat, 100 * (1 - share), axis=0), np.percentile(flat, 100 * share, axis=0)
    room = max(ROOM * float((high - low).max()), 1e-3 * float(np.abs(flat).max()), 1e-6)
    return low - room, high + room


def around(paths: FloatArray, share: float) -> tuple[FloatArray, FloatArray]:
    """Low and high ``(d,)`` around whole paths ``(views, n, d)``, from dot to arrow head, but for those that stray far away.

    Example:
        >>> starts = np.linspace(0.0, 1.0, 100)[:, None] * np.ones(2)
        >>> low, high = around(np.stack([starts, starts + np.eye(100)[:, -1:]]), 0.99)  # the last one goes to (2, 2)
        >>> high.round(2).tolist()
        [2.12, 2.12]
    """
    low, high = limits(paths, share)
    with np.errstate(invalid="ignore"):
        near = ((paths > low - (high - low)) & (paths < high + (high - low))).all(axis=(0, 2))
    return limits(paths[:, near]) if near.any() else (low, high)


def sample(paths: FloatArray, box: tuple[FloatArray, FloatArray]) -> NDArray[np.intp]:
    """Of paths ``(views, n, d)`` those to be drawn: all, or where long ones would tangle, every so many."""
    count = paths.shape[1]
    if count <= TANGLE:
        return np.arange(count)
    ways = np.linalg.norm(paths[-1] - paths[0], axis=-1)
    long = float(np.nanmedian(ways)) > LONG * float((box[1] - box[0]).max()) if np.isfinite(ways).any() else False
    return np.linspace(0, count - 1, TANGLE).round().astype(np.intp) if long else np.arange(min(count, SHOWN))


def legend(figure: Any, kinds: NDArray[Any], theme: Theme) -> None:
    """How many tracks of every kind, at the foot of the figure."""
    from matplotlib.lines import Line2D

    handles = []
    for kind in (*COLOURS, "unlabelled"):
        number = int((kinds == kind).sum())
        if number:
            name = f"{number:,} {kind}{'s' * (kind == 'outlier' and number > 1)}" if " " not in kind else f"{kind}: {number:,}"
            mark = "x" if kind == "outlier" else "o"
            handles.append(Line2D([], [], color=colour_of(kind, theme), marker=mark, linestyle="", markersize=5, label=name))
    foot(figure, handles, theme)


def foot(figure: Any, handles: list[Any], theme: Theme, columns: int = 4) -> None:
    """The legend at the foot of the figure."""
    anchor = (0.5, 0.28 / figure.get_figheight())
    figure.legend(handles=handles, loc="upper center", bbox_to_anchor=anchor, ncols=columns, frameon=False, labelcolor=theme.ink)


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

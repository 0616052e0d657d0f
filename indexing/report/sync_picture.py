"""The picture of a synchronization: the score over the shift, with its peaks, of every pair of cameras."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from indexing.report.canvas import Theme, new_figure, png, shorten, style

if TYPE_CHECKING:
    from indexing.report.sync import Compared, SyncReport

FloatArray = NDArray[np.float64]
WIDTH, TOP, ROW, GAP, FOOT = 10.2, 0.28, 1.75, 0.56, 0.5  # inches
LEFT, MIDDLE, CLOSE, EDGE = 0.55, 0.55, 2.6, 0.15  # inches: the left edge, between curve and close-up, the close-up, the right
DRAWN = 12  # pairs
NEAR = 12.0  # frames to both sides in the close-up
CURVE, BEST, OTHER = "#2f7fb8", "#e8741e", "#8b949c"
LISTED = 5  # peaks with a dot


def picture_of(report: SyncReport, theme: Theme) -> bytes:
    """PNG: a row for every pair, with the whole curve at the left and the peak close up at the right."""
    pairs = report.pairs[:DRAWN]
    height = TOP + len(pairs) * (ROW + GAP) - GAP + FOOT
    with style(theme):
        figure = new_figure(WIDTH, height)
        wide = WIDTH - LEFT - MIDDLE - CLOSE - EDGE
        for i, pair in enumerate(pairs):
            bottom = 1 - (TOP + ROW + i * (ROW + GAP)) / height
            whole = figure.add_axes((LEFT / WIDTH, bottom, wide / WIDTH, ROW / height))
            close = figure.add_axes(((LEFT + wide + MIDDLE) / WIDTH, bottom, CLOSE / WIDTH, ROW / height))
            _draw_curve(whole, pair, theme)
            _draw_close(close, pair, theme)
            if i == len(pairs) - 1:
                whole.set_xlabel("shift, seconds", fontsize=8.5)
                close.set_xlabel("frames from the best shift", fontsize=8.5)
        return png(figure)


def title_of(pair: Compared) -> str:
    """What a pair's curve says, in a line."""
    said = f"{shorten(pair.a, 24)} → {shorten(pair.b, 24)}: "
    return said + (f"{pair.apart:+.4f} ± {pair.shift.sigma:.4f} s" if pair.shift.ok else "refused")


def _draw_curve(panel: Any, pair: Compared, theme: Theme) -> None:
    lags, scores = _curve(pair)
    if not len(lags):
        panel.set_axis_off()
        panel.set_title(f"{title_of(pair)}, nothing to compare", fontsize=9, loc="left", parse_math=False)
        return
    panel.plot(lags, scores, color=CURVE, linewidth=1.0, zorder=3)
    peaks = np.array(pair.shift.peaks.tolist(), dtype=np.float64).reshape(-1, 2)[:LISTED]
    for rank, (offset, score) in reversed(list(enumerate(peaks.tolist()))):
        colour = BEST if rank == 0 else OTHER
        panel.plot([offset], [score], marker="o", markersize=5.5 if rank == 0 else 4, color=colour, zorder=5 - min(rank, 1))
    panel.axvline(pair.apart, color=BEST, linewidth=0.8, alpha=0.6, zorder=2)
    _finish(panel, title_of(pair), theme)
    panel.set_ylabel("score", fontsize=8.5)
    panel.set_xlim(lags[0], lags[-1] if lags[-1] > lags[0] else lags[0] + 1)


def _draw_close(panel: Any, pair: Compared, theme: Theme) -> None:
    lags, scores = _curve(pair)
    if not len(lags):
        panel.set_axis_off()
        return
    frame = 1.0 / pair.shift.fps[1]
    at = (lags - pair.apart) / frame
    near = np.abs(at) <= NEAR
    panel.plot(at[near], scores[near], color=CURVE, linewidth=1.0, marker=".", markersize=4, zorder=3)
    spread = pair.shift.sigma / frame
    if np.isfinite(spread):
        panel.axvspan(-min(spread, NEAR), min(spread, NEAR), color=BEST, alpha=0.25, linewidth=0, zorder=1)
    panel.axvline(0.0, color=BEST, linewidth=0.8, alpha=0.6, zorder=2)
    _finish(panel, f"close up, ± {spread:.2g} frames" if np.isfinite(spread) else "close up", theme)
    panel.set_xlim(-NEAR, NEAR)


def _curve(pair: Compared) -> tuple[FloatArray, FloatArray]:
    """The finite part of the curve."""
    lags, scores = (np.asarray(values.detach().cpu().numpy(), dtype=np.float64) for values in (pair.shift.lags, pair.shift.scores))
    known = np.isfinite(scores)
    return lags[known], scores[known]


def _finish(panel: Any, title: str, theme: Theme) -> None:
    panel.set_title(title, fontsize=9, loc="left", parse_math=False)
    panel.grid(color=theme.line, linewidth=0.5, zorder=0)
    panel.set_axisbelow(True)
    panel.tick_params(length=2.5, labelsize=7.5)
    panel.margins(y=0.12)
    for name, side in panel.spines.items():
        side.set_linewidth(0.8)
        side.set_visible(name in ("left", "bottom"))

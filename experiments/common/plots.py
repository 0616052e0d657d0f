"""Pictures of the evaluation: curves of several methods side by side, and heat maps with their numbers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from experiments.recognition.protocol import Array
from indexing.report.canvas import LIGHT, cmap, new_figure, png, style

COLOURS = ("#0b4a60", "#e07b39", "#6aa84f", "#8e5ea2", "#b3123a", "#59636d")
MARKS = ("o", "s", "^", "D", "v", "P")
Curves = Mapping[str, tuple[Sequence[float], Sequence[float]]]
"""By method: x and y."""


def curves(
    panels: Mapping[str, Curves],
    across: str | Sequence[str],
    along: str = "accuracy",
    *,
    columns: int = 4,
    bottom: float | None = None,
    ticks: bool = False,
) -> bytes:
    """PNG of a panel per key; the same method has the same colour in all, and all share the vertical axis.

    Args:
        panels: title -> method -> (x, y).
        across, along: names of the axes; ``across`` one per panel, where they differ.
        columns: panels in a row, at most.
        bottom: of the vertical axis; by default below the lowest value.
        ticks: mark exactly the values of x.
    """
    names = list(dict.fromkeys(name for panel in panels.values() for name in panel))
    wide = min(columns, len(panels))
    rows = -(-len(panels) // wide)
    words = [across] * len(panels) if isinstance(across, str) else list(across)
    values = [value for panel in panels.values() for _, y in panel.values() for value in y if np.isfinite(value)]
    low = max(0.0, min(values, default=0.0) - 0.05) if bottom is None else bottom
    with style(LIGHT):
        figure = new_figure(3.0 * wide + 0.3, 2.5 * rows + 0.5)
        grid = figure.subplots(rows, wide, squeeze=False, sharey=True)
        for axes, (title, panel), word in zip(grid.flat, panels.items(), words, strict=False):
            for name, (x, y) in panel.items():
                which = names.index(name)
                axes.plot(x, y, color=COLOURS[which % 6], marker=MARKS[which % 6], markersize=4, linewidth=1.4, label=name)
                if ticks:
                    axes.set_xticks(list(x))
            axes.set_title(title, fontsize=9)
            axes.set_xlabel(word)
            axes.grid(color=LIGHT.line, linewidth=0.5)
        for axes in list(grid.flat)[len(panels) :]:
            axes.axis("off")
        grid[0, 0].set_ylim(low, 1.01)
        for line in grid:
            line[0].set_ylabel(along)
        _legend(figure, {line.get_label(): line for axes in grid.flat for line in axes.get_lines()})
        return png(figure)


def heat(panels: Mapping[str, Array], down: Sequence[object], across: Sequence[object], words: tuple[str, str]) -> bytes:
    """PNG of tables of shares, one beside the other, with their numbers.

    Args:
        panels: title -> ``(rows, columns)`` values between 0 and 1.
        down, across: names of rows and columns; words: what they are.
    """
    with style(LIGHT):
        cell = 0.5
        figure = new_figure((cell * len(across) + 0.9) * len(panels) + 0.4, cell * len(down) + 1.1)
        grid = figure.subplots(1, len(panels), squeeze=False, sharey=True)[0]
        for axes, (title, table) in zip(grid, panels.items(), strict=True):
            axes.imshow(table, cmap=cmap(LIGHT), vmin=0, vmax=1, aspect="equal")
            axes.set_xticks(range(len(across)), labels=[str(word) for word in across])
            axes.set_yticks(range(len(down)), labels=[str(word) for word in down])
            axes.tick_params(length=0)
            axes.set_title(title, fontsize=9)
            axes.set_xlabel(words[1])
            for (i, j), value in np.ndenumerate(table):
                _number(axes, i, j, float(value))
        grid[0].set_ylabel(words[0])
        figure.tight_layout()
        return png(figure, tight=True)


def _number(axes: Any, row: int, column: int, value: float) -> None:
    if np.isfinite(value):
        text = f"{value:.2f}".lstrip("0") if value < 1 else "1"
        axes.text(column, row, text, ha="center", va="center", fontsize=7, color=LIGHT.paper if value > 0.55 else LIGHT.ink)


def bars(panels: Mapping[str, tuple[Sequence[str], Mapping[str, Sequence[float]]]], along: str = "share right") -> bytes:
    """PNG of shares of several methods in groups, side by side.

    Args:
        panels: title -> (names of the groups, method -> a share per group).
    """
    names = list(dict.fromkeys(name for _, lines in panels.values() for name in lines))
    with style(LIGHT):
        figure = new_figure(4.2 * len(panels) + 0.4, 3.4)
        grid = figure.subplots(1, len(panels), squeeze=False, sharey=True)[0]
        for axes, (title, (groups, lines)) in zip(grid, panels.items(), strict=True):
            width = 0.8 / len(names)
            for name, shares in lines.items():
                which = names.index(name)
                at = np.arange(len(groups)) + (which - (len(names) - 1) / 2) * width
                drawn = axes.bar(at, shares, 0.9 * width, color=COLOURS[which % 6], label=name)
                axes.bar_label(drawn, [f"{share:.2f}".lstrip("0") if share < 1 else "1" for share in shares], fontsize=6)
            axes.set_xticks(range(len(groups)), labels=list(groups))
            axes.set_title(title, fontsize=9)
            axes.set_ylim(0, 1.08)
            axes.tick_params(length=0)
        grid[0].set_ylabel(along)
        _legend(figure, {drawn.get_label(): drawn for axes in grid for drawn in axes.containers})
        return png(figure)


def _legend(figure: Any, handles: Mapping[str, Any]) -> None:
    """What the colours mean, below everything, in as many columns as fit; and the room that is left for the rest."""
    width, height = figure.get_size_inches()
    columns = max(1, min(len(handles), int(width / (0.55 + 0.075 * max(map(len, handles))))))
    lines = -(-len(handles) // columns)
    figure.set_size_inches(width, height + 0.2 * (lines - 1))
    figure.legend(handles.values(), handles.keys(), loc="lower center", ncols=columns, frameon=False)
    figure.tight_layout(rect=(0, (0.2 * lines + 0.05) / (height + 0.2 * (lines - 1)), 1, 1))

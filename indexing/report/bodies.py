"""The report on bodies through many frames: what moves with which body, when each lives, how it moves, which stands still."""

from __future__ import annotations

import dataclasses
import functools
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dyntorch import Status
from dyntorch.core import Notice
from indexing.readers.matches import Photograph
from indexing.readers.tracks import TrackSet
from indexing.report.canvas import LIGHT, Theme, aspect, draw_photograph, finish, foot, layout, limits, png, shorten, style
from indexing.report.page import (
    even,
    markup,
    npz,
    safe_cell,
    sentence,
    table_csv,
)
from indexing.report.segmentation import STRAYS, LabelledReport, colour_of, describe_labels, legend_handles, mark_of, share
from indexing.report.summary import Summary, Table, register_page, warning_lines
from indexing.video.scene import evenly_spaced

FloatArray = NDArray[np.float64]
# the last one of videos
FILES = ("report.html", "segmentation.npz", "segmentation.json", "labels.csv", "tracks.csv", "segmentation.png", "segmentation.mp4")
FILM = "segmentation.mp4"
ALIVE = 3  # tracks that a frame must show of a body; fewer where it has fewer
GEOMETRY = {False: "with depth: fundamental matrices", True: "a plane, or under a rotation alone: homographies"}


@dataclass(frozen=True, eq=False, kw_only=True)
class BodiesReport(LabelledReport):
    """Everything that the report on bodies through many frames says."""

    tracks: TrackSet
    photographs: Mapping[int, Photograph] = field(default_factory=dict)
    size: tuple[float, float] | None = None

    TITLES = ("What moves with what", "The tracks do not decide")
    ABSENT = "too short"

    @functools.cached_property
    def present(self) -> NDArray[np.bool_]:
        """``(n,)`` tracks that two views see at least: of the others nothing can be known."""
        return np.asarray(self.there.sum(axis=0) > 1)

    @property
    def known_labels(self) -> NDArray[np.int64] | None:
        """``(n,)`` labels that the file has."""
        return self.tracks.known

    @property
    def static(self) -> int:
        """The body that stands still; 0 = the data do not say."""
        return int(self.arrays.static_body) if int(self.arrays.static_body) <= self.bodies else 0

    @functools.cached_property
    def named_notices(self) -> list[Notice]:
        """The notices, frames by their names: the library numbers them from 0."""
        notices = []
        for notice in self.result.notices:
            values = {key: self._frame(value) if key in ("frame", "frames") else value for key, value in notice.values.items()}
            notices.append(dataclasses.replace(notice, values=values).with_words(self.words))
        return notices

    def _frame(self, value: Any) -> Any:
        if isinstance(value, Sequence) and not isinstance(value, str):
            return ", ".join(str(self._frame(one)) for one in value)
        views = self.tracks.views
        return views[int(value)] if isinstance(value, (int, float)) and 0 <= int(value) < len(views) else value

    @functools.cached_property
    def warnings(self) -> list[tuple[str, float, str]]:
        """Code, figure and sentence of every notice."""
        return [(notice.code.value, notice.value, str(notice.text)) for notice in self.named_notices]

    @property
    def reason(self) -> str:
        """Why the data do not decide, and what to do; empty where they do."""
        return str(dataclasses.replace(self.result, notices=tuple(self.named_notices)).refusal(self.words, Status[self.status]))

    @functools.cached_property
    def there(self) -> NDArray[np.bool_]:
        """``(views, n)`` where each track is seen."""
        return np.asarray(np.isfinite(self.tracks.values).all(axis=-1))

    @property
    def pairs(self) -> NDArray[np.int64]:
        """``(P, 2)`` places of the views that were compared."""
        return np.asarray(self.arrays.pairs[(self.arrays.pairs >= 0).all(axis=-1)])

    def life(self, label: int) -> tuple[int, int] | None:
        """Places of the first and the last view that show a body; None = none does."""
        mine = self.there[:, self.arrays.labels == label].sum(axis=1)
        alive = np.flatnonzero((mine > 0) & (mine >= min(ALIVE, mine.max(initial=0))))
        return (int(alive[0]), int(alive[-1])) if len(alive) else None

    def motion(self, label: int) -> float:
        """Median way of a body's points in the picture, pixels per frame; the camera's own motion is in it."""
        values = self.tracks.values[:, self.arrays.labels == label]
        steps = np.linalg.norm(np.diff(values, axis=0), axis=-1) / self._frame_gaps[:, None]
        steps = steps[np.isfinite(steps)]
        return float(np.median(steps)) if len(steps) else float("nan")

    def planar(self, label: int) -> bool | None:
        """Whether most pairs of views see a body as a plane, or under a rotation; None where no pair shows it."""
        shown = np.abs(self.arrays.geometries[:, label - 1]).sum(axis=(1, 2)) > 0
        flat = self.arrays.planar[:, label - 1]
        shown |= flat
        return bool(flat[shown].mean() > 0.5) if shown.any() else None

    @functools.cached_property
    def _frame_gaps(self) -> FloatArray:
        """Frames between a view and the next."""
        numbers = self.tracks.views
        if self.tracks.by_time or not all(re.fullmatch(r"-?\d+", name) for name in numbers):
            return np.ones(len(numbers) - 1)
        return np.maximum(1.0, np.abs(np.diff([float(name) for name in numbers])))


def static_text(report: BodiesReport) -> str:
    """Which body stands still, in a sentence."""
    if report.static:
        return f"body {report.static} stands still"
    return "the tracks do not say which body stands still"


def describe(report: BodiesReport) -> str:
    """The result in plain words."""
    static = f" {sentence(static_text(report))}" * (report.bodies > 1)
    return describe_labels(report, f"tracks through {len(report.tracks.views):,} frames", further=static)


def rows_of(report: BodiesReport) -> list[list[str]]:
    """A row of words for every body: tracks, share, frames, motion, residual, doubtful, geometry."""
    labels = range(1, report.bodies + 1)
    # a point that rests goes nowhere, whatever the tracker's last digits say
    moved = even([round(report.motion(label), 2) for label in labels])
    noise = even([round(report.rms(label), 4) for label in labels])
    rows = []
    for label in labels:
        mine = report.of(label)
        life, flat = report.life(label), report.planar(label)
        names = "" if life is None else f"{report.tracks.views[life[0]]} to {report.tracks.views[life[1]]}"
        figures = [f"{mine.sum():,}", share(int(mine.sum()), int(report.present.sum())), names, moved[label - 1], noise[label - 1]]
        rows.append([*figures, f"{int((mine & report.is_doubtful).sum()):,}", "" if flat is None else GEOMETRY[flat]])
    return rows


@register_page(BodiesReport, "bodies", FILES)
def summarize(report: BodiesReport) -> Summary:
    """Everything that is said of bodies through many frames."""
    number, outliers = max(1, int(report.present.sum())), report.counts["outlier"]
    rows: list[list[object]] = []
    for label, (tracks, _, lives, moved, noise, _, geometry) in enumerate(rows_of(report), start=1):
        part = f"{100 * report.counts[f'body {label}'] / number:.1f} %"
        rows.append([f"body {label}" + " (static)" * (label == report.static), tracks, part, lives, moved, noise, geometry])
    rest = "outliers" if report.bodies else "unlabelled"
    rows.append([rest, f"{outliers:,}", f"{100 * outliers / number:.1f} %", "", "", "", ""])
    heads = ["body", "tracks ", "share ", "frames", "px per frame ", "noise rms px ", "geometry"]
    return Summary(
        headline=describe(report), tables=[Table(heads, rows, report.errors)], notes=warning_lines(report),
        pictures={"segmentation.png": partial(picture_of, report)}, dark=bool(report.photographs),
        files={
            "labels.csv": partial(labels_csv, report), "tracks.csv": partial(tracks_csv, report),
            "segmentation.npz": partial(as_npz, report), "segmentation.json": partial(as_json, report), FILM: None,
        },
        values=partial(page_values, report),
    )  # fmt: skip


def page_values(report: BodiesReport) -> dict[str, Any]:
    """Rows of the page's table of bodies, and what else its template shows."""
    dot = '<span class="drawn" style="color:{colour}" aria-hidden="true">●</span> body {label}{still}'
    bodies: list[list[Any]] = []
    for label, row in enumerate(rows_of(report), start=1):
        still = ", stands still" if label == report.static else ""
        name = markup(dot, colour=colour_of(label), label=label, still=still)
        bodies.append([name, *row[:2], markup("{words}{span}", words=row[2], span=_span(report, label)), *row[3:]])
    return {**report.values, "standing": static_text(report), "film": FILM, "bodies": bodies}


def _span(report: BodiesReport, label: int) -> Any:
    """How many tracks of a body each frame shows, as a small outline below the frames' names."""
    mine = report.there[:, report.arrays.labels == label].sum(axis=1)
    most, views = max(1, int(mine.max(initial=0))), len(mine)
    edge = " ".join(f"{100 * i / max(1, views - 1):.1f},{8 - 8 * n / most:.1f}" for i, n in enumerate(mine.tolist()))
    return markup(
        '<svg class="bar" viewBox="0 0 100 8" preserveAspectRatio="none" aria-hidden="true">'
        '<rect class="track" width="100" height="8"/><polygon points="0,8 {edge} 100,8" fill="{colour}"/></svg>',
        edge=edge, colour=colour_of(label),
    )  # fmt: skip


def as_npz(report: BodiesReport) -> bytes:
    """All arrays, without pickle; ``tracks, ids, frames`` are those that were given."""
    found, bodies = report.arrays, report.bodies
    compared = (found.pairs >= 0).all(axis=-1)
    arrays: dict[str, Any] = {name: getattr(found, name) for name in ("labels", "residuals", "threshold")}
    arrays |= {name: getattr(found, name)[compared][:, :bodies] for name in ("geometries", "homographies", "planar")}
    arrays |= {"probabilities": found.probabilities[:, : bodies + 1], "pairs": report.pairs, "static_body": report.static}
    arrays |= {"status": report.status, "tracks": report.tracks.values, "ids": np.array(report.tracks.ids)}
    arrays |= {"frames": np.array(report.tracks.views)}
    return npz(arrays if report.tracks.known is None else {**arrays, "known": report.tracks.known})


def as_json(report: BodiesReport) -> dict[str, Any]:
    """The result as numbers: bodies, when they live and how they move, which stands still, counts, status, and how it was made."""
    views, bodies = report.tracks.views, []
    for label in range(1, report.bodies + 1):
        number, life = report.counts[f"body {label}"], report.life(label)
        bodies.append({
            "label": label,
            "tracks": number,
            "share": number / max(1, int(report.present.sum())),
            "first_frame": None if life is None else views[life[0]],
            "last_frame": None if life is None else views[life[1]],
            "pixels_per_frame": report.motion(label),
            "planar": report.planar(label),
            "rms_residual": report.rms(label),
        })  # fmt: skip
    return {
        **report.outcome_json,
        "tracks": len(report.tracks.ids),
        "frames": len(views),
        "bodies": bodies,
        "static_body": report.static or None,
        "pairs": [[views[a], views[b]] for a, b in report.pairs.tolist()],
    }


def labels_csv(report: BodiesReport) -> str:
    """``id, label, name, probability, residual, frames, first, last`` of every track; label 0 is an outlier, or too short."""
    rows: list[list[Any]] = []
    views = report.tracks.views
    for i, (name, kind, sure) in enumerate(zip(report.tracks.ids, report.kinds, report.certainty, strict=True)):
        seen = np.flatnonzero(report.there[:, i])
        lived = [len(seen), views[seen[0]], views[seen[-1]]] if len(seen) else [0, "", ""]
        short = kind == "too short"
        figures = ["" if short else f"{sure:.4f}", "" if short or not report.bodies else f"{report.arrays.residuals[i]:.6g}"]
        rows.append([safe_cell(name), int(report.arrays.labels[i]), kind, *figures, *lived])
    return table_csv(["id", "label", "name", "probability", "residual", "frames", "first", "last"], rows)


def tracks_csv(report: BodiesReport) -> str:
    """``frame, time, id, x, y, label`` of every track in every frame that shows it: what ``dyntorch reconstruct`` reads, too."""
    tracks = report.tracks
    head = ["frame", "id", "x", "y", "label"]
    timed = tracks.times is not None and not tracks.by_time
    rows: list[list[Any]] = []
    for view, (name, there) in enumerate(zip(tracks.views, report.there, strict=True)):
        moment = [f"{tracks.times[view]:.6g}"] if tracks.times is not None and timed else []
        for i in np.flatnonzero(there).tolist():
            x, y = tracks.values[view, i, :2]
            rows.append([name, *moment, safe_cell(tracks.ids[i]), f"{x:.4f}", f"{y:.4f}", int(report.arrays.labels[i])])
    head = ["time" if tracks.by_time else "frame", *(["time"] if timed else []), *head[1:]]
    return table_csv(head, rows)


# ----------------------------------------------------------------------------------------------------------------------
# The picture: some of the frames, the points in the colours of their bodies, and their tails.


Box = tuple[FloatArray, FloatArray]
PANELS = 4  # frames that are shown
TALL = 4.4  # inches
WIDE = 0.22  # height over width below which pictures are drawn one above the other
NARROW = 1.3  # and from which they are all drawn side by side
TAIL = 0.12  # of all views: how far back tails lead
FRINGE = 3  # views before which tails are too short to be seen
DRAWN = 1500  # tracks of a body in a panel; more are a blot


def picture_of(report: BodiesReport, theme: Theme = LIGHT) -> bytes:
    """PNG: four frames from the first to the last, or those that there are photographs of."""
    shown = sorted(report.photographs) or evenly_spaced(len(report.tracks.views), PANELS)
    box = _box(report)
    with style(theme):
        columns = PANELS if aspect(box) > NARROW else 2 if aspect(box) > WIDE else 1
        figure, panels = layout([box] * len(shown), TALL, *((0.0, 0.12) if report.photographs else (0.45, 0.57)), columns)
        for panel, view in zip(panels, shown, strict=True):
            photograph = report.photographs.get(view)
            if photograph is not None:
                draw_photograph(panel, photograph, theme)
            _draw(panel, report, view, theme)
            finish(panel, *box, True, shorten(_view_name(report, view), 60))
            if photograph is not None:
                panel.set(xticks=[], yticks=[])
        suffixes = [" (static)" * (label == report.static) for label in range(1, report.bodies + 1)]
        foot(figure, legend_handles(report, suffixes, theme), columns=6, ink=theme.ink)
        return png(figure, tight=True)


def _view_name(report: BodiesReport, view: int) -> str:
    name, times = report.tracks.views[view], report.tracks.times
    if report.tracks.by_time:
        return f"{name} s"
    moment = "" if times is None else f", {times[view]:.2f} s"
    return f"frame {name}{moment}" if name.lstrip("-").replace(".", "", 1).isdigit() else name


def _box(report: BodiesReport) -> Box:
    """What every panel shows: the picture where its size is known, otherwise all of the tracks."""
    size = next((photograph.size for photograph in report.photographs.values()), report.size)
    if size is not None:
        return np.array([-0.5, -0.5]), np.array(size) - 0.5
    return limits(report.tracks.values[..., :2], STRAYS)


def _draw(panel: Any, report: BodiesReport, view: int, theme: Theme) -> None:
    """Points of one frame, those of small bodies on top, and the way that they came."""
    from matplotlib.collections import LineCollection

    tail = max(FRINGE, round(TAIL * len(report.tracks.views)))
    part = report.tracks.values[max(0, view - tail) : view + 1, :, :2]
    here = np.isfinite(part[-1]).all(axis=-1) & report.present
    size = float(np.clip(3000 / max(1, int(here.sum())), 3, 16))
    strays = part[-1, here & (report.arrays.labels == 0)]
    panel.scatter(*strays.T, s=0.8 * size, c=theme.muted, marker="x", linewidth=0.8, alpha=0.65, zorder=2)
    for label in range(1, report.bodies + 1):
        mine = np.flatnonzero(here & (report.arrays.labels == label))
        mine = mine[np.linspace(0, len(mine) - 1, min(len(mine), DRAWN)).round().astype(int)]
        ways = [path[np.isfinite(path).all(axis=1)] for path in part[:, mine].transpose(1, 0, 2)]
        lines = LineCollection(ways, colors=colour_of(label), linewidths=0.8, alpha=0.55, zorder=2 + label)
        panel.add_collection(lines, autolim=False)
        look: Any = {"marker": mark_of(label), "edgecolor": theme.paper, "linewidth": 0.3}
        panel.scatter(*part[-1, mine].T, s=size, c=colour_of(label), zorder=2.5 + label, **look)

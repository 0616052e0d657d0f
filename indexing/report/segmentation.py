"""The report on a segmentation: which match moves with which body, how each body moved, and how sure that is."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from indexing.opening import count
from indexing.readers.matches import MatchedPair, Photograph
from indexing.report.canvas import (
    LIGHT,
    Theme,
    aspect,
    draw_photograph,
    finish,
    foot,
    layout,
    limits,
    png,
    sample,
    shorten,
    style,
)
from indexing.report.page import (
    ResultReport,
    even,
    markup,
    matrix,
    npz,
    safe_cell,
    sentence,
    table_csv,
)
from indexing.report.summary import Summary, Table, register_page, warning_lines

FloatArray = NDArray[np.float64]
SURE = 0.9  # probability of its label below which a point is called doubtful
# neighbours in the list are apart for colour-blind eyes, too, on both papers and on gray
COLOURS = ("#2f7fb8", "#e8741e", "#2fa36b", "#c2478f", "#b99a0d", "#7d62c9", "#1fa6a6", "#d1493f")


@dataclass(frozen=True, eq=False, kw_only=True)
class LabelledReport(ResultReport):
    """A report on points (matches, tracks) that move each with a body, or with none."""

    ABSENT: ClassVar[str] = ""
    """What a point is called that nothing can be known of."""

    @property
    def present(self) -> NDArray[np.bool_]:
        """``(n,)`` the points that something can be known of."""
        raise NotImplementedError

    @property
    def known_labels(self) -> NDArray[np.int64] | None:
        """``(n,)`` labels that the file has; None where it has none."""
        raise NotImplementedError

    @property
    def bodies(self) -> int:
        """How many bodies."""
        return int(self.arrays.bodies)

    @property
    def status(self) -> str:
        """The status's name; that there are no bodies is no answer."""
        status = super().status
        return status if status != "OK" or self.bodies else "NO_CONSENSUS"

    @property
    def names(self) -> list[str]:
        """What labels mean: outlier, body 1, body 2, ..."""
        return ["outlier", *(f"body {i}" for i in range(1, self.bodies + 1))]

    @property
    def kinds(self) -> list[str]:
        """What each point is: one of the names, or absent."""
        labels, present = self.arrays.labels.tolist(), self.present.tolist()
        return [self.names[label] if there else self.ABSENT for label, there in zip(labels, present, strict=True)]

    @functools.cached_property
    def counts(self) -> dict[str, int]:
        """How many points of each kind, bodies first."""
        kinds = self.kinds
        return {name: kinds.count(name) for name in (*self.names[1:], "outlier", self.ABSENT)}

    @property
    def certainty(self) -> FloatArray:
        """``(n,)`` probability of the label of each point; NaN where it is absent."""
        own = np.take_along_axis(self.arrays.probabilities, self.arrays.labels[:, None], axis=1)[:, 0]
        return np.where(self.present, own, np.nan)

    @property
    def is_doubtful(self) -> NDArray[np.bool_]:
        """``(n,)`` points that might well have another label."""
        return np.asarray(self.certainty < SURE)

    def of(self, label: int) -> NDArray[np.bool_]:
        """``(n,)`` the points with a label."""
        return np.asarray(self.present & (self.arrays.labels == label))

    def rms(self, label: int | None = None) -> float:
        """Root mean square of the residuals of one body, or of all; NaN where there are no points."""
        mine = self.present & (self.arrays.labels > 0) if label is None else self.of(label)
        return float(np.sqrt(np.mean(np.square(self.arrays.residuals[mine])))) if mine.any() else float("nan")

    def rms_text(self, label: int | None = None) -> str:
        """The same in three digits, empty where there are no points."""
        value = self.rms(label)
        return f"{value:.3g}" if np.isfinite(value) else ""

    @property
    def misclassification(self) -> float | None:
        """Share of the points that are not labelled as the file says, whatever the bodies' numbers; None where it does not say."""
        if self.known_labels is None or not self.bodies:
            return None
        import torch

        from dyntorch import metrics

        known, present = torch.from_numpy(self.known_labels), torch.from_numpy(self.present)
        return float(metrics.misclassification(self.result.labels[present], known[present]))

    @property
    def values(self) -> dict[str, Any]:
        """What the templates of all such reports show: doubtful points, known labels, the residual."""
        doubtful = ["doubtful" if odd else "" for odd in self.is_doubtful.tolist()]
        return {"doubtful": doubtful, "compared": self.confusion_rows, "rms": self.rms_text(), "share": share}

    @property
    def outcome_json(self) -> dict[str, Any]:
        """And how many points are of each kind, doubtful and wrong, how far they are off, and how far they may be."""
        numbers = {"counts": self.counts, "doubtful": int(self.is_doubtful.sum()), "misclassified": self.misclassification}
        return {**super().outcome_json, **numbers, "rms_residual": self.rms(), "threshold": float(self.arrays.threshold)}

    @property
    def errors(self) -> list[str]:
        """How many labels are wrong, in a sentence, where the file has labels."""
        wrong = self.misclassification
        return [] if wrong is None else [f"misclassified: {100 * wrong:.2f} % against the labels of the file"]

    @property
    def confusion_rows(self) -> list[list[str]]:
        """A row for every body that the file knows: its name, and how many of its points were found to be of which body."""
        if self.known_labels is None or not self.bodies:
            return []
        rows = []
        for label in sorted(np.unique(self.known_labels[self.present]).tolist(), key=lambda label: (label == 0, label)):
            of = self.arrays.labels[self.present & (self.known_labels == label)]
            cells = [int((of == i).sum()) for i in (*range(1, self.bodies + 1), 0)]
            rows.append([f"body {label}" if label else "outlier", *(f"{cell:,}" if cell else "" for cell in cells)])
        return rows


def describe_labels(report: LabelledReport, points: str, where: str = "", further: str = "") -> str:
    """What moves with what, in plain words; or why the data do not decide."""
    number, counts = int(report.present.sum()), report.counts
    if report.status != "OK":
        start = f"The {number:,} {points} do not decide what moves with what. {sentence(report.reason)}"
        return start + " What follows is the best segmentation found, and not to be relied on." * (report.bodies > 0)
    *most, last = [f"{counts[name]:,}" for name in report.names[1:]]
    moved = f"{number - counts['outlier']:,} move "
    moved += f"with one of {report.bodies} bodies ({', '.join(most)} and {last})" if most else "as one body"
    outliers = f"; {count(counts['outlier'], 'fits', 'fit')} none" * (counts["outlier"] > 0)
    return f"Of {number:,} {points}{where}, {moved}{outliers}.{further}"


def legend_handles(report: LabelledReport, suffixes: Sequence[str], theme: Theme) -> list[Any]:
    """Entries of the legend: every body with its points and what else is said of it, and the outliers."""
    from matplotlib.lines import Line2D

    counts, handles = report.counts, []
    for label, suffix in enumerate(suffixes, start=1):
        text = f"body {label}: {counts[f'body {label}']:,}{suffix}"
        handles.append(Line2D([], [], color=colour_of(label), marker=mark_of(label), linestyle="", markersize=5.5, label=text))
    if counts["outlier"]:
        noun = "outlier" if report.bodies else "unlabelled"
        text = f"{counts['outlier']:,} {noun}{'s' * (report.bodies > 0 and counts['outlier'] > 1)}"
        handles.append(Line2D([], [], color=theme.muted, marker="x", linestyle="", markersize=5, label=text))
    return handles


def share(part: int, whole: int) -> str:
    """A share in whole percents."""
    percent = 100 * part / max(1, whole)
    return "under 1 %" if 0 < percent < 1 else f"{percent:.0f} %"


def colour_of(label: int) -> str:
    """The colour of a body."""
    return COLOURS[(label - 1) % len(COLOURS)]


# ----------------------------------------------------------------------------------------------------------------------
# Matches of two images.


# the last one of videos
FILES = ("report.html", "segmentation.npz", "segmentation.json", "labels.csv", "segmentation.png", "tracks.csv")
MOTION = {
    "fundamental": "fundamental matrix: a rigid body with depth",
    "homography": "homography: a plane, or a body seen under a rotation alone",
}


@dataclass(frozen=True, eq=False, kw_only=True)
class SegmentationReport(LabelledReport):
    """Everything that the report on a segmentation says."""

    pair: MatchedPair
    photographs: Sequence[Photograph] = ()
    size: tuple[float, float] | None = None

    TITLES = ("What moves with what", "The matches do not decide")
    ABSENT = "missing"

    @property
    def present(self) -> NDArray[np.bool_]:
        """``(n,)`` matches that are there in both images."""
        return self.pair.complete

    @property
    def known_labels(self) -> NDArray[np.int64] | None:
        """``(n,)`` labels that the file has."""
        return self.pair.known

    @property
    def models(self) -> list[str]:
        """What each body's motion is: fundamental or homography."""
        return [str(model) for model in self.result.models[: self.bodies]]

    @property
    def num_present(self) -> int:
        """How many matches are there in both images."""
        return int(self.present.sum())


def describe(report: SegmentationReport) -> str:
    """The result in plain words."""
    missing = report.counts["missing"]
    lost = f" {count(missing, 'more is', 'more are')} missing in an image." * (missing > 0)
    return describe_labels(report, "matches", " of two images", lost)


@register_page(SegmentationReport, "segmentation", FILES)
def summarize(report: SegmentationReport) -> Summary:
    """Everything that is said of a segmentation."""
    number, counts = report.num_present, report.counts
    noise = even([report.rms(label) for label in range(1, len(report.models) + 1)])
    rows: list[list[object]] = []
    for label, model in enumerate(report.models, start=1):
        mine = counts[f"body {label}"]
        rows.append([f"body {label}", f"{mine:,}", f"{100 * mine / number:.1f} %", model, noise[label - 1] if mine else ""])
    rest = "outliers" if report.models else "unlabelled"
    rows.append([rest, f"{counts['outlier']:,}", f"{100 * counts['outlier'] / number:.1f} %", "", ""])
    return Summary(
        headline=describe(report), notes=warning_lines(report),
        tables=[Table(["body", "matches ", "share ", "model", "noise rms px "], rows, report.errors)],
        pictures={"segmentation.png": partial(picture_of, report)}, dark=bool(report.photographs),
        files={
            "labels.csv": partial(labels_csv, report), "segmentation.npz": partial(as_npz, report),
            "segmentation.json": partial(as_json, report), "tracks.csv": None, "segmentation.mp4": None,
        },
        values=partial(page_values, report),
    )  # fmt: skip


def page_values(report: SegmentationReport) -> dict[str, Any]:
    """Rows of the page's tables: the bodies, their matrices, and how many matches of every known body were found to be of which."""
    bodies, matrices = [], []
    for label, model in enumerate(report.models, start=1):
        mine = report.of(label)
        dot = '<span class="drawn" style="color:{colour}" aria-hidden="true">●</span> body {label}'
        figures = [f"{mine.sum():,}", share(int(mine.sum()), report.num_present), report.rms_text(label)]
        doubtful = f"{int((mine & report.is_doubtful).sum()):,}"
        bodies.append([markup(dot, colour=colour_of(label), label=label), *figures, doubtful, MOTION.get(model, model)])
        found = report.arrays.homographies if model == "homography" else report.arrays.fundamentals
        matrices.append([f"body {label}", model, matrix(found[label - 1])])
    return {**report.values, "bodies": bodies, "matrices": matrices}


def as_npz(report: SegmentationReport) -> bytes:
    """All arrays, without pickle; ``x1, x2, ids, known`` are those that were given."""
    found, bodies = report.arrays, report.bodies
    arrays: dict[str, Any] = {name: getattr(found, name) for name in ("labels", "residuals", "coherence", "threshold")}
    arrays |= {name: getattr(found, name)[:bodies] for name in ("fundamentals", "homographies")}
    arrays |= {"probabilities": found.probabilities[:, : bodies + 1], "models": np.array(report.models, dtype=np.str_)}
    arrays |= {"status": report.status, "x1": report.pair.x1, "x2": report.pair.x2, "ids": np.array(report.pair.ids)}
    return npz(arrays if report.pair.known is None else {**arrays, "known": report.pair.known})


def as_json(report: SegmentationReport) -> dict[str, Any]:
    """The result as numbers: bodies with their models, counts, status, warnings, and how it came about."""
    bodies = [
        {
            "label": label,
            "matches": report.counts[f"body {label}"],
            "share": report.counts[f"body {label}"] / max(1, report.num_present),
            "model": model,
            "rms_residual": report.rms(label),
            "fundamental": report.arrays.fundamentals[label - 1],
            "homography": report.arrays.homographies[label - 1] if model == "homography" else None,
        }
        for label, model in enumerate(report.models, start=1)
    ]
    return {
        **report.outcome_json,
        "pair": report.pair.name,
        "matches": len(report.pair.ids),
        "bodies": bodies,
    }


def labels_csv(report: SegmentationReport) -> str:
    """``id, x1, y1, x2, y2, label, name, probability, residual`` of every match; label 0 is an outlier, or missing."""
    rows: list[list[Any]] = []
    columns = zip(report.pair.ids, report.pair.x1, report.pair.x2, report.kinds, report.certainty, strict=True)
    for i, (name, first, second, kind, sure) in enumerate(columns):
        places = [f"{value:.9g}" if np.isfinite(value) else "" for value in (*first, *second)]
        residual = f"{report.arrays.residuals[i]:.6g}" if report.bodies else ""
        rest = ["", ""] if kind == "missing" else [f"{sure:.4f}", residual]
        rows.append([safe_cell(name), *places, int(report.arrays.labels[i]), kind, *rest])
    return table_csv(["id", "x1", "y1", "x2", "y2", "label", "name", "probability", "residual"], rows)


# ----------------------------------------------------------------------------------------------------------------------
# The picture of a segmentation: both images, the matches coloured by their body, and how they moved.


Box = tuple[FloatArray, FloatArray]
MARKS = ("o", "s", "^", "D")  # one for every round through the colours
TALL = 5.2  # inches
WIDE = 0.42  # height over width below which images are drawn one above the other
STRAYS = 0.995  # of the matches, those that a panel without image shows
SLIM = 0.2  # least ratio of the sides of such a panel


def picture_of(report: SegmentationReport, theme: Theme = LIGHT) -> bytes:
    """PNG: image 1 with the way of every match of a body to its place in image 2, and image 2."""
    places = (report.pair.x1, report.pair.x2)
    photographs: list[Photograph | None] = [*report.photographs] or [None, None]
    boxes = [_box(report, i) for i in range(2)]
    size = float(np.clip(4500 / max(1, len(report.arrays.labels)), 5, 20))
    with style(theme):
        edge, gap = (0.0, 0.15) if report.photographs else (0.45, 0.5)
        figure, panels = layout(boxes, TALL, edge, gap, 2 if max(map(aspect, boxes)) > WIDE else 1)
        for i, (panel, points, photograph, box) in enumerate(zip(panels, places, photographs, boxes, strict=True)):
            if photograph is not None:
                draw_photograph(panel, photograph, theme)
            _draw_outliers(panel, points[report.of(0)], size, theme)
            for label in range(1, report.bodies + 1):  # the small ones on top: dense bodies would hide them otherwise
                mine = report.of(label)
                if i == 0:
                    _draw_ways(panel, np.stack([points[mine], places[1][mine]]), label, box)
                _draw_points(panel, points[mine], label, size, theme)
            name = photograph.name if photograph is not None else f"image {i + 1}"
            finish(panel, *box, True, shorten(name, 50) + ", with the way to image 2" * (i == 0 and report.bodies > 0))
            if photograph is not None:
                panel.set(xticks=[], yticks=[])
        suffixes = [" (homography)" * (model == "homography") for model in report.models]
        foot(figure, legend_handles(report, suffixes, theme), columns=6, ink=theme.ink)
        return png(figure, tight=True)


def _box(report: SegmentationReport, which: int) -> Box:
    """What a panel shows: the image where its size is known, otherwise the matches in either image."""
    size = report.photographs[which].size if report.photographs else report.size
    if size is not None:
        return np.array([-0.5, -0.5]), np.array(size) - 0.5
    places = np.stack([report.pair.x1, report.pair.x2])
    low, high = limits(places[:, report.arrays.labels > 0])
    every = limits(places[:, report.pair.complete], STRAYS)
    if (report.arrays.labels > 0).any():
        every = np.minimum(low, every[0]), np.maximum(high, every[1])
    sides = every[1] - every[0]
    room = np.maximum(0, SLIM * sides.max() - sides) / 2
    return every[0] - room, every[1] + room


def _draw_outliers(panel: Any, points: FloatArray, size: float, theme: Theme) -> None:
    panel.scatter(*points.T, s=0.7 * size, c=theme.muted, marker="x", linewidth=0.8, alpha=0.65, zorder=2)


def _draw_ways(panel: Any, paths: FloatArray, label: int, box: Box) -> None:
    """Where matches ``(2, n, 2)`` went; of long ways that would tangle, some."""
    from matplotlib.collections import LineCollection

    ways = paths[:, sample(paths, box)].transpose(1, 0, 2)
    panel.add_collection(LineCollection(list(ways), colors=colour_of(label), linewidths=0.8, alpha=0.45, zorder=3), autolim=False)


def _draw_points(panel: Any, points: FloatArray, label: int, size: float, theme: Theme) -> None:
    look: Any = {"marker": mark_of(label), "edgecolor": theme.paper, "linewidth": 0.4}
    panel.scatter(*points.T, s=size, c=colour_of(label), zorder=4, **look)


def mark_of(label: int) -> str:
    return MARKS[(label - 1) // len(COLOURS) % len(MARKS)]

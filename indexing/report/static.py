"""The report on a COLMAP database: what stands still in its images, and what was kept of its pairs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from indexing.colmap import MatchDatabase, StaticPoints
from indexing.opening import count
from indexing.readers.matches import Photograph
from indexing.report.canvas import LIGHT, Theme, draw_photograph, finish, foot, layout, png, shorten, style
from indexing.report.page import bar, safe_cell, sentence, table_csv
from indexing.report.summary import Summary, Table, register_page

FILES = ("report.html", "static.json", "images.csv", "pairs.csv", "static.png")
PANELS, COLUMNS, TALL = 6, 3, 6.6  # of the picture: images, and inches
ROWS = 100  # images and pairs that the page lists
KINDS = {1: "stands still", -1: "moves", 0: "not known"}
COLOURS = {1: "#2f7fb8", -1: "#e8741e"}


@dataclass(frozen=True, eq=False, kw_only=True)
class StaticReport:
    """Everything that the report on a database says."""

    static: StaticPoints
    written: str = ""
    masks: str = ""
    photographs: Mapping[int, Photograph] = field(default_factory=dict)
    heading: str = ""
    notes: Sequence[str] = ()
    manifest: Mapping[str, Any] = field(default_factory=dict)

    @property
    def title(self) -> str:
        """Heading of the page."""
        return self.heading or ("What stands still" if self.static.ok else "The matches do not decide what stands still")

    @property
    def refusal(self) -> str | None:
        """Why the matches do not decide; None where they do."""
        return None if self.static.ok else self.static.reason

    @property
    def matches(self) -> int:
        """Of all pairs of the database."""
        return self.static.database.matches

    @property
    def num_static(self) -> int:
        """Matches that stand still."""
        return sum(map(len, self.static.kept))

    @property
    def inliers(self) -> list[int]:
        """Verified static matches of each pair."""
        return [len(geometry.inliers) for geometry in self.static.geometries]

    @property
    def all_notes(self) -> list[str]:
        """What a reader should note, a sentence each, less the refusal."""
        return [*self.notes, *self.static.notes]


def describe(report: StaticReport) -> str:
    """The result in plain words."""
    database = report.static.database
    given = f"{count(report.matches, 'match', 'matches')} of {count(len(database.pairs), 'pair')} of {len(database.images)} images"
    if not report.static.ok:
        return f"The {given} do not decide. {sentence(report.static.reason)} No database was written."
    share = report.num_static / max(1, report.matches)
    enough = count(sum(map(bool, report.inliers)), "pair has", "pairs have")
    return f"Of {given}, {report.num_static:,} ({100 * share:.0f} %) stand still; {enough} enough of them."


def image_rows(report: StaticReport) -> list[list[Any]]:
    """Name, keypoints in matches, static ones, moving ones, spread of the static ones, and whether too few of them are left."""
    found = report.static
    used: list[set[int]] = [set() for _ in found.database.images]
    for pair in found.database.pairs:
        used[pair.first].update(pair.matches[:, 0].tolist())
        used[pair.second].update(pair.matches[:, 1].tolist())
    return [
        [image.name, len(used[k]), int((kinds > 0).sum()), int((kinds < 0).sum()), float(found.spread[k]), k in found.refused]
        for k, (image, kinds) in enumerate(zip(found.database.images, found.keypoints, strict=True))
    ]


def pair_rows(report: StaticReport) -> list[list[Any]]:
    """Names of both images, matches, bodies, how many of these stand still, matches kept, verified, and how the division ended."""
    found, rows = report.static, []
    for k, pair in enumerate(found.database.pairs):
        names = [found.database.images[place].name for place in (pair.first, pair.second)]
        static = int((found.signs[k] > 0).sum())
        state = found.bodies[k].state.lower().replace("_", " ") or "left to the votes"
        rows.append([*names, len(pair.matches), len(found.signs[k]), static, len(found.kept[k]), report.inliers[k], state])
    return rows


def as_json(report: StaticReport) -> dict[str, Any]:
    """The result as numbers."""
    heads = ("name", "matched", "static", "moving", "spread", "refused")
    columns = ("first", "second", "matches", "bodies", "static_bodies", "kept", "verified", "division")
    return {
        "status": "OK" if report.static.ok else "REFUSED",
        "reason": report.static.reason or None,
        "matches": report.matches,
        "kept": report.num_static,
        "verified": sum(report.inliers),
        "lead": report.static.lead,
        "images": [dict(zip(heads, row, strict=True)) for row in image_rows(report)],
        "pairs": [dict(zip(columns, row, strict=True)) for row in pair_rows(report)],
        "database": report.written or None,
        "masks": report.masks or None,
        "notes": report.all_notes,
        "manifest": report.manifest,
    }


@register_page(StaticReport, "static", FILES)
def summarize(report: StaticReport) -> Summary:
    """Everything that is said of what stands still in a database."""
    found, rows = report.static, image_rows(report)
    given = f"{report.matches:,} matches of {count(len(found.database.pairs), 'pair')} of images"
    few = sorted(rows, key=lambda row: row[2])[:10] if len(rows) > 20 else rows
    cells = [[row[0], f"{row[1]:,}", f"{row[2]:,}", f"{row[3]:,}", f"{100 * row[4]:.0f} %"] for row in few]
    more = [f"{len(rows) - len(few)} images with more static points: see the report"] if len(few) < len(rows) else []
    return Summary(
        headline=describe(report), opening=[describe(report) if found.ok else given],
        tables=[Table(["image", "matched ", "static ", "moving ", "spread "], cells, more)],
        notes=report.all_notes,
        closing=[f"database: {report.written}", f"masks: {report.masks}"] if found.ok else [],
        pictures={"static.png": partial(picture_of, report)}, dark=bool(report.photographs),
        files={
            "images.csv": partial(images_csv, report), "pairs.csv": partial(pairs_csv, report),
            "static.json": partial(as_json, report),
        },
        values=partial(page_values, report),
    )  # fmt: skip


def page_values(report: StaticReport) -> dict[str, Any]:
    """Rows of the page's tables."""
    images, pairs = image_rows(report), pair_rows(report)
    return {
        "images": [[name, *(f"{n:,}" for n in row[:3]), bar(row[3]), "refused" if row[4] else ""] for name, *row in images],
        "pairs": [[f"{a} and {b}", *(f"{n:,}" for n in row[:5]), row[5]] for a, b, *row in pairs],
        "rows": ROWS,
    }


def images_csv(report: StaticReport) -> str:
    """``image,matched,static,moving,spread,refused`` of every image."""
    rows = [[safe_cell(name), *row[:3], f"{row[3]:.3f}", int(row[4])] for name, *row in image_rows(report)]
    return table_csv(["image", "matched", "static", "moving", "spread", "refused"], rows)


def pairs_csv(report: StaticReport) -> str:
    """``first,second,matches,bodies,static_bodies,kept,verified,division`` of every pair."""
    head = ["first", "second", "matches", "bodies", "static_bodies", "kept", "verified", "division"]
    return table_csv(head, [[safe_cell(a), safe_cell(b), *row] for a, b, *row in pair_rows(report)])


# ----------------------------------------------------------------------------------------------------------------------
# The picture: some of the images, from the first to the last, and what stands still in them.


def images_drawn(database: MatchDatabase) -> list[int]:
    """Places of the images that the picture shows: evenly from those in matches."""
    used = sorted({place for pair in database.pairs for place in (pair.first, pair.second)})
    return [used[k] for k in np.unique(np.linspace(0, len(used) - 1, min(PANELS, len(used))).round().astype(int)).tolist()]


def picture_of(report: StaticReport, theme: Theme = LIGHT) -> bytes:
    """PNG: keypoints in matches, by what is known of them."""
    from matplotlib.lines import Line2D

    found = report.static
    places = images_drawn(found.database)
    cameras = [found.database.images[k].camera for k in places]
    boxes = [(np.array([-0.5, -0.5]), np.array([camera.width, camera.height]) - 0.5) for camera in cameras]
    with style(theme):
        figure, panels = layout(boxes, TALL, 0.0, 0.15, COLUMNS)
        for panel, place, box in zip(panels, places, boxes, strict=True):
            photograph = report.photographs.get(place)
            if photograph is not None:
                draw_photograph(panel, photograph, theme)
            image = found.database.images[place]
            _draw_points(panel, image.points - 0.5, found.keypoints[place], theme)
            finish(panel, *box, True, shorten(image.name, 32))
            panel.set(xticks=[], yticks=[])
        kinds = np.concatenate(found.keypoints)
        handles = [
            Line2D([], [], color=colour, marker="o", linestyle="", markersize=5, label=f"{KINDS[kind]}: {(kinds == kind).sum():,}")
            for kind, colour in COLOURS.items()
        ]
        foot(figure, handles, ink=theme.ink)
        return png(figure, tight=True)


def _draw_points(panel: Any, points: NDArray[np.float64], kinds: NDArray[np.int64], theme: Theme) -> None:
    """Static ones below, moving ones above, and what nothing is known of small and gray."""
    size = float(np.clip(3000 / max(1, len(points)), 2, 12))
    panel.scatter(*points[kinds == 0].T, s=0.3 * size, c=theme.muted, linewidth=0, alpha=0.35, zorder=2)
    for kind, colour in COLOURS.items():
        panel.scatter(*points[kinds == kind].T, s=size, c=colour, linewidth=0, zorder=3)

"""The sections of the report on a reconstruction, as HTML."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from indexing.report.page import Card, Column, cards, details, escape, listed, picture, provenance, section, sentence, table
from indexing.report.reconstruction_words import MEANING, heading, left_out

if TYPE_CHECKING:
    from indexing.report.reconstruction import ReconstructionReport

Drawn = tuple[bytes, bytes]
LISTED = 300  # points whose names are listed on the page


def body(report: ReconstructionReport, tracks: Drawn, scene: Drawn | None) -> str:
    """The page's sections: headline numbers, warnings, pictures, models, views, what stays open, points, settings."""
    parts = [cards(_headline(report)), _warnings(report), _scene(report, scene), _tracks(report, tracks), _models(report)]
    if report.solved:
        parts.append(_views(report))
    if report.ambiguity and report.solved:
        parts.append(section("What the tracks cannot tell", "", f"The scene is {report.ambiguity}."))
    parts.append(_points(report))
    parts.append(provenance(report.manifest))
    return "\n".join(part for part in parts if part)


def describe(report: ReconstructionReport) -> str:
    """The result in plain words."""
    number, views, counts = len(report.tracks.ids), len(report.tracks.views), report.counts
    if report.status != "OK":
        said = any(message in report.reason for _, _, message in report.warnings)  # then it is in the list that follows
        start = f"The {number:,} tracks through {views} views do not decide what the scene is."
        start += "" if said else f" {sentence(report.reason)}"
        return start + " The numbers are those of the best scene found, and not to be relied on." * report.solved
    parts = [f"{counts[name]:,} {'are on ' if report.bodies > 1 else ''}{_verb(name)}" for name in list(counts)[:2] if counts[name]]
    if counts["outlier"]:
        parts.append(f"{counts['outlier']:,} do not fit")
    if counts["missing"]:
        parts.append(f"{counts['missing']:,} are seen too rarely")
    return f"Of {number:,} points tracked through {views} views, {', '.join(parts)}. {report.motion[1]}"


def _verb(kind: str) -> str:
    return {"static": "stand still", "moving": "move"}.get(kind, kind)


def _headline(report: ReconstructionReport) -> list[Card]:
    counts, number = report.counts, len(report.tracks.ids)
    ok = report.status == "OK"
    items = [Card("Status", "Solved" if ok else "Refused", "the tracks decide" if ok else report.status.lower().replace("_", " "))]
    if not report.solved:
        return [*items, Card("Tracks", f"{number:,}", f"through {len(report.tracks.views)} views")]
    items += [Card(name.capitalize(), f"{counts[name]:,}", f"of {number:,} points") for name in list(counts)[:2] if counts[name]]
    single = int((np.isfinite(report.tracks.values).all(axis=-1) & ~report.inliers)[:, report.labels > 0].sum())
    rest = f"of {number:,} points" + f", and {single:,} single observation{'s' * (single > 1)} left out" * bool(single)
    rest += f"; {counts['missing']:,} seen too rarely" * bool(counts["missing"])
    items.append(Card("Outliers", f"{counts['outlier']:,}", rest))
    items.append(Card("Residual", f"{report.residual:.3g}", "rms distance from the tracks, in their unit"))
    items.append(Card("Noise", f"{report.sigma:.3g}", "standard deviation of a coordinate that this shows"))
    return items


def _warnings(report: ReconstructionReport) -> str:
    lines = []
    for code, _, text in report.warnings:
        meant, refuses = MEANING.get(code, ""), text in report.reason
        head = (
            f'<b class="bad">Refused: {escape(heading(code))}.</b>' if refuses else f"<b>{escape(heading(code).capitalize())}.</b>"
        )
        lines.append(f"<li>{head} {escape(f'{sentence(text)} {meant}'.strip())}</li>")
    lines += [f"<li>{escape(sentence(note))}</li>" for note in report.notes]
    return section("Please note", f"<ul>{''.join(lines)}</ul>") if lines else ""


def _scene(report: ReconstructionReport, drawn: Drawn | None) -> str:
    if drawn is None:
        return ""
    if report.bodies > 1:
        note = "Each body for itself: how large one is against the other, no view can tell."
    elif report.velocities is None or not np.nan_to_num(report.velocities).any():
        note = "Every point where it stands."
    else:
        note = "Every point where it was in the first view, and its way until the last."
    caption = "Drawn in the frame that comes nearest to the first view; the tracks leave it open, as said below."
    alt = f"The scene: {', '.join(f'{count} {name}' for name, count in report.counts.items() if count)}"
    return section("The scene", picture(drawn[0], alt, dark=drawn[1], caption=caption), note)


def _tracks(report: ReconstructionReport, drawn: Drawn) -> str:
    note = f"Every track{' by what it was found to be' * report.drawable}, with a dot where it begins."
    caption = (
        "On the right, the motion of the camera is taken out: what stands still is a dot, what moves keeps its own way."
        if report.drawable and report.velocities is not None
        else ""
    )
    title = "The tracks" if report.drawable else "The tracks as measured"
    return section(title, picture(drawn[0], f"{len(report.tracks.ids)} tracks", dark=drawn[1], caption=caption), note)


def _models(report: ReconstructionReport) -> str:
    if not report.candidates:
        return ""
    taken = ' <small class="none">taken</small>'
    rows = [
        [escape(name) + taken * (name == report.motion[0]), f"{score:.6g}", _figure(residual, ".3g", "")]
        for name, score, residual, _ in report.candidates
        if np.isfinite(score)
    ]
    failed = left_out(report.candidates)
    also = f" {sentence(failed)}" if failed else ""
    columns = [Column("Model"), Column("Penalized cost", "number"), Column("Rms residual", "number")]
    note = "The model of least cost was taken. Unknowns cost, so that a model is not chosen for being able to bend more." + also
    return section("Which motion", table(columns, rows, caption="Models, best first"), note)


def _figure(value: float, form: str, otherwise: str) -> str:
    return f"{value:{form}}" if np.isfinite(value) else otherwise


def _views(report: ReconstructionReport) -> str:
    """Times and residuals of all views, and their cameras behind a click."""
    rows, matrices = [], []
    for i, name in enumerate(report.tracks.views):
        seen = np.isfinite(report.tracks.values[i]).all(axis=1)
        used = report.inliers[i] & np.isfinite(report.residuals[i])
        rms = float(np.sqrt(np.mean(np.square(report.residuals[i, used])))) if used.any() else float("nan")
        out = int((seen & ~used).sum())
        rows.append([escape(name), f"{report.times[i]:.6g}", f"{int(seen.sum()):,}", f"{out:,}", _figure(rms, ".3g", "")])
        matrix = "<br>".join("&ensp;".join(f"{value:.6g}" for value in row) for row in report.cameras[i])
        matrices.append([escape(name), f"<code>{matrix}</code>"])
    names = ("Time", "Points seen", "Left out", "Rms residual")
    shown = table([Column("View"), *(Column(name, "number") for name in names)], rows, caption="Views")
    frame = "x, y, 1" if report.points.shape[1] == 2 else "x, y, z, 1"
    listed = table([Column("View"), Column(f"From ({frame}) to its image", "long")], matrices, css="plain", caption="Cameras")
    return section("The views", shown + details("Cameras", listed), "How well each view agrees with the scene.")


def _points(report: ReconstructionReport) -> str:
    if not report.solved:
        return ""
    order = ("moving", "body 1", "body 2", "outlier", "missing", "static")
    names = listed(report.tracks.ids, report.kinds, order, LISTED, "points.csv")
    note = "By the names of the file; points.csv has positions, velocities and residuals, reconstruction.npz all arrays."
    return section("Each point", names, note)

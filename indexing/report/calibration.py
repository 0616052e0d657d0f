"""The report on a calibration: the rig and the movement in space on one page that turns and plays, and what is not known."""

from __future__ import annotations

import dataclasses
import functools
import math
import tempfile
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from indexing import files
from indexing.calibrate.rig import ASSOCIATED, CALIBRATION, drop_associated, rotation_vectors, toml_of, write_associated
from indexing.clip import ClipSet
from indexing.opening import parse_json, read_bytes, read_text
from indexing.report.page import Script, even, notes_with_names, quiet, sentence
from indexing.report.rig import array_of, heat_picture, plan_picture, scene
from indexing.report.summary import Summary, Table, register_page, write_report
from indexing.writers import encode

if TYPE_CHECKING:
    from indexing.calibrate.left_right import SideExchange
    from indexing.calibrate.rig import CameraRig

FloatArray = NDArray[np.float64]
JSON, PAGE, PLAN, HEAT, PEOPLE = "calibration.json", "report.html", "rig.png", "residuals.png", "keypoints_3d"
REPORT = (PAGE, JSON, PLAN, HEAT)
ORDER = ("rotation x, rad", "rotation y, rad", "rotation z, rad", "centre x", "centre y", "centre z", "log focal length", "k1",
         "k2", "offset, s", "log rate")  # fmt: skip
"""What the rows and columns of a camera's covariance are."""
WHAT = {
    CALIBRATION: "the cameras, for Pose2Sim, AniPose and whatever reads their files",
    ".trc": "the movement in space, y up, for OpenSim",
    ".c3d": "the same, for programs of motion capture",
    ".npz": "the same as a clip set, from which dyntorch index fit learns",
    ASSOCIATED: "the keypoints on one clock, with the same people in the same order in all cameras, for Pose2Sim",
    JSON: "everything in numbers: covariances, clocks, residuals, notes",
}
"""What is in each file."""
FOCAL, K1, OFFSET, RATE = 6, 7, 9, 10


@dataclass(frozen=True, eq=False)
class CalibrationReport:
    """Everything that the report on a rig says."""

    rig: CameraRig
    heading: str = ""
    manifest: Mapping[str, Any] = field(default_factory=dict)
    afterwards: Sequence[str] = ()
    associated: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    folder: Path | None = None
    """Where it was written."""
    outputs: Sequence[str] = ()
    """Names of all files of the folder."""
    besides: Mapping[str, Any] = field(default_factory=dict)
    """Contents of those that are not of the report; None removes one of an earlier run."""

    @property
    def title(self) -> str:
        """Heading of the page."""
        return self.heading or (f"{len(self.rig.names)} cameras, calibrated" if self.rig.ok else "The recordings do not decide")

    @property
    def refusal(self) -> str | None:
        """Why the recordings do not decide; None where they do."""
        return None if self.rig.ok else self.rig.reason

    @functools.cached_property
    def notes(self) -> list[str]:
        """What a reader should know besides, a sentence each."""
        return [*self.rig.notes, *self.afterwards]

    @functools.cached_property
    def sigmas(self) -> FloatArray:
        """``(cameras, 11)`` standard deviations in the order of :data:`ORDER`; 0 = held."""
        variances = np.diagonal(array_of(self.rig.calibration.covariance), axis1=1, axis2=2)
        return np.sqrt(np.maximum(np.nan_to_num(variances, nan=np.inf), 0.0))

    @functools.cached_property
    def residual(self) -> FloatArray:
        """``(cameras,)`` pixels: the median of the joints' residuals; NaN where nothing agrees."""
        table = array_of(self.rig.calibration.residuals)
        return np.array([np.median(row[np.isfinite(row)]) if np.isfinite(row).any() else np.nan for row in table])


# ----------------------------------------------------------------------------------------------------------------------
# What is written, all of it together: made in memory first, then put into the folder file by file, each whole.


def outputs(persons: int) -> list[str]:
    """The names of all files of a calibration of so many people."""
    several = [f"{PEOPLE}_person{i + 1}" for i in range(persons)] if persons > 1 else [PEOPLE]
    return [*REPORT, CALIBRATION, f"{PEOPLE}.npz", *(f"{name}{suffix}" for suffix in (".trc", ".c3d") for name in several)]


def check_folder_of(folder: Path, inputs: Iterable[Path], persons: int = 1) -> None:
    """Raise where the files would replace an input, or anything that an earlier calibration did not write."""
    given, ours = [path.resolve() for path in inputs], earlier(folder)
    if any(path == folder.resolve() and path.is_dir() for path in given):
        raise ValueError(f"{folder}: is an input, and files of the report among its frames would spoil it; choose another --out")
    target = (folder / ASSOCIATED).resolve()
    inside = [path for path in given if target in (path, *path.parents)]
    if inside:
        raise ValueError(f"{inside[0]}: is an input, and {folder / ASSOCIATED} would be replaced; choose another folder for --out")
    for name in dict.fromkeys([*outputs(1), *outputs(persons), ASSOCIATED]):
        path = folder / name
        if path.resolve() in given:
            raise ValueError(f"{path}: is an input, and the output would replace it; choose another folder for --out")
        if path.exists() and name not in ours:
            raise ValueError(f"{path}: is there, and not from this command; move it away, or choose another folder for --out")


def earlier(folder: Path) -> set[str]:
    """What an earlier run of this command wrote into the folder."""
    try:
        known = parse_json(folder, read_text(folder / JSON), "")
        ours = str(known["manifest"]["arguments"]["command"]) == "calibrate"
        return {str(name) for name in known["files"]} | {JSON} if ours else set()
    except (ValueError, KeyError, TypeError):
        return set()


def write_calibration(folder: str | Path, report: CalibrationReport) -> tuple[Path, CalibrationReport]:
    """Write the report, and where the data decide, the cameras and the movement."""
    where, rig = Path(folder).expanduser(), report.rig
    check_folder_of(where, [], rig.persons)
    if not report.manifest:
        report = replace(report, manifest=files.manifest({"command": "calibrate"}))
    found, notes = _results(rig) if rig.ok else ({}, [])
    where, old = files.prepare(where), earlier(where)
    done = write_associated(where, rig) if rig.ok and rig.identities is not None else {}
    stale = old - {*found, *REPORT, *([ASSOCIATED] if done else [])}
    if stale and not rig.ok:
        notes.append(f"removed, as this run does not decide: {', '.join(sorted(stale))} of an earlier one")
    names = [*found, *REPORT, *([ASSOCIATED] if done else [])]
    if ASSOCIATED in stale:
        drop_associated(where)
    besides = {**dict.fromkeys(stale - {ASSOCIATED}), **found}
    report = replace(report, afterwards=(*report.afterwards, *notes), associated=done, folder=where, outputs=names, besides=besides)
    return write_report(where, report), report


def _results(rig: CameraRig) -> tuple[dict[str, Any], list[str]]:
    """The files of a good rig by their names, and what to say about them."""
    contents: dict[str, Any] = {CALIBRATION: toml_of(rig)}
    notes: list[str] = []
    clips = rig.people
    if not clips:
        return contents, ["no joint was seen by two cameras at once, so there is no movement in space"]
    several = len(clips) > 1
    for suffix in (".trc", ".c3d"):
        for who, clip in enumerate(clips, start=1):
            name = f"{PEOPLE}_person{who}{suffix}" if several else f"{PEOPLE}{suffix}"
            try:
                contents[name] = encode([clip], Path(name))[0]
            except ValueError as problem:
                notes.append(f"{name} was not written: {problem}")
    with tempfile.TemporaryDirectory() as passing:
        path = Path(passing) / "clips.npz"
        ClipSet(clips, "people in space").save(path)
        contents[f"{PEOPLE}.npz"] = read_bytes(path)
    unit = "metres" if rig.calibration.metric else "units of the rig (the scale is unknown)"
    notes.append(f"{PEOPLE}: {unit}, y up; in {CALIBRATION} z is up: (x, y, z) there is (y, z, x) here, as Pose2Sim has it")
    return contents, notes


def as_json(report: CalibrationReport) -> dict[str, Any]:
    """The result as numbers; a camera's time is the first one's times its rate plus its offset, in seconds."""
    rig, found = report.rig, report.rig.calibration
    times = array_of(found.times)
    return {
        "ok": rig.ok,
        "status": rig.state,
        "reason": rig.reason or None,
        "cameras": [_camera_json(report, i) for i in range(len(rig.names))],
        "covariance_of": ORDER,
        "units": rig.units, "metric": bool(found.metric), "upright": bool(found.upright),
        "scale": None if rig.stature is None else rig.stature,
        "lengths": [{"joints": list(ends), "metres": value} for ends, value in rig.lengths.items()],
        "focal_lengths": rig.lenses.source,
        "people": rig.persons, "joints": rig.joint_names, "points": rig.point_names,
        "residuals": array_of(found.residuals),
        "frames": len(times), "start": times[0] if len(times) else None, "end": times[-1] if len(times) else None,
        "point_sigma": point_sigma(report), "clock_confidence": found.clocks.confidence,
        "clock_cycle_error": found.clocks.cycle_error,
        "exchanges": [_exchange_json(report, one) for one in rig.exchanges],
        "unknown": rig.unknown,
        "notices": [
            {"code": notice.code.value, "value": notice.value, "message": notice.with_words(rig.words).text,
             "refuses": notice.code.refuses is not None}
            for notice in rig.with_camera_names.notices
        ],
        "notes": report.notes,
        "files": sorted(report.outputs),
        "manifest": report.manifest,
    }  # fmt: skip


def _exchange_json(report: CalibrationReport, one: SideExchange) -> dict[str, Any]:
    return {**dataclasses.asdict(one), "camera": report.rig.names[one.camera], "person": one.person + 1}


def point_sigma(report: CalibrationReport) -> float:
    """The standard deviation along an axis of a joint in space, in the unit of the rig: the median of all; NaN without any."""
    sigmas = array_of(report.rig.calibration.sigmas)
    known = sigmas[np.isfinite(sigmas)]
    return float(np.median(known)) if known.size else math.nan


def _camera_json(report: CalibrationReport, i: int) -> dict[str, Any]:
    found, view = report.rig.calibration, report.rig.views[i]
    clocks, sigmas = found.clocks, report.sigmas[i]
    return {
        "name": view.name, "path": str(view.take.path or ""), "size": list(view.size),
        "fps": view.take.fps, "fps_assumed": view.take.fps_assumed, "frames": view.take.count or None,
        "matrix": array_of(found.K[i]), "distortions": array_of(found.distortion[i]),
        "rotation": rotation_vectors(array_of(found.R))[i], "translation": array_of(found.t[i]),
        "center": array_of(found.centers[i]),
        "focal": float(found.focals[i]), "focal_sigma": float(found.focals[i]) * sigmas[FOCAL],
        "offset": float(clocks.offsets[i]), "offset_sigma": offset_sigma(report, i),
        "rate": float(clocks.rates[i]), "rate_sigma": sigmas[RATE],
        "covariance": array_of(found.covariance[i]),
        "residual": report.residual[i], "inliers": float(found.inliers[i]),
        "associated": report.associated.get(view.name),
    }  # fmt: skip


def offset_sigma(report: CalibrationReport, i: int) -> float:
    """Seconds: standard deviation of a camera's clock; 0 for the first, and where it was given."""
    return float(report.sigmas[i][OFFSET])


# ----------------------------------------------------------------------------------------------------------------------
# The page.


def page_values(report: CalibrationReport) -> dict[str, Any]:
    """The scene, and rows of the page's tables."""
    rig = report.rig
    data, drawn = scene(rig)
    return {
        "rig": rig, "noted": notes_with_names(rig.names, "" if rig.ok else rig.reason, report.notes),
        "data": data, "scene_note": drawn,
        "script": Script("rig.js") if data else None,
        "camera_rows": camera_rows(report), "clock_rows": clock_rows(report), "residual_rows": residual_rows(report),
        "lenses": sentence(f"focal lengths {rig.lenses.source}"), "unit": "m" if rig.calibration.metric else "units",
        "unknown": rig.unknown, "files": file_rows(report.outputs),
        "residual_heads": ["Joint", *((name, "number") for name in rig.names)], "joint_rows": joint_rows(report),
    }  # fmt: skip


def describe(report: CalibrationReport) -> str:
    """The result in plain words."""
    rig = report.rig
    if not rig.ok:
        return (
            f"The recordings do not decide where the cameras stand. {sentence(rig.reason)} No calibration and no movement was "
            "written; what follows is what was found, and not to be relied on."
        )
    people = "one person" if rig.persons == 1 else f"{rig.persons} people"
    typical = float(np.nanmedian(report.residual)) if np.isfinite(report.residual).any() else math.nan
    scale = "in metres" if rig.calibration.metric else "up to its scale"
    return (
        f"Where {len(rig.names)} cameras stood, their focal lengths and their clocks, from {people} in view; the movement "
        f"in space, {scale}. Joints as detected and as predicted are {typical:.1f} pixels apart."
    )


@register_page(CalibrationReport, "calibration", REPORT)
def summarize(report: CalibrationReport) -> Summary:
    """Everything that is said of a calibration, and of what was written of it."""
    rig = report.rig
    pixels = [f"{value:.1f}" if math.isfinite(value) else "none" for value in report.residual]
    rows = [
        [name, focal_text(report, i), place_text(report, i), offset_text(report, i), pixels[i], agrees_text(report, i)]
        for i, name in enumerate(rig.names)
    ]
    unit = "m" if rig.calibration.metric else "no unit"
    closing = [f"open: {text}" for text in rig.unknown] if rig.ok else []
    if report.folder is not None:
        results = sorted(name for name in report.outputs if not name.endswith((".png", ".html", ".json")))
        closing.append(f"written to {report.folder}/: {', '.join(results) or 'the report alone, and no calibration'}")
    return Summary(
        headline=describe(report), cards=cards(report), notes=report.notes, closing=closing,
        pictures={PLAN: lambda theme: plan_picture(rig), HEAT: lambda theme: heat_picture(rig)},
        files={JSON: partial(as_json, report)},
        values=partial(page_values, report),
        tables=[Table(["camera", "focal length px ", f"position {unit} ", "clock s ", "residual px ", "agrees "], rows)],
    )  # fmt: skip


def cards(report: CalibrationReport) -> list[tuple[str, str, str]]:
    """Headline numbers."""
    rig, found = report.rig, report.rig.calibration
    state = ("Status", "Solved", "the recordings decide") if rig.ok else ("Status", "Refused", rig.state)
    typical = f"{np.nanmedian(report.residual):.1f} px" if np.isfinite(report.residual).any() else "none"
    items = [
        state,
        ("Cameras", str(len(rig.names)), f"on the clock of {rig.names[0]}"),
        ("Residual", typical, "median of joints and cameras"),
        ("Scale", "metres" if found.metric else "unknown", _scale(rig)),
        (
            "Vertical",
            "by people" if found.upright else "by cameras",
            "who stand upright" if found.upright else "nobody stands upright",
        ),
    ]
    seconds = float(found.times[-1] - found.times[0]) if len(found.times) else 0.0
    sure = point_sigma(report)
    joints = f"{rig.persons} x {rig.joints.count} joints" + (
        f", ± {1000 * sure:.0f} mm" if found.metric and math.isfinite(sure) else ""
    )
    items.append(("Movement", f"{seconds:.1f} s", joints))
    return items


def _scale(rig: CameraRig) -> str:
    if not rig.calibration.metric:
        return "give a height or a length"
    if rig.stature is not None:
        return f"by a height of {rig.stature.height:g} m, ± {100 * rig.stature.sigma / rig.stature.extent:.1f} %"
    return "by known lengths"


def focal_text(report: CalibrationReport, i: int) -> str:
    """A focal length with its standard deviation, or that it was held."""
    focal, sigma = float(report.rig.calibration.focals[i]), float(report.sigmas[i][FOCAL])
    if not (math.isfinite(focal) and sigma < 1):  # known to a factor of two, or not at all
        return "unknown"
    return f"{focal:.1f} held" if sigma == 0 else f"{focal:.1f} ± {focal * sigma:.1f}"


def place_text(report: CalibrationReport, i: int) -> str:
    """Where a camera stands, and the standard deviation of that in the direction in which it is largest."""
    center, table = array_of(report.rig.calibration.centers[i]), array_of(report.rig.calibration.covariance[i])[3:6, 3:6]
    if not np.isfinite(center).all():
        return "unknown"
    sigma = math.sqrt(max(0.0, float(np.linalg.eigvalsh(np.nan_to_num(table)).max())))
    return f"{', '.join(f'{x:+.3f}' for x in center)}" + (f" ± {sigma:.3f}" if sigma > 0 else "")


def offset_text(report: CalibrationReport, i: int) -> str:
    """A camera's offset with its standard deviation."""
    offset, sigma = float(report.rig.calibration.clocks.offsets[i]), offset_sigma(report, i)
    if i == 0 or not math.isfinite(offset):
        return "unknown" if i else "reference"
    return f"{offset:+.4f} held" if sigma == 0 else f"{offset:+.4f} ± {sigma:.4f}" if math.isfinite(sigma) else f"{offset:+.4f}"


def camera_rows(report: CalibrationReport) -> list[list[Any]]:
    """The page's table of cameras."""
    found, rows = report.rig.calibration, []
    for i, view in enumerate(report.rig.views):
        cell = quiet(view.name, view.take.path or "")
        size, k1, sigma = f"{view.size[0]}x{view.size[1]}", float(found.distortion[i, 0]), float(report.sigmas[i][K1])
        axis = array_of(found.R[i])[2]
        if not (np.isfinite(axis).all() and math.isfinite(k1)):
            rows.append([cell, size, "unknown", "", "", "unknown", ""])
            continue
        wide = 2 * math.degrees(math.atan2(view.size[0] / 2, float(found.K[i, 0, 0])))
        across, down = math.degrees(math.atan2(axis[1], axis[0])), math.degrees(math.asin(max(-1.0, min(1.0, -axis[2]))))
        bent = f"{k1:+.3f} ± {sigma:.3f}" if sigma > 0 else f"{k1:+.3f} held" if k1 else "none"
        rows.append(
            [cell, size, focal_text(report, i), f"{wide:.0f}", bent, place_text(report, i), f"{across:+.0f}, {down:.0f} down"]
        )
    return rows


def clock_rows(report: CalibrationReport) -> list[list[Any]]:
    """The page's table of clocks."""
    clocks, rows = report.rig.calibration.clocks, []
    for i, view in enumerate(report.rig.views):
        rate, sigma, offset = float(clocks.rates[i]), float(report.sigmas[i][RATE]), float(clocks.offsets[i])
        drift = f"{1e6 * (rate - 1):+.0f}" + (f" ± {1e6 * sigma:.0f}" if 0 < sigma < math.inf else "")
        known = i > 0 and math.isfinite(offset)
        rows.append([
            view.name, f"{view.take.fps:.6g}{' (assumed)' if view.take.fps_assumed else ''}", offset_text(report, i),
            f"{offset * view.take.fps:+.2f}" if known else "", drift if known and rate != 1 else "0" if known else "",
        ])  # fmt: skip
    return rows


def residual_rows(report: CalibrationReport) -> list[list[Any]]:
    """The page's table of residuals by camera."""
    found, rows = array_of(report.rig.calibration.residuals), []
    medians = even(report.residual.tolist())
    for i, name in enumerate(report.rig.names):
        known = np.flatnonzero(np.isfinite(found[i]))
        worst = known[found[i][known].argmax()] if len(known) else None
        said = "none" if worst is None else f"{found[i][worst]:.1f}, {report.rig.point_names[worst]}"
        rows.append([name, medians[i], said, agrees_text(report, i)])
    return rows


def agrees_text(report: CalibrationReport, i: int) -> str:
    """The share of a camera's positions that agree."""
    share = float(report.rig.calibration.inliers[i])
    return f"{100 * share:.0f} %" if math.isfinite(share) else "none"


def joint_rows(report: CalibrationReport) -> list[list[Any]]:
    """Joint by joint, the residual in every camera."""
    table = array_of(report.rig.calibration.residuals)
    return [
        [name, *(f"{value:.1f}" if math.isfinite(value) else "none" for value in table[:, j])]
        for j, name in enumerate(report.rig.point_names)
    ]


def file_rows(names: Sequence[str]) -> list[list[str]]:
    """The files of the folder and what is in them; pictures and the page itself are not listed."""
    rows = []
    for name in sorted(names):
        what = WHAT.get(name) or WHAT.get(Path(name).suffix)
        if what is not None:
            rows.append([name, what])
    return rows

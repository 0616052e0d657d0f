"""A trial folder of Pose2Sim: its cameras, their frame rates and lenses, read from where Pose2Sim keeps them.

    TRIAL/Config.toml              [project] frame_rate, or "auto": that of the videos; what it lacks stands one folder above
    TRIAL/pose/<camera>_json/      a file of keypoints per frame
    TRIAL/videos/<camera>.mp4      where they were found
    TRIAL/calibration/*.toml       lenses; of a session of several trials beside these

``pose-sync/`` is then written in place of Pose2Sim's own step: folders of the same names, frame numbers of the camera that recorded
least (of which ``frame_range`` speaks), and a file for every number, so that its next steps see all that was recorded: they look at
as many numbers as the camera with the fewest files has files.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from indexing.opening import error, parse_toml, read_text
from indexing.sync.calibration import Lens, named_lenses
from indexing.sync.files import Plan
from indexing.sync.recordings import Take, camera_name, videos_named
from indexing.video.reading import probe

CONFIG, POSE, FILMS = "Config.toml", "pose", "videos"


REMEDY = "correct it, or give --fps"


@dataclass(frozen=True)
class Trial:
    """A trial folder."""

    folder: Path
    cameras: dict[str, Path]
    films: dict[str, Path]
    fps: float | None
    calibration: Path | None

    def rates(self) -> list[float | None]:
        """Frames per second of each camera: of its configuration, else of its video; None where nobody says."""
        films = [self.films.get(name) for name in self.cameras]
        return [self.fps or (None if film is None else probe(film).fps) for film in films]

    def with_videos(self, takes: Sequence[Take]) -> list[Take]:
        """Takes with the videos that their keypoints were found in."""
        return [dataclasses.replace(take, film=self.films.get(take.name)) for take in takes]

    def lenses(self, names: Sequence[str]) -> tuple[list[Lens] | None, tuple[str, ...]]:
        """The lenses of the cameras where the calibration has them, and what to say about it."""
        if self.calibration is None:
            return None, ()
        try:
            found, notes = named_lenses(self.calibration, names)
        except ValueError as problem:
            return None, (f"lenses are not known: {problem}",)
        fish = [lens.name for lens in found if lens.fisheye]
        if fish:
            return None, (f"lenses are not known: {self.calibration}: {fish[0]} has a fisheye lens, which is not modelled",)
        return found, (*notes, f"lenses of {self.calibration}")


def trial_of(folder: Path) -> Trial | None:
    """The trial in a folder; None where it is none: no configuration, or fewer than two cameras in ``pose``."""
    configs = [file for file in (folder.resolve().parent / CONFIG, folder / CONFIG) if file.is_file()]
    cameras = _cameras(folder / POSE)
    if not configs or len(cameras) < 2:
        return None
    films = {name: videos[0] for name in cameras if (videos := videos_named(folder / FILMS, name))}
    homes = [folder] if (folder / CONFIG) == configs[0] else [folder.resolve().parent, folder]
    return Trial(folder, cameras, films, _frame_rate(configs), _calibration(homes))


def trials_in(folder: Path) -> list[Path]:
    """The trials of a session: folders below with a configuration and keypoints, but those that it excludes."""
    if not (folder / CONFIG).is_file():
        return []
    project = _project(folder / CONFIG)
    excluded = project.get("exclude_from_batch", [])
    leave = {Path(str(name)).name for name in excluded} if isinstance(excluded, list) else set()
    below = _folders_below(folder, 3)  # participants, and their trials, and one more
    return [inner for inner in below if inner.name not in leave and trial_of(inner) is not None]


def _folders_below(folder: Path, depth: int) -> Iterator[Path]:
    inner = sorted(entry for entry in folder.iterdir() if entry.is_dir() and not entry.name.startswith("."))
    for entry in inner if depth else []:
        yield entry
        if not (entry / POSE).is_dir():
            yield from _folders_below(entry, depth - 1)


def _cameras(pose: Path) -> dict[str, Path]:
    """Camera folders by the last number of their names, as Pose2Sim sorts them; those named json, which it takes alone."""
    entries = [entry for entry in pose.iterdir() if entry.is_dir() and "json" in entry.name] if pose.is_dir() else []
    full = [entry for entry in sorted(entries) if any(file.suffix.lower() == ".json" for file in entry.iterdir())]
    return {camera_name(entry): entry for entry in sorted(full, key=lambda entry: _last_number(entry.name))}


def _last_number(name: str) -> tuple[bool, int]:
    """By what Pose2Sim sorts."""
    digits = "".join(letter if letter.isdecimal() else " " for letter in name).split()
    return (False, int(digits[-1])) if digits else (True, 0)


def _calibration(homes: Sequence[Path]) -> Path | None:
    """The newest calibration of the first folder that has one, as Pose2Sim chooses."""
    for home in homes:
        folders = sorted(entry for entry in home.iterdir() if entry.is_dir() and "calib" in entry.name.lower())
        files = [file for folder in folders[:1] for file in sorted(folder.glob("*.toml"))]
        if files:
            return max(files, key=lambda file: file.stat().st_mtime_ns)
    return None


def _project(path: Path) -> dict[str, Any]:
    found = parse_toml(path, read_text(path, REMEDY), REMEDY).get("project", {})
    return found if isinstance(found, dict) else {}


def _frame_rate(configs: Sequence[Path]) -> float | None:
    """Of the configurations, the last of which counts most."""
    said: tuple[Path, Any] | None = None
    for path in configs:
        rate = _project(path).get("frame_rate")
        said = said if rate is None else (path, rate)
    if said is None or said[1] == "auto":
        return None
    path, rate = said
    if isinstance(rate, bool) or not isinstance(rate, (int, float)) or not 0 < rate < 1e5:
        raise error(path, f"[project] frame_rate: expected a positive number or 'auto', got {rate!r}", REMEDY)
    return float(rate)


def shortest(takes: Sequence[Take]) -> int:
    """The camera whose frame numbers count: the one that recorded least, of equals the first."""
    return min(range(len(takes)), key=lambda i: takes[i].count)


def numbers(plans: Sequence[Plan]) -> int:
    """How many frame numbers there are: up to the last that two cameras have."""
    ends = sorted((int(one.numbers[-1]) + 1 for one in plans if len(one.numbers)), reverse=True)
    return ends[1] if len(ends) > 1 else sum(ends)

"""Files to try the commands on: ``dyntorch demo --examples FOLDER`` writes them, with the commands that use them.

They are what the README and the guides show: synthetic scenes and people, from fixed random numbers.
"""

from __future__ import annotations

import csv
import json
from collections.abc import Iterable, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from dyntorch import scenes
from indexing import files
from indexing.actors import Person, dataset, detect, perform, stream
from indexing.actors.textured import render_clip
from indexing.clip import Clip, ClipSet
from indexing.video.reading import av

if TYPE_CHECKING:
    from numpy.typing import NDArray

COMMANDS = """\
dyntorch index fit squat=squat.json lunge=lunge.json kick=kick.json@0.2-1.4 -o three.safetensors
dyntorch index fit lesson.npz -o moves.safetensors
dyntorch index scan session.npz -m moves.safetensors --truth truth.csv --report scan/
dyntorch index scan week/*.npz -m moves.safetensors --truth week.csv --report week-report/
dyntorch index fit people.npz --weights learned -o learned.safetensors --report learned/
dyntorch index evaluate people.npz --train azimuth=0 --test azimuth=90 --report evaluate/
dyntorch index evaluate solid.npz --camera virtual --azimuth 0,90 --leave-out subject
dyntorch index evaluate films.npz --leave-out subject
dyntorch sync cam1/ cam2/ cam3/ --fps 30 --out sync/
dyntorch sync cam1/ another-take/ --fps 30
dyntorch align a.csv b.csv c.csv --out align/
dyntorch segment matches.npz --out segment/
dyntorch segment street.csv --bodies 3 --size 1242 375 --out street/
dyntorch reconstruct tracks.csv --motion constant_velocity_3d --static parked.csv --fps 25 --out reconstruct/
"""
VIDEO_COMMANDS = """\
dyntorch index fit squat=squat.mp4 jumping_jack=jumping_jack.mp4 kick=kick.mp4@0-2 -o seen.safetensors
dyntorch index scan filmed.mp4 -m seen.safetensors --report filmed/
"""
NO_VIDEOS = "# no videos were written: that takes PyAV, pip install 'dyntorch[video]'\n"
ACTIONS = ("squat", "lunge", "jumping_jack", "kick")
FILMED = ("squat", "jumping_jack", "kick")
FILM_FPS = 15


def write_examples(folder: str | Path) -> list[str]:
    """Write all example files into a folder; the videos only where PyAV is installed."""
    where = files.prepare(folder)
    _geometry(where)
    _cameras(where)
    _people(where)
    _week(where)
    with_videos = find_spec("av") is not None
    _write_videos(where, with_videos)
    commands = COMMANDS + (VIDEO_COMMANDS if with_videos else NO_VIDEOS)
    files.write_text(where / "commands.txt", commands)
    return commands.splitlines()


def _geometry(where: Path) -> None:
    """Three views of a road, matches of two images, tracks of six views, and of a street through 20 frames."""
    road = scenes.planar(n=120, sigma=0.5, static=0.4, outliers=0.15, generator=torch.Generator().manual_seed(4))
    for name, view in zip("abc", road.views, strict=True):
        _table(where / f"{name}.csv", ("x", "y"), view.tolist())
    draw = torch.Generator().manual_seed(4)
    bodies = scenes.bodies((110, 80, 50), bodies=3, sigma=0.4, outliers=0.2, generator=draw)
    np.savez(where / "matches.npz", x1=bodies.views[0].numpy(), x2=bodies.views[1].numpy())
    draw = torch.Generator().manual_seed(7)
    scene = scenes.lifted_points("constant_velocity_3d", 120, views=6, static=0.4, sigma=0.5, outliers=0.05, generator=draw)
    known = (scene.labels == 1) & (torch.rand(120, generator=draw) < 0.5)
    rows = [(view, point, *xy.tolist()) for view, points in enumerate(scene.tracks) for point, xy in enumerate(points)]
    _table(where / "tracks.csv", ("frame", "id", "x", "y"), [row for row in rows if np.isfinite(row[2])])
    _table(where / "parked.csv", ("id",), [(int(point),) for point in torch.nonzero(known)])
    street = scenes.streets(3, frames=20, tracks=240, sigma=0.1, generator=torch.Generator().manual_seed(7)).tracks.tolist()
    rows = [(frame, point, f"{x:.2f}", f"{y:.2f}") for frame, points in enumerate(street) for point, (x, y) in enumerate(points)]
    _table(where / "street.csv", ("frame", "id", "x", "y"), [row for row in rows if row[2] != "nan"])


def _cameras(where: Path) -> None:
    """Three cameras, started one after the other, as OpenPose writes them; and one that filmed something else."""
    scene, _ = stream(["squat", "kick", "wave"], Person(), fps=30, rng=1)
    other, _ = stream(["bow", "throw", "squat"], Person.random(7), fps=30, rng=5)
    recorded = (("cam1", scene, 0, 0), ("cam2", scene, 60, 17), ("cam3", scene, 130, 8), ("another-take", other, 60, 0))
    for name, seen, azimuth, late in recorded:
        clip = detect(seen, azimuth=azimuth, rng=late)
        frames = files.prepare(where / name)
        for i, triples in enumerate(_triples(clip)[late:]):
            people = [{"pose_keypoints_2d": triples.ravel().tolist()}]
            files.write_text(frames / f"{name}_{i:012d}_keypoints.json", json.dumps({"people": people}))


def _people(where: Path) -> None:
    """A lesson and a session, single clips, and labelled sets in 2D and 3D."""
    teacher, other = Person.random(1), Person.random(2)
    lesson = dataset([teacher], ACTIONS, azimuth=0, rng=0)
    ClipSet(lesson).save(where / "lesson.npz")
    solid, truth = stream(["lunge", "squat", "kick", "jumping_jack", "squat"], other, rng=3)
    ClipSet([detect(solid, azimuth=70, rng=3)]).save(where / "session.npz")
    _table(where / "truth.csv", ("label", "start", "end"), [(label, round(start, 2), round(end, 2)) for label, start, end in truth])
    for clip in lesson:
        if clip.label != "jumping_jack":
            people = [
                {"image_id": i, "category_id": 1, "keypoints": triples.ravel().round(2).tolist(), "score": 0.9}
                for i, triples in enumerate(_triples(clip))
            ]
            files.write_text(where / f"{clip.label}.json", json.dumps(people))
    ClipSet(dataset(4, ACTIONS, azimuth=(0.0, 90.0), rng=2)).save(where / "people.npz")
    ClipSet(dataset(4, ACTIONS, azimuth=None, rng=2)).save(where / "solid.npz")


def _week(where: Path) -> None:
    """Sessions of three other people on three days, and what they did."""
    days = files.prepare(where / "week")
    done: list[tuple[str, str, float, float]] = []
    for number, day in enumerate(("monday", "wednesday", "friday")):
        order = [str(action) for action in np.random.default_rng(number).choice(ACTIONS, size=4)]
        solid, truth = stream(order, Person.random(10 + number), rng=10 + number)
        ClipSet([detect(solid, azimuth=30.0 * number, rng=number)]).save(days / f"{day}.npz")
        done += [(f"{day}.npz", label, round(start, 2), round(end, 2)) for label, start, end in truth]
    _table(where / "week.csv", ("file", "label", "start", "end"), done)


def _write_videos(where: Path, with_videos: bool) -> None:
    """Grey films: a set of two people, and as videos the actions of one and a recording of the other."""
    solid = [[perform(action, Person.random(person), fps=FILM_FPS, rng=person) for action in FILMED] for person in (1, 2)]
    parts = [[render_clip(clip, azimuth=0, rng=i + 10 * k) for i, clip in enumerate(clips)] for k, clips in enumerate(solid)]
    every = [part for person in parts for part in person]
    np.savez(
        where / "films.npz", frames=np.concatenate(every), offsets=np.cumsum([0, *map(len, every)]), action=[*FILMED, *FILMED],
        subject=np.repeat([1, 2], len(FILMED)), fps=float(FILM_FPS),
    )  # fmt: skip
    if with_videos:
        for action, part in zip(FILMED, parts[0], strict=True):
            _video(where / f"{action}.mp4", part)
        session, _ = stream(["kick", "squat", "jumping_jack"], Person.random(2), fps=FILM_FPS, rng=4)
        _video(where / "filmed.mp4", render_clip(session, azimuth=0, rng=20))


def _video(path: Path, frames: NDArray[np.uint8]) -> None:
    """MPEG-4, which every FFmpeg writes, at a rate at which no pixel is off by much."""
    with av().open(str(path), "w") as container:
        stream_ = container.add_stream("mpeg4", rate=FILM_FPS)
        stream_.height, stream_.width = frames.shape[1:]
        stream_.pix_fmt, stream_.bit_rate = "yuv420p", 2_000_000
        for image in frames:
            container.mux(stream_.encode(av().VideoFrame.from_ndarray(image, format="gray")))
        container.mux(stream_.encode())


def _triples(clip: Clip) -> NDArray[np.float64]:
    """``(frames, joints, 3)`` x, y and confidence; zeros where a joint was not seen, as detectors write it."""
    confidence = np.ones(clip.joints.shape[:2]) if clip.confidence is None else clip.confidence
    return np.nan_to_num(np.concatenate([clip.joints, confidence[..., None]], axis=2))


def _table(path: Path, head: Sequence[str], rows: Iterable[Sequence[Any]]) -> None:
    with open(path, "w", newline="", encoding="utf-8") as stream_:
        writer = csv.writer(stream_, lineterminator="\n")
        writer.writerow(head)
        writer.writerows(rows)

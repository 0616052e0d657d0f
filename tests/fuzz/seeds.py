"""A sound file of every format that the readers know, small, and how it is read and used."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from indexing.labels.format import registered_formats as label_formats
from tests.indexing.labels.test_format import BY_HAND
from tests.indexing.readers import test_formats, tools
from tests.indexing.readers.test_files import SAMPLES

FRAMES, JOINTS = 8, 17


@dataclass(frozen=True)
class Seed:
    """A sound file.

    Args:
        read: what reads it, and uses what was read.
        words: of ``dyntorch`` that read it, ``{}`` in place of the path; None where no command does.
        slow: how many other files are read in the time of this one.
    """

    name: str
    path: Path
    read: Callable[[Path], Any]
    words: tuple[str, ...] | None = None
    slow: int = 1


def make(folder: Path) -> list[Seed]:
    folder.mkdir(parents=True, exist_ok=True)
    found = [*_keypoints(folder), *_models(folder), *_sets(folder), *_points(folder), *_pairs(folder)]
    return [*found, *_tracks(folder), *_settings(folder), *_pictures(folder), *_labels(folder)]


def person(seed: int, frames: int = FRAMES) -> np.ndarray:
    """``(frames, 17, 3)``: x, y in pixels, confidence; somebody who moves."""
    rng = np.random.default_rng(seed)
    xy = rng.uniform(100, 400, (1, JOINTS, 2)) + 20 * np.sin(
        np.arange(frames)[:, None, None] * rng.uniform(0.1, 0.7, (1, JOINTS, 2))
    )
    return np.concatenate([xy, rng.uniform(0.5, 1, (frames, JOINTS, 1))], axis=2).round(2)


def written(path: Path, value: Any) -> Path:
    """A file of JSON, text or bytes."""
    path.parent.mkdir(parents=True, exist_ok=True)
    data = value if isinstance(value, bytes) else (value if isinstance(value, str) else json.dumps(value)).encode()
    path.write_bytes(data)
    return path


# ---- keypoints -----------------------------------------------------------------------------------------------------------
def keypoints(path: Path) -> Any:
    """Read as a command does, and look at every clip."""
    from indexing.readers import read
    from indexing.readers.recording import NobodySeen

    try:
        clips = read(path, person="largest")
    except NobodySeen as nobody:  # an answer of its own kind, which commands word
        raise ValueError(str(nobody)) from None
    for clip in clips:
        assert np.isfinite(clip.times).all()
        _ = clip.duration, clip.seen.any(), repr(clip)
    return list(clips)


def _scan(folder: Path) -> tuple[str, ...]:
    return ("index", "scan", "{}", "-m", str(folder / "action_small.safetensors"))


def _keypoints(folder: Path) -> list[Seed]:
    """What each tool writes, as the tests of the readers make it, and some of the other forms that they know."""
    seeds, people = [], person(2)
    for number, (tool, make_sample) in enumerate(SAMPLES.items()):
        place = folder / f"sample{number}"
        place.mkdir()
        path = make_sample(place).path
        path = path / "output_data" if (path / "output_data").is_dir() else path  # where FreeMoCap has its files
        seeds.append(Seed(tool, path, keypoints, _scan(folder), 2 if path.suffix in (".h5", ".slp", ".nc") else 1))
    lists = ("coco int", "mmpose frames", "ultralytics frames", "ultralytics strings", "openpose list", "alphapose cmu")
    others = [written(folder / f"{name}.json", test_formats.VARIANTS[name](people)) for name in lists]
    tables = ("deeplabcut", "mediapipe long")
    others += [test_formats.save_rows(folder / f"{name}.csv", test_formats.TABLES[name](people)) for name in tables]
    others.append(tools.deeplabcut(folder / "dlc_fixed.h5", people, [f"p{i}" for i in range(JOINTS)], "fixed"))
    others.append(tools.pyskl(folder / "set0.pkl", {"a": people[None], "b": people[None]}, [0, 1], {"train": "a"}, protocol=0))
    np.save(folder / "body.npy", people[..., :2])
    return seeds + [Seed(path.name, path, keypoints, _scan(folder)) for path in (*others, folder / "body.npy")]


def _sets(folder: Path) -> list[Seed]:
    clips = np.concatenate([person(i)[..., :2] for i in range(4)])
    about = {
        "offsets": np.arange(5) * FRAMES,
        "action": [0, 1, 0, 1],
        "action_names": ["run", "sit"],
        "fps": 30.0,
        "names": list("abcd"),
    }
    arrays = {**about, "joints": clips, "subject": [1, 2, 3, 4], "split": np.arange(12).reshape(4, 3), "up": ["-y"] * 4}
    arrays |= {"bones": [[0, 1], [1, 2]], "joint_names": [f"j{i}" for i in range(JOINTS)], "confidence": np.ones(clips.shape[:2])}
    np.savez_compressed(folder / "clipset.npz", **arrays)
    more = {"frame": np.tile(np.arange(FRAMES), 4), "when": np.array(["2020-01-01"] * 4, "M8[D]")}
    np.savez(folder / "clipset_raw.npz", **arrays, **more)
    films = np.random.default_rng(0).integers(0, 255, (4 * FRAMES, 24, 32), dtype=np.uint8)
    np.savez(folder / "films.npz", frames=films, subject=[1, 1, 2, 2], **about)
    evaluated = ("index", "evaluate", "{}", "--leave-out", "subject")
    return [
        *(Seed(name, folder / name, keypoints, evaluated) for name in ("clipset.npz", "clipset_raw.npz")),
        Seed("films.npz", folder / "films.npz", films_read),
    ]


def films_read(path: Path) -> Any:
    from indexing.readers.formats.clipset import holds_frames, read_film_set

    holds_frames(path)
    return [(film.duration, len(film), film.label, film.frames) for film in read_film_set(path)]


# ---- models --------------------------------------------------------------------------------------------------------------
def _models(folder: Path) -> list[Seed]:
    import torch

    from indexing import ActionIndexer, Clip, PhaseIndexer

    def clips(count: int, frames: int = 40) -> list[Clip]:
        return [Clip(person(i, frames)[..., :2], fps=30.0, label=["a", "b", "c"][i % 3], name=f"q{i}") for i in range(count)]

    few, query = clips(6), clips(2)
    ActionIndexer(scorer="nearest", search=False, reject=0.2).fit(few).save(folder / "action_small.safetensors")
    ActionIndexer(search=False, virtual_views=1).fit(few).save(folder / "action.safetensors")
    PhaseIndexer(harmonics=1, course="once", mirror=False).fit(clips(3, 8)).save(folder / "phase.safetensors")
    films = [np.uint8(40 * np.random.default_rng(i % 2).random((12, 24, 32)).cumsum(0) % 255) for i in range(4)]

    def bright(path: Path) -> None:
        from indexing import BrightnessIndexer

        torch.manual_seed(0)
        _finite(BrightnessIndexer.load(path).decision_function(films[:1]))

    def action(path: Path) -> None:
        indexer = ActionIndexer.load(path)
        with _other_joints(indexer.n_joints_):
            _finite(indexer.decision_function(query))
            indexer.predict(query)
            _finite(indexer.predict_proba(query))
            indexer.find(query[0])

    def phase(path: Path) -> None:
        indexer = PhaseIndexer.load(path)
        with _other_joints(indexer.n_joints_):
            _finite(indexer.decision_function(query))
            indexer.predict(query)

    from indexing import BrightnessIndexer

    BrightnessIndexer(size=24, flip=False).fit(films, ["a", "b", "a", "b"]).save(folder / "bright.safetensors")
    session = written(folder / "session.json", [
        {"image_id": i, "category_id": 1, "keypoints": row.ravel().tolist(), "score": 1.0} for i, row in enumerate(person(1, 40))
    ])  # fmt: skip
    scan = ("index", "scan", str(session), "-m", "{}")
    reads: dict[str, tuple[Callable[[Path], None], int]] = {
        "action_small": (action, 4), "action": (action, 6), "phase": (phase, 8), "bright": (bright, 12),
    }  # fmt: skip
    return [
        Seed(f"{name}.safetensors", folder / f"{name}.safetensors", read, scan if name != "bright" else None, slow)
        for name, (read, slow) in reads.items()
    ]


def _finite(values: Any) -> None:
    assert np.isfinite(values).all(), "NaN in the answer of a loaded model"


@contextlib.contextmanager
def _other_joints(joints: int) -> Any:
    """A model of other joints than the query's refuses it, rightly."""
    try:
        yield
    except ValueError as problem:
        if joints == JOINTS and "shares" not in str(problem):
            raise RuntimeError(f"a loaded model cannot be used: {problem}") from problem


# ---- points, pairs, tracks -----------------------------------------------------------------------------------------------
def points(path: Path) -> Any:
    from indexing.readers.matches import open_points, read_matches

    if path.suffix == ".npz":
        return read_matches([path])
    return read_matches([path], frames=(1, 2, 3)) if path.suffix == ".c3d" else open_points(path)


def _points(folder: Path) -> list[Seed]:
    rng = np.random.default_rng(1)
    xy, xyz = rng.uniform(0, 500, (12, 2)).round(2), rng.normal(size=(12, 3)).round(3)
    lines = "id,x1,y1,z1,x2,y2,z2\n" + "".join(
        f"l{i},{','.join(map(str, row))}\n" for i, row in enumerate(np.hstack([xyz, xyz + 1]))
    )
    table = "id,x,y,weight,static\n" + "".join(f"p{i},{x},{y},1,{i % 2}\n" for i, (x, y) in enumerate(xy))
    np.save(folder / "points.npy", xyz)
    told = {"ids": [f"p{i}" for i in range(12)], "weights": np.ones(12), "static": np.arange(12) % 2}
    np.savez(folder / "views.npz", x1=xy, x2=xy + 1, x3=xy + 2, **told)
    head = "ply\nformat {}\nelement vertex 12\nproperty {} x\nproperty {} y\nproperty {} z\nend_header\n"
    ascii_ply = head.format("ascii 1.0", *["float"] * 3) + "".join(" ".join(map(str, row)) + "\n" for row in xyz)
    binary = head.format("binary_little_endian 1.0", *["double"] * 3).encode() + xyz.astype("<f8").tobytes()
    files: dict[str, Any] = {
        "points.csv": table,
        "lines.csv": lines,
        "ascii.ply": ascii_ply,
        "binary.ply": binary,
        "marks.c3d": tools.c3d(),
    }
    for name, value in files.items():
        written(folder / name, value)
    two = ("align", "{}", str(folder / "lines.csv"))
    alone = {"lines.csv": two, "views.npz": ("align", "{}"), "marks.c3d": ("align", "{}", "--frames", "1,2,3")}
    return [
        Seed(name, folder / name, points, alone.get(name, ("align", "{}", str(folder / name), str(folder / name))))
        for name in (*files, "points.npy", "views.npz")
    ]


def _pairs(folder: Path) -> list[Seed]:
    from indexing.readers.matches import read_pair

    rng = np.random.default_rng(2)
    x1 = rng.uniform(0, 600, (20, 2)).round(2)
    both = np.hstack([x1, x1 + rng.normal(size=(20, 2)).round(2) + 5])
    rows = "".join(f"m{i},{','.join(map(str, row))},1,{i % 3}\n" for i, row in enumerate(both))
    written(folder / "pair.csv", "id,x1,y1,x2,y2,weight,label\n" + rows)
    np.save(folder / "pair.npy", both)
    np.savez_compressed(
        folder / "pair.npz", x1=both[:, :2], x2=both[:, 2:], label=np.arange(20) % 3, ids=np.arange(20).astype(str), wh=[640, 480]
    )
    return [Seed(name, folder / name, read_pair, ("segment", "{}"), 2) for name in ("pair.csv", "pair.npy", "pair.npz")]


def _tracks(folder: Path) -> list[Seed]:
    from indexing.readers.tracks import read_tracks

    rng = np.random.default_rng(3)
    start, speed = rng.uniform(0, 500, (9, 2)), rng.normal(size=(9, 2))
    views = [np.array([[1, 0.01 * v], [-0.01 * v, 1]]) for v in range(5)]
    tracks = np.stack([(start + v * speed) @ view + 3 * v for v, view in enumerate(views)]).round(3)
    rows = [f"{v},{v / 5},p{i},{x},{y},1,{int(i < 3)}" for v, view in enumerate(tracks) for i, (x, y) in enumerate(view)]
    written(folder / "tracks.csv", "frame,time,id,x,y,weight,static\n" + "\n".join(rows) + "\n")
    np.save(folder / "tracks.npy", tracks)
    extra = {"times": np.arange(5) / 5, "ids": [f"p{i}" for i in range(9)], "static": np.arange(9) < 3, "weights": np.ones((5, 9))}
    np.savez(folder / "tracks.npz", tracks=tracks, **extra)
    np.savez_compressed(folder / "tracks_c.npz", **{"a/y": tracks, "b/y": tracks})

    def read(path: Path) -> Any:
        found = read_tracks([path], key="a" if path.name == "tracks_c.npz" else None)
        _ = found.since_first().drop_short(), found.views
        return found

    def marked(path: Path) -> Any:
        return read_tracks([folder / "tracks.csv"], static=path)

    written(folder / "static.csv", "id\np0\np1\n")
    quick = ("reconstruct", "{}", "--motion", "static_2d")
    seeds = [Seed(name, folder / name, read, quick, 3) for name in ("tracks.csv", "tracks.npy", "tracks.npz")]
    return [
        *seeds,
        Seed("tracks_c.npz", folder / "tracks_c.npz", read, (*quick, "--key", "a"), 3),
        Seed("static.csv", folder / "static.csv", marked),
    ]


# ---- settings and pictures -----------------------------------------------------------------------------------------------
def _settings(folder: Path) -> list[Seed]:
    from indexing.labels import open_labels
    from indexing.sync.calibration import read_calibration

    written(folder / "truth.csv", "label,start,end,file\na,0.1,0.5,session.json\nb,0.6,0.9,session.json\n")
    lens = "matrix = [[900.0, 0.0, 320.0], [0.0, 900.0, 240.0], [0.0, 0.0, 1.0]]\ndistortions = [-0.1, 0.0, 0.0, 0.0]\n"
    written(folder / "Calib.toml", "".join(f'[cam0{i}]\nname = "cam0{i}"\nsize = [640.0, 480.0]\n{lens}' for i in (1, 2)))
    for camera in (1, 2):
        for i, frame in enumerate(person(camera, 14)):
            one = {"people": [{"person_id": [-1], "pose_keypoints_2d": frame.ravel().tolist()}]}
            written(folder / "pose" / f"cam0{camera}_json" / f"cam_{i:06d}_keypoints.json", one)
    truth = (*_scan(folder), "--truth", "{}")
    scan = tuple(word if word != "{}" or i > 2 else str(folder / "session.json") for i, word in enumerate(truth))
    return [
        Seed("truth.csv", folder / "truth.csv", partial(open_labels, recording="session.json"), scan),
        Seed("Calib.toml", folder / "Calib.toml", read_calibration, ("sync", str(folder / "pose"), "--calibration", "{}")),
    ]


def _labels(folder: Path) -> list[Seed]:
    from indexing.labels import Label, write_labels

    found = [Label(1, 3, "squat", "Ann", comment="c", score=1.5), Label(2, 4, "squat", "Ann"), Label(5, 5, "clap", tier="t")]
    seeds = []
    for name, suffix in (item for known in label_formats().values() for item in known.written.items()):
        path = folder / f"labels_{name}{suffix or '.json'}"
        write_labels(path, found, recording="session.mp4", duration=60, fps=25, format=name)
        seeds.append(Seed(path.name, path, labels))
    return [*seeds, *(Seed(f"labels of {name}", make_file(folder), labels_of_all) for name, make_file in BY_HAND.items())]


def labels(path: Path) -> Any:
    """Read labels of one hand, of a recording."""
    from indexing.labels import choose_labels, open_labels, within

    kept, notices = within(choose_labels(open_labels(path, recording="session.json", fps=25)).labels, 0.0, 10.0)
    return [label.duration for label in kept], notices, labels_of_all(path)


def labels_of_all(path: Path) -> Any:
    """Read labels of all recordings, and ask whether others could be written beside them."""
    from indexing.labels import Label, open_labels, write_labels

    if path.suffix in (".eaf", ".boris"):
        write_labels(path, [Label(1, 3, "squat", "Ann"), Label(2, 4, "squat", "Ann")], recording="session.mp4", dry=True)
    return [label.duration for label in open_labels(path, fps=25).labels]


def _pictures(folder: Path) -> list[Seed]:
    from PIL import Image

    from indexing.readers.matches import read_image

    image = np.random.default_rng(0).integers(0, 255, (24, 32), dtype=np.uint8)
    Image.fromarray(image).save(folder / "image.png")
    seeds = [Seed("image.png", folder / "image.png", read_image)]
    try:
        import av
    except ImportError:
        return seeds
    path = folder / "video.mp4"
    with av.open(str(path), "w") as container:
        container.metadata["title"] = "a film"
        stream = container.add_stream("libx264", rate=30, options={"preset": "ultrafast"})
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        for i in range(10):
            picture = np.roll(np.tile(np.arange(64, dtype=np.uint8) * 4, (48, 1)), 3 * i, axis=1)
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="gray")))
        container.mux(stream.encode())
    return [*seeds, Seed("video.mp4", path, video, ("index", "fit", "a={}", f"b={path}", "-o", str(folder / "out.safetensors")), 3)]


def video(path: Path) -> Any:
    from indexing.video import probe, read_video

    found, chunks = probe(path), list(read_video(path))
    for chunk in chunks:
        assert np.isfinite(chunk.times).all()
    return found, chunks

"""``dyntorch segment`` of whole videos and of tables of tracks: from files to files, and what is refused and how."""

from __future__ import annotations

import csv
import dataclasses
import json
import re
from pathlib import Path

import av
import numpy as np
import pytest
import torch

import dyntorch
from dyntorch.core.outcome import Notice, NoticeCode
from dyntorch.tasks.segment.result import TrackSegmentation
from indexing.report.bodies import FILES, FILM
from tests.indexing.cli.footage import SIZE, write_film

COMMAND = "segment"
FRAMES, COUNTS = 12, (30, 14, 6)


def moving(frames=FRAMES):
    """Tracks ``(frames, 50, 2)`` of a background that goes to the left, a body that goes down, and wrong ones; some are short."""
    rng = np.random.default_rng(0)
    start = np.concatenate([rng.uniform((10, 10), (230, 170), (COUNTS[0], 2)), rng.uniform((60, 30), (110, 80), (COUNTS[1], 2))])
    step = np.repeat([[-1.0, 0.0], [0.5, 3.0]], COUNTS[:2], axis=0)
    tracks = start + np.arange(frames)[:, None, None] * step
    tracks = np.concatenate([tracks, rng.uniform((0, 0), SIZE, (frames, COUNTS[2], 2))], axis=1)
    tracks[frames // 2 :, 3] = np.nan
    tracks[: frames - 3, 32] = np.nan
    tracks[1:, 7] = np.nan  # one frame alone
    return tracks


TRUTH = np.repeat([1, 2, 0], COUNTS)


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """The tracks as ``t.csv``, ``t.npz``, ``several.npz`` and ``t.npy``, two frames of them as ``two.csv``; a film ``room.mp4`` and
    its pictures ``room/f0.png`` ...; tables of which nothing can be told."""
    folder = tmp_path_factory.mktemp("tracks")
    tracks = moving()
    rows = [
        f"{view},p{i},{tracks[view, i, 0]!r},{tracks[view, i, 1]!r}"
        for view in range(FRAMES)
        for i in range(len(TRUTH))
        if np.isfinite(tracks[view, i, 0])
    ]
    rows = [row.replace("np.float64(", "").replace(")", "") for row in rows]
    (folder / "t.csv").write_text("\n".join(["frame,id,x,y", *rows]))
    (folder / "two.csv").write_text("\n".join(["frame,id,x,y", *(row for row in rows if row.startswith(("3,", "9,")))]))
    np.savez(folder / "t.npz", tracks=tracks, labels=TRUTH)
    shown = np.isfinite(tracks[..., 0])
    np.savez(folder / "several.npz", **{"room/y": np.nan_to_num(tracks), "room/vis": shown, "room/s": TRUTH, "hall/y": tracks})
    np.save(folder / "t.npy", tracks)
    np.savez(folder / "space.npz", tracks=np.zeros((4, 20, 3)))
    np.savez(folder / "short.npz", tracks=np.where(np.eye(20, dtype=bool)[..., None], 1.0, np.nan) * np.ones(2))
    np.savez(folder / "few.npz", tracks=tracks[:, :5])
    write_film(folder, "room", FRAMES)
    return folder


@pytest.fixture
def solved(monkeypatch):
    """The library's answer, known: two bodies, the first of which stands still; of videos, halves.  Records how it was asked."""
    asked: dict = {}

    def segment_tracks(tracks, **options):
        asked.update(options, tracks=tracks)
        frames, count = tracks.shape[:2]
        labels = torch.from_numpy(TRUTH) if count == len(TRUTH) else 1 + torch.arange(count) % 2
        labels = torch.where(torch.isfinite(tracks).all(-1).sum(0) > 1, labels, 0)
        geometries = torch.zeros(3, 2, 3, 3, dtype=torch.float64)
        geometries[:2, 0, 0, 1] = 1
        planar = torch.tensor([[False, True], [False, True], [False, False]])
        return TrackSegmentation(
            labels=labels, bodies=torch.tensor(2), static_body=torch.tensor(1),
            pairs=torch.tensor([[0, frames // 2], [0, frames - 1], [-1, -1]]), geometries=geometries, homographies=geometries,
            planar=planar, probabilities=0.9 * torch.eye(3, dtype=torch.float64)[labels] + 0.1 / 3,
            residuals=torch.where(labels == 0, 9.0, 0.25 * labels).double(),
            threshold=torch.tensor(float(options["threshold"])), status=torch.tensor(0),
        )  # fmt: skip

    monkeypatch.setattr(dyntorch, "segment_tracks", segment_tracks, raising=False)
    return asked


def read(folder="out"):
    return json.loads((Path(folder) / "segmentation.json").read_text())


def table(path):
    with open(path, newline="") as file:
        return list(csv.DictReader(file))


# ---- what is found -------------------------------------------------------------------------------------------------------
@pytest.mark.slow
def test_a_table_of_tracks(run, solved):
    code, out, err = run("@/t.csv --out out/")
    assert (code, err) == (0, "") and "report: out/report.html" in out
    assert sorted(path.name for path in Path("out").iterdir()) == sorted(set(FILES) - {FILM})
    assert re.search(r"body 1 \(static\) +29 +59\.2 % +0 to 11 +1\.00 +0\.25\d* +with depth", out)
    assert re.search(r"body 2 +14 +28\.6 % +0 to 11 +3\.04 +0\.5\d* +a plane, or under a rotation", out)
    assert re.search(r"outliers +6", out) and "note: 1 track is seen in fewer than two frames and was left out" in out
    assert solved["bodies"] is None and solved["threshold"] == 2.5
    assert solved["tracks"].shape == (FRAMES, 50, 2) and solved["generator"].initial_seed() == 0
    found, arrays = read(), np.load("out/segmentation.npz")
    assert found["status"] == "OK" and found["static_body"] == 1 and found["pairs"] == [["0", "6"], ["0", "11"]]
    assert found["counts"] == {"body 1": 29, "body 2": 14, "outlier": 6, "too short": 1}
    assert [part["planar"] for part in found["bodies"]] == [False, True] and found["misclassified"] is None
    assert len(found["manifest"]["inputs"]) == 1 and found["bodies"][0]["last_frame"] == "11"
    assert arrays["geometries"].shape == (2, 2, 3, 3) and arrays["pairs"].tolist() == [[0, 6], [0, 11]]
    rows = table("out/labels.csv")
    assert list(rows[0]) == ["id", "label", "name", "probability", "residual", "frames", "first", "last"] and len(rows) == 50
    assert rows[7] == {**rows[7], "id": "p7", "label": "0", "name": "too short", "probability": "", "residual": "", "frames": "1"}
    assert rows[3]["last"] == "5" and [int(row["label"]) for row in rows] == arrays["labels"].tolist()
    page = Path("out/report.html").read_text()
    assert "body 1 stands still" in page.lower() and page.count("data:image/png") == 1 and FILM not in page


def test_the_same_from_other_files(run, solved):
    outs = []
    for files in ("@/t.csv", "@/t.npz", "@/several.npz --key room", "@/t.npy"):
        code, out, err = run(files)
        assert (code, err) == (0, "") and ("misclassified: " in out) == ("npz" in files)
        outs.append(out.split("misclassified")[0].split("note")[0])
    assert len(set(outs)) == 1
    assert "misclassified: 0.00 %" in run("@/t.npz")[1]


@pytest.mark.slow
def test_what_is_written_is_read_again(run, solved):
    run("@/t.npz --out out")
    before = solved["tracks"]
    assert run("out/tracks.csv")[0] == 0
    assert solved["tracks"].shape == before.shape and float(solved["tracks"].nansum()) == pytest.approx(float(before.nansum()))


def test_flags_and_stretches_reach_the_library(run, solved):
    code, out, _ = run("@/t.csv --bodies 3 --threshold 1.5 --seed 7 --frames 0,2,4,11")
    assert code == 0 and "note: --bodies asks for 3, the tracks carry 2" in out
    assert solved["bodies"] == 3 and solved["threshold"] == 1.5 and solved["generator"].initial_seed() == 7
    assert solved["tracks"].shape[0] == 4 and re.search(r"body 1 \(static\).* 1\.00 ", out)  # a frame is a frame of the file
    assert run("@/t.csv --frames 2-8")[0] == 0 and solved["tracks"].shape[0] == 7
    np.testing.assert_array_equal(solved["tracks"][:, :32].numpy(), moving()[2:9, :32])
    code, out, _ = run("@/room.mp4 --frames 6-11")
    assert code == 0 and "note: frames 6 to 11 of the 12 that were read" in out and solved["tracks"].shape[0] == 6


@pytest.mark.slow
def test_a_whole_video(run, solved):
    code, out, err = run("@/room.mp4 --out out --title Room")
    assert (code, err) == (0, "") and "note: frames 0 to 11 of the 12 that were read (0.00 to 0.44 s)" in out
    assert sorted(path.name for path in Path("out").iterdir()) == sorted(FILES)
    with av.open("out/segmentation.mp4") as film:
        assert sum(1 for _ in film.decode(video=0)) == FRAMES
    assert {row["frame"] for row in table("out/tracks.csv")} == {str(k) for k in range(FRAMES)}
    page = Path("out/report.html").read_text()
    assert page.count("data:image/png") == 2 and FILM in page and "<h1>Room</h1>" in page
    assert run("@/room.mp4 --out out --every 5")[0] == 0 and len(table("out/labels.csv")) > 20
    assert {row["frame"] for row in table("out/tracks.csv")} == {"0", "5", "10"}


@pytest.mark.slow
def test_pictures(run, solved):
    code, out, _ = run("@/room --out out")
    assert code == 0 and "frames 0 to 11 of the 12 that were read" in out and " s)" not in out and Path("out", FILM).is_file()
    assert run("@/room/*.png --frames 0,3,6,9")[0] == 0 and solved["tracks"].shape[0] == 4


@pytest.mark.slow
def test_tracks_are_drawn_over_images(run, solved):
    for images in ("@/room.mp4", "@/room/*.png"):
        code, _, err = run(f"@/t.csv --images {images} --out out")
        assert (code, err) == (0, "") and Path("out", FILM).is_file()
        assert Path("out/report.html").read_text().count("data:image/png") == 2
    assert run("@/t.csv --images @/room --frames 2,5,8 --out out")[0] == 0  # some frames of all
    assert run("@/t.csv --out out")[0] == 0 and not Path("out", FILM).exists()  # that of an earlier run is not that of this one


@pytest.mark.slow
def test_two_frames_are_two_images(run, monkeypatch):
    asked = []

    def segment(x1, x2, **options):
        asked.append((x1, x2))
        raise ValueError("two views")

    monkeypatch.setattr(dyntorch, "segment", segment)
    films = ("@/room.mp4 --frames 0,11", "@/room.mp4 --at 0,0.4", "@/room/f0.png @/room/f9.png")
    for line in ("@/two.csv", "@/t.csv --frames 3,9", *films):
        code, _, err = run(line)
        assert code == 2 and err.endswith(": two views\n"), line
    tracks = moving()[[3, 9]]
    seen = np.isfinite(tracks).all(axis=(0, 2))
    there = torch.isfinite(torch.cat(asked[0], dim=-1)).all(-1)
    np.testing.assert_allclose(asked[0][0][there], tracks[0, seen])


# ---- what is refused -----------------------------------------------------------------------------------------------------
class Told(NoticeCode):
    CUT = "cut", "the scene changes at frame {frame}; give one of both parts", dyntorch.Status.AMBIGUOUS


@pytest.mark.slow
def test_a_scene_that_changes_is_refused_with_its_frame(run, solved, monkeypatch):
    solve, notice = dyntorch.segment_tracks, Notice(Told.CUT, 0.1, {"frame": 2})
    monkeypatch.setattr(
        dyntorch, "segment_tracks", lambda t, **o: dataclasses.replace(solve(t, **o), status=torch.tensor(3), notices=(notice,))
    )
    code, out, err = run("@/room.mp4 --every 4 --out out")
    said = "the scene changes at frame 8; give one of both parts"  # the third of frames 0, 4, 8
    assert (code, err) == (3, f"dyntorch: refused: {said}\n") and f"warning: cut: {said}" in out
    assert "note: --frames 0-4: the frames of one scene" in out  # of the other one there is one frame
    page = Path("out/report.html").read_text()
    assert "The scene changes at frame 8" in page and "not to be relied on" in page and read()["status"] == "AMBIGUOUS"


BAD = {
    "@/space.npz": "space.npz: holds 3D points, and segment takes what a camera sees",
    "@/short.npz": "short.npz: none of its 20 tracks is seen in two frames; a point keeps its id from frame to frame",
    "@/few.npz": "few.npz: 5 tracks in two frames or more, 8 are needed; give more",
    "@/several.npz": "several.npz: holds 2 sequences (room, hall); say which: --key room",
    "@/several.npz --key attic": "several.npz: has no sequence 'attic'; its sequences are room, hall",
    "@/t.csv --key room": "t.csv: --key room: has no keys",
    "@/t.csv --frames 0,99": "t.csv: has no frame 99; its 12 frames are 0 to 11",
    "@/t.csv --frames 40-99": "t.csv: --frames 40-99: 0 frames of it, and 2 are needed; its 12 frames are 0 to 11",
    "@/room.mp4 --frames 9-9": "--frames 9-9: the last frame must come after the first, such as --frames 0-99",
    "@/room.mp4 --frames 5-40": "room.mp4: has no frame 12; its 12 frames are 0 to 11",
    "@/t.csv --pair desk": "--pair desk",
    "@/several.npz --pair room": "it seems to hold tracks (frames, n, 2): leave --pair out, or say which with --key",
    "@/several.npz --pair room --key room": "--pair is of files of matches and --key of files of tracks; leave one out",
    "@/t.csv --at 0,1": "--at 0,1: it is for a video or a sequence of pictures",
    "@/t.csv --every 2": "--every 2: it is for a video",
    "@/t.csv --threshold auto": "--threshold auto is of two images, and more frames are given",
    "@/t.csv --no-spatial": "--no-spatial is of two images, and more frames are given",
    "@/t.csv --images @/room/f0.png --out out": "f0.png: 1 picture, and the tracks have 12 frames (0 to 11); give a picture for",
    "@/t.csv --images @/no.mp4 --out out": "no.mp4': no such file",
    "@/t.csv --threshold 1000": "t.csv: the points lie within ",
    "@/t.csv --out @/t.npy": "is a file; choose another folder",
    "@/room.mp4 --images @/room": "--images is of files of matches or tracks, and a video or pictures are given",
}


@pytest.mark.parametrize("line", BAD)
def test_bad_input_is_one_line_and_code_2(refuse, solved, line):
    refuse(line, says=(BAD[line],))


@pytest.mark.slow
def test_the_library_itself(run):
    code, out, _ = run("@/room.mp4 --bodies 2 --out out")
    assert code in (0, 3) and Path("out", FILM).is_file() and "body 2" in out
    assert sum(part["tracks"] for part in read()["bodies"]) > 50

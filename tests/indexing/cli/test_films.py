"""``dyntorch index`` on videos in place of keypoints: learn, scan and evaluate, from files and from film sets."""

import csv

import numpy as np
import pytest

from indexing.actors import Person, perform
from indexing.actors.textured import render_clip
from indexing.cli import main

FPS = 15
ACTIONS = ("squat", "jumping_jack")


def acted(action, who):
    return render_clip(perform(action, Person.random(who), fps=FPS, rng=who), azimuth=0, image=(48, 36), rng=10 * who)


def written(path, frames):
    av = pytest.importorskip("av")
    with av.open(str(path), "w") as file:
        stream = file.add_stream("ffv1", rate=FPS)
        stream.height, stream.width, stream.pix_fmt = *frames.shape[1:], "gray"
        for image in frames:
            file.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="gray")))
        file.mux(stream.encode())
    return path


@pytest.fixture(scope="module")
def films():
    return {(action, who): acted(action, who) for action in ACTIONS for who in (1, 2)}


@pytest.mark.slow
def test_fit_and_scan_files(films, tmp_path, capsys):
    squat, jack = (written(tmp_path / f"{action}.mkv", films[action, 1]) for action in ACTIONS)
    both = written(tmp_path / "both.mkv", np.concatenate([films["jumping_jack", 2], films["squat", 2]]))
    model = tmp_path / "moves.safetensors"
    assert main(["index", "fit", f"squat={squat}@0.1-2.5", f"jumping_jack={jack}", "-o", str(model)]) == 0
    said = capsys.readouterr().out
    assert "learned from pixels, at 15 frames per second" in said and "count both" not in said
    assert "squat.mkv@0.1-2.5: the recording runs from 0 to 2.2 s" in " ".join(said.split())
    ranges = [f"a={squat}@0.1-99", f"b={squat}@0.5-", f"c={jack}"]
    assert main(["index", "fit", *ranges, "-o", str(tmp_path / "other.safetensors")]) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "squat.mkv@0.1-99: the recording runs from 0 to" in said and "squat.mkv: 0.5 to 99 s count both as a and as b" in said
    for words, message in (
        ([f"a={squat}", f"b={squat}"], "squat.mkv: is given as a and as b; correct a label, or give the seconds of each"),
        ([f"a={squat}@50-99", f"b={jack}"], "no frame between 50 and 99 s"),
        ([f"a={squat}@4-2", f"b={jack}"], "it ends at 2 s, but starts at 4 s"),
    ):
        assert main(["index", "fit", *words, "-o", str(tmp_path / "none.safetensors")]) == 2
        assert message in capsys.readouterr().err and not (tmp_path / "none.safetensors").exists()
    assert main(["index", "scan", str(both), "-m", str(model), "--report", str(tmp_path / "out")]) == 0
    with (tmp_path / "out" / "events.csv").open() as file:
        events = list(csv.DictReader(file))
    change = len(films["jumping_jack", 2]) / FPS
    for label, inside in (("jumping_jack", lambda t: t < change), ("squat", lambda t: t > change)):
        longest = max((e for e in events if e["label"] == label), key=lambda e: float(e["end"]) - float(e["start"]))
        assert inside((float(longest["start"]) + float(longest["end"])) / 2)


def test_evaluate_a_film_set(films, tmp_path, capsys):
    parts = list(films.values())
    offsets = np.concatenate([[0], np.cumsum([len(part) for part in parts])])
    action, subject = np.array([(ACTIONS.index(action), who) for action, who in films]).T
    path = tmp_path / "films.npz"
    np.savez(path, frames=np.concatenate(parts), offsets=offsets, action=action, action_names=ACTIONS, subject=subject, fps=FPS)
    assert main(["index", "evaluate", str(path), "--leave-out", "subject"]) == 0
    assert "accuracy 1.000 (4 clips" in capsys.readouterr().out


def test_one_action_is_refused(films, tmp_path, capsys):
    squat = written(tmp_path / "squat.mkv", films["squat", 1][:10])
    assert main(["index", "fit", f"squat={squat}", "-o", str(tmp_path / "m.safetensors")]) != 0
    assert "only one action (squat)" in capsys.readouterr().err

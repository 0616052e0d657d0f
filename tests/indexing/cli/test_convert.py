"""``dyntorch convert``: recordings in the formats of other programs, all of them or none."""

from pathlib import Path

import numpy as np
import pytest

from indexing import Clip, ClipSet
from indexing.cli import main
from indexing.readers import read
from indexing.readers.c3d import read as read_c3d
from indexing.writers import FORMATS, suffixes_with_units
from tests.indexing.cli.footage import write_coco

RANDOM = np.random.default_rng(0)
BODY = RANDOM.uniform(0, 100, (1, 17, 2)) + 300 + RANDOM.normal(size=(40, 17, 2))
SUFFIXES = ", ".join([".npz", *FORMATS])
RIGHT = np.array([900.0, 0.0])


@pytest.fixture
def run(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    write_coco(Path("one.json"), Clip(BODY))
    write_coco(Path("two.json"), Clip(BODY), Clip(BODY[:30] + RIGHT))

    def call(words):
        code = main(words.split())
        said = capsys.readouterr()
        return code, " ".join(said.out.split()), said.err

    return call


def test_a_recording(run):
    code, out, _ = run("convert one.json -o one.trc --fps 25")
    assert code == 0 and "1 clip written to one.trc" in out
    assert "note: one.trc: the clip is 2D: written with z = 0" in out and "frames per second assumed" not in out
    assert "one.trc: confidences are left out" in out and "one.trc: up is -y" in out
    back = read("one.trc")[0]
    assert (
        np.allclose(back.joints, BODY, atol=0.01)
        and np.allclose(back.times, np.arange(40) / 25)
        and back.skeleton.joints[0] == "nose"
    )
    code, out, _ = run("convert one.json -o one.c3d --units px")
    assert code == 0 and out.count("30 frames per second assumed for one.json; --fps says otherwise") == 1
    assert np.allclose(read_c3d(Path("one.c3d")).values[..., :2], BODY, atol=0.01)
    assert run("convert one.c3d.npz -o one.trc")[0] == 2


@pytest.mark.slow
def test_people_and_fields_that_not_all_have_are_said(run):
    code, out, _ = run("convert two.json -o two.trc --fps 30")
    assert code == 0 and "two.json: 2 people in view; --person largest takes one" in out
    assert "two.trc: 2 people, their points named 1:nose and so on" in out and "2 clips written to two.trc" in out
    assert [clip.meta["person"] for clip in read("two.trc", person="everyone")] == ["1", "2"]
    code, out, _ = run("convert two.json -o largest.trc --fps 30 --person largest")
    assert code == 0 and "two.json: 2 people in view; followed is the largest" in out
    assert read("largest.trc")[0].joints.shape == (40, 17, 2)
    for name, more in (("a", {"subject": 1}), ("b", {})):
        ClipSet([Clip(BODY, fps=30.0, label=name, name=name, meta=more)]).save(f"{name}.npz")
    code, said, _ = run("convert a.npz b.npz -o both.npz")
    assert code == 0 and "both.npz: left out, as it is not known of all: subject" in said


def test_many(run):
    code, out, _ = run("convert one.json two.json --to c3d -o out --fps 30")
    assert code == 0 and "3 clips written to out/ (2 files)" in out and "one.c3d, two.c3d: the clip is 2D" in out
    assert sorted(path.name for path in Path("out").iterdir()) == ["one.c3d", "two.c3d"]
    code, out, _ = run("convert one.json two.json -o all.npz --fps 30")
    assert code == 0 and len(ClipSet.load("all.npz")) == 3
    code, out, _ = run("convert all.npz --to trc -o parts/deep")
    assert code == 0 and len(list(Path("parts/deep").iterdir())) == 3 and Path("parts/deep/all-0001.trc").exists()
    write_coco(Path("sub/one.json"), Clip(BODY))
    assert run("convert one.json sub/one.json --to trc -o both --fps 30")[0] == 0
    assert sorted(path.name for path in Path("both").iterdir()) == ["one-1.trc", "one-2.trc"]


BAD = {
    "convert -o a.trc": "no recordings; give at least one",
    "convert none.json -o a.trc": "none.json: no such file or folder",
    "convert one.json -o a.abc": f"-o a.abc: no format ends so; end it in {SUFFIXES}, or say it with --to for a folder",
    "convert one.json --to trc -o a.c3d": "--to trc and -o a.c3d say different formats",
    "convert one.json two.json -o a.trc": "a.trc: one recording is a file, but 2 are given; give a folder: --to trc -o a",
    "convert set.npz -o a.c3d": "a.c3d: 2 clips (set[0], ...) are not the people of one recording",
    "convert set.npz -o set.npz": "set.npz: is an input, and the output would replace it",
    "convert set.npz --to npz -o .": "set.npz: is an input, and the output would replace it",
    "convert uneven.npz -o a.c3d": "a.c3d: times are uneven",
    "convert one.json uneven.npz --to c3d -o a": "uneven.c3d: times are uneven",
    "convert one.json -o a.npz --units m": f"--units m: of {' and '.join(suffixes_with_units())} only",
    "convert one.json -o one.json/a.trc": "'one.json' is a file; choose another folder",
    "convert one.json --to mp4 -o a": "--to",
}


@pytest.mark.slow
@pytest.mark.parametrize("words", BAD)
def test_bad_input_leaves_nothing(run, words):
    np.savez("set.npz", joints=np.concatenate([BODY, BODY]), offsets=[0, 40, 80], fps=30.0)
    Clip(BODY, times=np.cumsum(np.linspace(0.01, 0.1, 40))).save("uneven.npz")
    before = sorted(Path().rglob("*"))
    code, _, err = run(words)
    assert code == 2 and BAD[words] in err and err.count("\n") == 1
    assert sorted(Path().rglob("*")) == before

"""``dyntorch archive``: recordings added, asked, checked and removed as a laboratory does, and every bad input as one line."""

from __future__ import annotations

import contextlib
import csv
import io
import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from indexing import Archive
from indexing.actors import Person, dataset, detect, stream
from indexing.archive import writer
from indexing.cli import main
from indexing.cli.commands import archive as verbs
from indexing.clip import ClipSet
from tests.indexing.cli.footage import write_coco

ACTIONS = ("squat", "kick", "wave")


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """``week/*.npz``, a file that is none, an example of each action, a model, and an archive of the week."""
    folder = tmp_path_factory.mktemp("laboratory")
    (folder / "week").mkdir()
    truth = []
    for i, day in enumerate(("monday", "tuesday", "friday")):
        solid, done = stream([ACTIONS[(i + j) % 3] for j in range(3)], Person.random(5 + i), rng=i)
        ClipSet([detect(solid, azimuth=40.0 * i, rng=i)]).save(folder / "week" / f"{day}.npz")
        truth += [(f"week/{day}.npz", *span) for span in done]
    (folder / "truth.json").write_text(json.dumps(truth))
    (folder / "broken.json").write_text('{"cut')
    lesson = dataset([Person.random(1)], ACTIONS, azimuth=0, rng=0)
    lesson.save(folder / "lesson.npz")
    for clip in lesson:
        write_coco(folder / f"{clip.label}.json", clip)
    with contextlib.chdir(folder), contextlib.redirect_stdout(io.StringIO()):
        assert main(["archive", "add", "lab.archive", "week"]) == 0
        assert main(["index", "fit", "lesson.npz", "-o", "moves.safetensors"]) == 0
    return folder


@pytest.fixture
def run(data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
    """Runs ``dyntorch archive`` in the folder of the data; ``@/`` in a word stands for an empty folder."""
    monkeypatch.chdir(data)
    capsys.readouterr()

    def call(*words: str) -> tuple[int, str, str]:
        code = main(["archive", *(word.replace("@/", f"{tmp_path}/") for word in words)])
        said = capsys.readouterr()
        return code, said.out, said.err

    return call


# ---- add -----------------------------------------------------------------------------------------------------------------
@pytest.mark.slow
def test_add_says_what_became_of_each(run, data: Path, tmp_path: Path) -> None:
    code, out, err = run("add", "@/a", "week", "squat.json", "broken.json")
    assert code == 0 and re.search(r"added +4 +[\d,]+ +\d", out) and re.search(r"failed +1", out)
    assert "30 frames per second assumed: squat.json" in out and "4 sources" in out
    assert err.startswith("dyntorch: failed: broken.json: not valid JSON") and err.count("\n") == 1
    code, out, err = run("add", "@/a", "week", "squat.json", "--person", "everyone")
    assert code == 0 and err == "" and re.search(r"known +4", out) and "added" not in out
    code, out, _ = run("add", "@/a", "squat.json", "--fps", "60")
    assert code == 0 and re.search(r"replaced +1", out) and "assumed" not in out
    archive = Archive(tmp_path / "a")
    assert len(archive.recordings()) == 4
    assert len(archive.add(data / "week").of("known")) == 3  # read alike from Python and from here


@pytest.mark.slow
def test_exit_codes_of_add(run) -> None:
    assert run("add", "@/a", "week/monday.npz", "broken.json", "--strict")[0] == 2
    assert run("add", "@/a", "week", "broken.json")[0] == 0  # two are new
    assert run("add", "@/a", "week", "broken.json")[0] == 2  # none is new
    assert run("add", "@/a", "week", "--strict")[0] == 0
    for words, expected in ((("week", "nope.json"), 0), (("week", "nope.json", "--strict"), 2), (("nope.json",), 2)):
        code, out, err = run("add", f"@/missing{len(words)}", *words)
        assert code == expected and err.count("\n") == 1 and "nope.json: no such file" in err
        assert "failed" in out and ("3 sources" in out) == ("week" in words)


def test_an_interruption_keeps_what_was_read(run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    reads, read = [], writer.read_source

    def stop(source, *more, **options):
        reads.append(source)
        if len(reads) == 3:
            raise KeyboardInterrupt
        return read(source, *more, **options)

    monkeypatch.setattr(writer, "read_source", stop)
    code, out, err = run("add", "@/a", "week")
    assert code == 130 and out == "" and err.count("\n") == 1
    assert "the archive is whole: 2 sources" in err and "the same command goes on from there" in err
    assert Archive(tmp_path / "a").verify().ok and len(Archive(tmp_path / "a").recordings()) == 2


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "killpg"), reason="needs groups of processes")
def test_ctrl_c_ends_the_workers_and_leaves_an_archive(data: Path, tmp_path: Path) -> None:
    many = tmp_path / "many"
    many.mkdir()
    for i in range(60):
        (many / f"{i}.npz").write_bytes((data / "week" / "monday.npz").read_bytes())
    words = [sys.executable, "-m", "indexing.cli", "archive", "add", str(tmp_path / "a"), str(many), "--workers", "2"]
    child = subprocess.Popen(words, start_new_session=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    started = time.monotonic()
    while not (tmp_path / "a" / "catalogue.sqlite").exists() and time.monotonic() - started < 120:
        time.sleep(0.05)
    os.killpg(child.pid, signal.SIGINT)
    out, err = child.communicate(timeout=120)
    assert child.returncode == 130 and out == "", err
    assert err.startswith("dyntorch: interrupted; ") and err.count("\n") == 1  # the workers say nothing
    with contextlib.redirect_stdout(io.StringIO()):
        assert main(["archive", "add", str(tmp_path / "a"), str(many)]) == 0
    assert Archive(tmp_path / "a").verify().ok and len(Archive(tmp_path / "a").recordings()) == 60


def test_bad_input_is_refused(refuse, tmp_path: Path) -> None:
    for verb in ("info @/none", "verify @/none", "remove @/none x", "find @/none -m moves.safetensors"):
        refuse(*verb.split(), says=("none", "no archive"))
    refuse("remove", "lab.archive", says=("no sources",))
    refuse("find", "lab.archive", "-m", "nope.safetensors", says=("nope.safetensors",))
    refuse("find", "lab.archive", "-m", "kick.json", says=("kick.json", "not a model file"))
    (tmp_path / "empty").mkdir()
    (tmp_path / "file").touch()
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "x.txt").touch()
    refuse("add", "@/a", says=("no sources",))
    refuse("add", "@/a", "@/empty", says=("nothing to add",))
    refuse("add", "@/file", "week", says=("is a file", "folder"))
    refuse("add", "@/full", "week", says=("full",))
    refuse("add", "@/a", "week", "--workers", "0", says=("--workers 0", "1 or more"))
    refuse("add", "@/a", "week", "--workers", "2", "--dask", "tcp://x:1", says=("leave one of them out",))
    assert not (tmp_path / "a").exists()


# ---- search --------------------------------------------------------------------------------------------------------------
def test_search_prints_hits_and_writes_the_report(run, data: Path, tmp_path: Path) -> None:
    code, out, err = run("search", "lab.archive", "kick.json@0.2-1.4", "-k", "3", "--report", "@/out")
    assert code == 0 and err == "" and "3 hits in 3 sources" in out and "assumed for kick.json" in out
    first = re.search(r"1 +(\S+) +([\d.]+) +([\d.]+) +[\d.]+", out)
    truth = [(file, start, end) for file, label, start, end in json.loads((data / "truth.json").read_text()) if label == "kick"]
    middle = (float(first[2]) + float(first[3])) / 2
    assert any(file == first[1] and start < middle < end for file, start, end in truth)
    assert {path.name for path in (tmp_path / "out").iterdir()} == {"report.html", "hits.csv", "metrics.json", "manifest.json"}
    rows = list(csv.DictReader((tmp_path / "out" / "hits.csv").open()))
    assert len(rows) == 3 and rows[0]["file"] == first[1]
    made = json.loads((tmp_path / "out" / "manifest.json").read_text())
    assert made["arguments"]["command"] == "archive search" and list(made["inputs"]) == ["kick.json"]
    assert made["archive"]["sources"] == 3 and made["timings"]["search"] > 0


@pytest.mark.slow
def test_search_of_a_clip_of_a_set_and_of_its_mirror_image(run) -> None:
    code, out, _ = run("search", "lab.archive", "lesson.npz", "--select", "action=kick", "-k", "2", "--mirror", "--workers", "1")
    assert code == 0 and "2 hits" in out and "assumed" not in out
    by_name = run("search", "lab.archive", "lesson.npz", "--select", "name=kick-0-0-0", "-k", "2", "--mirror")[1]
    assert by_name.splitlines()[:4] == out.splitlines()[:4]
    assert run("search", "lab.archive", "kick=kick.json@0.2-", "-k", "2")[0] == 0  # as an example of index fit is written


@pytest.mark.slow
def test_search_refuses_bad_input(refuse, run, data: Path, tmp_path: Path) -> None:
    search = ("search", "lab.archive")
    refuse(*search, "nope.json", says=("nope.json", "no such file"))
    refuse(*search, "kick.json@0.2-0.4", says=("0.5 s",))
    refuse(*search, "kick.json@50-60", says=("no frame between",))
    refuse(*search, "kick.json@2-1", says=("kick.json@2-1", "start"))
    refuse(*search, "lesson.npz", says=("lesson.npz", "3 clips", "--select", "action (kick, squat, wave)"))
    refuse(*search, "lesson.npz", "--select", "name=nobody", says=("name=nobody", "lesson.npz", "it holds squat-0-0-0, kick-0-0-0"))
    refuse(*search, "kick.json", "-k", "0", says=("1 or more",))
    refuse(*search, "kick.json", "--report", "week/monday.npz", says=("is a file",))
    refuse("search", "@/none", "kick.json", says=("none", "no archive"))
    refuse("search", "week", "kick.json", says=("week", "archive"))
    (tmp_path / "hits.csv").write_text("x")
    refuse(*search, "@/hits.csv", "--report", "@/", says=("hits.csv", "input"))


# ---- find ----------------------------------------------------------------------------------------------------------------
@pytest.mark.slow
def test_find_prints_events_and_writes_the_report(run, data: Path, tmp_path: Path) -> None:
    code, out, err = run("find", "lab.archive", "-m", "moves.safetensors", "--report", "@/out")
    assert code == 0 and err == "" and "margin" in out and "of 3 sources" in out
    assert {path.name for path in (tmp_path / "out").iterdir()} == {"report.html", "events.csv", "metrics.json", "manifest.json"}
    rows = list(csv.DictReader((tmp_path / "out" / "events.csv").open()))
    assert list(rows[0]) == ["file", "label", "start", "end", "score", "margin", "person"]
    truth = json.loads((data / "truth.json").read_text())
    right = [
        any(
            row["file"] == file and row["label"] == label and min(float(row["end"]), end) - max(float(row["start"]), start) > 0.5
            for row in rows
        )
        for file, label, start, end in truth
    ]
    assert sum(right) >= 7 and "player" in (tmp_path / "out" / "report.html").read_text()
    made = json.loads((tmp_path / "out" / "manifest.json").read_text())
    assert made["arguments"]["command"] == "archive find" and list(made["inputs"]) == ["moves.safetensors"]


@pytest.mark.slow
def test_many_events_are_counted(run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("indexing.report.archive.MAX_EVENTS_PRINTED", 2)
    code, out, _ = run("find", "lab.archive", "-m", "moves.safetensors")
    assert code == 0 and "times" in out and "margin" not in out and "events.csv of a report" in out
    code, out, _ = run("find", "lab.archive", "-m", "moves.safetensors", "--reject", "1000")
    assert code == 0 and "no action found in 3 sources" in out


# ---- info, verify, remove ------------------------------------------------------------------------------------------------
def test_infos_count_and_searches_say_what_was_cut(run) -> None:
    code, out, _ = run("info", "lab.archive")
    assert code == 0 and re.search(r"COCO-17 +17", out) and "3 sources," in out and "1 segment" in out
    code, out, _ = run("info", "lab.archive", "--sources")
    assert code == 0 and out.index("week/friday.npz") < out.index("week/monday.npz") < out.index("week/tuesday.npz")
    code, out, _ = run("search", "lab.archive", "squat.json@0.5-99", "-k", "1")
    assert code == 0 and "squat.json@0.5-99: the recording runs from 0 to" in out and "s of it is used" in out


@pytest.mark.slow
def test_verify_says_what_is_wrong(run, data: Path, tmp_path: Path) -> None:
    code, out, err = run("verify", "lab.archive")
    assert code == 0 and err == "" and "all there, whole, and once" in out
    assert run("add", "@/a", "week")[0] == 0
    (segment,) = (tmp_path / "a" / "segments").iterdir()
    content = bytearray(segment.read_bytes())
    content[-100] ^= 1
    segment.write_bytes(content)
    (segment.parent / "left.tmp").touch()
    code, out, err = run("verify", "@/a")
    assert code == 2 and "1 problem" in out and "1 file of interrupted additions" in out
    assert err.startswith("dyntorch: ") and "is not what was written" in err


def test_remove_takes_out_what_is_there(run, tmp_path: Path) -> None:
    assert run("add", "@/a", "week")[0] == 0
    code, out, err = run("remove", "@/a", "week/monday.npz", "week/sunday.npz", "week/friday.npz")
    assert code == 2 and out.count("1 recording removed") == 2 and err.count("\n") == 1 and "week/sunday.npz" in err
    assert [one.source for one in Archive(tmp_path / "a").recordings()] == ["week/tuesday.npz"]
    code, out, _ = run("info", "@/a")
    assert code == 0 and "1 source," in out


# ---- clusters, bars, help ------------------------------------------------------------------------------------------------
def test_without_dask_the_extra_is_named(refuse, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "dask.distributed", None)
    refuse("search", "lab.archive", "kick.json", "--dask", "tcp://x:1", says=('pip install "dyntorch[cluster]"',))


def test_a_cluster_that_is_not_there_is_one_line(refuse, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("dask.distributed")
    monkeypatch.setattr(verbs, "CLUSTER_TIMEOUT", 1)
    refuse("search", "lab.archive", "kick.json", "--dask", "tcp://127.0.0.1:9", says=("tcp://127.0.0.1:9", "scheduler that runs"))
    refuse("search", "lab.archive", "kick.json", "--dask", "foo://x", says=("foo", "scheduler that runs"))


def test_a_cluster_gives_the_same_answers(run, tmp_path: Path) -> None:
    distributed = pytest.importorskip("dask.distributed")
    search, find = ("search", "@/a", "kick.json", "-k", "4"), ("find", "@/a", "-m", "moves.safetensors")
    with distributed.LocalCluster(n_workers=1, threads_per_worker=1, processes=False, dashboard_address=None) as cluster:
        there = ("--dask", cluster.scheduler_address)
        assert run("add", "@/a", "week", *there)[0] == 0
        assert run(*search, "--report", "@/hits there", *there)[0] == run(*find, "--report", "@/finds there", *there)[0] == 0
    assert run(*search, "--report", "@/hits here")[0] == run(*find, "--report", "@/finds here")[0] == 0
    for kind, name in (("hits", "hits.csv"), ("finds", "events.csv")):
        assert (tmp_path / f"{kind} there" / name).read_text() == (tmp_path / f"{kind} here" / name).read_text()

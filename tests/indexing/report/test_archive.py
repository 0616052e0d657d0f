"""Pages on an archive: hits and finds as they are stored, safe with any name, and light however much was found."""

from __future__ import annotations

import csv
import dataclasses
import io
import json
import re

import numpy as np
import pytest

from indexing import Archive
from indexing.actors import Person, dataset, detect, stream
from indexing.archive.actions import ArchivedEvent
from indexing.archive.search import Hit
from indexing.clip import Clip
from indexing.report import archive as pages
from indexing.report.archive import FindReport, SearchReport
from indexing.report.summary import write_report
from tests.indexing.report.people import BROWSER, SCRIPT, in_browser
from tests.indexing.report.test_page import Page

ACTIONS = ("squat", "kick", "wave")
EVIL = f"week/{SCRIPT}.npz"


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory):
    """An archive of three recordings, what happens in each, and an example of each action."""
    clips, truth = [], {}
    for i, name in enumerate(("week/monday.npz", "week/friday.npz", EVIL)):
        solid, done = stream([ACTIONS[(i + j) % 3] for j in range(3)], Person.random(5 + i), rng=i)
        clips.append(detect(solid, azimuth=40.0 * i, rng=i).replace(name=name))
        truth[name] = done
    archive = Archive(tmp_path_factory.mktemp("archive") / "lab.archive")
    archive.add(clips)
    return archive, truth, {clip.label: [clip] for clip in dataset([Person.random(1)], ACTIONS, azimuth=0, rng=0)}


def hits_of(truth, **fields):
    spans = [(name, start, end) for name, done in truth.items() for _, start, end in done]
    return [Hit(name, "", start, end, 9.0 - i, **fields) for i, (name, start, end) in enumerate(spans)]


def events_of(truth):
    return [
        ArchivedEvent(label, start, end, 3.0 + i, 0.5 * i, 0, source=name)
        for i, (name, done) in enumerate(truth.items())
        for label, start, end in done
    ]


def searched(lab, hits, **fields):
    archive, _, examples = lab
    return SearchReport(examples["kick"][0].replace(name="kick.json, 0.2 to 1.4 s"), hits, archive, archive.info(), **fields)


def found(lab, events, **fields):
    archive, _, examples = lab
    return FindReport(ACTIONS, events, archive.recordings(), archive, archive.info(), examples, **fields)


class Whole(Page):
    """As other pages, but with a box to tick."""

    VOID = Page.VOID | {"input"}


def checked(path):
    """The page, after what must hold of every page."""
    text = path.read_text(encoding="utf-8")
    parsed = Whole(text)
    assert parsed.bad == [] and parsed.addresses == []
    assert "url(" not in text and "@import" not in text and "default-src 'none'" in text
    assert len(re.findall("<script>", text)) == ("data-player=" in text)
    assert not list(path.parent.glob(".*"))
    return text


def rows_of(path):
    return list(csv.DictReader(io.StringIO(path.read_text(encoding="utf-8"))))


# ---- search --------------------------------------------------------------------------------------------------------------
def test_every_hit_is_drawn_and_plays_beside_the_query(lab, tmp_path):
    hits = [*hits_of(lab[1])[:8], hits_of(lab[1], mirrored=True)[8]]
    text = checked(write_report(tmp_path / "out", searched(lab, hits, notes=["30 frames per second assumed"])))
    names = {path.name for path in (tmp_path / "out").iterdir()}
    assert names == {"report.html", "hits.csv", "metrics.json", "manifest.json"}
    assert text.count('class="pair"') == 9 and text.count('class="film"') == 17
    assert text.count('class="film turned"') == 1  # the query as in a mirror, beside the hit that resembles it so
    assert text.count('class="strip"') == 1 + 3 * 9  # the query; of each hit its key frames, and two films
    assert "kick.json, 0.2 to 1.4 s" in text and "30 frames per second assumed" in text and "mirrored" in text
    assert SCRIPT not in text and "week/&lt;script&gt;" in text
    films = {tuple(map(float, one)) for one in re.findall(r"--steps:(\d+);--lasts:([\d.]+)s", text)}
    assert len({lasts for _, lasts in films}) == 1  # all at the pace of the query
    rows = rows_of(tmp_path / "out" / "hits.csv")
    assert tuple(rows[0]) == ("rank", "file", "start", "end", "score", "person", "mirrored")
    assert [row["rank"] for row in rows] == [str(i) for i in range(1, 10)] and rows[8]["mirrored"] == "yes"
    assert float(rows[0]["start"]) == pytest.approx(hits[0].start, abs=1e-3)
    measured = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert (measured["hits"], measured["sources"], measured["best_score"]) == (9, 3, 9.0)
    assert measured["searched"]["sources"] == 3
    listed = json.loads((tmp_path / "out" / "manifest.json").read_text())["files"]
    assert set(listed) == names


@pytest.mark.slow
def test_many_hits_are_listed_and_the_rest_is_in_the_file(lab, tmp_path):
    hits = [Hit("week/monday.npz", "", 1.0, 2.0, -float(i)) for i in range(1200)]
    path = write_report(tmp_path, searched(lab, hits))
    text = checked(path)
    assert text.count('class="pair"') == pages.PICTURED
    assert f"{pages.ROWS - pages.PICTURED} more without pictures" in text and "200 further hits in hits.csv only" in text
    assert len(rows_of(tmp_path / "hits.csv")) == 1200 and path.stat().st_size < 2e6


def test_drawings_stop_where_a_page_would_grow_heavy(lab, tmp_path, monkeypatch):
    monkeypatch.setattr(pages, "WEIGHT", 30_000)
    text = checked(write_report(tmp_path, searched(lab, hits_of(lab[1]))))
    assert 1 <= text.count('class="pair"') < 9 and "more without pictures" in text


def test_nothing_found_is_a_page_too(lab, tmp_path):
    text = checked(write_report(tmp_path, found(lab, [])))
    assert "None of the actions was found in 3 recordings" in text and 'class="player"' not in text
    text = checked(write_report(tmp_path, searched(lab, [Hit("week/gone.npz", "", 1.0, 2.0, 1.0)])))  # removed meanwhile
    assert "no longer stored" in text and 'class="pair"' not in text
    assert {path.name for path in tmp_path.iterdir()} == {"report.html", "hits.csv", "metrics.json", "manifest.json"}
    text = checked(write_report(tmp_path, searched(lab, [])))
    assert "Nothing was found" in text and "What resembles it" not in text
    assert (tmp_path / "hits.csv").read_text() == ",".join(pages.HITS_HEAD) + "\n"


def test_a_query_of_dots_and_one_that_shows_nothing(lab, tmp_path):
    archive, truth, _ = lab
    hits = hits_of(truth)[:2]
    dots = Clip(np.random.default_rng(0).normal(size=(20, 5, 2)), fps=10.0, name="dots")
    text = checked(write_report(tmp_path / "a", SearchReport(dots, hits, archive, archive.info())))
    assert 'class="d"' in text and text.count('class="film"') == 4
    blank = Clip(np.full((20, 17, 2), np.nan), fps=10.0, name="blank")
    text = checked(write_report(tmp_path / "b", SearchReport(blank, hits, archive, archive.info())))
    assert "no joint seen" in text and text.count('class="film"') == 2


# ---- find ----------------------------------------------------------------------------------------------------------------
def test_few_recordings_are_played(lab, tmp_path):
    events = events_of(lab[1])
    text = checked(write_report(tmp_path, found(lab, events)))
    assert {path.name for path in tmp_path.iterdir()} == {"report.html", "events.csv", "metrics.json", "manifest.json"}
    assert text.count('class="player"') == 3 and "data-player" in text
    assert SCRIPT not in text and text.count('class="marks"') == 3
    data = re.search(r'data-player="([^"]*)"', text)[1].replace("&#34;", '"')
    colours = dict(json.loads(data)["actions"])
    for label, colour in colours.items():  # the same on all the page
        assert f'fill="{colour}"/></svg>{label}' in text
    rows = rows_of(tmp_path / "events.csv")
    assert tuple(rows[0]) == ("file", "label", "start", "end", "score", "margin", "person") and len(rows) == 9
    assert rows[0]["file"] == "week/monday.npz" and rows[0]["person"] == ""
    measured = json.loads((tmp_path / "metrics.json").read_text())
    assert measured["events"] == 9 and measured["events_by_class"] == dict.fromkeys(measured["events_by_class"], 3)
    assert measured["recordings_with_events"] == 3 and measured["recordings_by_class"]["kick"] == 3


@pytest.mark.slow
def test_thousands_of_recordings_are_a_light_page(lab, tmp_path):
    archive, truth, examples = lab

    class Copies:
        """The archive's recordings under many names."""

        def clip(self, source, start=None, end=None, person=""):
            return archive.clip(source.partition("#")[0], start, end, person)

    rng = np.random.default_rng(0)
    recordings, events = [], []
    for i in range(1000):
        for one in archive.recordings():
            name = f"{one.source}#{i}"
            recordings.append(dataclasses.replace(one, source=name))
            events += [
                ArchivedEvent(label, start, end, *rng.uniform(1, 9, size=2), 0, source=name)
                for label, start, end in truth[one.source]
                if label != "wave" and i % 2
            ]
    path = write_report(tmp_path, FindReport(ACTIONS, events, recordings, Copies(), archive.info(), examples))
    text = checked(path)
    assert path.stat().st_size < 2e6 and 'class="player"' not in text
    assert "The surest" in text and "The most doubtful" in text and "further recordings with finds in events.csv only" in text
    assert text.count('class="pair"') == 2 * pages.MOST and text.count('class="marks"') == pages.LISTED
    measured = json.loads((tmp_path / "metrics.json").read_text())
    assert measured["events_by_class"]["wave"] == 0 and measured["recordings"] == 3000
    assert len(rows_of(tmp_path / "events.csv")) == len(events) == 3000


@pytest.mark.skipif(BROWSER is None, reason="needs a browser: chromium or chrome")
def test_a_film_slides_by_frame_by_frame(lab, tmp_path):
    """The box that plays all is ticked, and half of the time has passed: the strip stands at its middle frame."""
    text = write_report(tmp_path, searched(lab, hits_of(lab[1])[:1])).read_text(encoding="utf-8")
    text = text.replace('class="all"', 'class="all" checked')
    script = """setTimeout(() => {
      const strip = document.querySelector(".film .strip"), played = strip.getAnimations()[0];
      played.currentTime = 500 * parseFloat(getComputedStyle(strip.parentElement).getPropertyValue("--lasts"));
      const shift = -new DOMMatrix(getComputedStyle(strip).transform).m41;
      const frame = strip.parentElement.getBoundingClientRect().width;
      document.title = JSON.stringify({frames: shift / frame, of: strip.getBoundingClientRect().width / frame});
    }, 50)"""
    seen = in_browser(text, script, tmp_path, "--virtual-time-budget=2000")
    assert seen["of"] == pytest.approx(round(seen["of"]), abs=0.02)
    assert seen["frames"] == pytest.approx(seen["of"] // 2, abs=0.02)

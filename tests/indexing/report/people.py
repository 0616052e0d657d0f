"""What the tests of reports show: a stick figure, a recording of it, and what was found there."""

from __future__ import annotations

import html
import json
import re
import shutil
import subprocess
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from indexing.clip import Clip
from indexing.report import RecordingResult
from indexing.report.summary import write_report
from indexing.skeleton import from_names

SCRIPT = "<script>alert(1)</script>"
"""What no page may run."""
BROWSER = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome", "chrome"))), None)


def in_browser(page: str, script: str, folder: Path, *options: str) -> Any:
    """What a script says of a page in its title, as JSON; without the policy, which would stop it."""
    free = re.sub(r'<meta http-equiv="Content-Security-Policy"[^>]*>', "", page)
    driven = folder / "driven.html"
    driven.write_text(free.replace("</body>", f"<script>{script}</script></body>"), encoding="utf-8")
    flags = f"--headless --no-sandbox --disable-gpu --dump-dom --user-data-dir={folder}/profile".split()
    done = subprocess.run([BROWSER, *flags, *options, driven.as_uri()], capture_output=True, text=True, check=True, timeout=120)
    return json.loads(html.unescape(re.search(r"<title>(\{.*?\})</title>", done.stdout)[1]))


def draw_all(reports: Iterable[Any], folder: Path, name: str) -> list[Any]:
    """What each report writes into its JSON file; its page has a picture, and no number that is none."""
    found = []
    for i, report in enumerate(reports):
        page = write_report(folder / str(i), report).read_text()
        assert "<img" in page and "nan" not in page.partition("<main>")[2].replace("data:image", "").split("base64")[0]
        found.append(json.loads((folder / str(i) / name).read_text()))
    return found


STICK = from_names(
    "stick", ("nose", "left_hand", "right_hand", "hip", "left_foot", "right_foot"),
    (("nose", "hip"), ("nose", "left_hand"), ("nose", "right_hand"), ("hip", "left_foot"), ("hip", "right_foot")),
)  # fmt: skip


@dataclass(frozen=True)
class Hit:
    label: object
    start: float
    end: float
    score: float = -0.5
    margin: float = 0.25
    exemplar: int | None = None


def person(frames=60, up="y", fps=30.0):
    joints = np.zeros((frames, 6, 2))
    joints[:] = [[0, 1.7], [-0.6, 1.2], [0.6, 1.2], [0, 0.9], [-0.2, 0], [0.2, 0]]
    joints[:, 1:3, 1] += 0.5 * np.sin(np.arange(frames) / 8)[:, None]
    return Clip(joints * ([1, -1] if up == "-y" else [1, 1]), fps=fps, skeleton=STICK, up=up)


def recording(events=(), truth=None, classes=("squat", "lunge"), frames=300, name="session.json", clip=True):
    rng = np.random.default_rng(0)
    times = np.arange(frames) / 30
    return RecordingResult(
        name, person(frames) if clip else None, times, list(classes), rng.normal(size=(frames, len(classes))), events, truth
    )

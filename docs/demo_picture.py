"""The picture of the demo at the top of the README: ``make demo && .venv/bin/python docs/demo_picture.py`` (needs chromium)."""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path

from PIL import Image

PAGE, SHOWN = (1200, 1700), (30, 622, 1170, 1552)
"""Size of the window, and what of it is shown: the accuracy by setting and the timeline, without what stands below it."""


PICTURE = Path(__file__).with_name("demo.png")


def main(report: Path = Path("demo-report/report.html"), picture: Path = PICTURE) -> None:
    """Photograph a report."""
    with tempfile.TemporaryDirectory() as folder:
        whole = Path(folder) / "page.png"
        words = ["--headless=new", "--no-sandbox", "--disable-gpu", "--hide-scrollbars", "--virtual-time-budget=8000"]
        words += [f"--window-size={PAGE[0]},{PAGE[1]}", f"--screenshot={whole}", report.resolve().as_uri()]
        subprocess.run(["chromium", *words], check=True, capture_output=True)
        Image.open(whole).crop(SHOWN).convert("RGB").save(picture, optimize=True)


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:]))

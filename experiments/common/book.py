"""What an experiment writes into its folder: tables as they are measured, pictures, and one JSON file with everything."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from experiments.common.tables import Row, aligned, markdown, note
from indexing.files import manifest, prepare, write_bytes, write_json


@dataclass
class Book:
    """Prints every table when it is there, and keeps it for the file.

    Args:
        folder: where everything is written; made at once, so that a folder that cannot be written is noticed before hours.
    """

    folder: Path
    tables: dict[str, Any] = field(default_factory=dict)
    rows: list[Row] = field(default_factory=list)
    seconds: dict[str, float] = field(default_factory=dict)
    _clock: float = field(default_factory=time.perf_counter)

    def __post_init__(self) -> None:
        self.folder = prepare(self.folder.expanduser())

    def grid(self, title: str, columns: Sequence[object], lines: Mapping[str, Sequence[Any]], rows: Sequence[Row] = ()) -> None:
        """A table with a line per method and a column per setting; and, under it, figures beside their goals."""
        head = ["", *map(str, columns)]
        print(f"\n### {title}\n\n" + aligned(head, [[name, *map(_cell, values)] for name, values in lines.items()]), flush=True)
        if rows:
            print("\n" + markdown(rows), flush=True)
        self.rows += rows
        kept = [{**vars(row), "reached": row.reached} for row in rows]
        table = {"columns": [str(column) for column in columns], "lines": {name: list(v) for name, v in lines.items()}}
        self.tables[title] = {**table, "figures": kept}
        now = time.perf_counter()
        self.seconds[title], self._clock = now - self._clock, now

    def picture(self, name: str, png: bytes) -> None:
        """One picture, ``name`` without ``.png``."""
        note(f"picture: {write_bytes(self.folder / f'{name}.png', png)}")

    def close(self, settings: Mapping[str, object], inputs: Sequence[Path] = (), seed: int = 0) -> None:
        """Say how many goals were reached, and write ``figures.json``."""
        goals = [row.reached for row in self.rows if row.reached is not None]
        print(f"\n{sum(goals)} of {len(goals)} goals reached, {sum(self.seconds.values()):.0f} s")
        about = manifest(dict(settings), list(inputs), seed=seed, timings=self.seconds)
        note(f"written: {write_json(self.folder / 'figures.json', {'manifest': about, 'tables': self.tables})}")


def _cell(value: Any) -> str:
    if isinstance(value, (float, np.floating)):
        number = float(value)
        return "" if np.isnan(number) else f"{number:.3f}" if abs(number) < 10 else f"{number:.0f}"
    return str(value)

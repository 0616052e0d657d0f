"""The pages of ``docs/results``: each states its command, which, run as the page says, writes what it prints into the page.

Any other settings (``--quick``, fewer scenes) leave the page as it is.  A script that has no page gets one at its first run.

``python -m experiments.common.results [ROOM...]`` runs the commands of all pages but those of
``benchmarks``, or of those of some rooms, one after the other.
"""

from __future__ import annotations

import contextlib
import io
import os
import platform
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import torch

from indexing.files import manifest, write_text

RESULTS = Path(__file__).parents[2] / "docs" / "results"
MARK = "<!-- measured: what stands below is written by the command -->"
COMMAND = re.compile(r"^`(?:DYNTORCH_DATA=\S+ )?python -m (?P<module>[\w.]+)(?P<words>[^`]*)`$", re.MULTILINE)


class Tee(io.StringIO):
    """Keeps what is printed, and prints it."""

    def __init__(self) -> None:
        super().__init__()
        self._terminal = sys.stdout

    def write(self, text: str) -> int:
        self._terminal.write(text)
        return super().write(text)

    def flush(self) -> None:
        self._terminal.flush()


@contextlib.contextmanager
def published(module: str, words: Sequence[str], pictures: Mapping[str, Path], folder: Path = RESULTS) -> Iterator[None]:
    """Write what is printed inside into the page of a module of ``experiments``, if the page is about these words.

    Args:
        module: as ``python -m`` names it.
        words: the arguments that it was given.
        pictures: files by name, as they are when the run has ended; one that the page shows is copied beside it.
        folder: of the pages; where there is none (a wheel has no documentation), nothing is written.
    """
    if not module.startswith("experiments.") or not folder.is_dir():
        yield
        return
    target = folder / f"{page_name(module)}.md"
    with contextlib.redirect_stdout(Tee()) as said:
        yield
    head = target.read_text(encoding="utf-8").partition(MARK)[0] if target.exists() else _new(module, words)
    stated = COMMAND.search(head)
    if stated is None or (stated["module"], shlex.split(stated["words"])) != (module, list(words)):
        print(f"{target.name} stays as it is: it is about another command", file=sys.stderr)
        return
    write_text(target, f"{head}{MARK}\n\n## As printed\n\n{_machine()}\n\n{as_markdown(said.getvalue())}\n")
    for name, picture in pictures.items():
        if f"({name}.png)" in head:
            shutil.copyfile(picture, folder / f"{name}.png")
    print(f"written: {target}", file=sys.stderr)


def page_name(module: str) -> str:
    """Of the page of a module: its rooms and its name, once where they are the same.

    Example:
        >>> page_name("experiments.recognition.open_set"), page_name("experiments.segmentation.segmentation")
        ('recognition-open_set', 'segmentation')
    """
    _, *rooms, name = module.split(".")
    return "-".join(rooms if rooms and rooms[-1] == name else [*rooms, name])


def as_markdown(printed: str) -> str:
    """Tables and headings as they are; any other paragraph of several lines keeps its lines.

    Example:
        >>> print(as_markdown("| a |\\n|---|\\n\\nb  1\\nc  2"))
        | a |
        |---|
        <BLANKLINE>
        ```text
        b  1
        c  2
        ```
    """
    parts = [part.strip("\n") for part in re.split(r"\n\s*\n", printed.strip("\n"))]
    keep = [part if part.startswith(("|", "#")) or "\n" not in part else f"```text\n{part}\n```" for part in parts]
    return "\n\n".join(re.sub(r"^#+", "###", part) for part in keep)


def _new(module: str, words: Sequence[str]) -> str:
    """The head of a page that nobody has written yet: what the module says of itself, and the command."""
    about = (sys.modules["__main__"].__doc__ or module).split("\n\n")[0].strip()
    return (
        f"# {page_name(module).replace('_', ' ').capitalize()}\n\n{about}\n\n`{shlex.join(['python', '-m', module, *words])}`\n\n"
    )


def _machine() -> str:
    """When and on what this was measured."""
    about = manifest([])
    model = re.search(r"^model name\s*:\s*(.+)$", _cpuinfo(), re.MULTILINE)
    parts = [f"{about['platform']['processors']} processors", model[1] if model else about["platform"]["machine"]]
    if torch.cuda.is_available():
        parts.append(torch.cuda.get_device_name())
    versions = ", ".join(f"{name} {about['versions'][name]}" for name in ("python", "torch", "numpy"))
    threads = f"OMP_NUM_THREADS={os.environ['OMP_NUM_THREADS']}" if "OMP_NUM_THREADS" in os.environ else "threads not limited"
    return f"*Measured on {about['time'][:10]}: {', '.join(parts)}; {platform.system()}; {versions}; {threads}.*"


def _cpuinfo() -> str:
    path = Path("/proc/cpuinfo")
    return path.read_text(encoding="utf-8", errors="replace") if path.exists() else ""


def run_pages(rooms: Sequence[str]) -> None:
    """Run the command of every page of some rooms; without rooms of all but ``benchmarks``, which is timed."""
    failed = []
    for page in sorted(RESULTS.glob("*.md")):
        stated = COMMAND.search(page.read_text(encoding="utf-8").partition(MARK)[0])
        room = stated["module"].split(".")[1] if stated else ""
        if stated and (room in rooms if rooms else room != "benchmarks"):
            print(f"... {page.stem}", file=sys.stderr, flush=True)
            command = [sys.executable, "-m", stated["module"], *shlex.split(stated["words"])]
            if subprocess.run(command, check=False).returncode:
                failed.append(page.stem)
    if failed:
        raise SystemExit(f"not all went through: {', '.join(failed)}")


if __name__ == "__main__":
    run_pages(sys.argv[1:])

"""Compile the kernel: ``python -m dyntorch.native.build`` does it in place, an installation by itself.

Needs the standard library only, as it runs before anything is installed.
"""

from __future__ import annotations

import hashlib
import os
import platform
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

SOURCES = tuple(Path(__file__).with_name(name) for name in ("kernel.c", "recognition.c"))
"""The first includes its parts, the headers beside it."""
LIBRARY = Path(__file__).with_name("kernel.dll" if sys.platform == "win32" else "kernel.so")
# exact where it matters: no reassociation, NaN stays NaN
FLAGS = ("-std=gnu11", "-O3", "-fPIC", "-fvisibility=hidden", "-ffp-contract=fast", "-fno-math-errno", "-fno-trapping-math")
LEVELS = {
    "base": (2, ()),
    "avx2": (4, ("-mavx2", "-mfma")),
    "avx512": (8, ("-mavx512f", "-mavx512dq", "-mavx512vl", "-mfma", "-mprefer-vector-width=512")),
}
"""Instruction sets: problems per register, and what the compiler is told besides."""


def source_digest() -> str:
    """Of the sources: a library that was made from others is not used."""
    parts = [*SOURCES, *sorted(LIBRARY.parent.glob("*.h"))]
    return hashlib.sha256(b"".join(part.read_bytes() for part in parts)).hexdigest()[:16]


def compile_library(target: Path = LIBRARY) -> str:
    """Compile the kernel for every instruction set that this kind of processor may have; why it cannot be, or nothing."""
    asked = os.environ.get("CC")
    compiler = next((path for name in ([asked] if asked else ["cc", "gcc", "clang"]) if (path := shutil.which(name))), None)
    if compiler is None:
        return f"no C compiler named {asked}" if asked else "no C compiler"
    levels = LEVELS if platform.machine().lower() in ("x86_64", "amd64") else {"base": LEVELS["base"]}
    with tempfile.TemporaryDirectory() as folder:
        objects = {(level, source): Path(folder) / f"{source.stem}-{level}.o" for level in levels for source in SOURCES}
        made = Path(folder) / target.name
        for (level, source), place in objects.items():
            lanes, flags = levels[level]
            names = (f"-DLANES={lanes}", f"-DSUFFIX={level}", f'-DSOURCE="{source_digest()}"')
            failure = _run([compiler, *FLAGS, *flags, *names, "-c", str(source), "-o", str(place)])
            if failure:
                return failure
        failure = _run([compiler, "-shared", "-s", *map(str, objects.values()), "-o", str(made), "-lm"])
        if failure:
            return failure
        try:
            # beside the target first: a library that somebody has loaded is replaced, never written into
            beside = target.with_suffix(f".{os.getpid()}")
            shutil.copyfile(made, beside)
            beside.replace(target)
        except OSError as error:
            return f"{target}: {error.strerror or error}"
    return ""


def _run(command: list[str]) -> str:
    """Why the compiler failed, in one line, or nothing."""
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=False, stdin=subprocess.DEVNULL, timeout=300)
    except (OSError, subprocess.TimeoutExpired) as error:
        return f"{command[0]}: {error}"
    lines = done.stderr.strip().splitlines()
    return "" if done.returncode == 0 else f"{Path(command[0]).name}: {lines[0] if lines else f'exit code {done.returncode}'}"


if __name__ == "__main__":
    reason = compile_library()
    print(f"not compiled: {reason}" if reason else f"compiled: {LIBRARY}")
    sys.exit(1 if reason else 0)

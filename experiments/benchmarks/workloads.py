"""What the benchmark of the action indexer runs, each in a process of its own, so that its peak memory is its own.

    python -m experiments.benchmarks.workloads NAME

prints one line of JSON: seconds per repeat, and the peak in megabytes above what the process held after its imports (data
and model included).
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from indexing import ActionIndexer

Array = NDArray[Any]
EXEMPLARS, QUERIES, FRAMES, CLASSES = 1000, 500, 16, 10
CLIP, HOUR = 48, 108_000  # frames at 30 per second
REPEATS, ASKED = 3, 100
NEAREST_ONLY: dict[str, Any] = {"scorer": "nearest", "search": False, "mirror": False, "virtual_views": 0}
# Kinect's 20 joints: hip, spine, neck, head; left and right arm; left and right leg (metres, facing the camera)
_RIGHT_LIMBS = [(0.18, 0.48), (0.24, 0.25), (0.27, 0.02), (0.28, -0.06), (0.10, -0.05), (0.11, -0.42), (0.12, -0.78), (0.13, -0.84)]
_LEFT_LIMBS = [(-x, y) for x, y in _RIGHT_LIMBS]
BODY = np.array([(0, 0), (0, 0.15), (0, 0.5), (0, 0.7), *_LEFT_LIMBS[:4], *_RIGHT_LIMBS[:4], *_LEFT_LIMBS[4:], *_RIGHT_LIMBS[4:]])


def movements(classes: Array, frames: int, rng: np.random.Generator) -> Array:
    """``(N, frames, 20, 2)``: smooth movements of a symmetric body, alike within a class and none the same."""
    time_ = np.linspace(0.0, 1.0, frames)[:, None]
    waves = np.sin(np.pi * time_ * np.arange(1, 5) + np.arange(4))  # (frames, 4)
    size = (4, *BODY.shape)
    styles = 0.08 * np.random.default_rng(0).normal(size=(CLASSES, *size))
    own = styles[classes] + 0.05 * rng.normal(size=(len(classes), *size))
    return np.asarray(BODY + np.einsum("fw,nwjd->nfjd", waves, own) + 0.01 * rng.normal(size=(len(classes), frames, *BODY.shape)))


def bank(rng: np.random.Generator) -> tuple[list[Array], Array, list[Array]]:
    """Exemplars, their labels, and queries."""
    labels = np.arange(EXEMPLARS) % CLASSES
    queries = rng.integers(0, CLASSES, QUERIES)
    return list(movements(labels, FRAMES, rng)), labels, list(movements(queries, FRAMES, rng))


def recognition(**options: Any) -> dict[str, Any]:
    """Predict 500 clips with 1000 exemplars."""
    before = resident()
    exemplars, labels, queries = bank(np.random.default_rng(1))
    start = time.perf_counter()
    indexer = ActionIndexer(**options).fit(exemplars, labels)
    fitted, fit_peak = time.perf_counter() - start, peak()
    forget_peak()
    seconds = timed(lambda: indexer.predict(queries), REPEATS)
    return {
        "seconds": seconds,
        "megabytes": peak() - before,
        "fit_seconds": fitted,
        "fit_megabytes": fit_peak - before,
        "mirrored": float(indexer.model_.mirrored.float().mean()),
    }


def answering(**options: Any) -> dict[str, Any]:
    """Predict one clip at a time with 1000 exemplars, as somebody does who waits for the answer."""
    before = resident()
    exemplars, labels, queries = bank(np.random.default_rng(1))
    indexer = ActionIndexer(**options).fit(exemplars, labels)
    indexer.predict(queries[:1])
    forget_peak()
    seconds = [timed(partial(indexer.predict, [query]), 1, warm=False)[0] for query in queries[:ASKED]]
    return {"seconds": seconds, "megabytes": peak() - before}


def warping() -> dict[str, Any]:
    """The same by dynamic time warping: 20 of the queries, one thread."""
    from experiments.recognition.baselines import WarpedNearest
    from indexing import Clip

    exemplars, labels, queries = bank(np.random.default_rng(1))
    method = WarpedNearest().fit([Clip(joints) for joints in exemplars], labels)
    asked = [Clip(joints) for joints in queries[:20]]
    return {"seconds": [one * QUERIES / len(asked) for one in timed(lambda: method.predict(asked), REPEATS)], "megabytes": 0.0}


def scanning(frames: int) -> dict[str, Any]:
    """Score every frame of a recording of 17 joints, learned from two people doing ten actions once each."""
    from indexing.actors import Person, dataset, detect, stream

    before = resident()
    exemplars = dataset(2, azimuth=0.0, rng=0)
    indexer = ActionIndexer().fit(exemplars, exemplars.labels)
    part, _ = stream([str(label) for label in np.unique(exemplars.labels)], Person.random(9), rng=3)
    seen = detect(part, azimuth=45.0, rng=4)
    joints = np.resize(seen.joints, (frames, *seen.joints.shape[1:]))  # the same minute again and again
    recording = seen.replace(joints=joints, times=np.arange(frames) / 30.0, confidence=None)
    forget_peak()
    seconds = timed(lambda: indexer.score_frames(recording), 1, warm=False)
    return {"seconds": seconds, "megabytes": peak() - before}


def crowded() -> dict[str, Any]:
    """Score every frame of an hour of 20 joints against 1000 exemplars of 1.6 seconds."""
    rng, before = np.random.default_rng(1), resident()
    indexer = ActionIndexer().fit(list(movements(np.arange(EXEMPLARS) % CLASSES, CLIP, rng)), np.arange(EXEMPLARS) % CLASSES)
    acts = movements(rng.integers(0, CLASSES, 100), CLIP, rng)
    recording = np.resize(acts.reshape(-1, *BODY.shape), (HOUR, *BODY.shape))
    forget_peak()
    return {"seconds": timed(lambda: indexer.score_frames(recording), 1, warm=False), "megabytes": peak() - before}


def learning(**options: Any) -> dict[str, Any]:
    """Learn from 1000 clips of 1.6 seconds, by ten people who take turns."""
    people = np.arange(EXEMPLARS) // CLASSES % 10
    labels, before = np.arange(EXEMPLARS) % CLASSES, resident()
    clips = list(movements(labels, CLIP, np.random.default_rng(1)))
    seconds = timed(lambda: ActionIndexer(**options).fit(clips, labels, groups=people), 1, warm=False)
    return {"seconds": seconds, "megabytes": peak() - before}


def timed(run: Callable[[], Any], repeats: int, warm: bool = True) -> list[float]:
    """Seconds of every repeat, after one that does not count."""
    if warm:
        run()
    seconds = []
    for _ in range(repeats):
        start = time.perf_counter()
        run()
        seconds.append(time.perf_counter() - start)
    return seconds


# ---- memory of this process, in megabytes ------------------------------------------------------------------------------
def resident() -> float:
    """What the process holds now; where only the peak is known, that."""
    return _status("VmRSS")


def peak() -> float:
    """The most that the process has held (since :func:`forget_peak`, where the system can forget)."""
    return _status("VmHWM")


def forget_peak() -> None:
    """Start the peak anew (Linux)."""
    with suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")


def _status(key: str) -> float:
    status = Path("/proc/self/status")
    if status.is_file():
        line = next(line for line in status.read_text().splitlines() if line.startswith(key + ":"))
        return float(line.split()[1]) / 1024
    import resource

    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (2**20 if sys.platform == "darwin" else 2**10)


WORKLOADS: dict[str, Callable[[], dict[str, Any]]] = {
    "plain": lambda: recognition(**NEAREST_ONLY),
    "search": recognition,
    "plain, one query": lambda: answering(**NEAREST_ONLY),
    "search, one query": answering,
    "warping": warping,
    "scan 20 minutes": lambda: scanning(HOUR // 3),
    "scan 1 hour": lambda: scanning(HOUR),
    "scan 1 hour, 1000 exemplars": crowded,
    "fit 1000 clips": learning,
    "fit 1000 clips, learned": lambda: learning(weights="learned"),
}

if __name__ == "__main__":
    print(json.dumps(WORKLOADS[sys.argv[1]]()))

"""Small videos whose content is known, written to files or handed over as chunks."""

from __future__ import annotations

import contextlib
from fractions import Fraction
from importlib import import_module

import numpy as np
import pytest

from indexing.video import Chunk

SIZE = (320, 240)


@pytest.fixture(scope="session", autouse=True)
def one_thread():
    """OpenCV's threads wait busily, which costs the tests beside these."""
    with contextlib.suppress(ImportError):
        import_module("cv2").setNumThreads(1)


@pytest.fixture
def write(tmp_path):
    """Writes frames ``(n, h, w[, 3])`` to a file in ``tmp_path`` and returns its path."""
    av = pytest.importorskip("av")

    def make(name, frames, *, fps=30, codec="libx264", pix_fmt="yuv420p", stamps=None, rotation=None, mirror=False, encoding=None):
        path = tmp_path / name
        with av.open(str(path), "w", options={"movflags": "faststart"} if name.endswith("mp4") else {}) as container:
            stream = container.add_stream(codec, rate=fps, options={"preset": "ultrafast"} if codec == "libx264" else {})
            stream.height, stream.width = frames.shape[1:3]
            stream.pix_fmt = pix_fmt
            if stamps is not None:
                stream.codec_context.time_base = stream.time_base = Fraction(1, 1000)
            if rotation is not None:
                if not hasattr(stream, "set_display_rotation"):
                    pytest.skip("this PyAV cannot write rotated videos; 17 can")
                stream.set_display_rotation(rotation, hflip=mirror)
            for i, image in enumerate(frames):
                picture = av.VideoFrame.from_ndarray(image, format=encoding or ("gray" if image.ndim == 2 else "rgb24"))
                if stamps is not None:
                    picture.pts, picture.time_base = int(stamps[i]), Fraction(1, 1000)
                container.mux(stream.encode(picture))
            container.mux(stream.encode())
        return path

    return make


def texture(rng, height, width, grain=4):
    cv2 = pytest.importorskip("cv2")
    fine = rng.uniform(0, 255, (height // grain + 2, width // grain + 2)).astype(np.float32)
    return cv2.resize(fine, (width, height), interpolation=cv2.INTER_CUBIC).clip(0, 255).astype(np.uint8)


@pytest.fixture(scope="session")
def scene():
    """A textured wall and blobs that move before it, seen by a camera that may move: chunks, and the blobs' centres.

    ``camera(i)`` is the ``(3, 3)`` map of the first frame's pixels to those of frame ``i``.
    """
    cv2 = pytest.importorskip("cv2")

    def make(frames=60, camera=None, blobs=3, fps=30.0, noise=2.0, radius=22, seed=0, chunk=25):
        rng = np.random.default_rng(seed)
        width, height = SIZE
        margin = 120
        wall = texture(rng, height + 2 * margin, width + 2 * margin, 7)
        coats = [texture(rng, 2 * radius, 2 * radius, 4) for _ in range(blobs)]
        inside = np.hypot(*np.mgrid[-radius:radius, -radius:radius]) < radius
        still, images, centres = np.array([[1.0, 0, -margin], [0, 1, -margin], [0, 0, 1]]), [], []
        for i in range(frames):
            angle = 2 * np.pi * i / 45 + np.arange(blobs)
            spots = np.stack(
                [width * (np.arange(blobs) + 1) / (blobs + 1) + 18 * np.sin(angle), height / 2 + 35 * np.cos(1.3 * angle)], 1
            )
            spots = np.rint(spots)
            image = wall.copy()
            for coat, (x, y) in zip(coats, spots.astype(int) + margin, strict=True):
                image[y - radius : y + radius, x - radius : x + radius][inside] = coat[inside]
            motion = np.eye(3) if camera is None else camera(i)
            image = cv2.warpPerspective(image, motion @ still, SIZE)
            images.append((image + noise * rng.normal(size=image.shape)).clip(0, 255).astype(np.uint8))
            centres.append(spots)
        stack, times = np.stack(images), np.arange(frames) / fps
        chunks = [Chunk(stack[i : i + chunk], times[i : i + chunk]) for i in range(0, frames, chunk)]
        return chunks, np.stack(centres)

    return make

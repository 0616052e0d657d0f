"""Made-up people in made-up videos, and networks that see them: every test of this room knows where everybody really is.

A person is a red disc at the hips and a blue disc on the circle about the body.  The networks look at the pixels that they are
given, as the real ones do, and answer in the formats of these.
"""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path

import numpy as np

from indexing.pose.blazepose import CIRCLE, GRIDS, HEATMAP, HIPS, JOINTS, LANDMARKS, PICTURE, REGION, anchors

HIP, TOP = (230, 30, 30), (30, 30, 230)
GROUND = 128


def pattern() -> np.ndarray:
    """``(33, 2)`` where joints are, about the hips, with the circle one unit above them."""
    angle = np.arange(JOINTS) * 2.4
    return np.stack([0.35 * np.cos(angle), -0.1 + 0.6 * np.sin(angle)], axis=1)


def joints_of(hips, circle) -> np.ndarray:
    """``(33, 2)`` of a person whose hips and circle are at these places."""
    up = np.asarray(circle, float) - hips
    right = np.array([-up[1], up[0]])
    shape = pattern()
    return hips + shape[:, :1] * right - shape[:, 1:] * up


def drawn(people, width, height) -> np.ndarray:
    """A frame of people, each ``(hips, circle)`` in pixels."""
    y, x = np.mgrid[:height, :width] + 0.5
    image = np.full((height, width, 3), GROUND, np.uint8)
    for hips, circle in people:
        radius = max(2.5, 0.12 * float(np.hypot(*(np.asarray(circle, float) - hips))))
        for (u, v), colour in ((hips, HIP), (circle, TOP)):
            image[np.hypot(x - u, y - v) < radius] = colour
    return image


def blobs(image: np.ndarray, colour: tuple[int, int, int]) -> np.ndarray:
    """``(k, 3)`` centres (pixels from the edge) and sizes of what has this colour."""
    import cv2

    red, blue = image[..., 0].astype(int), image[..., 2].astype(int)
    mask = (red - blue > 60) if colour == HIP else (blue - red > 60)
    _, _, stats, centres = cv2.connectedComponentsWithStats(mask.astype(np.uint8))
    large = stats[1:, cv2.CC_STAT_AREA] >= 4
    return np.column_stack([centres[1:][large] + 0.5, stats[1:][large, cv2.CC_STAT_AREA]])


def pairs(image: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """Hips and circles that belong together: of discs of about one size the nearest."""
    hips, tops = blobs(image, HIP), blobs(image, TOP)
    found = []
    for one in hips:
        alike = tops[np.abs(np.log(tops[:, 2] / one[2])) < 0.7]
        if len(alike):
            far = np.hypot(*(alike[:, :2] - one[:2]).T)
            found.append((one[:2], alike[np.argmin(far), :2]))
    return found


class SceneNetworks:
    """Sees the people of :func:`drawn`.

    Attributes:
        looks: how often each network ran.
    """

    def __init__(self, heatmaps: bool = False) -> None:
        self.heatmaps = heatmaps
        self.looks = {"detector": 0, "landmarks": 0}

    def detector(self, image):
        assert image.shape == (PICTURE, PICTURE, 3) and image.dtype == np.uint8
        self.looks["detector"] += 1
        raw, logits = np.zeros((len(anchors()), 12), np.float32), np.full(len(anchors()), -20, np.float32)
        for hips, circle in pairs(image):
            cell = np.floor(hips / PICTURE * GRIDS[0][0]).astype(int).clip(0, GRIDS[0][0] - 1)
            at = 2 * (cell[1] * GRIDS[0][0] + cell[0])
            points = np.array([circle, [0.2 * np.hypot(*(circle - hips))] * 2, hips, circle, circle, circle])
            points[[0, 2, 3, 4, 5]] -= anchors()[at] * PICTURE
            for twin in (at, at + 1):
                raw[twin], logits[twin] = points.ravel(), 3 - (twin - at)
        return raw, logits

    def landmarks(self, image):
        assert image.shape == (REGION, REGION, 3) and image.dtype == np.uint8
        self.looks["landmarks"] += 1
        values = np.zeros((LANDMARKS, 5), np.float32)
        heatmap = np.full((HEATMAP, HEATMAP, LANDMARKS), -20, np.float32)
        found = pairs(image)
        if not found:
            return values, 0.01, heatmap
        hips, circle = min(found, key=lambda one: np.hypot(*(one[0] - REGION / 2)))
        places = np.zeros((LANDMARKS, 2))
        places[:JOINTS], places[HIPS], places[CIRCLE] = joints_of(hips, circle), hips, circle
        values[:, :2], values[:, 3], values[:, 4] = places, 2, 3
        return values, 0.99, heatmap


def written(path: Path, frames, fps=30, stamps=None, rotation=None, codec="libx264", gop=12) -> Path:
    """A video file of RGB frames; ``stamps`` in milliseconds."""
    import av

    with av.open(str(path), "w") as container:
        options = {"preset": "ultrafast", "crf": "12", "g": str(gop)} if codec == "libx264" else {}
        stream = container.add_stream(codec, rate=fps, options=options)
        stream.height, stream.width = frames[0].shape[:2]
        stream.pix_fmt = "yuv444p" if codec == "libx264" else "yuv420p"
        if stamps is not None:
            stream.codec_context.time_base = stream.time_base = Fraction(1, 1000)
        if rotation is not None:
            stream.set_display_rotation(rotation, hflip=False)
        for i, image in enumerate(frames):
            picture = av.VideoFrame.from_ndarray(image, format="rgb24")
            if stamps is not None:
                picture.pts, picture.time_base = int(stamps[i]), Fraction(1, 1000)
            container.mux(stream.encode(picture))
        container.mux(stream.encode())
    return path

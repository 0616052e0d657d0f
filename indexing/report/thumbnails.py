"""Small stick figures as inline SVG: they take the colours of the page (light, dark, print) and weigh a kilobyte."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
from numpy.typing import NDArray

from indexing.cameras import y_up
from indexing.clip import Clip
from indexing.report.page import escape
from indexing.skeleton import known

FRAMES = 5  # key frames of a strip
AROUND = 9  # frames before and after the shown ones that say where a joint should be
FACE = {"nose", "eye", "ear", "mouth"}
WIDTH, HEIGHT = 40.0, 64.0  # of one key frame, in SVG units


def strip(clip: Clip, start: float | None = None, end: float | None = None, *, frames: int = FRAMES, alt: str = "") -> str:
    """A row of key frames of a clip, evenly spaced in time, as one inline ``<svg>``.

    Every frame is centred on the person and all share one scale, so walking does not shrink the figures and a jump stays
    visible.  3D joints are shown from the front.  Joints that were not seen, and those that a detector put in the wrong place,
    are left out with their bones.

    Args:
        clip: the recording.
        start, end: seconds, on the clip's own clock; by default the whole clip.
        frames: number of key frames.
        alt: description for those who do not see the picture.

    Returns:
        SVG markup, or ``""`` where no joint was seen in any key frame.
    """
    first = clip.times[0] if start is None else start
    last = clip.times[-1] if end is None else end
    wanted = np.linspace(first, last, frames)
    at = np.unique(np.abs(clip.times[None, :] - wanted[:, None]).argmin(axis=1))
    points = y_up(clip.replace(joints=_right(clip, at), times=clip.times[at], confidence=None))[..., :2].astype(np.float64)
    points[np.isnan(points).any(axis=2)] = np.nan
    seen = ~np.isnan(points[..., 0])
    drawn = seen.any(axis=1)
    if not drawn.any():
        return ""
    points, seen = points[drawn], seen[drawn]
    points[..., 0] -= np.array([np.median(frame[ok, 0]) for frame, ok in zip(points, seen, strict=True)])[:, None]
    seen &= ~(_stray(points[..., 0]) | _stray(points[..., 1]))  # they would shrink the person to a dot
    bounds = [(points[..., axis][seen].min(), points[..., axis][seen].max()) for axis in (0, 1)]
    extent = max((bounds[0][1] - bounds[0][0]) / (WIDTH - 6), (bounds[1][1] - bounds[1][0]) / (HEIGHT - 8))
    scale = 1.0 / extent if extent > 0 else 1.0
    middle = [sum(bound) / 2 for bound in bounds]
    places = np.empty_like(points)
    places[..., 0] = (points[..., 0] - middle[0]) * scale + WIDTH * (0.5 + np.arange(len(points))[:, None])
    places[..., 1] = (middle[1] - points[..., 1]) * scale + HEIGHT / 2  # SVG's y points down
    paths = _paths(clip, places, seen)
    width = WIDTH * len(points)
    drawing = "".join(f'<path class="{css}" d="{path}"/>' for css, path in paths.items() if path)
    return f'<svg class="strip" viewBox="0 0 {width:g} {HEIGHT:g}" role="img" aria-label="{escape(alt)}">{drawing}</svg>'


def _right(clip: Clip, at: NDArray[np.intp]) -> NDArray[Any]:
    """The joints of some frames; those that do not lie on their own path through the frames around them are NaN."""
    from indexing.repair import wrong_joints  # brings torch, which a report without figures does not need

    first, last = max(0, int(at[0]) - AROUND), min(len(clip), int(at[-1]) + AROUND + 1)
    joints = np.array(clip.joints[first:last], dtype=np.float32)
    joints[wrong_joints(joints, clip.times[first:last], np.array([0, last - first]))] = np.nan
    return joints[at - first]


def _paths(clip: Clip, places: NDArray[np.float64], seen: NDArray[np.bool_]) -> dict[str, str]:
    """SVG path data by CSS class: left limbs, right limbs, the middle, and dots for joints without bones."""
    skeleton = clip.skeleton or known(clip.joints.shape[1])
    bones = skeleton.bones if skeleton is not None else ()
    sides = [_side(name) for name in skeleton.joints] if skeleton is not None else []
    face = [_words(name) & FACE != set() for name in skeleton.joints] if skeleton is not None else []
    lines: dict[str, list[str]] = {"m": [], "r": [], "l": [], "h": [], "d": []}
    for place, ok in zip(places, seen, strict=True):
        spot = [f"{x:.1f} {y:.1f}" if good else "" for (x, y), good in zip(place, ok, strict=True)]
        if not bones:
            lines["d"] += [f"M{text}h0" for text in spot if text]
        head = _head(place, ok, face, sides)
        lines["h"].append(head)
        for a, b in bones:
            if ok[a] and ok[b] and not (head and face[a] and face[b]):
                both = {sides[a], sides[b]} - {"m"}
                side = both.pop() if len(both) == 1 else "m"
                lines[side].append(f"M{spot[a]}L{spot[b]}")
    return {css: "".join(path) for css, path in lines.items()}


def _head(place: NDArray[np.float64], ok: NDArray[np.bool_], face: list[bool], sides: list[str]) -> str:
    """A circle for the joints of the face, which as lines would look like a mask; ``""`` where they were not seen."""
    seen_face = np.array(face, dtype=bool) & ok if face else np.zeros(len(ok), dtype=bool)
    if not seen_face.any() or not {"l", "r"} <= set(sides):
        return ""
    x, y = place[seen_face].mean(axis=0)
    radius = min(max(float(np.ptp(place[seen_face], axis=0).max()) / 2, 3.6), 6.0)
    arc = f"a{radius:.1f} {radius:.1f} 0 1 0 "
    return f"M{x - radius:.1f} {y:.1f}{arc}{2 * radius:.1f} 0{arc}{-2 * radius:.1f} 0"


def _words(name: str) -> set[str]:
    """``{"left", "eye"}`` of ``left_eye``, ``LeftEye`` or ``left eye``."""
    return {word.lower() for word in re.findall(r"[A-Z]?[a-z]+|[A-Z]+(?![a-z])", name)}


def _side(name: str) -> str:
    words = _words(name)
    return "l" if words & {"left", "l"} else "r" if words & {"right", "r"} else "m"


def _stray(values: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Which coordinates lie so far from all others that they are a detector's mistake: two spreads beyond the bulk."""
    low, high = np.percentile(values[~np.isnan(values)], [10, 90])
    spread = high - low
    return (values < low - 2 * spread) | (values > high + 2 * spread) if spread > 0 else np.zeros(values.shape, dtype=bool)

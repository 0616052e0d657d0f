"""What a 2D keypoint detector would report of a 3D clip: a perspective camera, and the errors such detectors make."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from indexing.cameras import DISTANCE, rotation, y_up
from indexing.clip import Clip, FloatArray

BoolArray = NDArray[np.bool_]

FOCAL = 0.72  # focal length in image widths: the main camera of a phone
BURST = 4.0  # frames that a lost joint stays lost, on average
PAIRS = tuple((i, i + 1) for i in range(1, 17, 2))  # left and right joints of COCO-17
# Detectors place hips, wrists and ankles less exactly than the face (relative standard deviation per joint, mean square 1).
_SPREAD = np.array([0.6, 0.6, 0.6, 0.7, 0.7, 0.85, 0.85, 1.0, 1.0, 1.15, 1.15, 1.2, 1.2, 1.05, 1.05, 1.25, 1.25])
_SPREAD /= np.sqrt((_SPREAD**2).mean())


def detect(
    clip: Clip,
    *,
    azimuth: float,
    elevation: float = 0.1,
    distance: float = DISTANCE,
    rng: np.random.Generator | int = 0,
    noise: float = 0.012,
    dropout: float = 0.05,
    outliers: float = 0.01,
    image: tuple[int, int] = (1280, 720),
) -> Clip:
    """The pixels in which a keypoint detector finds the joints of a 3D clip.

    The camera is the one of :func:`indexing.cameras.virtual` (same angles, aimed at the clip's mean), without its scaling of the
    body, and with the image's axes as a photograph has them: right-handed data come out unmirrored, so a person who
    faces the camera has the anatomical left on the right of the image.

    Args:
        clip: 3D, COCO-17 joints, metres.
        azimuth: degrees; 0 looks along +z, into the face of a person at heading 0.
        elevation: radians, as for ``virtual``: positive looks up from below the hips, negative looks down.
        distance: metres from the clip's mean.
        noise: metres in the plane of the person, standard deviation of the jitter of a joint in full view: two thirds of the
            variance wander (0.2 s), the rest is white; joints hidden behind the body have up to twice as much.
        dropout: share of the joints that are lost (NaN), in bursts; the hidden ones more often.
        outliers: share of the joints that are wrong: half of them left and right exchanged, half anywhere about the body.
        image: width and height in pixels; what falls outside is lost too.

    Returns:
        a 2D clip in pixels, y down (``up="-y"``), with a confidence in [0, 1] per joint (0 where it is lost).

    Raises:
        ValueError: not 17 3D joints, none of them seen, a joint behind the camera, a share outside [0, 1), or a negative noise.

    Example:
        >>> from indexing.actors import Person, perform
        >>> seen = detect(perform("wave", Person()), azimuth=30.0)
        >>> seen.joints.shape[1:], seen.up, bool((seen.confidence <= 1).all())
        ((17, 2), '-y', True)
    """
    _check(clip, noise, dropout, outliers, distance)
    rng = np.random.default_rng(rng)
    metre = FOCAL * image[0] / distance  # pixels per metre in the plane of the person
    turned, pixels = _project(clip, azimuth, elevation, distance, image)
    hidden = _self_occlusion(turned)
    scale = (metre * noise * (1 + hidden) * _SPREAD)[..., None]
    pixels = pixels + scale * _jitter(pixels.shape, _rate(clip), rng)
    trust = 0.93 - 0.5 * hidden + 0.06 * _jitter(hidden.shape, _rate(clip), rng)
    pixels, wrong = _outliers(pixels, outliers, metre, rng)
    trust = np.where(wrong, trust - rng.uniform(0.0, 0.6, trust.shape), trust)
    lost = _missing_joints(hidden, dropout, rng) | ~((pixels >= 0) & (pixels < image)).all(axis=2)
    confidence = np.where(lost, 0.0, np.clip(trust, 0.02, 1.0))
    return clip.replace(joints=np.where(lost[..., None], np.nan, pixels), confidence=confidence, up="-y")


def _check(clip: Clip, noise: float, dropout: float, outliers: float, distance: float) -> None:
    if clip.joints.shape[1:] != (17, 3):
        raise ValueError(f"clip {clip.name!r}: the detector needs 17 COCO joints in 3D, got shape {clip.joints.shape}")
    if not clip.seen.any():
        raise ValueError(f"clip {clip.name!r}: no joint was seen in any frame; leave the clip out")
    for name, share in (("dropout", dropout), ("outliers", outliers)):
        if not 0 <= share < 1:
            raise ValueError(f"{name} is a share of the joints and must lie in [0, 1), got {share!r}")
    if not (noise >= 0 and distance > 0):
        raise ValueError(f"noise must be at least 0 and distance positive (metres), got {noise!r} and {distance!r}")


def _project(
    clip: Clip, azimuth: float, elevation: float, distance: float, image: tuple[int, int]
) -> tuple[FloatArray, FloatArray]:
    """Joints in camera axes about the clip's mean, and their pixels."""
    points = y_up(clip).astype(np.float64)
    turned = (points - np.nanmean(points, axis=(0, 1))) @ rotation(np.deg2rad(azimuth), elevation).T
    depth = turned[..., 2:] + distance
    if (depth <= 0.05).any():
        what = f"clip {clip.name!r}: a joint is {np.nanmin(depth):.2f} m in front of the camera"
        raise ValueError(f"{what}; increase distance={distance:g}")
    # Looking along +z in a right-handed frame with y up, x grows to the left: both image axes run against the scene's.
    return turned, np.array(image) / 2 - FOCAL * image[0] * turned[..., :2] / depth


def _rate(clip: Clip) -> float:
    return float(1.0 / np.median(np.diff(clip.times))) if len(clip) > 1 else 30.0


def _self_occlusion(turned: FloatArray) -> FloatArray:
    """``(frames, 17)`` in [0, 1]: how far a joint is covered by the body, from joints in camera axes (z away)."""
    hidden = np.zeros(turned.shape[:2])
    for left, right in PAIRS[2:]:  # a limb right behind its twin
        gap = turned[:, left] - turned[:, right]
        near = np.exp(-(gap[:, 0] ** 2 + gap[:, 1] ** 2) / 0.15**2)
        hidden[:, left] = near * _step(gap[:, 2], 0.04)
        hidden[:, right] = near * _step(-gap[:, 2], 0.04)
    neck, pelvis = turned[:, 5:7].mean(axis=1), turned[:, 11:13].mean(axis=1)
    spine = pelvis - neck
    long = (spine**2).sum(axis=1)
    for joint in (7, 8, 9, 10):  # an arm behind the trunk
        along = np.clip(((turned[:, joint] - neck) * spine).sum(axis=1) / long, 0.0, 1.0)
        gap = turned[:, joint] - (neck + along[:, None] * spine)
        behind = np.exp(-((gap[:, 0] / 0.16) ** 4)) * np.exp(-((gap[:, 1] / 0.25) ** 4)) * _step(gap[:, 2], 0.04)
        hidden[:, joint] = np.maximum(hidden[:, joint], behind)
    ears = turned[:, 3:5].mean(axis=1)
    for joint in range(5):  # the face from behind, the far eye and ear from the side
        gap = turned[:, joint] - ears
        hidden[:, joint] = _step(gap[:, 2] - 0.045, 0.015)
    out: FloatArray = np.nan_to_num(hidden)
    return out


def _step(value: FloatArray, width: float) -> FloatArray:
    step: FloatArray = 0.5 + 0.5 * np.tanh(value / (2 * width))
    return step


def _jitter(shape: tuple[int, ...], rate: float, rng: np.random.Generator) -> FloatArray:
    """Noise of standard deviation 1 along the first axis: two thirds of the variance keep for about 0.2 s, a third is white."""
    white = rng.normal(size=(2, *shape))
    keep = np.exp(-1.0 / (0.2 * rate))
    slow, fresh = white[0], np.sqrt(1 - keep**2)
    for frame in range(1, shape[0]):
        slow[frame] = keep * slow[frame - 1] + fresh * slow[frame]
    out: FloatArray = np.sqrt(2 / 3) * slow + np.sqrt(1 / 3) * white[1]
    return out


def _bursts(shape: tuple[int, int], chance: FloatArray | float, length: float, rng: np.random.Generator) -> BoolArray:
    """Boolean ``shape``: true with probability ``chance``, for runs of ``length`` frames on average (at least 1)."""
    lead = int(6 * length)  # bursts that began before the first frame
    starts = -np.log1p(-np.broadcast_to(chance, shape)) / length
    starts = np.concatenate([np.repeat(starts[:1], lead, axis=0), starts])
    frame, joint = np.nonzero(rng.random(starts.shape) < -np.expm1(-starts))
    ends = np.minimum(frame + rng.geometric(1.0 / length, len(frame)), len(starts))
    change = np.zeros((len(starts) + 1, shape[1]))
    np.add.at(change, (frame, joint), 1)
    np.add.at(change, (ends, joint), -1)
    return np.asarray(np.cumsum(change, axis=0)[lead:-1] > 0)


def _missing_joints(hidden: FloatArray, dropout: float, rng: np.random.Generator) -> BoolArray:
    weight = 0.4 + 2.0 * hidden
    chance = np.minimum(dropout * weight / weight.mean(), 0.5 + 0.5 * dropout)
    return _bursts((hidden.shape[0], hidden.shape[1]), chance, BURST, rng)


def _outliers(pixels: FloatArray, share: float, metre: float, rng: np.random.Generator) -> tuple[FloatArray, BoolArray]:
    """Pixels with outliers, and which joints they are; ``metre`` in pixels."""
    frames = len(pixels)
    swapped = np.zeros(pixels.shape[:2], dtype=bool)
    swapped[:, 1:] = np.repeat(_bursts((frames, len(PAIRS)), share * 17 / 32, 2.0, rng), 2, axis=1)  # the nose has no twin
    twin = [0, *(joint for left, right in PAIRS for joint in (right, left))]
    out = np.where(swapped[..., None], pixels[:, twin], pixels)
    far = _bursts((frames, pixels.shape[1]), share / 2, 1.5, rng)
    angle, reach = rng.uniform(0.0, 2 * np.pi, far.shape), metre * rng.uniform(0.2, 0.9, far.shape)
    away = np.stack([np.cos(angle), np.sin(angle)], axis=2) * reach[..., None]
    return np.where(far[..., None], out + away, out), swapped | far

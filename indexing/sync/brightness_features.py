"""What synchronization compares: the profile and the window kernels of a take, at the frames of a grid that both takes share."""

from __future__ import annotations

import tempfile
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from kornia.filters import gaussian_blur2d
from kornia.geometry.transform import warp_affine
from torch import Tensor
from torch.nn.functional import avg_pool1d, max_pool1d, normalize

from dyntorch.numerics import Message
from indexing.brightness.descriptors import as_grey, blur, gradients, weighted_differences
from indexing.brightness.videos import SHRINKING_BLOCK as FOOTAGE_BLOCK
from indexing.brightness.videos import Shrinker

# ----------------------------------------------------------------------------------------------------------------------
# The row-band profile: how much moves up, down and sideways, at which height of the box, frame by frame.


PROFILE_BLOCK = 32  # frames at once


PROFILE_BLUR = 1.5  # Pixels of the crop.
NUM_BANDS = 6  # Bands of rows, overlapping by half; 4 to 12 do the same.
PROFILE_NOISE_RATIO = 2.0  # Brightness change over the median below which it is noise (0 / 2 / 4: .78 / .88 / .82 within 1 frame).


def row_profile(crops: Tensor) -> Tensor:
    """``(T, 3 * bands)`` motion upwards, downwards and sideways in bands of rows that overlap by half, of crops ``(T, s, s)``."""
    parts = []
    for begin in range(0, len(crops), PROFILE_BLOCK):
        first, end = max(begin - 1, 0), min(begin + PROFILE_BLOCK + 1, len(crops))
        gx, gy, gt = gradients(blur(crops[first:end], PROFILE_BLUR))
        gt = gt.sign() * (gt.abs() - PROFILE_NOISE_RATIO * gt.abs().median()).clamp(min=0)
        u, v = weighted_differences(gx, gy, gt)
        parts.append(_pool_rows(u, v, NUM_BANDS)[begin - first : begin - first + PROFILE_BLOCK])
    return torch.cat(parts)


def reversed_profile(profile: Tensor) -> Tensor:
    """The profile of the same take played backwards: what moved up moves down."""
    up, down, across = profile.flip(0).chunk(3, dim=1)
    return torch.cat([down, up, across], dim=1)


def _pool_rows(u: Tensor, v: Tensor, bands: int) -> Tensor:
    rows = torch.stack([(-v).clamp(min=0).mean(-1), v.clamp(min=0).mean(-1), u.abs().mean(-1)], dim=1)  # (T, 3, s)
    step = rows.shape[-1] // (bands + 1)
    pooled = avg_pool1d(rows, 2 * step, step)[..., :bands]
    return pooled.sqrt().flatten(1).double()


WHITENING_HALF_WIDTH = 3  # Frames on either side that are whitened together (2 / 3 / 4 / 6: .89 / .90 / .90 / .90 within 1 frame).
PROFILE_RIDGE = 0.05  # Ridge of the whitening over the largest eigenvalue (.03 / .2: .91 / .87).


def whiten(first: Tensor, second: Tensor) -> tuple[Tensor, Tensor]:
    r"""Both cameras' profiles in space and time: centred, whitened by the covariance that they share, of norm 1 per frame.
    first, second ``(T, D)`` -> ``(T, (2 half_width + 1) D)``."""
    around = torch.arange(-WHITENING_HALF_WIDTH, WHITENING_HALF_WIDTH + 1)
    stacked = [z[(torch.arange(len(z))[:, None] + around).clamp(0, len(z) - 1)].flatten(1) for z in (first, second)]
    known = [y.isfinite().all(1) for y in stacked]
    centred = [y - y[seen].mean(0) for y, seen in zip(stacked, known, strict=True)]
    a, b = (y[seen] for y, seen in zip(centred, known, strict=True))
    root = inverse_root((a.T @ a / len(a) + b.T @ b / len(b)) / 2, PROFILE_RIDGE)
    one, two = (normalize((y @ root).nan_to_num(0.0), dim=1, eps=1e-9) for y in centred)
    return one, two


def inverse_root(matrix: Tensor, ridge: float) -> Tensor:
    """``(M + ridge * largest eigenvalue * I)^(-1/2)`` of a symmetric positive matrix ``(D, D)``."""
    values, vectors = torch.linalg.eigh(matrix)
    values = values.clamp(min=0) + ridge * values[-1].clamp(min=1e-30)
    return (vectors / values.sqrt()) @ vectors.T


# ----------------------------------------------------------------------------------------------------------------------
# A grey video as the direct method reads it: small 8-bit frames and their times, from an array or from chunks of any number.


@dataclass(frozen=True, eq=False)
class GrayVideo:
    """What is kept of a video."""

    frames: Tensor  # ``(T, h, w)`` uint8, the longer side at most ``largest``; of a stream, in a file that goes with the object
    times: Tensor  # ``(T,)`` float64 seconds, increasing
    scale: float  # pixels here per pixel of the video
    name: str  # for messages

    @property
    def fps(self) -> float:
        """Frames per second, by the median step."""
        return float(1 / self.times.diff().median())


MAX_IMAGE_SIDE = 320  # Longer side, pixels: a person a quarter as tall as a 1080p image keeps 45.
MIN_IMAGE_SIDE = 16  # Shorter side, pixels.


def read_gray_video(source: Any, name: str, fps: float | None = None, times: Any = None) -> GrayVideo:
    """Read a video once. source ``(frames, h, w)``, times ``(frames,)``."""
    spool = _Spool(name, MAX_IMAGE_SIDE, MIN_IMAGE_SIDE)
    if not isinstance(source, (np.ndarray, Tensor)):
        with tempfile.TemporaryFile() as file:
            stamps = [stamp for stamp in (spool.add(part, file) for part in _parts(source, name)) if stamp is not None]
            spool.check()
            file.flush()
            frames = torch.from_numpy(np.memmap(file, np.uint8, "r+", shape=(spool.count, *spool.size)))
        if stamps and times is None:
            times = np.concatenate(stamps)
    else:
        if source.ndim < 3:
            raise ValueError(f"{name}: expected grey frames (frames, h, w), got an array of shape {tuple(source.shape)}")
        small = [spool.bytes(source[begin : begin + FOOTAGE_BLOCK]) for begin in range(0, max(len(source), 1), FOOTAGE_BLOCK)]
        spool.check()
        frames = torch.cat(small)
    return GrayVideo(frames, _times(times, fps, len(frames), name), spool.scale, name)


def _parts(source: Any, name: str) -> Iterator[Any]:
    if isinstance(source, (str, bytes)) or not isinstance(source, Iterable):
        raise ValueError(
            f"{name}: expected grey frames (frames, h, w) or an iterable of chunks, got {type(source).__name__}; "
            "read a file first, for example with indexing.video.read_video(path)"
        )
    return iter(source)


MIN_FRAMES = 20  # Frames of a video.


class _Spool(Shrinker):
    """Counts, and keeps 8-bit frames."""

    def add(self, part: Any, file: Any) -> Any:
        """Write a chunk to a file; its times, where it has any."""
        stamps = None
        if isinstance(part, tuple) and len(part) == 2:
            part, stamps = part
            stamps = np.atleast_1d(torch.as_tensor(stamps, dtype=torch.float64).numpy(force=True))
        chunk = torch.as_tensor(part).cpu()
        chunk = chunk[None] if chunk.ndim == 2 else chunk
        if stamps is not None and len(stamps) != len(chunk):
            text = "{camera:{which}}: a chunk of {frames} frames has {times} times; give one per frame"
            raise ValueError(Message(text, which=self.name, frames=len(chunk), times=len(stamps)))
        for begin in range(0, len(chunk), FOOTAGE_BLOCK):
            file.write(self.bytes(chunk[begin : begin + FOOTAGE_BLOCK]).numpy().tobytes())
        return stamps

    def bytes(self, frames: Any) -> Tensor:
        """``(n, h, w)`` uint8 of a chunk."""
        return self(frames).round_().to(torch.uint8)

    def check(self) -> None:
        """Raise where there are too few frames."""
        if self.count < MIN_FRAMES:
            text = "{camera:{which}}: {frames} frames; at least {needed} are needed"
            raise ValueError(Message(text, which=self.name, frames=self.count, needed=MIN_FRAMES))


def _times(times: Any, fps: float | None, frames: int, name: str) -> Tensor:
    if times is None:
        if fps is None:
            raise ValueError(f"{name}: neither fps nor times are given; say how many frames per second the video has")
        if not (np.isfinite(fps) and fps > 0):
            raise ValueError(f"{name}: fps must be a positive number, got {fps!r}")
        return torch.arange(frames, dtype=torch.float64) / fps
    stamps = torch.as_tensor(times, dtype=torch.float64)
    if stamps.shape != (frames,):
        raise ValueError(f"{name}: times must be one per frame, ({frames},), got {tuple(stamps.shape)}")
    if not bool(stamps.isfinite().all()) or not bool((stamps.diff() > 0).all()):
        raise ValueError(f"{name}: times must be finite and increase from frame to frame; sort the frames and drop repeated ones")
    return stamps


# ----------------------------------------------------------------------------------------------------------------------
# Whether the camera moves: the flow of the image's border, where the background is.


@dataclass(frozen=True)
class Drift:
    """Motion of the background."""

    step: Tensor  # ``(T, 2)`` px per frame where it is followed, else 0
    lost: Tensor  # ``(T,)`` bool, where it cannot be

    @property
    def moves(self) -> bool:
        """Whether the camera moves."""
        return bool((self.step.norm(dim=1) > 0).double().mean() > MIN_DRIFT_FRAMES_SHARE)

    @property
    def too_fast(self) -> bool:
        """Whether it moves faster than can be followed, or the light changes."""
        return bool(self.lost.double().mean() > MIN_DRIFT_FRAMES_SHARE)

    @property
    def path(self) -> Tensor:
        """``(T, 2)`` where the background has moved to since the first frame."""
        return self.step.cumsum(0)


BORDER_SHARE = 0.12  # Share of the image on each side whose flow tells whether the camera moves.
MIN_EXPLAINED_SHARE = 0.5  # Share of the border's change that one translation must explain.
MIN_DRIFT_PIXELS = 0.05  # Per frame; below, the camera is on a tripod.
MIN_DRIFT_FRAMES_SHARE = 0.1  # Share of the frames in which it must move, or be lost, to count.
MIN_CHANGE = 0.02  # Grey 0..1 per frame: 5 standard deviations of a noise of 8 grey levels, after the blur.
MAX_UNEXPLAINED_SHARE = 0.3  # Share of the border that changes without one translation: a fast pan, a cut, flicker.


def drift(gx: Tensor, gy: Tensor, gt: Tensor) -> Drift:
    r"""Translation of the border of each frame from gradients ``(T, h, w)``, by least squares."""
    inside = torch.ones(gt.shape[1:], dtype=torch.bool, device=gt.device)
    rows, columns = (max(2, round(BORDER_SHARE * n)) for n in gt.shape[1:])
    inside[rows:-rows, columns:-columns] = False
    change = gt[:, inside].double()
    design = torch.stack([*(g[:, inside].double() for g in (gx, gy)), torch.ones_like(change)], dim=2)
    gram = design.mT @ design
    gram = gram + 1e-6 * torch.eye(3, dtype=torch.float64, device=gt.device) * gram.diagonal(dim1=1, dim2=2).amax(1)[:, None, None]
    found = torch.linalg.solve(gram, -(design.mT @ change[..., None]))
    left = change + (design @ found)[..., 0]
    step = found[:, :2, 0]
    spread = change - change.mean(1, keepdim=True)
    explained = 1 - left.square().sum(1) / spread.square().sum(1).clamp(min=1e-12)
    follows = (explained > MIN_EXPLAINED_SHARE) & (step.norm(dim=1) > MIN_DRIFT_PIXELS)
    lost = ((left.abs() > MIN_CHANGE).double().mean(1) > MAX_UNEXPLAINED_SHARE) & ~follows
    return Drift(step * follows[:, None], lost)


# ----------------------------------------------------------------------------------------------------------------------
# Where something moves: the box of a take, and the box that follows a person across the image or the image with its camera.


BOX_BLOCK = 32


Region = tuple[float, float, float, float]


@dataclass(frozen=True)
class GrayMotion:
    """Where something moves."""

    rows: Tensor  # ``(T, h)`` and ``(T, w)`` sums of the brightness change above the noise
    columns: Tensor
    changed: Tensor  # ``(T,)`` share of the pixels that change
    drift: Drift  # how the background moves

    @property
    def lively(self) -> Tensor:
        """``(T,)`` bool: frames in which something moves."""
        return self.changed > MIN_MOVING_SHARE

    @property
    def activity(self) -> Tensor:
        """``(T,)`` mean brightness change per pixel."""
        return self.rows.sum(1) / (self.rows.shape[1] * self.columns.shape[1])


MOTION_FLOOR = 0.006  # Grey 0..1 per frame below which change is noise,
MOTION_NOISE_RATIO = 6.0  # and in medians of the change: 4 standard deviations, 1 pixel in 16,000 by chance.
BOX_BLUR = 1.5  # Pixels.
MIN_MOVING_SHARE = 3e-4  # Share of the pixels that change in a frame that shows motion: 5 times what noise does.


def motion(frames: Tensor, region: Region | None = None) -> GrayMotion:
    """What moves in frames ``(T, h, w)``, in a region ``(x0, y0, x1, y1)`` of their pixels, after the background's own motion."""
    rows, columns, changed, steps, lost = [], [], [], [], []
    for begin in range(0, len(frames), BOX_BLOCK):
        first, end = max(begin - 1, 0), min(begin + BOX_BLOCK + 1, len(frames))
        gx, gy, gt = (g[begin - first :][:BOX_BLOCK] for g in gradients(blur(as_grey(frames[first:end]), BOX_BLUR)))
        camera = drift(gx, gy, gt)
        dx, dy = camera.step.float().T[..., None, None]
        change = (gt + gx * dx + gy * dy).abs()
        change = (change - max(MOTION_FLOOR, MOTION_NOISE_RATIO * float(change.median()))).clamp(min=0)
        if region is not None:
            x0, y0, x1, y1 = (round(v) for v in region)
            mask = change.new_zeros(change.shape[1:])
            mask[max(y0, 0) : max(y1, 0), max(x0, 0) : max(x1, 0)] = 1
            change = change * mask
        rows.append(change.sum(2).double())
        columns.append(change.sum(1).double())
        changed.append((change > 0).double().mean((1, 2)))
        steps.append(camera.step)
        lost.append(camera.lost)
    return GrayMotion(torch.cat(rows), torch.cat(columns), torch.cat(changed), Drift(torch.cat(steps), torch.cat(lost)))


BOX_SMOOTHING_SECONDS = 0.2  # Over which a moving box is smoothed.
MAX_BOX_RATIO = 1.6  # Box of the whole video over the moving one beyond which it moves.


def boxes(found: GrayMotion, fps: float) -> tuple[Tensor, bool]:
    """``(T, 3)`` centre x, centre y and side in pixels of the square about what moves, frame by frame, and whether it moves."""
    height = found.rows.shape[1]
    path = found.drift.path if found.drift.moves else found.rows.new_zeros(len(found.rows), 2)
    across, along = (_quantiles(_smooth(m, BOX_SMOOTHING_SECONDS * fps)) for m in (found.columns, found.rows))
    following = _square(across, along, height)
    seen = _smooth(found.lively.double()[:, None], BOX_SMOOTHING_SECONDS * fps)[:, 0] > 0
    whole = _square(
        _quantiles(found.columns.sum(0, keepdim=True)),
        _quantiles(found.rows.sum(0, keepdim=True)),
        height,
    )
    size = following[seen, 2].median() if bool(seen.any()) else whole[0, 2]
    if found.drift.moves or whole[0, 2] > MAX_BOX_RATIO * size:
        following[~seen] = whole
        centre = _smooth(following[:, :2] - path, BOX_SMOOTHING_SECONDS * fps) + path
        return torch.cat([centre, size.expand(len(centre), 1)], dim=1), True
    return whole.expand(len(path), 3), False


BOX_QUANTILES = (0.02, 0.98)  # Quantiles of the motion that a box encloses.


def _quantiles(marginals: Tensor) -> Tensor:
    """``(T, 2)`` positions between which ``BOX_QUANTILES`` of the sums of ``(T, n)`` lie."""
    total = marginals.cumsum(1)
    share = total / total[:, -1:].clamp(min=1e-12)
    return torch.stack([(share < q).sum(1).double() + end for q, end in zip(BOX_QUANTILES, (0.0, 1.0), strict=True)], dim=1)


BOX_PAD = 0.15  # Share of the box, added on each side.
MIN_BOX_SIDE = 0.35  # Share of the image's height.


def _square(across: Tensor, along: Tensor, height: int) -> Tensor:
    size = torch.maximum(across[:, 1] - across[:, 0], along[:, 1] - along[:, 0]) * (1 + 2 * BOX_PAD)
    return torch.stack([across.mean(1), along.mean(1), size.clamp(min=MIN_BOX_SIDE * height)], dim=1)


def _smooth(values: Tensor, sigma: float) -> Tensor:
    """Gaussian mean over time of ``(T, n)``, renormalized at the ends."""
    size = 2 * max(1, int(3 * sigma)) + 1
    total, weight = (
        gaussian_blur2d(x[None, None], (size, 1), (sigma, 1.0), "constant")[0, 0] for x in (values, torch.ones_like(values))
    )
    return total / weight


def crop(frames: Tensor, where: Tensor, side: int) -> Tensor:
    """``(n, side, side)`` float32 crops of frames ``(n, h, w)`` in boxes ``(n, 3)``; the border is repeated outside the image."""
    x, y, size = where.float().T
    scale = side / size
    to_crop = torch.zeros(len(where), 2, 3, device=where.device)
    to_crop[:, 0, 0] = to_crop[:, 1, 1] = scale
    to_crop[:, :, 2] = (side - 1) / 2 - scale[:, None] * torch.stack([x - 0.5, y - 0.5], dim=1)
    return warp_affine(as_grey(frames)[:, None], to_crop, (side, side), padding_mode="border", align_corners=True)[:, 0]


# ----------------------------------------------------------------------------------------------------------------------
# The thesis's window kernel in rank-free form: how the patches of a short window move, whatever they look like.
#
# Patch :math:`k` of a reference frame :math:`\tau` has the brightness differences
#
# .. math:: h_k(t) = \sum_{patch_k} (I_x, I_y)(\tau)\,(B(t) - B(\tau)) = -G_k\,(u, v)_k(t) + \dots,\qquad |t - \tau| \le w
#
# with :math:`G_k` the patch's own constant 2x2 matrix of gradients.  So the rows of :math:`H_\tau` (2 patches x L, L = 2w + 1)
# lie in
# the space of the motions' rows, which two cameras share: :math:`K_\tau = J H^T H J / tr` (:math:`J` centres) compares those
# spaces
# with no rank to choose.


KERNEL_BLOCK = 4  # reference frames at once


KERNEL_BLUR = 2.0  # Pixels of the crop: motion within a window must be small against it.
KERNEL_HALF_FRAMES = 10  # Frames on either side of the reference.
PATCH_SIDE = 10  # Pixels of the crop.
NUM_KERNEL_ROWS = 80  # Rows of most energy.
GRADIENT_DAMPING = 0.05  # Share of the largest gradient energy of a frame that is added to that of each patch.


def window_kernels(crops: Tensor, half: int = KERNEL_HALF_FRAMES, patch: int = PATCH_SIDE, rows: int = NUM_KERNEL_ROWS) -> Tensor:
    """``(T - 2 half, L, L)`` float64 of crops ``(T, s, s)``, trace 1 (0 if nothing moves); the first is frame ``half``."""
    frames = blur(crops, KERNEL_BLUR)
    gx, gy, _ = gradients(frames)
    gx[:, :, [0, -1]], gy[:, [0, -1]] = 0.0, 0.0  # with a neighbour on one side only, a difference is not central
    cells, slope = _patches(frames, patch), torch.stack([_patches(gx, patch), _patches(gy, patch)], dim=2)
    length = 2 * half + 1
    out = frames.new_zeros(max(len(frames) - 2 * half, 0), length, length, dtype=torch.float64)
    for begin in range(0, len(out), KERNEL_BLOCK):
        count = min(KERNEL_BLOCK, len(out) - begin)
        windows = cells[begin : begin + count + 2 * half].unfold(0, length, 1)  # (count, patches, px, L)
        steep = slope[begin + half : begin + half + count]  # (count, patches, 2, px)
        h = steep @ windows
        h = h - h[..., half : half + 1]
        energy = steep.square().sum(-1, keepdim=True)
        h = h / (energy + GRADIENT_DAMPING * energy.amax((1, 2, 3), keepdim=True)).clamp(min=1e-12).sqrt()
        out[begin : begin + count] = _kernel(h.flatten(1, 2).double(), rows)
    return out


def _patches(frames: Tensor, patch: int) -> Tensor:
    """``(T, patches, patch * patch)``; what does not fill a patch at the right and lower border is left out."""
    tiles = frames.unfold(1, patch, patch).unfold(2, patch, patch)
    return tiles.flatten(3).flatten(1, 2)


def _kernel(h: Tensor, rows: int) -> Tensor:
    """Kernels ``(n, L, L)`` of the strongest rows of ``(n, rows, L)``."""
    energy = h.square().sum(-1)
    best = energy.topk(min(rows, h.shape[1]), dim=1).indices
    h = h.gather(1, best[..., None].expand(-1, -1, h.shape[-1]))
    h = h - h.mean(-1, keepdim=True)
    kernel = h.mT @ h
    trace = kernel.diagonal(dim1=1, dim2=2).sum(1)
    return kernel / trace.clamp(min=1e-12)[:, None, None]


KERNEL_RIDGE = 0.02  # Ridge of the whitening of kernels over the largest eigenvalue.


def kernel_descriptors(first: Tensor, second: Tensor) -> tuple[Tensor, Tensor]:
    """Both cameras' kernels ``(n, L, L)`` as unit vectors ``(n, L * L)``: whitened by the mean kernel, the mean removed."""
    kernels = torch.cat([first, second])
    known = kernels.isfinite().all(-1).all(-1)
    if not bool(known.any()):
        return torch.zeros_like(first).flatten(1), torch.zeros_like(second).flatten(1)
    root = inverse_root(kernels[known].mean(0), KERNEL_RIDGE)
    white = root @ kernels @ root
    flat = (white - white[known].mean(0)).flatten(1).nan_to_num(0.0)
    flat = normalize(flat, dim=1, eps=1e-9)
    return flat[: len(first)], flat[len(first) :]


BLOCK = 64  # grid frames at once


@dataclass(frozen=True)
class Sampled:
    """A take on the grid: ``profile (T, D)``, ``kernels (T - 2 half, L, L)`` (the first at frame ``half``); NaN in gaps."""

    profile: Tensor
    kernels: Tensor
    start: float  # seconds, of the first frame of the grid
    rate: float  # frames of the grid per second

    def backwards(self) -> Sampled:
        """The same take played backwards."""
        return Sampled(reversed_profile(self.profile), self.kernels.flip(0, 1, 2), self.start, self.rate)


MAX_FPS = 45.0  # Faster videos are compared at a half, a third ... of their rate; windows were chosen at 30.


def common_rate(first: GrayVideo, second: GrayVideo) -> float:
    """The rate of the slower video, or a whole fraction of it."""
    rate = min(first.fps, second.fps)
    return rate / -(-rate // MAX_FPS)


def sample(source: GrayVideo, where: Tensor, rate: float) -> Sampled:
    """Profile and kernels of a take in boxes ``(T, 3)`` of its frames, block by block."""
    start = float(source.times[0])
    count = int((float(source.times[-1]) - start) * rate + 1e-6) + 1
    profiles, kernels = [], []
    for begin in range(0, count, BLOCK):
        first, end = max(begin - KERNEL_HALF_FRAMES, 0), min(begin + BLOCK + KERNEL_HALF_FRAMES, count)
        crops, known = _crops(source, where, start + torch.arange(first, end, dtype=torch.float64) / rate)
        part = row_profile(crops)
        part[~_all_known_within(known, 1)] = torch.nan
        profiles.append(part[begin - first :][: min(BLOCK, count - begin)])
        found = window_kernels(crops).float()
        found[~_all_known_within(known, KERNEL_HALF_FRAMES)[KERNEL_HALF_FRAMES : KERNEL_HALF_FRAMES + len(found)]] = torch.nan
        kernels.append(found)
    return Sampled(torch.cat(profiles), torch.cat(kernels), start, rate)


MAX_GAP_FRAMES = 2.5  # Over longer gaps nothing is interpolated.
CROP_SIDE = 96  # Pixels.


def _crops(source: GrayVideo, where: Tensor, times: Tensor) -> tuple[Tensor, Tensor]:
    """Crops at any times, blended from the frames before and after, and whether these are near enough."""
    stamps = source.times
    after = torch.searchsorted(stamps, times - 1e-9).clamp(1, len(stamps) - 1)
    before = after - 1
    span = stamps[after] - stamps[before]
    share = ((times - stamps[before]) / span).clamp(0, 1)
    share = torch.where(share < 1e-3, 0.0, torch.where(share > 1 - 1e-3, 1.0, share))
    box = torch.lerp(where[before], where[after], share[:, None])
    low, high = int(before[0]), int(after[-1]) + 1
    frames = source.frames[low:high]
    out = crop(frames[torch.where(share < 1, before, after) - low], box, CROP_SIDE)
    mixed = ((share > 0) & (share < 1)).nonzero()[:, 0]
    if len(mixed):
        out[mixed] = torch.lerp(
            out[mixed], crop(frames[after[mixed] - low], box[mixed], CROP_SIDE), share[mixed].float()[:, None, None]
        )
    known = (span <= MAX_GAP_FRAMES / source.fps) | (share == 0) | (share == 1)
    return out, known


def _all_known_within(known: Tensor, reach: int) -> Tensor:
    """``(T,)`` bool: whether all frames within ``reach`` are known."""
    lost = max_pool1d((~known).float()[None], 2 * reach + 1, 1, reach)[0]
    return lost == 0

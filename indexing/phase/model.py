"""Single frames of clips, what is learned of all actions, and the evidence that one frame gives for each of them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from dyntorch import Fourier, Polynomial
from dyntorch.numerics import orthonormal_basis
from indexing import scoring
from indexing.action.bank import EPSILON, Windows, compare_windows, stack
from indexing.action.kernels import cosine_distance
from indexing.cameras import virtual, y_up
from indexing.clip import Clip
from indexing.modelfile import part, store
from indexing.windows import concatenate_clips

NUM_TURNS = 8  # views of a clip in 3D
ELEVATIONS = (0.05, 0.3)  # radians, of their cameras, in turn

MIN_FRAME_JOINTS = 6  # joints: an affine camera takes any four anywhere, so five leave two numbers to judge by


@dataclass(frozen=True)
class TrainingFrames:
    """Training frames end to end: the frames, and for each its clip ``(F,)`` and its time in seconds ``(F,)``."""

    frames: Windows
    clip: Tensor
    times: Tensor

    def to(self, device: torch.device | str) -> TrainingFrames:
        """The same on another device."""
        return TrainingFrames(self.frames.to(device), self.clip.to(device), self.times.to(device))


def training_frames(clips: Sequence[Clip]) -> TrainingFrames:
    """All frames of images, missing joints interpolated in time (a joint that a clip never shows is not seen)."""
    source = concatenate_clips(clips)
    clip = torch.from_numpy(np.repeat(np.arange(len(clips)), np.diff(source.starts)))
    frames = Windows(torch.from_numpy(source.joints).double()[:, None], torch.from_numpy(source.seen)[clip])
    return TrainingFrames(frames, clip, torch.from_numpy(source.times))


def query_frames(clip: Clip) -> Windows:
    """The frames of an image with the joints that each of them shows."""
    joints = torch.from_numpy(np.nan_to_num(y_up(clip).astype(np.float64)))[:, None]
    return Windows(joints, torch.from_numpy(clip.seen))


def images(clip: Clip) -> list[Clip]:
    """An image itself; of 3D joints, views from all around."""
    if clip.dims == 2:
        return [clip]
    return [virtual(clip, 360 / NUM_TURNS * i, ELEVATIONS[i % len(ELEVATIONS)]) for i in range(NUM_TURNS)]


def normalize_frames(x: Tensor, seen: Tensor) -> Tensor:
    """Frames ``(F, n, 2)`` about the middle of the joints seen ``(F, n)``, Frobenius norm 1; zero where nothing is seen."""
    weight = seen[..., None].to(x)
    x = (x - (x * weight).sum(1, keepdim=True) / weight.sum(1, keepdim=True).clamp(min=1.0)) * weight
    return x / x.flatten(1).norm(dim=1).clamp(min=1e-300)[:, None, None]


def image_distance(query: Windows, bank: Windows) -> Tensor:
    """``(Q, E)`` 1 - cosine between frames, each about its middle: place and size in the image are free, the viewpoint is not."""

    def compare(a: Tensor, b: Tensor, _: Tensor | slice) -> Tensor:
        return cosine_distance(centre(a).flatten(1), centre(b).flatten(1))

    return compare_windows(query, bank, compare, worst=1.0)


def shape_distance(query: Windows, shapes: Windows) -> Tensor:
    r""":math:`\|(I - \Pi_g)\bar x\|^2`: the part of each frame ``(Q, shapes)`` that no affine image of a shape explains."""

    def residual(x: Tensor, basis: Tensor) -> Tensor:
        inner = x.mT.flatten(0, 1) @ basis.permute(1, 0, 2).flatten(1)
        return (1 - inner.square().reshape(len(x), 2, len(basis), 3).sum((1, 3))).clamp(0, 1)

    return _compare_shapes(query, shapes, MIN_FRAME_JOINTS, residual)


def _compare_shapes(query: Windows, shapes: Windows, min_joints: int, residual: Callable[[Tensor, Tensor], Tensor]) -> Tensor:
    """What is left of frames of norm 1, given the basis of each shape; all of it where too few joints are seen."""

    def compare(a: Tensor, b: Tensor, _: Tensor | slice) -> Tensor:
        if a.shape[2] < min_joints:
            return a.new_ones(len(a), len(b))
        x = centre(a)[:, 0]
        return residual(x / x.flatten(1).norm(dim=1).clamp(min=1e-300)[:, None, None], orthonormal_basis(centre(b)[:, 0]))

    return compare_windows(query, shapes, compare, worst=1.0)


def centre(x: Tensor) -> Tensor:
    return x - x.mean(-2, keepdim=True)


# ----------------------------------------------------------------------------------------------------------------------
# Frames of people near a camera: what perspective does to an affine image of their shape, to first order.
#
# A camera sees joint i at :math:`x_i = (A^T X_i + b) / (1 + m^T X_i)`; :math:`m^T X_i` is how much further than the middle of the
# body the joint is, in parts of the distance.  With the affine image :math:`\hat x` that explains most, the rest is
#
# .. math:: x - \hat x \approx -\Pi^\perp\, \hat x_i\,(m^T X_i), \qquad \min_m |x - \hat x + \Pi^\perp G m|^2 + \kappa |m|^2,
#
# three numbers for a frame.  :math:`\kappa` is the variance of what a frame leaves anyway, over that of relative depths: where
# people are far, m stays at 0 and the image affine.


LEAN_BLOCK = 200_000  # frames times shapes at once: bounds memory


def leaning(x: Tensor, basis: Tensor, kappa: float) -> Tensor:
    r"""What images of shapes by leaning cameras leave of frames, ``(Q, E)``, with what the prior adds."""
    n, count = x.shape[1], len(basis)
    pairs = (basis[..., :, None] * basis[..., None, :]).flatten(-2)  # (E, n, 9)
    third = (basis.mT @ pairs).unflatten(-1, (3, 3))  # (E, 3, 3, 3) of U_a U_b U_c
    fourth = (pairs.mT @ pairs).unflatten(-1, (3, 3)).unflatten(1, (3, 3))
    bent = n * (fourth - torch.einsum("eabj,eack->ebcjk", third, third)).flatten(3).flatten(1, 2)
    flat = x.mT.flatten(0, 1)  # (2 Q, n)
    inner = (flat @ basis.permute(1, 0, 2).flatten(1)).unflatten(0, (-1, 2)).unflatten(-1, (count, 3)).transpose(1, 2)
    seen = (flat @ pairs.permute(1, 0, 2).flatten(1)).unflatten(0, (-1, 2)).unflatten(-1, (count, 3, 3)).transpose(1, 2)
    square = inner.mT @ inner  # (Q, E, 3, 3): c c^T
    own = square.flatten(-2)
    gram = ((own.transpose(0, 1) @ bent).transpose(0, 1) - own).unflatten(-1, (3, 3))
    known = (own.transpose(0, 1) @ third.flatten(2).unflatten(-1, (3, 3)).flatten(1, 2)).transpose(0, 1)
    right = n**0.5 * ((inner[..., None, :] @ seen)[..., 0, :].sum(-2) - known)
    left = 1 - square.diagonal(dim1=-2, dim2=-1).sum(-1)
    return (left - _energy(gram, right, kappa)).clamp(min=0.0)


def _energy(gram: Tensor, right: Tensor, kappa: float) -> Tensor:
    r""":math:`r^T (G + \kappa)^{-1} r` of symmetric 3 x 3 matrices, by elimination: millions of them at once."""
    a, b, c = (gram[..., i, i] + kappa for i in range(3))
    d, e, f = gram[..., 0, 1], gram[..., 0, 2], gram[..., 1, 2]
    x, y, z = right.unbind(-1)
    b, c, f = b - d * d / a, c - e * e / a, f - d * e / a
    y, z = y - d * x / a, z - e * x / a
    energy = x * x / a + y * y / b
    c, z = c - f * f / b, z - f * y / b
    return energy + z * z / c


def perspective_distance(query: Windows, shapes: Windows, kappa: float) -> Tensor:
    """As :func:`shape_distance`, ``(Q, shapes)``, by cameras that may lean."""

    def residual(x: Tensor, basis: Tensor) -> Tensor:
        step = max(1, LEAN_BLOCK // max(1, len(basis)))
        return torch.cat([leaning(part, basis, kappa) for part in x.split(step)]).clamp(0, 1)

    return _compare_shapes(query, shapes, MIN_FRAME_JOINTS + 1, residual)


RIDGE = 1e-4  # of the mean diagonal; 1e-5 is as good, 1e-3 costs .5 and 1e-2 4 degrees
NUM_ROUNDS = 30  # alternations from the mean shape
NUM_STYLE_ROUNDS = 8  # alternations after every change of styles
STYLES = (-0.7, 0.0, 0.7)  # of people; five from -1 to 1 give the same
NUM_STYLE_CHANGES = 5
INITIAL_SWING = 0.3  # share by which styles start as more and less motion
MIN_STYLED_CLIPS = 4  # fewer do not tell styles apart
NUM_RIVALS = 5  # frames of other actions that an action is held against: 1 costs .004 of the AUC
PHASE_REACH = 4  # steps of the grid, .04 of the course: frames this near in phase stand for a phase; 8 cost .3 degrees
SHAPE_WEIGHT = 0.5  # beside the nearest images: 0 / .5 / 1 give .867 / .957 / .946 AUC from one view per take
LEAN_VARIANCE = 0.1  # of perspective cameras: what a frame of norm 1 leaves anyway, over the joints' relative depths
MAX_ASKED_SECONDS = 120  # spread over all clips: bounds the time of calibration
FRAMES_PER_SECOND = 8  # asked of each
MIN_CALIBRATED_CLASSES = 3  # among two, leaving one out leaves nothing to be nearer to
# at which a wrong action may reach an event's peak; .05 / .3: recall .58 / .78 at 0 / 15 % false finds of 13 actions
FALSE_ALARM_RATE = 0.1
EXTENT_RATE = 1.7  # times that rate for the level that an event's ends reach
MIN_LEVELS = (0.3, 0.0)  # of an event's peak and ends; at 0 a frame is as near to other actions


@dataclass(frozen=True)
class PhaseOptions:
    """What :class:`indexing.PhaseIndexer` learns from, and what it costs."""

    min_period: float = 0.3
    """Seconds that a cycle lasts at least."""
    max_period: float = 4.0
    """Seconds that a cycle lasts at most."""
    num_phases: int = 96
    """Phases that a frame is compared at: 3.75 degrees apart; 192 takes twice the time and changes the error by .1 degree."""
    max_training_frames: int = 1500
    """Frames that an action's course is learned from: 600 costs .9 degrees of phase."""
    max_kept_frames: int = 1000
    """Frames of an action that others are compared with: memory and time of every question."""
    event_seconds: float = 1.0
    """Seconds of a recording that scores are averaged over before events are cut from them."""


# ----------------------------------------------------------------------------------------------------------------------
# How the shape of the joints goes through an action, learned from single frames: :math:`X(\phi) = \sum_b c_b(\phi) X_b`.
#
# Maximum likelihood (:func:`dyntorch.shapes.fit_shapes`) has the least residual on the frames learned from, but not on other
# takes: 15 to 30 views are few, and people differ.  A ridge and a coordinate of style per clip take its phase error from 13.8 to
# 11.1 degrees (CMU walking, four views per take, other takes), 18 functions by maximum likelihood to 50.


@dataclass(frozen=True)
class Course:
    """The shapes of an action."""

    shapes: Tensor = field(metadata=store("real", None, "basis", "joints", 3))
    periodic: bool
    seen: Tensor = field(metadata=store("truth", "joints"))

    def bank(self, grid: int) -> Windows:
        """The shapes of all styles at all phases of the grid, style by style."""
        rows = basis_of(self.periodic, self.shapes.shape[1]).rows(_argument(phases(grid, self.periodic), self.periodic))
        values = torch.cat([_at(rows.to(self.shapes), shapes) for shapes in self.shapes])
        return Windows(values[:, None], self.seen.expand(len(values), -1))

    def curve(self, query: Windows, grid: int) -> Tensor:
        """``(Q, grid)`` what is left of every frame at every phase, in the style that leaves least."""
        return curves(query, [self], grid)[0]


def curves(query: Windows, courses: Sequence[Course], grid: int, lean: float | None = None) -> list[Tensor]:
    """:meth:`Course.curve` of several courses in one pass; ``lean``: by perspective cameras, see :func:`perspective_distance`."""
    bank = stack([course.bank(grid) for course in courses])
    left = shape_distance(query, bank) if lean is None else perspective_distance(query, bank, lean)
    parts = left.split([grid * len(course.shapes) for course in courses], 1)
    return [part.unflatten(1, (-1, grid)).amin(1) for part in parts]


def basis_of(periodic: bool, size: int) -> Fourier | Polynomial:
    """The basis with so many functions."""
    return Fourier((size - 1) // 2, 1.0) if periodic else Polynomial(size - 1)


def phases(grid: int, periodic: bool) -> Tensor:
    """``(grid,)`` in [0, 1) of a cycle, in [0, 1] of a course."""
    return torch.arange(grid, dtype=torch.float64) / grid if periodic else torch.linspace(0, 1, grid, dtype=torch.float64)


def _argument(phase: Tensor, periodic: bool) -> Tensor:
    return phase if periodic else 2 * phase - 1


def learn_course(x: Tensor, seen: Tensor, phase: Tensor, clip: Tensor, *, harmonics: int, periodic: bool) -> Course:
    r"""Alternate between cameras and shapes, each a linear problem; then give every clip a style a and repeat. x ``(F, n, 2)``."""
    rows = basis_of(periodic, 2 * harmonics + 1).rows(_argument(phase, periodic))
    _, owner, counts = clip.unique(return_inverse=True, return_counts=True)
    weight = seen.to(x) * (len(x) / (len(counts) * counts[owner].to(x)))[:, None]
    x = normalize_frames(x, seen)
    # the first guess stands still
    flat = x.permute(1, 0, 2).flatten(1)
    start = x.new_zeros(rows.shape[1], x.shape[1], 3)
    start[0] = torch.linalg.eigh(flat @ flat.mT)[1][:, -3:].flip(1)
    noise = torch.randn(start[1:].shape, generator=torch.Generator().manual_seed(0), dtype=x.dtype)
    start[1:] = 0.1 * noise.to(x.device) / rows.shape[1]
    shapes = _alternate(x, weight, rows, start, NUM_ROUNDS)
    known = seen.any(0)
    if len(counts) < MIN_STYLED_CLIPS:
        return Course(shapes[None], periodic, known)
    swing = INITIAL_SWING * shapes
    swing[0] = 0
    both = torch.cat([shapes, swing])
    levels = x.new_tensor(STYLES)
    for _ in range(NUM_STYLE_CHANGES):
        left = torch.stack([_residuals(x, weight, rows, _apply_style(both, level)) for level in levels])
        style = levels[x.new_zeros(len(levels), len(counts)).index_add_(1, owner, left).argmin(0)]
        style = style - style.mean()
        style = max(STYLES) * style / style.std(correction=0).clamp(min=1e-9)
        both = _alternate(x, weight, torch.cat([rows, style[owner, None] * rows], 1), both, NUM_STYLE_ROUNDS)
    return Course(torch.stack([_apply_style(both, level) for level in levels]), periodic, known)


def _apply_style(both: Tensor, level: Tensor) -> Tensor:
    plain, change = both.chunk(2)
    return plain + level * change


def _cameras(x: Tensor, weight: Tensor, at: Tensor) -> Tensor:
    """Affine cameras ``(F, 4, 2)``, the last row the translation."""
    wide = torch.cat([at, torch.ones_like(at[..., :1])], -1)
    heavy = (wide * weight[..., None]).mT
    gram = heavy @ wide
    size = gram.diagonal(dim1=1, dim2=2).sum(-1).clamp(min=1e-12)[:, None, None]
    ridge = 1e-9 * size * torch.eye(4, dtype=x.dtype, device=x.device)
    return torch.linalg.solve(gram + ridge, heavy @ x)


def _residuals(x: Tensor, weight: Tensor, rows: Tensor, shapes: Tensor) -> Tensor:
    """``(F,)`` weighted squared residual of every frame."""
    at = _at(rows, shapes)
    cameras = _cameras(x, weight, at)
    return ((x - at @ cameras[:, :3] - cameras[:, 3:]).square() * weight[..., None]).sum((1, 2))


def _alternate(x: Tensor, weight: Tensor, rows: Tensor, shapes: Tensor, rounds: int) -> Tensor:
    frames, n = weight.shape
    eye = torch.eye(3 * rows.shape[1], dtype=x.dtype, device=x.device)
    for _ in range(rounds):
        cameras = _cameras(x, weight, _at(rows, shapes))
        design = (rows[:, None, :, None] * cameras[:, :3].mT[:, :, None]).flatten(2)  # (F, 2, 3 B)
        gram = (weight.mT @ (design.mT @ design).flatten(1)).unflatten(1, eye.shape)
        right = ((x - cameras[:, 3:]) * weight[..., None]).permute(1, 0, 2).flatten(1) @ design.flatten(0, 1)
        gram = gram + RIDGE * gram.diagonal(dim1=1, dim2=2).mean(-1).clamp(min=1e-12)[:, None, None] * eye
        shapes = torch.linalg.solve(gram, right).reshape(n, -1, 3).transpose(0, 1)
        # the affine frame is free: unit covariance keeps the ridge meaningful
        at = _at(rows, shapes)
        at = (at - at.mean(1, keepdim=True)).flatten(0, 1)
        spread = at.mT @ at / frames
        factor = torch.linalg.cholesky_ex(spread + 1e-9 * spread.trace() * torch.eye(3).to(spread))[0]
        shapes = torch.linalg.solve_triangular(factor, shapes.mT, upper=False).mT
    return shapes


def _at(rows: Tensor, shapes: Tensor) -> Tensor:
    """``(F, n, 3)`` the shape of every frame."""
    return (rows @ shapes.flatten(1)).unflatten(1, shapes.shape[1:])


PAIR_BLOCK = 4_000_000  # of frames compared at once: bounds memory whatever the length of a recording


@dataclass(frozen=True)
class PhaseModel:
    """Training frames of all classes and the courses of their shapes."""

    bank: Windows = field(metadata=part(rows="frames", length=1))
    label: Tensor = field(metadata=store("every", "frames", below="classes"))
    phase: Tensor = field(metadata=store("real", "frames", least=0, most=1))
    courses: tuple[Course, ...]
    wrong: Tensor = field(metadata=store("real", None))
    options: PhaseOptions
    camera: str

    def to(self, device: torch.device | str) -> PhaseModel:
        """The same on another device."""
        courses = tuple(Course(c.shapes.to(device), c.periodic, c.seen.to(device)) for c in self.courses)
        moved = {name: getattr(self, name).to(device) for name in ("bank", "label", "phase", "wrong")}
        return replace(self, courses=courses, **moved)

    def without(self, c: int) -> PhaseModel:
        """As if a class had never been learned."""
        kept = self.label != c
        label = self.label[kept]
        return replace(
            self,
            bank=self.bank[kept],
            label=label - (label > c).long(),
            phase=self.phase[kept],
            courses=(*self.courses[:c], *self.courses[c + 1 :]),
        )

    def evidence(self, query: Windows) -> tuple[Tensor, Tensor]:
        r"""Score and phase of every frame for every class, ``(Q, classes)`` each."""
        step = max(1, PAIR_BLOCK // max(1, len(self.bank)))
        parts = [self._evidence(query[at : at + step]) for at in range(0, len(query), step)]
        return torch.cat([scores for scores, _ in parts]), torch.cat([phase for _, phase in parts])

    def _evidence(self, query: Windows) -> tuple[Tensor, Tensor]:
        distance = image_distance(query, self.bank)
        scores, found = [], []
        lean = LEAN_VARIANCE if self.camera == "projective" else None
        every = curves(query, self.courses, self.options.num_phases, lean)
        for c, (course, shapes) in enumerate(zip(self.courses, every, strict=True)):
            mine = self.label == c
            images = _by_phase(distance[:, mine], self.phase[mine], course.periodic, self.options.num_phases)
            curve = SHAPE_WEIGHT * _log(shapes) + (1 - SHAPE_WEIGHT) * _log(images)
            best, phase = _lowest(curve, course.periodic)
            others = distance[:, ~mine]
            rival = _log(others.topk(min(NUM_RIVALS, others.shape[1]), largest=False).values.mean(1)) if others.shape[1] else 0.0
            scores.append(rival - best)
            found.append(phase)
        told = (query.seen.sum(1) >= MIN_FRAME_JOINTS)[:, None]
        return torch.where(told, torch.stack(scores, 1), 0.0), torch.where(told, torch.stack(found, 1), torch.nan)


def _log(residual: Tensor) -> Tensor:
    return (residual + EPSILON).log()


def _by_phase(distance: Tensor, phase: Tensor, periodic: bool, grid: int) -> Tensor:
    """``(Q, grid)`` distance from the nearest frame within some steps of every phase, 1 where there is none."""
    at = (phase * (grid if periodic else grid - 1)).round().long().remainder(grid)
    nearest = distance.new_ones(len(distance), grid).scatter_reduce(1, at.expand(distance.shape), distance, "amin")
    sides = nearest[:, -PHASE_REACH:], nearest[:, :PHASE_REACH]
    if not periodic:
        sides = torch.ones_like(sides[0]), torch.ones_like(sides[1])
    return torch.cat([sides[0], nearest, sides[1]], 1).unfold(1, 2 * PHASE_REACH + 1, 1).amin(2)


def _lowest(curve: Tensor, periodic: bool) -> tuple[Tensor, Tensor]:
    """Least value ``(Q,)`` and its phase, between grid points by a parabola."""
    value, at = curve.min(1)
    last = curve.shape[1] - 1
    sides = [(at + step).remainder(last + 1) if periodic else (at + step).clamp(0, last) for step in (-1, 1)]
    before, after = (curve.gather(1, side[:, None])[:, 0] for side in sides)
    bend = before + after - 2 * value
    shift = torch.where(bend > 1e-12, (before - after) / (2 * bend.clamp(min=1e-12)), 0.0).clamp(-0.5, 0.5)
    if not periodic:
        return value, ((at + torch.where((at > 0) & (at < last), shift, 0.0)) / last).clamp(0, 1)
    phase = ((at + shift) / (last + 1)).remainder(1.0)
    return value, torch.where(phase < 1.0, phase, 0.0)


# ----------------------------------------------------------------------------------------------------------------------
# What seconds of an action find in the other actions, as if their own had never been learned: levels to refuse and to find by.


Array = NDArray[Any]


def wrong_scores(model: PhaseModel, learned: TrainingFrames, label: Tensor) -> Tensor:
    """``(seconds,)`` the best mean score of training seconds in a model that their class was left out of."""
    if len(model.courses) < MIN_CALIBRATED_CLASSES:
        return torch.zeros(0, dtype=torch.float64)
    whole = (learned.times / model.options.event_seconds).floor().long()
    cuts = (learned.clip.diff() != 0) | (whole.diff() != 0)
    piece = torch.cat([cuts.new_zeros(1), cuts]).cumsum(0)
    found = []
    for c in range(len(model.courses)):
        mine = piece[label[learned.clip] == c].unique()
        asked = [
            _spread((piece == one).nonzero()[:, 0], FRAMES_PER_SECOND)
            for one in _spread(mine, max(1, MAX_ASKED_SECONDS // len(model.courses)))
        ]
        scores = model.without(c).evidence(learned.frames[torch.cat(asked)])[0]
        found += [part.mean(0).max() for part in scores.split([len(one) for one in asked])]
    return torch.stack(found)


def _spread(values: Tensor, most: int) -> Tensor:
    """At most so many, spread evenly."""
    return values[torch.linspace(0, len(values) - 1, min(most, len(values))).round().long()]


def event_levels(wrong: Tensor, rate: float | None) -> tuple[float, float]:
    """Scores that an event needs somewhere and throughout, for a rate of wrong actions that may reach them."""
    return scoring.event_levels(wrong.cpu().numpy(), FALSE_ALARM_RATE if rate is None else rate, EXTENT_RATE, MIN_LEVELS)

"""What translating_planes() is given, checked once: matrices and matches in float64 with one flat batch, missing ones zero."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import prod

import torch
from torch import Tensor
from torch.nn.functional import pad

from dyntorch.geometry.homogeneous import apply, unit
from dyntorch.tasks.planes.closed_forms import finite_matrices
from dyntorch.tasks.planes.problem import LEAST, frames_of_calibration, frames_of_matches, frames_of_matrices

Points = Tensor | Sequence[Tensor]
Pair = tuple[Tensor, Tensor]

PLANE_MATCHES, BODY_MATCHES = 4, 7
"""Matches that determine a homography, and a fundamental matrix."""


MIN_SINGULAR_RATIO = 1e-8  # of a homography in coordinates of order 1, below which it maps its plane to a line


@dataclass(frozen=True)
class GivenPlanes:
    """All that is given, in normalized coordinates, with one flat batch."""

    homographies: Tensor  # ``(b, p, 3, 3)`` of norm 1, zero where one is missing
    fundamentals: Tensor  # ``(b, m, 3, 3)``
    planes: PlaneSightings  # matches of the planes
    bodies: PlaneSightings  # matches of the bodies
    matched: bool  # whether there are matches
    frames: Pair  # ``(b, 3, 3)`` from measured to normalized coordinates, of both views
    measured: Tensor  # ``(b, p, 3, 3)`` homographies as they came, zero where one is missing
    calibration: Tensor | None  # ``(b, 2, 3, 3)``
    batch: tuple[int, ...]  # the leading dimensions that came in
    like: Tensor  # what the results are to be like

    @staticmethod
    def of(H: Tensor, F: Tensor, planes: Pair | None, bodies: Pair | None, calibration: Tensor | None) -> GivenPlanes:
        """Checked matrices, with the matches where there are any."""
        # a device without float64 lends its data to the CPU and gets the result back
        home = torch.device("cpu") if H.device.type == "mps" else H.device
        batch = tuple(H.shape[:-3])
        h, f = (_finite(x.to(home, torch.float64).reshape(prod(batch), *x.shape[-3:])) for x in (H, F))
        seen = _sightings("x1 and x2", planes, batch, h.shape[1], PLANE_MATCHES, home)
        more = _sightings("body_matches", bodies, batch, f.shape[1], BODY_MATCHES, home)
        matched = planes is not None or bodies is not None
        cameras = None if calibration is None else calibration.to(home, torch.float64).reshape(prod(batch), 2, 3, 3)
        if planes is not None:
            h = h * (seen.weights.sum(-1) > 0)[..., None, None]
        if bodies is not None:
            f = f * (more.weights.sum(-1) > 0)[..., None, None]
        if matched:
            views = [torch.cat([a.flatten(1, 2), b.flatten(1, 2)], dim=1) for a, b in zip(seen.views, more.views, strict=True)]
            frames = frames_of_matches((views[0], views[1]), torch.cat([seen.weights.flatten(1), more.weights.flatten(1)], dim=1))
        elif cameras is not None:
            frames = frames_of_calibration((cameras[:, 0], cameras[:, 1]))
        else:
            frames = frames_of_matrices(h, f)
        inverse = [torch.linalg.inv_ex(frame)[0][:, None] for frame in frames]
        hn, fn = _regular(frames[1][:, None] @ h @ inverse[0], 3), _regular(inverse[1].mT @ f @ inverse[0], 2)
        return GivenPlanes(
            hn, fn, seen.transform(frames, hn), more.transform(frames, fn), matched, frames, h * _there(hn), cameras, batch, H
        )

    def present(self) -> Tensor:
        """Which planes and bodies count, ``(b, p + m)`` bool."""
        return torch.cat([_there(self.homographies), _there(self.fundamentals)], dim=1)[..., 0, 0] > 0

    def rows(self) -> Pair:
        """How many residuals there are ``(b,)``, and how many beyond the degrees of freedom."""
        used, p = self.present(), self.homographies.shape[1]
        planes, bodies = used[:, :p].sum(-1).double(), used[:, p:].sum(-1).double()
        rows = 8 * planes + 7 * bodies
        if self.matched:
            rows = 2 * self.planes.weights.sum((-2, -1)) + self.bodies.weights.sum((-2, -1))
        return rows, rows - (8 + 5 * planes + 2 * bodies)

    def back(self, result: Tensor) -> Tensor:
        """A result with a flat batch, in the caller's shape, dtype and device."""
        shaped = result.reshape((*self.batch, *result.shape[1:]))
        return shaped.to(self.like.device, self.like.dtype if result.is_floating_point() else result.dtype)


@dataclass(frozen=True)
class PlaneSightings:
    """Matches of k planes or bodies."""

    views: Pair  # two of ``(b, k, n, 2)``, finite
    weights: Tensor  # ``(b, k, n)``, 0 where a match is missing

    def transform(self, frames: Pair, matrices: Tensor) -> PlaneSightings:
        """In new coordinates, without the matches of matrices ``(b, k, 3, 3)`` that are missing."""
        weights = self.weights * _there(matrices)[..., 0] if self.weights.shape[1] else self.weights
        first, second = (apply(frame[:, None], x) * (weights > 0)[..., None] for frame, x in zip(frames, self.views, strict=True))
        return PlaneSightings((first, second), weights)


def _matrices(name: str, value: Tensor) -> Tensor:
    """Checked ``(*batch, k, 3, 3)``."""
    if not isinstance(value, Tensor):
        raise ValueError(f"{name} must be a torch.Tensor (*batch, n, 3, 3), got {type(value).__name__}; use torch.as_tensor(...)")
    if not value.is_floating_point() or value.ndim < 3 or value.shape[-2:] != (3, 3):
        raise ValueError(f"{name} must be a floating point tensor (*batch, n, 3, 3), got {tuple(value.shape)} {value.dtype}")
    return value


def pad_matches(name: str, views: tuple[Points, Points]) -> Pair:
    """Two views of the matches of k planes as ``(*batch, k, n, 2)``, filled up with NaN where a plane has fewer."""
    if len(views) != 2 or any(not isinstance(x, Tensor | Sequence) or isinstance(x, str) for x in views):
        kinds = ", ".join(type(x).__name__ for x in views)
        raise ValueError(f"{name} must be two views, each a tensor or a list of tensors, got {len(views)}: {kinds}")
    first, second = (x if isinstance(x, Tensor) else _stack(name, x) for x in views)
    if first.shape != second.shape or first.ndim < 3 or first.shape[-1] != 2 or not first.is_floating_point():
        raise ValueError(
            f"{name} must be two views (*batch, planes, n, 2), or lists of (*batch, n, 2), of one floating point type, "
            f"got {tuple(first.shape)} {first.dtype} and {tuple(second.shape)} {second.dtype}"
        )
    if not any(isinstance(x, Tensor) for x in views):
        counts = [[torch.as_tensor(x).shape[-2] for x in view] for view in views]
        if counts[0] != counts[1]:
            raise ValueError(f"{name} must be the same points in both views, got {counts[0]} and {counts[1]}; NaN = missing")
    return first, second


def _stack(name: str, points: Sequence[Tensor]) -> Tensor:
    shapes = [tuple(torch.as_tensor(x).shape) for x in points]
    if not shapes or any(len(s) < 2 or s[-1] != 2 or s[:-2] != shapes[0][:-2] for s in shapes):
        raise ValueError(f"{name} must be lists of tensors (*batch, n, 2), one for each plane, got {shapes}")
    longest = max(s[-2] for s in shapes)
    return torch.stack(
        [pad(torch.as_tensor(x), (0, 0, 0, longest - s[-2]), value=torch.nan) for x, s in zip(points, shapes, strict=True)], dim=-3
    )


def _sightings(name: str, views: Pair | None, batch: tuple[int, ...], count: int, least: int, home: torch.device) -> PlaneSightings:
    """Matches of ``count`` planes or bodies with a flat batch; those with fewer than ``least`` weigh nothing."""
    if views is None:
        empty = torch.zeros(prod(batch), 0, 0, 2, dtype=torch.float64, device=home)
        return PlaneSightings((empty, empty), empty[..., 0])
    if views[0].shape[:-2] != (*batch, count):
        raise ValueError(
            f"{name} must be (*batch, planes, n, 2) with batch {batch} and {count} planes as the matrices have, "
            f"got {tuple(views[0].shape)}"
        )
    first, second = (x.to(home, torch.float64).reshape(prod(batch), *x.shape[-3:]) for x in views)
    present = (first.isfinite() & second.isfinite()).all(-1)
    present = present & (present.sum(-1, keepdim=True) >= least)
    clean = [torch.where(present[..., None], x, 0.0) for x in (first, second)]
    return PlaneSightings((clean[0], clean[1]), present.double())


def both(H: Tensor | None, F: Tensor | None) -> Pair:
    """Homographies and fundamental matrices of one batch, dtype and device; none of a kind where it is not given."""
    given = [_matrices(name, value) for name, value in (("H", H), ("fundamentals", F)) if value is not None]
    if not given:
        raise ValueError(
            "translating_planes needs H (*batch, planes, 3, 3), fundamentals (*batch, bodies, 3, 3) or matches; got none"
        )
    if len(given) == 2 and (given[0].shape[:-3] != given[1].shape[:-3] or given[0].dtype != given[1].dtype):
        raise ValueError(
            f"H and fundamentals must have one batch and dtype, got {tuple(given[0].shape)} {given[0].dtype} "
            f"and {tuple(given[1].shape)} {given[1].dtype}"
        )
    none = given[0][..., :0, :, :]
    return none if H is None else given[0], none if F is None else given[-1]


def check_counts(planes: int, bodies: int, method: str) -> None:
    """Refuse fewer planes and bodies than a method takes."""
    if method != "auto" and method not in LEAST:
        raise ValueError(f"method must be 'auto' or one of {', '.join(LEAST)}, got {method!r}")
    if not bool(enough(torch.tensor(planes), torch.tensor(bodies), method)):
        least = {"auto": "3 planes, 2 planes and 1 fundamental matrix, or 2 fundamental matrices"}
        least |= {name: _count_words(p, m) for name, (p, m) in LEAST.items()}
        raise ValueError(
            f"H and fundamentals hold {_count_words(planes, bodies)}; method {method!r} needs at least {least[method]}: "
            f"add some, each with a translation of its own"
        )


def _count_words(planes: int, bodies: int) -> str:
    """As many planes and fundamental matrices as there are, such as ``"2 planes and 1 fundamental matrix"``."""
    said = [f"{planes} plane{'s' * (planes != 1)}"] * bool(planes)
    return " and ".join(said + [f"{bodies} fundamental matri{'x' if bodies == 1 else 'ces'}"] * bool(bodies)) or "none"


def enough(planes: Tensor, bodies: Tensor, method: str) -> Tensor:
    """Whether counts of planes and bodies determine the homography at infinity by a method, bool of their shape."""
    if method != "auto":
        return (planes >= LEAST[method][0]) & (bodies >= LEAST[method][1])
    return (bodies >= 2) | ((bodies == 1) & (planes >= 2)) | (planes >= 3)


def cameras(calibration: Tensor | Pair, batch: tuple[int, ...], like: Tensor) -> Tensor:
    """Calibration matrices of both views, ``(*batch, 2, 3, 3)``."""
    pair = (calibration, calibration) if not isinstance(calibration, Sequence) else tuple(calibration)
    if len(pair) != 2 or any(not isinstance(k, Tensor) or k.shape not in ((3, 3), (*batch, 3, 3)) for k in pair):
        given = pair if isinstance(calibration, Sequence) else pair[:1]
        got = " and ".join(str(tuple(k.shape)) if isinstance(k, Tensor) else _kind(k) for k in given) or "nothing"
        raise ValueError(
            f"calibration must be K (3, 3) or (*batch, 3, 3) of both views, batch {batch}, or a pair (K1, K2) of them, got {got}"
        )
    found = torch.stack([k.to(like).expand(*batch, 3, 3) for k in pair], dim=-3)
    if not bool(found.isfinite().all()) or bool((torch.linalg.det(found) == 0).any()):
        raise ValueError("calibration must be finite and invertible; a camera has K = [f 0 u; 0 f v; 0 0 1]")
    return found


def _kind(value: object) -> str:
    """A type, and what to do where it is an array of another library."""
    remedy = " (use torch.as_tensor(...))" if hasattr(value, "__array__") or isinstance(value, list) else ""
    return f"{type(value).__module__}.{type(value).__name__}{remedy}".removeprefix("builtins.")


def _there(matrices: Tensor) -> Tensor:
    """Which matrices ``(b, k, 3, 3)`` are not missing, 0 or 1, ``(b, k, 1, 1)``."""
    return (matrices != 0).any(-1, keepdim=True).any(-2, keepdim=True).to(matrices.dtype)


def _finite(matrices: Tensor) -> Tensor:
    """Zero in the place of matrices that are not finite; norm 1, as homographies in pixels may be of any size."""
    return unit(finite_matrices(matrices)[0])


def _regular(matrices: Tensor, rank: int) -> Tensor:
    """Matrices ``(b, k, 3, 3)`` of norm 1; zero where one is missing, or of a lower rank."""
    finite = _finite(matrices)
    values = torch.linalg.svdvals(finite)
    return torch.where((values[..., rank - 1] > MIN_SINGULAR_RATIO * values[..., 0])[..., None, None], finite, 0.0)

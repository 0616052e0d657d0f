"""segment(): which matches of two views move together, which are wrong, and how each body moved."""

from __future__ import annotations

from math import prod

import torch
from torch import Tensor

from dyntorch.blocks import one_thread
from dyntorch.devices import on_cpu
from dyntorch.invariants.fundamental_matrix import FundamentalMatrix
from dyntorch.matches import matches
from dyntorch.tasks.bodies_outcome import segmentation_notices
from dyntorch.tasks.bodies_pool import LEAST
from dyntorch.tasks.bodies_problem import Request, solve
from dyntorch.tasks.notices import check_threshold
from dyntorch.tasks.segmentation import BodyModel, Segmentation

MINIMAL = 8
"""Fewest matches: seven determine a fundamental matrix, and one has to agree with it."""


@one_thread
@on_cpu
def segment(
    x1: Tensor,
    x2: Tensor,
    bodies: int | None = None,
    threshold: float | None = 2.5,
    *,
    weights: Tensor | None = None,
    spatial: bool = True,
    generator: torch.Generator | None = None,
) -> Segmentation:
    r"""Bodies that moved independently between two views, and the matches that belong to none.

    Each body has a fundamental matrix of its own, :math:`x_2^T F_k\, x_1 = 0` (a plane, or a body seen under a pure rotation, a
    homography).  Matches that move like their neighbours in both images are linked; the linked ones are divided among bodies by
    least cost: truncated Sampson distances, links cut, and the smoothness of each body's depth.  Starts are robust affine flows,
    the epipolar geometries of which form a pool that bodies are chosen from; the best starts descend to maximum likelihood
    fits and labels in turns.  The number of bodies is the one of least cost with a penalty for each body.  Then all matches are
    labelled, the outliers among them.

    A search: it computes on the CPU wherever its tensors are, and the result returns to their device.

    Args:
        x1: ``(*batch, n, 2)`` points of view 1, pixels; NaN = missing.
        x2: the same points in view 2.
        bodies: how many; None finds out.
        threshold: Sampson distance in the unit of the points, about five standard deviations of the noise of a coordinate, at which
            a match may as well be an outlier; one that moves like its neighbours may be up to three times as far from its body.
            All scales follow it.  None estimates it from the matches, in twice the time.
        weights: ``(*batch, n)`` not negative; 0 leaves a match out, others weigh it in the last fits of the bodies, not in the
            search for them.
        spatial: whether bodies are regions of the images.  False for bodies that interleave, such as transparent motions or
            sparse points of a crowd: then only the geometry decides, which takes more matches and bears fewer outliers.
        generator: source of all randomness; None is torch's global one.

    Returns:
        A :class:`~dyntorch.tasks.segmentation.Segmentation`, without gradients.

    Raises:
        ValueError: fewer than eight matches or than seven for each body, shapes, dtypes or devices that do not agree, a
            threshold or a number of bodies that is not positive.

    Source: thesis chapter 6; Torr 1998 (models); Isack and Boykov, Energy-based geometric multi-model fitting, 2012.

    Example:
        >>> import torch, dyntorch as dyn
        >>> from dyntorch import scenes
        >>> draw = torch.Generator().manual_seed(0)
        >>> scene = scenes.bodies(160, bodies=2, sigma=0.5, outliers=0.2, generator=draw)
        >>> result = dyn.segment(*scene.views, generator=draw)
        >>> int(result.bodies), tuple(result.fundamentals.shape)
        (2, (2, 3, 3))
    """
    check_threshold(threshold)
    data = matches(FundamentalMatrix(), (x1, x2), weights)
    if generator is not None and not isinstance(generator, torch.Generator):
        raise ValueError(f"generator must be a torch.Generator or None, got {generator!r}; use torch.Generator().manual_seed(0)")
    if data.count == 1 and len(x1) >= MINIMAL:
        raise ValueError(
            f"x1 is {tuple(x1.shape)}: problems of one match each; for points as OpenCV gives them, use x1[:, 0], x2[:, 0]"
        )
    _check_counts(bodies, data.count)
    with torch.no_grad():
        found = [
            solve(first, second, weight, Request(bodies, threshold, spatial, generator))
            for first, second, weight in zip(*data.views, data.weights, strict=True)
        ]
    width = max([outcome.count for outcome in found], default=0)

    def stacked(name: str, shape: tuple[int, ...]) -> Tensor:
        """One part of all outcomes, bodies padded with 0."""
        parts = [getattr(outcome, name) for outcome in found]
        result = torch.zeros(len(parts), *shape, dtype=torch.float64, device=data.weights.device)
        for row, part in zip(result, parts, strict=True):
            row[tuple(slice(0, size) for size in part.shape)] = part
        return data.back(result)

    def numbers(values: list[int]) -> Tensor:
        return data.back(torch.tensor(values, dtype=torch.long, device=data.weights.device))

    n = data.count
    return Segmentation(
        labels=data.back(torch.stack([x.labels for x in found]) if found else torch.zeros(0, n, dtype=torch.long)),
        bodies=numbers([outcome.count for outcome in found]),
        fundamentals=stacked("fundamentals", (width, 3, 3)),
        homographies=stacked("homographies", (width, 3, 3)),
        models=_nested([outcome.models for outcome in found], data.batch),
        probabilities=stacked("probabilities", (n, width + 1)),
        residuals=stacked("residuals", (n,)),
        coherence=stacked("coherence", (n,)),
        status=numbers([int(outcome.status) for outcome in found]),
        threshold=stacked("threshold", ()),
        warnings=segmentation_notices(found, bodies, data.batch),
    )


def _check_counts(bodies: int | None, count: int) -> None:
    if bodies is not None and (isinstance(bodies, bool) or not isinstance(bodies, int) or bodies < 1):
        raise ValueError(f"bodies must be a positive whole number, or None to find out, got {bodies!r}")
    if count < MINIMAL:
        raise ValueError(f"segment needs at least {MINIMAL} matches, got {count}: add {MINIMAL - count}")
    if bodies is not None and bodies * LEAST > count:
        raise ValueError(
            f"bodies={bodies} take at least {LEAST} matches each, {bodies * LEAST} in all, got {count}: "
            f"add {bodies * LEAST - count}, or ask for at most {count // LEAST}"
        )


def _nested(models: list[tuple[BodyModel, ...]], batch: tuple[int, ...]) -> tuple[object, ...]:
    """Models of a flat batch in its shape."""
    if not batch:
        return models[0]
    step = prod(batch[1:])
    return tuple(_nested(models[i * step : (i + 1) * step], batch[1:]) for i in range(batch[0]))

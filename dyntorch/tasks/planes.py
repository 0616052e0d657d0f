"""translating_planes(): the homography at infinity of planes and bodies that translate independently, and every body's motion."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from dyntorch.blocks import map_blocks, one_thread
from dyntorch.fitting import fit
from dyntorch.invariants.collineation import Collineation
from dyntorch.invariants.fundamental_matrix import FundamentalMatrix
from dyntorch.tasks.planes_input import Given, Pair, Points, both, cameras, check_counts, padded
from dyntorch.tasks.planes_outcome import outcome
from dyntorch.tasks.planes_problem import Layout, Matches
from dyntorch.tasks.planes_result import TranslatingPlanes
from dyntorch.tasks.planes_solver import solve

BLOCK, STARTS = 1 << 21, 4
"""Numbers in the derivatives of one block of problems, and how many starts a problem has at most of the time."""


@one_thread
def translating_planes(
    H: Tensor | None = None,
    *,
    fundamentals: Tensor | None = None,
    x1: Points | None = None,
    x2: Points | None = None,
    body_matches: tuple[Points, Points] | None = None,
    method: str = "auto",
    refine: bool = True,
    calibration: Tensor | tuple[Tensor, Tensor] | None = None,
) -> TranslatingPlanes:
    r"""The homography at infinity from planes that translate independently, seen in two views.

    The cameras move, every body translates as it likes, and none rotates against the others.  A plane of body i, and a body k
    with depth, then have

    .. math:: H_i = \lambda_i (H_\infty + e_i n_i^T), \qquad F_k = [e_k]_\times H_\infty,

    with the homography at infinity common to all.  Three planes, two planes and a body, or two bodies determine it.  It gives
    every body's epipole and fundamental matrix, and reconstructs all bodies in one affine frame, each at a scale of its own.

    Closed forms start it (see ``method``); each start is refined by least squares on the matrices, then, where matches are given,
    on the Sampson distances of all of them, and the best is kept.  With matches the error is a third to a half of that without.

    Args:
        H: ``(*batch, p, 3, 3)`` homographies of the planes, view 1 to view 2, each of any scale; NaN = missing.  Those of OpenCV
            go in as ``torch.as_tensor(numpy.stack(list_of_H))``.  None fits them to the matches, or means no planes.
        fundamentals: ``(*batch, m, 3, 3)`` of bodies with depth, :math:`x_2^T F x_1 = 0`; None fits them to ``body_matches``.  One
            of them is worth many planes.
        x1: matches of every plane in view 1, ``(*batch, p, n, 2)``, NaN = missing, or p tensors ``(*batch, n_i, 2)``; pixels.
        x2: the same points in view 2.
        body_matches: two views of the matches of the bodies, in the same forms.
        method: the start: ``"linear"`` (extensors with 64 unknowns, 4 planes), ``"closed_form"`` (3 planes), ``"thesis"``
            (extensors with 84 unknowns, 5 planes), ``"mixed"`` (2 planes and a body), ``"fundamentals"`` (2 bodies); ``"auto"``
            tries all but the thesis's.
        refine: False returns the start as it is.
        calibration: K ``(3, 3)`` or ``(*batch, 3, 3)``, or a pair of them for the two views, upgrades the affine frame to a
            similarity: :math:`H_\infty \sim K_2 R K_1^{-1}`.

    Returns:
        A :class:`~dyntorch.tasks.planes_result.TranslatingPlanes`.

    Raises:
        ValueError: too few planes and bodies, shapes that do not fit each other, an unknown method, matches of the planes
            without those of the bodies.

    Source: thesis chapter 5; Wolf and Shashua, ICCV 2001; the linear system of 64 unknowns and the closed forms are derived here.

    Example:
        >>> import torch, dyntorch as dyn
        >>> from dyntorch import scenes
        >>> scene = scenes.translating_planes(4, generator=torch.Generator().manual_seed(0))
        >>> found = dyn.translating_planes(scene.homographies)
        >>> bool(torch.allclose(found.homography_at_infinity, scene.infinity, atol=1e-6))
        True
        >>> print(repr(found).splitlines()[0])
        TranslatingPlanes(planes=4, bodies=0, batch=(): 1 OK)
    """
    planes = _views(x1, x2)
    bodies = None if body_matches is None else padded("body_matches", body_matches)
    if H is None and planes is not None:
        H = fit(Collineation(2), planes[1], planes[0]).tensor
    if fundamentals is None and bodies is not None:
        fundamentals = fit(FundamentalMatrix, *bodies).tensor
    H, F = both(H, fundamentals)
    check_counts(H.shape[-3], F.shape[-3], method)
    if (planes is None and bodies is not None and H.shape[-3]) or (planes is not None and bodies is None and F.shape[-3]):
        raise ValueError("matches are given of the planes or of the bodies only: give both x1, x2 and body_matches, or neither")
    camera = None if calibration is None else cameras(calibration, tuple(H.shape[:-3]), H)
    with torch.no_grad():
        given = Given.of(H, F, planes, bodies, camera)
        result = outcome(given, _solved(given, method, refine), method, refine)
        shaped: dict[str, Any] = {name: given.back(value) for name, value in vars(result).items() if isinstance(value, Tensor)}
    return replace(result, **shaped)


def _views(x1: Points | None, x2: Points | None) -> Pair | None:
    if x1 is None and x2 is None:
        return None
    if x1 is None or x2 is None:
        raise ValueError(f"x1 and x2 belong together, got only {'x2' if x1 is None else 'x1'}: give both views, or neither")
    return padded("x1 and x2", (x1, x2))


def _solved(given: Given, method: str, refine: bool) -> tuple[Tensor, ...]:
    """What :func:`~dyntorch.tasks.planes_solver.solve` says, block by block, and the cost under the given matrices."""
    seen, body = given.planes, given.bodies
    layout = Layout(given.homographies.shape[1], given.fundamentals.shape[1])

    def block(h: Tensor, f: Tensor, spare: Tensor, *parts: Tensor) -> tuple[Tensor, ...]:
        x1, x2, w, y1, y2, v, s1, s2 = parts
        matches = Matches((x1, x2), w, (y1, y2), v, (s1, s2)) if given.matched else None
        separate = spare * 0 if matches is None else matches.normal(torch.cat([h, f], dim=1)).cost.nansum(1)
        return *solve(h, f, matches, spare, method, refine), separate

    parts = (*seen.views, seen.weights, *body.views, body.weights, *(frame[:, 0, 0] for frame in given.frames))
    numbers = 18 * seen.weights.shape[1] * seen.weights.shape[2] + layout.size * (9 * (layout.planes + layout.bodies) + layout.size)
    size = max(1, BLOCK // (STARTS * numbers))
    return map_blocks(block, given.homographies, given.fundamentals, given.rows()[1], *parts, size=size)

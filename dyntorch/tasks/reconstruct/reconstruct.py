"""reconstruct(): from tracks of a scene in which everything moves to cameras, points and velocities, in one call."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import fields, replace

import torch
from torch import Tensor

from dyntorch.core.normalize import hartley
from dyntorch.core.outcome import in_order, is_failure, noting
from dyntorch.geometry.bundle import calibrations
from dyntorch.geometry.triangulation import mask_missing
from dyntorch.numerics.arguments import check_options, on_cpu
from dyntorch.numerics.blocks import one_thread
from dyntorch.numerics.messages import Message
from dyntorch.tasks.reconstruct.motions import Motion, as_motion
from dyntorch.tasks.reconstruct.result import Reconstruction, ReconstructNotice, ReconstructOptions
from dyntorch.tasks.reconstruct.scene import ViewTracks
from dyntorch.tasks.reconstruct.solver import choose, solve


@one_thread
@on_cpu
def reconstruct(
    tracks: Tensor,
    motion: str | Motion,
    times: Tensor | Sequence[float] | None = None,
    *,
    static: Tensor | Sequence[bool] | None = None,
    threshold: float | None = None,
    weights: Tensor | None = None,
    calibration: Tensor | None = None,
    generator: torch.Generator | None = None,
    options: ReconstructOptions | None = None,
) -> Reconstruction:
    r"""Cameras, points and velocities from tracks of moving points, seen by moving, uncalibrated cameras.

    A moving point whose position :math:`X(t) = B(t)\,Y` is linear in some constants Y is a static point of a higher projective
    space :math:`P^k`, and a camera at time t a projection :math:`M = P\,B(t)` of it.  The Grassmann tensor of a few views is
    estimated linearly and constrained, the projections follow from it in closed form, all other views by resection; the known
    B(t) then fix the frame of :math:`P^k` up to an ambiguity of the scene, linearly, and bundle adjustment over all views ends
    it.  Where matches disagree, all of this is done robustly.  The results carry no gradients.

    A search: it computes on the CPU wherever its tensors are, and the result returns to their device.

    Args:
        tracks: ``(*batch, views, n, 2)`` pixels (3D sensors: ``(*batch, views, n, 3)``), NaN or infinite = missing.
        motion: a name in ``dyntorch.motions.MOTIONS``, a :class:`dyntorch.Motion` (any lift B(t)), or ``"auto"``: the declared
            models are tried and the one of least penalized cost is taken, one for the whole batch.
            ``print(dyntorch.motions.motion_table())`` lists them: static points, points that move at constant velocity in a plane
            (3 views of 13 tracks), in parallel planes (4, 20) or in space (4, 40; before 3D sensors 3, 21), along one direction,
            with constant acceleration, and two bodies in relative translation.
        times: of the views, any unit and spacing; default 0, 1, 2, ...  Far from 0 the points at time 0 lose digits: count from the
            first view.
        static: ``(*batch, n)`` bool, points known to stand still: they fix the motion common to all points, which no view can
            tell; without them, or with none True, the frame is the one in which the points move least.
        threshold: three standard deviations of the noise of one coordinate, in the unit of the tracks.  None estimates it from the
            tracks; infinity declares that there are no outliers.
        weights: ``(*batch, views, n)`` not negative; 0 leaves an observation out.
        calibration: K of all views ``(3, 3)``, or of each ``(views, 3, 3)``, or ``(*batch, views, 3, 3)``, in the unit of the
            tracks (3D sensors: the collineation ``(4, 4)`` from metric coordinates to the measured ones, the identity for sensors
            that measure lengths).  The scene is then metric, up to a similarity, where the motion and the cameras determine it:
            constant velocity and acceleration do before a single camera, bodies too; static points and points that move along one
            direction, or within parallel planes, need cameras that move, a static plane three of them.  See ``metric``,
            ``rotations``, ``translations`` and ``ambiguity`` of the result.
        generator: source of the random samples of the robust estimate.
        options: :class:`~dyntorch.tasks.reconstruct.result.ReconstructOptions`; None = the defaults.

    Returns:
        A :class:`~dyntorch.tasks.reconstruct.result.Reconstruction`: ``cameras (*batch, views, 3, d + 1)``,
        ``points (*batch, n, d)`` at time 0, ``velocities (*batch, n, d)`` per unit of the times,
        ``labels``, ``residual``, ``status``, ``warnings`` and the
        remaining ``ambiguity`` in words.

    Raises:
        ValueError: fewer views or tracks than the model needs, fewer different times (some views may share one), times that the
            precision does not resolve, tracks of another shape, an unknown model, a lift that is not finite or of too low a rank.

    Source: thesis chapter 3 and section 8.3; Wolf and Shashua 2002; Hartley and Schaffalitzky 2004.

    Example:
        >>> import torch, dyntorch as dyn
        >>> from dyntorch import metrics, scenes
        >>> scene = scenes.lifted_points("constant_velocity_2d", 40, views=4, sigma=0.5, generator=torch.Generator().manual_seed(0))
        >>> found = dyn.reconstruct(scene.tracks, motion="constant_velocity_2d")
        >>> found.cameras.shape, found.points.shape, found.velocities.shape
        (torch.Size([4, 3, 3]), torch.Size([40, 2]), torch.Size([40, 2]))
        >>> error = metrics.lifted_error(found.structure, scene.structure, scene.lifts)
        >>> bool(error.position < 0.03), bool(found.residual < 0.7)
        (True, True)
    """
    model = None if motion == "auto" else as_motion(motion)
    options = ReconstructOptions() if options is None else options
    check_options(options, ReconstructOptions)
    if generator is not None and not isinstance(generator, torch.Generator):
        raise ValueError(f"generator must be a torch.Generator or None, got {generator!r}; use torch.Generator().manual_seed(...)")
    moment, x, w, batch = _check(tracks, times, weights)
    if model is None or _moves(model):
        _check_resolution(moment, times, tracks.dtype)
    label = _static(static, batch, x)
    K = None if calibration is None else calibrations(calibration, batch, x.shape[1], x, x.shape[-1])
    limit = _limit(threshold)
    with torch.no_grad():
        if model is None:
            found = choose(normalize_tracks(x, w, moment), label, limit, generator, batch, options, K)
        else:
            _check_enough(model, moment, x)
            used = (w > 0).sum(-1) >= _resection(model)
            data = normalize_tracks(x, w * used[..., None], moment)
            found = _with_notices(solve(data, model, label, limit, generator, batch, options, K), label, used)
    return _to_caller(found, tracks)


def _check(
    tracks: Tensor, times: Tensor | Sequence[float] | None, weights: Tensor | None
) -> tuple[Tensor, Tensor, Tensor, tuple[int, ...]]:
    """Times, flat tracks and weights, and the batch."""
    if not isinstance(tracks, Tensor) or not tracks.is_floating_point():
        got = f"{tracks.dtype}" if isinstance(tracks, Tensor) else type(tracks).__name__
        raise ValueError(f"tracks must be a floating point torch.Tensor, got {got}; use torch.as_tensor(...).double()")
    if tracks.ndim < 3 or tracks.shape[-1] not in (2, 3):
        raise ValueError(f"tracks must be (*batch, views, n, 2), or (..., 3) of 3D sensors, got {tuple(tracks.shape)}")
    batch, (views, n, dim) = tuple(tracks.shape[:-3]), tracks.shape[-3:]
    moment = _times(times, views, n)
    w = torch.ones_like(tracks[..., 0]) if weights is None else weights
    if not isinstance(w, Tensor) or not _expands(w, (*batch, views, n)):
        given = tuple(w.shape) if isinstance(w, Tensor) else type(w).__name__
        raise ValueError(f"weights must be a tensor (*batch, views, n) = {(*batch, views, n)}, got {given}")
    if not bool((w >= 0).all()):
        raise ValueError(f"weights must not be negative or NaN, got {float(w.min()):g}; use 0 to leave an observation out")
    x, w = mask_missing(tracks.detach(), w.detach().expand(*batch, views, n))
    count = math.prod(batch)
    return moment, x.reshape(count, views, n, dim), w.reshape(count, views, n), batch


def _times(times: Tensor | Sequence[float] | None, views: int, n: int) -> Tensor:
    """One time per view, float64."""
    try:
        moment = torch.arange(views) if times is None else torch.as_tensor(times, dtype=torch.float64).detach().cpu()
    except (TypeError, ValueError, RuntimeError):
        moment = torch.empty(0)
    if moment.shape != (views,) or not bool(moment.isfinite().all()):
        swapped = "; tracks are (*batch, views, n, 2); yours look transposed" if moment.shape == (n,) and n != views else ""
        shape = getattr(times, "shape", None)
        got = repr(times) if shape is None else f"shape {tuple(shape)}" if tuple(shape) != (views,) else "NaN or infinite ones"
        raise ValueError(f"times must be {views} finite numbers, one per view, got {got}{swapped}")
    return moment.double()


MAX_TIME_ROUNDING = 1e-3  # rounding of the times over the spacing of the views
MAX_FRAME_ROUNDING = 1 / 16  # rounding below which whole numbers are exact frames
MAX_TIME_DISTANCE = (1e4, 1e9)  # over the span of the times, for float32 and float64: beyond, the points at time 0 are noise


def _check_resolution(moment: Tensor, times: Tensor | Sequence[float] | None, dtype: torch.dtype) -> None:
    """Refuse times that were rounded before they came here, and those so far from 0 that the points at time 0 would be noise."""
    if not len(moment):
        return
    furthest, different = float(moment.abs().max()), moment.unique()
    kind = torch.as_tensor(times).dtype if hasattr(times, "dtype") else torch.float64
    if kind.is_floating_point and kind != torch.float64:
        rounding = torch.finfo(kind).eps / 2 * furthest
        spacing = float(different.diff().median()) if len(different) > 1 else 1.0
        frames = bool((moment == moment.round()).all()) and rounding < MAX_FRAME_ROUNDING
        if rounding > MAX_TIME_ROUNDING * spacing and not frames:
            raise ValueError(
                f"times of {kind} near {furthest:g} are rounded by up to {rounding:.2g}, for views {spacing:.2g} apart; "
                "give them as float64 (.double() before anything is added), or count them from the first view"
            )
    span = float(different[-1] - different[0])
    far = MAX_TIME_DISTANCE[dtype == torch.float64]
    if span and furthest > far * span:
        raise ValueError(
            f"times reach {furthest:g}, {furthest / span:.2g} times what they span: in {dtype} the points at time 0 would be noise "
            f"(limit {far:.0e}); count times from the first view"
        )


def _expands(tensor: Tensor, shape: tuple[int, ...]) -> bool:
    """Whether a tensor of whole problems expands to the batch."""
    tail = min(2, len(shape)) if tensor.dtype != torch.bool else 1
    short = len(shape) - tensor.ndim
    fits = all(have in (1, want) for have, want in zip(tensor.shape, shape[max(short, 0) :], strict=False))
    return short >= 0 and tensor.shape[-tail:] == shape[-tail:] and fits


def _limit(threshold: float | None) -> float | None:
    try:
        value = None if threshold is None else math.nan if isinstance(threshold, bool) else float(threshold)
    except (TypeError, ValueError, RuntimeError):
        value = math.nan
    if value is not None and not value > 0:
        raise ValueError(f"threshold must be a positive number in the unit of the tracks, got {threshold!r}; None estimates it")
    return value


def _static(static: Tensor | Sequence[bool] | None, batch: tuple[int, ...], x: Tensor) -> Tensor | None:
    """Flat, or None where no point is known to stand still."""
    if static is None:
        return None
    n = x.shape[2]
    try:
        known = torch.as_tensor(static, device=x.device)
    except (TypeError, ValueError, RuntimeError):
        known = torch.empty(0)
    if known.dtype != torch.bool or not _expands(known, (*batch, n)):
        got = type(static).__name__ if known.shape == (0,) else f"{tuple(known.shape)} {known.dtype}"
        raise ValueError(f"static must be a bool tensor (*batch, n) = {(*batch, n)}, got {got}")
    return known.expand(*batch, n).reshape(len(x), n) if bool(known.any()) else None


def normalize_tracks(x: Tensor, weights: Tensor, times: Tensor) -> ViewTracks:
    """Every view of mean 0 and rms sqrt(l), the weights such that the error stays that of the measured units."""
    transforms = hartley(x.unsqueeze(-2), (weights > 0).to(x.dtype))
    # a view without images has the scale of the others: no weight of theirs depends on it
    seen = (weights > 0).any(-1)
    scales = torch.where(seen, transforms[..., 0, 0], torch.nan)
    scales = torch.where(seen, scales, scales.square().nanmean(-1, keepdim=True).sqrt()).nan_to_num(nan=1.0)
    scaling = torch.diag_embed(torch.nn.functional.pad(scales[..., None].expand(*scales.shape, x.shape[-1]), (0, 1), value=1.0))
    transforms = torch.where(seen[..., None, None], transforms, scaling)
    moved = x * scales[..., None, None] + transforms[..., None, :-1, -1]
    moved = torch.where((weights > 0)[..., None], moved, 0.0)
    # of order one: the views' scales over their mean
    share = scales.square().mean(-1, keepdim=True) / scales.square()
    return ViewTracks(moved, weights * share[..., None], scales, transforms, times)


def _resection(model: Motion) -> int:
    """Tracks that a view has to show for its projection."""
    return -(-((model.sensor + 1) * (model.k + 1) - 1) // model.sensor)


def _moves(model: Motion) -> bool:
    """Whether the times matter: there are constants that only views at different times tell."""
    return model.lift is not None and not model.static and model.k > model.dim


def _check_enough(model: Motion, times: Tensor, x: Tensor) -> None:
    """Refuse what no problem of this shape can be solved from."""
    views, n, dim = x.shape[1:]
    if dim != model.sensor:
        kind = "3D sensors" if model.sensor == 3 else "images"
        takes = f"{model.name!r} takes tracks of {kind}, (*batch, views, n, {model.sensor}), got {tuple(x.shape[1:])}"
        text = "{takes}; choose a motion for tracks of {dim} coordinates, or {arg:motion='auto'}"
        raise ValueError(Message(text, takes=takes, dim=dim))
    moves, different = _moves(model), len(times.unique())
    if moves and views > 1 and different == 1:
        text = "all times are {time:g}: views at different times are needed to see a motion; give {arg:times=}"
        raise ValueError(Message(text, time=float(times[0])))
    many = torch.arange(12, dtype=torch.float64)
    if model.shift is None and different > 1:  # the lift may make sense between the views only
        many = torch.linspace(float(times.min()), float(times.max()), 12, dtype=torch.float64)
    usual = model.views(many)
    if usual > len(many):
        raise ValueError(f"no number of views determines {model.name!r}: its lift leaves constants of the points unseen")
    if views < usual:
        raise ValueError(f"{model.name!r} needs at least {usual} views, got {views}; add views, or use a model with fewer unknowns")
    if moves and (model.views(times) > views or (different < views and model.ambiguity(times) > model.ambiguity(many))):
        hint = (
            f"got {different} in {views} views" if different < views else f"{views} views at {times.tolist()} do not determine it"
        )
        raise ValueError(f"{model.name!r} needs views at {usual} different times or more, {hint}; add views at other times")
    need = model.min_views_and_tracks(times)
    if n < need[1]:
        raise ValueError(f"{model.name!r} needs at least {need[1]} tracks through {need[0]} views, got {n}; add tracks")


def _with_notices(found: Reconstruction, static: Tensor | None, used: Tensor) -> Reconstruction:
    """Without cameras for views that show too little, and with the notices on what was given."""
    batch = found.status.shape
    good = ~is_failure(found.status).reshape(-1)
    unused = (~used).sum(-1)
    more, note = noting(tuple(batch))
    note(ReconstructNotice.UNUSED_VIEW, unused, unused > 0, needed=_resection(found.motion))
    if static is not None and found.velocities is not None and not found.motion.static:
        given = static & found.points.reshape(*static.shape, found.points.shape[-1]).isfinite().all(-1)
        note(ReconstructNotice.COMMON_VELOCITY, given.sum(-1), good & static.any(-1) & ~given.any(-1))
    seen = used.reshape(*batch, used.shape[-1])
    bodies = None if found.bodies is None else found.bodies * seen[..., None, :, None, None]
    return replace(found, cameras=found.cameras * seen[..., None, None], bodies=bodies, notices=in_order((*found.notices, *more)))


def _to_caller(found: Reconstruction, tracks: Tensor) -> Reconstruction:
    """Floating point results in the dtype and on the device of the tracks; times keep their own precision."""
    changed = {
        f.name: getattr(found, f.name).to(device=tracks.device, dtype=tracks.dtype)
        for f in fields(found)
        if isinstance(getattr(found, f.name), Tensor) and getattr(found, f.name).is_floating_point() and f.name != "times"
    }
    return replace(found, **changed)

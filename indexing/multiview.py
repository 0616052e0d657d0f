"""One performance seen by several synchronized cameras -> one exemplar in 3D, where the views decide its shape."""

from __future__ import annotations

import warnings

import numpy as np
import torch

from dyntorch import affine_factorization, metric_upgrade
from indexing.clip import Clip
from indexing.windows import ragged, sample, torn

# Share of the energy that one rigid space-time shape may leave unexplained.  On synthetic people a detector's noise leaves
# .002-.005, views that lag by .3 s .006-.04, views of another action .01-.05.
UNEXPLAINED = 0.01


def combine(views: tuple[Clip, ...]) -> list[Clip]:
    """A 3D clip from three or more views that decide it; otherwise the views themselves, each an exemplar of its own.

    The views are factored (Tomasi-Kanade, affine cameras fixed over the clip) and upgraded to a metric shape whose vertical
    is that of the images, so cameras should stand upright.

    Raises:
        ValueError: views with different numbers of joints, with depth, or without common time.
    """
    first = views[0]
    for i, view in enumerate(views):
        if view.joints.shape[1:] != first.joints.shape[1:] or view.dims != 2:
            raise ValueError(
                "views of one performance must be 2D with the same joints: "
                f"view 0 is {first.joints.shape[1:]}, view {i} {view.joints.shape[1:]}"
            )
        reason = torn(view)
        if reason:
            raise ValueError(f"view {i} of {first.name!r}: times: {reason}")
    start, end = max(view.times[0] for view in views), min(view.times[-1] for view in views)
    if not end > start:
        raise ValueError(f"the views of {first.name!r} share no time: the last starts at {start:g} s, the first ends at {end:g} s")
    if len(views) < 3:
        return list(views)
    steps = max(4, round((end - start) * float(first.fps or 30.0)))
    source = ragged(list(views))
    seen = source.seen.all(axis=0)
    if seen.sum() < 4:
        return list(views)
    windows = sample(source, np.arange(len(views)), np.full(len(views), start), np.full(len(views), end), steps)
    shape, cameras, left = affine_factorization(windows[:, :, torch.from_numpy(seen)].flatten(1, 2))
    metric, decided = metric_upgrade(shape, cameras)
    if not bool(decided) or float(left) > UNEXPLAINED:
        why = (
            f"{float(left):.0%} of the motion is not one rigid space-time shape"
            if decided
            else "the cameras stand too close together"
        )
        warnings.warn(
            f"views of {first.name!r} do not decide a 3D shape ({why}); each is used as an example of its own", stacklevel=2
        )
        return list(views)
    joints = np.full((steps, first.joints.shape[1], 3), np.nan, dtype=np.float32)
    joints[:, seen] = metric.reshape(steps, int(seen.sum()), 3).numpy()
    slots = (np.arange(steps) + 0.5) / steps
    return [first.replace(joints=joints, times=start + (end - start) * slots, confidence=None, up="y")]

"""What every verb of ``dyntorch`` answers on fixed scenes: name -> function that returns a result."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import torch
from torch import Tensor

import dyntorch as dyn
from dyntorch import counting, metrics, scenes
from tests.battery.cases import CASES as INVARIANTS
from tests.battery.cases import Case
from tests.battery.device_verbs import VERBS
from tests.battery.shape_cases import SHAPE_CASES, ShapeCase

Table = dict[str, Callable[[], Any]]


def seed(number: int = 0) -> torch.Generator:
    """Random numbers, the same every time."""
    return torch.Generator().manual_seed(number)


def normal(*shape: int, number: int = 0) -> Tensor:
    """Normal random numbers."""
    return torch.randn(*shape, generator=seed(number), dtype=torch.float64)


def tried(function: Callable[[], Any]) -> Any:
    """A result, or what was said instead."""
    try:
        return function()
    except (ValueError, TypeError, NotImplementedError, RuntimeError) as problem:
        return f"{type(problem).__name__}: {problem}"


def shown(result: Any) -> dict[str, Any]:
    """A result, and its repr where its class has one of its own."""
    made = hasattr(type(result).__repr__, "__wrapped__")  # by dataclass: all digits of all fields
    return {"result": result} if made else {"result": result, "repr": repr(result)}


OWN = (
    "transfer", "trajectory", "trajectory_planes", "concurrency", "epipoles", "fundamentals", "positions", "velocities", "labels",
)  # fmt: skip


# ---- invariants ------------------------------------------------------------------------------------------------------------
def own(invariant: Any, name: str, found: dyn.Solution, views: tuple[Tensor, ...]) -> Any:
    """What an invariant alone answers of its tensor."""
    method, tensor, motion = getattr(invariant, name), found.tensor, found.motion
    if name in ("epipoles", "fundamentals"):
        return method(tensor)
    if name in ("positions", "velocities"):
        return method(motion, *views)
    if name == "labels":
        return method(*invariant.fundamentals(tensor), *views)
    if name == "trajectory" and isinstance(invariant, dyn.ConstantVelocityTensor):
        return method(motion, *views)
    if name in ("trajectory", "trajectory_planes", "concurrency") or isinstance(invariant, dyn.ConstantVelocityTensor):
        return method(tensor, *views[:2])
    if name == "transfer" and not isinstance(invariant, (dyn.Collineation, dyn.TranslatingLinesMatrix)):
        return {f"{source} {target}": method(tensor, views[source - 1], source, target) for source, target in ((2, 1), (1, 3))}
    return method(tensor, views[-1] if name == "transfer" else views[0])


def linear(case: Case) -> dict[str, Any]:
    """Fit, and all that stands on a fit, of noisy matches."""
    invariant, sigma = case.invariant, case.noise / (case.units[0] if case.units else 1.0)
    kinds = {"static": 0.3} if case.moves else {}
    scene = case.raw(2 * case.minimal + 6, seed=1, batch=(2,), sigma=sigma, **kinds)
    found = dyn.fit(invariant, *scene.views)
    weights = torch.rand(scene.labels.shape, generator=seed(3), dtype=torch.float64)
    single = tuple(x.float() for x in scene.views)
    answer = {
        "fit": shown(found), "weighted": dyn.fit(invariant, *scene.views, weights=weights),
        "plain": dyn.fit(invariant, *scene.views, normalize=False).tensor, "float32": dyn.fit(invariant, *single).tensor,
        "refine": shown(dyn.refine(found, *scene.views)), "constrain": tried(lambda: dyn.constrain(found)),
        "sampson": dyn.sampson(invariant, found.tensor, *scene.views), "minimal": tried(lambda: invariant.minimal()),
        "algebraic": tried(lambda: dyn.core.algebraic(invariant, found.tensor, *scene.views)),
        "few": tried(lambda: dyn.fit(invariant, *(x[:, :3] for x in scene.views))),
        "compose": tried(lambda: invariant.compose(*found.motion)), "decompose": tried(lambda: invariant.decompose(found.tensor)),
        "exact": dyn.fit(invariant, *scene.exact).status,
    }  # fmt: skip
    if case.moves:
        answer["labelled"] = tried(lambda: dyn.fit(invariant, *scene.views, static=scene.labels == 1))
    answer |= {name: tried(partial(own, invariant, name, found, scene.views)) for name in OWN if hasattr(invariant, name)}
    return answer


def robust(case: Case) -> Any:
    """Robust fit of matches of which some are wrong."""
    sigma = 0.5 * case.noise / (case.units[0] if case.units else 1.0)
    scene = case.raw(min(160, max(60, 4 * case.minimal)), seed=31, sigma=sigma, outliers=case.outliers)
    return shown(dyn.robust_fit(case.invariant, *scene.views, threshold=3 * sigma, starts=(1, 4, 16), generator=seed(case.draw)))


def shapes(case: ShapeCase) -> dict[str, Any]:
    """The same of shapes."""
    views, truth = case.scene(case.many, sigma=0.5, seed=2)
    points, given = case.arguments(views)
    found = case.fit(views)
    return {
        "fit": shown(found), "refine": case.refine(found, views), "sampson": case.sampson(found.tensor, views),
        "decompose": tried(lambda: case.invariant.decompose(found.tensor)), "constrain": tried(lambda: dyn.constrain(found)),
        "compose": tried(lambda: case.invariant.compose(truth)), "minimal": tried(lambda: case.invariant.minimal()),
        "robust": tried(lambda: dyn.robust_fit(case.invariant, *points, threshold=3.0, starts=(1, 4), generator=seed(0), **given)),
    }  # fmt: skip


# ---- other verbs -----------------------------------------------------------------------------------------------------------
MOTIONS = {
    "static_2d": 30, "static_3d": 30, "constant_direction_2d": 40, "constant_velocity_2d": 40, "constant_acceleration_2d": 60,
    "constant_direction_3d": 40, "constant_velocity_planes_3d": 60, "constant_velocity_3d": 80, "constant_velocity_3d_sensors": 60,
    "two_bodies_2d": 60, "two_bodies_3d": 60,
}  # fmt: skip


def points_3d(model: str, **options: Any) -> Any:
    """Align three views of points of space as a model has them."""
    sensors = {"join": "projective", "minimal_join": "projective", "constant_velocity": "projective", "rigid": "rigid"}
    kind = scenes.constant_velocity if "velocity" in model else scenes.moving_points
    scene = kind(120, sensors=sensors.get(model, "affine"), sigma=2e-3, static=0.5, outliers=0.1, generator=seed(5))
    return shown(dyn.align_points(*scene.views, model=model, generator=seed(0), **options))  # type: ignore[arg-type]


def planar(threshold: float | None = 1.5) -> Any:
    scene = scenes.planar(90, sigma=0.5, static=0.4, outliers=0.15, batch=2, generator=seed(4))
    return shown(dyn.align_planar(*scene.views, threshold=threshold, generator=seed(0)))


def bodies(*counts: int, **options: Any) -> Any:
    scene = scenes.bodies(counts, bodies=len(counts), sigma=0.4, outliers=0.15, generator=seed(4))
    return shown(dyn.segment(*scene.views, generator=seed(0), **options))


def reconstructed(motion: str, asked: str = "", **options: Any) -> Any:
    """Reconstruct tracks of a motion, of which some are wrong, as those of this motion or as another word asks."""
    sigma = 2e-3 if motion.endswith("sensors") else 0.3
    scene = scenes.lifted_points(motion, MOTIONS[motion], sigma=sigma, outliers=0.05, generator=seed(7))
    times = None if scene.lifts is None else scene.times
    return shown(dyn.reconstruct(scene.tracks, asked or motion, times=times, generator=seed(0), **options))


def shifted(correspondence: bool, **options: Any) -> Any:
    if not correspondence:
        pair = scenes.nonrigid_pair(10, 8, 90, sigma=0.3, offset=0.2, generator=seed(1))
        return shown(dyn.synchronize(pair.a, pair.b, False, fps=pair.fps, generator=seed(0), **options))
    scene = scenes.filmed_person(12, 3.0, offset=0.37, noise=0.7, missing=0.05, fps=(30.0, 25.0), generator=seed(1))
    return shown(dyn.synchronize(scene.a, scene.b, True, times=scene.times, generator=seed(0), **options))


def counts() -> Any:
    names = sorted(counting.CONFIGURATIONS)
    small = [name for name in names if not name.startswith("shape")]
    return {
        "dim_v": {f"{n} {m} {k}": counting.dim_v(n, m, k) for n in range(1, 6) for m in range(1, 5) for k in range(1, 4)},
        "closed": [counting.dim_v_closed_form(4, 3, codim) for codim in (1, 2, 3)], "names": names,
        "options": {name: sorted(counting.options_of(name)) for name in names},
        "count": {name: tried(partial(counting.count, name)) for name in [*small, *MOTIONS]},
        "tableaux": (counting.standard_tableaux((3, 2, 1)), counting.semistandard_tableaux((2, 1), 4)),
    }  # fmt: skip


def errors() -> Any:
    a, b = normal(2, 3, 3), normal(2, 3, 3, number=1)
    rigid = [torch.block_diag(torch.linalg.qr(x[0]).Q, torch.ones(1, 1, dtype=x.dtype)) for x in (a, b)]
    labels, truth = torch.arange(20) % 3, torch.arange(20) % 4
    return {
        "relative": metrics.relative_error(a, b), "grid": metrics.grid_transfer_error(a, b, 640, 480),
        "rotation": metrics.rotation_error(*rigid), "translation": metrics.translation_error(*rigid),
        "labels": metrics.label_scores(labels, truth), "wrong": metrics.misclassification(labels, truth),
        "gauge": tried(lambda: metrics.affine_gauge(normal(3, 4, 4), normal(3, 4, 4, number=1))),
    }  # fmt: skip


# ---- refusals --------------------------------------------------------------------------------------------------------------
def refusals() -> Any:
    """What is said to bad input, and what of data that cannot decide."""
    x1, x2, x3 = scenes.planar(40, static=1.0, sigma=0.5, generator=seed(0)).views
    still = torch.zeros(40, 6, 2, dtype=torch.float64) + normal(6, 2)
    calls: dict[str, Callable[[], Any]] = {
        "views": lambda: dyn.fit(dyn.HomographyTensor, x1, x2),
        "name": lambda: dyn.fit("homography", x1, x2, x3),  # type: ignore[arg-type]
        "size": lambda: dyn.fit(dyn.FundamentalMatrix, x1, x2[:-1]), "dims": lambda: dyn.fit(dyn.JoinTensor, x1, x2, x3),
        "weights": lambda: dyn.fit(dyn.FundamentalMatrix, x1, x2, weights=-torch.ones(40)),
        "matrix": lambda: dyn.null_space(normal(3), 1),
        "threshold": lambda: dyn.align_planar(x1, x2, x3, threshold=-1.0),
        "model": lambda: dyn.align_points(x1, x2, x3, model="bent"),  # type: ignore[arg-type]
        "flat": lambda: dyn.align_points(x1, x2, x3), "bodies": lambda: dyn.segment(x1, x2, bodies=0),
        "few": lambda: dyn.segment(x1[:4], x2[:4]),
        "motion": lambda: dyn.reconstruct(torch.stack([x1, x2]), "curved"),
        "two views": lambda: dyn.reconstruct(torch.stack([x1, x2]), "constant_velocity_3d"),
        "clock": lambda: dyn.synchronize(still, still, fps=-1.0),
        "nothing moves": lambda: shown(dyn.synchronize(still, still, fps=30.0)),
        "planes": lambda: dyn.translating_planes(), "still": lambda: shown(dyn.fit(dyn.HomographyTensor, x1, x2, x3)),
        "check": lambda: dyn.fit(dyn.HomographyTensor, x1[:9], x2[:9], x3[:9]).check(), "dim": lambda: counting.dim_v(0, 1, 1),
        "count": lambda: counting.count("fundamentals"), "profile": lambda: dyn.GrassmannTensor(4, (2, 2, 2)),
        "lone camera": lambda: dyn.synchronize_cameras([still], fps=30.0), "lift": lambda: dyn.Motion(),
    }  # fmt: skip
    return {name: tried(call) for name, call in calls.items()}


def table() -> Table:
    """All cases."""
    found: Table = {f"linear {case!r} {i}": partial(linear, case) for i, case in enumerate(INVARIANTS)}
    found |= {f"robust {case!r} {i}": partial(robust, case) for i, case in enumerate(INVARIANTS)}
    found |= {f"shape {case!r}": partial(shapes, case) for case in SHAPE_CASES}
    found |= {f"verb {verb.name}": lambda verb=verb: shown(verb.call(*verb.inputs())) for verb in VERBS}
    models = ("join", "minimal_join", "constant_velocity", "affine_constant_velocity", "rigid")
    found |= {f"align_points {model}": partial(points_3d, model) for model in models}
    found |= {f"reconstruct {motion}": partial(reconstructed, motion, threshold=None) for motion in MOTIONS}
    return found | {
        "align_points rigid velocity": partial(points_3d, "rigid", motion="constant_velocity"),
        "align_planar": planar, "align_planar auto": partial(planar, None), "segment": partial(bodies, 90, 60, 40),
        "segment known": partial(bodies, 70, 50, bodies=2, spatial=False),
        "segment auto": partial(bodies, 80, 50, threshold=None),
        "reconstruct robust": partial(reconstructed, "static_3d", threshold=1.0),
        "reconstruct auto": partial(reconstructed, "constant_velocity_2d", "auto"),
        "synchronize same": partial(shifted, True), "synchronize different": partial(shifted, False),
        "synchronize rate": partial(shifted, True, rate=1.0, max_shift=1.0),
        "counting": counts, "metrics": errors, "refusals": refusals,
    }  # fmt: skip

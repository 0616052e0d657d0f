"""One small problem for every public verb, and how often it may make the host wait for a device."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

import dyntorch as dyn
from dyntorch import scenes
from dyntorch.geometry.rigid import rotation_exponential
from tests.draws import random as randn
from tests.draws import seeded as draw

F64 = torch.float64


@dataclass(frozen=True)
class Verb:
    """One call of a public verb."""

    name: str
    """The public name, and after a space what is special about the call."""
    inputs: Callable[[], tuple[Any, ...]]
    """Tensors, or sequences and mappings of them, on the CPU."""
    call: Callable[..., Any]
    """The call on these inputs, wherever they are; a generator is made inside, so that every call draws the same numbers."""
    compare: Callable[[Any], Any] = lambda result: result
    """The part of the result that is defined: signs and bases that are free may differ."""
    tolerance: float = 1e-6
    """Of numbers, relative to the largest of their tensor."""

    @property
    def waits(self) -> int:
        """Most host waits of this call."""
        return WAITS.get(self.name.split()[0], 0)

    def __repr__(self) -> str:
        return self.name.replace(" ", "-")


def inhomogeneous(x: Tensor) -> Tensor:
    return x[..., :-1] / x[..., -1:]


# ---- inputs ------------------------------------------------------------------------------------------------------------
def planar() -> tuple[Tensor, ...]:
    return scenes.planar(40, static=0.4, sigma=0.2, generator=draw(3)).views


def cameras_and_points() -> tuple[Tensor, Tensor, Tensor]:
    """Cameras ``(3, 3, 4)``, points ``(12, 4)`` and images ``(3, 12, 2)``."""
    cameras = torch.eye(3, 4, dtype=F64) + torch.rand(3, 3, 4, generator=draw(), dtype=F64) / 4
    structure = torch.rand(12, 4, generator=draw(1), dtype=F64) + 1
    return cameras, structure, dyn.geometry.reproject(cameras, structure)


def tracks(motion: str, n: int, views: int, **options: Any) -> tuple[Tensor]:
    return (scenes.lifted_points(motion, n, views=views, generator=draw(3), **{"sigma": 0.3, **options}).tracks,)


def two_bodies() -> tuple[Tensor, ...]:
    return scenes.bodies((30, 30), sigma=0.3, generator=draw(1)).views


def projector(columns: Tensor) -> Tensor:
    """Onto what the columns of a matrix span."""
    basis = torch.linalg.qr(columns).Q
    return basis @ basis.mT


def driven() -> tuple[Tensor, Tensor]:
    """Tracks ``(6, 60, 2)`` of a street with one car, and its cameras."""
    street = scenes.streets(2, frames=6, tracks=60, sigma=0.1, generator=draw(3))
    return street.tracks, street.cameras


def planes(count: int = 5, bodies: int = 0) -> scenes.TranslatingScene:
    return scenes.translating_planes(count, bodies, sigma=0.1, n=20, generator=draw(2))


def filmed(n: int = 8, **options: Any) -> tuple[Tensor, Tensor]:
    scene = scenes.filmed_person(n, 2.5, offset=0.2, noise=0.3, generator=draw(2), **options)
    return scene.a, scene.b


def walkers() -> tuple[Tensor, ...]:
    """Images ``(90, 6, 2)`` in three cameras of points that go smooth ways of their own."""
    t, phase = torch.arange(90, dtype=F64)[:, None, None] / 30, randn(3, 6, 3)
    body = 0.5 * phase[0] + 0.6 * torch.sin(1.3 * t + phase[1]) + 0.3 * torch.sin(2.9 * t + phase[2])
    views = []
    for k in range(3):
        turn = rotation_exponential(torch.tensor([0.3 * (k % 2), 1.5 * k, 0.0], dtype=F64))
        views.append(1500 * inhomogeneous(body @ turn.mT + torch.tensor([0.1 * k, 0.0, 5.0])) + torch.tensor([960.0, 540.0]))
    return tuple(views)


def nonrigid() -> tuple[Tensor, Tensor]:
    scene = scenes.nonrigid_pair(8, 8, 60, sigma=0.2, offset=0.12, generator=draw(1))
    return scene.a, scene.b


def paths() -> tuple[Tensor, Tensor]:
    """Cameras ``(6, 3, 4)`` and images ``(6, 10, 2)`` of points on straight lines, each at a speed of its own."""
    cameras = torch.cat([torch.eye(3, dtype=F64) + 0.1 * randn(6, 3, 3, seed=1), randn(6, 3, 1, seed=2)], -1)
    start = torch.cat([randn(10, 2, seed=3), 6 + randn(10, 1, seed=4), torch.ones(10, 1, dtype=F64)], -1)
    way = torch.cat([randn(10, 3, seed=5) / 3, torch.zeros(10, 1, dtype=F64)], -1)
    points = start + torch.arange(6, dtype=F64)[:, None, None] * way
    return cameras, inhomogeneous(points @ cameras.mT)


def deforming_images() -> tuple[Tensor, Tensor]:
    """Images of a thing that is a mixture of two shapes, by two affine cameras fixed to each other."""
    mixed = randn(20, 2, seed=5) @ randn(2, 30, seed=6)
    first, second = (mixed.unflatten(1, (10, 3)) @ randn(2, 1, 3, 2, seed=7)).unbind(0)
    return first, second


def moving_shapes() -> tuple[Tensor, Tensor, Tensor]:
    """Tracks ``(12, 8, 2)``, rows ``(12, 2)`` and points ``(2, 8, 3)`` of a shape at constant velocity."""
    rows = dyn.Polynomial(1).rows(torch.linspace(-1, 1, 12, dtype=F64))
    points, cameras = randn(2, 8, 3), randn(12, 3, 2, seed=1)
    return torch.einsum("vb,bnk,vkd->vnd", rows, points, cameras), rows, points


def still_shape(frame: str) -> tuple[Tensor, ...]:
    """Six points (affine: five, whose tensor is one row), ``(6, 2)`` each: what six cameras see of them."""
    structure, cameras = randn(5 if frame == "affine" else 6, 4), randn(6, 4, 3, seed=1)
    if frame == "plane":
        structure[:4, 2] = 0.0
    if frame == "affine":
        structure[:, 3], cameras[:, :3, 2], cameras[:, 3, 2] = 1.0, 0.0, 1.0
    x = inhomogeneous(structure @ cameras)
    return (x + 1e-4 * randn(*x.shape, seed=2)).unbind(-2)


def lifted_shape() -> tuple[Tensor, ...]:
    """Eight points of P^4, ``(14, 2)`` each: what as many projections to the plane see of them."""
    x = inhomogeneous(randn(8, 5) @ randn(14, 5, 3, seed=1))
    return (x + 1e-4 * randn(*x.shape, seed=2)).unbind(-2)


def timed_shape() -> tuple[Tensor, ...]:
    """Twelve times, and eight points ``(12, 2)`` at constant velocity."""
    x = moving_shapes()[0]
    return (torch.linspace(0, 3, 12, dtype=F64), *(x + 1e-4 * randn(*x.shape, seed=2)).unbind(-2))


def labelled_points() -> tuple[Tensor, ...]:
    """Three views ``(12, 3)`` of points of space, and which of them are known to stand still."""
    scene = scenes.moving_points(12, static=0.7, sigma=0.0, generator=draw(1))
    return (*scene.views, scene.labels == 1)


def affine_tracks() -> tuple[Tensor]:
    """``(5, 20, 2)`` orthographic images of one rigid body."""
    turn, _ = torch.linalg.qr(randn(5, 3, 3, seed=4))
    return (randn(20, 3) @ turn[:, :2].mT + randn(5, 1, 2, seed=5),)


def two_hyperplanes() -> Tensor:
    """``(12, 4)``: seven points of body 1 and five of body 2."""
    structure = torch.rand(12, 4, generator=draw(1), dtype=F64)
    structure[:, 2], structure[:, 3] = 1.0, torch.arange(12) >= 7
    return structure


def two_body_cameras() -> tuple[Tensor, ...]:
    """Projections ``(2, 3, 4)``, structure, hyperplanes and labels of two bodies that translate."""
    structure, first = two_hyperplanes(), torch.rand(2, 3, 3, generator=draw(2), dtype=F64)
    way = torch.tensor([[0.3, 0.2], [0.1, -0.4]], dtype=F64)
    pair = dyn.geometry.hyperplane_pair(structure)
    return torch.cat([first, first[:, :, :2] @ way[..., None]], -1), structure, pair.hyperplanes, pair.labels


def affine_bodies() -> tuple[Tensor, Tensor]:
    """Two views ``(20, 2)`` of two bodies, 12 and 8 points."""
    points, cameras = torch.rand(20, 3, generator=draw(), dtype=F64), torch.rand(2, 3, 2, generator=draw(1), dtype=F64)
    return points[:, :2], torch.cat([points[:12] @ cameras[0], points[12:] @ cameras[1] + 0.3])


def lens() -> tuple[Tensor, ...]:
    matrix = torch.tensor([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]], dtype=F64)
    return randn(9, 2) * 100 + 300, matrix, torch.tensor([-0.2, 0.05, 0, 0], dtype=F64)


def motion_and_views() -> tuple[Any, ...]:
    return scenes.planar(40, generator=draw(3)).motion, *planar()


def shift(offset: float) -> dyn.Shift:
    """A shift that stands out alone."""
    peaks, none = torch.tensor([[offset, 1.0]], dtype=F64), torch.zeros(0, dtype=F64)
    return dyn.Shift(offset, 0.01, 1.0, 0.0, 0.9, peaks, "epipolar", (30.0, 30.0), 0.0, none, none, status=torch.tensor(0))


# ---- calls that take several steps -------------------------------------------------------------------------------------
def shape_tensor(tensor: dyn.Invariant, points: tuple[Tensor, ...]) -> tuple[Any, ...]:
    """A shape tensor from fit to use."""
    found = dyn.refine(dyn.fit(tensor, *points), *points)
    family = found.invariant
    return found, family.score(found.tensor, *points), dyn.sampson(family, found.tensor, *points)


def dynamic_shape_tensor(form: Any, times: Tensor, points: tuple[Tensor, ...]) -> tuple[Any, ...]:
    """A dynamic one from fit to use; the form "span" tells no times."""
    found = dyn.refine(dyn.fit(dyn.DynamicShapeTensor(form=form), *points, times=times), *points, times=times)
    family = found.invariant
    recovered = () if form == "span" else (family.recover(found.tensor, *points),)
    return found, family.score(found.tensor, *points), *recovered


def without_frame(result: tuple[Any, ...]) -> tuple[Any, ...]:
    """What a shape tensor gave, without its refined structure, whose frame is free."""
    found, *rest = result
    return found.tensor, found.status, found.singular_values, *rest


# ---- the table ---------------------------------------------------------------------------------------------------------
H = dyn.HomographyTensor
LENS = (torch.diag(torch.tensor([1000.0, 1000, 1])), [-0.1, 0, 0, 0])
VERBS: tuple[Verb, ...] = (
    Verb("fit", planar, lambda *x: dyn.fit(H, *x)),
    Verb("fit weights", lambda: (*planar(), torch.linspace(0.5, 1.5, 40, dtype=F64)), lambda *x: dyn.fit(H, *x[:3], weights=x[3])),
    Verb("robust_fit", planar, lambda *x: dyn.robust_fit(H, *x, threshold=1.5, generator=draw())),
    Verb("refine", planar, lambda *x: dyn.refine(dyn.fit(H, *x), *x)),
    Verb(
        "constrain",
        lambda: scenes.lifted_points("constant_velocity_2d", 30, times=(0, 4, 9), sigma=0.3, generator=draw()).tracks.unbind(0),
        lambda *x: dyn.constrain(dyn.fit(dyn.GrassmannTensor(4, (2, 2, 1)), *x)),
    ),
    Verb("sampson", motion_and_views, lambda m, *x: dyn.sampson(H, H.compose(*m), *x)),
    Verb("algebraic", motion_and_views, lambda m, *x: dyn.core.algebraic(H, H.compose(*m), *x)),
    Verb("null_space", lambda: (randn(3, 12, 9),), dyn.null_space),
    Verb("align_planar", planar, lambda *x: dyn.align_planar(*x, threshold=1.5, generator=draw())),
    Verb(
        "plane_motions",
        lambda: (torch.eye(3, dtype=F64) + 0.2 * randn(4, 3, 3),),
        dyn.geometry.plane_motions,
        # the two solutions come in either order
        compare=lambda found: (found.rotations.sum(-3), found.translations.sum(-2), found.normal.sum(-2)),
    ),
    Verb(
        "align_planar calibration",
        planar,
        lambda *x: dyn.align_planar(*x, threshold=1.5, calibration=torch.diag(torch.tensor([900.0, 900, 1])), generator=draw()),
    ),
    Verb(
        "align_planar four views",
        lambda: scenes.planar(40, static=0.4, sigma=0.2, views=4, generator=draw(3)).views,
        lambda *x: dyn.align_planar(*x, threshold=1.5, generator=draw()),
    ),
    Verb(
        "DynamicTensor motion",
        lambda: scenes.dynamic(2, 4, 2, 90, static=0.2, sigma=1e-3, generator=draw(3)).views,
        lambda *x: (lambda fitted: (dyn.refine(fitted, *x).motion, dyn.sampson(fitted.invariant, fitted.tensor, *x)))(
            dyn.fit(dyn.DynamicTensor(2, 4, 2), *x)
        ),
    ),
    *(
        Verb(
            f"align_points {model}",
            lambda n=n, static=static, sensors=sensors: (
                scenes.constant_velocity(n, static=static, sigma=1e-3, generator=draw(2), sensors=sensors).views
            ),
            lambda *x, model=model: dyn.align_points(*x, model=model, threshold=0.02, generator=draw()),
        )
        for model, sensors, n, static in (
            ("constant_velocity", "projective", 24, 0.0),
            ("affine_constant_velocity", "affine", 30, 0.4),
        )
    ),
    Verb(
        "align_points join labelled",
        labelled_points,
        lambda *x: dyn.align_points(*x[:3], static=x[3], threshold=0.02, generator=draw()),
    ),
    Verb(
        "align_points rigid",
        lambda: scenes.constant_velocity(40, static=0.4, sigma=1e-3, generator=draw(1), sensors="rigid").views,
        lambda *x: dyn.align_points(*x, model="rigid", motion="straight", threshold=0.02, generator=draw()),
    ),
    Verb(
        "align_lines",
        lambda: scenes.translating_lines(60, sigma=1e-4, generator=draw()).views,
        lambda *x: dyn.align_lines(*x, threshold=0.01, generator=draw()),
    ),
    Verb("segment", two_bodies, lambda *x: dyn.segment(*x, bodies=2, spatial=False, generator=draw())),
    Verb("segment_tracks", lambda: driven()[:1], lambda x: dyn.segment_tracks(x, 2, generator=draw())),
    Verb("segment_tracks cameras", driven, lambda x, cameras: dyn.segment_tracks(x, 2, cameras=cameras, generator=draw())),
    Verb("translating_planes", lambda: (planes().homographies,), dyn.translating_planes),
    Verb(
        "translating_planes bodies",
        lambda: (planes(2, 1).homographies, planes(2, 1).body_fundamentals),
        lambda h, f: dyn.translating_planes(h, fundamentals=f),
    ),
    Verb(
        "reconstruct",
        lambda: (*tracks("constant_velocity_2d", 24, 4, times=None), torch.tensor([0.0, 1, 2, 3], dtype=F64)),
        lambda x, t: dyn.reconstruct(x, "constant_velocity_2d", t, generator=draw()),
    ),
    Verb("synchronize", filmed, lambda a, b: dyn.synchronize(a, b, fps=30.0, rate=1.0, max_shift=1.0, generator=draw())),
    Verb(
        "synchronize calibration",
        filmed,
        lambda a, b: dyn.synchronize(a, b, fps=30.0, rate=1.0, max_shift=1.0, generator=draw(), calibration=(LENS,) * 2),
    ),
    Verb(
        "synchronize_cameras",
        lambda: (*filmed(), filmed()[0]),
        lambda *x: dyn.synchronize_cameras(list(x), fps=30.0, rate=1.0, max_shift=1.0),
    ),
    Verb("breaks", filmed, lambda a, b: dyn.tasks.breaks(a, b, shift(0.2), fps=30.0, max_shift=1.0)),
    Verb(
        "camera_breaks",
        lambda: (*filmed(), filmed()[0]),
        lambda *x: dyn.tasks.camera_breaks(
            list(x), dyn.combine_shifts({(0, 1): shift(0.2), (0, 2): shift(0.0), (1, 2): shift(-0.2)}, 3), fps=30.0, max_shift=1.0
        ),
    ),
    Verb(
        "combine_shifts",
        lambda: ({(0, 1): shift(1.0), (0, 2): shift(3.0), (1, 2): shift(2.01)},),
        lambda shifts: dyn.combine_shifts(shifts, 3),
    ),
    Verb(
        "calibrate",
        walkers,
        lambda *x: dyn.calibrate(list(x), fps=30.0, sizes=(1920, 1080), clocks=[0.0, 0.0, 0.0]),
        tolerance=1e-5,
    ),
    Verb("reconstruct_pair", nonrigid, lambda a, b: dyn.reconstruct_pair(a, b, 0.12, fps=25.0)),
    Verb(
        "fit_distortion",
        lambda: scenes.two_view(60, sigma=0.1, generator=draw()).views,
        lambda *x: dyn.geometry.fit_distortion(*x, sizes=((640, 480),) * 2),
    ),
    Verb("undistort", lens, dyn.geometry.undistort),
    Verb("distort", lens, dyn.geometry.distort),
    Verb("triangulate_trajectories", paths, dyn.triangulate_trajectories),
    Verb(
        "triangulate_trajectories four-views",  # two lines meet the rays of four views: which is first is chance
        lambda: tuple(part[:4] for part in paths()),
        dyn.triangulate_trajectories,
        compare=lambda found: (found.status, found.residual),
    ),
    Verb("points_on_lines", lambda: (*paths(), dyn.triangulate_trajectories(*paths()).lines), dyn.tasks.points_on_lines),
    Verb(
        "trajectory_cameras",
        lambda: (inhomogeneous((randn(1, 728, 4) + randn(6, 728, 1, seed=1) * randn(728, 4, seed=2)) @ randn(6, 3, 4, seed=3).mT),),
        lambda x: dyn.trajectory_cameras(x, bundle=False),
    ),
    Verb("line_camera", lambda: (randn(2, 3, 4),), dyn.geometry.line_camera),
    Verb(
        "triangulate",
        lambda: (cameras_and_points()[0], cameras_and_points()[2]),
        lambda c, x: dyn.geometry.triangulate(c, x, steps=2),
    ),
    Verb("resect", lambda: cameras_and_points()[1:], dyn.geometry.resect),
    Verb("reproject", lambda: cameras_and_points()[:2], dyn.geometry.reproject),
    Verb(
        "bundle_adjust",
        lambda: (cameras_and_points()[2], cameras_and_points()[0] + 1e-3 * randn(3, 3, 4), cameras_and_points()[1]),
        lambda x, c, y: dyn.geometry.bundle_adjust(x, None, c, y),
    ),
    Verb("grassmann_tensor", lambda: (cameras_and_points()[0][:2],), lambda p: dyn.geometry.grassmann_tensor(p, (2, 2))),
    Verb(
        "joint_epipoles",
        lambda: (
            [torch.cat([p, t * (p @ torch.tensor([1.0, 2, 2, 0], dtype=F64))[:, None]], -1) for t, p in enumerate(randn(3, 3, 4))],
        ),
        dyn.geometry.joint_epipoles,
    ),
    Verb("hyperplane_pair", lambda: (two_hyperplanes(),), dyn.geometry.hyperplane_pair),
    Verb(
        "two_bodies",
        two_body_cameras,
        dyn.geometry.two_bodies,
        # the affine frame of the world is free: what its cameras span is not
        compare=lambda found: (projector(found.cameras[..., 0, :, :, :-1].flatten(-3, -2)), found.determined),
    ),
    Verb("affine_segmentation", lambda: affine_bodies(), dyn.tasks.affine_segmentation),
    Verb(
        "multibody_matrix",
        lambda: tuple(x.flatten(0, 1)[:40] for x in scenes.two_view(24, batch=2, generator=draw()).views),
        lambda a, b: dyn.invariants.multibody_matrix(a, b, 2),
    ),
    Verb("projective_factorization", lambda: (cameras_and_points()[2],), lambda x: dyn.tasks.projective_factorization(x, 4)),
    Verb(
        "velocity_factorization",
        lambda: (
            (randn(12, 3) + torch.arange(6, dtype=F64)[:, None, None] * randn(12, 3, seed=1)) @ randn(6, 3, 2, seed=2),
            torch.arange(6, dtype=F64),
        ),
        dyn.tasks.velocity_factorization,
        compare=lambda found: found.points @ found.cameras.mT + found.offsets[:, None],  # the frame of the world is free
    ),
    Verb("fit_shapes", lambda: moving_shapes()[:2], dyn.shapes.fit_shapes),
    Verb(
        "recover_times",
        lambda: (moving_shapes()[2], moving_shapes()[0]),
        lambda s, x: dyn.shapes.recover_times(s, dyn.Polynomial(1), x),
    ),
    Verb("fit_perspective_shapes", lambda: moving_shapes()[:2], dyn.shapes.fit_perspective_shapes, tolerance=1e-4),
    Verb(
        "deformable_shapes",
        deforming_images,
        lambda a, b: dyn.shapes.deformable_shapes(a, b, 2),
        # mirrored shapes before mirrored cameras fit alike
        compare=lambda found: (found.status, found.coefficients.abs(), found.points.square().sum(-1), found.residual, found.sigma),
        tolerance=1e-4,
    ),
    Verb(
        "recover_perspective_times",
        lambda: (moving_shapes()[2], moving_shapes()[0]),
        lambda s, x: dyn.shapes.recover_perspective_times(s, dyn.Polynomial(1), x),
        tolerance=1e-4,
    ),
    Verb(
        "canonical_correlation",
        lambda: (randn(2, 20, 2), randn(2, 20, 2, seed=1)),
        lambda a, b: dyn.numerics.canonical_correlation(dyn.numerics.orthonormal_basis(a), dyn.numerics.orthonormal_basis(b)),
    ),
    Verb("orthonormal_basis", lambda: (randn(2, 20, 2),), dyn.numerics.orthonormal_basis),
    *(
        Verb(
            f"ShapeTensor {frame}",
            lambda frame=frame: still_shape(frame),
            lambda *p, frame=frame: shape_tensor(dyn.ShapeTensor(frame), p),
            compare=without_frame,
            tolerance=1e-4,  # of distances and of times: descents stop where the cost does, at the root of its digits
        )
        for frame in ("general", "plane", "affine")
    ),
    Verb(
        "LiftedShapeTensor",
        lifted_shape,
        lambda *p: shape_tensor(dyn.LiftedShapeTensor(4), p),
        compare=without_frame,
        tolerance=1e-4,
    ),
    *(
        Verb(
            f"DynamicShapeTensor {form}",
            timed_shape,
            lambda t, *p, form=form: dynamic_shape_tensor(form, t, p),
            compare=without_frame,
            tolerance=1e-4,
        )
        for form in ("joint", "basis", "span")
    ),
    Verb(
        "affine_factorization",
        affine_tracks,
        dyn.numerics.affine_factorization,
        # the signs of singular vectors are free
        compare=lambda found: (found[0][..., None, :, :] @ found[1], found[2]),
    ),
    Verb("metric_upgrade", lambda: dyn.numerics.affine_factorization(*affine_tracks())[:2], dyn.numerics.metric_upgrade),
)

WAITS = {
    # for every fit one for the certificates of the null space and one for what looks weak; one where weights are given; one for
    # every step of a descent, on whether all problems are done, beside hundreds of kernels; one for every round of starts or notice
    "fit": 3,
    "robust_fit": 35,
    "refine": 32,
    "constrain": 32,
    "align_planar": 120,
    "align_points": 250,
    "align_lines": 60,
    "translating_planes": 150,
    "bundle_adjust": 50,
    "fit_shapes": 60,
    "fit_perspective_shapes": 150,
    "deformable_shapes": 16,
    "ShapeTensor": 40,
    "LiftedShapeTensor": 60,
    "DynamicShapeTensor": 60,
    "DynamicTensor": 40,
    # one for every question on values: what is given, what decides
    "recover_perspective_times": 2,
    "velocity_factorization": 8,
    "metric_upgrade": 4,
    **dict.fromkeys(("affine_factorization", "recover_times", "triangulate_trajectories", "hyperplane_pair", "two_bodies"), 1),
    **dict.fromkeys(("affine_segmentation", "multibody_matrix"), 1),
    # computes on the CPU (dyntorch.numerics.arguments.on_cpu): one copy for every tensor that comes in
    **dict.fromkeys(("trajectory_cameras", "projective_factorization"), 1),
    **dict.fromkeys(("segment", "segment_tracks", "reconstruct", "synchronize", "breaks", "reconstruct_pair", "fit_distortion"), 2),
    "synchronize_cameras": 3,
    "camera_breaks": 3,
    "calibrate": 3,
    "combine_shifts": 12,
}
"""Public names that wait for the device, how often a call of the table does at most, and why.  Measured: 2 (fit), 17, 27, 5, 64,
7 to 75, 22 and 58 to 86, 34 (fit_shapes), 7 to 24 (ShapeTensor), 7 to 41; before they were lent to the CPU: synchronize 300 to 900,
reconstruct 33 to 1,000."""

ROOMS = ("core", "geometry", "invariants", "numerics", "shapes", "tasks")
"""Faces that hand on public names beside those of the top level."""
PUBLIC = {name: getattr(face, name) for face in (dyn, *(getattr(dyn, room) for room in ROOMS)) for name in face.__all__}
NOT_VERBS = {
    *("counting", "metrics", "motions", "scenes"),  # modules
    # tools of verbs
    *("on_cpu", "one_thread", "map_blocks", "check_options", "with_names", "with_words", "as_python", "status_from", "native"),
    *("native_correlations", "native_deviations", "native_residuals"),
    # names, numbers and what results say
    *("Message", "Notice", "BodyModel", "LineStatus", "Status", "Motion", "MotionName", "MOTION_MODELS", "Polynomial", "Fourier"),
    *("NoticeCode", "Invariant", "MovingShapes", "Recovery", "Outcome", "DecisionModel"),
    *(name for name in PUBLIC if name.endswith("Options")),
    # results, and invariants: tests/battery/on_input.py takes each of them to a device
    *(name for name, value in PUBLIC.items() if isinstance(value, type) and issubclass(value, dyn.core.Outcome | dyn.Invariant)),
} - {verb.name.split()[0] for verb in VERBS}
"""Public names that compute nothing by themselves."""

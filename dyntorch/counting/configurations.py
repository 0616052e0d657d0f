"""Configurations of the invariants by name: which matches each takes, in which order, and the rows they give.

A configuration is a function of a field and of the numbers of matches of each kind.  Its first keyword, whose default is None,
is the kind that it is usually estimated from; None takes as many as raise the rank.  It returns its steps with that kind last.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from dyntorch.counting.exact import Configuration, Field, IntArray, Measure, Step, Views
from dyntorch.counting.lifted import MOTIONS
from dyntorch.counting.shapes import dynamic_shape, lifted_shape


def homography(
    field: Field, *, moving: int | None = None, static: int = 0, labelled_static: int = 0, lines: Sequence[int] = (),
    static_lines: Sequence[int] = (), on_line: int = 0, static_on_line: int = 0,
) -> list[Step]:  # fmt: skip
    """Points of a plane that move along straight lines, three views: homography tensor, 3x3x3."""
    views = Views(field, 2, (2, 2, 2), ("join",) * 3)
    within = _confined_points(views, 2, on_line=on_line, static_on_line=static_on_line)
    return _moving_points(views, moving, static, labelled_static, lines, static_lines, within)


def dual_homography(
    field: Field, *, moving: int | None = None, static: int = 0, labelled_static: int = 0, static_points: int = 0
) -> list[Step]:
    """Lines of a plane that meet in a point, three views: dual homography tensor, 3x3x3."""
    dual = Views(field, 2, (2, 2, 2), ("join",) * 3)  # of the dual plane: its points are lines, its lines are pencils
    return [
        Step("static point", static_points, lambda: dual.filled(dual.extensor(2))),
        *_moving_points(dual, moving, static, labelled_static, (), ()),
    ]


def join(
    field: Field, *, moving: int | None = None, static: int = 0, labelled_static: int = 0, lines: Sequence[int] = (),
    static_lines: Sequence[int] = (), on_plane: int = 0, on_line: int = 0, static_on_plane: int = 0, static_on_line: int = 0,
) -> list[Step]:  # fmt: skip
    """3D points that move along straight lines, three poses: join tensors, 4x4x4."""
    views = Views(field, 3, (3, 3, 3), ("join",) * 3)
    within = _confined_points(views, 2, on_plane, on_line, static_on_plane, static_on_line)
    return _moving_points(views, moving, static, labelled_static, lines, static_lines, within)


def minimal_join(
    field: Field, *, moving: int | None = None, static: int = 0, labelled_static: int = 0, lines: Sequence[int] = (),
    static_lines: Sequence[int] = (), on_plane: int = 0, on_line: int = 0, static_on_plane: int = 0, static_on_line: int = 0,
) -> list[Step]:  # fmt: skip
    """3D points that move along straight lines, the third pose through a camera: minimal join tensor, 4x4x3."""
    views = Views(field, 3, (3, 3, 2), ("join",) * 3)
    within = _confined_points(views, 2, on_plane, on_line, static_on_plane, static_on_line)
    return _moving_points(views, moving, static, labelled_static, lines, static_lines, within)


def dynamic(
    field: Field, *, moving: int | None = None, static: int = 0, labelled_static: int = 0, on_plane: int = 0, on_line: int = 0,
    static_on_plane: int = 0, static_on_line: int = 0, dim: int = 3, poses: int = 4, within: int = 3,
) -> list[Step]:  # fmt: skip
    """Points of P^n that move within flats, any number of views: dynamic tensor; without other numbers in planes, 4x4x4x4."""
    if not 1 <= within <= dim or poses <= within:
        raise ValueError(
            f"expected 1 <= within <= dim and poses > within, got within = {within}, dim = {dim}, poses = {poses}: within counts "
            "the points that span the flat of a match, 2 for a line"
        )
    join_of_points: list[Measure | int] = ["join"] * poses
    space = Views(field, dim, (dim,) * poses, join_of_points)
    return [
        Step("labelled static", labelled_static, lambda: space.labelled(space.extensor(1), free=within - 1)),
        Step("static", static, lambda: space.fixed(space.extensor(1))),
        *_confined_points(space, within, on_plane, on_line, static_on_plane, static_on_line),
        Step("moving", moving, lambda: space.moving(space.extensor(within))),
    ]


def constant_velocity(
    field: Field, *, moving: int | None = None, static: int = 0, equal_velocity: int = 0, linear_velocity: int = 0,
    planar_velocity: int = 0, on_plane: int = 0, on_line: int = 0, static_on_plane: int = 0, static_on_line: int = 0,
) -> list[Step]:  # fmt: skip
    """3D points with constant velocities, three poses: constant velocity tensor, 4x4x4."""
    confined = on_plane, on_line, static_on_plane, static_on_line
    return _velocities(field, 4, moving, static, equal_velocity, linear_velocity, planar_velocity, confined)


def constant_velocity_3x4x4(
    field: Field, *, moving: int | None = None, static: int = 0, equal_velocity: int = 0, linear_velocity: int = 0,
    planar_velocity: int = 0, on_plane: int = 0, on_line: int = 0, static_on_plane: int = 0, static_on_line: int = 0,
) -> list[Step]:  # fmt: skip
    """3D points with constant velocities, the third pose through a camera: constant velocity tensor, 3x4x4."""
    confined = on_plane, on_line, static_on_plane, static_on_line
    return _velocities(field, 3, moving, static, equal_velocity, linear_velocity, planar_velocity, confined)


def lines(
    field: Field, *, moving: int | None = None, translating: int = 0, static: int = 0, objects: Sequence[int] = (),
    static_points: int = 0, on_plane: int = 0, static_on_plane: int = 0,
) -> list[Step]:  # fmt: skip
    """3D lines that move within planes, two poses: translating lines matrix, 6x6."""
    space = Views(field, 3, (3, 3), ("join", "join"))
    plane = space.extensor(3)

    def direction() -> IntArray:
        return np.append(field.random(3), 0)

    def translated(shift: IntArray) -> IntArray:
        before = np.hstack([field.random(2, 3), np.ones((2, 1), dtype=np.int64)])
        return field.kron(*space.images([before, before + shift]))

    def static_point() -> IntArray:
        # every line through a point in one view matches every line through it in the other
        seen = [field.product(camera, point) for point in space.extensor(1) for camera in space.cameras]
        stars = [[field.join([point, corner]) for corner in np.eye(4, dtype=np.int64)] for point in seen]
        return field.kron(*stars)

    def rigid(shift: IntArray) -> Callable[[], IntArray]:
        return lambda: translated(shift)

    return [
        Step("static point", static_points, static_point),
        Step("static", static, lambda: space.fixed(space.extensor(2))),
        Step("static on plane", static_on_plane, lambda: space.fixed(space.within(plane, 2))),
        Step("on plane", on_plane, lambda: space.moving(plane, 2)),
        *(Step("object", number, rigid(direction())) for number in objects),
        Step("translating", translating, lambda: translated(direction())),
        Step("moving", moving, lambda: space.moving(space.extensor(3), 2)),
    ]


def fundamental(
    field: Field, *, static: int | None = None, coplanar: int = 0, on_plane: int = 0, on_line: int = 0
) -> list[Step]:  # fmt: skip
    """Points, two views: fundamental matrix, 3x3."""
    return _static_points(Views(field, 3, (2, 2), ("join", "join")), static, coplanar, on_plane, on_line)


def segmentation(
    field: Field, *, second: int | None = None, first: int = 27, planar_first: int = 0, planar_second: int = 0, on_line: int = 0
) -> list[Step]:
    """Points of two bodies, two views, nobody knows which: segmentation matrix, 6x6."""
    bodies = [Views(field, 3, (2, 2), ("join", "join")) for _ in range(2)]
    planes = [views.extensor(3) for views in bodies]

    def monomials(point: IntArray) -> IntArray:
        return np.outer(point, point)[np.triu_indices(3)]

    def match(views: Views, within: IntArray) -> IntArray:
        return field.kron(*(monomials(image[0]) for image in views.images([views.within(within)] * 2)))

    def on(body: int, plane: bool) -> Callable[[], IntArray]:
        views = bodies[body]
        return lambda: match(views, planes[body] if plane else views.extensor(4))

    line = bodies[0].extensor(2)
    return [
        Step("on line", on_line, lambda: match(bodies[0], line)),
        Step("planar first", planar_first, on(0, True)),
        Step("first", first, on(0, False)),
        Step("planar second", planar_second, on(1, True)),
        Step("second", second, on(1, False)),
    ]


def trifocal(
    field: Field, *, static: int | None = None, coplanar: int = 0, on_plane: int = 0, on_line: int = 0
) -> list[Step]:  # fmt: skip
    """A point in one view, lines through it in two others: trifocal tensor, 3x3x3."""
    return _static_points(Views(field, 3, (2, 2, 2), ("join", "hyper", "hyper")), static, coplanar, on_plane, on_line)


def quadrifocal(
    field: Field, *, static: int | None = None, coplanar: int = 0, on_plane: int = 0, on_line: int = 0
) -> list[Step]:  # fmt: skip
    """Lines through a point in each of four views: quadrifocal tensor, 3x3x3x3."""
    return _static_points(Views(field, 3, (2, 2, 2, 2), ("hyper",) * 4), static, coplanar, on_plane, on_line)


def shape_tensor(
    field: Field, *, images: int | None = None, synthetic: bool = False, points: int = 8, general: bool = False,
    on_plane: int = 0, on_line: int = 0,
) -> list[Step]:  # fmt: skip
    """Images of 6, 7 or 8 points, 4 of them coplanar (or general); each is a match: shape tensor, 3x3 to 3x3x3x3."""
    if points not in (6, 7, 8):
        raise ValueError(f"points must be 6, 7 or 8, got {points}")
    shape = field.random(points - 4, 4)

    def rows(seen: IntArray) -> IntArray:
        # seven points measure one and lines through two, six measure two
        measured = points - 4 if points < 7 else 8 - points
        return field.kron(*(p[None] if i < measured else field.null(p) for i, p in enumerate(seen)))

    plane, line = field.random(3, 4), field.random(2, 4)

    def image(centres: IntArray | None = None) -> IntArray:
        *shift, scale = field.random(4).tolist()
        if centres is not None:  # the camera whose centre is a point of their span
            *shift, scale = field.product(field.random(len(centres)), centres).tolist()
            if general:
                *shift, scale = (pow(int(c), -1, field.prime) for c in (*shift, -scale))
            else:
                scale = -scale
        if general:  # the camera is (diag | scale 1) once the first four points are the basis
            return rows(shape[:, :3] * np.array(shift) % field.prime + shape[:, 3:] * scale % field.prime)
        # with coplanar ones it is (scale I | shift)
        return rows(scale * shape[:, :3] % field.prime + shape[:, 3:] * np.array(shift) % field.prime)

    def concurrent() -> IntArray:
        # a camera in a point of the basis, or in the plane, sees all others in one point, wherever it likes
        shown = [*np.eye(3, dtype=np.int64), np.ones(3, dtype=np.int64)] if general else field.random(81, 3)
        return np.vstack([rows(np.tile(point, (points - 4, 1))) for point in shown])

    return [
        Step("synthetic", int(synthetic), concurrent, constraint=True),
        Step("on line", on_line, lambda: image(line)),
        Step("on plane", on_plane, lambda: image(plane)),
        Step("image", images, image),
    ]


def by_numbers(
    field: Field, *, k: int, views: Sequence[int] = (), m: int = 1, r: int = 1, measure: Measure | Sequence[Measure] = "join",
    matches: int | None = None, profile: Sequence[int] = (), static: int = 0, on_plane: int = 0, on_line: int = 0,
) -> list[Step]:  # fmt: skip
    """Primitives of ``m`` points, anywhere within extensors of ``r`` points of ``P^k``, seen in views ``P^l``."""
    if profile and measure != "join":
        raise ValueError("profile and measure exclude each other: join takes all hyperplanes through a point, hyper takes one")
    sizes = tuple(views) or (2,) * len(profile)
    kinds: Sequence[Measure | int] = tuple(profile) or ((measure,) * len(sizes) if isinstance(measure, str) else tuple(measure))
    if not sizes:
        raise ValueError("views is empty; give the projective dimension of each view, such as [2, 2, 2]")
    if profile and len(profile) != len(sizes):
        raise ValueError(f"profile must have one number for each of {len(sizes)} views, got {len(profile)}")
    if not profile and (len(kinds) != len(sizes) or set(kinds) - {"join", "hyper"}):
        raise ValueError(f"measure must be join or hyper, one word or one for each of {len(sizes)} views, got {measure!r}")
    if not 1 <= m <= r <= k + 1:
        raise ValueError(
            f"expected 1 <= m <= r <= k + 1, got m = {m}, r = {r}, k = {k}: m points lie within an extensor of r points"
        )
    for size, kind in zip(sizes, kinds, strict=True):
        if isinstance(kind, int) and not 1 <= kind <= size + 1 - m:
            raise ValueError(
                f"profile: {m} points lie in {max(size + 1 - m, 0)} hyperplanes of a view of dimension {size}, got {kind}"
            )
        if not isinstance(kind, int) and m > size + (kind == "join"):
            raise ValueError(f"{m} points have no {kind} in a view of dimension {size}; views must be larger or m smaller")
    for number, most, flat in ((on_line, 2, "a line"), (on_plane, k, f"a hyperplane of P^{k}")):
        if number and m > most:
            raise ValueError(f"{m} points span no extensor within {flat}; leave these matches out")
    space = Views(field, k, sizes, kinds, points=m)
    hyperplane, line = space.extensor(k), space.extensor(2)

    def within(flat: IntArray) -> Callable[[], IntArray]:
        return lambda: space.moving(space.within(flat, min(r, len(flat))), m)

    return [
        Step("static", static, lambda: space.fixed(space.extensor(m))),
        Step("on line", on_line, within(line)),
        Step("on plane", on_plane, within(hyperplane)),
        Step("general", matches, lambda: space.moving(space.extensor(r), m)),
    ]


_NAMED: tuple[Configuration, ...] = (
    homography, dual_homography, join, minimal_join, dynamic, constant_velocity, constant_velocity_3x4x4, lines, fundamental,
    segmentation, trifocal, quadrifocal, shape_tensor, lifted_shape, dynamic_shape, *MOTIONS,
)  # fmt: skip
CONFIGURATIONS: dict[str, Configuration] = {function.__name__: function for function in _NAMED}


def _moving_points(
    views: Views, moving: int | None, static: int, labelled_static: int, lines: Sequence[int], static_lines: Sequence[int],
    confined: Sequence[Step] = (),
) -> list[Step]:  # fmt: skip
    def on(line: IntArray) -> Callable[[], IntArray]:
        return lambda: views.moving(line)

    def fixed_on(line: IntArray) -> Callable[[], IntArray]:
        return lambda: views.fixed(views.within(line))

    return [
        Step("labelled static", labelled_static, lambda: views.labelled(views.extensor(1))),
        Step("static", static, lambda: views.fixed(views.extensor(1))),
        *(Step("static line", number, fixed_on(views.extensor(2))) for number in static_lines),
        *(Step("line", number, on(views.extensor(2))) for number in lines),
        *confined,
        Step("moving", moving, lambda: views.moving(views.extensor(2))),
    ]


def _velocities(
    field: Field, third: int, moving: int | None, static: int, equal: int, linear: int, planar: int,
    confined: tuple[int, int, int, int],
) -> list[Step]:  # fmt: skip
    poses = [field.random(4, 4), field.random(4, 4), field.random(third, 4)]
    common, plane = field.random(1, 3), field.random(2, 3)
    origin = field.random(3)

    def match(velocity: IntArray, at: IntArray | None = None) -> IntArray:
        start, step = np.append(field.random(3) if at is None else at, 1), np.append(velocity, 0)
        first, second, last = (field.product(pose, start + time * step) for time, pose in enumerate(poses))
        return field.kron(first, second, field.null(last))

    def confined_to(axes: IntArray, moves: bool) -> Callable[[], IntArray]:
        # start and velocity within a plane or a line
        def within() -> IntArray:
            velocity = field.product(field.random(len(axes)), axes) if moves else np.zeros(3, dtype=np.int64)
            return match(velocity, (origin + field.product(field.random(len(axes)), axes)) % field.prime)

        return within

    return [
        Step("static", static, lambda: match(np.zeros(3, dtype=np.int64))),
        Step("static on line", confined[3], confined_to(common, False)),
        Step("static on plane", confined[2], confined_to(plane, False)),
        Step("on line", confined[1], confined_to(common, True)),
        Step("on plane", confined[0], confined_to(plane, True)),
        Step("equal velocity", equal, lambda: match(common[0])),
        Step("linear velocity", linear, lambda: match(field.product(field.random(1), common))),
        Step("planar velocity", planar, lambda: match(field.product(field.random(2), plane))),
        Step("moving", moving, lambda: match(field.random(3))),
    ]


def _static_points(views: Views, static: int | None, coplanar: int, on_plane: int, on_line: int) -> list[Step]:
    plane, line = views.extensor(3), views.extensor(2)
    return [
        Step("on line", on_line, lambda: views.fixed(views.within(line))),
        Step("coplanar", coplanar, lambda: views.fixed(views.within(plane))),
        Step("on plane", on_plane, lambda: views.fixed(views.within(plane))),
        Step("static", static, lambda: views.fixed(views.extensor(1))),
    ]


def _confined_points(
    views: Views, step: int, on_plane: int = 0, on_line: int = 0, static_on_plane: int = 0, static_on_line: int = 0
) -> list[Step]:
    """Points that stay on one line, or in one hyperplane of the space (a plane of space), as far as their motion lets them."""
    hyperplane, line = views.extensor(views.k), views.extensor(2)

    def moving(flat: IntArray) -> Callable[[], IntArray]:
        return lambda: views.moving(views.within(flat, min(step, len(flat))))

    def fixed(flat: IntArray) -> Callable[[], IntArray]:
        return lambda: views.fixed(views.within(flat))

    return [
        Step("static on line", static_on_line, fixed(line)),
        Step("static on plane", static_on_plane, fixed(hyperplane)),
        Step("on line", on_line, moving(line)),
        Step("on plane", on_plane, moving(hyperplane)),
    ]

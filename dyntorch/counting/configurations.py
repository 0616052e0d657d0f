"""Configurations of the invariants by name: which matches each takes, in which order, and the rows they give.

A configuration is a function of a field and of the numbers of matches of each kind.  Its first keyword, whose default is None,
is the kind that it is usually estimated from; None takes as many as raise the rank.  It returns its steps with that kind last.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import combinations, product

import numpy as np

from dyntorch.counting.exact import Configuration, Field, IntArray, Measure, Step, Views
from dyntorch.counting.lifted import MOTIONS

LARGEST = 1500
"""Unknowns that are counted in seconds."""


def lifted_shape(
    field: Field, *, images: int | None = None, synthetic: bool = False, points: int = 8, space: int = 4, image: int = 2
) -> list[Step]:
    """Images P^k -> P^l of points of P^k, each a match, projections eliminated: lifted shape tensor."""
    if not 1 <= image < space:
        raise ValueError(f"projections lower the dimension: image must be 1 to space - 1, got space = {space}, image = {image}")
    min_points = -(-(space + 1) * (image + 1) // image)
    if not min_points <= points <= 2 * space + 2:
        raise ValueError(f"points must be {min_points} to {2 * space + 2} for P^{space} -> P^{image}, got {points}")
    others = points - space - 1
    even, more = divmod(space + 1, others)
    tables = Partitions(field, space + 1, (even + 1,) * more + (even,) * (others - more))
    if tables.width > LARGEST:
        raise ValueError(f"{tables.width:,} unknowns are too many; up to {LARGEST:,} are counted, give fewer points or dimensions")
    shape = np.vstack([np.eye(space + 1, dtype=np.int64), field.random(others, space + 1)])

    def image_rows() -> IntArray:
        return tables.rows(field.product(shape, field.random(space + 1, image + 1)))

    def constraints() -> IntArray:
        return tables.synthetic(points, image)

    return [Step("synthetic", int(synthetic), constraints, constraint=True), Step("image", images, image_rows)]


def dynamic_shape(
    field: Field, *, images: int | None = None, synthetic: bool = False, coplanar_base: bool = False, degree: int = 1
) -> list[Step]:
    """Images of six points at constant velocity (or higher degree) at known times, each through another camera of the plane."""
    if not 1 <= degree <= 4:
        raise ValueError(f"degree must be 1 to 4, got {degree}")
    paths = field.random(degree + 1, 6, 4)
    paths[1:, :, 3], paths[0, :, 3] = 0, 1
    tables = Partitions(field, 4, (2, 2))
    size = (2 if coplanar_base else 9) * degree + 1

    def powers(time: int) -> IntArray:
        return np.array([pow(time, d, field.prime) for d in range(size)], dtype=np.int64)

    def places(time: int) -> IntArray:
        moved = sum(path * pow(time, d, field.prime) % field.prime for d, path in enumerate(paths)) % field.prime
        return field.product(moved, field.random(4, 3))

    if coplanar_base:
        # the first four stand still in the plane Z = 0
        paths[1:, :4], paths[0, :4, 2] = 0, 0

    def image_rows() -> IntArray:
        time = int(field.random(1)[0])
        x = places(time)
        row = _across(field, x) if coplanar_base else tables.rows(x)
        return field.kron(powers(time), row)

    def constraints() -> IntArray:
        if coplanar_base:
            return np.zeros((1, 3 * size), dtype=np.int64)
        return field.kron(np.eye(size, dtype=np.int64), tables.synthetic(6, 2))

    return [Step("synthetic", int(synthetic), constraints, constraint=True), Step("image", images, image_rows)]


def _across(field: Field, x: IntArray) -> IntArray:
    """The line through the images of points 5 and 6 in the frame of the first four: p5 x p6."""
    frame = x[:3]
    others = field.product(x[3:], field.inverse(frame))
    depth = np.array([pow(int(v), -1, field.prime) for v in others[0]], dtype=np.int64)
    a, b = (p * depth % field.prime for p in others[1:])
    return np.array([[(int(a[i]) * int(b[j]) - int(a[j]) * int(b[i])) % field.prime for i, j in ((1, 2), (2, 0), (0, 1))]])


class Partitions:
    """The ordered partitions of the basis into sets of given sizes: what a view puts before each of the unknowns."""

    def __init__(self, field: Field, size: int, profile: Sequence[int]) -> None:
        self.field, self.size, self.profile = field, size, tuple(profile)
        ordered = list(_ordered_partitions(tuple(range(size)), self.profile))
        places = [{chosen: i for i, chosen in enumerate(combinations(range(size), a))} for a in self.profile]
        self.index = [np.array([places[j][parts[j]] for parts in ordered]) for j in range(len(self.profile))]
        flat = [[i for part in parts for i in part] for parts in ordered]
        odd = [sum(a > b for n, a in enumerate(order) for b in order[n + 1 :]) % 2 for order in flat]
        self.sign = np.where(np.array(odd) == 1, field.prime - 1, 1)

    @property
    def width(self) -> int:
        """Unknowns."""
        return len(self.sign)

    def rows(self, x: IntArray) -> IntArray:
        """Rows of one view ``(n, l + 1)``: one for every choice of hyperplanes through the points behind the basis."""
        field, slots = self.field, []
        for j, a in enumerate(self.profile):
            incidence = field.product(field.null(x[self.size + j]), x[: self.size].T)
            minors = np.stack([field.join(incidence[list(chosen)]) for chosen in combinations(range(len(incidence)), a)])
            slots.append(minors[:, self.index[j]])
        rows = []
        for chosen in product(*(range(len(slot)) for slot in slots)):
            row = self.sign
            for slot, i in zip(slots, chosen, strict=True):
                row = row * slot[i] % field.prime
            rows.append(row)
        return np.stack(rows)

    def synthetic(self, points: int, image: int) -> IntArray:
        """What vanishes in every view of any points: the null space of rows of no shape."""
        views: list[IntArray] = []
        while sum(map(len, views)) < self.width + 10:
            views.append(self.rows(self.field.random(points, image + 1)))
        return self.field.null(np.vstack(views))


def _ordered_partitions(left: tuple[int, ...], profile: tuple[int, ...]) -> list[tuple[tuple[int, ...], ...]]:
    if not profile:
        return [()]
    chosen = combinations(left, profile[0])
    return [(part, *rest) for part in chosen for rest in _ordered_partitions(tuple(i for i in left if i not in part), profile[1:])]


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
        Step("static point", static_points, lambda: dual.star_rows(dual.extensor(2))),
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
        Step("labelled static", labelled_static, lambda: space.labelled_rows(space.extensor(1), free=within - 1)),
        Step("static", static, lambda: space.static_rows(space.extensor(1))),
        *_confined_points(space, within, on_plane, on_line, static_on_plane, static_on_line),
        Step("moving", moving, lambda: space.moving_rows(space.extensor(within))),
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

    def translating_rows(shift: IntArray) -> IntArray:
        before = np.hstack([field.random(2, 3), np.ones((2, 1), dtype=np.int64)])
        return field.kron(*space.images([before, before + shift]))

    def static_point() -> IntArray:
        # every line through a point in one view matches every line through it in the other
        seen = [field.product(camera, point) for point in space.extensor(1) for camera in space.cameras]
        stars = [[field.join([point, corner]) for corner in np.eye(4, dtype=np.int64)] for point in seen]
        return field.kron(*stars)

    def rigid(shift: IntArray) -> Callable[[], IntArray]:
        return lambda: translating_rows(shift)

    return [
        Step("static point", static_points, static_point),
        Step("static", static, lambda: space.static_rows(space.extensor(2))),
        Step("static on plane", static_on_plane, lambda: space.static_rows(space.within(plane, 2))),
        Step("on plane", on_plane, lambda: space.moving_rows(plane, 2)),
        *(Step("object", number, rigid(direction())) for number in objects),
        Step("translating", translating, lambda: translating_rows(direction())),
        Step("moving", moving, lambda: space.moving_rows(space.extensor(3), 2)),
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
    for number, max_points, flat in ((on_line, 2, "a line"), (on_plane, k, f"a hyperplane of P^{k}")):
        if number and m > max_points:
            raise ValueError(f"{m} points span no extensor within {flat}; leave these matches out")
    space = Views(field, k, sizes, kinds, points=m)
    hyperplane, line = space.extensor(k), space.extensor(2)

    def within(flat: IntArray) -> Callable[[], IntArray]:
        return lambda: space.moving_rows(space.within(flat, min(r, len(flat))), m)

    return [
        Step("static", static, lambda: space.static_rows(space.extensor(m))),
        Step("on line", on_line, within(line)),
        Step("on plane", on_plane, within(hyperplane)),
        Step("general", matches, lambda: space.moving_rows(space.extensor(r), m)),
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
    def moving_rows_on(line: IntArray) -> Callable[[], IntArray]:
        return lambda: views.moving_rows(line)

    def static_rows_on(line: IntArray) -> Callable[[], IntArray]:
        return lambda: views.static_rows(views.within(line))

    return [
        Step("labelled static", labelled_static, lambda: views.labelled_rows(views.extensor(1))),
        Step("static", static, lambda: views.static_rows(views.extensor(1))),
        *(Step("static line", number, static_rows_on(views.extensor(2))) for number in static_lines),
        *(Step("line", number, moving_rows_on(views.extensor(2))) for number in lines),
        *confined,
        Step("moving", moving, lambda: views.moving_rows(views.extensor(2))),
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
        Step("on line", on_line, lambda: views.static_rows(views.within(line))),
        Step("coplanar", coplanar, lambda: views.static_rows(views.within(plane))),
        Step("on plane", on_plane, lambda: views.static_rows(views.within(plane))),
        Step("static", static, lambda: views.static_rows(views.extensor(1))),
    ]


def _confined_points(
    views: Views, step: int, on_plane: int = 0, on_line: int = 0, static_on_plane: int = 0, static_on_line: int = 0
) -> list[Step]:
    """Points that stay on one line, or in one hyperplane of the space (a plane of space), as far as their motion lets them."""
    hyperplane, line = views.extensor(views.k), views.extensor(2)

    def moving_rows(flat: IntArray) -> Callable[[], IntArray]:
        return lambda: views.moving_rows(views.within(flat, min(step, len(flat))))

    def static_rows(flat: IntArray) -> Callable[[], IntArray]:
        return lambda: views.static_rows(views.within(flat))

    return [
        Step("static on line", static_on_line, static_rows(line)),
        Step("static on plane", static_on_plane, static_rows(hyperplane)),
        Step("on line", on_line, moving_rows(line)),
        Step("on plane", on_plane, moving_rows(hyperplane)),
    ]

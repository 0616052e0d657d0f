"""Counting against every rank that is known for these configurations, samplers and identities."""

from __future__ import annotations

import subprocess
import sys
from functools import partial

import numpy as np
import pytest

from dyntorch.counting import CONFIGURATIONS, Count, count, dim_v, options_of
from dyntorch.counting.exact import LARGEST
from tests.grid import assert_refused


def ranks(counted: Count):
    return counted.rank, counted.width, counted.minimal


@pytest.mark.parametrize(
    ("name", "options", "rank", "width", "minimal"),
    [
        ("fundamental", {}, 8, 9, 8),
        ("fundamental", {"coplanar": 20}, 6, 9, 6),
        ("trifocal", {}, 26, 27, 7),
        ("trifocal", {"coplanar": 20}, 21, 27, None),
        ("quadrifocal", {}, 80, 81, 6),
        ("quadrifocal", {"coplanar": 20}, 72, 81, None),
        ("homography", {}, 26, 27, 26),
        ("homography", {"static": 40}, 10, 27, 10),
        ("homography", {"static": 2, "moving": 30}, 26, 27, 26),
        ("homography", {"static": 30, "moving": 15}, 25, 27, 25),
        ("dual_homography", {}, 26, 27, 26),
        ("dual_homography", {"static": 40}, 10, 27, 10),
        ("join", {}, 60, 64, 60),
        ("join", {"static": 40}, 20, 64, 20),
        ("join", {"static": 40, "moving": 39}, 59, 64, 59),
        ("join", {"static": 40, "moving": 40}, 60, 64, 60),
        ("minimal_join", {}, 47, 48, 47),
        ("constant_velocity", {}, 63, 64, 21),
        ("constant_velocity", {"static": 40}, 36, 64, 12),
        ("constant_velocity", {"equal_velocity": 40}, 36, 64, 12),
        ("constant_velocity", {"linear_velocity": 60}, 49, 64, None),
        ("constant_velocity", {"planar_velocity": 60}, 58, 64, None),
        ("constant_velocity", {"static": 5, "moving": 16}, 63, 64, 21),
        ("constant_velocity", {"static": 10, "moving": 11}, 63, 64, 21),
        ("constant_velocity", {"static": 15, "moving": 9}, 63, 64, 21),
        ("constant_velocity", {"static": 20, "moving": 9}, 63, 64, 21),
        ("constant_velocity_3x4x4", {}, 47, 48, 24),
        ("lines", {}, 35, 36, 35),
        ("lines", {"translating": 60}, 31, 36, 31),
        ("lines", {"static": 60}, 20, 36, 20),
        ("lines", {"objects": [60]}, 20, 36, 20),
        ("lines", {"objects": [60, 60]}, 28, 36, 28),
        ("lines", {"objects": [60, 60, 60]}, 31, 36, 31),
        ("lines", {"objects": [60, 60, 60, 60]}, 31, 36, 31),
        ("segmentation", {}, 35, 36, 35),
        ("segmentation", {"first": 28, "second": 7}, 34, 36, 34),
        ("shape_tensor", {}, 80, 81, 6),
        ("lifted_shape", {"synthetic": True}, 29, 30, 10),
        ("dynamic_shape", {"synthetic": True}, 59, 60, 49),
        ("dynamic_shape", {"coplanar_base": True}, 8, 9, 8),
        ("dynamic_shape", {"degree": 2, "coplanar_base": True}, 14, 15, 14),
    ],
)
def test_rank_of_named_configurations(name, options, rank, width, minimal):
    counted = count(name, **options)
    assert (counted.rank, counted.width, counted.nullity) == (rank, width, width - rank)
    assert minimal in (None, counted.minimal)
    assert counted.agreed
    assert counted.full == {"join": 60}.get(name, width - 1)
    assert (counted.missing == 0) == (counted.rank == counted.full)


@pytest.mark.parametrize(
    ("numbers", "rank", "useful"),
    [
        ({"first": 40, "second": 0}, 27, 27),  # the 9 products with another form vanish on a body
        ({"first": 27, "second": 8}, 35, 35),
        ({"first": 26, "second": 9}, 35, 35),
        ({"first": 20, "second": 15}, 35, 35),
        ({"first": 8, "second": 27}, 35, 35),
        ({"first": 28, "second": 7}, 34, 34),
        ({"first": 40, "second": 40}, 35, 35),
        ({"first": 7, "second": 40}, 34, 34),
        ({"first": 0, "planar_first": 40, "second": 0}, 15, 15),
        ({"first": 0, "planar_first": 40, "second": 40}, 33, 33),  # F_2 times [e]xH, any e
        ({"planar_second": 6, "second": 0}, 33, 33),
        ({"planar_second": 5, "second": 0}, 32, 32),
        ({"first": 0, "planar_first": 40, "planar_second": 40, "second": 0}, 27, 27),  # 3 x 3 products
        ({"first": 0, "planar_first": 15, "planar_second": 12, "second": 0}, 27, 27),
    ],
)
def test_rank_of_two_bodies(numbers, rank, useful):
    counted = count("segmentation", **numbers)
    assert (counted.rank, counted.width, counted.minimal) == (rank, 36, useful)
    assert counted.agreed
    other = count("segmentation", seed=1, **numbers)
    assert other.rank == rank


@pytest.mark.parametrize(
    ("k", "numbers", "rank", "width", "minimal"),
    [
        (3, {"views": [2, 2]}, 8, 9, 8),
        (2, {"views": [2, 2]}, 6, 9, 6),
        (2, {"views": [2, 2], "measure": ["hyper", "join"]}, 8, 9, 4),  # DLT of a collineation
        (3, {"views": [2, 2, 2]}, 17, 27, 17),
        (3, {"views": [2, 2, 2], "measure": ["join", "hyper", "hyper"]}, 26, 27, 7),
        (2, {"views": [2, 2, 2], "measure": ["join", "hyper", "hyper"]}, 21, 27, None),
        (3, {"views": [2] * 4, "measure": "hyper"}, 80, 81, 6),
        (2, {"views": [2] * 4, "measure": "hyper"}, 72, 81, None),
        (3, {"views": [2, 2, 2], "m": 2, "r": 2}, 23, 27, 23),
        (2, {"views": [2, 2, 2], "r": 2}, 26, 27, 26),
        (2, {"views": [2, 2, 2], "measure": "hyper"}, 26, 27, 4),
        (3, {"views": [3, 3, 3], "r": 2}, 60, 64, 60),
        (3, {"views": [3, 3, 2], "r": 2}, 47, 48, 47),
        (3, {"views": [3] * 4, "r": 3}, 255, 256, 255),
        (3, {"views": [3] * 4}, 35, 256, 35),  # static points of a join: dim V(4, 4, 1)
        (3, {"views": [3] * 4, "r": 2}, 210, 256, 210),
        (2, {"views": [2] * 4, "r": 2}, 72, 81, 72),
        (3, {"views": [2] * 4, "r": 2}, 81, 81, 81),
        (3, {"views": [2] * 5, "r": 2}, 243, 243, 243),
        pytest.param(3, {"views": [2] * 6, "r": 2}, 728, 729, 728, marks=pytest.mark.slow),
        (2, {"views": [1, 1, 1]}, 7, 8, 7),
        (3, {"views": [3, 3], "m": 2, "r": 3}, 35, 36, 35),
        (6, {"views": [3, 3, 3], "measure": ["join", "join", "hyper"]}, 63, 64, 21),
        (6, {"views": [3, 3, 2], "measure": ["join", "join", "hyper"]}, 47, 48, 24),
        (7, {"views": [3, 3, 3], "measure": ["join", "join", "hyper"]}, 64, 64, None),  # "P^7": no constraint is left
    ],
)
def test_rank_by_numbers(k, numbers, rank, width, minimal):
    counted = count(k, **numbers)
    assert (counted.rank, counted.width, counted.nullity) == (rank, width, width - rank)
    assert minimal in (None, counted.minimal)
    assert counted.agreed
    assert (counted.full, counted.missing) == (rank, 0)


@pytest.mark.parametrize("static", [0, 5, 10, 14])
def test_unlabelled_static_points_add_at_most_10_and_20(static):
    for moving in (5, 16, 20, 26):
        assert count("homography", static=static, moving=moving).rank == min(26, min(static, 10) + moving)
    for moving in (39, 40, 55):
        assert count("join", static=2 * static, moving=moving).rank == min(60, min(2 * static, 20) + moving)


@pytest.mark.parametrize(
    ("name", "option", "numbers", "expected"),
    [
        ("homography", "lines", [20] * 5, [8, 15, 21, 26, 26]),
        ("homography", "lines", [8, 7, 6, 5], [8, 15, 21, 26]),
        ("homography", "lines", [8, 8, 8, 2], [8, 15, 21, 23]),  # "at most 8 points on a line" is not sufficient
        ("homography", "static_lines", [20] * 4, [4, 7, 9, 10]),
        ("join", "lines", [20] * 11, [8, 16, 24, 32, 40, 44, 48, 52, 56, 60, 60]),
        ("join", "lines", [8] * 5 + [4] * 5, [8, 16, 24, 32, 40, 44, 48, 52, 56, 60]),
        ("lines", "objects", [60] * 4, [20, 28, 31, 31]),
    ],
)
def test_rank_grows_line_by_line(name, option, numbers, expected):
    assert [kind.rank for kind in count(name, **{option: numbers}).kinds] == expected


@pytest.mark.parametrize(
    ("name", "option", "options", "profile"),
    [
        ("homography", "labelled_static", {}, [7, 14, 21, 26]),
        ("dual_homography", "labelled_static", {}, [7, 14, 21, 26]),
        ("dual_homography", "static_points", {}, [8, 15, 21, 26]),
        ("join", "labelled_static", {}, [10, 20, 30, 40, 50, 56, 60]),
        ("shape_tensor", "images", {}, [16, 31, 45, 58, 70, 80]),
        ("shape_tensor", "images", {"synthetic": True}, [77, 80]),
        ("quadrifocal", "static", {}, [16, 31, 45, 58, 70, 80]),
        ("lines", "static_points", {}, [9, 17, 24, 30, 35]),
    ],
)
def test_rank_grows_match_by_match(name, option, options, profile):
    counted = count(name, **{option: len(profile) + 2}, **options)
    assert counted.profile == (*profile, profile[-1], profile[-1])
    assert counted.minimal == len(profile)


def test_labelled_and_static_points_save_moving_ones_and_lines():
    for name, moving in (("homography", [26, 19, 12, 5, 0]), ("join", [60, 50, 40, 30, 20, 10, 4, 0])):
        assert [count(name, labelled_static=k, moving=0).missing for k in range(len(moving))] == moving
    # two rigid objects reach 28 alone ("two objects are sufficient") and 35 with two static points
    assert [count("lines", static_points=k, translating=60).rank for k in (0, 1, 2)] == [31, 34, 35]
    assert [count("lines", static_points=k, objects=[60]).rank for k in (1, 2, 3, 4)] == [28, 33, 34, 35]
    assert [count("lines", static_points=k, objects=[60, 60]).rank for k in (0, 2)] == [28, 35]


@pytest.mark.slow
def test_synthetic_constraints_of_the_shape_tensor_leave_nine_dimensions():
    counted = count("shape_tensor", synthetic=True)
    assert counted.rank == 80 and counted.minimal == 2
    assert count("shape_tensor", synthetic=True, images=0).rank == dim_v(3, 4, 2) == 72


# --------------------------------------------------------------------------------------------------- samplers


def labelled_static(field):
    """The labelled static points of the homography tensor, with the cameras A = B = identity given."""
    while True:
        point, free = field.random(3), np.eye(3, dtype=int)
        yield np.vstack([field.kron(point, point, free), field.kron(point, free, point), field.kron(free, point, point)])


def shared_translation(field):
    """Lines of one object that translates, between two random frames."""
    poses, shift = field.random(2, 4, 4), np.append(field.random(3), 0)
    while True:
        before = np.hstack([field.random(2, 3), np.ones((2, 1), dtype=int)])
        first, second = (
            field.join(field.product(ends, pose.T)) for ends, pose in zip((before, before + shift), poses, strict=True)
        )
        yield field.kron(second, first)


def on_four_lines(field):
    """8 + 8 + 8 + 2 points."""
    for number in (8, 8, 8, 2):
        line = field.random(2, 3)
        for _ in range(number):
            yield field.kron(*field.product(field.random(3, 2), line))


@pytest.mark.parametrize(
    ("sampler", "rank", "width", "minimal"),
    [(labelled_static, 26, 27, 4), (shared_translation, 20, 36, 20), (on_four_lines, 23, 27, 23)],
)
def test_rank_of_a_sampler(sampler, rank, width, minimal):
    counted = count(sampler)
    assert ranks(counted) == (rank, width, minimal)
    assert counted.full is counted.missing is None
    assert counted.name == sampler.__name__
    assert count(sampler, matches=2).profile == counted.profile[:2]


def minimal_join_tensor(field, first, second, camera):
    """N_ijk = eps_lmk W_li (W A)_mj for W = M B^-1, from its equation det[W p, W A p', q] = 0."""
    projection = field.product(camera, field.inverse(second))
    moved = field.product(projection, first)
    tensor = np.zeros((4, 4, 3), dtype=np.int64)
    for left, middle, right, sign in ((0, 1, 2, 1), (1, 2, 0, 1), (2, 0, 1, 1), (1, 0, 2, -1), (2, 1, 0, -1), (0, 2, 1, -1)):
        tensor[:, :, right] += sign * (projection[left][:, None] * moved[middle][None] % field.prime)
    return tensor % field.prime


def skew_rows(slices):
    """Linear equations on vec(A) of A^T S + S^T A = 0."""
    for form in slices:
        for i in range(4):
            for j in range(i, 4):
                row = np.zeros((4, 4), dtype=np.int64)
                row[:, i] += form[:, j]
                row[:, j] += form[:, i]
                yield row.ravel()


@pytest.mark.parametrize(("cameras", "rank"), [(1, 11), (2, 15)])
def test_one_minimal_join_tensor_does_not_determine_the_motion(cameras, rank):
    def equations(field):
        first, second = field.random(4, 4), field.random(4, 4)
        for _ in range(cameras):
            tensor = minimal_join_tensor(field, first, second, field.random(3, 4))
            yield from skew_rows(np.moveaxis(tensor, 2, 0))

    assert count(equations).rank == rank


@pytest.mark.parametrize(("slices", "nullity"), [(1, 4), (2, 1), (3, 1)])
def test_slices_of_the_homography_tensor_that_determine_the_motion(slices, nullity):
    def equations(field):
        a, b = field.random(3, 3), field.random(3, 3)
        for column in b.T[:slices].tolist():
            cross = np.array([[0, -column[2], column[1]], [column[2], 0, -column[0]], [-column[1], column[0], 0]])
            form = -field.product(cross, a)  # G_k = -[b_k] A
            for i in range(3):
                for j in range(i, 3):
                    row = np.zeros((3, 3), dtype=np.int64)
                    row[:, i] += form[:, j]
                    row[:, j] += form[:, i]
                    yield row

    def flattened(field):
        return (row.ravel() for row in equations(field))

    assert count(flattened).nullity == nullity


def test_dimension_of_the_cone_of_homography_tensors():
    def directions(field):
        levi = np.zeros((3, 3, 3), dtype=np.int64)
        levi[[0, 1, 2], [1, 2, 0], [2, 0, 1]], levi[[0, 2, 1], [2, 1, 0], [1, 0, 2]] = 1, -1

        def tensor(a, b):  # linear in each, so that its value at unit matrices is the derivative
            return np.stack([field.product(field.product(a.T, face % field.prime), b) for face in levi]).ravel()

        a, b, units = field.random(3, 3), field.random(3, 3), np.eye(9, dtype=np.int64).reshape(9, 3, 3)
        yield from (tensor(unit, b) for unit in units)
        yield from (tensor(a, unit) for unit in units)

    assert count(directions).rank == 17  # 8 + 8 + 1


def test_dimension_of_the_cone_of_minimal_join_tensors():
    """22 + 1 although (A, B) has 30 + 1: eight unknowns are lost.  W = M B^-1 enters twice, A once."""

    def directions(field):
        a, w = field.random(4, 4), field.random(3, 4)

        def tensor(left, right):  # cross products of the columns of W with those of W A
            right = field.product(right, a)
            return np.stack([
                (left[i][:, None] * right[j] % field.prime - left[j][:, None] * right[i] % field.prime) % field.prime
                for i, j in ((1, 2), (2, 0), (0, 1))
            ])  # fmt: skip

        for at in np.ndindex(w.shape):
            unit = np.zeros_like(w)
            unit[at] = 1
            yield (tensor(unit, w) + tensor(w, unit)).ravel()
        for at in np.ndindex(a.shape):
            unit = np.zeros_like(a)
            unit[at] = 1
            moved = field.product(w, unit)
            yield np.stack([w[i][:, None] * moved[j] % field.prime - w[j][:, None] * moved[i] % field.prime
                            for i, j in ((1, 2), (2, 0), (0, 1))]).ravel()  # fmt: skip

    assert count(directions).rank == 23


def test_structure_equations_of_constant_velocity_have_rank_11_of_14():
    def equations(field):
        gauge = field.random(7, 7)
        poses = field.random(3, 4, 4)
        w = [field.product(np.hstack([pose, time * pose[:, :3]]), gauge) for time, pose in enumerate(poses)]
        zero = np.zeros_like(w[0])
        yield np.hstack([zero, w[0]])  # w0 g' = 0
        yield np.hstack([-w[1], w[1]])  # w1 (g' - g) = 0
        yield np.hstack([-2 * w[2], w[2]])

    assert ranks(count(equations))[:2] == (11, 14)


def test_results():
    text = str(count("homography", static=12, moving=10))
    assert text == (
        "homography: rank 20 of 27, nullity 7, from 20 of 22 matches: 10 of 12 static (rank 10), 10 of 10 moving (rank 20);"
        " rank 26 takes 6 more moving"
    )
    assert "profile" not in repr(count("join"))
    with pytest.raises(AttributeError):
        count("fundamental").rank = 3
    for name in ("homography", "lines", "trifocal"):
        assert count(name, seed=1) == count(name, seed=2)
    nothing, many = count("homography", moving=0), count("homography", moving=1_000_000)
    assert (nothing.rank, nothing.profile, nothing.missing, nothing.full) == (0, (), 26, 26)
    assert len(many.profile) == 1_000_000 and many.minimal == 26


def test_first_option_is_the_usual_kind():
    for name in CONFIGURATIONS:
        default, *others = options_of(name).values()
        assert default is None and None not in others
    assert count("homography", labelled_static=2, moving=None).minimal == 2 + 12


def floats(field):
    yield np.ones(3) / 2


def ragged(field):
    yield [1, 2, 3]
    yield [1, 2]


def empty(field):
    return []


def wide(field):
    yield np.ones(LARGEST + 1, dtype=int)


def test_count_misuse():
    cases = [
        ("homografy", {}, "unknown configuration 'homografy'; known are homography"),
        ("homography", {"planar": 3}, "no option planar; it has moving, static"),
        ("homography", {"views": [2, 2]}, "no option views"),
        ("homography", {"static": -1}, "static must be a number from 0 to 1,000,000, got -1"),
        ("homography", {"static": None}, "static must be a number"),
        ("homography", {"static": 1.5}, "static must be a number"),
        ("homography", {"static": True}, "static must be a number"),
        ("homography", {"moving": 10**9}, "moving must be a number"),
        ("homography", {"lines": 8}, "lines must be a list of numbers"),
        ("homography", {"lines": [8, -1]}, "lines must be a list of numbers"),
        ("shape_tensor", {"synthetic": 3}, "synthetic must be True or False"),
        (3, {}, "needs views"),
        (3, {"views": []}, "views is empty"),
        (3, {"views": [2, 2], "m": 2}, "expected 1 <= m <= r <= k"),
        (3, {"views": [2, 2], "r": 5}, "expected 1 <= m <= r <= k"),
        (3, {"views": [2, 2], "m": 0}, "expected 1 <= m <= r <= k"),
        (3, {"views": [2, 1], "m": 3, "r": 3}, "3 points have no join in a view of dimension 1"),
        (3, {"views": [2, 2], "m": 3, "r": 3, "measure": "hyper"}, "no hyper in a view of dimension 2"),
        (3, {"views": [2, 2], "measure": "meet"}, "measure must be join or hyper"),
        (3, {"views": [2, 2], "measure": ["join"]}, "measure must be join or hyper"),
        (3, {"views": [9] * 4}, "10,000 unknowns are too many"),
        (3, {"views": [2, 2], "moving": 3}, "no option moving; it has views, m, r, measure, matches"),
        (-1, {"views": [2]}, "expected the name"),
        (True, {"views": [2]}, "expected the name"),
        (None, {}, "expected the name"),
        (floats, {}, "integers only"),
        (ragged, {}, "one width, got widths"),
        (empty, {}, "gave no matches"),
        (wide, {}, "4,097 unknowns are too many"),
        (on_four_lines, {"matches": 30}, "ended after 26 matches, 30 were asked for"),
    ]
    assert_refused(*((partial(count, what, **options), message) for what, options, message in cases))


def test_counting_does_not_load_torch():
    code = "import sys; from dyntorch.counting import count; count('homography'); print('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.strip() == "False"

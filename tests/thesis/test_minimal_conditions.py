"""Thesis 10.1, "up to 10 points on one hyperplane": how many matches of each kind count, by ranks of matrices written out here."""

from math import comb

import numpy as np
import pytest

from dyntorch import counting

PRIME = 1_000_003


def rank(rows):
    """Modulo a prime of its own, by plain elimination."""
    rows = np.array(rows, dtype=np.int64) % PRIME
    found = 0
    for column in range(rows.shape[1]):
        pivot = next((i for i in range(found, len(rows)) if rows[i, column]), None)
        if pivot is None:
            continue
        rows[[found, pivot]] = rows[[pivot, found]]
        rows[found] = rows[found] * pow(int(rows[found, column]), -1, PRIME) % PRIME
        rows[found + 1 :] = (rows[found + 1 :] - rows[found + 1 :, column, None] * rows[found]) % PRIME
        found += 1
    return found


def products(number, sizes, within, step, seed=0):
    """Rows p1 x p2 x ... of matches, each within its own random ``step`` dimensions of the span of common vectors."""
    draw = np.random.default_rng(seed)
    cameras = [draw.integers(0, PRIME, (size, 4)) for size in sizes]
    common = draw.integers(0, PRIME, (within, 4))
    rows = []
    for _ in range(number):
        own = draw.integers(0, PRIME, (step, within)) @ common % PRIME
        row = np.ones(1, dtype=np.int64)
        for camera in cameras:
            point = draw.integers(0, PRIME, step) @ own % PRIME
            row = np.outer(row, camera @ point % PRIME).ravel() % PRIME
        rows.append(row)
    return rows


@pytest.mark.parametrize(("name", "sizes"), [("join", (4, 4, 4)), ("minimal_join", (4, 4, 3))])
def test_points_of_space_on_a_plane_or_line_moving_or_not(name, sizes):
    found = {c.option: c for c in counting.capacities(name)}
    full = rank(products(70, sizes, 4, 2))
    assert full == found["moving"].rank
    for option, within, step in (
        ("on_plane", 3, 2),
        ("on_line", 2, 2),
        ("static_on_plane", 3, 1),
        ("static_on_line", 2, 1),
        ("static", 4, 1),
    ):
        rows = products(40, sizes, within, step)
        alone = rank(rows)
        assert (found[option].matches, found[option].rank) == (alone, alone)
        assert rank(rows + products(70, sizes, 4, 2, seed=0)) == full == found[option].full
        assert found[option].missing == full - alone


@pytest.mark.slow
def test_they_are_dimensions_of_v():
    found = {c.option: c.rank for c in counting.capacities("dynamic", dim=2, poses=4, within=2)}
    assert (found["moving"], found["static"]) == (counting.dim_v(3, 4, 2), counting.dim_v(3, 4, 1))
    assert found["on_line"] == found["on_plane"] == counting.dim_v(2, 4, 2) and found["static_on_line"] == counting.dim_v(2, 4, 1)
    join = {c.option: c.rank for c in counting.capacities("join")}
    assert join["static_on_plane"] == counting.dim_v(3, 3, 1) == 10  # the thesis's example


def test_static_cameras_see_as_much_as_planes_and_lines_carry():
    """Two views of a plane leave 6 of 8 conditions, of a line 3: symmetric forms, and the pairs that a line map leaves."""
    found = {c.option: (c.matches, c.missing) for c in counting.capacities("fundamental")}
    rows = [products(20, (3, 3), within, 1) for within in (4, 3, 2)]
    assert [rank(r) for r in rows] == [8, 6, 3]
    assert found["static"] == (8, 0) and found["on_plane"] == (6, 2) == (comb(4, 2), 2) and found["on_line"] == (3, 5)


def test_constant_velocity_within_a_plane():
    """P_t ~ A_t (x + t v), rows p0 x p1 x planes through p2: starts and velocities in one plane."""
    draw = np.random.default_rng(1)
    cameras = draw.integers(0, PRIME, (3, 4, 4))

    def match(start, velocity):
        p = [camera @ (start + t * velocity) % PRIME for t, camera in enumerate(cameras)]
        a, b, c, d = (int(x) for x in p[2])
        planes = np.array([[b, -a, 0, 0], [0, c, -b, 0], [0, 0, d, -c]])
        return [np.kron(np.outer(p[0], p[1]).ravel() % PRIME, plane % PRIME) % PRIME for plane in planes]

    def on_plane():
        axes, origin = draw.integers(0, PRIME, (2, 3)), draw.integers(0, PRIME, 3)
        rows = []
        for _ in range(20):
            start, velocity = (draw.integers(0, PRIME, 2) @ axes % PRIME for _ in range(2))
            rows += match(np.append((origin + start) % PRIME, 1), np.append(velocity, 0))
        return rows

    found = {c.option: c for c in counting.capacities("constant_velocity", only=["on_plane"])}
    assert rank(on_plane()) == found["on_plane"].rank == 35


def test_lifted_models_on_planes_are_smaller_models():
    """Points at constant velocities on one plane are planar constant velocity seen by 3D sensors, or cameras."""
    space = {c.option: c for c in counting.capacities("constant_velocity_3d", only=["on_plane", "planar_velocity"])}
    assert space["on_plane"].rank < space["planar_velocity"].rank
    assert counting.count("constant_velocity_3d", on_plane=100, moving=0).missing == space["on_plane"].missing
    assert counting.count("constant_velocity_2d", on_line=30, moving=0).missing == 8


def test_mixtures_count_together():
    counted = counting.count("join", on_plane=10, static=2, moving=48)
    assert (counted.rank, counted.nullity, counted.missing) == (60, 4, 0)
    assert [kind.useful for kind in counted.kinds] == [2, 10, 48]
    short = counting.count("join", on_plane=40, static=30, moving=0)
    assert (short.rank, short.missing) == (20 + 26 - 10, 24)  # static points of the plane belong to both
    general = counting.count(3, views=[3, 3, 3, 3], r=3, on_plane=100, static=3)
    assert [kind.useful for kind in general.kinds] == [3, 81, 171]
    with pytest.raises(ValueError, match="3 points span no extensor within a line"):
        counting.count(3, views=[3, 3], m=3, r=3, on_line=1)
    with pytest.raises(ValueError, match="expected 1 <= within <= dim and poses > within"):
        counting.count("dynamic", within=4)

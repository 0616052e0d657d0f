"""Streets: what the camera sees is the projection of what stands and drives, for as long as nothing hides it."""

import math

import pytest
import torch

from dyntorch.geometry.homogeneous import homogeneous, inhomogeneous
from dyntorch.scenes import StreetOptions, streets
from dyntorch.scenes.traffic import CAR, ROAD, Boxes, Chance, driven, drives, rotations, street_walls
from tests.draws import seeded
from tests.grid import assert_refused


@pytest.fixture(scope="module")
def street():
    return streets(3, 20, 300, generator=seeded(5))


def test_tracks_are_projections_and_cars_move_visibly(street):
    seen = street.exact.isfinite().all(-1)
    assert torch.equal(seen, street.tracks.isfinite().all(-1))
    image = homogeneous(street.points) @ street.cameras.mT
    torch.testing.assert_close(inhomogeneous(image)[seen], street.exact[seen])
    off = (street.tracks - street.exact)[seen]
    # the drift adds to sigma = .5
    assert 0.4 < off.std() < 1.2 and off.mean().abs() < 0.1
    assert image[..., 2][seen].min() > 1.9
    both = seen[:-1] & seen[1:]
    for label in (2, 3):
        for other in {1, 2, 3} - {label}:
            motion = street.motions[:, other - 1]
            turn = motion[1:, :, :3] @ motion[:-1, :, :3].mT
            shift = motion[1:, :, 3] - (turn @ motion[:-1, :, 3:])[..., 0]
            there = street.points[:-1] @ turn.mT + shift[:, None]
            apart = (inhomogeneous(homogeneous(there) @ street.cameras[1:].mT) - street.exact[1:]).norm(dim=-1)
            assert apart[both & (street.labels == label)].max() > 0.8


def test_bodies_move_rigidly_and_the_street_not_at_all(street):
    for label in (1, 2, 3):
        motion = street.motions[:, label - 1]
        first = street.points[0, street.labels == label]
        moved = first @ motion[..., :3].mT + motion[:, None, :, 3]
        torch.testing.assert_close(moved, street.points[:, street.labels == label])
        torch.testing.assert_close(motion[..., :3] @ motion[..., :3].mT, torch.eye(3, dtype=torch.float64).expand(20, 3, 3))
    still = street.points[:, street.labels == 1]
    assert torch.equal(still, still[:1].expand_as(still))


def test_cars_stand_on_the_road_and_are_as_large_as_cars(street):
    for label in (2, 3):
        points = street.points[0, street.labels == label]
        assert points[:, 1].max() < ROAD + 1e-9 and points[:, 1].min() > ROAD - CAR[1] - 1e-9
        assert (points.amax(0) - points.amin(0))[[0, 2]].norm() < math.hypot(CAR[0], CAR[2])
    long = streets(2, 20, 100, options=StreetOptions(buses=1.0), generator=seeded(1))
    points = long.points[0, long.labels == 2]
    assert (points.amax(0) - points.amin(0))[1] > CAR[1]


def test_shapes_labels_and_missing(street):
    assert street.tracks.shape == (20, 300, 2) and street.cameras.shape == (20, 3, 4) and street.motions.shape == (20, 3, 3, 4)
    assert street.tracks.dtype == street.cameras.dtype == torch.float64 and street.labels.dtype == torch.int64
    assert street.size == (1242, 375) and len(street.kinds) == 2
    torch.testing.assert_close(torch.linalg.inv(street.K) @ street.cameras[0, :, :3] @ street.cameras[0, :, :3].mT, street.K.mT)
    counts = torch.bincount(street.labels)
    assert counts[0] == 0 and counts[1:].min() >= 15 and counts[1] > 100
    seen = street.tracks.isfinite().all(-1)
    assert torch.equal(seen, street.tracks.isfinite().any(-1))
    # a track is one piece of at least five frames; most are short
    assert (seen.diff(dim=0).sum(0) + seen[0].int() + seen[-1].int() <= 2).all()
    assert seen.sum(0).min() >= 5 and seen.sum(0).double().median() < 18
    exact = street.exact[seen]
    assert exact.min() >= 0 and exact[:, 0].max() <= 1241 and exact[:, 1].max() <= 374


def test_outliers_follow_nothing():
    street = streets(2, 20, 200, outliers=0.2, generator=seeded(3))
    assert (street.labels == 0).sum() == 40
    off = (street.tracks - street.exact).norm(dim=-1)
    worst = off.nan_to_num().amax(0)
    assert worst[street.labels > 0].max() < 12 and worst[street.labels == 0].median() > 12


def test_sigma_zero_is_exact_and_the_seed_decides():
    clean, noisy, other = (streets(2, 12, 100, sigma=s, generator=seeded(seed)) for s, seed in ((0.0, 7), (0.5, 7), (0.5, 8)))
    seen = clean.exact.isfinite()
    assert torch.equal(clean.tracks[seen], clean.exact[seen])
    assert torch.equal(noisy.exact[seen], clean.exact[seen]) and torch.equal(noisy.labels, clean.labels)
    assert not torch.equal(other.labels, clean.labels)


def test_a_camera_that_stands_and_one_that_turns():
    quiet = StreetOptions(speed=(0.0, 0.0), steering=0.0, turn=(0.0, 0.0), pitch=0.0)
    standing = streets(2, 12, 100, options=quiet, generator=seeded(0))
    torch.testing.assert_close(standing.cameras, standing.cameras[:1].expand_as(standing.cameras))
    wide = StreetOptions(turn=(0.03, 0.03), steering=0.0, pitch=0.0, junction=(3.0, 12.0))
    turning = streets(2, 12, 100, options=wide, generator=seeded(0))
    rotation = torch.linalg.inv(turning.K) @ turning.cameras[:, :, :3]
    angle = ((rotation[-1] @ rotation[0].mT).diagonal().sum() - 1).div(2).acos()
    torch.testing.assert_close(angle, torch.tensor(11 * 0.03, dtype=torch.float64))


def test_one_body_and_one_kind_of_traffic():
    empty = streets(1, 8, 60, generator=seeded(2))
    assert empty.labels.unique().tolist() == [1] and empty.kinds == ()
    oncoming = streets(3, 12, 150, options=StreetOptions(traffic=("oncoming",)), generator=seeded(2))
    assert oncoming.kinds == ("oncoming", "oncoming")
    # towards the camera
    assert (oncoming.motions[-1, 1:, 2, 3] < oncoming.motions[0, 1:, 2, 3]).all()


def test_cars_that_stop_drive_for_a_part_of_the_clip():
    street = streets(3, 20, 200, options=StreetOptions(traffic=("stopping",)), generator=seeded(1))
    pace = street.motions[:, 1:, :, 3].diff(dim=0).norm(dim=-1)
    assert street.kinds == ("stopping", "stopping")
    assert (pace.amin(0) < 1e-9).all() and (pace.amax(0) > 0.3).all()
    assert ((pace < 1e-9).sum(0) >= 4).all() and ((pace > 0.3).sum(0) >= 4).all()


def test_rays_meet_the_nearest_box_the_road_or_nothing():
    place = torch.tensor([[[0.0, ROAD, 10.0], [0.0, ROAD, 20.0]]], dtype=torch.float64)
    heading = torch.tensor([[math.pi / 2, 0.0]], dtype=torch.float64)
    size = torch.tensor([[2.0, 1.5, 4.0]], dtype=torch.float64).expand(2, 3)
    boxes = Boxes(place, heading, size, torch.zeros(2, dtype=torch.float64), torch.tensor([1, 2]))
    ray = torch.tensor([[0.0, 0.05, 1.0], [0.0, 0.0, 1.0], [0.15, 0.05, 1.0], [0.5, 0.3, 1.0]], dtype=torch.float64)
    depth, box = boxes.first_hit(torch.zeros(4, dtype=torch.int64), torch.zeros_like(ray), ray, -1, -2)
    # across the street: the box is 2 deep and 4 wide
    assert box.tolist() == [0, -2, 0, -1]
    torch.testing.assert_close(depth[[0, 2, 3]], torch.tensor([9.0, 9.0, ROAD / 0.3], dtype=torch.float64))
    there = torch.tensor([[1.5, 1.0, 9.5]], dtype=torch.float64)
    local = boxes.local(torch.tensor([0]), torch.tensor([0]), there)
    torch.testing.assert_close(local, torch.tensor([[0.5, 1.0 - ROAD, 1.5]], dtype=torch.float64))
    torch.testing.assert_close(boxes.world(0, torch.tensor([0]), local), there)


def test_nobody_drives_through_anybody():
    chance = Chance(seeded(4))
    straight = torch.zeros(20, dtype=torch.float64)
    own = driven(straight + 0.8, straight, "equal", CAR, (0.0, 0.0), 0)
    found = [drives(3, own, 25.0, ("slower", "oncoming", "crossing", "turning"), 0.3, chance) for _ in range(8)]
    for cars in (cars for cars in found if cars is not None):
        walls = street_walls(own, cars, 25.0, chance)
        assert len(walls.body) > 20
        for car in (own, *cars):
            local = (rotations(walls.heading[0]).mT @ (car.place[:, None] - walls.place[0])[..., None])[..., 0]
            assert ((local[..., [0, 2]].abs() - walls.size[:, [0, 2]] / 2).amax(-1) > 0.7).all()
            assert all((car.place - other.place).norm(dim=-1).min() > 2 for other in (own, *cars) if other is not car)
    assert any(cars is not None for cars in found)


@pytest.mark.slow
def test_misuse_is_named():
    assert_refused(
        (lambda: streets(0), "bodies >= 1"),
        (lambda: streets(2, 4), "frames >= 5"),
        (lambda: streets(4, tracks=60), "at least 120 tracks, got tracks=60"),
        (lambda: streets(sigma=-1.0), "sigma must be >= 0"),
        (lambda: streets(outliers=1.5), "outliers is a share"),
        (lambda: streets(options=StreetOptions(traffic=("flying",))), "traffic must name some of slower"),
        (lambda: streets(2, 6, 60, options=StreetOptions(visible=1e6)), "no street with bodies=2"),
    )

"""What belongs to no body, which body rests, and motions in the pixels of the tracks."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from dyntorch.geometry.epipolar import sampson_squared
from dyntorch.geometry.homogeneous import apply
from dyntorch.metrics import relative_error
from dyntorch.tasks.segment import labels as module
from dyntorch.tasks.segment.frame_pairs import TrackSet
from dyntorch.tasks.segment.labels import distances, distances_from_cameras, find_static_body, motions, outliers, widths
from dyntorch.tasks.segment.search import one_hot
from tests.dyntorch.tasks.segment.videos import F64, Shot, shot

PAIRS = ((0, 4), (2, 7), (0, 9))


def pairs_of(scene: Shot):
    film = scene.film()
    return [film.pair(pair) for pair in PAIRS]


def members(scene: Shot) -> torch.Tensor:
    return one_hot(scene.labels - 1, int(scene.labels.max())).double()


def true_geometry(scene: Shot) -> list[torch.Tensor]:
    """``(1, K, 3, 3)`` for every pair, in the coordinates of the film."""
    back = scene.film().change.inverse()
    bodies = range(int(scene.labels.max()))
    return [torch.stack([back.mT @ scene.fundamental(k, a, b) @ back for k in bodies])[None] for a, b in PAIRS]


def moved(scene: Shot):
    return motions(pairs_of(scene), true_geometry(scene), members(scene), scene.film())


def test_distances_are_in_pixels_and_missing_where_a_track_is():
    scene = shot((30, 20))
    scene.tracks[4, :3] = torch.nan
    geometry = true_geometry(scene)
    geometry[2][:, 1] = 0.0  # this motion is not known
    found = distances(pairs_of(scene), geometry, 50)
    assert found.shape == (3, 2, 50)
    assert bool(found[0, :, :3].isnan().all()) and not bool(found[0, :, 3:].isnan().any())
    assert bool(found[2, 1].isnan().all()) and not bool(found[2, 0].isnan().any())
    known = sampson_squared(scene.fundamental(1, 2, 7), scene.tracks[2], scene.tracks[7]).sqrt()
    torch.testing.assert_close(found[1, 1], known, rtol=1e-6, atol=1e-8)


def test_outliers_are_usually_far_from_their_body(monkeypatch):
    distance = torch.full((3, 2, 6), 0.1, dtype=F64)
    labels = torch.tensor([0, 0, 0, 1, 1, 1])
    distance[:, 0, 0] = torch.tensor([9.0, 9.0, 0.1])  # twice of three
    distance[:, 0, 1] = torch.tensor([9.0, 0.1, 0.1])  # once
    distance[:, 1, 2] = 9.0  # from the other body
    distance[:, 1, 3] = torch.tensor([5.0, 5.0, torch.nan])  # where it is known
    distance[:, 1, 4] = torch.nan  # nowhere
    none = torch.zeros(6, dtype=F64)
    assert outliers(distance, labels, none).tolist() == [True, False, False, True, False, False]
    full = torch.ones(6, dtype=F64)
    assert outliers(distance, labels, full).tolist() == [True, False, False, False, False, False]
    monkeypatch.setattr(module, "MAX_BODY_DISTANCE_PIXELS", 0.05)
    assert outliers(distance, labels, none).tolist() == [True, True, True, True, False, True]


def test_motions_are_those_of_the_pixels():
    scene = shot((40, 30, 20), sigma=0.1)
    found = moved(scene)
    assert found.fundamentals.shape == found.homographies.shape == (3, 3, 3, 3) and found.planar.shape == (3, 3)
    for row, (a, b) in zip(found.fundamentals, PAIRS, strict=True):
        for body, F in enumerate(row):
            own = scene.labels == body + 1
            assert float(F.norm()) == pytest.approx(1.0)
            assert float(relative_error(F, scene.fundamental(body, a, b))) < 1e-6
            off = sampson_squared(F, scene.tracks[a], scene.tracks[b]).sqrt()
            assert float(off[own].median()) < 0.3


def test_a_planar_body_has_homographies():
    scene = shot((50, 40), planar=(2,))
    found = moved(scene)
    assert found.planar.tolist() == [[False, True]] * 3
    assert bool((found.homographies[:, 0] == 0).all())
    own = scene.labels == 2
    for H, (a, b) in zip(found.homographies[:, 1], PAIRS, strict=True):
        assert float(H.norm()) == pytest.approx(1.0)
        off = (apply(H, scene.tracks[a][own]) - scene.tracks[b][own]).norm(dim=-1)
        assert float(off.median()) < 0.4


def test_motions_are_zero_where_a_body_has_too_few_tracks():
    scene = shot((40, 30))
    scene.tracks[7, 43:] = torch.nan  # three tracks of body 2 are left
    found = moved(scene)
    assert bool((found.fundamentals[1, 1] == 0).all()) and not bool(found.planar[1, 1])
    assert bool((found.fundamentals[0].norm(dim=(-2, -1)) > 0.9).all())
    assert bool(found.fundamentals.isfinite().all()) and bool(found.homographies.isfinite().all())


def test_widths_are_shares_of_the_picture():
    scene = shot((60, 40))
    found = widths(scene.film(), members(scene))
    assert found.shape == (2,) and bool((found > 0).all()) and bool((found <= 1).all())
    assert float(found[0]) > 2 * float(found[1])
    everything = torch.ones(1, 100, dtype=F64)
    assert float(widths(scene.film(), everything)) == pytest.approx(1.0)
    # frames that show nothing do not count
    empty = torch.cat([scene.tracks, torch.full_like(scene.tracks[:3], torch.nan)])
    torch.testing.assert_close(widths(TrackSet.of(empty, 2.5), members(scene)), found)


@pytest.mark.parametrize(
    ("counts", "rests"),
    [((60, 30), 0), ((60, 20, 20), 0), ((40, 35), None), ((30, 60), None), ((80,), 0)],
    ids=["large", "three", "not large enough", "large but narrow", "alone"],
)
def test_what_rests_is_the_largest_and_widest(counts, rests):
    scene = shot(counts)
    assert find_static_body(scene.film(), members(scene)) == rests


def test_what_rests_has_a_share_of_all(monkeypatch):
    scene = shot((40, 20, 20, 20))
    for share, known in ((0.5, None), (0.3, 0)):
        monkeypatch.setattr(module, "MIN_STATIC_SHARE", share)
        assert find_static_body(scene.film(), members(scene)) == known


def test_declared_cameras_agree_with_what_rests():
    scene = shot((40, 30, 20), sigma=0.1)
    off = distances_from_cameras(scene.tracks, members(scene), scene.cameras, pairs_of(scene))
    assert int(off.argmin()) == 0 and float(off[0]) < 0.3 and float(off[1:].min()) > 5 * float(off[0])
    scaled = scene.cameras * torch.linspace(-2, 3, 10, dtype=F64)[:, None, None]
    torch.testing.assert_close(
        distances_from_cameras(scene.tracks, members(scene), scaled, pairs_of(scene)), off, rtol=1e-5, atol=1e-8
    )
    world = torch.linalg.qr(torch.randn(4, 4, generator=torch.Generator().manual_seed(0), dtype=F64))[0]
    torch.testing.assert_close(
        distances_from_cameras(scene.tracks, members(scene), scene.cameras @ world, pairs_of(scene)), off, rtol=1e-4, atol=1e-6
    )
    # the cameras of a body that moves agree with that one
    other = distances_from_cameras(scene.tracks, members(scene), scene.projections[:, 1], pairs_of(scene))
    assert int(other.argmin()) == 1


def test_a_body_in_no_pair_agrees_with_nothing():
    scene = shot((40, 30))
    tracks = scene.tracks.clone()
    tracks[1:, 40:] = torch.nan
    gone = replace(scene, tracks=tracks)
    off = distances_from_cameras(tracks, members(gone), scene.cameras, pairs_of(gone))
    assert float(off[1]) == torch.inf and float(off[0]) < 0.5

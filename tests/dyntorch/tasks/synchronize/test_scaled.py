"""Tracks about their middle: place and distance of the person go, everything else stays."""

import pytest
import torch

from dyntorch.scenes import filmed
from dyntorch.tasks.synchronize.tracks import read_tracks, scale_frames


def tracks_of(x, fps=30.0):
    return read_tracks("a", x, fps, None, None)


def scene(**more):
    return filmed(11, seconds=4.0, generator=torch.Generator().manual_seed(0), **more)


def test_medians_of_every_frame_are_nought():
    found = scale_frames(tracks_of(scene(noise=1.0).a))
    assert torch.allclose(found.x.median(1).values, torch.zeros(120, 2, dtype=torch.float64), atol=1e-9)


def test_place_and_distance_are_taken_out():
    x = scene(walk=0.0).a
    t = torch.arange(120, dtype=torch.float64)[:, None, None] / 30
    path = torch.cat([300 * (0.7 * t).sin(), 20 * t], dim=-1)
    # constant factors change the unit alone
    one, moved = (
        scale_frames(tracks_of(x)),
        scale_frames(tracks_of(3 * x + path)),
    )
    assert torch.allclose(moved.x, 3 * one.x, atol=1e-6)
    slow = 1 + 0.2 * t / 4  # somebody who comes nearer
    near = scale_frames(tracks_of(slow * x))
    ratio = (near.x.norm(dim=-1) / one.x.norm(dim=-1).clamp(min=1e-9))[15:-15].median(1).values
    assert float(ratio.max() / ratio.min()) < 1.03  # of 1.15


def test_one_wrong_point_moves_nothing_else():
    tracks = tracks_of(scene(noise=1.0).a)
    x = tracks.x.clone()
    x[:, 4] += 500.0
    good, bad = scale_frames(tracks), scale_frames(tracks_of(x))
    rest = torch.arange(11) != 4
    away = (good.x - bad.x)[:, rest].norm(dim=-1)
    assert float(away.median()) < 0.2 * float(good.x[:, rest].norm(dim=-1).median())


def test_missing_positions_stay_missing():
    x = scene(noise=1.0, missing=0.3).a
    x[50] = torch.nan
    found = scale_frames(tracks_of(x))
    assert bool(found.x.isfinite().all()) and not found.x[found.weights == 0].any()
    assert torch.equal(found.weights > 0, x.isfinite().all(-1))


@pytest.mark.parametrize("frames", [1, 2])
def test_takes_of_a_frame_or_two(frames):
    found = scale_frames(tracks_of(torch.rand(frames, 5, 2, generator=torch.Generator().manual_seed(1))))
    assert bool(found.x.isfinite().all())
    assert bool(scale_frames(tracks_of(torch.full((frames, 5, 2), torch.nan))).x.isfinite().all())

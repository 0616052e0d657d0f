"""Which frames are compared, where a video has a cut, and coordinates that no shift or scale of pixels changes."""

from __future__ import annotations

import pytest
import torch

from dyntorch.geometry.homogeneous import apply
from dyntorch.tasks.segment.frame_pairs import PairStack, TrackSet, find_scene_cut, select_frame_pairs, select_near_pairs
from tests.dyntorch.tasks.segment.videos import F64, draw, shot


def long_film(frames: int, length: int = 10, each: int = 6, shortest: int = 2) -> TrackSet:
    """Many tracks of up to ``length`` frames, ``each`` of which begin in every frame."""
    generator = draw()
    count = frames * each
    start = torch.arange(frames).repeat_interleave(each)
    lives = torch.randint(shortest, length + 1, (count,), generator=generator)
    number = torch.arange(frames)[:, None]
    there = (number >= start) & (number < start + lives)
    x = 500 * torch.rand(count, 2, generator=generator, dtype=F64) + 4.0 * number[..., None]
    return TrackSet.of(torch.where(there[..., None], x, torch.nan))


def kept(pairs, film):
    """``(n,)`` in how many pairs each track is."""
    return torch.stack([film.seen[a] & film.seen[b] for a, b in pairs]).sum(0)


def test_coordinates_are_centred_and_what_is_missing_is_zero():
    scene = shot((40, 20))
    film = scene.film()
    assert float(film.x.reshape(-1, 2).norm(dim=-1).median()) == pytest.approx(1.0, abs=0.1)
    moved = TrackSet.of(3.5 * scene.tracks + torch.tensor([1000.0, -70.0], dtype=F64), 3.5)
    torch.testing.assert_close(moved.x, film.x, rtol=0, atol=1e-9)
    assert moved.pixel == pytest.approx(film.pixel)
    torch.testing.assert_close(apply(film.change, scene.tracks[3]), film.x[3], rtol=0, atol=1e-9)
    assert float((scene.tracks[3][1] - scene.tracks[3][0]).norm() * film.change[0, 0]) == pytest.approx(
        float((film.x[3][1] - film.x[3][0]).norm())
    )
    scene = shot((40,))
    tracks = scene.tracks.clone()
    tracks[2:5, 7] = torch.nan
    tracks[0, 3, 0] = torch.inf  # half a point is none
    film = TrackSet.of(tracks)
    assert not bool(film.seen[2:5, 7].any()) and not bool(film.seen[0, 3]) and int((~film.seen).sum()) == 4
    assert bool((film.x[~film.seen] == 0).all()) and bool(film.x.isfinite().all())
    assert film.lengths.tolist() == [10] * 3 + [9] + [10] * 36  # from the first to the last frame, holes included
    equal = TrackSet.of(torch.full((3, 10, 2), 5.0, dtype=F64))
    assert bool(equal.x.isfinite().all()) and equal.pixel > 0


def test_a_pair_holds_the_tracks_of_both_frames_and_trusts_those_that_move_little():
    film = long_film(30)
    pair = film.pair((10, 13))
    assert pair.index.tolist() == (film.seen[10] & film.seen[13]).nonzero().flatten().tolist()
    torch.testing.assert_close(pair.view.x1, film.x[10][pair.index])
    torch.testing.assert_close(pair.view.x2, film.x[13][pair.index])
    still = film.pair((10, 10))
    assert bool((still.precision == 1).all()) and bool((pair.precision < 1).all()) and bool((pair.precision > 0).all())
    both = PairStack.of([pair, film.pair((3, 20))])
    assert both.present.sum(-1).tolist() == [len(pair.index), int((film.seen[3] & film.seen[20]).sum())]
    torch.testing.assert_close(both.weight[0, : len(pair.index)] * pair.precision.mean(), pair.precision)
    chance = torch.rand(2, 3, film.x.shape[1])
    assert torch.equal(both.members(chance)[0][..., : len(pair.index)], chance[..., pair.index].double())
    assert bool((both.members(chance)[1][..., ~both.present[1]] == 0).all())


def test_near_pairs_have_enough_in_common_and_grow_with_the_video():
    short, long = long_film(30), long_film(120)
    gaps, starts, common = (1, 2, 4), 10, 16
    found = select_near_pairs(short, gaps, starts, common)
    assert found and all(b - a in gaps and int((short.seen[a] & short.seen[b]).sum()) >= common for a, b in found)
    assert len(set(found)) == len(found)
    more = select_near_pairs(long, gaps, starts, common)
    assert 2 * len(found) < len(more) < 8 * len(found)
    assert select_near_pairs(short, (50,), 3, 1) in ([], [(0, 29)])  # no gap is wider than the video
    assert select_near_pairs(short, gaps, starts, 10_000) == []


def test_chosen_pairs_show_all_tracks_and_grow_with_the_length_of_the_video_at_most():
    film = long_film(40, each=12, shortest=4)
    pairs = select_frame_pairs(film, 64)
    assert pairs == sorted(set(pairs)) == select_frame_pairs(film, 64)
    assert all(0 <= a < b < 40 for a, b in pairs)
    assert all(int((film.seen[a] & film.seen[b]).sum()) >= 20 for a, b in pairs)
    assert float((kept(pairs, film)[film.seen.sum(0) >= 3] > 0).double().mean()) > 0.95
    assert max(b - a for a, b in pairs) > 2 * min(b - a for a, b in pairs)  # near and far
    counts = [len(select_frame_pairs(long_film(frames), 10_000)) for frames in (40, 80, 160)]
    assert counts[0] < counts[1] < counts[2] < 5 * counts[0]
    assert len(select_frame_pairs(long_film(160), 64)) <= 64
    for frames in (2, 3, 8):
        film = shot((30, 20), frames=frames).film()
        pairs = select_frame_pairs(film, 64)
        assert 1 <= len(pairs) <= frames * (frames - 1) // 2 and (0, frames - 1) in pairs
        assert bool((kept(pairs, film) == len(pairs)).all())


def test_plain_videos_have_no_cut():
    jumps = shot((60, 20)).tracks
    jumps[5:, :20] += 300.0  # of some tracks
    for film in (shot((60, 40)).film(), shot((60,), frames=3).film(), shot((60, 30), moves=4.0).film(), TrackSet.of(jumps)):
        assert find_scene_cut(film) is None
    assert find_scene_cut(long_film(60)) is None


def test_a_cut_is_where_tracks_end_and_others_begin_or_all_jump():
    tracks = shot((60,)).tracks
    for frame in (3, 6):
        before, after = tracks.clone(), tracks.clone()
        before[frame:], after[:frame] = torch.nan, torch.nan
        before[:, :4] = tracks[:, :4]  # a few are taken for the same
        cut = find_scene_cut(TrackSet.of(torch.cat([before, after], 1)))
        assert cut is not None and cut.frame == frame
        assert cut.share == pytest.approx(4 / 60, abs=0.02) and cut.jump == 0
    for frame in (2, 7):
        jump = shot((60, 20)).tracks
        jump[frame:] = jump[frame:][:, torch.randperm(80, generator=draw(1))]
        cut = find_scene_cut(TrackSet.of(jump))
        assert cut is not None and cut.frame == frame and cut.jump > 5

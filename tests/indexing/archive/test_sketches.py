"""Sketches against brute force: every window by itself, its planes by a decomposition of numpy's."""

import numpy as np
import pytest
import torch

from indexing.archive import sketches
from indexing.archive.search import probe_of
from indexing.archive.segments import ArchiveSegment, write_segment
from indexing.archive.sketches import Candidates, Probe, correlation, mark_resembling, orthonormal, refine_candidates, scan
from indexing.archive.tracks import Layout, StorageFormat, tracks_of
from indexing.clip import Clip
from indexing.windows import concatenate_clips

STORAGE = StorageFormat()


def movement(rng, seconds, joints=9):
    """Joints that swing about their places at frequencies of their own: ``(frames, joints, 3)`` at 30 frames per second."""
    t = np.arange(round(seconds * 30))[:, None, None] / 30
    rate, phase, size = rng.uniform(0.2, 1.5, (joints, 3)), rng.uniform(0, 6.3, (joints, 3)), rng.uniform(0.05, 0.4, (joints, 3))
    return rng.normal(size=(joints, 3)) + size * np.sin(2 * np.pi * rate * t + phase)


def image(points, rng):
    """By any affine camera, in pixels."""
    return points @ rng.normal(size=(3, 2)) * 80 + rng.uniform(200, 800, 2)


@pytest.fixture(scope="module")
def segment(tmp_path_factory):
    rng = np.random.default_rng(0)
    folder = tmp_path_factory.mktemp("segment")
    tracks = []
    for number, seconds in enumerate((20.0, 3.0, 0.7, 12.0), 1):
        tracks += tracks_of(Clip(image(movement(rng, seconds), rng), fps=30.0), STORAGE, number)
    layout = Layout.learn(tracks, None, STORAGE)
    path = folder / write_segment(folder, tracks, layout, STORAGE).file
    return ArchiveSegment.open(path), layout


def planes(segment, probe, track, row):
    """The window's axes and the example's, ``(2, samples k)``, in floats."""
    rows = int(segment.firsts[track]) + row + np.arange(probe.samples) * probe.stride
    x = np.asarray(segment.codes[rows], dtype=np.float64) * np.asarray(segment.scales[rows])[:, None, None]
    return x.transpose(1, 0, 2).reshape(2, -1), probe.codes.reshape(2, -1).astype(np.float64)


def reference(segment, probe):
    """``{(track, row): squared largest canonical correlation}`` of every window that lies in a track."""
    found = {}
    for track, (first, rows) in enumerate(segment.tracks[:, 2:4].tolist()):
        for row in range(rows - probe.span):
            if (first + row) % probe.stride == 0:
                found[track, row] = squared_cosine(*planes(segment, probe, track, row))
    return found


def probe(segment, layout, seconds=1.0, track=0, begin=4.0, tempo=1.0, moving=False, samples=4):
    rows = slice(round(begin * segment.rate), round((begin + seconds) * segment.rate) + 1)
    joints = segment.positions(track)[rows]
    source = concatenate_clips([Clip(joints, times=np.arange(len(joints)) / segment.rate)])
    return probe_of(source, 0, layout, segment.rate, tempo, samples, moving=moving)


def squared_cosine(window, example):
    """The largest canonical correlation of two planes, by numpy."""
    return np.linalg.svd(np.linalg.qr(window.T)[0].T @ np.linalg.qr(example.T)[0], compute_uv=False)[0] ** 2


def test_scan_is_the_best_of_every_window_and_candidates_settle_where_they_fit_best(segment):
    stored, layout = segment
    for seconds in (0.5, 1.0, 2.5):
        example = probe(stored, layout, seconds)
        result = scan(stored, [example], 10_000)
        assert len(result) >= 3
        for score, track, row in zip(result.score.tolist(), result.track.tolist(), result.row.tolist(), strict=True):
            assert score == pytest.approx(squared_cosine(*planes(stored, example, track, row)), abs=1e-3), seconds
        assert (result.row >= 0).all() and (result.row + example.span < stored.tracks[result.track, 3]).all(), seconds
        assert result.score[0] >= max(reference(stored, example).values()) - 1e-3
        assert result.track[0] == 0 and abs(result.row[0] / stored.rate - 4.0) <= 1 / stored.rate + 0.1 * seconds
    probes = [probe(stored, layout, 2.5, tempo=tempo) for tempo in (0.8, 1.0, 1.25)]
    finer = [probe(stored, layout, 2.5, tempo=tempo, samples=16) for tempo in (0.8, 1.0, 1.25)]
    assert finer[1].samples > 2 * probes[1].samples
    start, scanned = np.array([60, 58, 150]), probes[1]
    found = Candidates(np.zeros(3, np.float32), np.zeros(3, np.int64), start, np.ones(3, np.int64))
    moved = refine_candidates(stored, probes, finer, found)
    assert moved.probe.tolist() == np.repeat(range(3), 3).tolist() and moved.score.argmax() == 3 and moved.score[3] > 0.999
    for number, begin, row, score in zip(moved.probe, np.tile(start, 3), moved.row, moved.score, strict=True):
        fine, half = finer[number], scanned.stride // 2
        middle = begin + (scanned.span - fine.span) // 2
        values = {at: squared_cosine(*planes(stored, fine, 0, at)) for at in range(middle - half, middle + half + 1)}
        assert [score, values[row]] == pytest.approx([max(values.values())] * 2, abs=1e-3)


def test_another_camera_sees_the_same(segment):
    """The rank condition: any affine image of the same points lies in the span of their three coordinates."""
    rng = np.random.default_rng(2)
    points = movement(rng, 30.0)
    tracks = [one for camera in range(2) for one in tracks_of(Clip(image(points, rng), fps=30.0), STORAGE, camera)]
    layout = Layout.learn(tracks, None, StorageFormat(dimensions=9))
    codes = [layout.project(track.positions()) for track in tracks]
    rows = 100 + np.arange(6) * 3
    window, example = (one[rows].transpose(1, 0, 2) for one in codes)
    flat = window.reshape(2, -1).astype(np.float64)
    c = torch.tensor(flat @ orthonormal(example).reshape(2, -1).T.astype(np.float64))[:, None, :, None]
    gram = torch.tensor(flat @ flat.T)
    value = float(correlation(c, torch.stack([gram[0, 0], gram[0, 1], gram[1, 1]])[:, None]))
    assert value > 0.99  # two planes of one space of three dimensions share a line


def test_blocks_parts_and_the_number_that_is_asked_for_change_nothing(segment, monkeypatch):
    stored, layout = segment
    both = [probe(stored, layout, 1.0), probe(stored, layout, 1.5, tempo=1.25)]
    whole = scan(stored, both, 500)
    parts = [scan(stored, both, 500, begin=at, end=at + 90) for at in range(0, len(stored.codes), 90)]
    assert same(whole, Candidates.concatenate(parts).top(500))
    assert same(whole.top(5), scan(stored, both, 5))
    for block in (7, 64):
        monkeypatch.setattr(sketches, "BLOCK", block)
        assert same(whole, scan(stored, both, 500)), block


def test_only_movement_counts_where_it_is_asked_for(tmp_path):
    rng = np.random.default_rng(3)
    points = movement(rng, 12.0)
    points[150:] = points[150]  # who stands still is no example of anything
    tracks = tracks_of(Clip(image(points, rng) + rng.normal(size=(360, 9, 2)), fps=30.0), STORAGE)
    layout = Layout.learn(tracks, None, STORAGE)
    stored = ArchiveSegment.open(tmp_path / write_segment(tmp_path, tracks, layout, STORAGE).file)
    marked = mark_resembling(stored, [probe(stored, layout, 1.5, begin=2.0, moving=True)], 0.6, 0.2)
    assert marked[31:50].all() and not marked[85:].any()


def same(one, other):
    return all(np.array_equal(getattr(one, name), getattr(other, name)) for name in ("track", "row", "probe")) and np.allclose(
        one.score, other.score, atol=1e-4
    )


def test_probe_lies_in_the_middle():
    asked = Probe(0, False, 1.0, 3, np.zeros((2, 5, 8), np.float32))
    assert (asked.samples, asked.span) == (5, 12)


def test_a_track_as_long_as_the_window_is_found_wherever_it_lies(tmp_path):
    """The grid of the scan knows no tracks: what is hardly longer than a window may lie between two of its steps."""
    rng = np.random.default_rng(4)
    for before in (0.7, 0.9, 1.1, 1.3):
        clips = [Clip(image(movement(rng, seconds), rng), fps=30.0) for seconds in (before, 3.0, 1.0)]
        tracks = [track for number, clip in enumerate(clips) for track in tracks_of(clip, STORAGE, number)]
        layout = Layout.learn(tracks, None, STORAGE)
        stored = ArchiveSegment.open(tmp_path / write_segment(tmp_path, tracks, layout, STORAGE).file)
        source = concatenate_clips([Clip(stored.positions(1), times=np.arange(len(tracks[1])) / stored.rate)])
        found = scan(stored, [probe_of(source, 0, layout, stored.rate, 1.0)], 10)
        assert found.track[0] == 1 and found.score[0] > 0.999


def test_the_best_candidates_are_those_of_sorting_all():
    rng = np.random.default_rng(0)
    found = Candidates(rng.integers(0, 9, 60).astype(np.float32), *rng.integers(0, 4, (3, 60)))
    order = np.lexsort((found.probe, found.row, found.track, -found.score))
    for count in (0, 1, 13, 60, 70):
        best = found.top(count)
        for name in ("score", "track", "row", "probe"):
            np.testing.assert_array_equal(getattr(best, name), getattr(found, name)[order[:count]])

"""Two sets of labels compared: against brute force on a grid, scikit-learn, and the published F1 of temporal segmentation."""

from __future__ import annotations

import itertools
import math
import tracemalloc

import numpy as np
import pytest
from sklearn.metrics import cohen_kappa_score, confusion_matrix

from indexing.comparing import NONE, ComparedSpan, SegmentCounts, compare, kappa, right_segments, time_table

STEP = 0.01
LENGTH = 20.0
LABELS = ("jump", "squat", "wave")


def tiled(rng, labels=LABELS):
    """Segments that do not overlap, at multiples of the grid's step."""
    edges = np.sort(rng.choice(np.arange(1, round(LENGTH / STEP)), size=2 * int(rng.integers(2, 9)), replace=False)) * STEP
    return [(str(rng.choice(labels)), a, b) for a, b in zip(edges[::2], edges[1::2], strict=True)]


def anyhow(rng, number=9):
    """Segments that overlap as they like, of one label, too."""
    ends = np.sort(rng.integers(0, round(LENGTH / STEP), size=(number, 2)), axis=1) * STEP
    return [(str(rng.choice(LABELS)), a, b) for a, b in ends.tolist()]


def framed(intervals):
    """The set of labels of each step of the grid."""
    middle = (np.arange(round(LENGTH / STEP)) + 0.5) * STEP
    return [{label for label, a, b in intervals if a < t < b} for t in middle]


def named(frames):
    return [next(iter(frame), NONE) for frame in frames]


def span(known, found, name="a", end=LENGTH, person=""):
    return ComparedSpan(name, 0.0, end, known, found, person)


@pytest.mark.parametrize("seed", range(6))
def test_kappa_is_that_of_frames_as_they_become_short(seed):
    rng = np.random.default_rng(seed)
    known, found = tiled(rng), tiled(rng)
    both = compare([span(known, found)])
    frames = named(framed(known)), named(framed(found))
    assert both.kappa == pytest.approx(cohen_kappa_score(*frames))
    names = [*both.labels, NONE]
    assert np.allclose(both.seconds, confusion_matrix(*frames, labels=names) * STEP)
    assert both.agreement == pytest.approx(np.mean([a == b for a, b in zip(*frames, strict=True)]))
    for label, one in both.by_label.items():
        assert one.kappa == pytest.approx(cohen_kappa_score([a == label for a in frames[0]], [a == label for a in frames[1]]))


def shared(known, found):
    """What one moment adds to the table, pair by pair: the definition, with the shorter side filled up."""
    out = {}
    if not known and not found:
        return {(NONE, NONE): 1.0}
    most = max(len(known), len(found))
    for label in known & found:
        out[label, label] = 1 / most
    mine, theirs = sorted(known - found), sorted(found - known)
    size = most - len(known & found)
    mine, theirs = mine + [NONE] * (size - len(mine)), theirs + [NONE] * (size - len(theirs))
    for a, b in itertools.product(mine, theirs):
        out[a, b] = out.get((a, b), 0.0) + 1 / (most * size)
    return out


@pytest.mark.parametrize("seed", range(6))
def test_time_with_several_labels_is_shared_evenly(seed):
    rng = np.random.default_rng(seed)
    known, found = anyhow(rng), anyhow(rng)
    both = compare([span(known, found)])
    names = [*both.labels, NONE]
    expected = np.zeros((len(names), len(names)))
    for mine, theirs in zip(framed(known), framed(found), strict=True):
        for (a, b), share in shared(mine, theirs).items():
            expected[names.index(a), names.index(b)] += share * STEP
    assert np.allclose(both.seconds, expected)
    assert both.total_seconds == pytest.approx(LENGTH)
    for label, one in both.by_label.items():
        here, there = (np.array([label in frame for frame in framed(side)]) for side in (known, found))
        assert (one.known, one.found, one.both) == pytest.approx([STEP * x.sum() for x in (here, there, here & there)])


def published(recognized, truth, overlap):
    """True positives as MS-TCN counts them: segments found in order, each with its best known one."""
    hits = np.zeros(len(truth))
    for label, start, end in recognized:
        union = np.array([max(end, b) - min(start, a) for _, a, b in truth])
        cut = np.array([min(end, b) - max(start, a) for _, a, b in truth])
        iou = (cut / union) * [label == name for name, _, _ in truth]
        best = int(np.argmax(iou))
        if iou[best] >= overlap and not hits[best]:
            hits[best] = 1
    return int(hits.sum())


def test_segments_are_counted_as_the_field_counts_them():
    for seed in range(20):
        rng = np.random.default_rng(seed)
        known, found = tiled(rng), tiled(rng)
        both = compare([span(known, found)])
        for overlap in (0.1, 0.25, 0.5):
            right = published(found, known, overlap)
            assert both.segments[overlap] == SegmentCounts(right, len(found), len(known)), seed
            assert both.segments[overlap].f1 == pytest.approx(2 * right / (len(found) + len(known)))
    for scale in np.random.default_rng(0).uniform(0.01, 1000, 50):  # one half is enough however it is rounded
        assert right_segments([(0.1 * scale, 1.2 * scale)], [(0.1 * scale, 2.3 * scale)], 0.5) == 1
    assert right_segments([(0.0, 0.99)], [(0.0, 2.0)], 0.5) == 0
    halves, whole = [(0.0, 1.1), (1.1, 2.0)], [(0.0, 2.0)]  # one known segment makes one find right
    assert right_segments(halves, whole, 0.1) == 1 == right_segments(halves[::-1], whole, 0.1)
    assert right_segments(whole, halves, 0.1) == 1
    assert right_segments([], whole, 0.1) == right_segments(whole, [], 0.1) == 0


def test_the_same_twice_agrees_and_order_does_not_matter():
    rng = np.random.default_rng(3)
    known, found = anyhow(rng), anyhow(rng)
    same = compare([span(known, known)])
    assert same.kappa == pytest.approx(1.0) and same.agreement == pytest.approx(1.0)
    there = compare([span(known, found)])
    mixed = compare([span(known[::-1], [found[i] for i in rng.permutation(len(found))])])
    assert np.allclose(there.seconds, mixed.seconds) and there.segments == mixed.segments
    back = compare([span(found, known)])
    assert np.allclose(there.seconds, back.seconds.T) and there.kappa == pytest.approx(back.kappa)


def test_people_and_recordings_are_compared_each_with_their_own():
    one, other = [("squat", 1.0, 3.0)], [("squat", 10.0, 12.0)]
    apart = compare([span(one, other, person="1"), span(other, one, person="2")])
    assert apart.by_label["squat"].both == 0.0 and apart.segments[0.1] == SegmentCounts(0, 2, 2)
    assert apart.total_seconds == pytest.approx(2 * LENGTH)
    parts = [compare([span(one, one)]), compare([span(other, one)])]
    together = compare([span(one, one), span(other, one, "b")])
    assert np.allclose(together.seconds, parts[0].seconds + parts[1].seconds)
    assert together.segments[0.5] == parts[0].segments[0.5] + parts[1].segments[0.5]


def test_what_does_not_exist_is_no_number():
    nothing = compare([span([], [])])
    assert nothing.labels == () and math.isnan(nothing.kappa) and nothing.agreement == 1.0
    assert math.isnan(nothing.segments[0.5].f1) and nothing.total_seconds == pytest.approx(LENGTH)
    assert math.isnan(compare([]).agreement) and math.isnan(kappa(np.zeros((2, 2))))
    missed = compare([span([("squat", 1.0, 2.0)], [])])
    assert math.isnan(missed.segments[0.5].precision) and missed.segments[0.5].recall == 0.0 and missed.kappa == 0.0
    assert time_table(np.zeros(0), np.zeros((0, 1), bool), np.zeros((0, 1), bool)).tolist() == [[0.0, 0.0], [0.0, 0.0]]


def test_all_numbers_as_json():
    plain = compare([span([("squat", 0.0, 5.0)], [("squat", 0.0, 5.0), ("jump", 6.0, 7.0)])]).to_json()
    assert plain["at_overlap"]["0.5"] == {"right": 1, "found": 2, "known": 1, "precision": 0.5, "recall": 1.0, "f1": 2 / 3}
    assert plain["confusion_seconds"]["labels"] == ["jump", "squat", NONE]
    assert plain["by_label"]["squat"]["seconds_both"] == 5.0 and plain["seconds_compared"] == LENGTH
    # labels are cut at the ends, and moments count for nothing
    cut = compare([span([("squat", -5.0, 2.0), ("clap", 1.0, 1.0), ("jump", 30.0, 31.0)], [("squat", 0.0, 2.0)])])
    assert cut.labels == ("squat",) and cut.kappa == pytest.approx(1.0) and cut.segments[0.5] == SegmentCounts(1, 1, 1)


def test_bad_input_says_what_is_wrong(monkeypatch):
    with pytest.raises(ValueError, match="a: 'squat' from 3 s to 2 s is no interval; give seconds, start first"):
        compare([span([("squat", 3, 2)], [])])
    with pytest.raises(ValueError, match="is no interval"):
        compare([span([], [("squat", 0.0, math.nan)])])
    for start, end in ((0.0, math.nan), (math.nan, 1.0), (0.0, math.inf), (2.0, 1.0)):
        with pytest.raises(ValueError, match=f"a: {start} s to {end} s is no span of time; give seconds, start first"):
            compare([ComparedSpan("a", start, end, [("squat", 0.0, 1.0)], [])])
    texts = [(f"remark {i}", float(i), i + 0.5) for i in range(4)]
    monkeypatch.setattr("indexing.comparing.MAX_LABELS", 3)
    with pytest.raises(ValueError, match="4 different labels, of which 3 can be compared; are they free text"):
        compare([span(texts, [])])


@pytest.mark.slow
def test_blocks_change_nothing_and_bound_what_is_held(monkeypatch):
    rng = np.random.default_rng(0)
    starts = np.sort(rng.uniform(0, 1000, size=(2, 1500)))
    one = span(*([(f"l{rng.integers(300):03d}", a, a + 2.0) for a in side] for side in starts.tolist()), end=1002.0)
    blocks, held = [], []
    for block in (64, 10**6):
        monkeypatch.setattr("indexing.comparing.BLOCK", block)
        tracemalloc.start()
        blocks.append(compare([one]))
        held.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert np.allclose(blocks[0].seconds, blocks[1].seconds, atol=1e-9) and blocks[0].segments == blocks[1].segments
    assert blocks[1].by_label["l007"].both == pytest.approx(blocks[0].by_label["l007"].both)
    assert blocks[0].total_seconds == pytest.approx(1002.0) and held[0] < 6e6 < 20e6 < held[1]

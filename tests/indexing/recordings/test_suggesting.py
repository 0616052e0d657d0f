"""Which parts of recordings are worth a label: what nobody knows first, never the same twice, never what is labelled or still."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from indexing import ActionIndexer, Clip
from indexing.actors import Person, dataset, detect, stream
from indexing.recordings import suggesting
from indexing.recordings.suggesting import compare_parts, parts_of, select_parts, suggest

KNOWN = ("squat", "wave")
DONE = ["squat", "kick", "wave", "kick", "bow", "squat", "kick", "wave"]


@pytest.fixture(scope="module")
def learned() -> ActionIndexer:
    clips = dataset([Person()], KNOWN, azimuth=0, rng=0)
    return ActionIndexer().fit(clips, clips.labels)


@pytest.fixture(scope="module")
def recording() -> tuple[Clip, list[tuple[str, float, float]]]:
    solid, truth = stream(DONE, Person(), rng=3)
    return detect(solid, azimuth=20, rng=3), truth


def names(found, truth):
    """What happens in each part, as far as it is one action."""
    out = []
    for one in found:
        shared = [(min(one.end, b) - max(one.start, a), label) for label, a, b in truth]
        out.append(max(shared)[1])
    return out


@pytest.mark.slow
def test_what_is_not_known_comes_first_and_not_twice(learned, recording) -> None:
    clip, truth = recording
    found = suggest(learned, [clip], 3)
    assert set(names(found[:2], truth)) == {"kick", "bow"}
    assert {one.reason for one in found[:2]} == {"unlike what is known"}
    assert all(one.start < one.end and 0 <= one.margin <= 1 and one.guess in KNOWN for one in found)
    spans = sorted((one.start, one.end) for one in suggest(learned, [clip], 99))
    assert all(a[1] <= b[0] + 1e-9 for a, b in pairwise(spans))


@pytest.mark.slow
def test_nobody_who_stands_still_or_is_not_seen_is_suggested(learned, recording) -> None:
    clip, _ = recording
    still = clip.replace(joints=np.repeat(clip.joints[:1], len(clip), axis=0))
    shares: list[float] = []
    found = suggest(learned, [still, clip.replace(times=clip.times + 1000.0)], 2, progress=shares.append)
    assert {one.recording for one in found} == {1} and min(one.start for one in found) > 1000
    assert shares == sorted(shares) and 0 < shares[-1] <= 1
    gone = clip.joints.copy()
    gone[(clip.times > 4) & (clip.times < 12)] = np.nan
    for one in suggest(learned, [clip.replace(joints=gone, confidence=None)], 99):
        assert max(0.0, min(one.end, 12) - max(one.start, 4)) <= 0.6 * (one.end - one.start)


def test_parts_cover_the_recording_and_stay_within_gaps(learned, recording) -> None:
    clip, _ = recording
    kept = (clip.times < 6) | (clip.times > 9)
    torn = clip.replace(joints=clip.joints[kept], times=clip.times[kept], confidence=None)
    parts = parts_of(learned, torn, [])
    assert not ((parts.spans[:, 0] < 8.9) & (parts.spans[:, 1] > 6.1)).any()
    assert parts.spans.min() >= clip.times[0] and parts.spans.max() <= clip.times[-1]


@pytest.mark.slow
def test_what_is_known_or_labelled_is_not_suggested(learned, recording, monkeypatch) -> None:
    clip, truth = recording
    parts = parts_of(learned, clip, [])
    likely, near, apart, usual = compare_parts(learned, parts.windows)
    assert likely.shape == (len(parts.spans), 2) and apart.shape == (len(parts.spans),) * 2
    assert np.allclose(apart, apart.T, atol=0.1) and (np.diag(apart) < 0.01).all() and 0 < usual < 1
    inside = [any(a <= (s + e) / 2 <= b and label in KNOWN for label, a, b in truth) for s, e in parts.spans]
    assert near[inside].max() < near[~np.array(inside)].min()
    done = [(a, b) for label, a, b in truth if label == "kick"]
    assert "kick" not in names(suggest(learned, [clip], 2, [done]), truth)
    assert suggest(learned, [clip], 9, [[(-1.0, 1e6)]]) == []
    monkeypatch.setattr(suggesting, "MAX_CANDIDATES", 4)
    assert 1 <= len(suggest(learned, [clip], 99)) <= 4  # too many are thinned out
    with pytest.raises(ValueError, match="number=0: suggests nothing; give 1 or more"):
        suggest(learned, [clip], 0)


def left(points, centres):
    """What is unlike everything known, summed."""
    return float(np.linalg.norm(points[:, None] - centres, axis=2).min(axis=1).sum())


@pytest.mark.parametrize("seed", range(3))
def test_each_leaves_the_least_that_is_unlike_what_is_known(seed: int) -> None:
    rng = np.random.default_rng(seed)
    points, known = rng.normal(size=(40, 2)), rng.normal(size=(3, 2))
    apart = np.linalg.norm(points[:, None] - points, axis=2)
    picked = select_parts(np.linalg.norm(points[:, None] - known, axis=2).min(axis=1), apart, 6)
    assert len(set(picked)) == 6
    for count, one in enumerate(picked):
        before = np.concatenate([known, points[picked[:count]]])
        tried = [left(points, np.concatenate([before, points[[i]]])) for i in range(40)]
        assert tried[one] == pytest.approx(min(tried))

"""segment_tracks: small videos of rigid bodies and streets, and what the result must and must not depend on."""

from __future__ import annotations

from dataclasses import fields, replace

import pytest
import torch

import dyntorch as dyn
from dyntorch import scenes
from dyntorch.core.outcome import Status
from dyntorch.geometry.epipolar import sampson_squared
from dyntorch.metrics import misclassification
from dyntorch.tasks.segment import agglomeration, frame_pairs
from dyntorch.tasks.segment import tracks as module
from dyntorch.tasks.segment.result import SegmentNotice
from tests.dyntorch.tasks.segment.videos import F64, Shot, draw, shot

QUICK = dyn.TrackSegmentOptions(max_frame_pairs=8, num_hypotheses=100)


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    """Fewer pairs of frames, fewer hypotheses, and one start: enough for a hundred tracks."""
    monkeypatch.setattr(frame_pairs, "MIN_FRAME_PAIRS", 6)
    monkeypatch.setattr(agglomeration, "KERNEL_PAIRS_PER_GAP", 5)
    monkeypatch.setattr(module, "PIECE_COUNTS", (8,))
    monkeypatch.setattr(module, "MERGE_PAIRS_PER_GAP", 4)


def segmented(tracks, bodies=None, seed: int = 9, **given):
    return dyn.segment_tracks(tracks, bodies, **{"generator": draw(seed), "options": QUICK, **given})


def wrong(found, labels) -> float:
    return float(misclassification(found.labels, labels))


def codes(found) -> list:
    return [one.code for one in found.notices]


# ---- labels ------------------------------------------------------------------------------------------------------------
@pytest.mark.slow
@pytest.mark.parametrize("counts", [(45, 25, 20), (40, 20, 20, 20)], ids=str)
def test_bodies_of_a_known_number(counts):
    scene = shot(counts, seed=1)
    found = segmented(scene.tracks, len(counts)).check()
    assert int(found.bodies) == len(counts) and int(found.status) == Status.OK
    assert wrong(found, scene.labels) <= 0.05
    assert int(found.static_body) == 1


@pytest.mark.slow
@pytest.mark.parametrize("counts", [(70,), (50, 30), (45, 25, 20)], ids=str)
def test_the_number_of_bodies_is_found(counts):
    scene = shot(counts, seed=2)
    found = segmented(scene.tracks)
    assert int(found.bodies) == len(counts)
    assert wrong(found, scene.labels) <= 0.05
    assert (SegmentNotice.ONE_BODY in codes(found)) == (len(counts) == 1)


@pytest.mark.slow
def test_a_street():
    street = scenes.streets(2, frames=10, tracks=150, sigma=0.1, generator=draw(5))
    found = segmented(street.tracks, 2, cameras=street.cameras)
    assert wrong(found, street.labels) <= 0.05
    assert int(found.static_body) == int(found.labels[street.labels == 1].mode().values)


def partial() -> Shot:
    """Tracks that begin and end somewhere; body 3 appears in frame 4."""
    scene = shot((50, 30, 25), frames=12, seed=3)
    generator, number = draw(1), torch.arange(12)[:, None]
    start = torch.randint(0, 5, (105,), generator=generator)
    start[80:] += 4
    there = (number >= start) & (number < start + torch.randint(5, 11, (105,), generator=generator))
    return replace(scene, tracks=torch.where(there[..., None], scene.tracks, torch.nan))


@pytest.mark.slow
def test_partial_tracks_bodies_that_never_meet_and_empty_frames():
    scene = partial()
    found = segmented(scene.tracks, 3).check()
    assert wrong(found, scene.labels) <= 0.05
    late = int(found.labels[scene.labels == 3].mode().values)
    gone = found.pairs[:, 0] < 4
    assert bool(gone.any()) and bool((found.geometries[gone, late - 1] == 0).all())
    assert bool((found.geometries[~gone, late - 1].norm(dim=(-2, -1)) > 0.9).any())
    scene = shot((50, 30, 25), frames=12, seed=3)
    scene.tracks[6:, 50:80] = torch.nan
    scene.tracks[:6, 80:] = torch.nan
    assert wrong(segmented(scene.tracks, 3), scene.labels) <= 0.05
    scene = shot((50, 30), frames=8)
    scene.tracks[[0, 4]] = torch.nan
    found = segmented(scene.tracks, 2)
    assert wrong(found, scene.labels) <= 0.05
    assert not bool((found.pairs == 0).any()) and not bool((found.pairs == 4).any())


@pytest.mark.slow
def test_tracks_that_follow_nothing_or_are_missing_are_outliers():
    scene = shot((50, 30))
    chance = draw(5)
    tracks = scene.tracks.clone()
    tracks[:, :5] = 640 * torch.rand(10, 5, 2, generator=chance, dtype=F64)
    found = segmented(tracks, 2)
    assert bool((found.labels[:5] == 0).all()) and float((found.labels[5:] > 0).double().mean()) > 0.95
    assert bool((found.probabilities[:5, 0] == 1).all()) and bool((found.residuals[:5] > 2.5).all())
    tracks = scene.tracks.clone()
    tracks[:, 0] = torch.nan
    tracks[1:, 1] = torch.nan
    found = segmented(tracks, 2)
    assert found.labels[:2].tolist() == [0, 0] and wrong(found, torch.cat([scene.labels[:2] * 0, scene.labels[2:]])) <= 0.05
    assert bool((found.residuals[:2] == 0).all()) and bool((found.probabilities[:2, 1:] == 0).all())


@pytest.mark.slow
def test_tracks_that_are_not_searched_follow():
    scene = shot((70, 50), seed=4)
    few = replace(QUICK, max_searched=60)
    found = segmented(scene.tracks, 2, options=few)
    assert wrong(found, scene.labels) <= 0.05
    assert bool((found.labels > 0).all())


@pytest.mark.slow
@pytest.mark.parametrize("bodies", [2, None])
def test_before_a_camera_that_stands(bodies):
    scene = shot((50, 30), frames=6)
    tracks = scene.tracks.clone()
    tracks[:, :50] = tracks[:1, :50] + 0.1 * torch.randn(6, 50, 2, generator=draw(3), dtype=F64)
    found = segmented(tracks, bodies)
    assert int(found.bodies) == 2 and wrong(found, scene.labels) <= 0.05 and int(found.static_body) == 1


@pytest.mark.parametrize("frames", [2, 3])
def test_two_or_three_frames(frames):
    scene = shot((50, 30), frames=10)
    found = segmented(scene.tracks[:: 10 // frames][:frames], 2)
    assert wrong(found, scene.labels) <= 0.05


# ---- parts of the result -----------------------------------------------------------------------------------------------
@pytest.mark.slow
def test_parts_of_the_result_fit_together():
    scene = shot((50, 30), planar=(2,))
    found = segmented(scene.tracks, 2)
    P = len(found.pairs)
    sizes = torch.bincount(found.labels, minlength=3)[1:].tolist()
    assert sizes == sorted(sizes, reverse=True)
    assert found.geometries.shape == found.homographies.shape == (P, 2, 3, 3) and found.planar.shape == (P, 2)
    assert bool((found.pairs[:, 0] < found.pairs[:, 1]).all()) and bool((found.pairs >= 0).all())
    assert found.probabilities.shape == (80, 3)
    torch.testing.assert_close(found.probabilities.sum(-1), torch.ones(80, dtype=F64))
    assert float((found.probabilities.argmax(-1) == found.labels).double().mean()) == 1.0
    square = torch.zeros(80, dtype=F64)
    for (a, b), row in zip(found.pairs.tolist(), found.geometries, strict=True):
        for body, F in enumerate(row):
            own = found.labels == body + 1
            assert float(F.norm()) == pytest.approx(1.0)
            square[own] += sampson_squared(F, scene.tracks[a][own], scene.tracks[b][own])
    torch.testing.assert_close(found.residuals, (square / P).sqrt(), rtol=1e-3, atol=1e-3)
    assert float(found.residuals.median()) < 0.3
    flat = int(found.labels[scene.labels == 2].mode().values) - 1
    assert float(found.planar[:, flat].double().mean()) > 0.8 and not bool(found.planar[:, 1 - flat].any())
    assert bool(((found.homographies != 0).any(-1).any(-1) == found.planar).all())
    assert "body 1: 50 tracks, stands still" in repr(found) and "outliers: 0" in repr(found)


@pytest.mark.slow
def test_declared_cameras_name_what_rests():
    scene = shot((40, 36))
    found = segmented(scene.tracks, 2)
    assert int(found.static_body) == 0 and codes(found) == [SegmentNotice.UNSURE_STATIC]
    first = int(found.labels[scene.labels == 1].mode().values)
    cameras = torch.stack([scene.cameras, scene.projections[:, 1], scene.cameras.flip(0)[:, [1, 0, 2]]])
    batch = segmented(scene.tracks.expand(3, -1, -1, -1), 2, cameras=cameras)
    assert batch.static_body.tolist() == [first, 3 - first, 0]
    assert [(one.code, one.problem) for one in batch.notices] == [(SegmentNotice.DISAGREEING, (2,))]
    assert segmented(scene.tracks, 2, cameras=scene.cameras).static_body == first


# ---- what it must not depend on ----------------------------------------------------------------------------------------
@pytest.mark.slow
def test_order_unit_origin_and_precision_of_the_tracks_do_not_matter():
    scene = shot((50, 30))
    one = segmented(scene.tracks, 2)
    order = torch.randperm(80, generator=draw(7))
    assert segmented(scene.tracks[:, order], 2).labels.tolist() == one.labels[order].tolist()
    other = segmented(0.01 * scene.tracks - 4.0, 2, threshold=0.025)
    assert other.labels.tolist() == one.labels.tolist() and other.pairs.tolist() == one.pairs.tolist()
    torch.testing.assert_close(other.residuals, 0.01 * one.residuals, rtol=0.05, atol=1e-4)
    single = segmented(scene.tracks.float(), 2)
    values = [getattr(single, field.name) for field in fields(single)]
    assert {x.dtype for x in values if isinstance(x, torch.Tensor) and x.is_floating_point()} == {torch.float32}
    assert float((one.labels == single.labels).double().mean()) > 0.95


@pytest.mark.slow
@pytest.mark.parametrize("dtype", [torch.float32, F64])
def test_the_default_dtype_decides_nothing_and_the_global_generator_draws(dtype):
    tracks = shot((45, 25), frames=6).tracks.to(dtype)
    before, found = torch.get_default_dtype(), []
    for default in (torch.float32, F64):
        torch.manual_seed(3)
        torch.set_default_dtype(default)
        try:
            found.append(segmented(tracks, 2, generator=None))
        finally:
            torch.set_default_dtype(before)
    for field in fields(found[0]):
        value, known = (getattr(one, field.name) for one in found)
        if isinstance(value, torch.Tensor):
            torch.testing.assert_close(value, known, rtol=0, atol=0, equal_nan=True, msg=field.name)


@pytest.mark.slow
def test_a_batch_is_a_loop_and_one_bad_problem_harms_no_other():
    first, second = shot((50, 30), frames=6), shot((80,), frames=6, seed=5)
    nothing = torch.full_like(first.tracks, torch.nan)
    generator = draw(2)
    both = segmented(torch.stack([first.tracks, nothing, second.tracks]), generator=generator)
    assert both.labels.shape == (3, 80) and both.bodies.tolist() == [2, 0, 1]
    assert both.status.tolist()[0] == Status.OK and both.status.tolist()[1] == Status.TOO_FEW
    generator = draw(2)
    alone = [segmented(one, generator=generator) for one in (first.tracks, nothing, second.tracks)]
    for place, one in enumerate(alone):
        P, K = len(one.pairs), int(one.bodies)
        assert both.labels[place].tolist() == one.labels.tolist()
        assert both.pairs[place, :P].tolist() == one.pairs.tolist() and bool((both.pairs[place, P:] == -1).all())
        torch.testing.assert_close(both.geometries[place, :P, :K], one.geometries)
        assert bool((both.geometries[place, P:] == 0).all()) and bool((both.geometries[place, :, K:] == 0).all())
        torch.testing.assert_close(both.probabilities[place, :, : K + 1], one.probabilities)
        torch.testing.assert_close(both.residuals[place], one.residuals)


# ---- what is refused, and what is said ---------------------------------------------------------------------------------
def empty(found) -> bool:
    parts = (found.labels, found.bodies, found.static_body, found.residuals)
    return all(bool((part == 0).all()) for part in parts) and bool((found.probabilities[:, 0] == 1).all())


def alone_in_a_frame() -> torch.Tensor:
    tracks = torch.full((6, 40, 2), torch.nan, dtype=F64)
    tracks[torch.arange(40) % 6, torch.arange(40)] = shot((40,), frames=6).tracks[0]
    return tracks


def never_together() -> torch.Tensor:
    """Each pair of frames shows five tracks."""
    tracks = torch.full((8, 20, 2), torch.nan, dtype=F64)
    for start in range(4):
        tracks[2 * start : 2 * start + 2, 5 * start : 5 * start + 5] = shot((20,)).tracks[:2, :5]
    return tracks


def cut() -> torch.Tensor:
    tracks = shot((60,)).tracks
    before, after = tracks.clone(), tracks.clone()
    before[6:], after[:6] = torch.nan, torch.nan
    return torch.cat([before, after], 1)


def jump() -> torch.Tensor:
    tracks = shot((60,)).tracks.clone()
    tracks[4:] = tracks[4:].flip(1)
    return tracks


@pytest.mark.parametrize(
    ("tracks", "notice", "status", "words"),
    [
        (alone_in_a_frame, SegmentNotice.SHORT, Status.TOO_FEW, "no track is in two frames"),
        (never_together, SegmentNotice.FEW_COMMON, Status.TOO_FEW, "more than 5 tracks in common"),
        (lambda: shot((60,), moves=0.0, sigma=0.0).tracks, SegmentNotice.STILL, Status.DEGENERATE, "nothing moves"),
        (cut, SegmentNotice.CUT, Status.DEGENERATE, "a cut at frame 6"),
        (jump, SegmentNotice.CUT, Status.DEGENERATE, "jump at frame 4"),
    ],
    ids=["short", "few common", "still", "cut", "jump"],
)
def test_what_cannot_be_segmented_is_refused(tracks, notice, status, words):
    found = segmented(tracks())
    assert codes(found) == [notice] and int(found.status) == status and empty(found)
    assert words in repr(found)
    with pytest.raises(ValueError, match=words):
        found.check()


def test_fewer_bodies_than_were_asked_for():
    scene = shot((9,), frames=5)
    found = segmented(scene.tracks, 3)
    assert int(found.bodies) < 3 and int(found.status) == Status.NO_CONSENSUS
    if int(found.bodies):
        assert SegmentNotice.FEWER_BODIES in codes(found) and "3 bodies were asked for" in repr(found)


@pytest.mark.slow
def test_a_spare_body_is_said():
    found = segmented(shot((80,), seed=2).tracks, 2)
    assert SegmentNotice.SPARE_BODY in codes(found) or int(found.bodies) < 2


GOOD = shot((8,), frames=4).tracks


@pytest.mark.parametrize(
    ("tracks", "given", "words"),
    [
        ("video.mp4", {}, "tracks must be a floating-point tensor .* got str"),
        (GOOD[0], {}, r"tracks must be .*got \(8, 2\)"),
        (GOOD[..., :1], {}, r"tracks must be .*got \(4, 8, 1\)"),
        (GOOD.long(), {}, "tracks must be a floating-point tensor.*int64"),
        (GOOD[:1], {}, "tracks hold 1 frame, and motion needs two"),
        (GOOD[:, :7], {}, "at least 8 tracks, got 7: add 1"),
        (GOOD, {"bodies": 0}, "bodies must be a positive whole number, or None.*got 0"),
        (GOOD, {"bodies": 2.0}, "bodies must be a positive whole number.*got 2.0"),
        (GOOD, {"bodies": True}, "bodies must be a positive whole number.*got True"),
        (GOOD, {"threshold": None}, "threshold.*None"),
        (GOOD, {"threshold": 0.0}, "threshold.*0.0"),
        (GOOD, {"threshold": float("nan")}, "threshold.*nan"),
        (GOOD, {"cameras": torch.zeros(3, 3, 4)}, r"cameras must be \(\*batch, 4, 3, 4\).*got \(3, 3, 4\)"),
        (GOOD, {"cameras": "K.txt"}, "cameras must be .*got str"),
        (GOOD.expand(2, -1, -1, -1), {"cameras": torch.zeros(3, 4, 3, 4)}, r"cameras must be .*got \(3, 4, 3, 4\)"),
        (GOOD, {"cameras": torch.full((4, 3, 4), torch.nan)}, "cameras hold numbers that are not finite; give"),
        (GOOD, {"generator": 7}, r"generator must be a torch.Generator or None, got 7; use torch.Generator\(\)"),
        (GOOD, {"options": dyn.SegmentOptions()}, "options must be TrackSegmentOptions, got SegmentOptions"),
        (torch.zeros(0, 5, 20, 2), {}, "holds no problem; give one at least"),
    ],
)
def test_bad_input_is_refused_with_the_value_and_a_remedy(tracks, given, words):
    with pytest.raises(ValueError, match=words):
        dyn.segment_tracks(tracks, **given)


@pytest.mark.parametrize(("count", "frames"), [(20, 5), (120, 12)])
def test_random_tracks_are_no_bodies(count, frames):
    tracks = 300 * torch.rand(frames, count, 2, generator=draw(), dtype=torch.float64)
    found = dyn.segment_tracks(tracks, generator=draw())
    assert int(found.status) == Status.NO_CONSENSUS and not found.labels.any()
    assert "by itself" in found.reason


@pytest.mark.slow
def test_options_decide():
    scene = shot((45, 25, 20), seed=2)
    assert int(segmented(scene.tracks, options=replace(QUICK, max_bodies=2)).bodies) == 2
    assert SegmentNotice.STILL in codes(segmented(scene.tracks, options=replace(QUICK, min_motion=1e3)))
    assert len(segmented(scene.tracks, 3, options=replace(QUICK, max_frame_pairs=6)).pairs) == 6

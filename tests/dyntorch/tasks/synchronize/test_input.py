"""Misuse of synchronize: every error names the field, what it got and the remedy."""

import math

import pytest
import torch

from dyntorch.tasks.synchronize.synchronize import synchronize

A, TIMES = torch.rand(20, 4, 2, generator=torch.Generator().manual_seed(0)), torch.arange(20.0)
K = [[100.0, 0, 50], [0, 100, 50], [0, 0, 1]]


@pytest.mark.parametrize(
    ("more", "words"),
    [
        ({}, r"give either fps or times, got neither"),
        ({"fps": 30.0, "times": (TIMES, TIMES)}, r"give either fps or times, got both"),
        ({"fps": (30.0, 30.0, 25.0)}, r"fps must be a pair, one of a and one of b, got 3 values"),
        ({"times": (TIMES,)}, r"times must be a pair, one of a and one of b, got 1 values"),
        ({"fps": (30.0, -1.0)}, r"fps of b must be a positive number of frames per second, got -1.0"),
        ({"times": (TIMES, TIMES[:19])}, r"times of b must be 20 finite seconds, one per frame, got \(19,\)"),
        ({"times": (TIMES.flip(0), TIMES)}, r"times of a must increase, but frame 1 is not after the one before; sort or drop"),
        ({"fps": 30.0, "max_shift": 0.0}, r"max_shift must be a positive number of seconds or None, got 0.0"),
        ({"fps": 30.0, "max_shift": math.inf}, r"max_shift must be .* got inf"),
        ({"fps": 30.0, "rate": 30.0}, r"rate must be about 1 .*, got 30.0; give fps for frame rates"),
        ({"fps": 30.0, "camera": "pinhole"}, r"camera must be one of auto, perspective, affine, projective, got 'pinhole'"),
        ({"fps": 30.0, "camera": "affine", "correspondence": False}, r"camera='affine' is for corresponding points; leave it out"),
        ({"fps": 30.0, "weights": (torch.ones(20, 4),)}, r"weights must be a pair, one of a and one of b"),
        ({"fps": 30.0, "weights": torch.ones(20, 4)}, r"weights must be a pair, one of a and one of b"),
        ({"fps": 30.0, "weights": (None, torch.ones(20, 3))}, r"weights of b must be \(20, 4\)"),
        ({"fps": 30.0, "calibration": (K, None)}, r"calibration of a: calibration of a camera must be None or \(K, dist\)"),
        ({"fps": 30.0, "calibration": ((K, None),)}, r"calibration must be a pair, of a and of b: each None or \(K, dist\)"),
        ({"fps": 30.0, "calibration": (None, ([[1.0]], None))}, r"calibration of b: calibration: K must be"),
    ],
)
def test_misuse_names_the_field_and_the_remedy(more, words):
    with pytest.raises(ValueError, match=words):
        synchronize(A, A, **more)


@pytest.mark.parametrize(
    ("a", "b", "words"),
    [
        (A.numpy(), A, r"a must be a tensor \(frames, points, 2\), got ndarray"),
        (A, A[..., :1], r"b must be a tensor \(frames, points, 2\), got \(20, 4, 1\)"),
        (A, A.long(), r"b must hold floating point numbers, got torch.int64"),
        (A[:11], A, r"a has 11 frames, 12 are needed at least"),
        (A, A[:, :3], r"a has 4 points and b 3: corresponding points are as many; give the same ones .* correspondence=False"),
    ],
)
def test_wrong_tracks_are_named(a, b, words):
    with pytest.raises(ValueError, match=words):
        synchronize(a, b, fps=30.0)


@pytest.mark.parametrize("gap", [864000.0, 1e12])
def test_takes_that_are_nearly_all_gap_are_refused(gap):
    points, clock = A.double().repeat(2, 1, 1), torch.arange(40, dtype=torch.float64) / 30
    torn = clock + gap * (torch.arange(40) > 29)
    with pytest.raises(
        ValueError, match=r"times of b run over .* it has 40 frames 0.0333 s apart, and none for .* one side of that gap"
    ):
        synchronize(points, points, times=(clock, torn))

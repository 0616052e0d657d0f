"""Batches of searches: the same as one after the other, different lengths filled up, a bad problem that spoils no other."""

from dataclasses import fields, replace

import pytest
import torch

import dyntorch as dyn
from dyntorch.core.outcome import Status, stack_results
from dyntorch.geometry.lens import Division, fit_distortion
from dyntorch.scenes.two_cameras import filmed_person, nonrigid_pair
from tests.draws import seeded

D = torch.float64


def padded(takes):
    """Takes of different lengths, frames of NaN at the end."""
    return torch.nn.utils.rnn.pad_sequence(takes, batch_first=True, padding_value=float("nan"))


def same(whole, one, place):
    """Every tensor and number of a batch's problem is that of the problem alone, what is beyond only fills."""
    for field in fields(one):
        value, part = getattr(one, field.name), getattr(whole, field.name)
        if isinstance(value, float | int) and isinstance(part, torch.Tensor):
            assert float(part[place]) == value, field.name
        elif isinstance(value, torch.Tensor):
            assert part.dtype == value.dtype, field.name
            own = part[place][tuple(slice(size) for size in value.shape)]
            torch.testing.assert_close(own, value, rtol=0, atol=0, equal_nan=True, msg=field.name)


def test_stacked_fills_up_and_keeps_what_is_the_same():
    found = stack_results(
        [(torch.ones(2), 1.5, "a", None), (torch.zeros(1, dtype=torch.float32).double(), 2.0, "a", torch.ones(1))], (2,)
    )
    assert found[0].isnan().tolist() == [[False, False], [False, True]] and found[1].tolist() == [1.5, 2.0]
    assert found[2] == "a" and found[3].isnan().tolist() == [[True], [False]]
    assert stack_results([("x",), ("y",)], (2,)) == (("x", "y"),)


@pytest.fixture(scope="module")
def takes():
    scenes = [
        filmed_person(8, seconds=seconds, offset=0.2 * k, noise=0.3, generator=seeded(k)) for k, seconds in enumerate((2.0, 2.6))
    ]
    return [one.a for one in scenes], [one.b for one in scenes]


@pytest.mark.slow
@pytest.mark.parametrize("correspondence", [True, False])
def test_synchronize_in_batches(takes, correspondence):
    a, b = takes
    gone = torch.full_like(a[0], float("nan"))
    whole = dyn.synchronize(padded([*a, gone]), padded([*b, b[0]]), correspondence, fps=30.0)
    alone = [dyn.synchronize(x, y, correspondence, fps=30.0) for x, y in zip(a, b, strict=True)]
    for place, one in enumerate(alone):
        same(whole, one, place)
        again = whole.problem(place)
        assert (again.offset, again.ok, again.reason, repr(again)[:20]) == (one.offset, one.ok, one.reason, repr(one)[:20])
    assert whole.status.tolist() == [*(int(one.status) for one in alone), int(Status.TOO_FEW)] and not bool(whole.ok[2])
    assert "batch=(3,)" in repr(whole) and {notice.problem for notice in whole.notices if notice.code == "unusable"} == {(2,)}
    moments = torch.tensor([0.0, 1.0], dtype=D)
    torch.testing.assert_close(whole.at(moments)[:2], torch.stack([one.at(moments) for one in alone]))
    torch.testing.assert_close(whole.inverse(moments)[:2], torch.stack([one.inverse(moments) for one in alone]))
    with pytest.raises(ValueError, match="problem 2 of 3"):
        replace(whole, status=whole.status * torch.tensor([0, 0, 1])).check()


def test_misuse_of_all_problems_is_raised(takes):
    a, b = takes
    with pytest.raises(ValueError, match="give either fps or times"):
        dyn.synchronize(padded(a), padded(b))
    with pytest.raises(ValueError, match="need the same \\*batch"):
        dyn.synchronize(padded(a), torch.stack([b[0]] * 3), fps=30.0)
    with pytest.raises(ValueError, match="no problem"):
        dyn.reconstruct_pair(torch.zeros(0, 20, 4, 2), torch.zeros(0, 20, 4, 2), 0.0, fps=30.0)


@pytest.mark.slow
def test_reconstruct_pair_in_batches():
    scenes = [nonrigid_pair(6, 5, frames, sigma=0.2, offset=0.1, generator=seeded(frames)) for frames in (50, 40)]
    a, b = ([getattr(one, name) for one in scenes] for name in "ab")
    short = torch.full_like(a[0], float("nan"))
    short[:3] = a[0][:3]
    shifts = torch.tensor([one.offset for one in scenes] + [0.0], dtype=D)
    whole = dyn.reconstruct_pair(padded([*a, short]), padded([*b, b[0]]), shifts, fps=scenes[0].fps)
    images = whole.images()
    for place, scene in enumerate(scenes):
        one = dyn.reconstruct_pair(scene.a, scene.b, scene.offset, fps=scene.fps)
        same(whole, one, place)
        torch.testing.assert_close(images[place][:, : len(one.times)], one.images(), equal_nan=True)
    assert whole.status.tolist()[2] == Status.TOO_FEW and "batch=(3,)" in repr(whole) and not bool(whole.labels[2].any())


@pytest.mark.slow
def test_fit_distortion_in_batches():
    views = dyn.scenes.two_view(80, generator=seeded(0)).views
    lens = Division.of(views[0], (640, 480), strength=-0.2)
    bent = [lens.distort(x) for x in views]
    a, b = (torch.stack([x, y, torch.full_like(x, float("nan"))]) for x, y in zip(bent, views, strict=True))
    whole = fit_distortion(a, b, sizes=((640, 480), (640, 480)))
    for place in range(2):
        one = fit_distortion(a[place], b[place], sizes=((640, 480), (640, 480)))
        assert (float(whole.lambda_a[place]), float(whole.lambda_b[place])) == (one.lambda_a, one.lambda_b)
        assert (float(whole.gain[place]), bool(whole.significant[place])) == (one.gain, one.significant)
        torch.testing.assert_close(whole.lenses[0].undistort(a)[place], one.lenses[0].undistort(a[place]))
    assert not bool(whole.significant[2]) and float(whole.lambda_a[2]) == 0 and float(whole.sigmas[0][2]) == float("inf")
    with pytest.raises(ValueError, match=r"matches must be \(\*batch, N, 2\)"):
        fit_distortion(a, b[:, :10])

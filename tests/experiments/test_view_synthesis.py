"""Views that nobody took: the scene of the experiment, and the warps against its own renderer."""

from __future__ import annotations

import pytest
import torch

from dyntorch.geometry.homogeneous import apply
from experiments.reconstruction import view_synthesis
from experiments.reconstruction.view_synthesis import CARS, HEIGHT, WIDTH, Scene, camera, observe, psnr, render, synthesize


@pytest.fixture(autouse=True)
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    """One ray per pixel: a blockier image, four times as fast."""
    monkeypatch.setattr(view_synthesis, "SAMPLES", 1)


def truth(cameras: torch.Tensor) -> Scene:
    outlines = torch.stack([car.corners(0.0) for car in CARS])
    return Scene(cameras, outlines, torch.tensor([car.velocity for car in CARS], dtype=torch.float64))


def test_the_renderer_puts_cars_where_they_are():
    view = camera((0.0, -20.0, 40.0))
    for time in (0.0, 2.0):
        image = render(view, time)
        assert image.shape == (3, HEIGHT, WIDTH) and image.min() >= 0 and image.max() <= 1
        side = CARS[2].place(time) + torch.tensor([0.0, 0.9])  # beside the panes
        u, v = apply(view, side[None])[0].round().long().tolist()
        assert image[:, v, u].argmax() == 2  # the blue car


def test_tracks_are_the_corners_and_vanish_below_cars():
    still = CARS[0].place(1.0)[None]
    tracks = observe(torch.stack([camera((0.0, -20.0, 40.0))] * 2), (0.0, 1.0), still, 0.0, torch.Generator().manual_seed(0))
    assert tracks.shape == (2, 4 * len(CARS) + 1, 2)
    assert tracks[0, -1].isfinite().all() and tracks[1, -1].isnan().all()
    torch.testing.assert_close(tracks[1, :4], apply(camera((0.0, -20.0, 40.0)), CARS[0].corners(1.0)))


@pytest.mark.slow
def test_a_view_that_was_taken_comes_back():
    view = camera((-5.0, -25.0, 38.0))
    found = synthesize(render(view, 1.0)[None], (1.0,), truth(view[None]), view, 1.0)
    # the ground below cars was never seen, the cars were; borders of pixels aside, nothing changes
    assert found.covered.double().mean() > 0.97 and found.moving.any()
    assert psnr(found.image, render(view, 1.0), found.covered) > 35


@pytest.mark.slow
def test_another_time_and_camera_come_near_the_truth():
    cameras = torch.stack([camera(place) for place in ((-10.0, -27.0, 36.0), (8.0, -28.0, 37.0))])
    images = torch.stack([render(view, time) for view, time in zip(cameras, (0.0, 2.0), strict=True)])
    new = camera((0.0, -30.0, 36.0))
    found, real = synthesize(images, (0.0, 2.0), truth(cameras), new, 1.0), render(new, 1.0)
    assert psnr(found.image, real, found.covered) > 20 > psnr(images[0], real, found.covered) + 5
    # the same in any affine frame of the plane
    frame = torch.tensor([[0.3, 0.1, 1.0], [-0.2, 0.4, 2.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
    back, scene = torch.linalg.inv(frame), truth(cameras)
    moved = Scene(cameras @ back, apply(frame, scene.outlines), scene.velocities @ frame[:2, :2].mT)
    again = synthesize(images, (0.0, 2.0), moved, new @ back, 1.0)
    assert (again.image - found.image).abs().mean() < 1e-3

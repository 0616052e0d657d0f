"""A person before two cameras: the scene obeys its own equations, and its faults are those asked for."""

import pytest
import torch

from dyntorch.geometry.homogeneous import homogeneous, inhomogeneous
from dyntorch.geometry.lens import Division
from dyntorch.scenes import filmed_person


def make(seed=0, **more):
    return filmed_person(**{"generator": torch.Generator().manual_seed(seed)} | more)


def test_the_pictures_are_those_of_the_cameras():
    scene, still = make(offset=0.4), make()
    assert torch.allclose(scene.exact[0], inhomogeneous(homogeneous(scene.points) @ scene.cameras[0].mT))
    assert torch.equal(scene.a, scene.exact[0]) and torch.equal(scene.b, scene.exact[1])
    # b at a's moments
    value = ((homogeneous(still.exact[1]) @ scene.fundamental) * homogeneous(scene.exact[0])).sum(-1)
    assert float(value.abs().max()) < 1e-9 and float(scene.fundamental.norm()) == pytest.approx(1)
    assert bool(((scene.a > 0) & (scene.a < torch.tensor([1280.0, 960.0]))).all())
    assert torch.equal(make(3, noise=1.0).b, make(3, noise=1.0).b) and not torch.equal(make(3).points, make(4).points)


def test_clocks_run_as_told():
    still = make(seconds=4.0)
    moved = make(seconds=4.0, offset=0.5)
    assert torch.allclose(moved.b[15:], still.b[:-15], atol=1e-9)  # 15 frames later
    fast = make(seconds=8.0, rate=2.0)
    assert torch.allclose(fast.b[::2], still.b, atol=1e-9)
    fine = make(seconds=4.0, fps=(30.0, 60.0))
    assert torch.allclose(fine.b[::2], still.b, atol=1e-9) and len(fine.a) == 120
    times = torch.tensor([0.0, 0.1, 0.5]), torch.tensor([1.0, 1.2])
    given = make(times=tuple(t.double() for t in times), offset=1.0)
    assert given.a.shape == (3, 15, 2) and given.b.shape == (2, 15, 2)
    assert torch.allclose(given.b[0], still.b[0], atol=1e-9)


def test_faults_are_those_asked_for():
    scene = make(n=17, seconds=20.0, noise=2.0, missing=0.2, outliers=0.1, wrong=3)
    gone = scene.a.isnan().any(-1)
    assert float(gone.double().mean()) == pytest.approx(0.2, abs=0.05)
    far = scene.outliers[0]
    assert float(far[~gone].double().mean()) == pytest.approx(0.1, abs=0.02)
    good = ~gone & ~far
    away = scene.a - scene.exact[0]
    assert float(away[good].std()) == pytest.approx(2.0, rel=0.05) and float(away[far].std()) > 100
    assert int(scene.wrong.sum()) == 3
    off = (scene.b - scene.exact[1]).norm(dim=-1).nanmedian(0).values
    assert bool((off[scene.wrong] > 10).all()) and bool((off[~scene.wrong] < 5).all())
    whole = make(missing=0.2, noise=1.0).a.isnan().any(-1)
    assert int(whole.diff(dim=0).sum()) < 0.35 * int(whole.sum())  # in blocks


def test_lenses_bend_and_motion_repeats_only_where_asked_to():
    scene = make(lens=-0.3, walk=1.2)
    lens = Division.of(scene.a, (1280.0, 960.0), -0.3)
    assert float((scene.a - scene.exact[0]).abs().max()) > 5
    assert torch.allclose(lens.undistort(scene.a), scene.exact[0], atol=1e-6)
    scene = make(period=1.0, walk=0.0)
    assert torch.allclose(scene.points[30:], scene.points[:-30], atol=1e-9)
    for free in (make(walk=0.0), make(period=1.0)):
        assert float((free.points[30:] - free.points[:-30]).norm(dim=-1).mean()) > 0.03
    assert float(make(walk=2.0).points.mean(1).std(0).max()) > float(make(walk=0.0).points.mean(1).std(0).max())

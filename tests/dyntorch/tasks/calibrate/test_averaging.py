"""First cameras from exact pairs and rays: exact, with cameras in a line and with a pair that is wrong."""

from itertools import combinations

import pytest
import torch

from dyntorch.geometry.epipolar import sampson_squared
from dyntorch.tasks.calibrate import averaging
from dyntorch.tasks.calibrate.averaging import PairGeometry, average_rotations, nearest_points, position_cameras, relative_rotations
from tests.draws import seeded
from tests.dyntorch.tasks.calibrate.rigs import exponential, shape_error

F64 = torch.float64


def turns(c, seed=0):
    g = seeded(seed)
    return torch.stack([exponential(torch.randn(3, generator=g, dtype=F64)) for _ in range(c)])


def rig(c=4, m=60, line=False, seed=0):
    """Rotations, centres, points and rays in the cameras' frames, all points before all cameras."""
    g = seeded(seed)
    R = torch.stack([exponential(0.2 * torch.randn(3, generator=g, dtype=F64)) for _ in range(c)])
    centers = torch.randn(c, 3, generator=g, dtype=F64)
    if line:
        centers = torch.linspace(-1, 1, c, dtype=F64)[:, None] * torch.tensor([2.0, 0.3, 0.1], dtype=F64)
    points = torch.randn(m, 3, generator=g, dtype=F64) + torch.tensor([0.0, 0.0, 7.0], dtype=F64)
    rays = (points - centers[:, None]) @ R.mT
    return R, centers, points, rays / rays[..., 2:]


def pair_of(R, centers, rays, i, j, focals, unit=1920.0):
    """The geometry of two cameras, from E = [b]x R."""
    turn, base = R[j] @ R[i].mT, R[j] @ (centers[i] - centers[j])
    x, y, z = base.tolist()
    E = torch.tensor([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]], dtype=F64) @ turn
    f1, f2 = focals[i] / unit, focals[j] / unit
    F = torch.diag(torch.tensor([1 / f2, 1 / f2, 1.0], dtype=F64)) @ E @ torch.diag(torch.tensor([1 / f1, 1 / f1, 1.0], dtype=F64))
    x1, x2 = f1 * rays[i, :, :2], f2 * rays[j, :, :2]
    return PairGeometry(F / F.norm(), x1, x2, torch.ones(len(x1), dtype=F64), unit, 1.0, len(x1)), turn


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_relative_rotations_have_the_true_one(sign):
    R, centers, _, rays = rig(seed=1)
    focals = [1500.0, 1100.0, 1800.0, 1300.0]
    tried = torch.tensor([focals, [900.0] * 4], dtype=F64)
    for i, j in combinations(range(4), 2):
        pair, truth = pair_of(R, centers, rays, i, j, focals)
        pair = PairGeometry(sign * pair.F, pair.x1, pair.x2, pair.weights, pair.unit, 1.0, pair.matches)
        (found, other), (share, _) = relative_rotations(pair, tried[:, i], tried[:, j])
        torch.testing.assert_close(other, relative_rotations(pair, tried[1:, i], tried[1:, j])[0][0])
        best = int(share.argmax())
        assert torch.allclose(found[best], truth, atol=1e-9)
        assert torch.allclose(torch.linalg.det(found), torch.ones(2, dtype=F64)) and float(share[best]) == 1.0
        assert float(sampson_squared(pair.F, pair.x1, pair.x2).sqrt().max()) < 1e-9


@pytest.mark.parametrize("seed", range(4))
def test_averaged_rotations_are_exact(seed):
    R = turns(5, seed)
    ratios = {(i, j): R[j] @ R[i].mT for i, j in combinations(range(5), 2)}
    found = average_rotations(ratios, dict.fromkeys(ratios, 7.0), 5)
    assert torch.allclose(found, R @ R[0].mT, atol=1e-9)
    # a chain is enough
    chain = {pair: turn for pair, turn in ratios.items() if pair[1] == pair[0] + 1}
    assert torch.allclose(average_rotations(chain, dict.fromkeys(chain, 2.0), 5), R @ R[0].mT, atol=1e-9)


def test_a_wrong_pair_drops_out(monkeypatch):
    R = turns(5, 9)
    ratios = {(i, j): R[j] @ R[i].mT for i, j in combinations(range(5), 2)}
    ratios[1, 3] = exponential(torch.tensor([0.0, 1.5, 0.6])) @ ratios[1, 3]
    truth = R @ R[0].mT
    errors = []
    for iterations in (20, 1):
        monkeypatch.setattr(averaging, "AVERAGING_ITERATIONS", iterations)
        found = average_rotations(ratios, dict.fromkeys(ratios, 1.0), 5)
        errors.append(float((found - truth).norm(dim=(1, 2)).max()))
    assert errors[0] < 0.01 and errors[0] < 0.05 * errors[1]


@pytest.mark.parametrize("line", [False, True])
def test_positions_from_rays_are_exact(line):
    R, centers, points, rays = rig(line=line, seed=2)
    weights = (torch.rand(4, 60, generator=seeded(3), dtype=F64) > 0.2).double()
    weights[:, :10] = 1.0
    found, met = position_cameras(R, rays, weights)
    both = weights.sum(0) >= 2
    # rotations are known: only shift and scale are free, and the scale is positive
    scale = (centers - centers.mean(0)).norm() / (found - found.mean(0)).norm()
    assert torch.allclose(scale * (found - found.mean(0)), centers - centers.mean(0), atol=1e-7)
    assert torch.allclose(scale * (met - found[0])[both], (points - centers[0])[both], atol=1e-6)
    assert shape_error(found, centers) < 1e-7
    assert torch.allclose(nearest_points(R, centers, rays, weights)[both], points[both], atol=1e-9)

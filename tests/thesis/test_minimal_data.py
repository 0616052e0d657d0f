"""Exact matches at the stated counts are solved, whatever digits their squares lose; those that decide nothing are refused.

Scenes from the thesis's definitions (1.3, chapters 3 and 6), in pixels, by torch alone.
"""

import pytest
import torch
from torch import Tensor

import dyntorch as dyn
from tests.battery.epipolar import lift
from tests.draws import seeded

F64 = torch.float64
LOST = 1e-7
"""Singular value, of the largest, whose square is rounding of a Gram in float64."""


def seen(cameras: Tensor, points: Tensor) -> Tensor:
    """Images ``(..., n, 2)`` of homogeneous points ``(..., n, k + 1)``."""
    image = points @ cameras.mT
    return image[..., :2] / image[..., 2:]


def cameras(*count: int, generator: torch.Generator, angle: float = 0.5, distance: float = 5.0) -> Tensor:
    """Calibrated cameras ``(*count, 3, 4)`` that look at the origin, turned by up to ``angle`` rad about each axis."""
    turn = torch.zeros(*count, 3, 3, dtype=F64)
    angles = angle * (2 * torch.rand(*count, 3, generator=generator, dtype=F64) - 1)
    turn[..., 1, 2], turn[..., 0, 2], turn[..., 0, 1] = angles.unbind(-1)
    rotation = torch.linalg.matrix_exp(turn - turn.mT)
    centre = torch.randn(*count, 3, 1, generator=generator, dtype=F64) * torch.tensor([[1.0], [1.0], [0.5]], dtype=F64)
    ahead = torch.tensor([[0.0], [0.0], [distance]], dtype=F64)
    lens = torch.tensor([[1000.0, 0, 500], [0, 1000, 400], [0, 0, 1]], dtype=F64)
    return lens @ torch.cat([rotation, ahead - rotation @ centre], -1)


# ---- six views of straight trajectories (1.3): one vanishing determinant, 728 matches ---------------------------------
SIX = dyn.GrassmannTensor(5, (1,) * 6, dual=True)


def paths(cameras: Tensor, n: int, seed: int) -> tuple[Tensor, ...]:
    """Each point anywhere on a line of its own in every view."""
    g = seeded(seed)
    start, way = torch.randn(n, 3, generator=g, dtype=F64), torch.randn(n, 3, generator=g, dtype=F64)
    where = 2 * torch.rand(6, n, 1, generator=g, dtype=F64) - 1
    return tuple(seen(cameras, lift(start + where * way)).unbind(0))


@pytest.mark.slow
def test_six_views_at_their_728_matches():
    rig = cameras(6, generator=seeded(3), angle=0.25, distance=6.0)
    given = paths(rig, 728, 4)
    found = dyn.fit(SIX, *given)
    assert found.status == dyn.Status.OK
    assert found.singular_values[-2] < LOST * found.singular_values[0]  # so it has to be found in the rows
    fresh, apart = paths(rig, 60, 5), tuple(x.roll(v, 0) for v, x in enumerate(paths(rig, 60, 5)))
    of_paths, of_none = (dyn.core.algebraic(SIX, found.tensor, *x).abs().median() for x in (fresh, apart))
    assert of_paths < 1e-5 * of_none
    with pytest.raises(ValueError, match="at least 728 matches"):
        dyn.fit(SIX, *(x[1:] for x in given))
    rig[1:3] = rig[0]  # three of one centre: any line through their rays' planes
    found = dyn.fit(SIX, *paths(rig, 728, 4))
    assert found.status == dyn.Status.DEGENERATE and found.tensor.abs().max() == 0


# ---- two bodies: the segmentation matrix (chapter 6), 35 matches, at least 8 of each ----------------------------------
def bodies(counts: tuple[int, int], batch: int, seed: int, *, flat: bool = False) -> tuple[Tensor, Tensor]:
    """Two views ``(batch, n, 2)`` of two rigid bodies, the first one perhaps a plane; those of body 1 come first."""
    g = seeded(seed)
    first, views = cameras(batch, generator=g, angle=0.3), []
    for n, plane in zip(counts, (flat, False), strict=True):
        x = 3 * torch.rand(batch, n, 3, generator=g, dtype=F64) - 1.5
        if plane:
            x[..., 2] = 0.3 * x[..., 0] - 0.2 * x[..., 1] + 0.1
        second = cameras(batch, generator=g, angle=0.3)
        views.append((seen(first, lift(x)), seen(second, lift(x))))
    return torch.cat([views[0][0], views[1][0]], 1), torch.cat([views[0][1], views[1][1]], 1)


def test_two_bodies_of_35_matches():
    x1, x2 = bodies((27, 8), 300, 0)
    found = dyn.fit(dyn.SegmentationMatrix, x1, x2)
    assert (found.status == dyn.Status.OK).all()
    assert (found.singular_values[:, -2] < LOST * found.singular_values[:, 0]).sum() >= 3
    labels = dyn.SegmentationMatrix.labels(*dyn.SegmentationMatrix.fundamentals(found.tensor), x1, x2)
    first = labels[:, :1]
    assert (labels[:, :27] == first).all() and (labels[:, 27:] != first).all()
    alone = [dyn.fit(dyn.SegmentationMatrix, a, b).status for a, b in zip(x1[:8], x2[:8], strict=True)]
    assert torch.stack(alone).tolist() == found.status[:8].tolist()
    with pytest.raises(ValueError, match="at least 35 matches"):
        dyn.fit(dyn.SegmentationMatrix, x1[:, 1:], x2[:, 1:])


@pytest.mark.parametrize("away", [0.0, 1e4, 1e7])
@pytest.mark.parametrize(
    ("counts", "flat"), [((28, 7), False), ((20, 15), True), ((30, 30), True), ((60, 0), False)], ids=["7", "35", "60", "one"]
)
def test_bodies_that_leave_more_open(counts, flat, away):
    """Seven matches of one body, a planar body, a single body: wherever the origin of the picture is."""
    views = [x + away for x in bodies(counts, 20, 1, flat=flat)]
    found = dyn.fit(dyn.SegmentationMatrix, *views)
    assert (found.status == dyn.Status.DEGENERATE).all() and found.tensor.abs().max() == 0


def test_matches_of_few_digits_are_not_looked_at_more_closely():
    """What float32 rounds away no row can say; a planar body does not come back as two."""
    x1, x2 = (x.float() for x in bodies((20, 15), 20, 1, flat=True))
    assert not (dyn.fit(dyn.SegmentationMatrix, x1, x2).status == dyn.Status.OK).any()


# ---- planar constant velocity (chapter 3): P^4 -> P^2, four views, ten points -----------------------------------------
@pytest.mark.slow
def test_ten_points_at_constant_velocity_in_four_views():
    family, g = dyn.GrassmannTensor(4, (2, 1, 1, 1)), seeded(1)
    at = torch.stack([torch.cat([torch.eye(3), t * torch.eye(3)[:, :2]], 1) for t in range(4)]).double()
    rig = cameras(200, 4, generator=g)[..., [0, 1, 3]] @ at
    structure = torch.cat([4 * torch.rand(200, 30, 2, generator=g, dtype=F64) - 2, torch.ones(200, 30, 1, dtype=F64)], -1)
    structure = torch.cat([structure, 0.4 * torch.randn(200, 30, 2, generator=g, dtype=F64)], -1)
    views = [seen(rig[:, v], structure) for v in range(4)]
    found = dyn.fit(family, *(x[:, :10] for x in views))
    assert (found.status == dyn.Status.OK).all()
    assert (found.singular_values[:, -2] < LOST * found.singular_values[:, 0]).any()
    fresh = [x[:, 10:] for x in views]
    assert (dyn.sampson(family, found.tensor, *fresh).median(-1).values < 1e-3).all()  # px
    assert (dyn.sampson(family, found.tensor, *(x.roll(v, 1) for v, x in enumerate(fresh))).median(-1).values > 1).all()
    with pytest.raises(ValueError, match="at least 10 matches"):
        dyn.fit(family, *(x[:, :9] for x in views))
    still = [seen(rig[:, :1], structure[:, None])[:, 0, :10]] * 4  # one camera that stands still
    assert (dyn.fit(family, *still).status == dyn.Status.DEGENERATE).all()


# ---- derivatives where a Gram holds none of the digits ----------------------------------------------------------------
def test_derivatives_of_hard_matches_are_those_of_finite_differences():
    x1, x2 = bodies((27, 8), 300, 0)
    s = dyn.fit(dyn.SegmentationMatrix, x1, x2).singular_values
    hard = int(((s[:, -2] / s[:, 0]).log10() + 7.3).abs().argmin())
    x1, x2, g = x1[hard], x2[hard], seeded(9)
    weight, turn = (torch.randn(size, generator=g, dtype=F64) for size in ((6, 6), x1.shape))

    def value(step: Tensor) -> Tensor:
        tensor = dyn.fit(dyn.SegmentationMatrix, x1 + step * turn, x2 - step * turn.flip(0)).tensor
        return (weight * tensor).sum().square()

    zero = torch.zeros((), dtype=F64, requires_grad=True)
    (slope,) = torch.autograd.grad(value(zero), zero)
    step = torch.tensor(1e-7, dtype=F64)
    differences = (value(step) - value(-step)) / (2 * step)
    assert abs(slope - differences) < 1e-3 * abs(differences)

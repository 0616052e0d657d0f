"""The least squares problem of a body before fixed cameras: derivatives and descent, against finite differences and the truth."""

import pytest
import torch

from dyntorch.geometry.rigid import BodyProblem, FilmedBody, fit_body, rotation_exponential
from dyntorch.numerics.least_squares import LeastSquaresOptions

D = torch.float64
FRAMES, N = 12, 9
CAMERA = torch.tensor([0] * 5 + [1] * 4)


def normal(seed, *shape):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=D)


def body():
    inner = torch.tensor([[1.5, 0.1, 0.2], [0.0, 1.4, 0.1], [0.0, 0.0, 1.0]], dtype=D).expand(1, 2, 3, 3)
    sights = torch.eye(3, 4, dtype=D).repeat(1, 2, 1, 1)
    sights[0, 1, :, :3], sights[0, 1, :, 3] = rotation_exponential(normal(0, 3)), torch.tensor([0.3, -0.2, 3.0])
    motions = torch.cat([rotation_exponential(0.5 * normal(1, FRAMES, 3)), 0.2 * normal(2, FRAMES, 3, 1)], -1)[None]
    motions[..., 2, 3] += 4
    return FilmedBody(inner.clone(), sights, motions, 0.4 * normal(3, 1, N, 3))


def problem(at, noise=0.0):
    return BodyProblem(at.images(CAMERA)[0] + noise * normal(4, 1, FRAMES, N, 2), 0.5 + normal(5, 1, FRAMES, N).abs(), CAMERA)


@pytest.mark.slow
def test_derivatives_are_those_of_finite_differences():
    at = body()
    given = problem(at, 0.1)
    error, common, own = given._linear(at)
    near = 1e-6
    still = torch.zeros(1, common.shape[-1], dtype=D), torch.zeros(1, FRAMES, 6, dtype=D)
    for part, slope in ((0, common), (1, own)):
        for k in range(slope.shape[-1]):
            step = [x.clone() for x in still]
            step[part][..., k] = -near
            moved = given._linear(FilmedBody(*given.retract(tuple(at), tuple(step))))[0]
            torch.testing.assert_close((moved - error) / near, slope[..., k], atol=1e-4, rtol=1e-4)


def test_descends_to_the_truth_and_each_problem_as_alone():
    at = body()
    given = problem(at)
    start = at._replace(
        points=at.points + 0.02 * normal(6, 1, N, 3), calibrations=at.calibrations * torch.tensor([1.1, 1.1, 1.0])[:, None]
    )
    options = LeastSquaresOptions(iterations=60, tolerance=1e-9)
    assert float(fit_body(given, start, options)[1]) < 1e-16
    twice = BodyProblem(given.x.expand(2, -1, -1, -1), given.weights.expand(2, -1, -1), CAMERA)
    behind = start._replace(motions=start.motions * torch.tensor([1.0, 1.0, 1.0, -1.0]))
    both, cost = fit_body(twice, FilmedBody(*(torch.cat(parts) for parts in zip(start, behind, strict=True))), options)
    # points behind a camera are no start
    assert float(cost[0]) < 1e-16 and cost[1].isinf() and bool(both.points.isfinite().all())

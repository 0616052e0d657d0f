"""Normal equations against automatic derivatives of a residual that is written here, elimination against dense algebra."""

import dataclasses
import math

import pytest
import torch

from dyntorch.tasks.calibrate.adjustment import PARAMETERS, Priors, RigAdjustment, RigState, camera_covariance, gauge, images
from dyntorch.tasks.calibrate.input import Sightings
from tests.draws import seeded
from tests.dyntorch.tasks.calibrate.rigs import exponential, pictures

F64 = torch.float64
CENTERS = torch.tensor([[960.0, 540.0], [640.0, 360.0], [900.0, 500.0]], dtype=F64)
C, T, N = 3, 4, 3
COUNT = C * PARAMETERS


class Lines:
    """Tracks that are straight: what is seen at any time is known exactly."""

    centers = CENTERS
    times = torch.linspace(-1.5, 1.5, T, dtype=F64)

    def __init__(self, generator):
        self.start = CENTERS[:, None, None] + 200 * torch.randn(C, 1, N, 2, generator=generator, dtype=F64)
        self.slope = 30 * torch.randn(C, 1, N, 2, generator=generator, dtype=F64)
        self.known = (torch.rand(C, T, N, generator=generator, dtype=F64) > 0.15).double()
        self.known[:2] = 1.0

    def at(self, clocks):
        own = clocks[..., 1:].exp() * self.times + clocks[..., :1]
        x = self.start + self.slope * own[..., None, None]
        return Sightings(x, self.slope.expand_as(x), self.known.expand(x.shape[:-1]))


def world(seed=0):
    """A problem away from its minimum, and where it is."""
    g = seeded(seed)

    def draw(*size):
        return torch.randn(*size, generator=g, dtype=F64)

    R = torch.stack([exponential(0.3 * draw(3)) for _ in range(C)])
    t = torch.tensor([0.0, 0.0, 5.0], dtype=F64) + 0.3 * draw(1, C, 3)
    lens = torch.tensor([math.log(1400.0), -0.1, 0.02], dtype=F64) + torch.tensor([0.1, 0.05, 0.01], dtype=F64) * draw(1, C, 3)
    state = RigState(R[None], t, lens, 0.1 * draw(1, C, 2), draw(1, T, N, 3))
    scale = torch.tensor([0.7, 0.015, 0.05, math.inf, 1e-2], dtype=F64).repeat(C, 1)
    mean = torch.tensor([7.2, 0.0, 0.0, 0.05, 0.0], dtype=F64).repeat(C, 1)
    weights = torch.rand(1, C, T, N, generator=g, dtype=F64) + 0.2
    basis = torch.eye(COUNT, dtype=F64)[:, 6:]  # the first camera's pose is held
    sigma = torch.tensor([[40.0, 55.0, 70.0]], dtype=F64)
    return RigAdjustment(Lines(g), weights, sigma, 4.0, Priors(mean, scale), basis), state


def moved(state, change):
    """The state after a change ``(33 + 36,)``: cameras turn about their own centres, all else is added."""
    cameras = change[:COUNT].view(C, PARAMETERS)
    points = change[COUNT:].view(T, N, 3)
    zero = torch.zeros(C, dtype=F64)
    x, y, z = cameras[:, :3].unbind(-1)
    cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1).view(C, 3, 3)
    turn = torch.linalg.matrix_exp(cross)
    return RigState(
        (turn @ state.R[0])[None],
        ((turn @ state.t[0, ..., None])[..., 0] + cameras[:, 3:6])[None],
        state.lens + cameras[:, 6:9],
        state.clocks + cameras[:, 9:],
        state.points + points,
    )


def residuals(problem, state):
    """All the errors ``(c, T, n, 2)`` px, written out."""
    lines, errors = problem.views, []
    for i in range(C):
        own = state.clocks[0, i, 1].exp() * lines.times + state.clocks[0, i, 0]
        track = lines.start[i] + lines.slope[i] * own[:, None, None]
        lens = state.lens[0, i]
        seen = pictures(state.points[0], state.R[0, i], state.t[0, i], lens[0].exp(), lens[1], lens[2], CENTERS[i].tolist())
        errors.append(seen - track)
    return torch.stack(errors)


def cost(problem, state):
    """Twice the negative logarithm of the likelihood, as the head of the file says."""
    errors = residuals(problem, state)
    nu = problem.freedom
    share = errors.square().sum(-1) / (nu * problem.sigma[0, :, None, None] ** 2)
    total = (problem.weights[0] * problem.views.known * (nu + 2) * (1 + share).log()).sum()
    away = (torch.cat([state.lens[0], state.clocks[0]], -1) - problem.priors.mean) / problem.priors.scale
    return total + away[:, [0, 2, 3, 4]].square().sum() + 2 * (1 + away[:, 1].square()).log().sum()


def dense(problem, normal):
    """Matrix and gradient of all unknowns together, points first, from the blocks."""
    points = torch.block_diag(*normal.matrix[0].movedim(-1, 0))
    mixed = points.new_zeros(len(points), COUNT)
    mixed[:, normal.place] = normal.mixed[0].movedim(-1, 0).reshape(len(points), -1)
    slope = normal.slope[0].mT.flatten()
    matrix = torch.cat([torch.cat([points, mixed], 1), torch.cat([mixed.mT, normal.others[0]], 1)])
    return matrix, torch.cat([slope, normal.gradient[0]])


def ordered():
    """Places of points and cameras in a change, in the order of :func:`dense`."""
    return torch.cat([torch.arange(COUNT, COUNT + T * N * 3), torch.arange(COUNT)])


def test_the_cost_is_the_formula_and_the_gradient_half_of_its():
    problem, state = world()
    assert float(problem.evaluate(tuple(state)).cost) == pytest.approx(float(cost(problem, state)), rel=1e-12)
    order = ordered()
    zero = torch.zeros(len(order), dtype=F64, requires_grad=True)
    (truth,) = torch.autograd.grad(cost(problem, moved(state, zero)), zero)
    _, found = dense(problem, problem.linear(state))
    scale = truth.abs().max()
    assert torch.allclose(found / scale, truth[order] / 2 / scale, rtol=1e-9, atol=1e-12)


@pytest.mark.slow
def test_the_matrix_is_that_of_gauss_and_newton():
    problem, state = world(seed=1)
    order = ordered()
    zero = torch.zeros(len(order), dtype=F64)

    def rows(change):
        return residuals(problem, moved(state, change)).flatten()

    jacobian = torch.autograd.functional.jacobian(rows, zero, vectorize=True)[:, order]
    errors = residuals(problem, state)
    nu, spread = problem.freedom, problem.sigma[0, :, None, None] ** 2
    weight = problem.weights[0] * problem.views.known * (nu + 2) / (nu * spread + errors.square().sum(-1))
    weight = weight[..., None].expand(C, T, N, 2).flatten()
    truth = jacobian.mT @ (weight[:, None] * jacobian)
    away = torch.cat([state.lens[0], state.clocks[0]], -1) - problem.priors.mean
    prior = problem.priors.scale**-2
    prior[:, 1] = 2 / (problem.priors.scale[:, 1] ** 2 + away[:, 1] ** 2)
    place = T * N * 3 + (torch.arange(C)[:, None] * PARAMETERS + torch.arange(6, 11)).flatten()
    truth[place, place] += prior.flatten()
    found, _ = dense(problem, problem.linear(state))
    root = truth.diagonal().rsqrt()
    assert torch.allclose(root[:, None] * found * root, root[:, None] * truth * root, rtol=0, atol=1e-10)


@pytest.mark.parametrize("damping", [1e-3, 0.3])
def test_a_step_solves_the_damped_equations_of_all_unknowns(damping):
    problem, state = world(seed=2)
    normal = problem.linear(state)
    matrix, gradient = dense(problem, normal)
    count = T * N * 3
    basis = torch.block_diag(torch.eye(count, dtype=F64), problem.basis)
    inside, slope = basis.mT @ matrix @ basis, basis.mT @ gradient
    # points are damped by their own diagonal, cameras by that which is left once they are eliminated
    free = inside.clone()
    free[:count, :count].diagonal().mul_(1 + damping)
    left = free[count:, count:] - free[count:, :count] @ torch.linalg.solve(free[:count, :count], free[:count, count:])
    floor = 1e-9 * left.diagonal().max()  # damped_step lifts all by a billionth of the largest
    free[count:, count:].diagonal().add_(damping * (left.diagonal() + floor))
    truth = basis @ torch.linalg.solve(free, slope)
    cameras, points = problem.step(problem.evaluate(tuple(state)), torch.tensor([damping], dtype=F64))
    found = torch.cat([points.flatten(), cameras.flatten()])
    assert float((found - truth).norm() / truth.norm()) < 1e-7
    assert float(cameras[0, 0, :6].abs().max()) == 0.0
    new = RigState(*problem.retract(tuple(state), (cameras, points)))
    change = torch.cat([-cameras.flatten(), -points.flatten()])
    for one, other in zip(new, moved(state, change), strict=True):
        assert torch.allclose(one, other, atol=1e-9)


def test_descents_lower_the_cost_and_subsets_are_their_own():
    problem, state = world(seed=3)
    at = problem.evaluate(tuple(state))
    step = problem.step(at, torch.tensor([1e3], dtype=F64))
    assert float(problem.evaluate(problem.retract(tuple(state), step)).cost) < float(at.cost)
    two = RigState(*(torch.cat([part, part]) for part in state))
    both = dataclasses.replace(
        problem, weights=problem.weights.repeat(2, 1, 1, 1), sigma=torch.cat([problem.sigma, 2 * problem.sigma])
    )  # fmt: skip
    keep = torch.tensor([0])
    assert float(both.subset(keep).evaluate(tuple(two.of(keep))).cost) == pytest.approx(float(at.cost), rel=1e-12)
    problem.weights[:, :, 1, 2] = 0.0  # points that nobody sees stay
    _, points = problem.step(problem.evaluate(tuple(state)), torch.tensor([1e-3], dtype=F64))
    assert float(points[0, 1, 2].abs().max()) == 0.0 and bool(points.isfinite().all())


def test_changes_of_the_world_leave_every_image():
    _, state = world(seed=5)
    unseen = gauge(state.R[0], state.t[0])
    assert int(torch.linalg.matrix_rank(unseen)) == 7
    x = state.points[0]
    h = 1e-5
    for k in range(7):
        # what the world's change does to points: turn, shift, or scale
        axis = torch.eye(3, dtype=F64)[k % 3]
        by_points = torch.linalg.cross(axis.expand_as(x), x) if k < 3 else (axis.expand_as(x) if k < 6 else x)
        change = torch.cat([unseen[:, k], by_points.flatten()])
        ahead, back = (images(moved(state, sign * h * change), CENTERS) for sign in (1, -1))
        still = torch.cat([torch.zeros(COUNT, dtype=F64), by_points.flatten()])
        alone = images(moved(state, h * still), CENTERS) - images(moved(state, -h * still), CENTERS)
        assert float((ahead - back).abs().max()) < 1e-6 * float(alone.abs().max())


def test_covariances_are_those_of_the_whole_information_without_the_world():
    problem, state = world(seed=6)
    normal = problem.linear(state)
    _, reduced, _ = normal.eliminate_points(torch.zeros(1, dtype=F64))
    unseen = gauge(state.R[0], state.t[0])
    found = camera_covariance(reduced[0], torch.eye(COUNT, dtype=F64), unseen)
    # independent: all unknowns, with changes of the cameras' world forbidden by Lagrange's multipliers
    matrix, _ = dense(problem, normal)
    total, count = len(matrix), T * N * 3
    scale = matrix.diagonal().rsqrt()
    held = torch.zeros(total, 7, dtype=F64)
    held[count : count + COUNT] = unseen
    held = scale[:, None] * held
    held = held / held.norm(dim=0)
    bordered = torch.cat(
        [torch.cat([scale[:, None] * matrix * scale, held], 1), torch.cat([held.mT, torch.zeros(7, 7, dtype=F64)], 1)]
    )
    inverse = torch.linalg.inv(bordered)[:total, :total] * scale[:, None] * scale
    truth = inverse[count : count + COUNT, count : count + COUNT]
    root = truth.diagonal().clamp(min=1e-300).rsqrt()
    assert torch.allclose(root[:, None] * found * root, root[:, None] * truth * root, rtol=0, atol=1e-5)
    assert float((found @ unseen).norm() / found.norm() / unseen.norm()) < 1e-9

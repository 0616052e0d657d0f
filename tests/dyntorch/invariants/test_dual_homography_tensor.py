"""Dual homography tensor: lines and static points, ranks, quadrifocal contraction, maps of lines, distances, degenerate input."""

import pytest
import torch

from dyntorch.core.residual import whiten
from dyntorch.geometry.homogeneous import apply, homogeneous, unit
from dyntorch.invariants.dual_homography_tensor import DualHomographyTensor, quadrifocal
from tests.draws import random
from tests.grid import assert_refused

LINES = DualHomographyTensor("lines")
ONES = (torch.ones(()).double(),) * 3


def near_identity(*batch, seed=0):
    return [unit(torch.eye(3).double() + 0.2 * random(*batch, 3, 3, seed=seed + s)) for s in (0, 1)]


def raw(line):
    return line / line[..., :2].norm(dim=-1, keepdim=True)


def concurrent(motion, n, seed=0):
    """Lines of three views through static points of order 1, and those points in every view."""
    first = random(n, 2, seed=seed)
    points = [first, *(apply(torch.linalg.inv(m), first) for m in motion)]
    views = [raw(torch.linalg.cross(homogeneous(x), random(n, 3, seed=seed + 1 + v))) for v, x in enumerate(points)]
    return views, points


def static_lines(motion, n, seed=0):
    first = random(n, 3, seed=seed)
    return [raw(first), *(raw(first @ m) for m in motion)]  # l = A^T l1


def test_quadrifocal_contracted_with_a_line_is_the_tensor_of_its_plane():
    cameras, line = random(4, 6, 3, 4), random(6, 3, seed=1)
    tensor = DualHomographyTensor.from_quadrifocal(quadrifocal(*cameras), line)
    planes = (line[:, None] @ cameras[3])[:, 0]
    basis = torch.linalg.svd(planes[:, None]).Vh[:, 1:].mT
    to_view = [P @ basis for P in cameras[:3]]
    motion = [to_view[0] @ torch.linalg.inv(g) for g in to_view[1:]]
    direct = DualHomographyTensor.compose(*motion)
    alignment = (tensor * direct).flatten(1).sum(1).abs()
    torch.testing.assert_close(alignment, torch.ones(6).double(), rtol=0, atol=1e-12)


def test_quadrifocal_of_lines_through_one_point():
    cameras, point = random(4, 3, 4), random(4, seed=1)
    lines = [torch.linalg.cross(P @ point, random(3, seed=2 + v)) for v, P in enumerate(cameras)]
    value = torch.einsum("ijkl,i,j,k,l->", quadrifocal(*cameras), *lines)
    minors = torch.stack(
        [torch.stack([cameras[v][i] for v, i in enumerate(rows)]) for rows in torch.cartesian_prod(*[torch.arange(3)] * 4)]
    )
    torch.testing.assert_close(quadrifocal(*cameras).flatten(), torch.linalg.det(minors))
    assert abs(float(value)) < 1e-10


@pytest.mark.parametrize(("source", "target"), [(2, 1), (3, 1), (1, 2), (3, 2), (1, 3), (2, 3)])
def test_static_lines_are_transferred(source, target):
    motion = near_identity()
    lines = static_lines(motion, 20)
    found = DualHomographyTensor.transfer(-2 * DualHomographyTensor.compose(*motion), 3 * lines[source - 1], source, target)
    sign = (found * lines[target - 1]).sum(-1, keepdim=True).sign()
    torch.testing.assert_close(sign * found, lines[target - 1], rtol=1e-9, atol=1e-10)


@pytest.mark.parametrize("view", [1, 2, 3])
def test_concurrency_is_the_static_point(view):
    motion = near_identity()
    views, points = concurrent(motion, 20)
    others = [x for v, x in enumerate(views) if v != view - 1]
    found = DualHomographyTensor.concurrency(DualHomographyTensor.compose(*motion), *others, view=view)
    torch.testing.assert_close(found, points[view - 1], rtol=1e-8, atol=1e-8)


def angle_and_offset(motion, views):
    """Angle and offset of the carried lines against the first, for lines of about the same orientation."""
    parts = []
    for matrix, line in zip(motion, views[1:], strict=True):
        carried = raw(line @ torch.linalg.inv(matrix))
        carried = carried * (carried[:, :2] * views[0][:, :2]).sum(-1, keepdim=True).sign()
        turn = torch.atan2(carried[:, 1], carried[:, 0]) - torch.atan2(views[0][:, 1], views[0][:, 0])
        parts += [torch.remainder(turn + torch.pi, 2 * torch.pi) - torch.pi, carried[:, 2] - views[0][:, 2]]
    return torch.stack(parts, dim=-1)


def disturbed(lines, turn, shift):
    angle = torch.atan2(lines[:, 1], lines[:, 0]) + turn
    return torch.stack([angle.cos(), angle.sin(), lines[:, 2] + shift], dim=-1)


def test_residual_of_static_lines_agrees_with_finite_differences():
    motion = near_identity()
    views = [disturbed(line, *(0.1 * random(2, 10, seed=5 + v))) for v, line in enumerate(static_lines(motion, 10))]
    scales = tuple(torch.tensor(s).double() for s in (0.5, 1.5, 2.0))
    covariance, step = torch.zeros(10, 4, 4).double(), 1e-6
    for v in range(3):
        for direction in ((step, 0.0), (0.0, step)):
            ends = []
            for sign in (1, -1):
                moved = list(views)
                moved[v] = disturbed(views[v], sign * direction[0], sign * direction[1])
                ends.append(angle_and_offset(motion, moved))
            column = (ends[0] - ends[1]) / (2 * step) * scales[v]
            covariance = covariance + column[:, :, None] * column[:, None, :]
    truth = whiten(angle_and_offset(motion, views), covariance)
    torch.testing.assert_close(LINES.whitened_static_residual(tuple(motion), tuple(views), scales), truth, rtol=1e-5, atol=1e-7)
    flipped = (views[0], -views[1], 3 * views[2])
    torch.testing.assert_close(LINES.whitened_static_residual(tuple(motion), flipped, scales), truth, rtol=1e-5, atol=1e-7)


def test_static_distance_needs_no_motion_and_is_chi_square():
    motion, sigma = near_identity(), 1e-3
    exact = static_lines(motion, 5000)
    views = [disturbed(line, *(sigma * random(2, 5000, seed=5 + v))) for v, line in enumerate(exact)]
    tensor = DualHomographyTensor.compose(*motion)
    distance = DualHomographyTensor.static_distance(-tensor, *views)
    truth = LINES.whitened_static_residual(tuple(motion), tuple(views), ONES).norm(dim=-1)
    torch.testing.assert_close(distance, truth, rtol=1e-6, atol=1e-9)
    assert abs(float((distance / sigma).square().mean()) - 4) < 0.2
    moving, _ = concurrent(motion, 50)
    assert DualHomographyTensor.static_distance(tensor, *moving).median() > 100 * sigma


def test_degenerate_input_is_never_nan():
    tensors = torch.stack([torch.zeros(3, 3, 3), torch.ones(3, 3, 3), random(3, 3, 3)]).double().requires_grad_()
    lines = random(3, 4, 3)
    with torch.no_grad():
        lines[:, 0] = torch.tensor([0.0, 0.0, 1.0])
    outputs = [
        *DualHomographyTensor.decompose(tensors),
        DualHomographyTensor.transfer(tensors, lines),
        DualHomographyTensor.concurrency(tensors, lines, lines),
        DualHomographyTensor.static_distance(tensors, lines, lines, lines),
    ]
    assert all(o.isfinite().all() for o in outputs)
    for output in outputs:
        (gradient,) = torch.autograd.grad(output.sum(), tensors, retain_graph=True)
        assert gradient.isfinite().all()
    assert torch.equal(outputs[0][0], torch.zeros(3, 3).double())


def test_misuse_is_refused():
    zeros = torch.zeros(3, 3, 3)
    assert_refused(
        (lambda: DualHomographyTensor("circles"), "'circles'"),
        (lambda: DualHomographyTensor.transfer(zeros, torch.zeros(1, 3), 1, 1), "got 1 and 1"),
        (lambda: DualHomographyTensor.from_quadrifocal(zeros, torch.zeros(3)), r"\(3, 3, 3\)"),
        (lambda: quadrifocal(*torch.zeros(4, 3, 3)), r"\(3, 3\)"),
    )

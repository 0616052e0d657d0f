"""The algebra of shape tensors against what it is derived from: determinants, closed forms, exact counts."""

import pytest
import torch

from dyntorch import counting
from dyntorch.invariants.shape_tensor import ShapeTensor
from dyntorch.shapes import static as shape_rows
from dyntorch.shapes.static import dual_cameras, reference_cameras
from tests.battery.references import rank
from tests.battery.shape_cases import SHAPE_CASES

CPU = torch.device("cpu")
FREE = {("general", 6): 5, ("general", 7): 11, ("general", 8): 23, ("plane", 6): 3, ("plane", 7): 6, ("plane", 8): 9}


def draw(*shape, seed=0):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def contracted(tensor, points, lines):
    """The form on the points whose slot takes a point and on the lines of the others."""
    vectors = [p if a == 2 else line for a, p, line in zip(shape_rows.PROFILES[4 + len(points)], points, lines, strict=True)]
    for u in vectors:
        tensor = torch.tensordot(u, tensor, dims=1)
    return tensor


@pytest.mark.parametrize(("frame", "n"), FREE)
def test_the_form_is_the_determinant_of_four_lines(frame, n):
    others = draw(n - 4, 4)
    cameras = dual_cameras(others) if frame == "general" else reference_cameras(others)
    tensor = shape_rows.form(cameras).reshape((3,) * (n - 4))
    ratios = []
    for seed in range(4):
        first, second = draw(2, n - 4, 3, seed=seed)
        rows = [torch.stack([a, b]) @ c for a, b, c in zip(first, second, cameras, strict=True)]
        chosen = [r[:a] for r, a in zip(rows, shape_rows.PROFILES[n], strict=True)]
        ratios.append(contracted(tensor, torch.linalg.cross(first, second), first) / torch.linalg.det(torch.cat(chosen)))
    torch.testing.assert_close(torch.stack(ratios), ratios[0].sign() * torch.ones(4).double())


def test_closed_forms_beside_a_reference_plane():
    v = draw(4, 3)
    six = shape_rows.form(shape_rows.finite_cameras(v[:2])).reshape(3, 3)
    p, q = draw(2, 3, seed=1)
    torch.testing.assert_close((p @ six @ q).abs(), (torch.linalg.cross(p, q) @ (v[0] - v[1])).abs())
    eight = shape_rows.form(shape_rows.finite_cameras(v)).reshape(3, 3, 3, 3)
    lines = draw(4, 3, seed=2)
    others = [torch.linalg.det(torch.stack([lines[j] for j in range(4) if j != i])) for i in range(4)]
    expected = sum((-1) ** i * (lines[i] @ v[i]) * others[i] for i in range(4))
    torch.testing.assert_close(contracted(eight, lines, lines).abs(), expected.abs())


@pytest.mark.parametrize(("frame", "n"), FREE)
def test_free_coefficients_are_those_that_exact_counts_leave(frame, n):
    general = frame == "general"
    basis = shape_rows.free(n, CPU) if general else shape_rows.plane_map(n, CPU).mT
    assert rank(basis) == FREE[frame, n]
    if (frame, n) != ("plane", 8):  # among the tests of counting
        synthetic = counting.count("shape_tensor", points=n, general=general, synthetic=True, images=0)
        assert 3 ** (n - 4) - synthetic.rank == FREE[frame, n]
    counted = counting.count("shape_tensor", points=n, general=general, synthetic=True, images=5)
    assert counted.rank == 3 ** (n - 4) - 1 and counted.minimal == ShapeTensor(frame, n).minimal()
    # all points at one place u: of the basis, or anywhere
    places = torch.cat([torch.eye(3), torch.ones(1, 3)]).double() if general else draw(50, 3)
    rows = shape_rows._products(torch.nn.functional.normalize(places, dim=-1)[:, None].expand(-1, n - 4, 3))
    assert (rows @ basis.mT).abs().max() < 1e-12


def test_synthetic_constraints_of_eight_points_with_a_reference_plane_are_dim_v():
    assert 81 - rank(shape_rows.plane_map(8, CPU)) == counting.dim_v(3, 4, 2) == 72
    # products of vectors within planes span what annihilates the tensors: nine dimensions are left
    planes = draw(200, 2, 3)
    vectors = [draw(200, 1, 2, seed=s) @ planes for s in range(1, 5)]
    products = torch.einsum("na,nb,nc,nd->nabcd", *(u[:, 0] for u in vectors)).flatten(1)
    assert rank(products) == 72 and (products @ shape_rows.plane_map(8, CPU)).abs().max() < 1e-10


@pytest.mark.parametrize("case", [c for c in SHAPE_CASES if (c.frame, c.n) in FREE], ids=repr)
def test_the_tensor_is_the_null_vector_of_all_coefficients(case):
    """The reference that solves for all of 9, 27, 81: many more views without the synthetic constraints, no more with them."""
    points, shape = case.scene(10, seed=3)
    x = torch.stack([torch.nn.functional.pad(p, (0, 1), value=1.0) for p in points], -2)
    rows = shape_rows._products(shape_rows.canonical(x)[0]).flatten(0, 1)
    assert rank(rows) == rows.shape[1] - 1
    null = torch.linalg.svd(rows).Vh[-1].reshape(case.invariant.shape())
    assert case.apart(null, case.invariant.compose(shape)) < 1e-7


def test_affine_annihilator_holds_barycentric_coordinates():
    shape = draw(6, 3)
    tensor = ShapeTensor("affine").compose(shape)
    torch.testing.assert_close(tensor @ tensor.mT, torch.eye(2).double())
    homogeneous = torch.nn.functional.pad(shape, (0, 1), value=1.0)
    weights = homogeneous[4:] @ torch.linalg.inv(homogeneous[:4])
    rows = torch.cat([weights, -torch.eye(2).double()], dim=-1)
    torch.testing.assert_close(rows @ tensor.mT @ tensor, rows)


def test_frame_of_the_view_is_that_of_the_four_points():
    x = torch.nn.functional.pad(draw(3, 7, 2), (0, 1), value=1.0)
    q, noise = shape_rows.canonical(x)
    for view, found in zip(x, q, strict=True):
        scale = torch.linalg.solve(view[:3].mT, view[3])
        expected = torch.nn.functional.normalize(torch.linalg.solve(view[:3].mT * scale, view[4:].mT).mT, dim=-1)
        torch.testing.assert_close(found * (found * expected).sum(-1, keepdim=True).sign(), expected)
    lines = shape_rows.lines_through(q)
    torch.testing.assert_close(lines @ lines.mT, torch.eye(2).double().expand(3, 3, 2, 2))
    assert (lines @ q[..., None]).abs().max() < 1e-14 and (noise > 0).all()
    # the noise of a point is about what moving all points does to it
    turns = torch.stack(
        [shape_rows.canonical(x + 1e-6 * draw(3, 7, 3, seed=s) * torch.tensor([1, 1, 0]))[0] - q for s in range(60)]
    )
    size = shape_rows.local(x)[1][:, None]
    measured = turns.square().sum(-1).mean(0).sqrt() / (1e-6 * size)
    assert ((measured / noise > 0.2) & (measured / noise < 1.5)).all()

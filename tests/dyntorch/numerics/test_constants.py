"""Cached tables serve every later call, wherever the first one came from."""

import ast
from pathlib import Path

import pytest
import torch

from dyntorch.core import matrix
from dyntorch.core import primitives as base
from dyntorch.core import primitives as plane
from dyntorch.geometry import epipolar, extensors, grassmann, grassmann_nearest
from dyntorch.geometry import epipolar as epipolar_variance
from dyntorch.geometry import epipolar_fit as epipolar_descent
from dyntorch.geometry import extensors as exterior
from dyntorch.geometry import grassmann as grassmann_recovery
from dyntorch.geometry import homogeneous as monomials
from dyntorch.geometry import pairs as epipole_pairs
from dyntorch.invariants import dynamic_shape_tensor as dynamic_shape_rows
from dyntorch.invariants import dynamic_tensor
from dyntorch.invariants import reprojection as shape_residual
from dyntorch.numerics import eigenspaces, lags
from dyntorch.numerics.blocks import constant
from dyntorch.shapes import basis as dynamic_shape_theory
from dyntorch.shapes import lifted
from dyntorch.shapes import static as shape_completion
from dyntorch.shapes import static as shape_points
from dyntorch.shapes import static as shape_rows
from dyntorch.shapes.basis import Polynomial
from dyntorch.tasks.planes import closed_forms as infinity_extensors
from dyntorch.tasks.planes import problem as planes_problem
from dyntorch.tasks.planes import problem as planes_starts
from dyntorch.tasks.synchronize import projective

CPU = torch.device("cpu")
TABLES = [
    (lags._epipolar_places, (CPU,)),
    (lags._resection_places, (CPU,)),
    (epipolar_variance._plane, (CPU,)),
    (extensors._levi_civita, (3, torch.float64, CPU)),
    (extensors._laplace, (4, 2, CPU)),
    (extensors._dual_signs, (4, 2, CPU)),
    (exterior._splits, (4, 2, 1, CPU)),
    (dynamic_tensor.vanishing_forms, (2, 3, 2, CPU)),
    (grassmann._removals, (4, 2, CPU)),
    (grassmann._insertions, (4, 2, CPU)),
    (grassmann_nearest._determinant_rows, ((2, 1, 1), (3, 3, 3), CPU)),
    (grassmann_recovery.tables, ((2, 1, 1), (3, 3, 3), 2, CPU)),
    (plane._linear_minor_tables, (3, 2, CPU)),
    (base.triangle, (4, CPU)),
    (base._above_the_diagonal, (CPU,)),
    (matrix._unpacking, ((3, 3), CPU)),
    (eigenspaces._generic, (5, 2, CPU)),
    (epipolar.polar, (torch.float64, CPU)),
    (epipolar._places, (CPU,)),
    (epipolar_descent._tables, (torch.float64, CPU)),
    (epipolar_descent._pairs, (CPU,)),
    (epipole_pairs._product_table, (CPU,)),
    (infinity_extensors._joins, (3, 64, CPU)),
    (infinity_extensors._invariant_basis, (CPU,)),
    (monomials.symmetric, (2, CPU)),
    (monomials.factors, (2, 2, CPU)),
    (monomials.collecting, (2, 2, CPU)),
    (monomials.multiplicity, (2, 2, CPU)),
    (planes_problem._parameter_places, (3, 1, CPU)),
    (planes_starts._frames, (CPU,)),
    (projective._products, (CPU,)),
    (shape_completion._choices, (8, CPU)),
    (shape_points._basis, ("plane", 4, CPU)),
    (lifted.partitions, (3, (2, 2), CPU)),
    (lifted.chosen_basis, (3, 2, CPU)),
    (shape_points.plane_inverse, (6, CPU)),
    (shape_rows.centring_basis, (5, CPU)),
    (shape_rows.free, (6, CPU)),
    (shape_rows.plane_map, (6, CPU)),
    (shape_residual._maps, (shape_residual.CameraKind(affine=True), CPU)),
    (dynamic_shape_rows.basis_points_first, (6, (0, 1, 2, 3), CPU)),
    (dynamic_shape_rows._nodes, (Polynomial(1), CPU)),
    (dynamic_shape_rows._samples, (Polynomial(1), CPU)),
    (dynamic_shape_theory._to_powers, (3, CPU)),
]
"""All of them: the last test says so."""


def tensors(table):
    if isinstance(table, torch.Tensor):
        return [table]
    return [t for part in (table if isinstance(table, tuple) else vars(table).values()) for t in tensors_of(part)]


def tensors_of(part):
    return tensors(part) if isinstance(part, torch.Tensor | tuple) else []


def within_grad(function):
    torch.func.grad(lambda x: (function(), x)[1])(torch.ones(()))


def within_vmap(function):
    torch.func.vmap(lambda x: (function(), x)[1])(torch.ones(2))


def within_jvp(function):
    torch.func.vmap(lambda t: torch.func.jvp(lambda x: (function(), x)[1], (torch.ones(()),), (t,)))(torch.ones(2))


def within_inference(function):
    with torch.inference_mode():
        function()


def on_another_device(function):
    with torch.device("meta"):
        function()


@pytest.mark.parametrize("around", [within_grad, within_vmap, within_jvp, within_inference, on_another_device])
def test_what_surrounds_the_first_call_leaves_no_trace(around):
    failures = []
    for table, sizes in TABLES:
        for other, _ in TABLES:  # some are made from others
            other.cache_clear()
        around(lambda table=table, sizes=sizes: table(*sizes))
        once = table.cache_info().currsize == 1
        cached = tensors(table(*sizes))
        table.cache_clear()
        fresh = tensors(table(*sizes))
        if not (once and len(cached) == len(fresh) > 0 and all(map(plain_and_equal, cached, fresh))):
            failures.append(table.__name__)
    assert failures == []


def plain_and_equal(tensor, expected):
    return (
        not torch._C._functorch.is_functorch_wrapped_tensor(tensor)
        and not tensor.is_inference()
        and not tensor.requires_grad
        and tensor.device == CPU
        and tensor.equal(expected)
    )


def test_a_mistake_is_the_callers():
    @constant
    def table(n):
        raise ValueError(f"no table of {n}")

    with pytest.raises(ValueError, match="no table of 3"):
        table(3)


@pytest.mark.slow
def test_no_other_function_caches_tensors():
    listed = {table.__name__ for table, _ in TABLES}
    decorated, cached = set(), set()
    for path in sorted(Path(extensors.__file__).parents[1].rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.FunctionDef):
                names = {ast.unparse(d).split("(")[0] for d in node.decorator_list}
                decorated |= {node.name} if "constant" in names else set()
                # what comes from a cache of the standard library must not be a tensor
                cached |= {node.name} if names & {"lru_cache", "cache"} and "Tensor" in ast.unparse(node.returns) else set()
    assert decorated == listed | {"count_rows"}  # whose numbers are no tensors
    assert cached == set()

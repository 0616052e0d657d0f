"""torch.func through solvers that look at values: every order and nesting, against the same function in plain operations."""

from __future__ import annotations

from typing import NamedTuple

import pytest
import torch
from torch import Tensor
from torch.func import grad, hessian, jacfwd, jacrev, jvp, vjp, vmap

from dyntorch.numerics.function_transforms import is_transformed, over_problems


class Parts(NamedTuple):
    value: Tensor
    positive: Tensor
    given: Tensor


def smooth(x: Tensor, y: Tensor) -> Tensor:
    return torch.stack([x.sin() * y, x.square() * y.cos()], dim=-1).sum(-2)


def decided(x: Tensor, y: Tensor) -> Parts:
    """The same of ``(b, n)``, with a look at values, a count and an input that goes out as it came."""
    assert type(float(x.detach().sum())) is float
    value = torch.stack([x.sin() * y, x.square() * y.cos()], dim=-1).sum(-2)
    return Parts(value, (x > 0).sum(-1), y)


def solved(x: Tensor, y: Tensor) -> Tensor:
    """Of one problem ``(n,)``."""
    return over_problems(lambda x, y: decided(x, y).value, x[None], y[None])[0]


def data(*shape: int) -> tuple[Tensor, Tensor]:
    x, y = torch.randn(2, *shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    return x, y


WAYS = {
    "vmap": lambda f: vmap(f),
    "vmap of the second": lambda f: lambda x, y: vmap(f, in_dims=(None, 1))(x[0], y.mT),
    "nested vmap": lambda f: lambda x, y: vmap(vmap(f, in_dims=(None, 0)), in_dims=(0, None))(x, y),
    "grad of vmap": lambda f: grad(lambda x, y: vmap(f)(x, y).sin().sum(), argnums=(0, 1)),
    "vmap of grad": lambda f: vmap(grad(lambda x, y: f(x, y).sin().sum(), argnums=(0, 1))),
    "jacrev": lambda f: lambda x, y: jacrev(f, argnums=(0, 1))(x[0], y[0]),
    "jacfwd": lambda f: lambda x, y: jacfwd(f, argnums=(0, 1))(x[0], y[0]),
    "jacrev of vmap": lambda f: jacrev(vmap(f)),
    "vmap of jacfwd": lambda f: vmap(jacfwd(f)),
    "jvp": lambda f: lambda x, y: jvp(lambda x: f(x, y[0]), (x[0],), (y[1],)),
    "vmap of jvp": lambda f: vmap(lambda x, y: jvp(f, (x, y), (y, x))),
    "vjp": lambda f: lambda x, y: vjp(f, x[0], y[0])[1](torch.ones(2, dtype=x.dtype)),
    "hessian": lambda f: lambda x, y: hessian(lambda x, y: f(x, y).sum(), argnums=(0, 1))(x[0], y[0]),
    "vmap of hessian": lambda f: vmap(hessian(lambda x, y: f(x, y).sum())),
    "reverse over reverse": lambda f: lambda x, y: jacrev(jacrev(lambda x: f(x, y[0])))(x[0]),
    "third": lambda f: lambda x, y: jacrev(jacfwd(jacrev(lambda x: f(x, x).sum())))(x[0]),
    "both arguments the same": lambda f: lambda x, y: jacrev(lambda x: f(x, x))(x[0]),
}


@pytest.mark.parametrize("way", WAYS)
def test_every_way_gives_what_plain_operations_give(way):
    x, y = data(3, 4)
    torch.testing.assert_close(WAYS[way](solved)(x, y), WAYS[way](smooth)(x, y))


def test_autograd_outside_of_a_transformation():
    found = []
    for f in (solved, smooth):
        x, y = (part.requires_grad_() for part in data(3, 4))
        value = vmap(grad(lambda x, y, f=f: f(x, y).sin().sum()))(x, y).square().sum()
        first = torch.autograd.grad(value, (x, y), create_graph=True)
        found.append((*first, *torch.autograd.grad(sum(part.sin().sum() for part in first), (x, y))))
    torch.testing.assert_close(*found)


def test_records_counts_and_what_nothing_depends_on():
    x, y = data(3, 4)

    def parts(x: Tensor, y: Tensor) -> Parts:
        assert is_transformed(x, (None, (y,)))
        found = over_problems(decided, x[None], y[None])
        return Parts(*(part[0] for part in found))

    found, plain = vmap(parts)(x, y), decided(x, y)
    torch.testing.assert_close(found, plain)
    assert not is_transformed(x, y) and found.positive.dtype == torch.int64
    assert over_problems(decided, x, y).given is y  # without a transformation it is the call itself
    slope = vmap(grad(lambda y, x: parts(x, y).given.square().sum()))(y, x)
    torch.testing.assert_close(slope, 2 * y)
    tangent = jvp(lambda x: over_problems(decided, x[None], y[:1])[0], (x[0],), (y[0],))[1]
    torch.testing.assert_close(tangent[0], jvp(lambda x: smooth(x, y[0]), (x[0],), (y[0],))[1])
    frozen = lambda x: over_problems(lambda x: x.detach().sin(), x)  # noqa: E731
    assert (grad(lambda x: frozen(x).sum())(x) == 0).all() and (jvp(frozen, (x,), (y,))[1] == 0).all()
    assert (vmap(hessian(lambda x: frozen(x[None]).sum()))(x) == 0).all()

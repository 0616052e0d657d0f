"""Forward-mode derivatives: closed forms, and many threads at once."""

from concurrent.futures import ThreadPoolExecutor

import torch

from dyntorch.forward import derivatives, jacobian


def cubes(theta):
    return torch.stack([theta[:, 0] ** 3, theta[:, 0] * theta[:, 1]], dim=-1)


def test_closed_forms():
    theta = torch.tensor([[2.0, 3.0], [-1.0, 5.0]], dtype=torch.float64)
    value, slope = jacobian(cubes, theta)
    torch.testing.assert_close(value, torch.tensor([[8.0, 6.0], [-1.0, -5.0]], dtype=torch.float64))
    expected = torch.tensor([[[12.0, 3.0], [0.0, 2.0]], [[3.0, 5.0], [0.0, -1.0]]], dtype=torch.float64)
    torch.testing.assert_close(slope, expected)
    tangent = torch.tensor([[1.0, -2.0], [0.5, 1.0]], dtype=torch.float64)
    torch.testing.assert_close(derivatives(cubes, theta, tangent[None])[1][:, 0], (tangent[:, None] @ expected)[:, 0])


def test_threads_do_not_disturb_each_other():
    """torch has one level of dual numbers for the whole process: without the lock this raises."""
    theta = torch.rand(50, 6, dtype=torch.float64, generator=torch.Generator().manual_seed(0))

    def run(_):
        return jacobian(lambda t: t.sin().cumsum(-1).exp(), theta)[1]

    expected = run(0)
    with ThreadPoolExecutor(8) as pool:
        assert all(torch.equal(found, expected) for found in pool.map(run, range(200)))

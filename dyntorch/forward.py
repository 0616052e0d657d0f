"""Derivatives of batched functions along tangents: how changes of the parameters carry forward to the values."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor
from torch.autograd import grad


def derivatives(function: Callable[[Tensor], Tensor], theta: Tensor, tangents: Tensor) -> tuple[Tensor, Tensor]:
    """Value and directional derivatives by one pass over all tangents.

    By reverse mode alone: what it pulls back is linear in the cotangent, and pulling back through that carries tangents forward.
    Dual numbers would do it in one pass, but torch's first product of one with a constant imports its compiler, as does the first
    backward pass of ``torch.func``, and gradients given to autograd import sympy: that takes longer (1.5 s, 0.5 s) than most verbs.
    Only sums are differentiated here.

    Args:
        function: ``(k, *batch, p)`` to ``(k, *batch, rows)``, each problem of each k by itself.  Tensors that were made in
            inference mode cannot take part.
        theta: ``(*batch, p)``.
        tangents: ``(k, *batch, p)``.

    Returns:
        ``(*batch, rows)`` and ``(*batch, k, rows)``.

    Example:
        >>> import torch
        >>> derivatives(torch.square, torch.tensor([[3.0, 4.0]]), torch.tensor([[[1.0, 0.5]]]))[1].tolist()
        [[[6.0, 4.0]]]
    """
    count = len(tangents)
    with torch.inference_mode(False), torch.enable_grad():
        several = theta.detach().expand(tangents.shape).clone().requires_grad_()
        values = function(several)
        rows = values.shape[-1]
        if not values.requires_grad:
            return values[0], torch.zeros_like(values).movedim(0, -2)
        if rows <= count:  # fewer values than tangents: one pass back, each copy of theta for one value
            slopes = grad(values[:rows].diagonal(dim1=0, dim2=-1).sum(), several)[0][:rows]
            return values[0].detach(), torch.einsum("k...p,r...p->...kr", tangents, slopes)
        cotangents = torch.zeros_like(values, requires_grad=True)
        pulled = grad((values * cotangents).sum(), several, create_graph=True)[0]
        pushed = grad((pulled * tangents.detach().clone()).sum(), cotangents)[0]
    return values[0].detach(), pushed.movedim(0, -2)


def jacobian(function: Callable[[Tensor], Tensor], theta: Tensor) -> tuple[Tensor, Tensor]:
    """Value ``(*batch, rows)`` and transposed Jacobian ``(*batch, p, rows)`` of a function of ``theta (*batch, p)``."""
    count = theta.shape[-1]
    tangents = torch.eye(count, dtype=theta.dtype, device=theta.device).reshape(count, *[1] * (theta.ndim - 1), count)
    return derivatives(function, theta, tangents.expand(count, *theta.shape))


def by_match(
    function: Callable[[Tensor, tuple[Tensor, ...], tuple[Tensor, ...]], Tensor],
    theta: Tensor,
    problems: tuple[Tensor, ...],
    matches: tuple[Tensor, ...],
) -> tuple[Tensor, Tensor]:
    """Value and transposed Jacobian of a function of the matches: a few values per match, many parameters.

    Every match gets its own copy of the parameters, so that one backward pass per value serves all matches.

    Args:
        function: parameters ``(b, n, p)``, what belongs to a problem ``(b, n, ...)`` and to a match ``(b, n, 1, ...)`` to
            ``(b, n, 1, c)``.
        theta: ``(b, p)``.
        problems: ``(b, ...)`` each.
        matches: ``(b, n, ...)`` each.

    Returns:
        ``(b, n c)`` and ``(b, p, n c)``.

    Example:
        >>> import torch
        >>> x = torch.tensor([[1.0, 2.0]])
        >>> by_match(lambda t, p, m: t[..., None, :] * m[0][..., None], torch.tensor([[3.0]]), (), (x,))[1].tolist()
        [[[1.0, 2.0]]]
    """
    count = matches[0].shape[1]
    # copies: what was made in inference mode may not be saved for a backward pass
    with torch.inference_mode(False), torch.enable_grad():
        copies = theta.detach()[:, None].repeat(1, count, 1).requires_grad_()
        shared = tuple(x.detach().clone()[:, None].expand(-1, count, *x.shape[1:]) for x in problems)
        value = function(copies, shared, tuple(x.detach().clone().unsqueeze(2) for x in matches))[..., 0, :]
        slopes = [grad(column.sum(), copies, retain_graph=True)[0] for column in value.unbind(-1)]
    return value.detach().flatten(1), torch.stack(slopes, dim=2).flatten(1, 2).mT


def normalized_derivative(value: Tensor, slope: Tensor) -> tuple[Tensor, Tensor]:
    r""":math:`v / |v|` and its transposed Jacobian, from values ``(*batch, rows)`` and their own ``(*batch, p, rows)``.

    Values that are 0 stay so.

    Example:
        >>> import torch
        >>> value, slope = normalized_derivative(torch.tensor([0.0, 2.0]), torch.eye(2))
        >>> value.tolist(), slope.tolist()
        ([0.0, 1.0], [[0.5, 0.0], [0.0, 0.0]])
    """
    norm = value.norm(dim=-1, keepdim=True)
    norm = norm.where(norm > 0, 1.0)
    value = value / norm
    # across the value: along it only the scale changes
    return value, (slope - (slope @ value[..., None]) * value[..., None, :]) / norm[..., None]

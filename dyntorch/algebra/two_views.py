"""What closed forms for the matches of two views have in common: the check of what they are given, and how results print."""

from __future__ import annotations

from torch import Tensor


def check_matches(x1: Tensor, x2: Tensor, weights: Tensor | None = None) -> None:
    """Refuse what is not two views of the same points.

    Args:
        x1: ``(*batch, n, 2)`` points of view 1.
        x2: ``(*batch, n, 2)`` points of view 2.
        weights: ``(*batch, n)``; only its type is checked.

    Raises:
        ValueError: no tensors, no floating point numbers, or other shapes.

    Example:
        >>> check_matches([[1.0, 2.0]], [[1.0, 2.0]])
        Traceback (most recent call last):
            ...
        ValueError: x1 must be a torch.Tensor, got list; use torch.as_tensor(...)
    """
    for name, value in (("x1", x1), ("x2", x2), ("weights", x1 if weights is None else weights)):
        if not isinstance(value, Tensor):
            raise ValueError(f"{name} must be a torch.Tensor, got {type(value).__name__}; use torch.as_tensor(...)")
    if x1.shape != x2.shape or x1.ndim < 2 or x1.shape[-1] != 2 or not (x1.is_floating_point() and x2.is_floating_point()):
        raise ValueError(
            f"x1 and x2 must be floating point (*batch, n, 2) of one shape, got {tuple(x1.shape)} {x1.dtype} and "
            f"{tuple(x2.shape)} {x2.dtype}"
        )


def described(result: object, labels: Tensor, degenerate: Tensor, bodies: int) -> str:
    """Shape, how many matches each label has, and how many problems are degenerate, in two lines.

    Args:
        result: whose class names it.
        labels: ``(*batch, n)``, 0 = no body.
        degenerate: ``(*batch,)`` bool.
        bodies: largest label.

    Example:
        >>> import torch
        >>> print(described(0, torch.tensor([1, 1, 2, 0]), torch.tensor(True), 2))
        int(matches=4, bodies=2, batch=(): degenerate)
          labels: 2 of body 1, 1 of body 2, 1 unlabelled
    """
    counts = labels.flatten().bincount(minlength=bodies + 1).tolist()
    state = "degenerate" if not degenerate.ndim else f"{int(degenerate.sum())} of {degenerate.numel()} degenerate"
    state = state if degenerate.ndim or bool(degenerate) else "not degenerate"
    head = f"{type(result).__name__}(matches={labels.shape[-1]}, bodies={bodies}, batch={tuple(degenerate.shape)}: {state})"
    listed = [f"{counts[k]} of body {k}" for k in range(1, bodies + 1)] + [f"{counts[0]} unlabelled"] * bool(counts[0])
    return f"{head}\n  labels: {', '.join(listed)}"

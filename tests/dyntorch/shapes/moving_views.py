"""Single affine views of moving points, written from their definition."""

import torch


def draw(*shape, g):
    return torch.randn(*shape, generator=g, dtype=torch.float64)


def moving_views(functions, times, *, n=8, batch=(), noise=0.0, seed=0, cameras=(3, 2)):
    """Views ``(*batch, views, n, 2)`` at times ``(views,)`` or ``(*batch, views)``, and the shapes ``(*batch, B, n, 3)``.

    ``functions`` are the functions of the time of the trajectories; noise is a part of the RMS extent of each view.
    """
    g = torch.Generator().manual_seed(seed)
    shapes = draw(*batch, len(functions), n, 3, g=g)
    times = times.expand(*batch, times.shape[-1])
    position = sum(f(times)[..., None, None] * shapes[..., b, None, :, :] for b, f in enumerate(functions))
    x = position @ draw(*times.shape, *cameras, g=g) + draw(*times.shape, 1, 2, g=g)
    extent = (x - x.mean(-2, keepdim=True)).square().mean((-2, -1), keepdim=True).sqrt()
    return x + noise * extent * draw(*x.shape, g=g), shapes


LINEAR = (torch.ones_like, lambda t: t)
SQUARE = (torch.ones_like, lambda t: t, lambda t: 2 * t**2 - 1)
WAVE = (torch.ones_like, torch.cos, torch.sin)

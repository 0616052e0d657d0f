"""Static shape tensors under noise: does a single new image show the shape, whoever took it?

    python -m experiments.recognition.shape_tensor --quick

A tensor is fitted to a few views of random points of space; then it scores one new view of the same points and one of a shape
whose points are a sixth of its size away, both with the noise of the training views. "right" is the share of pairs in which the
new view scores better; beside it what a view of the shape scores in pixels, which is the noise where the model holds. The
baseline compares the new image with the nearest training view after the best affine map of the image: what a person would do
without the tensor.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

import dyntorch as dyn
from experiments.common.runner import SceneConfig, Tables, Words, experiment
from experiments.thesis.definitions import cameras, homogeneous, mapped, normal, seeded

SETTINGS: tuple[tuple[str, int, int], ...] = (
    ("general", 6, 4),
    ("general", 6, 8),
    ("general", 7, 6),
    ("general", 8, 6),
    ("plane", 6, 4),
    ("plane", 8, 4),
    ("affine", 5, 4),
    ("affine", 8, 4),
)
"""Form of the tensor, points, training views."""
NOISES = (0.1, 0.5, 1.0)
TURN = 1.0
"""Radians: how far the cameras turn about each axis."""
DIFFERENCE = 0.15
"""Of each coordinate, between both shapes, where the shapes have standard deviation 1."""
HEAD = ("form", "points", "views", "noise px", "right", "score of the shape px", "of another px", "nearest view right")


def shape(form: str, n: int, draw: torch.Generator) -> Tensor:
    """Random points; the first four are coplanar where the form asks for a reference plane."""
    P = normal(n, 3, draw=draw)
    if form == "plane":
        P[:4, 2] = 0.3 * P[:4, 0] - 0.2 * P[:4, 1]
    return P


def altered(form: str, points: Tensor, draw: torch.Generator) -> Tensor:
    """Another shape, much like the first; its reference plane stays."""
    kept = 4 if form == "plane" else 0
    return torch.cat([points[:kept], points[kept:] + DIFFERENCE * normal(len(points) - kept, 3, draw=draw)])


def images(form: str, points: Tensor, views: int, sigma: float, draw: torch.Generator) -> Tensor:
    """Noisy views ``(views, n, 2)``, pixels: perspective cameras a few units away, or affine ones."""
    if form == "affine":
        exact = torch.stack([150 * points @ normal(3, 2, draw=draw) / 2 + 300 for _ in range(views)])
    else:
        exact = torch.stack([mapped(points, camera) for camera in cameras(views, draw, turn=TURN)])
    return exact + sigma * normal(*exact.shape, draw=draw)


def nearest(training: Tensor, image: Tensor) -> float:
    """Least root mean square distance to a training view after the best affine map of the image."""
    source = homogeneous(image)
    left = [(source @ torch.linalg.lstsq(source, view).solution - view).square().mean().sqrt() for view in training]
    return float(min(left))


def line(form: str, n: int, views: int, sigma: float, scenes: int, seed: int) -> Sequence[str]:
    """One row of the table."""
    invariant = dyn.ShapeTensor() if form == "general" else dyn.ShapeTensor(form)
    right, beside, same, other = [], [], [], []
    for scene in range(scenes):
        draw = seeded(1000 * seed + scene)
        points = shape(form, n, draw)
        strange = altered(form, points, draw)
        training = images(form, points, views, sigma, draw)
        new, wrong = images(form, points, 1, sigma, draw), images(form, strange, 1, sigma, draw)
        found = dyn.fit(invariant, *training.unbind(1))
        if found.status == dyn.Status.OK:
            found = dyn.refine(found, *training.unbind(1))
        mine, its = (float(dyn.sampson(invariant, found.tensor, *x.unbind(1))) for x in (new, wrong))
        right.append(mine < its)
        same.append(mine)
        other.append(its)
        beside.append(nearest(training, new[0]) < nearest(training, wrong[0]))
    middle = [float(torch.tensor(values).median()) for values in (same, other)]
    shares = [sum(values) / scenes for values in (right, beside)]
    return form, str(n), str(views), f"{sigma:g}", f"{shares[0]:.2f}", f"{middle[0]:.2g}", f"{middle[1]:.2g}", f"{shares[1]:.2f}"


@experiment(SceneConfig(scenes=40), quick={"scenes": 20})
def tables(config: SceneConfig) -> Tables:
    """Static shape tensors over the points, the views and the noise."""
    noises = (0.5,) if config.quick else NOISES
    lines = [line(*setting, sigma, config.scenes, config.seed) for setting in SETTINGS for sigma in noises]
    yield f"one new image, {config.scenes} shapes a row", Words(HEAD, lines)

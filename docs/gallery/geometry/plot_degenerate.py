"""
Degenerate configurations
=========================

What no method can decide, in three pictures: equations that say too little, two worlds with the same images, and a
movement that repeats itself.
"""

import math

import matplotlib.pyplot as plt
import torch

import dyntorch as dyn
from dyntorch import scenes

# %%
# The homography tensor has 27 entries. Every moving point gives one equation; in general position 26 of them leave
# one tensor. The singular values of the equations, with the status that the estimate has.
draw = torch.Generator().manual_seed(0)
general = scenes.planar(n=60, generator=draw)
still = scenes.planar(n=60, static=1.0, generator=draw)
on_line = scenes.planar(n=60, generator=draw)


def moved_in(scene, points):
    """Three views of other points of the same plane, given where they are in view 1 at the three moments."""
    views = []
    for matrix, x in zip((torch.eye(3, dtype=torch.float64), *scene.motion), points, strict=True):
        homogeneous = torch.cat([x, torch.ones_like(x[:, :1])], dim=1) @ torch.linalg.inv(matrix).mT
        views.append(homogeneous[:, :2] / homogeneous[:, 2:])
    return views


place = torch.linspace(60, 580, 60, dtype=torch.float64)
line = [torch.stack([place + step, 0.4 * (place + step) + 100], dim=1) for step in (0.0, 31.0, 47.0)]
line = [
    x + torch.stack([speed * place.cos(), 0.4 * speed * place.cos()], dim=1)
    for x, speed in zip(line, (0.0, 20.0, 33.0), strict=True)
]
point = torch.tensor([300.0, 250.0], dtype=torch.float64)
ways = torch.nn.functional.normalize(torch.randn(60, 2, generator=draw, dtype=torch.float64), dim=1)
through = [point + ways * (30 + 200 * torch.rand(60, 1, generator=draw, dtype=torch.float64)) for _ in range(3)]
cases = {"general": general.views, "nothing moves": still.views, "all on one line": moved_in(on_line, line)}
cases["all lines through one point"] = moved_in(on_line, through)
figure, axes = plt.subplots()
for name, views in cases.items():
    solution = dyn.fit(dyn.HomographyTensor, *views)
    status = dyn.Status(int(solution.status)).name
    values = (solution.singular_values / solution.singular_values.max()).clamp(min=1e-17)
    axes.semilogy(range(1, len(values) + 1), values, "o-", markersize=4, label=f"{name}: {status}")
axes.set(xlabel="singular value", ylabel="relative size", title="Homography tensor: how many directions the matches leave open")
axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.16), ncol=2)
plt.show()

# %%
# Two worlds with the same images: add one velocity to all points and to the camera. Here a camera that looks at a
# plane from above, so that the image is where things are against the camera.
draw = torch.Generator().manual_seed(5)
points = torch.randn(7, 2, generator=draw) * 2
velocities = torch.randn(7, 2, generator=draw) * 0.5
velocities[:3] = 0
common = torch.tensor([0.9, 0.35])
figure, panels = plt.subplots(1, 3, figsize=(8.8, 3.4))
worlds = (("world 1: three points stand still", torch.zeros(2)), ("world 2: they all move", common))
camera = torch.tensor([[-3.0, -3.5], [-2.2, -3.3], [-1.4, -3.1]])
for panel, (title, added) in zip(panels, worlds, strict=False):
    for start, velocity in zip(points, velocities, strict=True):
        path = torch.stack([start + k * (velocity + added) for k in range(3)])
        panel.plot(*path.T, "o-", markersize=4, linewidth=1, color="C0" if velocity.abs().sum() == 0 else "C1")
    panel.plot(*torch.stack([camera[k] + k * added for k in range(3)]).T, "s-", color="k", markersize=5, label="camera")
    panel.set(title=title, aspect="equal", xlim=(-5, 6), ylim=(-5, 5), xticks=[], yticks=[])
    panel.legend(loc="upper left", fontsize=8)
for k in range(3):
    panels[2].scatter(*(points + k * velocities - camera[k]).T, s=22, color=f"C{k + 2}", label=f"view {k + 1}")
panels[2].set(title="what the camera sees of both", aspect="equal", xticks=[], yticks=[])
panels[2].legend(fontsize=8)
plt.show()

# %%
# A movement that repeats itself: every shift by a period fits equally well.
once = scenes.filmed_person(15, 12.0, offset=0.5, noise=2.0, generator=torch.Generator().manual_seed(3))
periodic = scenes.filmed_person(15, 12.0, offset=0.5, noise=2.0, walk=0.0, period=1.5, generator=torch.Generator().manual_seed(3))
figure, axes = plt.subplots(2, 1, sharex=True, figsize=(8, 4.6))
for panel, scene, title in ((axes[0], once, "happens once"), (axes[1], periodic, "repeats itself every 1.5 s")):
    shift = dyn.synchronize(scene.a, scene.b, fps=scene.fps)
    panel.plot(shift.lags, shift.scores, linewidth=1.2)
    panel.axvline(0.5, color="C1", linewidth=1)
    panel.set(ylabel="score", title=f"{title}: {'ok' if shift.ok else 'refused'}")
    if not math.isnan(shift.offset) and not shift.ok:
        print(shift.reason)
axes[1].set(xlabel="offset (s); orange: the truth")
plt.show()

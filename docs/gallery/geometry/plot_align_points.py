"""
A lidar among things that move
==============================

Three sweeps of a 3D sensor; half of the points moved on straight lines, some matches are wrong. Which rigid motion
did the sensor make?
"""

import matplotlib.pyplot as plt
import torch

import dyntorch as dyn
from dyntorch import metrics, scenes

draw = torch.Generator().manual_seed(1)
scene = scenes.moving_points(160, static=0.4, outliers=0.15, sigma=0.005, sensors="rigid", generator=draw)
found = dyn.align_points(*scene.views, model="rigid", threshold=0.02, generator=draw)
print(found)
print(f"error of the motion: {float(metrics.relative_error(found.A, scene.motion[0])):.4f}")


# %%
# Every match as a path through the three sweeps, from above. In the coordinates of the first sweep, what stood
# still is a point.
def moved(matrix, x):
    homogeneous = torch.cat([x, torch.ones_like(x[:, :1])], dim=1) @ matrix.mT
    return homogeneous[:, :3] / homogeneous[:, 3:]


sweeps = scene.views
aligned = (sweeps[0], moved(found.A, sweeps[1]), moved(found.B, sweeps[2]))
figure, axes = plt.subplots(1, 2, figsize=(8.4, 4))
for panel, views, title in zip(
    axes, (sweeps, aligned), ("Three sweeps as measured", "In the first one's coordinates"), strict=True
):
    for label, colour, name in ((2, "C1", "found to move"), (1, "C0", "found to stand still")):
        for number, path in enumerate(torch.stack(views, dim=1)[found.labels == label]):
            panel.plot(*path[:, :2].T, "-o", color=colour, markersize=2.5, linewidth=0.8, label=name if number == 0 else None)
    panel.set(aspect="equal", title=title, xlim=(-4, 4), ylim=(-4, 4), xlabel="x (m)")
axes[1].legend(fontsize=8, loc="upper right")
plt.show()

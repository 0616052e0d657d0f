"""
A scene in which everything moves
=================================

Tracks of 3D points, each at its own constant velocity, before six uncalibrated cameras. A point whose position is
linear in some unknowns is a static point of a higher projective space; one tensor engine takes them all.
"""

import matplotlib.pyplot as plt
import torch

import dyntorch as dyn
from dyntorch import scenes

draw = torch.Generator().manual_seed(7)
scene = scenes.lifted_points("constant_velocity_3d", 120, views=6, static=0.4, sigma=0.5, outliers=0.05, generator=draw)
known = (scene.labels == 1) & (torch.rand(120, generator=draw) < 0.5)  # some points known to stand still
found = dyn.reconstruct(scene.tracks, "constant_velocity_3d", scene.times, static=known, threshold=1.5)
print(found)

# %%
# The result is known up to an affinity of the world; to show it beside the truth, the best affinity is applied.
truth, points = scene.points, found.points
lifted = torch.cat([points, torch.ones_like(points[:, :1])], dim=1)
affinity = torch.linalg.lstsq(lifted, truth).solution
placed = lifted @ affinity
steps = found.velocities @ affinity[:3]

figure = plt.figure(figsize=(8.8, 4.2))
left = figure.add_subplot(1, 2, 1)
for k in (0, 2, 5):
    left.scatter(*scene.tracks[k].T, s=6, label=f"view {k + 1}")
left.set(title="Tracks in three of six views (px)", aspect="equal")
left.invert_yaxis()
left.legend(fontsize=8)
right = figure.add_subplot(1, 2, 2, projection="3d")
still = found.labels == 1
right.scatter(*placed[still].T, s=12, color="C0", label="stand still")
right.scatter(*placed[~still].T, s=6, color="C1", label="move")
right.quiver(*placed[~still].T, *(2 * steps[~still]).T, color="C1", linewidth=0.8, arrow_length_ratio=0.2)
right.set(title="Found: points and velocities", xticklabels=[], yticklabels=[], zticklabels=[])
right.legend(fontsize=8)
plt.show()
print(f"median error of the positions: {100 * float((placed - truth).norm(dim=1).median() / truth.std()):.2f} % of the scene")

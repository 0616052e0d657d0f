"""
A road with cars, seen by a moving camera
=========================================

Three views of a plane. Some points belong to the plane and stand still, more of them move along straight lines, some
are mismatched, and nobody says which is which. One tensor ties the three views of every point together, whether it
moves or not.
"""

import matplotlib.pyplot as plt
import torch

import dyntorch as dyn
from dyntorch import scenes

draw = torch.Generator().manual_seed(4)
road = scenes.planar(n=120, sigma=0.5, static=0.4, outliers=0.15, generator=draw)
found = dyn.align_planar(*road.views, threshold=1.5, generator=draw)
print(found)


# %%
# All three views put together in the first one, by A and B.
def mapped(matrix, x):
    homogeneous = torch.cat([x, torch.ones_like(x[:, :1])], dim=1) @ matrix.mT
    return homogeneous[:, :2] / homogeneous[:, 2:]


first, second, third = road.views[0], mapped(found.A, road.views[1]), mapped(found.B, road.views[2])
figure, (left, right) = plt.subplots(1, 2, figsize=(8.4, 3.8), sharex=True, sharey=True)
for x, colour in zip(road.views, ("C0", "C1", "C2"), strict=True):
    left.scatter(*x.T, s=8, color=colour)
left.set(title="Three views as they are, in one frame", xlim=(-60, 700), ylim=(540, -60))
for label, colour, name in ((0, "0.75", "wrong match"), (2, "C1", "moved"), (1, "C0", "stood still")):
    chosen = found.labels == label
    if label == 2:
        for one, two, three in zip(first[chosen], second[chosen], third[chosen], strict=True):
            right.plot(*torch.stack([one, two, three]).T, color=colour, linewidth=1)
    right.scatter(*first[chosen].T, s=10, color=colour, label=f"{name} ({int(chosen.sum())})")
right.set(title="Put together by A and B")
right.legend(fontsize=8, loc="upper center", bbox_to_anchor=(0.5, -0.07), ncol=3)
plt.show()

"""
Which match moves with which body
=================================

Matches of two images of three bodies, a fifth of them wrong. Nobody says how many bodies there are.
"""

import matplotlib.pyplot as plt
import torch

import dyntorch as dyn
from dyntorch import metrics, scenes

draw = torch.Generator().manual_seed(4)
scene = scenes.bodies((110, 80, 50), bodies=3, sigma=0.4, outliers=0.2, generator=draw)
found = dyn.segment(*scene.views, generator=draw)
print(found)
print(f"misclassified: {100 * float(metrics.misclassification(found.labels, scene.labels)):.1f} %")

# %%
# Given and found: every match as an arrow from the first image to the second.
x1, x2 = scene.views
figure, axes = plt.subplots(1, 2, figsize=(8.6, 3.8), sharex=True, sharey=True)
for panel, labels, title in ((axes[0], None, "Given: matches"), (axes[1], found.labels, "Found: bodies and wrong matches")):
    for body in range(1 if labels is None else 4):
        chosen = torch.ones(len(x1), dtype=torch.bool) if labels is None else labels == body
        colour = "0.4" if labels is None else "0.8" if body == 0 else f"C{body - 1}"
        name = None if labels is None else "wrong" if body == 0 else f"body {body}"
        step = x2[chosen] - x1[chosen]
        panel.quiver(*x1[chosen].T, *step.T, angles="xy", scale_units="xy", scale=1, color=colour, width=0.003, label=name)
    panel.set(aspect="equal", title=title, xlim=(0, 640), ylim=(480, 0))
axes[1].legend(fontsize=8, loc="upper center", bbox_to_anchor=(0.5, -0.07), ncol=4)
plt.show()

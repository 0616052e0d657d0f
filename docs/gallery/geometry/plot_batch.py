"""
A thousand problems at once, with gradients
===========================================

Every verb takes leading batch dimensions and gives what a loop would. Here: how the accuracy of a motion grows with
the number of matches, of 60 scenes each in one call, from the linear solution and refined. Then a gradient through
the estimate.
"""

import matplotlib.pyplot as plt
import torch

import dyntorch as dyn
from dyntorch import metrics, scenes

COUNTS = (26, 35, 50, 100, 200, 500)
linear, refined = [], []
for n in COUNTS:
    scene = scenes.planar(n=n, batch=60, sigma=0.5, generator=torch.Generator().manual_seed(n))  # everything moves
    solution = dyn.fit(dyn.HomographyTensor, *scene.views)
    for kept, one in ((linear, solution), (refined, dyn.refine(solution, *scene.views))):
        error = metrics.grid_transfer_error(one.motion[0], scene.motion[0], 640, 480)
        kept.append(float(error.median()))

figure, axes = plt.subplots()
axes.loglog(COUNTS, linear, "s--", label="linear (null space)")
axes.loglog(COUNTS, refined, "o-", label="refined (maximum likelihood)")
axes.set(xlabel="matches", ylabel="median error over the image (px)", xticks=COUNTS, xticklabels=COUNTS)
axes.set_title("Camera motion from points that all move, 0.5 px of noise")
axes.minorticks_off()
axes.legend()
plt.show()

# %%
# The estimate is differentiable: which matches pull the motion where?
scene = scenes.planar(n=60, sigma=0.5, generator=torch.Generator().manual_seed(1))
x1, x2, x3 = (view.clone().requires_grad_() for view in scene.views)
A = dyn.fit(dyn.HomographyTensor, x1, x2, x3).motion[0]
centre = torch.tensor([320.0, 240.0, 1.0], dtype=A.dtype)
mapped = A @ centre
(mapped[0] / mapped[2]).backward()  # where the middle of view 2 is in view 1, horizontally
pull = x1.grad.norm(dim=1)
figure, axes = plt.subplots(figsize=(6, 4))
dots = axes.scatter(*scene.views[0].T, c=pull, s=40, cmap="viridis")
figure.colorbar(dots, label="px of the result per px of the match")
axes.set(aspect="equal", title="How much each match decides where the middle goes")
axes.invert_yaxis()
plt.show()

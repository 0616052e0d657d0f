"""
Wrong matches
=============

Sixteen scenes at every share of wrong matches, in which everything that is right moves. `robust_fit` takes any
invariant; here the homography tensor. A scene counts as found where 95 % of the right matches are inliers.
"""

import matplotlib.pyplot as plt
import torch

import dyntorch as dyn
from dyntorch import scenes

SHARES = (0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6)
found, seconds = [], []
for share in SHARES:
    draw = torch.Generator().manual_seed(1)
    scene = scenes.planar(n=200, batch=16, sigma=0.5, outliers=share, generator=draw)
    solution = dyn.robust_fit(dyn.HomographyTensor, *scene.views, threshold=1.5, generator=draw)
    right = scene.labels != 0
    recall = (solution.inliers & right).sum(-1) / right.sum(-1)
    wrong = (solution.inliers & ~right).sum(-1) / solution.inliers.sum(-1).clamp(min=1)
    found.append((float((recall > 0.95).double().mean()), float(recall.mean()), float(wrong.mean())))

figure, axes = plt.subplots()
axes.plot(SHARES, [one[0] for one in found], "o-", label="scenes found")
axes.plot(SHARES, [one[1] for one in found], "s--", label="right matches kept")
axes.plot(SHARES, [one[2] for one in found], "^:", label="wrong ones among the inliers")
axes.set(xlabel="share of wrong matches", ylim=(-0.03, 1.05), title="Homography tensor, everything moving, 0.5 px of noise")
axes.legend(loc="center left")
plt.show()

"""
Planes that translate by themselves
===================================

Patches of eight planes, each translating by itself, in two views of an uncalibrated camera. What they share is the
homography at infinity, and with it the affine scene. More planes tell it better.
"""

import matplotlib.pyplot as plt
import torch

import dyntorch as dyn
from dyntorch import metrics, scenes

PLANES, SCENES = (3, 4, 5, 6, 8), 24
alone, with_matches = [], []
for planes in PLANES:
    scene = scenes.translating_planes(planes, batch=SCENES, sigma=0.5, generator=torch.Generator().manual_seed(planes))
    given = dyn.fit(dyn.Collineation(2), scene.x2, scene.x1).tensor  # a homography for each plane: view 1 to view 2
    for results, found in (
        (alone, dyn.translating_planes(given)),
        (with_matches, dyn.translating_planes(x1=scene.x1, x2=scene.x2)),
    ):
        errors = metrics.relative_error(found.homography_at_infinity, scene.infinity)
        results.append(float(errors.median()))

figure, axes = plt.subplots()
axes.semilogy(PLANES, alone, "s--", label="from the homographies alone")
axes.semilogy(PLANES, with_matches, "o-", label="with the matches (maximum likelihood)")
axes.set(xlabel="planes", ylabel="relative error, median", xticks=PLANES, title="Homography at infinity, 0.5 px of noise")
axes.legend()
plt.show()

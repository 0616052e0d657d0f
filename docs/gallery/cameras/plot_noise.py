"""
How sure, and when it refuses
=============================

Eight takes at every level of noise, four seconds each. Solid: the error, which the error bar predicts. Where the
motion drowns in the noise, the pair is refused, and is not counted as an answer.
"""

import matplotlib.pyplot as plt
import numpy as np
import torch

import dyntorch as dyn
from dyntorch import scenes

LEVELS, TAKES = (1.0, 3.0, 8.0, 20.0, 40.0), 8
errors, bars, answered = [], [], []
for level in LEVELS:
    found = []
    for seed in range(TAKES):
        scene = scenes.filmed_person(15, 4.0, offset=0.31, noise=level, generator=torch.Generator().manual_seed(seed))
        shift = dyn.synchronize(scene.a, scene.b, fps=scene.fps)
        found.append((30 * abs(shift.offset - 0.31), 30 * shift.sigma, shift.ok))
    error, bar, ok = map(np.array, zip(*found, strict=True))
    errors.append(np.median(error[ok]) if ok.any() else np.nan)
    bars.append(np.median(bar[ok]) if ok.any() else np.nan)
    answered.append(ok.mean())

figure, (left, right) = plt.subplots(1, 2)
left.loglog(LEVELS, errors, "o-", label="median error of what was answered")
left.loglog(LEVELS, bars, "s--", label="error bar (one sigma)")
left.set(xlabel="noise of a keypoint (px; the person is 300 px tall)", ylabel="frames", title="Error of the shift")
left.legend(fontsize=8)
right.bar(range(len(LEVELS)), answered)
right.set(xticks=range(len(LEVELS)), xticklabels=[f"{level:g}" for level in LEVELS], ylim=(0, 1.05))
right.set(xlabel="noise (px)", ylabel="share", title="Called ok")
plt.show()

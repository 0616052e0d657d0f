"""
Synthetic people
================

What the demo, the examples and many tests are made of: thirteen actions, people who differ in build and manner, and a
detector that errs, from :mod:`indexing.actors`. Each row is one performance by another person.
"""

import matplotlib.pyplot as plt
import numpy as np

from indexing.actors import ACTIONS, Person, detect, perform

figure, axes = plt.subplots(7, 2, figsize=(8, 9.6))
for number, (action, panel) in enumerate(zip(ACTIONS, axes.T.flat, strict=False)):
    clip = detect(perform(action, Person.random(number), rng=number), azimuth=35, rng=number, outliers=0.0, dropout=0.0)
    chosen = np.linspace(0, len(clip) - 1, 8).round().astype(int)
    width = 1.15 * np.ptp(clip.joints[..., 1])
    for step, frame in enumerate(chosen):
        joints = clip.joints[frame] + [0.55 * width * step, 0]
        for a, b in clip.skeleton.bones:
            panel.plot(*joints[[a, b]].T, color=plt.cm.viridis(step / 9), linewidth=1.4, solid_capstyle="round")
    panel.set(aspect="equal", title=f"{action.replace('_', ' ')} ({clip.duration:.1f} s)")
    panel.invert_yaxis()
    panel.axis("off")
axes.T.flat[-1].axis("off")
plt.show()

# %%
# Keypoints are in pixels, y down, as detectors write them. `detect` adds noise, gaps and wrong joints; here the
# last two are off.

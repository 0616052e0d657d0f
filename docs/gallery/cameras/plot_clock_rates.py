"""
Clocks that do not run alike
============================

Two cameras say 30 frames per second, but one of them runs 400 millionths fast: after a minute it is most of a frame
off. The rate is found with the offset.
"""

import matplotlib.pyplot as plt
import torch

import dyntorch as dyn
from dyntorch import scenes

RATE = 1.0004
scene = scenes.filmed_person(15, 60.0, offset=0.40, rate=RATE, noise=2.0, generator=torch.Generator().manual_seed(2))
free = dyn.synchronize(scene.a, scene.b, fps=scene.fps)
fixed = dyn.synchronize(scene.a, scene.b, fps=scene.fps, rate=1.0)
print(free)

# %%
# The error of the clock, in frames, over the take.
times = torch.linspace(0, 60, 200, dtype=torch.float64)
truth = times * RATE + 0.40
figure, axes = plt.subplots()
axes.plot(times, 30 * (fixed.at(times) - truth), "--", color="C3", label="rate said to be 1")
axes.plot(times, 30 * (free.at(times) - truth), label=f"rate found: {1e6 * (free.rate - 1):+.0f} ± {1e6 * free.rate_sigma:.0f} ppm")
axes.axhline(0, color="0.8", linewidth=1, zorder=0)
axes.set(xlabel="time of the first camera (s)", ylabel="error (frames)", title="One clock runs 400 ppm fast")
axes.legend()
plt.show()

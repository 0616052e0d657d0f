"""
The one linear relation
=======================

Two cameras that watch one performance see two images of one shape in space and time, and the four coordinates of each
point fulfil one linear relation. So the largest canonical correlation of the two images is 1, whatever the angle
between the cameras; that of another action is not.
"""

import matplotlib.pyplot as plt
import numpy as np
import torch

from dyntorch import numerics
from indexing.actors import Person, detect, perform

LENGTH = 40


def image(action, azimuth, person):
    """The plane that the centred coordinates of all joints in all frames span, as a basis ``(frames * joints, 2)``."""
    clip = detect(perform(action, person), azimuth=azimuth, noise=0.0, dropout=0.0, outliers=0.0, distance=20.0)
    frames = np.linspace(0, len(clip) - 1, LENGTH).round().astype(int)  # every performance in as many frames
    points = torch.from_numpy(clip.joints[frames].reshape(-1, 2).copy())
    return numerics.orthonormal_basis(points - points.mean(0))


def residual(a, b):
    """One minus the largest cosine between the planes that the coordinates span."""
    return 1 - float(numerics.canonical_correlation(a[None], b[None]))


# %%
# The example: a squat by one person, seen from 0 degrees. Asked: the same performance, another person's, and other
# actions.
example = image("squat", 0.0, Person.random(1))
turns = np.arange(0, 181, 15)
figure, axes = plt.subplots()
for label, action, person in (
    ("the same performance", "squat", Person.random(1)),
    ("squat by another person", "squat", Person.random(5)),
    ("jumping jack", "jumping_jack", Person.random(5)),
    ("kick", "kick", Person.random(5)),
):
    axes.plot(turns, [residual(example, image(action, float(turn), person)) + 1e-7 for turn in turns], label=label)
axes.set(yscale="log", xlabel="second camera turned by (degrees)", ylabel="what the relation leaves unexplained", xticks=turns[::2])
axes.set_title("A squat seen from 0 degrees, against what a second camera sees")
axes.legend(loc="lower center", ncol=2)
plt.show()

# %%
# The cameras are 20 m away, nearly affine, so the same performance has a residual near zero at every angle. Whoever
# else squats violates the relation, but less than who does something else. `indexing` adds up such evidence over
# several ways of centring and several tempi.

"""
Two cameras, started by hand
============================

The same person, seen from 0 and from 70 degrees; the second camera was started 17 frames late. The keypoints alone
say how far the clocks are apart.
"""

import matplotlib.pyplot as plt
import numpy as np

from indexing import synchronize
from indexing.actors import Person, detect, stream

LATE = 17
scene, _ = stream(["squat", "kick", "wave"], Person.random(3), fps=30, rng=1)
a, b = (detect(scene, azimuth=azimuth, rng=azimuth) for azimuth in (0, 70))
b = b.joints[LATE:]
shift = synchronize(a.joints, b, fps=30)
print(shift)

# %%
# The score over all shifts has one peak. Below: the same frame numbers, and the same moments.
figure = plt.figure(figsize=(8, 5.4))
grid = figure.add_gridspec(2, 4, height_ratios=(1, 1.25))
curve = figure.add_subplot(grid[0, :])
curve.plot(shift.lags, shift.scores)
curve.axvline(shift.offset, color="C1", linewidth=1, label=f"{shift.offset:+.4f} ± {shift.sigma:.4f} s (truth {-LATE / 30:+.4f})")
curve.set(xlabel="offset (s)", ylabel="score", title="Score of every shift")
curve.legend(loc="upper right")
whole = [f for f in range(100, 200) if np.isfinite([a.joints[f], b[f], b[round(f + shift.frames)]]).all()]
# no joint is missing, and much happens until camera 2 sees the moment
frame = max(whole, key=lambda f: np.abs(b[f] - b[round(f + shift.frames)]).max())
late = round(frame + shift.frames)
seen = ((1, frame, a.joints), (2, frame, b), (1, frame, a.joints), (2, late, b))
moments = [(f"camera {camera}, frame {number}", joints[number]) for camera, number, joints in seen]
for number, (title, joints) in enumerate(moments):
    panel = figure.add_subplot(grid[1, number])
    for one, other in a.skeleton.bones:
        panel.plot(*joints[[one, other]].T, color="C0" if number % 2 == 0 else "C1", solid_capstyle="round")
    panel.set(aspect="equal")
    panel.set_title(title, fontsize=9)
    panel.invert_yaxis()
    panel.axis("off")
plt.show()

"""
From pixels alone
=================

No pose estimator: three actions learned from one film each, and asked of another person in other clothes before
another background. The camera stands where it stood.
"""

import matplotlib.pyplot as plt
import numpy as np

from indexing import BrightnessIndexer
from indexing.actors import Person, dataset
from indexing.actors.textured import render_clip

ACTIONS = ["squat", "jumping_jack", "kick"]
solid = [dataset([Person.random(person)], ACTIONS, azimuth=None, fps=15.0, rng=person) for person in (1, 2)]
shown, asked = ([render_clip(clip, azimuth=0, rng=i + 10 * k) for i, clip in enumerate(clips)] for k, clips in enumerate(solid))
indexer = BrightnessIndexer(fps=15.0).fit(shown, ACTIONS)
print(indexer.predict(asked))

# %%
# The scores of every frame know nothing of later frames. Above each curve a frame of the film learned from, and one
# of the film asked about.
figure = plt.figure(figsize=(8.4, 4.6))
grid = figure.add_gridspec(2, 6, height_ratios=(1, 1.6))
for number, frames in enumerate((shown[0], asked[0], shown[1], asked[1], shown[2], asked[2])):
    panel = figure.add_subplot(grid[0, number])
    panel.imshow(frames[len(frames) // 2], cmap="gray")
    panel.set_title("learned" if number % 2 == 0 else "asked", fontsize=9)
    panel.axis("off")
for number, (action, frames) in enumerate(zip(ACTIONS, asked, strict=True)):
    panel = figure.add_subplot(grid[1, 2 * number : 2 * number + 2])
    for label, score in zip(indexer.classes_, indexer.score_frames(frames).T, strict=True):
        panel.plot(np.arange(len(frames)) / 15, score, label=label.replace("_", " "))
    panel.set(title=action.replace("_", " "), xlabel="time (s)", ylim=(0, 1))
    if number == 0:
        panel.set_ylabel("score")
        panel.legend(fontsize=8, loc="lower right")
plt.show()

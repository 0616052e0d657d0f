"""
One clip for each action
========================

Six actions, shown once by one person to one camera. Eight other people are asked about, from all sides. The
comparison is with the nearest example by plain 2D distance, which falls off as the camera turns.
"""

import matplotlib.pyplot as plt
import numpy as np

from indexing import ActionIndexer
from indexing.actors import Person, dataset

ACTIONS = ["squat", "lunge", "jumping_jack", "kick", "wave", "throw"]
lesson = dataset([Person.random(1)], ACTIONS, azimuth=0, rng=0)  # six clips of 2D keypoints with a detector's errors
indexer = ActionIndexer().fit(lesson, lesson.labels)


# %%
# The baseline: every clip brought to 16 frames, centred and scaled.
def flat(clip):
    frames = np.linspace(0, len(clip) - 1, 16).round().astype(int)
    joints = np.nan_to_num(clip.joints[frames] - np.nanmean(clip.joints, axis=(0, 1)))
    return (joints / np.linalg.norm(joints)).ravel()


def nearest(clips):
    examples = np.array([flat(clip) for clip in lesson])
    return lesson.labels[np.argmax([[flat(clip) @ example for example in examples] for clip in clips], axis=1)]


# %%
# Asked from every 30 degrees.
turns = np.arange(0, 181, 30)
ours, plain = [], []
for turn in turns:
    asked = dataset([Person.random(seed) for seed in range(2, 10)], ACTIONS, azimuth=float(turn), rng=int(turn) + 1)
    ours.append(np.mean(indexer.predict(asked) == asked.labels))
    plain.append(np.mean(nearest(asked) == asked.labels))

figure, axes = plt.subplots()
axes.plot(turns, ours, "o-", label="dyntorch")
axes.plot(turns, plain, "s--", label="2D nearest neighbour")
axes.axhline(1 / len(ACTIONS), color="0.7", linewidth=1)
axes.text(180, 1 / len(ACTIONS) + 0.02, "chance", ha="right", color="0.5")
axes.set(xlabel="camera turned by (degrees)", ylabel="clips right", ylim=(0, 1.03), xticks=turns, title="Other people, other sides")
axes.legend(loc="center left")
plt.show()

# %%
# These are actors, who differ in build, tempo and size of movement, and the keypoints have a detector's noise and
# gaps. On recorded people one example of each of ten actions is right in .85 from the same side and in .80 from 90
# degrees.

"""
How far an action has got, from single frames
=============================================

`PhaseIndexer` judges every frame from itself alone, and each frame may come from another camera. It says which action
the frame is from, and how much of it is done.
"""

import matplotlib.pyplot as plt

from indexing import PhaseIndexer
from indexing.actors import Person, detect, perform

people, names = [Person.random(seed) for seed in range(3)], ["walk", "sit_down", "kick"]
train = [detect(perform(name, person, rng=i), azimuth=40.0 * i, rng=i) for i, person in enumerate(people) for name in names]
indexer = PhaseIndexer().fit(train)  # nobody says where in its action a frame is

figure, axes = plt.subplots(1, 2, sharey=True)
for panel, action in zip(axes, ("sit_down", "walk"), strict=True):
    asked = detect(perform(action, Person.random(9), rng=9), azimuth=60.0, rng=9)  # another person, another camera
    scores, phase = indexer.analyse(asked)  # (frames, actions) each
    said = scores.argmax(axis=1)
    column = list(indexer.classes_).index(action)
    right = said == column
    if action == "sit_down":
        panel.plot([0, 1], [0, 1], color="0.8", label="steadily")
    panel.scatter((asked.times / asked.times[-1])[right], phase[right, column], s=14, label="frame taken for the right action")
    panel.scatter((asked.times / asked.times[-1])[~right], phase[~right, column], s=18, marker="x", label="for another one")
    panel.set(xlabel="share of the clip that has passed", title=action.replace("_", " "))
axes[0].set_ylabel("phase found")
axes[0].legend(fontsize=8)
plt.show()

# %%
# Walking repeats itself: its phase runs from 0 to 1 with every double step. What looks alike in one frame stays
# alike: who stands before sitting down might as well be about to walk.

"""
Actions in a long recording
===========================

A model of four actions, one clip each; a recording of another person, camera turned by 70 degrees. Above what really
happened, below what was found, and the evidence for every action over time.
"""

import matplotlib.pyplot as plt

from indexing import ActionIndexer
from indexing.actors import Person, dataset, detect, stream

ACTIONS = ["squat", "lunge", "jumping_jack", "kick"]
lesson = dataset([Person.random(1)], ACTIONS, azimuth=0, rng=0)
indexer = ActionIndexer().fit(lesson, lesson.labels)
order = ["lunge", "squat", "kick", "jumping_jack", "squat", "kick", "lunge"]
solid, truth = stream(order, Person.random(2), rng=3)
session = detect(solid, azimuth=70, rng=3)
events = indexer.find(session)
for event in events:
    print(f"{event.label:13s} {event.start:5.1f} to {event.end:5.1f} s, score {event.score:.1f}, margin {event.margin:.1f}")

# %%
# The score of an event is the evidence averaged over its time; its margin how far that is above the next best
# action.
colours = {label: f"C{i}" for i, label in enumerate(indexer.classes_)}
figure, (bars, curves) = plt.subplots(2, height_ratios=(1, 2), sharex=True, figsize=(8, 4.6))
found = [(event.label, event.start, event.end) for event in events]
for row, spans in enumerate((truth, found)):
    for label, start, end in spans:
        bars.barh(1 - row, end - start, left=start, height=0.7, color=colours[label])
        bars.text((start + end) / 2, 1 - row, label.replace("_", "\n"), ha="center", va="center", color="white", fontsize=7.5)
bars.set(yticks=(0, 1), yticklabels=("found", "truth"), title="What happened, and what was found")
for label, score in zip(indexer.classes_, indexer.score_frames(session).T, strict=True):
    curves.plot(session.times, score, color=colours[label], label=label)
curves.set(xlabel="time (s)", ylabel="evidence", xlim=(0, session.times[-1]))
curves.legend(ncol=4, loc="upper center", bbox_to_anchor=(0.5, -0.22))
plt.show()

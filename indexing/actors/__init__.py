"""Synthetic people: articulated bodies that perform everyday actions, and what a keypoint detector would see of them.

For the demo and for tests: plausible joint-angle curves, no recorded data.  A :class:`Person` has proportions and habits,
:func:`perform` gives one action as a 3D clip, :func:`stream` several in a row with their true intervals, :func:`detect` the noisy
2D keypoints in a camera anywhere around the person, :func:`dataset` all of it for several people and cameras.
Everything is deterministic given the seed.

Example:
    >>> from indexing.actors import Person, detect, perform
    >>> person = Person.random(7)
    >>> front = detect(perform("jumping_jack", person, rng=1), azimuth=0.0, rng=2)
    >>> front.label, front.dims, front.up
    ('jumping_jack', 2, '-y')
"""

from indexing.actors.body import Person
from indexing.actors.detector import detect
from indexing.actors.perform import ACTIONS, dataset, perform, stream

__all__ = ["ACTIONS", "Person", "dataset", "detect", "perform", "stream"]

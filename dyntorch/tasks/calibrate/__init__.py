"""calibrate: cameras, lenses, clocks and the movement in space, from the people in view.

``calibrate`` says the stages; ``input`` checks what is given, ``observations`` reads tracks at common moments, ``averaging`` makes
first cameras from the pairs' epipolar geometry, ``adjusting`` and ``adjustment`` make them the best ones, with ``bones`` that stay
as long as they are; ``structure`` holds the points of every frame, ``world`` what is up and how long a metre is, ``diagnosis``
what the data leave open.
"""

"""calibrate: cameras, lenses, clocks and the movement in space, from the people in view.

``calibrate`` says the stages; ``input`` checks what is given, ``observations`` reads tracks at common moments, ``averaging`` makes
first cameras from the pairs' epipolar geometry, ``bundle`` adjusts them and the points of every frame, ``bundle_problem`` is what
it minimizes; ``world_frame`` holds what is up and how long a metre is, ``diagnosis`` what the data leave open.
"""

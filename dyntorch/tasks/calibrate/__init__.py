"""calibrate: cameras, lenses, clocks and the movement in space, from the people in view.

``calibrate`` says the stages, and what the data leave open; ``input`` checks what is given and reads tracks at common moments,
``averaging`` makes first cameras from the pairs' epipolar geometry, ``bundle`` adjusts them and the points of every frame,
``world_frame`` holds what is up and how long a metre is.
"""

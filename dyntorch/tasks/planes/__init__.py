"""translating_planes: cameras, bodies and planes from homographies of planes that translate independently.

``planes`` holds the verb and its result, ``input`` what it is given, ``closed_forms`` the thesis's solutions, ``problem`` the
refinement over matches, ``notices`` what the data cannot tell.
"""

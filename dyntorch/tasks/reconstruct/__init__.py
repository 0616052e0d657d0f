"""reconstruct: cameras, points and velocities from tracks of points that all move.

``motions`` declares how points may move; ``reconstruct`` holds the verb, ``solver`` its stages for one motion (``projections``
from the Grassmann tensor, ``scene`` from the projections), ``robust`` the search among wrong tracks, ``diagnosis`` what is not
determined. ``factorization`` holds the thesis's cross-checks.
"""

"""synchronize, synchronize_cameras: the clocks of cameras from what they see.

``synchronize`` is the verb for two cameras and its stages; ``tracks`` reads and smooths what is given.  ``same_points``
searches the shift of corresponding points with the scores of ``epipolar`` (or of ``motion_capture``) and the tests of
``evidence``; ``different_points`` does it without correspondence, by ``subspace`` and ``row_spaces``; ``projective`` by the
motion of a ``rigid_body``.  ``cameras`` puts more than two on one clock, ``breaks`` finds offsets that jump
(``piecewise_offset``).
"""

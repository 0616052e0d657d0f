"""synchronize, synchronize_cameras: the clocks of cameras from what they see.

``synchronize`` holds the verb for two cameras and its stages, ``tracks`` what is given, ``epipolar`` the score of a shift for
corresponding points, ``evidence`` how sure it is; ``different`` and ``subspace`` do it without correspondence; ``cameras`` puts
more than two on one clock.
"""

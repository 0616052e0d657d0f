"""Recordings on one clock, from files, clips, arrays and videos: keypoints, point tracks, or brightness alone.

``synchronize`` is the verb, and finds the breaks of clocks of cameras that lost frames; ``recordings`` reads what is given,
``people`` pairs the persons of two cameras.  ``brightness`` compares videos without points by ``brightness_features``, ``sound``
what their microphones heard.  ``calibration``, ``files`` and ``pose2sim`` read and write what other tools need, ``trimming`` cuts
the videos.
"""

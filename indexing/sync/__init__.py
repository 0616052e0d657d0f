"""Recordings on one clock, from files, clips, arrays and videos: keypoints, point tracks, or brightness alone.

``synchronize`` is the verb; ``recordings`` reads what is given, ``people`` pairs the persons of two cameras.  ``brightness``
compares videos without points by ``brightness_features``, ``sound`` what their microphones heard; ``breaks`` mends clocks of
cameras that lost frames.  ``calibration``, ``files`` and ``pose2sim`` read and write what other tools need, ``trimming`` cuts
the videos.
"""

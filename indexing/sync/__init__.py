"""Recordings on one clock, from files, clips, arrays and videos: keypoints, point tracks, or brightness alone.

``synchronize`` holds the verb; ``takes`` reads what is given, ``people`` pairs the persons of two cameras, ``calibration`` and
``files`` read and write what others' tools need, ``brightness`` compares videos without points, by the measurements of
``gray``.
"""

"""Recordings on one clock, from files, clips, arrays and videos: keypoints, point tracks, or brightness alone.

``synchronize`` holds the verb; ``takes`` reads what is given, ``people`` pairs the persons of two cameras, ``calibration`` and
``files`` read and write what others' tools need, ``trial`` those of Pose2Sim, ``trimming`` cuts the videos; ``brightness`` compares
videos without points, by the measurements of ``gray``, ``sound`` what ``listening`` hears in them; ``breaking`` mends clocks of
cameras that lost frames.
"""

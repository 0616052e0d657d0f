"""Actions learned from one to a few examples of keypoints, and found in other recordings, from other viewpoints.

``indexer`` is the estimator; ``inputs`` checks what it is given, ``bank`` compares windows by space-time subspaces, ``exemplars``
makes the windows of the examples, ``learning`` builds the ``model`` that scores, ``joint_weights`` learns which joints matter,
``background`` makes what is not the action, ``stream`` scores long recordings.
"""

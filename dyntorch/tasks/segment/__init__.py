"""segment: which matches of two views, or tracks of a video, move together, and how.

``segment`` is the verb for two views: ``coherence`` links neighbours, ``search`` looks for bodies by their ``energy``, ``labels``
labels all matches.  ``tracks`` is the verb for a whole video: ``frame_pairs`` selects the pairs of frames that are compared,
``residual_kernel`` measures which tracks move alike, ``agglomeration`` cuts them into pieces and merges these to bodies,
``track_energy`` improves labels and geometries together.  ``result`` and ``options`` are of both; ``affine`` is the thesis's
segmentation before affine cameras.
"""

"""segment: which matches of two views, or tracks of a video, move together, and how.

``segment`` is the verb for two views: ``coherence`` links neighbours and says what a segmentation costs, ``search`` looks for
bodies of least cost, ``labels`` labels all matches.  ``tracks`` is the verb for a whole video: ``frame_pairs`` selects the pairs
of frames that are compared, ``agglomeration`` measures which tracks move alike, cuts them into pieces and merges these to bodies,
``track_energy`` improves labels and geometries together.  ``result`` is of both; ``affine`` is the thesis's segmentation before
affine cameras.
"""

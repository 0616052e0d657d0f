"""segment: which matches of two views move together, and how.

``segment`` holds the verb and its stages in order: the matches (``coherence`` links neighbours), the ``search`` for bodies by
their ``energy``, the ``labels``, the ``result``.  ``affine`` is the thesis's segmentation before affine cameras.
"""

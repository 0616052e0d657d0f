"""An archive of movements on disk: a thousand hours of recordings, searched by example or by a learned model in seconds.

``archive`` is the face (:class:`Archive`), ``results`` what it answers, ``options`` every number that decides.  ``sources`` reads
what is added, ``tracks`` is the movement as it is stored, ``layout`` the joints and the codes of poses, ``segments`` the files,
``catalogue`` what is in them, ``workers`` whoever does the work.  The verbs are ``adding``, ``searching`` (an example of
``queries``, compared by ``sketches``, then exactly by ``comparing``), ``finding`` and ``verifying``.
"""

"""An archive of movements on disk: a thousand hours of recordings, searched by example or by a learned model in seconds.

``archive`` is the face (:class:`Archive`).  ``sources`` reads what is added, ``tracks`` is movement as it is stored, with the
joints and the codes of poses, ``segments`` the files, ``catalogue`` what is in them, ``workers`` who does the work.  ``writer``
adds, merges and verifies; ``search`` compares an example by ``sketches``, then exactly; ``actions`` finds those of a learned model.
"""

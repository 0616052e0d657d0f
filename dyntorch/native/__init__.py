"""The kernel in C below null spaces and recognition, optional: the torch path is its reference and stands in for it.

``kernel.c`` and ``recognition.c`` are compiled when the package is installed, where there is a C compiler (``build``); ``library``
loads them and hands tensors to them, ``recognition`` those of windows and sightings.
"""

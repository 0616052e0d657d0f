"""The kernel in C below null spaces, optional: the torch path is its reference and stands in for it.

``kernel.c`` is compiled when the package is installed, where there is a C compiler (``build``); ``library`` loads it and hands
tensors to it.
"""

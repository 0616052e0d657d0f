"""Knows matrices and numbers only, no camera and no point: null spaces, least squares, subspaces, time lags, quantiles.

Everything here is batched over leading dimensions and computes in float64.  ``nullspace`` is the only place where null spaces
are solved, ``least_squares`` holds the one Levenberg-Marquardt, ``blocks`` cuts batches into pieces that fit the cache and
gives each to a thread, ``arguments`` checks what a function was given and where it computes.
"""

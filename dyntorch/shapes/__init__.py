"""Shapes of points seen by uncalibrated cameras, every view by another one: standing still (``static``), or moving in time.

``basis`` says how a point may move, ``moving`` finds the shapes, ``times`` when a new view was taken; ``theory`` holds what the
thesis proves of dynamic shape tensors and nothing else needs.
"""

"""align_planar, align_points, align_lines: the motion of a camera or sensor, and what stood still.

A file for each kind of scene; ``labelling`` tells static, moving and mismatched points apart, ``result`` is what all of them
return.
"""

"""
How many matches are enough, exactly
====================================

The rank of the estimation matrix while matches arrive, counted in a prime field: no rounding, no threshold. A tensor
is determined when all but one dimension are filled.
"""

import matplotlib.pyplot as plt

import dyntorch as dyn

figure, axes = plt.subplots(figsize=(8, 4))
cases = {
    "points of a plane that move": dyn.counting.count("homography", moving=34),
    "... first 12 that stand still, unknown to us": dyn.counting.count("homography", static=12, moving=24),
    "... 4 known to stand still, then moving ones": dyn.counting.count("homography", labelled_static=4, moving=8),
}
for name, counted in cases.items():
    ranks = [0, *counted.profile]
    axes.step(range(len(ranks)), ranks, where="post", label=f"{name}: {counted.rank} of {counted.width}")
    print(counted, end="\n\n")
axes.axhline(26, color="0.85", linewidth=1, zorder=0)
axes.set(xlabel="matches", ylabel="rank", title="Homography tensor: rank while matches arrive (grey: one tensor is left)")
axes.legend(fontsize=8, loc="lower right")
plt.show()

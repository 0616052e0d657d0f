"""
The time of a moving shape, from one view
=========================================

Thirteen points that go through a cycle, seen once at each of sixty phases, every view by another uncalibrated camera:
no two views show the same pose. What is learned is how the points move. A single new view then tells its phase.
"""

import matplotlib.pyplot as plt
import torch

import dyntorch as dyn

g = torch.Generator().manual_seed(0)
phase = 6.28 * torch.rand(160, generator=g).double()
still, c, s = torch.randn(3, 13, 3, generator=g).double() * torch.tensor([1, 0.4, 0.4]).reshape(3, 1, 1)
pose = still + phase.cos()[:, None, None] * c + phase.sin()[:, None, None] * s
x = pose @ torch.randn(160, 3, 2, generator=g).double()  # another camera for every view
x = x + 0.02 * torch.randn(x.shape, generator=g).double()

walk = dyn.fit(dyn.DynamicShapeTensor(dyn.Fourier(1)), *x[:60].unbind(1), times=phase[:60]).check()
seen = walk.invariant.recover(walk.tensor, *x[60:].unbind(1))
other = walk.invariant.score(walk.tensor, *torch.randn(13, 100, 2, generator=g).double())

# %%
# A hundred new views: the phase found, and how much the shape leaves unexplained.
figure, (left, right) = plt.subplots(1, 2)
left.plot([0, 6.28], [0, 6.28], color="0.8")
left.scatter(phase[60:], seen.times, s=12)
left.set(xlabel="true phase (rad)", ylabel="found from one view", aspect="equal", title="Phase of 100 new views")
bins = torch.logspace(-6, 0, 40).numpy()
right.hist(seen.residual.numpy(), bins, label="views of the shape")
right.hist(other.numpy(), bins, label="views of other shapes")
right.set(xscale="log", xlabel="unexplained share", title="Is it this shape at all?")
right.legend(fontsize=8)
plt.show()

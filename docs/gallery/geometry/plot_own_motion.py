"""
A motion of your own
====================

Things in free fall: two constant velocities across, and along the vertical an acceleration that differs from thing to
thing (balls and feathers). The motion is declared by its lift B(t): the position at time t is B(t) times the unknowns
of a point. Everything else follows: how many views and tracks are needed, the tensor, the cameras, the scene.
"""

import matplotlib.pyplot as plt
import torch

import dyntorch as dyn


def falling(t):
    """x = a + t b, y = c + t d, z = e + t^2 f, homogeneous: (4, 7)."""
    return torch.cat([torch.eye(4), t * torch.eye(4)[:, :2], t**2 * torch.eye(4)[:, 2:3]], dim=1)


motion = dyn.Motion(falling, "falling")
views, tracks = motion.minimal(range(8))
print(f"at least {views} views and {tracks} tracks; here 8 and 200")

# %%
# A scene, eight cameras around it, 0.3 px of noise.
draw = torch.Generator().manual_seed(3)
times = torch.arange(8, dtype=torch.float64)
unknowns = torch.randn(200, 7, generator=draw, dtype=torch.float64) * torch.tensor([2, 2, 1.5, 1, 0.15, 0.15, -0.03])
unknowns[:, 3] = 1.0
world = torch.stack([unknowns @ falling(float(t)).double().T for t in times])  # (views, n, 4)
turns = torch.linalg.matrix_exp(0.15 * (lambda w: w - w.mT)(torch.randn(8, 3, 3, generator=draw, dtype=torch.float64)))
places = torch.tensor([0.0, 0.0, 14.0]) + torch.randn(8, 3, generator=draw, dtype=torch.float64)
cameras = torch.cat([turns, places[..., None]], dim=2)
images = world @ cameras.mT
tracks = 700 * images[..., :2] / images[..., 2:]
tracks = tracks + 0.3 * torch.randn(tracks.shape, generator=draw, dtype=torch.float64)
found = dyn.reconstruct(tracks, motion, times)
print(found)

# %%
# The trajectories in two views, and how far each reprojected point is from its track.
figure, (left, right) = plt.subplots(1, 2, figsize=(8.4, 3.8))
for n in range(0, 200, 4):
    left.plot(*tracks[:, n].T, linewidth=0.8, color=f"C{n // 4 % 5}")
left.set(title="Tracks of every fourth thing (px)", aspect="equal")
left.invert_yaxis()
error = torch.stack([found.image(found.cameras[k], float(times[k])) - tracks[k] for k in range(8)]).norm(dim=-1)
right.hist(error.flatten().numpy(), 40)
right.set(xlabel="px", ylabel="observations", title="Distance of the reprojected points")
plt.show()

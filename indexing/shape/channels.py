"""Channels: the same window seen with different things taken away, each carrying its own evidence.

A window is ``(length, joints, 2)``.  ``clip`` keeps pose and motion, ``frame`` drops where the person is, ``motion`` drops
the pose, ``velocity`` keeps only change.  Measured and not useful: scaling every frame, frame-centred velocity or motion,
mean pose, acceleration.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

CHANNELS = ("clip", "frame", "motion", "velocity")


def channel(windows: Tensor, name: str) -> Tensor:
    """One channel of every window.

    Args:
        windows: ``(*batch, length, joints, dims)`` without NaN.
        name: one of :data:`CHANNELS`.

    Returns:
        ``(*batch, length or length - 2, joints, dims)``.

    Example:
        >>> import torch
        >>> still = torch.rand(5, 3, 2)[:1].expand(4, 3, 2)
        >>> bool(channel(still, "motion").abs().max() < 1e-6)
        True
    """
    if name == "clip":
        return windows - windows.mean(dim=(-3, -2), keepdim=True)
    if name == "frame":
        return windows - windows.mean(dim=-2, keepdim=True)
    if name == "motion":
        return windows - windows.mean(dim=-3, keepdim=True)
    if name == "velocity":
        return windows[..., 2:, :, :] - windows[..., :-2, :, :]
    raise ValueError(f"unknown channel {name!r}; known: {', '.join(CHANNELS)}")


def order_free(windows: Tensor, whole_image: bool = False) -> Tensor:
    r"""Three moments of the joints that forget when in the window something happened.

    With :math:`f_t` the frame-centred coordinates, :math:`m_t = f_t - \bar f` and :math:`v_t = f_{t+1} - f_t`, they are
    :math:`\sum_t f_t f_t^T`, :math:`\sum_t m_t m_t^T` and :math:`\sum_t v_t v_t^T`.

    Args:
        windows: ``(batch, length, joints, 2)``.
        whole_image: use both coordinates; otherwise heights alone, which a turn about the vertical leaves as they are.

    Returns:
        ``(3, batch, size * size)`` with size = joints, or 2 joints; not normalized.

    Source: covariance descriptors of joints, Hussein et al. 2013.
    """
    still = channel(windows, "frame")
    still = still.flatten(-2) if whole_image else still[..., 1]
    moving = still - still.mean(dim=-2, keepdim=True)
    change = still[..., 1:, :] - still[..., :-1, :]
    return torch.stack([(x.mT @ x).flatten(-2) for x in (still, moving, change)])


@dataclass(frozen=True)
class JointMetric:
    r"""How much each direction of joint space counts, per channel: :math:`W = (\Sigma + \lambda I)^{-\alpha}`.

    Sigma is the joints' covariance over all fitted windows, scaled to mean diagonal 1.  Head, neck and shoulders move as
    one and would be counted many times; a mild whitening (alpha 1/4) counts them once and lets hands speak.  W acts on
    the rows (joints) of both coordinates alike, so the rank conditions between views stay exact.
    """

    covariance: Tensor  # (channels, joints, joints), float64
    power: float

    FLOOR = 0.1  # lambda; .03 amplifies noise (-2 %), 1 whitens too little (-1 %) on UTKinect and Florence3D

    @classmethod
    def learn(cls, windows: Tensor, seen: Tensor, power: float) -> JointMetric:
        """From windows ``(N, length, joints, dims)`` and the joints seen in each, ``(N, joints)``."""
        # joints never seen go to the middle of the others, where they change no mean
        known = seen[:, None, :, None].to(windows)
        middle = (windows * known).sum(dim=2, keepdim=True) / known.sum(dim=2, keepdim=True).clamp(min=1.0)
        windows = torch.where(known > 0, windows, middle)
        covariances = []
        for name in CHANNELS:
            x = channel(windows, name) * seen[:, None, :, None]
            x = x / x.square().sum(dim=(1, 2, 3), keepdim=True).clamp(min=1e-30).sqrt()
            sigma = torch.einsum("ntjd,ntkd->jk", x, x).double() / len(x)
            covariances.append(sigma * len(sigma) / sigma.trace().clamp(min=1e-30))
        return cls(torch.stack(covariances), power)

    def weights(self, name: str, joints: Tensor | slice = slice(None)) -> Tensor | None:
        """``(joints, joints)`` W of one channel among the chosen joints; ``None`` where it is the identity."""
        if self.power == 0:
            return None
        sigma = self.covariance[CHANNELS.index(name)][joints][:, joints]
        values, vectors = torch.linalg.eigh(sigma)
        return ((vectors * (values.clamp(min=0) + self.FLOOR) ** -self.power) @ vectors.mT).float()

    def apply(self, windows: Tensor, name: str, joints: Tensor | slice = slice(None)) -> Tensor:
        """``(N, length' * joints, dims)``: a channel of the windows, weighted and laid out as tall matrices."""
        x = channel(windows, name)
        weights = self.weights(name, joints)
        if weights is not None:
            x = torch.einsum("jk,ntkd->ntjd", weights.to(x), x)
        return x.flatten(1, 2)

r"""Depth for images of a person: a kernel ridge learned within a second from synthetic actors of the same joint layout.

An image does not tell depth, but which poses people take does, in part: of the variance of the pose's depth on recordings of
new people .30 to .37 is found on UTKinect, .1 (from the front) to .49 on Florence3D.  Virtual views of lifted exemplars are
worth no more than those of flat cards (:func:`indexing.shape.views.turn`; means over four turns, UTKinect .901 against .903,
Florence3D .881 and .881, true depth .915 and .879), so report the card beside them.  What depth adds is evidence:
two lifted bodies compared however they are turned (:func:`solid`, the term ``turned`` of the residual).  Its logarithm with
weight .3 beside the three epipolar ones, nearest exemplar alone, means over turns without / cards / lifted: UTKinect, one
exemplar per class .802 / .815 / .815, all of them .953 / .952 / .957; Florence3D .667 / .684 / .686 and .852 / .860 / .860.

**Which way is away.**  Far cameras see a body and its mirror image in depth alike; labels of left and right decide which of
the two it is.  Photographs (x grows towards the right of the image) must be lifted with ``photograph=True``, images that
:func:`indexing.cameras.virtual` makes of right-handed data (Kinect) without.  With the wrong one all depths come out with the
other sign: the same person seen from behind.  Virtual views and comparisons between lifted clips are none the worse for it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from indexing.actors.layouts import LAYOUTS, agree, layout_map
from indexing.actors.random_poses import random_views
from indexing.cameras import rotation
from indexing.clip import FloatArray
from indexing.shape.bank import Windows
from indexing.shape.symmetry import from_names, mirror_permutation
from indexing.shape.views import mirror
from indexing.skeleton import Skeleton

ACTORS = 3000  # rows: 1000, 3000, 6000 find .22, .30, .27 of the pose's depth on UTKinect; a fit takes .2, 1.1, 4.7 s
RIDGE, WIDTH = 0.3, 0.5  # the ridge, and gamma times the number of inputs
SLACK = 1e-3  # share of their variance by which joints deviate from the linear fit that places joints not seen
CHUNK = 2000  # windows lifted at once: bounds memory


@dataclass(frozen=True)
class Lifter:
    r"""Depth from an image: :math:`\hat z(x) = \sum_i a_i \exp(-\gamma\|x - x_i\|^2)` with :math:`(K + \alpha I)\,a = z`.

    x is a whole clip, centred, in units of the standard deviation of its heights; z is in the same units.

    Args:
        images: ``(actors, length, joints, 2)`` of the synthetic actors; coefficients: ``(actors, length * joints)``;
            symmetry: ``(joints,)`` the mirror image of every joint; photograph: whether x grows as in a photograph.

    Source: kernel ridge regression, Saunders, Gammerman and Vovk 1998.
    """

    images: Tensor
    coefficients: Tensor
    symmetry: Tensor
    photograph: bool = False

    @classmethod
    def fit(
        cls, joints: Sequence[str], length: int = 12, seed: int = 0, *, actors: int = ACTORS, photograph: bool = False
    ) -> Lifter:
        """Learn from ``actors`` synthetic people who have the named joints, in about a second.

        Args:
            joints: names, in the order of the data: ``LAYOUTS["COCO-17"]``, a skeleton's, or :func:`layout_of` the data.
            length: steps per window.

        Raises:
            ValueError: a name that is not understood, or no joint has a side.

        Example:
            >>> from indexing.actors.layouts import LAYOUTS
            >>> lifter = Lifter.fit(LAYOUTS["COCO-17"], length=4, actors=50)
            >>> lifter.depth(lifter.images[:3]).shape
            torch.Size([3, 4, 17])
        """
        names = tuple(joints)
        layout, symmetry = layout_map(names), from_names(names)
        if layout is None or symmetry is None:
            wrong = [name for name in names if layout_map((name,)) is None]
            raise ValueError(
                f"joints: no body has joints called {', '.join(wrong[:5])}; use names as in indexing.actors.layouts.LAYOUTS"
                if wrong
                else f"joints: none of {', '.join(names[:5])}... has a left and a right; name the sides"
            )
        views = random_views(actors, length, layout, seed)
        images, scale = standardized(torch.from_numpy(views.image))
        gram = _kernel(images, images)
        gram.diagonal().add_(RIDGE)
        depth = (torch.from_numpy(views.depth) / scale[..., 0]).flatten(1)
        coefficients = torch.cholesky_solve(depth, torch.linalg.cholesky(gram))
        return cls(images.float(), coefficients.float(), symmetry, photograph)

    def depth(self, windows: Tensor, seen: Tensor | None = None, *, average: bool = True) -> Tensor:
        """``(N, length, joints)`` away from the camera, in the units of the images, about each window's mean.

        Args:
            windows: ``(N, length, joints, 2)``, y up, without NaN.
            seen: ``(N, joints)``: joints that were not seen are first placed where the actors have them, given the others.
            average: over mirror image and reversed time, in which people move as well.

        Raises:
            ValueError: windows of other length or other joints than the lifter was fitted for.
        """
        if windows.shape[1:] != self.images.shape[1:]:
            expected = tuple(self.images.shape[1:])
            raise ValueError(
                f"windows: {tuple(windows.shape[1:])} per window, but the lifter was fitted for {expected}; fit another"
            )
        values = windows.to(self.images)
        if self.photograph:
            values = values * values.new_tensor([-1.0, 1.0])
        if seen is not None:
            values = self.completed(Windows(values, seen))
        x, scale = standardized(values)
        predict = self._average if average else self._plain
        lifted = torch.cat([predict(part) for part in x.split(CHUNK)]) * scale[..., 0]
        return (lifted - lifted.mean(dim=(1, 2), keepdim=True)).to(windows)

    def completed(self, windows: Windows) -> Tensor:
        r"""The images with joints that were never seen where a linear fit to the actors puts them, frame by frame.

        :math:`\hat x_m = S_{ms}(S_{ss} + \epsilon I)^{-1} x_s` with the second moments S of the actors' frames, centred on the
        joints that are seen.
        """
        out = windows.values.clone()
        joints = out.shape[2]
        frames, means = self.images.flatten(2).flatten(0, 1), self.images.mean(dim=1).flatten(1)
        total, still = frames.mT @ frames / len(frames), means.mT @ means / len(means)
        for rows, seen in windows.patterns():
            if bool(seen.all()) or not bool(seen.any()):
                continue
            # x - m with m = centre @ (mean of x over the clip), so its moments need no pass over the actors
            centre = torch.kron((seen / seen.sum()).to(total).expand(joints, joints), torch.eye(2).to(total))
            moment = total - centre @ still - still @ centre.mT + centre @ still @ centre.mT
            known = seen.repeat_interleave(2)
            among = moment[known][:, known]
            among.diagonal().add_(SLACK * among.diagonal().mean())
            weights = torch.linalg.solve(among, moment[known][:, ~known])
            mine = windows.values[rows][:, :, seen]
            middle = mine.mean(dim=(1, 2), keepdim=True)
            filled = ((mine - middle).flatten(2) @ weights).unflatten(2, (-1, 2)) + middle
            out[rows[:, None, None], torch.arange(out.shape[1])[None, :, None], (~seen).nonzero()[:, 0]] = filled
        return out

    def _plain(self, x: Tensor) -> Tensor:
        return (_kernel(x, self.images) @ self.coefficients).view(x.shape[:3])

    def _average(self, x: Tensor) -> Tensor:
        flipped = mirror(x, self.symmetry)
        forward = self._plain(x) + self._plain(flipped)[:, :, self.symmetry]
        backward = self._plain(x.flip(1)) + self._plain(flipped.flip(1))[:, :, self.symmetry]
        return (forward + backward.flip(1)) / 4


def lift_views(windows: Tensor, depth: Tensor, azimuth: FloatArray, pitch: FloatArray) -> Tensor:
    """The lifted body turned about the vertical and pitched, seen orthographically; depth 0 = :func:`indexing.shape.views.turn`.

    Args:
        windows: ``(N, length, joints, 2)``, y up; depth: ``(N, length, joints)`` away from the camera.
        azimuth, pitch: ``(N,)`` radians, as for :func:`indexing.cameras.rotation`.

    Returns:
        ``(N, length, joints, 2)``.

    Example:
        >>> import numpy as np
        >>> import torch
        >>> from indexing.shape.views import turn
        >>> x, angle = torch.rand(1, 4, 3, 2), np.array([0.7])
        >>> torch.allclose(lift_views(x, torch.zeros(1, 4, 3), angle, angle), turn(x, angle, angle))
        True
    """
    rotations = torch.tensor(np.stack([rotation(a, p) for a, p in zip(azimuth, pitch, strict=True)]), dtype=windows.dtype)
    solid = torch.cat([windows, depth[..., None]], dim=3)
    return torch.einsum("nij,ntkj->ntki", rotations[:, :2], solid - solid.mean(dim=(1, 2), keepdim=True))


def solid(windows: Windows, lifter: Lifter) -> Windows:
    """The windows with lifted depth as third coordinate: the residual's term ``turned`` compares such bodies."""
    return Windows(torch.cat([windows.values, lifter.depth(windows.values, windows.seen)[..., None]], dim=3), windows.seen)


def layout_of(skeleton: Skeleton | None, windows: Tensor, seen: Tensor | None = None) -> tuple[str, ...] | None:
    """Names of the joints: of the format with this mirror symmetry that the skeleton does not contradict, else the skeleton's.

    Args:
        windows: ``(N, length, joints, 2)``; seen: ``(N, joints)`` which joints count in each (all).

    Returns:
        ``None`` where neither a known format nor the names tell what the joints are.
    """
    symmetry = mirror_permutation(skeleton, windows, seen)
    if symmetry is None:
        return None
    for names in LAYOUTS.values():
        swap = from_names(names)
        if swap is not None and torch.equal(swap, symmetry) and (skeleton is None or agree(names, skeleton.joints)):
            return names
    return skeleton.joints if skeleton is not None and layout_map(skeleton.joints) is not None else None


def understood(names: tuple[str, ...]) -> bool:
    """Whether a lifter can be made for joints with these names."""
    return layout_map(names) is not None and from_names(names) is not None


def standardized(windows: Tensor) -> tuple[Tensor, Tensor]:
    """Windows about their mean in units of the standard deviation of their heights, and ``(N, 1, 1, 1)`` that deviation."""
    x = windows - windows.mean(dim=(1, 2), keepdim=True)
    scale = x[..., 1:].square().mean(dim=(1, 2), keepdim=True).sqrt().clamp(min=1e-12)
    return x / scale, scale


def _kernel(a: Tensor, b: Tensor) -> Tensor:
    left, right = a.flatten(1), b.flatten(1)
    squares = left.square().sum(dim=1)[:, None] + right.square().sum(dim=1) - 2 * left @ right.mT
    return squares.mul_(-WIDTH / left.shape[1]).exp_()

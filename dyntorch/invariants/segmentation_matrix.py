"""The segmentation matrix: two rigid bodies that move independently, in two views, without saying which point is on which."""

from __future__ import annotations

import torch
from torch import Tensor

from dyntorch.core.invariant import Frame, Invariant
from dyntorch.core.matrix import gram
from dyntorch.core.normalize import hartley, unit_tensors
from dyntorch.core.primitives import Monomials, Point
from dyntorch.core.residual import algebraic, sampson
from dyntorch.geometry.homogeneous import homogeneous, symmetric, unit
from dyntorch.geometry.pairs import factor_product, hyperplane_pair, product_matrix
from dyntorch.invariants.fundamental_matrix import FundamentalMatrix
from dyntorch.numerics.nullspace import gram_null_space

FLOOR = 1e-3
"""Least squared gradient, over the median one, that a weight of the reweighted fit believes."""


class RelationPair(Invariant):
    r"""Base of the 6 x 6 matrices of a product, :math:`\nu(p_2)^T S\, \nu(p_1) = (p_2^T F_1 p_1)(p_2^T F_2 p_1)`."""

    primitives = (Monomials(),) * 2
    layout = (1, 0)
    # otherwise a fifth to a half of the scenes with a planar body, and all of a single body, pass for two bodies at .1 px
    resolves_noise = False

    @staticmethod
    def product(first: Tensor, second: Tensor) -> Tensor:
        """The matrix S of two relations ``(*batch, 3, 3)``: ``(*batch, 6, 6)`` of norm 1; 0 where one of them is 0."""
        return unit_tensors(product_matrix(first, second), 2)

    def tensor_of(self, basis: Tensor) -> Tensor:
        """The matrix for plain monomials, of a null vector for isometric ones."""
        scale = Monomials().scale(basis.device).to(basis.dtype)
        return scale[:, None] * super().tensor_of(basis) * scale

    def basis_of(self, tensor: Tensor) -> Tensor:
        scale = Monomials().scale(tensor.device).to(tensor.dtype)
        return super().basis_of(tensor / scale[:, None] / scale)

    @staticmethod
    def fundamentals(tensor: Tensor) -> tuple[Tensor, Tensor]:
        r"""The fundamental matrices of both bodies, from the null spaces of S, which are spanned by the epipoles. tensor
        ``(*batch, 6, 6)`` -> ``(*batch, 3, 3)``."""
        first, second = factor_product(tensor.double())
        return first.to(tensor.dtype), second.to(tensor.dtype)

    @staticmethod
    def decompose_by_derivatives(tensor: Tensor, x1: Tensor, x2: Tensor) -> tuple[Tensor, Tensor]:
        r"""The fundamental matrices by another way, with the matches: the derivative of the form at a match is its epipolar
        line. tensor ``(*batch, 6, 6)``, x1, x2 ``(*batch, n, 2)`` -> ``(*batch, 3, 3)``."""
        finite = x1.isfinite().all(-1) & x2.isfinite().all(-1)
        views = [torch.where(finite[..., None], x, 0.0).double() for x in (x1, x2)]
        weights = finite.double()
        frames = [hartley(x[..., None, :], weights) for x in views]
        first, second = (p.move(x, t) for p, x, t in zip(RelationPair.primitives, views, frames, strict=True))
        # the matrix of the normalized matches
        lifts = [Monomials().action(torch.linalg.inv_ex(t)[0]) for t in frames]
        form = (Monomials().raw(second) @ (lifts[1].mT @ tensor.double() @ lifts[0]))[..., symmetric(2, tensor.device)]
        half = 0.5 + 0.5 * torch.eye(3, dtype=form.dtype, device=form.device)
        lines = (form * half @ homogeneous(first)[..., None])[..., 0]
        labels = hyperplane_pair(lines, weights).labels
        matrices = [_eight_points(first, second, (labels == k).double()) for k in (1, 2)]
        F1, F2 = (unit(frames[1].mT @ f @ frames[0]).to(tensor.dtype) for f in matrices)
        return F1, F2

    @staticmethod
    def labels(first: Tensor, second: Tensor, x1: Tensor, x2: Tensor) -> Tensor:
        r"""Which of two bodies each match moves with: the one to whose epipolar geometry its Sampson distance is less. first,
        second ``(*batch, 3, 3)``, x1, x2 ``(*batch, n, 2)`` -> ``(*batch, n)``."""
        distances = torch.stack([sampson(FundamentalMatrix, f, x1, x2) for f in (first, second)])
        finite = distances.isfinite().all(0)
        return torch.where(finite, 1 + distances.argmin(0), 0)

    @staticmethod
    def reweight(tensor: Tensor, x1: Tensor, x2: Tensor) -> Tensor:
        r"""Weights :math:`1 / \|\nabla h_n\|^2` of the matches for the next fit: the algebraic error becomes that in the
        images. tensor ``(*batch, 6, 6)``, x1, x2 ``(*batch, n, 2)`` -> ``(*batch, n)``."""
        value, distance = algebraic(RelationPair, tensor, x1, x2), sampson(RelationPair, tensor, x1, x2)
        square = torch.where(distance > 0, value / torch.where(distance > 0, distance, 1.0), 0.0).square()
        size = square.masked_fill(~(distance > 0), torch.nan).nanmedian(-1, keepdim=True).values.nan_to_num(nan=1.0)
        weights = 1 / torch.maximum(square / torch.where(size > 0, size, 1.0), torch.full_like(square, FLOOR))
        # a match without any distance has lost its gradient in the quotient
        weights = torch.where(distance > 0, weights, 1.0)
        return torch.where(distance.isfinite(), weights, 0.0)


def _eight_points(x1: Tensor, x2: Tensor, weights: Tensor) -> Tensor:
    """Fundamental matrices ``(*batch, 3, 3)`` of normalized, weighted matches."""
    basis = gram_null_space(gram((Point(2),) * 2, (x1, x2), weights)).basis
    invariant = FundamentalMatrix()
    return invariant.constrain(invariant.tensor_of(basis))


class SegmentationMatrix(RelationPair):
    r"""Points of two bodies in two views: :math:`\nu(p_2)^T S\, \nu(p_1) = (p_2^T F_1 p_1)(p_2^T F_2 p_1) = 0`.

    :math:`\nu` has the six monomials 00, 01, 02, 11, 12, 22 of a point.  No match says which body it belongs to; 35 matches
    determine the 36 coefficients if at least 8 are of each body (27 at most count).  A planar body leaves nullity 3, two planar
    bodies 9, one plane alone 21: then S vanishes on both bodies, but says nothing of the motion.

    Its motion has 14 degrees of freedom, those of two fundamental matrices: for each a homography :math:`A_k` of view 1 to view 2
    and the epipole :math:`e_k` of view 2, :math:`F_k = [e_k]_\times A_k`.  The order of the bodies means nothing.

    S has 35 degrees of freedom for these 14, so noise bends it, and half a pixel often leaves it ``AMBIGUOUS``.  ``OK`` says that
    no other S fits as well, not that its labels are right: at 0.1 and 0.5 px, 100 and 200 matches, the labels of the fit were 20 %
    wrong or more in 17 of 60 scenes.  :func:`dyntorch.refine`, which varies the true parameters, is what labels noisy matches: at
    most 7 % wrong in these.  Outliers bend S as well (robust estimation is not sure to stand 5 %); :func:`dyntorch.segment` is
    for those.

    Source: thesis chapter 6; Wolf and Shashua, CVPR 2001; Vidal, Ma, Soatto and Sastry, IJCV 2006.

    Example:
        >>> import torch, dyntorch as dyn
        >>> from dyntorch.scenes import bodies
        >>> scene = bodies(40, interleaved=True, generator=torch.Generator().manual_seed(0))
        >>> S = dyn.fit(dyn.SegmentationMatrix, *scene.views).tensor
        >>> labels = dyn.SegmentationMatrix.labels(*dyn.SegmentationMatrix.fundamentals(S), *scene.views)
        >>> int((labels == scene.labels).sum()) in (0, 40)
        True

        Under noise, refine before labelling:

        >>> scene = bodies(100, sigma=0.3, interleaved=True, generator=torch.Generator().manual_seed(0))
        >>> S = dyn.refine(dyn.fit(dyn.SegmentationMatrix, *scene.views), *scene.views).tensor
        >>> labels = dyn.SegmentationMatrix.labels(*dyn.SegmentationMatrix.fundamentals(S), *scene.views)
        >>> wrong = int((labels != scene.labels).sum())
        >>> min(wrong, 100 - wrong) < 5
        True
    """

    motion = (Frame(1, 0), Frame(1, vector=True)) * 2
    dof = 14

    @staticmethod
    def compose(*motion: Tensor) -> Tensor:
        r"""The segmentation matrix of two bodies, :math:`S_{\{ac\}\{bd\}} \sim \sum F_{1,ab} F_{2,cd}`.

        Args:
            motion: two fundamental matrices ``(*batch, 3, 3)``; or the four parts :math:`A_1, e_1, A_2, e_2`, ``(*batch, 3, 3)``
                from view 1 to view 2 and ``(*batch, 3)`` in view 2.

        Returns:
            ``(*batch, 6, 6)`` of norm 1, the first axis of view 2; 0 where a fundamental matrix is 0.

        Raises:
            ValueError: neither two parts nor four.

        Example:
            >>> import torch
            >>> F = FundamentalMatrix.compose(torch.eye(3), torch.tensor([0.0, 0.0, 1.0]))
            >>> S = SegmentationMatrix.compose(F, F)  # (x1 y2 - x2 y1)^2
            >>> bool(torch.allclose(S / S[0, 3], torch.diag(torch.tensor([1.0, -2, 0, 1, 0, 0]))[[3, 1, 2, 0, 4, 5]]))
            True
        """
        if len(motion) not in (2, 4):
            raise ValueError(f"compose takes F1, F2, or A1, e1, A2, e2, got {len(motion)} parts")
        if len(motion) == 4:
            motion = FundamentalMatrix.compose(*motion[:2]), FundamentalMatrix.compose(*motion[2:])
        return SegmentationMatrix.product(*motion)

    @staticmethod
    def decompose(tensor: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        r"""The motion of both bodies: that of :meth:`FundamentalMatrix.decompose` for either of the :meth:`fundamentals`.

        Args:
            tensor: ``(*batch, 6, 6)`` of any scale.

        Returns:
            :math:`A_1, e_1, A_2, e_2`, ``(*batch, 3, 3)`` and ``(*batch, 3)`` of norm 1; 0 for a zero matrix (a failed fit).

        Example:
            >>> import torch
            >>> e = torch.eye(3, dtype=torch.float64)
            >>> A1, e1, A2, e2 = SegmentationMatrix.decompose(SegmentationMatrix.compose(e, e[0], e, e[1]))
            >>> (e1 + e2).tolist()
            [1.0, 1.0, 0.0]
        """
        first, second = SegmentationMatrix.fundamentals(tensor)
        return *FundamentalMatrix.decompose(first), *FundamentalMatrix.decompose(second)

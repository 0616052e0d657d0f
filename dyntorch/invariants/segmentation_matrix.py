"""The segmentation matrix: two rigid bodies that move independently, in two views, without saying which point is on which."""

from __future__ import annotations

from torch import Tensor

from dyntorch.core.invariant import Frame
from dyntorch.invariants.base_pairs import RelationPair
from dyntorch.invariants.fundamental_matrix import FundamentalMatrix


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

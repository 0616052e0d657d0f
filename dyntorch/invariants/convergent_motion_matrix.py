"""The product of two view relations: static points of space, and points that move on coplanar lines through one point."""

from __future__ import annotations

import torch
from torch import Tensor

from dyntorch.core.invariant import Frame
from dyntorch.geometry.extensors import adjugate
from dyntorch.geometry.homogeneous import skew, unit, unit_vectors
from dyntorch.invariants.fundamental_matrix import FundamentalMatrix
from dyntorch.invariants.segmentation_matrix import RelationPair


class ConvergentMotionMatrix(RelationPair):
    r"""Static points, and points that move along lines of one plane through one of its points, in two views:
    :math:`\nu(p_2)^T S\, \nu(p_1) = (p_2^T [e_2]_\times H\, p_1)(p_2^T [v_2]_\times H\, p_1) = 0`.

    Traffic on a straight road: each point keeps its line, at any speed, forwards or backwards, and parallel lines meet in their
    vanishing point.  With the homography H of the plane from view 1 to view 2 and the image :math:`v_2` of the common point, the
    vertex, the line of a point passes through :math:`v_2` and :math:`H p_1`, so

    .. math:: p_2^T G\, p_1 = 0, \qquad G = [v_2]_\times H, \qquad F = [e_2]_\times H:

    G is like a fundamental matrix, of rank two, with the vertices :math:`v_1 = H^{-1} v_2` and :math:`v_2` for epipoles.  But F
    and G share H, which is two conditions (the lines :math:`e_1 v_1` and :math:`e_2 v_2` correspond under both),

    .. math:: v_2^T F\, v_1 = 0, \qquad e_2^T G\, e_1 = 0,

    and leaves 8 + 2 + 2 = 12 degrees of freedom of the 14 of a :class:`~dyntorch.SegmentationMatrix`.  Conversely, two matrices of
    rank two that fulfil both have a common H (:func:`plane_of`), so the moving points tell the homography of their plane.

    The order of the factors is not in the matches, however many: a point that moves and a static point above the plane differ
    from :math:`H p_1` alike, the one by a multiple of :math:`v_2`, the other of :math:`e_2`.  (Bodies that translate against each
    other have the same form, with the homography at infinity for H.)  The calibration tells them apart (:meth:`static_first`),
    or one match off the plane that is known to be static.  A camera that travels along the lines has its epipole at the vertex:
    then F = G, and nothing is known of H.

    35 matches, 8 of either kind, determine the matrix.  Under noise fit with reweighted matches, then refine the 12
    parameters with weights of 1 (:func:`dyntorch.refine` keeps those of the fit otherwise).  40 scenes of 200 matches at 0.1 and
    0.5 px: relative error of H in normalized coordinates .0005 and .0026 before, .0002 and .0014 after; wrong labels .4 and 2.0 %
    before, .4 and 1.9 % after (with the true matrices .4 and 1.8 %).  Outliers are not its strength, as 35 matches without one are
    rare: with 3 % of them :func:`dyntorch.robust_fit` finds 14 of 20 scenes (175 matches).  :func:`dyntorch.segment` first, and
    then the matches that it keeps, is for those.

    Source: Bartoli, The geometry of dynamic scenes: on coplanar and convergent linear motions embedded in 3D static scenes, 2005;
    its product with the static scene after thesis chapter 6.

    Example:
        >>> import torch, dyntorch as dyn
        >>> from dyntorch.scenes import convergent_motions
        >>> scene = convergent_motions(60, generator=torch.Generator().manual_seed(0))
        >>> S = dyn.fit(ConvergentMotionMatrix, *scene.views).tensor
        >>> K = scene.extras["calibration"]
        >>> H, e2, v2, _ = ConvergentMotionMatrix.static_first(*ConvergentMotionMatrix.decompose(S), K, K)
        >>> vertex = scene.extras["vertex"]
        >>> bool((v2[:2] / v2[2] - vertex[:2] / vertex[2]).norm() < 1e-4)
        True

        Under noise, in turns of weights and fits, then the 12 parameters:

        >>> scene = convergent_motions(200, sigma=0.3, generator=torch.Generator().manual_seed(0))
        >>> fitted = dyn.fit(ConvergentMotionMatrix, *scene.views)
        >>> for _ in range(5):
        ...     weights = ConvergentMotionMatrix.reweight(fitted.tensor, *scene.views)
        ...     fitted = dyn.fit(ConvergentMotionMatrix, *scene.views, weights=weights)
        >>> S = dyn.refine(fitted, *scene.views, weights=torch.ones(200)).tensor
        >>> labels = ConvergentMotionMatrix.labels(*ConvergentMotionMatrix.fundamentals(S), *scene.views)
        >>> wrong = int((labels != scene.labels).sum())
        >>> min(wrong, 200 - wrong) < 10
        True
    """

    motion = (Frame(1, 0), Frame(1, vector=True), Frame(1, vector=True))
    dof = 12

    @staticmethod
    def compose(homography: Tensor, epipole: Tensor, vertex: Tensor) -> Tensor:
        r"""The matrix of the product of :math:`[e_2]_\times H` and :math:`[v_2]_\times H`.

        Args:
            homography: H of the plane ``(*batch, 3, 3)``, view 1 to view 2.
            epipole: :math:`e_2` ``(*batch, 3)``, in view 2.
            vertex: :math:`v_2` ``(*batch, 3)``, in view 2; it may change places with the epipole.

        Returns:
            ``(*batch, 6, 6)`` of norm 1; 0 where a part is 0.

        Example:
            >>> import torch
            >>> e = torch.eye(3)
            >>> ConvergentMotionMatrix.compose(e, e[0], e[1]).nonzero().tolist()  # (y1 - y2) (x2 - x1)
            [[1, 5], [2, 4], [4, 2], [5, 1]]
        """
        return ConvergentMotionMatrix.product(*ConvergentMotionMatrix.factors(homography, epipole, vertex))

    @staticmethod
    def factors(homography: Tensor, epipole: Tensor, vertex: Tensor) -> tuple[Tensor, Tensor]:
        r"""The fundamental matrix F of the static points and its like G of the moving ones.

        Args:
            homography: H ``(*batch, 3, 3)``, view 1 to view 2.
            epipole, vertex: :math:`e_2` and :math:`v_2` ``(*batch, 3)``.

        Returns:
            F and G ``(*batch, 3, 3)`` of norm 1; 0 where a part is 0.  :meth:`labels` takes them.

        Example:
            >>> import torch
            >>> F, G = ConvergentMotionMatrix.factors(torch.eye(3), torch.tensor([1.0, 0.0, 0.0]), torch.tensor([0.0, 0.0, 1.0]))
            >>> FundamentalMatrix.epipoles(G)[0].tolist()
            [0.0, 0.0, 1.0]
        """
        return FundamentalMatrix.compose(homography, epipole), FundamentalMatrix.compose(homography, vertex)

    @staticmethod
    def decompose(tensor: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        r"""The homography of the plane, and the epipole and the vertex in view 2, which S does not tell apart.

        With :math:`\|e_2\| = 1` every homography of F is :math:`H = e_2 a^T - [e_2]_\times F`, and
        :math:`g\, G = [v_2]_\times H` gives g and a.

        Args:
            tensor: ``(*batch, 6, 6)`` of any scale.  Under noise its factors do not share a plane: a start for
                :func:`dyntorch.refine`.

        Returns:
            H ``(*batch, 3, 3)``, norm 1, view 1 to view 2; :math:`e_2` and :math:`v_2` ``(*batch, 3)``, norm 1, or the other way
            round: :meth:`static_first` says.  0 for a zero matrix (a failed fit).

        Example:
            >>> import torch
            >>> e = torch.eye(3, dtype=torch.float64)
            >>> H, e2, v2 = ConvergentMotionMatrix.decompose(ConvergentMotionMatrix.compose(e, e[0], e[1]))
            >>> (H * 3**0.5).round(decimals=9).abs().tolist(), (e2 + v2).tolist()
            ([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]], [1.0, 1.0, 0.0])
        """
        first, second = ConvergentMotionMatrix.fundamentals(tensor.double())
        epipole, vertex = FundamentalMatrix.epipoles(first)[1], FundamentalMatrix.epipoles(second)[1]
        homography = plane_of(first, second)
        return homography.to(tensor.dtype), epipole.to(tensor.dtype), vertex.to(tensor.dtype)

    @staticmethod
    def vertices(homography: Tensor, vertex: Tensor) -> tuple[Tensor, Tensor]:
        r"""The common point of the lines in both views: :math:`v_1 \sim H^{-1} v_2`.

        Args:
            homography: H ``(*batch, 3, 3)``.
            vertex: :math:`v_2` ``(*batch, 3)``.

        Returns:
            :math:`v_1` and :math:`v_2` ``(*batch, 3)``, homogeneous, norm 1, the largest coordinate positive.

        Example:
            >>> import torch
            >>> v1, v2 = ConvergentMotionMatrix.vertices(torch.diag(torch.tensor([2.0, 1.0, 1.0])), torch.tensor([2.0, 0.0, 1.0]))
            >>> (v1 / v1[2]).tolist(), (v2 / v2[2]).tolist()
            ([1.0, 0.0, 1.0], [2.0, 0.0, 1.0])
        """
        first = (adjugate(homography.double()) @ vertex.double()[..., None]).to(vertex.dtype)
        return unit(first)[..., 0], unit(vertex[..., None])[..., 0]

    @staticmethod
    def static_first(
        homography: Tensor, epipole: Tensor, vertex: Tensor, calibration1: Tensor, calibration2: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        r"""Which of the two points is the epipole, by the calibration: :math:`K_2^T F K_1` has two equal singular values, G not.

        Args:
            homography: H ``(*batch, 3, 3)``.
            epipole, vertex: ``(*batch, 3)``, in any order.
            calibration1, calibration2: :math:`K_1, K_2` ``(*batch, 3, 3)``.

        Returns:
            H, :math:`e_2`, :math:`v_2`, and ``(*batch,)`` from 0 (undecided) to 1 by how much :math:`\sigma_2 / \sigma_1` of
            F is nearer to 1 than that of G.  It is 0 where the vertex lies in the other direction of motion that the homography of
            a plane admits.

        Example:
            >>> import torch
            >>> e, v = torch.eye(3)[0], torch.tensor([0.0, 2.0, 1.0])
            >>> H = torch.eye(3) + e[:, None] * torch.tensor([0.0, 1.0, 0.0])  # sideways over a ground
            >>> _, e2, v2, gap = ConvergentMotionMatrix.static_first(H, v, e, torch.eye(3), torch.eye(3))
            >>> e2.tolist(), v2.tolist(), round(float(gap), 2)
            ([1.0, 0.0, 0.0], [0.0, 2.0, 1.0], 0.38)
        """
        both = torch.stack([epipole, vertex], dim=-2)
        matrices = calibration2[..., None, :, :].mT @ skew(both) @ homography[..., None, :, :] @ calibration1[..., None, :, :]
        # a value of each, not a null vector of data
        values = torch.linalg.svdvals(torch.nan_to_num(matrices.detach().double()))
        unequal = 1 - values[..., 1] / torch.where(values[..., 0] > 0, values[..., 0], 1.0)
        swap = unequal[..., 1] < unequal[..., 0]
        both = torch.where(swap[..., None, None], both.flip(-2), both)
        gap = (unequal[..., 0] - unequal[..., 1]).abs()
        return homography, both[..., 0, :], both[..., 1, :], gap.to(homography.dtype)


def plane_of(first: Tensor, second: Tensor) -> Tensor:
    r"""The homography that two fundamental matrices share, :math:`F = [e]_\times H,\ G = [v]_\times H`: of a plane, or at
    infinity. first ``(*batch, 3, 3)``, second ``(*batch, 3, 3)`` -> ``(*batch, 3, 3)``."""
    epipole, vertex = FundamentalMatrix.epipoles(first)[1], FundamentalMatrix.epipoles(second)[1]
    part = -skew(epipole) @ first  # a homography of F, singular
    moved = skew(vertex) @ part
    across = torch.linalg.cross(vertex, epipole)
    # g G = moved + across a^T: what is orthogonal to the second term says g
    along = unit_vectors(torch.linalg.cross(vertex, across))[..., None, :]
    row, target = (along @ second)[..., 0, :], (along @ moved)[..., 0, :]
    square = row.square().sum(-1, keepdim=True)
    scale = (row * target).sum(-1, keepdim=True) / torch.where(square > 0, square, 1.0)
    length = across.square().sum(-1, keepdim=True)
    rest = (across[..., None, :] @ (scale[..., None] * second - moved))[..., 0, :]
    homography = part + epipole[..., :, None] * (rest / torch.where(length > 0, length, 1.0))[..., None, :]
    return unit(homography)

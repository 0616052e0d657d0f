r"""Products of two bilinear forms: the 6 x 6 matrix of :math:`(p_2^T F_1 p_1)(p_2^T F_2 p_1)`, and the two forms in it.

The matrix takes monomials of the points, :math:`\nu(p_2)^T S\, \nu(p_1)`, in the order 00, 01, 02, 11, 12, 22.
"""

from __future__ import annotations

import torch
from torch import Tensor

from dyntorch.algebra.homogeneous import unit_vectors
from dyntorch.algebra.monomials import collecting, factors, multiplicity, symmetric
from dyntorch.algebra.rank_two import null_vectors, rank_one
from dyntorch.constants import constant
from dyntorch.nullspace import null_space

STEPS = 12
"""Steps to the nearest product.  Without any, 1 of 40 noisy scenes (100 matches, .01 px, epipoles 2 degrees apart) is useless."""
EXACT = 1e-10  # of the norm of the matrix: what rounding leaves of an exact product
FULL = 1e-12  # damping that is none
RIDGE = 1e-15  # of the trace: leaves equations of coinciding epipoles solvable


def product_matrix(*forms: Tensor) -> Tensor:
    r"""The matrix S of the product of bilinear forms, for two of them :math:`S_{\{ac\}\{bd\}} = \sum F_{ab} G_{cd}`, not scaled.

    Args:
        forms: K matrices ``(*batch, 3, 3)``.

    Returns:
        ``(*batch, M, M)``, M the number of monomials of degree K; 6 for two forms.

    Example:
        >>> import torch
        >>> product_matrix(torch.eye(3), torch.eye(3)).diagonal().tolist()  # (p2 . p1)^2
        [1.0, 2.0, 2.0, 1.0, 2.0, 1.0]
    """
    product = forms[0]
    for form in forms[1:]:
        product = (product[..., :, None, :, None] * form[..., None, :, None, :]).flatten(-4, -3).flatten(-2)
    collect = collecting(len(forms), 2, product.device).to(product.dtype)
    return collect @ product @ collect.mT


def factor_product(matrix: Tensor) -> tuple[Tensor, Tensor]:
    r"""The two matrices of rank two whose product a 6 x 6 matrix is, through its null spaces: the epipoles.

    :math:`F_k e_k = 0` gives :math:`S\, \nu(e_k) = 0`: the null space of S holds the two symmetric matrices
    :math:`e_k e_k^T` of rank one, that of :math:`S^T` those of the epipoles of view 2.  With a basis :math:`B_k` across
    :math:`e'_k` and :math:`A_k` across :math:`e_k`, :math:`F_k = B_k G_k A_k^T`, and S is linear in
    :math:`G_1 \otimes G_2`, which has to be of rank one.  Of the two ways to pair the epipoles the one that leaves less of S
    is right.

    Args:
        matrix: ``(*batch, 6, 6)`` of any scale; the nearest null spaces where it has full rank.  The epipoles must differ in
            both views.

    Returns:
        F and G ``(*batch, 3, 3)`` of norm 1, in an order that depends on nothing but them; 0 for a matrix that is 0.

    Raises:
        ValueError: not 6 x 6.

    Example:
        >>> import torch
        >>> F = torch.tensor([[0.0, 1.0, 0.0], [-1.0, 0.0, 2.0], [0.0, 2.0, 0.0]], dtype=torch.float64)
        >>> G = torch.tensor([[0.0, 0.0, 1.0], [0.0, 0.0, 3.0], [-1.0, -2.0, 1.0]], dtype=torch.float64)
        >>> both = factor_product(product_matrix(F, G))
        >>> bool(torch.allclose(product_matrix(*both), product_matrix(F, G) / (F.norm() * G.norm())))
        True
    """
    if matrix.shape[-2:] != (6, 6):
        raise ValueError(f"matrix must be (*batch, 6, 6), got {tuple(matrix.shape)}")
    size = torch.linalg.matrix_norm(matrix.detach(), keepdim=True)
    sound = size.isfinite() & (size > 0)
    # any product in place of what is none, so that nothing is NaN
    stand_in = product_matrix(*torch.diag_embed(matrix.new_tensor([[1.0, -1.0, 0.0], [1.0, 0.0, 2.0]])).unbind(0))
    flat = torch.where(sound, matrix / torch.where(sound, size, 1.0), stand_in).reshape(-1, 6, 6)
    scale = multiplicity(2, 2, flat.device).to(flat.dtype).sqrt()
    flat, second, first = _balanced(flat / scale[:, None] / scale)
    found = _nearest(flat, _paired(flat, _epipoles(null_space(flat.mT, 2)), _epipoles(null_space(flat, 2))))
    found = second[:, None, :, None] * found * first[:, None, None, :]
    found = unit_vectors(found.flatten(-2))
    found = _ordered(found).unflatten(-1, (3, 3)).reshape(*matrix.shape[:-2], 2, 3, 3)
    found = torch.where(sound[..., None], found, 0.0)
    return found[..., 0, :, :], found[..., 1, :, :]


def _balanced(matrix: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The isometric matrix in units in which the points of both views are of order 1, and the scales ``(b, 3)`` of the forms' axes.

    In pixels its entries are 1e-10 and 1 side by side, and the null spaces would be rounding.
    """
    scales = []
    for axis in (2, 1):
        square = matrix.square().sum(axis)
        # monomials that are quadratic, linear and constant in the measured coordinates
        two, one, none = square[:, [0, 1, 3]].sum(-1), square[:, [2, 4]].sum(-1), square[:, 5]
        unit = (two.square() / (none * two + one.square()).clamp(min=1e-300)).clamp(min=1e-60)
        scale = unit ** (-0.25)
        scales.append(torch.stack([scale, scale, torch.ones_like(scale)], dim=-1))
    index = factors(2, 2, matrix.device)
    left, right = (s[:, index[:, 0]] * s[:, index[:, 1]] for s in scales)
    matrix = left[:, :, None] * matrix * right[:, None, :]
    matrix = matrix / torch.linalg.matrix_norm(matrix, keepdim=True).clamp(min=1e-300)
    return matrix, 1 / scales[0], 1 / scales[1]


def _epipoles(kernel: Tensor) -> Tensor:
    """The two vectors ``(b, 2, 3)`` whose outer squares span a plane of symmetric matrices, isometric monomials ``(b, 2, 6)``."""
    plain = kernel / multiplicity(2, 2, kernel.device).to(kernel.dtype).sqrt()
    form = plain[..., symmetric(2, kernel.device)]
    # both forms vanish on the vector across both epipoles; what is left are 2 x 2 matrices
    common = null_space(form.flatten(1, 2))
    across = null_space(common, 2)
    a, b = (across[:, None] @ form @ across[:, None].mT).unbind(1)
    # p a + q b is of rank one
    first, last = (m[:, 0, 0] * m[:, 1, 1] - m[:, 0, 1].square() for m in (a, b))
    middle = a[:, 0, 0] * b[:, 1, 1] + a[:, 1, 1] * b[:, 0, 0] - 2 * a[:, 0, 1] * b[:, 0, 1]
    discriminant = middle.square() - 4 * first * last
    real = discriminant > 0
    root = torch.where(real, torch.where(real, discriminant, 1.0).sqrt(), 0.0)
    large = -0.5 * (middle + torch.where(middle < 0, -root, root))
    roots = torch.stack([torch.stack([large, first], -1), torch.stack([last, large], -1)], dim=1)
    squares = torch.einsum("bkr,brij->bkij", roots, torch.stack([a, b], dim=1))
    longest = squares.detach().diagonal(dim1=-2, dim2=-1).abs().argmax(-1)
    column = squares.gather(-1, longest[..., None, None].expand(-1, -1, 2, 1))[..., 0]
    return unit_vectors(unit_vectors(column) @ across)


def _paired(matrix: Tensor, second: Tensor, first: Tensor) -> Tensor:
    """The forms ``(b, 2, 2, 3, 3)`` for epipoles ``(b, 2, 3)`` of view 2 and view 1, paired in both ways."""
    bases = [null_space(e.flatten(0, 1)[:, None], 2).reshape(-1, 2, 2, 3) for e in (second, first)]
    return torch.stack([_forms(matrix, bases[0], chosen) for chosen in (bases[1], bases[1].flip(1))], dim=1)


def _forms(matrix: Tensor, second: Tensor, first: Tensor) -> Tensor:
    """Forms ``(b, 2, 3, 3)`` of norm 1 within given bases ``(b, 2, 2, 3)``."""
    collect = collecting(2, 2, matrix.device).to(matrix.dtype)
    collect = collect / collect.norm(dim=-1, keepdim=True)
    inner = matrix
    for basis in (second, first):
        pairs = (basis[:, 0, :, None, :, None] * basis[:, 1, None, :, None, :]).flatten(3).flatten(1, 2) @ collect.mT  # (b, 4, 6)
        gram = pairs @ pairs.mT
        ridge = RIDGE * gram.diagonal(dim1=-2, dim2=-1).sum(-1)
        gram = gram + torch.diag_embed(ridge[:, None].expand(-1, 4))
        inner = (torch.linalg.solve_ex(gram, pairs)[0] @ inner).mT
    # rows by the pairs of basis vectors of view 2, columns by those of view 1: (i j, k l) -> (i k, j l)
    kron = inner.unflatten(-1, (2, 2)).unflatten(-3, (2, 2)).transpose(-3, -2).flatten(-2).flatten(-3, -2)
    left, right = rank_one(kron)
    forms = second.mT @ torch.stack([left, right], dim=1).unflatten(-1, (2, 2)) @ first
    return forms / torch.linalg.matrix_norm(forms, keepdim=True).clamp(min=1e-300)


def _nearest(matrix: Tensor, tries: Tensor) -> Tensor:
    """The forms ``(b, 2, 3, 3)`` of rank two whose product is nearest, by damped Gauss-Newton steps from ``(b, 2, 2, 3, 3)``."""
    rest = _rest(matrix.repeat_interleave(2, 0), tries.flatten(0, 1))[0].unflatten(0, (-1, 2))
    forms = _best(tries, rest)
    chosen = (rest.detach().amin(-1) > EXACT).nonzero()[:, 0]
    if len(chosen):
        forms = forms.index_copy(0, chosen, _descent(matrix[chosen], tries[chosen]))
    # a full step at the end gives exact products the gradient of the nearest one, too
    rest, scale = _rest(matrix, forms)
    trial = _step(matrix, forms, scale, torch.full_like(rest, FULL))
    better = _rest(matrix, trial)[0] <= rest.clamp(min=EXACT)
    return torch.where(better[:, None, None, None], trial, forms)


def _descent(matrix: Tensor, tries: Tensor) -> Tensor:
    """:func:`_nearest` of matrices that are no product."""
    target, current = matrix.repeat_interleave(2, 0), tries.flatten(0, 1)
    rest, scale = _rest(target, current)
    damping = torch.full_like(rest, 1e-4)
    for _ in range(STEPS):
        trial = _step(target, current, scale, damping)
        left, size = _rest(target, trial)
        better = left < rest
        current = torch.where(better[:, None, None, None], trial, current)
        rest, scale = torch.where(better, left, rest), torch.where(better, size, scale)
        damping = torch.where(better, damping * 0.1, damping * 10)
    return _best(current.unflatten(0, (-1, 2)), rest.unflatten(0, (-1, 2)))


def _best(tries: Tensor, rest: Tensor) -> Tensor:
    """Those of two tries that leave less."""
    return tries.gather(1, rest.detach().argmin(-1)[:, None, None, None, None].expand(-1, 1, 2, 3, 3))[:, 0]


def _rest(matrix: Tensor, forms: Tensor) -> tuple[Tensor, Tensor]:
    """Distance ``(b,)`` of the matrix to the multiples of the product, and the best factor."""
    product = (_with(forms[:, 1]) @ forms[:, 0].flatten(1)[..., None])[..., 0]
    flat = matrix.flatten(1)
    scale = (flat * product).sum(-1) / product.square().sum(-1).clamp(min=1e-300)
    return (flat - scale[:, None] * product).norm(dim=-1), scale


def _step(matrix: Tensor, forms: Tensor, scale: Tensor, damping: Tensor) -> Tensor:
    """Forms of norm 1 and rank two after one damped step along them."""
    flat = forms.flatten(2)
    first, second = (_with(forms[:, 1 - k]) * scale[:, None, None] for k in (0, 1))
    value = matrix.flatten(1) - (first @ flat[:, 0, :, None])[..., 0]
    jacobian = torch.cat([first, second], dim=-1)
    # the scale of the second form is that of the first, and the rank stays two
    left, right = null_vectors(forms)
    across = (left[..., :, None] * right[..., None, :]).flatten(2)
    zero = torch.zeros_like(across[:, 0])
    fixed = [[across[:, 0], zero], [zero, across[:, 1]], [zero, flat[:, 1]]]
    rows = torch.stack([torch.cat(pair, dim=-1) for pair in fixed], dim=1)
    system = jacobian.mT @ jacobian + rows.mT @ rows + torch.diag_embed(damping[:, None].expand(-1, 18))
    step = torch.linalg.solve_ex(system, jacobian.mT @ value[..., None])[0].nan_to_num(nan=0.0, posinf=0.0, neginf=0.0)
    moved = forms + step[..., 0].unflatten(-1, (2, 3, 3))
    right = null_vectors(moved)[1]
    moved = moved - (moved @ right[..., None]) * right[..., None, :]
    return moved / torch.linalg.matrix_norm(moved, keepdim=True).clamp(min=1e-300)


def _with(form: Tensor) -> Tensor:
    """The isometric product with a given form ``(b, 3, 3)`` as a map ``(b, 36, 9)`` of the other."""
    table = _product_table(form.device).to(form.dtype)
    return (form.flatten(1) @ table).unflatten(-1, (36, 9))


@constant
def _product_table(device: torch.device) -> Tensor:
    """Coefficients ``(9, 36 * 9)`` of the isometric product of two forms."""
    collect = collecting(2, 2, torch.device("cpu"))
    collect = (collect / collect.norm(dim=-1, keepdim=True)).unflatten(-1, (3, 3))
    return torch.einsum("iac,jbd->cdijab", collect, collect).reshape(9, 36 * 9).to(device)


def _ordered(forms: Tensor) -> Tensor:
    """Both vectors ``(b, 2, 9)``, whose product does not know their order, in the one that a fixed measure gives them."""
    measure = forms.detach().square() @ torch.linspace(1, 2, 9, dtype=forms.dtype, device=forms.device)
    return torch.where((measure[:, 0] < measure[:, 1])[:, None, None], forms.flip(1), forms)

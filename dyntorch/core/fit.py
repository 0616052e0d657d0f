"""fit(): matches -> normalization -> estimation matrix or Gram -> null space -> tensor, for every invariant."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import torch
from torch import Tensor

from dyntorch.core.invariant import Invariant, as_invariant
from dyntorch.core.kernel_fit import slot_kinds
from dyntorch.core.matches import Matches, check_plain, matches, relative_weights
from dyntorch.core.matrix import estimation_matrix, gram, labelled_rows, triangular_factor, within_noise
from dyntorch.core.normalize import Normalization, denormalize, normalization
from dyntorch.core.outcome import Status, is_failure
from dyntorch.core.primitives import Primitive
from dyntorch.core.solution import Solution, with_copies
from dyntorch.native import library
from dyntorch.numerics.blocks import each, map_blocks, one_thread, replace_problems, select, workers
from dyntorch.numerics.eigenspaces import RESOLVED, on_host, orthonormal
from dyntorch.numerics.function_transforms import needs_gradient, over_problems
from dyntorch.numerics.nullspace import GramNullSpace, gram_null_space, null_space

MAX_RELATIVE_NOISE = 0.5
"""Residual energy of the solution times the harmonic sum of that of all other directions: above it another tensor fits as well.
Measured: 0.02 for the homography tensor at 2 px and 0.1 at 5 px (100 matches), 0.01 to 0.1 for the tensors of space at usual noise;
1 to 5 for scenes of lower rank with noise (velocities in a plane, lines that only translate), 3 % of them below 0.5."""
MAX_NARROW_WIDTH, MIN_SPARE_ROWS, CHANCE_FACTOR, CHANCE_QUANTILE = 9, 5, 1.3, -2.576
"""A tensor of up to 9 entries has few other directions, and from few matches one is small by chance: random matches passed
AMBIGUOUS in 5 % of 1500 problems for 12 in one dimension (16 % for 8) and in 1.4 % for a fundamental matrix of 16.  There the limit
is the 0.5 % quantile of chi-square over the rows to spare, times what random matches showed it to be off (1.1 to 2); true
collineations of a line keep it at noise of 3 % of the scene (8 matches) to 10 % (12).  Fewer than 5 rows to spare judge nothing."""
MAX_GRAM_ROUNDING = 1e-10
"""Rounding error of a null vector from a float64 Gram, eps * (s_1 / s_{D-1})^2, above which the matrix itself is decomposed, unless
the noise outweighs it a thousandfold anyway."""
MAX_GRADIENT_ROUNDING = 1e-6
"""The same rounding error, as that of derivatives, which come from a Gram in any case, above which the rows are levelled first
(unless the noise, which the derivatives of levelled rows leave out, outweighs it)."""
ROUNDING = 32.0
"""Singular value, in units of eps times the largest, up to which exact matches make it by their rounding: those that the Gram calls
degenerate are so in their rows as well.  Measured on 70 kinds of degenerate matches: 3 at most where the centre of the views is
within their extent; a centre so many extents away loses so many times the digits.  Of general matches the smallest was 1e5."""
MIN_CONDITION_OF_NOISE = 5e5
"""Trace of the Gram times the harmonic sum of its other eigenvalues above which noise may reach the last of them.  General motion
has 1e4 (lines) to 3e5 (constant velocity, 60 matches), data of lower rank 1e6 at noise of 1 % of the scene and 1e9 at 0.03 %."""
KERNEL_LIMITS = (
    RESOLVED,
    MAX_GRAM_ROUNDING,
    MIN_CONDITION_OF_NOISE,
    MAX_RELATIVE_NOISE,
    MAX_NARROW_WIDTH,
    MIN_SPARE_ROWS,
    CHANCE_FACTOR,
    CHANCE_QUANTILE,
)
"""In the order in which the kernel takes them."""
BLOCK, MIN_BLOCK = 5 << 19, 1 << 20
"""Numbers in the largest temporary of one block of the batch, summed in pieces by the Gram, and fewest in a block that is cut for
the sake of another core.  Measured best: 364 problems of 200 points of the plane (47 us each; 128: 59), 131 of space.  100 problems
of 100 points take 3.9 ms on one core; cut for two they take 5.5."""


@one_thread
def fit(
    invariant: Invariant | type[Invariant],
    *views: Tensor,
    weights: Tensor | None = None,
    static: Tensor | None = None,
    dimensions: Tensor | None = None,
    normalize: bool = True,
    **given: Tensor,
) -> Solution:
    r"""Fit a multilinear invariant to matches: the null vector(s) of the estimation matrix, for a whole batch at once.

    Every match puts rows :math:`u_1 \otimes u_2 \otimes \dots` into a matrix whose null space holds the tensor.  The matches
    are normalized, the Gram of the matrix is summed up without building the matrix, its null space is found with a
    certificate (problems that are ill-conditioned take the matrix itself), and the tensor is carried back.  Differentiable
    with respect to matches and weights.

    Args:
        invariant: an invariant class such as ``dyntorch.HomographyTensor``, or an instance of a family: ``Collineation(3)``.
        *views: matches, one argument per view, ``(*batch, n, ...)``; NaN = missing.
        weights: ``(*batch, n)`` not negative; 0 leaves a match out.
        static: ``(*batch, n)`` bool: matches known not to move add all their rows (segmented configuration, thesis 8.1).
        dimensions: ``(*batch, n)`` integers in place of it: dimension of the linear subspace that each match is known to stay in, 1
            for a static point, 2 for a line, up to ``invariant.within``, which says nothing new.
        normalize: False skips the similarity of every view (for matches that are of order 1 already).
        **given: what else the invariant takes, by name.

    Returns:
        A :class:`Solution` with ``tensor``, ``status``, ``singular_values``, ``motion``; same dtype and device as the views.

    Raises:
        ValueError: misuse - too few matches per problem, shapes, dtypes or devices that do not agree.

    Source: thesis chapters 2, 3, 8; Hartley 1997 (normalization).

    Example:
        >>> import torch, dyntorch as dyn
        >>> x2 = torch.rand(20, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
        >>> A = torch.tensor([[1.0, 0.1, 2.0], [-0.1, 1.0, 3.0], [0.1, 0.2, 1.0]], dtype=torch.float64)
        >>> p1 = torch.cat([x2, torch.ones(20, 1, dtype=torch.float64)], dim=-1) @ A.T
        >>> solution = dyn.fit(dyn.Collineation(2), p1[:, :2] / p1[:, 2:], x2)
        >>> solution
        Solution(Collineation(n=2), matches=20, batch=(): 1 OK)
        >>> (solution.tensor / solution.tensor[2, 2]).mul(1000).round().div(1000).tolist()
        [[1.0, 0.1, 2.0], [-0.1, 1.0, 3.0], [0.1, 0.2, 1.0]]
    """
    invariant, views = as_invariant(invariant).bind_arguments(views, weights, **given)
    return fit_matches(invariant, matches(invariant, views, weights, static, dimensions, mapped=True), normalize=normalize)


def fit_matches(invariant: Invariant, data: Matches, *, normalize: bool = True) -> Solution:
    """:func:`fit` for checked matches."""
    few = data.count < invariant.minimal()
    if data.static is not None:
        # a static match frees one slot at a time; how many of its rows are new the rank will say
        few = few and data.count * max(labelled_rows(invariant.primitives)) < invariant.width() - invariant.nullity
    if data.views[0].shape[0] and few:
        raise ValueError(f"{invariant!r} needs at least {invariant.minimal()} matches, got {data.count}; add matches")
    check_plain(invariant)
    solve = partial(_fit_blocks, invariant, normalize, torch.finfo(data.dtype).eps)
    (views, present), fits = over_problems(solve, data.views, data.weights, data.static)
    data = replace(data, views=views, weights=present)
    norm = Normalization.of(invariant, fits.transforms)
    tensor, status, uncertainty = (data.back(part) for part in (fits.tensor, fits.status, fits.uncertainty))
    return Solution(invariant, tensor, uncertainty, data, norm, fits.normalized, status=status)


class LinearFits(NamedTuple):
    """Linear fits of a block of problems, in their own coordinates and in normalized ones."""

    tensor: Tensor
    normalized: Tensor
    status: Tensor
    uncertainty: Tensor
    transforms: tuple[Tensor, ...]
    """As in :class:`~dyntorch.core.normalize.Normalization`."""


def _fit_blocks(
    invariant: Invariant, normalize: bool, precision: float, views: tuple[Tensor, ...], weights: Tensor, static: Tensor | None
) -> tuple[tuple[tuple[Tensor, ...], Tensor], LinearFits]:
    """Views and weights ``(b, n, ...)`` with what they lack filled in, and the linear fits of all problems."""
    views, weights = invariant.fill_missing(views, weights)
    count = weights.shape[-1]
    per_problem = count * max(1, invariant.copies or 1) * _largest(invariant)
    max_size, min_size = (max(1, number // max(1, per_problem)) for number in (BLOCK, MIN_BLOCK))
    size = min(max_size, max(min_size, -(-len(weights) // workers())))
    copies = with_copies(invariant, views, weights, static)
    return (views, weights), map_blocks(partial(_fit_block, invariant, normalize, precision), *copies, size=size)


def _largest(invariant: Invariant) -> int:
    """Numbers per match in the largest temporary of the Gram."""
    packed = math.prod(p.width * (p.width + 1) // 2 for p in invariant.primitives[1:])
    return packed if len(invariant.primitives) > 1 else invariant.width() * invariant.rows()


def _fit_block(
    invariant: Invariant, normalize: bool, precision: float, views: tuple[Tensor, ...], weights: Tensor, static: Tensor | None
) -> LinearFits:
    """One block: by the kernel where there is one, what it leaves by torch."""
    kinds = slot_kinds(invariant, views, weights, static)
    if not kinds or not weights.numel():
        return _fit_by_torch(invariant, normalize, precision, views, weights, static)
    fits, left = _fit_by_kernel(invariant, kinds, normalize, views, weights)
    if len(left) == len(weights):
        return _fit_by_torch(invariant, normalize, precision, views, weights, None)
    if len(left):
        rest = _fit_by_torch(invariant, normalize, precision, tuple(x[left] for x in views), weights[left], None)
        fits = replace_problems(fits, left, rest)
    return fits


def _fit_by_kernel(
    invariant: Invariant, kinds: Sequence[int], normalize: bool, views: tuple[Tensor, ...], weights: Tensor
) -> tuple[LinearFits, Tensor]:
    """Fits of one block, and the problems ``(k,)`` that they say nothing of."""
    vectors, given = library.VECTORS in kinds, views
    norm: Normalization | None = None
    whole = invariant.nullity == 1 and library.CONIC_MONOMIALS not in kinds and not vectors
    if vectors:
        norm = normalization(invariant, views, relative_weights(weights)) if normalize else _identity(invariant, views)
        slots = zip(norm.primitives, norm.apply(invariant, views), strict=True)
        given = tuple(primitive.vectors(x)[..., 0, :] for primitive, x in slots)
    found = library.fit_points(
        kinds,
        given,
        weights,
        [p.width for p in invariant.primitives],
        dim=invariant.nullity,
        normalized=normalize and not vectors,
        rows=invariant.rows(),
        minimal=invariant.minimal(),
        constraint=invariant.constraint if whole else None,
        limits=KERNEL_LIMITS,
    )
    transforms = tuple(found.transforms) if norm is None else norm.transforms
    left = place = found.status[:0]
    if bool(found.flags.any()):
        left, place = ((found.flags == flag).nonzero()[:, 0] for flag in (library.UNDECIDED, library.WEAK))
    if len(place):
        norm = norm or Normalization.of(invariant, transforms)
        moved = tuple(p.move(x[place], t[place]) for p, x, t in zip(invariant.primitives, views, transforms, strict=True))
        parts = (norm.primitives, moved, relative_weights(weights[place]), None, found.basis[place], invariant.resolves_noise)
        noisy = place[within_noise(*parts, second=found.second[place, None])]
        found.status[noisy] = found.status[noisy].where(found.status[noisy] != int(Status.OK), int(Status.AMBIGUOUS))
    if whole:
        order = (0, *(1 + v for v in invariant.axes()))
        tensors = found.tensor.permute(order), found.normalized.permute(order)
        return LinearFits(*tensors, found.status, found.uncertainty, transforms), left
    norm = norm or Normalization.of(invariant, transforms)
    tensor = invariant.normalize(transforms).constrain(invariant.tensor_of(found.basis))
    return _carried_back(invariant, norm, tensor, found.status, found.uncertainty), left


def _fit_by_torch(
    invariant: Invariant, normalize: bool, precision: float, views: tuple[Tensor, ...], weights: Tensor, static: Tensor | None
) -> LinearFits:
    """One block."""
    # components first in memory: every later pass then runs along the matches
    views = tuple(x.mT.contiguous().mT for x in views)
    # weights of any unit: a problem that counts its matches in thousands is no different
    weights = relative_weights(weights)
    fixed = invariant.intrinsic or not normalize
    norm = _identity(invariant, views) if fixed else normalization(invariant, views, weights)
    moved = norm.apply(invariant, views)
    own = invariant.estimate_tensor(moved, weights)
    if own is None:
        # as many digits as the measurements have, less those that their distance from the origin takes
        away = torch.stack([t[..., :-1, -1].norm(dim=-1) for t in norm.transforms]).amax(0).detach()
        rows = EstimationRows(norm.primitives, moved, weights, static, ROUNDING * precision * (1 + away))
        basis, status, uncertainty = _solve_null_space(invariant, rows)
        tensor = invariant.normalize(norm.transforms).constrain(invariant.tensor_of(basis))
    else:
        tensor, uncertainty = own.tensor, own.uncertainty
        status = _status(own.few, own.degenerate, own.ambiguous)
    if invariant.copies is not None:
        status, uncertainty = status.amax(-1), uncertainty.amax(-1)
    return _carried_back(invariant, norm, tensor, status, uncertainty)


def _carried_back(invariant: Invariant, norm: Normalization, tensor: Tensor, status: Tensor, uncertainty: Tensor) -> LinearFits:
    """Fits of normalized matches in the measured coordinates."""
    tensor = select(~is_failure(status), tensor, 0.0)
    # coordinates may be so large or small that float64 holds no tensor of theirs
    back = denormalize(invariant, tensor, norm.actions)
    flat = back.detach().flatten(status.ndim)
    representable = flat.isfinite().all(-1) & (flat != 0).any(-1)
    status = torch.where(representable | is_failure(status), status, int(Status.DEGENERATE))
    sound = ~is_failure(status)
    return LinearFits(select(sound, back, 0.0), select(sound, tensor, 0.0), status, uncertainty, norm.transforms)


@dataclass(frozen=True)
class EstimationRows:
    """What the estimation matrices of a block of problems are made of: normalized matches."""

    primitives: tuple[Primitive, ...]
    views: tuple[Tensor, ...]
    weights: Tensor
    static: Tensor | None
    rounding: Tensor
    """``(*batch,)`` singular value, of the largest, up to which it is rounding of the measurements."""

    def of(self, place: tuple[Tensor, ...]) -> EstimationRows:
        """Those of some problems, where none has primitives of its own."""
        return EstimationRows(self.primitives, *each(lambda x: x[place], (self.views, self.weights, self.static, self.rounding)))

    @property
    def parts(self) -> tuple[tuple[Primitive, ...], tuple[Tensor, ...], Tensor, Tensor | None]:
        """As the functions of :mod:`dyntorch.core.matrix` take them."""
        return self.primitives, self.views, self.weights, self.static


def _solve_null_space(invariant: Invariant, rows: EstimationRows) -> tuple[Tensor, Tensor, Tensor]:
    """Null space ``(*batch, nullity, D)``, status and uncertainty ``(*batch,)`` of normalized matches."""
    nullity, width, weights = invariant.nullity, invariant.width(), rows.weights
    present = (weights > 0).sum(-1) * invariant.rows()
    if rows.static is not None:
        for free, count in enumerate(labelled_rows(rows.primitives), start=1):
            present = present + ((weights > 0) & (rows.static == free)).sum(-1) * (count - invariant.rows())
    g = gram(*rows.parts)

    def factor(chosen: Tensor) -> Tensor:
        if invariant.copies is not None:
            return triangular_factor(*rows.parts)[chosen]
        return triangular_factor(*rows.of((chosen,)).parts)

    few = present < width - nullity
    if rows.static is None:
        few = few | ((weights > 0).sum(-1) < invariant.minimal())
    space, judged_by_rows = _null_space_by_rows(g, nullity, factor, torch.where(few, torch.inf, rows.rounding))
    basis = space.basis
    spare = (present - (width - nullity)).clamp(min=0)
    trace = g.diagonal(dim1=-2, dim2=-1).sum(-1)
    # frames of single matches, from points of theirs, may be all noise, and then nothing looks weak
    limit = 0.0 if invariant.intrinsic else MIN_CONDITION_OF_NOISE
    square, rounding, weak = _relative_noise(space.residual, space.competing, trace, spare, limit)
    exact = _outweighs_noise(rounding, square)
    exact = (exact.index_fill(0, judged_by_rows, True) if len(judged_by_rows) else exact) & ~space.degenerate
    weak = weak & ~space.degenerate
    if invariant.copies is not None:
        weak = torch.zeros_like(weak)
    worn = exact & (rounding > MAX_GRADIENT_ROUNDING) & (rounding > square) & needs_gradient(g)
    # an accelerator waits once per block for all answers: what a tensor and its status are must not depend on where it lives
    asked = int((exact & ~worn).any().long() + 2 * weak.any() + 4 * worn.any())
    if asked & 1:
        basis = _with_matrix(basis, exact & ~worn, null_space, rows, invariant, host=bool(len(judged_by_rows)))
    if asked & 4:
        basis = _with_matrix(basis, worn, _preconditioned_null_space, rows, invariant, host=bool(len(judged_by_rows)))
    ambiguous = square * present.clamp(min=1) > _ambiguity_limit(spare, width)
    if asked & 2:
        place = weak.nonzero(as_tuple=True)  # an accelerator waits here, and for every mask that is an index
        with torch.no_grad():
            ambiguous[place] |= within_noise(*rows.of(place).parts, basis[place], invariant.resolves_noise)
    return basis, _status(few, space.degenerate, ambiguous), square.sqrt()


def _relative_noise(
    residual: Tensor, competing: Tensor, trace: Tensor, spare: Tensor, limit: float = MIN_CONDITION_OF_NOISE
) -> tuple[Tensor, Tensor, Tensor]:
    """The noise that a solution leaves, per row, against what every other direction has, squared; the rounding of its Gram; and
    whether the last of the others may be noise alone.  residual ``(*batch, nullity)``, the rest ``(*batch,)``."""
    noise = residual.clamp(min=0).mean(-1) / spare.clamp(min=1)
    square = torch.where(spare > 0, noise * competing, torch.zeros_like(noise)).detach()
    condition = (trace * competing).detach()
    return square, torch.finfo(trace.dtype).eps * condition, (spare > 0) & (condition > limit)


def _outweighs_noise(rounding: Tensor, square: Tensor) -> Tensor:
    """Whether the rows are to be decomposed: rounding of the Gram is neither small nor far below the noise."""
    return (rounding > MAX_GRAM_ROUNDING) & (rounding > 1e-3 * square)


def _ambiguity_limit(spare: Tensor, width: int) -> Tensor:
    """Of :data:`MAX_RELATIVE_NOISE` for so many rows to spare ``(*batch,)``, such that matches by chance stay above it."""
    if width > MAX_NARROW_WIDTH:
        return torch.full_like(spare, MAX_RELATIVE_NOISE, dtype=torch.float64)
    # the quantile of chi-square over its mean (Wilson and Hilferty)
    part = 2 / (9 * spare.clamp(min=MIN_SPARE_ROWS).double())
    return torch.where(
        spare >= MIN_SPARE_ROWS,
        (CHANCE_FACTOR * (1 - part + CHANCE_QUANTILE * part.sqrt()) ** 3).clamp(max=MAX_RELATIVE_NOISE),
        MAX_RELATIVE_NOISE,
    )


def _status(few: Tensor, degenerate: Tensor, ambiguous: Tensor) -> Tensor:
    """The first of these that holds."""
    status = torch.where(ambiguous, int(Status.AMBIGUOUS), int(Status.OK))
    status = torch.where(degenerate, int(Status.DEGENERATE), status)
    return torch.where(few, int(Status.TOO_FEW), status)


def _null_space_by_rows(
    gram: Tensor, dim: int, factor: Callable[[Tensor], Tensor], tolerance: Tensor
) -> tuple[GramNullSpace, Tensor]:
    r"""``gram_null_space`` whose ``degenerate`` does not depend on the device, and is what the rows say, not their squares.
    gram ``(b, ..., D, D)``, factor ``(k,)``, tolerance ``(b, ...)`` -> ``(k,)``."""
    space = gram_null_space(gram, dim)
    asked = tolerance.isfinite().expand_as(space.degenerate)
    doubted = _some(space.degenerate & asked)
    if not len(doubted):
        return space, doubted
    if not on_host(gram):
        space = _replace_problems(space, doubted, **vars(gram_null_space(gram[doubted].cpu(), dim)))
        doubted = _some(space.degenerate & asked)
        if not len(doubted):
            return space, doubted
    values = _singular_values(factor(doubted).detach().cpu(), gram.shape[-1])
    others, null = values[..., :-dim], values[..., -dim:].flip(-1)
    lost = others[..., -1] <= tolerance[doubted].cpu() * values[..., 0]
    # of a null space that is larger there is nothing to say
    competing = torch.where(lost[..., None], 1.0, others).square().reciprocal().sum(-1)
    return _replace_problems(space, doubted, residual=null.square(), competing=competing, degenerate=lost), doubted


def _some(flagged: Tensor) -> Tensor:
    """Problems ``(k,)`` with a flag, of ``(b, ...)``."""
    return flagged.flatten(1).any(-1).nonzero()[:, 0] if flagged.ndim > 1 else flagged.nonzero()[:, 0]


def _replace_problems(space: GramNullSpace, place: Tensor, **parts: Tensor) -> GramNullSpace:
    """The null spaces with these parts of some problems."""
    put = {name: (values := getattr(space, name)).index_put((place,), part.to(values.device)) for name, part in parts.items()}
    return replace(space, **put)


def _singular_values(factor: Tensor, size: int) -> Tensor:
    """``(..., D)``, descending; 0 of a matrix that is not finite, and those that fewer rows lack."""
    finite = torch.isfinite(factor).flatten(-2).all(-1)[..., None, None]
    values: Tensor = torch.linalg.svdvals(torch.where(finite, factor, 0.0))
    return torch.nn.functional.pad(values, (0, size - values.shape[-1]))


def _with_matrix(
    basis: Tensor, exact: Tensor, solve: Callable[[Tensor, int], Tensor], rows: EstimationRows, invariant: Invariant, *, host: bool
) -> Tensor:
    """Replace the null spaces of the chosen problems by those of their estimation matrices, which are not squared. basis
    ``(*batch, nullity, D)``, exact ``(*batch,)``, solve ``(k, rows, D)``."""
    place = exact.nonzero(as_tuple=True)
    matrix = estimation_matrix(*rows.of(place).parts) if invariant.copies is None else estimation_matrix(*rows.parts)[place]
    solution = solve(matrix.cpu() if host else matrix, invariant.nullity)
    return basis.index_put(place, solution.to(basis.device))


def _preconditioned_null_space(matrix: Tensor, dim: int) -> Tensor:
    r"""``null_space`` of rows that hardly tell some vectors from null ones."""
    with torch.no_grad():
        finite = torch.isfinite(matrix).flatten(1).all(-1)[:, None, None]
        values, frame = torch.linalg.svd(torch.where(finite, matrix, 0.0), full_matrices=matrix.shape[-2] < matrix.shape[-1])[1:]
        others = values[:, : matrix.shape[-1] - dim].clamp(min=torch.finfo(values.dtype).tiny)
        size = torch.cat([others, others[:, -1:].expand(-1, dim)], dim=-1)
        level = frame.mT / size[:, None, :]
    return orthonormal(level @ null_space(matrix @ level, dim).mT).mT


def _identity(invariant: Invariant, views: tuple[Tensor, ...]) -> Normalization:
    transforms = []
    for primitive, x in zip(invariant.primitives, views, strict=True):
        eye = torch.eye(primitive.dim + 1, dtype=x.dtype, device=x.device)
        transforms.append(eye.expand(*x.shape[: primitive.match_axis(x)], -1, -1))
    return Normalization.of(invariant, transforms)

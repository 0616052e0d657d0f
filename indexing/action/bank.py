"""All pairs of windows compared at once: residuals between views, fused, and the similarity kernels for learning.

``nearest`` is what scorer A stands on (the epipolar residual, free of the viewpoint), ``Kernels`` what scorer B stands on
(heights, which a turn about the vertical leaves alone, and the whole image, which is bound to the view).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any, TypeVar

import torch
from torch import Tensor

from dyntorch.numerics import canonical_correlation, orthonormal_basis
from indexing.action.options import MachineOptions, NearestOptions
from indexing.modelfile import stored

# ----------------------------------------------------------------------------------------------------------------------
# Channels: the same window seen with different things taken away, each carrying its own evidence.
#
# A window is ``(length, joints, 2)``.  ``clip`` keeps pose and motion, ``frame`` drops where the person is, ``motion`` drops
# the pose, ``velocity`` keeps only change.  Measured and not useful: scaling every frame, frame-centred velocity or motion,
# mean pose, acceleration.


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

    covariance: Tensor = field(metadata=stored("real", "channels", "joints", "joints", name="metric"))  # float64
    power: float = field(metadata=stored("real", name="metric_power", least=0, most=10))  # alpha
    floor: float = field(default=NearestOptions.floor, kw_only=True)  # lambda

    @classmethod
    def learn(cls, windows: Tensor, seen: Tensor, power: float, floor: float = NearestOptions.floor) -> JointMetric:
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
        return cls(torch.stack(covariances), power, floor=floor)

    def weights(self, name: str, joints: Tensor | slice = slice(None)) -> Tensor | None:
        """``(joints, joints)`` W of one channel among the chosen joints; ``None`` where it is the identity."""
        if self.power == 0:
            return None
        sigma = self.covariance[CHANNELS.index(name)][joints][:, joints]
        values, vectors = torch.linalg.eigh(sigma)
        return ((vectors * (values.clamp(min=0) + self.floor) ** -self.power) @ vectors.mT).float()

    def apply(self, windows: Tensor, name: str, joints: Tensor | slice = slice(None)) -> Tensor:
        """``(N, length' * joints, dims)``: a channel of the windows, weighted and laid out as tall matrices."""
        x = channel(windows, name)
        weights = self.weights(name, joints)
        if weights is not None:
            x = torch.einsum("jk,ntkd->ntjd", weights.to(x), x)
        return x.flatten(1, 2)


NEAREST = ("clip", "frame", "motion")  # channels of the epipolar residual; velocity adds nothing there
EPSILON = 1e-3  # added to residuals before the log: the noise floor (1e-4 gives the same accuracy)
PAIR_BLOCK = 2_000_000  # pairs of windows in flight: bounds memory, and keeps the intermediate matrices in cache
TABLE_BLOCK = 25_000_000  # entries of a table with every copy of every exemplar: 100 MB


@dataclass(frozen=True)
class Windows:
    """Batched windows and the joints that were seen in each.

    values: ``(N, length, joints, dims)`` float32 without NaN; seen: ``(N, joints)`` bool.
    """

    values: Tensor = field(metadata=stored("real", "rows", "length", "joints", 2))
    seen: Tensor = field(metadata=stored("truth", "rows", "joints"))

    def __len__(self) -> int:
        return len(self.values)

    def __getitem__(self, index: Tensor | slice) -> Windows:
        return Windows(self.values[index], self.seen[index])

    def to(self, device: torch.device | str) -> Windows:
        """The same windows on another device."""
        return Windows(self.values.to(device), self.seen.to(device))

    def patterns(self) -> Iterator[tuple[Tensor, Tensor]]:
        """``(indices, joints seen)`` of every group of windows with the same joints seen."""
        if bool(self.seen.all()):
            yield torch.arange(len(self), device=self.values.device), self.seen.new_ones(self.seen.shape[1])
            return
        rows, group = self.seen.unique(dim=0, return_inverse=True)
        for i, joints in enumerate(rows):
            yield (group == i).nonzero()[:, 0], joints


def stack(parts: list[Windows]) -> Windows:
    """Windows end to end."""
    return Windows(torch.cat([part.values for part in parts]), torch.cat([part.seen for part in parts]))


COMMON = 3  # joints that two windows must share: two always fit one another


@dataclass(frozen=True)
class Described:
    """Windows as they are compared, described once for all comparisons: tensors whose first axis is the windows'."""

    parts: tuple[Tensor, ...]

    def __len__(self) -> int:
        return len(self.parts[0])

    def __getitem__(self, index: slice) -> Described:
        return Described(tuple(part[index] for part in self.parts))


Side = TypeVar("Side", Tensor, Described)


def between(
    query: Windows,
    bank: Windows,
    compare: Callable[[Side, Side, Tensor | slice], Tensor],
    worst: float,
    describe: Callable[[Tensor, Tensor | slice], Side] | None = None,
) -> Tensor:
    """Fill a ``(queries, bank)`` table from ``compare(queries, bank, joints)``, on the joints both sides saw.

    Windows are grouped by which joints were seen, so that a comparison is always exact on the joints it has; pairs that
    share fewer than three joints get the value ``worst``.

    Args:
        describe: what is compared of ``(N, length, joints, dims)`` values among some joints; the values themselves by default.
            It is called once for all comparisons of a group.
    """
    groups = list(bank.patterns())
    out = query.values.new_empty(len(query), len(bank))
    for rows, seen in query.patterns():
        for columns, known in groups:
            both = seen & known
            if int(both.sum()) < min(COMMON, len(both)):
                out[rows[:, None], columns] = worst
                continue
            joints: Tensor | slice = slice(None) if bool(both.all()) else both.nonzero()[:, 0]
            left: Any = query.values[rows][:, :, joints]
            right: Any = bank.values[columns][:, :, joints]
            if describe is not None:
                left, right = describe(left, joints), describe(right, joints)
            step = max(1, PAIR_BLOCK // max(1, len(columns)))
            for at in range(0, len(rows), step):
                out[rows[at : at + step, None], columns] = compare(left[at : at + step], right, joints)
    return out


def fused_residual(
    query: Windows,
    copies: list[Windows],
    metric: JointMetric,
    channels: tuple[str, ...] = NEAREST,
    weights: Tensor | None = None,
    terms: tuple[str, ...] = ("epi",),
) -> Tensor:
    r"""Residual of every query to every exemplar, the best over the exemplar's copies (crops, mirror images).

    .. math:: D(q, e) = \min_{\text{copies}} \sum_{c} w_c \sum_{\text{terms}} \log(r_c(q, e) + \epsilon)

    Terms: ``epi`` :math:`1 - s_1(U_q, U_e)`, the largest canonical correlation between the channel spaces under the joint
    metric (any viewpoint); ``up`` :math:`1 - \cos(y_q, y_e)`, heights only (upright cameras, turned about the vertical);
    ``nn`` :math:`1 - \cos(X_q, X_e)`, the whole image (one viewpoint); ``turned``
    :math:`1 - \max_R \cos(X_q R, X_e)` over turns R of flat cards about the vertical.

    Args:
        query: ``Q`` windows of images; copies: each with the same ``E`` exemplars; weights: ``(channels,)``, 1 by default.

    Returns:
        ``(Q, E)``; very negative = the two can be views of one action.

    Source: thesis chapter 7 (rank of stacked measurements).
    """

    if not copies:
        raise ValueError("no exemplar to compare with")
    spelled = [(i, *_TERMS[term]) for i in range(len(channels)) for term in terms]

    def describe(values: Tensor, joints: Tensor | slice) -> Described:
        applied = [metric.apply(values, name, joints) for name in channels]
        return Described(tuple(unit(applied[i]) for i, unit, _ in spelled))

    def product(left: Described, right: Described, joints: Tensor | slice) -> Tensor:
        total: Tensor | None = None
        for (i, _, correlation), a, b in zip(spelled, left.parts, right.parts, strict=True):
            residual = correlation(a, b).neg_().add_(1.0).clamp_(min=0.0).add_(EPSILON)
            if weights is not None and weights[i] != 1:
                residual = residual.pow_(float(weights[i]))
            total = residual if total is None else total.mul_(residual)
        if total is None:
            raise ValueError("no channel to compare")
        return total

    total_weight = len(channels) if weights is None else float(weights.sum())
    worst = (1.0 + EPSILON) ** (len(terms) * total_weight)
    bank, step = stack(copies), max(1, TABLE_BLOCK // sum(len(copy) for copy in copies))
    best = [
        between(query[at : at + step], bank, product, worst, describe).unflatten(1, (len(copies), -1)).amin(dim=1)
        for at in range(0, max(1, len(query)), step)
    ]
    return torch.cat(best).log_()


Unit = Callable[[Tensor], Tensor]


def _flat(x: Tensor) -> Tensor:
    return torch.nn.functional.normalize(x.flatten(1), dim=1)


def _product(a: Tensor, b: Tensor) -> Tensor:
    return a @ b.mT


def _solid(x: Tensor) -> Tensor:
    return x / x.flatten(1).norm(dim=1).clamp(min=1e-12)[:, None, None]


def _turned(a: Tensor, b: Tensor) -> Tensor:
    """A turn of a flat card scales its x by -1 to 1: the best one takes the product of the x without its sign."""
    return (a[..., 1] @ b[..., 1].mT).add_((a[..., 0] @ b[..., 0].mT).abs_())


# What is compared of a channel, and the correlation of two of them: 1 where they are the same.
_TERMS: dict[str, tuple[Unit, Callable[[Tensor, Tensor], Tensor]]] = {
    "epi": (orthonormal_basis, canonical_correlation),
    "up": (lambda x: _flat(x[..., 1]), _product),
    "nn": (_flat, _product),
    "turned": (_solid, _turned),
}


@dataclass
class Kernels:
    r"""Mean of Gaussian-like kernels :math:`K = \tfrac1k \sum_k \exp(-d_k / s_k)` on cosine distances :math:`d_k`.

    The distances: heights in each channel, the whole image in each channel, and the order-free moments of the heights; all
    are one GEMM of unit vectors, and the kernel is positive definite.  ``one_side`` adds what helps where all cameras stand
    on one side: the moments of the whole image, and the (indefinite) epipolar and affine-invariant distances (JHMDB .81 ->
    .87).  :math:`s_k` is half the median distance between training windows (twice that costs 1-2 %).
    """

    metric: JointMetric
    one_side: bool = False
    scales: Tensor | None = None

    @property
    def count(self) -> int:
        """How many distances there are."""
        one_side, moments = self.one_side, 3
        return len(CHANNELS) * (4 if one_side else 2) + moments * (2 if one_side else 1)

    def fit(self, windows: Windows, options: MachineOptions) -> Tensor:
        """Set the scales from training windows and return their ``(N, N)`` kernel matrix."""
        chosen = windows[torch.arange(0, len(windows), max(1, len(windows) // options.scale_windows))]
        scales = []
        for k in range(self.count):

            def one(left: Described, right: Described, joints: Tensor | slice, k: int = k) -> Tensor:
                return next(d for i, d in enumerate(self._distances(left, right)) if i == k)

            scales.append(kernel_scale(between(chosen, chosen, one, 1.0, self._describe), options.width))
        self.scales = torch.stack(scales)
        return self(windows, windows)

    def __call__(self, query: Windows, bank: Windows) -> Tensor:
        """``(Q, E)`` kernel matrix."""
        scales = self.scales
        if scales is None:
            raise ValueError("the kernels have no scales yet; fit them first")

        def total(left: Described, right: Described, joints: Tensor | slice) -> Tensor:
            out = scales.new_zeros(len(left), len(right))
            for scale, distance in zip(scales, self._distances(left, right), strict=True):
                out.add_(distance.div_(-scale).exp_())
            return out.div_(len(scales))

        return between(query, bank, total, 0.0, self._describe)

    def _describe(self, values: Tensor, joints: Tensor | slice) -> Described:
        """Unit vectors, and where bases are compared those with three axes."""
        parts = []
        for name in CHANNELS:
            x = self.metric.apply(values, name, joints)
            parts += [_flat(x[..., 1]), _flat(x), *([orthonormal_basis(x)] if self.one_side else [])]
        for whole_image in (False, True)[: 1 + self.one_side]:
            parts += [_flat(moment) for moment in order_free(values, whole_image)]
        return Described(tuple(parts))

    def _distances(self, left: Described, right: Described) -> Iterator[Tensor]:
        """``(Q, E)`` distances, one kernel after the other."""
        for a, b in zip(left.parts, right.parts, strict=True):
            if a.ndim == 3:
                yield 1 - canonical_correlation(a, b)
                yield 1 - canonical_correlation(a, b, shared=2)
            else:
                yield _product(a, b).neg_().add_(1.0).clamp_(min=0.0)


def kernel_scale(distances: Tensor, width: float) -> Tensor:
    """The scale of a kernel from the ``(N, N)`` distances of its training rows: ``width`` of the median between different rows."""
    off = ~torch.eye(len(distances), dtype=torch.bool, device=distances.device)
    return width * distances[off].median().clamp(min=1e-6 / width)


def cosine_distance(a: Tensor, b: Tensor) -> Tensor:
    """``(Q, E)`` 1 - cosine of the angle between rows."""
    return _product(_flat(a), _flat(b)).neg_().add_(1.0).clamp_(min=0.0)

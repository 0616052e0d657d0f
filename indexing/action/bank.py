r"""All pairs of windows compared at once: planes of space-time, residuals between views, fused, and the kernels for learning.

The image of a window in one channel is a tall matrix X with two columns, x and y of all joints over all frames.  With the
factorization :math:`X / \|X\| = U L^T`, U orthonormal and L lower triangular, the 2x2 product :math:`C = U_q^T U_e` of two windows
gives every evidence there is of the pair: the four entries for all pairs are two GEMMs, and the rest is elementwise.
The nearest exemplar of scorer A stands on the epipolar residual, free of the viewpoint; :class:`Kernels` of scorer B on heights,
which a turn about the vertical leaves alone, and on the whole image, which is bound to the view.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import lru_cache, partial
from itertools import groupby, product

import torch
from torch import Tensor

from dyntorch.numerics import map_blocks, native_residuals
from indexing.modelfile import store

GRAM_EPSILON = 1e-6  # of a 2x2 Gram, relative to its trace: as in dyntorch.numerics.orthonormal_basis
FEW_BLOCK = 8  # queries up to which one product that reads all windows once is faster: one query 6.2 ms for 10.2

Entries = tuple[Tensor, Tensor, Tensor, Tensor]  # 00, 01, 10, 11 of 2x2 matrices


def factorize(images: Tensor) -> tuple[Tensor, Tensor]:
    r"""Orthonormal rows and triangular factor of each image: :math:`X / \|X\| = U L^T`. images ``(N, 2, rows)`` ->
    ``(N, 2, rows)``."""
    # the unit is that of the largest entry: no square of it leaves the range
    largest = images.abs().amax((1, 2), keepdim=True)
    usable = largest.isfinite()
    if not bool(usable.all()):
        images, largest = torch.where(usable, images, 0.0), torch.where(usable, largest, 0.0)
    x = images / torch.where(largest > 0, largest, 1.0)
    g00, g01, _, g11 = (x @ x.mT).flatten(1).unbind(1)
    scale = (g00 + g11).clamp(min=torch.finfo(x.dtype).tiny).rsqrt()
    l00 = (g00 * scale**2 + GRAM_EPSILON).sqrt()
    l10 = g01 * scale**2 / l00
    l11 = (g11 * scale**2 + GRAM_EPSILON - l10**2).clamp(min=GRAM_EPSILON / 2).sqrt()
    inverse = torch.stack([1 / l00, torch.zeros_like(l00), -l10 / (l00 * l11), 1 / l11], dim=1).unflatten(1, (2, 2))
    return (inverse * scale[:, None, None]) @ x, torch.stack([l00, l10, l11], dim=1)


def entries(left: Tensor, right: Tensor) -> Entries:
    """``(Q, E)`` the four entries of C of all pairs, from U ``(Q, 2, rows)`` and ``(E, 2, rows)``."""
    count = len(left)
    both = left.transpose(0, 1).flatten(0, 1)
    if count <= FEW_BLOCK:
        c = (right.flatten(0, 1) @ both.mT).view(len(right), 2, 2, count).permute(2, 1, 3, 0).contiguous()
        return c[0, 0], c[0, 1], c[1, 0], c[1, 1]
    first, second = both @ right[:, 0].mT, both @ right[:, 1].mT
    return first[:count], second[:count], first[count:], second[count:]


def epipolar_correlation(c: Entries) -> Tensor:
    r"""``(Q, E)`` the largest singular value of C, the correlation of two images of one shape: 1 whatever the viewpoints."""
    c00, c01, c10, c11 = c
    one, other = c00 + c11, c01 - c10
    total = one.square_().addcmul_(other, other).sqrt_()
    one, other = c00 - c11, c01 + c10
    return total.add_(one.square_().addcmul_(other, other).sqrt_()).mul_(0.5)


def _products(c: Entries, left: Tensor, right: Tensor) -> tuple[Tensor, Tensor]:
    """Of x with x and of y with y of unit images, from L of both: ``X_q^T X_e = L_q C L_e^T``."""
    c00, c01, c10, c11 = c
    (l00, l10, l11), (m00, m10, m11) = left.T[..., None], right.T
    heights = (c00 * l10).addcmul_(c10, l11).mul_(m10)
    rest = (c01 * l10).addcmul_(c11, l11)
    heights.addcmul_(rest, m11)
    return torch.mul(c00, l00, out=rest).mul_(m00), heights


def _card_correlation(c: Entries, left: Tensor, right: Tensor) -> Tensor:
    """A turn of a flat card scales its x by -1 to 1: the best one takes the product of the x without its sign."""
    across, heights = _products(c, left, right)
    return across.abs_().add_(heights)


# Evidence of a pair of windows in one channel: a correlation, 1 where they are the same.
TERMS: dict[str, Callable[[Entries, Tensor, Tensor], Tensor]] = {
    "epi": lambda c, left, right: epipolar_correlation(c),
    "nn": lambda c, left, right: torch.add(*_products(c, left, right)),
    "turned": _card_correlation,
}


Terms = tuple[str, ...]  # that are fused in all channels


def fuse_terms(
    left: Sequence[Tensor], right: Sequence[Tensor], fusions: Sequence[Terms], powers: Sequence[float], epsilon: float
) -> list[Tensor]:
    r"""``(Q, E)`` products :math:`\prod_c \prod_{\text{terms}} (r_c + \epsilon)^{w_c}` of residuals, of each fusion."""
    tables: list[Tensor | None] = [None] * len(fusions)
    for i, power in enumerate(powers):
        (u, left_factor), (v, right_factor) = left[2 * i : 2 * i + 2], right[2 * i : 2 * i + 2]
        c = entries(u, v)
        for number, terms in enumerate(fusions):
            for term in terms:
                residual = TERMS[term](c, left_factor, right_factor).neg_().add_(1.0 + epsilon).clamp_(min=epsilon)
                if power != 1:
                    residual.pow_(power)
                table = tables[number]
                tables[number] = residual if table is None else table.mul_(residual)
    return [table for table in tables if table is not None]


WHITENING_POWER = 0.25  # of the joint metric: UTKinect .909 -> .919, few shots +3 %; .5 whitens too much
COVARIANCE_FLOOR = 0.1  # beside a mean diagonal of 1; .03 amplifies noise (-2 %), 1 whitens too little (-1 %; UTKinect, Florence3D)

# ----------------------------------------------------------------------------------------------------------------------
# Channels: the same window seen with different things taken away, each carrying its own evidence.
#
# A window is ``(length, joints, 2)``.  ``clip`` keeps pose and motion, ``frame`` drops where the person is, ``motion`` drops
# the pose, ``velocity`` keeps only change.  Measured and not useful: scaling every frame, frame-centred velocity or motion,
# mean pose, acceleration.


CHANNELS = ("clip", "frame", "motion", "velocity")


def channel(windows: Tensor, name: str) -> Tensor:
    """One channel of every window. windows ``(*batch, length, joints, dims)`` ->
    ``(*batch, length or length - 2, joints, dims)``."""
    if name == "clip":
        return windows - windows.mean(dim=(-3, -2), keepdim=True)
    if name == "frame":
        return windows - windows.mean(dim=-2, keepdim=True)
    if name == "motion":
        return windows - windows.mean(dim=-3, keepdim=True)
    if name == "velocity":
        return windows[..., 2:, :, :] - windows[..., :-2, :, :]
    raise ValueError(f"unknown channel {name!r}; known: {', '.join(CHANNELS)}")


def order_free_moments(windows: Tensor, whole_image: bool = False) -> Tensor:
    r"""Three moments of the joints that forget when in the window something happened. windows ``(batch, length, joints, 2)`` ->
    ``(3, batch, size * size)``."""
    still = channel(windows, "frame")
    still = still.flatten(-2) if whole_image else still[..., 1]
    moving = still - still.mean(dim=-2, keepdim=True)
    change = still[..., 1:, :] - still[..., :-1, :]
    return torch.stack([(x.mT @ x).flatten(-2) for x in (still, moving, change)])


def fill_unseen(windows: Tensor, seen: Tensor) -> Tensor:
    """Joints never seen, ``(N, joints)``, moved to the middle of the others, where they change no mean."""
    known = seen[:, None, :, None].to(windows)
    middle = (windows * known).sum(dim=2, keepdim=True) / known.sum(dim=2, keepdim=True).clamp(min=1.0)
    return torch.where(known > 0, windows, middle)


@dataclass(frozen=True)
class JointMetric:
    r"""How much each direction of joint space counts, per channel: :math:`W = (\Sigma + \lambda I)^{-\alpha}`."""

    covariance: Tensor = field(metadata=store("real", "channels", "joints", "joints", name="metric"))  # float64
    power: float = field(metadata=store("real", name="metric_power", least=0, most=10))  # alpha
    floor: float = field(default=COVARIANCE_FLOOR, kw_only=True)  # lambda

    @classmethod
    def learn(cls, windows: Tensor, seen: Tensor, power: float, floor: float = COVARIANCE_FLOOR) -> JointMetric:
        """From windows ``(N, length, joints, dims)`` and the joints seen in each, ``(N, joints)``."""
        windows = fill_unseen(windows, seen)
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


def flatten_channel(windows: Tensor, name: str, weights: Tensor | None) -> Tensor:
    """``(N, dims, length' * joints)``: each coordinate of a channel in one piece, its joints weighted."""
    x = channel(windows, name).movedim(-1, 1)
    return (x if weights is None else x @ weights.to(x).mT).flatten(2)


NEAREST = ("clip", "frame", "motion")  # channels of the epipolar residual; velocity adds nothing there
EPSILON = 1e-3  # added to residuals before the log: the noise floor (1e-4 gives the same accuracy)
PAIR_BLOCK = 2**16  # pairs of windows in flight: their tables stay in the cache (2 million: 50 ns a pair and channel, so 28)
DEVICE_BLOCK = 2**21  # the same elsewhere, where every call costs a launch
VALUE_BLOCK = 2**21  # the same where values are compared, not what is described of them: bounds memory
ROW_BLOCK = 128  # queries among them: enough for a fast matrix product
QUERY_BLOCK = 256  # queries that one worker describes at once: bounds memory
MIN_TO_PROJECT = 300  # windows from which principal directions are learned: fewer may not hold what others show
# of the energy of exemplars' planes, by the principal directions of a channel: residuals of motion are ten times those of poses.
# UTKinect stays at .9505 so, Florence3D turns .8762 to .8767, streams .8603 to .8608; .01 in all costs UTKinect .0015
MAX_LEFT_OUT = {"clip": 0.003, "frame": 0.003, "motion": 0.03}
MAX_SHARE_KEPT = 0.8  # of all directions, above which nothing is won
TINY = 1e-12  # norm of heights, in images of norm 1, below which they are none
MAX_CACHE_BYTES = 2**25  # bytes of the descriptions that a bank keeps: 32 MB; those it needed last stay in any case


@dataclass(frozen=True)
class Windows:
    """Batched windows and the joints that were seen in each."""

    values: Tensor = field(metadata=store("real", "rows", "length", "joints", 2))
    seen: Tensor = field(metadata=store("truth", "rows", "joints"))

    def __len__(self) -> int:
        return len(self.values)

    def __getitem__(self, index: Tensor | slice) -> Windows:
        return Windows(self.values[index], self.seen[index])

    def to(self, device: torch.device | str) -> Windows:
        """The same windows on another device."""
        return Windows(self.values.to(device), self.seen.to(device))


def mirror(windows: Tensor, permutation: Tensor) -> Tensor:
    """The same action done by the other side of the body: image mirrored, left and right joints exchanged."""
    flipped = windows[:, :, permutation].clone()
    flipped[..., 0].neg_()
    return flipped


def patterns(seen: Tensor) -> Iterator[tuple[Tensor, Tensor]]:
    """``(indices, joints seen)`` of every group of windows ``(N, joints)`` with the same joints seen."""
    if bool(seen.all()):
        yield torch.arange(len(seen), device=seen.device), seen.new_ones(seen.shape[1])
        return
    rows, group = seen.unique(dim=0, return_inverse=True)
    for i, joints in enumerate(rows):
        yield (group == i).nonzero()[:, 0], joints


def stack(parts: list[Windows]) -> Windows:
    """Windows end to end."""
    return Windows(torch.cat([part.values for part in parts]), torch.cat([part.seen for part in parts]))


MIN_SHARED_JOINTS = 3  # joints that two windows must share: two always fit one another


def compare_windows(
    query: Windows, bank: Windows, compare: Callable[[Tensor, Tensor, Tensor | slice], Tensor], worst: float
) -> Tensor:
    """Fill a ``(queries, bank)`` table from ``compare(queries, bank, joints)`` of values, on the joints both sides saw."""
    groups = list(patterns(bank.seen))
    out = query.values.new_empty(len(query), len(bank))
    for rows, seen in patterns(query.seen):
        for columns, known in groups:
            joints = _shared_joints(seen, known)
            if joints is None:
                out[rows[:, None], columns] = worst
            else:
                right = bank.values[columns][:, :, joints]
                for some in rows.split(max(1, VALUE_BLOCK // max(1, len(columns)))):
                    out[some[:, None], columns] = compare(query.values[some][:, :, joints], right, joints)
    return out


def _shared_joints(seen: Tensor, known: Tensor) -> Tensor | slice | None:
    """The joints that both sides saw; ``None`` where they are too few."""
    both = seen & known
    if int(both.sum()) < min(MIN_SHARED_JOINTS, len(both)):
        return None
    return slice(None) if bool(both.all()) else both.nonzero()[:, 0]


# ----------------------------------------------------------------------------------------------------------------------
# Exemplars, described once.  What a query costs beside its comparisons is the description of what it is compared with: mirror
# images, channels, the joint metric, bases.  A bank makes it on first use and keeps it.


@dataclass(frozen=True)
class Description:
    """Windows as they are compared: tensors whose first axis is the windows'."""

    parts: tuple[Tensor, ...]

    def __len__(self) -> int:
        return len(self.parts[0])

    def __getitem__(self, index: Tensor | slice) -> Description:
        return Description(tuple(part[index] for part in self.parts))

    @property
    def size(self) -> int:
        """Bytes."""
        return sum(part.numel() * part.element_size() for part in self.parts)


Describe = Callable[[Tensor], Description]  # of ``(N, length, joints, 2)`` values among some joints
Describer = Callable[[Tensor | slice], Describe]  # makes it for some joints
Compare = Callable[[Description, Description], Sequence[Tensor]]  # ``(Q, E)`` tables
Lower = Callable[[Description, Description, Sequence[Tensor], Tensor | None], bool]  # puts the least into columns of tables


@dataclass(frozen=True)
class Copy:
    """Images of exemplars that are compared as these: crops, mirror images."""

    windows: Windows
    numbers: Tensor | None = None
    symmetry: Tensor | None = None

    def select(self, chosen: Tensor) -> Copy:
        """Of some exemplars, ``(N,)`` bool."""
        numbers = chosen.nonzero()[:, 0] if self.numbers is None else self.numbers[chosen[self.numbers]]
        return dataclasses.replace(self, numbers=numbers)

    def groups(self) -> Iterator[tuple[Tensor | None, Tensor]]:
        """``(numbers, joints seen)`` of the exemplars that show the same joints."""
        seen = self.windows.seen if self.numbers is None else self.windows.seen[self.numbers]
        seen = seen if self.symmetry is None else seen[:, self.symmetry]
        for rows, known in patterns(seen):
            alone = self.numbers is None and len(rows) == len(seen)
            yield (None if alone else rows if self.numbers is None else self.numbers[rows]), known

    def values(self, numbers: Tensor | slice) -> Tensor:
        """``(N, length, joints, 2)`` of some."""
        values = self.windows.values[numbers]
        return values if self.symmetry is None else mirror(values, self.symmetry)


@dataclass(frozen=True)
class Facing:
    """Windows of a copy that show the same joints, as they face queries that show the same joints."""

    numbers: Tensor | None
    described: Description | None = None
    describe: Describe | None = None
    key: tuple[int, ...] = ()

    @property
    def size(self) -> int:
        """Bytes of what is kept."""
        return 0 if self.described is None else self.described.size

    def select(self, numbers: Tensor, place: Tensor) -> Facing:
        """Some exemplars only, given their numbers and the place of every exemplar among these, -1 without one."""
        if self.numbers is None:
            return self if self.described is None else dataclasses.replace(self, described=self.described[numbers])
        columns = place[self.numbers]
        kept = (columns >= 0).nonzero()[:, 0]
        described = None if self.described is None else self.described[kept]
        return dataclasses.replace(self, numbers=columns[kept], described=described)


class Bank:
    """Exemplars that queries are compared with again and again, described on first use and kept."""

    def __init__(self, copies: Sequence[Copy], describer: Describer) -> None:
        self._copies, self._describer = copies, describer
        self._cache: dict[tuple[bool, ...], list[Facing]] = {}

    def __len__(self) -> int:
        return len(self._copies[0].windows)

    def facing(self, seen: Tensor) -> list[Facing]:
        """All copies, as they face queries that saw these joints."""
        key = tuple(seen.tolist())
        found = self._cache.pop(key, None)
        if found is None:
            found = [one for copy in self._copies for one in self._describe_copy(copy, seen)]
        self._cache[key] = found  # the last one is the one used last
        for old in list(self._cache)[:-1]:
            if sum(one.size for faced in list(self._cache.values()) for one in faced) <= MAX_CACHE_BYTES:
                break
            self._cache.pop(old, None)
        return found

    def _describe_copy(self, copy: Copy, seen: Tensor) -> Iterator[Facing]:
        for numbers, known in copy.groups():
            joints, count = _shared_joints(seen, known), len(copy.windows) if numbers is None else len(numbers)
            if joints is None or not count:
                yield Facing(numbers)
                continue
            describe = partial(_describe_joints, joints, self._describer(joints))
            blocks = (slice(at, at + QUERY_BLOCK) for at in range(0, count, QUERY_BLOCK))
            parts = [describe(copy.values(some if numbers is None else numbers[some])) for some in blocks]
            described = Description(tuple(torch.cat(same) for same in zip(*(one.parts for one in parts), strict=True)))
            yield Facing(numbers, described, describe, (id(self._describer), *(seen & known).tolist()))


def _describe_joints(joints: Tensor | slice, describe: Describe, values: Tensor) -> Description:
    return describe(values[:, :, joints])


def min_over_copies(
    query: Windows,
    banks: Sequence[Bank],
    compare: Compare,
    worst: Sequence[float],
    chosen: Tensor | None = None,
    lower: Lower = lambda *_: False,
) -> list[Tensor]:
    """``(queries, exemplars)`` tables, each the least over the exemplars' copies of what ``compare`` says, or ``lower``, which does
    it faster where it can."""
    total = max((len(bank) for bank in banks), default=0)
    place = None
    if chosen is not None and not torch.equal(chosen, torch.arange(total, device=chosen.device)):
        place = torch.full((total,), -1, device=chosen.device)
        place[chosen] = torch.arange(len(chosen), device=chosen.device)
    width = total if chosen is None else len(chosen)
    out: list[Tensor] = []
    for rows, seen in patterns(query.seen):
        faced = [one for bank in banks for one in bank.facing(seen)]
        if place is not None and chosen is not None:
            faced = [one.select(chosen, place) for one in faced]
        faced.sort(key=lambda one: one.key)
        every = len(rows) == len(query)
        values = query.values if every else query.values[rows]
        size = QUERY_BLOCK if values.device.type == "cpu" else max(1, DEVICE_BLOCK // max(1, width))
        found: tuple[Tensor, ...] = map_blocks(partial(_tables, faced, (compare, lower), worst, width), values, size=size)
        if every:
            return list(found)
        out = out or [query.values.new_empty(len(query), width) for _ in worst]
        for table, part in zip(out, found, strict=True):
            table[rows] = part
    return out


def _tables(
    faced: list[Facing], ways: tuple[Compare, Lower], worst: Sequence[float], width: int, values: Tensor
) -> tuple[Tensor, ...]:
    """Of one block of queries that saw the same joints: compared with all that faces them, at once or tile by tile."""
    compare, lower = ways
    tables = tuple(values.new_full((len(values), width), torch.inf) for _ in worst)
    block = PAIR_BLOCK if values.device.type == "cpu" else DEVICE_BLOCK
    for _, alike in groupby(faced, key=lambda one: one.key):
        query: Description | None = None
        for one in alike:
            if one.describe is None or one.described is None:
                for table, bound in zip(tables, worst, strict=True):
                    _lower(table, one.numbers, table.new_full((1, 1), bound))
                continue
            query = one.describe(values) if query is None else query
            if lower(query, one.described, tables, one.numbers):
                continue
            tall = min(len(query), max(min(block, ROW_BLOCK), block // max(1, len(one.described))))
            wide = max(1, block // max(1, tall))
            for top, left in product(range(0, len(query), max(1, tall)), range(0, len(one.described), wide)):
                down, across = slice(top, top + tall), slice(left, left + wide)
                for table, part in zip(tables, compare(query[down], one.described[across]), strict=True):
                    if one.numbers is None:
                        _lower(table[down, across], None, part)
                    else:
                        _lower(table[down], one.numbers[across], part)
    return tables


def _lower(table: Tensor, columns: Tensor | None, values: Tensor) -> None:
    """Where values are less than a table, or some columns of it, they take their place."""
    if columns is None:
        torch.minimum(table, values, out=table)
    else:
        table.index_copy_(1, columns, torch.minimum(table.index_select(1, columns), values))


def fused_residuals(
    query: Windows,
    banks: Sequence[Bank],
    fusions: Sequence[Terms],
    chosen: Tensor | None = None,
    powers: Sequence[float] = (1.0,) * len(NEAREST),
) -> list[Tensor]:
    r"""Residual of every query to every exemplar of banks of planes (:func:`planes_of`), the best over its copies (crops, mirror
    images): a ``(queries, chosen)`` table for each fusion of terms. powers: of the channels."""
    worst = [(1.0 + EPSILON) ** (len(terms) * sum(powers)) for terms in fusions]

    def fuse(left: Description, right: Description) -> list[Tensor]:
        return fuse_terms(left.parts, right.parts, fusions, powers, EPSILON)

    def lower(left: Description, right: Description, tables: Sequence[Tensor], columns: Tensor | None) -> bool:
        return set(powers) == {1.0} and native_residuals(left.parts, right.parts, fusions, EPSILON, tables, columns)

    tables = min_over_copies(query, banks, fuse, worst, chosen, lower)
    return [table.log_() for table in tables]


def planes_of(metric: JointMetric, exemplars: Callable[[], Windows] | None = None) -> Describer:
    """A describer for :class:`Bank`: windows as planes, in each channel; where there are many exemplars, among the principal
    directions of theirs (:func:`principal_directions`)."""

    @lru_cache(maxsize=8)  # banks of all crops ask for the same joints, one after the other
    def bases(joints: tuple[int, ...] | None) -> list[tuple[Tensor | None, Tensor | None]]:
        chosen = slice(None) if joints is None else torch.tensor(joints, device=metric.covariance.device)
        weights = [metric.weights(name, chosen) for name in NEAREST]
        some = None if exemplars is None else exemplars()
        if some is not None:
            some = some[some.seen[:, chosen].all(dim=1)]
        if some is None or len(some) < MIN_TO_PROJECT:
            return [(one, None) for one in weights]
        values, found = some.values[:, :, chosen], []
        for name, one in zip(NEAREST, weights, strict=True):
            axes = factorize(flatten_channel(values, name, one))[0]
            found.append((one, principal_directions(axes, MAX_LEFT_OUT[name])))
        return found

    def among(joints: Tensor | slice) -> Describe:
        each = bases(None if isinstance(joints, slice) else tuple(joints.tolist()))

        def describe(values: Tensor) -> Description:
            parts: list[Tensor] = []
            for name, (weights, directions) in zip(NEAREST, each, strict=True):
                axes, factor = factorize(flatten_channel(values, name, weights))
                parts += [axes if directions is None else axes @ directions, factor]
            return Description(tuple(parts))

        return describe

    return among


def principal_directions(axes: Tensor, left_out: float) -> Tensor | None:
    """``(rows, K)`` the directions that hold all but a part of the energy of planes ``(N, 2, rows)``; ``None`` where they are many.

    Products of a plane with exemplars' among them are off by at most the root of what they leave out of both."""
    flat = axes.flatten(0, 1).double()
    values, vectors = torch.linalg.eigh(flat.mT @ flat)
    count = max(1, int((values.cumsum(0) > left_out * values.sum()).sum()))
    return vectors[:, -count:].to(axes).contiguous() if count < MAX_SHARE_KEPT * len(values) else None

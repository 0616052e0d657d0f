r"""Which joints and channels tell actions apart: weights learned by gradient through the epipolar residual.

Weights are first learned for all actions together, then for each action on top; both are pulled towards equal ones as hard as
held-out groups of exemplars ask for, and are equal where these do not gain from learning.  Queries and the exemplars they
are compared with come from different groups (people), and queries should be seen from elsewhere: a turned flat card is an
affine image of itself, from which this residual learns nothing about other viewpoints, so give rendered views.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import cast

import torch
from torch import Tensor

from indexing.action.bank import (
    EPSILON,
    GRAM_EPSILON,
    NEAREST,
    Bank,
    Copy,
    Entries,
    JointMetric,
    Windows,
    fill_unseen,
    flatten_channel,
    fused_residuals,
    planes_of,
    stack,
)
from indexing.modelfile import store

NUM_CANDIDATES = 2  # nearest exemplars per class that a query is compared with: as many as the scorer averages
PULLS = (1.0, 0.3, 0.1, 0.03)  # towards equal weights, that are tried, strongest first
NUM_STEPS = 40  # of Adam; stopping early pulls, too: with junk joints 80 steps win .27, 40 win .34
LEARNING_RATE = 0.1  # at the start; it falls to 0
INITIAL_LOG_SHARPNESS = 1.0  # of the softmax over classes
MAX_FOLDS = 4  # of the groups, each held out once
MIN_GAIN_SIGMAS = 1.0  # standard errors over groups by which learning must beat equal weights
NUM_ROUNDS = 2  # of finding the nearest exemplars and learning the weights
MAX_QUERIES = 200
MAX_ENTRIES = 60_000  # queries x classes x joints: 3.5 s of one core, 7 s where it learns

MAX_WEIGHT = 1e6  # of a joint or a scorer, the mean being 1

# ----------------------------------------------------------------------------------------------------------------------
# The epipolar residual as a function of joint weights: everything it needs, tabled once for the pairs that matter.
#
# A joint's weight multiplies its squared coordinates after the joint metric's whitening, so every 2x2 product that the largest
# canonical correlation is made of is *linear* in the weights: with the products of every joint at hand, another set of weights
# costs one matrix product and a closed form, whatever the length of the clips.


ABSENT = -100.0  # score of a class with no exemplar in another group


@dataclass(frozen=True)
class Evidence:
    """Products of every joint's coordinates, for queries and the exemplars nearest to them."""

    cross: Tensor
    left: Tensor
    right: Tensor
    hub: Tensor
    valid: Tensor
    labels: Tensor
    groups: Tensor

    def scores(self, joints: Tensor, channels: Tensor) -> Tensor:
        """Minus the mean log residual to the nearest exemplars, for ``B`` sets of weights at once. joints
        ``(B, channels, classes or 1, joints)`` -> ``(B, Q, classes)``."""
        weights = joints.expand(-1, -1, self.cross.shape[1], -1).permute(1, 2, 3, 0)
        shape = (*self.cross.shape[:-1], len(joints))
        tables = (self.cross, self.left, self.right)
        # a GEMM each; nothing is copied
        products = ((table.flatten(2, 5) @ weights).view(shape).flatten(4, 5).unbind(4) for table in tables)
        cross, left, right = (cast("Entries", entries) for entries in products)
        logs = (epipolar(cross, left, right) + EPSILON).log()
        total = torch.einsum("xcqkn,nx->ncqk", logs, channels) - self.hub
        count = self.valid.sum(2)
        mean = torch.where(self.valid, total, 0.0).sum(3) / count.clamp(min=1)
        return torch.where(count > 0, -mean, ABSENT).mT


def epipolar(cross: Entries, left: Entries, right: Entries) -> Tensor:
    r"""Residual :math:`1 - s_1` of two images from their products: differentiable, closed form."""
    c00, c01, c10, c11 = cross
    l00, l01, l11, left_det = _add_ridge(left)
    r00, r01, r11, right_det = _add_ridge(right)
    # D = adj(L) C, then tr(D adj(R) C^T), whose entries are products of these
    d00, d01 = l11 * c00 - l01 * c10, l11 * c01 - l01 * c11
    d10, d11 = l00 * c10 - l01 * c00, l00 * c11 - l01 * c01
    trace = (
        d00 * (r11 * c00 - r01 * c01) + d01 * (r00 * c01 - r01 * c00)
        + d10 * (r11 * c10 - r01 * c11) + d11 * (r00 * c11 - r01 * c10)
    ) / (left_det * right_det)  # fmt: skip
    det = (c00 * c11 - c01 * c10).square() / (left_det * right_det)
    # where both correlations are the same the root has no derivative; a floor far below the noise gives it the value 0
    root = (trace.square() - 4 * det).clamp(min=1e-10).sqrt()
    return 1 - ((trace + root) / 2).clamp(min=1e-10, max=1.0).sqrt()


def _add_ridge(gram: Entries) -> Entries:
    """Entries 00, 01, 11 and the determinant of symmetric 2x2 matrices, with a ridge."""
    scale = (gram[0] + gram[3]).clamp(min=1e-30)
    a, b, d = gram[0] + GRAM_EPSILON * scale, gram[1], gram[3] + GRAM_EPSILON * scale
    return a, b, d, (a * d - b * b).clamp(min=1e-30)


def gather(
    query: Windows,
    owner: Tensor,
    copies: list[Windows],
    metrics: tuple[JointMetric, JointMetric],
    channels: Tensor,
    labels: Tensor,
    groups: Tensor,
    hub: Tensor,
) -> Evidence:
    """The tables of queries and, of each class, the exemplars of other groups that are nearest to them."""
    metric, found_by = metrics
    planes, powers = planes_of(found_by), channels.tolist()
    tables = [fused_residuals(query, [Bank([Copy(copy)], planes)], [("epi",)], powers=powers)[0] for copy in copies]
    table, which = torch.stack(tables).min(dim=0)
    table = torch.where(groups[owner][:, None] == groups[None], torch.inf, table - hub)
    chosen, valid = [], []
    for action in range(int(labels.max()) + 1):
        mine = (labels == action).nonzero()[:, 0]
        value, place = table[:, mine].topk(min(NUM_CANDIDATES, len(mine)), dim=1, largest=False)
        room = (0, NUM_CANDIDATES - place.shape[1])
        chosen.append(torch.nn.functional.pad(mine[place], room))
        valid.append(torch.nn.functional.pad(value.isfinite(), room))
    index = torch.stack(chosen)  # (classes, Q, K)
    place = which.gather(1, index.transpose(0, 1).flatten(1)).view_as(index.transpose(0, 1)).transpose(0, 1) * len(labels) + index
    nearest = stack(copies)[place.flatten()]
    cross, left, right = torch.stack([_products(query, nearest, metric, name, index.shape) for name in NEAREST], dim=1)
    return Evidence(cross, left, right, hub[index], torch.stack(valid), labels[owner], groups[owner])


def _products(query: Windows, nearest: Windows, metric: JointMetric, name: str, shape: torch.Size) -> Tensor:
    """``(3, *shape, 2, 2, joints)`` tables of one channel; a joint that either side has not seen counts for nothing."""
    count, weights = query.values.shape[2], metric.weights(name)
    filled = (fill_unseen(part.values, part.seen) for part in (query, nearest))
    x, y = (flatten_channel(values, name, weights).unflatten(2, (-1, count)) for values in filled)
    y = y.unflatten(0, shape)
    own = torch.einsum("qatj,qbtj->qabj", x, x)[None, :, None].expand(*shape, 2, 2, count)
    pairs = torch.einsum("qatj,cqkbtj->cqkabj", x, y), own, torch.einsum("cqkatj,cqkbtj->cqkabj", y, y)
    both = query.seen[None, :, None] & nearest.seen.unflatten(0, shape)
    return torch.stack(pairs) * both[..., None, None, :]


@dataclass(frozen=True)
class WeightedMetric(JointMetric):
    """A joint metric whose whitened joints are then weighted, in the channels of the epipolar residual."""

    roots: Tensor

    def weights(self, name: str, joints: Tensor | slice = slice(None)) -> Tensor | None:
        """``(joints, joints)`` weighted W of one channel among the chosen joints."""
        roots = self.roots[NEAREST.index(name)][joints].float()
        whitening = super().weights(name, joints)
        return torch.diag(roots) if whitening is None else roots[:, None] * whitening


@dataclass(frozen=True)
class JointWeights:
    """How much each joint, each channel and for each class each joint counts: 1 in the mean."""

    joints: Tensor = field(metadata=store("real", "nearest", "joints", least=0, most=MAX_WEIGHT))
    channels: Tensor = field(metadata=store("real", "nearest", least=0, most=MAX_WEIGHT))
    by_class: Tensor | None = field(default=None, metadata=store("real", "classes", "joints", least=0, most=MAX_WEIGHT))

    @classmethod
    def uniform(cls, joints: int, device: torch.device | None = None) -> JointWeights:
        """All ones."""
        return cls(torch.ones(len(NEAREST), joints, device=device), torch.ones(len(NEAREST), device=device))

    @property
    def is_uniform(self) -> bool:
        """Whether nothing differs from equal weights."""
        return self.by_class is None and bool((self.joints == 1).all()) and bool((self.channels == 1).all())

    @property
    def is_usable(self) -> bool:
        """Whether some joint of each class and some channel counts."""
        joints = self.joints if self.by_class is None else self.joints[:, None] * self.by_class
        return bool((joints.sum(-1) > 0).all()) and bool(self.channels.sum() > 0)

    def metric(self, metric: JointMetric, action: int | None = None) -> JointMetric:
        """The joint metric with these weights, of one class where there are weights by class."""
        if self.is_uniform:
            return metric
        weights = self.joints if action is None or self.by_class is None else _mean_one(self.joints * self.by_class[action])
        return WeightedMetric(metric.covariance, metric.power, weights.sqrt(), floor=metric.floor)

    def banks(self, crops: Sequence[Sequence[Copy]], metric: JointMetric, labels: Tensor) -> list[list[Bank]]:
        """Banks of each crop to compare with under these weights; each class's exemplars under its own."""
        if self.by_class is None:
            planes = planes_of(self.metric(metric))
            return [[Bank(copies, planes)] for copies in crops]
        own = [(labels == action, planes_of(self.metric(metric, action))) for action in labels.unique().tolist()]
        return [[Bank([copy.select(mine) for copy in copies], planes) for mine, planes in own] for copies in crops]


def learn_joint_weights(
    query: Windows,
    owner: Tensor,
    copies: list[Windows],
    metric: JointMetric,
    labels: Tensor,
    *,
    groups: Tensor,
    hub: Tensor,
    symmetry: Tensor | None = None,
) -> JointWeights | None:
    r"""Weights :math:`w \ge 0` of joints and channels under which exemplars of other groups name the queries best, if any do better
    than equal ones. groups ``(N,)``, hub ``(N,)``, symmetry ``(joints,)``."""
    home, count, classes = labels.device, query.values.shape[2], int(labels.max()) + 1
    candidates = _have_others(labels, groups)[owner].nonzero()[:, 0]
    if len(labels[owner[candidates]].unique()) < 2:
        return None
    limit = max(1, min(MAX_QUERIES, MAX_ENTRIES // (count * classes)))
    rows = candidates[torch.randperm(len(candidates), generator=torch.Generator().manual_seed(0))[:limit].to(home)]
    query, owner, tied = query[rows], owner[rows], (torch.arange(count) if symmetry is None else symmetry).to(home)
    found = JointWeights.uniform(count, home)
    for _ in range(NUM_ROUNDS):  # the nearest exemplars, by what was learned before
        evidence = gather(query, owner, copies, (metric, found.metric(metric)), found.channels, labels, groups, hub)
        found = _from_evidence(evidence, tied, classes)
        if found.is_uniform:
            return None
    return found


def _from_evidence(evidence: Evidence, tied: Tensor, classes: int) -> JointWeights:
    """For all actions together, and then for each."""
    equal = torch.ones(len(NEAREST), 1, len(tied), device=tied.device), torch.ones(len(NEAREST), device=tied.device)
    joints, channels = _choose(evidence, _Together(tied, *equal))
    each = _choose(evidence, _Each(tied, joints, channels, classes))[0]
    return JointWeights(joints[:, 0], channels, None if each.shape[1] == 1 else _mean_one((each / joints)[0]))


def _have_others(labels: Tensor, groups: Tensor) -> Tensor:
    """``(N,)`` which exemplars have another of their class in another group."""
    return ((labels[:, None] == labels[None]) & (groups[:, None] != groups[None])).any(dim=1)


# ---- how hard to pull --------------------------------------------------------------------------------------------------
Weights = tuple[Tensor, Tensor]  # (B, channels, classes or 1, joints) and (B, channels), for B problems at once


@dataclass(frozen=True)
class _Together:
    """Weights of all actions together: logarithms of each joint's, of each joint's in each channel, and of the channels'."""

    tied: Tensor
    joints: Tensor
    channels: Tensor

    def start(self) -> list[Tensor]:
        return [torch.zeros_like(self.joints[:1]), torch.zeros_like(self.joints), torch.zeros_like(self.channels)]

    def weights(self, logs: list[Tensor]) -> Weights:
        joints = logs[0] + logs[1]
        return _mean_one(self.joints * (joints + joints[..., self.tied]).div(2).exp()), _mean_one(logs[2].exp())


@dataclass(frozen=True)
class _Each(_Together):
    """A factor per class and joint on top of weights that stay."""

    classes: int

    def start(self) -> list[Tensor]:
        return [self.joints.new_zeros(1, self.classes, self.joints.shape[2])]

    def weights(self, logs: list[Tensor]) -> Weights:
        joints = _mean_one(self.joints * (logs[0] + logs[0][..., self.tied]).div(2).exp())
        return joints, self.channels.expand(len(joints), -1)


def _choose(evidence: Evidence, stage: _Together) -> Weights:
    """Learn with the strongest pull that held-out groups cannot tell from the best; not at all where they gain nothing."""
    names, group = evidence.groups.unique(return_inverse=True)
    if len(names) < 3:
        return stage.joints, stage.channels
    folds = min(MAX_FOLDS, len(names))
    part = torch.randperm(len(names), generator=torch.Generator().manual_seed(0)).to(group.device)[group] % folds
    held = part == torch.arange(folds + 1, device=group.device)[:, None]  # in the last problem nothing is held out
    losses, (joints, channels) = _descend(evidence, stage, ~held)
    here = losses[part, :, torch.arange(len(part), device=part.device)]  # (Q, pulls) where a query was held out
    won = here[:, :1] - here[:, 1:]
    by_group = torch.stack([won[group == number].mean(dim=0) for number in range(len(names))])
    gain, sigma = by_group.mean(dim=0), by_group.std(dim=0) / len(names) ** 0.5
    best = int(gain.argmax())
    if gain[best] <= MIN_GAIN_SIGMAS * sigma[best]:
        return stage.joints, stage.channels
    chosen = int((gain >= gain[best] - sigma[best]).nonzero()[0, 0])
    return joints[-1, 1 + chosen], channels[-1, 1 + chosen]


def _descend(evidence: Evidence, stage: _Together, train: Tensor) -> tuple[Tensor, Weights]:
    """Every pull on every part of the queries at once: ``(parts, 1 + pulls, Q)`` losses, and the weights; first without
    learning."""
    pulls = evidence.hub.new_tensor(PULLS)
    shape = len(train), 1 + len(pulls)
    learning = torch.ones(shape, device=pulls.device)
    learning[:, 0] = 0.0
    learning = learning.flatten()
    pull = torch.cat([pulls[:1], pulls]).repeat(len(train))
    share = (train.to(evidence.hub) / train.sum(dim=1, keepdim=True)).repeat_interleave(shape[1], dim=0)
    logs = [value.to(evidence.hub).expand(len(pull), *value.shape).clone().requires_grad_() for value in stage.start()]
    sharp = torch.full((len(pull),), INITIAL_LOG_SHARPNESS).to(evidence.hub).requires_grad_()
    optimizer = torch.optim.Adam([sharp, *logs], lr=LEARNING_RATE)

    def losses() -> tuple[Tensor, list[Tensor], Weights]:
        free = [value * learning.view(-1, *(1 for _ in value.shape[1:])) for value in logs]
        weights = stage.weights(free)
        scores = sharp.exp()[:, None, None] * evidence.scores(*weights)
        return torch.nn.functional.cross_entropy(scores.mT, evidence.labels.expand(len(pull), -1), reduction="none"), free, weights

    for step in range(NUM_STEPS):
        optimizer.param_groups[0]["lr"] = LEARNING_RATE * (1 - step / NUM_STEPS)
        optimizer.zero_grad()
        loss, free, _ = losses()
        penalty = sum(value.square().flatten(1).mean(dim=1) for value in free)
        ((loss * share).sum(dim=1) + pull * penalty).sum().backward()
        optimizer.step()
    with torch.no_grad():
        loss, _, (joints, channels) = losses()
    return loss.unflatten(0, shape), (joints.unflatten(0, shape), channels.unflatten(0, shape))


def _mean_one(weights: Tensor) -> Tensor:
    return weights / weights.mean(dim=-1, keepdim=True)

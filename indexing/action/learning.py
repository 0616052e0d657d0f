"""Learning a shape model from its exemplars: metric, mirror images, hubs, the kernel machine, and how the evidence is weighed."""

from __future__ import annotations

import dataclasses
import warnings
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from indexing.action.bank import COVARIANCE_FLOOR, WHITENING_POWER, JointMetric, Windows, stack
from indexing.action.exemplars import CARD_PITCH_SIGMA, MAX_SAMPLED_MOMENTS, Exemplars, turn
from indexing.action.joint_weights import JointWeights, learn_joint_weights
from indexing.action.kernels import Kernels
from indexing.action.model import (
    NEAREST_WEIGHT,
    PENALTY,
    Blend,
    ClassProfiles,
    PairwiseMachine,
    ShapeModel,
    class_scores,
    evidence,
    mirror_some,
    standardize,
)

MIN_MUTUAL_SHARE = 0.5  # of the mirror images of two classes that are nearest to the other one: neither is mirrored then
HUB_SHARE = 0.5  # of an exemplar's closeness to other classes that is taken off: +2..3 %, one shot +4 %
NUM_HUB_NEIGHBOURS = 5  # nearest windows of other classes that measure that closeness
MAX_PAIRS = 10**8  # of exemplars that are compared with each other: all of them up to 10,000 exemplars (400 MB), a part of more
MAX_TRAINING_ROWS = 3000  # the fit of the kernel machine grows with their square
MAX_TRAINING_ROWS_SOLID = 5000  # the same where exemplars have depth: true views are worth more
NEAREST_WEIGHT_SOLID = 0.5  # the same for exemplars with depth: B then sees true views (1.5: -1.5 % on Florence3D)
BLENDS = ((1.0, 0.0), (1.0, 0.25), (1.0, 0.5), (1.0, 1.0), (1.0, 1.5), (1.0, 3.0), (0.0, 1.0))  # weights of B and A that are tried
MIN_EXAMPLES_TO_BLEND = 8  # per class; from 5 on it costs 1 to 2 % on UTKinect
MAX_FOLDS = 5  # groups of people whose machines are trained
NUM_QUERY_VIEWS = 4  # virtual views that ask per exemplar, besides the image itself
QUERY_NOISE = 0.01  # of the body height, on these views: without it the kernel machine looks too good
HALVES_PER_JOINT = 4  # random halves: importances from two seeds then correlate by .83-.98 on UTKinect
MIN_HALVES = 32
MAX_HALVES = 200
MAX_IMPORTANCE_QUERIES = 120
IMPORTANCE_RIDGE = 1.0  # of the regression on 0/1 masks, in masks: matters only with more joints than halves

# ----------------------------------------------------------------------------------------------------------------------
# How the scorers are weighed, learned from people who were left out: once over the whole set, whatever its actions are.
#
# Every exemplar, as it was seen and in its virtual views, is asked of what was learned from the other people.  The blend with the
# fewest mistakes is taken.  Asked of other clips of the same person, every scorer looks perfect and nothing is learned (UTKinect
# .939 against .953 without): so groups must be known.


def leave_out(groups: Tensor) -> Tensor:
    """``(N,)`` number of the fold of each exemplar: people are dealt to at most five folds."""
    _, number = groups.unique(return_inverse=True)
    return number % min(MAX_FOLDS, int(number.max()) + 1)


@dataclass(frozen=True)
class Trained:
    """What a kernel machine was trained on."""

    rows: Windows
    owner: Tensor
    gram: Tensor


def learn_blend(model: ShapeModel, groups: Tensor, trained: Trained) -> Blend:
    """The blend that serves people best who were left out. groups ``(N,)``."""
    labels, folds = model.labels, leave_out(groups)
    # only those are asked whose action somebody in another fold performs, too
    usable = ((folds[:, None] != folds[None]) & (labels[:, None] == labels[None])).any(dim=1)
    few = int(torch.bincount(labels).median()) < MIN_EXAMPLES_TO_BLEND
    if few or int(folds.max()) < 1 or not bool(usable.any()):
        return model.blend
    asked = asked_views(model)
    views = []
    for windows in asked:
        found = _machine_out(model, trained, windows, folds), _out(model.residuals(windows), model, folds)
        views.append(torch.stack([standardize(scores) for scores in found]))
    evidence = torch.cat([view[:, usable] for view in views], dim=1).double()
    truth = labels[usable].repeat(len(asked))
    return _fewest_mistakes(evidence, truth, model.blend)


def _out(residuals: Tensor, model: ShapeModel, folds: Tensor) -> Tensor:
    """``(N, classes)`` scores of every exemplar among those of the other folds."""
    scores = class_scores(residuals.masked_fill(folds[:, None] == folds[None], torch.inf), model.labels, model.classes)
    known = scores.isfinite()
    least = torch.where(known, scores, torch.inf).amin(dim=1, keepdim=True)
    return torch.where(known, scores, least.nan_to_num(posinf=0.0))


def asked_views(model: ShapeModel) -> list[Windows]:
    """The exemplars as they are and in some virtual views, each a bit wrong, as a detector's are."""
    rng, whole = np.random.default_rng(0), model.exemplars.crop(0)
    count = len(whole)
    asked = [whole]
    for i in range(NUM_QUERY_VIEWS):
        azimuth, pitch = rng.uniform(0, 2 * np.pi, count), rng.normal(scale=CARD_PITCH_SIGMA, size=count)
        if bool(model.exemplars.solid.any()):
            if i >= len(model.exemplars.views) // count:
                break
            values = model.exemplars.view(i).values
        else:
            values = turn(whole.values, azimuth, pitch)
        size = (values[..., 1].amax(dim=2) - values[..., 1].amin(dim=2)).median(dim=1).values
        noise = torch.from_numpy(rng.normal(size=values.shape)).to(values)
        asked.append(Windows(values + QUERY_NOISE * size[:, None, None, None] * noise, whole.seen))
    return asked


def _machine_out(model: ShapeModel, trained: Trained, asked: Windows, folds: Tensor) -> Tensor:
    """The same of the kernel machine, trained once per fold; actions that nobody else performs get the least."""
    out = torch.full((len(folds), model.classes), -1.0, device=folds.device)
    if model.kernels is None:
        return out
    owner, against = trained.owner, model.kernels(asked, trained.rows)
    for fold in folds.unique():
        kept = (folds[owner] != fold).nonzero()[:, 0]
        mine = (folds == fold).nonzero()[:, 0]
        known, numbers = np.unique(model.labels[owner[kept]].cpu().numpy(), return_inverse=True)
        if len(known) < 2:
            continue
        machine = PairwiseMachine.fit(trained.gram[kept][:, kept], numbers, PENALTY)
        scores = machine(against[mine][:, kept[machine.support.to(kept.device)]])
        out[mine[:, None], torch.from_numpy(known).to(mine.device)[None]] = scores
    return out


def blend_scores(evidence: Tensor, blend: Blend) -> Tensor:
    """``(N, classes)`` sum of the standardized scores ``(2, N, classes)`` of B and A."""
    return blend.kernel * evidence[0] + blend.nearest * evidence[1]


def _fewest_mistakes(evidence: Tensor, truth: Tensor, prior: Blend) -> Blend:
    """Among blends with the same number of mistakes, that next to the one that is used where nothing was learned."""
    best, chosen = (float("inf"), 0.0), prior
    for kernel, nearest in BLENDS:
        blend = dataclasses.replace(prior, kernel=kernel, nearest=nearest)
        wrong = float((blend_scores(evidence, blend).argmax(dim=1) != truth).sum())
        far = abs(nearest / (kernel + nearest) - prior.nearest / (prior.kernel + prior.nearest))
        if (wrong, far) < best:
            best, chosen = (wrong, far), blend
    return chosen


@dataclass(frozen=True)
class Lesson:
    """How to learn. groups ``(N,)``."""

    view: str = "any"
    scorer: str = "both"
    learned: bool = False
    groups: Tensor | None = None
    symmetry: Tensor | None = None
    guard: bool = True
    hidden: int = 0


def learn(exemplars: Exemplars, labels: Tensor, classes: int, lesson: Lesson) -> ShapeModel:
    """Learn everything from the exemplars' windows. labels ``(N,)``."""
    originals = exemplars.crop(0)
    nothing = torch.zeros(len(labels), device=labels.device)
    metric = JointMetric.learn(originals.values, originals.seen, WHITENING_POWER, COVARIANCE_FLOOR)
    none, share = torch.zeros_like(labels, dtype=torch.bool), float(exemplars.solid.float().mean())
    model = ShapeModel(
        exemplars, labels, classes, lesson.view, lesson.scorer, metric, lesson.symmetry, none,
        nothing, torch.zeros_like(exemplars.owner, dtype=nothing.dtype), None, None, None,
        blend=Blend(nearest=share * NEAREST_WEIGHT_SOLID + (1 - share) * NEAREST_WEIGHT),
        hidden=lesson.hidden,
    )  # fmt: skip
    asked = asked_exemplars(labels)
    if lesson.symmetry is not None:
        model = dataclasses.replace(model, mirrored=_mirror_is_same_action(model, originals, asked) if lesson.guard else ~none)
    model = _with_hubs(model, originals, asked)
    if len(asked) < len(labels):
        lesson = _without_all_pairs(lesson, len(labels))
    weights = _learn_joint_weights(model, lesson)
    if weights is not None:
        model = _with_hubs(dataclasses.replace(model, joint_weights=weights, hub=nothing), originals, asked)
    trained = None
    if lesson.scorer != "nearest":
        model, trained = _with_machine(model, one_side=lesson.view == "same")
    if lesson.learned and lesson.groups is not None and trained is not None and lesson.scorer == "both":
        model = dataclasses.replace(model, blend=learn_blend(model, lesson.groups, trained))
    return _with_evidence(model, originals, asked)


def asked_exemplars(labels: Tensor) -> Tensor:
    """Numbers of the exemplars that are compared with all of them: every one, or as large a part of each class as can be."""
    step = -(-(len(labels) ** 2) // MAX_PAIRS)
    return labels.argsort(stable=True)[::step].sort().values if step > 1 else torch.arange(len(labels), device=labels.device)


def _without_all_pairs(lesson: Lesson, count: int) -> Lesson:
    """What is learned from more exemplars than can be compared with each other."""
    what = ["" if lesson.scorer == "nearest" else "the kernel machine is trained on a part of them"]
    what += ["weights stay equal"] if lesson.learned else []
    if any(what):
        said = " and ".join(one for one in what if one)
        warnings.warn(f"{count:,} exemplars are too many to compare each with each: {said}", stacklevel=6)
    return dataclasses.replace(lesson, learned=False)


def _learn_joint_weights(model: ShapeModel, lesson: Lesson) -> JointWeights | None:
    """How much each joint counts, learned across views of 3D exemplars: of turned cards nothing can be learned."""
    if not lesson.learned or lesson.view != "any" or lesson.groups is None or not bool(model.exemplars.solid.all()):
        return None
    asked, count = asked_views(model)[1:], len(model.labels)
    if not asked:
        return None
    copies = [model.exemplars.crop(i) for i in range(len(model.exemplars.crops) // count)]
    if model.symmetry is not None and bool(model.mirrored.any()):
        copies += [mirror_some(crop, model.symmetry, model.mirrored) for crop in copies]
    owner = torch.arange(count, device=model.labels.device).repeat(len(asked))
    return learn_joint_weights(
        stack(asked), owner, copies, model.metric, model.labels, groups=lesson.groups, hub=model.hub, symmetry=lesson.symmetry
    )


def _mirror_is_same_action(model: ShapeModel, originals: Windows, asked: Tensor) -> Tensor:
    """``(N,)`` whether the mirror image of an exemplar is still the same action."""
    if model.symmetry is None:
        return model.mirrored
    flipped = mirror_some(originals[asked], model.symmetry, torch.ones_like(asked, dtype=torch.bool))
    nearest = model.labels[model.residuals(flipped).argmin(dim=1)]
    own = torch.nn.functional.one_hot(model.labels[asked], model.classes).float()
    lands = own.mT @ torch.nn.functional.one_hot(nearest, model.classes).float() / own.sum(dim=0).clamp(min=1)[:, None]
    mutual = (lands > MIN_MUTUAL_SHARE) & (lands.mT > MIN_MUTUAL_SHARE)
    mutual.fill_diagonal_(False)
    return ~mutual.any(dim=1)[model.labels]


def _with_hubs(model: ShapeModel, originals: Windows, asked: Tensor) -> ShapeModel:
    """Measure, among the exemplars, how close each is to other classes."""
    residual, labels = model.residuals(originals[asked]), model.labels
    model = dataclasses.replace(model, hub=_hub(residual, labels[asked], labels))
    step = max(1, len(model.exemplars.moments) // MAX_SAMPLED_MOMENTS)
    sample = torch.arange(0, len(model.exemplars.moments), step, device=labels.device)
    labels = labels[model.exemplars.owner]
    residual = model.moment_residuals(model.exemplars.moments[sample])
    return dataclasses.replace(model, moment_hub=_hub(residual, labels[sample], labels))


def _with_evidence(model: ShapeModel, originals: Windows, asked: Tensor) -> ShapeModel:
    """What profiles the exemplars have, and what evidence, were their own class unknown."""
    query = originals[asked]
    tables = [model.residuals(query) + model.hub]
    if model.kernels is not None:
        tables.append(model.kernel_residuals(query))
    profiles = _profiles([tables[0] - model.hub, *tables[1:]], asked, model.labels, model.classes, model.hidden)
    return dataclasses.replace(model, profiles=profiles, evidence_out=_evidence_out(tables, asked, model))


def _profiles(tables: list[Tensor], asked: Tensor, labels: Tensor, classes: int, hidden: int) -> ClassProfiles | None:
    """The profiles of exemplars, each asked as if it had not been learned; tables ``(asked, N)`` of residuals among them."""
    each = torch.arange(len(asked), device=asked.device)
    scores = [class_scores(table.index_put((each, asked), table.new_tensor(torch.inf)), labels, classes) for table in tables]
    return ClassProfiles.learn(torch.cat(scores, dim=1), labels[asked], classes - hidden)


def _evidence_out(tables: list[Tensor], asked: Tensor, model: ShapeModel) -> Tensor:
    """The evidence that exemplars would have for other classes, were their own class unknown; of all that could be taken for
    one."""
    if model.num_known == 1:
        return _between_kinds(tables[0], model.labels[asked], model)
    found, refused = [], []
    for c in range(model.classes):
        mine, rest, kept = model.labels[asked] == c, model.labels[asked] != c, model.labels != c
        classes, hidden = model.classes - 1, model.hidden - (c >= model.num_known)
        if classes == hidden:  # no known class is left
            continue
        labels, others = model.labels[kept] - (model.labels[kept] > c).long(), (kept.cumsum(0) - 1)[asked[rest]]
        among, foreign = [table[rest][:, kept] for table in tables], [table[mine][:, kept] for table in tables]
        hub = _hub(among[0], labels[others], labels)
        among[0], foreign[0] = among[0] - hub, foreign[0] - hub
        profiles = _profiles(among, others, labels, classes, hidden)
        scores = [class_scores(table, labels, classes) for table in foreign]
        unusual = None if profiles is None else profiles.distance(torch.cat(scores, dim=1), classes)
        found.append(evidence(scores[0], model.classes, unusual, hidden))
        refused.append(scores[0].argmax(dim=1) >= classes - hidden)
    if not found:
        return tables[0].new_zeros(0)
    every = torch.cat(found)
    return torch.where(torch.cat(refused), every.min(), every)


def _between_kinds(residual: Tensor, asked: Tensor, model: ShapeModel) -> Tensor:
    """How near exemplars of background come to every kind that is not theirs: as near another movement comes to the action."""
    rows = asked >= model.num_known
    scores = class_scores(residual[rows], model.labels, model.classes)
    foreign = torch.nn.functional.one_hot(asked[rows], model.classes) == 0
    return scores[:, model.num_known :][foreign[:, model.num_known :]]


def _hub(residual: Tensor, rows: Tensor, columns: Tensor) -> Tensor:
    """``(columns,)`` half the mean residual from the nearest windows of other classes: near to everything = little evidence."""
    other = rows[:, None] != columns[None]
    count = max(1, min(NUM_HUB_NEIGHBOURS, int(other.sum(dim=0).min())))
    foreign = torch.where(other, residual, torch.inf).topk(count, dim=0, largest=False).values.mean(dim=0)
    # a class that the sampled rows hold alone has nothing to compare with: it gets the usual share
    known = foreign.isfinite()
    return HUB_SHARE * torch.where(known, foreign, foreign[known].mean() if known.any() else foreign.new_tensor(0.0))


def _with_machine(model: ShapeModel, one_side: bool) -> tuple[ShapeModel, Trained]:
    """Train scorer B on the exemplars, their virtual views and mirror images, as many as the budget of rows allows."""
    exemplars, count = model.exemplars, len(model.exemplars)
    both = model.symmetry is not None and bool(model.mirrored.any())
    rows_at_most = MAX_TRAINING_ROWS_SOLID if bool(exemplars.solid.any()) else MAX_TRAINING_ROWS
    copies = max(1, rows_at_most // (count * (1 + both)))
    parts = [exemplars.crop(0)] + [exemplars.view(i) for i in range(min(copies - 1, len(exemplars.views) // count))]
    rows, owner = stack(parts), torch.arange(count, device=model.labels.device).repeat(len(parts))
    if len(asked_exemplars(model.labels)) < count:
        owner = model.labels.argsort(stable=True)[:: -(-count * (1 + both) // rows_at_most)]
        rows = rows[owner]
    if both and model.symmetry is not None:
        chosen = model.mirrored[owner]
        rows = stack([rows, mirror_some(rows[chosen], model.symmetry, chosen[chosen])])
        owner = torch.cat([owner, owner[chosen]])
    kernels = Kernels(one_side)
    gram = kernels.fit(rows)
    machine = PairwiseMachine.fit(gram, model.labels[owner].cpu().numpy().astype(np.int64), PENALTY)
    trained = Trained(rows, owner, gram)
    return dataclasses.replace(model, kernels=kernels, support=rows[machine.support.to(owner.device)], machine=machine), trained


# ----------------------------------------------------------------------------------------------------------------------
# Which joints matter for which action: how much the evidence for an action grows when a joint is seen.
#
# Read off any fitted model, whatever its weights: weights tell how joints are treated, not what they tell; and leaving one
# joint out tells nothing where its neighbours say the same.  So random halves of the joints are hidden from the queries, and a
# joint's importance is its linear share in the margin of the true action, over all that can be seen beside it.


def importance(model: ShapeModel, groups: Tensor | None = None) -> Tensor:
    r"""Linear share of every joint in the margin of every action. model ``(N,)`` -> ``(classes, joints)``."""
    originals, labels = model.exemplars.crop(0), model.labels
    groups = torch.arange(len(labels), device=labels.device) if groups is None else groups.to(labels.device)
    generator = torch.Generator().manual_seed(0)
    asked = _sample_queries(labels, generator)
    query, truth = originals[asked], labels[asked]
    hidden = groups[asked][:, None] == groups[None]
    member = torch.nn.functional.one_hot(labels, model.classes).double()
    hidden &= ((~hidden).double() @ member > 0)[:, labels]
    masks = halves(originals.seen.shape[1], generator).to(labels.device)
    margins = torch.stack([_margins(model, query, truth, hidden, mask) for mask in masks])  # (masks, queries)
    by_class = margins @ (member[asked] / member[asked].sum(dim=0).clamp(min=1))
    design = masks.double() - masks.double().mean(dim=0)
    gram = design.mT @ design
    gram.diagonal().add_(IMPORTANCE_RIDGE)
    return torch.linalg.solve(gram, design.mT @ (by_class - by_class.mean(dim=0))).mT


def typical(model: ShapeModel) -> Tensor:
    """``(classes,)`` the exemplar of every class that is nearest to the others of its class."""
    originals, labels = model.exemplars.crop(0), model.labels
    out = torch.zeros(model.classes, dtype=torch.long)
    for action in range(model.classes):
        mine = (labels == action).nonzero()[:, 0]
        out[action] = mine[model.residuals(originals[mine[:MAX_IMPORTANCE_QUERIES]])[:, mine].mean(dim=0).argmin()]
    return out


def halves(joints: int, generator: torch.Generator) -> Tensor:
    """``(masks, joints)`` bool: random halves of the joints and, after each, the other half; of at least three joints."""
    size = max(min(3, joints), joints // 2)
    out = []
    for _ in range(min(MAX_HALVES, max(MIN_HALVES, HALVES_PER_JOINT * joints)) // 2):
        order = torch.randperm(joints, generator=generator)
        for part in (order[:size], order[joints - size :]):
            out.append(torch.zeros(joints, dtype=torch.bool).index_fill_(0, part, True))
    return torch.stack(out)


def _sample_queries(labels: Tensor, generator: torch.Generator) -> Tensor:
    """At most ``MAX_IMPORTANCE_QUERIES`` exemplars, as many of every class as there are or as fit."""
    each = max(1, MAX_IMPORTANCE_QUERIES // int(labels.max() + 1))
    order = torch.randperm(len(labels), generator=generator).to(labels.device)
    kept = [order[labels[order] == action][:each] for action in range(int(labels.max()) + 1)]
    return torch.cat(kept)


def _margins(model: ShapeModel, query: Windows, truth: Tensor, hidden: Tensor, mask: Tensor) -> Tensor:
    residual = model.residuals(Windows(query.values, query.seen & mask)).masked_fill(hidden, torch.inf)
    nearest = residual.new_full((len(query), model.classes), torch.inf)
    nearest.scatter_reduce_(1, model.labels.expand(len(query), -1), residual, "amin")
    own = nearest.gather(1, truth[:, None])[:, 0]
    return (nearest.scatter(1, truth[:, None], torch.inf).min(dim=1).values - own).double()

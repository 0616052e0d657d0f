"""Which joints matter for which action: how much the evidence for an action grows when a joint is seen.

Read off any fitted model, whatever its weights: weights tell how joints are treated, not what they tell; and leaving one
joint out tells nothing where its neighbours say the same.  So random halves of the joints are hidden from the queries, and a
joint's importance is its linear share in the margin of the true action, over all that can be seen beside it.
"""

from __future__ import annotations

import torch
from torch import Tensor

from indexing.shape.bank import Windows
from indexing.shape.model import ShapeModel

HALVES = 4  # random halves per joint: importances from two seeds then correlate by .83-.98 on UTKinect (clapping: .60)
HALVES_AT_MOST = 200
QUERIES = 120
RIDGE = 1.0  # of the regression on 0/1 masks, in masks: matters only where there are more joints than halves


def importance(model: ShapeModel, groups: Tensor | None = None, seed: int = 0) -> Tensor:
    r"""Linear share of every joint in the margin of every action.

    .. math:: \operatorname{margin}_c(m) \approx a_c + \sum_j b_{cj} m_j, \quad m \in \{0, 1\}^n \text{, half of it 1}

    The margin, in nats of the residual, is how much nearer the nearest exemplar of the true class is than that of any other,
    averaged over the exemplars of the class, none compared with exemplars of its own group.  An action that only this group
    shows keeps its exemplars: then joints matter by how well they set it apart from the others.

    Args:
        model: fitted; groups: ``(N,)`` who performed each exemplar (by default each exemplar is its own group).
        seed: of the halves and of the exemplars that are asked, where there are many.

    Returns:
        ``(classes, joints)`` b, float64; negative where a joint misleads.

    Source: Banzhaf value of cooperative games, fitted by least squares (Hammer and Holzman 1992).
    """
    originals, labels = model.exemplars.crop(0), model.labels
    groups = torch.arange(len(labels), device=labels.device) if groups is None else groups.to(labels.device)
    generator = torch.Generator().manual_seed(seed)
    asked = _asked(labels, generator)
    query, truth = originals[asked], labels[asked]
    hidden = groups[asked][:, None] == groups[None]
    member = torch.nn.functional.one_hot(labels, model.classes).double()
    hidden &= ((~hidden).double() @ member > 0)[:, labels]
    masks = halves(originals.seen.shape[1], generator).to(labels.device)
    margins = torch.stack([_margins(model, query, truth, hidden, mask) for mask in masks])  # (masks, queries)
    by_class = margins @ (member[asked] / member[asked].sum(dim=0).clamp(min=1))
    design = masks.double() - masks.double().mean(dim=0)
    gram = design.mT @ design
    gram.diagonal().add_(RIDGE)
    return torch.linalg.solve(gram, design.mT @ (by_class - by_class.mean(dim=0))).mT


def typical(model: ShapeModel) -> Tensor:
    """``(classes,)`` the exemplar of every class that is nearest to the others of its class."""
    originals, labels = model.exemplars.crop(0), model.labels
    out = torch.zeros(model.classes, dtype=torch.long)
    for action in range(model.classes):
        mine = (labels == action).nonzero()[:, 0]
        out[action] = mine[model.residuals(originals[mine[:QUERIES]])[:, mine].mean(dim=0).argmin()]
    return out


def halves(joints: int, generator: torch.Generator) -> Tensor:
    """``(masks, joints)`` bool: random halves of the joints and, after each, the other half; of at least three joints."""
    size = max(min(3, joints), joints // 2)
    out = []
    for _ in range(min(HALVES_AT_MOST, max(32, HALVES * joints)) // 2):
        order = torch.randperm(joints, generator=generator)
        for part in (order[:size], order[joints - size :]):
            out.append(torch.zeros(joints, dtype=torch.bool).index_fill_(0, part, True))
    return torch.stack(out)


def _asked(labels: Tensor, generator: torch.Generator) -> Tensor:
    """At most :data:`QUERIES` exemplars, as many of every class as there are or as fit."""
    each = max(1, QUERIES // int(labels.max() + 1))
    order = torch.randperm(len(labels), generator=generator).to(labels.device)
    kept = [order[labels[order] == action][:each] for action in range(int(labels.max()) + 1)]
    return torch.cat(kept)


def _margins(model: ShapeModel, query: Windows, truth: Tensor, hidden: Tensor, mask: Tensor) -> Tensor:
    residual = model.residuals(Windows(query.values, query.seen & mask)).masked_fill(hidden, torch.inf)
    nearest = residual.new_full((len(query), model.classes), torch.inf)
    nearest.scatter_reduce_(1, model.labels.expand(len(query), -1), residual, "amin")
    own = nearest.gather(1, truth[:, None])[:, 0]
    return (nearest.scatter(1, truth[:, None], torch.inf).min(dim=1).values - own).double()

"""How the scorers are weighed, learned from people who were left out: once over the whole set, whatever its actions are.

Every exemplar, as it was seen and in its virtual views, is asked of what was learned from the other people.  The blend with the
fewest mistakes is taken, and the sharpness that makes the answers most likely.  Asked of other clips of the same person, every
scorer looks perfect and nothing is learned (UTKinect .939 against .953 without): so groups must be known.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from indexing.shape.bank import Windows
from indexing.shape.machine import PairwiseMachine
from indexing.shape.model import Blend, ShapeModel, class_scores, standardized
from indexing.shape.views import PITCH, turn

BLENDS = ((1.0, 0.0), (1.0, 0.25), (1.0, 0.5), (1.0, 1.0), (1.0, 1.5), (1.0, 3.0), (0.0, 1.0))  # of B and A
ENOUGH = 8  # examples per class from which the blend is learned: chosen from 5 on UTKinect it costs 1 to 2 % (.90 to .91 for .92)
SHARPNESSES = tuple(float(2 ** (k / 4)) for k in range(-4, 17))  # .5 .. 16
FOLDS = 5  # groups of people whose machines are trained
VIEWS = 4  # virtual views asked per exemplar, besides the image itself
NOISE = 0.01  # of the body height, on asked views: without it the kernel machine looks too good


def leave_out(groups: Tensor) -> Tensor:
    """``(N,)`` number of the fold of each exemplar: people are dealt to at most five folds."""
    _, number = groups.unique(return_inverse=True)
    return number % min(FOLDS, int(number.max()) + 1)


@dataclass(frozen=True)
class Trained:
    """What a kernel machine was trained on.

    rows: the exemplars, their virtual views and mirror images; owner: ``(rows,)`` whose they are; gram: ``(rows, rows)``.
    """

    rows: Windows
    owner: Tensor
    gram: Tensor


def learn_blend(model: ShapeModel, groups: Tensor, trained: Trained | None) -> Blend:
    """The blend that serves people best who were left out.

    Args:
        model: with every scorer learned from all exemplars.
        groups: ``(N,)`` who performs each exemplar.
        trained: what the kernel machine was trained on; ``None`` without one.

    Returns:
        the model's own blend where nothing can be left out.
    """
    labels, folds = model.labels, leave_out(groups)
    # only those are asked whose action somebody in another fold performs, too
    usable = ((folds[:, None] != folds[None]) & (labels[:, None] == labels[None])).any(dim=1)
    if int(folds.max()) < 1 or not bool(usable.any()):
        return model.blend
    asked = asked_views(model)
    views = []
    for windows in asked:
        found = []
        if trained is not None:
            found.append(_machine_out(model, trained, windows, folds))
        if model.scorer != "kernel":
            found.append(_out(model.residuals(windows), model, folds))
        views.append(torch.stack([standardized(scores) for scores in found]))
    evidence = torch.cat([view[:, usable] for view in views], dim=1).double()
    truth = labels[usable].repeat(len(asked))
    if model.scorer != "both":
        return _sharpened(model.blend, evidence[0], truth, int(usable.sum()))
    few = int(torch.bincount(labels).median()) < ENOUGH
    blend = model.blend if few else _fewest_mistakes(evidence, truth, model.blend)
    return _sharpened(blend, blended(evidence, blend), truth, int(usable.sum()))


def _out(residuals: Tensor, model: ShapeModel, folds: Tensor) -> Tensor:
    """``(N, classes)`` scores of every exemplar among those of the other folds."""
    scores = class_scores(residuals.masked_fill(folds[:, None] == folds[None], torch.inf), model.labels, model.classes)
    known = scores.isfinite()
    least = torch.where(known, scores, torch.inf).amin(dim=1, keepdim=True)
    return torch.where(known, scores, least.nan_to_num(posinf=0.0))


def asked_views(model: ShapeModel) -> list[Windows]:
    """The exemplars as they are and in some virtual views, each a bit wrong, as a detector's are.

    Whole exemplars, as queries are: asked of their crops, which the machine was trained on, it looks too good.
    """
    rng, whole = np.random.default_rng(0), model.exemplars.crop(0)
    count = len(whole)
    asked = [whole]
    for i in range(VIEWS):
        azimuth, pitch = rng.uniform(0, 2 * np.pi, count), rng.normal(scale=PITCH, size=count)
        if bool(model.exemplars.solid.any()):
            if i >= len(model.exemplars.views) // count:
                break
            values = model.exemplars.view(i).values
        else:
            values = turn(whole.values, azimuth, pitch)
        size = (values[..., 1].amax(dim=2) - values[..., 1].amin(dim=2)).median(dim=1).values
        noise = torch.from_numpy(rng.normal(size=values.shape)).to(values)
        asked.append(Windows(values + NOISE * size[:, None, None, None] * noise, whole.seen))
    return asked


def _machine_out(model: ShapeModel, trained: Trained, asked: Windows, folds: Tensor) -> Tensor:
    """The same of the kernel machine, trained once per fold; actions that nobody else performs get the least."""
    out = torch.full((len(folds), model.classes), -1.0)
    if model.kernels is None:
        return out
    owner, against = trained.owner, model.kernels(asked, trained.rows)
    for fold in folds.unique():
        kept = (folds[owner] != fold).nonzero()[:, 0]
        mine = (folds == fold).nonzero()[:, 0]
        known, numbers = np.unique(model.labels[owner[kept]].numpy(), return_inverse=True)
        if len(known) < 2:
            continue
        machine = PairwiseMachine.fit(trained.gram[kept][:, kept], numbers)
        scores = machine(against[mine][:, kept[machine.support]])
        out[mine[:, None], torch.from_numpy(known)[None]] = scores
    return out


def blended(evidence: Tensor, blend: Blend) -> Tensor:
    """``(N, classes)`` sum of the standardized scores ``(2, N, classes)`` of B and A."""
    return blend.kernel * evidence[0] + blend.nearest * evidence[1]


def _fewest_mistakes(evidence: Tensor, truth: Tensor, prior: Blend) -> Blend:
    """Among blends with the same number of mistakes, that next to the one that is used where nothing was learned."""
    best, chosen = (float("inf"), 0.0), prior
    for kernel, nearest in BLENDS:
        blend = dataclasses.replace(prior, kernel=kernel, nearest=nearest)
        wrong = float((blended(evidence, blend).argmax(dim=1) != truth).sum())
        far = abs(nearest / (kernel + nearest) - prior.nearest / (prior.kernel + prior.nearest))
        if (wrong, far) < best:
            best, chosen = (wrong, far), blend
    return chosen


def _sharpened(blend: Blend, scores: Tensor, truth: Tensor, exemplars: int) -> Blend:
    """The blend with the sharpness that makes the answers most likely, were one more of the exemplars asked a mistake.

    Without that mistake, people who are all recognized would make every answer certain.
    """
    even, count = standardized(scores), scores.shape[1]
    doubt = 1 / (exemplars + 2)
    losses = []
    for sharp in SHARPNESSES:
        chance = torch.log_softmax(sharp * even, dim=1)
        right = chance.gather(1, truth[:, None])[:, 0]
        losses.append(-float((1 - doubt) * right.mean() + doubt * chance.mean() * count / max(count - 1, 1)))
    return dataclasses.replace(blend, sharpness=SHARPNESSES[int(np.argmin(losses))])

"""Ways to tell unknown actions from known ones, compared on the same learned model: larger is better known.

Each is told by what the exemplars say of one another, asked without themselves; nothing is fitted to unknown clips.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import torch
from torch import Tensor

from experiments.recognition.protocol import Array
from indexing import ActionIndexer, Clip
from indexing.action.bank import Windows
from indexing.action.model import ClassProfiles, ShapeModel, class_scores, evidence, standardize
from indexing.actors import dataset
from indexing.joints import has_names as has_names
from indexing.joints import match_joints
from indexing.skeleton import Skeleton

_LIMBS = [f"{side}_{joint}" for side in ("left", "right") for joint in ("shoulder", "elbow", "wrist")]
JOINTS = {
    "utkinect": ["mid_hip", "spine", "neck", "nose", *_LIMBS[:3], "left_hand", *_LIMBS[3:], "right_hand"]
    + [f"{side}_{joint}" for side in ("left", "right") for joint in ("hip", "knee", "ankle", "foot")],
    "florence3d": ["nose", "neck", "spine", *_LIMBS]
    + [f"{side}_{joint}" for side in ("left", "right") for joint in ("hip", "knee", "ankle")],
}
"""Names of the joints, which the files number: the head is compared with a nose."""
EULER = 0.5772  # mean of the standard Gumbel distribution


def named(clip: Clip, name: str) -> Clip:
    """A clip of a set with names for its joints, if it has none."""
    if has_names(clip.skeleton):
        return clip
    bones = clip.skeleton.bones if clip.skeleton is not None else ()
    return clip.replace(skeleton=Skeleton(name, tuple(JOINTS[name]), bones))


def ways(learned: ActionIndexer, clips: Sequence[Clip], labels: Array, name: str) -> Callable[[Sequence[Clip]], dict[str, Array]]:
    """What every way says of clips, from one fitted indexer.

    Args:
        clips, labels: that it was fitted to; name: of their set.

    Raises:
        ValueError: a class has one exemplar only.
    """
    model = learned.model_
    itself = torch.eye(len(model.labels), dtype=torch.bool)
    originals = model.exemplars.crop(0)
    among = model.residuals(originals).masked_fill(itself, torch.inf)
    own = class_scores(among, model.labels, model.classes)
    alone = ClassProfiles.learn(own, model.labels, model.classes)
    if alone is None:
        raise ValueError("ways: a class has one exemplar only, and nothing to be asked of; give two, or no ways")
    near = -among.topk(3, dim=1, largest=False).values.mean(dim=1)
    background = _against_people(clips, labels, name)

    def say(asked: Sequence[Clip]) -> dict[str, Array]:
        query = learned._queries(asked)
        residual, scores = model.residuals(query), model.nearest_scores(query)
        local = residual.topk(3, dim=1, largest=False)
        found = {
            "best score": scores.amax(dim=1),
            "a: extreme values per class": _extreme(scores, own, model.labels),
            "b: nearest profiles": -torch.cdist(scores, own).topk(3, dim=1, largest=False).values.mean(dim=1),
            "b: local density": -local.values.mean(dim=1) - near[local.indices].mean(dim=1),
            "b: distance from the profiles": -alone.distance(scores, model.classes),
            "c: against synthetic people": background(asked),
            "d: agreement of scorers and crops": _agreement(model, query),
            "e: how far it stands out": evidence(scores, model.classes),
            "e: with the profiles of the nearest": evidence(scores, model.classes, alone.distance(scores, model.classes)),
        }
        return {way: np.asarray(values) for way, values in found.items()}

    return say


def _extreme(scores: Tensor, own: Tensor, labels: Tensor) -> Tensor:
    r"""``(Q,)`` log chance that an exemplar's own class is as far, the best over classes; distances are of Gumbel's distribution.

    Source: Rudd et al. 2018 (extreme value machine), with the tail fitted by moments.
    """
    classes = scores.shape[1]
    each = [-own[labels == c, c] for c in range(classes)]
    pooled = torch.cat([values - values.mean() for values in each]).std()
    scale = pooled * np.sqrt(6) / np.pi
    middle = torch.stack([values.mean() for values in each]) - EULER * scale
    beyond = -torch.expm1(-torch.exp(-((-scores - middle) / scale).clamp(-30, 30)))
    return beyond.clamp(min=1e-30).log().amax(dim=1)


def _agreement(model: ShapeModel, query: Windows) -> Tensor:
    """``(Q,)`` how many of whole exemplars, crops and kernel machine name the class that most of them name, then their margins."""
    whole = class_scores(model.whole_residuals(query, torch.arange(len(model.labels))), model.labels, model.classes)
    each = [whole, model.nearest_scores(query)]
    if model.kernels is not None:
        each += [model.kernel_scores(query), model.machine_scores(query)]
    votes = torch.stack([torch.nn.functional.one_hot(scores.argmax(dim=1), model.classes) for scores in each]).sum(dim=0)
    margins = torch.stack([standardize(scores).topk(2, dim=1).values for scores in each]).mean(dim=0)
    return votes.amax(dim=1) + 0.1 * (margins[:, 0] - margins[:, 1])


def _against_people(clips: Sequence[Clip], labels: Array, name: str) -> Callable[[Sequence[Clip]], Tensor]:
    """How much nearer clips are to the best class than to synthetic people who do thirteen things, seen from anywhere."""
    taught = [named(clip, name) for clip in clips]
    people = [match_joints(clip, taught[0].skeleton)[0] for clip in dataset(2, azimuth=[40.0, 160.0, 280.0], rng=0)]
    indexer = ActionIndexer(scorer="nearest", virtual_views=0, mirror=False).fit(taught, labels, background=people)
    known = indexer.model_.num_known

    def say(asked: Sequence[Clip]) -> Tensor:
        scores = indexer.model_.plain_scores(indexer._queries([named(clip, name) for clip in asked]))
        return scores[:, :known].amax(dim=1) - scores[:, known:].amax(dim=1)

    return say

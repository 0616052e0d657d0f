"""The report on what was learned: which clips, how the evidence is weighed, and which body parts tell the actions apart."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from indexing import files
from indexing.cameras import y_up
from indexing.clip import Clip
from indexing.opening import count
from indexing.report.canvas import FACE, LIGHT, new_figure, png, shorten_all, style
from indexing.report.page import markup
from indexing.report.summary import Summary, Table, register_page
from indexing.skeleton import Skeleton, usual_layout

# ----------------------------------------------------------------------------------------------------------------------
# Which body parts tell the actions apart: a skeleton per action, its joints and bones coloured by how much they matter.


if TYPE_CHECKING:
    from indexing.action.indexer import ActionIndexer

Array = NDArray[np.float64]
FILES = ("report.html", "metrics.json", "manifest.json", "body_parts.png")
NOBODY = "Nobody could be left out (the clips have no field 'subject', or it is one person): the usual weights stand."
COLUMNS = 5  # skeletons in a row
PANEL = 1.62, 1.95  # inches
PIECES = 16  # of a bone, each in its own colour
HOT = ("#f2a65a", "#dd4f0e")  # some, and most; the colour of lines = none
THIN, THICK, DOT = 1.6, 4.6, 2.2  # points: bones that matter least and most, and how much wider joints are than bones
HEAD = 15.0  # points across, where the joints of a face stand for it
TRAIL = 2  # joints per action whose path is drawn
NAMED = 3  # joints per action that the table names


@dataclass(frozen=True, eq=False)
class BodyParts:
    """How much every joint matters for every action, and a clip that shows each. importance ``(C, joints)``."""

    classes: Sequence[Hashable]
    importance: Array
    examples: Sequence[Clip]
    skeleton: Skeleton | None = None

    def __post_init__(self) -> None:
        values = np.asarray(self.importance, dtype=np.float64)
        joints = {clip.joints.shape[1] for clip in self.examples}
        if not len(self.classes) == len(values) == len(self.examples) or joints != {values.shape[1]}:
            raise ValueError(
                f"importance {values.shape} must be (classes, joints), with a class and an example in each row: got "
                f"{len(self.classes)} classes and {len(self.examples)} examples with {sorted(joints)} joints"
            )
        own = self.examples[0].skeleton if self.skeleton is None else self.skeleton
        object.__setattr__(self, "importance", values)
        object.__setattr__(self, "skeleton", usual_layout(values.shape[1]) if own is None else own)

    @property
    def shares(self) -> Array:
        """``(C, joints)`` importance between 0 (none, or misleading) and 1 (the joint that matters most for the action)."""
        positive = self.importance.clip(min=0)
        return np.asarray(positive / np.maximum(positive.max(axis=1, keepdims=True), 1e-12))


def measure_body_parts(indexer: ActionIndexer) -> BodyParts:
    """What a fitted indexer says: how much the margin of an action grows when a joint is seen."""
    import torch

    from indexing.action.learning import importance, typical

    groups = getattr(indexer, "groups_", None)
    numbers = None if groups is None else torch.from_numpy(np.unique(np.asarray(groups), return_inverse=True)[1])
    known = len(indexer.classes_)  # what follows is background
    examples = [indexer.exemplar(int(i)) for i in typical(indexer.model_)[:known]]
    values = importance(indexer.model_, numbers)[:known].cpu().numpy()
    return BodyParts(indexer.classes_.tolist(), values, examples, indexer.skeleton_)


def body_parts(parts: BodyParts) -> bytes:
    """PNG: a skeleton per action, in its most telling pose; strong colour and thick lines where a joint matters."""
    number = len(parts.classes)
    rows = -(-number // COLUMNS)
    columns = -(-number // rows)  # rows of about the same length
    width, height = PANEL[0] * columns + 0.2, PANEL[1] * rows + 0.42
    names = shorten_all(parts.classes, 20)
    with style():
        figure = new_figure(width, height)
        for i in range(number):
            row, column = divmod(i, columns)
            box = (0.1 + PANEL[0] * column, 0.42 + PANEL[1] * (rows - 1 - row), PANEL[0], PANEL[1] - 0.24)
            axes = figure.add_axes((box[0] / width, box[1] / height, box[2] / width, box[3] / height))
            axes.set_axis_off()
            _person(axes, parts, i)
            centre = ((box[0] + box[2] / 2) / width, (box[1] + box[3] + 0.05) / height)
            figure.text(*centre, names[i], ha="center", va="bottom", fontsize=9, fontweight="bold", parse_math=False)
        _key(figure, width, height)
        return png(figure)


def telling_joints(parts: BodyParts) -> list[list[Any]]:
    """The page's table of the joints that matter most, by name."""
    names = parts.skeleton.joints if parts.skeleton is not None else tuple(f"joint {i}" for i in range(parts.shares.shape[1]))
    rows: list[list[Any]] = []
    for label, share in zip(parts.classes, parts.shares, strict=True):
        first = [f"{names[j].replace('_', ' ')} ({share[j]:.0%})" for j in np.argsort(-share)[:NAMED] if share[j] > 0]
        rows.append([label, ", ".join(first) or markup('<span class="none">none stands out</span>')])
    return rows


def telling_pose(points: Array, usual: Array, share: Array) -> int:
    """Index of the frame in which the joints that matter are furthest from where they usually are. points
    ``(frames, joints, 2)``."""
    return int((np.nan_to_num(np.square(points - usual)).sum(axis=2) @ (share + 1e-3)).argmax())


def in_body(points: Array) -> Array:
    """``(frames, joints, 2)`` about the middle of the joints seen in each frame, in units of the person's usual height."""
    middle = np.nanmean(points, axis=1, keepdims=True)
    height = np.nanmedian(np.nanmax(points[..., 1], axis=1) - np.nanmin(points[..., 1], axis=1))
    return np.asarray((points - middle) / max(float(height), 1e-9))


def _person(axes: Any, parts: BodyParts, index: int) -> None:
    """One skeleton, and the paths of its most telling joints."""
    share = parts.shares[index]
    points = _points(parts.examples[index])
    everyone = np.concatenate([in_body(_points(clip)) for clip in parts.examples])
    usual = np.nan_to_num(everyone).sum(axis=0) / np.maximum((~np.isnan(everyone)).sum(axis=0), 1)
    pose = points[telling_pose(in_body(points), usual, share)]
    colours = _colours()
    paths = np.argsort(share)[-TRAIL:]
    for joint in paths:
        axes.plot(*points[:, joint].T, color=colours(share[joint]), linewidth=0.9, alpha=0.55, zorder=1, solid_capstyle="round")
    face = _face(parts.skeleton, len(pose)) & ~np.isnan(pose).any(axis=1)
    _draw_bones(axes, pose, share, _bones(parts.skeleton), colours)
    dots, values = pose[~face], share[~face]
    size = (THIN + DOT + (THICK - THIN + DOT) * values) * (1.0 if len(pose) <= 40 else 0.5)
    if face.any():  # a head in place of eyes and ears
        dots, values = np.vstack([dots, pose[face].mean(axis=0)]), np.append(values, share[face].max())
        size = np.append(size, HEAD)
    order = np.argsort(values)
    colour = colours(values[order])
    axes.scatter(*dots[order].T, s=np.square(size[order]), c=colour, edgecolors=LIGHT.paper, linewidths=0.6, zorder=4)
    _frame(axes, np.concatenate([pose, points[:, paths].reshape(-1, 2)]), points)


def _draw_bones(axes: Any, pose: Array, share: Array, bones: Sequence[tuple[int, int]], colours: Any) -> None:
    """Bones whose colour and width run from one end's share to the other's; what matters lies on top."""
    from matplotlib.collections import LineCollection

    along = np.linspace(0, 1, PIECES + 1)
    for a, b in sorted(bones, key=lambda bone: share[list(bone)].max()):
        if np.isnan(pose[[a, b]]).any():
            continue
        line = pose[a] + along[:, None] * (pose[b] - pose[a])
        value = share[a] + (along[1:] + along[:-1]) / 2 * (share[b] - share[a])
        pieces = list(np.stack([line[:-1], line[1:]], axis=1))
        widths = THIN + (THICK - THIN) * value
        axes.add_collection(LineCollection(pieces, colors=colours(value), linewidths=widths, capstyle="round", zorder=2))


def _points(clip: Clip) -> Array:
    """``(frames, joints, 2)`` of frames in which something was seen, y up."""
    points = y_up(clip)[..., :2].astype(np.float64)
    points[np.isnan(points).any(axis=2)] = np.nan
    return np.asarray(points[~np.isnan(points).all(axis=(1, 2))])


def _frame(axes: Any, shown: Array, points: Array) -> None:
    """Limits around the pose and the paths; the same margin for everyone."""
    height = np.nanmedian(np.nanmax(points[..., 1], axis=1) - np.nanmin(points[..., 1], axis=1))
    low, high = np.nanmin(shown, axis=0), np.nanmax(shown, axis=0)
    middle = (low + high) / 2
    half = 0.58 * max(float(height), float(high[1] - low[1]), float(high[0] - low[0]) * PANEL[1] / PANEL[0], 1e-9)
    aspect = PANEL[0] / (PANEL[1] - 0.24)
    axes.set(xlim=(middle[0] - aspect * half, middle[0] + aspect * half), ylim=(middle[1] - half, middle[1] + half))


def _key(figure: Any, width: float, height: float) -> None:
    """What the colours mean, below the skeletons."""
    middle, y = 0.5, 0.2 / height
    axes = figure.add_axes((middle - 0.45 / width, y - 0.045 / height, 0.9 / width, 0.09 / height))
    axes.imshow(np.linspace(0, 1, 64)[None], cmap=_colours(), aspect="auto")
    axes.set_axis_off()
    figure.text(middle - 0.53 / width, y, "tells little", ha="right", va="center", fontsize=8, color=LIGHT.muted)
    figure.text(middle + 0.53 / width, y, "tells most", ha="left", va="center", fontsize=8, color=LIGHT.muted)


def _face(skeleton: Skeleton | None, joints: int) -> NDArray[np.bool_]:
    """``(joints,)`` which belong to the face."""
    names = skeleton.joints if skeleton is not None else ("",) * joints
    return np.array([bool(set(re.split(r"[^a-z]+", name.lower())) & FACE) for name in names])


def _bones(skeleton: Skeleton | None) -> list[tuple[int, int]]:
    """Bones to draw: none of the face's, which would look like a mask."""
    if skeleton is None:
        return []
    face = _face(skeleton, len(skeleton.joints))
    return [(a, b) for a, b in skeleton.bones if not (face[a] or face[b])]


def _colours() -> Any:
    from matplotlib.colors import LinearSegmentedColormap

    return LinearSegmentedColormap.from_list("parts", (LIGHT.line, *HOT))


# ----------------------------------------------------------------------------------------------------------------------
# The page.


@dataclass(frozen=True, eq=False)
class TrainingReport:
    """What a model was learned from, into which file, and what a person should know of it."""

    indexer: ActionIndexer
    clips: Sequence[Clip]
    notes: Sequence[str] = ()
    closing: Sequence[str] = ()
    manifest: Mapping[str, Any] = field(default_factory=dict)

    @property
    def title(self) -> str:
        """Heading of the page."""
        return f"{len(self.indexer.classes_)} actions learned"

    @cached_property
    def parts(self) -> BodyParts:
        """How much each joint matters."""
        return measure_body_parts(self.indexer)


@register_page(TrainingReport, "training", FILES)
def summarize(report: TrainingReport) -> Summary:
    """Everything that is said of what was learned."""
    indexer, clips = report.indexer, report.clips
    rows = [
        [label, len(mine), f"{sum(clip.duration for clip in mine):.1f}", ", ".join(sorted({_joints_text(clip) for clip in mine}))]
        for label, mine in _by_label(clips).items()
    ]
    return Summary(
        headline=describe(report), cards=_cards(indexer, clips),
        tables=[Table(["action", "examples ", "seconds ", "joints "], rows)],
        notes=[*report.notes, *_background_notes(indexer)], closing=report.closing,
        pictures={"body_parts.png": lambda theme: body_parts(report.parts)},
        files={"metrics.json": lambda: _metrics(indexer, report.parts), files.MANIFEST: lambda: report.manifest},
        values=lambda: {
            "joints": telling_joints(report.parts), "weighing": _weight_rows(indexer),
            "examples": [[label, f"{number:,}", seconds] for label, number, seconds, _ in rows],
        },
    )  # fmt: skip


def _by_label(clips: Sequence[Clip]) -> dict[str, list[Clip]]:
    groups: dict[str, list[Clip]] = {}
    for clip in clips:
        groups.setdefault(str(clip.label), []).append(clip)
    return dict(sorted(groups.items()))


def _joints_text(clip: Clip) -> str:
    return f"{clip.joints.shape[1]} in {clip.dims}D"


def _background_notes(indexer: ActionIndexer) -> list[str]:
    """What the actions are told from, besides one another."""
    model = indexer.model_
    if not model.hidden:
        return []
    clips = int((model.labels >= model.num_known).sum())
    return [f"told from a background of {count(clips, 'clip')} in {count(model.hidden, 'kind')}, which are never reported"]


def describe(report: TrainingReport) -> str:
    """What was learned, in plain words."""
    indexer, clips = report.indexer, report.clips
    seconds = sum(clip.duration for clip in clips)
    words = [f"{len(indexer.classes_)} actions were learned from {len(clips)} clips ({seconds:.0f} s in all)."]
    if indexer.weights == "learned":
        people = people_left_out(indexer)
        chosen = f"How the evidence is weighed was chosen by what serves people best who are left out ({people} people)."
        words.append(chosen if people else NOBODY)
    return " ".join(words)


def people_left_out(indexer: ActionIndexer) -> int:
    """How many people the weights were learned from by leaving each out; 0 where nobody could be."""
    people = 0 if indexer.groups_ is None else len(set(indexer.groups_.tolist()))
    return people if people > 1 else 0


def _cards(indexer: ActionIndexer, clips: Sequence[Clip]) -> list[tuple[str, str, str]]:
    counts = Counter(str(clip.label) for clip in clips)
    few, many = min(counts.values()), max(counts.values())
    people = {str(clip.meta["subject"]) for clip in clips if "subject" in clip.meta}
    items = [
        ("Actions", f"{len(indexer.classes_):,}", ""),
        ("Examples", f"{len(clips):,}", f"{few} per action" if few == many else f"{few} to {many} per action"),
        ("Joints", f"{indexer.n_joints_}", "" if indexer.skeleton_ is None else indexer.skeleton_.name),
    ]
    return [*items, ("People", f"{len(people)}", "")] if people else items


def _weight_rows(indexer: ActionIndexer) -> list[list[str]]:
    """What each kind of evidence weighs."""
    model, blend = indexer.model_, indexer.model_.blend
    total = blend.kernel + blend.nearest
    depth = "of the 3D examples" if bool(model.exemplars.solid.any()) else "none: bodies stay flat, as in the image"
    equal = "no: equal weights serve people best who are left out" if people_left_out(indexer) else "no: nobody could be left out"
    learned = equal if model.joint_weights is None else "yes"
    shares = {"nearest": blend.nearest / total, "kernel": blend.kernel / total}
    if model.scorer != "both":
        shares = {name: float(name == model.scorer) for name in shares}
    return [
        ["Nearest example, whatever the viewpoint", f"{shares['nearest']:.0%}"],
        ["Kernel machine over virtual views", f"{shares['kernel']:.0%}"],
        ["Depth for virtual views", depth],
        ["Joints weighed differently", learned if indexer.weights == "learned" else "no: weights were not learned"],
    ]


def _metrics(indexer: ActionIndexer, parts: BodyParts) -> dict[str, Any]:
    joints = parts.skeleton.joints if parts.skeleton is not None else [str(i) for i in range(parts.shares.shape[1])]
    blend = indexer.model_.blend
    return {
        "actions": [str(label) for label in parts.classes],
        "joints": list(joints),
        "importance": parts.importance.tolist(),
        "blend": {"kernel": blend.kernel, "nearest": blend.nearest},
        "joint_weights_learned": indexer.model_.joint_weights is not None,
    }

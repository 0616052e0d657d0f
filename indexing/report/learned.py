"""The report on what was learned: which clips, how the evidence is weighed, and which body parts tell the actions apart."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from indexing import files
from indexing.report.body_parts import BodyParts, body_parts, body_parts_section, measure_body_parts
from indexing.report.page import Card, Column, cards, details, escape, made_by, page, section, settings, table

if TYPE_CHECKING:
    from indexing.clip import Clip
    from indexing.indexer import ActionIndexer

PICTURE = "body_parts.png"
NOBODY = "Nobody could be left out (the clips have no field 'subject', or it is one person): the usual weights stand."


def write_learned(
    folder: str | Path, indexer: ActionIndexer, clips: Sequence[Clip], notes: Sequence[str], manifest: Mapping[str, Any]
) -> Path:
    """Write a report into a folder: ``report.html``, ``body_parts.png``, ``metrics.json`` and ``manifest.json``.

    Args:
        indexer: fitted to ``clips``; manifest: of :func:`indexing.files.manifest`.

    Returns:
        the path of ``report.html``.

    Raises:
        ValueError: the folder or a file in it cannot be written.
    """
    where, parts = files.prepare(folder), measure_body_parts(indexer)
    names = [PICTURE, "metrics.json", files.MANIFEST, "report.html"]
    files.write_bytes(where / PICTURE, body_parts(parts))
    files.write_json(where / "metrics.json", _metrics(indexer, parts))
    files.write_json(where / files.MANIFEST, {**manifest, "files": names})
    sections = [cards(_headline(indexer, clips)), body_parts_section(parts), _weighing(indexer), _examples(clips)]
    if notes:
        sections.insert(1, section("Please note", f"<ul>{''.join(f'<li>{escape(note)}</li>' for note in notes)}</ul>"))
    made = "What was run, with which versions and on which files: enough to run it again."
    sections.append(section("How this was made", details("Settings, versions and inputs", settings(manifest)), made))
    html = page(
        f"{len(indexer.classes_)} actions learned",
        "\n".join(sections),
        summary=_summary(indexer, clips),
        kind="Action recognition",
        footer=made_by(manifest),
    )
    return files.write_text(where / "report.html", html)


def _summary(indexer: ActionIndexer, clips: Sequence[Clip]) -> str:
    seconds = sum(clip.duration for clip in clips)
    words = [f"{len(indexer.classes_)} actions were learned from {len(clips)} clips ({seconds:.0f} s in all)."]
    if indexer.weights == "learned":
        people = people_left_out(indexer)
        if people:
            words.append(f"How the evidence is weighed was chosen by what serves people best who are left out ({people} people).")
        else:
            words.append(NOBODY)
    return " ".join(words)


def people_left_out(indexer: ActionIndexer) -> int:
    """How many people the weights were learned from by leaving each out; 0 where nobody could be."""
    people = 0 if indexer.groups_ is None else len(set(indexer.groups_.tolist()))
    return people if people > 1 else 0


def _headline(indexer: ActionIndexer, clips: Sequence[Clip]) -> list[Card]:
    counts = Counter(str(clip.label) for clip in clips)
    few, many = min(counts.values()), max(counts.values())
    people = {str(clip.meta["subject"]) for clip in clips if "subject" in clip.meta}
    items = [
        Card("Actions", f"{len(indexer.classes_):,}"),
        Card("Examples", f"{len(clips):,}", f"{few} per action" if few == many else f"{few} to {many} per action"),
        Card("Joints", f"{indexer.n_joints_}", "" if indexer.skeleton_ is None else indexer.skeleton_.name),
    ]
    return [*items, Card("People", f"{len(people)}")] if people else items


def _weighing(indexer: ActionIndexer) -> str:
    """What each kind of evidence weighs."""
    model, blend = indexer.model_, indexer.model_.blend
    total = blend.kernel + blend.nearest
    depth = "of the 3D examples" if bool(model.exemplars.solid.any()) else "none: bodies stay flat, as in the image"
    equal = "no: equal weights serve people best who are left out" if people_left_out(indexer) else "no: nobody could be left out"
    learned = "yes" if model.parts.learned else equal
    shares = {"nearest": blend.nearest / total, "kernel": blend.kernel / total}
    if model.scorer != "both":
        shares = {name: float(name == model.scorer) for name in shares}
    rows = [
        ["Nearest example, whatever the viewpoint", f"{shares['nearest']:.0%}"],
        ["Kernel machine over virtual views", f"{shares['kernel']:.0%}"],
        ["Depth for virtual views", depth],
        ["Joints weighed differently", learned if indexer.weights == "learned" else "no: weights were not learned"],
    ]
    return section("How the evidence is weighed", table([Column("Evidence"), Column("Share", "long")], rows))


def _examples(clips: Sequence[Clip]) -> str:
    groups: dict[str, list[Clip]] = {}
    for clip in clips:
        groups.setdefault(str(clip.label), []).append(clip)
    rows = [
        [escape(label), f"{len(mine):,}", f"{sum(clip.duration for clip in mine):.1f}"] for label, mine in sorted(groups.items())
    ]
    return section("Examples", table([Column("Action"), Column("Clips", "number"), Column("Seconds", "number")], rows))


def _metrics(indexer: ActionIndexer, parts: BodyParts) -> dict[str, Any]:
    joints = parts.skeleton.joints if parts.skeleton is not None else [str(i) for i in range(parts.shares.shape[1])]
    blend = indexer.model_.blend
    return {
        "actions": [str(label) for label in parts.classes],
        "joints": list(joints),
        "importance": parts.importance.tolist(),
        "blend": {"kernel": blend.kernel, "nearest": blend.nearest, "sharpness": blend.sharpness},
        "joint_weights_learned": indexer.model_.parts.learned,
    }

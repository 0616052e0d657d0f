"""The report on what was learned, from the command that writes it."""

from __future__ import annotations

import json
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from indexing import ActionIndexer, Clip
from indexing.action.bank import Windows
from indexing.action.learning import halves, importance
from indexing.actors import dataset
from indexing.cli import main
from indexing.report.training import BodyParts, body_parts, measure_body_parts, telling_joints
from indexing.skeleton import COCO17


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    where = tmp_path_factory.mktemp("learned")
    clips = dataset(2, ["squat", "wave", "kick"], azimuth=0.0, rng=3)
    clips.save(where / "set.npz")
    assert main(["index", "fit", str(where / "set.npz"), "-o", str(where / "m.safetensors"), "--report", str(where / "out")]) == 0
    return where


@pytest.mark.slow
def test_the_report_says_what_was_learned(folder):
    names = ["body_parts.png", "manifest.json", "metrics.json", "report.html"]
    assert sorted(path.name for path in (folder / "out").iterdir()) == names
    html = (folder / "out" / "report.html").read_text()
    assert "3 actions learned" in html and "Which body parts matter" in html and "weights were not learned" in html
    measured = json.loads((folder / "out" / "metrics.json").read_text())
    assert measured["joint_weights_learned"] is False
    assert measured["actions"] == ["kick", "squat", "wave"] and len(measured["importance"]) == 3
    assert len(measured["joints"]) == len(measured["importance"][0]) == 17
    assert (folder / "out" / "body_parts.png").read_bytes().startswith(b"\x89PNG")


def test_flags_of_the_other_kind_of_input_are_refused(folder, capsys):
    words = ["index", "fit", str(folder / "set.npz"), "-o", str(folder / "n.safetensors")]
    assert main([*words, "--region", "all"]) == 2
    assert "--region: of the pixels of videos only" in capsys.readouterr().err
    assert not (folder / "n.safetensors").exists()


JOINTS, TELLING = 6, 2


def test_halves_show_every_joint_once_and_a_linear_margin_is_found():
    masks = halves(8, torch.Generator().manual_seed(0))
    assert (masks.sum(dim=1) == 4).all()
    assert (masks[::2] ^ masks[1::2]).all()
    assert (halves(3, torch.Generator().manual_seed(0)).sum(dim=1) == 3).all()  # fewer than three cannot be compared
    share = torch.tensor([[1.0, -0.5, 0.2, 0.0, 2.0, 0.3], [0.0, 0.7, 0.1, 1.5, -1.0, 0.4]])
    labels, groups = torch.tensor([0, 0, 1, 1]), torch.tensor([0, 1, 0, 1])
    windows = Windows(torch.zeros(4, 5, JOINTS, 2), torch.ones(4, JOINTS, dtype=torch.bool))
    windows.values[:, 0, 0, 0] = labels.float()  # lets the stub tell who asks

    def residuals(query):
        asks = query.values[:, 0, 0, 0].long()
        evidence = (query.seen.float() * share[asks]).sum(dim=1, keepdim=True)
        return torch.where(asks[:, None] == labels[None], -evidence, torch.zeros(()))

    exemplars = SimpleNamespace(crop=lambda _: windows)
    model = SimpleNamespace(exemplars=exemplars, labels=labels, classes=2, residuals=residuals)
    found = importance(model, groups)
    # halves of fixed size tell joints from each other, not how many are seen: compare about the mean
    centred = share.double() - share.double().mean(dim=1, keepdim=True)
    torch.testing.assert_close(found - found.mean(dim=1, keepdim=True), centred, atol=0.15, rtol=0.15)


def fitted(people=3):
    rng = np.random.default_rng(0)
    curves = rng.normal(size=(3, 12, 2)) * 3
    clips, labels, who = [], [], []
    for person in range(people):
        for action in range(3):
            joints = rng.normal(size=(12, JOINTS, 2))
            joints[:, TELLING] = curves[action] + 0.1 * rng.normal(size=(12, 2))
            clips.append(joints)
            labels.append("abc"[action])
            who.append(person)
    return ActionIndexer(scorer="nearest", search=False, mirror=False).fit(clips, labels), who


def test_a_planted_joint_matters_most_for_every_action():
    indexer, who = fitted()
    indexer.groups_ = np.array(who)
    parts = measure_body_parts(indexer)
    assert list(parts.classes) == ["a", "b", "c"]
    assert (parts.importance.argmax(axis=1) == TELLING).all()
    assert parts.shares.min() == 0
    assert (parts.shares.max(axis=1) == 1).all()
    assert np.isfinite(measure_body_parts(fitted(people=1)[0]).importance).all()  # one example per action is enough
    with pytest.raises(ValueError, match=r"importance \(2, 3\) must be \(classes, joints\)"):
        BodyParts(["a", "b"], np.zeros((2, 3)), parts.examples)


def people(count, joints=17, skeleton=COCO17, unseen=()):
    rng = np.random.default_rng(1)
    points = rng.normal(size=(count, 5, joints, 2))
    points[:, :, list(unseen)] = np.nan
    points[:, 2] = np.nan if unseen else points[:, 2]
    clips = [Clip(one, skeleton=skeleton) for one in points]
    return BodyParts([f"<move {i}>" for i in range(count)], rng.normal(size=(count, joints)), clips)


def test_the_joints_that_matter_most_are_named():
    rows = telling_joints(people(2))
    assert [label for label, _ in rows] == ["<move 0>", "<move 1>"] and all("(100%)" in str(joints) for _, joints in rows)
    nobody = BodyParts(["a"], -np.ones((1, 17)), people(1).examples)
    assert "none stands out" in telling_joints(nobody)[0][1]


def test_skeletons_without_bones_or_names_and_joints_that_were_not_seen():
    parts = people(1, joints=5, skeleton=None, unseen=[3])
    assert parts.skeleton is None
    assert body_parts(parts).startswith(b"\x89PNG")

"""Model files made to do harm: whatever a part of them says, loading refuses it in one line, or what is loaded can be used."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors import safe_open
from safetensors.torch import save_file

from indexing import ActionIndexer, BrightnessIndexer, Clip, PhaseIndexer
from indexing.action.joint_weights import JointWeights
from indexing.modelfile import (
    Parts,
    labels_from_json,
    labels_to_json,
    model_kind,
    number,
    part,
    read_fields,
    read_integer,
    skeleton_from_json,
    store,
    tensors_of,
    usable,
)
from tests.grid import grid


def clip(seed: int, frames: int = 30) -> Clip:
    rng = np.random.default_rng(seed)
    rest, swing = rng.uniform(100, 400, (1, 17, 2)), rng.uniform(0.1, 0.7, (1, 17, 2))
    return Clip(rest + 20 * np.sin(np.arange(frames)[:, None, None] * swing), label="abc"[seed % 3], name=f"q{seed}")


@pytest.fixture(scope="module")
def models(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder, clips = tmp_path_factory.mktemp("models"), [clip(i) for i in range(6)]
    films = [np.uint8(40 * np.random.default_rng(i % 2).random((12, 24, 32)).cumsum(0) % 255) for i in range(4)]
    fitted: dict[str, Any] = {
        "action": ActionIndexer(search=False, virtual_views=1, reject=0.2).fit(clips),
        "phase": PhaseIndexer(harmonics=1, course="once", mirror=False).fit([clip(i, 8) for i in range(3)]),
        "bright": BrightnessIndexer(size=24, flip=False).fit(films, ["a", "b", "a", "b"]),
    }
    # weights of joints that differ, which so few examples do not teach
    weights = JointWeights(torch.linspace(0.5, 1.5, 17).repeat(3, 1), torch.tensor([0.5, 1.0, 1.5]))
    fitted["action"].model_ = replace(fitted["action"].model_, joint_weights=weights)
    for name, indexer in fitted.items():
        indexer.save(folder / f"{name}.safetensors")
    return {name: folder / f"{name}.safetensors" for name in fitted}


KINDS: dict[str, Any] = {"action": ActionIndexer, "phase": PhaseIndexer, "bright": BrightnessIndexer}


def changed(path: Path, target: Path, tensor: str = "", value: Any = None, **header: Any) -> Path:
    """The model with another tensor, or with other entries of its header; a dict is put into what is there."""
    with safe_open(path, framework="pt") as file:
        tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        known = json.loads(file.metadata()["dyntorch"])
    if tensor:
        tensors[tensor] = value(tensors[tensor])
    for key, new in header.items():
        known[key] = known[key] | new if isinstance(new, dict) and isinstance(known.get(key), dict) else new
    save_file(tensors, target, metadata={"dyntorch": json.dumps(known)})
    return target


def refused(name: str, path: Path, *words: str) -> None:
    with pytest.raises(ValueError, match=re.escape(str(path))) as caught:
        KINDS[name].load(path)
    said = str(caught.value)
    assert type(caught.value) is ValueError
    assert "\n" not in said
    assert "; " in said
    assert len(said) < 400 + len(str(path))
    assert all(word in said for word in words), said


def all_of(value: float) -> Any:
    return lambda tensor: torch.full_like(tensor, value)


TENSORS = {
    "action": "crops.values views.values moments.values metric hub parts.joints machine.dual scales evidence_out",
    "phase": "bank.values phase wrong course.0.shapes",
    "bright": "motion",
}


@pytest.mark.parametrize(("name", "tensor"), [(name, tensor) for name, tensors in TENSORS.items() for tensor in tensors.split()])
def test_no_number_of_a_model_is_missing_or_beyond_what_can_be_computed(name: str, tensor: str, models, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    path = tmp_path / "m.safetensors"
    for value in (float("nan"), float("inf"), -float("inf"), 3e38):
        refused(name, changed(models[name], path, tensor, all_of(value)), tensor, "expected numbers")
    for kind in (torch.int64, torch.float16, torch.uint8, torch.float8_e4m3fn):
        refused(name, changed(models[name], path, tensor, lambda t, kind=kind: t.float().to(kind)), tensor, "expected float32")
    refused(name, changed(models[name], path, tensor, lambda t: t[None]), tensor)


APART: tuple[tuple[str, str, Any], ...] = (
    ("action", "labels", all_of(0)),
    ("action", "labels", all_of(9)),
    ("action", "owner", all_of(0)),
    ("action", "crops.seen", lambda t: t.to(torch.uint8)),
    ("action", "machine.counts", all_of(0)),
    ("action", "machine.counts", all_of(2**40)),
    ("action", "parts.channels", all_of(0)),
    ("action", "parts.joints", all_of(-1)),
    ("action", "solid", lambda t: t[:1]),
    ("action", "metric_power", all_of(1e6)),
    ("phase", "label", all_of(1)),
    ("phase", "phase", all_of(2)),
    ("phase", "course.1.seen", lambda t: t[:-1]),
    ("bright", "lengths", all_of(2**40)),
    ("bright", "labels", all_of(0)),
)


@grid((("name", "tensor", "value"), APART))
def test_parts_that_do_not_belong_together_are_refused(name: str, tensor: str, value: Any, models, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    refused(name, changed(models[name], tmp_path / "m.safetensors", tensor, value), "not a model that can be used")


LIES: dict[str, list[dict[str, Any]]] = {
    "action": [
        {"parameters": {"tempi": [0.5] * 10**6}},
        {"parameters": {"length": 10**9}},
        {"parameters": {"length": 7}},
        {"parameters": {"random_state": 1e308}},
        {"parameters": {"search": True}},
        {"joints": 10**400},
        {"joints": 0},
        {"scorer": "nearest"},
        {"view": []},
        {"blend": {"kernel": float("nan")}},
        {"blend": {"more": 1}},
        {"groups": ["a"]},
        {"skeleton": ["s", ["a"] * 3, []]},
        {"skeleton": ["s", ["a"] * 17, [[0, 10**400]]]},
        {"classes": {"values": ["a", "a", "b"]}},
        {"classes": {"values": ["a", "b", ["c"]]}},
        {"classes": {"dtype": "<U999999999"}},
        {"classes": {"values": [0, 1, float("nan")], "dtype": "<f8"}},
        {"version": 10**400},
        {"format": [[1e308] * 1000]},
    ],
    "phase": [{"joints": 3}, {"periodic": [1, 0, 0]}, {"parameters": {"harmonics": 10**9}}],
    "bright": [{"parameters": {"size": 10**400}}, {"parameters": {"region": [10**400, 0, 1, 1]}}, {"classes": {"values": ["a"]}}],
}


@pytest.mark.slow
@grid((("name", "header"), [(name, header) for name, headers in LIES.items() for header in headers]))
def test_headers_that_lie_are_refused(name: str, header: dict[str, Any], models, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    refused(name, changed(models[name], tmp_path / "m.safetensors", **header))


@pytest.mark.parametrize("name", KINDS)
def test_headers_without_end_pipes_and_devices_are_refused(name: str, tmp_path: Path) -> None:
    path = tmp_path / "m.safetensors"
    for text in ("[" * 100_000, "9" * 5000, '{"a":' * 5000, "{"):
        save_file({"a": torch.zeros(1)}, path, metadata={"dyntorch": text})
        refused(name, path, "its header is damaged")
        with pytest.raises(ValueError, match="its header is damaged"):
            model_kind(path)
    os.mkfifo(tmp_path / "pipe")
    for place, said in ((tmp_path / "pipe", "is a pipe"), (Path("/dev/zero"), "is a device"), (tmp_path, "is a folder")):
        refused(name, place, said)


def test_labels_and_truth_values_survive() -> None:
    for labels in (
        np.array([3, -1, 7]), np.array([3, 1, 7], dtype=np.uint8), np.array([0.5, -2.0, 1e9]), np.array(["ä", "日本", "</script>"]),
        np.array([True, False]), np.array(["a", "b"], dtype=object),
    ):  # fmt: skip
        again = labels_from_json(json.loads(json.dumps(labels_to_json(labels))))
        assert again.dtype == labels.dtype and again.tolist() == labels.tolist()
    odd = torch.tensor([0, 1, 2, 255], dtype=torch.uint8).view(torch.bool)
    assert Parts({"a": odd}).truth("a", 4).tolist() == [False, True, True, True]


@dataclass(frozen=True)
class Inner:
    values: torch.Tensor = field(metadata=store("real", "rows", "wide"))
    rows: torch.Tensor | None = field(metadata=store("every", "rows", below="rows"))


@dataclass(frozen=True)
class Outer:
    shown: Inner = field(metadata=part(rows="windows"))
    other: Inner | None = field(metadata=part("", rows=3))
    weight: float = field(metadata=store("real", name="w", most=1))
    about: str = ""


def test_a_model_is_kept_by_its_fields() -> None:
    model = Outer(Inner(torch.ones(5, 2), torch.arange(5)), Inner(torch.ones(3, 2), None), 0.5, "not kept")
    kept = tensors_of(model)
    assert list(kept) == ["shown.values", "shown.rows", "values", "w"]
    sizes: dict[str, int] = {}
    found = read_fields(Outer, Parts(kept), sizes)
    assert sizes == {"windows": 5, "wide": 2} and found["weight"] == 0.5 and found["other"].rows is None
    assert torch.equal(found["shown"].rows, torch.arange(5)) and "about" not in found
    with pytest.raises(ValueError, match=r"shown\.values: expected float32 \(4, any\)"):
        read_fields(Outer, Parts(kept), {"windows": 4})
    with pytest.raises(ValueError, match=r"values: expected float32 \(3, 2\), got float32 \(4, 2\)"):
        read_fields(Outer, Parts({**kept, "values": torch.ones(4, 2)}), {})
    with pytest.raises(ValueError, match="w: expected numbers from -1e\\+10 to 1"):
        read_fields(Outer, Parts({**kept, "w": torch.tensor(2.0)}), {})


def test_parts_and_values_say_what_they_expect() -> None:
    parts = Parts({"a": torch.arange(6).reshape(2, 3), "b": torch.ones(2)})
    assert parts.integers("a", None, 3).shape == (2, 3)
    assert parts.every("a", 2, 3, below=6).numel() == 6
    wrong: list[tuple[Callable[[], object], str]] = [
        (lambda: parts.integers("a", None, 4), r"a: expected int64 \(any, 4\), got int64 \(2, 3\)"),
        (lambda: parts.real("b", 2, least=2, most=3), r"b: expected numbers from 2 to 3"),
        (lambda: parts.every("a", 2, 3, below=10), "a: expected each of the numbers from 0 to 9"),
        (lambda: number(True, "x", 0, 1), "x: expected a number from 0 to 1, got True"),
        (lambda: read_integer(1.0, "x", 0, 1), r"x: expected a whole number from 0 to 1, got 1\.0"),
        (lambda: skeleton_from_json(["s", ["a"], []], 2), "skeleton: 1 names for 2 joints"),
        (lambda: labels_from_json({"values": [], "dtype": "<i8"}), "are no labels"),
    ]
    for call, said in wrong:
        with pytest.raises(ValueError, match=said):
            call()
    with pytest.raises(ValueError, match=r"m: not a model that can be used \(KeyError: 'a'\); fit"), usable("m"):
        raise KeyError("a")

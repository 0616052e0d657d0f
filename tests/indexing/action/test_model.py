"""Model files: what is read back answers the same, what is damaged is refused by name, and nothing is ever half-written."""

import json
import re

import numpy as np
import pytest
import torch
from safetensors import safe_open
from safetensors.torch import save_file
from sklearn.base import clone

from indexing import ActionIndexer, ActionOptions
from indexing.actors import Person, dataset

FEW = ("squat", "wave", "kick", "bow")


@pytest.fixture(scope="module")
def train():
    return dataset([Person.random(0), Person.random(1)], FEW, azimuth=0.0, rng=0)


@pytest.fixture(scope="module")
def test():
    return dataset([Person.random(2)], FEW, azimuth=(60.0, 120.0), rng=1)


@pytest.fixture(scope="module")
def saved(train, tmp_path_factory):
    path = tmp_path_factory.mktemp("model") / "moves.safetensors"
    ActionIndexer(reject=0.2, none_label="none").fit(train).save(path)
    return path


def contents(path):
    with safe_open(path, framework="pt") as file:
        return {name: file.get_tensor(name) for name in file.keys()}, json.loads(file.metadata()["dyntorch"])  # noqa: SIM118


def write(path, tensors, header):
    save_file(tensors, path, metadata={"dyntorch": header if isinstance(header, str) else json.dumps(header)})


@pytest.mark.slow
def test_parameters_of_numpy_types_survive(train, tmp_path):
    options = {
        "none_label": np.str_("none"), "reject": np.float64(0.1), "tempi": np.array([0.8, 1.2]), "length": np.int64(10),
        "random_state": None,
    }  # fmt: skip
    ActionIndexer(scorer="nearest", **options).fit(train).save(tmp_path / "m.safetensors")
    loaded = ActionIndexer.load(str(tmp_path / "m.safetensors"))
    for name, value in options.items():
        np.testing.assert_array_equal(getattr(loaded, name), value)


def test_labels_and_parameters_that_no_file_can_hold_are_refused(train, tmp_path):
    for labels in (np.array(FEW, dtype="S"), np.array([(), (1,), (2,), (3,), 0], dtype=object)[:4]):
        with pytest.raises(ValueError, match=r"labels of type .* cannot be saved; use text or numbers"):
            ActionIndexer(scorer="nearest").fit(train[:4], labels).save(tmp_path / "m.safetensors")
    with pytest.raises(ValueError, match="none_label"):
        ActionIndexer(scorer="nearest", none_label=object()).fit(train).save(tmp_path / "m.safetensors")
    assert list(tmp_path.iterdir()) == []


def refused(path, *words):
    with pytest.raises(ValueError, match=re.escape(str(path))) as caught:
        ActionIndexer.load(path)
    assert "\n" not in str(caught.value) and all(word in str(caught.value) for word in words), str(caught.value)


def test_what_is_no_model_file_is_refused(saved, tmp_path):
    refused(tmp_path / "none.safetensors", "no such", "index fit")
    refused(tmp_path)  # a folder
    path, whole = tmp_path / "m.safetensors", saved.read_bytes()
    for data in (b"", b"{}", b"hello world, this is text\n" * 50, bytes(4096), b"PK\x03\x04" * 99):
        path.write_bytes(data)
        refused(path, "not a model file", "index fit")
    for size in (1, 7, 8, 9, 100, 1000, len(whole) // 2, len(whole) - 1):
        path.write_bytes(whole[:size])
        refused(path, "not a model file")
    save_file({"weight": torch.zeros(3)}, path)
    refused(path, "action-indexer is expected")
    write(path, {"weight": torch.zeros(3)}, {"format": "something"})
    refused(path, "action-indexer is expected")


def test_headers_and_tensors_that_make_no_sense_are_refused(saved, tmp_path):
    (tensors, header), path = contents(saved), tmp_path / "m.safetensors"
    headers = ["", "not json", "[]", "3", "null", '"text"']
    keys = ("format", "version", "parameters", "classes", "joints", "view", "skeleton")
    headers += [{name: value for name, value in header.items() if name != key} for key in keys]
    wrong = (
        ("version", 99), ("parameters", {"veiw": "any"}), ("parameters", []), ("parameters", {"reject": "often"}),
        ("classes", {"values": ["a", "b"], "dtype": "<i8"}), ("classes", {"values": ["a", "b"], "dtype": "<U1"}),
        ("classes", {"values": ["a"], "dtype": "strange"}), ("joints", "many"), ("joints", 5), ("skeleton", ["s", ["a"], [[0, 9]]]),
        ("skeleton", 7), ("view", "front"),
    )  # fmt: skip
    for one in [*headers, *(header | {key: value} for key, value in wrong)]:
        write(path, tensors, one)
        refused(path)
    for name in tensors:
        if name not in ("symmetry", "scales", "seconds", "cyclic"):  # a model may do without these
            write(path, {key: value for key, value in tensors.items() if key != name}, header)
            refused(path, "fit on the examples again")
    for name in ("labels", "crops.values", "crops.seen", "moments.seen", "owner", "metric", "hub", "machine.dual"):
        write(path, {**tensors, name: tensors[name][:-1].contiguous()}, header)
        refused(path)


def test_files_from_before_depth_went_are_read_where_it_decided_nothing(saved, tmp_path):
    (tensors, header), path = contents(saved), tmp_path / "m.safetensors"
    old = header | {"layout": None, "parts": [0.0, 0.0], "parameters": header["parameters"] | {"depth": "auto"}}
    write(path, tensors | {"parts.joints": torch.ones(3, 17), "parts.channels": torch.ones(3)}, old)
    loaded = ActionIndexer.load(path)
    assert loaded.get_params() == ActionIndexer.load(saved).get_params() and loaded.model_.joint_weights is None
    write(path, tensors, old | {"layout": {"joints": ["nose"], "photograph": True}})
    refused(path, "depth of 2D examples is no longer guessed")


def test_weights_of_joints_survive_and_are_refused_where_nothing_counts(saved, test, tmp_path):
    (tensors, header), path = contents(saved), tmp_path / "m.safetensors"
    draw = torch.Generator().manual_seed(0)
    weights = {
        "parts.joints": torch.rand(3, 17, generator=draw), "parts.channels": torch.tensor([0.5, 1.0, 1.5]),
        "parts.by_class": torch.rand(4, 17, generator=draw),
    }  # fmt: skip
    write(path, tensors | weights, header)
    loaded, equal = ActionIndexer.load(path), ActionIndexer.load(saved)
    loaded.save(tmp_path / "again.safetensors")
    assert contents(tmp_path / "again.safetensors")[0].keys() == tensors.keys() | weights.keys()
    again = ActionIndexer.load(tmp_path / "again.safetensors")
    np.testing.assert_array_equal(again.decision_function(test), loaded.decision_function(test))
    assert np.abs(loaded.decision_function(test) - equal.decision_function(test)).max() > 1e-3
    for name, value in weights.items():
        write(path, tensors | weights | {name: torch.zeros_like(value)}, header)
        refused(path, "no joint or no channel counts")
        write(path, tensors | weights | {name: value[:-1].contiguous()}, header)
        refused(path)


def test_options_are_kept_where_they_are_not_the_defaults(train, test, tmp_path):
    usual, other = tmp_path / "usual.safetensors", tmp_path / "other.safetensors"
    plain = ActionIndexer(scorer="nearest", options=ActionOptions()).fit(train)
    plain.save(usual)
    assert "options" not in contents(usual)[1]["parameters"] and ActionIndexer.load(usual).options is None
    options = ActionOptions(num_durations=2, rest_weight=1.0)
    taught = clone(ActionIndexer(scorer="nearest", options=options)).fit(train)
    taught.save(other)
    assert contents(other)[1]["parameters"]["options"] == {"num_durations": 2, "rest_weight": 1.0}
    again = ActionIndexer.load(other)
    assert again.options == options
    np.testing.assert_array_equal(again.score_frames(test[0]), taught.score_frames(test[0]))
    assert not np.array_equal(again.score_frames(test[0]), plain.score_frames(test[0]))


def test_options_that_are_none_are_refused(saved, tmp_path):
    (tensors, header), path = contents(saved), tmp_path / "bad.safetensors"
    for options, message in (
        ([1], "options: expected fields"), ({"nearest": {"neighbours": 1}}, "options: there is no 'nearest'"),
        ({"num_durations": 1.5}, "options.num_durations: expected a value like 24"), ({"window_step": "x"}, "options.window_step"),
    ):  # fmt: skip
        header["parameters"]["options"] = options
        write(path, tensors, header)
        refused(path, message)

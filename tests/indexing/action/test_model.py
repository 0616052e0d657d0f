"""Model files: what is read back answers the same, what is damaged is refused by name, and nothing is ever half-written."""

import json
import os
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


@pytest.mark.parametrize(
    "labels",
    [
        np.array([3, -1, 7, 2]), np.array([3, 1, 7, 2], dtype=np.uint8), np.array([0.5, 1.5, -2.0, 1e9]), np.array(FEW),
        np.array(["ä", "日本", "</script>", "a b"]), np.array([True, False, True, False]), np.array(FEW, dtype=object),
    ],
    ids=["int", "uint8", "float", "str", "unicode", "bool", "object"],
)  # fmt: skip
def test_labels_survive(labels, train, tmp_path):
    indexer = ActionIndexer(scorer="nearest").fit(train[:4], labels)
    indexer.save(tmp_path / "m.safetensors")
    loaded = ActionIndexer.load(tmp_path / "m.safetensors")
    assert loaded.classes_.dtype == indexer.classes_.dtype
    assert loaded.predict(train[:4]).tolist() == labels.tolist()


@pytest.mark.parametrize(
    "options",
    [
        {"none_label": np.int64(-1)}, {"none_label": np.str_("none")}, {"none_label": None}, {"reject": np.float64(0.1)},
        {"tempi": np.array([0.8, 1.2])}, {"length": np.int64(10)}, {"random_state": None},
    ],
    ids=str,
)  # fmt: skip
def test_parameters_of_numpy_types_survive(options, train, tmp_path):
    ActionIndexer(scorer="nearest", **options).fit(train).save(tmp_path / "m.safetensors")
    loaded = ActionIndexer.load(tmp_path / "m.safetensors")
    for name, value in options.items():
        np.testing.assert_array_equal(getattr(loaded, name), value)


@pytest.mark.parametrize(
    "labels", [np.array(FEW, dtype="S"), np.array([(), (1,), (2,), (3,), 0], dtype=object)[:4]], ids=["bytes", "tuples"]
)
def test_labels_that_no_file_can_hold_are_refused(labels, train, tmp_path):
    indexer = ActionIndexer(scorer="nearest").fit(train[:4], labels)
    with pytest.raises(ValueError, match=r"labels of type .* cannot be saved; use text or numbers"):
        indexer.save(tmp_path / "m.safetensors")
    assert list(tmp_path.iterdir()) == []


def test_parameters_that_no_file_can_hold_are_refused(train, tmp_path):
    indexer = ActionIndexer(scorer="nearest", none_label=object()).fit(train)
    with pytest.raises(ValueError, match="none_label"):
        indexer.save(tmp_path / "m.safetensors")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_a_loaded_model_learns_on(saved, train, test):
    lunges = dataset([Person.random(0)], ["lunge"], azimuth=0.0, rng=5)
    loaded = ActionIndexer.load(saved).partial_fit(lunges)
    assert loaded.classes_.tolist() == sorted([*FEW, "lunge"])
    assert loaded.set_params(reject=None).fit(train).score(test, test.labels) > 0.8


def test_saving_twice_writes_the_same_bytes(saved, tmp_path):
    ActionIndexer.load(saved).save(tmp_path / "again.safetensors")
    assert (tmp_path / "again.safetensors").read_bytes() == saved.read_bytes()


def refused(path, *words):
    with pytest.raises(ValueError, match=re.escape(str(path))) as caught:
        ActionIndexer.load(path)
    message = str(caught.value)
    assert type(caught.value) is ValueError
    assert "\n" not in message
    assert all(word in message for word in words), message


def test_a_missing_file_is_named(tmp_path):
    refused(tmp_path / "none.safetensors", "no such", "index fit")
    refused(tmp_path)  # a folder


@pytest.mark.parametrize("data", [b"", b"{}", b"hello world, this is text\n" * 50, bytes(4096), b"PK\x03\x04" * 99])
def test_other_files_are_refused(data, tmp_path):
    path = tmp_path / "m.safetensors"
    path.write_bytes(data)
    refused(path, "not a model file", "index fit")


def test_truncated_files_are_refused(saved, tmp_path):
    data, path = saved.read_bytes(), tmp_path / "m.safetensors"
    for size in (1, 7, 8, 9, 100, 1000, len(data) // 2, len(data) - 1):
        path.write_bytes(data[:size])
        refused(path, "not a model file")


def test_safetensors_of_something_else_are_refused(tmp_path):
    path = tmp_path / "m.safetensors"
    save_file({"weight": torch.zeros(3)}, path)
    refused(path, "action-indexer is expected")
    save_file({"weight": torch.zeros(3)}, path, metadata={"dyntorch": json.dumps({"format": "something"})})
    refused(path, "action-indexer is expected")


@pytest.mark.parametrize("header", ["", "not json", "[]", "3", "null", '"text"', "{"])
def test_strange_metadata_is_refused(header, saved, tmp_path):
    tensors, _ = contents(saved)
    save_file(tensors, tmp_path / "m.safetensors", metadata={"dyntorch": header})
    refused(tmp_path / "m.safetensors")


@pytest.mark.parametrize("key", ["format", "version", "parameters", "classes", "joints", "view", "skeleton"])
def test_a_missing_key_is_refused(key, saved, tmp_path):
    tensors, metadata = contents(saved)
    del metadata[key]
    save_file(tensors, tmp_path / "m.safetensors", metadata={"dyntorch": json.dumps(metadata)})
    refused(tmp_path / "m.safetensors")


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("version", 99), ("parameters", {"veiw": "any"}), ("parameters", []), ("parameters", {"reject": "often"}),
        ("parameters", {"length": -3}), ("parameters", {"view": "front"}), ("classes", {"values": ["a", "b"], "dtype": "<i8"}),
        ("classes", {"values": ["a", "b"], "dtype": "<U1"}), ("classes", {"values": ["a"], "dtype": "strange"}), ("classes", []),
        ("joints", "many"), ("joints", None), ("joints", 5), ("skeleton", ["s", ["a"], [[0, 9]]]), ("skeleton", ["s"]),
        ("skeleton", 7), ("view", "front"),
    ],
    ids=str,
)  # fmt: skip
def test_wrong_values_are_refused(key, value, saved, tmp_path):
    tensors, metadata = contents(saved)
    save_file(tensors, tmp_path / "m.safetensors", metadata={"dyntorch": json.dumps(metadata | {key: value})})
    refused(tmp_path / "m.safetensors")


def test_files_from_before_depth_went_are_read_where_none_was_guessed(saved, tmp_path):
    tensors, metadata = contents(saved)
    old = metadata | {"layout": None, "parameters": metadata["parameters"] | {"depth": "auto"}}
    save_file(tensors, tmp_path / "m.safetensors", metadata={"dyntorch": json.dumps(old)})
    assert ActionIndexer.load(tmp_path / "m.safetensors").get_params() == ActionIndexer.load(saved).get_params()
    old["layout"] = {"joints": ["nose"], "photograph": True}
    save_file(tensors, tmp_path / "m.safetensors", metadata={"dyntorch": json.dumps(old)})
    refused(tmp_path / "m.safetensors", "depth of 2D examples is no longer guessed")


def test_missing_tensors_are_refused(saved, tmp_path):
    tensors, metadata = contents(saved)
    for name in tensors:
        if name not in ("symmetry", "scales", "seconds", "cyclic"):  # a model may do without these
            rest = {key: value for key, value in tensors.items() if key != name}
            save_file(rest, tmp_path / "m.safetensors", metadata={"dyntorch": json.dumps(metadata)})
            refused(tmp_path / "m.safetensors", "fit on the examples again")


@pytest.mark.parametrize(
    "name", ["labels", "crops.values", "crops.seen", "moments.seen", "owner", "metric", "hub", "parts.joints", "machine.dual"]
)
def test_tensors_that_do_not_fit_together_are_refused(name, saved, tmp_path):
    tensors, metadata = contents(saved)
    short = {**tensors, name: tensors[name][:-1].contiguous()}
    save_file(short, tmp_path / "m.safetensors", metadata={"dyntorch": json.dumps(metadata)})
    refused(tmp_path / "m.safetensors")


def test_damaged_headers_are_refused_or_harmless(saved, tmp_path):
    data, path, rng = bytearray(saved.read_bytes()), tmp_path / "m.safetensors", np.random.default_rng(0)
    for at in rng.integers(0, 3000, 150):
        broken = data.copy()
        broken[at] ^= 1 << int(rng.integers(8))
        path.write_bytes(broken)
        try:
            ActionIndexer.load(path)
        except ValueError as error:
            assert str(path) in str(error)  # noqa: PT017  (some damage leaves a valid model, e.g. in a joint's name)


def test_a_failing_write_keeps_the_old_file_and_leaves_nothing_behind(saved, train, tmp_path, monkeypatch):
    path = tmp_path / "m.safetensors"
    path.write_bytes(saved.read_bytes())

    def full(*args, **kwargs):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "replace", full)
    with pytest.raises(ValueError, match="No space left"):
        ActionIndexer(scorer="nearest").fit(train[:4]).save(path)
    monkeypatch.undo()
    assert path.read_bytes() == saved.read_bytes()
    assert [p.name for p in tmp_path.iterdir()] == ["m.safetensors"]


def test_places_that_cannot_be_written_are_named(train, tmp_path):
    indexer = ActionIndexer(scorer="nearest").fit(train[:4])
    for path in (tmp_path / "no" / "such" / "m.safetensors", tmp_path):
        with pytest.raises(ValueError, match=re.escape(str(path))):
            indexer.save(path)
    assert list(tmp_path.iterdir()) == []


def test_text_paths_are_taken(saved, test):
    assert ActionIndexer.load(str(saved)).predict(test).shape == (len(test),)


def test_options_are_kept_where_they_are_not_the_defaults(train, test, tmp_path):
    plain, usual, other = tmp_path / "plain.safetensors", tmp_path / "usual.safetensors", tmp_path / "other.safetensors"
    ActionIndexer(scorer="nearest").fit(train).save(plain)
    ActionIndexer(scorer="nearest", options=ActionOptions()).fit(train).save(usual)
    assert plain.read_bytes() == usual.read_bytes() and ActionIndexer.load(usual).options is None
    options = ActionOptions(num_durations=2, rest_weight=1.0)
    taught = clone(ActionIndexer(scorer="nearest", options=options)).fit(train)
    taught.save(other)
    assert contents(other)[1]["parameters"]["options"] == {"num_durations": 2, "rest_weight": 1.0}
    again = ActionIndexer.load(other)
    assert again.options == options
    np.testing.assert_array_equal(again.score_frames(test[0]), taught.score_frames(test[0]))
    assert not np.array_equal(again.score_frames(test[0]), ActionIndexer.load(plain).score_frames(test[0]))


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ([1], "options: expected fields"), ({"nearest": {"neighbours": 1}}, "options: there is no 'nearest'"),
        ({"num_durations": 1.5}, "options.num_durations: expected a value like 24"), ({"window_step": "x"}, "options.window_step"),
    ],
)  # fmt: skip
def test_options_that_are_none_are_refused(options, said, saved, tmp_path):
    tensors, header = contents(saved)
    header["parameters"]["options"] = options
    save_file(tensors, tmp_path / "bad.safetensors", metadata={"dyntorch": json.dumps(header)})
    with pytest.raises(ValueError, match=re.escape(said)):
        ActionIndexer.load(tmp_path / "bad.safetensors")

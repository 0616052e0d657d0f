"""The runtime's face: what the networks are given, and what is taken from their outputs."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from indexing.pose import networks
from indexing.pose.models import ModelSet
from indexing.pose.networks import LiteNetworks, prune

SHAPES = {b"detector": [(1, 2254, 12), (1, 2254, 1)], b"landmarks": [(1, 195), (1, 1), (1, 256, 256, 1), (1, 64, 64, 39), (1, 117)]}
MODELS = ModelSet("full", b"detector", b"landmarks", (Path("d.tflite"), Path("l.tflite")))


class Runtime:
    """Stands in for LiteRT's interpreter: outputs count upwards from the mean of the input."""

    def __init__(self, model_content, num_threads):
        assert num_threads == 1
        self.shapes = SHAPES[model_content]

    def allocate_tensors(self):
        pass

    def get_input_details(self):
        return [{"index": 7}]

    def get_output_details(self):
        return [{"shape": np.array(shape), "index": 100 + i} for i, shape in enumerate(self.shapes)]

    def set_tensor(self, index, image):
        assert index == 7 and image.dtype == np.float32 and image.ndim == 4
        self.given = image

    def invoke(self):
        self.mean = self.given.mean()

    def get_tensor(self, index):
        shape = self.shapes[index - 100]
        return self.mean + np.arange(np.prod(shape), dtype=np.float32).reshape(shape)


@pytest.fixture
def runtime(monkeypatch):
    room = type("room", (), {"Interpreter": Runtime})
    monkeypatch.setattr(networks, "import_module", lambda name: room)


def test_pictures_are_given_in_the_range_of_each_network_and_outputs_known_by_size(runtime):
    both = LiteNetworks(MODELS)
    for level, mean in ((0, -1), (255, 1)):
        raw, logits = both.detector(np.full((224, 224, 3), level, np.uint8))
        assert raw.shape == (2254, 12) and logits.shape == (2254,)
        assert raw[0, 0] == pytest.approx(mean) and logits[1] == pytest.approx(mean + 1)
    values, present, heatmap = both.landmarks(np.full((256, 256, 3), 255, np.uint8))
    assert values.shape == (39, 5) and heatmap.shape == (64, 64, 39)
    assert present == pytest.approx(1) and values[0, 1] == pytest.approx(2) and heatmap[0, 0, 1] == pytest.approx(2)


def test_a_network_with_other_outputs_is_said(runtime, monkeypatch):
    monkeypatch.setitem(SHAPES, b"detector", [(1, 896, 16), (1, 896, 1)])
    with pytest.raises(ValueError, match=r"d\.tflite: has no output of shape \(2254, 12\); fetch the model files again"):
        LiteNetworks(MODELS).detector(np.zeros((224, 224, 3), np.uint8))


def test_bytes_that_are_no_network(capfd):
    pytest.importorskip("ai_edge_litert")
    with pytest.raises(ValueError, match=r"d\.tflite: is no network that LiteRT can run"):
        LiteNetworks(ModelSet("full", b"nothing of a network" * 20, b"", MODELS.paths))
    assert capfd.readouterr().err == ""


def test_a_runtime_that_cannot_be_imported(monkeypatch):
    def broken(name):
        raise ImportError("libLiteRt.so: cannot open")

    monkeypatch.setattr(networks, "import_module", broken)
    with pytest.raises(ValueError, match=r"libLiteRt\.so: cannot open.*pip install 'dyntorch\[pose\]'"):
        LiteNetworks(MODELS)


def test_what_leads_to_no_wanted_output_is_left_out():
    """A chain 0 -> 1 -> 2 with a branch 1 -> 3 -> 4, of which 2 and 4 are outputs."""
    schema = pytest.importorskip("ai_edge_litert.schema_py_generated")
    flatbuffers = pytest.importorskip("flatbuffers")
    model, graph = schema.ModelT(), schema.SubGraphT()
    graph.tensors, graph.operators = [], []
    for size in (4, 4, 7, 4, 900):
        tensor = schema.TensorT()
        tensor.shape = np.array([1, size], np.int32)
        graph.tensors.append(tensor)
    for source, target in ((0, 1), (1, 3), (1, 2), (3, 4)):
        operator = schema.OperatorT()
        operator.inputs, operator.outputs = np.array([source], np.int32), np.array([target], np.int32)
        graph.operators.append(operator)
    graph.inputs, graph.outputs = np.array([0], np.int32), np.array([4, 2], np.int32)
    model.subgraphs = [graph]
    builder = flatbuffers.Builder(0)
    builder.Finish(model.Pack(builder))
    left = schema.Model.GetRootAs(prune(bytes(builder.Output()), {7}), 0).Subgraphs(0)
    assert left.OutputsAsNumpy().tolist() == [2] and left.OperatorsLength() == 2
    flow = [(left.Operators(i).Inputs(0), left.Operators(i).Outputs(0)) for i in range(2)]
    assert flow == [(0, 1), (1, 2)]


@pytest.mark.parametrize("content", [b"", b"l", b"landmarks", bytes(100), b"\xff" * 300])
def test_what_cannot_be_read_as_a_network_stays_as_it_is(content):
    assert prune(content, {1}) == content

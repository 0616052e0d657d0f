"""BlazePose's networks, run by LiteRT on one thread of the processor."""

from __future__ import annotations

import contextlib
import math
import os
import struct
import sys
import threading
from collections.abc import Collection, Iterator, Sequence
from importlib import import_module
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from indexing.opening import error
from indexing.pose.blazepose import HEATMAP, LANDMARKS, POINTS, Floats, anchors
from indexing.pose.models import AGAIN, ModelSet, needs

Image = NDArray[np.uint8]
OUTPUTS_FIELD, OPERATORS_FIELD = 8, 10  # of a graph in LiteRT's files
QUIET = threading.Lock()  # the process has one stream of errors


class Networks(Protocol):
    """What is asked of the networks; not to be shared by threads."""

    def detector(self, image: Image) -> tuple[Floats, Floats]:
        """``(2254, 12)`` boxes and points, and ``(2254,)`` logits, of an RGB picture ``(224, 224, 3)``."""

    def landmarks(self, image: Image) -> tuple[Floats, float, Floats]:
        """``(39, 5)`` landmarks, the probability of a person, and ``(64, 64, 39)`` logits, of an RGB region ``(256, 256, 3)``."""


class LiteNetworks:
    """The networks of a set of model files."""

    def __init__(self, models: ModelSet) -> None:
        self._detector = _interpreter(models.detector, str(models.paths[0]))
        wanted = {LANDMARKS * 5, 1, HEATMAP * HEATMAP * LANDMARKS}
        self._landmarks = _interpreter(prune(models.landmarks, wanted), str(models.paths[1]))

    def detector(self, image: Image) -> tuple[Floats, Floats]:
        """See :class:`Networks`."""
        self._detector.run(np.divide(image, 127.5, dtype=np.float32) - np.float32(1))
        count = len(anchors())
        return self._detector.output(count, 4 + 2 * POINTS), self._detector.output(count)

    def landmarks(self, image: Image) -> tuple[Floats, float, Floats]:
        """See :class:`Networks`."""
        self._landmarks.run(np.divide(image, 255, dtype=np.float32))
        heatmap = self._landmarks.output(HEATMAP, HEATMAP, LANDMARKS)
        return self._landmarks.output(LANDMARKS, 5), float(self._landmarks.output(1)[0]), heatmap


class _Interpreter:
    """One network, whose outputs are known by their sizes."""

    def __init__(self, running: Any, name: str) -> None:
        self._running, self._name = running, name
        self._input = running.get_input_details()[0]["index"]
        self._outputs = {math.prod(map(int, one["shape"])): one["index"] for one in running.get_output_details()}

    def run(self, image: Floats) -> None:
        """Run it on an image."""
        self._running.set_tensor(self._input, image[None])
        self._running.invoke()

    def output(self, *shape: int) -> Floats:
        """What it gave in this shape."""
        at = self._outputs.get(math.prod(shape))
        if at is None:
            raise error(self._name, f"has no output of shape {shape}", AGAIN)
        return np.array(self._running.get_tensor(at)).reshape(shape)


def _interpreter(model: bytes, name: str) -> _Interpreter:
    try:
        interpreter = import_module("ai_edge_litert.interpreter").Interpreter
    except ImportError as problem:
        raise needs(problem) from None
    try:
        with _quiet():
            running = interpreter(model_content=model, num_threads=1)
            running.allocate_tensors()
    except (ValueError, RuntimeError):
        raise error(name, "is no network that LiteRT can run", AGAIN) from None
    return _Interpreter(running, name)


def prune(model: bytes, wanted: Collection[int]) -> bytes:
    """A network without the operators that only lead to outputs that nobody asks for; what is left computes the same, bit for
    bit."""
    data = bytearray(model)
    try:
        graph = import_module("ai_edge_litert.schema_py_generated").Model.GetRootAs(data, 0).Subgraphs(0)
        sizes = {int(one): math.prod(map(int, graph.Tensors(int(one)).ShapeAsNumpy())) for one in graph.OutputsAsNumpy()}
        outputs = [one for one, size in sizes.items() if size in wanted]
        operators = [graph.Operators(i) for i in range(graph.OperatorsLength())]
        flow = [(one.InputsAsNumpy().tolist(), one.OutputsAsNumpy().tolist()) for one in operators]
        kept = sorted(_required_operators(flow, outputs))
        first = graph._tab.Vector(graph._tab.Offset(OPERATORS_FIELD))
        # an operator is named by how far behind its place in the list it stands
        places = [first + 4 * i + int.from_bytes(data[first + 4 * i : first + 4 * i + 4], "little") for i in kept]
        _relist(data, first, [place - (first + 4 * i) for i, place in enumerate(places)])
        _relist(data, graph._tab.Vector(graph._tab.Offset(OUTPUTS_FIELD)), outputs)
    except (ImportError, AttributeError, TypeError, ValueError, IndexError, OverflowError, struct.error):
        return model  # slower, and nothing else
    return bytes(data)


def _required_operators(flow: Sequence[tuple[list[int], list[int]]], outputs: Sequence[int]) -> set[int]:
    """Which operators lead to some tensors."""
    maker = {tensor: i for i, (_, made) in enumerate(flow) for tensor in made}
    found: set[int] = set()
    left = list(outputs)
    while left:
        operator = maker.get(left.pop())
        if operator is not None and operator not in found:
            found.add(operator)
            left += flow[operator][0]
    return found


def _relist(data: bytearray, first: int, values: Sequence[int]) -> None:
    """Put fewer values of four bytes into a list that begins at ``first``, its length standing before it."""
    struct.pack_into(f"<I{len(values)}I", data, first - 4, len(values), *values)


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Without the line that the runtime writes past Python on every start."""
    with QUIET:
        try:
            sys.stderr.flush()
            kept, nowhere = os.dup(2), os.open(os.devnull, os.O_WRONLY)
        except (OSError, ValueError, AttributeError):  # no stream of errors at all
            yield
            return
        os.dup2(nowhere, 2)
        try:
            yield
        finally:
            os.dup2(kept, 2)
            os.close(kept)
            os.close(nowhere)

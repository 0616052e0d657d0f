"""Clocks as they are given: known, of a file, as numbers."""

from __future__ import annotations

import json

import pytest
import torch

from indexing.calibrate.priors import given_clocks
from tests.indexing.calibrate.scene import clocks_of


def test_what_is_given():
    assert given_clocks(None, ["a"]) is None and given_clocks("known", ["a", "b"]).tolist() == [[0, 1], [0, 1]]
    assert given_clocks([1.0, 1.5], ["a", "b"]).tolist() == [[0, 1], [0.5, 1]]
    found = given_clocks(torch.tensor([[1.0, 2.0], [5.0, 1.0]]), ["a", "b"])
    t = 7.0  # of the common clock: a says 15, b says 12
    assert found[0].tolist() == [0, 1] and float(found[1, 1] * (1 + 2 * t) + found[1, 0]) == pytest.approx(5 + t)
    assert given_clocks(clocks_of(torch.tensor([0.0, -0.4])), ["a", "b"]).tolist() == [[0, 1], [pytest.approx(-0.4), 1]]
    with pytest.raises(ValueError, match="clocks must be offset and rate of 2 cameras"):
        given_clocks([1.0, 2.0, 3.0], ["a", "b"])
    with pytest.raises(ValueError, match="rates positive"):
        given_clocks([[0.0, 1.0], [0.0, 0.0]], ["a", "b"])


def test_what_sync_wrote(tmp_path):
    file = tmp_path / "sync.json"
    cameras = [{"name": "b", "offset": 0.0, "rate": 1.0}, {"name": "a", "offset": -0.5, "rate": 1.00001}]
    file.write_text(json.dumps({"ok": True, "cameras": cameras}))
    found = given_clocks(file, ["a", "b"])
    assert found[1].tolist() == [pytest.approx(0.5 / 1.00001), pytest.approx(1 / 1.00001)]
    assert given_clocks(str(file), ["b", "a"])[1].tolist() == [-0.5, 1.00001]
    with pytest.raises(ValueError, match=r"sync.json: has no clock of c \(it has b, a\)"):
        given_clocks(file, ["a", "c"])
    for content, said in (
        ({"ok": False, "cameras": cameras}, "did not decide on these clocks"), ({"ok": True}, "has no list of cameras"),
        ([1], "no list"),
        ({"ok": True, "cameras": [{"name": "a", "offset": None, "rate": 1}, cameras[0]]}, "a: offset and rate are no numbers"),
    ):  # fmt: skip
        file.write_text(json.dumps(content))
        with pytest.raises(ValueError, match=said):
            given_clocks(file, ["a", "b"])
    with pytest.raises(ValueError, match=r"no.json: no such file"):
        given_clocks(tmp_path / "no.json", ["a", "b"])

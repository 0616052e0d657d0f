"""Networks that see made-up people, in the place of those that nobody has here."""

from __future__ import annotations

from pathlib import Path

import pytest

from indexing.pose import models
from indexing.pose.models import ModelSet
from tests.indexing.pose.scene import SceneNetworks


@pytest.fixture
def seeing(monkeypatch):
    """All that looks for networks finds those of the scene; a list of those that were made."""
    pytest.importorskip("av")
    pytest.importorskip("cv2")
    made: list[SceneNetworks] = []

    def networks(models):
        made.append(SceneNetworks())
        return made[-1]

    def load(name=None, models=None):
        return ModelSet(name or "heavy", b"", b"", (Path("detector"), Path("landmarks")))

    monkeypatch.setattr("indexing.pose.detection.LiteNetworks", networks)
    for room in ("models", "detection", "writing"):
        monkeypatch.setattr(f"indexing.pose.{room}.load_models", load)
    monkeypatch.setattr(models, "missing_parts", list)
    return made

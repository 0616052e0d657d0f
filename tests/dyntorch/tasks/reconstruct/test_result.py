"""What reconstruct returns: its repr, positions at any time, check()."""

from __future__ import annotations

import pytest
import torch

import dyntorch as dyn
from dyntorch import scenes


@pytest.mark.slow
def test_repr_of_one_and_of_a_batch() -> None:
    scene = scenes.lifted_points("constant_velocity_2d", 30, views=4, batch=2, generator=torch.Generator().manual_seed(0))
    one = repr(dyn.reconstruct(scene.tracks[0], "constant_velocity_2d"))
    assert one.startswith("Reconstruction(constant_velocity_2d, views=4, points=30, batch=(): 1 OK)")
    assert "30 moving" in one and "velocity common to all points" in one
    tracks = scene.tracks.clone()
    tracks[1] = torch.nan
    found = dyn.reconstruct(tracks, "constant_velocity_2d")
    assert "1 OK, 1 TOO_FEW" in repr(found) and "warning few_observed: 1 of 2 problems" in repr(found)
    with pytest.raises(ValueError, match="problem 1 of 2: TOO_FEW"):
        found.check()


def test_two_bodies_say_nothing_about_other_times() -> None:
    scene = scenes.lifted_points("two_bodies_2d", 30, views=3, generator=torch.Generator().manual_seed(0))
    found = dyn.reconstruct(scene.tracks, "two_bodies_2d")
    assert found.velocities is None and torch.equal(found.at(3.0), found.points)
    with pytest.raises(ValueError, match="says nothing about times between the views"):
        found.image(found.cameras[0], 0.5)
    assert "body 1" in repr(found)

"""Videos to synchronize: one person before two cameras that have nothing in common."""

import numpy as np
import pytest

from indexing.actors import Person, stream
from indexing.actors.textured import film

ACTIONS = ["squat", "wave", "bow", "punch", "kick"]


def two_films(actions, seed, frames=120, image=(80, 60), turn=35.0, noise=2.0):
    clip, _ = stream(actions, Person.random(seed), rng=seed, rest=(0.1, 0.4))
    clip = clip.between(0.0, (frames - 1) / 30.0 + 1e-6)
    return tuple(film(clip, azimuth=angle, image=image, noise=noise, rng=seed + k) for k, angle in enumerate((10.0, 10.0 + turn)))


@pytest.fixture(scope="session")
def films():
    """Two uint8 videos ``(150, 60, 80)`` in step."""
    return two_films(ACTIONS, 5, 150)


@pytest.fixture(scope="session")
def other():
    """A video of another person at other things."""
    return two_films(["jumping_jack", "sit_down", "kick", "bow"], 9, 120)[1]


@pytest.fixture
def rng():
    return np.random.default_rng(0)

"""Films of synthetic people: what moves in them is the person, and where geometry says."""

import numpy as np
import pytest
import torch

from indexing import Clip
from indexing.actors import Person, perform
from indexing.actors.textured import render_clip
from indexing.skeleton import COCO17
from indexing.sync.brightness_features import boxes, motion

CLIP = perform("wave", Person(), fps=15.0)


def test_films_are_reproducible_and_only_the_person_moves():
    one, again, other = (render_clip(CLIP, azimuth=0.0, image=(80, 60), rng=seed) for seed in (1, 1, 2))
    assert one.shape == (len(CLIP), 60, 80) and one.dtype == np.uint8
    assert np.array_equal(one, again)
    assert np.corrcoef(one[0].ravel(), other[0].ravel())[0, 1] < 0.3
    assert 30 < one.std() < 80
    still = CLIP.replace(joints=np.repeat(CLIP.joints[:1], len(CLIP), axis=0))
    frames = render_clip(still, azimuth=0.0, noise=0.0)
    assert (frames == frames[0]).all()
    where, _ = boxes(motion(torch.from_numpy(render_clip(CLIP, azimuth=0.0, noise=0.0))), 15.0)
    assert where[0, 1] < 60  # the waving arm is above the middle


BAD = {
    "needs 3D joints": (Clip(np.zeros((5, 17, 2)), fps=10.0), {}),
    "joints are missing": (Clip(np.full((5, 17, 3), np.nan), fps=10.0, skeleton=COCO17), {}),
    "in front of the camera": (CLIP, {"distance": 0.3}),
    "noise must be": (CLIP, {"noise": -1.0}),
}


def test_what_cannot_be_filmed():
    for words, (clip, options) in BAD.items():
        with pytest.raises(ValueError, match=words):
            render_clip(clip, azimuth=0.0, **options)

"""The warping against a loop over library frames, and pooling over time."""

import numpy as np
import torch

from indexing.brightness.descriptors import LENGTH
from indexing.brightness.stream import MEAN_SHARPNESS, SLACK, Pool, VideoExemplars, Warping, build_library


def exemplars(lengths=(5, 3, 7), labels=(1, 0, 1)):
    rows = torch.rand(sum(lengths), LENGTH, generator=torch.Generator().manual_seed(0)) / 20
    return VideoExemplars(rows, torch.tensor(lengths), torch.tensor(labels))


def test_warping_is_the_loop_of_its_definition_in_any_chunks():
    parts = exemplars()
    queries = torch.rand(9, LENGTH, generator=torch.Generator().manual_seed(1)) / 20
    window = 4.0
    found = Warping(build_library(parts, 2, False), window).push(queries)
    keep = 1 - 1 / window
    tracks = [one.numpy() for one in parts.videos()]
    states = [np.zeros(len(track)) for track in tracks]
    for t, query in enumerate(queries.numpy()):
        for i, track in enumerate(tracks):
            old = np.concatenate([[0, 0], states[i]])  # nothing before the first frame
            states[i] = np.array(
                [
                    keep * max(old[j + 1], old[j + 2] - SLACK, old[j] - SLACK) + (1 - keep) * float(query @ track[j])
                    for j in range(len(track))
                ]
            )
        known = 1 - keep ** (t + 1)
        expected = [states[1].max() / known, max(states[0].max(), states[2].max()) / known]
        np.testing.assert_allclose(found[t].numpy(), expected, rtol=1e-5)
    placed = build_library(parts, 2, True)
    queries = torch.rand(50, LENGTH, generator=torch.Generator().manual_seed(2)) / 20
    stream = Warping(placed, 5.0)
    chunked = torch.cat([stream.push(part) for part in queries.split([1, 0, 16, 33])])
    torch.testing.assert_close(chunked, Warping(placed, 5.0).push(queries))


def test_the_pool_is_a_weighted_mean_of_exponentials():
    scores = np.random.default_rng(3).random((6, 2))
    energy = np.array([0.0, 0.5, 1.0, 0.0, 0.2, 0.9])
    found = Pool(2, 4.0).push(scores, energy)
    for t in range(1, 6):
        weight = 0.75 ** np.arange(t, -1, -1) * energy[: t + 1]
        mean = (weight[:, None] * np.exp(MEAN_SHARPNESS * scores[: t + 1])).sum(0) / weight.sum()
        np.testing.assert_allclose(found[t], np.log(mean) / MEAN_SHARPNESS, rtol=1e-9)
    assert found[0].tolist() == [0, 0]

"""Bodies that exchange pieces: wrong joinings are mended, and right ones stay."""

from __future__ import annotations

import pytest
import torch

from dyntorch.metrics import misclassification
from dyntorch.tasks.segment import track_energy
from dyntorch.tasks.segment.frame_pairs import TrackSet, select_frame_pairs
from dyntorch.tasks.segment.track_energy import Exchanges, TrackEvidence, no_links
from dyntorch.tasks.segment.tracks import EXCHANGE_CUT_WEIGHTS
from tests.dyntorch.tasks.segment.videos import shot

COUNTS = (48, 40)


def exchanges() -> tuple[Exchanges, torch.Tensor, torch.Tensor]:
    """Of six pieces, three of each of two bodies, without links: the labels of the pieces and of the bodies, from 0."""
    scene = shot(COUNTS, frames=6, sigma=0.1)
    film = TrackSet.of(scene.tracks)
    pairs = [film.pair(pair) for pair in select_frame_pairs(film, 64)]
    evidence = TrackEvidence.of(pairs, no_links(sum(COUNTS), film.x.device))
    truth = scene.labels - 1
    place = torch.cat([torch.arange(count) * 3 // count for count in COUNTS])
    return Exchanges(evidence, 3 * truth + place), 3 * truth + place, truth


@pytest.mark.parametrize("weight", EXCHANGE_CUT_WEIGHTS)
@pytest.mark.parametrize("wrong", [(), (1,), (0, 4)])
def test_pieces_in_the_wrong_body_are_put_right(wrong, weight):
    search, pieces, truth = exchanges()
    labels = truth.clone()
    for piece in wrong:
        labels[pieces == piece] = 1 - labels[pieces == piece]
    found = search.improve(labels, weight)
    assert float(misclassification(found + 1, truth + 1)) == 0.0


def test_bodies_stay_as_many_as_they_are(monkeypatch):
    search, _, truth = exchanges()
    for most in (track_energy.MAX_EXCHANGES, 1):
        monkeypatch.setattr(track_energy, "MAX_EXCHANGES", most)
        one = Exchanges(search.evidence, search.cut)
        assert len(one.improve(1 - truth, 1.0).unique()) == 2


def test_sets_of_pieces_are_fitted_once():
    search, _, truth = exchanges()
    search.improve(truth, 1.0)
    known = dict(search.known)
    search.improve(truth, 1.0)
    assert search.known == known

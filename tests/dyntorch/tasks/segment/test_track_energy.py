"""What a segmentation of tracks costs, the noise it finds, and labels and geometries that descend in turns."""

from __future__ import annotations

from dataclasses import replace
from itertools import product
from math import log

import pytest
import torch

from dyntorch.geometry.epipolar import sampson_squared
from dyntorch.metrics import misclassification
from dyntorch.tasks.segment import track_energy
from dyntorch.tasks.segment.coherence import Links, relief_cost
from dyntorch.tasks.segment.frame_pairs import DOUBLED_VARIANCE_MOTION, TrackSet, select_frame_pairs
from dyntorch.tasks.segment.search import one_hot
from dyntorch.tasks.segment.track_energy import (
    EFFECTIVE_PAIRS,
    MAX_TRACK_DISTANCE,
    MAX_TRACK_NOISE_PIXELS,
    MIN_BODY_TRACKS,
    MIN_TRACK_NOISE_PIXELS,
    MIN_TRACK_PARALLAX_PIXELS,
    RELIEF_WEIGHT,
    TRACK_FREEDOM,
    Exchanges,
    TrackEvidence,
    costs,
    descend_labels,
    energy,
    fit_groups,
    no_links,
    noise,
)
from dyntorch.tasks.segment.tracks import EXCHANGE_CUT_WEIGHTS
from tests.dyntorch.tasks.segment.videos import F64, Shot, draw, shot

HERE = torch.device("cpu")


def pairs_of(scene: Shot, threshold: float = 2.5):
    film = scene.film(threshold)
    return [film.pair(pair) for pair in select_frame_pairs(film, 64)]


def evidence_of(scene: Shot, links: Links | None = None) -> TrackEvidence:
    return TrackEvidence.of(pairs_of(scene), no_links(len(scene.labels), HERE) if links is None else links)


def chain(scene: Shot, weight: float = 3.0) -> Links:
    """Every track is linked with the next one, in a ring."""
    n = len(scene.labels)
    place = torch.arange(n)
    return Links(torch.stack([(place + 1) % n, (place - 1) % n], -1), torch.full((n, 2), weight, dtype=F64))


def fits(scene: Shot, evidence: TrackEvidence):
    """Geometries ``(1, K, 3, 3)`` of the true bodies, and the members."""
    member = one_hot(scene.labels[None] - 1, int(scene.labels.max())).double()
    return fit_groups(evidence, member[0], (4.0, 1.0, 0.3))[:, None], member


def test_evidence_counts_the_pairs_of_a_track():
    scene = shot((40,))
    scene.tracks[5:, 3] = torch.nan
    scene.tracks[1:, 4] = torch.nan
    evidence = evidence_of(scene)
    known = [sum(track in pair.index.tolist() for pair in evidence.pairs) for track in range(5)]
    assert evidence.count[:5].tolist() == known
    assert known[0] == len(evidence.pairs) > known[3] and known[4] == 0
    share = evidence.share()
    assert float(share[0] * known[0]) == pytest.approx(EFFECTIVE_PAIRS) and bool(share.isfinite().all())


def test_the_noise_is_that_of_the_scene_between_its_limits():
    scene = shot((80, 40), sigma=0.0)
    pairs = [replace(pair, precision=torch.ones_like(pair.precision)) for pair in pairs_of(scene)]
    member, geometry, none = one_hot(scene.labels[None] - 1, 2).double(), scene.truth(pairs), no_links(len(scene.labels), HERE)
    for sigma in (0.08, 0.2, 0.4):
        chance, found = draw(3), []
        for pair in pairs:
            # normal errors look a little smaller to Student's distribution: errors of the distribution itself are drawn
            normal = torch.randn(2, len(pair.index), 2, generator=chance, dtype=F64) * sigma * pair.view.pixel
            square = torch.randn(round(TRACK_FREEDOM), len(pair.index), 1, generator=chance, dtype=F64).square().sum(0)
            first, second = normal * (TRACK_FREEDOM / square).sqrt()
            found.append(replace(pair, view=replace(pair.view, x1=pair.view.x1 + first, x2=pair.view.x2 + second)))
        assert float(noise(TrackEvidence.of(found, none), geometry, member)) == pytest.approx(sigma, rel=0.2)
    assert float(noise(TrackEvidence.of(pairs, none), geometry, member)) == pytest.approx(MIN_TRACK_NOISE_PIXELS)
    wild = torch.randn(1, 2, 3, 3, generator=draw(), dtype=F64).expand(len(pairs), -1, -1, -1, -1)
    assert float(noise(TrackEvidence.of(pairs, none), wild, member)) == pytest.approx(MAX_TRACK_NOISE_PIXELS)


def test_the_energy_is_the_sum_that_is_said():
    scene = shot((16, 12), frames=4)
    scene.tracks[3, 2:6] = torch.nan
    links = chain(scene)
    evidence = evidence_of(scene, links)
    geometry, member = fits(scene, evidence)
    scale = torch.tensor([0.17], dtype=F64)
    labels = scene.labels - 1
    total = 0.0
    reliefs = [
        relief_cost(pair.view, F, member[..., pair.index], MIN_TRACK_PARALLAX_PIXELS)[0]
        for pair, F in zip(evidence.pairs, geometry, strict=True)
    ]
    for track in range(28):
        own = int(labels[track])
        said = 0.0
        for pair, F, hills in zip(evidence.pairs, geometry, reliefs, strict=True):
            if track not in pair.index.tolist():
                continue
            place = pair.index.tolist().index(track)
            x1, x2 = pair.view.x1[place], pair.view.x2[place]
            # as of a track at rest
            variance = (0.17 * pair.view.pixel) ** 2 * (1 + (x2 - x1).norm() / pair.view.pixel / DOUBLED_VARIANCE_MOTION)
            z = float(sampson_squared(F[0][own], x1[None], x2[None]) / variance)
            said += (TRACK_FREEDOM + 1) * log(1 + min(z, MAX_TRACK_DISTANCE**2) / TRACK_FREEDOM) + log(0.17**2)
            said += RELIEF_WEIGHT * float(hills[own, place])
        total += EFFECTIVE_PAIRS * said / int(evidence.count[track])
    for track in range(28):
        for place, weight in zip(links.index[track].tolist(), links.weight[track].tolist(), strict=True):
            total += weight / 2 * (int(labels[track]) != int(labels[place]))
    found = energy(evidence, geometry, labels[None], scale)
    assert float(found) == pytest.approx(total, rel=1e-8)


def test_costs_are_least_in_the_own_body_and_few_tracks_cost_infinity():
    scene = shot((40, 30, 20))
    evidence = evidence_of(scene)
    geometry, member = fits(scene, evidence)
    scale = torch.tensor([0.1], dtype=F64)
    cost = costs(evidence, geometry, scale, None)[0]
    assert cost.shape == (3, 90)
    assert float((cost.argmin(0) == scene.labels - 1).double().mean()) > 0.97
    torch.testing.assert_close(costs(evidence, geometry, scale, member, 0.0)[0], cost)
    few = torch.arange(90) % 2
    few[: MIN_BODY_TRACKS - 1] = 2
    assert float(energy(evidence, geometry, few[None], scale)) == torch.inf


@pytest.mark.slow
def test_a_descent_improves_wrong_labels_and_starts_go_side_by_side():
    scene = shot((40, 30))
    evidence = evidence_of(scene, chain(scene))
    truth = scene.labels - 1
    wrong = truth.clone()
    wrong[::5] = 1 - wrong[::5]
    random = torch.randint(0, 2, (70,), generator=draw(4))
    found = descend_labels(evidence, torch.stack([truth, wrong, random]), 2)
    assert found.bodies == 2 and found.labels.shape == (3, 70) and found.member.shape == (3, 2, 70)
    torch.testing.assert_close(found.member.sum(1), torch.ones(3, 70), rtol=0, atol=1e-5)
    right = (found.labels == truth).double().mean(-1)
    assert float(right[0]) > 0.98 and float(right[1]) > 0.95 and bool(found.energy[:2].isfinite().all())
    assert int(found.energy.argmin()) != 2 or float(right[2]) > 0.95
    one = found.of(1)
    assert one.labels.tolist() == found.labels[1:2].tolist() and one.energy.shape == (1,)
    assert all(F.shape == (1, 2, 3, 3) for F in one.geometry)
    scene = shot((30, 20), frames=5)
    evidence = evidence_of(scene, chain(scene))
    truth = scene.labels - 1
    wrong = truth.clone()
    wrong[::6] = 1 - wrong[::6]
    both = descend_labels(evidence, torch.stack([wrong, wrong]), 2)
    alone = descend_labels(evidence, wrong[None], 2)
    assert both.labels[1].tolist() == alone.labels[0].tolist()
    torch.testing.assert_close(both.energy[:1], alone.energy, rtol=1e-4, atol=1e-3)


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


def test_pieces_in_the_wrong_body_are_put_right(monkeypatch):
    search, pieces, truth = exchanges()
    for wrong, weight in product(((), (1,), (0, 4)), EXCHANGE_CUT_WEIGHTS):
        labels = truth.clone()
        for piece in wrong:
            labels[pieces == piece] = 1 - labels[pieces == piece]
        assert float(misclassification(search.improve(labels, weight) + 1, truth + 1)) == 0.0
    known = dict(search.known)
    search.improve(truth, 1.0)
    assert search.known == known  # no set of pieces is fitted twice
    monkeypatch.setattr(track_energy, "MAX_EXCHANGES", 1)
    assert len(Exchanges(search.evidence, search.cut).improve(1 - truth, 1.0).unique()) == 2

"""Labels of all matches, given bodies: outliers, neighbours, weights, and the mean field against a loop."""

from __future__ import annotations

import pytest
import torch

from dyntorch import scenes
from dyntorch.geometry.epipolar import sampson_squared
from dyntorch.geometry.homogeneous import unit
from dyntorch.metrics import misclassification
from dyntorch.tasks.segment.coherence import Links, View, coherence
from dyntorch.tasks.segment.labels import LABEL_SHARPNESS, NUM_LABEL_UPDATES, label_field, label_matches

F64 = torch.float64
SCALE = 1 / 200
THRESHOLD = 2.5 * SCALE


def draw(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def labelled(seed: int = 0, spatial: bool = True, found=None, weights=None, share: float = 0.3):
    """Two bodies and 30 % outliers, labelled from the true geometries; the view, the truth and the labelling."""
    scene = scenes.bodies(150, 2, sigma=0.5, outliers=0.3, generator=draw(seed))
    x1, x2 = (x * SCALE - torch.tensor([1.6, 1.2], dtype=F64) for x in scene.views)
    inverse = torch.linalg.inv(torch.tensor([[SCALE, 0, -1.6], [0, SCALE, -1.2], [0, 0, 1]], dtype=F64))
    F = unit(inverse.mT @ torch.stack(scene.motion) @ inverse)
    none = Links(torch.zeros(150, 0, dtype=torch.long), torch.zeros(150, 0, dtype=F64))
    view = View(x1, x2, SCALE, coherence(x1, x2, 3 * SCALE).links if spatial else none)
    found = scene.labels if found is None else found
    weights = torch.ones(150, dtype=F64) if weights is None else weights
    return (
        view,
        scene.labels,
        label_matches(view, found, F, weights, THRESHOLD, 3 * SCALE if spatial else None, share=share),
    )


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_labels_are_right(seed):
    _, truth, result = labelled(seed)
    assert float(misclassification(result.labels, truth)) <= 0.04
    assert result.probabilities.shape == (3, 150) and bool((result.probabilities >= 0).all())
    torch.testing.assert_close(result.probabilities.sum(0), torch.ones(150, dtype=F64))
    assert torch.equal(result.labels, result.probabilities.argmax(0))


@pytest.mark.parametrize("spatial", [True, False])
def test_what_is_far_from_all_bodies_is_an_outlier(spatial):
    view, truth, result = labelled(3, spatial, found=torch.zeros(150, dtype=torch.long))
    distance = sampson_squared(result.fundamentals, view.x1, view.x2).sqrt().amin(0)
    assert bool((result.labels[distance > 2 * THRESHOLD] == 0).all())
    assert float((result.labels[truth == 0] == 0).double().mean()) > (0.8 if spatial else 0.6)
    inlier = truth > 0
    if not spatial:
        assert float((result.labels[inlier] == truth[inlier]).double().mean()) > 0.9


def test_neighbours_tell_outliers_that_fit_by_chance():
    _, truth, near = labelled(4)
    _, _, alone = labelled(4, spatial=False)
    wrong = truth == 0
    assert int((near.labels[wrong] > 0).sum()) < int((alone.labels[wrong] > 0).sum())


def test_geometries_descend_to_their_members():
    view, truth, result = labelled(5)
    for k, F in enumerate(result.fundamentals, start=1):
        typical = float(sampson_squared(F, view.x1, view.x2)[truth == k].sqrt().median()) / SCALE
        assert 0.2 < typical < 0.5  # 0.67 standard deviations


def test_weights_decide_the_fits():
    truth = labelled(6)[1]
    light = torch.ones(150, dtype=F64)
    light[(truth == 1).nonzero().flatten()[:20]] = 0.0
    _, _, without = labelled(6, weights=light)
    _, _, scaled = labelled(6, weights=1e3 * light)
    _, _, full = labelled(6)
    torch.testing.assert_close(scaled.fundamentals, without.fundamentals, rtol=0, atol=1e-6)
    assert float((without.fundamentals[0] - full.fundamentals[0]).abs().max()) > 1e-6
    torch.testing.assert_close(without.fundamentals[1], full.fundamentals[1], rtol=0, atol=1e-3)
    # matches of weight 0 are labelled like others
    assert float((without.labels == full.labels).double().mean()) > 0.97


def test_field_one_match_at_a_time():
    view, _, _ = labelled(0)
    cost = 3 * torch.rand(2, 150, generator=draw(1), dtype=F64)
    links = view.links
    found = label_field(cost, 1.3, links)
    full = LABEL_SHARPNESS * torch.cat([torch.full((1, 150), 1.3, dtype=F64), cost])
    member = torch.softmax(-full, 0)
    for _ in range(NUM_LABEL_UPDATES):
        fresh = torch.zeros_like(member)
        for i in range(150):
            pull = (member[:, links.index[i]] * links.weight[i]).sum(-1)
            fresh[:, i] = torch.softmax(LABEL_SHARPNESS * pull - full[:, i], 0)
        member = (member + fresh) / 2
    torch.testing.assert_close(found, member)


def test_no_links_leave_the_softmax_of_the_costs():
    none = Links(torch.zeros(6, 0, dtype=torch.long), torch.zeros(6, 0, dtype=F64))
    cost = 3 * torch.rand(2, 6, generator=draw(2), dtype=F64)
    expected = torch.softmax(-LABEL_SHARPNESS * torch.cat([torch.ones(1, 6, dtype=F64), cost]), 0)
    torch.testing.assert_close(label_field(cost, 1.0, none), expected)

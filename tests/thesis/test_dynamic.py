"""Thesis 9.3, general dynamic P^n -> P^n: any space, any number of views, points within linear subspaces of any dimension."""

from functools import partial

import pytest
import torch

import dyntorch as dyn
from dyntorch import counting
from dyntorch.core.outcome import is_failure
from tests.battery.epipolar import parts_error
from tests.draws import random
from tests.grid import assert_refused, grid

EXACT = [(1, 2, 1), (1, 4, 1), (2, 2, 1), (2, 3, 1), (2, 3, 2), (2, 4, 2), (3, 2, 1), (3, 3, 2), (3, 4, 2), (3, 4, 3), (4, 4, 3)]
"""(n, m, k): points of P^n, m views, subspaces of k dimensions."""


def observed(n, m, k, dimensions, seed=0, batch=()):
    """Observations of points that wander within subspaces of so many dimensions each, and the maps from view 2, 3, ... to 1."""
    draw = torch.Generator().manual_seed(seed)
    count, size = len(dimensions), n + 1
    A = torch.eye(size).double() + 0.25 * torch.randn(*batch, m, size, size, generator=draw, dtype=torch.float64)
    A[..., 0, :, :] = torch.eye(size)
    A[..., -1, :-1] *= 0.2
    span = torch.randn(*batch, count, k, size, generator=draw, dtype=torch.float64)
    span[..., -1] = 1.0
    mix = torch.rand(*batch, count, m, k, generator=draw, dtype=torch.float64) - 0.5
    mix = mix * (torch.arange(k) < torch.as_tensor(dimensions)[:, None])[:, None]
    mix[..., 0] = 1.0 - mix[..., 1:].sum(-1)  # in front of infinity
    world = mix @ span
    p = torch.linalg.solve(A[..., None, :, :, :], world[..., None])[..., 0]
    views = (p[..., :-1] / p[..., -1:]).unbind(-2)
    return views, A.unbind(-3)[1:]


def apart(found, true):
    """The worst relative error of the matrices, each up to scale and sign."""
    return float(parts_error(tuple(found), tuple(true)).max())


def disturbed(views, sigma):
    return [x + sigma * random(*x.shape, seed=v) for v, x in enumerate(views)]


@grid((("n", "m", "k"), EXACT))
def test_the_collineations_of_all_views_come_out_exactly_at_the_minimal_number(n, m, k):
    invariant = dyn.DynamicTensor(n, m, k)
    least = counting.dim_v(n + 1, m, k)
    assert invariant.minimal() == least and invariant.nullity == (n + 1) ** m - least
    views, A = observed(n, m, k, [k] * least)
    solution = dyn.fit(invariant, *views).check()
    assert apart(solution.motion, A) < 1e-6
    with pytest.raises(ValueError, match=f"needs at least {least} matches"):
        dyn.fit(invariant, *(x[1:] for x in views))


def test_line_paths_in_three_views_are_the_homography_tensor_and_the_join_tensors():
    for n, known in ((2, dyn.HomographyTensor), (3, dyn.JoinTensor)):
        views, A = observed(n, 3, 2, [2] * (2 * known.minimal()))
        general, own = dyn.fit(dyn.DynamicTensor(n, 3, 2), *views), dyn.fit(known, *views)
        rows = [s.tensor.flatten(-3).reshape(-1, (n + 1) ** 3) for s in (general, own)]
        torch.testing.assert_close(rows[0].T @ rows[0], rows[1].T @ rows[1])
        for number in ("dof", "codim", "nullity"):
            assert getattr(general.invariant, number) == getattr(known, number)
        assert general.invariant.minimal() == known.minimal()
        for one, other in zip(general.motion, own.motion, strict=True):
            torch.testing.assert_close(one, other)
        # composed from one motion, tensor by tensor or as a span; and distances to first order
        made = [invariant.compose(*A).flatten(-3).reshape(-1, (n + 1) ** 3) for invariant in (general.invariant, known())]
        torch.testing.assert_close(made[0].T @ made[0], made[1].T @ made[1])
        near = disturbed(views, 1e-7)
        distances = [dyn.sampson(s.invariant, s.tensor, *near) for s in (general, own)]
        torch.testing.assert_close(*distances, rtol=1e-3, atol=1e-10)


def test_points_in_planes_take_256_unknowns_and_255_matches():
    """3D points that move within planes, four sensors; static ones and ones on lines are among them, and nobody knows."""
    invariant = dyn.DynamicTensor(3, 4, 3)
    assert (invariant.width(), invariant.minimal(), invariant.nullity, invariant.codim) == (256, 255, 1, 1)
    kinds = [3] * 160 + [2] * 110 + [1] * 20
    views, A = observed(3, 4, 3, kinds)
    assert apart(dyn.fit(invariant, *views).check().motion, A) < 1e-6
    noisy = disturbed(views, 1e-3)
    rough = dyn.fit(invariant, *noisy)
    refined = dyn.refine(rough, *noisy)
    assert apart(refined.motion, A) < 0.5 * apart(rough.motion, A)


@pytest.mark.slow
def test_matches_of_known_kinds_say_more():
    """A point of j dimensions fulfils the form whatever stands in k - j of the slots."""
    invariant = dyn.DynamicTensor(3, 4, 3)
    kinds = torch.tensor([3] * 30 + [2] * 25 + [1] * 8)
    views, A = observed(3, 4, 3, kinds.tolist(), seed=3)
    with pytest.raises(ValueError, match="needs at least 255 matches, got 63"):
        dyn.fit(invariant, *views)
    solution = dyn.fit(invariant, *views, dimensions=kinds).check()
    assert apart(solution.motion, A) < 1e-6
    # the rows of the labels, from the definition: any vector in each choice of 3 - j slots
    tensor = solution.tensor
    p = [torch.cat([x, torch.ones_like(x[:, :1])], dim=-1) for x in views]
    line, still = 40, 60
    for slots, match in (*((s, still) for s in ("ij", "ik", "il", "jk", "jl", "kl")), *((s, line) for s in "ijkl")):
        keep = [s for s in "ijkl" if s not in slots]
        left = torch.einsum("ijkl," + ",".join(keep) + "->" + slots, tensor, *(p["ijkl".index(s)][match] for s in keep))
        assert left.abs().max() < 1e-9
    # and refinement holds each kind to its own conditions: better than by what all of them fulfil
    noisy = disturbed(views, 1e-3)
    labelled = dyn.refine(dyn.fit(invariant, *noisy, dimensions=kinds), *noisy)
    assert abs(float(labelled.sigma) / 1e-3 - 1) < 0.25
    blind = dyn.refine(solution, *noisy, dimensions=torch.full_like(kinds, 3))
    assert apart(labelled.motion, A) < apart(blind.motion, A)


def test_labels_are_those_of_the_older_tensors_too():
    views, _ = observed(2, 3, 2, [2] * 12 + [1] * 3)
    kinds = torch.tensor([2] * 12 + [1] * 3)
    one = dyn.fit(dyn.HomographyTensor, *views, dimensions=kinds)
    torch.testing.assert_close(one.tensor, dyn.fit(dyn.HomographyTensor, *views, static=kinds == 1).tensor)
    general = dyn.fit(dyn.DynamicTensor(2, 3, 2), *views, static=kinds == 1)
    torch.testing.assert_close(general.tensor, one.tensor)
    fit = partial(dyn.fit, dyn.HomographyTensor, *views)
    assert_refused(
        (lambda: fit(dimensions=kinds, static=kinds == 1), "give it or static=, not both"),
        (lambda: fit(dimensions=kinds + 1), r"must be 1 to 2 for HomographyTensor, got 2 to 3"),
        (lambda: fit(dimensions=kinds.double()), "must be integers, got torch.float64"),
        (lambda: dyn.fit(dyn.Collineation(2), *views[:2], dimensions=kinds), "no rows for matches within fewer dimensions"),
    )


def test_what_says_nothing_is_refused_with_its_reason():
    assert_refused(
        (lambda: dyn.DynamicTensor(2, 3, 3), "points that may be anywhere in P\\^2 fulfil no equation"),
        (lambda: dyn.DynamicTensor(3, 2, 2), "so many points always lie in 2 dimensions; give 3 views or more"),
        (lambda: dyn.DynamicTensor(2, 3, 0), "k must be an integer of at least 1, got 0"),
        (lambda: dyn.DynamicTensor(2.0, 3, 2), "n must be an integer of at least 1, got 2.0"),
    )
    # by the dimension of V(n, m, k): nothing is left to be a form
    assert counting.dim_v(3, 3, 3) == 3**3 and counting.dim_v(4, 2, 2) == 4**2
    # static points alone are a smaller space: other tensors fit as well
    views, _ = observed(2, 4, 2, [1] * 100)
    assert bool(is_failure(dyn.fit(dyn.DynamicTensor(2, 4, 2), *views).status))


def test_transfer_and_trajectories_in_every_view():
    invariant = dyn.DynamicTensor(2, 4, 2)
    views, _ = observed(2, 4, 2, [2] * 90 + [1] * 10)
    tensor = dyn.fit(invariant, *views).tensor
    for source in range(1, 5):
        for target in set(range(1, 5)) - {source}:
            moved = invariant.transfer(tensor, views[source - 1][90:], source, target)
            torch.testing.assert_close(moved, views[target - 1][90:], rtol=0, atol=1e-7)
    p = [torch.cat([x, torch.ones_like(x[:, :1])], dim=-1) for x in views]
    for view in range(1, 5):
        line = invariant.flats(tensor, *views, view=view)[:90, 0]
        assert (line * p[view - 1][:90]).sum(-1).abs().max() < 1e-7
    with pytest.raises(ValueError, match="two different views of 1 to 4, got 2 and 2"):
        invariant.transfer(tensor, views[0], 2, 2)

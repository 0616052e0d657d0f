"""Normalization: centroid 0 and RMS distance sqrt(d), and back, for tensors, motions and vectors of every kind."""

import pytest
import torch

import dyntorch as dyn
from dyntorch.core.invariant import Frame, Invariant
from dyntorch.core.normalize import denormalize, denormalize_motion, normalization, normalize_motion
from dyntorch.core.primitives import Point
from tests.battery.cases import CASES
from tests.draws import random

SIMPLE = [case for case in CASES if case.invariant.copies is None]


def raw(case, n=30, batch=(4,)):
    scene = case.raw(n, batch=batch)
    return scene, normalization(case.invariant, scene.exact, torch.ones(*batch, n, dtype=torch.float64))


@pytest.mark.parametrize("case", SIMPLE, ids=repr)
def test_points_of_every_view_are_centred_and_of_unit_size(case):
    scene, norm = raw(case)
    for primitive, x, t, scale in zip(case.invariant.primitives, scene.exact, norm.transforms, norm.scales, strict=True):
        d = primitive.dim
        points = primitive.points(x) @ t[:, None, :d, :d].mT + t[:, None, None, :d, d]
        flat = points.flatten(1, 2)
        assert flat.mean(1).abs().max() < 1e-10
        torch.testing.assert_close(flat.square().sum(-1).mean(-1).sqrt(), torch.full((4,), float(d)).double().sqrt())
        assert torch.equal(scale, t[:, 0, 0]) and (t[:, :d, :d] == scale[:, None, None] * torch.eye(d).double()).all()


def test_weights_count_as_matches():
    x = random(1, 6, 2)
    weights = torch.tensor([[2.0, 1.0, 0.0, 3.0, 1.0, 1.0]]).double()
    repeated = torch.cat([x[:, i : i + 1].expand(1, int(w), 2) for i, w in enumerate(weights[0])], dim=1)
    a = normalization(dyn.FundamentalMatrix(), (x, x), weights)
    b = normalization(dyn.FundamentalMatrix(), (repeated, repeated), torch.ones(1, 8).double())
    for one, other in zip(a.transforms, b.transforms, strict=True):
        torch.testing.assert_close(one, other)


@pytest.mark.parametrize("kind", ["equal", "weightless", "one"])
def test_points_without_extent_keep_scale_one(kind):
    x, weights = random(2, 5, 3), torch.ones(2, 5).double()
    if kind == "equal":
        x[0] = torch.tensor([3.0, 4.0, 5.0])
    else:
        weights[0, int(kind == "one") :] = 0
    x.requires_grad_()
    norm = normalization(dyn.Collineation(3), (x, x), weights)
    assert norm.transforms[0][0, 0, 0] == 1 and norm.transforms[0][1, 0, 0] != 1
    sum(t.sum() for t in norm.transforms).backward()
    assert x.grad.isfinite().all() and all(t.isfinite().all() for t in norm.transforms)


@pytest.mark.parametrize("case", SIMPLE, ids=repr)
def test_denormalized_tensor_takes_the_measured_vectors(case):
    """The form on measured vectors is, up to one factor, that on the vectors moved by the actions."""
    invariant, (scene, norm) = case.invariant, raw(case, batch=(2,))
    tensor = random(2, *([invariant.nullity] if invariant.nullity > 1 else []), *invariant.shape(), seed=1)
    back = denormalize(invariant, tensor, norm.actions)
    assert back.shape == tensor.shape
    order = len(invariant.shape())
    span = back.flatten(-order).reshape(2, invariant.nullity, -1)
    torch.testing.assert_close(span @ span.mT, torch.eye(invariant.nullity).double().expand(2, -1, -1), rtol=0, atol=1e-9)
    if invariant.nullity > 1:
        return
    letters = "ijklpq"[:order]
    before = [p.vectors(x)[:, :, 0] for p, x in zip(invariant.primitives, scene.exact, strict=True)]
    after = [v @ m.mT for v, m in zip(before, norm.actions, strict=True)]
    terms = ",".join(f"bn{letter}" for letter in letters)
    values = []
    for form, vectors in ((back, before), (tensor, after)):
        values.append(torch.einsum(f"b{letters},{terms}->bn", form, *(vectors[v] for v in invariant.axes())))
    factor = (values[1] * values[0]).sum(-1, keepdim=True) / values[0].square().sum(-1, keepdim=True)
    torch.testing.assert_close(factor * values[0], values[1], rtol=1e-6, atol=1e-9 * float(values[1].abs().max()))


def test_several_tensors_span_the_moved_space_and_zero_stays_zero():
    invariant = dyn.JoinTensor()
    tensor = random(3, 4, 4, 4, 4)
    tensor[1] = 0
    actions = tuple(random(3, 4, 4, seed=v) for v in (5, 6, 7))
    tensor.requires_grad_()
    back = denormalize(invariant, tensor, actions)
    assert back[1].abs().max() == 0
    moved = torch.einsum("bvxyz,bxi,byj,bzk->bvijk", tensor, *actions).flatten(2).detach()
    flat = back.flatten(2).detach()
    for b in (0, 2):
        u, v = torch.linalg.qr(moved[b].T).Q, flat[b].T
        assert (v - u @ (u.T @ v)).abs().max() < 1e-10
    back.square().sum(-1).sin().sum().backward()
    assert tensor.grad.isfinite().all()


def test_motion_there_and_back_and_by_hand():
    class Mixed(Invariant):
        primitives = (Point(2), Point(2), Point(3))
        motion = (Frame(0, 1), Frame(1, vector=True), Frame(2), Frame(0, 2), Frame(None, 1))

    transforms = tuple(random(3, k, k, seed=v) for v, k in enumerate((3, 3, 4)))
    parts = tuple(random(3, *shape, seed=10 + i) for i, shape in enumerate(((3, 3), (3,), (4, 4), (3, 4), (3, 3))))
    moved = normalize_motion(Mixed(), parts, transforms)
    t1, t2, t3 = transforms
    by_hand = (
        t1 @ parts[0] @ torch.linalg.inv(t2),
        (t2 @ parts[1][..., None])[..., 0],
        t3 @ parts[2],
        t1 @ parts[3] @ torch.linalg.inv(t3),
        parts[4] @ torch.linalg.inv(t2),
    )
    back = denormalize_motion(Mixed(), moved, transforms)
    for found, expected in zip((*moved, *back), (*by_hand, *parts), strict=True):
        cosine = torch.nn.functional.cosine_similarity(found.flatten(1), expected.flatten(1))
        torch.testing.assert_close(cosine.abs(), torch.ones(3).double())
        torch.testing.assert_close(found.flatten(1).norm(dim=-1), torch.ones(3).double())

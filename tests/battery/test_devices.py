"""Every public verb gives on an accelerator what it gives on the CPU, keeps its tensors there, and seldom makes the host wait."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import pytest
import torch
from torch import Tensor

import dyntorch as dyn
from dyntorch import scenes
from dyntorch.numerics.arguments import on_cpu
from tests.battery.device_verbs import (
    NOT_VERBS,
    PUBLIC,
    ROOMS,
    VERBS,
    WAITS,
    Verb,
    cameras_and_points,
    draw,
    moving_shapes,
    nonrigid,
    paths,
    planar,
    planes,
    randn,
    shift,
    still_shape,
    tracks,
    two_hyperplanes,
)
from tests.battery.pretend_device import counted, moved, pretend_device
from tests.thesis.test_minimal_data import bodies

DEVICES = ("pretend", pytest.param("cuda", marks=pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")))


def device_of(name: str) -> torch.device:
    return pretend_device() if name == "pretend" else torch.device(name, 0)


def parts(value: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    """Tensors and numbers of a result, with their names."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        value = {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        for key, part in value.items():
            yield from parts(part, f"{path}.{key}")
    elif isinstance(value, (tuple, list)):
        for key, part in enumerate(value):
            yield from parts(part, f"{path}.{key}")
    elif isinstance(value, (Tensor, float, int)):
        yield path, value


def same(here: Any, there: Any, path: str, tolerance: float) -> None:
    """Whole numbers and truth values equal, the others within the tolerance of the largest, and rounding of what is zero."""
    here, there = torch.as_tensor(here), torch.as_tensor(there).cpu()
    assert here.shape == there.shape and here.dtype == there.dtype, path
    size = float(here[here.isfinite()].abs().max()) if here.is_floating_point() and bool(here.isfinite().any()) else 0.0
    torch.testing.assert_close(
        there, here, rtol=0, atol=tolerance * size + 1e-9, equal_nan=True, msg=lambda text: f"{path}: {text}"
    )


@pytest.mark.slow
@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("verb", VERBS, ids=repr)
def test_a_verb_gives_the_same_there(verb: Verb, device: str) -> None:
    home, inputs = device_of(device), verb.inputs()
    here = verb.call(*inputs)
    with counted() as traffic:
        there = verb.call(*moved(inputs, home))
    strangers = [path for path, part in parts(there) if isinstance(part, Tensor) and part.device != home]
    assert not strangers
    assert len(traffic) <= verb.waits, str(traffic)
    found = dict(parts(verb.compare(there)))
    for path, part in parts(verb.compare(here)):
        same(part, found[path], path, verb.tolerance)


CV = dyn.ConstantVelocityTensor
H = dyn.HomographyTensor
L = dyn.TranslatingLinesMatrix


def plane() -> dyn.Solution:
    return dyn.fit(H, *planar())


def space() -> dyn.Solution:
    return dyn.fit(CV, *scenes.constant_velocity(24, generator=draw(2)).views)


USES: dict[str, tuple[Callable[[], Any], Callable[..., Any]]] = {
    # what the library makes, on the CPU; and what a user then does with it, wherever it is
    "Solution": (plane, lambda s: (s.motion, s.singular_values, s.check(), s.to(torch.float32), repr(s))),
    "Solution of a batch": (
        lambda: dyn.fit(H, *scenes.planar(40, batch=3, generator=draw()).views),
        lambda s: (s[1], s[torch.tensor([True, False, True])], s[1:], s.status, repr(s)),
    ),
    "HomographyTensor": (
        lambda: (plane(), *planar()),
        lambda s, x, y, z: (H.transfer(s.tensor, y), H.trajectory(s.tensor, x, y), H.static_distance(s.tensor, x, y, z)),
    ),
    "ConstantVelocityTensor": (
        lambda: (space(), *scenes.constant_velocity(24, generator=draw(2)).views),
        lambda s, *x: (
            CV.transfer(s.tensor, x[0], x[1]),
            CV.positions(s.motion, *x),
            CV.fix_gauge(s.motion, *(v[:4] for v in x)),
            CV.static_distance(s.motion, *x),
        ),
    ),
    "Shift": (lambda: shift(0.5), lambda s: (s.at(2.0), s.at([1.0, 2.0]), s.inverse(1.0), s.since(3.0).peaks, repr(s))),
    "Clocks": (
        lambda: dyn.combine_shifts({(0, 1): shift(1.0), (0, 2): shift(3.0), (1, 2): shift(2.01)}, 3),
        lambda c: (c.at([1.0, 2.0]), c.at(2.0), c.inverse(1, [1.0, 2.0]), c.rates, repr(c)),
    ),
    "Reconstruction": (
        lambda: dyn.reconstruct(*tracks("constant_velocity_2d", 24, 4), "constant_velocity_2d", generator=draw()),
        lambda r: (r.at(2.5), r.image(r.cameras[..., 0, :, :], 1.5), repr(r)),
    ),
    "PairReconstruction": (lambda: dyn.reconstruct_pair(*nonrigid(), 0.12, fps=25.0), lambda r: (r.images(), repr(r))),
    "Recovery": (
        lambda: dyn.shapes.recover_times(moving_shapes()[2], dyn.Polynomial(1), moving_shapes()[0]),
        lambda r: (r.ambiguous(0.01), r.ambiguous(r.rise.new_full(r.rise.shape[:-1], 0.01))),
    ),
    "TranslatingPlanes": (
        lambda: (dyn.translating_planes(planes().homographies), randn(4, 2), randn(4, 2, seed=1)),
        lambda p, x, y: (p.cameras(), p.depth(0, x), repr(p), p.reconstruct(0, x, y)),
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", USES)
def test_results_are_used_where_they_are(name: str) -> None:
    home, (make, use) = pretend_device(), USES[name]
    made = make()
    made = made if isinstance(made, tuple) else (made,)
    away = tuple(part.to(home) if isinstance(part, dyn.Solution) else moved(part, home) for part in made)
    here, there = (list(parts(use(*given))) for given in (made, away))
    floats = {"Shift": {".0", ".1", ".2"}}.get(name, set())  # of numbers: they have no device
    assert not [path for path, part in there if isinstance(part, Tensor) and part.device != home and path not in floats]
    for (path, part), (_, other) in zip(here, there, strict=True):
        same(part, other, path, 1e-6)


def test_the_table_lists_every_public_name():
    listed = {verb.name.split()[0] for verb in VERBS}
    assert listed | NOT_VERBS == set(PUBLIC) - set(ROOMS) and set(WAITS) <= listed


@pytest.mark.parametrize(
    ("invariant", "views"),
    [
        # one body where two are asked for, velocities in a plane, lines in pure translation: nothing but noise tells tensors apart
        (dyn.SegmentationMatrix, lambda g: scenes.two_view(60, batch=8, sigma=0.1, generator=g).views),
        (dyn.ConstantVelocityTensor, lambda g: scenes.constant_velocity(60, batch=8, sigma=0.01, static=1.0, generator=g).views),
        (L, lambda g: scenes.translating_lines(60, batch=8, sigma=0.005, motion="translation", generator=g).views),
        (dyn.HomographyTensor, lambda g: scenes.planar(60, batch=8, sigma=0.5, generator=g).views),
        # exact ones that a Gram cannot tell from such that leave more open, and those that do: a planar body
        (dyn.SegmentationMatrix, lambda g: bodies((27, 8), 12, 0)),
        (dyn.SegmentationMatrix, lambda g: bodies((20, 15), 8, 0, flat=True)),
    ],
    ids=("one-body", "static-points", "one-translation", "healthy", "minimal", "planar-body"),
)
def test_status_does_not_depend_on_the_device(invariant, views):
    views = views(draw())
    here = dyn.fit(invariant, *views)
    there = dyn.fit(invariant, *moved(views, pretend_device()))
    assert there.status.tolist() == here.status.tolist()
    # nor on the neighbours in the batch
    assert dyn.fit(invariant, *(x[5:] for x in views)).status.tolist() == here.status[5:].tolist()


def test_what_looks_weak_costs_one_wait_more():
    """Certificate, what looks weak, and where: not one for every tensor that is looked at there."""
    views = moved(still_shape("plane"), pretend_device())
    with counted() as traffic:
        dyn.fit(dyn.ShapeTensor("plane"), *views)
    assert len(traffic) <= 3, str(traffic)


WEIGHED: dict[str, tuple[Callable[[], tuple[Any, ...]], Callable[..., Any], tuple[int, ...]]] = {
    # inputs, the call with weights, the shape of these
    "fit": (planar, lambda w, *x: dyn.fit(H, *x, weights=w), (40,)),
    "robust_fit": (planar, lambda w, *x: dyn.robust_fit(H, *x, weights=w, threshold=1.5), (40,)),
    "align_planar": (planar, lambda w, *x: dyn.align_planar(*x, weights=w), (40,)),
    "segment": (planar, lambda w, *x: dyn.segment(*x[:2], weights=w), (40,)),
    "multibody_matrix": (planar, lambda w, *x: dyn.invariants.multibody_matrix(*x[:2], 2, w), (40,)),
    "affine_segmentation": (planar, lambda w, *x: dyn.tasks.affine_segmentation(*x[:2], w), (40,)),
    "fit_distortion": (planar, lambda w, *x: dyn.geometry.fit_distortion(*x[:2], w), (40,)),
    "fix_gauge": (
        lambda: (torch.eye(4, dtype=torch.float64), randn(9, 3), randn(9, 3, seed=1), randn(9, 3, seed=2)),
        lambda w, m, *x: CV.fix_gauge((m, m, m), *x, weights=w),
        (9,),
    ),
    "reconstruct": (lambda: tracks("static_2d", 12, 3), lambda w, x: dyn.reconstruct(x, "static_2d", weights=w), (3, 12)),
    "projective_factorization": (lambda: (randn(3, 12, 2),), lambda w, x: dyn.tasks.projective_factorization(x, 4, w), (3, 12)),
    "velocity_factorization": (
        lambda: (randn(6, 10, 2), torch.arange(6, dtype=torch.float64)),
        lambda w, x, t: dyn.tasks.velocity_factorization(x, t, 3, w),
        (6, 10),
    ),
    "triangulate_trajectories": (paths, lambda w, p, x: dyn.triangulate_trajectories(p, x, w), (6, 10)),
    "triangulate": (cameras_and_points, lambda w, p, y, x: dyn.geometry.triangulate(p, x, w), (3, 12)),
    "resect": (cameras_and_points, lambda w, p, y, x: dyn.geometry.resect(y, x, w), (3, 12)),
    "bundle_adjust": (cameras_and_points, lambda w, p, y, x: dyn.geometry.bundle_adjust(x, w, p, y), (3, 12)),
    "hyperplane_pair": (lambda: (two_hyperplanes(),), lambda w, y: dyn.geometry.hyperplane_pair(y, w), (12,)),
    "fit_shapes": (moving_shapes, lambda w, x, rows, s: dyn.shapes.fit_shapes(x, rows, w), (12, 8)),
    "recover_times": (moving_shapes, lambda w, x, r, s: dyn.shapes.recover_times(s, dyn.Polynomial(1), x, w), (12, 8)),
}


@pytest.mark.parametrize("name", WEIGHED)
def test_a_negative_weight_is_refused_everywhere(name: str) -> None:
    inputs, call, shape = WEIGHED[name]
    weights = torch.ones(shape, dtype=torch.float64)
    weights.view(-1)[3] = -1.0
    for home in ("cpu", pretend_device()):
        with pytest.raises(ValueError, match=r"weights must .*not .*negative"):
            call(*moved((weights, *inputs()), home))


# ---- on_cpu ------------------------------------------------------------------------------------------------------------
@dataclasses.dataclass(frozen=True)
class Holder:
    values: Tensor
    parts: Mapping[str, list[Tensor]]
    name: str = "kept"


@on_cpu
def lender(holder: Holder, generator: torch.Generator | None = None) -> tuple[Holder, Tensor]:
    """Of one device, the CPU's."""
    assert holder.values.device.type == holder.parts["a"][0].device.type == "cpu"
    noise = torch.rand(3, generator=generator)
    return Holder(2 * holder.values, {"a": [noise]}), holder.values.argmax()


def test_on_cpu_finds_tensors_wherever_they_are_held():
    home = pretend_device()
    values = torch.tensor([1.0, 3.0, 2.0])
    result, best = lender(Holder(values.to(home), {"a": [values.to(home)]}), generator=draw(1))
    assert result.values.device == result.parts["a"][0].device == best.device == home
    assert result.values.tolist() == [2.0, 6.0, 4.0] and int(best) == 1 and result.name == "kept"
    assert torch.equal(result.parts["a"][0].cpu(), torch.rand(3, generator=draw(1)))
    assert on_cpu(lambda x: x)(values) is values
    away = values.to(home).requires_grad_()
    on_cpu(torch.square)(away).sum().backward()
    assert away.grad is not None and away.grad.tolist() == [2.0, 6.0, 4.0]
    with pytest.raises(ValueError, match="meta, pretend"):
        on_cpu(torch.add)(torch.zeros(2, device="meta"), torch.zeros(2).to(home))

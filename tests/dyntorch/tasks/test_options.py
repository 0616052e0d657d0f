"""Options of the verbs: frozen, flat, every field said in a sentence and read by its room."""

import ast
import inspect
import re
from dataclasses import FrozenInstanceError, fields, replace
from pathlib import Path

import pytest
import torch

import dyntorch as dyn
from dyntorch import scenes
from dyntorch.tasks.align.result import AlignNotice

KINDS = [getattr(dyn, name) for name in dyn.__all__ if name.endswith("Options")]
NAMES = [kind.__name__ for kind in KINDS]


def room_of(kind):
    return Path(dyn.__file__).parent.joinpath(*kind.__module__.split(".")[1:-1])


@pytest.mark.parametrize("kind", KINDS, ids=NAMES)
def test_options_are_frozen_and_said_and_read(kind):
    with pytest.raises(FrozenInstanceError):
        setattr(kind(), fields(kind)[0].name, 0)
    tree = ast.parse(Path(inspect.getsourcefile(kind)).read_text(encoding="utf-8"))
    (node,) = [one for one in tree.body if isinstance(one, ast.ClassDef) and one.name == kind.__name__]
    assert ast.get_docstring(node)
    for before, after in zip(node.body[1::2], node.body[2::2], strict=True):
        assert isinstance(before, ast.AnnAssign), node.name
        assert isinstance(after, ast.Expr) and len(after.value.value) > 10, ast.unparse(before.target)
    text = " ".join(path.read_text(encoding="utf-8") for path in sorted(room_of(kind).rglob("*.py")))
    assert not {one.name for one in fields(kind)} - set(re.findall(r"\boptions\s*\.(\w+)\b", text))


def plane():
    draw = torch.Generator().manual_seed(0)
    return [torch.rand(40, 2, generator=draw, dtype=torch.float64) * 100 for _ in range(3)]


@pytest.mark.parametrize(
    "call",
    [
        lambda **given: dyn.align_planar(*plane(), **given),
        lambda **given: dyn.align_points(*[torch.cat([x, x[:, :1]], -1) for x in plane()], **given),
        lambda **given: dyn.align_lines(*[torch.rand(50, 2, 3) for _ in range(2)], **given),
        lambda **given: dyn.reconstruct(torch.stack(plane()), "constant_velocity_2d", **given),
        lambda **given: dyn.synchronize(
            plane()[0][:, None].expand(-1, 8, -1), plane()[1][:, None].expand(-1, 8, -1), fps=30, **given
        ),
        lambda **given: dyn.synchronize_cameras([torch.rand(40, 8, 2), torch.rand(40, 8, 2)], fps=30.0, **given),
    ],
    ids=["align_planar", "align_points", "align_lines", "reconstruct", "synchronize", "synchronize_cameras"],
)
def test_options_of_another_verb_are_refused(call):
    with pytest.raises(ValueError, match=r"options must be \w+Options, got SegmentOptions.*use dataclasses\.replace"):
        call(options=dyn.SegmentOptions())


@pytest.mark.slow
def test_options_of_the_alignment_decide():
    def aligned(scene, model, **given):
        options = dyn.AlignOptions(**given)
        return dyn.align_points(*scene.views, model=model, generator=torch.Generator().manual_seed(0), options=options)

    scene = scenes.moving_points(60, sensors="projective", sigma=1e-4, static=0.5, generator=torch.Generator().manual_seed(5))
    codes = [{str(notice.code) for notice in aligned(scene, "join", max_deviation=most).notices} for most in (0.05, 0.0)]
    assert codes[1] - codes[0] == {str(AlignNotice.UNCERTAIN)}
    drawn = [aligned(scene, "join", num_samples=number).labels for number in (None, 1000, 200)]
    assert torch.equal(drawn[0], drawn[1]) and float((drawn[2] == drawn[0]).double().mean()) > 0.9
    scene = scenes.constant_velocity(60, sensors="affine", sigma=1e-4, static=0.3, generator=torch.Generator().manual_seed(5))
    static = [int((aligned(scene, "affine_constant_velocity", min_static_share=share).labels == 1).sum()) for share in (0.1, 0.9)]
    assert static[0] > 10 and static[1] < static[0]


def test_options_of_the_synchronization_decide():
    g = torch.Generator().manual_seed(0)
    a = torch.randn(60, 10, 2, generator=g, dtype=torch.float64).cumsum(0)
    shipped = dyn.SynchronizeOptions()
    longer = replace(shipped, min_frames=100)
    with pytest.raises(ValueError, match="a has 60 frames, 100 are needed"):
        dyn.synchronize(a, a, fps=30.0, options=longer)
    careful = replace(shipped, min_margin=20.0)
    assert not dyn.synchronize(a, a, fps=30.0, options=careful).ok

"""The contract of an invariant: what follows from a declaration, and use of the class in place of its default instance."""

import inspect
from dataclasses import dataclass

import pytest
import torch

import dyntorch as dyn
from dyntorch.core.invariant import ARGUMENTS, Invariant, as_invariant, on_class
from dyntorch.core.primitives import HyperplanesThrough, Line, Point
from tests.draws import random
from tests.grid import assert_refused


@pytest.mark.parametrize(
    ("primitives", "nullity", "layout", "expected"),
    [
        ((Point(2), Point(2)), 1, (1, 0), ((3, 3), 9, 1, 8)),
        ((Point(3), Point(2), HyperplanesThrough(2)), 1, None, ((4, 3, 3), 36, 2, 18)),
        ((HyperplanesThrough(3), Point(3)), 1, None, ((4, 4), 16, 3, 5)),
        ((Point(3), Point(2)), 2, (1, 0), ((3, 4), 12, 1, 10)),
        ((Line(), Point(1)), 5, (0, 1), ((6, 2), 12, 1, 7)),
    ],
)
def test_sizes_follow_from_the_declaration(primitives, nullity, layout, expected):
    class Declared(Invariant):
        pass

    Declared.primitives, Declared.nullity, Declared.layout = primitives, nullity, layout
    for invariant in (Declared, Declared()):
        assert (invariant.shape(), invariant.width(), invariant.rows(), invariant.minimal()) == expected


def test_defaults_leave_everything_as_it_is():
    invariant, tensor = Invariant(), torch.rand(2, 3)
    assert invariant.constrain(tensor) is tensor
    assert invariant.normalize((tensor,)) is invariant
    assert invariant.whitened_residual((), (), ()) is None
    with pytest.raises(ValueError, match="Invariant has no separate residual for static matches; leave out static="):
        invariant.whitened_static_residual((), (), ())


def test_on_class_stands_for_the_default_instance():
    @dataclass(frozen=True)
    class Family:
        size: int = 3

        @on_class
        def doubled(self, add: int = 0) -> int:
            """Twice the size."""
            return 2 * self.size + add

    assert Family.doubled() == 6 and Family(5).doubled() == 10 and Family.doubled(add=1) == 7
    assert vars(Family)["doubled"].__doc__ == "Twice the size."


def test_as_invariant():
    assert isinstance(as_invariant(dyn.HomographyTensor), dyn.HomographyTensor)
    given = dyn.Collineation(3)
    assert as_invariant(given) is given

    @dataclass(frozen=True)
    class Family(Invariant):
        k: int

    with pytest.raises(ValueError, match=r"Family is a family: give its parameters, Family\(\.\.\.\)"):
        as_invariant(Family)
    for wrong in ("HomographyTensor", 3, torch.rand, int):
        with pytest.raises(ValueError, match=r"expected an invariant such as dyntorch\.HomographyTensor, got "):
            as_invariant(wrong)


def test_the_arguments_that_a_misspelt_one_is_compared_with_are_those_of_the_verbs():
    taken = {
        name
        for verb in (dyn.fit, dyn.robust_fit, dyn.refine, dyn.sampson)
        for name, parameter in inspect.signature(verb).parameters.items()
        if parameter.kind is parameter.KEYWORD_ONLY
    }
    assert taken == set(ARGUMENTS)


def test_a_misspelt_argument_is_named_with_the_one_that_was_meant():
    x, plane, dynamic = random(20, 2), dyn.Collineation(2), dyn.DynamicShapeTensor(dyn.Fourier(1))
    assert_refused(
        (lambda: dyn.fit(plane, x, x, weigths=1.0), "takes no argument 'weigths'; did you mean 'weights'"),
        (lambda: dyn.fit(plane, x, x, threshold=1.0), "takes no argument 'threshold'; leave it out"),
        (lambda: dyn.fit(plane, x, x, colour=1.0), "takes no argument 'colour'; leave it out"),
        (lambda: dyn.fit(dynamic, *[x] * 6, time=1.0), "takes no argument 'time'; did you mean 'times'"),
        error=TypeError,
    )

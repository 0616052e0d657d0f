"""What decides in fit_shapes() and recover_times(): every number, by its name, with its unit and what was measured for it."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class ShapeStartOptions:
    """The solutions that the descent starts from."""

    same_function: float = 1e-9
    """Singular value, over the largest, below which products of basis functions are the same function at the times of the views."""
    window_views: int = 6
    """Least number of views in a window in which the shape is taken to stand still."""
    windows: int = 200
    """Windows at most."""
    fill_rounds: int = 3
    """Rounds in which missing points are filled in from the mean shape."""
    fill_ridge: float = 1e-3
    """Ridge of the regression of a view's points on the mean shape, whose columns are of norm 1."""
    steps: int = 20
    """Steps from every start before the best one goes on.  Measured (16 kinds of 15 scenes: degree 1 and 2, 1 and 2 harmonics, 8
    and 14 points, noise 1 and 3 %, 40 views): of 240 scenes 3 go on from a start that does not lead to the least cost of all; of 45
    of the hardest kind (2 harmonics, 8 points, 3 %) 6, and 8 after 10 steps, which take 15 % less time."""
    steps_for_a_function: int = 5
    """Steps for each function that is added to the last start.  It leads to the least cost most often where points move by a third
    of the extent of their shape (55 of 60 scenes of degree 2 and of 2 harmonics at 1 %, the graph 33), the graph where by all of
    it."""


@dataclass(frozen=True)
class ShapesOptions:
    """Every number that decides in :func:`dyntorch.shapes.fit_shapes`."""

    starts: ShapeStartOptions = ShapeStartOptions()
    ambiguous: float = 0.5
    """Expected relative error of the shapes above which other shapes explain the views as well."""
    free: float = 4e-12
    """Eigenvalue of the normal matrix with all cameras at norm 1, over the largest, below which its direction is free.  Measured:
    the affine frame, which is, 1e-12 (the ridge of the Grams), points in a plane or at rest 1e-16 to 2e-12, five points of degree 2
    from 7e-11, eight points of constant velocity from 3e-4."""
    exact: float = 1e-6
    """Noise of views of norm 1 below which they are called exact; float32 leaves 1e-8 to 1e-7."""


@dataclass(frozen=True)
class RecoveryOptions:
    """Every number that decides in :func:`dyntorch.shapes.recover_times`."""

    minima: int = 3
    """Minima of the grid that are refined."""
    steps: int = 8
    """Gauss-Newton steps in the time; exact data need 4 from a grid of 64, noise of 3 % 6."""


@dataclass(frozen=True)
class PerspectiveOptions:
    """Every number that decides about perspective cameras in :func:`dyntorch.shapes.fit_perspective_shapes`."""

    steps: int = 2
    """Gauss-Newton steps from the linear camera."""
    nearest: float = 0.05
    """Least depth of a point, in parts of that of the middle of the shape."""
    depth: float = 0.15
    """Relative depths of points to expect, RMS: people before a camera at 2 m have .1 to .15, at 4.5 m .05."""
    first_depth: float = 1.0
    """The same in the first round, whose noise is what affine cameras leave (.15: 1.5 to 2 times as many steps)."""
    rounds: int = 8
    """Descents at most, each with the noise that the last one left: the cameras leave the affine ones step by step."""
    settled: float = 0.8
    """Of the noise of the last round, above which it is the noise of the views and no more rounds follow."""
    affine: ShapesOptions = ShapesOptions()
    """Of the affine shapes from which the descent starts."""


@dataclass(frozen=True)
class DeformableOptions:
    """Every number that decides in :func:`dyntorch.shapes.deformable_shapes`."""

    rounds: int = 150
    """Rounds of least squares in turn, at most; exact data with 20 % of the images missing need 20 to 100."""
    tolerance: float = 1e-7
    """Share of the error by which a round has to lower it for another one; the error of exact data is 0 at 1e-26."""
    exact: float = 1e-26
    """Mean squared error, of images of rms 1, that is rounding."""
    fills: int = 30
    """Rounds in which coordinates that only one camera saw, or none, are filled in from the shapes, before the first turn."""
    ridge: float = 1e-13
    """Ridge of the normal equations, of their mean diagonal entry: what no image shows stays finite."""
    flat: float = 1e-4
    """Third singular value of the joint images of both cameras, over the first, below which both see one projection only: cameras
    that look the same way, or a flat scene."""
    alike: float = 3.0
    """The same over the fourth, which is noise, below which the third may be noise as well."""
    metric: float = 1e-3
    """Least eigenvalue of the metric that constant lengths give, over the largest, below which they decide none."""
    lengths: int = 8
    """Rounds of reweighting of the metric that constant lengths give; 4 leave up to 1 % of its entries."""
    uncertain: float = 0.3
    """Relative error of the metric within three standard deviations above which lengths decide none."""
    chance: float = 9.0
    """Cost, in variances, that three standard deviations of one parameter make."""
    hardly: float = 0.2
    """Share of the cost by which a metric that is so far off has to cost more, too: the noise in the weights themselves makes some
    per cent where bones are a few times as long as the noise and nothing moves."""
    grid: int = 120
    """Members of the family of metrics of two scaled orthographic cameras that are tried at once."""
    zooms: int = 5
    """Times that the grid is laid closer about the best one: the last one is 1e-7 wide."""
    turns: int = 5
    """Rounds of rotations to the mean shape before the shapes are found."""

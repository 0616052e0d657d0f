"""What decides which matches of a COLMAP database stand still: every number of its stages, by its name, with its unit."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class DivideOptions:
    """How the pairs of images are divided into bodies, each by itself."""

    least: int = 16
    """Matches of a pair below which it is not divided: two bodies of eight.  Votes of other pairs decide about it."""
    most: int = 1500
    """Matches of a pair that are divided, drawn at random; the others of it join the bodies of those beside them.  Bounds the time
    of a pair to about a second."""
    beside: int = 5
    """Divided matches nearest in both images whose majority such a match joins, if the body's motion agrees with it."""
    per_image: int = 30
    """Pairs of an image, those with most matches, that are divided; the votes decide about its others.  Bounds the time by the
    number of images."""
    shared_out: int = 40
    """Pairs from which on the command line takes all cores: a process more takes as long to start as ten pairs."""


@dataclass(frozen=True)
class VoteOptions:
    """How the bodies of all pairs agree on what stands still."""

    shared: int = 6
    """Keypoints of a body on which other pairs have voted, from which these decide about the body."""
    agreed: float = 0.7
    """Agreement in [-1, 1] of the votes on a body's keypoints from which the body is static, and below minus which it moves.  What
    lies between is two bodies that moved alike between two images: it has no vote."""
    alone: float = 0.3
    """Weight of the votes of a pair of one body: that two things do not move apart between two images says little."""
    neighbours: float = 0.5
    """Weight of the votes of a keypoint that another one is matched with, of its own ones: matches carry votes along tracks."""
    passes: int = 2
    """Times that votes are carried along matches: as many pairs away."""
    turns: int = 30
    """Times at most that bodies and keypoints tell each other."""
    seeds: int = 5
    """Pairs with most matches whose bodies are tried as the static one, of those that are still open: 15 bodies or so."""


@dataclass(frozen=True)
class SpreadOptions:
    """By what the static body is told from a moving one, however many matches that has."""

    cells: int = 8
    """Columns and rows of the grid on an image in which keypoints are counted."""
    border: float = 0.5
    """Weight of the share of the grid's outermost cells, where what stands still surrounds what moves; the rest is that of all
    cells.  Cells without a match of any body do not count."""
    lead: float = 1.15
    """Spread over that of the next body, over all images, from which it is the static one.  Ten scenes of which 60 % moves: 3.3
    to 9."""
    alike: float = 0.5
    """Share of common static keypoints from which two answers are one."""


@dataclass(frozen=True)
class KeepOptions:
    """Which matches are kept, and what COLMAP's own estimation makes of them."""

    least: int = 15
    """Verified matches of a pair below which it has none: COLMAP's mapper leaves out pairs of fewer."""
    points: int = 15
    """Keypoints that stand still below which an image is refused by name."""
    images: float = 0.5
    """Share of the images with matches that must not be refused, or else all are."""
    distance: float = 4.0
    """Epipolar distance of COLMAP's verification, pixels: COLMAP's default."""


@dataclass(frozen=True)
class MaskOptions:
    """Where around moving keypoints a mask is black."""

    least: float = 0.008
    """Radius of a disc around a moving keypoint at least, of the diagonal of the image."""
    most: float = 0.05
    """Radius at most."""
    gaps: float = 2.0
    """Radius over the distance to the third nearest moving keypoint: discs of a body close up."""
    side: int = 1024
    """Pixels of the longer side at which a mask is drawn; then it is enlarged."""


@dataclass(frozen=True)
class StaticOptions:
    """Options of :func:`indexing.colmap.find_static`, by stage."""

    divide: DivideOptions = DivideOptions()
    vote: VoteOptions = VoteOptions()
    spread: SpreadOptions = SpreadOptions()
    keep: KeepOptions = KeepOptions()
    mask: MaskOptions = MaskOptions()

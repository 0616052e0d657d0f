"""What decides in camera_motion() and track_points(): every number, by its name, with its unit and what was measured for it."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class CameraMotionOptions:
    """Whether, when and by how much the camera moves; pixels are those of the working image."""

    working: int = 640
    """Longest side, pixels, at which a camera's motion is measured."""
    cells: tuple[int, int] = (8, 6)
    """Of the image; the same number of points in each, so that a textured person does not outvote the background."""
    per_cell: int = 8
    """Points in each cell."""
    fewest: int = 12
    """Points below which nothing is said about the camera."""
    tolerance: float = 1.5
    """Pixels of a point from where the camera's motion puts it; KLT's own error is about 0.1."""
    close: float = 0.5
    """Pixels, to tell which of two models is the better one."""
    rest: float = 0.5
    """Pixels that points stay within where the camera stands."""
    stands: float = 0.035
    """Such points say that it stands where (share of all points) x (standard deviation / longest side) exceeds this.  Of a person
    before a plain wall .8 of the corners are the person's, and the largest group that agrees may move with the person: 20 clips of
    signing before a fixed camera have .09-.21 in their median frames, two fixed cameras in a laboratory .20 and .23.  What rests on
    a subject that the camera follows is compact."""
    trusted: float = 0.25
    """Share of points that must agree with a motion; below, the picture has changed or the background is hidden."""
    renew: float = 0.6
    """Share of the best support of a key frame at which a new one is taken."""
    far: float = 0.2
    """Of the width: a key frame this far away overlaps too little."""
    still: float = 0.002
    """Of the diagonal (1.5 pixels of 640 x 480): a tripod stays well below, a hand goes beyond within half a second."""
    window: float = 0.5
    """Seconds within which the corners of the picture must move by that."""
    unseen: float = 0.1
    """Share of frames without enough background above which the answer is called unsure."""


@dataclass(frozen=True)
class TrackOptions:
    """Points that move, followed through a video; pixels are those of the working image."""

    working: int = 960
    """Longest side, pixels: KLT is exact to a tenth of these."""
    back: float = 0.7
    """Pixels between a point and where following it there and back ends."""
    patch: tuple[int, int] = (17, 17)
    """Surroundings of a point that are followed, pixels."""
    change: float = 16
    """Grey levels over a chunk, after shrinking by four: beyond noise, where something moved."""
    check: int = 5
    """Frames after which a point must still look like itself."""
    same: float = 0.6
    """Correlation of its surroundings then: where somebody passes before the background, its points are dragged along, and there
    and back agree."""
    corner: float = 0.01
    """Of the best corner's strength, below which nothing is a corner."""
    renew: int = 10
    """Frames after which new points replace lost ones."""
    apart: int = 90
    """Points are at least one part in so many of the width apart."""
    moving: float = 0.01
    """Of the diagonal: extent of a track that counts as moving."""
    dragged: float = 0.15
    """Of that, extent of the middle half: background dragged along by a passer-by rests for the rest of its life."""
    rest: float = 0.25
    """Share of points on ground where nothing moves now: people who rest and move later."""
    wandering: float = 3.0
    """Pixels: extent of a track from which it may be worth keeping."""
    shortest: int = 10
    """Frames of a track that is worth keeping."""
    camera: CameraMotionOptions = CameraMotionOptions()
    """How the camera's own motion is found, which is taken out."""


@dataclass(frozen=True)
class SceneOptions:
    """Every point that can be followed through pictures, the background too."""

    count: int = 800
    """Points followed at a time."""
    follow: TrackOptions = TrackOptions(working=1280, back=0.5, patch=(15, 15), corner=0.003, renew=5, apart=60, shortest=2)
    """How each is followed.  Rendered scenes of :mod:`experiments.alignment.videos`, points more than a pixel off after 40 frames,
    patches of 11 / 15 / 21 pixels: a plane .001 / 0 / .002, a room .021 / .029 / .042."""
    views: int = 3
    """Pictures taken where nobody says which."""
    several: int = 8
    """The same for ``dyntorch reconstruct``, which compares many models of motion."""
    present: float = 0.6
    """Share of the pictures taken in which a point must be seen, where it may be missing in some."""
    lasting: float = 0.5
    """Share of the points of the first picture that must still be followed in the last one taken, where nobody says which."""
    anchored: float = 1.0
    """Pixels, of the working image, by which a point is corrected at most when it is compared with the first picture that shows it;
    beyond, it is lost.  Without that comparison .08 of the points of a plane and .09 of those of a room are more than a pixel off:
    the edges of what moves drag them along."""
    anchors: int = 24
    """Pictures taken up to which that is done: it costs their number squared."""
    most: int = 200
    """Pictures taken at most where a whole video is followed and nobody says which."""
    tracks: int = 3000
    """Points kept at most of a whole video."""
    brief: int = 5
    """Pictures taken that must show a point of a whole video; half of them where there are fewer than twice as many."""
    span: int = 16
    """Pictures of a whole video after which a point is compared with a newer one: its first one is too unlike by then.  Share of
    the points of a rendered room of 90 pictures that end more than 3 pixels off: without a comparison .14, with spans of
    8 / 16 / 24 pictures .039 / .030 / .024."""
    kept: int = 4
    """Pictures of a whole video that are kept, to draw on."""
    fewest: int = 12
    """Points that must be there in two pictures."""
    rest: float = 1.0
    """Pixels, of the working image, that a point which rests before a resting camera stays within."""
    movers: int = 4
    """Points that must go beyond that: with fewer, nothing moves."""
    threshold: float = 1.0
    """Pixels, of the working image, within which a point is followed.  Estimated from the matches, it is .3: a tenth of a wall that
    rests before a resting camera is then called moving, because a few per cent of the points are that far off."""

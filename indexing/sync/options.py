"""What decides in synchronize() of recordings: every number of its stages, by its name, with its unit and its measurement."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from dyntorch import SynchronizeOptions
from indexing.video.options import TrackOptions

Measure = Literal["profile", "window"]
"""What of the brightness is compared: the row-band profile, which the window kernel must confirm, or the window kernel alone."""
MEASURES = ("profile", "window")


@dataclass(frozen=True)
class RecordingOptions:
    """What is taken of one camera's recording."""

    fewest: int = 12
    """Frames of keypoints at least: those that :func:`dyntorch.synchronize` takes."""
    candidates: int = 3
    """People of a camera that are tried, besides the largest one of each frame."""
    seen: float = 0.2
    """Share of the longest person's frames that a person must be seen in to be tried."""
    same: float = 0.9
    """Share of the frames of a person in which the largest one is that person, from where on they are one."""
    uneven: float = 0.1
    """Of a frame, by which times of an even grid are off it at most."""
    exact: float = 1e-9
    """Relative difference by which a frame rate is still the one that was given."""
    empty: float = 0.1
    """Share of frames without a person above which it is said."""
    sparse: float = 20
    """Times its frames that a take's clock may run over, for its frames to be compared."""
    sparse_frames: int = 20_000
    """Frames that it may run over in any case."""
    pauses: tuple[float, ...] = (60.0, 10.0, 1.0)
    """Seconds without frames at which a take that is nearly all gap is cut: as few as will do."""


@dataclass(frozen=True)
class PeopleOptions:
    """Which person of one camera is which of the other."""

    joints: int = 8
    """Joints of the same name in two layouts, for them to be compared as the same points."""
    tolerance: float = 2.0
    """Frames within which two answers are the same."""
    sigmas: float = 3
    """Sum of the standard deviations of two answers, times this, within which they are the same."""
    likeliest: int = 3
    """Pairings that are tried thoroughly where a fast look is sure of none."""
    weak: float = 0.5
    """Share of the best pairing's confidence below which an answer that differs is no rival."""
    away: float = 2.0
    """Times the usual distance from the epipolar lines that makes a stretch of another person.  Of one person, the running median
    stays below 1.5 (pose2sim, all pairs, and actors); of two who were swapped 10 m apart it reaches 2 to 3, because two who stand
    upright fit each other's epipolar lines."""
    lasting: float = 0.25
    """Seconds that such a stretch lasts at least."""
    seen: int = 4
    """Joints that must be seen for a frame to be judged."""
    jump: float = 0.5
    """Box diagonals from one frame to the next that make another person."""


@dataclass(frozen=True)
class VideoOptions:
    """Recordings of which at least one is a video."""

    agree: float = 2.0
    """Frames within which tracks and brightness say the same."""
    tracks: int = 4
    """Moving points that must be followed in each video."""
    size: int = 320
    """Longer side at which brightness is read, pixels: all that the method looks at."""
    people: int = 4
    """Looked for in a video at most, where a pose model is there: pairings of more are not tried."""


@dataclass(frozen=True)
class SoundOptions:
    """What two microphones heard, as a witness or alone.  Measurements: ``python -m experiments.synchronization.sound``."""

    samples: int = 16_000
    """Per second, to which all sound is brought: the bands below need no more."""
    gap: float = 0.02
    """Seconds that the timestamps of a file may be off its samples before a gap is taken for one; Matroska rounds to .001."""
    quiet: float = 3e-4
    """Of full scale: a recording that is nowhere louder holds the rounding of its samples, 10 steps of 16 bits."""
    lowest: float = 200.0
    """Hertz: below are hum of the mains, wind and hands on the phone, of one microphone alone."""
    highest: float = 7000.0
    """Hertz: what phones' noise suppression leaves."""
    bands: int = 8
    """Bands of pitch, of equal ratio."""
    window: float = 0.01
    """Seconds of a spectrum."""
    hop: float = 0.002
    """Seconds from one to the next, of the envelopes that offset and rate are read from."""
    step: float = 0.01
    """Seconds, of the envelopes in which shifts are searched."""
    smooth: float = 0.05
    """Hertz over which magnitudes are averaged in the phase transform.  Least evidence against the next peak, music at 10 dB,
    0 / .05 / .5 Hz: 7.3 / 7.4 / 5.0; the same of all kinds at -5 dB: 1.6 / 3.0 / 2.9."""
    slowest: float = 0.5
    """Hertz: slower changes of loudness are those of automatic gain."""
    overlap: float = 2.0
    """Seconds that both must have recorded at once."""
    drift: float = 2e-4
    """Seconds per second that one clock may gain on the other: those of phones and cameras gain 5e-5 at most."""
    piece: float = 30.0
    """Seconds within which drift is not looked at, 6 ms at most."""
    shortest_piece: float = 2.0
    """Seconds of the pieces whose scatter tells how sure offset and rate are, at least."""
    fewest_pieces: int = 12
    """How many of them there are in an overlap that is long enough."""
    blur: float = 0.003
    """Seconds, standard deviation by which scores are smoothed about the peak, for their slope and curvature."""
    long: float = 30.0
    """Seconds of overlap from which a rate is looked for: 1e-4 moves the ends by 3 ms then."""
    sure: float = 3.0
    """Standard deviations that a rate must be off 1, and two witnesses off each other to contradict."""
    rounds: int = 8
    """Newton's steps."""
    peaks: int = 7
    """Peaks that are looked at."""
    apart: float = 0.1
    """Seconds within which a peak is the slope of a higher one: half of this is a band's envelope, and a room's first echoes."""
    stretch: float = 0.03
    """Seconds that speak as one, a clap.  Evidence (sum over root of squares) at .02 / .03 / .05 / .1 s, recordings of 60 s: speech
    at 10 dB 23 / 20 / 17 / 13, steps at -5 dB 7.1 / 6.7 / 6.3 / 6.0; the strongest of 600 unrelated pairs 4.8 / 4.7 / 5.0 / 4.9."""
    chance: float = 1e-2
    """Probability of evidence as strong by chance at any shift, at most, by a bound that is far above it: evidence of 5.3 for
    recordings of 60 s, 4.9 for 10 s."""
    apart_by: float = 3.0
    """Sum over root of squares of what short stretches say for the best shift rather than another one, at least.  1,200 unrelated
    pairs reach 1.5, wrong answers to a metronome 1.9; right ones of 60 s 4.8 and more, music at -5 dB 2.9 to 6.8."""
    nearer: float = 3.0
    """Metres, standard deviation of how much nearer the sound is to one camera: 10 m, 29 ms, is then the limit."""
    speed: float = 343.0
    """Metres per second, of sound at 20 degrees."""
    latency: float = 0.015
    """Seconds, standard deviation between sound and pictures of a file: three of them are the 45 ms that ITU-R BT.1359-1 finds to
    be noticed."""
    shown: int = 20_000
    """Points of the curve that are kept for its picture."""


@dataclass(frozen=True)
class TrimOptions:
    """Videos that are cut to what all cameras recorded."""

    same: float = 0.25
    """Of a frame, by which times of keypoints are those of the video's frames at most."""
    longer: float = 2.0
    """Frames by which keypoints may run over the end of their video."""
    denominator: int = 1001
    """Of the frame rate as a fraction, at most: 30000/1001."""
    crf: str = "17"
    """Quality of H.264: the eye sees no difference from 18 down, and who looks for keypoints should not, either."""
    preset: str = "veryfast"
    """Of H.264: speed for size."""
    mpeg4: str = "2"
    """Quality of MPEG-4, where there is no H.264."""
    every: int = 20
    """Frames from one report of progress to the next."""


@dataclass(frozen=True)
class GrayOptions:
    """What is kept of a gray video."""

    largest: int = 320
    """Longer side kept, pixels: a person a quarter as tall as a 1080p image keeps 45."""
    smallest: int = 16
    """Shorter side, pixels, at least."""
    fewest: int = 20
    """Frames at least."""
    fastest: float = 45.0
    """Frames per second: faster video is compared at a half, a third... of its rate; windows were chosen at 30."""
    gap: float = 2.5
    """Frames: over longer gaps nothing is interpolated."""


@dataclass(frozen=True)
class ProfileOptions:
    """How much moves up, down and sideways, in bands of rows."""

    sigma: float = 1.5
    """Blur of the crop, pixels of it."""
    bands: int = 6
    """Bands of rows, overlapping by half; 4 to 12 do the same."""
    quiet: float = 2.0
    """Times the median brightness change, below which change is noise.  Share within 1 frame at 0 / 2 / 4, training seeds: CMU in
    place, 70 frames, noise 8: .78 / .88 / .82; walking and running .68 / .72 / .72; 150 frames: all the same."""
    reach: int = 3
    """Frames on either side that are whitened together.  Share within 1 frame of 218 training pairs of all kinds: no neighbours,
    ridge .1: .86; reach 2 / 3 / 4 / 6, ridge .1: .89 / .90 / .90 / .90."""
    ridge: float = 0.05
    """Ridge of the whitening, over the largest eigenvalue: at reach 3, .03 / .2: .91 / .87."""


@dataclass(frozen=True)
class KernelOptions:
    """The thesis's window kernel: how the patches of a short window move."""

    sigma: float = 2.0
    """Blur, pixels of the crop: motion within a window must be small against it."""
    half: int = 10
    """Frames on either side of the reference."""
    patch: int = 10
    """Side of a patch, pixels of the crop."""
    rows: int = 80
    """Rows kept: those of most energy."""
    damping: float = 0.05
    """Of the largest gradient energy of a frame, added to that of each patch by which it is divided."""
    ridge: float = 0.02
    """Ridge of the whitening of kernels, over the largest eigenvalue."""


@dataclass(frozen=True)
class DriftOptions:
    """Whether the camera moves: the flow of the image's border."""

    border: float = 0.12
    """Share of the image, on each side."""
    explained: float = 0.5
    """Share of the border's change that one translation must explain; a person who crosses the border leaves most unexplained."""
    least: float = 0.05
    """Pixels per frame below which the camera is on a tripod."""
    often: float = 0.1
    """Share of the frames in which it must be seen to count."""
    change: float = 0.02
    """Grey 0..1 per frame that is a change: 5 standard deviations of a noise of 8 grey levels, after the blur."""
    changed: float = 0.3
    """Share of the border that changes so without one translation: a fast pan, a cut, flicker."""


@dataclass(frozen=True)
class BoxOptions:
    """The box about what moves."""

    side: int = 96
    """Side of a crop, pixels."""
    quiet: float = 0.006
    """Grey 0..1 per frame below which change is noise."""
    noise: float = 6.0
    """Times the median change, below which change is noise: 4 standard deviations, 1 pixel in 16,000 by chance."""
    sigma: float = 1.5
    """Blur, pixels."""
    inside: tuple[float, float] = (0.02, 0.98)
    """Quantiles of the motion that a box encloses."""
    pad: float = 0.15
    """Of the box, added on each side."""
    smallest: float = 0.35
    """Smallest side, of the image's height."""
    follow: float = 0.2
    """Seconds over which a moving box is smoothed."""
    wider: float = 1.6
    """Times the moving box, from which the box of the take is too wide."""
    lively: float = 3e-4
    """Share of the pixels that must change in a frame that shows motion: 5 times what noise does."""
    liveliest: int = 10
    """Frames in which something moves, at least."""


@dataclass(frozen=True)
class LagOptions:
    """The score of every lag."""

    power: float = 0.35
    """Of the overlap in the score.  Share within 1 frame at 0 / .25 / .5, training seeds: CMU in place, 70 frames .88 / .88 / .88,
    150 frames .92 / 1.00 / 1.00; walking and running .68 / .72 / .80: a mean alone (0) prefers chance agreement in short
    overlaps."""
    overlap: float = 0.35
    """Share of the shorter take that must overlap."""
    kernel_overlap: float = 0.3
    """Share of its kernels that must overlap."""
    part_overlap: float = 0.5
    """Share of a half that must overlap."""
    apart: int = 8
    """Frames from the best beyond which another peak is another answer."""
    peaks: int = 10
    """Peaks reported at most."""
    floor: float = 0.35
    """Frames of the grid: standard deviation of an accepted offset.  Measured .24 to .32 RMS on shifts by quarters of a frame and
    four pairs of rates: the parabola is hardly better than whole frames (.29)."""


@dataclass(frozen=True)
class WindowOptions:
    """Whether every moment of the overlap asks for the same lag."""

    size: int = 16
    """Frames of a window."""
    hop: int = 8
    """Frames from one window to the next."""
    reach: int = 12
    """Lags on either side of the candidate."""
    tolerance: int = 1
    """Lags within which a window speaks for the candidate."""
    sharpness: float = 10.0
    """Of the softmax over mean cosines.  AUC right against wrong candidates, five training sets, at 10 / 20 / 40: .926 / .904 /
    .892 (windows of 24: .927 / .921 / .909); of the peak's height .899, halves .854, height above the other lags .853, next peak
    .821."""
    known: float = 0.75
    """Share of a window's pairs of frames that must be known."""
    outlier: float = 0.05
    """Share of windows that may say anything."""
    fewest_kernels: int = 5
    """Pairs of kernels from which their windows are heard."""


@dataclass(frozen=True)
class VerdictOptions:
    """What must hold besides being the best, for a lag to be believed."""

    tolerance: int = 2
    """Frames within which halves and kernel agree with the best lag."""
    second: float = 0.8
    """Of the best score: a peak as high as this makes the motion periodic or the answer open."""
    backwards: float = 0.95
    """Of the best score: b played backwards must do worse."""
    lead: float = 30.0
    """Nats for doing better than b played backwards by 100 %."""
    enough: float = 31.0
    """Nats: evidence of short windows, and the lead.  Training, 235 pairs of one event (213 best lags within 1 frame) and 1,175 of
    unrelated or reversed takes: 67 right, 1 wrong (by 2 frames) and none of the unrelated pass; at 25: 84, 2 and 3."""
    agreed: tuple[float, float] = (16.5, 6.2)
    """Centre and scale of the logistic curve of confidence where halves and kernel agree, in nats, on all these pairs."""
    open: tuple[float, float] = (23.3, 4.9)
    """The same where they do not."""


@dataclass(frozen=True)
class SyncOptions:
    """Every number that decides in :func:`indexing.synchronize`, by stage."""

    tracks: TrackOptions = TrackOptions()
    """Of moving points followed through videos."""
    points: SynchronizeOptions = SynchronizeOptions()
    """Those of :func:`dyntorch.synchronize`, for keypoints and tracks."""
    recording: RecordingOptions = RecordingOptions()
    people: PeopleOptions = PeopleOptions()
    video: VideoOptions = VideoOptions()
    sound: SoundOptions = SoundOptions()
    gray: GrayOptions = GrayOptions()
    profile: ProfileOptions = ProfileOptions()
    kernel: KernelOptions = KernelOptions()
    drift: DriftOptions = DriftOptions()
    box: BoxOptions = BoxOptions()
    lags: LagOptions = LagOptions()
    windows: WindowOptions = WindowOptions()
    verdict: VerdictOptions = VerdictOptions()
    window_verdict: VerdictOptions = VerdictOptions(enough=25.0, agreed=(12.1, 4.0), open=(112.0, 38.0))
    """Of the window kernel alone, ``measure="window"``.  144 pairs of synthetic actors (129 best lags within 1 frame; the profile:
    135) and 576 of unrelated or reversed takes: 22 right ones pass and none of the others; at 20: 49 and 3, at 15: 74 and 10."""

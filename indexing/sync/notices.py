"""What is said about the recordings that are synchronized: every notice of this room, and its sentence."""

from __future__ import annotations

from collections.abc import Iterable

from dyntorch import Status
from dyntorch.core import Notice, NoticeCode, Outcome

_METHODS = "tracks say {tracks}, brightness says {brightness}"


class SyncNotice(NoticeCode):
    """What to know of recordings, of the people in them, and of two methods that must agree."""

    NOTE = "note", "{text}"
    """What a reader says; ``camera`` is the recording that it speaks of."""
    ASSUMED = "assumed_rate", "30 frames per second assumed for {names}; {arg:fps=} says otherwise"
    """Files that do not say how many frames a second has."""
    SAME = "same_recording", "{names} are the same recording"
    """One recording given twice."""
    METHODS = "methods", _METHODS
    """What each method says."""
    PEOPLE = "people", "several people in view: compared {first} with {second}, the best of {value:g} pairings"
    """Who was compared."""
    BY_PIXELS = "by_pixels", "the keypoints do not decide ({keypoints}); this is what the videos' pixels say"
    """Keypoints of videos that do not decide, and pixels that do."""
    NEITHER = "neither", "the pixels do not decide, either: {pixels}"
    """Neither keypoints nor pixels of two videos decide."""
    DISAGREE = (
        "disagree",
        f"{_METHODS}; record keypoints of the people, or a longer take with more motion",
        Status.NO_CONSENSUS,
    )
    """Two methods that say different things."""
    UNDECIDED = "undecided", "neither tracks nor brightness decide: {tracks}; {brightness}", Status.AMBIGUOUS
    """Neither of two methods decides."""
    FEW_TRACKS = (
        "few_tracks",
        "fewer than {needed} moving points could be followed in {names}; use keypoints",
        Status.TOO_FEW,
    )
    """Nothing to follow."""
    UNUSABLE = "unusable", "{text}", Status.TOO_FEW
    """A method that cannot be tried."""
    PAIRINGS = (
        "pairings",
        "one pairing of people says {value:+.3f} s, but pairings of other people say {rivals}; name one person per camera "
        "({arg:person=}), or record one who moves otherwise",
        Status.NO_CONSENSUS,
    )
    """Pairings of other people that are as sure."""


class SoundNotice(NoticeCode):
    """What the sound of two videos says, and why it does not decide."""

    NONE = "no_sound", "{camera:{which}} has no sound; use keypoints or pixels", Status.TOO_FEW
    """A video without a stream of sound."""
    SILENT = "silent", "the sound of {camera:{which}} is silence; use keypoints or pixels", Status.DEGENERATE
    """A microphone that was off."""
    SHORT = (
        "short",
        "the sounds overlap by less than {value:g} s at every shift that is searched; film longer, or raise {arg:max_shift}",
        Status.TOO_FEW,
    )
    """Nothing to compare."""
    NOTHING = (
        "no_peak",
        "no shift of the sound stands out: the microphones heard too little, or different things; clap at some uneven moments",
        Status.AMBIGUOUS,
    )
    """No peak stands out."""
    REPEATED = (
        "sound_repeats",
        "the sound repeats itself: {value:+.3f} s fits hardly better than {rivals} s; clap at some uneven moments",
        Status.AMBIGUOUS,
    )
    """Several peaks, as of a metronome."""
    AGREES = "sound_agrees", "sound agrees: {value:+.3f} s"
    """The sound says the same; the value is how much later."""
    OPEN = "sound_open", "the sound does not decide: {why}"
    """The sound is no witness."""
    ALONE = "sound_alone", "the sound says {offset} ± {sigma} s; {arg:method='sound'} takes its word"
    """The sound decides where nothing else does."""
    CONTRADICTS = (
        "sound_contradicts",
        "the sound says {offset} ± {sigma} s, and the pictures say {found} ± {own} s: one of them is wrong; {arg:method='sound'} "
        "takes the word of the sound, {arg:sound=False} that of the pictures",
        Status.NO_CONSENSUS,
    )
    """The sound says something else."""


class BrightnessNotice(NoticeCode):
    """Why the brightness of two videos does not decide, or what to know besides."""

    FLICKER = (
        "flicker",
        "all of {camera:{which}} changes: its camera moves fast, or the light flickers; stabilize the video first",
        Status.DEGENERATE,
    )
    """A picture that changes everywhere."""
    STILL = "still", "nothing moves in {camera:{which}}; choose a take with motion", Status.DEGENERATE
    """Nothing moves."""
    CAMERA_MOVES = (
        "camera_moves",
        "{camera:{which}}: the camera moves ({value:.1f} px per frame); its motion was taken out approximately",
    )
    """A camera that moves."""
    CROSSES = "crosses", "{camera:{which}}: motion crosses the image; a moving box follows it"
    """Motion across the image."""
    REPEATED = (
        "repeated",
        "another shift fits nearly as well ({value:.0f} % of the best score): the motion repeats, or there is too little of it; "
        "film "
        "longer and less regular motion, or give {arg:max_shift}",
        Status.AMBIGUOUS,
    )
    """Another shift fits as well."""
    HALVES = (
        "halves",
        "the halves of the overlap disagree with the whole (by {first:+.2f} and {second:+.2f} s): do both videos show the same "
        "event? "
        "Use a longer overlap, or keypoints",
        Status.NO_CONSENSUS,
    )
    """The two halves of the overlap contradict the whole."""
    KERNEL = (
        "kernel",
        {
            "short": "the window kernel has too few frames, so the best shift is not confirmed; use a longer overlap, or keypoints",
            "apart": "the window kernel says {value:+.2f} s from it, so the best shift is not confirmed; use a longer overlap, or "
            "keypoints",
        },
        Status.NO_CONSENSUS,
    )
    """The second measure does not confirm the first."""
    BACKWARDS = (
        "backwards",
        "{camera:b} fits as well when played backwards: the motion is symmetric in time, or of another time; use keypoints",
        Status.AMBIGUOUS,
    )
    """Motion that looks the same backwards."""
    EVIDENCE = (
        "evidence",
        "too little evidence ({value:.0f} of {needed:.0f}): similar motion of another time would fit about as well; use a longer "
        "overlap, or keypoints",
        Status.AMBIGUOUS,
    )
    """Too little evidence."""


def reader_notices(texts: Iterable[str], camera: str = "") -> list[Notice]:
    """Notes of a reader as notices, of one recording or of all."""
    return [Notice(SyncNotice.NOTE, 0.0, {"text": text, "camera": camera}) for text in texts]


def accepted_notices(shift: Outcome) -> list[Notice]:
    """The notices that refuse nothing."""
    return [notice for notice in shift.notices if notice.code.refuses is None]

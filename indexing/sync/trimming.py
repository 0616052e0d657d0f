"""Videos cut to what all cameras recorded, with equal numbers of frames at equal moments: ``synchronized_videos/``.

Programs that want synchronized videos (FreeMoCap among them) take frame k of every file for one moment.  So every moment of the
reference's clock takes the nearest frame of each camera, and all files have one constant frame rate: a clock that runs faster has
a frame left out now and then, one that runs slower has one twice, and none is off by more than half of its own frame.
"""

from __future__ import annotations

import math
import shutil
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from indexing.files import recover_folder, replacing_folder
from indexing.opening import entries, parse_json, read_text
from indexing.sync.files import check_inputs, count_repeated, not_ours
from indexing.sync.recordings import Take, videos_named
from indexing.video.drawing import ClockRelation, add_video_stream
from indexing.video.reading import Orientation, av, frame_times, orientation, read_video

FOLDER = "synchronized_videos"
Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class CameraVideo:
    """A camera's video, and when its frames were taken. stamps ``(frames,)``, times ``(frames,)``."""

    name: str
    path: Path
    stamps: Floats
    times: Floats

    @property
    def frame(self) -> float:
        """Seconds from one frame to the next, usually."""
        return float(np.median(np.diff(self.times))) if len(self.times) > 1 else math.inf


@dataclass(frozen=True, eq=False)
class Cut:
    """Which frames of a video are written. rows ``(k,)``."""

    film: CameraVideo
    rows: NDArray[np.int64]
    rest: float

    @property
    def file(self) -> str:
        """The name of the file that is written."""
        return f"{self.film.name}.mp4"

    @property
    def num_repeated(self) -> int:
        """How many frames stand for more than one moment."""
        return count_repeated(self.rows)

    @property
    def left_out(self) -> int:
        """How many frames between the first and the last are not written."""
        return int(self.rows[-1] - self.rows[0] + 1 - len(np.unique(self.rows)))

    def as_json(self) -> dict[str, Any]:
        """The same in plain types."""
        first, last = int(self.rows[0]), int(self.rows[-1])
        return {
            "file": f"{FOLDER}/{self.file}", "of": str(self.film.path), "frames": len(self.rows), "first": first, "last": last,
            "repeated": self.num_repeated, "left_out": self.left_out, "rest": self.rest,
        }  # fmt: skip


@dataclass(frozen=True, eq=False)
class Trim:
    """What all cameras recorded, frame by frame."""

    fps: Fraction
    start: float
    cuts: tuple[Cut, ...]

    @property
    def frames(self) -> int:
        """Of every file."""
        return len(self.cuts[0].rows)


def video_of(take: Take) -> CameraVideo:
    """The video of a camera: what it is itself, what its keypoints were found in, or the one that lies beside them."""
    path = take.footage or find_video(take)
    if path is None:
        where = take.path or take.name
        raise ValueError(
            f"{where}: no video of this camera is known: give the video itself, or put it beside the keypoints under the name "
            f"{take.name}.mp4 (or in a folder videos/ there)"
        )
    stamps = frame_times(path)[1]
    return CameraVideo(take.name, path, stamps, frame_clock(take, path, stamps))


def find_video(take: Take) -> Path | None:
    """The video that lies beside a camera's keypoints and has its name, or in a folder ``videos`` there or one above."""
    if take.path is None or take.kind != "keypoints":
        return None
    home = take.path.resolve().parent
    videos = (videos_named(folder, take.name) for folder in (home, home / "videos", home.parent / "videos"))
    return next((files[0] for files in videos if len(files) == 1), None)


TIME_TOLERANCE_FRAMES = 0.25  # Within this the times of keypoints are those of the video's frames.
MAX_OVERRUN_FRAMES = 2.0  # Frames by which keypoints may run over the end of their video.


def frame_clock(take: Take, path: Path, stamps: Floats, mended: Floats | None = None) -> Floats:
    """When the frames of a video were taken, on the clock of a camera's keypoints. mended ``(frames,)``."""
    if take.kind != "keypoints":
        return stamps
    near = np.abs(stamps[np.clip(np.searchsorted(stamps, take.times), 1, len(stamps) - 1) - [[1], [0]]] - take.times).min(axis=0)
    own = stamps if near.max(initial=0.0) <= TIME_TOLERANCE_FRAMES / take.fps else np.arange(len(stamps)) / take.fps
    if take.times[-1] > own[-1] + MAX_OVERRUN_FRAMES / take.fps:
        raise ValueError(
            f"{path}: has {len(stamps)} frames, but there are keypoints of {take.name} up to frame "
            f"{round(take.times[-1] * take.fps)}; give the video that they were found in"
        )
    if mended is None:
        return own
    rows = np.clip(np.searchsorted(take.times, own, side="right") - 1, 0, len(mended) - 1)
    return np.asarray(own + (mended - take.times)[rows], dtype=np.float64)


MAX_FPS_DENOMINATOR = 1001  # Of the frame rate as a fraction: 30000/1001.


def trim(films: Sequence[CameraVideo], clocks: Sequence[ClockRelation], fps: float | None = None) -> Trim:
    """Choose the frames of what all cameras recorded: at each moment the nearest one of each."""
    first = films[0]
    own = (len(first.times) - 1) / (first.times[-1] - first.times[0]) if len(first.times) > 1 else 0.0
    if fps is None and not own > 0:
        raise ValueError(f"{first.path}: has one frame, and so no frame rate; give it (--videos-fps)")
    exact = Fraction(own if fps is None else fps).limit_denominator(MAX_FPS_DENOMINATOR)
    half = [min(film.frame / 2, 1.0) for film in films]
    begins = [float(clock.inverse(film.times[0] - off)) for film, clock, off in zip(films, clocks, half, strict=True)]
    ends = [float(clock.inverse(film.times[-1] + off)) for film, clock, off in zip(films, clocks, half, strict=True)]
    begin, end, step = max(begins), min(ends), float(1 / exact)
    zero = float(first.times[0])
    number = math.ceil((begin - zero) / step - 1e-6)
    count = math.floor((end - zero) / step + 1e-6) - number + 1
    if count < 1:
        late, early = films[int(np.argmax(begins))].name, films[int(np.argmin(ends))].name
        raise ValueError(
            f"{early} ended {begin - end:.2f} s before {late} began, so no moment is in the videos of all cameras; leave one of "
            "them out"
        )
    moments = zero + (number + np.arange(count)) * step
    cuts = tuple(_select_frames(film, np.asarray(clock.at(moments), np.float64)) for film, clock in zip(films, clocks, strict=True))
    return Trim(exact, float(moments[0]), cuts)


def _select_frames(film: CameraVideo, wanted: Floats) -> Cut:
    """The frame nearest to each time of the camera's clock."""
    after = np.clip(np.searchsorted(film.times, wanted), 0, len(film.times) - 1)
    before = np.maximum(after - 1, 0)
    rows = np.where(np.abs(film.times[before] - wanted) <= np.abs(film.times[after] - wanted), before, after)
    return Cut(film, rows, float(np.abs(film.times[rows] - wanted).max()))


# ----------------------------------------------------------------------------------------------------------------------
# Writing.


def check_videos(folder: Path, inputs: Sequence[Path]) -> None:
    """Raise where the trimmed videos would replace an input, or files that this command did not write."""
    target = folder / FOLDER
    recover_folder(target)
    check_inputs(target, inputs)
    if target.exists() and not target.is_dir():
        raise ValueError(f"{target}: is a file, and a folder of this name is to be written; move it away")
    known = written_before(folder)
    other = next((file for file in entries(target) if file.name not in known), None) if target.exists() else None
    if other is not None:
        raise not_ours(other)


def written_before(folder: Path) -> set[str]:
    """The names of the trimmed videos that an earlier run of this command wrote."""
    try:
        known = parse_json(folder, read_text(folder / "sync.json"), "")
        if str(known["manifest"]["arguments"]["command"]) != "sync":
            return set()
        return {Path(str(one["file"])).name for one in known["videos"]["cameras"].values()}
    except (ValueError, KeyError, TypeError, AttributeError):
        return set()


def drop_videos(folder: Path) -> bool:
    """Remove the trimmed videos of an earlier run, which this one does not stand for."""
    target = folder / FOLDER
    known = written_before(folder)
    if not (known and target.is_dir() and {file.name for file in entries(target)} <= known):
        return False
    shutil.rmtree(target)
    return True


PROGRESS_FRAMES = 20  # Frames from one report of progress to the next.


def write_videos(folder: Path, chosen: Trim, done: Callable[[float], None] | None = None) -> Path:
    """Write ``synchronized_videos/<camera>.mp4`` for every camera: all of them, or nothing."""
    target, total = folder / FOLDER, chosen.frames * len(chosen.cuts)
    with replacing_folder(target) as building:
        for i, cut in enumerate(chosen.cuts):
            written = 0
            try:
                for written in _encode(building / cut.file, cut, chosen.fps):
                    if done is not None and written % PROGRESS_FRAMES == 0:
                        done((i * chosen.frames + written) / total)
            except av().FFmpegError as problem:
                raise OSError(problem.errno, problem.strerror) from problem
            if written < chosen.frames:
                raise ValueError(
                    f"{cut.film.path}: reading stopped at frame {written} of {chosen.frames}; copy it again from the camera"
                )
    return target


H264_CRF = "17"  # Quality of H.264: no visible difference from 18 down, nor for a keypoint detector.
MPEG4_QSCALE = "2"  # Quality of MPEG-4, where there is no H.264.


def _encode(path: Path, cut: Cut, fps: Fraction) -> Iterator[int]:
    """Write a file frame by frame; how many are written."""
    with av().open(str(path), "w", format="mp4") as container:
        stream = add_video_stream(container, fps, H264_CRF, MPEG4_QSCALE)
        for number, frame in enumerate(_frames(cut)):
            if number == 0:
                stream.width, stream.height = frame.width, frame.height
            frame.pts, frame.time_base = number, 1 / fps
            frame.pict_type = av().video.frame.PictureType.NONE
            container.mux(stream.encode(frame))
            yield number + 1
        container.mux(stream.encode())


def _frames(cut: Cut) -> Iterator[Any]:
    """PyAV's frame of every moment, upright, of even size."""
    wanted = cut.film.stamps[cut.rows]
    close = cut.film.frame / 4
    source = read_video(cut.film.path, start=max(0.0, float(wanted[0]) - 1.0)).stored_frames()
    shape: tuple[int, int] | None = None
    here: Any = None
    made: Any = None
    ahead = next(source, None)
    for moment in wanted.tolist():
        while ahead is not None and (here is None or ahead[1] <= moment + 1e-9 or abs(ahead[1] - moment) < abs(here[1] - moment)):
            here, ahead = ahead, next(source, None)
            made = None
        if here is None or (ahead is None and abs(here[1] - moment) > max(close, 1e-3)):
            return
        if made is None:
            made = _upright(here[0], shape)
            shape = shape or (made.width, made.height)
        yield made


def _upright(frame: Any, shape: tuple[int, int] | None) -> Any:
    """A frame turned as the file asks for, of even size (a last row or column is cut), in the colours that play everywhere."""
    turned = orientation(frame)
    if turned == Orientation() and frame.width % 2 == frame.height % 2 == 0 and shape in (None, (frame.width, frame.height)):
        return frame if frame.format.name == "yuv420p" else frame.reformat(format="yuv420p")
    image = turned(frame.to_ndarray(format="rgb24"))
    image = image[: image.shape[0] // 2 * 2, : image.shape[1] // 2 * 2]
    made = av().VideoFrame.from_ndarray(np.ascontiguousarray(image), format="rgb24")
    width, height = shape or (made.width, made.height)
    return made.reformat(width, height, "yuv420p")


def trim_as_json(chosen: Trim) -> dict[str, Any]:
    """What was written, in plain types, as sync.json has it."""
    return {
        "folder": FOLDER, "frames": chosen.frames, "fps": float(chosen.fps), "start": chosen.start,
        "cameras": {cut.film.name: cut.as_json() for cut in chosen.cuts},
    }  # fmt: skip

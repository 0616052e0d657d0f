"""Flags of ``dyntorch archive add | search | find | info | verify | remove``."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from indexing.cli.flags import command
from indexing.cli.flags.shared import DASK, FOLDER, REPORT, WORKERS, Following, Reading


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

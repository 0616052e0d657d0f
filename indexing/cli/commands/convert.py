"""``dyntorch convert``: recordings in the format of another program."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

from dyntorch.numerics import with_words
from indexing.cli.console import check_file, check_folder, count, flag_words, keep, names, progress, say
from indexing.cli.flags.geometry import Convert
from indexing.cli.inputs import assumed_rate_notes, clip_notes, read_clips
from indexing.clip import Clip, ClipSet
from indexing.files import prepare, write_bytes
from indexing.opening import first_duplicate
from indexing.recordings.people import of_recording, tracked_people
from indexing.registry import format_names
from indexing.writers import encode, suffixes_with_units

WORDS = flag_words("fps", "units")
SUFFIXES = (".npz", *(f".{name}" for name in format_names("writers")))


def run(flags: Convert) -> int:
    """Read all, write all or nothing, and say what the format does not hold."""
    if not flags.recordings:
        raise ValueError("no recordings; give at least one keypoint file or folder")
    single = _single(flags)
    target = check_file(flags.output, flags.recordings) if single else check_folder(flags.output)
    suffixes = suffixes_with_units()
    if flags.units is not None and f".{flags.to or target.suffix[1:].lower()}" not in suffixes:
        raise ValueError(f"--units {flags.units}: of {' and '.join(suffixes)} only; leave it out")
    with progress("reading", steps=False):
        read = [(path, *_read(flags, path)) for path in flags.recordings]
    found, notes = [(path, clips) for path, clips, _ in read], [note for *_, said in read for note in said]
    if single and len(found) > 1 and target.suffix.lower() != ".npz":
        raise ValueError(
            f"{target}: one recording is a file, but {len(found)} are given; give a folder: --to {target.suffix[1:].lower()} "
            f"-o {target.with_suffix('')}"
        )
    parts = [(target, [clip for _, clips in found for clip in clips])] if single else _parts(flags, found, target)
    keep(flags.recordings, [path for path, _ in parts])
    with progress("writing", steps=False):
        ready = [_write(flags, clips, path) for path, clips in parts]
        prepare(target.parent if single else target)
        about: dict[str, list[str]] = {}
        for (path, _), (write, said) in zip(parts, ready, strict=True):
            write()
            for note in said:
                about.setdefault(note, []).append(path.name)
    notes += [f"{names(which)}: {note}" for note, which in about.items()]
    for note in dict.fromkeys(notes):
        say(f"note: {note}")
    size = sum(path.stat().st_size for path, _ in parts)
    where = str(target) if single else f"{target}/ ({count(len(parts), 'file')})"
    say(f"{count(sum(len(clips) for _, clips in parts), 'clip')} written to {where}, {max(1, round(size / 1000)):,} kB")
    return 0


def _single(flags: Convert) -> bool:
    """Whether the output is one file."""
    suffix = flags.output.suffix.lower()
    if suffix in SUFFIXES and not flags.output.expanduser().is_dir():
        if flags.to is not None and f".{flags.to}" != suffix:
            raise ValueError(f"--to {flags.to} and -o {flags.output} say different formats; leave --to out")
        return True
    if flags.to is None:
        raise ValueError(f"-o {flags.output}: no format ends so; end it in {', '.join(SUFFIXES)}, or say it with --to for a folder")
    return False


def _read(flags: Convert, path: Path) -> tuple[list[Clip], list[str]]:
    """The clips of a file, and what a reader should know: of a recording, those of its people."""
    clips = list(read_clips(flags.reading, path))
    notes = clip_notes(clips, flags.reading) + assumed_rate_notes(clips)
    if not of_recording(clips):
        return clips, notes
    crowd = tracked_people(clips, path.stem or path.resolve().name)
    if crowd.ghosts:
        notes.append(f"{path}: {count(sum(crowd.ghosts.values()), 'track')} left out, as of no person")
    # whoever was too short in view to be a person of a recording is still what there is to convert
    people = [who.clip.replace(meta={**who.clip.meta, "person": who.name or None}) for who in crowd.people] or clips
    if len(people) > 1:
        notes.append(f"{path}: {len(people)} people in view; --person largest takes one")
    return people, notes


def _write(flags: Convert, clips: Sequence[Clip], path: Path) -> tuple[Callable[[], object], list[str]]:
    """What writes a file, and what is not in it: a format that cannot hold the clips is found before anything is written."""
    if path.suffix.lower() == ".npz":
        whole = len(flags.recordings) == 1 or flags.to is not None
        kept = [_sharing(clip, clips, whole) for clip in clips]
        given = {key for clip in clips for key, value in clip.meta.items() if value is not None}
        lost = sorted(given - set(kept[0].meta) - {"followed", "untracked", "people"})
        notes = [f"left out, as it is not known of all: {', '.join(lost)}"] if lost else []
        return partial(ClipSet(kept, path.name).save, path), notes
    if path.suffix.lower() in suffixes_with_units():
        clips = [clip.replace(fps_assumed=False) for clip in clips]  # which was said of the recording
    try:
        data, notes = encode(clips, path, flags.units)
    except ValueError as problem:
        raise ValueError(with_words(problem, WORDS)) from None
    return partial(write_bytes, path, data), [with_words(note, WORDS) for note in notes]


def _parts(flags: Convert, found: Sequence[tuple[Path, list[Clip]]], folder: Path) -> list[tuple[Path, list[Clip]]]:
    """A file of each recording, of a set of clips one of each clip."""
    parts = []
    for path, clips in found:
        stem = path.stem or path.resolve().name
        together = len(clips) == 1 or of_recording(clips) or flags.to == "npz"
        parts += [(stem, clips)] if together else [(f"{stem}-{i + 1:04d}", [clip]) for i, clip in enumerate(clips)]
    times = Counter(stem for stem, _ in parts)
    stems = [stem if times[stem] == 1 else f"{stem}-{i + 1}" for i, (stem, _) in enumerate(parts)]
    twice = first_duplicate(stems)
    if twice is not None:
        raise ValueError(f"{folder}: two recordings would be {twice}.{flags.to}; rename one, or convert them one by one")
    return [(folder / f"{stem}.{flags.to}", clips) for stem, (_, clips) in zip(stems, parts, strict=True)]


def _sharing(clip: Clip, clips: Sequence[Clip], whole: bool) -> Clip:
    """The clip with what is known of all of them, as a clip set has a column for each field."""
    fields = [key for key in clip.meta if all(other.meta.get(key) is not None for other in clips)]
    kept = fields if whole and "person" in fields else [key for key in fields if key not in ("followed", "untracked", "people")]
    return clip.replace(meta={key: clip.meta[key] for key in kept})

"""Videos: the people in them are found by a pose model (:mod:`indexing.pose`), where one is there."""

from __future__ import annotations

import numpy as np

from indexing.clip import ClipSet
from indexing.opening import error
from indexing.readers.files import Options, Source, WatchOptions
from indexing.readers.recording import NobodySeen, merge_people, to_clips


def read_video(source: Source, options: Options) -> ClipSet:
    """Find the people in a video; ``person`` says who of them is meant, as for files of keypoints."""
    from indexing.pose import available, detect
    from indexing.pose.models import FETCH

    if options.size is not None:
        raise error(source.path, "size= does not apply to a video", "leave size out")
    if available() is None:
        raise error(source.path, "is a video, and there is no pose model to find the people in it", f"{FETCH}, or give keypoints")
    how = options.watching or WatchOptions()
    found = merge_people(detect(source.path, how.people, model=how.model, every=how.every, fps=options.fps).clips)
    if found is None:
        raise NobodySeen(source.path, np.zeros(0, dtype=np.int64))
    return to_clips(source.path, found, options)

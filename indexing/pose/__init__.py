"""Videos to keypoints: people found and followed by BlazePose, offline and not smoothed.  Needs the extra ``pose`` and model files.

The files are, in the order of the work: :mod:`~indexing.pose.models` (the model files, and how they are fetched),
:mod:`~indexing.pose.networks` (their runtime), :mod:`~indexing.pose.blazepose` (regions of a picture, and what the networks say of
them), :mod:`~indexing.pose.tracking` (people from frame to frame, and who is who), :mod:`~indexing.pose.chunks` (long videos),
:mod:`~indexing.pose.detection` (the verb) and :mod:`~indexing.pose.writing` (keypoint files).
"""

from __future__ import annotations

from indexing.pose.detection import Detected as Detected
from indexing.pose.detection import NobodyInVideo as NobodyInVideo
from indexing.pose.detection import detect as detect
from indexing.pose.models import available as available
from indexing.pose.models import get_models as get_models
from indexing.pose.tracking import PoseOptions as PoseOptions
from indexing.pose.writing import KeypointFile as KeypointFile
from indexing.pose.writing import keypoint_file as keypoint_file

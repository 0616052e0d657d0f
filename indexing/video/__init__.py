"""Videos: reading, point tracks, camera motion, and a video to check a synchronization by.  Needs the extra ``video``."""

from __future__ import annotations

from indexing.video.drawing import write_check_video as write_check_video
from indexing.video.motion import CameraMotion as CameraMotion
from indexing.video.motion import Move as Move
from indexing.video.motion import camera_motion as camera_motion
from indexing.video.motion import stabilize as stabilize
from indexing.video.reading import Chunk as Chunk
from indexing.video.reading import Video as Video
from indexing.video.reading import VideoInfo as VideoInfo
from indexing.video.reading import probe as probe
from indexing.video.reading import read_video as read_video
from indexing.video.scene import SceneTrackOptions as SceneTrackOptions
from indexing.video.scene import SceneTracks as SceneTracks
from indexing.video.scene import track_scene as track_scene
from indexing.video.scene import track_whole as track_whole
from indexing.video.sequence import PictureSequence as PictureSequence
from indexing.video.tracks import Tracks as Tracks
from indexing.video.tracks import track_points as track_points

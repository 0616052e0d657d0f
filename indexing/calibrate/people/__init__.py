"""Who is who in several cameras that nobody calibrated.

``association`` holds the verb and its stages in order; ``tracklets`` splits the tracks of one camera and clusters tracklets,
``pair_geometry`` estimates clock and epipolar geometry of two cameras, ``assignment`` assigns the tracklets of all cameras to
people, ``result`` is what is returned.
"""

from __future__ import annotations

from indexing.calibrate.people.association import associate as associate
from indexing.calibrate.people.result import Association as Association
from indexing.calibrate.people.result import PeopleNotice as PeopleNotice
from indexing.calibrate.people.result import TrackExchange as TrackExchange

__all__ = ["Association", "PeopleNotice", "TrackExchange", "associate"]

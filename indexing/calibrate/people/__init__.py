"""Who is who in several cameras that nobody calibrated.

``association`` holds the verb, its stages in order and its result; ``tracklets`` splits the tracks of one camera and clusters
tracklets, ``pair_geometry`` estimates clock and epipolar geometry of two cameras, ``assignment`` assigns the tracklets of all
cameras to people.
"""

from __future__ import annotations

from indexing.calibrate.people.assignment import PeopleNotice as PeopleNotice
from indexing.calibrate.people.association import Association as Association
from indexing.calibrate.people.association import TrackExchange as TrackExchange
from indexing.calibrate.people.association import associate as associate

__all__ = ["Association", "PeopleNotice", "TrackExchange", "associate"]

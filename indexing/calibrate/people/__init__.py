"""Who is who in several cameras that nobody calibrated.

``association`` holds the verb and its stages in order; ``tracklets`` cuts the tracks of one camera, ``relations`` finds clock and
epipolar geometry of two cameras and what they say about two pieces, ``clusters`` sorts pieces into people, ``result`` is what
is returned.  ``options`` has every number that decides.
"""

from __future__ import annotations

from indexing.calibrate.people.association import associate as associate
from indexing.calibrate.people.options import AssociationOptions as AssociationOptions
from indexing.calibrate.people.result import Association as Association
from indexing.calibrate.people.result import PeopleNotice as PeopleNotice
from indexing.calibrate.people.result import TrackExchange as TrackExchange

__all__ = ["Association", "AssociationOptions", "PeopleNotice", "TrackExchange", "associate"]

"""What people mark in recordings, and what was found there: files of BORIS, ELAN, Label Studio, VIA, ActivityNet, and tables.

``label`` is what all share (:class:`Label`, :class:`LabelFile`, :func:`within`), ``reading`` and ``writing`` are the verbs,
``detect`` asks the formats whose a file is.  A format is a file or room in ``formats/`` and registers itself there as
``format.LabelFormat``.  ``media`` knows which file of the labels is which recording and whose clock runs when, ``markup`` reads
XML that may be hostile.
"""

from __future__ import annotations

from indexing.labels.label import Label as Label
from indexing.labels.label import LabelFile as LabelFile
from indexing.labels.label import within as within
from indexing.labels.reading import choose_labels as choose_labels
from indexing.labels.reading import open_labels as open_labels
from indexing.labels.reading import read_labels as read_labels
from indexing.labels.writing import write_labels as write_labels

__all__ = [
    *("Label", "LabelFile", "choose_labels", "open_labels", "read_labels", "within", "write_labels"),
]

"""ELAN: ``reading`` reads tiers, ``times`` gives their annotations times, ``writing`` puts tiers into a file."""

from __future__ import annotations

from indexing.labels.format import LabelFormat
from indexing.labels.formats.elan.reading import read
from indexing.labels.formats.elan.writing import write

FORMAT = LabelFormat("an ELAN .eaf", ("xml",), read, write=write, written={"elan": ".eaf"}, program="ELAN")

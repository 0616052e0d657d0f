"""One file a format that is written: it declares ``FORMAT`` (:class:`indexing.writers.markers.Writer`); its name is the suffix."""

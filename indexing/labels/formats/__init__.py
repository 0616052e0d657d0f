"""One file or room a format of labels: it declares ``FORMAT`` (:class:`indexing.labels.format.LabelFormat`)."""

"""One file or room a format of labels: it declares ``FORMAT`` (:class:`indexing.labels.label.LabelFormat`)."""

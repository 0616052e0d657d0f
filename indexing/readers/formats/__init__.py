"""One file a format of keypoints: it declares ``FORMAT`` (:class:`indexing.readers.files.Format`), and its name is the format's."""

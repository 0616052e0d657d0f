"""segment_tracks: bodies through a whole video, from tracks of which many are short.

``segment_tracks`` says the stages in order: ``frames`` chooses the pairs of frames that are compared, ``preferences`` finds which
tracks move alike, ``merging`` cuts them into pieces and joins these to bodies, which ``exchange`` pieces if their number is known,
``descent`` improves labels and geometries together, ``choosing`` takes the best, ``labels`` says what belongs to no body and which
body rests.
"""

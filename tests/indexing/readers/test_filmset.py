"""Film sets: frames in place of joints, everything else as in a clip set."""

from __future__ import annotations

import numpy as np
import pytest

from indexing.readers.formats.clipset import FilmSet, holds_frames, read_film_set

FRAMES = np.arange(9 * 4 * 5, dtype=np.uint8).reshape(9, 4, 5)
WHOLE = {"frames": FRAMES, "offsets": [0, 4, 9], "action": [1, 0], "action_names": ["run", "sit"], "subject": [7, 8], "fps": 10.0}


def test_what_is_written_is_read(tmp_path):
    np.savez(tmp_path / "films.npz", **WHOLE)
    films = read_film_set(tmp_path / "films.npz")
    assert isinstance(films, FilmSet) and films.labels.tolist() == ["sit", "run"]
    assert np.array_equal(films[1].frames, FRAMES[4:]) and films[1].times.tolist() == pytest.approx([0, 0.1, 0.2, 0.3, 0.4])
    assert [film.label for film in films.select(subject=8)] == ["run"]
    assert films.fields == ("subject",) and films[0].duration == pytest.approx(0.3)


def test_times_and_frame_numbers_start_at_zero_in_every_film(tmp_path):
    np.savez(tmp_path / "a.npz", **WHOLE, frame=[3, 4, 6, 7, 0, 1, 2, 3, 5])
    films = read_film_set(tmp_path / "a.npz")
    assert films[0].times.tolist() == pytest.approx([0, 0.1, 0.3, 0.4])


def test_frames_are_told_from_joints(tmp_path):
    np.savez(tmp_path / "films.npz", **WHOLE)
    np.savez(tmp_path / "clips.npz", joints=np.ones((4, 3, 2)))
    (tmp_path / "broken.npz").write_bytes(b"PK nothing")
    found = [holds_frames(tmp_path / name) for name in ("films.npz", "clips.npz", "broken.npz", "absent.npz")]
    assert found == [True, False, False, False]


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"frames": FRAMES.astype(float)}, "uint8"),
        ({"frames": FRAMES[0]}, "3 dimensions"),
        ({"offsets": [0, 4, 8]}, "frames has 9 frames"),
        ({"action": [0]}, "action has 1 values for 2"),
        ({"fps": 0.0}, "fps must be positive"),
    ],
)
def test_bad_sets_are_refused(tmp_path, change, says):
    np.savez(tmp_path / "films.npz", **(WHOLE | change))
    with pytest.raises(ValueError, match=says) as caught:
        read_film_set(tmp_path / "films.npz")
    assert "films.npz" in str(caught.value)

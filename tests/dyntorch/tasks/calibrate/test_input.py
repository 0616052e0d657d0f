"""What is wrong with what is given, said in one line with its argument and its camera."""

import pytest
import torch

import dyntorch as dyn
from tests.dyntorch.tasks.calibrate.rigs import F64, Motion, filmed

TAKE = filmed(Motion(), cameras=3, frames=40)
K = torch.tensor([[1500.0, 0, 960], [0, 1500, 540], [0, 0, 1]], dtype=F64)


def with_first(change):
    return [change(TAKE.tracks[0]), *TAKE.tracks[1:]]


WRONG = {
    "one camera": ({"tracks": TAKE.tracks[:1]}, r"tracks: 1 cameras given; give 2 to 8"),
    "nine cameras": ({"tracks": [x + k for k in range(9) for x in TAKE.tracks[:1]]}, r"tracks: 9 cameras given; give 2 to 8"),
    "other points": ({"tracks": with_first(lambda x: x[:, :5])}, r"tracks: cameras have \[5, 8\] points; give the same points"),
    "twins": ({"tracks": [TAKE.tracks[0], TAKE.tracks[1], TAKE.tracks[0]]}, r"tracks: cameras 0 and 2 are the same recording"),
    "no points": ({"tracks": [x[:, :0] for x in TAKE.tracks]}, r"camera 0: .*no points"),
    "three axes": ({"tracks": with_first(lambda x: x[0])}, r"camera 0: .*tracks\[0\]"),
    "nothing seen": ({"tracks": with_first(lambda x: x * torch.nan)}, r"camera 0: .*seen"),
    "shares": ({"tracks": [x / 2000 for x in TAKE.tracks]}, r"camera 0: points lie between 0 and 1"),
    "other size": ({"sizes": (640, 360)}, r"camera \d: sizes say 640x360 px, but points lie from \["),
    "no sizes": ({"sizes": None}, r"sizes: give the width and height"),
    "size of zero": ({"sizes": (1920, 0)}, r"sizes must be .*got \(1920, 0\)"),
    "two sizes": ({"sizes": [(1920, 1080)] * 2}, r"sizes must be"),
    "text size": ({"sizes": "1920x1080"}, r"sizes must be .*1920x1080"),
    "fps of zero": ({"fps": 0.0}, r"fps of camera 0 must be a positive number, got 0.0"),
    "no fps": ({"fps": None}, r"fps: give frames per second"),
    "two fps": ({"fps": [30.0, 25.0]}, r"fps: 2 values for 3 cameras"),
    "negative focal": ({"focal": [1500.0, -1.0, None]}, r"focal of camera 1 must be a positive number, got -1.0"),
    "two focals": ({"focal": [1500.0, 1400.0]}, r"focal: 2 values for 3 cameras"),
    "focal and lens": ({"focal": 1500.0, "calibration": [(K, None), None, None]}, r"focal of camera 0 is given twice"),
    "two lenses": ({"calibration": [(K, None)] * 2}, r"calibration: 2 values for 3 cameras"),
    "half a lens": ({"calibration": [None, (K[:2], None), None]}, r"camera 1: "),
    "two clocks": ({"clocks": [0.0, 0.1]}, r"clocks: give 3 offsets in seconds"),
    "a clock of nothing": ({"clocks": [0.0, float("nan"), 0.0]}, r"clocks: give 3 offsets"),
    "a clock that stands": ({"clocks": [[0.0, 1.0], [0.0, 0.0], [0.0, 1.0]]}, r"clocks: give 3 offsets"),
    "never together": ({"clocks": [0.0, 100.0, 200.0]}, r"tracks: no two cameras run at the same time"),
    "height of zero": ({"height": 0.0}, r"height must be a positive number of metres, got 0.0"),
    "height and lengths": ({"height": 1.7, "lengths": {(0, 1): 0.4}}, r"height and lengths both fix the scale"),
    "a length of one point": ({"lengths": {(1, 1): 0.4}}, r"lengths: \(1, 1\) are not two different points"),
    "a length of no point": ({"lengths": {(1, 8): 0.4}}, r"lengths: \(1, 8\) are not two different points out of 0..7"),
    "a length of zero": ({"lengths": {(1, 2): 0.0}}, r"lengths: the distance of points \(1, 2\) must be"),
    "weights below zero": ({"weights": [-torch.ones(40, 8)] * 3}, r"camera 0: weights of tracks\[0\] must be .*not negative"),
    "other weights": ({"weights": [torch.ones(40, 7)] * 3}, r"camera 0: weights of tracks\[0\]"),
    "times that go back": ({"times": [-t for t in TAKE.times]}, r"camera 0: times of .* must increase"),
    "fewer times": ({"times": [t[:-1] for t in TAKE.times]}, r"camera 0: times of .*40"),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", WRONG)
def test_bad_input_is_one_clear_line(name):
    change, said = WRONG[name]
    given = {"tracks": TAKE.tracks, "fps": 30.0, "sizes": (1920, 1080), "clocks": [0.0] * 3, **change}
    with pytest.raises(ValueError, match=said) as caught:
        dyn.calibrate(given.pop("tracks"), **given)
    assert "\n" not in str(caught.value) and len(str(caught.value)) < 400

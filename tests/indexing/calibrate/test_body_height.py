"""Heights: as lengths between the joints of a body that stands, and what is said of those that are none."""

from __future__ import annotations

import numpy as np
import pytest

from indexing.actors import Person, perform
from indexing.calibrate.priors import check_height, standing_extent
from indexing.skeleton import BODY25, BODY25B, COCO17, HAND21, MEDIAPIPE33


def test_the_extent_is_that_of_winters_table():
    assert standing_extent(COCO17.joints, 2.0).extent == pytest.approx(2.0 * (0.936 - 0.039))
    assert standing_extent(BODY25B.joints, 1.8).extent == pytest.approx(1.8 * (1.0 - 0.01)) and standing_extent(
        BODY25B.joints, 1.8
    ).tops == ("head_top",)
    assert standing_extent(MEDIAPIPE33.joints, 1.8).bottoms == ("left_foot_index", "right_foot_index")
    no_face = [joint for joint in COCO17.joints if "shoulder" in joint or "ankle" in joint]
    assert standing_extent(no_face, 1.0).extent == pytest.approx(0.818 - 0.039) and standing_extent(no_face, 1.0).sigma > 0.01
    assert standing_extent(["LAnkle", "REye", "hip"], 1.7).tops == ("REye",)
    for layout in (COCO17, BODY25):
        one = standing_extent(layout.joints, 1.75)
        assert 0.005 < one.sigma / one.extent < 0.025 and f"{one.height:g} m" in one.note and "Drillis" in one.note


def test_a_body_that_stands_has_about_this_extent():
    """Synthetic people are built from lengths of their own: head to ankle within a few percent of the table."""
    solid = perform("wave", Person(), fps=30.0, rng=0)
    tall = np.ptp(solid.joints[0, :, 1])
    assert standing_extent(COCO17.joints, 1.7).extent == pytest.approx(tall, rel=0.12)


@pytest.mark.parametrize(
    ("height", "said"),
    [
        (0.0, "got 0"), (17.0, "got 17"), (-1.7, "got -1.7"), (float("nan"), "got nan"),
        (175.0, "got 175; in centimetres? give 1.75"),
        (1750.0, "got 1750; in millimetres? give 1.75"), (5.9, "got 5.9; in feet? give 1.8"),
        (69.0, "got 69; in inches? give 1.75"),
    ],
)  # fmt: skip
def test_no_height_of_a_person(height, said):
    with pytest.raises(ValueError, match="height must be that of a standing person in metres") as problem:
        check_height(height)
    assert str(problem.value).endswith(said)


def test_joints_that_no_height_says_anything_of():
    with pytest.raises(ValueError, match="do not reach from the head or the shoulders to the feet"):
        standing_extent(HAND21.joints, 1.75)
    with pytest.raises(ValueError, match="do not reach"):
        standing_extent((), 1.75)

"""The phase of a step against legs that swing as a cosine."""

import numpy as np

from experiments.recognition.gait_data import step_phase


def test_phase_of_a_step_is_that_of_the_ankles():
    seconds = np.arange(240) / 60
    joints = np.zeros((240, 31, 3))
    joints[:, 1, 0], joints[:, 2, 0] = 0.1, -0.1  # hips: left is at +x, so ahead is +z
    joints[:, 7, 2] = joints[:, 11, 2] = 0.1  # toes before feet
    lead = 0.3 * np.cos(2 * np.pi * (seconds / 1.1 + 0.15))
    joints[:, 5, 2], joints[:, 9, 2] = lead, -lead
    phase = step_phase(joints + np.array([0.0, 0.0, 1.2]) * seconds[:, None, None])
    off = (phase - seconds / 1.1 - 0.15 + 0.5) % 1 - 0.5
    assert np.isnan(phase).sum() < 40
    assert np.nanmax(np.abs(off)) < 0.01


def test_somebody_who_stands_has_no_phase():
    joints = np.zeros((50, 31, 3))
    joints[:, 1, 0], joints[:, 2, 0], joints[:, 7, 2] = 0.1, -0.1, 0.1
    joints[:, 5, 2] = 0.3
    assert np.isnan(step_phase(joints)).all()

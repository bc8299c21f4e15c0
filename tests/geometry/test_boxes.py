"""Boxes: overlap within a horizon."""

import numpy as np
import pytest

from drivax.geometry.boxes import overlap, overlap_within, time_to_overlap


@pytest.fixture(scope="module")
def pairs():
    """Random boxes and velocities, 4,000 pairs without relative motion."""
    rng, count = np.random.default_rng(0), 40_000

    def boxes():
        heading = rng.uniform(-4, 4, count)
        x, y = rng.uniform(-15, 15, (2, count))
        length, width = rng.uniform(0.5, 12, count), rng.uniform(0.4, 3, count)
        return np.stack([x, y, np.cos(heading), np.sin(heading), length, width], axis=1)

    a, b = boxes(), boxes()
    velocity_a, velocity_b = rng.uniform(-12, 12, (2, count, 2))
    velocity_a[:4000] = velocity_b[:4000]
    return a, velocity_a, b, velocity_b


@pytest.mark.parametrize("horizon_s", (0.9, 3.0))
def test_boxes_overlap_within_a_horizon_if_the_time_to_overlap_is_shorter(pairs, horizon_s):
    expected = time_to_overlap(*pairs, horizon_s) < horizon_s
    assert 0.05 < expected.mean() < 0.5
    assert np.array_equal(overlap_within(*pairs, horizon_s), expected)


def test_corners_that_touch_in_passing_overlap_within_a_horizon_only():
    box = np.array([0.0, 0.0, 1.0, 0.0, 2.0, 2.0])
    # On its way along (1, 1) the centre passes (2, -2), where the corner (1, -1) touches.
    other = np.array([0.0, -4.0, 1.0, 0.0, 2.0, 2.0])
    motion = box, np.zeros(2), other, np.ones(2), 5.0
    assert overlap_within(*motion)
    assert time_to_overlap(*motion) == 5.0


def test_overlap_within_no_time_is_overlap(pairs):
    a, _, b, _ = pairs
    assert np.array_equal(overlap_within(*pairs, 0.0), overlap(a, b))

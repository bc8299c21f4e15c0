from __future__ import annotations

import numpy as np
import pytest

from drivax.synthetic.expert.candidates import (
    SPACING_M,
    Shift,
    candidate_boxes,
    candidate_corners,
    shift_path,
)
from drivax.synthetic.roads.curves import Pose, join_curves, resample, straight, turn

from .oracles import distance_to_polyline
from .staged_scenes import CAR, road, scene


def bend():
    first = straight(Pose(0.0, 0.0, 0.0), 60.0)
    arc = turn(first.end, np.pi / 2, 20.0)
    return resample(join_curves(first, arc, straight(arc.end, 100.0)), 0.5)


@pytest.mark.parametrize(
    "shift", [Shift(), Shift(3.0, 5.0, 25.0, 40.0, 60.0), Shift(-1.0, 0.0, 12.0, 30.0, 50.0)]
)
@pytest.mark.parametrize("pose", [Pose(30.0, 0.0, 0.0), Pose(31.3, 0.8, 0.06), Pose(29.0, -1.1, -0.1)])
def test_candidate_starts_at_ego_with_tangent_headings(shift, pose):
    roles, _ = scene(road(turn=bend()), 8.0)
    candidate = shift_path(roles.paths[0], roles.drivers, pose, 30.0, 110.0, shift)
    assert np.hypot(*(candidate.xy[0] - [pose.x, pose.y])) < 0.03
    assert candidate.heading[0] == pytest.approx(pose.heading, abs=0.01)
    chords = np.diff(candidate.xy, axis=0)
    assert np.allclose(np.hypot(*chords.T), SPACING_M, atol=0.003)
    middle = (candidate.heading[1:] + candidate.heading[:-1]) / 2
    turned = np.arctan2(chords[:, 1], chords[:, 0]) - middle
    assert np.abs((turned + np.pi) % (2 * np.pi) - np.pi).max() < 0.01


def test_shifted_candidate_has_its_offset_and_returns():
    roles, _ = scene(road(turn=bend()), 8.0)
    shift = Shift(3.0, 5.0, 25.0, 40.0, 60.0)
    candidate = shift_path(roles.paths[0], roles.drivers, Pose(30.0, 0.0, 0.0), 30.0, 110.0, shift)
    gap = distance_to_polyline(candidate.xy, roles.paths[0].curve.xy)
    assert np.allclose(gap[(candidate.base_m > 26) & (candidate.base_m < 39)], 3.0, atol=0.02)
    assert gap[(candidate.base_m < 5) | (candidate.base_m > 60)].max() < 0.02
    assert np.all(np.diff(candidate.base_m) > 0)
    # Only the part that is not on the path is checked against the edges: 4 corners each metre.
    assert len(candidate_corners(candidate, np.array(CAR))) == pytest.approx(4 * 59, abs=12)
    assert candidate_boxes(candidate, np.array(CAR)).shape == (len(candidate.xy), 6)


def test_bends_bound_the_speed():
    roles, _ = scene(road(turn=bend()), 8.0)
    candidate = shift_path(roles.paths[0], roles.drivers, Pose(30.0, 0.0, 0.0), 30.0, 110.0, Shift())
    curvature = np.abs(np.gradient(candidate.heading, SPACING_M)).max()
    assert candidate.limit_mps.min() == pytest.approx(
        min((4.2 / curvature) ** 0.5, 0.8 / curvature), rel=0.05
    )
    driver = roles.drivers.lateral_mps2[0]
    assert candidate.preferred_mps.min() == pytest.approx((driver / curvature) ** 0.5, rel=0.05)
    assert np.all(candidate.preferred_mps <= candidate.limit_mps + 1e-9)

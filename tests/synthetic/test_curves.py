from __future__ import annotations

import math

import numpy as np
import pytest

from drivax.synthetic.roads.curves import (
    STEP_M,
    Curve,
    Pose,
    connect_poses,
    draw_winding_curve,
    from_curvature,
    gradient,
    join_curves,
    quintic,
    resample,
    smooth_step,
    straight,
    turn,
)


def tangent_error(curve: Curve) -> float:
    """Largest difference between stored headings (mean of two samples) and the directions of the chords, rad."""
    chord = np.arctan2(*np.diff(curve.xy, axis=0).T[::-1])
    middle = (curve.heading[1:] + curve.heading[:-1]) / 2
    return float(np.abs((chord - middle + math.pi) % (2 * math.pi) - math.pi).max())


def test_constant_curvature_is_a_circle():
    curve = from_curvature(np.full(201, 0.05), 0.1, Pose(3.0, -2.0, 0.7))
    centre = np.array([3.0 - 20 * math.sin(0.7), -2.0 + 20 * math.cos(0.7)])
    assert np.hypot(*(curve.xy - centre).T) == pytest.approx(20.0, abs=1e-3)
    assert curve.heading[-1] == pytest.approx(0.7 + 20.0 * 0.05)


@pytest.mark.parametrize("angle", [-2.0, -math.pi / 2, -0.5, 0.4, 1.2, math.pi / 2, 1.9])
def test_turn_ends_one_tangent_beyond_the_corner(angle):
    start = Pose(1.0, 2.0, 0.3)
    curve = turn(start, angle, 12.0)
    corner = start.ahead(12.0)
    end = Pose(corner.x, corner.y, 0.3 + angle).ahead(12.0)
    assert np.hypot(curve.end.x - end.x, curve.end.y - end.y) < 0.01
    assert curve.end.heading == pytest.approx(end.heading, abs=1e-3)
    assert tangent_error(curve) < 0.005
    steps = np.diff(curve.arc_m)
    assert steps.max() <= STEP_M + 1e-6 and np.ptp(steps) < 0.01


@pytest.mark.parametrize("end", [Pose(30.0, 12.0, 1.3), Pose(14.0, -25.0, -1.7), Pose(40.0, 2.0, 0.2)])
def test_connecting_curves_meet_their_poses_smoothly(end):
    curve = connect_poses(Pose(0.0, 0.0, 0.0), end)
    assert np.hypot(*curve.xy[0]) < 1e-6
    assert np.hypot(curve.end.x - end.x, curve.end.y - end.y) < 0.01
    assert curve.end.heading == pytest.approx(end.heading, abs=2e-3)
    assert tangent_error(curve) < 0.01
    # No kink: neighbouring headings differ by what a radius of 6 m needs at most.
    assert np.abs(np.diff(curve.heading)).max() < STEP_M / 6


def test_poses_without_a_single_bend_are_refused():
    with pytest.raises(ValueError, match="no single bend"):
        connect_poses(Pose(0.0, 0.0, 0.0), Pose(-10.0, 5.0, math.pi / 2))


def test_quintic_has_zero_curvature_at_its_ends():
    curve = quintic(Pose(0.0, 0.0, 0.0), Pose(60.0, 3.5, 0.0))
    lateral = curve.xy[:, 1]
    t = curve.xy[:, 0] / 60
    assert np.allclose(lateral, 3.5 * (10 * t**3 - 15 * t**4 + 6 * t**5), atol=0.02)
    curvature = np.gradient(curve.heading, curve.arc_m)
    assert abs(curvature[0]) < 1e-3 and abs(curvature[-1]) < 1e-3
    # Peak curvature of the quintic step: 10 / sqrt(3) * height / length^2.
    assert np.abs(curvature).max() == pytest.approx(10 / math.sqrt(3) * 3.5 / 3600, rel=0.05)


def test_joined_curves_share_points_and_unwrap_headings():
    a = straight(Pose(0.0, 0.0, 3.1), 5.0)
    b = straight(Pose(a.end.x, a.end.y, 3.1 - 2 * math.pi), 5.0)
    both = join_curves(a, b)
    assert len(both.xy) == len(a.xy) + len(b.xy) - 1
    assert np.ptp(both.heading) < 1e-9
    assert both.arc_m[-1] == pytest.approx(10.0)


def test_shifted_and_reversed_curves():
    curve = from_curvature(np.full(101, 0.02), 0.5, Pose(0.0, 0.0, 0.0))
    left = curve.parallel(3.0)
    assert np.hypot(*(left.xy - curve.xy).T) == pytest.approx(3.0)
    assert left.arc_m[-1] == pytest.approx(50.0 * (1 - 3 * 0.02), rel=1e-3)
    back = left.reverse()
    assert np.array_equal(back.xy[0], left.xy[-1])
    assert math.cos(back.heading[0] - left.heading[-1]) == pytest.approx(-1.0)


def test_resampled_curves_keep_ends_and_spacing():
    original = from_curvature(np.full(77, 0.03), 0.33, Pose(0.0, 0.0, 1.0))
    curve = resample(original, 0.5)
    assert curve.xy[[0, -1]] == pytest.approx(original.xy[[0, -1]])
    steps = np.diff(curve.arc_m)
    assert np.ptp(steps) < 1e-3 and abs(steps.mean() - 0.5) < 0.01


@pytest.mark.parametrize("seed", range(5))
def test_winding_roads_keep_curvature_and_turn_limits(seed):
    rng = np.random.default_rng(seed)
    curve = draw_winding_curve(rng, 400.0, max_curvature=1 / 35, max_turn=2.0, start=Pose(0.0, 0.0, 0.0))
    assert np.ptp(curve.heading) <= 2.0 + 1e-9
    assert np.abs(np.diff(curve.heading)).max() <= STEP_M / 35 + 1e-9
    assert curve.arc_m[-1] == pytest.approx(400.0, abs=0.6)
    # Between knots at least 35 m apart curvature changes by at most 2 / 35.
    assert np.abs(np.diff(curve.heading, 2)).max() < STEP_M**2 * (2 / 35) / 35 * 1.01


def test_displaced_curve_has_exact_distance_and_tangent():
    # On a circle of radius 40 m a displacement of 3 m to the left of a left turn gives a circle of 37 m.
    angle = np.linspace(0.0, 1.5, 241)
    circle = Curve(40.0 * np.stack([np.cos(angle), np.sin(angle)], axis=-1), angle + math.pi / 2)
    inner = circle.offset_by(np.full(len(angle), 3.0))
    assert np.hypot(*inner.xy.T) == pytest.approx(37.0)
    assert inner.heading == pytest.approx(circle.heading)
    # A growing displacement turns the heading: it is the direction of the chords, and left stays left.
    bent = circle.offset_by(3.5 * smooth_step(np.linspace(0.0, 1.0, len(angle))))
    chords = np.diff(bent.xy, axis=0)
    middle = (bent.heading[1:] + bent.heading[:-1]) / 2
    assert np.unwrap(np.arctan2(chords[:, 1], chords[:, 0])) == pytest.approx(middle, abs=2e-3)
    assert np.hypot(*bent.xy[-1]) == pytest.approx(36.5)


def test_smooth_step_has_no_slope_or_curvature_at_its_ends():
    share = np.array([-1.0, 0.0, 0.5, 1.0, 2.0])
    assert smooth_step(share) == pytest.approx([0.0, 0.0, 0.5, 1.0, 1.0])
    h = 1e-3
    near = smooth_step(np.array([h, 2 * h, 1 - h, 1 - 2 * h]))
    # Third order at both ends: 10 h^3.
    assert near == pytest.approx([10 * h**3, 80 * h**3, 1 - 10 * h**3, 1 - 80 * h**3], abs=2e-10 * 8)


def test_poses_move_ahead_and_aside_and_turn():
    pose = Pose(1.0, 2.0, math.pi / 2)
    assert pose.ahead(3.0).y == pytest.approx(5.0) and pose.ahead(3.0).x == pytest.approx(1.0)
    assert pose.shift_left(3.0).x == pytest.approx(-2.0) and pose.shift_left(3.0).y == pytest.approx(2.0)
    back = pose.reverse()
    assert (back.x, back.y) == (1.0, 2.0) and math.cos(back.heading - pose.heading) == pytest.approx(-1.0)


@pytest.mark.parametrize("count", [2, 3, 40])
def test_gradient_has_the_bits_of_numpy(count):
    rng = np.random.default_rng(count)
    values, steps = rng.normal(size=count), rng.uniform(0.1, 1.0, count)
    for position in (np.cumsum(steps), 0.5 * np.arange(count)):
        assert np.array_equal(gradient(values, position), np.gradient(values, position))

from __future__ import annotations

import numpy as np
import pytest
import shapely

from drivax.geometry.boxes import corners
from drivax.scenario.recording import Tracks
from drivax.synthetic.expert.violations import first_overlap_step
from drivax.synthetic.sensing import (
    NoiseConfig,
    SensorConfig,
    add_perception_noise,
    find_visible,
    largest_shift_m,
)

SENSOR = SensorConfig()


def boxes(*rows):
    """One step of (x, y, heading, length, width) per user."""
    table = np.array(rows, dtype=np.float64)
    heading = table[:, 2]
    return np.stack(
        [table[:, 0], table[:, 1], np.cos(heading), np.sin(heading), table[:, 3], table[:, 4]], axis=-1
    )[:, None]


def look(rows, heights, blocks=None, config=SENSOR):
    box = boxes(*rows)
    valid = np.ones(box.shape[:2], bool)
    mask = np.ones(len(rows), bool) if blocks is None else np.array(blocks)
    return find_visible(box, np.array(heights, dtype=np.float64), valid, mask, config)[:, 0].tolist()


EGO = (0.0, 0.0, 0.0, 4.6, 1.9)


def test_vans_hide_pedestrians_unless_masked():
    van, pedestrian = (10.0, 0.0, 0.0, 5.0, 2.0), (15.0, 0.0, 0.0, 0.6, 0.6)
    assert look([EGO, van, pedestrian], [1.5, 2.4, 1.75]) == [True, True, False]
    assert look([EGO, van, pedestrian], [1.5, 2.4, 1.75], [True, False, True]) == [True, True, True]
    # 3 m to the side the van does not hide it.
    assert look([EGO, van, (15.0, 3.0, 0.0, 0.6, 0.6)], [1.5, 2.4, 1.75]) == [True, True, True]


def test_low_roofs_do_not_occlude():
    """The eye is 1.7 m up; the ray to half a truck's height (1.75 m) rises, so a roof of 1.5 m is below it."""
    car, truck = (10.0, 0.0, 0.0, 4.6, 1.9), (40.0, 0.0, 0.0, 8.0, 1.9)
    assert look([EGO, car, truck], [1.5, 1.5, 3.5]) == [True, True, True]
    assert look([EGO, car, truck], [1.5, 1.8, 3.5]) == [True, True, False]
    # The ray to half a car's height, 0.75 m at 40 m, is at 1.5 m 8.4 m away: a roof of 1.4 m there is passed ...
    assert look([EGO, (6.0, 0.0, 0.0, 4.0, 1.9), (42.0, 0.0, 0.0, 4.6, 1.9)], [1.5, 1.4, 1.5])[2]
    # ... and one of 1.5 m at 12 m is not.
    assert not look([EGO, (12.0, 0.0, 0.0, 4.0, 1.9), (42.0, 0.0, 0.0, 4.6, 1.9)], [1.5, 1.5, 1.5])[2]


def test_range_is_to_the_centre_and_invalid_users_are_not_visible():
    rows = [EGO, (79.9, 0.0, 0.0, 4.6, 1.9), (0.0, 80.1, 0.0, 4.6, 1.9)]
    assert look(rows, [1.5, 1.5, 1.5]) == [True, True, False]
    assert look(rows, [1.5, 1.5, 1.5], config=SensorConfig(range_m=100.0))[2]
    valid = np.array([[True, True, False], [True, False, True]])
    box = np.repeat(boxes(*rows[:2]), 3, axis=1)
    is_visible = find_visible(box, np.array([1.5, 1.5]), valid, np.ones(2, bool), SENSOR)
    assert is_visible.tolist() == [[True, True, False], [True, False, False]]


@pytest.mark.parametrize("seed", range(4))
def test_visibility_agrees_with_shapely_in_crowds(seed):
    """Brute force with shapely; every blocker is a wall here, so that heights do not matter."""
    rng = np.random.default_rng(seed)
    users, steps = 25, 4
    heading = rng.uniform(-np.pi, np.pi, (users, steps))
    size = rng.uniform([0.6, 0.6], [12.0, 2.6], (users, steps, 2))[:, :1].repeat(steps, axis=1)
    xy = rng.uniform(-60, 60, (users, steps, 2))
    xy[0] = 0.0
    box = np.concatenate([xy, np.cos(heading)[..., None], np.sin(heading)[..., None], size], axis=-1)
    blocks = rng.random(users) < 0.7
    valid = rng.random((users, steps)) < 0.9
    valid[0] = True
    is_visible = find_visible(box, np.full(users, 100.0), valid, blocks, SENSOR)
    shapes = shapely.polygons(corners(box))
    eye = xy[0, 0]
    total = 0
    for t in range(steps):
        for i in range(1, users):
            walls = [shapes[j, t] for j in range(1, users) if j != i and valid[j, t] and blocks[j]]
            ends = [*corners(box[i, t]), box[i, t, :2]]
            free = [
                all(
                    shapely.length(shapely.intersection(shapely.LineString([eye, end]), w)) < 1e-9
                    for w in walls
                )
                for end in ends
            ]
            expected = valid[i, t] and any(free) and np.hypot(*xy[i, t]) <= 80.0
            assert is_visible[i, t] == expected, (t, i)
            total += int(expected)
    assert 10 < total < 90


def tracks(count=400, steps=91, speed=10.0):
    heading = np.full((count, steps), 0.3)
    valid = np.ones((count, steps), bool)
    valid[:, :3] = False
    move = speed * 0.1 * np.arange(steps)
    direction = np.stack([np.cos(heading), np.sin(heading)], axis=-1)
    return Tracks(
        xy=np.where(valid[..., None], move[None, :, None] * direction, 0.0),
        z=np.zeros((count, steps)),
        heading=np.where(valid, heading, 0.0),
        velocity=np.where(valid[..., None], speed * direction, 0.0),
        size=np.ones((count, steps, 3)),
        valid=valid,
        kind=np.ones(count, np.int8),
        track_id=np.arange(count),
    )


def test_noise_has_the_requested_size_and_correlation():
    plain = tracks()
    config = NoiseConfig()
    result = add_perception_noise(plain, 0, np.random.default_rng(1), config)
    error = (result.xy - plain.xy)[1:, 3:]
    along = error @ np.array([np.cos(0.3), np.sin(0.3)])
    across = error @ np.array([-np.sin(0.3), np.cos(0.3)])
    turn = (result.heading - plain.heading)[1:, 3:]
    faster = np.hypot(*np.moveaxis(result.velocity, -1, 0))[1:, 3:] - 10.0
    # 400 tracks of 88 steps: the estimates have errors of about one in a hundred.
    for values, sigma, memory in (
        (along, config.along_m, config.position_correlation),
        (across, config.across_m, config.position_correlation),
        (turn, config.heading_rad, config.heading_correlation),
        (faster, config.speed_mps, config.speed_correlation),
    ):
        assert abs(values.mean()) < 0.02 * sigma
        assert values.std() == pytest.approx(sigma, rel=0.03)
        assert np.mean(values[:, 1:] * values[:, :-1]) / values.var() == pytest.approx(memory, abs=0.02)
        assert values.std(axis=0) == pytest.approx(sigma, rel=0.2)  # from the first step on
        assert np.abs(values).max() <= 3.0001 * sigma


def test_noise_keeps_ego_sizes_and_invalid_states():
    plain = tracks(5)
    result = add_perception_noise(plain, 2, np.random.default_rng(1), NoiseConfig())
    for name in ("xy", "heading", "velocity"):
        assert np.array_equal(getattr(result, name)[2], getattr(plain, name)[2]), name
        assert np.array_equal(getattr(result, name)[~plain.valid], getattr(plain, name)[~plain.valid]), name
    assert np.array_equal(result.size, plain.size) and np.array_equal(result.valid, plain.valid)
    off = add_perception_noise(plain, 2, np.random.default_rng(1), NoiseConfig(level=0.0))
    assert np.allclose(off.xy, plain.xy, atol=1e-12) and np.allclose(off.velocity, plain.velocity, atol=1e-12)


def test_standing_users_stay_within_centimetres_and_keep_speed_zero():
    plain = tracks(300, speed=0.0)
    result = add_perception_noise(plain, 0, np.random.default_rng(1), NoiseConfig())
    assert (result.velocity == 0.0).all()
    assert np.hypot(*np.moveaxis(result.xy - plain.xy, -1, 0)).max() < 0.02
    assert np.abs(result.heading - plain.heading).max() < 0.002


def test_reversing_users_still_reverse():
    plain = tracks(50, speed=-0.1)
    result = add_perception_noise(plain, 0, np.random.default_rng(1), NoiseConfig())
    along = result.velocity[..., 0] * np.cos(result.heading) + result.velocity[..., 1] * np.sin(
        result.heading
    )
    assert along.max() <= 0.0


class Extreme(np.random.Generator):
    """Draws errors of the largest size with random signs."""

    def __init__(self, seed):
        super().__init__(np.random.PCG64(seed))

    def normal(self, loc=0.0, scale=1.0, size=None):
        return 1e6 * self.choice([-1.0, 1.0], size=(*size[:-1], 1)) * np.ones(size)


#: The longest vehicles of the world (buses), cars, and pedestrians.
LARGEST = ((12.0, 2.55), (5.3, 2.05), (0.7, 0.7))


@pytest.mark.parametrize(("length", "width"), LARGEST)
def test_no_corner_moves_farther_than_the_bound(length, width):
    """Compare with the corners of boxes with the largest errors of all signs."""
    plain = tracks(300)
    plain.size[:] = (length, width, 1.5)
    moved = add_perception_noise(plain, 0, Extreme(0), NoiseConfig())

    def points(them):
        box = [them.xy, np.cos(them.heading)[..., None], np.sin(them.heading)[..., None], them.size[..., :2]]
        return corners(np.concatenate(box, axis=-1))[:, 3:]

    shift = np.hypot(*np.moveaxis(points(moved) - points(plain), -1, 0)).max()
    bound = largest_shift_m(NoiseConfig(), length, width)
    assert 0.99 * bound < shift <= bound + 1e-4
    assert largest_shift_m(NoiseConfig(level=2.0), length, width) == pytest.approx(2 * bound)
    assert largest_shift_m(NoiseConfig(level=0.0), length, width) == 0.0


@pytest.mark.parametrize(("length", "width"), LARGEST)
def test_noise_never_makes_a_user_overlap_a_free_ego(length, width):
    """A user just clear of the enlarged ego is still clear of ego after the largest errors."""
    rng = np.random.default_rng(5)
    count = 100
    bearing, heading = rng.uniform(-np.pi, np.pi, (2, count))
    ego = np.array([0.0, 0.0, 1.0, 0.0, 4.6, 1.9])
    direction = np.stack([np.cos(bearing), np.sin(bearing)], axis=-1)
    near, far = np.zeros(count), np.full(count, 20.0)
    one_step = np.ones((2, 1), bool)

    def box(distance, k):
        return np.array([*(distance * direction[k]), np.cos(heading[k]), np.sin(heading[k]), length, width])

    for k in range(count):
        for _ in range(30):
            middle = (near[k] + far[k]) / 2
            touches = (
                first_overlap_step(
                    np.stack([ego, box(middle, k)])[:, None], one_step, np.ones((2, 2), bool)
                ).min()
                < 1
            )
            near[k], far[k] = (middle, far[k]) if touches else (near[k], middle)
    plain = tracks(count + 1, 4)
    plain.valid[:] = True
    plain.xy[1:], plain.heading[1:] = (far[:, None] * direction)[:, None], heading[:, None]
    plain.velocity[:] = 10.0 * np.stack([np.cos(plain.heading), np.sin(plain.heading)], axis=-1)
    room = shapely.Polygon(corners(ego))
    for seed in range(8):
        moved = add_perception_noise(plain, 0, Extreme(seed), NoiseConfig())
        for k in range(count):
            pose = (*moved.xy[k + 1, 0], np.cos(moved.heading[k + 1, 0]), np.sin(moved.heading[k + 1, 0]))
            assert room.distance(shapely.Polygon(corners(np.array([*pose, length, width])))) > 0.0

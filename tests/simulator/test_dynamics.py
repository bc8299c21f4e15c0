"""The bicycle: stopping distance, circles, grip, and its inverse; displacements; action spaces over them."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from drivax.errors import UsageError
from drivax.learning.config import TrainConfig
from drivax.settings import dump, load, parse_yaml
from drivax.simulator.dynamics import bicycle, command_between, displace, displacement, follow
from drivax.tasks.actions import (
    DELTA_LOCAL,
    DIRECT_STATE,
    DISCRETE,
    PHYSICAL,
    PUBLISHED,
    DeltaLocal,
    Discrete,
    Physical,
    Published,
    Route,
)
from drivax.tasks.task import Task

SPACES = {
    "physical": PHYSICAL,
    "published": PUBLISHED,
    "discrete": DISCRETE,
    "delta_local": DELTA_LOCAL,
    "direct_state": DIRECT_STATE,
    "limited": Physical(jerk_mps3=10.0, steering_rate=0.2),
}
LENGTH_M = 4.8


@partial(jax.jit, static_argnames=("space", "steps"))
def drive(space, motion, action, steps, last=None):
    """Return the motions and executed actions under one action."""

    def one(now, _):
        motion, last = now
        executed = space.actuate(motion, action, last, LENGTH_M)
        motion = space.move(motion, executed, LENGTH_M)
        return (motion, executed), (motion, executed)

    first = jnp.zeros(space.size) if last is None else last
    return jax.lax.scan(one, (motion, first), None, steps)[1]


def path_of(motion, acceleration, curvature, steps):
    action = jnp.array([acceleration / 6, curvature / 0.3])
    return np.asarray(drive(PHYSICAL, jnp.asarray(motion, jnp.float32), action, steps)[0])


def test_full_braking_from_10_mps_stops_after_8_33_m():
    path = path_of([0.0, 0.0, 0.0, 10.0], -6.0, 0.0, 60)
    assert path[-1, 0] == pytest.approx(100 / 12, abs=1e-3)
    assert path[-1, 3] == 0.0
    np.testing.assert_array_equal(path[20:, :], np.broadcast_to(path[-1], path[20:].shape))
    assert (np.diff(path[:, 0]) >= 0).all()


def test_constant_curvature_drives_a_circle():
    radius, speed = 20.0, 5.0
    path = path_of([0.0, 0.0, 0.0, speed], 0.0, 1 / radius, 251)
    centre = np.array([0.0, radius])
    np.testing.assert_allclose(np.linalg.norm(path[:, :2] - centre, axis=1), radius, rtol=1e-3)
    assert path[:, 2].min() >= -np.pi and path[:, 2].max() < np.pi


def test_grip_limits_curvature():
    speed = 20.0
    path = path_of([0.0, 0.0, 0.0, speed], 0.0, 0.3, 10)
    turned = path[-1, 2] / (10 * 0.1)
    assert turned * speed == pytest.approx(8.0, rel=1e-3)


def test_following_a_drivable_log_reproduces_it():
    rng = np.random.default_rng(0)
    acceleration, curvature = rng.uniform(-2, 2, 60), np.repeat(rng.uniform(-0.05, 0.05, 12), 5)
    step, followed = jax.jit(bicycle), jax.jit(lambda m, a, b: bicycle(m, *follow(m, a, b)))
    log = [np.array([0.0, 0.0, 0.0, 8.0], np.float32)]
    for a, k in zip(acceleration, curvature, strict=True):
        log.append(np.asarray(step(log[-1], jnp.float32(a), jnp.float32(k))))
    motion = jnp.asarray(log[0])
    for t in range(58):
        motion = followed(motion, log[t + 1], log[t + 2])
        assert float(np.linalg.norm(motion[:2] - log[t + 1][:2])) < 0.1


def test_a_standing_car_steers_straight():
    still = jnp.array([3.0, 4.0, 1.0, 0.0])
    acceleration, curvature = follow(still, still, still.at[0].add(0.05))
    assert float(curvature) == 0.0
    assert float(acceleration) == 0.0


def test_command_between_inverts_the_bicycle():
    motion = jnp.array([5.0, -3.0, 3.1, 9.0])  # turns over the wrap of the heading
    read = command_between(motion, bicycle(motion, jnp.float32(-1.5), jnp.float32(0.08)))
    np.testing.assert_allclose(read, [-1.5, 0.08], atol=1e-4)
    slow = jnp.array([0.0, 0.0, 0.0, 0.2])
    assert float(command_between(slow, bicycle(slow, jnp.float32(0.0), jnp.float32(0.3)))[1]) == 0.0


def test_displacement_is_in_the_agent_frame_and_inverts_displace():
    # Heading north: 3 m ahead is +y, 0.4 m left is -x.
    motion = jnp.array([10.0, 20.0, np.pi / 2, 7.0])
    moved = displace(motion, jnp.array([3.0, 0.4]), jnp.float32(2.0))
    speed = np.hypot(3.0, 0.4) / 0.1
    np.testing.assert_allclose(moved, [9.6, 23.0, np.pi / 2 + 2.0 - 2 * np.pi, speed], rtol=1e-5)
    shift, turn = displacement(motion, moved)
    np.testing.assert_allclose([*shift, turn], [3.0, 0.4, 2.0], atol=1e-5)
    still = displace(motion, jnp.zeros(2), jnp.float32(0.0))
    np.testing.assert_allclose(still, [10.0, 20.0, np.pi / 2, 0.0], atol=1e-6)


@pytest.mark.parametrize("name", ["physical", "published", "discrete", "delta_local", "limited"])
def test_zero_action_adds_nothing_and_bounds_clip(name):
    space, motion = SPACES[name], jnp.array([1.0, 2.0, 0.5, 4.0])
    after = np.asarray(space.move(motion, jnp.zeros(space.size), LENGTH_M))
    if name == "delta_local":
        np.testing.assert_allclose(after, [1.0, 2.0, 0.5, 0.0], atol=1e-6)
    else:
        expected = [1.0 + 0.4 * np.cos(0.5), 2.0 + 0.4 * np.sin(0.5), 0.5, 4.0]
        np.testing.assert_allclose(after, expected, rtol=1e-6)
    action = jnp.full(space.size, 7.0)
    executed = np.asarray(space.actuate(motion, action, action.at[:].set(1.0), LENGTH_M))
    np.testing.assert_allclose(executed, 1.0, rtol=1e-6)
    assert bool(space.exceeds_bounds(action)) and not bool(space.exceeds_bounds(jnp.ones(space.size)))


@pytest.mark.parametrize("name", SPACES)
def test_every_space_maps_controls_to_actions(name):
    """The car gets about where the bicycle would, and to the same speed."""
    space, motion = SPACES[name], jnp.array([1.0, 2.0, 0.5, 9.0])
    action = space.action(motion, jnp.float32(1.0), jnp.float32(0.03), LENGTH_M)
    last = space.action(motion, jnp.float32(0.5), jnp.float32(0.02), LENGTH_M)
    after = np.asarray(space.move(motion, space.actuate(motion, action, last, LENGTH_M), LENGTH_M))
    expected = np.asarray(bicycle(motion, jnp.float32(1.0), jnp.float32(0.03)))
    near = 0.05 if name == "discrete" else 0.02
    np.testing.assert_allclose(after, expected, atol=near)


@pytest.mark.parametrize("name", ["physical", "published", "delta_local", "direct_state", "limited"])
def test_expert_actions_of_each_space_follow_a_log(name):
    space, rng = SPACES[name], np.random.default_rng(1)
    log = [jnp.array([0.0, 0.0, 3.0, 8.0])]
    command, step = (0.0, 0.0), jax.jit(bicycle)
    for t in range(42):
        if t % 10 == 0:
            command = (rng.uniform(-0.5, 0.5), rng.uniform(-0.01, 0.01))
        log.append(step(log[-1], jnp.float32(command[0]), jnp.float32(command[1])))
    log = jnp.stack(log)

    @jax.jit
    def follow_all(log):
        def one(now, t):
            motion, last = now
            action = space.expert(motion, log[t + 1], log[t + 2], LENGTH_M)
            executed = space.actuate(motion, action, last, LENGTH_M)
            motion = space.move(motion, executed, LENGTH_M)
            return (motion, executed), (motion, space.exceeds_bounds(action))

        history = jnp.broadcast_to(log[0], (16, 4))
        return jax.lax.scan(one, (log[0], space.first(history, LENGTH_M)), jnp.arange(40))[1]

    driven, clipped = follow_all(log)
    assert np.linalg.norm(driven[:, :2] - log[1:41, :2], axis=1).max() < 0.1
    assert not np.asarray(clipped).any()


def test_levels_are_denser_near_zero_and_contain_it():
    accelerations, curvatures = (np.asarray(levels) for levels in DISCRETE.levels())
    np.testing.assert_allclose(accelerations, [-1, -4 / 9, -1 / 9, 0, 1 / 9, 4 / 9, 1], rtol=1e-6)
    np.testing.assert_allclose(curvatures, np.array([-36, -25, -16, -9, -4, -1, 0, 1, 4, 9, 16, 25, 36]) / 36)
    assert (np.diff(np.diff(curvatures))[6:] > 0).all()
    found = [int(DISCRETE.index(DISCRETE.of_index(jnp.int32(i)))) for i in range(0, 91, 5)]
    assert DISCRETE.choices == 91 and found == list(range(0, 91, 5))
    np.testing.assert_array_equal(DISCRETE.of_index(jnp.int32(45)), [0.0, 0.0])
    # 0.05 is nearer to 1/36 than to 4/36, and 0.3 to 4/9 than to 1/9.
    snapped = DISCRETE.actuate(jnp.zeros(4), jnp.array([0.3, 0.05]), jnp.zeros(2), LENGTH_M)
    np.testing.assert_allclose(snapped, [4 / 9, 1 / 36], rtol=1e-6)


@pytest.mark.parametrize(
    "options",
    [{"accelerations": 6}, {"curvatures": 1}, {"density": 0.5}, {"density": np.nan}, {"steering": 0.0}],
)
def test_invalid_levels_are_refused(options):
    with pytest.raises(UsageError):
        Discrete(**options)


@pytest.mark.parametrize(
    ("space", "options", "words"),
    [
        (Physical, {"braking_mps2": 0.0}, "braking_mps2 is 0; use a positive number"),
        (Physical, {"steering": np.nan}, "steering is nan"),
        (Physical, {"jerk_mps3": -1.0}, "jerk_mps3 is -1"),
        (Published, {"steering": 1.6}, "steering is 1.6 rad; use less than a right angle"),
        (Route, {"offset_m": 0.0}, "offset_m is 0"),
        (DeltaLocal, {"turn_rad": 0.0}, "turn_rad is 0"),
    ],
)
def test_invalid_settings_are_refused(space, options, words):
    with pytest.raises(UsageError, match=words) as error:
        space(**options)
    assert words in str(error.value)


def test_actuator_rates_limit_changes():
    space = Physical(jerk_mps3=10.0, steering_rate=0.2)
    motion, full = jnp.array([0.0, 0.0, 0.0, 5.0]), jnp.array([-1.0, 1.0])
    executed = np.asarray(drive(space, motion, full, 20)[1])
    acceleration, curvature = executed[:, 0] * 6, executed[:, 1] * 0.3
    np.testing.assert_allclose(acceleration[:6], -np.arange(1, 7), rtol=1e-5)  # 10 m/s3 x 0.1 s a step
    np.testing.assert_allclose(curvature[:15], 0.02 * np.arange(1, 16), rtol=1e-5)
    np.testing.assert_allclose(curvature[15:], 0.3, rtol=1e-5)
    # It stands after less than 2 s; off the brake, it starts at the rate from zero, not from -6.
    stopped = np.asarray(drive(space, motion, full, 20)[0])[-1]
    assert stopped[3] == 0.0
    start = jnp.array([1.0, 0.0])
    restarted = drive(space, jnp.asarray(stopped), start, 3, last=jnp.asarray(executed[-1]))[1]
    np.testing.assert_allclose(restarted[:, 0] * 6, [1.0, 2.0, 3.0], rtol=1e-5)
    np.testing.assert_allclose(restarted[:, 1] * 0.3, [0.28, 0.26, 0.24], rtol=1e-4)


def test_published_steering_rate_limits_the_angle():
    space, motion = Published(steering_rate=0.5), jnp.array([0.0, 0.0, 0.0, 3.0])
    executed = np.asarray(drive(space, motion, jnp.array([0.0, 1.0]), 8)[1])
    np.testing.assert_allclose(executed[:, 1] * 0.3, np.minimum(0.05 * np.arange(1, 9), 0.3), rtol=1e-5)


def test_limited_actuators_start_from_the_logged_command():
    space = Physical(jerk_mps3=10.0)
    before = jnp.array([0.0, 0.0, 0.0, 8.0])
    now = bicycle(before, jnp.float32(-3.0), jnp.float32(0.06))
    history = jnp.broadcast_to(before, (16, 4)).at[-1].set(now)
    np.testing.assert_allclose(space.first(history, LENGTH_M), [-0.5, 0.2], atol=1e-4)
    np.testing.assert_array_equal(replace(space, jerk_mps3=None).first(history, LENGTH_M), [0.0, 0.0])


def test_direct_state_wraps_and_never_reverses():
    motion = DIRECT_STATE.move(jnp.zeros(4), jnp.array([5.0, -2.0, 4.0, -1.0]), LENGTH_M)
    np.testing.assert_allclose(motion, [5.0, -2.0, 4.0 - 2 * np.pi, 0.0], rtol=1e-6)


@pytest.mark.parametrize("name", ["physical", "published", "discrete", "delta_local", "direct_state"])
def test_spaces_are_chosen_by_name(name):
    task = load(Task, {"actions": name})
    assert task.actions == SPACES[name]
    assert load(Task, parse_yaml(dump(task))) == task
    if name == "published":
        limited = load(Task, {"actions": {"kind": name, "jerk_mps3": 8}})
        assert limited.actions == Published(jerk_mps3=8.0) and limited.actions.braking_mps2 == 4.0


def test_policies_do_not_learn_in_direct_state():
    with pytest.raises(UsageError, match="direct_state"):
        load(TrainConfig, {"task": {"actions": "direct_state"}})
    assert load(TrainConfig, {"task": {"actions": "delta_local"}}).task.actions == DELTA_LOCAL

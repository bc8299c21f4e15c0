"""nuPlan's controller: fits against brute-force least squares, steps against NumPy in double precision and by hand."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import lsq_linear

from drivax.errors import UsageError
from drivax.learning.config import TrainConfig
from drivax.settings import dump, load, parse_yaml
from drivax.simulator.controller import TrackingConfig, fit_curvatures, fit_speeds, propagate, track
from drivax.tasks.actions import Trajectory
from drivax.tasks.task import Task
from quick import quick

CONFIG, DT = TrackingConfig(), 0.1
#: nuPlan's car.
LENGTH_M, WHEELBASE_M, AXLE_M = 5.176, 3.089, 1.461


def wrapped(angle):
    return (angle + np.pi) % (2 * np.pi) - np.pi


def stacked_least_squares(rows, values):
    return lsq_linear(np.concatenate(rows), np.concatenate(values), method="bvls", tol=1e-14).x


def oracle_profiles(poses, jerk_penalty=1e-4, rate_penalty=1e-2):
    """Speeds and curvatures of each displacement, from the two published problems, written as stacked residuals."""
    moved, heading = np.diff(poses[:, :2], axis=0), poses[:-1, 2]
    m = len(moved)
    # Unknowns: v_0, a_0 ... a_(m-2). Two residuals per displacement, and one per change of acceleration.
    rows = np.zeros((m, 2, m))
    for k in range(m):
        for axis, part in enumerate((np.cos(heading[k]), np.sin(heading[k]))):
            rows[k, axis, 0] = DT * part
            rows[k, axis, 1 : 1 + k] = DT * DT * part
    jerk = np.zeros((m - 2, m))
    for k in range(m - 2):
        jerk[k, 1 + k], jerk[k, 2 + k] = -1.0, 1.0
    x = stacked_least_squares(
        [rows.reshape(-1, m), np.sqrt(jerk_penalty) * jerk], [moved.ravel(), np.zeros(m - 2)]
    )
    speeds = x[0] + np.concatenate([[0.0], np.cumsum(x[1:] * DT)])
    # Unknowns: k_0 and the curvature rates.
    turns = np.zeros((m, m))
    for k in range(m):
        turns[k, 0] = speeds[k] * DT
        turns[k, 1 : 1 + k] = speeds[k] * DT * DT
    weights = np.diag([1e-5] + [np.sqrt(rate_penalty)] * (m - 1))
    y = stacked_least_squares([turns, weights], [wrapped(np.diff(poses[:, 2])), np.zeros(m)])
    return speeds, y[0] + np.concatenate([[0.0], np.cumsum(y[1:] * DT)])


def oracle_step(state, plan, wheelbase=WHEELBASE_M):
    """One step of tracker and car: state is the rear axle's x, y, heading, speed, then acceleration and steering."""
    x, y, heading, speed, acceleration, steering = state
    speeds, curvatures = oracle_profiles(plan)
    last = len(speeds) - 1
    desired = np.interp(1.0, np.arange(len(speeds)) * DT, speeds)
    away = np.array([x, y]) - plan[0, :2]
    error = np.array(
        [
            -away[0] * np.sin(plan[0, 2]) + away[1] * np.cos(plan[0, 2]),
            wrapped(heading - plan[0, 2]),
            steering,
        ]
    )
    if desired <= 0.2 and speed <= 0.2:
        command, rate = -0.5 * (speed - desired), 0.0
    else:
        command = -(10.0 / (10.0 + 1.0)) * (speed - desired)
        a, b, g = np.eye(3), np.zeros(3), np.zeros(3)
        for n in range(10):
            held = speed + n * DT * command
            step = np.eye(3)
            step[0, 1], step[1, 2] = held * DT, held * DT / wheelbase
            bend = np.array([0.0, -held * curvatures[min(n, last)] * DT, 0.0])
            a, b, g = step @ a, step @ b + [0.0, 0.0, DT], step @ g + bend
        z = a @ error + g
        z[1:] = wrapped(z[1:])
        q = np.diag([1.0, 10.0, 0.0])
        rate = float(-(b @ q @ z) / (b @ q @ b + 1.0))
    acceleration = 0.1 / 0.3 * (command - acceleration) + acceleration
    steering_after = np.clip(0.1 / 0.15 * rate * DT + steering, -np.pi / 3, np.pi / 3)
    x, y = x + speed * DT * np.cos(heading), y + speed * DT * np.sin(heading)
    heading = wrapped(heading + speed * DT * np.tan(steering) / wheelbase)
    return np.array([x, y, heading, max(speed + acceleration * DT, 0.0), acceleration, steering_after])


def centre(axle):
    return np.stack(
        [
            axle[..., 0] + AXLE_M * np.cos(axle[..., 2]),
            axle[..., 1] + AXLE_M * np.sin(axle[..., 2]),
            axle[..., 2],
        ],
        -1,
    )


def line(speed, steps=41, aside=0.0):
    t = np.arange(steps) * DT
    return np.stack([speed * t, np.full(steps, aside), 0 * t], -1)


def circle(speed, radius, steps=41):
    angle = speed * np.arange(steps) * DT / radius
    return np.stack([radius * np.sin(angle), radius - radius * np.cos(angle), wrapped(angle)], -1)


def slowing(speed, deceleration, steps=41):
    along = np.cumsum(np.maximum(speed - deceleration * np.arange(steps) * DT, 0.0)) * DT
    return np.stack([along, 0 * along, np.full(steps, 3.0)], -1) @ np.diag(
        [np.cos(3.0), 1.0, 1.0]
    ) + np.stack([0 * along, along * np.sin(3.0), 0 * along], -1)


def noisy(seed, speed=6.0, steps=41):
    rng = np.random.default_rng(seed)
    poses = circle(speed, 30.0, steps)
    return poses + rng.normal(size=poses.shape) * [0.05, 0.05, 0.01]


PLANS = {
    "line": line(10.0), "circle": circle(5.0, 20.0), "slowing": slowing(6.0, 2.0), "noisy": noisy(0),
    "fast": noisy(1, 25.0), "slow": circle(0.5, 8.0), "standing": line(0.0), "short": noisy(2, 8.0, 6),
}  # fmt: skip


@pytest.fixture(params=PLANS)
def plan(request):
    return PLANS[request.param]


def test_fitted_profiles_equal_brute_force_least_squares(plan):
    poses = jnp.asarray(plan, jnp.float32)
    speeds = fit_speeds(poses, CONFIG)
    expected, curvatures = oracle_profiles(plan)
    np.testing.assert_allclose(speeds, expected, atol=2e-4 * max(1.0, expected.max()))
    # A standing plan leaves its curvature open; the fit says zero.
    fitted = fit_curvatures(poses, speeds, CONFIG)
    np.testing.assert_allclose(fitted, 0.0 if not expected.any() else curvatures, atol=2e-4)


def closed_loop(plan_at, motion, last, steps, length_m=LENGTH_M):
    """Motions and actuators of a car that gets a new plan at every step."""

    @jax.jit
    def drive(plans, motion, last):
        def step(now, plan):
            motion, last = now
            last = track(motion, plan, last, jnp.float32(length_m), CONFIG)
            motion = propagate(motion, last, jnp.float32(length_m), CONFIG)
            return (motion, last), (motion, last)

        return jax.lax.scan(step, (motion, last), plans)[1]

    plans = np.stack([plan_at(n) for n in range(steps)])
    motions, actuators = drive(
        jnp.asarray(plans, jnp.float32), jnp.asarray(motion, jnp.float32), jnp.asarray(last, jnp.float32)
    )
    return np.asarray(motions), np.asarray(actuators)


@pytest.mark.parametrize("name", ["line", "circle", "slowing", "noisy"])
def test_closed_loop_equals_double_precision(name):
    reference = {
        "line": line(10.0, 81),
        "circle": circle(5.0, 20.0, 81),
        "slowing": slowing(6.0, 2.0, 81),
        "noisy": noisy(3, 7.0, 81),
    }[name]
    axle = np.array([*(reference[0] + [0.3, -0.4, 0.05]), 5.5, 0.4, 0.02])
    start = [*centre(axle[None, :3])[0], axle[3]]
    motions, actuators = closed_loop(lambda n: centre(reference[n : n + 41]), start, [0.4, 0.02, 0.0], 40)
    for n in range(40):
        axle = oracle_step(axle, reference[n : n + 41])
        expected = [*centre(axle[None, :3])[0], axle[3]]
        away = motions[n] - expected
        away[2] = wrapped(away[2])
        np.testing.assert_allclose(away, 0.0, atol=2e-3, err_msg=f"step {n}")
        assert actuators[n, 0] == pytest.approx(axle[4], abs=5e-3) or axle[3] == 0.0


def test_single_steps_by_hand():
    """On the plan and at its speed all is zero; at 1 m/s less 10/11 m/s2 are due, of which the lag passes a third."""
    step = jax.jit(partial(track, length_m=jnp.float32(LENGTH_M), config=CONFIG))
    plan = jnp.asarray(centre(line(10.0)), jnp.float32)
    motion = lambda speed, y=0.0: jnp.array([AXLE_M, y, 0.0, speed])  # noqa: E731
    np.testing.assert_allclose(step(motion(10.0), plan, jnp.zeros(3)), 0.0, atol=1e-3)
    np.testing.assert_allclose(step(motion(9.0), plan, jnp.zeros(3))[0], 10 / 11 / 3, atol=1e-3)
    # The old acceleration decays by a third per step.
    np.testing.assert_allclose(step(motion(10.0), plan, jnp.array([3.0, 0.0, 0.0]))[0], 2.0, atol=1e-3)
    # A car left of the line steers to the right. In ten steps, a steering rate of 1 rad/s turns it by dt^2 v / L times
    # 0 + 1 + ... + 9 = 45, and moves it aside by dt^3 v^2 / L times 0 + 0 + 1 + 3 + ... + 36 = 120.
    heading_unit = 10.0 / WHEELBASE_M * DT * DT * 45
    lateral_unit = 100.0 / WHEELBASE_M * DT**3 * 120
    rate = -(lateral_unit * 1.0) / (lateral_unit**2 + 10 * heading_unit**2 + 1.0)
    np.testing.assert_allclose(step(motion(10.0, 1.0), plan, jnp.zeros(3))[2], rate * 2 / 3, rtol=2e-3)
    # Below 0.2 m/s toward a stop: half the speed error, and no steering.
    stop = jnp.asarray(centre(line(0.0)), jnp.float32)
    np.testing.assert_allclose(step(motion(0.1, 0.5), stop, jnp.zeros(3)), [-0.05 / 3, 0.0, 0.0], atol=1e-5)


def test_the_rear_axle_moves_along_the_present_heading():
    """10 m/s and 0.1 rad: 1 m ahead, then a turn by tan(0.1) / 3.089 about the rear axle."""
    after = quick(
        lambda m, a: propagate(m, a, jnp.float32(LENGTH_M), CONFIG),
        jnp.array([AXLE_M, 0.0, 0.0, 10.0]),
        jnp.array([2.0, 0.1, 0.5]),
    )
    turn = np.tan(0.1) / WHEELBASE_M
    expected = [1.0 + AXLE_M * np.cos(turn), AXLE_M * np.sin(turn), turn, 10.2]
    np.testing.assert_allclose(after, expected, atol=1e-5)


def test_a_stopping_car_never_reverses():
    last = track(
        jnp.array([AXLE_M, 0.0, 0.0, 0.1]),
        jnp.asarray(centre(line(0.0)), jnp.float32),
        jnp.array([-4.0, 0.0, 0.0]),
        jnp.float32(LENGTH_M),
        CONFIG,
    )
    assert float(last[0]) == pytest.approx(-1.0)
    assert float(propagate(jnp.array([AXLE_M, 0.0, 0.0, 0.1]), last, jnp.float32(LENGTH_M), CONFIG)[3]) == 0.0


def test_car_converges_to_a_line_and_to_a_circle():
    aside, _ = closed_loop(
        lambda n: centre(line(10.0, 241)[n : n + 41]), [AXLE_M, 1.5, 0.1, 8.0], np.zeros(3), 200
    )
    # The published weights damp little: after 8 s it is still 0.2 m aside.
    assert np.abs(aside[-10:, 1]).max() < 0.02 and np.abs(aside[-10:, 3] - 10.0).max() < 0.02
    speed, radius = 6.0, 25.0
    reference = circle(speed, radius, 221)
    turning, actuators = closed_loop(
        lambda n: centre(reference[n : n + 41]), [AXLE_M, 0.0, 0.0, speed], np.zeros(3), 180
    )
    axle = turning[:, :2] - AXLE_M * np.stack([np.cos(turning[:, 2]), np.sin(turning[:, 2])], -1)
    away = np.linalg.norm(axle - [0.0, radius], axis=-1) - radius
    assert np.abs(away[-20:]).max() < 0.05
    np.testing.assert_allclose(actuators[-20:, 1], np.arctan(WHEELBASE_M / radius), atol=0.01)


@pytest.mark.parametrize(
    ("speed", "radius", "zero_m", "logged_m"), [(6.0, 15.0, 1.17, 0.16), (10.0, 30.0, 1.23, 0.22)]
)
def test_straight_wheels_at_the_start_leave_a_circle(speed, radius, zero_m, logged_m):
    """Largest distance from the circle of the rear axle; the devkit's controller leaves it by 1.16 m and 1.23 m."""
    reference = circle(speed, radius, 141)
    angle = speed * 0.1 * np.arange(-22, 1) / radius
    poses = np.stack([radius * np.sin(angle), radius - radius * np.cos(angle), angle], -1)
    history = jnp.asarray(np.column_stack([centre(poses), np.full(23, speed)]), jnp.float32)
    for name, expected_m in (("zero", zero_m), ("logged", logged_m)):
        first = Trajectory(initial_steering=name).first(history, LENGTH_M)[:3]
        motions, _ = closed_loop(
            lambda n: centre(reference[n : n + 41]), [AXLE_M, 0.0, 0.0, speed], np.asarray(first), 100
        )
        axle = motions[:, :2] - AXLE_M * np.stack([np.cos(motions[:, 2]), np.sin(motions[:, 2])], -1)
        away = np.abs(np.linalg.norm(axle - [0.0, radius], axis=-1) - radius).max()
        assert away == pytest.approx(expected_m, abs=0.01)


def test_gradients_are_finite():
    def loss(poses):
        last = track(jnp.array([0.0, 0.0, 0.0, 0.0]), poses, jnp.zeros(3), jnp.float32(LENGTH_M), CONFIG)
        return propagate(jnp.array([0.0, 0.0, 0.0, 3.0]), last, jnp.float32(LENGTH_M), CONFIG).sum()

    for poses in (line(0.0), circle(5.0, 20.0)):
        assert np.isfinite(quick(jax.grad(loss), jnp.asarray(poses, jnp.float32))).all()


def test_plans_have_the_length_of_the_space():
    space = Trajectory(steps=5)
    long, short = jnp.asarray(line(4.0, 9), jnp.float32), jnp.asarray(line(4.0, 3), jnp.float32)
    assert space.size == 18
    np.testing.assert_allclose(space.plan(long).reshape(-1, 3), line(4.0, 6), atol=1e-6)
    np.testing.assert_allclose(space.plan(short).reshape(-1, 3), line(4.0, 6), atol=1e-6)
    held = space.action(jnp.array([0.0, 0.0, 0.0, 4.0]), jnp.float32(0.0), jnp.float32(0.0), LENGTH_M)
    np.testing.assert_allclose(held.reshape(-1, 3), line(4.0, 6), atol=1e-6)


def test_the_space_is_selected_by_name():
    task = load(Task, {"actions": {"kind": "trajectory", "steps": 40, "controller": {"horizon": 8}}})
    assert task.actions == Trajectory(40, TrackingConfig(horizon=8))
    assert load(Task, parse_yaml(dump(task))) == task
    with pytest.raises(UsageError, match="a plan of 1 steps is too short"):
        Trajectory(steps=1)
    for name, value in (
        ("horizon", 0),
        ("wheelbase", 0.0),
        ("stopping_gain", -1.0),
        ("steering_lag_s", np.nan),
    ):
        with pytest.raises(UsageError, match=f"{name} is .*; use "):
            TrackingConfig(**{name: value})
    with pytest.raises(UsageError, match="less than a right angle"):
        TrackingConfig(most_steering=1.6)
    with pytest.raises(UsageError, match="cannot learn in trajectory"):
        load(TrainConfig, {"task": {"actions": "trajectory"}})

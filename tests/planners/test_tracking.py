"""Tracking: each command against a brute-force minimum, the whole drive against NumPy in double precision."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import solve_discrete_are
from scipy.optimize import minimize_scalar

from drivax.planners.pdm.tracking import Car, Reference, step_car, track
from drivax.simulator.controller import TrackingConfig, acceleration_to, steering_rate
from drivax.simulator.dynamics import bicycle
from drivax.tasks.actions import Trajectory
from quick import quick

CONFIG, WHEELBASE, DT = TrackingConfig(), 3.0, 0.1


def lateral_system(speed, curvature=0.0):
    """One step of the lateral errors: x' = A x + B u + g."""
    a = np.eye(3)
    a[0, 1], a[1, 2] = DT * speed, DT * speed / WHEELBASE
    return a, np.array([0.0, 0.0, DT]), np.array([0.0, -DT * speed * curvature, 0.0])


def at_the_horizon(x, rate, speeds, curvatures):
    for speed, curvature in zip(speeds, curvatures, strict=True):
        a, b, g = lateral_system(speed, curvature)
        x = a @ x + b * rate + g
    return x


def test_acceleration_minimises_its_cost():
    for speed, wanted in ((5.0, 8.0), (12.0, 3.0), (4.0, 4.0)):
        cost = lambda a, v=speed, w=wanted: 10.0 * (v + a - w) ** 2 + a * a  # noqa: E731  10 steps of 0.1 s
        assert float(acceleration_to(jnp.asarray(speed), jnp.asarray(wanted), CONFIG)) == pytest.approx(
            minimize_scalar(cost).x, abs=1e-4
        )


def test_steering_rate_minimises_its_cost():
    rng = np.random.default_rng(0)
    for _ in range(5):
        x = rng.normal(size=3) * [1.0, 0.3, 0.1]
        speeds, curvatures = rng.uniform(0, 15, 10), rng.normal(size=10) * 0.05

        def cost(rate, x=x, speeds=speeds, curvatures=curvatures):
            e, h, _ = at_the_horizon(x, rate, speeds, curvatures)
            return e * e + 10.0 * h * h + rate * rate

        found = steering_rate(
            tuple(jnp.asarray(part) for part in x), jnp.asarray(speeds), jnp.asarray(curvatures),
            jnp.asarray(WHEELBASE), CONFIG,
        )  # fmt: skip
        assert float(found) == pytest.approx(minimize_scalar(cost).x, rel=1e-3, abs=1e-4)


def test_gains_equal_the_riccati_recursion_for_one_step():
    """With the cost to go P of SciPy's algebraic equation as Q, one step of the recursion has the stationary gain."""
    q, r = 7.0, 2.0
    p = solve_discrete_are(np.eye(1), np.array([[DT]]), np.array([[q]]), np.array([[r]]))[0, 0]
    gain = DT * p / (r + DT * p * DT)
    one = TrackingConfig(horizon=1, speed_weight=float(p), acceleration_weight=r)
    assert float(acceleration_to(jnp.asarray(3.0), jnp.asarray(4.0), one)) == pytest.approx(gain, rel=1e-5)
    # The lateral system, over which the rate is held for ten steps: A, B, and K = (B'QB + r)^-1 B'QA of one such step.
    a, b = np.eye(3), np.zeros(3)
    step, into, _ = lateral_system(8.0)
    for _ in range(10):
        a, b = step @ a, step @ b + into
    weights = np.diag([1.0, 10.0, 0.0])
    gains = b @ weights @ a / (b @ weights @ b + 1.0)
    for axis in range(3):
        error = tuple(jnp.asarray(0.1 * (axis == part)) for part in range(3))
        found = steering_rate(error, jnp.full(10, 8.0), jnp.zeros(10), jnp.asarray(WHEELBASE), CONFIG)
        assert float(found) == pytest.approx(-0.1 * gains[axis], rel=1e-4)


def test_actuators_close_two_thirds_of_their_error_per_step():
    car = Car(jnp.asarray([0.0, 0.0, 0.0, 10.0]), jnp.zeros(()), jnp.zeros(()))
    for n in range(1, 6):
        car = step_car(car, jnp.asarray(2.0), jnp.asarray(0.3), jnp.asarray(WHEELBASE), CONFIG)
        assert float(car.acceleration) == pytest.approx(2.0 * (1.0 - (2 / 3) ** n), rel=1e-5)
        assert float(car.steering) == pytest.approx(n * 0.03 * 2 / 3, rel=1e-5)
    hard = Car(car.motion, car.acceleration, jnp.asarray(1.04))
    turned = step_car(hard, jnp.zeros(()), jnp.asarray(9.0), jnp.asarray(WHEELBASE), CONFIG)
    assert float(turned.steering) == pytest.approx(np.pi / 3)


def oracle(motion, pose, speeds, curvatures):
    """The tracker and the car in double precision, with matrices instead of the recursion on numbers."""
    x, y, psi, v = motion
    acceleration = steering = 0.0
    found = [(x, y, psi, v)]
    for t in range(len(speeds) - 1):
        last = len(speeds) - 1
        wanted = speeds[min(t + 10, last)]
        cos, sin = pose[t, 2:]
        error = [(y - pose[t, 1]) * cos - (x - pose[t, 0]) * sin, psi - np.arctan2(sin, cos), steering]
        if wanted <= 0.2 and v <= 0.2:
            asked, rate = 0.5 * (wanted - v), 0.0
        else:
            asked = 10.0 / 11.0 * (wanted - v)
            ahead = np.maximum(v + asked * DT * np.arange(10), 0.0)
            bends = curvatures[np.minimum(t + np.arange(10), last)]
            free = at_the_horizon(np.array(error), 0.0, ahead, bends)
            unit = at_the_horizon(np.zeros(3), 1.0, ahead, np.zeros(10))
            weights = np.array([1.0, 10.0, 0.0])
            rate = -np.sum(weights * unit * free) / (np.sum(weights * unit * unit) + 1.0)
        acceleration += (asked - acceleration) / 3.0
        steering = np.clip(steering + rate * DT * 2.0 / 3.0, -np.pi / 3, np.pi / 3)
        way = max(v + acceleration * DT, 0.0)
        distance = (v + way) / 2 * DT if v + acceleration * DT >= 0 else v * v / (-2 * acceleration)
        bend = np.clip(np.tan(steering) / WHEELBASE, -8.0 / max(v * v, 1e-3), 8.0 / max(v * v, 1e-3))
        x += distance * np.cos(psi + bend * distance / 2)
        y += distance * np.sin(psi + bend * distance / 2)
        psi, v = psi + bend * distance, way
        found.append((x, y, psi, v))
    return np.array(found)


@pytest.fixture(scope="module")
def drives():
    """A lane to the side, a circle of 20 m to the left, and a stop."""
    t = np.arange(41) * DT
    straight = np.stack([10.0 * t, 0 * t, 1 + 0 * t, 0 * t], 1)
    angle = 5.0 * t / 20.0
    circle = np.stack([20 * np.sin(angle), 20 - 20 * np.cos(angle), np.cos(angle), np.sin(angle)], 1)
    slowing = np.maximum(6.0 - 2.0 * t, 0.0)
    stop = np.stack([np.cumsum(slowing * DT) - 0.6, 0 * t, 1 + 0 * t, 0 * t], 1)
    pose = np.stack([straight, circle, stop])
    speed = np.stack([np.full(41, 10.0), np.full(41, 5.0), slowing])
    bend = np.stack([0 * t, 0 * t + 1 / 20, 0 * t])
    begin = np.array([[0.0, 1.0, 0.0, 10.0], [0.0, 0.0, 0.0, 5.0], [0.0, 0.0, 0.0, 6.0]])

    def all_of(begin, *parts):
        one = lambda m, r: track(Car(m, jnp.zeros(()), jnp.zeros(())), r, jnp.asarray(WHEELBASE), CONFIG)  # noqa: E731
        return jax.vmap(one)(begin, Reference(*parts))

    cars = quick(all_of, *(jnp.asarray(part, jnp.float32) for part in (begin, pose, speed, bend)))
    return cars, [oracle(*one) for one in zip(begin, pose, speed, bend, strict=True)], pose


def test_tracked_motions_equal_double_precision(drives):
    cars, expected, _ = drives
    for found, right in zip(cars.motion, expected, strict=True):
        np.testing.assert_allclose(found, right, atol=2e-3)


def test_tracker_reaches_the_line_keeps_the_circle_and_stops(drives):
    cars, _, _ = drives
    # A metre aside is closed within the 4 s, without swinging far beyond.
    assert abs(cars.motion[0, -1, 1]) < 0.1 and cars.motion[0, :, 1].min() > -0.2
    away = np.linalg.norm(cars.motion[1, :, :2] - [0.0, 20.0], axis=-1) - 20.0
    # The wheels are straight at first.
    assert np.abs(away).max() < 0.6 and abs(away[-1]) < 0.05
    assert cars.motion[2, -1, 3] < 0.25


def test_first_tracked_step_equals_the_simulator(drives):
    cars, _, _ = drives
    bend = np.tan(cars.steering[:, 1]) / WHEELBASE
    for now, then, acceleration, k in zip(
        cars.motion[:, 0], cars.motion[:, 1], cars.acceleration[:, 1], bend, strict=True
    ):
        np.testing.assert_allclose(
            bicycle(jnp.asarray(now), jnp.asarray(acceleration), jnp.asarray(k)), then, atol=1e-5
        )


@pytest.fixture(scope="module")
def executed():
    """Plans of 4 s, tracked after one fit and as the task executes them: handed over, and fitted, at every step."""
    t, space, length = np.arange(81) * DT, Trajectory(steps=40), jnp.float32(WHEELBASE / CONFIG.wheelbase)
    speed = np.stack([np.full(81, 5.0), 4.0 + np.minimum(t, 4.0), np.maximum(6.0 - 2.0 * t, 0.0)])
    bend = np.stack([np.full(81, 1 / 20), 0.03 * np.sin(t), 0 * t])
    heading = np.cumsum(speed * bend * DT, axis=1)
    x, y = (np.cumsum(speed * DT * part(heading), axis=1) for part in (np.cos, np.sin))
    poses = jnp.asarray(np.stack([x, y, heading], -1), jnp.float32)
    motions = jnp.asarray([[0.4, 0.3, 0.05, 5.0], [0.5, 0.0, 0.0, 4.0], [0.6, -0.4, 0.0, 6.0]])

    def both(motion, poses):
        plan = space.plan(poses[:41]).reshape(-1, 3)
        more = poses[40] + jnp.arange(1, 41)[:, None] * (poses[40] - poses[39]) * jnp.array([1, 1, 0])
        car, wheelbase = Car(motion, jnp.float32(0.2), jnp.float32(0.05)), jnp.float32(WHEELBASE)
        reference = Reference.fit(plan, 40, wheelbase, CONFIG)
        cars = track(car, reference, wheelbase, CONFIG, about_axle=True)
        whole = jnp.concatenate([plan, more])

        def step(now, begin):
            motion, last = now
            action = jax.lax.dynamic_slice(whole, (begin, 0), (41, 3)).reshape(-1)
            last = space.actuate(motion, action, last, length)
            motion = space.move(motion, last, length)
            return (motion, last), motion

        last = jnp.zeros(space.size).at[:2].set(jnp.array([0.2, 0.05]))
        return cars.motion[1:], jax.lax.scan(step, (motion, last), jnp.arange(40))[1]

    return quick(jax.vmap(both), motions, poses)


def test_first_step_along_a_plan_equals_the_executed_one(executed):
    tracked, driven = executed
    np.testing.assert_allclose(tracked[:, 0], driven[:, 0], atol=1e-5)


def test_drive_along_a_plan_stays_near_the_executed_one(executed):
    """They differ by the fits of later steps only."""
    tracked, driven = executed
    away = np.linalg.norm(tracked[..., :2] - driven[..., :2], axis=-1)
    assert away[:, :10].max() < 0.02 and away.max() < 0.1

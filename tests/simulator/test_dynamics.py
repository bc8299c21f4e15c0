"""The bicycle: stopping distance, circles, grip, and its inverse."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from drivax.simulator.dynamics import bicycle, follow


def drive(motion, acceleration, curvature, steps):
    def one(motion, _):
        motion = bicycle(motion, jnp.asarray(acceleration), jnp.asarray(curvature))
        return motion, motion

    return np.asarray(jax.lax.scan(one, jnp.asarray(motion, jnp.float32), None, steps)[1])


def test_full_braking_from_ten_stops_at_8_33_m_and_stays():
    path = drive([0.0, 0.0, 0.0, 10.0], -6.0, 0.0, 60)
    assert path[-1, 0] == pytest.approx(100 / 12, abs=1e-3)
    assert path[-1, 3] == 0.0
    np.testing.assert_array_equal(path[20:, :], np.broadcast_to(path[-1], path[20:].shape))
    assert (np.diff(path[:, 0]) >= 0).all()


def test_constant_curvature_drives_a_circle():
    radius, speed = 20.0, 5.0
    path = drive([0.0, 0.0, 0.0, speed], 0.0, 1 / radius, 251)
    centre = np.array([0.0, radius])
    np.testing.assert_allclose(np.linalg.norm(path[:, :2] - centre, axis=1), radius, rtol=1e-3)
    assert path[:, 2].min() >= -np.pi and path[:, 2].max() < np.pi


def test_grip_limits_curvature():
    speed = 20.0
    path = drive([0.0, 0.0, 0.0, speed], 0.0, 0.3, 10)
    turned = path[-1, 2] / (10 * 0.1)
    assert turned * speed == pytest.approx(8.0, rel=1e-3)


def test_following_a_drivable_log_reproduces_it():
    rng = np.random.default_rng(0)
    acceleration, curvature = rng.uniform(-2, 2, 60), np.repeat(rng.uniform(-0.05, 0.05, 12), 5)
    log = [np.array([0.0, 0.0, 0.0, 8.0], np.float32)]
    for a, k in zip(acceleration, curvature, strict=True):
        log.append(np.asarray(bicycle(jnp.asarray(log[-1]), jnp.asarray(a), jnp.asarray(k))))
    motion = jnp.asarray(log[0])
    for t in range(58):
        motion = bicycle(motion, *follow(motion, jnp.asarray(log[t + 1]), jnp.asarray(log[t + 2])))
        assert float(jnp.linalg.norm(motion[:2] - log[t + 1][:2])) < 0.1


def test_a_standing_car_steers_straight():
    still = jnp.array([3.0, 4.0, 1.0, 0.0])
    acceleration, curvature = follow(still, still, still.at[0].add(0.05))
    assert float(curvature) == 0.0
    assert float(acceleration) == 0.0

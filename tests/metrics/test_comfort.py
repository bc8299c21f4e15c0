"""Comfort equals SciPy's filter over the whole episode."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.signal import savgol_filter

from drivax.metrics.comfort import (
    SMOOTH,
    YAW_ACCELERATION,
    YAW_RATE,
    check_comfort,
    check_trip_comfort,
    savgol_matrix,
    savgol_tail_matrix,
)


@pytest.mark.parametrize(("window", "order", "derivative"), [SMOOTH, YAW_RATE, YAW_ACCELERATION])
def test_tail_matrix_equals_scipys_filter(window, order, derivative):
    signal = np.random.default_rng(0).normal(size=60)
    whole = savgol_filter(signal, window, order, deriv=derivative)
    for end in (40, 50):
        tail = savgol_tail_matrix(window, order, derivative) @ signal[end - 22 : end]
        cut = savgol_filter(signal[:end], window, order, deriv=derivative)
        np.testing.assert_allclose(tail, cut[-19:], atol=1e-9)
        settled = len(tail) - window // 2
        np.testing.assert_allclose(tail[:settled], whole[end - 19 : end][:settled], atol=1e-9)
    operator = savgol_matrix(41, window, order, derivative)
    whole = savgol_filter(signal[:41], window, order, deriv=derivative)
    np.testing.assert_allclose(operator @ signal[:41], whole, atol=1e-9)


def histories(speed, heading):
    """Return the 23-row history at every step of a long signal."""
    motion = np.stack([0 * speed, 0 * speed, heading, speed], -1).astype(np.float32)
    return np.stack([motion[t - 22 : t + 1] for t in range(22, len(speed))])


def test_comfort_equals_limits_on_scipys_signals():
    rng = np.random.default_rng(3)
    t = np.arange(120) * 0.1
    speed = 8 + 2.0 * np.sin(0.9 * t) + 0.4 * np.sin(5.1 * t)
    heading = 0.5 * np.sin(0.8 * t) + 0.02 * rng.normal(size=t.size).cumsum()
    result = jax.vmap(check_comfort)(jnp.asarray(histories(speed, heading)))
    a = np.diff(speed) / 0.1
    lateral = (speed[1:] + speed[:-1]) / 2 * np.diff(heading) / 0.1

    def smoothed(signal):
        # A sample before the first keeps the windows of the steps that are evaluated away from SciPy's edge.
        return savgol_filter(np.concatenate([[0.0], signal]), 8, 2)[1:]

    smooth = smoothed(a)
    fine = (smooth >= -4.05) & (smooth <= 2.40)
    fine &= np.abs(smoothed(lateral)) <= 4.89
    fine &= np.abs(savgol_filter(smooth, 15, 2, deriv=1, delta=0.1)) <= 4.13
    magnitude = np.abs(savgol_filter(smoothed(np.hypot(a, lateral)), 15, 2, deriv=1, delta=0.1))
    fine &= magnitude <= 8.37
    # Like accelerations, headings are filtered from step 1 on.
    turn = heading[1:]
    fine &= np.abs(savgol_filter(turn, 5, 2, deriv=1, delta=0.1)) <= 0.95
    fine &= np.abs(savgol_filter(turn, 5, 3, deriv=2, delta=0.1)) <= 1.93
    # A history at step t evaluates step t - 11; the last one evaluates twelve steps at once.
    running = np.concatenate([np.asarray(result.comfortable[:-1, 0]), np.asarray(result.comfortable[-1])])
    expected = fine[10:]
    assert 0.2 < expected.mean() < 0.98
    np.testing.assert_array_equal(running, expected)
    motion = jnp.asarray(np.stack([0 * speed, 0 * speed, heading, speed], -1), jnp.float32)
    whole = jax.jit(check_trip_comfort)(motion)
    np.testing.assert_array_equal(whole.comfortable, expected)
    np.testing.assert_allclose(whole.jerk_mps3, magnitude[10:], rtol=1e-3, atol=5e-3)


def test_lateral_acceleration_alone_fails_comfort():
    # 10 m/s at 0.5 rad/s is 5 m/s2: over the limit of 4.89.
    heading = np.arange(23) * 0.05
    result = check_comfort(jnp.asarray(histories(np.full(23, 10.0), heading)[0]))
    assert not bool(result.comfortable.any())
    np.testing.assert_allclose(result.lateral_mps2, 5.0, rtol=1e-3)


def test_wrapping_heading_is_comfortable():
    heading = (np.linspace(np.pi - 0.1, np.pi + 0.1, 23) + np.pi) % (2 * np.pi) - np.pi
    result = check_comfort(jnp.asarray(histories(np.full(23, 5.0), heading)[0]))
    assert bool(result.comfortable.all())


def test_steering_weave_of_1_hz_is_uncomfortable():
    """Yaw rates up to 1.26 rad/s; a window of 1.5 s, as nuPlan's devkit declares but does not use, would hide them."""
    heading = 0.2 * np.sin(2 * np.pi * 0.1 * np.arange(60))
    motion = jnp.asarray(np.stack([0 * heading, 0 * heading, heading, np.full(60, 2.0)], -1), jnp.float32)
    assert not bool(jax.jit(check_trip_comfort)(motion).comfortable.any())
    assert np.abs(savgol_filter(heading, 15, 2, deriv=1, delta=0.1)[11:-11]).max() < 0.95

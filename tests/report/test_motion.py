from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from scipy.signal import savgol_filter

from drivax.metrics.comfort import check_trip_comfort
from drivax.report.charts import COMMANDS, SIGNALS, signals
from drivax.report.pictures.drawing import Rollout
from drivax.report.pictures.player_data import pack_episode

from .conftest import make_scenario, offset_path
from .test_player_data import shorts


def wavy(steps=91):
    """A car on a wave, faster and slower: x, y, heading, speed."""
    time = np.arange(steps) * 0.1
    speed, heading = 8 + 2 * np.sin(time), 0.3 * np.sin(0.7 * time) + 3.1  # headings wrap at pi
    xy = np.cumsum(speed[:, None] * np.stack((np.cos(heading), np.sin(heading)), -1) * 0.1, axis=0)
    return np.column_stack((xy, (heading + np.pi) % (2 * np.pi) - np.pi, speed))


def test_signals_equal_scipy_savgol_filter():
    path = wavy()
    found = signals(path)
    along = np.diff(path[:, 3]) / 0.1
    heading = np.unwrap(path[:, 2])
    np.testing.assert_allclose(found["speed"], path[:, 3])
    assert all(np.isnan(found[one.name][0]) for one in SIGNALS[1:])
    # An even window's interior value belongs to half a sample later in SciPy; its edges are read off the polynomial.
    np.testing.assert_allclose(
        found["acceleration"][1:], savgol_filter(along, 8, 2, mode="interp"), atol=1e-9
    )
    jerk = savgol_filter(savgol_filter(along, 8, 2), 15, 2, 1, delta=0.1)
    np.testing.assert_allclose(found["jerk"][1:], jerk, atol=1e-9)
    rate = savgol_filter(heading[1:], 5, 2, 1, delta=0.1)
    np.testing.assert_allclose(found["yaw_rate"][1:], rate, atol=1e-9)
    middle = (path[1:, 3] + path[:-1, 3]) / 2
    np.testing.assert_allclose(found["curvature"][1:], rate / middle, atol=1e-9)


def test_lateral_acceleration_equals_the_comfort_metric():
    path = wavy().astype(np.float32)
    judged = np.asarray(check_trip_comfort(jnp.asarray(path)).lateral_mps2)
    np.testing.assert_allclose(np.abs(signals(path)["lateral"][12:]), judged[1:], atol=2e-3)


def test_circle_has_constant_curvature():
    angle = np.arange(91) * 0.1 * 6.0 / 40.0  # 6 m/s on a radius of 40 m
    path = np.column_stack((40 * np.sin(angle), 40 - 40 * np.cos(angle), angle, np.full(91, 6.0)))
    found = signals(path)
    np.testing.assert_allclose(found["curvature"][1:], 1 / 40, rtol=1e-6)
    np.testing.assert_allclose(found["lateral"][1:], 36 / 40, rtol=1e-6)
    np.testing.assert_allclose(found["jerk"][1:], 0, atol=1e-9)


def test_signals_are_nan_in_gaps_and_short_paths():
    path = wavy()
    path[:20] = np.nan
    path[80:] = np.nan
    found = signals(path)
    np.testing.assert_allclose(found["jerk"][21:80], signals(wavy()[20:80])["jerk"][1:])
    assert np.isnan(found["jerk"][:21]).all() and np.isnan(found["jerk"][80:]).all()
    path[:70] = np.nan
    short = signals(path)
    assert np.isnan(short["jerk"]).all() and np.isfinite(short["speed"][70:80]).all()
    standing = wavy()
    standing[:, 3] = 0.1
    assert np.isnan(signals(standing)["curvature"]).all()
    assert all(np.isnan(values).all() for values in signals(np.full((91, 4), np.nan)).values())


def test_packed_signals_are_within_half_a_step():
    scenario = make_scenario(0)
    ego = offset_path(scenario, 3.0)
    ego[85:] = np.nan
    asked = np.column_stack((np.linspace(-1, 1, 91), np.full(91, np.nan)))
    asked[:10] = np.nan
    packed = pack_episode(scenario, [Rollout("x", ego, 10, {}, "success", asked)], "t")["rollouts"][0][
        "signals"
    ]
    found = signals(ego) | dict(zip((one.name for one in COMMANDS), asked.T, strict=True))
    for one, text in zip((*SIGNALS, *COMMANDS), packed, strict=True):
        values = shorts(text, 91).astype(float)
        values[values == -32768] = np.nan
        np.testing.assert_allclose(values * one.step, found[one.name], atol=one.step / 2 + 1e-9)

"""Track a trajectory with two one-step linear-quadratic regulators and a bicycle model with actuator lags.

Source: nuPlan's planner simulation (LQR tracker and kinematic bicycle), which PDM-Closed uses for its proposals. The
car moves by ``simulator.dynamics.bicycle``, so the first step of a tracked proposal equals the simulator's.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from drivax.geometry.vectors import wrap
from drivax.scenario.bank.scenario_bank import Scalar
from drivax.scenario.record import record
from drivax.scenario.schema import DT_S
from drivax.simulator.dynamics import bicycle
from drivax.simulator.types import MOTION_HEADING, MOTION_SPEED


@dataclass(frozen=True)
class TrackingConfig:
    """Tracker and vehicle model; defaults as in nuPlan.

    Attributes:
        horizon: Steps for which commands are held and after which errors are measured.
        speed_weight, acceleration_weight: Costs of squared speed error and acceleration.
        lateral_weight, heading_weight, steering_weight, rate_weight: Costs of squared lateral error (m),
            heading error (rad), steering angle (rad) and steering rate (rad/s).
        stopping_mps, stopping_gain: Below this speed a stopping car uses this gain, 1/s, instead.
        acceleration_lag_s, steering_lag_s: Time constants of the actuators.
        most_steering: Largest steering angle, rad.
        wheelbase: Relative to the length (nuPlan's vehicle: 3.089 m of 5.176 m).
    """

    horizon: int = 10
    speed_weight: float = 10.0
    acceleration_weight: float = 1.0
    lateral_weight: float = 1.0
    heading_weight: float = 10.0
    steering_weight: float = 0.0
    rate_weight: float = 1.0
    stopping_mps: float = 0.2
    stopping_gain: float = 0.5
    acceleration_lag_s: float = 0.2
    steering_lag_s: float = 0.05
    most_steering: float = math.pi / 3
    wheelbase: float = 3.089 / 5.176


@record
class Car:
    """A car with actuators."""

    motion: Float[Array, "*batch 4"]  # x, y, heading, speed
    acceleration: Float[Array, "*batch"]  # m/s2
    steering: Float[Array, "*batch"]  # Angle of the front wheels, rad


@record
class Reference:
    """Reference trajectory, at steps of 0.1 s from now on."""

    pose: Float[Array, "*batch T 4"]  # x, y, cosine and sine of the heading
    speed: Float[Array, "*batch T"]  # m/s
    curvature: Float[Array, "*batch T"]  # Of the path, 1/m


def acceleration_to(speed: Scalar, desired: Scalar, config: TrackingConfig) -> Scalar:
    """Acceleration a that minimises ``q (v_N - v*)^2 + r a^2`` with ``v_N = v + N dt a`` and desired speed v*, m/s2."""
    q, r, b = config.speed_weight, config.acceleration_weight, config.horizon * DT_S
    return b * q * (desired - speed) / (b * q * b + r)


def steering_rate(
    error: tuple[Array, Array, Array], speeds: Float[Array, " N"], curvatures: Float[Array, " N"],
    wheelbase: Scalar, config: TrackingConfig,
) -> Scalar:  # fmt: skip
    """Constant steering rate u that minimises ``x_N' Q x_N + r u^2``, rad/s.

    x is (lateral error e, heading error h, steering angle d), and per step
    ``e += dt v h``, ``h += dt v (d / L - k)``, ``d += dt u``: linear in x and u. With z the state at the horizon for
    ``u = 0`` and b that for ``x = 0, k = 0, u = 1``, ``u = -b' Q z / (b' Q b + r)``. Here x is ``error``, v ``speeds``,
    k ``curvatures`` and L ``wheelbase``.
    """
    e, h, d = error
    be, bh, bd = (jnp.zeros(()) for _ in range(3))
    for step in range(config.horizon):
        way, k = speeds[step] * DT_S, curvatures[step]
        e, h = e + way * h, h + way * (d / wheelbase - k)
        be, bh, bd = be + way * bh, bh + way * bd / wheelbase, bd + DT_S
    h, d = wrap(h), wrap(d)
    q_e, q_h, q_d = config.lateral_weight, config.heading_weight, config.steering_weight
    gain = q_e * be * be + q_h * bh * bh + q_d * bd * bd + config.rate_weight
    return -(q_e * be * e + q_h * bh * h + q_d * bd * d) / gain


def moved(car: Car, acceleration: Array, rate: Array, wheelbase: Scalar, config: TrackingConfig) -> Car:
    """Return the car one step after a command; each actuator closes ``dt / (dt + lag)`` of its error."""
    share = DT_S / (DT_S + config.acceleration_lag_s), DT_S / (DT_S + config.steering_lag_s)
    acceleration = car.acceleration + share[0] * (acceleration - car.acceleration)
    steering = car.steering + share[1] * rate * DT_S
    steering = jnp.clip(steering, -config.most_steering, config.most_steering)
    motion = bicycle(car.motion, acceleration, jnp.tan(steering) / wheelbase)
    return Car(motion, acceleration, steering)


def track(car: Car, reference: Reference, wheelbase: Scalar, config: TrackingConfig) -> Car:
    """Return the car at every step of a reference, the present one included."""
    last = reference.speed.shape[0] - 1
    ahead = np.minimum(np.arange(last)[:, None] + np.arange(config.horizon), last)
    to_have = reference.speed[np.minimum(np.arange(last) + config.horizon, last)]

    def step(car: Car, now: tuple[Any, Array, Array]) -> Any:
        (x, y, cos, sin), desired, curvatures = now
        motion, speed = car.motion, car.motion[MOTION_SPEED]
        stops = (desired <= config.stopping_mps) & (speed <= config.stopping_mps)
        gentle = config.stopping_gain * (desired - speed)
        acceleration = jnp.where(stops, gentle, acceleration_to(speed, desired, config))
        lateral = (motion[1] - y) * cos - (motion[0] - x) * sin
        heading = wrap(motion[MOTION_HEADING] - jnp.arctan2(sin, cos))
        speeds = jnp.maximum(speed + acceleration * DT_S * np.arange(config.horizon), 0.0)
        rate = steering_rate((lateral, heading, car.steering), speeds, curvatures, wheelbase, config)
        car = moved(car, acceleration, jnp.where(stops, 0.0, rate), wheelbase, config)
        return car, car

    poses = tuple(reference.pose[:last].T)
    _, cars = jax.lax.scan(step, car, (poses, to_have, reference.curvature[ahead]))
    return jax.tree.map(lambda first, rest: jnp.concatenate([first[None], rest]), car, cars)

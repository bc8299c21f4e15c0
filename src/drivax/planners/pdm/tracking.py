"""Track a trajectory with two one-step linear-quadratic regulators and a bicycle model with actuator lags.

The tracker of ``simulator.controller``, with the speeds and curvatures of a proposal instead of fitted ones. The car
moves by ``simulator.dynamics.bicycle``, so the first step of a tracked proposal equals the simulator's, except in the
action space ``trajectory``, whose controller and car are others.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from drivax.geometry.vectors import wrap
from drivax.scenario.bank.scenario_bank import Scalar
from drivax.scenario.record import record
from drivax.scenario.schema import DT_S
from drivax.simulator.controller import TrackingConfig, acceleration_to, steering_rate
from drivax.simulator.dynamics import bicycle
from drivax.simulator.types import MOTION_HEADING, MOTION_SPEED


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


def step_car(car: Car, acceleration: Array, rate: Array, wheelbase: Scalar, config: TrackingConfig) -> Car:
    """Return the car one step after a command; each actuator closes ``dt / (dt + lag)`` of its error."""
    gains = DT_S / (DT_S + config.acceleration_lag_s), DT_S / (DT_S + config.steering_lag_s)
    acceleration = car.acceleration + gains[0] * (acceleration - car.acceleration)
    steering = car.steering + gains[1] * rate * DT_S
    steering = jnp.clip(steering, -config.most_steering, config.most_steering)
    motion = bicycle(car.motion, acceleration, jnp.tan(steering) / wheelbase)
    return Car(motion, acceleration, steering)


def track(car: Car, reference: Reference, wheelbase: Scalar, config: TrackingConfig) -> Car:
    """Return the car at every step of a reference, the present one included."""
    last = reference.speed.shape[0] - 1
    ahead = np.minimum(np.arange(last)[:, None] + np.arange(config.horizon), last)
    target_speed = reference.speed[np.minimum(np.arange(last) + config.horizon, last)]

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
        car = step_car(car, acceleration, jnp.where(stops, 0.0, rate), wheelbase, config)
        return car, car

    poses = tuple(reference.pose[:last].T)
    _, cars = jax.lax.scan(step, car, (poses, target_speed, reference.curvature[ahead]))
    return jax.tree.map(lambda first, rest: jnp.concatenate([first[None], rest]), car, cars)

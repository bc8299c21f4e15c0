"""Track a trajectory with two one-step linear-quadratic regulators and a bicycle model with actuator lags.

The tracker is that of ``simulator.controller``. The car moves as in the simulator, so the first step of a tracked
proposal equals the executed one if the action space can express it. The car moves by ``simulator.dynamics.bicycle`` and
tracks the speeds and curvatures of the proposal; in the action space ``trajectory``, it turns about its rear axle and
tracks speeds and curvatures that are fitted to the plan.
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
from drivax.simulator.contact import REAR_AXLE
from drivax.simulator.controller import (
    Poses,
    TrackingConfig,
    fit_curvatures,
    fit_speeds,
    propagate,
    speed_command,
    steering_rate,
)
from drivax.simulator.dynamics import bicycle
from drivax.simulator.types import MOTION_SPEED


@record
class Car:
    """Motion and actuators of a car."""

    motion: Float[Array, "*batch 4"]  # x, y, heading, speed
    acceleration: Float[Array, "*batch"]  # m/s2
    steering: Float[Array, "*batch"]  # Angle of the front wheels, rad


@record
class Reference:
    """Reference trajectory of the tracked point, at steps of 0.1 s from now on; the last values hold afterwards."""

    pose: Float[Array, "*batch T 4"]  # x, y, cosine and sine of the heading
    speed: Float[Array, "*batch N"]  # m/s
    curvature: Float[Array, "*batch N"]  # Of the path, 1/m

    @classmethod
    def fit(cls, plan: Poses, steps: int, wheelbase: Scalar, config: TrackingConfig) -> Reference:
        """Return the reference of the rear axle for planned poses of the box centre; its poses end after ``steps``.

        Speeds and curvatures are those that ``simulator.controller`` fits at the present step; it fits again later.
        """
        x, y, heading = plan.T
        cos, sin, axle_m = jnp.cos(heading), jnp.sin(heading), _axle_m(wheelbase, config)
        x, y = x - axle_m * cos, y - axle_m * sin
        poses = jnp.stack([x, y, heading], axis=-1)
        speeds = fit_speeds(poses, config)
        pose = jnp.stack([x, y, cos, sin], axis=-1)[: steps + 1]
        return cls(pose, speeds, fit_curvatures(poses, speeds, config))


def step_car(
    car: Car, acceleration: Array, rate: Array, wheelbase: Scalar, config: TrackingConfig, about_axle: bool = False
) -> Car:  # fmt: skip
    """Return the car one step after a command; each actuator closes ``dt / (dt + lag)`` of its error.

    The command has an ``acceleration`` (m/s2) and a steering ``rate`` (rad/s). ``about_axle`` selects the car of the
    action space ``trajectory``, which turns by the present steering angle.
    """
    gains = DT_S / (DT_S + config.acceleration_lag_s), DT_S / (DT_S + config.steering_lag_s)
    acceleration = car.acceleration + gains[0] * (acceleration - car.acceleration)
    steering = car.steering + gains[1] * rate * DT_S
    steering = jnp.clip(steering, -config.most_steering, config.most_steering)
    if about_axle:
        acceleration = jnp.maximum(acceleration, -car.motion[MOTION_SPEED] / DT_S)
        actuators = jnp.stack([acceleration, car.steering, jnp.zeros(())])
        motion = propagate(car.motion, actuators, wheelbase / config.wheelbase, config)
    else:
        motion = bicycle(car.motion, acceleration, jnp.tan(steering) / wheelbase)
    return Car(motion, acceleration, steering)


def track(
    car: Car, reference: Reference, wheelbase: Scalar, config: TrackingConfig, about_axle: bool = False
) -> Car:
    """Return the car at every step of a reference, the present one included; ``about_axle`` as in :func:`step_car`."""
    steps, last = reference.pose.shape[0] - 1, reference.speed.shape[0] - 1
    horizon_steps = np.minimum(np.arange(steps)[:, None] + np.arange(config.horizon), last)
    target_speed = reference.speed[np.minimum(np.arange(steps) + config.horizon, last)]
    axle_m = _axle_m(wheelbase, config) if about_axle else 0.0

    def step(car: Car, target: tuple[Any, Array, Array]) -> Any:
        (x, y, cos, sin), desired, curvatures = target
        car_x, car_y, car_heading, speed = car.motion
        car_x, car_y = car_x - axle_m * jnp.cos(car_heading), car_y - axle_m * jnp.sin(car_heading)
        acceleration, is_stopping = speed_command(speed, desired, config)
        lateral_error = (car_y - y) * cos - (car_x - x) * sin
        heading_error = wrap(car_heading - jnp.arctan2(sin, cos))
        speeds = speed + acceleration * DT_S * np.arange(config.horizon)
        speeds = speeds if about_axle else jnp.maximum(speeds, 0.0)
        errors = (lateral_error, heading_error, car.steering)
        rate = steering_rate(errors, speeds, curvatures, wheelbase, config)
        # Without the barrier XLA fuses the regulator with the motion of the car, and does not vectorise it.
        rate = jax.lax.optimization_barrier(jnp.where(is_stopping, 0.0, rate))
        car = step_car(car, acceleration, rate, wheelbase, config, about_axle)
        return car, car

    poses = tuple(reference.pose[:steps].T)
    _, cars = jax.lax.scan(step, car, (poses, target_speed, reference.curvature[horizon_steps]))
    return jax.tree.map(lambda first, rest: jnp.concatenate([first[None], rest]), car, cars)


def _axle_m(wheelbase: Scalar, config: TrackingConfig) -> Scalar:
    """Return the distance of the rear axle behind the box centre, m."""
    return REAR_AXLE * wheelbase / config.wheelbase

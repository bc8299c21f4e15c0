"""nuPlan's ego controller: an LQR that tracks planned poses, and a kinematic bicycle about the rear axle.

Source: nuplan-devkit, ``LQRTracker`` and ``KinematicBicycleModel``, with their weights. Speeds and curvatures of the
plan are fitted to its poses; commands are held over the horizon. Unlike in nuPlan, the car never reverses.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from drivax.errors import UsageError
from drivax.geometry.vectors import wrap
from drivax.scenario.bank.scenario_bank import Scalar
from drivax.scenario.schema import DT_S
from drivax.simulator.contact import REAR_AXLE
from drivax.simulator.types import MOTION_HEADING, MOTION_SPEED, History, Motion

#: Poses of a box centre or a rear axle: x, y (m), heading (rad).
Poses = Float[Array, "n 3"]
#: Actuator states in a step: acceleration (m/s2), steering angle at its start (rad), steering rate (rad/s).
Actuators = Float[Array, " 3"]
ACCELERATION, STEERING, RATE = range(3)
#: Regularisation of the first curvature, which a plan without motion does not determine.
_FIRST_CURVATURE = 1e-10
#: Steps for initial acceleration and steering; distance driven in them up to which steering is 0, m.
_RECENT, _STILL_M = 5, 0.5
#: Settings that cannot be 0: most divide, or keep a divisor away from 0.
_POSITIVE = (
    "horizon", "acceleration_weight", "rate_weight", "most_steering", "wheelbase", "curvature_rate_penalty"
)  # fmt: skip


@dataclass(frozen=True)
class TrackingConfig:
    """Tracker and vehicle model; defaults as in nuPlan.

    Attributes:
        horizon: Steps for which commands are held and after which errors are measured.
        speed_weight, acceleration_weight: Costs of squared speed error and acceleration.
        lateral_weight, heading_weight, steering_weight, rate_weight: Costs of squared lateral error (m),
            heading error (rad), steering angle (rad) and steering rate (rad/s).
        stopping_mps, stopping_gain: Where neither actual nor desired speed exceeds this speed, the acceleration is the
            speed error times this gain, 1/s.
        acceleration_lag_s, steering_lag_s: Time constants of the actuators.
        most_steering: Largest steering angle, rad.
        wheelbase: Relative to the length (nuPlan's vehicle: 3.089 m of 5.176 m).
        jerk_penalty, curvature_rate_penalty: Costs of squared changes of acceleration, and of squared curvature rates,
            where speeds and curvatures are fitted to poses.
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
    jerk_penalty: float = 1e-4
    curvature_rate_penalty: float = 1e-2

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not 0.0 <= value < math.inf or (name in _POSITIVE and not value):
                cure = "use a positive number" if name in _POSITIVE else "use 0 or a positive number"
                raise UsageError(f"{name} is {value:g}", cure=cure)
        if self.most_steering >= math.pi / 2:
            problem = f"most_steering is {self.most_steering:g} rad"
            raise UsageError(problem, cure="use less than a right angle (1.57)")


def acceleration_to(speed: Scalar, desired: Scalar, config: TrackingConfig) -> Scalar:
    """Acceleration a, m/s2, minimising ``q (v_N - v*)^2 + r a^2`` with ``v_N = v + N dt a`` and desired speed v*."""
    q, r, b = config.speed_weight, config.acceleration_weight, config.horizon * DT_S
    return b * q * (desired - speed) / (b * q * b + r)


def speed_command(speed: Scalar, desired: Scalar, config: TrackingConfig) -> tuple[Scalar, Bool[Array, ""]]:
    """Return the commanded acceleration, m/s2, and whether the car is stopping: its wheels then keep their angle."""
    is_stopping = (desired <= config.stopping_mps) & (speed <= config.stopping_mps)
    stopping = config.stopping_gain * (desired - speed)
    return jnp.where(is_stopping, stopping, acceleration_to(speed, desired, config)), is_stopping


def steering_rate(
    error: tuple[Array, Array, Array], speeds: Float[Array, " N"], curvatures: Float[Array, " N"],
    wheelbase: Scalar, config: TrackingConfig,
) -> Scalar:  # fmt: skip
    """Constant steering rate u (rad/s) that minimises ``x_N' Q x_N + r u^2``.

    x = (lateral error e, m; heading error h and steering angle d, rad) starts at ``error``. In a step with speed v,
    curvature k and wheelbase L, ``e += dt v h``, ``h += dt v (d / L - k)``, ``d += dt u``: linear in x and u. With z
    the state at the horizon for ``u = 0`` and b that for ``x = 0, k = 0, u = 1``, ``u = -b' Q z / (b' Q b + r)``.
    """
    e, h, d = error
    be, bh, bd = (jnp.zeros(()) for _ in range(3))
    for step in range(config.horizon):
        distance, k = speeds[step] * DT_S, curvatures[step]
        e, h = e + distance * h, h + distance * (d / wheelbase - k)
        be, bh, bd = be + distance * bh, bh + distance * bd / wheelbase, bd + DT_S
    h, d = wrap(h), wrap(d)
    q_e, q_h, q_d = config.lateral_weight, config.heading_weight, config.steering_weight
    gain = q_e * be * be + q_h * bh * bh + q_d * bd * bd + config.rate_weight
    return -(q_e * be * e + q_h * bh * h + q_d * bd * d) / gain


def fit_speeds(poses: Poses, config: TrackingConfig) -> Float[Array, " m"]:
    """Fit speeds v (m/s) of steps between poses: least squares of ``dt v_k - s_k`` plus a penalty on jerk.

    s is the displacement along the heading at the start of each step; ``v_k = v_0 + dt (a_0 + ... + a_(k-1))``, and the
    penalty is on ``(a_(k+1) - a_k)^2``. The solution is linear in s.
    """
    shift, heading = jnp.diff(poses[:, :2], axis=0), poses[:-1, 2]
    along = shift[:, 0] * jnp.cos(heading) + shift[:, 1] * jnp.sin(heading)
    return jnp.asarray(_speed_fit(along.shape[0], config.jerk_penalty), along.dtype) @ along


@functools.cache
def _speed_fit(steps: int, penalty: float) -> np.ndarray[tuple[int, int], np.dtype[np.float64]]:
    """Return the matrix from displacements to fitted speeds."""
    # Matrices from the unknowns v_0, a_0, a_1, ... to the speeds, and to the changes of acceleration.
    speeds = np.tri(steps) * DT_S
    speeds[:, 0] = 1.0
    jerk = np.diff(np.eye(steps)[1:], axis=0)
    normal = DT_S**2 * speeds.T @ speeds + penalty * jerk.T @ jerk
    return speeds @ np.linalg.solve(normal, speeds.T * DT_S)


def fit_curvatures(poses: Poses, speeds: Float[Array, " m"], config: TrackingConfig) -> Float[Array, " m"]:
    """Fit curvatures k (1/m) of steps between poses: least squares of ``dt v k - turn`` plus a penalty on their rate.

    The solution is ``k = c (1 - g) + u``: u are the curvatures for a first curvature of 0, ``1 - g`` their
    derivative with respect to the first one (two tridiagonal systems), and c is the first one. This elimination is
    accurate in single precision at any speed.
    """
    turn, distance = wrap(jnp.diff(poses[:, 2])), speeds * DT_S
    weight = config.curvature_rate_penalty / DT_S**2
    size = distance.shape[0] - 1
    diagonal = distance[1:] ** 2 + weight * jnp.where(jnp.arange(size) < size - 1, 2.0, 1.0)
    below, above = (jnp.full(size, -weight).at[end].set(0.0) for end in (0, -1))
    right_side = jnp.stack([distance[1:] * turn[1:], distance[1:] ** 2], axis=-1)
    u, g = jnp.pad(jax.lax.linalg.tridiagonal_solve(below, diagonal, above, right_side), ((1, 0), (0, 0))).T
    first = jnp.sum(distance * (turn - distance * u)) / (jnp.sum(distance**2 * (1.0 - g)) + _FIRST_CURVATURE)
    return first * (1.0 - g) + u


def track(
    motion: Motion, plan: Poses, last: Actuators, length_m: Scalar, config: TrackingConfig
) -> Actuators:
    """Return the actuator states of the next step, in which the car follows a plan.

    Args:
        motion: Motion of the box centre.
        plan: Planned poses of the box centre from the present step on, 0.1 s apart.
        last: Actuator states of the step before.
        length_m: Length of the car.
        config: Tracker and vehicle model.
    """
    axle, poses = _rear_axle(motion[None, :3], length_m)[0], _rear_axle(plan, length_m)
    speed, steering, wheelbase = motion[MOTION_SPEED], steering_of(last, config), config.wheelbase * length_m
    speeds = fit_speeds(poses, config)
    desired = speeds[min(config.horizon, speeds.shape[0] - 1)]
    curvatures = fit_curvatures(poses, speeds, config)
    curvatures = curvatures[np.minimum(np.arange(config.horizon), speeds.shape[0] - 1)]
    acceleration, is_stopping = speed_command(speed, desired, config)
    cos, sin, offset = jnp.cos(poses[0, 2]), jnp.sin(poses[0, 2]), axle - poses[0]
    error = offset[1] * cos - offset[0] * sin, wrap(offset[2]), steering
    speeds_ahead = speed + acceleration * DT_S * np.arange(config.horizon)
    rate = steering_rate(error, speeds_ahead, curvatures, wheelbase, config)
    rate = jnp.where(is_stopping, 0.0, rate)
    change = _lag_share(config.acceleration_lag_s) * (acceleration - last[ACCELERATION])
    acceleration = jnp.maximum(last[ACCELERATION] + change, -speed / DT_S)  # Never reverse.
    return jnp.stack([acceleration, steering, _lag_share(config.steering_lag_s) * rate])


def recent_actuators(history: History, length_m: Scalar, config: TrackingConfig) -> Actuators:
    """Return mean acceleration and steering angle of the last half second of a motion, and no steering rate."""
    before, now = history[-1 - _RECENT], history[-1]
    distance_m = (before[MOTION_SPEED] + now[MOTION_SPEED]) / 2 * _RECENT * DT_S
    turn = wrap(now[MOTION_HEADING] - before[MOTION_HEADING])
    curvature = jnp.where(distance_m > _STILL_M, turn / jnp.maximum(distance_m, _STILL_M), 0.0)
    steering = jnp.arctan(curvature * config.wheelbase * length_m)
    acceleration = (now[MOTION_SPEED] - before[MOTION_SPEED]) / (_RECENT * DT_S)
    limit = config.most_steering
    return jnp.stack([acceleration, jnp.clip(steering, -limit, limit), jnp.zeros(())])


def steering_of(last: Actuators, config: TrackingConfig) -> Scalar:
    """Return the steering angle after a step, rad."""
    return jnp.clip(last[STEERING] + last[RATE] * DT_S, -config.most_steering, config.most_steering)


def propagate(motion: Motion, actuators: Actuators, length_m: Scalar, config: TrackingConfig) -> Motion:
    """Return the motion of the box centre one step later: the rear axle moves at the present speed and steering."""
    speed, distance = motion[MOTION_SPEED], motion[MOTION_SPEED] * DT_S
    x, y, heading = _rear_axle(motion[None, :3], length_m)[0]
    turn = distance * jnp.tan(actuators[STEERING]) / (config.wheelbase * length_m)
    x, y, heading = x + distance * jnp.cos(heading), y + distance * jnp.sin(heading), wrap(heading + turn)
    to_centre = REAR_AXLE * length_m
    next_speed = jnp.maximum(speed + actuators[ACCELERATION] * DT_S, 0.0)
    return jnp.stack(
        [x + to_centre * jnp.cos(heading), y + to_centre * jnp.sin(heading), heading, next_speed]
    )


def _rear_axle(poses: Poses, length_m: Scalar) -> Poses:
    """Return the poses of the rear axle from those of the box centre."""
    x, y, heading = poses.T
    to_axle = REAR_AXLE * length_m
    return jnp.stack([x - to_axle * jnp.cos(heading), y - to_axle * jnp.sin(heading), heading], axis=-1)


def _lag_share(lag_s: float) -> float:
    """Return the share of the error that a first-order lag closes in a step."""
    return DT_S / (DT_S + lag_s)

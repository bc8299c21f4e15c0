"""Dynamics of a driven agent over one step of 0.1 s.

:func:`bicycle` is the default; :func:`displace` moves by a displacement in the agent's own frame (``delta_local``).
Everything is differentiable, with finite gradients at standstill, where headings wrap, and at every limit.
"""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from drivax.geometry.vectors import norm, rotate, wrap
from drivax.scenario.bank.scenario_bank import Scalar, Vector
from drivax.scenario.schema import DT_S
from drivax.simulator.types import Motion

#: Grip limit: largest ``|curvature| v^2``, m/s2.
GRIP_MPS2 = 8.0
#: Moves shorter than this are straight, m.
_STILL_M = 0.1
#: Minimum distance ahead of a point that pure pursuit steers to, m.
_MIN_PURSUIT_M = 1.0
#: Gain on the along-track error when following a log, 1/s2.
_ALONG_GAIN = 1.0


def bicycle(motion: Motion, acceleration: Scalar, curvature: Scalar) -> Motion:
    """Drive at an acceleration (m/s2) along an arc of a curvature (1/m, positive to the left).

    The position moves along the mean heading. Grip limits the curvature at the present speed, ``|k| v^2 <= 8 m/s2``.
    """
    x, y, heading, speed = motion[0], motion[1], motion[2], motion[3]
    limit = GRIP_MPS2 / jnp.maximum(speed * speed, 1e-3)
    curvature = jnp.clip(curvature, -limit, limit)
    distance, next_speed = accelerate(speed, acceleration)
    turn = curvature * distance
    mean_heading = heading + turn / 2.0
    dx, dy = distance * jnp.cos(mean_heading), distance * jnp.sin(mean_heading)
    return jnp.stack([x + dx, y + dy, wrap(heading + turn), next_speed])


def accelerate(speed: Float[Array, "*R"], acceleration: Float[Array, "*R"]) -> tuple[Array, Array]:
    """Return the distance (m) of a step at a constant acceleration, and the speed (m/s) after it.

    A car that would reach a negative speed stops within the step after ``v^2 / (2 |a|)``: no creep, no reverse.
    """
    unbounded_speed = speed + acceleration * DT_S
    is_stopping = unbounded_speed < 0.0
    next_speed = jnp.where(is_stopping, 0.0, unbounded_speed)
    braking = jnp.where(is_stopping, -acceleration, 1.0)  # 1 where unused, so that gradients stay finite
    distance = jnp.where(is_stopping, speed * speed / (2.0 * braking), (speed + next_speed) / 2.0 * DT_S)
    return distance, next_speed


def displace(motion: Motion, shift: Vector, turn: Scalar) -> Motion:
    """Move by ``shift`` metres (ahead, left) in the agent's own frame, then turn by ``turn`` rad.

    The new speed is the distance over the step. Grip does not limit it, and an agent may slide sideways.
    """
    x, y = motion[:2] + rotate(shift, jnp.cos(motion[2]), jnp.sin(motion[2]))
    return jnp.stack([x, y, wrap(motion[2] + turn), norm(shift) / DT_S])


def displacement(motion: Motion, target: Motion) -> tuple[Vector, Scalar]:
    """Return shift (ahead, left, m) and turn (rad) from one motion to another; the inverse of :func:`displace`."""
    shift = rotate(target[:2] - motion[:2], jnp.cos(motion[2]), -jnp.sin(motion[2]))
    return shift, wrap(target[2] - motion[2])


def command_between(before: Motion, now: Motion) -> tuple[Scalar, Scalar]:
    """Return the acceleration and curvature of :func:`bicycle` between two motions; moves below 0.1 m are straight."""
    distance = (before[3] + now[3]) / 2.0 * DT_S
    turn = wrap(now[2] - before[2])
    curvature = jnp.where(distance > _STILL_M, turn / jnp.maximum(distance, _STILL_M), 0.0)
    return (now[3] - before[3]) / DT_S, curvature


def follow(motion: Motion, target: Motion, next_target: Motion) -> tuple[Scalar, Scalar]:
    """Return the acceleration and curvature that follow a log, from its motions one and two steps ahead.

    The acceleration is the speed error over one step, plus 1/s^2 times the along-track error; the curvature is that of
    the circle through the second position, 0 for moves below 0.1 m.
    """
    cos, sin = jnp.cos(motion[2]), jnp.sin(motion[2])
    # Along-track error: how far the log is ahead of where the mean speed takes the car.
    offset = target[:2] - motion[:2]
    along_error = offset[0] * cos + offset[1] * sin - (motion[3] + target[3]) / 2 * DT_S
    acceleration = (target[3] - motion[3]) / DT_S + _ALONG_GAIN * along_error
    next_offset = next_target[:2] - motion[:2]
    forward, left = next_offset[0] * cos + next_offset[1] * sin, next_offset[1] * cos - next_offset[0] * sin
    squared_m2 = forward * forward + left * left
    curvature = jnp.where(squared_m2 > _STILL_M**2, 2.0 * left / jnp.maximum(squared_m2, _STILL_M**2), 0.0)
    return acceleration, curvature


def pursuit(pose: Float[Array, " pose"], offset: Float[Array, " 2"]) -> Scalar:
    """Return the curvature (1/m) of the arc from a pose to a point, 0 for a point less than 1 m ahead.

    Pure pursuit (Coulter 1992): ``k = 2 y / L^2`` for a point at (x, y) in the frame of the pose, at distance L.
    ``pose`` begins with x, y, cos and sin of the heading, as a box does; ``offset`` points from the pose to the point.
    """
    forward = offset[0] * pose[2] + offset[1] * pose[3]
    left = offset[1] * pose[2] - offset[0] * pose[3]
    curvature = 2.0 * left / jnp.maximum(forward * forward + left * left, _MIN_PURSUIT_M**2)
    return jnp.where(forward > _MIN_PURSUIT_M, curvature, 0.0)

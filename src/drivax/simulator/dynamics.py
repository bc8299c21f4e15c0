"""How a driven agent moves in one step of 0.1 s. Motions are (x, y, heading, speed); speed is never negative.

:func:`bicycle` is the default; :func:`displace` moves by a displacement in the agent's own frame (``delta_local``);
a state that is given outright (``direct_state``) needs no function. Everything is differentiable, with gradients that
are finite at a standstill, at the turn of the circle and at every limit.
"""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from drivax.geometry.vectors import norm, rotate, wrap
from drivax.scenario.schema import DT_S

#: Grip limit |curvature| v^2, m/s2.
GRIP_MPS2 = 8.0
#: Moves shorter than this say nothing about curvature, m.
_STILL_M = 0.1
#: Gain on the along-track error when following a log, 1/s.
_ALONG_GAIN = 1.0


def bicycle(
    motion: Float[Array, " 4"], acceleration: Float[Array, ""], curvature: Float[Array, ""]
) -> Float[Array, " 4"]:
    """One step of 0.1 s: the car drives the distance it really travels and turns by curvature times distance.

    A car that would go below zero speed stops inside the step after ``v^2 / (2 |a|)`` and stays: no creep, no reverse.
    The curvature is limited to what grip allows at the present speed, ``|k| v^2 <= 8 m/s2``.

    Args:
        motion: x, y (m), heading (rad), speed (m/s, not negative).
        acceleration: m/s2.
        curvature: 1/m, positive to the left.
    """
    x, y, heading, speed = motion[0], motion[1], motion[2], motion[3]
    limit = GRIP_MPS2 / jnp.maximum(speed * speed, 1e-3)
    curvature = jnp.clip(curvature, -limit, limit)
    unclipped = speed + acceleration * DT_S
    stops = unclipped < 0.0
    after = jnp.where(stops, 0.0, unclipped)
    braking = jnp.where(stops, -acceleration, 1.0)
    distance = jnp.where(stops, speed * speed / (2.0 * braking), (speed + after) / 2.0 * DT_S)
    turn = curvature * distance
    mean = heading + turn / 2.0
    return jnp.stack(
        [x + distance * jnp.cos(mean), y + distance * jnp.sin(mean), wrap(heading + turn), after]
    )


def displace(
    motion: Float[Array, " 4"], shift: Float[Array, " 2"], turn: Float[Array, ""]
) -> Float[Array, " 4"]:
    """Moves by ``shift`` metres (ahead, left) in the agent's own frame, then turns by ``turn`` rad.

    The new speed is the distance over the step, so that a chain of displacements has the speed of its path. Nothing
    limits it: there is no grip, and an agent may slide sideways.
    """
    step = rotate(shift, jnp.cos(motion[2]), jnp.sin(motion[2]))
    place = motion[:2] + step
    return jnp.stack([place[0], place[1], wrap(motion[2] + turn), norm(shift) / DT_S])


def displacement(
    motion: Float[Array, " 4"], target: Float[Array, " 4"]
) -> tuple[Float[Array, " 2"], Float[Array, ""]]:
    """The inverse of :func:`displace`: shift (ahead, left, m) and turn (rad) from a motion to another."""
    shift = rotate(target[:2] - motion[:2], jnp.cos(motion[2]), -jnp.sin(motion[2]))
    return shift, wrap(target[2] - motion[2])


def command_between(
    before: Float[Array, " 4"], now: Float[Array, " 4"]
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """The acceleration and curvature that :func:`bicycle` was driven with, from the motions around a step.

    Moves under 0.1 m say nothing about curvature and count as straight.
    """
    distance = (before[3] + now[3]) / 2.0 * DT_S
    turn = wrap(now[2] - before[2])
    curvature = jnp.where(distance > _STILL_M, turn / jnp.maximum(distance, _STILL_M), 0.0)
    return (now[3] - before[3]) / DT_S, curvature


def follow(
    motion: Float[Array, " 4"], target: Float[Array, " 4"], beyond: Float[Array, " 4"]
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Acceleration and curvature that follow a log (semantics, ``expert_actions``).

    The speed error is closed in one step, plus 1/s times the along-track error; the curvature is that of the circle
    through the position logged two steps ahead; moves under 0.1 m steer straight.

    Args:
        motion: The car now.
        target: Logged motion one step ahead.
        beyond: Logged motion two steps ahead.
    """
    cos, sin = jnp.cos(motion[2]), jnp.sin(motion[2])
    # Where the car gets to if it keeps its speed on average, against where the log is.
    ahead = target[:2] - motion[:2]
    along = ahead[0] * cos + ahead[1] * sin - (motion[3] + target[3]) / 2 * DT_S
    acceleration = (target[3] - motion[3]) / DT_S + _ALONG_GAIN * along
    aim = beyond[:2] - motion[:2]
    forward, left = aim[0] * cos + aim[1] * sin, aim[1] * cos - aim[0] * sin
    squared = forward * forward + left * left
    curvature = jnp.where(squared > _STILL_M**2, 2.0 * left / jnp.maximum(squared, _STILL_M**2), 0.0)
    return acceleration, curvature

"""Constant-velocity forecast: future boxes, times to overlap with ego, and at-fault collisions."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from drivax.geometry.boxes import COS, LENGTH, SIN, WIDTH, X, Y, overlap_within
from drivax.geometry.vectors import norm
from drivax.scenario.bank.scenario_bank import Integer, Vector
from drivax.scenario.record import record
from drivax.scenario.schema import DT_S
from drivax.simulator.contact import classify_contacts, others_on_level
from drivax.simulator.types import MOTION_HEADING, MOTION_SPEED, MOTION_X, MOTION_Y, Frame

#: Samples of the next five seconds.
_LOOKS, _LOOK_S = 11, 0.5
#: Weight of the present distance relative to the distance from the path.
_FURTHER = 0.02


@record
class Forecast:
    """Agents that keep their velocity and heading."""

    box: Float[Array, "K 6"]  # Their boxes now
    velocity: Float[Array, "K 2"]  # m/s
    kind: Int[Array, " K"]  # ``scenario.schema.AgentKind``
    valid: Bool[Array, " K"]  # Mask of present agents

    @classmethod
    def of(
        cls, frame: Frame, slot: Integer, ignored: Bool[Array, " S"], way: Float[Array, "M 2"],
        most: int, radius_m: float,
    ) -> Forecast:  # fmt: skip
        """Select the ``most`` agents within ``radius_m`` that come nearest to ego's path ``way`` in five seconds."""
        away = norm(frame.box[:, :2] - frame.box[slot, :2])
        counts = others_on_level(frame, slot) & ~ignored & (away <= radius_m)
        times = jnp.arange(_LOOKS)[:, None] * _LOOK_S
        x = frame.box[:, X] + times * frame.velocity[:, 0]
        y = frame.box[:, Y] + times * frame.velocity[:, 1]
        squared = (x - way[:, 0, None, None]) ** 2 + (y - way[:, 1, None, None]) ** 2
        reach = norm(frame.box[:, LENGTH : WIDTH + 1]) / 2
        clear = jnp.maximum(jnp.sqrt(jnp.min(squared, axis=(0, 1))) - reach, 0.0)
        rank = jnp.where(counts, clear + _FURTHER * away, jnp.inf)
        _, rows = jax.lax.top_k(-rank, min(most, away.shape[0]))
        return cls(frame.box[rows], frame.velocity[rows], frame.kind[rows], counts[rows])

    def at(self, times_s: Float[Array, " T"]) -> Float[Array, "T K 6"]:
        """Boxes at each time."""
        times = times_s[:, None]
        moved = (self.box[:, X] + times * self.velocity[:, 0], self.box[:, Y] + times * self.velocity[:, 1])
        same = (jnp.broadcast_to(self.box[:, part], moved[0].shape) for part in (COS, SIN, LENGTH, WIDTH))
        return jnp.stack([*moved, *same], axis=-1)


def boxes_of(motion: Float[Array, "*T 4"], size: Vector) -> Float[Array, "*T 6"]:
    """Boxes of one size at motions (x, y, heading, speed)."""
    heading = motion[..., MOTION_HEADING]
    length, width = (jnp.broadcast_to(part, heading.shape) for part in size)
    parts = (motion[..., MOTION_X], motion[..., MOTION_Y], jnp.cos(heading), jnp.sin(heading), length, width)
    return jnp.stack(parts, axis=-1)


def overlapping(
    motion: Float[Array, "T 4"], size: Vector, others: Forecast, horizon_s: float = 0.0
) -> Bool[Array, "T K"]:
    """Mask of the agents that ego overlaps within a horizon from each step of a motion, at constant velocities."""
    me = boxes_of(motion, size)[:, None]
    velocity = me[..., COS : SIN + 1] * motion[:, None, MOTION_SPEED, None]
    then = others.at(jnp.arange(motion.shape[0]) * DT_S)
    return overlap_within(me, velocity, then, others.velocity, horizon_s) & others.valid


def fault_times(
    motion: Float[Array, "T 4"], size: Vector, others: Forecast, touching: Bool[Array, "T K"],
    unlawful: Bool[Array, " T"],
) -> Float[Array, " K"]:  # fmt: skip
    """Return the time of the first at-fault collision with each agent, s; infinite for none.

    ``simulator.contact.classify_contacts`` decides the fault at the first overlap (``touching``: :func:`overlapping`);
    ``unlawful`` masks the steps at which ego is in several lanes or off the road.
    """
    steps = jnp.arange(motion.shape[0])
    first = jnp.min(jnp.where(touching, steps[:, None].astype(jnp.float32), jnp.inf), axis=0)
    hit = jnp.isfinite(first)
    step = jnp.where(hit, first, 0.0).astype(jnp.int32)
    me = boxes_of(motion[step], size)
    moved = others.box.at[:, :2].add(others.velocity * (step * DT_S)[:, None])
    speeds = norm(others.velocity)

    def at_fault(both: Array, kind: Array, speed: Array, other: Array, several: Array) -> Array:
        two, slot = jnp.zeros(2), jnp.zeros((), jnp.int32)
        kinds, lights = jnp.stack([kind, kind]), jnp.zeros(0, jnp.int32)
        frame = Frame(both, jnp.zeros((2, 2)), two, two == 0.0, kinds, lights)
        return classify_contacts(frame, slot, jnp.arange(2) == 1, speed, two + other, several)[0][1]

    pairs = jnp.stack([me, moved], axis=1)
    fault = jax.vmap(at_fault)(pairs, others.kind, motion[step, MOTION_SPEED], speeds, unlawful[step])
    return jnp.where(hit & fault, first * DT_S, jnp.inf)

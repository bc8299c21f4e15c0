"""Constant-velocity forecast: future boxes, times to overlap with ego, and at-fault collisions."""

from __future__ import annotations

from functools import partial

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


@record
class Contacts:
    """First contact of ego's motion with each agent, and whose fault it is."""

    touches: Bool[Array, "*batch K"]
    step: Int[Array, "*batch K"]  # Of the motion; 0 without a contact
    lawful_fault: Bool[Array, "*batch K"]  # Ego's fault if it is in a single lane and on the road
    unlawful_fault: Bool[Array, "*batch K"]  # Ego's fault otherwise

    @classmethod
    def along(cls, motion: Float[Array, "T 4"], size: Vector, others: Forecast) -> Contacts:
        """Find the first overlap with each agent; ``simulator.contact.classify_contacts`` decides its fault."""
        steps = jnp.arange(motion.shape[0])
        touching = overlapping(motion, size, others)
        first = jnp.min(jnp.where(touching, steps[:, None].astype(jnp.float32), jnp.inf), axis=0)
        touches = jnp.isfinite(first)
        step = jnp.where(touches, first, 0.0).astype(jnp.int32)
        me = boxes_of(motion[step], size)
        moved = others.box.at[:, :2].add(others.velocity * (step * DT_S)[:, None])

        def at_fault(unlawful: bool, both: Array, kind: Array, speed: Array, other: Array) -> Array:
            zeros, slot = jnp.zeros(2), jnp.zeros((), jnp.int32)
            kinds, lights = jnp.stack([kind, kind]), jnp.zeros(0, jnp.int32)
            frame = Frame(both, jnp.zeros((2, 2)), zeros, zeros == 0.0, kinds, lights)
            fresh = jnp.arange(2) == 1
            return classify_contacts(frame, slot, fresh, speed, zeros + other, jnp.asarray(unlawful))[0][1]

        pairs = jnp.stack([me, moved], axis=1)
        contacts = pairs, others.kind, motion[step, MOTION_SPEED], norm(others.velocity)
        faults = (jax.vmap(partial(at_fault, unlawful))(*contacts) for unlawful in (False, True))
        return cls(touches, step, *faults)

    def needs_lanes(self, steps: int) -> Bool[Array, " T"]:
        """Mask of the steps at which a fault depends on lanes and road."""
        depends = self.touches & (self.lawful_fault != self.unlawful_fault)
        return ((self.step == jnp.arange(steps)[:, None]) & depends).any(axis=1)

    def fault_times(self, unlawful: Bool[Array, " T"]) -> Float[Array, " K"]:
        """Return the time of the contact with each agent if it is at fault, s, else infinity.

        ``unlawful`` masks the steps at which ego is in several lanes or off the road.
        """
        fault = jnp.where(unlawful[self.step], self.unlawful_fault, self.lawful_fault)
        return jnp.where(self.touches & fault, self.step * DT_S, jnp.inf)

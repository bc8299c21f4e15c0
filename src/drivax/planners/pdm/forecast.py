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

#: Number and interval of the samples of the next five seconds.
_SAMPLES, _SAMPLE_S = 11, 0.5
#: Weight of the present distance from ego relative to the distance from the path.
_DISTANCE_WEIGHT = 0.02


@record
class Forecast:
    """Agents that keep their velocity and heading."""

    box: Float[Array, "K 6"]  # Boxes at the present step
    velocity: Float[Array, "K 2"]  # m/s
    kind: Int[Array, " K"]  # ``scenario.schema.AgentKind``
    valid: Bool[Array, " K"]  # Mask of present agents

    @classmethod
    def of(
        cls, frame: Frame, slot: Integer, is_ignored: Bool[Array, " S"], path: Float[Array, "M 2"],
        count: int, radius_m: float,
    ) -> Forecast:  # fmt: skip
        """Select up to ``count`` agents within ``radius_m`` of ego that come nearest to its path in five seconds.

        Of agents equally near to the path, those nearer to ego come first. Rows without an agent are not ``valid``.
        """
        distance = norm(frame.box[:, :2] - frame.box[slot, :2])
        is_eligible = others_on_level(frame, slot) & ~is_ignored & (distance <= radius_m)
        times = jnp.arange(_SAMPLES)[:, None] * _SAMPLE_S
        x = frame.box[:, X] + times * frame.velocity[:, 0]
        y = frame.box[:, Y] + times * frame.velocity[:, 1]
        squared_distance = (x - path[:, 0, None, None]) ** 2 + (y - path[:, 1, None, None]) ** 2
        radius = norm(frame.box[:, LENGTH : WIDTH + 1]) / 2
        clearance = jnp.maximum(jnp.sqrt(jnp.min(squared_distance, axis=(0, 1))) - radius, 0.0)
        rank = jnp.where(is_eligible, clearance + _DISTANCE_WEIGHT * distance, jnp.inf)
        _, rows = jax.lax.top_k(-rank, min(count, distance.shape[0]))
        return cls(frame.box[rows], frame.velocity[rows], frame.kind[rows], is_eligible[rows])

    def at(self, times_s: Float[Array, " T"]) -> Float[Array, "T K 6"]:
        """Return the boxes at each time."""
        times = times_s[:, None]
        x, y = (self.box[:, axis] + times * self.velocity[:, axis] for axis in (X, Y))
        constants = (jnp.broadcast_to(self.box[:, column], x.shape) for column in (COS, SIN, LENGTH, WIDTH))
        return jnp.stack([x, y, *constants], axis=-1)


def boxes_of(motion: Float[Array, "*T 4"], size: Vector) -> Float[Array, "*T 6"]:
    """Return boxes of one size at motions (x, y, heading, speed)."""
    heading = motion[..., MOTION_HEADING]
    length, width = (jnp.broadcast_to(extent, heading.shape) for extent in size)
    x, y = motion[..., MOTION_X], motion[..., MOTION_Y]
    return jnp.stack([x, y, jnp.cos(heading), jnp.sin(heading), length, width], axis=-1)


def predict_overlaps(
    motion: Float[Array, "T 4"], size: Vector, others: Forecast, horizon_s: float = 0.0
) -> Bool[Array, "T K"]:
    """Return the mask of agents that ego overlaps within a horizon of each step of a motion, at constant velocities."""
    ego_box = boxes_of(motion, size)[:, None]
    velocity = ego_box[..., COS : SIN + 1] * motion[:, None, MOTION_SPEED, None]
    boxes = others.at(jnp.arange(motion.shape[0]) * DT_S)
    return overlap_within(ego_box, velocity, boxes, others.velocity, horizon_s) & others.valid


@record
class Contacts:
    """First contact of ego's motion with each agent, and whether ego is at fault."""

    touches: Bool[Array, "*batch K"]  # Mask of the agents that ego touches
    step: Int[Array, "*batch K"]  # Step of the motion; 0 without a contact
    lawful_fault: Bool[Array, "*batch K"]  # Ego's fault if it is in a single lane and on the road
    unlawful_fault: Bool[Array, "*batch K"]  # Ego's fault otherwise

    @classmethod
    def along(cls, motion: Float[Array, "T 4"], size: Vector, others: Forecast) -> Contacts:
        """Find the first overlap with each agent, and ego's fault in it (``simulator.contact.classify_contacts``)."""
        steps = jnp.arange(motion.shape[0])
        is_touching = predict_overlaps(motion, size, others)
        first = jnp.min(jnp.where(is_touching, steps[:, None].astype(jnp.float32), jnp.inf), axis=0)
        touches = jnp.isfinite(first)
        step = jnp.where(touches, first, 0.0).astype(jnp.int32)
        ego_boxes = boxes_of(motion[step], size)
        other_boxes = others.box.at[:, :2].add(others.velocity * (step * DT_S)[:, None])

        def is_at_fault(
            is_unlawful: bool, boxes: Array, kind: Array, speed: Array, other_speed: Array
        ) -> Array:
            """Return whether ego, the first of two boxes, is at fault in its contact with the other."""
            # A frame of two; height, velocities, lights and ego's kind do not matter.
            zeros, slot = jnp.zeros(2), jnp.zeros((), jnp.int32)
            kinds, lights = jnp.stack([kind, kind]), jnp.zeros(0, jnp.int32)
            frame = Frame(boxes, jnp.zeros((2, 2)), zeros, zeros == 0.0, kinds, lights)
            is_new, speeds = jnp.arange(2) == 1, zeros + other_speed
            return classify_contacts(frame, slot, is_new, speed, speeds, jnp.asarray(is_unlawful))[0][1]

        pairs = jnp.stack([ego_boxes, other_boxes], axis=1)
        contacts = pairs, others.kind, motion[step, MOTION_SPEED], norm(others.velocity)
        faults = (jax.vmap(partial(is_at_fault, is_unlawful))(*contacts) for is_unlawful in (False, True))
        return cls(touches, step, *faults)

    def needs_lanes(self, steps: int) -> Bool[Array, " T"]:
        """Return the mask of steps at which a fault depends on lanes and road."""
        depends = self.touches & (self.lawful_fault != self.unlawful_fault)
        return ((self.step == jnp.arange(steps)[:, None]) & depends).any(axis=1)

    def fault_times(self, is_unlawful: Bool[Array, " T"]) -> Float[Array, " K"]:
        """Return the time of ego's contact with each agent, s; infinite without a contact that is ego's fault.

        ``is_unlawful`` masks the steps at which ego is in several lanes or off the road.
        """
        fault = jnp.where(is_unlawful[self.step], self.unlawful_fault, self.lawful_fault)
        return jnp.where(self.touches & fault, self.step * DT_S, jnp.inf)

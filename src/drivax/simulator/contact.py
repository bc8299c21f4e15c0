"""Contacts of one agent with the others: overlap, who is at fault, what kind of collision, time to collision."""

from __future__ import annotations

import enum

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from drivax.geometry.boxes import COS, LENGTH, SIN, WIDTH, X, Y, gap, overlap, time_to_overlap
from drivax.scenario.bank.queries import LEVEL_M
from drivax.scenario.schema import AgentKind
from drivax.simulator.types import Frame

TTC_HORIZON_S = 5.0
#: Gaps are given up to here, m.
FARTHEST_GAP_M = 50.0
#: Below this speed a car stands (semantics, ``at_fault_collision`` and ``ttc``).
STOPPED_MPS = 0.05
#: Rear axle behind the box centre, as a share of the length (nuPlan's vehicle: 1.461 m of 5.176 m).
REAR_AXLE = 1.461 / 5.176


class Contact(enum.IntEnum):
    """What there is between the evaluated agent and another.

    ``IGNORED`` overlapped when it appeared and counts for nothing until it parts; ``HIT`` touches without the evaluated
    agent's fault, ``AT_FAULT`` with it; ``PARTED`` is apart again, its fault decided once and for all; ``GONE``, of
    these three, is absent.
    """

    ABSENT = 0
    APART = 1
    HIT = 2
    IGNORED = 3
    AT_FAULT = 4
    PARTED = 5
    GONE = 6


class CollisionType(enum.IntEnum):
    """Kind of the first collision, seen from the evaluated agent.

    The first that fits, in this order: ``VULNERABLE``: a pedestrian or cyclist; ``STOPPED_OBJECT``: the agent's front
    hits another agent that stands; ``HEAD_ON``: headings differ by more than 135 deg, unless it touches from behind;
    ``REAR_END``: the front hits an agent whose heading differs by less than 45 deg; ``REAR_ENDED``: hit from behind;
    ``SIDE_SWIPE``: everything else, crossing traffic included.
    """

    NONE = 0
    REAR_END = 1
    REAR_ENDED = 2
    SIDE_SWIPE = 3
    HEAD_ON = 4
    VULNERABLE = 5
    STOPPED_OBJECT = 6


def overlaps(frame: Frame, slot: Int[Array, ""]) -> Bool[Array, " S"]:
    """Which valid others overlap the agent now, on its level."""
    others = frame.valid & (jnp.arange(frame.valid.shape[0]) != slot)
    level = jnp.abs(frame.z - frame.z[slot]) <= LEVEL_M
    return overlap(frame.box[slot], frame.box) & others & level


def first_contacts(before: Int[Array, " S"], touching: Bool[Array, " S"]) -> Bool[Array, " S"]:
    """Which overlaps count and begin now: the other was there and apart, and has never been hit before."""
    return touching & (before == Contact.APART)


def next_contacts(
    before: Int[Array, " S"], touching: Bool[Array, " S"], valid: Bool[Array, " S"], fault: Bool[Array, " S"]
) -> Int[Array, " S"]:
    """Contact code of every slot, one step later.

    Args:
        before: Codes of the step before.
        touching: Who overlaps now.
        valid: Who is there now.
        fault: For those whose first contact is now: whether it is the evaluated agent's fault.
    """
    c = Contact
    appears = (before == c.IGNORED) | (before == c.ABSENT) | (before == c.GONE)
    known = jnp.where(
        before == c.APART, jnp.where(fault, c.AT_FAULT, c.HIT), jnp.where(before == c.PARTED, c.HIT, before)
    )
    contact = jnp.where(appears, c.IGNORED, known)
    judged = (before == c.HIT) | (before == c.AT_FAULT) | (before == c.PARTED) | (before == c.GONE)
    apart, absent = jnp.where(judged, c.PARTED, c.APART), jnp.where(judged, c.GONE, c.ABSENT)
    return jnp.where(valid, jnp.where(touching, contact, apart), absent).astype(jnp.int8)


def relative(frame: Frame, slot: Int[Array, ""]) -> tuple[Array, Array, Array, Array]:
    """Every slot's centre in the agent's frame (ahead, left) and cosine and sine of its heading there."""
    me = frame.box[slot]
    dx, dy = frame.box[:, X] - me[X], frame.box[:, Y] - me[Y]
    cos = frame.box[:, COS] * me[COS] + frame.box[:, SIN] * me[SIN]
    sin = frame.box[:, SIN] * me[COS] - frame.box[:, COS] * me[SIN]
    return dx * me[COS] + dy * me[SIN], dy * me[COS] - dx * me[SIN], cos, sin


def classify_contacts(
    frame: Frame, slot: Int[Array, ""], fresh: Bool[Array, " S"], speed: Float[Array, ""],
    others_speed: Float[Array, " S"], unlawful: Bool[Array, ""],
) -> tuple[Bool[Array, " S"], Int[Array, ""]]:  # fmt: skip
    """Fault and type of contacts that began at this step.

    Fault follows nuPlan's order: agent itself stopped: no; the other stopped: yes; the other behind: no; hit with the
    front: yes; sideways: yes when the agent leaves its lane or the road.

    Args:
        frame: All agents now.
        slot: The evaluated agent.
        fresh: Slots whose contact began at this step.
        speed: The larger speed of the agent before and after the step.
        others_speed: The same for every slot.
        unlawful: The agent is in several lanes or off the road.

    Returns:
        Which fresh contacts are the agent's fault, and the type of the nearest one.
    """
    me = frame.box[slot]
    ahead, left, cos, _ = relative(frame, slot)
    bearing = jnp.arctan2(jnp.abs(left), ahead + REAR_AXLE * me[LENGTH])
    behind = bearing > 5 * jnp.pi / 6
    # The front bumper as a thin box.
    bumper = jnp.stack(
        [me[X] + me[LENGTH] / 2 * me[COS], me[Y] + me[LENGTH] / 2 * me[SIN], me[COS], me[SIN],
         jnp.full((), 0.02), me[WIDTH]]
    )  # fmt: skip
    front = overlap(bumper, frame.box)
    stopped, other_stopped = speed < STOPPED_MPS, others_speed < STOPPED_MPS
    fault = ~stopped & (other_stopped | (~behind & (front | unlawful)))
    vulnerable = (frame.kind == AgentKind.PEDESTRIAN) | (frame.kind == AgentKind.CYCLIST)
    head_on, same_way = cos < -(0.5**0.5), cos > 0.5**0.5
    kind = jnp.where(
        vulnerable,
        CollisionType.VULNERABLE,
        jnp.where(
            other_stopped & front,
            CollisionType.STOPPED_OBJECT,
            jnp.where(
                head_on & (front | ~behind),
                CollisionType.HEAD_ON,
                jnp.where(
                    front & same_way,
                    CollisionType.REAR_END,
                    jnp.where(behind, CollisionType.REAR_ENDED, CollisionType.SIDE_SWIPE),
                ),
            ),
        ),
    )
    nearest = jnp.argmin(jnp.where(fresh, ahead**2 + left**2, jnp.inf))
    return fresh & fault, jnp.where(fresh.any(), kind[nearest], CollisionType.NONE).astype(jnp.int8)


def time_to_collision(frame: Frame, slot: Int[Array, ""], left_out: Bool[Array, " S"]) -> Float[Array, ""]:
    """Seconds to the first overlap at constant velocities and fixed headings, at most 5 (semantics, ``ttc``).

    Agents that lie entirely behind the rear axle are followers and never count; nor does one that has run into the
    agent without its fault, which ``left_out`` names. Of the rest, agents that overlap within
    the horizon is ahead or comes into the lane that the agent sweeps; no cone narrows the view.
    """
    me = frame.box[slot]
    ahead, _, cos, sin = relative(frame, slot)
    reach = jnp.abs(cos) * frame.box[:, LENGTH] / 2 + jnp.abs(sin) * frame.box[:, WIDTH] / 2
    counts = frame.valid & ~left_out & (jnp.arange(frame.valid.shape[0]) != slot)
    counts &= (ahead + reach > -REAR_AXLE * me[LENGTH]) & (jnp.abs(frame.z - frame.z[slot]) <= LEVEL_M)
    times = time_to_overlap(me, frame.velocity[slot], frame.box, frame.velocity, TTC_HORIZON_S)
    return jnp.min(jnp.where(counts, times, TTC_HORIZON_S))


def nearest_gap(frame: Frame, slot: Int[Array, ""], left_out: Bool[Array, " S"]) -> Float[Array, ""]:
    """Distance between the agent's box and the nearest other on its level, m, at most 50; 0 where they overlap.

    Args:
        frame: All agents now.
        slot: The agent.
        left_out: Who does not count: those that overlapped it when they appeared, until they part.
    """
    counts = frame.valid & ~left_out & (jnp.arange(frame.valid.shape[0]) != slot)
    counts &= jnp.abs(frame.z - frame.z[slot]) <= LEVEL_M
    # Boxes of empty slots may hold anything; the agent's own one, pushed away, keeps gradients finite.
    gaps = gap(frame.box[slot], jnp.where(counts[:, None], frame.box, frame.box[slot]))
    return jnp.min(jnp.where(counts, jnp.minimum(gaps, FARTHEST_GAP_M), FARTHEST_GAP_M))

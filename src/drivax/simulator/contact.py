"""Contacts of one agent with the others: overlap, fault, type of collision, time to collision, gap."""

from __future__ import annotations

import enum
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from drivax.geometry.boxes import COS, LENGTH, SIN, WIDTH, X, Y, gap, overlap, time_to_overlap
from drivax.scenario.bank.queries import LEVEL_M
from drivax.scenario.bank.scenario_bank import Integer, Scalar
from drivax.scenario.bank.smallest import first_smallest
from drivax.scenario.schema import AgentKind
from drivax.simulator.types import Frame

TTC_HORIZON_S = 5.0
#: Largest gap, m.
FARTHEST_GAP_M = 50.0
#: Below this speed an agent is stopped, for ``at_fault_collision`` and ``ttc``.
STOPPED_MPS = 0.05
#: Tangent of 30 and cosine of 45 degrees.
_TAN_30, _COS_45 = 3.0**-0.5, 0.5**0.5
#: Length of the box that stands for the front bumper, m.
_BUMPER_M = 0.02
#: Rear axle behind the box centre, as a share of the length (nuPlan's vehicle: 1.461 m of 5.176 m).
REAR_AXLE = 1.461 / 5.176
#: Constants of the native kernel.
RULES: dict[str, Any] = {
    "pedestrian": AgentKind.PEDESTRIAN, "cyclist": AgentKind.CYCLIST, "level_m": LEVEL_M,
    "horizon_s": TTC_HORIZON_S, "stopped_mps": STOPPED_MPS, "rear_axle": REAR_AXLE, "behind_tan": _TAN_30,
    "parallel_cos": _COS_45, "bumper_m": _BUMPER_M,
}  # fmt: skip


class Contact(enum.IntEnum):
    """Contact of the evaluated agent with another.

    ``IGNORED``: has overlapped since it appeared and does not count until it separates; ``HIT``: overlaps without the
    evaluated agent's fault, ``AT_FAULT`` with it; ``PARTED``: separated again after ``HIT`` or ``AT_FAULT``;
    ``GONE``: absent after ``HIT``, ``AT_FAULT``, ``PARTED`` or ``RETURNED``; ``RETURNED``: was gone and has overlapped
    since it reappeared, ignored until it is ``PARTED``.
    """

    ABSENT = 0
    APART = 1
    HIT = 2
    IGNORED = 3
    AT_FAULT = 4
    PARTED = 5
    GONE = 6
    RETURNED = 7


class CollisionType(enum.IntEnum):
    """Type of the first collision, seen from the evaluated agent.

    The first that applies, in this order: ``VULNERABLE``: with a pedestrian or cyclist; ``STOPPED_OBJECT``: the agent's
    front hits a stopped agent; ``HEAD_ON``: headings differ by more than 135 deg, and the other agent is not behind
    unless the front hits it; ``REAR_END``: the front hits an agent whose heading differs by less than 45 deg;
    ``REAR_ENDED``: hit from behind; ``SIDE_SWIPE``: all others, crossing traffic included.
    """

    NONE = 0
    REAR_END = 1
    REAR_ENDED = 2
    SIDE_SWIPE = 3
    HEAD_ON = 4
    VULNERABLE = 5
    STOPPED_OBJECT = 6


def others_on_level(frame: Frame, slot: Integer) -> Bool[Array, " S"]:
    """Mask of the valid agents other than ``slot`` that are on its level."""
    others = frame.valid & (jnp.arange(frame.valid.shape[0]) != slot)
    return others & (jnp.abs(frame.z - frame.z[slot]) <= LEVEL_M)


def overlaps(frame: Frame, slot: Integer) -> Bool[Array, " S"]:
    """Mask of the other agents that overlap the agent, on its level."""
    return overlap(frame.box[slot], frame.box) & others_on_level(frame, slot)


def first_contacts(before: Int[Array, " S"], touching: Bool[Array, " S"]) -> Bool[Array, " S"]:
    """Mask of the overlaps that begin at this step and count: those with agents in the state ``APART``."""
    return touching & (before == Contact.APART)


def ignored_overlaps(codes: Int[Array, " S"]) -> Bool[Array, " S"]:
    """Mask of the overlaps that do not count until the agents separate, by contact code."""
    return (codes == Contact.IGNORED) | (codes == Contact.RETURNED)


def next_contacts(
    before: Int[Array, " S"], touching: Bool[Array, " S"], valid: Bool[Array, " S"], fault: Bool[Array, " S"]
) -> Int[Array, " S"]:
    """Return the contact code of every slot, one step after ``before``.

    ``fault`` marks the evaluated agent's fault in contacts that begin at this step.
    """
    c = Contact
    # A slot that overlaps as it appears is ignored. A contact after ``PARTED`` is never a new fault.
    contact = jnp.where(before == c.PARTED, c.HIT, before)
    contact = jnp.where(before == c.APART, jnp.where(fault, c.AT_FAULT, c.HIT), contact)
    contact = jnp.where(before == c.ABSENT, c.IGNORED, jnp.where(before == c.GONE, c.RETURNED, contact))
    was_hit = (before == c.HIT) | (before >= c.AT_FAULT)
    apart, absent = jnp.where(was_hit, c.PARTED, c.APART), jnp.where(was_hit, c.GONE, c.ABSENT)
    return jnp.where(valid, jnp.where(touching, contact, apart), absent).astype(jnp.int8)


def relative_poses(frame: Frame, slot: Integer) -> tuple[Array, Array, Array, Array]:
    """Return every slot's centre (ahead, left, m), and cosine and sine of its heading, in the agent's frame."""
    ego = frame.box[slot]
    dx, dy = frame.box[:, X] - ego[X], frame.box[:, Y] - ego[Y]
    cos = frame.box[:, COS] * ego[COS] + frame.box[:, SIN] * ego[SIN]
    sin = frame.box[:, SIN] * ego[COS] - frame.box[:, COS] * ego[SIN]
    return dx * ego[COS] + dy * ego[SIN], dy * ego[COS] - dx * ego[SIN], cos, sin


def classify_contacts(
    frame: Frame, slot: Integer, begins: Bool[Array, " S"], speed: Scalar, others_speed: Float[Array, " S"],
    unlawful: Bool[Array, ""],
) -> tuple[Bool[Array, " S"], Integer]:  # fmt: skip
    """Return a mask of the at-fault contacts among those of ``begins``, and the type of the nearest one of ``begins``.

    As in nuPlan, the agent is not at fault if it is stopped. Otherwise it is at fault if the other is stopped, or if
    the other is not behind and the agent hits it with its front or is ``unlawful``: in several lanes or off the road.
    Speeds are the larger of those before and after the step.
    """
    ego = frame.box[slot]
    ahead, left, cos, _ = relative_poses(frame, slot)
    # Behind: at a bearing of more than 150 degrees from the rear axle.
    behind = jnp.abs(left) < -_TAN_30 * (ahead + REAR_AXLE * ego[LENGTH])
    x, y = ego[X] + ego[LENGTH] / 2 * ego[COS], ego[Y] + ego[LENGTH] / 2 * ego[SIN]
    bumper = jnp.stack([x, y, ego[COS], ego[SIN], jnp.full((), _BUMPER_M), ego[WIDTH]])
    front = overlap(bumper, frame.box)
    stopped, other_stopped = speed < STOPPED_MPS, others_speed < STOPPED_MPS
    fault = ~stopped & (other_stopped | (~behind & (front | unlawful)))
    vulnerable = (frame.kind == AgentKind.PEDESTRIAN) | (frame.kind == AgentKind.CYCLIST)
    opposite, parallel = cos < -_COS_45, cos > _COS_45
    c = CollisionType
    cases = (
        (vulnerable, c.VULNERABLE), (other_stopped & front, c.STOPPED_OBJECT),
        (opposite & (front | ~behind), c.HEAD_ON), (front & parallel, c.REAR_END), (behind, c.REAR_ENDED),
    )  # fmt: skip
    collision_type = jnp.full(front.shape, c.SIDE_SWIPE)
    for mask, case in reversed(cases):  # jnp.select, an argmax over all cases, is slower
        collision_type = jnp.where(mask, case, collision_type)
    nearest = first_smallest(jnp.where(begins, ahead**2 + left**2, jnp.inf))
    return begins & fault, jnp.where(begins.any(), collision_type[nearest], c.NONE).astype(jnp.int8)


def time_to_collision(frame: Frame, slot: Integer, ignored: Bool[Array, " S"]) -> Scalar:
    """Return the time to the first overlap at constant velocities and headings, s, at most 5.

    Agents entirely behind the rear axle are followers and do not count, nor do those in ``ignored``, such as one that
    ran into the agent without the agent's fault. All others count, in any direction: one that overlaps within the
    horizon is ahead or comes into the lane that the agent sweeps.
    """
    ego = frame.box[slot]
    ahead, _, cos, sin = relative_poses(frame, slot)
    reach = jnp.abs(cos) * frame.box[:, LENGTH] / 2 + jnp.abs(sin) * frame.box[:, WIDTH] / 2
    is_relevant = others_on_level(frame, slot) & ~ignored & (ahead + reach > -REAR_AXLE * ego[LENGTH])
    times = time_to_overlap(ego, frame.velocity[slot], frame.box, frame.velocity, TTC_HORIZON_S)
    return jnp.min(jnp.where(is_relevant, times, TTC_HORIZON_S))


def nearest_gap(frame: Frame, slot: Integer, ignored: Bool[Array, " S"]) -> Scalar:
    """Return the gap to the nearest other box on the agent's level, m, at most 50; 0 where they overlap.

    Agents in ``ignored`` do not count, such as those that have overlapped the agent since they appeared.
    """
    is_relevant = others_on_level(frame, slot) & ~ignored
    # Boxes of empty slots are arbitrary; the agent's own box in their place keeps gradients finite.
    gaps = gap(frame.box[slot], jnp.where(is_relevant[:, None], frame.box, frame.box[slot]))
    return jnp.min(jnp.where(is_relevant, jnp.minimum(gaps, FARTHEST_GAP_M), FARTHEST_GAP_M))

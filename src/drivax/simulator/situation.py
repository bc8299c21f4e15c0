"""Measure the facts that metrics, rewards and planners share."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from drivax.geometry.boxes import corners
from drivax.geometry.vectors import norm, root, wrap
from drivax.scenario.bank import queries
from drivax.scenario.bank.columns import AgentColumn
from drivax.scenario.bank.scenario_bank import Integer, Scalar, ScenarioBank
from drivax.scenario.schema import CURRENT_STEP, DT_S
from drivax.simulator import contact
from drivax.simulator.ahead import has_route
from drivax.simulator.contact import STOPPED_MPS, Contact
from drivax.simulator.lights import check_lights
from drivax.simulator.types import (
    FACTS,
    MOTION_HEADING,
    MOTION_SPEED,
    ON_REQUEST,
    AgentContext,
    Facts,
    Frame,
    LightMemory,
    Situation,
    Surroundings,
)

#: Lights of the route count while the agent is within this distance of it, m.
_ON_ROUTE_M = 2.0
#: How far back a lane change at the start of an episode is looked for, steps.
_ENTRY_STEPS = 16
#: Steps over which accelerations and yaw rates are differences.
_RATE_STEPS = 5
#: Steps in a second; a log that moves less than this stands, m (semantics, ``progress_ratio``).
_SECOND, _STANDS_M = round(1.0 / DT_S), 0.5
#: Facts that compare with the log's schedule.
_SCHEDULE = frozenset({"late_m", "early_m", "completed"})
#: Facts that need fault classification, and those that need contacts.
_FAULTS = frozenset({"at_fault", "collision_type", "ttc_s"})
_CONTACTS = _FAULTS | {"collision", "ignored", "gap_m"}
#: Facts that need lane passages.
_PASSAGES = frozenset({"strand", "lane_changed", "merged"})


def measure(
    bank: ScenarioBank, context: AgentContext, frame: Frame, previous: Frame,
    contacts: Int[Array, " S"], lights: LightMemory, reads: frozenset[str] = FACTS, strand: Any = None,
) -> tuple[Situation, Int[Array, " S"], LightMemory]:  # fmt: skip
    """Measure the driven agent.

    ``context`` has the present step and motion, but ``route_m`` and ``z`` of the step before; ``contacts`` and
    ``lights`` are those of the step before. ``frame`` and ``previous`` are all agents now and one step ago. ``strand``
    is the previous fact of that name (None at the start of an episode). Facts that ``reads`` does not name are None and
    not computed.

    Returns:
        The situation (with present ``route_m`` and ``z``), new contact codes, new light memory.
    """
    around = surroundings(bank, context, frame)
    lanes, route, me = around.lanes, around.route, frame.box[context.slot]
    ground = _ground(bank, context, frame)
    offroad_m, left_map, offroad = off_the_road(bank, context.index, me, ground, lanes)
    z = jnp.where(lanes.near, lanes.z + bank.height_m(context.index, context.slot) / 2, frame.z[context.slot])
    context = replace(context, route_m=jnp.maximum(context.route_m, route.along_m), z=z)
    # Not ``offroad``: a lateral hit is a fault in a scenario without a map, too.
    unlawful = lanes.leaving_lane | (offroad_m > queries.OFFROAD_TOLERANCE_M)
    codes, fault, kind, ttc = _measure_contacts(context, frame, previous, contacts, unlawful, reads)
    routed = has_route(bank, context)
    red, on_route = jnp.zeros((), bool), routed & (route.distance_m <= _ON_ROUTE_M)
    if "red_light" in reads:
        red, lights = check_lights(bank, context, me, ground, on_route, lights)
    now, logged = context.history[-1], bank.agents[context.index, context.step, context.slot]
    acceleration, jerk, lateral = _rates(context.history)
    facts = Facts(
        collision=((codes == Contact.HIT) | (codes == Contact.AT_FAULT)).any(),
        at_fault=fault,
        collision_type=kind,
        offroad=offroad,
        offroad_m=offroad_m,
        left_map=left_map,
        red_light=red,
        ttc_s=ttc,
        ttc_defined=now[MOTION_SPEED] >= STOPPED_MPS,
        speed_mps=now[MOTION_SPEED],
        limit_mps=lanes.limit,
        routed=routed,
        logged=logged[AgentColumn.VALID] > 0,
        ignored=(codes == Contact.IGNORED).sum().astype(jnp.int16),
        wrong_way=lanes.wrong_way,
        straddling=lanes.straddling,
        moved_m=_step_length(context),
        progress_m=context.route_m,
        route_deviation_m=route.distance_m,
        off_route=~lanes.on_corridor & routed,
        log_divergence_m=norm(now[:2] - logged[AgentColumn.XY]),
        goal_distance_m=norm(now[:2] - bank.goal[context.row]),
        lateral_acceleration_mps2=lateral,
        acceleration_mps2=acceleration,
        jerk_mps3=jerk,
        **_requested_facts(bank, context, frame, codes, reads, strand),
    )
    return Situation(context, _drop_unread(facts, reads), around), codes, lights


def forget_strand(facts: Facts, over: Bool[Array, ""]) -> Facts:
    """Set the ``strand`` fact, if it is measured, to -1 (none) where the episode is ``over``."""

    def forget(path: tuple[Any, ...], fact: Array) -> Array:
        return jnp.where(over, jnp.int16(-1), fact) if path[0].name == "strand" else fact

    # As a tree: facts that are not read are None, which the constructor refuses under type checks.
    return jax.tree_util.tree_map_with_path(forget, facts)


def surroundings(bank: ScenarioBank, context: AgentContext, frame: Frame) -> Surroundings:
    """Return all agents, the lanes around the driven agent, and its position on its route."""
    me = frame.box[context.slot]
    ground = _ground(bank, context, frame)
    routed, pose = context.slot == bank.ego_slot(context.row), (me[:2], me[2:4], corners(me))
    lanes = queries.around_lanes(bank, context.index, *pose, ground, routed, context.row)
    # Room for the step itself and for the way along a bend, which is longer on the route.
    ahead_m = 1.5 * _step_length(context) + 2.0
    return Surroundings(
        frame, lanes, queries.project_on_route(bank, context.row, me[:2], context.route_m, ahead_m)
    )


def _ground(bank: ScenarioBank, context: AgentContext, frame: Frame) -> Scalar:
    """Height of the ground under the driven agent, m."""
    return frame.z[context.slot] - bank.height_m(context.index, context.slot) / 2


def _step_length(context: AgentContext) -> Scalar:
    """Distance that the driven agent moved in the last step, m."""
    return norm(context.history[-1, :2] - context.history[-2, :2])


def _measure_contacts(
    context: AgentContext, frame: Frame, previous: Frame, contacts: Int[Array, " S"], unlawful: Bool[Array, ""],
    reads: frozenset[str],
) -> tuple[Int[Array, " S"], Bool[Array, ""], Integer, Scalar]:  # fmt: skip
    """Return contact codes, whether a new contact is at fault, its type, and time to collision.

    Values that ``reads`` does not need are zero; without any of them codes stay unchanged.
    """
    fault, kind, ttc = jnp.zeros(contacts.shape, bool), jnp.zeros((), jnp.int8), jnp.zeros(())
    if not reads & _CONTACTS:
        return contacts, fault.any(), kind, ttc
    touching = contact.overlaps(frame, context.slot)
    if reads & _FAULTS:
        fresh = contact.first_contacts(contacts, touching)
        speed = jnp.maximum(context.history[-1, MOTION_SPEED], context.history[-2, MOTION_SPEED])
        others_speed = jnp.where(previous.valid, _speeds(previous), 0.0)
        others_speed = jnp.maximum(_speeds(frame), others_speed)
        fault, kind = contact.classify_contacts(frame, context.slot, fresh, speed, others_speed, unlawful)
    codes = contact.next_contacts(contacts, touching, frame.valid, fault)
    if "ttc_s" in reads:
        ttc = contact.time_to_collision(
            frame, context.slot, (codes == Contact.IGNORED) | (codes == Contact.HIT)
        )
    return codes, fault.any(), kind, ttc


def _speeds(frame: Frame) -> Float[Array, " S"]:
    # By coordinate: XLA sums slowly over an axis of two.
    return root(frame.velocity[:, 0] ** 2 + frame.velocity[:, 1] ** 2)


def _requested_facts(
    bank: ScenarioBank, context: AgentContext, frame: Frame, codes: Int[Array, " S"], reads: frozenset[str],
    strand: Any,
) -> dict[str, Array]:  # fmt: skip
    """Return the facts measured on request; those outside ``reads`` are zero."""
    facts: dict[str, Array] = dict.fromkeys(("gap_m", "lag_m"), jnp.zeros(()))
    facts |= dict.fromkeys(_SCHEDULE, jnp.zeros(()))
    if reads & _SCHEDULE:
        facts |= _schedule(bank, context)
    facts |= {"strand": jnp.int16(-1)} | dict.fromkeys(("lane_changed", "merged"), jnp.zeros((), bool))
    if "gap_m" in reads:
        facts["gap_m"] = contact.nearest_gap(frame, context.slot, codes == Contact.IGNORED)
    if "lag_m" in reads:
        me, logged = frame.box[context.slot], bank.agents[context.index, context.step, context.slot]
        facts["lag_m"] = jnp.sum((logged[AgentColumn.XY] - me[:2]) * me[2:4])
    if reads & _PASSAGES:
        ground, me = _ground(bank, context, frame), frame.box[context.slot]
        if strand is None:
            # An agent that changes lanes at the start comes from its pose 15 steps ago.
            x, y, psi = context.history[-_ENTRY_STEPS, : MOTION_HEADING + 1]
            heading = jnp.stack([jnp.cos(psi), jnp.sin(psi)])
            strand = queries.lane_passage(bank, context.index, jnp.stack([x, y]), heading, ground, -1).strand
        passage = queries.lane_passage(bank, context.index, me[:2], me[2:4], ground, strand)
        facts |= {"strand": passage.strand, "lane_changed": passage.changed, "merged": passage.merged}
    return facts


def _schedule(bank: ScenarioBank, context: AgentContext) -> dict[str, Scalar]:
    """Return the facts that compare the way on the route with that of the log at the same time."""
    way, last = bank.log_progress[context.row], bank.last_step[context.row]
    step = jnp.minimum(context.step + _SECOND, last)
    final = bank.agents[context.index, last, bank.ego_slot(context.row), AgentColumn.VELOCITY]
    # After its end the log continues at its last speed.
    later = way[step] + norm(final) * (context.step + _SECOND - step) * DT_S
    whole, done = way[last] - way[CURRENT_STEP], context.route_m - way[CURRENT_STEP]
    moves = whole >= _STANDS_M
    completed = jnp.where(moves, jnp.clip(done / jnp.where(moves, whole, 1.0), 0.0, 1.0), 1.0)
    late_m, early_m = way[context.step] - context.route_m, context.route_m - later
    return {"late_m": late_m, "early_m": early_m, "completed": completed}


def _drop_unread(facts: Facts, reads: frozenset[str]) -> Facts:
    """Return the facts with None in place of those that are not requested."""
    # The next passage is evaluated from the strand of this one.
    desired = reads | ({"strand"} if reads & _PASSAGES else frozenset())

    def keep(path: tuple[Any, ...], fact: Array) -> Array | None:
        """Return the fact if it is read; as a tree, for the reason in :func:`forget_strand`."""
        return fact if path[0].name in desired else None

    return facts if desired >= FACTS | ON_REQUEST else jax.tree_util.tree_map_with_path(keep, facts)


def off_the_road(
    bank: ScenarioBank, index: Integer, me: Float[Array, " 6"], ground: Scalar, lanes: queries.LaneHits
) -> tuple[Scalar, Bool[Array, ""], Bool[Array, ""]]:
    """Return how far the worst corner of a box is off the road (m), whether the box left the map, and the road.

    Without a map it left neither, whatever the distance.
    """
    offroad_m = queries.offroad_distance(bank, index, me[:2], corners(me), lanes.points_near, ground).max()
    off = (offroad_m > queries.OFFROAD_TOLERANCE_M) & queries.is_mapped(bank, index)
    return offroad_m, queries.left_the_map(bank, index, me[:2]), off


def _rates(history: Float[Array, "history 4"]) -> tuple[Scalar, Scalar, Scalar]:
    """Return causal acceleration, jerk and lateral acceleration: differences over 0.5 s."""
    speed, heading = history[:, MOTION_SPEED], history[:, MOTION_HEADING]
    n, span_s = _RATE_STEPS, _RATE_STEPS * DT_S
    acceleration = (speed[-1] - speed[-1 - n]) / span_s
    before = (speed[-1 - n] - speed[-1 - 2 * n]) / span_s
    yaw_rate = wrap(heading[-1] - heading[-1 - n]) / span_s
    return acceleration, (acceleration - before) / span_s, yaw_rate * speed[-1]

"""Measure the facts that metrics, rewards and planners share."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from drivax import kernels
from drivax.geometry.boxes import corners
from drivax.geometry.vectors import norm, root, wrap
from drivax.kernels.bindings import Agents, measure_contacts
from drivax.scenario.bank import queries
from drivax.scenario.bank.columns import AgentColumn
from drivax.scenario.bank.scenario_bank import Integer, Scalar, ScenarioBank
from drivax.scenario.schema import CURRENT_STEP, DT_S
from drivax.simulator import contact
from drivax.simulator.ahead import has_route, leader_gap
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

#: Only lights of the route count while the agent is within this distance of it, m.
_ON_ROUTE_M = 2.0
#: Rows of the history, the present one included, in which a lane change may begin before an episode.
_ENTRY_STEPS = 16
#: Steps between the two values whose difference gives an acceleration or a yaw rate.
_RATE_STEPS = 5
#: Steps in a second; distance below which a log stands still, m, as in ``progress_ratio``.
_SECOND, _STANDS_M = round(1.0 / DT_S), 0.5
#: Facts that compare with the log's schedule.
_SCHEDULE = frozenset({"late_m", "early_m", "completed"})
#: Cap of time gaps, s.
LONGEST_GAP_S = 10.0
#: Facts that need fault classification, and those that need contacts.
_FAULTS = frozenset({"at_fault", "collision_type", "ttc_s"})
_CONTACTS = _FAULTS | {"collision", "ignored", "gap_m"}
#: Facts that need lane passages.
PASSAGES = frozenset({"strand", "lane_changed", "merged"})


def measure(
    bank: ScenarioBank, context: AgentContext, frame: Frame, previous: Frame,
    contacts: Int[Array, " S"], lights: LightMemory, reads: frozenset[str] = FACTS, strand: Any = None,
) -> tuple[Situation, Int[Array, " S"], LightMemory]:  # fmt: skip
    """Measure the driven agent.

    ``context`` has the present step and motion; its ``route_m`` and ``z``, ``contacts``, ``lights`` and the fact
    ``strand`` (None: that of :func:`entry_strand`) are those of the step before. ``frame`` and ``previous`` are all
    agents now and one step before. Facts that ``reads`` does not name are None and not computed.

    Returns:
        The situation (with present ``route_m`` and ``z``), new contact codes, new light memory.
    """
    around = surroundings(bank, context, frame)
    lanes, route, ego = around.lanes, around.route, frame.box[context.slot]
    ground = _ground(bank, context, frame)
    offroad_m, left_map, offroad = measure_offroad(bank, context.index, ego, ground, lanes)
    z = jnp.where(lanes.near, lanes.z + bank.height_m(context.index, context.slot) / 2, frame.z[context.slot])
    context = replace(context, route_m=jnp.maximum(context.route_m, route.along_m), z=z)
    unlawful = lanes.leaving_lane | offroad
    codes, fault, collision_type, ttc = _measure_contacts(context, frame, previous, contacts, unlawful, reads)
    routed = has_route(bank, context)
    red_light, on_route = jnp.zeros((), bool), routed & (route.distance_m <= _ON_ROUTE_M)
    if "red_light" in reads:
        red_light, lights = check_lights(bank, context, ego, ground, on_route, lights)
    motion, log_row = context.history[-1], bank.agents[context.index, context.step, context.slot]
    acceleration, jerk, lateral = _rates(context.history)
    facts = Facts(
        collision=((codes == Contact.HIT) | (codes == Contact.AT_FAULT)).any(),
        at_fault=fault,
        collision_type=collision_type,
        offroad=offroad,
        offroad_m=offroad_m,
        left_map=left_map,
        red_light=red_light,
        ttc_s=ttc,
        ttc_defined=motion[MOTION_SPEED] >= STOPPED_MPS,
        speed_mps=motion[MOTION_SPEED],
        limit_mps=lanes.limit,
        routed=routed,
        logged=log_row[AgentColumn.VALID] > 0,
        ignored=contact.ignored_overlaps(codes).sum().astype(jnp.int16),
        wrong_way=lanes.wrong_way,
        straddling=lanes.straddling,
        moved_m=_step_length(context),
        progress_m=context.route_m,
        route_deviation_m=route.distance_m,
        off_route=~lanes.on_corridor & routed,
        log_divergence_m=norm(motion[:2] - log_row[AgentColumn.XY]),
        goal_distance_m=norm(motion[:2] - bank.goal[context.row]),
        lateral_acceleration_mps2=lateral,
        acceleration_mps2=acceleration,
        jerk_mps3=jerk,
        **_requested_facts(bank, context, frame, codes, reads, strand),
    )
    return Situation(context, _select_facts(facts, reads), around), codes, lights


def entry_strand(bank: ScenarioBank, context: AgentContext) -> Integer:
    """Return the strand from which an episode's first lane passage starts.

    It is that of the pose 15 steps ago, so that a lane change under way at the start counts.
    """
    x, y, psi = context.history[-_ENTRY_STEPS, : MOTION_HEADING + 1]
    xy, heading = jnp.stack([x, y]), jnp.stack([jnp.cos(psi), jnp.sin(psi)])
    ground = context.z - bank.height_m(context.index, context.slot) / 2
    return queries.lane_passage(bank, context.index, xy, heading, ground, -1).strand


def replace_strand(facts: Facts, done: Bool[Array, ""], strand: Any) -> Facts:
    """Set the fact ``strand``, if it is measured, to ``strand`` where the episode is ``done``."""

    def select(path: tuple[Any, ...], fact: Array) -> Array:
        return jnp.where(done, strand, fact) if path[0].name == "strand" else fact

    # As a tree: facts that are not read are None, which the constructor refuses under type checks.
    return jax.tree_util.tree_map_with_path(select, facts)


def surroundings(bank: ScenarioBank, context: AgentContext, frame: Frame) -> Surroundings:
    """Return all agents, the lanes around the driven agent, and its position on its route."""
    ego, ground = frame.box[context.slot], _ground(bank, context, frame)
    is_ego, pose = context.slot == bank.ego_slot(context.row), (ego[:2], ego[2:4], corners(ego))
    lanes = queries.around_lanes(bank, context.index, *pose, ground, is_ego, context.row)
    # On the inside of a bend the agent gains more along the route than it drives.
    ahead_m = 1.5 * _step_length(context) + 2.0
    route = queries.project_on_route(bank, context.row, ego[:2], context.route_m, ahead_m)
    return Surroundings(frame, lanes, route)


def _ground(bank: ScenarioBank, context: AgentContext, frame: Frame) -> Scalar:
    """Return the height of the ground under the driven agent, m."""
    return frame.z[context.slot] - bank.height_m(context.index, context.slot) / 2


def _step_length(context: AgentContext) -> Scalar:
    """Return the distance of the driven agent's last step, m."""
    return norm(context.history[-1, :2] - context.history[-2, :2])


def _measure_contacts(
    context: AgentContext, frame: Frame, previous: Frame, contacts: Int[Array, " S"], unlawful: Bool[Array, ""],
    reads: frozenset[str],
) -> tuple[Int[Array, " S"], Bool[Array, ""], Integer, Scalar]:  # fmt: skip
    """Return contact codes, whether a new contact is at fault, the type of the nearest one, and time to collision.

    Values that ``reads`` does not need are zero; if it needs no contacts, the codes stay unchanged.
    """
    fault, collision_type, ttc = jnp.zeros(contacts.shape, bool), jnp.zeros((), jnp.int8), jnp.zeros(())
    if not reads & _CONTACTS:
        return contacts, fault.any(), collision_type, ttc
    if "ttc_s" in reads and kernels.in_use():
        reference = partial(_measure_contacts, reads=reads)
        native = kernels.with_reference(_measure_contacts_natively, reference)
        return native(context, frame, previous, contacts, unlawful)
    touching = contact.overlaps(frame, context.slot)
    if reads & _FAULTS:
        begins = contact.first_contacts(contacts, touching)
        speed = jnp.maximum(context.history[-1, MOTION_SPEED], context.history[-2, MOTION_SPEED])
        others_speed = jnp.maximum(_speeds(frame), jnp.where(previous.valid, _speeds(previous), 0.0))
        fault, collision_type = contact.classify_contacts(
            frame, context.slot, begins, speed, others_speed, unlawful
        )
    codes = contact.next_contacts(contacts, touching, frame.valid, fault)
    if "ttc_s" in reads:
        ignored = contact.ignored_overlaps(codes) | (codes == Contact.HIT)
        ttc = contact.time_to_collision(frame, context.slot, ignored)
    return codes, fault.any(), collision_type, ttc


def _measure_contacts_natively(
    context: AgentContext, frame: Frame, previous: Frame, contacts: Int[Array, " S"], unlawful: Bool[Array, ""],
) -> tuple[Int[Array, " S"], Bool[Array, ""], Integer, Scalar]:  # fmt: skip
    """Return the result of :func:`_measure_contacts` for all ``reads``, computed by the native kernel."""
    speed = jnp.maximum(context.history[-1, MOTION_SPEED], context.history[-2, MOTION_SPEED])
    agents = Agents(frame.box, frame.velocity, frame.z, frame.valid, frame.kind)
    previous_agents = (previous.velocity, previous.valid)
    return measure_contacts(agents, previous_agents, context.slot, speed, unlawful, contacts, contact.RULES)


def _speeds(frame: Frame) -> Float[Array, " S"]:
    """Return the speed of every slot, summing by coordinate: XLA sums slowly over an axis of two."""
    return root(frame.velocity[:, 0] ** 2 + frame.velocity[:, 1] ** 2)


def _requested_facts(
    bank: ScenarioBank, context: AgentContext, frame: Frame, codes: Int[Array, " S"], reads: frozenset[str],
    strand: Any,
) -> dict[str, Array]:  # fmt: skip
    """Return the facts measured on request; placeholders for those outside ``reads``."""
    facts: dict[str, Array] = dict.fromkeys(ON_REQUEST, jnp.zeros(()))
    facts |= {"strand": jnp.int16(-1)} | dict.fromkeys(("lane_changed", "merged"), jnp.zeros((), bool))
    if reads & _SCHEDULE:
        facts |= _schedule_facts(bank, context)
    if "gap_m" in reads:
        facts["gap_m"] = contact.nearest_gap(frame, context.slot, contact.ignored_overlaps(codes))
    if "time_gap_s" in reads:
        speed = jnp.maximum(context.history[-1, MOTION_SPEED], STOPPED_MPS)
        facts["time_gap_s"] = jnp.clip(leader_gap(bank, context, frame) / speed, 0.0, LONGEST_GAP_S)
    if "lag_m" in reads:
        ego, logged = frame.box[context.slot], bank.agents[context.index, context.step, context.slot]
        facts["lag_m"] = jnp.sum((logged[AgentColumn.XY] - ego[:2]) * ego[2:4])
    if reads & PASSAGES:
        facts |= _passage_facts(bank, context, frame, strand)
    return facts


def _passage_facts(bank: ScenarioBank, context: AgentContext, frame: Frame, strand: Any) -> dict[str, Array]:
    """Return the facts of lane passages; ``strand`` is that of the step before, None for :func:`entry_strand`."""
    ego, ground = frame.box[context.slot], _ground(bank, context, frame)
    strand = entry_strand(bank, context) if strand is None else strand
    passage = queries.lane_passage(bank, context.index, ego[:2], ego[2:4], ground, strand)
    return {"strand": passage.strand, "lane_changed": passage.changed, "merged": passage.merged}


def completed_share(bank: ScenarioBank, context: AgentContext) -> Scalar:
    """Return the completed share of the log's path from its current step to its end, in [0, 1]; 1 if the log stands."""
    log_m, last = bank.log_progress[context.row], bank.last_step[context.row]
    log_gain, gain = log_m[last] - log_m[CURRENT_STEP], context.route_m - log_m[CURRENT_STEP]
    log_moves = log_gain >= _STANDS_M
    return jnp.where(log_moves, jnp.clip(gain / jnp.where(log_moves, log_gain, 1.0), 0.0, 1.0), 1.0)


def _schedule_facts(bank: ScenarioBank, context: AgentContext) -> dict[str, Scalar]:
    """Return the facts that compare the progress on the route with that of the log."""
    log_m, last = bank.log_progress[context.row], bank.last_step[context.row]
    later_step = jnp.minimum(context.step + _SECOND, last)
    velocity = bank.agents[context.index, last, bank.ego_slot(context.row), AgentColumn.VELOCITY]
    # After its end the log continues at its last speed.
    later_m = log_m[later_step] + norm(velocity) * (context.step + _SECOND - later_step) * DT_S
    completed = completed_share(bank, context)
    late_m, early_m = log_m[context.step] - context.route_m, context.route_m - later_m
    return {"late_m": late_m, "early_m": early_m, "completed": completed}


def _select_facts(facts: Facts, reads: frozenset[str]) -> Facts:
    """Replace facts that are not requested by None."""
    # The next step's lane passage starts from the strand of this one.
    names = reads | ({"strand"} if reads & PASSAGES else frozenset())

    def select(path: tuple[Any, ...], fact: Array) -> Array | None:
        return fact if path[0].name in names else None

    # As a tree, for the reason in :func:`replace_strand`.
    return facts if names >= FACTS | ON_REQUEST else jax.tree_util.tree_map_with_path(select, facts)


def measure_offroad(
    bank: ScenarioBank, index: Integer, box: Float[Array, " 6"], ground: Scalar, lanes: queries.LaneHits
) -> tuple[Scalar, Bool[Array, ""], Bool[Array, ""]]:
    """Return the largest distance of a corner beyond the road's edge (m), and the facts ``left_map`` and ``offroad``.

    Without a map both facts are false, whatever the distance.
    """
    offroad_m = queries.offroad_distance(bank, index, box[:2], corners(box), lanes.points_near, ground).max()
    offroad = (offroad_m > queries.OFFROAD_TOLERANCE_M) & queries.is_mapped(bank, index)
    return offroad_m, queries.left_the_map(bank, index, box[:2]), offroad


def _rates(history: Float[Array, "history 4"]) -> tuple[Scalar, Scalar, Scalar]:
    """Return acceleration (m/s2), jerk (m/s3) and lateral acceleration (m/s2) by backward differences over 0.5 s."""
    speed, heading = history[:, MOTION_SPEED], history[:, MOTION_HEADING]
    n, span_s = _RATE_STEPS, _RATE_STEPS * DT_S
    acceleration = (speed[-1] - speed[-1 - n]) / span_s
    previous_acceleration = (speed[-1 - n] - speed[-1 - 2 * n]) / span_s
    yaw_rate = wrap(heading[-1] - heading[-1 - n]) / span_s
    return acceleration, (acceleration - previous_acceleration) / span_s, yaw_rate * speed[-1]

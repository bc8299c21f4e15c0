"""Reactive traffic (``idm``): vehicles follow their logged paths by the Intelligent Driver Model (IDM).

:data:`TRAFFIC` holds all traffic models by name.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from drivax.errors import UsageError, did_you_mean
from drivax.geometry.boxes import LENGTH, WIDTH, overlap
from drivax.plugins import find_named, is_dotted, makes
from drivax.scenario.bank.columns import SizeColumn
from drivax.scenario.bank.queries import LEVEL_M
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.scenario.record import record
from drivax.scenario.schema import DT_S, AgentKind
from drivax.simulator.dynamics import accelerate
from drivax.simulator.idm import IdmParameters, idm_acceleration
from drivax.simulator.lights import is_red, is_yellow
from drivax.simulator.traffic import agent_paths
from drivax.simulator.traffic.agent_paths import PROFILE_SPEED, PROFILE_Z, AgentPaths
from drivax.simulator.traffic.bank_data import data_of
from drivax.simulator.traffic.corridor import FREE_M, Leaders, Movers, columns, leaders, path_poses
from drivax.simulator.traffic.log import LogTraffic
from drivax.simulator.types import AgentContext, Frame, Traffic

#: Steps of recent motion kept for observations; older frames repeat the oldest.
PAST = 10
#: Phases of a vehicle.
REPLAYS, WAITS, DRIVES, LEFT = range(4)
#: Free space around the box that a vehicle needs to enter: at each end and on each side, m.
_ENTRY_END_M, _ENTRY_SIDE_M = 0.5, 0.1
#: Vehicles slower than this whose front is over a stop line wait, too, m/s.
_STANDS_MPS = 0.5


@record
class Reactive:
    """State of the R vehicles of a scenario that may react; the last of the 10 rows is the present step."""

    begin: Int[Array, "*batch"]  # First step of the episode; until then all agents moved as logged
    phase: Int[Array, "*batch R"]  # Replays (0), waits to appear (1), drives (2), has left (3)
    entry: Int[Array, "*batch R"]  # Step at which the vehicle appears in the log
    arc: Float[Array, "*batch 10 R"]  # Arc length along the path, m
    speed: Float[Array, "*batch 10 R"]  # m/s
    there: Bool[Array, "*batch 10 R"]  # Whether the vehicle is on the road
    # Slots of agents that the vehicle overlapped when it appeared, until they separate; -1 for none
    ignored: Int[Array, "*batch R 2"]


@dataclass(frozen=True)
class IdmTraffic:
    """Vehicles that react to ego, to all other agents and to red and yellow lights.

    A vehicle that travels more than 2 m in the rest of its log, and does not reverse, follows its own path; all other
    agents replay. A vehicle ignores up to two agents that it overlaps when it appears, until they separate.

    Attributes:
        drivers: IDM parameters of each reacting class (``scenario.schema.AgentKind``); other classes replay.
    """

    drivers: tuple[tuple[int, IdmParameters], ...] = ((int(AgentKind.VEHICLE), IdmParameters()),)
    name: str = "idm"

    def __post_init__(self) -> None:
        kinds = [kind for kind, _ in self.drivers]
        if not kinds or len(set(kinds)) < len(kinds):
            cure = "name one class or more, each once"
            raise UsageError(f"IDM traffic with drivers of the classes {list(map(int, kinds))}", cure=cure)

    def prepare(self, bank: ScenarioBank) -> ScenarioBank:
        """Return the bank with the paths of reacting vehicles; unchanged if it has them."""
        return agent_paths.with_paths(bank, tuple(kind for kind, _ in self.drivers))

    def start(self, bank: ScenarioBank, index: Any, step: Any) -> Reactive:
        """Return the logged traffic state at ``step``."""
        paths = data_of(bank, AgentPaths)
        index, step = jnp.asarray(index, jnp.int32), jnp.asarray(step, jnp.int32)
        slot = paths.slot[index].astype(jnp.int32)
        entry = paths.appears[index, step].astype(jnp.int32)
        log_step = jnp.minimum(entry, bank.steps - 1)
        row = jnp.arange(slot.shape[0])
        travels = paths.log_arc[index, -1] - paths.log_arc[index, step] > agent_paths.TRAVELS_M
        reacts = (slot >= 0) & travels & (entry < bank.steps) & (self._driver_index(bank, index, slot) >= 0)
        drives = reacts & (entry <= step)
        present_values = (paths.log_arc[index, log_step, row], paths.log_speed[index, log_step, row], drives)
        phase = jnp.where(reacts, jnp.where(drives, DRIVES, WAITS), REPLAYS).astype(jnp.int8)
        arc, speed, there = (jnp.broadcast_to(values, (PAST, *values.shape)) for values in present_values)
        ignored = paths.overlaps[index, log_step, row]
        return Reactive(step, phase, entry.astype(jnp.int16), arc, speed, there, ignored)

    def agents(self, bank: ScenarioBank, context: AgentContext, back: int) -> Float[Array, "A 8"]:
        """Return rows of the moving slots ``back`` steps ago (at most 9): reacting agents simulated, others logged."""
        paths, state = data_of(bank, AgentPaths), context.traffic
        step = context.step - back
        logged = bank.agents[context.index, jnp.clip(step, 0, bank.steps - 1)]
        age = PAST - 1 - min(back, PAST - 1)
        (pose, profile), speed = path_poses(paths, context.index, state.arc[age]), state.speed[age, :, None]
        direction, valid = pose[:, 2:], state.there[age, :, None].astype(jnp.float32)
        values = [pose[:, :2], profile[:, PROFILE_Z, None], direction, direction * speed, valid]
        rows = jnp.concatenate(values, axis=-1)
        slot = paths.slot[context.index].astype(jnp.int32)
        reacts = (state.phase != REPLAYS) & (step > state.begin)
        return logged.at[jnp.where(reacts, slot, logged.shape[0])].set(rows, mode="drop")

    def advance(self, bank: ScenarioBank, context: AgentContext, frame: Frame) -> Reactive:
        """Advance all vehicles by one step of 0.1 s from the present frame."""
        paths, state = data_of(bank, AgentPaths), context.traffic
        drives, waits = state.phase == DRIVES, state.phase == WAITS
        slot = paths.slot[context.index].astype(jnp.int32)
        movers, limit = _movers(bank, context, slot)
        movers = replace(movers, ignored=_keep_ignored(movers, frame, waits))
        ahead = leaders(paths, context.index, movers, frame)
        driver = self._parameters(bank, context.index, slot)
        distance, speed = accelerate(movers.speed, _acceleration(bank, context, movers, limit, ahead, driver))
        arc = movers.arc + distance
        enters = waits & _may_enter(context, movers, ahead, frame)
        arrives = arc >= paths.spacing[context.index] * (agent_paths.PATH_POINTS - 1)
        phase = jnp.where(enters, DRIVES, jnp.where(drives & arrives, LEFT, state.phase))
        arc = jnp.where(drives, arc, movers.arc)
        speed = jnp.where(drives, speed, jnp.where(enters, _entry_speed(movers, ahead, driver), movers.speed))
        histories = ((state.arc, arc), (state.speed, speed), (state.there, phase == DRIVES))
        arc, speed, there = (jnp.concatenate([past[1:], new[None]]) for past, new in histories)
        ignored = movers.ignored.astype(jnp.int16)
        return Reactive(state.begin, phase.astype(jnp.int8), state.entry, arc, speed, there, ignored)

    def _driver_index(self, bank: ScenarioBank, index: Any, slot: Int[Array, " R"]) -> Int[Array, " R"]:
        """Return the index in ``drivers`` of each vehicle's class; -1 for none."""
        kind = bank.agent_box[index, jnp.maximum(slot, 0), SizeColumn.KIND].astype(jnp.int32)
        driver_index = jnp.full(kind.shape, -1)
        for i, (driver_kind, _) in enumerate(self.drivers):
            driver_index = jnp.where(kind == driver_kind, i, driver_index)
        return driver_index

    def _parameters(self, bank: ScenarioBank, index: Any, slot: Int[Array, " R"]) -> IdmParameters:
        """Return the IDM parameters of each vehicle, scalars if there is one class.

        Vehicles of other classes, which replay the log, get those of the last class.
        """
        if len(self.drivers) == 1:
            return self.drivers[0][1]
        driver_index = self._driver_index(bank, index, slot)
        parameters = {
            field.name: jnp.asarray([getattr(driver, field.name) for _, driver in self.drivers])[driver_index]
            for field in fields(IdmParameters)
        }
        return IdmParameters(**parameters)


def _movers(
    bank: ScenarioBank, context: AgentContext, slot: Int[Array, " R"]
) -> tuple[Movers, Float[Array, " R"]]:
    """Return the vehicles at their present (or entry) poses, and the speed limits of their paths."""
    state = context.traffic
    arc, speed = state.arc[-1], state.speed[-1]
    pose, profile = path_poses(data_of(bank, AgentPaths), context.index, arc)
    size = bank.agent_box[context.index, jnp.maximum(slot, 0), SizeColumn.FOOTPRINT]
    box, z = jnp.concatenate([pose, size], axis=-1), profile[:, PROFILE_Z]
    return Movers(box, z, arc, speed, slot, state.ignored.astype(jnp.int32)), profile[:, PROFILE_SPEED]


def _keep_ignored(movers: Movers, frame: Frame, waits: Bool[Array, " R"]) -> Int[Array, "R 2"]:
    """Return the slots that stay ignored: those that the vehicle still overlaps, and all while it waits."""
    other = jnp.maximum(movers.ignored, 0)
    is_level = jnp.abs(frame.z[other] - movers.z[:, None]) <= LEVEL_M
    overlaps = overlap(movers.box[:, None], frame.box[other]) & frame.valid[other] & is_level
    return jnp.where((movers.ignored >= 0) & (overlaps | waits[:, None]), movers.ignored, -1)


def _acceleration(
    bank: ScenarioBank, context: AgentContext, movers: Movers, limit: Float[Array, " R"], ahead: Leaders,
    driver: IdmParameters,
) -> Float[Array, " R"]:  # fmt: skip
    """Return the lower of the IDM accelerations behind the leader and behind a standing car on the stop line."""
    stop = _stop_gap(bank, context, movers, driver)
    to_leader = idm_acceleration(movers.speed, limit, ahead.gap, ahead.speed, driver)
    to_line = idm_acceleration(movers.speed, limit, stop, jnp.zeros_like(stop), driver)
    return jnp.minimum(to_leader, to_line)


def _stop_gap(
    bank: ScenarioBank, context: AgentContext, movers: Movers, driver: IdmParameters
) -> Float[Array, " R"]:
    """Return the distance from the front bumper to the nearest stop line that requires a stop, m; 10 km for none.

    Red requires a stop of all vehicles that can still stop, yellow of those that can stop comfortably. At red the
    distance is 0 for a vehicle that stands with its front, but not its centre, over the line.
    """
    paths = data_of(bank, AgentPaths)
    light = paths.stop_light[context.index].astype(jnp.int32)
    state = bank.light_state[context.index, jnp.clip(context.step, 0, bank.steps - 1)][light]
    line_m = paths.stop_arc[context.index] - movers.arc[:, None]
    front_m = line_m - movers.box[:, LENGTH, None] / 2
    squared_speed = (movers.speed * movers.speed)[:, None]
    max_braking = jnp.reshape(driver.max_braking_mps2, (-1, 1))
    comfortable_braking = jnp.reshape(driver.comfortable_braking_mps2, (-1, 1))
    red, yellow = is_red(state), is_yellow(state)
    on_line = (front_m <= 0.0) & (line_m > 0.0) & (movers.speed < _STANDS_MPS)[:, None]
    can_stop = squared_speed <= 2 * max_braking * front_m
    can_stop_gently = squared_speed <= 2 * comfortable_braking * front_m
    brakes = (front_m > 0.0) & ((red & can_stop) | (yellow & can_stop_gently))
    return jnp.min(jnp.where(brakes | (red & on_line), jnp.maximum(front_m, 0.0), FREE_M), axis=1)


def _may_enter(context: AgentContext, movers: Movers, ahead: Leaders, frame: Frame) -> Bool[Array, " R"]:
    """Mask of the waiting vehicles that enter at the next step: those that are due and have free space.

    Of late vehicles that need the same space the first one due enters; a vehicle on time yields to late ones, but not
    to others on time, as in the log.
    """
    state = context.traffic
    margin = jnp.asarray([0.0, 0.0, 0.0, 0.0, 2 * _ENTRY_END_M, 2 * _ENTRY_SIDE_M])
    box, velocity = frame.box[ahead.slots], frame.velocity[ahead.slots]
    next_box = box.at[..., :2].add(velocity * DT_S)
    is_blocked = (overlap((movers.box + margin)[:, None], next_box) & ahead.valid).any(axis=1)
    entry = state.entry.astype(jnp.int32)
    is_ready = (state.phase == WAITS) & (context.step + 1 >= entry) & ~is_blocked
    is_late = context.step + 1 > entry
    # By entry step, then by row; as floats, whose minima vectorise.
    order = (entry * entry.shape[0] + jnp.arange(entry.shape[0])).astype(jnp.float32)
    radius = jnp.sqrt(jnp.sum(movers.box[:, LENGTH : WIDTH + 1] ** 2, axis=-1)) / 2
    x, y = columns(movers.box)[:2]
    dx, dy = x[:, None] - x, y[:, None] - y
    is_near = dx * dx + dy * dy < (radius[:, None] + radius + 2 * _ENTRY_END_M) ** 2
    # Vehicles that are not ready come last.
    order = jnp.where(is_ready, order, jnp.inf)
    first = jnp.min(jnp.where(is_near & (is_late[None] | is_late[:, None]), order[None], jnp.inf), axis=1)
    return is_ready & (first >= order)


def _entry_speed(movers: Movers, ahead: Leaders, driver: IdmParameters) -> Float[Array, " R"]:
    """Return the logged speed, limited so that the vehicle can brake comfortably behind its leader."""
    room = jnp.maximum(ahead.gap - driver.min_gap_m, 0.0)
    square = jnp.maximum(ahead.speed, 0.0) ** 2 + 2.0 * driver.comfortable_braking_mps2 * room
    return jnp.minimum(movers.speed, jnp.sqrt(jnp.maximum(square, 1e-6)))


#: Traffic models by name.
TRAFFIC: dict[str, Callable[[], Traffic]] = {"log": LogTraffic, "idm": IdmTraffic}


def make_traffic(name: str) -> Traffic:
    """Return the traffic model of a name in :data:`TRAFFIC`, or of ``package.module:name``.

    The latter is a model, its class, or a function that makes one without arguments.

    Raises:
        UsageError: Unknown name, or the dotted name leads to something else, which is not called.
    """
    if name in TRAFFIC:
        return TRAFFIC[name]()
    if not is_dotted(name):
        cure = did_you_mean(name, TRAFFIC, otherwise=f"use {', '.join(TRAFFIC)}, or package.module:name")
        raise UsageError(f"unknown traffic {name!r}", cure=cure)
    traffic = find_named(name)
    if isinstance(traffic, type) or not isinstance(traffic, Traffic):
        traffic = traffic() if makes(traffic, Traffic) else None
    if not isinstance(traffic, Traffic):
        raise UsageError(f"{name!r} makes no traffic", cure="see drivax.simulator.Traffic")
    return traffic

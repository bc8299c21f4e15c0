"""Reactive traffic (``idm``): vehicles follow their logged paths by the Intelligent Driver Model; traffic by name."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from drivax.errors import UsageError
from drivax.geometry.boxes import LENGTH, WIDTH, overlap
from drivax.plugins import find_named, is_dotted, makes
from drivax.scenario.bank.columns import SizeColumn
from drivax.scenario.bank.queries import LEVEL_M
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.scenario.record import record
from drivax.scenario.schema import DT_S, AgentKind
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
#: Free space that an entry place needs beyond the box: at each end and on each side, m.
_ENTRY_END_M, _ENTRY_SIDE_M = 0.5, 0.1
#: Vehicles slower than this with the front over a stop line wait too, m/s.
_STANDS_MPS = 0.5


@record
class Reactive:
    """State of the R vehicles of a scenario that may react; the last of the 10 rows is now."""

    begin: Int[Array, "*batch"]  # First step of the episode; until then all agents moved as logged
    phase: Int[Array, "*batch R"]  # Replays (0), waits to appear (1), drives (2), has left (3)
    entry: Int[Array, "*batch R"]  # Step at which the vehicle appears in the log
    arc: Float[Array, "*batch 10 R"]  # Arc length along the path, m
    speed: Float[Array, "*batch 10 R"]  # m/s
    there: Bool[Array, "*batch 10 R"]  # Whether the vehicle is on the road
    # Slots of agents overlapped on appearing, until they separate; -1 for none
    ignored: Int[Array, "*batch R 2"]


@dataclass(frozen=True)
class IdmTraffic:
    """Vehicles that react to ego, to all other agents and to red lights.

    A vehicle that travels more than 2 m in the rest of its log follows its own path; all other agents replay. Pairs
    that overlap when the vehicle appears ignore each other until they separate.

    Attributes:
        drivers: IDM parameters of each reacting class (``scenario.schema.AgentKind``); other classes replay.
    """

    drivers: tuple[tuple[int, IdmParameters], ...] = ((int(AgentKind.VEHICLE), IdmParameters()),)
    name: str = "idm"

    def prepare(self, bank: ScenarioBank) -> ScenarioBank:
        """Return the bank with the paths of reacting vehicles; unchanged if it has them."""
        return agent_paths.with_paths(bank, tuple(kind for kind, _ in self.drivers))

    def start(self, bank: ScenarioBank, index: Any, step: Any) -> Reactive:
        """Return the logged traffic state at ``step``."""
        paths = data_of(bank, AgentPaths)
        index, step = jnp.asarray(index, jnp.int32), jnp.asarray(step, jnp.int32)
        slot = paths.slot[index].astype(jnp.int32)
        entry = paths.appears[index, step].astype(jnp.int32)
        at = jnp.minimum(entry, bank.steps - 1)
        row = jnp.arange(slot.shape[0])
        travels = paths.log_arc[index, -1] - paths.log_arc[index, step] > agent_paths.TRAVELS_M
        reacts = (slot >= 0) & travels & (entry < bank.steps) & (self._class(bank, index, slot) >= 0)
        now = reacts & (entry <= step)
        arc, speed = paths.log_arc[index, at, row], paths.log_speed[index, at, row]
        phase = jnp.where(reacts, jnp.where(now, DRIVES, WAITS), REPLAYS).astype(jnp.int8)
        arc, speed, there = (jnp.broadcast_to(rows, (PAST, *rows.shape)) for rows in (arc, speed, now))
        ignored = paths.overlaps[index, at, row]
        return Reactive(step, phase, entry.astype(jnp.int16), arc, speed, there, ignored)

    def agents(self, bank: ScenarioBank, context: AgentContext, back: int) -> Float[Array, "A 8"]:
        """Return rows of the moving slots ``back`` steps ago (at most 9): reacting agents simulated, others logged."""
        paths, now = data_of(bank, AgentPaths), context.traffic
        step = context.step - back
        logged = bank.agents[context.index, jnp.clip(step, 0, bank.steps - 1)]
        at = PAST - 1 - min(back, PAST - 1)
        (pose, profile), speed = path_poses(paths, context.index, now.arc[at]), now.speed[at, :, None]
        direction, valid = pose[:, 2:], now.there[at, :, None].astype(jnp.float32)
        parts = [pose[:, :2], profile[:, PROFILE_Z, None], direction, direction * speed, valid]
        rows = jnp.concatenate(parts, axis=-1)
        slot = paths.slot[context.index].astype(jnp.int32)
        reacts = (now.phase != REPLAYS) & (step > now.begin)
        return logged.at[jnp.where(reacts, slot, logged.shape[0])].set(rows, mode="drop")

    def advance(self, bank: ScenarioBank, context: AgentContext, frame: Frame) -> Reactive:
        """Advance all vehicles by one step of 0.1 s from the present frame."""
        paths, now = data_of(bank, AgentPaths), context.traffic
        drives, waits = now.phase == DRIVES, now.phase == WAITS
        slot = paths.slot[context.index].astype(jnp.int32)
        movers, limit = _movers(bank, context, slot)
        movers, ignored = _update_ignored(movers, frame, waits)
        ahead = leaders(paths, context.index, movers, frame)
        driver = self._parameters(bank, context.index, slot)
        acceleration = _acceleration(bank, context, movers, limit, ahead, driver)
        arc, speed = _drive_step(movers.arc, movers.speed, acceleration)
        enters = waits & _may_enter(context, movers, ahead, frame)
        arrived = arc >= paths.spacing[context.index] * (agent_paths.PATH_POINTS - 1)
        phase = jnp.where(enters, DRIVES, jnp.where(drives & arrived, LEFT, now.phase))
        arc = jnp.where(drives, arc, movers.arc)
        speed = jnp.where(drives, speed, jnp.where(enters, _entry_speed(movers, ahead, driver), movers.speed))
        steps = ((now.arc, arc), (now.speed, speed), (now.there, phase == DRIVES))
        arc, speed, there = (jnp.concatenate([rows[1:], row[None]]) for rows, row in steps)
        return Reactive(now.begin, phase.astype(jnp.int8), now.entry, arc, speed, there, ignored)

    def _class(self, bank: ScenarioBank, index: Any, slot: Int[Array, " R"]) -> Int[Array, " R"]:
        """Index in ``drivers`` of each vehicle's class; -1 for none."""
        kind = bank.agent_box[index, jnp.maximum(slot, 0), SizeColumn.KIND].astype(jnp.int32)
        driver_index = jnp.full(kind.shape, -1)
        for i, (driver_kind, _) in enumerate(self.drivers):
            driver_index = jnp.where(kind == driver_kind, i, driver_index)
        return driver_index

    def _parameters(self, bank: ScenarioBank, index: Any, slot: Int[Array, " R"]) -> IdmParameters:
        """IDM parameters per vehicle (scalars if there is one class).

        Vehicles without a class (-1) get the last one's; they replay the log.
        """
        if len(self.drivers) == 1:
            return self.drivers[0][1]
        driver_index = self._class(bank, index, slot)
        table = {
            field.name: jnp.asarray([getattr(driver, field.name) for _, driver in self.drivers])[driver_index]
            for field in fields(IdmParameters)
        }
        return IdmParameters(**table)


def _movers(
    bank: ScenarioBank, context: AgentContext, slot: Int[Array, " R"]
) -> tuple[Movers, Float[Array, " R"]]:
    """Return the vehicles at their present (or entry) poses, and the speed limits of their paths."""
    now = context.traffic
    arc, speed = now.arc[-1], now.speed[-1]
    pose, profile = path_poses(data_of(bank, AgentPaths), context.index, arc)
    size = bank.agent_box[context.index, jnp.maximum(slot, 0), SizeColumn.FOOTPRINT]
    box, z = jnp.concatenate([pose, size], axis=-1), profile[:, PROFILE_Z]
    return Movers(box, z, arc, speed, slot, now.ignored.astype(jnp.int32)), profile[:, PROFILE_SPEED]


def _update_ignored(
    movers: Movers, frame: Frame, waits: Bool[Array, " R"]
) -> tuple[Movers, Int[Array, "R 2"]]:
    """Stop ignoring agents that a driving vehicle has separated from; return the new slots, too, as stored."""
    other = jnp.maximum(movers.ignored, 0)
    level = jnp.abs(frame.z[other] - movers.z[:, None]) <= LEVEL_M
    touches = overlap(movers.box[:, None], frame.box[other]) & frame.valid[other] & level
    ignored = jnp.where((movers.ignored >= 0) & (touches | waits[:, None]), movers.ignored, -1)
    return replace(movers, ignored=ignored), ignored.astype(jnp.int16)


def _acceleration(
    bank: ScenarioBank, context: AgentContext, movers: Movers, limit: Float[Array, " R"], ahead: Leaders,
    driver: IdmParameters,
) -> Float[Array, " R"]:  # fmt: skip
    """IDM acceleration behind the leader, and before a red light as behind a standing car on the stop line."""
    stop = _stop_gap(bank, context, movers, driver)
    behind = idm_acceleration(movers.speed, limit, ahead.gap, ahead.speed, driver)
    before = idm_acceleration(movers.speed, limit, stop, jnp.zeros_like(stop), driver)
    return jnp.minimum(behind, before)


def _stop_gap(
    bank: ScenarioBank, context: AgentContext, movers: Movers, driver: IdmParameters
) -> Float[Array, " R"]:
    """Distance from the front bumper to the nearest stop line that requires a stop, m; 10 km for none.

    Red stops all vehicles that still can, yellow those that can stop comfortably. At red it is 0 for a vehicle that
    stands with its front over the line.
    """
    paths = data_of(bank, AgentPaths)
    light = paths.stop_light[context.index].astype(jnp.int32)
    state = bank.light_state[context.index, jnp.clip(context.step, 0, bank.steps - 1)][light]
    line = paths.stop_arc[context.index] - movers.arc[:, None]
    front = line - movers.box[:, LENGTH, None] / 2
    square = (movers.speed * movers.speed)[:, None]
    hard = jnp.reshape(driver.max_braking_mps2, (-1, 1))
    soft = jnp.reshape(driver.comfortable_braking_mps2, (-1, 1))
    red, yellow = is_red(state), is_yellow(state)
    on_line = (front <= 0.0) & (line > 0.0) & (movers.speed < _STANDS_MPS)[:, None]
    brakes = (front > 0.0) & ((red & (square <= 2 * hard * front)) | (yellow & (square <= 2 * soft * front)))
    return jnp.min(jnp.where(brakes | (red & on_line), jnp.maximum(front, 0.0), FREE_M), axis=1)


def _drive_step(
    arc: Float[Array, " R"], speed: Float[Array, " R"], acceleration: Float[Array, " R"]
) -> tuple[Float[Array, " R"], Float[Array, " R"]]:
    """Return arc length and speed one step later; a vehicle that would reverse stops within the step."""
    unclipped = speed + acceleration * DT_S
    stops = unclipped < 0.0
    after = jnp.where(stops, 0.0, unclipped)
    braking = jnp.where(stops, -acceleration, 1.0)
    distance = jnp.where(stops, speed * speed / (2.0 * braking), (speed + after) / 2.0 * DT_S)
    return arc + distance, after


def _may_enter(context: AgentContext, movers: Movers, ahead: Leaders, frame: Frame) -> Bool[Array, " R"]:
    """Mask of the waiting vehicles that appear in the next step: due, and with a free entry.

    Of two that wait for the same space the one due first enters first; two on time both enter, as in the log.
    """
    now = context.traffic
    margin = jnp.asarray([0.0, 0.0, 0.0, 0.0, 2 * _ENTRY_END_M, 2 * _ENTRY_SIDE_M])
    box, velocity = frame.box[ahead.slots], frame.velocity[ahead.slots]
    next_box = box.at[..., :2].add(velocity * DT_S)
    blocked = (overlap((movers.box + margin)[:, None], next_box) & ahead.valid).any(axis=1)
    entry = now.entry.astype(jnp.int32)
    ready = (now.phase == WAITS) & (context.step + 1 >= entry) & ~blocked
    late = context.step + 1 > entry
    # By entry step, then by row; as floats, whose minima vectorise.
    order = (entry * entry.shape[0] + jnp.arange(entry.shape[0])).astype(jnp.float32)
    reach = jnp.sqrt(jnp.sum(movers.box[:, LENGTH : WIDTH + 1] ** 2, axis=-1)) / 2
    x, y = columns(movers.box)[:2]
    dx, dy = x[:, None] - x, y[:, None] - y
    near = dx * dx + dy * dy < (reach[:, None] + reach + 2 * _ENTRY_END_M) ** 2
    # Vehicles that are not ready come last; one due now yields to late ones.
    order = jnp.where(ready, order, jnp.inf)
    rival = jnp.where(near & (late[None] | late[:, None]), order[None], jnp.inf)
    return ready & (jnp.min(rival, axis=1) >= order)


def _entry_speed(movers: Movers, ahead: Leaders, driver: IdmParameters) -> Float[Array, " R"]:
    """Logged speed, limited so that the vehicle can brake comfortably behind its leader."""
    room = jnp.maximum(ahead.gap - driver.min_gap_m, 0.0)
    square = jnp.maximum(ahead.speed, 0.0) ** 2 + 2.0 * driver.comfortable_braking_mps2 * room
    return jnp.minimum(movers.speed, jnp.sqrt(jnp.maximum(square, 1e-6)))


#: Traffic models by name.
TRAFFIC: dict[str, Callable[[], Traffic]] = {"log": LogTraffic, "idm": IdmTraffic}


def make_traffic(name: str) -> Traffic:
    """Return the traffic model of a name in :data:`TRAFFIC`, or of ``package.module:name``.

    The latter is a model, its class, or a function that makes one without arguments.

    Raises:
        UsageError: There is no such traffic, or the name leads to something else, which is not called.
    """
    if name in TRAFFIC:
        return TRAFFIC[name]()
    if not is_dotted(name):
        cure = f"use {', '.join(TRAFFIC)}, or package.module:name"
        raise UsageError(f"there is no traffic {name!r}", cure=cure)
    traffic = find_named(name)
    if isinstance(traffic, type) or not isinstance(traffic, Traffic):
        traffic = traffic() if makes(traffic, Traffic) else None
    if not isinstance(traffic, Traffic):
        raise UsageError(f"{name!r} makes no traffic", cure="see drivax.simulator.types.Traffic")
    return traffic

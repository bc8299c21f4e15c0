"""Traffic that reacts (``idm``): vehicles drive along their own logged paths by the Intelligent Driver Model."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from drivax.geometry.boxes import LENGTH, WIDTH, overlap
from drivax.scenario.bank.columns import AgentColumn, SizeColumn
from drivax.scenario.bank.queries import LEVEL_M
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.scenario.record import record
from drivax.scenario.schema import DT_S, AgentKind, LightState
from drivax.simulator.idm import IdmParameters, idm_acceleration
from drivax.simulator.traffic.agent_paths import (
    PATH_POINTS,
    PROFILE_SPEED,
    PROFILE_Z,
    TRAVELS_M,
    AgentPaths,
    with_paths,
)
from drivax.simulator.traffic.bank_data import data_of
from drivax.simulator.traffic.corridor import FREE_M, Leaders, Movers, columns, leaders, path_poses
from drivax.simulator.types import AgentContext, Frame

#: Steps of recent motion that are kept, which is what observations look back; older frames repeat the oldest.
PAST = 10
#: What a vehicle does: it replays its log, waits to appear, drives, or has left.
REPLAYS, WAITS, DRIVES, LEFT = range(4)
#: Free space that an entry place needs beyond the box: at each end and on each side, m.
_ENTRY_END_M, _ENTRY_SIDE_M = 0.5, 0.1
#: Who stands with the front over a stop line waits too; slower than this is standing, m/s.
_STANDS_MPS = 0.5


@record
class Reactive:
    """State of the R vehicles of a scenario that may react; the last of the 10 rows is now.

    Attributes:
        begin: Step at which the episode began; until then all agents moved as logged.
        phase: Replays (0), waits to appear (1), drives (2), has left (3).
        entry: Step at which the log has the vehicle appear.
        arc: Place along the path, m.
        speed: m/s.
        there: Whether the vehicle is on the road.
        ignored: Slots of things that it overlapped when it appeared and has not parted from; -1 for none.
    """

    begin: Int[Array, "*batch"]
    phase: Int[Array, "*batch R"]
    entry: Int[Array, "*batch R"]
    arc: Float[Array, "*batch 10 R"]
    speed: Float[Array, "*batch 10 R"]
    there: Bool[Array, "*batch 10 R"]
    ignored: Int[Array, "*batch R 2"]


@dataclass(frozen=True)
class IdmTraffic:
    """Vehicles react to ego, to each other, to everything else in their way and to red lights.

    A vehicle that travels more than 2 m in the rest of its log follows its own path; every other agent replays. What a
    driver cannot help is left alone: a pair that overlaps when the vehicle appears ignores each other until it parts.

    Attributes:
        drivers: IDM parameters of each class of agents that reacts (``scenario.schema.AgentKind``); the other classes
            replay.
    """

    drivers: tuple[tuple[int, IdmParameters], ...] = ((int(AgentKind.VEHICLE), IdmParameters()),)
    name: str = "idm"

    def prepare(self, bank: ScenarioBank) -> ScenarioBank:
        """The bank with the paths that this traffic needs; one that has them already is returned unchanged."""
        return with_paths(bank, tuple(kind for kind, _ in self.drivers))

    def start(self, bank: ScenarioBank, index: Any, step: Any) -> Reactive:
        """All agents where the log has them at ``step``.

        Raises:
            UsageError: The bank has no paths.
        """
        paths = data_of(bank, AgentPaths)
        index, step = jnp.asarray(index, jnp.int32), jnp.asarray(step, jnp.int32)
        slot = paths.slot[index].astype(jnp.int32)
        entry = paths.appears[index, step].astype(jnp.int32)
        at = jnp.minimum(entry, bank.steps - 1)
        row = jnp.arange(slot.shape[0])
        travels = paths.log_arc[index, -1] - paths.log_arc[index, step] > TRAVELS_M
        reacts = (slot >= 0) & travels & (entry < bank.steps) & (self._class(bank, index, slot) >= 0)
        now = reacts & (entry <= step)
        arc = paths.log_arc[index, at, row]
        speed = paths.log_speed[index, at, row]
        phase = jnp.where(reacts, jnp.where(now, DRIVES, WAITS), REPLAYS)
        return Reactive(
            begin=step,
            phase=phase.astype(jnp.int8),
            entry=entry.astype(jnp.int16),
            arc=jnp.broadcast_to(arc, (PAST, *arc.shape)),
            speed=jnp.broadcast_to(speed, (PAST, *speed.shape)),
            there=jnp.broadcast_to(now, (PAST, *now.shape)),
            ignored=paths.overlaps[index, at, row],
        )

    def agents(self, bank: ScenarioBank, context: AgentContext, back: int) -> Float[Array, "A 8"]:
        """Rows of the moving slots ``back`` steps ago (at most 9): who reacts on its path, others as logged."""
        paths, now = data_of(bank, AgentPaths), context.traffic
        step = context.step - back
        logged = bank.agents[context.index, jnp.clip(step, 0, bank.steps - 1)]
        at = PAST - 1 - min(back, PAST - 1)
        (here, profile), speed = path_poses(paths, context.index, now.arc[at]), now.speed[at, :, None]
        direction, there = here[:, 2:], now.there[at, :, None].astype(jnp.float32)
        height = profile[:, PROFILE_Z : PROFILE_Z + 1]
        driven = jnp.concatenate(
            [here[:, AgentColumn.XY], height, direction, direction * speed, there], axis=-1
        )
        slot = paths.slot[context.index].astype(jnp.int32)
        reacts = (now.phase != REPLAYS) & (step > now.begin)
        return logged.at[jnp.where(reacts, slot, logged.shape[0])].set(driven, mode="drop")

    def advance(self, bank: ScenarioBank, context: AgentContext, frame: Frame) -> Reactive:
        """One step of 0.1 s: every agent looks at the present frame, then all move."""
        paths, now = data_of(bank, AgentPaths), context.traffic
        slot = paths.slot[context.index].astype(jnp.int32)
        movers, most = _movers(bank, context, slot)
        movers, ignored = _without_parted(movers, frame, now.phase == WAITS)
        ahead = leaders(paths, context.index, movers, frame)
        driver = self._parameters(bank, context.index, slot)
        acceleration = _acceleration(bank, context, movers, most, ahead, driver)
        arc, speed = _driven(movers.arc, movers.speed, acceleration)
        drives, waits = now.phase == DRIVES, now.phase == WAITS
        enters = waits & _may_enter(context, movers, ahead, frame)
        arrived = arc >= paths.spacing[context.index] * (PATH_POINTS - 1)
        phase = jnp.where(enters, DRIVES, jnp.where(drives & arrived, LEFT, now.phase))
        arc = jnp.where(drives, arc, movers.arc)
        speed = jnp.where(drives, speed, jnp.where(enters, _entry_speed(movers, ahead, driver), movers.speed))
        return Reactive(
            begin=now.begin,
            phase=phase.astype(jnp.int8),
            entry=now.entry,
            arc=jnp.concatenate([now.arc[1:], arc[None]]),
            speed=jnp.concatenate([now.speed[1:], speed[None]]),
            there=jnp.concatenate([now.there[1:], (phase == DRIVES)[None]]),
            ignored=ignored,
        )

    def _class(self, bank: ScenarioBank, index: Any, slot: Int[Array, " R"]) -> Int[Array, " R"]:
        """Which of the drivers each vehicle is; -1 where none."""
        kind = bank.agent_box[index, jnp.maximum(slot, 0), SizeColumn.KIND].astype(jnp.int32)
        number = jnp.full(kind.shape, -1)
        for place, (name, _) in enumerate(self.drivers):
            number = jnp.where(kind == name, place, number)
        return number

    def _parameters(self, bank: ScenarioBank, index: Any, slot: Int[Array, " R"]) -> IdmParameters:
        """Parameters of each vehicle."""
        if len(self.drivers) == 1:
            return self.drivers[0][1]
        number = self._class(bank, index, slot)
        table = {
            field.name: jnp.asarray([getattr(driver, field.name) for _, driver in self.drivers])[number]
            for field in fields(IdmParameters)
        }
        return IdmParameters(**table)


def _movers(
    bank: ScenarioBank, context: AgentContext, slot: Int[Array, " R"]
) -> tuple[Movers, Float[Array, " R"]]:
    """The vehicles where they are now (waiting ones where they will appear), and the speed that their paths allow."""
    now = context.traffic
    arc, speed = now.arc[-1], now.speed[-1]
    here, profile = path_poses(data_of(bank, AgentPaths), context.index, arc)
    size = bank.agent_box[context.index, jnp.maximum(slot, 0), SizeColumn.FOOTPRINT]
    box, z = jnp.concatenate([here, size], axis=-1), profile[:, PROFILE_Z]
    return Movers(box, z, arc, speed, slot, now.ignored.astype(jnp.int32)), profile[:, PROFILE_SPEED]


def _without_parted(
    movers: Movers, frame: Frame, waits: Bool[Array, " R"]
) -> tuple[Movers, Int[Array, "R 2"]]:
    """Ignores no longer what a vehicle has parted from; one that waits has not met it yet."""
    other = jnp.maximum(movers.ignored, 0)
    level = jnp.abs(frame.z[other] - movers.z[:, None]) <= LEVEL_M
    together = overlap(movers.box[:, None], frame.box[other]) & frame.valid[other] & level
    kept = jnp.where((movers.ignored >= 0) & (together | waits[:, None]), movers.ignored, -1)
    return Movers(movers.box, movers.z, movers.arc, movers.speed, movers.slot, kept), kept.astype(jnp.int16)


def _acceleration(
    bank: ScenarioBank, context: AgentContext, movers: Movers,
    most: Float[Array, " R"], ahead: Leaders, driver: IdmParameters
) -> Float[Array, " R"]:  # fmt: skip
    """IDM behind the leader, and before a red light as behind a car that stands on the stop line."""
    stop = _stop_gap(bank, context, movers, driver)
    behind = idm_acceleration(movers.speed, most, ahead.gap, ahead.speed, driver)
    before = idm_acceleration(movers.speed, most, stop, jnp.zeros_like(stop), driver)
    return jnp.minimum(behind, before)


def _stop_gap(
    bank: ScenarioBank, context: AgentContext, movers: Movers, driver: IdmParameters
) -> Float[Array, " R"]:
    """Distance from the front bumper to the nearest stop line of the path that asks to stop, m.

    A red light asks all that can still stop, a yellow one those that can do so comfortably.
    """
    paths = data_of(bank, AgentPaths)
    light = paths.stop_light[context.index].astype(jnp.int32)
    state = bank.light_state[context.index, jnp.clip(context.step, 0, bank.steps - 1)][light]
    line = paths.stop_arc[context.index] - movers.arc[:, None]
    front = line - movers.box[:, LENGTH : LENGTH + 1] / 2
    square = (movers.speed * movers.speed)[:, None]
    hard, soft = (
        jnp.reshape(driver.max_braking_mps2, (-1, 1)),
        jnp.reshape(driver.comfortable_braking_mps2, (-1, 1)),
    )
    red = (state == LightState.STOP) | (state == LightState.ARROW_STOP)
    yellow = (state == LightState.CAUTION) | (state == LightState.ARROW_CAUTION)
    over = (front <= 0.0) & (line > 0.0) & (movers.speed < _STANDS_MPS)[:, None]
    can = (front > 0.0) & ((red & (square <= 2 * hard * front)) | (yellow & (square <= 2 * soft * front)))
    return jnp.min(jnp.where(can | (red & over), jnp.maximum(front, 0.0), FREE_M), axis=1)


def _driven(
    arc: Float[Array, " R"], speed: Float[Array, " R"], acceleration: Float[Array, " R"]
) -> tuple[Float[Array, " R"], Float[Array, " R"]]:
    """Place and speed one step later; who would go below zero stops inside the step."""
    unclipped = speed + acceleration * DT_S
    stops = unclipped < 0.0
    after = jnp.where(stops, 0.0, unclipped)
    braking = jnp.where(stops, -acceleration, 1.0)
    distance = jnp.where(stops, speed * speed / (2.0 * braking), (speed + after) / 2.0 * DT_S)
    return arc + distance, after


def _may_enter(context: AgentContext, movers: Movers, ahead: Leaders, frame: Frame) -> Bool[Array, " R"]:
    """Who of the waiting may appear one step from now: it is time, and the place will be free.

    Of two that wait for one place the one that is due first goes first; those that appear on time never exclude
    each other, since the log has room for both.
    """
    now = context.traffic
    size = jnp.asarray([0.0, 0.0, 0.0, 0.0, 2 * _ENTRY_END_M, 2 * _ENTRY_SIDE_M])
    box, velocity = frame.box[ahead.things], frame.velocity[ahead.things]
    then = box.at[..., :2].add(velocity * DT_S)
    taken = (overlap((movers.box + size)[:, None], then) & ahead.real).any(axis=1)
    entry = now.entry.astype(jnp.int32)
    ready = (now.phase == WAITS) & (context.step + 1 >= entry) & ~taken
    late = context.step + 1 > entry
    # Whole numbers as floats: their minima vectorise.
    order = (entry * entry.shape[0] + jnp.arange(entry.shape[0])).astype(jnp.float32)
    reach = jnp.sqrt(jnp.sum(movers.box[:, LENGTH : WIDTH + 1] ** 2, axis=-1)) / 2
    x, y = columns(movers.box)[:2]
    dx, dy = x[:, None] - x, y[:, None] - y
    near = dx * dx + dy * dy < (reach[:, None] + reach + 2 * _ENTRY_END_M) ** 2
    # Those that are not ready come last; one that is due now makes way for those that are late.
    order = jnp.where(ready, order, jnp.inf)
    rival = jnp.where(near & (late[None] | late[:, None]), order[None], jnp.inf)
    return ready & (jnp.min(rival, axis=1) >= order)


def _entry_speed(movers: Movers, ahead: Leaders, driver: IdmParameters) -> Float[Array, " R"]:
    """The logged speed, at most what lets a vehicle brake comfortably behind its leader."""
    room = jnp.maximum(ahead.gap - driver.min_gap_m, 0.0)
    square = jnp.maximum(ahead.speed, 0.0) ** 2 + 2.0 * driver.comfortable_braking_mps2 * room
    return jnp.minimum(movers.speed, jnp.sqrt(jnp.maximum(square, 1e-6)))

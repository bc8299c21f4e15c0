"""Paths of reacting agents: geometry along the log and beyond, speed limits, and stop lines.

Computed once per bank with numpy (:func:`with_paths`); a step only looks up rows.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from drivax.geometry.boxes import overlap
from drivax.geometry.polylines import Polylines, arc_lengths, point_to_segment
from drivax.geometry.vectors import wrap
from drivax.scenario.bank.columns import AgentColumn, LaneRow, SizeColumn
from drivax.scenario.bank.queries import LANE_CUTOFF_M, LEVEL_M
from drivax.scenario.bank.scenario_bank import WORD, ScenarioBank
from drivax.scenario.record import record, static
from drivax.scenario.schema import AgentKind, Flag
from drivax.simulator.traffic.agent_lights import light_arcs
from drivax.simulator.traffic.bank_data import TrafficData, find_data, with_data

#: Points of a path, equally far apart along it.
PATH_POINTS = 96
#: Columns read by the look-ahead are stored apart: half as many cache lines for most of the reads.
PATH_X, PATH_Y, PATH_COS, PATH_SIN = range(4)
PROFILE_Z, PROFILE_SPEED = range(2)
#: How far a path goes on beyond the last logged pose, m (semantics, Traffic), and the stored points' distance.
EXTENSION_M, _EXTENSION_STEP_M = 60.0, 4.0
#: An agent reacts if it travels further than this in the rest of its log, m.
TRAVELS_M = 2.0
#: Overlapping agents stored per step.
OVERLAPS = 2
#: Logged positions nearer to each other than this do not shape a path, m: a standing car's boxes jitter.
_KEY_M = 1.0
#: A log that moves backwards further than this belongs to a reversing vehicle, m.
_BACKWARDS_M = 1.5
#: Lateral acceleration in curves and braking towards them, m/s2.
CURVE_MPS2, CURVE_BRAKING_MPS2 = 2.5, 1.5
#: Half the stretch over which a curvature is measured: at least this many metres, and this many seconds at peak speed.
_CURVE_M, _CURVE_S = 2.5, 0.25
Numbers = np.ndarray[Any, Any]
_Tables = tuple[Numbers, ...]


@record
class AgentPaths(TrafficData):
    """Paths of the R agents of a scenario that may react; rows without an agent have slot -1.

    Attributes:
        slot: Agent slot of each path.
        points: x, y, cos, sin, evenly spaced.
        profile: Height of the box centre, and speed limit from peak and curves (m/s), at the same points.
        spacing: Arc length between two points, m.
        log_arc: Arc length of the logged agent at each step, m; never decreases, holds while unobserved.
        log_speed: Logged speed at each step, not negative, m/s.
        appears: First step at or after each step at which the log has the agent; T for none.
        stop_arc: Arc lengths of the stop lines that the path crosses, m; very large for none.
        stop_light: Slot of the light of each of them.
        overlaps: Up to two slots whose boxes the agent overlaps in the log, -1 for none.
        kinds: Agent classes with paths.
    """

    slot: Int[Array, "N R"]
    points: Float[Array, "N R M 4"]
    profile: Float[Array, "N R M 2"]
    spacing: Float[Array, "N R"]
    log_arc: Float[Array, "N T R"]
    log_speed: Float[Array, "N T R"]
    appears: Int[Array, "N T R"]
    stop_arc: Float[Array, "N R 4"]
    stop_light: Int[Array, "N R 4"]
    overlaps: Int[Array, "N T R 2"]
    kinds: tuple[int, ...] = static()


@dataclass(frozen=True)
class _Logs:
    """Logs of V agents, flattened over the scenarios of a bank: where each belongs, and its motion."""

    scenario: Int[np.ndarray, " V"]
    slot: Int[np.ndarray, " V"]
    xy: Float[np.ndarray, "V T 2"]
    z: Float[np.ndarray, "V T"]
    heading: Float[np.ndarray, "V T"]
    speed: Float[np.ndarray, "V T"]
    valid: Bool[np.ndarray, "V T"]
    extension: Float[np.ndarray, "V X 2"]

    def part(self, chosen: Numbers) -> _Logs:
        return _Logs(*(getattr(self, name)[chosen] for name in self.__dataclass_fields__))


@dataclass(frozen=True)
class _Courses:
    """The lines of V agents and where their logs are on them."""

    lines: Polylines  # x, y, z, heading (unwrapped)
    log_arc: Float[np.ndarray, "V T"]


def with_paths(bank: ScenarioBank, kinds: tuple[int, ...] = (int(AgentKind.VEHICLE),)) -> ScenarioBank:
    """Return the bank with paths of all agents of ``kinds`` that drive forward more than 2 m in their log.

    A path is the logged line, thinned to a metre, with logged headings, extended by 60 m along the agent's last lane.
    Its speed limit is the log's peak, 2.5 m/s2 of lateral acceleration, and 1.5 m/s2 of braking towards curves. A bank
    that already has such paths is returned unchanged.
    """
    known = find_data(bank, AgentPaths)
    if known is not None and known.kinds == kinds:
        return bank
    logs = _candidates(bank, kinds)
    courses = _courses(bank, logs)
    count = np.bincount(logs.scenario, minlength=len(bank))
    # A bank that keeps its padding shares programs with others of its capacity.
    rows = max(2, -(-int(count.max(initial=0)) // 2) * 2) if bank.trimmed else bank.agents.shape[2]
    row = np.arange(len(logs.slot)) - np.concatenate(([0], np.cumsum(count)))[logs.scenario]
    shape, at = (len(bank), rows), (logs.scenario, row)

    def placed(values: Numbers, fill: float, dtype: Any) -> Array:
        result = np.full((*shape, *values.shape[1:]), fill, dtype)
        result[at] = values
        return jnp.asarray(result)

    points, profile, spacing = _sampled(courses.lines, _peak(logs))
    at_points = np.concatenate([points, profile], axis=-1)
    stop_arc, stop_light = light_arcs(bank, logs.scenario, at_points, spacing)
    return with_data(
        bank,
        AgentPaths(
            slot=placed(logs.slot, -1, np.int16),
            points=placed(points, 0.0, np.float32),
            profile=placed(profile, 0.0, np.float32),
            spacing=placed(spacing, 1.0, np.float32),
            log_arc=jnp.swapaxes(placed(courses.log_arc, 0.0, np.float32), 1, 2),
            log_speed=jnp.swapaxes(placed(np.maximum(logs.speed, 0.0), 0.0, np.float32), 1, 2),
            appears=jnp.swapaxes(placed(_appears(logs.valid), bank.steps, np.int16), 1, 2),
            stop_arc=placed(stop_arc, 1e6, np.float32),
            stop_light=placed(stop_light, 0, np.int16),
            overlaps=jnp.asarray(_logged_overlaps(bank, logs, row, rows)),
            kinds=kinds,
        ),
    )


def _candidates(bank: ScenarioBank, kinds: tuple[int, ...]) -> _Logs:
    """Logs of the agents that may react: of these kinds, moving more than 2 m, never backwards."""
    agents, kind = (
        np.asarray(bank.agents, np.float64),
        np.asarray(bank.agent_box[:, : bank.agents.shape[2], SizeColumn.KIND]),
    )
    valid = agents[..., AgentColumn.VALID] > 0
    there = np.argwhere(np.isin(kind, kinds) & valid.any(axis=1))
    scenario, slot = there[:, 0], there[:, 1]
    rows = agents[scenario, :, slot]
    heading = np.arctan2(rows[..., AgentColumn.SIN], rows[..., AgentColumn.COS])
    along = (
        rows[..., AgentColumn.VX] * rows[..., AgentColumn.COS]
        + rows[..., AgentColumn.VY] * rows[..., AgentColumn.SIN]
    )
    seen = valid[scenario, :, slot]
    extension = np.asarray(bank.extension, np.float64)[scenario, slot]
    logs = _Logs(
        scenario, slot, rows[..., AgentColumn.XY], rows[..., AgentColumn.Z], heading, along, seen, extension
    )
    key = _keys(logs.xy, logs.valid)
    last, _ = _neighbours(key)
    xy, turned = (np.take_along_axis(x, last[..., None], 1) for x in (logs.xy, logs.heading[..., None]))
    step = np.diff(xy, axis=1) * key[:, 1:, None] * (np.cumsum(key, axis=1)[:, 1:, None] > 1)
    moved = np.hypot(step[..., 0], step[..., 1])
    facing = step[..., 0] * np.cos(turned[:, :-1, 0]) + step[..., 1] * np.sin(turned[:, :-1, 0])
    flips = np.abs(wrap(np.diff(turned[..., 0], axis=1))) > np.pi / 2
    forward = (np.where(facing < 0, moved, 0.0).sum(1) < _BACKWARDS_M) & ~flips.any(1)
    return logs.part((moved.sum(1) > TRAVELS_M) & forward)


def _keys(xy: Float[np.ndarray, "V T 2"], valid: Bool[np.ndarray, "V T"]) -> Bool[np.ndarray, "V T"]:
    """Which steps shape a path: the first valid one, and each that is a metre away from the one before."""
    key, last = np.zeros_like(valid), np.full_like(xy[:, 0], np.inf)
    for step in range(valid.shape[1]):
        away = xy[:, step] - last
        key[:, step] = valid[:, step] & (np.hypot(away[:, 0], away[:, 1]) >= _KEY_M)
        last = np.where(key[:, step, None], xy[:, step], last)
    return key


def _neighbours(key: Bool[np.ndarray, "V T"]) -> tuple[Int[np.ndarray, "V T"], Int[np.ndarray, "V T"]]:
    """The last key step at or before each step (the first one before it), and the first at or after (T for none)."""
    steps = key.shape[1]
    at = np.arange(steps)
    last = np.maximum.accumulate(np.where(key, at, -1), axis=1)
    following = np.minimum.accumulate(np.where(key, at, steps)[:, ::-1], axis=1)[:, ::-1]
    return np.where(last < 0, np.argmax(key, axis=1)[:, None], last), following


def _courses(bank: ScenarioBank, logs: _Logs) -> _Courses:
    """The line of every agent, logged and extended, and where its log is on it."""
    count, steps = logs.valid.shape
    key = _keys(logs.xy, logs.valid)
    last, following = _neighbours(key)
    rows = np.arange(count)
    end = steps - 1 - np.argmax(logs.valid[:, ::-1], axis=1)
    final, final_heading = logs.xy[rows, end], logs.heading[rows, end]
    ahead = final - logs.xy[rows, last[:, -1]]
    # The last pose shapes the path too, unless a standing car's jitter put it behind.
    onward = ahead[:, 0] * np.cos(final_heading) + ahead[:, 1] * np.sin(final_heading) > 0.2
    points = max(1, min(int(EXTENSION_M / _EXTENSION_STEP_M), logs.extension.shape[1]))
    beyond = logs.extension[:, :points]
    line = np.concatenate([logs.xy, final[:, None], beyond], axis=1)
    tangent = np.diff(np.concatenate([final[:, None], beyond, beyond[:, -1:]], axis=1), axis=1)
    tangent = tangent[:, :-1] + tangent[:, 1:]
    heading = np.concatenate(
        [logs.heading, final_heading[:, None], np.arctan2(tangent[..., 1], tangent[..., 0])], axis=1
    )
    height = np.concatenate([logs.z, logs.z[rows, end][:, None], _heights(bank, logs, beyond, end)], axis=1)
    shapes = np.concatenate([key, onward[:, None], np.ones((count, points), bool)], axis=1)
    flat = np.concatenate([line, height[..., None], heading[..., None]], axis=-1)[shapes]
    # Turns over the whole row of agents: each is continuous, whatever it starts at.
    flat[:, 3] = np.unwrap(flat[:, 3]) if len(flat) else flat[:, 3]
    start = np.concatenate(([0], np.cumsum(shapes.sum(1))))
    lines = Polylines(flat, start, arc_lengths(flat, start))
    return _Courses(lines, _log_arcs(logs, lines, key, last, following))


def _log_arcs(
    logs: _Logs, lines: Polylines, key: Numbers, last: Numbers, following: Numbers
) -> Float[np.ndarray, "V T"]:
    """Arc length of every logged step: between two shaping points by how far it has come towards the next."""
    place = lines.start[:-1, None] + np.cumsum(key, axis=1) - 1
    place = np.maximum(place, lines.start[:-1, None])
    begin, then = lines.points[place], lines.points[np.minimum(place + 1, len(lines.points) - 1)]
    way = then[..., :2] - begin[..., :2]
    length = np.maximum(np.hypot(way[..., 0], way[..., 1]), 1e-9)
    come = ((logs.xy - begin[..., :2]) * way).sum(-1) / length
    arc = lines.arc[place] + np.clip(np.where(key, 0.0, come), 0.0, length)
    return np.maximum.accumulate(np.where(logs.valid & (key.cumsum(1) > 0), arc, 0.0), axis=1)


def _heights(bank: ScenarioBank, logs: _Logs, beyond: Numbers, end: Numbers) -> Float[np.ndarray, "V X"]:
    """Heights of the box centre beyond the log: of the lanes below, on one level with the point before."""
    flags, lanes = np.asarray(bank.flags), np.asarray(bank.lanes)
    half = np.asarray(bank.agent_box[:, :, SizeColumn.HEIGHT])[logs.scenario, logs.slot] / 2
    height = np.repeat(logs.z[np.arange(len(end)), end][:, None], beyond.shape[1], axis=1)
    used = np.asarray(bank.grid_lane[:, -1])
    for scenario in np.unique(logs.scenario[(flags[logs.scenario] & int(Flag.ELEVATION)) != 0]):
        mine = np.flatnonzero(logs.scenario == scenario)
        segments = lanes[scenario, : LaneRow.HALF_WIDTH, : int(used[scenario])].astype(np.float64)
        ground = height[mine, 0] - half[mine]
        for point in range(beyond.shape[1]):
            ground = _ground(segments, beyond[mine, point], ground)
            height[mine, point] = ground + half[mine]
    return height


def _ground(segments: Numbers, xy: Numbers, ground: Numbers) -> Float[np.ndarray, " V"]:
    """Height of the nearest lane within 4 m of each point, on the level of ``ground``; that itself where none is."""
    low, high = xy.min(axis=0) - LANE_CUTOFF_M, xy.max(axis=0) + LANE_CUTOFF_M
    middle = (segments[0:2] + segments[2:4]) / 2
    # Segments are at most 4 m long.
    around = ((middle > low[:, None] - 2.0) & (middle < high[:, None] + 2.0)).all(axis=0)
    ax, ay, bx, by, z = segments[:, around]
    if not around.any():
        return ground
    far, _ = point_to_segment(xy[:, None], np.stack([ax, ay], -1)[None], np.stack([bx, by], -1)[None])
    far = np.where(np.abs(z - ground[:, None]) <= LEVEL_M, far, np.inf)
    return np.where(far.min(axis=1) <= LANE_CUTOFF_M, z[far.argmin(axis=1)], ground)


def _peak(logs: _Logs) -> Float[np.ndarray, " V"]:
    return np.max(np.where(logs.valid, logs.speed, 0.0), axis=1, initial=0.0)


def _sampled(
    lines: Polylines, peak: Numbers
) -> tuple[Float[np.ndarray, "V M 4"], Float[np.ndarray, "V M 2"], Float[np.ndarray, " V"]]:
    """Paths at equally distant points, their heights and the speed that they allow, and the points' distance."""
    row, spacing = np.arange(lines.count)[:, None], lines.length / (PATH_POINTS - 1)
    arc = spacing[:, None] * np.arange(PATH_POINTS)
    if not lines.count:
        return np.zeros((0, PATH_POINTS, 4)), np.zeros((0, PATH_POINTS, 2)), spacing
    points = lines.at(row, arc)
    half = np.maximum(_CURVE_M, _CURVE_S * peak)[:, None]
    ahead = np.minimum(arc + half, lines.length[:, None])
    behind = np.maximum(arc - half, 0.0)
    turn = lines.at(row, ahead)[..., 3] - lines.at(row, behind)[..., 3]
    curvature = np.abs(turn) / (ahead - behind)
    speed = np.minimum(peak[:, None], np.sqrt(CURVE_MPS2 / np.maximum(curvature, 1e-6)))
    for point in range(PATH_POINTS - 2, -1, -1):
        reach = np.sqrt(speed[:, point + 1] ** 2 + 2 * CURVE_BRAKING_MPS2 * spacing)
        speed[:, point] = np.minimum(speed[:, point], reach)
    direction = [np.cos(points[..., 3:]), np.sin(points[..., 3:])]
    placed = np.concatenate([points[..., :2], *direction], axis=-1)
    return placed, np.stack([points[..., 2], speed], axis=-1), spacing


def _appears(valid: Bool[np.ndarray, "V T"]) -> Int[np.ndarray, "V T"]:
    steps = valid.shape[1]
    at = np.where(valid, np.arange(steps), steps)
    return np.minimum.accumulate(at[:, ::-1], axis=1)[:, ::-1]


def _logged_overlaps(bank: ScenarioBank, logs: _Logs, row: Numbers, rows: int) -> Numbers:
    """Frame slots whose box each agent's own overlaps in the log, step by step; the first two, -1 for none."""
    overlaps = np.full((len(bank), bank.steps, rows, OVERLAPS), -1, np.int16)
    tables = tuple(np.asarray(part) for part in (bank.agents, bank.agent_box, bank.parked, bank.parked_when))
    for scenario in np.unique(logs.scenario):
        mine = np.flatnonzero(logs.scenario == scenario)
        boxes, z, valid = _logged_boxes(tables, int(scenario))
        own, slots = boxes[:, logs.slot[mine]], logs.slot[mine]
        reach = np.hypot(boxes[0, :, 4], boxes[0, :, 5]) / 2
        dx, dy = (own[:, :, None, i] - boxes[:, None, :, i] for i in (0, 1))
        near = dx * dx + dy * dy < (reach[slots][:, None] + reach) ** 2
        near &= valid[:, None] & valid[:, slots][..., None] & (slots[:, None] != np.arange(boxes.shape[1]))
        near &= np.abs(z[:, slots][..., None] - z[:, None]) <= LEVEL_M
        step, agent, other = np.nonzero(near)
        meets = overlap(own[step, agent], boxes[step, other])
        counted: dict[tuple[int, int], int] = {}
        for t, a, o in zip(step[meets].tolist(), agent[meets].tolist(), other[meets].tolist(), strict=True):
            place = counted.get((t, a), 0)
            counted[t, a] = place + 1
            if place < OVERLAPS:
                overlaps[scenario, t, row[mine[a]], place] = o
    return overlaps


def _logged_boxes(tables: _Tables, scenario: int) -> tuple[Numbers, Numbers, Numbers]:
    """Boxes, heights and validity of all slots of a frame, at every logged step."""
    agents, box, parked, when = (table[scenario] for table in tables)
    step = np.arange(len(agents))
    there = (when[step // WORD] >> (step % WORD).astype(np.uint32)[:, None]) & 1 > 0
    rows = np.pad(agents, ((0, 0), (0, len(box) - agents.shape[1]), (0, 0)))
    rows = np.where(there[..., None], parked, rows)
    size = np.broadcast_to(box[None, :, SizeColumn.FOOTPRINT], (len(rows), len(box), 2))
    boxes = np.concatenate([rows[..., AgentColumn.XY], rows[..., AgentColumn.HEADING], size], axis=-1)
    return boxes, rows[..., AgentColumn.Z], rows[..., AgentColumn.VALID] > 0

"""Paths of reacting agents: geometry along the log and beyond, speed limits, and stop lines.

Computed once per bank with numpy (:func:`with_paths`); a simulation step only reads rows.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from drivax.geometry.boxes import LENGTH, WIDTH, overlap
from drivax.geometry.polylines import Polylines, arc_lengths, point_to_segment
from drivax.geometry.vectors import wrap
from drivax.scenario.bank.columns import NEVER_M, AgentColumn, LaneRow, LightRow, SizeColumn
from drivax.scenario.bank.queries import LANE_CUTOFF_M, LEVEL_M
from drivax.scenario.bank.scenario_bank import WORD, ScenarioBank
from drivax.scenario.record import record, static
from drivax.scenario.schema import AgentKind, Flag
from drivax.simulator.traffic.bank_data import TrafficData, find_data, with_data

#: Points of a path, equally far apart along it.
PATH_POINTS = 96
#: Columns of paths. Those that the look-ahead reads are a separate array: most reads touch half as many cache lines.
PATH_X, PATH_Y, PATH_COS, PATH_SIN = range(4)
PROFILE_Z, PROFILE_SPEED = range(2)
#: Length of a path beyond the last logged pose, and spacing of its points, m.
EXTENSION_M, _EXTENSION_STEP_M = 60.0, 4.0
#: An agent reacts if it travels further than this in the rest of its log, m.
TRAVELS_M = 2.0
#: Overlapping agents stored per step.
OVERLAPS = 2
#: Minimum distance between key positions, m. Only these shape a path, because the boxes of a standing car jitter.
_KEY_M = 1.0
#: A vehicle whose log moves backwards by this much or more reverses, m.
_BACKWARDS_M = 1.5
#: The last pose shapes the path, too, if it is further ahead of the last key position than this, m.
_LAST_POSE_M = 0.2
#: Lateral acceleration in curves and braking towards them, m/s2.
CURVE_MPS2, CURVE_BRAKING_MPS2 = 2.5, 1.5
#: Half the length over which a curvature is measured: at least this many metres, and this many seconds at peak speed.
_CURVE_M, _CURVE_S = 2.5, 0.25
#: Number of stop lines stored per path: the first ones.
STOPS = 4
#: Stop lines that a path crosses within this distance are one stop, m.
_ONE_STOP_M = 3.0
#: Distance beyond a stop at which the path's heading decides which of its lights counts, m.
_DECISION_M = 20.0
#: Minimum cosine of the angle between a path and the lane of a line that it crosses.
_MIN_COS = 0.5
Numbers = np.ndarray[Any, Any]


@record
class AgentPaths(TrafficData):
    """Paths of the R agents of a scenario that may react; rows without an agent have slot -1."""

    slot: Int[Array, "N R"]  # Agent slot of each path
    points: Float[Array, "N R M 4"]  # x, y, cos, sin, evenly spaced
    # Height of the box centre (m), and speed limit from peak speed and curves (m/s), at the same points
    profile: Float[Array, "N R M 2"]
    spacing: Float[Array, "N R"]  # Arc length between two points, m
    # Arc length of the logged agent at each step, m; never decreases, holds while unobserved
    log_arc: Float[Array, "N T R"]
    log_speed: Float[Array, "N T R"]  # Logged speed at each step, not negative, m/s
    # First step at or after each step at which the log has the agent; T for none
    appears: Int[Array, "N T R"]
    # Arc lengths of the stop lines that the path crosses, m; very large for none
    stop_arc: Float[Array, "N R 4"]
    stop_light: Int[Array, "N R 4"]  # Slot of the light of each of them
    overlaps: Int[Array, "N T R 2"]  # Up to two slots whose boxes the agent overlaps in the log, -1 for none
    kinds: tuple[int, ...] = static()  # Agent classes with paths


@dataclass(frozen=True)
class _Logs:
    """Logs of V agents, flattened over the scenarios of a bank."""

    scenario: Int[np.ndarray, " V"]
    slot: Int[np.ndarray, " V"]
    xy: Float[np.ndarray, "V T 2"]
    z: Float[np.ndarray, "V T"]
    heading: Float[np.ndarray, "V T"]
    speed: Float[np.ndarray, "V T"]
    valid: Bool[np.ndarray, "V T"]
    extension: Float[np.ndarray, "V X 2"]

    def part(self, agents: Numbers) -> _Logs:
        return _Logs(*(getattr(self, name)[agents] for name in self.__dataclass_fields__))


def with_paths(bank: ScenarioBank, kinds: tuple[int, ...] = (int(AgentKind.VEHICLE),)) -> ScenarioBank:
    """Return the bank with paths of all agents of ``kinds`` that drive forward more than 2 m in their log.

    A path has the logged positions, at least 1 m apart, with their headings, and 60 m along the agent's last lane. Its
    speed limit follows from the log's peak speed, 2.5 m/s2 of lateral acceleration, and 1.5 m/s2 of braking towards
    curves. A bank that already has these paths is returned unchanged.
    """
    previous = find_data(bank, AgentPaths)
    if previous is not None and previous.kinds == kinds:
        return bank
    logs = _candidates(bank, kinds)
    lines, log_arc = _lines(bank, logs)
    count = np.bincount(logs.scenario, minlength=len(bank))
    # An even number, or the capacity: a bank that keeps its padding shares programs with others of its capacity.
    row_count = max(2, -(-int(count.max(initial=0)) // 2) * 2) if bank.trimmed else bank.agents.shape[2]
    row = np.arange(len(logs.slot)) - np.concatenate(([0], np.cumsum(count)))[logs.scenario]

    def spread(values: Numbers, fill: float, dtype: Any) -> Array:
        """Arrange values of all agents ``[V, ...]`` by scenario and row ``[N, R, ...]``."""
        result = np.full((len(bank), row_count, *values.shape[1:]), fill, dtype)
        result[logs.scenario, row] = values
        return jnp.asarray(result)

    peak = np.max(np.where(logs.valid, logs.speed, 0.0), axis=1, initial=0.0)
    points, profile, spacing = _sample_paths(lines, peak)
    columns = np.concatenate([points, profile], axis=-1)
    stop_arc, stop_light = _light_arcs(bank, logs.scenario, columns, spacing)
    paths = AgentPaths(
        slot=spread(logs.slot, -1, np.int16),
        points=spread(points, 0.0, np.float32),
        profile=spread(profile, 0.0, np.float32),
        spacing=spread(spacing, 1.0, np.float32),
        log_arc=jnp.swapaxes(spread(log_arc, 0.0, np.float32), 1, 2),
        log_speed=jnp.swapaxes(spread(np.maximum(logs.speed, 0.0), 0.0, np.float32), 1, 2),
        appears=jnp.swapaxes(spread(_next_step(logs.valid), bank.steps, np.int16), 1, 2),
        stop_arc=spread(stop_arc, NEVER_M, np.float32),
        stop_light=spread(stop_light, 0, np.int16),
        overlaps=jnp.asarray(_logged_overlaps(bank, logs, row, row_count)),
        kinds=kinds,
    )
    return with_data(bank, paths)


def _candidates(bank: ScenarioBank, kinds: tuple[int, ...]) -> _Logs:
    """Return the logs of the agents that may react: of these kinds, moving more than 2 m, and not reversing."""
    agents = np.asarray(bank.agents, np.float64)
    kind = np.asarray(bank.agent_box[:, : bank.agents.shape[2], SizeColumn.KIND])
    has_agent = (agents[..., AgentColumn.VALID] > 0).any(axis=1)
    scenario, slot = np.argwhere(np.isin(kind, kinds) & has_agent).T
    tracks = agents[scenario, :, slot]
    speed = tracks[..., AgentColumn.VX] * tracks[..., AgentColumn.COS]
    speed += tracks[..., AgentColumn.VY] * tracks[..., AgentColumn.SIN]
    logs = _Logs(
        scenario,
        slot,
        xy=tracks[..., AgentColumn.XY],
        z=tracks[..., AgentColumn.Z],
        heading=np.arctan2(tracks[..., AgentColumn.SIN], tracks[..., AgentColumn.COS]),
        speed=speed,
        valid=tracks[..., AgentColumn.VALID] > 0,
        extension=np.asarray(bank.extension, np.float64)[scenario, slot],
    )
    return logs.part(_travels_forward(logs))


def _travels_forward(logs: _Logs) -> Bool[np.ndarray, " V"]:
    """Mask of the agents that move more than 2 m, and neither reverse nor flip their heading."""
    # Moves between key steps: the jitter of a standing car does not count. The first key step has no move before it.
    key = _key_steps(logs.xy, logs.valid)
    last = _last_key(key)
    xy, heading = (np.take_along_axis(x, last[..., None], 1) for x in (logs.xy, logs.heading[..., None]))
    move = np.diff(xy, axis=1) * key[:, 1:, None] * (np.cumsum(key, axis=1)[:, 1:, None] > 1)
    distance_m = np.hypot(move[..., 0], move[..., 1])
    forward_m = move[..., 0] * np.cos(heading[:, :-1, 0]) + move[..., 1] * np.sin(heading[:, :-1, 0])
    flips = np.abs(wrap(np.diff(heading[..., 0], axis=1))) > np.pi / 2
    reverses = (np.where(forward_m < 0, distance_m, 0.0).sum(1) >= _BACKWARDS_M) | flips.any(1)
    return (distance_m.sum(1) > TRAVELS_M) & ~reverses


def _key_steps(xy: Float[np.ndarray, "V T 2"], valid: Bool[np.ndarray, "V T"]) -> Bool[np.ndarray, "V T"]:
    """Mask of the steps that shape a path: the first valid one, and each that is 1 m or more from the last of them."""
    key, last = np.zeros_like(valid), np.full_like(xy[:, 0], np.inf)
    for step in range(valid.shape[1]):
        offset = xy[:, step] - last
        key[:, step] = valid[:, step] & (np.hypot(offset[:, 0], offset[:, 1]) >= _KEY_M)
        last = np.where(key[:, step, None], xy[:, step], last)
    return key


def _last_key(key: Bool[np.ndarray, "V T"]) -> Int[np.ndarray, "V T"]:
    """Return the last key step at or before each step, or the first key step if there is none before it."""
    last = np.maximum.accumulate(np.where(key, np.arange(key.shape[1]), -1), axis=1)
    return np.where(last < 0, np.argmax(key, axis=1)[:, None], last)


def _next_step(valid: Bool[np.ndarray, "V T"]) -> Int[np.ndarray, "V T"]:
    """Return the first valid step at or after each step; T where there is none."""
    steps = valid.shape[1]
    step = np.where(valid, np.arange(steps), steps)
    return np.minimum.accumulate(step[:, ::-1], axis=1)[:, ::-1]


def _lines(bank: ScenarioBank, logs: _Logs) -> tuple[Polylines, Float[np.ndarray, "V T"]]:
    """Return the line of every agent (x, y, z, unwrapped heading), and the arc length of its log at each step."""
    count, steps = logs.valid.shape
    key = _key_steps(logs.xy, logs.valid)
    agent = np.arange(count)
    end = steps - 1 - np.argmax(logs.valid[:, ::-1], axis=1)
    final_xy, final_heading = logs.xy[agent, end], logs.heading[agent, end]
    offset = final_xy - logs.xy[agent, _last_key(key)[:, -1]]
    # The last pose shapes the path, too, unless it is behind, by the jitter of a standing car.
    is_ahead = offset[:, 0] * np.cos(final_heading) + offset[:, 1] * np.sin(final_heading) > _LAST_POSE_M
    point_count = max(1, min(int(EXTENSION_M / _EXTENSION_STEP_M), logs.extension.shape[1]))
    extension = logs.extension[:, :point_count]
    xy = np.concatenate([logs.xy, final_xy[:, None], extension], axis=1)
    # The tangent at a point of the extension is the sum of the pieces before and after it.
    tangent = np.diff(np.concatenate([final_xy[:, None], extension, extension[:, -1:]], axis=1), axis=1)
    tangent = tangent[:, :-1] + tangent[:, 1:]
    heading = np.arctan2(tangent[..., 1], tangent[..., 0])
    heading = np.concatenate([logs.heading, final_heading[:, None], heading], axis=1)
    height = _heights(bank, logs, extension, end)
    height = np.concatenate([logs.z, logs.z[agent, end][:, None], height], axis=1)
    mask = np.concatenate([key, is_ahead[:, None], np.ones((count, point_count), bool)], axis=1)
    flat = np.concatenate([xy, height[..., None], heading[..., None]], axis=-1)[mask]
    # Unwrapped over all agents at once: a line is continuous at any initial heading.
    flat[:, 3] = np.unwrap(flat[:, 3]) if len(flat) else flat[:, 3]
    start = np.concatenate(([0], np.cumsum(mask.sum(1))))
    lines = Polylines(flat, start, arc_lengths(flat, start))
    return lines, _log_arcs(logs, lines, key)


def _log_arcs(logs: _Logs, lines: Polylines, key: Numbers) -> Float[np.ndarray, "V T"]:
    """Return the arc length of every logged step: between two key steps by projection on their chord."""
    # The first points of a line are its key steps, so their running count is the point at or before each step.
    point = lines.start[:-1, None] + np.cumsum(key, axis=1) - 1
    point = np.maximum(point, lines.start[:-1, None])
    before, after = lines.points[point], lines.points[np.minimum(point + 1, len(lines.points) - 1)]
    chord = after[..., :2] - before[..., :2]
    length = np.maximum(np.hypot(chord[..., 0], chord[..., 1]), 1e-9)
    along = ((logs.xy - before[..., :2]) * chord).sum(-1) / length
    arc = lines.arc[point] + np.clip(np.where(key, 0.0, along), 0.0, length)
    return np.maximum.accumulate(np.where(logs.valid & (key.cumsum(1) > 0), arc, 0.0), axis=1)


def _heights(bank: ScenarioBank, logs: _Logs, extension: Numbers, end: Numbers) -> Float[np.ndarray, "V X"]:
    """Return heights of the box centre beyond the log, from the nearest lane on the level of the point before.

    ``end`` is the last valid step of each log. In scenarios without elevation the height at this step is kept.
    """
    flags, lanes = np.asarray(bank.flags), np.asarray(bank.lanes)
    half_height = np.asarray(bank.agent_box[:, :, SizeColumn.HEIGHT])[logs.scenario, logs.slot] / 2
    height = np.repeat(logs.z[np.arange(len(end)), end][:, None], extension.shape[1], axis=1)
    segment_count = np.asarray(bank.grid_lane[:, -1])
    for scenario in np.unique(logs.scenario[(flags[logs.scenario] & int(Flag.ELEVATION)) != 0]):
        agents = np.flatnonzero(logs.scenario == scenario)
        segments = lanes[scenario, : LaneRow.HALF_WIDTH, : int(segment_count[scenario])].astype(np.float64)
        ground = height[agents, 0] - half_height[agents]
        for point in range(extension.shape[1]):
            ground = _ground(segments, extension[agents, point], ground)
            height[agents, point] = ground + half_height[agents]
    return height


def _ground(segments: Numbers, xy: Numbers, ground: Numbers) -> Float[np.ndarray, " V"]:
    """Return the height of the nearest lane within 4 m of each point on the level of ``ground``, or ``ground``."""
    low, high = xy.min(axis=0) - LANE_CUTOFF_M, xy.max(axis=0) + LANE_CUTOFF_M
    middle = (segments[0:2] + segments[2:4]) / 2
    # Segments are at most 4 m long.
    is_near = ((middle > low[:, None] - 2.0) & (middle < high[:, None] + 2.0)).all(axis=0)
    if not is_near.any():
        return ground
    ax, ay, bx, by, z = segments[:, is_near]
    distance, _ = point_to_segment(xy[:, None], np.stack([ax, ay], -1)[None], np.stack([bx, by], -1)[None])
    distance = np.where(np.abs(z - ground[:, None]) <= LEVEL_M, distance, np.inf)
    return np.where(distance.min(axis=1) <= LANE_CUTOFF_M, z[distance.argmin(axis=1)], ground)


def _sample_paths(
    lines: Polylines, peak: Numbers
) -> tuple[Float[np.ndarray, "V M 4"], Float[np.ndarray, "V M 2"], Float[np.ndarray, " V"]]:
    """Return evenly spaced poses on paths, their heights and speed limits, and the spacing; ``peak`` is in m/s."""
    row, spacing = np.arange(lines.count)[:, None], lines.length / (PATH_POINTS - 1)
    arc = spacing[:, None] * np.arange(PATH_POINTS)
    if not lines.count:
        return np.zeros((0, PATH_POINTS, 4)), np.zeros((0, PATH_POINTS, 2)), spacing
    points = lines.at(row, arc)
    half_m = np.maximum(_CURVE_M, _CURVE_S * peak)[:, None]
    ahead_m = np.minimum(arc + half_m, lines.length[:, None])
    behind_m = np.maximum(arc - half_m, 0.0)
    turn = lines.at(row, ahead_m)[..., 3] - lines.at(row, behind_m)[..., 3]
    curvature = np.abs(turn) / (ahead_m - behind_m)
    speed = np.minimum(peak[:, None], np.sqrt(CURVE_MPS2 / np.maximum(curvature, 1e-6)))
    # Backwards, so that every point allows braking to the limits of all later ones.
    for point in range(PATH_POINTS - 2, -1, -1):
        braking_speed = np.sqrt(speed[:, point + 1] ** 2 + 2 * CURVE_BRAKING_MPS2 * spacing)
        speed[:, point] = np.minimum(speed[:, point], braking_speed)
    direction = [np.cos(points[..., 3:]), np.sin(points[..., 3:])]
    poses = np.concatenate([points[..., :2], *direction], axis=-1)
    return poses, np.stack([points[..., 2], speed], axis=-1), spacing


def _logged_overlaps(bank: ScenarioBank, logs: _Logs, row: Numbers, row_count: int) -> Numbers:
    """Return the first two frame slots that each agent overlaps at each step of the log, -1 for none."""
    overlaps = np.full((len(bank), bank.steps, row_count, OVERLAPS), -1, np.int16)
    tables = [np.asarray(table) for table in (bank.agents, bank.agent_box, bank.parked, bank.parked_when)]
    for scenario in np.unique(logs.scenario):
        agents = np.flatnonzero(logs.scenario == scenario)
        boxes, z, valid = _logged_boxes(*(table[scenario] for table in tables))
        agent_boxes, slots = boxes[:, logs.slot[agents]], logs.slot[agents]
        radius = np.hypot(boxes[0, :, LENGTH], boxes[0, :, WIDTH]) / 2
        dx, dy = (agent_boxes[:, :, None, i] - boxes[:, None, :, i] for i in (0, 1))
        is_near = dx * dx + dy * dy < (radius[slots][:, None] + radius) ** 2
        is_near &= valid[:, None] & valid[:, slots][..., None] & (slots[:, None] != np.arange(boxes.shape[1]))
        is_near &= np.abs(z[:, slots][..., None] - z[:, None]) <= LEVEL_M
        candidates = np.argwhere(is_near)
        step, agent, other = candidates.T
        step, agent, other = candidates[overlap(agent_boxes[step, agent], boxes[step, other])].T
        # Overlaps are sorted by step and agent: the rank of each is its offset from the first of its agent and step.
        key = step * len(agents) + agent
        rank = np.arange(len(key)) - np.searchsorted(key, key)
        is_first = rank < OVERLAPS
        position = scenario, step[is_first], row[agents[agent[is_first]]], rank[is_first]
        overlaps[position] = other[is_first]
    return overlaps


def _logged_boxes(
    agents: Numbers, box: Numbers, parked: Numbers, parked_when: Numbers
) -> tuple[Numbers, Numbers, Numbers]:
    """Return boxes, heights and validity of all slots of a scenario's frames, at every logged step."""
    step = np.arange(len(agents))
    is_parked = (parked_when[step // WORD] >> (step % WORD).astype(np.uint32)[:, None]) & 1 > 0
    rows = np.pad(agents, ((0, 0), (0, len(box) - agents.shape[1]), (0, 0)))
    rows = np.where(is_parked[..., None], parked, rows)
    size = np.broadcast_to(box[None, :, SizeColumn.FOOTPRINT], (len(rows), len(box), 2))
    boxes = np.concatenate([rows[..., AgentColumn.XY], rows[..., AgentColumn.HEADING], size], axis=-1)
    return boxes, rows[..., AgentColumn.Z], rows[..., AgentColumn.VALID] > 0


def _light_arcs(
    bank: ScenarioBank, scenario: Int[np.ndarray, " V"], columns: Float[np.ndarray, "V M 6"],
    spacing: Float[np.ndarray, " V"],
) -> tuple[Float[np.ndarray, "V 4"], Int[np.ndarray, "V 4"]]:  # fmt: skip
    """Return arc lengths of the first four stops of each path, and the slots of their lights.

    ``columns`` are those of the points and profiles of paths. Lights that are never observed do not count.
    """
    arcs = np.full((len(scenario), STOPS), NEVER_M)
    lights = np.zeros((len(scenario), STOPS), np.int64)
    line, state = np.asarray(bank.light_line, np.float64), np.asarray(bank.light_state)
    exits = np.arctan2(line[:, LightRow.EXIT_SIN], line[:, LightRow.EXIT_COS])
    for index in np.unique(scenario):
        observed = np.flatnonzero((state[index] >= 0).any(axis=0))
        agents = np.flatnonzero(scenario == index)
        if not len(observed):
            continue
        crossings = _crossings(line[index][:, observed], columns[agents], spacing[agents])
        for path, arc in zip(agents, crossings, strict=True):
            heading = np.arctan2(columns[path, :, PATH_SIN], columns[path, :, PATH_COS])
            stops = _stops(arc, heading, spacing[path], exits[index, observed])
            for number, (stop_m, light) in enumerate(stops[:STOPS]):
                arcs[path, number], lights[path, number] = stop_m, observed[light]
    return arcs, lights


def _crossings(line: Numbers, columns: Numbers, spacing: Numbers) -> Float[np.ndarray, "V L"]:
    """Return the arc length at which each path first crosses each stop line forwards; infinite where it does not."""
    cos, sin = line[LightRow.COS], line[LightRow.SIN]
    dx, dy = columns[:, :, None, PATH_X] - line[LightRow.X], columns[:, :, None, PATH_Y] - line[LightRow.Y]
    ahead, left = dx * cos + dy * sin, dy * cos - dx * sin
    before, after = ahead[:, :-1], ahead[:, 1:]
    fraction = -before / np.where(after > before, after - before, 1.0)
    is_within = np.abs(left[:, :-1] + fraction * np.diff(left, axis=1)) <= line[LightRow.HALF]
    is_parallel = columns[:, :-1, None, PATH_COS] * cos + columns[:, :-1, None, PATH_SIN] * sin > _MIN_COS
    is_level = np.abs(columns[:, :-1, None, PATH_SIN + 1 + PROFILE_Z] - line[LightRow.Z]) <= LEVEL_M
    crosses = (before < 0.0) & (after >= 0.0) & is_within & is_parallel & is_level
    first = np.argmax(crosses, axis=1)
    arc = (first + np.take_along_axis(fraction, first[:, None], axis=1)[:, 0]) * spacing[:, None]
    return np.where(crosses.any(axis=1), arc, np.inf)


def _stops(arc: Numbers, heading: Numbers, spacing: float, exits: Numbers) -> list[tuple[float, int]]:
    """Return a path's stops in order: arc length, and the light whose lane ends closest to the heading 20 m beyond.

    ``arc`` are the arc lengths at which the path crosses each line, ``exits`` the headings at the ends of their lanes.
    """
    groups: list[list[int]] = []
    for light in (int(light) for light in np.argsort(arc) if np.isfinite(arc[light])):
        if groups and arc[light] - arc[groups[-1][0]] <= _ONE_STOP_M:
            groups[-1].append(light)
        else:
            groups.append([light])
    stops = []
    for group in groups:
        point = min(round((arc[group[0]] + _DECISION_M) / spacing), len(heading) - 1)
        light = min(group, key=lambda light: abs(float(wrap(exits[light] - heading[point]))))
        stops.append((float(arc[light]), light))
    return stops

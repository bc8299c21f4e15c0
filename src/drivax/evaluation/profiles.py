"""Evaluate stored episodes by the rules of another program.

The only such profile is ``devkit``, nuPlan's closed-loop score as its devkit computes it
(:mod:`drivax.evaluation.devkit`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import shapely
from jaxtyping import Array, Bool, Float

from drivax.errors import DataError
from drivax.escaping import csv_text
from drivax.evaluation.devkit import DevkitVerdict, EgoMotion, Road, RoadObject, Tracks, devkit_verdict
from drivax.evaluation.episode_table import EpisodeTable, Trajectories
from drivax.evaluation.rollout import unpack_poses
from drivax.files import write_text
from drivax.geometry.boxes import corners
from drivax.planners.nuplan.map import lane_lines, roadblocks
from drivax.scenario.bank.queries import LEVEL_M, around_lanes, offroad_distance
from drivax.scenario.bank.scenario_bank import DEFAULT_LANE_WIDTH_M, ScenarioBank
from drivax.scenario.bank.sizes import Sizes
from drivax.scenario.schema import DT_S, AgentKind, Scenario
from drivax.scenario.store import ScenarioSet
from drivax.seal import edited_files
from drivax.simulator.contact import REAR_AXLE
from drivax.table import Cell, Column, Table

#: The metric of drivax for each term of the devkit's score.
TERMS = {
    "score": "nuplan_score", "fault_score": "at_fault_collision", "drivable": "offroad", "direction": "direction",
    "making_progress": "making_progress", "ttc_ok": "ttc_ok", "progress": "progress_ratio",
    "speed": "speed_compliance", "comfortable": "comfortable",
}  # fmt: skip
#: Terms that equal 1 minus the metric of drivax.
_NEGATED = ("fault_score", "drivable")
#: Longest window for the speeds of simulated traffic, steps.
_SPEED_STEPS = 5
#: Largest difference of terms that count as equal.
_TOLERANCE = 0.005
FILE = "devkit.csv"


@dataclass(frozen=True)
class ProfileRow:
    """Terms of an episode by both definitions.

    Attributes:
        dataset: Data set of the scenario.
        scenario_id: Id of the scenario.
        ours: Value of each term (:data:`TERMS`) by drivax, NaN if undefined.
        devkit: Value of each term by the devkit.
    """

    dataset: str
    scenario_id: str
    ours: dict[str, float]
    devkit: dict[str, float]

    @property
    def differing(self) -> tuple[str, ...]:
        """Terms that differ, except the score."""
        names = [name for name in TERMS if name != "score"]
        return tuple(name for name in names if abs(self.ours[name] - self.devkit[name]) > _TOLERANCE)


def devkit_rows(
    table: EpisodeTable, data: ScenarioSet, progress: Callable[[int, int], None] = lambda done, total: None
) -> list[ProfileRow]:
    """Evaluate every episode of a table by the devkit's rules.

    Maps of drivax contain lane centre lines and road edges. Lanes are therefore strips of constant width, the drivable
    area ends at the road edges, and connectors stand for intersections. Agents on another level of the road are
    ignored.

    Args:
        table: Episodes with trajectories.
        data: The scenario set of the evaluation.
        progress: Called with (done, total) after every episode.

    Raises:
        DataError: The table lacks a metric that the devkit's terms are compared with, or the set lacks a scenario.
    """
    if missing := [metric for metric in TERMS.values() if metric not in table.metrics]:
        cure = "run drivax evaluate again"
        raise DataError(f"lacks the metric {missing[0]!r}", file=table.folder, cure=cure)
    indices = {(entry["dataset"], entry["scenario_id"]): index for index, entry in enumerate(data.entries)}
    if missing := [key for key in table.scenarios if key not in indices]:
        cure = "pass the set that was evaluated with --data SET"
        raise DataError("is not in the scenario set", file=data.path, record=missing[0][1], cure=cure)
    sizes, crashes, result = Sizes.used(data), table.crash_by_scenario, []
    for number, key in enumerate(table.scenarios):
        verdict = devkit_episode(data[indices[key]], table.trajectories, number, sizes)
        ours = {name: float(table.metrics[metric][number]) for name, metric in TERMS.items()}
        ours |= {name: 1.0 - ours[name] for name in _NEGATED}
        devkit = {name: float(getattr(verdict, name)) for name in TERMS}
        # After a crash the last state is repeated, which may look comfortable and safe.
        devkit |= {"score": 0.0} if key in crashes else {}
        result.append(ProfileRow(*key, ours, devkit))
        progress(number + 1, len(table))
    return result


def devkit_episode(scenario: Scenario, trajectories: Trajectories, row: int, sizes: Sizes) -> DevkitVerdict:
    """Evaluate one episode by the devkit's rules.

    Args:
        scenario: Scenario of the episode.
        trajectories: Trajectories of the evaluation.
        row: Row of the episode in ``trajectories``.
        sizes: Sizes of the set's banks.
    """
    start, end = trajectories.begin(row, scenario), int(scenario.steps)
    steps, count = slice(start, end), end - start
    ego = _ego(scenario, trajectories.ego[row, :count].astype(np.float64), start)
    expert = scenario.agent_xy[steps, 0][scenario.agent_valid[steps, 0]].astype(np.float64)
    others = None if trajectories.others is None else unpack_poses(trajectories.others[row, :count])
    return devkit_verdict(ego, _tracks(scenario, steps, others), _road(scenario, steps, sizes), expert)


def write_rows(rows: Sequence[ProfileRow], path: Path) -> None:
    """Write a CSV file with both values of every term, and the names of the terms that differ."""
    columns = (f"{side}_{name}" for name in TERMS for side in ("drivax", "devkit"))
    # Mark results of edited files.
    edited = {f"edited: {name}": "1" for name in edited_files()}
    lines = [["dataset", "scenario_id", *columns, "differ", *edited]]
    for row in rows:
        values = (value for name in TERMS for value in (row.ours[name], row.devkit[name]))
        cells = ("" if np.isnan(value) else f"{value:.6g}" for value in values)
        lines.append([row.dataset, row.scenario_id, *cells, " ".join(row.differing), *edited.values()])
    write_text(path, csv_text(lines))


def format_rows(rows: Sequence[ProfileRow]) -> str:
    """Format a table of the terms: both means, the number of episodes that differ, and the number with both."""
    lines = []
    for name, metric in TERMS.items():
        pairs = np.array([(row.ours[name], row.devkit[name]) for row in rows])
        pairs = pairs[~np.isnan(pairs).any(axis=1)]
        means = [f"{mean:.3f}" for mean in pairs.mean(axis=0)] if len(pairs) else ["", ""]
        differ = int((np.abs(pairs[:, 0] - pairs[:, 1]) > _TOLERANCE).sum())
        term = f"1 - {metric}" if name in _NEGATED else metric
        numbers = (*means, f"{differ:,}", f"{len(pairs):,}")
        lines.append((Cell(name), Cell(term), *map(Cell, numbers)))
    columns = (
        Column("devkit's term", label=True), Column("ours", left=True),
        *map(Column, ("drivax", "devkit", "differ in", "n")),
    )  # fmt: skip
    return Table("profile", columns, tuple(lines)).text()


def _ego(scenario: Scenario, motion: Float[np.ndarray[Any, Any], "t 4"], start: int) -> EgoMotion:
    """Return ego's motion; accelerations are backward differences, and yaw rates forward differences.

    The first acceleration is 0 unless ego starts at its logged position, and the previous step is in the log.
    """
    x, y, heading, speed = motion.T
    previous_step = max(start - 1, 0)
    # The log does not contain the speed before a noisy start.
    starts_in_log = np.allclose(motion[0, :2], scenario.agent_xy[start, 0], atol=1e-3)
    previous_speed = speed[0]
    if starts_in_log and scenario.agent_valid[previous_step, 0]:
        previous_speed = float(np.hypot(*scenario.agent_velocity[previous_step, 0]))
    turns = np.diff(np.unwrap(heading))
    yaw_rate = np.append(turns, turns[-1:]) / DT_S if len(turns) else np.zeros(1)
    length, width = (float(size) for size in scenario.agent_size[0, :2])
    return EgoMotion(
        xy=np.stack([x, y], axis=-1),
        heading=heading,
        speed=np.abs(speed),
        acceleration=np.diff(speed, prepend=previous_speed) / DT_S,
        yaw_rate=yaw_rate,
        yaw_acceleration=np.diff(yaw_rate, prepend=yaw_rate[:1]) / DT_S,
        size_m=(length, width),
        rear_axle_m=length * REAR_AXLE,
    )


def _tracks(scenario: Scenario, steps: slice, others: Float[np.ndarray[Any, Any], "t A 3"] | None) -> Tracks:
    """Return the other agents on ego's level: those that traffic moves, and parked ones."""
    slots = slice(1, scenario.agent_xy.shape[1] if others is None else others.shape[1])
    xy, heading, speed, moving = _moving_agents(scenario, steps, slots, others)
    ego_z = _fill_gaps(scenario.agent_z[:, :1], scenario.agent_valid[:, :1])[steps]
    z = _fill_gaps(scenario.agent_z[:, slots], scenario.agent_valid[:, slots])[steps]
    parked = scenario.parked_valid[steps] & (np.abs(scenario.parked_z - ego_z) <= LEVEL_M)
    present = np.concatenate([moving & (np.abs(z - ego_z) <= LEVEL_M), parked], axis=1)
    ever_present = present.any(axis=0)

    def concatenate(moving_values: Any, parked_values: Any) -> Any:
        parked_series = np.broadcast_to(parked_values, (len(present), *np.shape(parked_values)))
        values = np.concatenate([moving_values, parked_series], axis=1)[:, ever_present]
        return np.nan_to_num(values).astype(np.float64)

    kind = np.concatenate([scenario.agent_kind[slots], scenario.parked_kind])[ever_present]
    size = np.concatenate([scenario.agent_size[slots, :2], scenario.parked_size[:, :2]])[ever_present]
    is_static = np.isin(kind, (AgentKind.STATIC, AgentKind.OTHER))
    return Tracks(
        xy=concatenate(xy, scenario.parked_xy),
        heading=concatenate(heading, scenario.parked_heading),
        speed=np.where(is_static, 0.0, concatenate(speed, np.zeros(parked.shape[1]))),
        present=present[:, ever_present],
        size_m=size.astype(np.float64),
        kind=kind,
    )


def _moving_agents(
    scenario: Scenario, steps: slice, slots: slice, others: Float[np.ndarray[Any, Any], "t A 3"] | None
) -> tuple[Any, Any, Any, Any]:
    """Return positions, headings, speeds and presence of the agents that traffic moves."""
    if others is None:
        velocity = scenario.agent_velocity[steps, slots]
        speed = np.hypot(velocity[..., 0], velocity[..., 1])
        xy, heading = scenario.agent_xy[steps, slots], scenario.agent_heading[steps, slots]
        return xy, heading, speed, scenario.agent_valid[steps, slots]
    poses = others[:, 1:].astype(np.float64)
    xy = poses[..., :2]
    return xy, poses[..., 2], _speeds(xy), ~np.isnan(poses[..., 0])


def _speeds(xy: Float[np.ndarray[Any, Any], "t A 2"]) -> Float[np.ndarray[Any, Any], "t A"]:
    """Return speeds over the longest valid window of the last 0.5 s, or over the next step where an agent appears.

    Speeds over one step are noisy, because stored positions are multiples of 2 cm.
    """
    speed = np.zeros(xy.shape[:2])
    for lag in range(1, _SPEED_STEPS + 1):
        window_speed = np.linalg.norm(xy[lag:] - xy[:-lag], axis=-1) / (lag * DT_S)
        speed[lag:] = np.where(np.isnan(window_speed), speed[lag:], window_speed)
    appears = np.isnan(np.concatenate([xy[:1] + np.nan, xy[:-1]])[..., 0])
    next_speed = np.linalg.norm(np.diff(xy, axis=0, append=xy[-1:]), axis=-1) / DT_S
    return np.where(appears, np.nan_to_num(next_speed), speed)


def _fill_gaps(
    values: Float[np.ndarray[Any, Any], "t A"], valid: Bool[np.ndarray[Any, Any], "t A"]
) -> Float[np.ndarray[Any, Any], "t A"]:
    """Fill gaps with the previous valid value, and leading gaps with the first valid value."""
    steps = np.arange(len(values))[:, None]
    last = np.maximum.accumulate(np.where(valid, steps, -1), axis=0)
    return np.take_along_axis(values, np.where(last >= 0, last, valid.argmax(axis=0)), axis=0)


def _road(scenario: Scenario, steps: slice, sizes: Sizes) -> Road:
    objects = _objects(scenario)
    intersections = shapely.unary_union([lane.polygon for lane in objects if lane.connector])
    bank = ScenarioBank.from_scenarios([scenario], trim=sizes)
    heights = _fill_gaps(scenario.agent_z[:, :1], scenario.agent_valid[:, :1])[steps, 0]
    z = jnp.asarray(heights - scenario.agent_size[0, 2] / 2)

    def outside_m(ego: EgoMotion) -> np.ndarray[Any, Any]:
        return np.asarray(_corner_distances(bank, jnp.asarray(ego.boxes, jnp.float32), z), np.float64)

    def in_intersection(points: np.ndarray[Any, Any]) -> Any:
        return shapely.contains_xy(intersections, points[:, 0], points[:, 1])

    return Road(objects, outside_m, in_intersection)


@jax.jit
def _corner_distances(
    bank: ScenarioBank, boxes: Float[Array, "t 6"], z: Float[Array, " t"]
) -> Float[Array, "t 4"]:
    """Return the distance of each corner of ego's boxes beyond the road edges, m, at ground heights ``z``."""
    index = jnp.zeros((), jnp.int32)

    def box_distances(box: Float[Array, " 6"], ground: Float[Array, ""]) -> Float[Array, " 4"]:
        points = corners(box)
        near_lane = around_lanes(bank, index, box[:2], box[2:4], points, ground).points_near
        return offroad_distance(bank, index, box[:2], points, near_lane, ground)

    return jax.vmap(box_distances)(boxes, z)


def _objects(scenario: Scenario) -> list[RoadObject]:
    """Return lanes and connectors in the order of the lane graph; those without segments have an empty area."""
    lines, blocks, objects = lane_lines(scenario), roadblocks(scenario), []
    for index, points in enumerate(lines):
        line: Any = shapely.linestrings(points) if len(points) else shapely.LineString()
        width, limit = float(scenario.lane_width[index]), float(scenario.lane_limit[index])
        half_width = (width if width > 0 else DEFAULT_LANE_WIDTH_M) / 2
        links = (table[index].tolist() for table in (scenario.lane_successor, scenario.lane_predecessor))
        successors, predecessors = (tuple(i for i in lanes if 0 <= i < len(lines)) for lanes in links)
        polygon, limit_mps = line.buffer(half_width, cap_style="flat"), limit if limit > 0 else None
        connector = bool(scenario.lane_interpolating[index])
        lane = RoadObject(polygon, line, blocks[index], limit_mps, connector, successors, predecessors)
        objects.append(lane)
    return objects

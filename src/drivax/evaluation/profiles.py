"""Evaluate stored episodes by the rules of another program.

The only profile is ``devkit``: nuPlan's closed-loop score as its devkit computes it (:mod:`drivax.evaluation.devkit`).
"""

from __future__ import annotations

import csv
import io
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
from drivax.evaluation.devkit import DevkitVerdict, EgoMotion, Road, RoadObject, Tracks, devkit_verdict
from drivax.evaluation.episode_table import EpisodeTable, Trajectories
from drivax.evaluation.rollout import unpack_poses
from drivax.files import write_text
from drivax.geometry.boxes import corners
from drivax.scenario.bank.queries import LEVEL_M, around_lanes, offroad_distance
from drivax.scenario.bank.scenario_bank import DEFAULT_LANE_WIDTH_M, ScenarioBank, Sizes
from drivax.scenario.roadblocks import lane_lines, roadblocks
from drivax.scenario.schema import DT_S, AgentKind, Scenario
from drivax.scenario.store import ScenarioSet
from drivax.simulator.contact import REAR_AXLE
from drivax.table import Cell, Column, Table

#: Our metric of each term of the devkit's score.
TERMS = {
    "score": "nuplan_score", "fault_score": "at_fault_collision", "drivable": "offroad", "direction": "direction",
    "making_progress": "making_progress", "ttc_ok": "ttc_ok", "progress": "progress_ratio",
    "speed": "speed_compliance", "comfortable": "comfortable",
}  # fmt: skip
#: Terms that are 1 less our metric.
_NEGATED = ("fault_score", "drivable")
#: Longest window of the speeds of simulated traffic, steps.
_SPEED_STEPS = 5
#: Largest difference of equal terms.
_TOLERANCE = 0.005
FILE = "devkit.csv"


@dataclass(frozen=True)
class ProfileRow:
    """An episode by both definitions.

    Attributes:
        dataset: Data set of the scenario.
        scenario_id: Id of the scenario.
        ours: Our value of each term (:data:`TERMS`), NaN where it is undefined.
        devkit: The devkit's.
    """

    dataset: str
    scenario_id: str
    ours: dict[str, float]
    devkit: dict[str, float]

    @property
    def differing(self) -> tuple[str, ...]:
        """Terms that differ, except the score."""
        return tuple(
            name
            for name in TERMS
            if name != "score" and abs(self.ours[name] - self.devkit[name]) > _TOLERANCE
        )


def devkit_rows(
    table: EpisodeTable, data: ScenarioSet, progress: Callable[[int, int], None] = lambda done, total: None
) -> list[ProfileRow]:
    """Evaluate every episode of a table by the devkit's rules.

    drivax maps hold lane centre lines and road edges, so lanes are strips of constant width, the drivable area ends at
    the edges, and connectors stand for intersections. Agents on another level of the road are left out.

    Args:
        table: Episodes with trajectories.
        data: The scenario set that was evaluated.
        progress: Called with (done, total) after every episode.

    Raises:
        DataError: The table lacks a metric that the devkit's terms are compared with.
    """
    missing = [metric for metric in TERMS.values() if metric not in table.metrics]
    if missing:
        raise DataError(
            f"lacks the metric {missing[0]!r}", file=table.folder, cure="run drivax evaluate again"
        )
    rows = {(entry["dataset"], entry["scenario_id"]): row for row, entry in enumerate(data.entries)}
    sizes, crashes, result = Sizes.used(data), table.crash_by_scenario, []
    for number, key in enumerate(table.scenarios):
        verdict = devkit_episode(data[rows[key]], table.trajectories, number, sizes)
        ours = {name: float(table.metrics[metric][number]) for name, metric in TERMS.items()}
        ours |= {name: 1.0 - ours[name] for name in _NEGATED}
        devkit = {name: float(getattr(verdict, name)) for name in TERMS}
        # After a crash ego stands still, which is comfortable and hits nothing; a crash never improves a score.
        devkit |= {"score": 0.0} if key in crashes else {}
        result.append(ProfileRow(*key, ours, devkit))
        progress(number + 1, len(table))
    return result


def devkit_episode(scenario: Scenario, driven: Trajectories, row: int, sizes: Sizes) -> DevkitVerdict:
    """Evaluate one episode by the devkit's rules.

    Args:
        scenario: Its scenario.
        driven: Trajectories of the evaluation.
        row: The episode.
        sizes: Sizes of the set's banks.
    """
    start = int(driven.start[row])
    steps = slice(start, int(scenario.steps))
    ego = _ego(scenario, driven.ego[row, : steps.stop - start].astype(np.float64), start)
    valid = scenario.agent_valid[steps, 0]
    expert = scenario.agent_xy[steps, 0][valid].astype(np.float64)
    others = None if driven.others is None else unpack_poses(driven.others[row, : steps.stop - start])
    return devkit_verdict(ego, _tracks(scenario, steps, others), _road(scenario, steps, sizes), expert)


def write_rows(rows: Sequence[ProfileRow], path: Path) -> None:
    """Write both definitions of every episode, and the terms that differ, as CSV."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    columns = (f"{side}_{name}" for name in TERMS for side in ("drivax", "devkit"))
    writer.writerow(["dataset", "scenario_id", *columns, "differ"])
    for row in rows:
        values = (value for name in TERMS for value in (row.ours[name], row.devkit[name]))
        cells = ("" if np.isnan(value) else f"{value:.6g}" for value in values)
        writer.writerow([row.dataset, row.scenario_id, *cells, " ".join(row.differing)])
    write_text(path, text.getvalue())


def format_rows(rows: Sequence[ProfileRow]) -> str:
    """Return a table of both definitions: means of each term and the number of episodes that differ in it."""
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
    """Return ego's motion; accelerations are backward differences (the first from the log), yaw rates forward ones."""
    x, y, heading, speed = motion.T
    before = max(start - 1, 0)
    # A noisy start does not come from the log.
    logged = (
        np.allclose(motion[0, :2], scenario.agent_xy[start, 0], atol=1e-3) and scenario.agent_valid[before, 0]
    )
    previous_speed = float(np.hypot(*scenario.agent_velocity[before, 0])) if logged else speed[0]
    turns = np.diff(np.unwrap(heading))
    yaw_rate = np.append(turns, turns[-1:]) / DT_S if len(turns) else np.zeros(1)
    length, width = scenario.agent_size[0, :2].astype(np.float64)
    return EgoMotion(
        np.stack([x, y], axis=-1), heading, np.abs(speed), np.diff(speed, prepend=previous_speed) / DT_S, yaw_rate,
        np.diff(yaw_rate, prepend=yaw_rate[:1]) / DT_S, (float(length), float(width)), float(length) * REAR_AXLE,
    )  # fmt: skip


def _tracks(scenario: Scenario, steps: slice, others: Float[np.ndarray[Any, Any], "t A 3"] | None) -> Tracks:
    """Return the other agents, as moved by traffic, and parked ones."""
    count = scenario.agent_xy.shape[1] if others is None else others.shape[1]
    slots = slice(1, count)
    kind = np.concatenate([scenario.agent_kind[slots], scenario.parked_kind])
    if others is None:
        xy, heading = scenario.agent_xy[steps, slots], scenario.agent_heading[steps, slots]
        moving = scenario.agent_valid[steps, slots]
        velocity = scenario.agent_velocity[steps, slots]
        speed = np.hypot(velocity[..., 0], velocity[..., 1])
    else:
        poses = others[:, 1:].astype(np.float64)
        xy, heading, moving = poses[..., :2], poses[..., 2], ~np.isnan(poses[..., 0])
        speed = _speeds(xy)
    ground = _fill_gaps(scenario.agent_z[:, :1], scenario.agent_valid[:, :1])[steps]
    level = (
        np.abs(_fill_gaps(scenario.agent_z[:, slots], scenario.agent_valid[:, slots])[steps] - ground)
        <= LEVEL_M
    )
    parked = scenario.parked_valid[steps] & (np.abs(scenario.parked_z - ground) <= LEVEL_M)
    present = np.concatenate([moving & level, parked], axis=1)
    seen = present.any(axis=0)

    def concatenate(of_moving: Any, of_parked: Any) -> Any:
        static_values = np.broadcast_to(of_parked, (len(parked), *np.shape(of_parked)))
        return np.nan_to_num(np.concatenate([of_moving, static_values], axis=1)[:, seen]).astype(np.float64)

    static = np.isin(kind[seen], (AgentKind.STATIC, AgentKind.OTHER))
    size = np.concatenate([scenario.agent_size[slots, :2], scenario.parked_size[:, :2]])[seen]
    return Tracks(
        concatenate(xy, scenario.parked_xy),
        concatenate(heading, scenario.parked_heading),
        np.where(static, 0.0, concatenate(speed, np.zeros(parked.shape[1]))),
        present[:, seen], size.astype(np.float64), kind[seen],
    )  # fmt: skip


def _speeds(xy: Float[np.ndarray[Any, Any], "t A 2"]) -> Float[np.ndarray[Any, Any], "t A"]:
    """Speeds over the longest valid window of up to 0.5 s, because stored positions are multiples of 2 cm."""
    speed = np.zeros(xy.shape[:2])
    for lag in range(1, _SPEED_STEPS + 1):
        window_speed = np.linalg.norm(xy[lag:] - xy[:-lag], axis=-1) / (lag * DT_S)
        speed[lag:] = np.where(np.isnan(window_speed), speed[lag:], window_speed)
    first = np.isnan(np.concatenate([xy[:1] + np.nan, xy[:-1]])[..., 0])
    next_speed = np.linalg.norm(np.diff(xy, axis=0, append=xy[-1:]), axis=-1) / DT_S
    return np.where(first, np.nan_to_num(next_speed), speed)


def _fill_gaps(
    values: Float[np.ndarray[Any, Any], "t A"], valid: Bool[np.ndarray[Any, Any], "t A"]
) -> Float[np.ndarray[Any, Any], "t A"]:
    """Fill gaps with the last valid value, or with the first one at the beginning."""
    steps = np.arange(len(values))[:, None]
    last = np.maximum.accumulate(np.where(valid, steps, -1), axis=0)
    return np.take_along_axis(values, np.where(last >= 0, last, valid.argmax(axis=0)), axis=0)


def _road(scenario: Scenario, steps: slice, sizes: Sizes) -> Road:
    objects = _objects(scenario)
    crossing = shapely.unary_union([each.polygon for each in objects if each.connector])
    bank = ScenarioBank.from_scenarios([scenario], trim=sizes)
    heights = _fill_gaps(scenario.agent_z[:, :1], scenario.agent_valid[:, :1])[steps, 0]
    z = jnp.asarray(heights - scenario.agent_size[0, 2] / 2)

    def outside_m(ego: EgoMotion) -> np.ndarray[Any, Any]:
        return np.asarray(_corner_distances(bank, jnp.asarray(ego.boxes, jnp.float32), z), np.float64)

    return Road(objects, outside_m, lambda points: shapely.contains_xy(crossing, points[:, 0], points[:, 1]))


@jax.jit
def _corner_distances(
    bank: ScenarioBank, boxes: Float[Array, "t 6"], z: Float[Array, " t"]
) -> Float[Array, "t 4"]:
    """Distance of the corners of boxes beyond the road edges."""
    index = jnp.zeros((), jnp.int32)

    def beyond(box: Float[Array, " 6"], ground: Float[Array, ""]) -> Float[Array, " 4"]:
        points = corners(box)
        near = around_lanes(bank, index, box[:2], box[2:4], points, ground).points_near
        return offroad_distance(bank, index, box[:2], points, near, ground)

    return jax.vmap(beyond)(boxes, z)


def _objects(scenario: Scenario) -> list[RoadObject]:
    """Lanes and connectors, in the order of the lane graph; those without segments have an empty area."""
    lines, blocks, objects = lane_lines(scenario), roadblocks(scenario), []
    count = len(lines)
    for index, points in enumerate(lines):
        line: Any = shapely.linestrings(points) if len(points) else shapely.LineString()
        width, limit = float(scenario.lane_width[index]), float(scenario.lane_limit[index])
        half = (width if width > 0 else DEFAULT_LANE_WIDTH_M) / 2
        links = (scenario.lane_successor[index], scenario.lane_predecessor[index])
        objects.append(
            RoadObject(
                line.buffer(half, cap_style="flat"), line, blocks[index], limit if limit > 0 else None,
                bool(scenario.lane_interpolating[index]),
                *(tuple(other for other in linked.tolist() if 0 <= other < count) for linked in links),
            )
        )  # fmt: skip
    return objects

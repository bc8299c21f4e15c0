"""A hand-made scenario (curved road, light, agents of every kind) and run folders of evaluations and a training."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest

from drivax.scenario.schema import (
    AgentKind,
    Capacity,
    LightState,
    RoadKind,
    Scenario,
    SourceCounts,
    record_dtype,
)
from drivax.scenario.store import ScenarioSet, ScenarioWriter

SMALL = Capacity(
    name="small",
    agents=6,
    parked=3,
    segments=512,
    features=16,
    lanes=8,
    lights=3,
    stops=2,
    routes=2,
    route_points=120,
    road_rows=8,
    events=1,
    extension=2,
    grid=4,
)
RADIUS_M, SPEED_MPS = 80.0, 8.0


def on_arc(s, offset=0.0):
    """Points and headings of a left curve through the origin heading along +x, ``offset`` metres to its left."""
    angle = np.asarray(s) / RADIUS_M
    radius = RADIUS_M - offset
    return np.stack((radius * np.sin(angle), RADIUS_M - radius * np.cos(angle)), -1), angle


def add_lines(record, lines, rng):
    """Store polylines as segments, in shuffled order as the grid leaves them."""
    a, b, kind, feature, start = [], [], [], [], []
    for row, (road_kind, points) in enumerate(lines):
        arc = np.concatenate(([0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))))
        a.extend(points[:-1])
        b.extend(points[1:])
        kind.extend([road_kind] * (len(points) - 1))
        feature.extend([row] * (len(points) - 1))
        start.extend(arc[:-1])
        record["feature_kind"][row] = road_kind
    order = rng.permutation(len(a))
    used = slice(0, len(a))
    record["segment_a"][used, :2] = np.array(a)[order]
    record["segment_b"][used, :2] = np.array(b)[order]
    for name, values in (("kind", kind), ("feature", feature), ("start_m", start)):
        record[f"segment_{name}"][used] = np.array(values)[order]
    record["segment_blocks"][:] = (0, 0, 0, len(a))


def place(record, row, kind, size, s, offset, steps=slice(0, 91), identity=1):
    """Put an agent on the road: arc length per step, metres to the left."""
    xy, heading = on_arc(np.broadcast_to(s, 91), offset)
    record["agent_xy"][steps, row] = xy[steps]
    record["agent_heading"][steps, row] = heading[steps]
    velocity = np.gradient(xy, 0.1, axis=0)
    record["agent_velocity"][steps, row] = velocity[steps]
    record["agent_valid"][steps, row] = True
    record["agent_kind"][row], record["agent_size"][row], record["agent_id"][row] = kind, size, identity


def make_scenario(number: int) -> Scenario:
    record = np.zeros((), record_dtype(SMALL))
    record["lane_length"] = 1.0
    record["scenario_id"], record["dataset"] = f"hand-{number:02d}".encode(), b"hand"
    record["segment"] = f"road-{number // 2}".encode()
    record["dt_s"], record["current_step"], record["steps"] = 0.1, 10, 91
    s = np.linspace(-40, 140, 61)
    square = np.array([[40.0, 4.0], [43, 4], [43, 14], [40, 14], [40, 4]])
    lines = [
        (RoadKind.EDGE_BOUNDARY, on_arc(s, -5.0)[0]),
        (RoadKind.EDGE_BOUNDARY, on_arc(s, 5.0)[0][::-1]),
        (RoadKind.LANE_SURFACE, on_arc(s, -1.8)[0]),
        (RoadKind.LANE_BIKE, on_arc(s, 4.0)[0]),
        (RoadKind.LINE_BROKEN_SINGLE_WHITE, on_arc(s, 0.0)[0]),
        (RoadKind.CROSSWALK, square),
    ]
    add_lines(record, lines, np.random.default_rng(number))
    time = (np.arange(91) - 10) * 0.1
    place(record, 0, AgentKind.VEHICLE, (4.6, 1.9, 1.6), SPEED_MPS * time + 0.3 * time**2, -1.8)
    place(record, 1, AgentKind.VEHICLE, (4.9, 2.0, 1.6), 25 + SPEED_MPS * time, -1.8, identity=2)
    place(record, 2, AgentKind.PEDESTRIAN, (0.8, 0.8, 1.8), 30.0, 4 - 0.8 * time, slice(20, 60), identity=3)
    place(record, 3, AgentKind.CYCLIST, (1.8, 0.7, 1.7), 5 + 4 * time, 4.0, identity=4)
    place(record, 4, AgentKind.VEHICLE, (4.9, 2.0, 1.6), 900.0 + 0 * time, 700.0, identity=5)  # far away
    xy, heading = on_arc(15.0, -4.0)
    record["parked_xy"][0], record["parked_heading"][0] = xy, heading
    record["parked_size"][0], record["parked_kind"][0] = (4.4, 1.8, 1.5), AgentKind.VEHICLE
    record["parked_valid"][5:80, 0] = True
    left, right = on_arc(38.0, 0.0)[0], on_arc(38.0, -3.6)[0]
    record["light_line"][0] = (*left, *right)
    record["light_state"][:] = LightState.UNOBSERVED
    record["light_state"][:50, 0], record["light_state"][50:, 0] = LightState.STOP, LightState.GO
    record["stop_xy"][0], record["stop_lane"][:] = on_arc(60.0, -6.0)[0], -1
    route = on_arc(np.arange(100.0) - 20, -1.8)[0]
    record["route_xy"][0, :100], record["route_points"][0] = route, 100
    record["goal_xy"] = on_arc(SPEED_MPS * 8.0, -1.8)[0]
    source = SourceCounts(91, 7, 6, {"lane": 2}, 400, 1)
    tags = {"dataset": "hand", "difficulty": "hard" if number % 2 else "easy"}
    return Scenario(record, SMALL, source, tags=tags)


def offset_path(scenario: Scenario, sideways_m: float) -> np.ndarray:
    """The log's path ``[91, 4]``, offset to the left by up to ``sideways_m`` at the end."""
    xy, heading = scenario.agent_xy[:, 0], scenario.agent_heading[:, 0]
    speed = np.linalg.norm(scenario.agent_velocity[:, 0], axis=-1)
    away = sideways_m * np.clip((np.arange(91) - 10) / 80, 0, None)
    normal = np.stack((-np.sin(heading), np.cos(heading)), -1)
    return np.column_stack((xy + away[:, None] * normal, heading, speed)).astype(np.float32)


#: Failures of the policy by scenario: collision, off-road, red light.
FAILS = {1: "collision", 3: "offroad", 4: "red_light", 5: "collision"}


def episode(planner: str, scenario: Scenario, number: int) -> dict[str, object]:
    failed = (
        FAILS.get(number)
        if planner == "policy"
        else ("offroad" if planner == "constant" and number % 2 else None)
    )
    row: dict[str, object] = {"planner": planner, "dataset": "hand", "scenario_id": scenario.id}
    row |= {"segment": f"road-{number // 2}", "seed": 0, "traffic": "log"}
    for name in ("collision", "offroad", "red_light"):
        row[name] = int(name == failed)
    row["collision_type"] = {1: 1, 5: 5}.get(number, 0) if failed == "collision" else 0
    row["accuracy"] = int(failed is None)
    row["success"] = int(failed is None and not (planner == "policy" and number == 6))
    row["reached_goal"] = int(not (planner == "policy" and number == 6))
    if number % 3 == 0:
        row["red_light"] = ""  # no light here: undefined
    row["min_ttc"] = ""  # undefined everywhere
    row["progress_ratio"] = round(0.9 - 0.05 * number + (0.1 if planner == "policy" else 0), 4)
    row["vmax_score"] = 0.0 if failed else round(0.8 - 0.01 * number, 4)
    return row


def commands(planner: str) -> np.ndarray:
    """Eighty actions: a wave for the policy, zero for others."""
    wave = np.sin(np.arange(80) / 7.0) * (planner == "policy")
    return np.stack((wave, -wave / 2), -1).astype(np.float16)


def write_evaluation(folder: Path, planner: str, scenarios: ScenarioSet, data: Path) -> Path:
    """A run folder as ``drivax evaluate`` writes it."""
    folder.mkdir(parents=True)
    rows = [episode(planner, scenario, number) for number, scenario in enumerate(scenarios)]
    with (folder / "episodes.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
    sideways = {"expert": 0.0, "constant": -9.0}.get(planner, 3.0)
    events = {
        name: np.array([40 if row[name] == 1 else -1 for row in rows], np.int16)
        for name in ("collision", "offroad", "red_light")
    }
    np.savez(
        folder / "trajectories.npz",
        scenario_id=np.array([row["scenario_id"] for row in rows]),
        ego=np.stack([offset_path(scenario, sideways)[10:] for scenario in scenarios]),  # from `start` on
        action=np.tile(commands(planner), (len(rows), 1, 1)),
        start=np.full(len(rows), 10),
        **{f"{name}_step": steps for name, steps in events.items()},
    )
    about = {
        "kind": "evaluation",
        "planner": planner,
        "traffic": "log",
        "data": {"path": str(data), "hash": scenarios.hash, "name": "hand-made roads"},
        "command": f"drivax evaluate --planner {planner} --data set",
        "versions": {"drivax": "0.1.0"},
        "note": "</script><b>not markup</b>",
    }
    (folder / "run.json").write_text(json.dumps(about))
    return folder


def redescribe(folder: Path, **changes: str) -> Path:
    """Change keys of an evaluation, such as its planner, in ``run.json`` and in every row."""
    about = json.loads((folder / "run.json").read_text())
    (folder / "run.json").write_text(json.dumps(about | changes))
    with (folder / "episodes.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    with (folder / "episodes.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(row | changes for row in rows)
    return folder


def write_training(folder: Path) -> Path:
    folder.mkdir(parents=True)
    (folder / "run.json").write_text(json.dumps({"kind": "training", "command": "drivax train ppo.yaml"}))
    rows = [
        {"step": 100 * i, "time_s": i, "rollout/success": i / 20, "loss/policy": -1.0 / (i + 1)}
        for i in range(20)
    ]
    (folder / "metrics.jsonl").write_text("\n".join(map(json.dumps, rows)) + '\n{"step": 20')
    return folder


@pytest.fixture(scope="session")
def hand_set(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("hand") / "set"
    with ScenarioWriter(path, SMALL, source={"kind": "hand"}) as writer:
        for number in range(8):
            writer.add(make_scenario(number))
    return path


@pytest.fixture(scope="session")
def scenarios(hand_set) -> ScenarioSet:
    return ScenarioSet.open(hand_set)


@pytest.fixture
def runs(tmp_path, scenarios, hand_set) -> list[Path]:
    """Three evaluations, the policy last, and a training."""
    planners = ("expert", "constant", "policy")
    folders = [write_evaluation(tmp_path / name, name, scenarios, hand_set) for name in planners]
    return [*folders, write_training(tmp_path / "training")]

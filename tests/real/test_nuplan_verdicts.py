"""The devkit profile against figures that nuPlan's devkit computed on made-up motions and a straight road."""

import gzip
import json
import os
from pathlib import Path

import numpy as np
import pytest
import shapely

from drivax.evaluation.devkit import EgoMotion, Road, RoadObject, Tracks, comfort_series, devkit_verdict
from drivax.scenario.schema import DT_S, AgentKind

SHARED = Path(__file__).resolve().parents[3] / "shared" / "data"
FILE = Path(os.environ.get("DRIVAX_NUPLAN_VERDICTS", SHARED / "nuplan_metrics" / "verdicts.json.gz"))
SCENES = FILE.parent / "scenes"
needs_scenes = pytest.mark.skipif(not SCENES.is_dir(), reason=f"{SCENES} is not there")
pytestmark = pytest.mark.skipif(not FILE.is_file(), reason=f"{FILE} is not there")
KINDS = {
    "vehicle": AgentKind.VEHICLE, "pedestrian": AgentKind.PEDESTRIAN, "cyclist": AgentKind.CYCLIST,
    "static": AgentKind.STATIC,
}  # fmt: skip
SIZE_M, WIDTH_M, BEGIN_M, END_M = (5.176, 2.297), 3.7, -150.0, 350.0
#: What six decimals of the motion make of the filtered series.
ROUNDED = 2.5e-5
NOWHERE = Road((), lambda ego: np.zeros((len(ego.xy), 4)))
X, Y, HEADING, SPEED, ACCELERATION, YAW_RATE = 4, 5, 2, 6, 7, 8


def scenes():
    stored = json.loads(gzip.decompress(FILE.read_bytes())) if FILE.is_file() else {}
    for group, members in stored.items():
        for number, scene in enumerate(members):
            yield pytest.param(scene, id=f"{group}-{number}")


def road_of(scene):
    """Two lanes side by side; in ``two_way`` scenes the second runs back."""
    lanes = []
    for block, (y, back) in enumerate(((0.0, False), (WIDTH_M, scene["two_way"]))):
        ends = [(BEGIN_M, y), (END_M, y)]
        area = shapely.box(BEGIN_M, y - WIDTH_M / 2, END_M, y + WIDTH_M / 2)
        line = shapely.linestrings(ends[::-1] if back else ends)
        lanes.append(RoadObject(area, line, block if scene["two_way"] else 0, scene["limit"]))
    area = shapely.box(BEGIN_M, -WIDTH_M / 2, END_M, 1.5 * WIDTH_M)
    return Road(lanes, lambda ego: shapely.distance(area, shapely.points(ego.corners)))


def ego_of(rows, past):
    """All columns have six decimals; where the yaw rate is that of the step, it gives turns with one more."""
    turned, by_rate = np.diff(rows[:, HEADING]), DT_S * rows[:-1, YAW_RATE]
    turned = np.where(np.abs(turned - by_rate) < 1.1e-6, by_rate, turned)
    heading = np.cumsum(np.append(rows[0, HEADING], turned))
    yaw_acceleration = np.diff(rows[:, YAW_RATE], prepend=past[-1, YAW_RATE]) / DT_S
    return EgoMotion(
        rows[:, [X, Y]], heading, np.abs(rows[:, SPEED]), rows[:, ACCELERATION], rows[:, YAW_RATE],
        np.where(rows[:, SPEED] == 0.0, 0.0, yaw_acceleration), SIZE_M,
    )  # fmt: skip


def tracks_of(scene, samples):
    agents = scene["agents"]
    heading, speed, x, y = (np.array([agent[name] for agent in agents]) for name in ("h", "v", "x", "y"))
    way = np.stack([np.cos(heading), np.sin(heading)], axis=-1) * speed[:, None]
    time_s = DT_S * np.arange(samples)[:, None]
    return Tracks(
        np.stack([x, y], axis=-1) + time_s[..., None] * way,
        np.broadcast_to(heading, (samples, len(agents))),
        np.broadcast_to(speed, (samples, len(agents))),
        np.ones((samples, len(agents)), bool),
        np.array([agent["size"] for agent in agents]).reshape(-1, 2),
        np.array([KINDS[agent["kind"]] for agent in agents], int),
    )


@pytest.mark.parametrize("scene", list(scenes()))
def test_nuplan_verdicts_are_reproduced(scene):
    rows, past, expected = np.array(scene["ego"]), np.array(scene["past"]), scene["devkit"]
    ego = ego_of(rows, past)
    expert = np.stack([scene["v0"] * DT_S * np.arange(len(rows)), np.zeros(len(rows))], axis=-1)
    verdict = devkit_verdict(ego, tracks_of(scene, len(rows)), road_of(scene), expert)
    for name in ("fault_score", "drivable", "direction", "ttc_ok", "making_progress"):
        assert getattr(verdict, name) == expected[name], name
    for name in ("speed", "progress", "score", "backward_m"):
        assert getattr(verdict, name) == pytest.approx(expected[name], abs=2e-6), name
    assert verdict.progress_m == pytest.approx(expected["progress_m"][:2], abs=2e-6)
    assert verdict.comfort.within == expected["comfort"]["ok"]
    assert bool(verdict.comfortable) == expected["comfort"]["comfortable"]
    for name, series in expected["comfort"]["series"].items():
        np.testing.assert_allclose(verdict.comfort.series[name], series, atol=ROUNDED, err_msg=name)
    found = {(each.sample, each.agent, each.type, each.at_fault) for each in verdict.collisions}
    assert found == {(each["k"], each["id"], each["type"], each["fault"]) for each in expected["collisions"]}
    assert np.flatnonzero(verdict.in_lane).tolist() == expected["together"]
    times = [np.inf if value is None else value for value in expected["ttc_series"]]
    np.testing.assert_allclose(verdict.ttc_s, times, atol=1e-9)


def scene_states(name):
    """Ego's states, box and neighbours of one of the devkit's own scenes; poses are of the rear axle."""
    scene = json.loads((SCENES / name).with_suffix(".json").read_text())
    states = [scene["ego"], *scene.get("ego_future_states", [])]
    pose = np.array([state["pose"] for state in states])
    time_s = np.array([state["time_us"] for state in states]) / 1e6
    heading = pose[:, 2]
    ego = EgoMotion(
        pose[:, :2] + 1.461 * np.stack([np.cos(heading), np.sin(heading)], axis=-1), heading,
        np.array([np.hypot(*state["velocity"]) for state in states]),
        np.array([state["acceleration"][0] for state in states], float),
        np.zeros(len(states)), np.zeros(len(states)), SIZE_M,
        dt_s=float(np.diff(time_s).mean()) if len(states) > 1 else DT_S,
    )  # fmt: skip
    worlds = [scene["world"], *scene.get("world_future_states", [])][: len(states)]
    kinds = {
        "vehicles": AgentKind.VEHICLE,
        "bicycles": AgentKind.CYCLIST,
        "pedestrians": AgentKind.PEDESTRIAN,
    }
    agents = [
        {agent["id"]: (agent, kinds[kind]) for kind in kinds for agent in world[kind]} for world in worlds
    ]
    ids = sorted(set().union(*agents))
    first = [next(world[number] for world in agents if number in world) for number in ids]
    boxes = [
        [world.get(number, each)[0] for number, each in zip(ids, first, strict=True)] for world in agents
    ]
    poses = np.array([[agent["box"]["pose"] for agent in row] for row in boxes]).reshape(len(worlds), -1, 3)
    tracks = Tracks(
        poses[..., :2], poses[..., 2], np.array([[float(agent["speed"]) for agent in row] for row in boxes]),
        np.array([[number in world for number in ids] for world in agents]).reshape(len(worlds), -1),
        np.array([agent["box"]["size"][::-1] for agent, _ in first], float).reshape(-1, 2),
        np.array([kind for _, kind in first], int),
    )  # fmt: skip
    return ego, tracks, scene["expected"]


@needs_scenes
@pytest.mark.parametrize(
    ("name", "series"),
    [
        ("lon_acceleration", "lon"),
        ("lon_jerk", "lonjerk"),
        ("yaw_rate", "yaw"),
        ("yaw_acceleration", "yawacc"),
    ],
)
def test_series_of_the_devkits_own_scenes_are_reproduced(name, series):
    ego, _, expected = scene_states(f"ego_{name}/ego_{name}")
    values = comfort_series(ego).series[series]
    # They are given with two decimals.
    np.testing.assert_allclose(np.round(values, 2), expected["time_series"]["values"], atol=1e-3)


@needs_scenes
@pytest.mark.parametrize(
    ("name", "faults"),
    [
        ("active_front_collision", 1),
        ("active_rear_collision", 0),
        ("no_collision", 0),
        ("stopped_ego_collision", 0),
    ],
)
def test_faults_of_the_devkits_own_scenes_are_reproduced(name, faults):
    ego, tracks, expected = scene_states(f"no_ego_at_fault_collision/{name}")
    verdict = devkit_verdict(ego, tracks, NOWHERE, ego.xy)
    assert sum(each.at_fault for each in verdict.collisions) == expected["statistics"][1][1] == faults
    assert (verdict.fault_score == 1.0) == expected["statistics"][0][1]


@needs_scenes
@pytest.mark.parametrize("name", ["ego_stopped", "in_collision", "no_relevant_tracks"])
def test_times_to_collision_of_the_devkits_own_scenes_are_reproduced(name):
    ego, tracks, expected = scene_states(f"time_to_collision_within_bound/{name}")
    verdict = devkit_verdict(ego, tracks, NOWHERE, ego.xy)
    assert verdict.ttc_s.tolist() == expected["time_series"]["values"]
    assert bool(verdict.ttc_ok) == expected["statistics"][1][1]

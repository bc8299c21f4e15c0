"""Recordings and scenarios from plain arrays, and errors that name the argument."""

from __future__ import annotations

import copy
import math
from typing import Any

import numpy as np
import pytest

from drivax.errors import DataError, UsageError
from drivax.scenario.arrays import recording_from_arrays, resample, scenario_from_arrays
from drivax.scenario.build.assemble import assemble
from drivax.scenario.recording import differentiate, windows
from drivax.scenario.schema import AgentKind, Flag, LightState, RoadKind

T = np.arange(91) * 0.1


@pytest.fixture
def agents() -> dict[str, Any]:
    """A car at 10 m/s to the east, and a pedestrian that is valid from step 30 to 59."""
    xy = np.zeros((2, 91, 2))
    xy[0, :, 0] = 10.0 * T
    xy[1] = (40.0, 5.0)
    valid = np.ones((2, 91), bool)
    valid[1, :30] = valid[1, 60:] = False
    return {
        "xy": xy, "heading": np.zeros((2, 91)), "valid": valid, "size": [(4.5, 1.9, 1.5), (0.6, 0.7, 1.8)],
        "kind": ["vehicle", "pedestrian"],
    }  # fmt: skip


@pytest.fixture
def roads() -> dict[str, Any]:
    """Two lanes one after the other, another next to the first, inside a closed edge."""
    return {
        "lanes": [
            {"points": [(-50, 0), (50, 0)], "successors": [1], "left": [2], "limit_mps": 13.9},
            {"points": [(50, 0), (150, 0)], "width_m": 3.5},
            {"points": [(-50, 3.5), (50, 3.5)], "right": [0], "kind": "bike"},
        ],
        "edges": [[(-50, -2), (150, -2), (150, 6), (-50, 6), (-50, -2)]],
        "crosswalks": [[(40, -2), (43, -2), (43, 6), (40, 6)]],
        "stop_signs": [{"point": (50, -3), "lanes": [0]}],
    }


def test_arrays_become_a_scenario(agents, roads):
    states = ["red"] * 40 + [None] * 11 + ["green"] * 40
    scenario = scenario_from_arrays("own-1", agents, roads, [{"lane": 1, "states": states}], route=[0, 1])
    assert (scenario.id, bytes(scenario.dataset[()]), int(scenario.current_step)) == ("own-1", b"own", 10)
    np.testing.assert_allclose(scenario.agent_xy[:, 0, 0], 10.0 * T - 10.0, atol=1e-5)
    np.testing.assert_allclose(scenario.agent_velocity[:, 0], [[10.0, 0.0]] * 91, atol=1e-4)
    assert scenario.parked_valid[:, 0].tolist() == agents["valid"][1].tolist()
    assert scenario.parked_kind[0] == AgentKind.PEDESTRIAN
    expected = (
        Flag.LIGHTS | Flag.LANE_GRAPH | Flag.SPEED_LIMITS | Flag.DIFFERENTIATED_VELOCITY | Flag.CLOSED_EDGES
    )
    assert scenario.has & expected == expected
    assert not scenario.has & (Flag.CHAINED_GRAPH | Flag.DEFAULT_SIZES | Flag.ELEVATION | Flag.NO_FUTURE)
    assert scenario.light_state[[0, 39, 40, 51], 0].tolist() == [4, 4, -1, 6]
    assert scenario.source.map_features == {
        "lane": 3, "road_line": 0, "road_edge": 1, "crosswalk": 1, "speed_bump": 0, "stop_sign": 1, "driveway": 0
    }  # fmt: skip


def test_lane_indices_become_links(agents, roads):
    recording = recording_from_arrays("a", agents, roads, [{"lane": 1, "states": [6] * 91}], route=[0, 1])
    first, second, beside, edge, walk, sign = recording.features
    assert [f.feature_id for f in recording.features] == [0, 1, 2, 3, 4, 5]
    assert (first.successors, first.left_neighbours, beside.right_neighbours) == ((1,), (2,), (0,))
    assert (first.limit_mps, second.limit_mps, second.width_m) == (13.9, None, 3.5)
    assert (beside.kind, edge.kind, walk.kind) == (
        RoadKind.LANE_BIKE,
        RoadKind.EDGE_BOUNDARY,
        RoadKind.CROSSWALK,
    )
    assert sign.lanes == (0,) and recording.route_lanes == (0, 1)
    assert (recording.lights[0].stop_point == second.points[0]).all()


def test_invalid_entries_may_hold_anything(agents, roads):
    agents["xy"][1, :30] = np.nan
    agents["heading"][1, 70:] = 1e9
    tracks = recording_from_arrays("a", agents, roads).tracks
    assert not tracks.xy[1, :30].any() and not tracks.heading[1, 60:].any()
    scenario_from_arrays("a", agents, roads)


def test_heights_are_required_where_roads_have_them(agents, roads):
    np.testing.assert_allclose(recording_from_arrays("a", agents, roads).tracks.z[:, 40], [0.75, 0.9])
    for heights in ((0, 3), (5, 5)):
        roads["lanes"][0]["points"] = [(-50, 0, heights[0]), (50, 0, heights[1])]
        with pytest.raises(UsageError, match=r'agents\["z"\] is missing'):
            recording_from_arrays("a", agents, roads)
    agents["z"] = np.full((2, 91), 2.0)
    assert recording_from_arrays("a", agents, roads).tracks.z[0, 3] == 2.0


def test_given_velocity_size_and_id_are_kept(agents, roads):
    agents |= {"velocity": np.full((2, 91, 2), 3.0), "size": np.full((2, 91, 3), 2.0), "id": [70, 8]}
    recording = recording_from_arrays("a", agents, roads)
    assert Flag.DIFFERENTIATED_VELOCITY not in recording.flags
    assert recording.tracks.velocity[0, 5].tolist() == [3.0, 3.0]
    assert recording.tracks.size[1, 40].tolist() == [2.0] * 3 and recording.tracks.track_id.tolist() == [
        70,
        8,
    ]


def test_missing_sizes_are_defaults_of_ego_and_of_the_class(agents, roads):
    del agents["size"], agents["kind"]
    scenario = scenario_from_arrays("a", agents, roads)
    assert Flag.DEFAULT_SIZES in scenario.has
    assert scenario.agent_size[0].tolist() == pytest.approx([4.9, 2.0, 1.5])
    assert scenario.parked_size[0].tolist() == pytest.approx([4.1, 1.9, 1.6])
    np.testing.assert_allclose(recording_from_arrays("a", agents, roads).tracks.z[:, 40], [0.75, 0.8])


def test_a_stop_point_without_height_is_at_the_height_of_its_lane(agents, roads):
    roads["lanes"][0]["points"] = [(-50, 0, 30.0), (50, 0, 36.0)]
    agents["z"] = np.full((2, 91), 33.0)
    states = ["red"] * 91
    lights = [{"lane": 0, "states": states, "stop_point": p} for p in ((45, 0), (45, 0, 35.0))]
    lights.append({"lane": 1, "states": states, "stop_point": (60, 0)})
    recording = recording_from_arrays("a", agents, roads, lights)
    assert [float(light.stop_point[2]) for light in recording.lights] == [36.0, 35.0, 0.0]


def test_long_recordings_are_cut_into_windows(agents, roads):
    long = {name: np.repeat(np.array(agents[name]), 2, axis=1) for name in ("xy", "heading", "valid")}
    long["xy"][0, :, 0] = np.arange(182)
    with pytest.raises(DataError, match=r"182 steps.*windows"):
        scenario_from_arrays("a", long, roads)
    cut = list(windows(recording_from_arrays("a", long, roads)))
    assert [w.scenario_id for w in cut] == ["a@0", "a@40", "a@80"] and {w.segment for w in cut} == {"a"}
    assert assemble(cut[1]).id == "a@40"


WRONG = {
    'agents["xy"] has shape (2, 90, 2), not (2, 91, 2)': lambda a, r: a.update(xy=a["xy"][:, :90]),
    'agents["heading"] is missing': lambda a, r: a.pop("heading"),
    'agents["valid"] has shape (91,)': lambda a, r: a.update(valid=np.ones(91)),
    'agents["size"] has shape (2, 2), not (2, 3)': lambda a, r: a.update(size=[(4, 2), (1, 1)]),
    'agents["kind"] has 1 entries, not 2': lambda a, r: a.update(kind=["vehicle"]),
    "agents[\"kind\"][1] is 'lorry'": lambda a, r: a.update(kind=["vehicle", "lorry"]),
    'agents["id"] has shape (3,)': lambda a, r: a.update(id=[1, 2, 3]),
    "agents has an unknown key 'yaw'": lambda a, r: a.update(yaw=0),
    "roads has an unknown key 'lane'": lambda a, r: r.update(lane=[]),
    'roads["lanes"][1] has an unknown key \'speed\'': lambda a, r: r["lanes"][1].update(speed=3),
    'roads["lanes"][0]["successors"] names lane 3, there are 3': lambda a, r: r["lanes"][0].update(successors=[3]),
    'roads["lanes"][0]["points"] has shape (1, 2)': lambda a, r: r["lanes"][0].update(points=[(0, 0)]),
    'roads["lanes"][2]["points"] is not an array': lambda a, r: r["lanes"][2].update(points="abc"),
    'roads["edges"][0] has a point that is not finite': lambda a, r: r["edges"].insert(0, [(0, 0), (0, np.nan)]),
    'agents["id"] has a number that is not an integer': lambda a, r: a.update(id=[1.2, 1.7]),
    "agents[\"kind\"] is 'vehicle'": lambda a, r: a.update(kind="vehicle"),
    'roads["lanes"] is 3': lambda a, r: r.update(lanes=3),
    'roads["lanes"][0]["points"] is missing': lambda a, r: r["lanes"][0].pop("points"),
    'roads["lanes"][0]["successors"] is 0.5': lambda a, r: r["lanes"][0].update(successors=0.5),
    'roads["lanes"][0]["kind"] is <RoadKind.EDGE': lambda a, r: r["lanes"][0].update(kind=RoadKind.EDGE_BOUNDARY),
    "roads[\"lanes\"][0][\"limit_mps\"] is 'fast'": lambda a, r: r["lanes"][0].update(limit_mps="fast"),
    'roads["stop_signs"][0]["point"] is missing': lambda a, r: r["stop_signs"][0].pop("point"),
    'roads["stop_signs"][0] names lane 9': lambda a, r: r["stop_signs"][0].update(lanes=[9]),
}  # fmt: skip


@pytest.mark.parametrize("case", WRONG)
def test_errors_name_the_argument(case, agents, roads):
    WRONG[case](agents, roads)
    with pytest.raises(UsageError) as error:
        scenario_from_arrays("a", agents, roads)
    assert case in error.value.problem and error.value.cure and "\n" not in str(error.value)


def test_other_errors_name_their_argument(agents, roads):
    with pytest.raises(UsageError, match="ego is 2, there are 2 agents"):
        scenario_from_arrays("a", agents, roads, ego=2)
    with pytest.raises(UsageError, match="route names lane 7"):
        scenario_from_arrays("a", agents, roads, route=[7])
    with pytest.raises(UsageError, match=r'lights\[0\]\["states"\] has 3 entries, not 91'):
        scenario_from_arrays("a", agents, roads, [{"lane": 0, "states": ["red"] * 3}])
    with pytest.raises(UsageError, match=r'lights\[0\]\["lane"\] is missing'):
        scenario_from_arrays("a", agents, roads, [{"states": ["red"] * 91}])
    with pytest.raises(UsageError, match=r'lights\[0\]\["states"\] is .red.; give a list'):
        scenario_from_arrays("a", agents, roads, [{"lane": 0, "states": "red"}])
    with pytest.raises(UsageError, match=r'lights\[0\]\["lane"\] names 2 lanes'):
        scenario_from_arrays("a", agents, roads, [{"lane": [0, 1], "states": ["red"] * 91}])
    with pytest.raises(UsageError, match=r"lights\[0\].*'blue'"):
        scenario_from_arrays("a", agents, roads, [{"lane": 0, "states": ["blue"] * 91}])
    with pytest.raises(UsageError, match=r"dt_s is 0.5.*resample\(agents, 0.5\)"):
        scenario_from_arrays("a", agents, roads, dt_s=0.5)
    with pytest.raises(UsageError, match="dt_s is nan"):
        scenario_from_arrays("a", agents, roads, dt_s=math.nan)
    with pytest.raises(DataError, match="ego is not valid at the current step"):
        scenario_from_arrays("a", agents, roads, ego=1)


# --- Time bases and velocities.


def test_16_resampling_interpolates_and_turns_the_short_way(agents, roads):
    """2 Hz: along a circle, over the jump of the heading at pi."""
    angle = np.linspace(3.0, 3.5, 19)
    slow = {
        "xy": 20 * np.stack((np.cos(angle), np.sin(angle)), axis=-1)[None],
        "heading": ((angle + math.pi) % (2 * math.pi) - math.pi)[None],
        "valid": np.ones((1, 19), bool),
        "z": np.linspace(0, 9, 19)[None],
        "kind": ["cyclist"],
    }
    fast = resample(slow, 0.5)
    assert fast["xy"].shape == (1, 91, 2) and fast["valid"].all() and fast["kind"] == ["cyclist"]
    at = np.linspace(0, 18, 91)
    for axis in (0, 1):
        np.testing.assert_allclose(
            fast["xy"][0, :, axis], np.interp(at, np.arange(19), slow["xy"][0, :, axis])
        )
    turn = (fast["heading"][0] - np.interp(at, np.arange(19), angle) + math.pi) % (2 * math.pi) - math.pi
    np.testing.assert_allclose(turn, 0.0, atol=1e-12)
    np.testing.assert_allclose(fast["z"][0], np.linspace(0, 9, 91))


def test_16_resampling_never_bridges_gaps():
    valid = np.array([[True, True, False, True, True, False, True]])
    slow = {"xy": np.zeros((1, 7, 2)), "heading": np.zeros((1, 7)), "valid": valid}
    slow["xy"][0, ~valid[0]] = np.nan
    fast = resample(slow, 0.2)
    assert fast["valid"][0].astype(int).tolist() == [1, 1, 1, 0, 0, 0, 1, 1, 1, 0, 0, 0, 1]
    assert np.isfinite(fast["xy"][fast["valid"]]).all()


def test_16_resampling_20_hz_keeps_every_other_step():
    x = np.random.default_rng(0).normal(size=(1, 41, 2))
    fast = {"xy": x, "heading": np.zeros((1, 41)), "valid": np.ones((1, 41), bool), "velocity": x}
    resampled = resample(fast, 0.05)
    np.testing.assert_allclose(resampled["xy"], x[:, ::2], atol=1e-12)
    assert "velocity" not in resampled
    np.testing.assert_allclose(resample(copy.deepcopy(fast), 0.1)["xy"], x, atol=1e-12)
    with pytest.raises(UsageError, match="dt_s is 0"):
        resample(fast, 0)


def test_resampling_of_a_rounded_step_ends_at_the_last_step():
    fast = {"xy": np.zeros((1, 271, 2)), "heading": np.zeros((1, 271)), "valid": np.ones((1, 271), bool)}
    assert resample(fast, 0.033333333)["valid"].tolist() == [[True] * 91]
    empty = {"xy": np.zeros((1, 0, 2)), "heading": np.zeros((1, 0)), "valid": np.zeros((1, 0), bool)}
    assert resample(empty, 0.05)["xy"].shape == (1, 0, 2)


def test_velocities_are_differences_within_observed_intervals():
    """By hand: one-sided at the ends, central inside, zero without a neighbour and over gaps."""
    xy = np.zeros((1, 7, 2))
    xy[0, :, 0] = [0, 1, 4, 9, 50, 60, 80]
    valid = np.array([[True, True, True, False, True, False, False]])
    xy[0, ~valid[0]] = 999.0
    velocity = differentiate(xy, valid, np.array([0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6]))
    np.testing.assert_allclose(velocity[0, :, 0], [10, 20, 30, 0, 0, 0, 0])
    np.testing.assert_array_equal(velocity[0, :, 1], 0)


def test_light_states_may_be_enumeration_members(agents, roads):
    states = [LightState.FLASHING_STOP] * 91
    recording = recording_from_arrays(
        "a", agents, roads, [{"lane": 0, "states": states, "stop_point": (1, 2)}]
    )
    assert set(recording.lights[0].states.tolist()) == {7}
    assert recording.lights[0].stop_point.tolist() == [1.0, 2.0, 0.0]

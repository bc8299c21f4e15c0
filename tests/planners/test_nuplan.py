"""Planners with nuPlan's interface: what they are given, how they drive, and how their errors are reported."""

from __future__ import annotations

import copy
import pickle
import sys
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import drivax
import nuplan_devkit as devkit
from drivax.api import find_planner
from drivax.errors import UsageError
from drivax.evaluation.rollout import drive, episode_keys
from drivax.evaluation.runner import evaluate, format_crashes
from drivax.planners.catalogue import default_task, make_planner
from drivax.planners.functions import PlannerError
from drivax.planners.nuplan.interface import (
    DynamicCarState,
    EgoState,
    StateSE2,
    StateVector2D,
    TimePoint,
    TrackedObjectType,
)
from drivax.planners.nuplan.map import MapApi, SemanticMapLayer
from drivax.planners.nuplan.planner import Host, NuplanPlanner, ScenarioView
from drivax.planners.pdm.brake import EmergencyBrake
from drivax.planners.simple import Expert
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.scenario.bank.sizes import Sizes
from drivax.scenario.build.assemble import assemble
from drivax.scenario.schema import AgentKind
from drivax.simulator.simulator import Simulator
from drivax.tasks.actions import DIRECT_STATE, PHYSICAL, Trajectory
from drivax.tasks.task import Task
from drivax.testing.worlds import rotate_recording
from nuplan_planners import DevkitIdm, Faulty, Late, Replay
from scenes import GLIMPSE, GREEN, RED, SMALL, car, straight_road

SPACE = Trajectory(steps=40)
TASK = Task(actions=SPACE, observation=GLIMPSE)
EAST_M, NORTH_M = 664_000.0, 3_997_000.0


def curved(radius_m=60.0, speed=8.0):
    """A drive on a circle, as a logged track."""
    ego = car(0.0, 0.0, 0.0, speed)
    angle = speed * (np.arange(91) - 10) * 0.1 / radius_m
    ego["xy"] = radius_m * np.stack([np.sin(angle), 1 - np.cos(angle)], -1)
    ego["heading"] = angle
    ego["velocity"] = speed * np.stack([np.cos(angle), np.sin(angle)], -1)
    return ego


def far_away(recording, name):
    """The same world, turned and in coordinates of a map."""
    return replace(rotate_recording(recording, 0.7, EAST_M, NORTH_M), scenario_id=name)


@pytest.fixture(scope="module")
def scenarios():
    """A free road, a standing car, a red light, and a curved drive among others."""
    others = [
        car(20.0, 3.7, 0.0, 6.0), car(10.0, -1.0, 1.0, 1.2, 0.6, 0.6, AgentKind.PEDESTRIAN, range(5, 60)),
        car(-20.0, 3.7, 0.1, 3.0, 1.8, 0.6, AgentKind.CYCLIST), car(60.0, 3.7, 0.3, 0.0, kind=AgentKind.STATIC),
    ]  # fmt: skip
    recordings = {
        "free": straight_road([car(0, 0, 0, 8)]),
        "standing": straight_road([car(0, 0, 0, 8), car(50, 0, 0, 0)]),
        "red": straight_road([car(0, 0, 0, 8)], RED, 40.0),
        "curve": straight_road([curved(), *others], [GREEN if step % 2 else RED for step in range(91)], 40.0),
    }
    return [assemble(far_away(recording, name), SMALL) for name, recording in recordings.items()]


def axle(scenario):
    """The logged poses of the rear axle in the source's frame."""
    heading, length = scenario.agent_heading[:, 0].astype(float), float(scenario.agent_size[0, 0])
    behind = length * 1.461 / 5.176
    xy = scenario.agent_xy[:, 0].astype(float) + scenario.origin[:2]
    return np.column_stack([xy - behind * np.column_stack([np.cos(heading), np.sin(heading)]), heading])


def replay(scenario, space):
    """Motion under a planner that repeats the log, and what it was given."""
    seen = []
    planner = NuplanPlanner(Host(Replay(axle(scenario), seen), "tests:Replay"), space)
    planner.prepare(lambda number: scenario)
    simulator = Simulator(replace(TASK, actions=space, metrics="none", to_the_end=True))
    bank, rows = ScenarioBank.from_scenarios([scenario]), jnp.arange(1)
    episodes = jax.device_get(drive(simulator, planner, bank, rows, episode_keys(bank, rows, 0)))
    assert episodes.crashed.tolist() == [-1]
    return episodes.motion[0], seen


@pytest.fixture(scope="module")
def replayed(scenarios):
    return replay(scenarios[3], DIRECT_STATE)


def test_a_planner_that_repeats_the_log_drives_it(replayed, scenarios):
    np.testing.assert_allclose(replayed[0][:, :2], scenarios[3].agent_xy[10:, 0], rtol=0, atol=1e-4)


@pytest.mark.slow
def test_the_controller_tracks_the_log(scenarios):
    motion, seen = replay(scenarios[3], SPACE)
    assert np.linalg.norm(motion[:, :2] - scenarios[3].agent_xy[10:, 0], axis=1).max() < 0.35
    # Ego's acceleration and steering are those of the actuators.
    ego = seen[40].history.ego_states[-1]
    assert ego.tire_steering_angle == pytest.approx(
        np.arctan(ego.car_footprint.vehicle_parameters.wheel_base / 60.0), abs=0.02
    )
    assert ego.dynamic_car_state.tire_steering_rate != 0.0
    # The yaw rate is that of speed and steering at the new state.
    car_state, before = ego.dynamic_car_state, seen[40].history.ego_states[-2].dynamic_car_state
    wheelbase = ego.car_footprint.vehicle_parameters.wheel_base
    rate = car_state.rear_axle_velocity_2d.x * np.tan(ego.tire_steering_angle) / wheelbase
    assert car_state.angular_velocity == pytest.approx(rate, rel=1e-6)
    assert car_state.angular_acceleration == pytest.approx(10 * (rate - before.angular_velocity), rel=1e-6)
    # nuPlan starts with straight wheels, and with the yaw rate of the log.
    first = seen[1].history.ego_states[-1]
    assert first.tire_steering_angle == 0.0
    assert first.dynamic_car_state.angular_velocity == pytest.approx(8.0 / 60.0, rel=1e-3)


def test_inputs_are_those_of_the_set(replayed, scenarios):
    """At 1e-6 of the stored log: ego, agents, lights, time, and the history before the start."""
    scenario, direct = scenarios[3], replayed[1]
    origin = scenario.origin[:2]
    assert len(direct) == 81 and direct[1].iteration.index == 0
    for known in (direct[1], direct[40]):
        step = round(known.iteration.time_s / 0.1) - 20
        egos, observations = known.history.ego_states, known.history.observations
        assert len(egos) == len(observations) == 21
        for back in (0, 5, 10):
            ego, at = egos[-1 - back], step - back
            assert ego.time_us == (at + 20) * 100_000
            place, speed = [*ego.rear_axle], ego.dynamic_car_state.rear_axle_velocity_2d.x
            # Driven poses came back in single precision, and their speed is the length of a chord.
            near = (1e-6, 1e-6) if at <= 10 else (2e-5, 2e-4)
            np.testing.assert_allclose(place, axle(scenario)[at], rtol=0, atol=near[0])
            np.testing.assert_allclose(speed, np.hypot(*scenario.agent_velocity[at, 0]), rtol=0, atol=near[1])
            if at >= 2:
                np.testing.assert_allclose(ego.dynamic_car_state.angular_velocity, 8.0 / 60.0, atol=1e-4)
            objects = observations[-1 - back].tracked_objects
            expected = np.flatnonzero(scenario.agent_valid[at, 1:]) + 1
            parked = np.flatnonzero(scenario.parked_valid[at])
            assert len(objects) == len(expected) + len(parked)
            by_token = {item.track_token: item for item in objects}
            for slot in expected:
                item = by_token[str(scenario.agent_id[slot])]
                found = [*item.center, *item.velocity, item.box.length, item.box.width, item.box.height]
                right = [
                    *(scenario.agent_xy[at, slot] + origin), scenario.agent_heading[at, slot],
                    *scenario.agent_velocity[at, slot], *scenario.agent_size[slot],
                ]  # fmt: skip
                np.testing.assert_allclose(found, right, rtol=0, atol=1e-6)
            for slot in parked:
                item = by_token[str(scenario.parked_id[slot])]
                np.testing.assert_allclose(
                    [*item.center.point], scenario.parked_xy[slot] + origin, rtol=0, atol=1e-6
                )
        status = {data.lane_connector_id: data.status.name for data in known.traffic_light_data}
        assert status == {3: "GREEN" if step % 2 else "RED"}
    kinds = [item.tracked_object_type.name for item in direct[1].history.observations[-1].tracked_objects]
    assert kinds == ["VEHICLE", "PEDESTRIAN", "BICYCLE", "GENERIC_OBJECT"]
    first = direct[1].history.observations[-1].tracked_objects
    assert [item.tracked_object_type.name for item in first.get_agents()] == kinds[:3]
    assert [item.tracked_object_type.name for item in first.get_static_objects()] == kinds[3:]


def test_initialization_names_route_and_goal(replayed, scenarios):
    known = replayed[1][0]
    lanes = {
        known.map_api.get_map_object(name, SemanticMapLayer.ROADBLOCK) for name in known.route_roadblock_ids
    }
    assert None not in lanes and {lane.id for block in lanes for lane in block.interior_edges} == {
        "1",
        "2",
        "3",
    }
    np.testing.assert_allclose(
        [*known.mission_goal.point], scenarios[3].goal_xy + scenarios[3].origin[:2], rtol=0, atol=1e-6
    )


@pytest.mark.slow
def test_a_route_follower_drives_brakes_and_stops(scenarios):
    """On a free road it speeds up on the lane; it stops behind a car and before the line of a red light."""
    planner = make_planner("nuplan_planners:RouteIdm", SPACE)
    results = evaluate(planner, scenarios[:3], task=TASK)
    assert results.planner == "route_idm" and not results.crashes
    for metric in ("collision", "offroad", "red_light"):
        assert not results.metrics[metric].any(), metric
    driven = results.trajectories.ego
    assert driven[0, -1, 3] > 10.0 and results.metrics["progress_ratio"][0] == 1.0
    assert (driven[1:, -1, 3] < 1.5).all()
    along = np.linalg.norm(driven[:, -1, :2] - driven[:, 0, :2], axis=1)
    assert 36.0 < along[1] < 50.0 - 4.8 and 28.0 < along[2] < 40.0 - 2.4


@pytest.mark.slow
def test_episodes_do_not_depend_on_the_batch(scenarios):
    """Each scenario has an instance of its own, also in a second evaluation."""
    planner = make_planner("nuplan_planners:RouteIdm", SPACE)
    sizes = Sizes.used(scenarios)
    together = evaluate(planner, scenarios[:3], task=TASK, sizes=sizes).trajectories.ego
    alone = evaluate(planner, scenarios[1:2], task=TASK, sizes=sizes).trajectories.ego
    np.testing.assert_array_equal(alone[0], together[1])


@pytest.mark.slow
def test_errors_of_the_planner_fail_its_episode(scenarios):
    planner = NuplanPlanner(Host(Faulty, "tests:Faulty"), SPACE)
    results = evaluate(planner, scenarios[:1], task=TASK)
    (crash,) = results.crashes
    assert (crash.scenario_id, crash.step) == ("free", 12)
    assert crash.error.startswith("ZeroDivisionError: no way out (nuplan_planners.py:")
    assert format_crashes(results).startswith("faulty crashed in 1 of 1 episodes")
    late = evaluate(NuplanPlanner(Host(Late, "tests:Late"), SPACE), scenarios[:1], task=TASK)
    assert late.crashes[0].step == 10
    assert late.crashes[0].error == "the trajectory from 3.5 to 11 s does not continue from now, 3 s"


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("Seeing", "'nuplan_planners:Seeing' observes Sensors; only DetectionsTracks"),
        ("Blind", "planner 'nuplan_planners:Blind': NotImplementedError: no observation"),
        ("Sized", "is called with \\(\\); name a function that makes nuplan_planners:Sized"),
        (
            "Broken",
            "planner 'nuplan_planners:Broken': FileNotFoundError: weights.ckpt \\(nuplan_planners.py:",
        ),
    ],
)
def test_planners_that_cannot_be_made_are_refused(name, words):
    with pytest.raises(UsageError, match=words):
        make_planner(f"nuplan_planners:{name}")


def test_the_planner_has_its_own_action_space_unless_the_task_gives_one(scenarios):
    planner = make_planner("nuplan_planners:RouteIdm")
    assert isinstance(planner, NuplanPlanner) and default_task(planner).actions == Trajectory()
    assert make_planner("nuplan_planners:RouteIdm", PHYSICAL).actions == PHYSICAL
    assert (
        EmergencyBrake(planner, SPACE).prepare == planner.prepare and EmergencyBrake(Expert()).prepare is None
    )
    bank = drivax.load(scenarios[:1]).bank
    assert find_planner("nuplan_planners:RouteIdm", bank)[1].actions == Trajectory()
    assert find_planner("nuplan_planners:RouteIdm", bank, task=TASK)[0].actions == SPACE
    with pytest.raises(UsageError, match="route_idm needs stored scenarios"):
        evaluate(
            planner,
            bank,
            [{"dataset": "test", "scenario_id": "free", "segment": "free"}],
            task=default_task(planner),
        )


@pytest.mark.slow
def test_the_first_poses_are_followed_by_the_bicycle(scenarios):
    planner = make_planner("nuplan_planners:RouteIdm", PHYSICAL)
    results = evaluate(planner, scenarios[:1], task=replace(TASK, actions=PHYSICAL))
    assert not results.crashes and results.trajectories.ego[0, -1, 3] > 10.0
    assert not results.metrics["offroad"].any()


def test_the_map_has_lanes_links_and_areas():
    """Of the hand-made road: lane 1 (up to 40 m) leads into lane 3, lane 2 is 3.7 m to the left of both."""
    scenario = assemble(straight_road([car(0, 0, 0, 8)], RED, 40.0), SMALL)
    known = MapApi(scenario)
    point = lambda x, y: StateVector2D(x + float(scenario.origin[0]), y + float(scenario.origin[1]))  # noqa: E731
    lanes = {lane.id: lane for lane in known.lanes.values()}
    assert [lane.id for lane in lanes["1"].outgoing_edges] == ["3"]
    assert [lane.id for lane in lanes["3"].incoming_edges] == ["1"]
    left, right = lanes["1"].adjacent_edges
    assert (left.id, right) == ("2", None)
    assert lanes["1"].get_roadblock_id() == lanes["2"].get_roadblock_id()
    assert lanes["3"].has_traffic_lights() and not lanes["1"].has_traffic_lights()
    assert lanes["1"].speed_limit_mps == pytest.approx(13.4)
    at = known.get_one_map_object(point(10.0, 0.4), SemanticMapLayer.LANE)
    assert at.id == "1" and at.contains_point(point(39.9, -1.8)) and not at.contains_point(point(40.1, 0.0))
    assert known.get_all_map_objects(point(10.0, 20.0), SemanticMapLayer.LANE) == []
    assert known.get_distance_to_nearest_map_object(point(10.0, 7.55), SemanticMapLayer.LANE) == (
        "2",
        pytest.approx(2.0),
    )
    near = known.get_proximal_map_objects(point(10.0, 0.0), 1.9, [0, 11])
    assert {lane.id for lane in near[0]} == {"1", "2"} and near[11] == []
    path = at.baseline_path
    start = path.discrete_path[0]
    assert path.get_nearest_arc_length_from_position(point(10.0, 1.0)) == pytest.approx(
        10.0 - (start.x - float(scenario.origin[0])), abs=1e-4
    )
    pose = path.get_nearest_pose_from_position(point(10.0, 1.0))
    np.testing.assert_allclose([*pose], [*point(10.0, 0.0), 0.0], atol=1e-4)
    assert path.get_nearest_curvature_from_position(point(10.0, 1.0)) == pytest.approx(0.0, abs=1e-6)
    np.testing.assert_allclose(at.left_boundary.points[:, 1] - path.points[:, 1], 1.85, atol=1e-5)
    assert at.polygon.area == pytest.approx(path.length * 3.7, rel=1e-5)
    assert at.parent.polygon.area > at.polygon.area
    with pytest.raises(NotImplementedError, match="the map has no get_raster_map_layer"):
        known.get_raster_map_layer(SemanticMapLayer.LANE)


def test_curvature_of_a_line_is_that_of_its_circle():
    from drivax.planners.nuplan.map import Polyline

    angle = np.linspace(0.0, 1.0, 41)
    line = Polyline("arc", 40.0 * np.stack([np.sin(angle), 1 - np.cos(angle)], -1))
    assert line.length == pytest.approx(40.0, rel=1e-3)
    assert line.get_curvature_at_arc_length(20.0) == pytest.approx(1 / 40.0, rel=1e-3)


def test_centre_moves_as_in_the_devkit():
    """At 10 m/s on 20 m the centre of a 5.176 m car has 0.7305 m/s across.

    The devkit adds d (w^2 + alpha) = 1.461 (0.25 + 0.2) to the acceleration along; a rigid body has -d w^2 there.
    """
    state = DynamicCarState(StateVector2D(10.0, 0.0), StateVector2D(1.0, 0.0), 0.5, 0.2, 0.0, 1.461)
    assert [*state.center_velocity_2d] == pytest.approx([10.0, 0.7305])
    assert [*state.center_acceleration_2d] == pytest.approx([1.0 + 0.65745, 0.0])


def test_types_equal_those_of_the_devkit_by_name():
    import enum

    theirs = enum.Enum("TrackedObjectType", {"VEHICLE": 0, "BARRIER": 1})
    assert TrackedObjectType.VEHICLE == theirs.VEHICLE and theirs.VEHICLE == TrackedObjectType.VEHICLE
    assert TrackedObjectType.BARRIER != theirs.BARRIER
    assert TrackedObjectType.VEHICLE.fullname == "vehicle" and int(TrackedObjectType.BICYCLE) == 2


def test_vehicle_has_nuplan_proportions():
    view = ScenarioView(assemble(straight_road([car(0, 0, 0, 8, length=5.176, width=2.297)]), SMALL))
    vehicle = view.vehicle
    found = (vehicle.front_length, vehicle.rear_length, vehicle.wheel_base, vehicle.rear_axle_to_center)
    assert found == pytest.approx((4.049, 1.127, 3.089, 1.461), abs=1e-5)
    box = view.ego(10, np.tile([0.0, 0.0, 0.0, 8.0], (23, 1))).car_footprint
    front_left = np.array([*box.all_corners()[0]])
    assert box.geometry.area == pytest.approx(5.176 * 2.297, rel=1e-5)
    np.testing.assert_allclose(front_left - view.origin, [2.588, 1.1485], atol=1e-5)


def states_of(scenario):
    """Ego and observation of step 10, as planners get them."""
    view = ScenarioView(scenario)
    return view.ego(10, np.tile([0.0, 0.0, 0.0, 8.0], (23, 1))), view.logged_tracks(10), view.map


def test_objects_pass_isinstance_for_the_devkit_once_it_is_imported(scenarios, monkeypatch):
    ego, observation, known = states_of(scenarios[3])
    lane, block = next(iter(known.lanes.values())), next(iter(known.blocks.values()))
    agents, others = (
        getattr(observation.tracked_objects, f"get_{name}")() for name in ("agents", "static_objects")
    )
    assert not isinstance(ego, devkit.EgoState) and ego.__class__ is EgoState
    for name, module in devkit.modules().items():
        monkeypatch.setitem(sys.modules, name, module)
    assert isinstance(ego, devkit.EgoState) and isinstance(ego, EgoState)
    assert isinstance(observation, devkit.DetectionsTracks)
    assert observation.detection_type() == "DetectionsTracks"
    assert [isinstance(item, devkit.Agent) for item in [*agents, ego.agent, *others]] == [True] * 4 + [False]
    assert isinstance(others[0], devkit.StaticObject) and not isinstance(agents[0], devkit.StaticObject)
    assert isinstance(ego.center, devkit.StateSE2) and isinstance(ego.time_point, devkit.TimePoint)
    assert isinstance(lane, devkit.NuPlanLane) and isinstance(known, devkit.AbstractMap)
    assert isinstance(block, devkit.RoadBlockGraphEdgeMapObject)
    # Copies and pickles keep our class.
    for twin in (copy.deepcopy(ego), pickle.loads(pickle.dumps(ego))):
        assert type(twin) is EgoState and twin.center == ego.center


def test_poses_have_matrices_distances_and_lists():
    pose = StateSE2(3.0, 4.0, np.pi / 2)
    np.testing.assert_allclose(pose.as_matrix(), [[0, -1, 3], [1, 0, 4], [0, 0, 1]], atol=1e-15)
    assert [*StateSE2.from_matrix(pose.as_matrix())] == pytest.approx([3.0, 4.0, np.pi / 2])
    assert pose.distance_to(devkit.StateSE2(0.0, 0.0, 1.0)) == 5.0
    assert StateSE2.deserialize(pose.serialize()) == pose and pose.serialize() == [3.0, 4.0, np.pi / 2]


def test_times_compare_and_add_with_those_of_others():
    ours, theirs = TimePoint(300), devkit.TimePoint(200)
    assert ours > theirs and theirs <= ours and ours >= theirs and ours != theirs
    assert theirs < ours and TimePoint(200) == theirs and hash(TimePoint(5)) == hash(TimePoint(5))
    assert (ours + theirs).time_us == (theirs + ours).time_us == 500
    assert ours.diff(theirs).time_us == (ours - theirs).time_us == 100 and (theirs - ours).time_us == -100


def test_states_are_split_and_joined(scenarios):
    ego, _, _ = states_of(scenarios[3])
    split = ego.to_split_state()
    assert len(split) == 10 and split.angular_states == [ego.rear_axle.heading]
    assert [*ego][:4] == [ego.time_us, *ego.rear_axle] and len([*ego]) == 9 and [*ego][4] == 8.0
    again = EgoState.from_split_state(split)
    assert [*again] == pytest.approx(
        [*ego], rel=1e-12
    ) and again.car_footprint.width == ego.car_footprint.width


def test_the_rear_axle_has_the_speed_along_the_heading():
    """On a circle of 10 m the rear axle has 5 m/s and the centre of a 5.176 m car hypot(5, 1.461 x 0.5)."""
    view = ScenarioView(assemble(straight_road([car(0, 0, 0, 8, length=5.176)]), SMALL))
    angle = 0.05 * np.arange(23)
    x, y = 10 * np.sin(angle) + 1.461 * np.cos(angle), -10 * np.cos(angle) + 1.461 * np.sin(angle)
    motions = np.column_stack([x, y, angle, np.full(23, np.hypot(5.0, 1.461 * 0.5))])
    state = view.ego(10, motions).dynamic_car_state
    assert state.rear_axle_velocity_2d.x == pytest.approx(5.0, abs=2e-4)
    assert [*state.center_velocity_2d] == pytest.approx([5.0, 0.7305], abs=5e-4)


def test_history_begins_two_seconds_before_the_start(replayed, scenarios):
    """Before the log, agents and ego keep their first velocity."""
    history = replayed[1][1].history
    scenario, oldest = scenarios[3], history.observations[0]
    assert (
        history.duration == pytest.approx(2.0) and len(history.ego_states) == len(history.observations) == 21
    )
    slot = int(np.flatnonzero(scenario.agent_valid[0, 1:])[0]) + 1
    item = next(o for o in oldest.tracked_objects if o.track_token == str(scenario.agent_id[slot]))
    right = scenario.agent_xy[0, slot] - 1.0 * scenario.agent_velocity[0, slot] + scenario.origin[:2]
    np.testing.assert_allclose([*item.center.point], right, atol=1e-5)
    ego = history.ego_states[0]
    assert ego.time_us == 1_000_000 and item.timestamp_us == ego.time_us
    right = axle(scenario)[0, :2] - scenario.agent_velocity[0, 0]
    np.testing.assert_allclose([*ego.rear_axle.point], right, atol=1e-4)


def test_points_of_a_box_and_neighbours_of_a_lane(scenarios):
    ego, _, known = states_of(scenarios[3])
    box, pose = ego.car_footprint, ego.center
    assert [*box.get_point_of_interest(7)] == [pose.x, pose.y] and box.half_height == box.height / 2
    expected = {1: (2.4, 0), 2: (-2.4, 0), 3: (2.4, 1), 4: (2.4, -1), 5: (-2.4, 1), 8: (0, 1), 9: (0, -1)}
    for point, place in expected.items():
        np.testing.assert_allclose(np.subtract([*box.corner(point)], [*pose.point]), place, atol=1e-6)
    assert [*ego.agent.velocity] == [8.0, 0.0] and ego.agent.predictions is None
    assert ego.waypoint.center == pose and ego.waypoint.velocity.x == 8.0
    lanes = {lane.id: lane for lane in known.lanes.values()}
    assert (lanes["2"].index, lanes["1"].index) == (0, 1)
    assert lanes["2"].is_left_of(lanes["1"]) and lanes["1"].is_right_of(lanes["2"])
    assert not lanes["1"].is_left_of(lanes["2"])


def junction(*others, light=RED, **changes):
    """A recording in which lane 1 leads into connector 3 at 40 m; lane 2 is to the left of lane 1."""
    recording = straight_road([car(0, 0, 0, 8), *others], light, 40.0)
    changed = {2: {"right_neighbours": (1,)}, 3: {"interpolating": True, "left_neighbours": ()}}
    features = [replace(item, **changed.get(item.feature_id, {})) for item in recording.features]
    return replace(recording, features=tuple(features), **changes)


def test_layers_are_answered_or_refused(scenarios):
    known = MapApi(assemble(junction(), SMALL))
    point = lambda x, y: StateVector2D(*np.add(known.scenario.origin[:2], [x, y]))  # noqa: E731
    assert known.is_in_layer(point(10.0, 5.5), 5) and not known.is_in_layer(point(10.0, 5.6), 5)
    assert known.get_one_map_object(point(10.0, 0.0), 5).polygon.area > 500 * 3.7
    assert known.is_in_layer(point(50.0, 0.0), 1) and not known.is_in_layer(point(10.0, 0.0), 1)
    assert known.get_proximal_map_objects(point(10.0, 0.0), 9.0, [15]) == {15: []}
    with pytest.raises(NotImplementedError, match="no layer 4; it has LANE, INTERSECTION"):
        known.is_in_layer(point(0.0, 0.0), 4)
    for name in ("lane", "lane_connector", "roadblock", "roadblock_connector"):
        kind = "NuPlan" + name.title().replace("_", "").replace("Roadblock", "RoadBlock")
        number = "3" if "connector" in name else "1"
        assert type(getattr(known, f"_get_{name}")(number)).__name__ == kind


def test_routes_are_extended_or_refused():
    short = assemble(junction(route_lanes=(1,)), SMALL)
    assert ScenarioView(short).initialization().route_roadblock_ids == ["1", "3"]
    record = short.record.copy()
    record["route_points"] = 0
    lost = replace(short, record=record)
    with pytest.raises(PlannerError, match="scenario hand-made has no route"):
        ScenarioView(lost).initialization()


def test_the_call_sequence_of_the_devkits_idm_planner_works(monkeypatch):
    """It sees the leader's speed along its own heading, and a car that starts with straight wheels."""
    for name, module in devkit.modules().items():
        monkeypatch.setitem(sys.modules, name, module)
    recording = junction(car(20, 0, 0, 5), car(90, 0, 0, 0, kind=AgentKind.STATIC), light=GREEN)
    scenario, seen = assemble(far_away(recording, "leader"), SMALL), []
    planner = NuplanPlanner(Host(DevkitIdm(seen), "tests:DevkitIdm"), SPACE)
    planner.prepare(lambda number: scenario)
    simulator = Simulator(replace(TASK, metrics=("collision",), to_the_end=True))
    bank, rows = ScenarioBank.from_scenarios([scenario]), jnp.arange(1)
    episodes = jax.device_get(drive(simulator, planner, bank, rows, episode_keys(bank, rows, 0)))
    assert episodes.crashed.tolist() == [-1] and not episodes.metrics["collision"].value.any()
    ego, (gap, speed, static) = seen[0]
    assert (gap, speed, static) == (pytest.approx(15.2, abs=1e-3), pytest.approx(5.0, abs=1e-4), False)
    assert ego.tire_steering_angle == 0.0 and ego.dynamic_car_state.speed == pytest.approx(8.0, abs=1e-4)
    assert abs(episodes.motion[0, -1, 3] - 5.0) < 1.0

from __future__ import annotations

import math

import numpy as np
import pytest

from drivax.scenario.schema import AgentKind
from drivax.synthetic.domains import DOMAINS
from drivax.synthetic.roads.curves import Pose, straight
from drivax.synthetic.roads.families import FAMILIES, CurvedRoad
from drivax.synthetic.roads.network import Crossing, Draft, RoadNetwork
from drivax.synthetic.roads.signals import LightGroup, SignalPlan
from drivax.synthetic.traffic.path_arrays import speed_profile
from drivax.synthetic.traffic.paths import Sway, lane_path, random_lanes
from drivax.synthetic.traffic.placement import Density, draw_drivers, draw_path, place_vehicles
from drivax.synthetic.traffic.role_assignment import assign_roles
from drivax.synthetic.traffic.roles import (
    EgoPlan,
    Override,
    Pedestrian,
    Roles,
    ScriptedUser,
    Staging,
    Tailgate,
)
from drivax.synthetic.traffic.simulation import Run, WorldTraffic, run_all, simulate

from . import traffic_scenes
from .oracles import box_corners, shared_area
from .traffic_scenes import crossroads, drivers, road, roles


def line_with_light(signals=None):
    """200 m of road, a stop line, 20 m of junction, 300 m of road; limit 15 m/s."""
    draft = Draft()
    a = draft.lane(straight(Pose(0.0, 0.0, 0.0), 200.0), 3.5, 15.0)
    b = draft.lane(straight(Pose(200.0, 0.0, 0.0), 20.0), 3.5, 15.0, connector=True)
    c = draft.lane(straight(Pose(220.0, 0.0, 0.0), 300.0), 3.5, 15.0)
    draft.link(a, b)
    draft.link(b, c)
    return RoadNetwork("test", tuple(draft.lanes), (), signals=signals)


def light(green_s, offset_s=0.0):
    """Green for ``green_s`` from ``offset_s`` on, then yellow, then a long red."""
    groups = (LightGroup((1,), False), LightGroup((), False))
    return SignalPlan(groups, ((0,), (1,)), (green_s, 500.0), offset_s=offset_s)


def run(network, table, at, speed, seconds, overrides=()):
    routes = [(0, 1, 2)] * len(at)
    return traffic_scenes.run(network, routes, table, at, speed, seconds, Staging(overrides=overrides))


def test_speed_profile_equals_brute_force():
    network = CurvedRoad().build(np.random.default_rng(3))
    path = lane_path(network, random_lanes(network, 0, np.random.default_rng(0)), Sway())
    got = speed_profile(path, 0.9, 2.0, 1.4)
    top = np.minimum(0.9 * path.limit_mps, np.sqrt(2.0 / np.maximum(np.abs(path.curvature), 1e-6)))
    for i in range(0, len(top), 61):
        brute = min(math.sqrt(top[j] ** 2 + 2 * 1.4 * path.step_m * (j - i)) for j in range(i, len(top)))
        assert got[i] == pytest.approx(brute)
    assert got.min() < top.max()


def test_free_driver_reaches_and_holds_the_preferred_speed():
    motion = run(line_with_light(), drivers(1, speed_factor=0.9), [10.0], [5.0], 20.0)
    assert motion.speed[0, -1] == pytest.approx(0.9 * 15.0, rel=0.02)
    assert motion.speed[0].max() <= 0.9 * 15.0 + 0.05


@pytest.mark.parametrize("speed", [6.0, 10.0, 14.0])
@pytest.mark.parametrize("seed", range(3))
def test_all_vehicles_stop_behind_the_line_at_red(speed, seed):
    table = drivers(3, seed, speed_factor=0.95)
    motion = run(line_with_light(light(1.0, -10.0)), table, [140.0, 110.0, 70.0], [speed] * 3, 30.0)
    front = motion.distance_m[0] + table.size_m[0, 0] / 2
    assert front.max() < 200.0
    assert front[-1] > 197.0
    assert motion.speed[:, -1] == pytest.approx(0.0, abs=0.05)
    gaps = motion.distance_m[:-1, -1] - motion.distance_m[1:, -1]
    lengths = (table.size_m[:-1, 0] + table.size_m[1:, 0]) / 2
    assert np.all(gaps - lengths > 1.0) and np.all(gaps - lengths < 4.0)
    assert motion.acceleration.min() > -4.5


def test_vehicles_pass_green_and_start_when_red_turns_green():
    through = run(line_with_light(light(30.0)), drivers(1), [150.0], [12.0], 10.0)
    assert through.distance_m[0, -1] > 230.0
    table = drivers(1)
    waits = run(line_with_light(light(20.0, offset_s=10.0)), table, [185.0], [8.0], 25.0)
    front = waits.distance_m[0] + table.size_m[0, 0] / 2
    assert front[99] < 200.0 and waits.speed[0, 99] < 0.3
    assert waits.distance_m[0, -1] > 230.0


@pytest.mark.parametrize("at", range(120, 196, 5))
def test_yellow_never_leads_to_running_red(at):
    table = drivers(1, seed=at)
    motion = run(line_with_light(light(1.0)), table, [float(at)], [13.0], 15.0)
    front = motion.distance_m[0] + table.size_m[0, 0] / 2
    # Green until 1.0 s, yellow until 4.0 s.
    passed = np.flatnonzero(front > 200.0)
    assert not len(passed) or passed[0] <= 41
    assert motion.acceleration.min() > -5.5


def test_no_follower_touches_a_leader_that_brakes_to_a_halt():
    table = drivers(4, seed=2)
    stop = Override(vehicle=0, first_step=20, last_step=120, acceleration_mps2=-4.0)
    motion = run(line_with_light(), table, [150.0, 120.0, 92.0, 60.0], [12.0] * 4, 16.0, (stop,))
    assert motion.speed[0, 70] == 0.0
    assert motion.acceleration[0, 25:40] == pytest.approx(-4.0)
    gaps = motion.distance_m[:-1] - motion.distance_m[1:]
    assert (gaps - (table.size_m[:-1, 0] + table.size_m[1:, 0])[:, None] / 2).min() > 0.3


def test_positions_are_the_integral_of_speeds_and_stops_are_exact():
    stop = Override(0, 5, 60, -6.0)
    motion = run(line_with_light(), drivers(1, speed_factor=1.0), [20.0], [10.0], 8.0, (stop,))
    v, s = motion.speed[0], motion.distance_m[0]
    # Trapezoids are exact at constant acceleration; in the step of the halt the distance is v^2 / (2 a).
    halt = int(np.flatnonzero((v[1:] == 0) & (v[:-1] > 0))[0])
    moved = np.diff(s)
    trapezoid = (v[1:] + v[:-1]) / 2 * 0.1
    others = np.arange(len(moved)) != halt
    assert np.allclose(moved[others], trapezoid[others])
    assert moved[halt] == pytest.approx(v[halt] ** 2 / (2 * -motion.acceleration[0, halt]))
    assert np.all(v[halt + 1 : 60] == 0) and np.ptp(s[halt + 1 : 60]) == 0


@pytest.mark.parametrize("crossing", [True, False])
def test_no_vehicle_enters_while_another_still_crosses(crossing):
    network = crossroads()
    assert np.argwhere(network.conflicts).tolist() == [[1, 4], [4, 1]]
    table = drivers(2, speed_factor=0.9)
    # Row 0 creeps across the junction, or has crossed it already.
    at = [104.0 if crossing else 140.0, 50.0]
    creep = Override(vehicle=0, first_step=0, last_step=75, acceleration_mps2=0.0)
    routes = ((0, 1, 2), (3, 4, 5))
    motion = traffic_scenes.run(network, routes, table, at, [2.0, 10.0], 15.0, Staging(overrides=(creep,)))
    front = motion.distance_m[1] + table.size_m[1, 0] / 2
    rear = motion.distance_m[0] - table.size_m[0, 0] / 2
    entered = int(np.flatnonzero(front > 100.0)[0])
    if crossing:
        assert rear[entered] >= 113.0 and entered > 50
        assert motion.speed[1, :entered].min() < 3.0
    else:
        assert entered < 60 and motion.speed[1].min() > 5.0


def test_vehicles_leave_at_the_end_of_the_map():
    motion = run(line_with_light(), drivers(1), [480.0], [13.0], 6.0)
    assert motion.valid[0, 0] and not motion.valid[0, -1]
    assert np.all(np.diff(motion.valid[0].astype(int)) <= 0)


def test_platoon_reaches_the_equilibrium_gap():
    # In equilibrium 1 - (v / v0)^4 = ((s0 + v T) / s)^2 (Treiber, Hennecke and Helbing 2000).
    network, _ = road(3000.0)
    table = drivers(4, 3, speed_factor=0.9)
    table.top_speed_mps[0] = 8.0
    motion = traffic_scenes.run(network, [(0,)] * 4, table, [150.0, 120.0, 90.0, 60.0], [8.0] * 4, 150.0)
    speed = motion.speed[0, -1]
    assert speed == pytest.approx(8.0, abs=0.05)
    for k in range(1, 4):
        gap = (
            motion.distance_m[k - 1, -1]
            - motion.distance_m[k, -1]
            - (table.size_m[k - 1, 0] + table.size_m[k, 0]) / 2
        )
        expected = (2.0 + speed * table.headway_s[k]) / math.sqrt(1 - (speed / (0.9 * 15.0)) ** 4)
        assert gap == pytest.approx(expected, rel=0.02)


def test_drivers_apply_decisions_after_their_reaction_time():
    network, _ = road(1000.0)
    stop = Staging(overrides=(Override(0, 30, 100, -3.0),))
    begins = []
    for reaction in (0.0, 0.5):
        table = drivers(2, 1, speed_factor=0.8, reaction_s=reaction, headway_s=1.5)
        motion, calm = (
            traffic_scenes.run(network, [(0,)] * 2, table, [130.0, 100.0], [11.0] * 2, 8.0, staging)
            for staging in (stop, Staging())
        )
        gap = motion.distance_m[0] - motion.distance_m[1] - table.size_m[:, 0].mean()
        assert gap.min() > 0.5
        begins.append(int(np.flatnonzero(np.abs(motion.acceleration[1] - calm.acceleration[1]) > 1e-9)[0]))
    # Without delay the follower sees the leader slow down one step later.
    assert begins == [31, 36]


def test_cyclists_are_followed_on_narrow_lanes_and_passed_on_wide_ones():
    for width, passes in ((3.5, False), (7.0, True)):
        network, _ = road(600.0, width_m=width)
        table = drivers(2, speed_factor=0.8)
        table.kind[1] = AgentKind.CYCLIST
        table.size_m[1] = (1.8, 0.65, 1.75)
        table.top_speed_mps[1] = 5.0
        scene = roles(network, [(0,)] * 2, table, [60.0, 90.0], [10.0, 5.0])
        scene.paths[1] = lane_path(network, (0,), Sway((0.55 - width / 2,), (0.0,), (math.pi / 2,)))
        motion = WorldTraffic(scene, np.arange(200) / 10).run()
        assert (motion.xy[0, -1, 0] > motion.xy[1, -1, 0]) == passes
        assert motion.kind.tolist() == [AgentKind.VEHICLE, AgentKind.CYCLIST]


def test_planned_ego_follows_its_plan_and_others_react():
    network, _ = road(1000.0)
    table = drivers(2, speed_factor=0.8)
    first, steps = 20, 100
    free = traffic_scenes.run(network, [(0,)] * 2, table, [100.0, 70.0], [11.0] * 2, steps / 10)
    v = np.maximum(free.speed[0, first] - 3.0 * np.arange(steps - first) / 10, 0.0)
    x = free.xy[0, first, 0] + np.concatenate([[0.0], np.cumsum((v[1:] + v[:-1]) * 0.05)])
    plan = EgoPlan(first, np.stack([x, np.full(len(x), 0.3)], axis=-1), np.full(len(x), 0.01), v)
    motion = traffic_scenes.run(network, [(0,)] * 2, table, [100.0, 70.0], [11.0] * 2, steps / 10, ego=plan)
    assert np.array_equal(motion.xy[:, :first], free.xy[:, :first])
    assert np.array_equal(motion.xy[0, first:], plan.xy) and np.array_equal(
        motion.heading[0, first:], plan.heading
    )
    assert np.array_equal(motion.speed[0, first:], v)
    assert motion.distance_m[0, first:] == pytest.approx(x, abs=1e-6)
    gap = motion.xy[0, :, 0] - motion.xy[1, :, 0] - table.size_m[:, 0].mean()
    assert gap.min() > 0.5 and motion.speed[1, -1] < 0.5


def test_cars_stop_for_pedestrians_on_a_crossing():
    network, _ = road(400.0)
    axis = np.array([[200.0, -2.5], [200.0, 2.5]])
    network = RoadNetwork("test", network.lanes, (), crossings=(Crossing(axis, 3.0, ((0, 200.0),)),))
    way = straight(Pose(200.0, -8.0, math.pi / 2), 16.0)
    pedestrians = (Pedestrian(way, 0.0, 1.3, crossing=0, kerb_m=5.5, across_m=10.5),)
    table = drivers(2, speed_factor=0.8)
    motion = traffic_scenes.run(
        network, [(0,)] * 2, table, [115.0, 90.0], [11.0] * 2, 25.0, pedestrians=pedestrians
    )
    assert motion.xy[2, -1, 1] > 2.0
    crossing = np.abs(motion.xy[2, :, 1]) < 2.5
    front = motion.xy[0, :, 0] + table.size_m[0, 0] / 2
    # While a pedestrian is on the lane, the car is before the crosswalk or beyond it.
    rear = motion.xy[0, :, 0] - table.size_m[0, 0] / 2
    assert np.all((front[crossing] < 198.5) | (rear[crossing] > 201.5))
    assert motion.xy[0, -1, 0] > 230.0 and motion.acceleration.min() > -5.0


def test_repeated_runs_are_equal_and_users_keep_their_order():
    network, _ = road(400.0)
    steps = 50
    parked = ScriptedUser.from_pose(AgentKind.VEHICLE, (4.5, 1.8, 1.5), Pose(50.0, -6.0, 0.0), steps)
    extra = ScriptedUser.from_pose(AgentKind.CYCLIST, (1.8, 0.6, 1.7), Pose(60.0, -7.0, 0.0), steps)
    pedestrians = (Pedestrian(straight(Pose(0.0, 9.0, 0.0), 80.0), 0.0, 1.2),)
    scene = roles(
        network, [(0,)] * 2, drivers(2), [100.0, 60.0], [9.0] * 2, pedestrians=pedestrians, parked=(parked,)
    )
    traffic = WorldTraffic(scene, np.arange(steps) / 10)
    staging = Staging(overrides=(Override(0, 10, 30, -3.0),), extras=(extra,))
    first, calm, again = traffic.run(staging), traffic.run(), traffic.run(staging)
    assert first.kind.tolist() == [1, 1, AgentKind.PEDESTRIAN, AgentKind.VEHICLE, AgentKind.CYCLIST]
    assert first.vehicles == 2 and first.xy.shape == (5, steps, 2) and calm.xy.shape == (4, steps, 2)
    for name in ("xy", "heading", "speed", "valid", "distance_m", "acceleration", "size_m"):
        assert np.array_equal(getattr(first, name), getattr(again, name)), name
    assert not np.array_equal(first.xy[0], calm.xy[0])
    later = first.from_step(20)
    assert np.array_equal(later.xy, first.xy[:, 20:]) and later.acceleration.shape == (2, steps - 20)


@pytest.mark.parametrize("family", FAMILIES, ids=lambda family: family.name)
@pytest.mark.parametrize("seed", range(2))
def test_dense_traffic_has_no_overlaps(family, seed):
    rng = np.random.default_rng(seed)
    network = family.build(rng)
    start = network.starts[int(rng.integers(len(network.starts)))]
    along = float(rng.uniform(start.low_m, start.high_m))
    where = place_vehicles(network, start.lane, along, Density(spacing_m=(12.0, 40.0)), rng)
    first = [start.lane, *where.lane]
    table = draw_drivers(len(first), Density(), rng, [network.lanes[lane] for lane in first])
    paths = [
        draw_path(network, random_lanes(network, lane, rng), bool(cyclist), rng)
        for lane, cyclist in zip(first, table.cyclist, strict=True)
    ]
    at = np.array([along, *where.along_m])
    speed = []
    for i, path in enumerate(paths):
        fastest = speed_profile(
            path, table.speed_factor[i], table.lateral_mps2[i], table.slowing_mps2[i], table.top_speed_mps[i]
        )
        lines = [span.begin_m - at[i] - 8.0 for span in path.spans if network.lanes[span.lane].connector]
        room = max(min((line for line in lines if line > -8.0), default=math.inf), 0.0)
        speed.append(min(0.8 * fastest[int(at[i] / path.step_m)], math.sqrt(3.0 * room)))
    traffic = WorldTraffic(Roles(network, paths, table, at, np.array(speed), ()), np.arange(150) / 10)
    motion = traffic.run()
    assert len(first) > 8
    for t in range(0, 150, 3):
        xy = np.where(motion.valid[:, t, None], motion.xy[:, t], np.nan)
        near = np.hypot(*np.moveaxis(xy[:, None] - xy, -1, 0)) < 12.5
        for a, b in np.argwhere(np.triu(near, 1)):
            boxes = [box_corners(xy[k], motion.heading[k, t], *table.size_m[k, :2]) for k in (a, b)]
            assert shared_area(*boxes) < 1e-6, (t, a, b)
    # Traffic flows, and speeds match the positions.
    assert np.ptp(motion.distance_m, axis=1).mean() > 25.0
    moved = np.hypot(*np.moveaxis(np.diff(motion.xy, axis=1), -1, 0))
    travelled = (motion.speed[:, 1:] + motion.speed[:, :-1]) * 0.05
    assert np.abs(moved - travelled)[motion.valid[:, 1:]].max() < 0.15


def draw_roles(seed):
    """Roles on drawn roads, and the times of their steps."""
    domain, rng, times = DOMAINS["grid"], np.random.default_rng(seed), (np.arange(131) - 40) * 0.1
    network = domain.draw_family(rng).build(rng, domain.style)
    return assign_roles(network, domain, times, 0.35, (0.34, 0.33, 0.33), rng, (), False), times


def staged_run(seed, world):
    """A run on drawn roads; every second one has a plan of ego, and every third one an event."""
    drawn, times = draw_roles(2 * seed + world % 2)
    traffic = WorldTraffic(drawn, times[: 131 - 7 * world])
    ego, staging = None, Staging()
    if world % 2:
        motion = traffic.run()
        ego = EgoPlan(53, motion.xy[0, 53:], motion.heading[0, 53:], motion.speed[0, 53:] / 2)
    if world % 3 == 0:
        steps, poses = (
            len(traffic.times_s),
            [Pose(*drawn.paths[k].curve.xy[n], 0.0) for k, n in ((1, -80), (0, 300))],
        )
        pedestrian = ScriptedUser.from_pose(AgentKind.PEDESTRIAN, (0.6, 0.6, 1.7), poses[0], steps)
        pedestrian.valid[:20] = False
        car = ScriptedUser.from_pose(AgentKind.VEHICLE, (4.5, 1.8, 1.5), poses[1], steps)
        staging = Staging((Override(1, 66, 90, -5.0),), (pedestrian, car), (Tailgate(2, 0.5),), (3,))
    return Run(traffic, staging, ego)


@pytest.mark.parametrize("seed", range(3))
def test_worlds_simulated_together_equal_worlds_alone(seed):
    runs = [staged_run(seed, world) for world in range(5)]
    for run, together in zip(runs, simulate(runs), strict=True):
        alone = run.traffic.run(run.staging, run.ego)
        for name in ("kind", "size_m", "xy", "heading", "speed", "valid", "distance_m", "acceleration"):
            np.testing.assert_array_equal(getattr(together, name), getattr(alone, name), err_msg=name)
        assert [len(path.curve.xy) for path in together.paths] == [len(path.curve.xy) for path in alone.paths]
        changed = [a is not b for a, b in zip(alone.paths, run.traffic.roles.paths, strict=True)]
        assert alone.vehicles > 3 and (run is not runs[0] or any(changed))


def test_tasks_return_results_in_order_however_many_runs_they_need():
    scene = roles(road()[0], [(0,)], drivers(1), [20.0], [10.0])

    def task(number):
        motions = []
        for steps in range(2, 2 + (3 * number) % 5):
            motions.append((yield Run(WorldTraffic(scene, np.arange(steps) / 10))))
        return number, [motion.xy.shape[1] for motion in motions]

    expected = [(number, list(range(2, 2 + (3 * number) % 5))) for number in range(20)]
    assert list(run_all(task(number) for number in range(20))) == expected
    assert list(run_all([])) == []

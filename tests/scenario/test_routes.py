from __future__ import annotations

import numpy as np
import pytest

from drivax.geometry.angles import wrap
from drivax.geometry.polylines import project
from drivax.scenario.agents import local_tracks
from drivax.scenario.assemble import ego_log
from drivax.scenario.lane_paths import trace
from drivax.scenario.lanes import LaneSegments, lane_graph
from drivax.scenario.routes import Route, find_routes, log_progress
from drivax.scenario.schema import RoadKind
from drivax.scenario.segments import cut, road_lines

from .recordings import arc, driving, lane, line, make_tracks

ZERO = np.zeros(3)


def routes_of(features, path, given=(), valid=None, heading=None, most_routes=12):
    graph = lane_graph(features, ZERO)
    on = LaneSegments.of(cut(road_lines(features, ZERO, None)), graph)
    tracks = local_tracks(make_tracks([path], valid=valid, heading=heading), 0, ZERO)
    ego = ego_log(tracks, 10)
    index = graph.index()
    return find_routes(graph, on, ego, [index[i] for i in given], most_routes, 400), ego, graph


def check_smooth(route: Route, kink=0.2):
    """Points a metre apart whose direction never jumps."""
    step = np.linalg.norm(np.diff(route.xyz[:, :2], axis=0), axis=1)
    assert step == pytest.approx(np.ones(len(step)), abs=0.01)
    assert np.abs(wrap(np.diff(route.heading))).max() < kink


def two_lanes(begin=-100.0, end=600.0):
    return (
        lane(1, line((begin, 0), (end, 0)), left_neighbours=(2,)),
        lane(2, line((begin, 3.5), (end, 3.5)), right_neighbours=(1,)),
    )


def junction():
    """A lane from the west that forks: straight on to the east, left to the north."""
    return (
        lane(1, line((-100, 0), (50, 0)), successors=(2, 3)),
        lane(2, line((50, 0), (400, 0))),
        lane(3, arc((50, 15), 15.0, -np.pi / 2, 0.0, step=0.25), successors=(4,)),
        lane(4, line((65, 15), (65, 400))),
    )


def test_progress_on_a_straight_road_is_the_distance_driven():
    found, _, _ = routes_of(two_lanes(), driving(speed=10.0, y=0.4))
    assert found.on_lanes
    route = found.routes[0]
    assert route.xyz[0] == pytest.approx([-30.0, 0.0, 0.0])  # 20 m behind the first logged position
    assert len(route.xyz) == 400
    assert set(route.lane) == {0}
    assert found.progress == pytest.approx(20.0 + np.arange(91.0), abs=1e-6)
    assert found.goal == pytest.approx([80.0, 0.0])
    check_smooth(route, kink=1e-6)


def test_the_route_turns_where_the_goal_is():
    turned = np.concatenate(
        (line((-10, 0), (50, 0)), arc((50, 15), 15.0, -np.pi / 2, 0.0)[1:], line((65, 16), (65, 60)))
    )
    s = np.linspace(0, 119.0, 91)
    total = np.concatenate(([0], np.cumsum(np.hypot(*np.diff(turned[:, :2], axis=0).T))))
    path = np.stack([np.interp(s, total, turned[:, i]) for i in (0, 1)], axis=-1)
    found, _, _ = routes_of(junction(), path)
    assert [x for x in dict.fromkeys(found.routes[0].lane.tolist()) if x >= 0] == [0, 2, 3]
    assert np.diff(found.progress) == pytest.approx(np.full(90, s[1]), abs=0.05)
    check_smooth(found.routes[0])
    straight, _, _ = routes_of(junction(), driving(speed=15.0))
    assert [x for x in dict.fromkeys(straight.routes[0].lane.tolist()) if x >= 0] == [0, 1]
    ends = {tuple(np.round(route.xyz[-1, :2])) for route in straight.routes if len(route.xyz) > 250}
    assert len(ends) >= 2  # the other way is among the alternatives


def test_a_lane_change_of_the_log_is_followed_without_a_jump():
    path = driving(speed=12.0)
    path[:, 1] = 3.5 / (1 + np.exp(-(path[:, 0] - 45) / 5))
    found, ego, _ = routes_of(two_lanes(), path)
    route = found.routes[0]
    assert list(dict.fromkeys(route.lane.tolist())) == [0, 1]
    check_smooth(route, kink=0.03)
    _, apart = project(route.xyz, ego.seen[:, :2])
    assert apart[-1] < 0.01
    assert apart.mean() < 1.0
    assert np.abs(np.diff(route.xyz[:, 1])).max() < 0.19  # at most 1.875 x 3.5 m / 36 m


def test_two_changes_share_the_stretch_up_to_the_goal_on_lanes_that_begin_elsewhere():
    features = (
        lane(1, line((-100, 0), (600, 0)), left_neighbours=(2,)),
        lane(2, line((-150, 3.5), (600, 3.5)), right_neighbours=(1,), left_neighbours=(3,)),
        lane(3, line((-40, 7), (600, 7)), right_neighbours=(2,)),
    )
    graph = lane_graph(features, ZERO)
    xyz, label = trace(graph, (0, 1, 2), 100.0, -100.0, (5.0, 100.0), 0.5, 20.0)  # the ego is at (0, 0)
    y = np.interp([0, 42.5, 52.5, 62.5, 71.25, 81.25, 91.25, 300], xyz[:, 0], xyz[:, 1])
    assert y == pytest.approx([0, 0, 1.75, 3.5, 3.5, 5.25, 7, 7], abs=0.01)
    assert list(dict.fromkeys(label.tolist())) == [0, 1, 2]


def test_a_given_route_is_taken_as_it_is():
    found, _, graph = routes_of(junction(), driving(speed=3.0), given=(1, 3, 4))
    assert found.on_lanes
    assert [graph.lane_id[x] for x in dict.fromkeys(found.routes[0].lane.tolist()) if x >= 0] == [1, 3, 4]
    driven = driving(speed=10.0)  # straight on, although the route turns
    other, _, graph = routes_of(junction(), driven, given=(1, 3, 4))
    assert other.on_lanes
    assert other.routes[0].xyz[-1, 1] > 100
    assert other.goal[0] == pytest.approx(65.0, abs=4.0)
    changing, _, graph = routes_of(two_lanes(), driving(speed=8.0), given=(1, 2))
    assert [graph.lane_id[x] for x in dict.fromkeys(changing.routes[0].lane.tolist())] == [1, 2]
    check_smooth(changing.routes[0], kink=0.04)


def test_routes_go_fifty_metres_past_the_goal_where_the_map_ends():
    found, _, _ = routes_of(two_lanes(end=100.0), driving(speed=10.0))
    route = found.routes[0]
    assert len(route.xyz) - 1 - found.progress[-1] >= PAST_GOAL
    assert route.xyz[-1, :2] == pytest.approx([150.0, 0.0], abs=1.0)
    assert route.lane[-1] == -1
    beyond, _, _ = routes_of(two_lanes(end=75.0), driving(speed=10.0))  # the log leaves the map
    assert len(beyond.routes[0].xyz) - 1 - beyond.progress[-1] >= PAST_GOAL - 1.0


PAST_GOAL = 50.0


def test_where_lanes_begin_at_the_ego_the_route_begins_behind_it():
    found, _, _ = routes_of(two_lanes(begin=-5.0), driving(speed=10.0))
    assert found.routes[0].xyz[0, :2] == pytest.approx([-30.0, 0.0])
    assert found.routes[0].lane[0] == -1
    assert found.progress[0] == pytest.approx(20.0)
    chain = (
        lane(1, line((-60, 0), (-8, 0)), successors=(2,)),
        lane(3, arc((-8, 30), 30.0, -np.pi / 2 - 0.8, -np.pi / 2), successors=(2,)),
        lane(2, line((-8, 0), (500, 0))),
    )
    on_chain, _, graph = routes_of(chain, driving(speed=10.0))
    assert graph.lane_id[on_chain.routes[0].lane[0]] == 1  # where it came from, not the merging one


@pytest.mark.parametrize("features", [(), (lane(1, line((0, 200), (90, 200))),)])
def test_without_a_lane_in_reach_the_route_is_the_log(features):
    found, _, _ = routes_of(features, driving(speed=10.0))
    assert not found.on_lanes
    assert len(found.routes) == 2
    assert found.routes[0].xyz[0, :2] == pytest.approx([-10.0, 0.0])
    assert found.progress == pytest.approx(np.arange(91.0), abs=1e-6)
    assert len(found.routes[0].xyz) - 1 - found.progress[-1] >= PAST_GOAL
    assert set(found.routes[0].lane) == {-1}


def test_bike_lanes_and_oncoming_lanes_are_no_way():
    features = (
        lane(1, line((-100, 0), (400, 0)), kind=RoadKind.LANE_BIKE),
        lane(2, line((400, 1), (-100, 1))),
    )
    assert not routes_of(features, driving())[0].on_lanes


def test_a_standing_ego_has_a_way_ahead_and_no_progress():
    rng = np.random.default_rng(0)
    still = np.array([0.0, 0.5]) + rng.normal(0.0, 0.02, (91, 2))
    found, _, _ = routes_of(two_lanes(), still, heading=np.zeros((1, 91)))
    assert found.on_lanes
    assert np.ptp(found.progress) < 0.2
    log = found.routes[1]
    assert len(log.xyz) - 1 >= PAST_GOAL
    check_smooth(log, kink=0.05)
    assert log.xyz[-1, 1] == pytest.approx(0.0, abs=0.01)  # on along its lane
    off, _, _ = routes_of((), still, heading=np.full((1, 91), 1.0))
    direction = off.routes[0].xyz[-1] - off.routes[0].xyz[0]
    assert np.arctan2(direction[1], direction[0]) == pytest.approx(1.0, abs=0.05)


def test_the_log_route_is_the_logged_way_and_goes_on_along_the_lane():
    path = driving(speed=10.0)
    path[:, 1] = 0.5 * np.sin(path[:, 0] / 15)
    found, ego, _ = routes_of(two_lanes(), path)
    _, apart = project(found.routes[1].xyz, ego.seen[:, :2])
    assert apart.max() < 0.01
    assert len(found.routes[1].xyz) - 1 >= 90 + PAST_GOAL
    check_smooth(found.routes[1], kink=0.1)


def test_alternatives_differ_and_include_the_lane_change():
    found, _, _ = routes_of(two_lanes(), driving(speed=10.0))
    assert len(found.routes) >= 3
    assert any(route.xyz[-1, 1] > 3.0 for route in found.routes[2:])
    for route in found.routes:
        check_smooth(route, kink=0.05)
    assert len(routes_of(junction(), driving(), most_routes=2)[0].routes) == 2


def test_chained_lanes_with_gaps_give_a_continuous_route():
    features = (
        lane(1, line((-100, 0), (30, 0))),
        lane(2, line((30.3, 0.35), (90, 0.35))),
        lane(3, line((90, 0), (500, 0))),
    )
    found, _, _ = routes_of(features, driving(speed=10.0))
    assert list(dict.fromkeys(found.routes[0].lane.tolist())) == [0, 1, 2]
    check_smooth(found.routes[0], kink=0.06)


def test_progress_repeats_over_gaps_and_never_runs_back():
    valid = np.ones((1, 91), dtype=bool)
    valid[0, :3] = valid[0, 40:60] = False
    path = driving(speed=10.0)
    path[70:] = path[70] + np.array([-1.0, 0.0])  # rolls back by a metre
    found, _, _ = routes_of(two_lanes(), path, valid=valid)
    assert (np.diff(found.progress) >= 0).all()
    assert found.progress[:4] == pytest.approx([20.0] * 4)
    assert found.progress[39:60] == pytest.approx([56.0] * 21)
    assert found.progress[60] == pytest.approx(77.0)
    assert found.progress[70:] == pytest.approx(np.full(21, found.progress[69]))


def test_progress_does_not_jump_to_another_branch_of_the_route():
    hairpin = np.concatenate((line((0, 0), (60, 0)), line((60, 4), (0, 4))))
    route = Route.along(hairpin, np.zeros(len(hairpin), dtype=np.int64), 400)
    path = driving(speed=6.0, x=6.0, y=1.9)
    path[:, 1] += np.where(path[:, 0] > 25, 0.3, 0.0)  # nearer to the way back than to the way out
    tracks = local_tracks(make_tracks([path]), 0, ZERO)
    progress = log_progress(route, ego_log(tracks, 10))
    assert progress == pytest.approx(path[:, 0], abs=0.05)

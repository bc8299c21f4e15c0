from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivax.geometry.polylines import project
from drivax.geometry.vectors import wrap
from drivax.scenario.build.assemble import ego_log
from drivax.scenario.build.lane_paths import LaneSearch, trace
from drivax.scenario.build.lanes import LaneSegments, lane_graph
from drivax.scenario.build.routes import (
    LEAST_M,
    Intent,
    Route,
    RouteStyle,
    find_routes,
    join,
    log_progress,
    published_paths,
    score,
)
from drivax.scenario.build.segments import cut, road_lines
from drivax.scenario.build.tracks import local_tracks
from drivax.scenario.schema import RoadKind

from .recordings import arc, driving, lane, line, make_tracks

ZERO = np.zeros(3)


def routes_of(features, path, most_routes=12, style: RouteStyle = "graph", **more):
    """Routes of one log; ``intended`` and ``corridor`` name lanes by id, ``valid`` and ``heading`` are the track's."""
    intended, corridor = more.pop("intended", ()), more.pop("corridor", ())
    graph = lane_graph(features, ZERO)
    on = LaneSegments.of(cut(road_lines(features, ZERO, None)), graph)
    tracks = local_tracks(make_tracks([path], **more), 0, ZERO)
    ego = ego_log(tracks, 10)
    index = graph.index()
    intent = Intent(tuple(index[i] for i in intended), tuple(index[i] for i in corridor))
    return find_routes(on, ego, intent, style, most_routes, 400), ego, graph


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


def test_route_follows_a_logged_lane_change_smoothly():
    path = driving(speed=12.0)
    path[:, 1] = 3.5 / (1 + np.exp(-(path[:, 0] - 45) / 5))
    found, ego, _ = routes_of(two_lanes(), path)
    route = found.routes[0]
    assert list(dict.fromkeys(route.lane.tolist())) == [0, 1]
    check_smooth(route, kink=0.03)
    _, apart = project(route.xyz, ego.positions[:, :2])
    assert apart[-1] < 0.01
    assert apart.mean() < 1.0
    assert np.abs(np.diff(route.xyz[:, 1])).max() < 0.19  # at most 1.875 x 3.5 m / 36 m


def test_two_lane_changes_share_the_stretch_to_the_goal():
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


def test_intended_route_is_used_unchanged():
    found, _, graph = routes_of(junction(), driving(speed=3.0), intended=(1, 3, 4))
    assert found.on_lanes
    assert [graph.lane_id[x] for x in dict.fromkeys(found.routes[0].lane.tolist()) if x >= 0] == [1, 3, 4]
    driven = driving(speed=10.0)  # straight on, although the route turns
    other, _, graph = routes_of(junction(), driven, intended=(1, 3, 4))
    assert other.on_lanes
    assert other.routes[0].xyz[-1, 1] > 100
    assert other.goal[0] == pytest.approx(65.0, abs=4.0)
    changing, _, graph = routes_of(two_lanes(), driving(speed=8.0), intended=(1, 2))
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


def test_route_begins_behind_ego_where_lanes_begin_at_ego():
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


def test_routes_avoid_bike_lanes_and_oncoming_lanes():
    features = (
        lane(1, line((-100, 0), (400, 0)), kind=RoadKind.LANE_BIKE),
        lane(2, line((400, 1), (-100, 1))),
    )
    assert not routes_of(features, driving())[0].on_lanes


def test_standing_ego_has_a_route_ahead_and_no_progress():
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


def test_log_route_follows_the_log_then_its_lane():
    path = driving(speed=10.0)
    path[:, 1] = 0.5 * np.sin(path[:, 0] / 15)
    found, ego, _ = routes_of(two_lanes(), path)
    _, apart = project(found.routes[1].xyz, ego.positions[:, :2])
    assert apart.max() < 0.01
    assert len(found.routes[1].xyz) - 1 >= 90 + PAST_GOAL
    check_smooth(found.routes[1], kink=0.1)


def test_alternatives_differ_and_include_the_lane_change():
    found, _, _ = routes_of(two_lanes(), driving(speed=10.0))
    assert len(found.routes) >= 3
    assert any(route.xyz[-1, 1] > 3.0 for route in found.routes[2:])
    assert len({route.xyz.tobytes() for route in found.routes[2:]}) == len(found.routes) - 2
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


def test_progress_repeats_over_gaps_and_never_decreases():
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


def changing(at_step: int, speed: float = 12.0) -> np.ndarray:
    """A change from y = 0 to y = 3.5 that is half done at this step."""
    path = driving(speed=speed)
    path[:, 1] = 3.5 / (1 + np.exp(-(path[:, 0] - (at_step - 10) * 0.1 * speed) / 5))
    return path


@pytest.mark.parametrize("at_step", [5, 8, 10, 12, 16])
def test_lane_change_under_way_at_the_current_step_is_continued(at_step):
    path = changing(at_step)
    found, ego, _ = routes_of(two_lanes(), path)
    _, apart = project(found.routes[0].xyz, ego.positions[:, :2])
    assert (apart <= 1.5).mean() >= 0.95
    assert apart[: ego.current + 1].max() <= 1.0 + 0.05  # never more than a metre beside where ego drove
    assert apart[-1] < 0.05  # on its lane in the end
    for route in found.routes:
        check_smooth(route, kink=0.12)


def test_offset_path_bends_only_beyond_one_metre():
    straight = line((0, 0), (200, 0))
    driven = np.stack((np.linspace(40, 60, 21), np.full(21, 3.0)), axis=-1)
    bent = join(straight, driven, 30.0)
    assert bent[40:61, 1] == pytest.approx(np.full(21, 2.0))
    assert bent[75, 1] == pytest.approx(1.0)  # half of the way back: the cubic is symmetric without a slope
    assert not bent[90:, 1].any()
    assert not bent[:21, 1].any()
    near = join(straight, driven - [0.0, 2.1], 30.0)
    assert near is straight
    slanted = driven.copy()
    slanted[:, 1] = 1.0 + 0.1 * (slanted[:, 0] - 40)  # reaches y = 3, drifting 0.1 m per metre
    on = join(straight, slanted, 30.0)[:, 1]
    assert on[60] == pytest.approx(2.0)
    assert on[61] - on[60] == pytest.approx(0.1, abs=0.02)  # it goes on as ego moves
    one_pose = join(straight, np.array([[30.0, -2.5]]), 20.0)
    assert one_pose[30, 1] == pytest.approx(-1.5)


def crossing_streets():
    """Two lanes over each other at the ego; it comes from the south-west and goes on along the second."""
    return (
        lane(1, line((-60, 0), (60, 0)), successors=(3,)),
        lane(2, arc((60, 150), 150.0, -np.pi / 2 - 0.8, -np.pi / 2), successors=(3,)),
        lane(3, line((60, 0), (400, 0))),
    )


def test_the_lane_that_fits_the_heading_comes_first():
    curved = arc((60, 150), 150.0, -np.pi / 2 - 0.8, -np.pi / 2, step=0.02)
    total = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(curved[:, :2], axis=0).T))))
    path = np.stack([np.interp(60 + np.arange(91) * 0.5, total, curved[:, i]) for i in (0, 1)], axis=-1)
    found, ego, graph = routes_of(crossing_streets(), path)
    assert graph.lane_id[found.routes[0].lane[20]] == 2
    _, apart = project(found.routes[0].xyz, ego.positions[:, :2])
    assert apart.max() < 0.1


def test_routes_prefer_the_corridor_of_the_intended_route():
    """Two ways around a block of the same length: the corridor decides."""
    features = (
        lane(1, line((-60, 0), (20, 0)), successors=(2, 3)),
        lane(2, line((20, 0), (50, 12), (80, 0)), successors=(4,)),
        lane(3, line((20, 0), (50, -12), (80, 0)), successors=(4,)),
        lane(4, line((80, 0), (400, 0))),
    )
    for corridor in ((1, 2, 4), (1, 3, 4)):
        search = search_of(features, need=250.0, corridor=corridor)
        goal = search.to_goal(np.array([100.0, 0.0, 0.0]), 0.0)[0]
        assert [int(search.graph.lane_id[i]) for i in goal.lanes] == list(corridor)
        first = search.alternatives(2)[0]
        assert [int(search.graph.lane_id[i]) for i in first.lanes] == list(corridor)


def search_of(features, need=200.0, corridor=(), xy=(0.0, 0.0), heading=0.0):
    graph = lane_graph(features, ZERO)
    on = LaneSegments.of(cut(road_lines(features, ZERO, None)), graph)
    index = graph.index()
    return LaneSearch.start(on, np.array([*xy, 0.0]), heading, need, [index[i] for i in corridor])


def test_candidates_are_as_long_as_speed_and_map_require():
    """At least max(200 m, v x 12 s) ahead; as many as the capacity has, if the map has as many."""
    fast, ego, _ = routes_of(two_lanes(end=900.0), driving(speed=25.0))
    for route in fast.routes[2:]:
        s, _ = project(route.xyz, ego.xyz[10:11, :2])
        assert len(route.xyz) - 1 - s[0] >= 300.0 - 1.0
    comb = [lane(0, line((-100, 0), (10, 0)), successors=tuple(range(1, 5)))]
    for i in range(1, 5):
        y = 8.0 * i
        comb.append(lane(i, line((10, 0), (60, y)), successors=tuple(range(10 * i, 10 * i + 4))))
        comb += [lane(10 * i + j, line((60, y), (400, y + 20 * j - 30))) for j in range(4)]
    found, _, _ = routes_of(comb, driving())
    assert len(found.routes) == 12
    ends = {tuple(np.round(route.xyz[-1, :2])) for route in (found.routes[0], *found.routes[2:])}
    assert len(ends) >= 10


# Published routes -----------------------------------------------------------------------------------------------


def brute_force(search: LaneSearch) -> dict[tuple[int, ...], float]:
    """Scores of the first ten paths that use no lane twice, up to the first lane that ends 250 m ahead.

    The order is that of breadth-first search: fewer lanes, then the earlier branch.
    """
    complete, ended = [], []

    def grow(lane_path, number):
        if search.reach(lane_path) >= LEAST_M:
            complete.append((len(number), number, lane_path))
            return
        children = search.expand(lane_path)
        if not any(child.changes == lane_path.changes for child in children):
            ended.append((len(number), number, lane_path))
        for i, child in enumerate(children):
            grow(child, (*number, i))

    for i, lane_path in enumerate(lane_path for lane_path in search.starts if lane_path.lateral <= 2.5):
        grow(lane_path, (i,))
    pool = [*sorted(complete, key=lambda item: item[:2]), *sorted(ended, key=lambda item: item[:2])][:10]
    return {lane_path.lanes: hand_score(search, lane_path) for _, _, lane_path in pool}


def hand_score(search: LaneSearch, lane_path) -> float:
    graph = search.graph
    turns = length = total = 0.0
    changes = 0
    for a, b in zip(lane_path.lanes, (*lane_path.lanes[1:], None), strict=True):
        part = slice(graph.lines.start[a], graph.lines.start[a + 1])
        points = graph.lines.points[part, :2]
        steps = np.diff(points, axis=0)
        turn = abs(wrap(np.arctan2(*steps[-1][::-1]) - np.arctan2(*steps[0][::-1])))
        turns += turn > np.deg2rad(30)
        total += turn
        if b is None or b in graph.successor[a]:
            length += np.hypot(*steps.T).sum()
        else:
            changes += 1
    length -= lane_path.s
    return -0.3 * changes - 0.2 * turns + 0.1 * length - 0.1 * total / length


def network(seed: int, layers: int, width: int):
    """Layers of lanes, linked at random; some turn; straight neighbours run parallel."""
    rng = np.random.default_rng(seed)
    features, x = [], -30.0
    for layer in range(layers):
        length = float(rng.integers(60, 130))
        turns = rng.random(width + 2) < 0.3
        beside = (rng.random(width + 1) < 0.5) & ~turns[:-1] & ~turns[1:]
        for row in range(width):
            number, y = 10 * layer + row, 3.5 * row
            tip = (x + length, y + (length * rng.uniform(-0.4, 0.9) if turns[row + 1] else 0.0))
            features.append(
                lane(
                    number,
                    line((x, y), (x + length / 2, y), tip, step=5.0),
                    successors=tuple(10 * (layer + 1) + r for r in range(width) if rng.random() < 0.6),
                    left_neighbours=(number + 1,) if row + 1 < width and beside[row + 1] else (),
                    right_neighbours=(number - 1,) if row > 0 and beside[row] else (),
                )
            )
        x += length
    return tuple(features)


@given(st.integers(0, 10**6), st.integers(2, 4), st.integers(1, 3))
@settings(max_examples=40)
def test_published_paths_equal_brute_force_enumeration(seed, layers, width):
    search = search_of(network(seed, layers, width), need=LEAST_M)
    lane_paths = published_paths(search)
    expected = brute_force(search)
    assert {lane_path.lanes for lane_path in lane_paths} == set(expected)
    assert len(lane_paths) == len(expected)
    scores = [score(search, lane_path) for lane_path in lane_paths]
    assert scores == pytest.approx([expected[lane_path.lanes] for lane_path in lane_paths])
    assert scores == sorted(scores, reverse=True)  # best first


def two_pairs():
    """Two lanes side by side up to x = 100, and two that follow them up to x = 400."""
    return (
        lane(1, line((-100, 0), (100, 0)), left_neighbours=(2,), successors=(3,)),
        lane(2, line((-100, 3.5), (100, 3.5)), right_neighbours=(1,), successors=(4,)),
        lane(3, line((100, 0), (400, 0))),
        lane(4, line((100, 3.5), (400, 3.5))),
    )


def test_the_published_score_by_hand_best_first():
    """-0.3 lane changes - 0.2 turns + 0.1 length - 0.1 curvature; the published sort keeps the worst."""
    features = (
        lane(1, line((-50, 0), (100, 0)), successors=(2, 3)),
        lane(2, line((100, 0), (300, 0))),
        lane(3, line((100, 0), (110, 0), (110, 10)), successors=(4,)),
        lane(4, line((110, 10), (110, 400))),
    )
    search = search_of(features, need=LEAST_M)
    straight, turning = sorted(published_paths(search), key=lambda lane_path: len(lane_path.lanes))
    assert score(search, straight) == pytest.approx(0.1 * 300)
    length = 100 + 20 + 390
    assert score(search, turning) == pytest.approx(-0.2 + 0.1 * length - 0.1 * (np.pi / 2) / length)
    assert published_paths(search)[0] == turning
    changed = search_of(two_pairs(), need=LEAST_M)
    assert [round(score(changed, lane_path), 6) for lane_path in published_paths(changed)] == [40.0, 39.7]


def test_published_routes_begin_at_the_first_pose_and_lead_to_the_goal():
    found, _, _ = routes_of(two_pairs(), driving(speed=10.0, y=0.4), style="published")
    assert found.on_lanes
    assert found.routes[0].xyz[0] == pytest.approx([-10.0, 0.0, 0.0])
    assert found.progress == pytest.approx(np.arange(91.0), abs=1e-6)
    assert found.goal == pytest.approx([80.0, 0.0])
    assert len(found.routes) == 3  # to the goal, the log, and one with a lane change
    assert all(len(route.xyz) >= 250 for route in (found.routes[0], *found.routes[2:]))
    far, _, _ = routes_of(two_lanes(), driving(speed=10.0, y=-2.6), style="published")
    assert not far.on_lanes  # further than 2.5 m from any lane
    assert len(routes_of(two_lanes(end=100.0), driving(), style="published")[0].routes) >= 2  # a short map


def test_the_published_search_ends_on_dense_graphs():
    """Breadth-first search over a grid of lanes is cut off rather than exponential."""
    rows = 8
    features = []
    for column, row in np.ndindex(12, rows):
        points = line((5.0 * column - 2, 1.0 * row), (5.0 * column + 3, 1.0 * row))
        onward = tuple(100 * (column + 1) + other for other in range(rows))
        features.append(lane(100 * column + row, points, successors=onward))
    assert published_paths(search_of(tuple(features), need=LEAST_M)) == []

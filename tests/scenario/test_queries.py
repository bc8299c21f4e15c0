"""Map queries by the grid equal brute force on generated maps; signs and lanes equal NumPy in float64."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from drivax.scenario.bank.columns import LaneRow
from drivax.scenario.bank.queries import (
    EDGE_CUTOFF_M,
    LANE_CUTOFF_M,
    around_lanes,
    lane_course,
    lane_distance,
    left_of_edges,
    light_crossing,
    offroad_distance,
    project_on_route,
    route_ahead,
    vertex_distances,
)
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.scenario.build.assemble import assemble
from drivax.scenario.recording import MapFeature
from drivax.scenario.schema import RoadKind
from drivax.studies.bench import without_grid
from drivax.synthetic.world import generate_recording
from metric_scenes import fork
from scenes import LANE_M, bank_of, car, line, straight_road


@pytest.fixture(scope="module")
def scenarios():
    return [assemble(generate_recording(5, i)) for i in range(4)]


def poses(scenario, count, rng):
    """Random poses near the map: a point of a segment, shifted by up to 9 m."""
    used = int(scenario.segment_blocks[3])
    pick = rng.integers(0, used, count)
    xy = scenario.segment_a[pick, :2] + rng.uniform(-9, 9, (count, 2))
    return xy.astype(np.float32), rng.uniform(-np.pi, np.pi, count).astype(np.float32)


def corners_of(xy, heading):
    local = np.array([[2.4, 1], [2.4, -1], [-2.4, -1], [-2.4, 1]])
    cos, sin = np.cos(heading), np.sin(heading)
    turn = np.stack([np.stack([cos, sin], -1), np.stack([-sin, cos], -1)], -2)
    return (xy[:, None] + local @ turn).astype(np.float32)


@jax.jit
def _look(bank, index, xy, heading, corners):
    def one(p, h, points):
        direction = jnp.stack([jnp.cos(h), jnp.sin(h)])
        z = jnp.zeros(())
        lanes = around_lanes(bank, index, p, direction, points, z)
        distance, known = left_of_edges(bank, index, p, points, z)
        off = offroad_distance(bank, index, p, points, lanes.points_near, z)
        return lanes, jnp.where(known, distance, 0.0), known, off

    return jax.vmap(one)(xy, heading, corners)


def look(bank, index, xy, heading):
    return _look(bank, index, xy, heading, jnp.asarray(corners_of(np.asarray(xy), np.asarray(heading))))


lanes_at, edges_at, course_at = jax.jit(around_lanes), jax.jit(left_of_edges), jax.jit(lane_course)
crossing = jax.jit(light_crossing)


def test_grid_equals_brute_force(scenarios):
    bank = ScenarioBank.from_scenarios(scenarios)
    whole = without_grid(bank)
    rng = np.random.default_rng(0)
    for row, scenario in enumerate(scenarios):
        xy, heading = (jnp.asarray(part) for part in poses(scenario, 300, rng))
        grid, brute = (look(b, jnp.asarray(row), xy, heading) for b in (bank, whole))
        assert np.asarray(grid[2]).any()
        np.testing.assert_array_equal(grid[2], brute[2])
        np.testing.assert_allclose(grid[1], brute[1], atol=1e-5)
        # Of these, only straddling depends on lanes beyond the cut-off.
        for name in ("near", "points_near", "on_corridor", "wrong_way", "limit", "leaving_lane"):
            np.testing.assert_array_equal(getattr(grid[0], name), getattr(brute[0], name), err_msg=name)
        near = np.asarray(grid[0].near)
        np.testing.assert_array_equal(
            np.asarray(grid[0].straddling)[near], np.asarray(brute[0].straddling)[near]
        )


def test_edge_distance_against_float64(scenarios):
    scenario = scenarios[0]
    bank = ScenarioBank.from_scenarios([scenario])
    xy, heading = poses(scenario, 200, np.random.default_rng(1))
    _, distance, known, _ = look(bank, jnp.asarray(0), jnp.asarray(xy), jnp.asarray(heading))
    edges = int(scenario.segment_blocks[1])
    a, b = (scenario.record[f"segment_{end}"][:edges, :2].astype(np.float64) for end in "ab")
    for points, found, near in zip(
        corners_of(xy, heading), np.asarray(distance), np.asarray(known), strict=True
    ):
        for point, value, is_near in zip(points, found, near, strict=True):
            t = np.clip(((point - a) * (b - a)).sum(1) / ((b - a) ** 2).sum(1), 0, 1)
            nearest = np.linalg.norm(point - a - t[:, None] * (b - a), axis=1).min()
            if abs(nearest - EDGE_CUTOFF_M) < 1e-3:
                continue
            assert is_near == (nearest <= EDGE_CUTOFF_M)
            if is_near:
                assert abs(value) == pytest.approx(nearest, abs=2e-3)


def test_distances_to_lanes_and_to_points_against_float64(scenarios):
    """Points of a map are put on every segment one by one: every half metre from its beginning, and at its end."""
    scenario = scenarios[1]
    bank = ScenarioBank.from_scenarios([scenario])
    xy, _ = poses(scenario, 150, np.random.default_rng(3))
    at, row = jnp.asarray(xy, jnp.float32), jnp.asarray(0)
    lane_m = np.asarray(jax.vmap(lambda p: lane_distance(bank, row, p, jnp.zeros(())))(at))
    found = np.stack(jax.vmap(lambda p: vertex_distances(bank, row, p, 0.5))(at), axis=1)
    edges, ends = int(scenario.segment_blocks[1]), int(scenario.segment_blocks[2])
    a, b = (scenario.record[f"segment_{end}"][:, :2].astype(np.float64) for end in "ab")
    parts = [slice(0, edges), slice(edges, ends)]

    def points(part):
        steps = np.arange(0, 4.01, 0.5)[:, None]
        lines = [(p, q, np.linalg.norm(q - p)) for p, q in zip(a[part], b[part], strict=True)]
        return np.concatenate(
            [np.concatenate([p + steps[steps[:, 0] <= m] * (q - p) / m, q[None]]) for p, q, m in lines]
        )

    for column, cutoff in enumerate((EDGE_CUTOFF_M, LANE_CUTOFF_M)):
        expected = np.linalg.norm(xy[:, None] - points(parts[column]), axis=2).min(axis=1)
        near = expected < cutoff
        assert near.sum() > 20
        np.testing.assert_allclose(found[near, column], expected[near], atol=2e-3)
        assert (found[~near, column] >= cutoff - 2e-3).all()
    begin, along = a[parts[1]], (b - a)[parts[1]]
    t = np.clip(((xy[:, None] - begin) * along).sum(2) / (along**2).sum(1), 0, 1)
    expected = np.linalg.norm(xy[:, None] - begin - t[..., None] * along, axis=2).min(axis=1)
    expected = np.where(expected <= LANE_CUTOFF_M + 1e-3, expected, np.inf)
    sure = ~(np.abs(expected - LANE_CUTOFF_M) <= 1e-3)
    np.testing.assert_allclose(lane_m[sure], expected[sure], atol=2e-3)


def test_side_of_a_sharp_vertex():
    # A wedge of road, drivable to the left of (0,0) -> (10,0) -> (0,4): outside its tip both lines disagree.
    recording = straight_road([car(0, 0, 0, 5)])
    from drivax.scenario.recording import MapFeature
    from drivax.scenario.schema import RoadKind

    wedge = MapFeature(9, RoadKind.EDGE_MEDIAN, line((20, 30), (30, 30), (20, 34), (20, 30)))
    bank = bank_of(replace(recording, features=(*recording.features, wedge)))
    tips = jnp.array([[31.0, 30.5], [31.0, 29.8], [28.0, 30.3], [22.0, 31.0], [19.0, 31.0], [25.0, 29.0]])
    expected = [False, False, True, True, False, False]
    for tip, inside in zip(tips, expected, strict=True):
        distance, known = edges_at(bank, jnp.asarray(0), tip, tip[None], jnp.zeros(()))
        assert bool(known[0])
        assert bool(distance[0] > 0) == inside, tip


def test_segments_of_other_levels_are_ignored():
    bank = bank_of(straight_road([car(0, 0, 0, 5)]))
    point = jnp.array([[0.0, -3.0]])
    below, known = edges_at(bank, jnp.asarray(0), point[0], point, jnp.asarray(0.0))
    assert bool(known[0]) and float(below[0]) == pytest.approx(-1.15, abs=1e-3)
    assert not bool(edges_at(bank, jnp.asarray(0), point[0], point, jnp.asarray(5.0))[1][0])


def test_lanes_of_a_two_lane_road():
    bank = bank_of(straight_road([car(0, 0, 0, 5)]))

    def at(x, y, heading):
        xy = jnp.array([x, y], jnp.float32)
        box = jnp.asarray(corners_of(np.array([[x, y]]), np.array([heading]))[0])
        return lanes_at(
            bank, jnp.asarray(0), xy, jnp.array([np.cos(heading), np.sin(heading)]), box, jnp.zeros(())
        )

    inside = at(0, 0.2, 0.0)
    assert bool(inside.near) and bool(inside.on_corridor) and not bool(inside.straddling)
    assert float(inside.limit) == pytest.approx(13.4)
    backwards = at(0, 0.2, np.pi)
    assert bool(backwards.wrong_way) and float(backwards.limit) == -1.0
    between = at(0, 1.85, 0.0)  # on the line between both lanes: neither holds all corners, together they do
    assert not bool(between.straddling) and bool(between.leaving_lane)
    edge = at(0, -1.5, 0.0)  # right corners 2.5 m from the right lane's centre
    assert bool(edge.straddling)


def test_driven_lane_of_a_fork():
    """At its start a lane of 4 m/s and one of 13.4 m/s hold the box; a connector has the limit of what it joins."""

    def limit(recording, routed, heading=0.0):
        box = jnp.asarray(corners_of(np.array([[1.5, -0.3]]), np.array([heading]))[0])
        xy, direction = jnp.array([1.5, -0.3]), jnp.array([np.cos(heading), np.sin(heading)])
        found = lanes_at(bank_of(recording), jnp.asarray(0), xy, direction, box, jnp.zeros(()), routed)
        assert not bool(found.leaving_lane)
        return float(found.limit)

    ego = [car(0, 0, 0, 5)]
    right, ahead = (fork(ego, route=route) for route in ((1, 5, 6), (1, 3)))
    assert limit(right, True) == pytest.approx(4.0) and limit(ahead, True) == pytest.approx(13.4)
    assert limit(right, False) == limit(ahead, False) == pytest.approx(13.4)
    assert limit(fork(ego, connector=True, route=(1, 5, 6)), True) == pytest.approx(13.4)
    # Of the two lanes only that which turns leads at most 30 degrees away from a heading of -35 degrees.
    assert limit(ahead, True, -np.deg2rad(35)) == pytest.approx(4.0)


def test_crossing_street_is_not_driven_next_to_a_lane():
    """0.1 m outside its lane a car is nearer to a street that crosses at 60 degrees."""
    road = straight_road([car(0, 0, 0, 5)])
    street = MapFeature(9, RoadKind.LANE_SURFACE, line((-50, -90), (50, 83.2)), 5.0, LANE_M, (), ())
    bank = bank_of(replace(road, features=(*road.features, street)))
    xy = np.array([0.5, -1.95])
    box = jnp.asarray(corners_of(xy[None], np.zeros(1))[0])
    found = lanes_at(bank, jnp.asarray(0), jnp.asarray(xy), jnp.array([1.0, 0.0]), box, jnp.zeros(()))
    assert float(found.limit) == pytest.approx(13.4)


def test_limits_of_connectors():
    """Known limits of joined lanes, else the own one, else that of the class."""
    for joined, own, expected in ((13.4, 4.0, 13.4), (9.0, 20.0, 9.0), (0.0, 4.0, 4.0), (0.0, 0.0, 13.4)):
        road = fork([car(0, 0, 0, 5)], limit=own, connector=True)
        features = [replace(f, limit_mps=joined) if f.feature_id in (1, 6) else f for f in road.features]
        bank = bank_of(replace(road, features=tuple(features)))
        turn = np.floor(np.asarray(bank.lanes[0, LaneRow.LANE])) == 2
        assert np.asarray(bank.lanes[0, LaneRow.LIMIT])[turn] == pytest.approx(expected), (joined, own)


def test_followed_lane_fits_position_and_heading():
    """Lanes along +x on y = 0 and y = 3.7."""
    bank = bank_of(straight_road([car(0, 0, 0, 5)]))

    def follow(y, heading):
        direction = jnp.array([np.cos(heading), np.sin(heading)], jnp.float32)
        return course_at(bank, jnp.asarray(0), jnp.array([10.0, y], jnp.float32), direction, jnp.zeros(()))

    for y, centre in ((0.4, 0.0), (-1.2, 0.0), (2.5, 3.7), (4.2, 3.7)):
        direction, offset, there = follow(y, 0.3)
        assert np.asarray(direction) == pytest.approx([1.0, 0.0], abs=1e-5)
        assert float(offset) == pytest.approx(y - centre, abs=1e-4) and bool(there)
    assert not bool(follow(0.4, np.pi)[2])  # against it
    assert not bool(follow(0.4, np.deg2rad(61))[2])  # across it
    assert not bool(follow(-2.6, 0.0)[2])  # beside it


def test_route_projection_and_lookahead():
    bank = bank_of(straight_road([car(0, 0, 0, 5)]))
    index = jnp.asarray(0)
    start = bank.log_progress[0, 10]
    hit = project_on_route(bank, index, jnp.array([7.3, 1.1]), start)
    assert float(hit.along_m - start) == pytest.approx(7.3, abs=1e-3)
    assert float(hit.lateral_m) == pytest.approx(1.1, abs=1e-3)
    rows, there = route_ahead(bank, index, start, jnp.array([5.0, 10.5, 1000.0]))
    np.testing.assert_allclose(rows[:2, :2], [[5, 0], [10.5, 0]], atol=1e-2)
    assert there.tolist() == [True, True, False]


def test_stop_line_is_finite():
    bank = bank_of(straight_road([car(0, 0, 0, 5)], light=4))
    z = jnp.zeros(())
    through, _ = crossing(bank, jnp.asarray(0), jnp.array([39.0, 0.5]), jnp.array([41.0, 0.5]), z)
    beside, _ = crossing(bank, jnp.asarray(0), jnp.array([39.0, 3.0]), jnp.array([41.0, 3.0]), z)
    back, before = crossing(bank, jnp.asarray(0), jnp.array([41.0, 0.5]), jnp.array([39.0, 0.5]), z)
    above, _ = crossing(bank, jnp.asarray(0), jnp.array([39.0, 0.5]), jnp.array([41.0, 0.5]), z + 8.0)
    assert bool(through[0]) and not bool(beside[0]) and not bool(back[0]) and not bool(above[0])
    assert float(before[0]) == pytest.approx(1.0, abs=1e-3)

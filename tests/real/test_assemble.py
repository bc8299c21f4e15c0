"""Assembly of the real recordings at ``../shared/data``: properties of any real map."""

from __future__ import annotations

import numpy as np
import pytest

from drivax.datasets.womd.example_reader import WomdExample
from drivax.datasets.womd.scenario_reader import WomdScenario
from drivax.geometry.polylines import point_to_segment
from drivax.scenario.build.assemble import assemble
from drivax.scenario.recording import with_ego
from drivax.scenario.schema import CAPACITIES, AgentKind, Flag, Scenario

FILES = {
    "scenario": (WomdScenario, "womd/motion_data_one_scenario.tfrecord"),
    "example": (WomdExample, "womd/motion_data_one_example.tfrecord"),
}


@pytest.fixture(scope="module", params=FILES)
def recording(request, real_data):
    pytest.importorskip("google.protobuf", reason="needs the extra 'womd'")
    reader, name = FILES[request.param]
    return next(iter(reader().read(real_data / name)))


@pytest.fixture(scope="module")
def scenario(recording) -> Scenario:
    return assemble(recording)


def ends(scenario, block):
    part = slice(scenario.segment_blocks[block], scenario.segment_blocks[block + 1])
    return (x[part].astype(np.float64) for x in (scenario.segment_a, scenario.segment_b))


def test_every_track_has_a_slot(recording, scenario):
    placed = {*scenario.agent_id[scenario.agent_id >= 0], *scenario.parked_id[scenario.parked_id >= 0]}
    seen = recording.tracks.valid.any(axis=1)
    assert placed == set(recording.tracks.track_id[seen].tolist())
    assert scenario.agent_id[0] == recording.tracks.track_id[recording.ego]
    assert not set(scenario.overflow) - {"lights_without_lane"}


def test_segments_are_short_and_runs_fit_the_queries(scenario):
    used = scenario.segment_blocks[3]
    length = np.hypot(*(scenario.segment_b - scenario.segment_a)[:used, :2].T)
    assert length.max() <= 4.0
    assert length.min() > 0.0
    for start, cap in (
        (scenario.grid_edge, scenario.capacity.edge_run),
        (scenario.grid_lane, scenario.capacity.lane_run),
    ):
        counts = np.diff(start.astype(np.int64)).reshape(64, 64)
        runs = counts[:, :-2] + counts[:, 1:-1] + counts[:, 2:]
        assert runs.max() <= cap


@pytest.mark.parametrize("block", [0, 1])
def test_nine_cells_contain_all_segments_within_eight_metres(scenario, block):
    a, b = ends(scenario, block)
    start = (scenario.grid_edge, scenario.grid_lane)[block].astype(np.int64)
    rng = np.random.default_rng(0)
    for xy in a[rng.integers(0, len(a), 200), :2] + rng.uniform(-8, 8, (200, 2)):
        column, row = np.floor((xy - scenario.grid_origin.astype(np.float64)) / 10.0).astype(int)
        assert 1 <= column < 63
        assert 1 <= row < 63
        found = np.concatenate(
            [
                np.arange(start[y * 64 + column - 1], start[y * 64 + column + 2])
                for y in (row - 1, row, row + 1)
            ]
        )
        distance, _ = point_to_segment(xy[None], a[:, :2], b[:, :2])
        needed = np.flatnonzero(distance <= 8.0) + scenario.segment_blocks[block]
        assert np.isin(needed, found).all()


def test_ego_is_on_the_drivable_side_of_the_nearest_edge(scenario):
    """Check-list 7: edges are oriented, drivable side on the left."""
    a, b = ends(scenario, 0)
    good = []
    for xy in scenario.agent_xy[scenario.agent_valid[:, 0], 0].astype(np.float64):
        distance, _ = point_to_segment(xy[None], a[:, :2], b[:, :2])
        tied = np.flatnonzero(distance <= distance.min() + 1e-3)
        step, offset = (b - a)[tied, :2], xy - a[tied, :2]
        side = (step[:, 0] * offset[:, 1] - step[:, 1] * offset[:, 0]) / np.hypot(*step.T)
        good.append(side[np.abs(side).argmax()] > 0)
    assert np.mean(good) >= 0.99


def test_routes_are_a_metre_apart_and_pass_the_log(scenario):
    for points, xy in zip(scenario.route_points, scenario.route_xy, strict=True):
        if points:
            step = np.hypot(*np.diff(xy[:points].astype(np.float64), axis=0).T)
            assert step == pytest.approx(np.ones(points - 1), abs=0.02)
    log = scenario.agent_xy[scenario.agent_valid[:, 0], 0]
    for row in (0, 1):
        route = scenario.route_xy[row, : scenario.route_points[row]]
        apart = np.hypot(*(log[:, None] - route).transpose(2, 0, 1)).min(axis=1)
        assert apart.max() < (4.0, 0.71)[row]
    assert (np.diff(scenario.log_progress) >= 0).all()
    assert scenario.route_points[0] - 1 - scenario.log_progress[-1] >= 50.0


def test_other_vehicles_as_ego_have_routes(recording):
    """Each of ten logged cars that ends on a lane has a route of lanes along its log."""
    reach = 2.0 if recording.flags & Flag.LANE_GRAPH else 4.0  # a truncated map lacks lanes
    tracks, now = recording.tracks, recording.current_step
    rows = np.flatnonzero((tracks.kind == AgentKind.VEHICLE) & tracks.valid[:, now])[:40:4]
    routed = 0
    for row in rows:
        other = assemble(with_ego(recording, int(row)))
        if Flag.ROUTE in other.has:
            routed += 1
            log = other.agent_xy[other.agent_valid[:, 0], 0]
            route = other.route_xy[0, : other.route_points[0]]
            apart = np.hypot(*(log[:, None] - route).transpose(2, 0, 1)).min(axis=1)
            assert apart.mean() < reach
            moved = np.hypot(*(log[-1] - log[0]))
            assert other.log_progress[-1] - other.log_progress[0] >= 0.8 * moved - 3.0
    assert routed >= 3


def test_further_egos_have_the_routes_of_their_own_recordings(recording):
    """Seven moving cars; where a log is used to its end, the route is that of the recording with this ego."""
    scenario = assemble(recording, CAPACITIES["default"].with_egos(8))
    tracks, compared = recording.tracks, 0
    assert (scenario.ego_slot > 0).all() and scenario.ego_on_lanes.sum() >= 4
    for k, slot in enumerate(scenario.ego_slot):
        (row,) = np.flatnonzero(tracks.track_id == scenario.agent_id[slot])
        last, now = int(scenario.ego_last_step[k]), recording.current_step
        assert tracks.valid[row, now : last + 1].all() and last >= now + 20
        assert np.hypot(*(tracks.xy[row, now : last + 1] - tracks.xy[row, now]).T).max() > 2.0
        if not tracks.valid[row, last + 1 :].any():
            other = assemble(with_ego(recording, int(row)))
            count, shift = int(other.route_points[0]), (other.origin - scenario.origin)[:2]
            route = scenario.ego_route_xy[k, : scenario.ego_route_points[k]]
            np.testing.assert_allclose(route, other.route_xy[0, :count] + shift, atol=0.02)
            assert scenario.ego_on_lanes[k] == (Flag.ROUTE in other.has)
            compared += 1
    assert compared >= 4
